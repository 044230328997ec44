"""pyOMA-2, contained: SSI-dat and a comparison with SSI-cov, without its side effects on the process."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.errors import MissingError
from operando.indicators import mac
from operando.stabilization import Tolerances, classify, select_modes

AGREE_STD, AGREE_HZ, AGREE_MAC = 3.0, 0.002, 0.9
"""Of one mode by two programs: frequencies within so many standard deviations or so large a part of them, and the MAC at least."""

MEMORY_BYTES = 1e9
"""pyOMA-2 holds 2·block rows·channels·samples numbers; the record is cut to what fits here."""


@contextmanager
def contained_pyoma() -> Iterator[Any]:
    """The module ``pyoma2.functions.ssi``, with NumPy's error state and the logging of the process left as they were, no progress bars."""
    state = np.geterr()
    logger, plots = logging.getLogger("pyoma2"), logging.getLogger("matplotlib")
    handlers, level, plot_level = list(logger.handlers), logger.level, plots.level
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                from pyoma2.functions import ssi
            except ImportError as error:
                raise MissingError("pyOMA-2 is not installed", hint="pip install pyOMA-2") from error
            bar = ssi.trange
            ssi.trange = range
            logger.setLevel(logging.CRITICAL)
            try:
                with np.errstate(divide="ignore", invalid="ignore"):
                    yield ssi
            finally:
                ssi.trange = bar
    finally:
        for handler in list(logger.handlers):
            if handler not in handlers:
                logger.removeHandler(handler)
        logger.setLevel(level)
        plots.setLevel(plot_level)
        np.seterr(**state)


def pyoma_poles(
    data: NDArray[Any], sampling_hz: float, rows: int, max_order: int, references: NDArray[np.int_], method: str, max_damping: float = 0.25
) -> tuple[list[int], list[NDArray[Any]], list[NDArray[Any]], list[NDArray[Any]], int]:
    """Poles of all even orders by pyOMA-2 (``cov`` or ``dat``) of samples (r, n_samples).

    Gives orders, frequencies, damping ratios and shapes as ``operando.stabilization.classify`` takes them, and the number of samples used:
    the record is cut where it would not fit into memory.
    """
    r, n = data.shape
    used = int(min(n, MEMORY_BYTES / (16 * rows * r)))
    part = np.asarray(data[:, :used], float)
    part = part - part.mean(axis=1, keepdims=True)
    part = part / part.std()
    with contained_pyoma() as ssi:
        hankel, _ = ssi.build_hank(part, part[references], rows, method)
        obs, state, output, _ = ssi.SSI_fast(hankel, rows, max_order, step=2)
        hz, zeta, shapes, lam, *_ = ssi.SSI_poles(obs, state, output, max_order, 1 / sampling_hz, step=2, xi_max=max_damping)
    orders, f_out, z_out, v_out = [], [], [], []
    for column in range(2, hz.shape[1]):
        keep = np.isfinite(hz[:, column]) & (np.imag(lam[:, column]) > 0)
        orders.append(2 * column)
        f_out.append(hz[keep, column])
        z_out.append(zeta[keep, column])
        v_out.append(shapes[keep, column, :].T)
    return orders, f_out, z_out, v_out, used


def second_opinion(
    hz: NDArray[np.float64],
    zeta: NDArray[np.float64],
    shapes: NDArray[np.complex128],
    std_hz: NDArray[np.float64] | None,
    data: NDArray[Any],
    sampling_hz: float,
    band: tuple[float, float],
    rows: int,
    max_order: int,
    references: NDArray[np.int_],
    tolerances: Tolerances | None = None,
) -> tuple[dict[str, Any], ...]:
    """What pyOMA-2 (SSI-cov, unweighted) makes of the same record, mode by mode.

    Returns
    -------
    tuple of dict
        For each own mode and each mode that only pyOMA-2 sees: ``frequency_hz``, ``other_frequency_hz``, ``damping_ratio``,
        ``other_damping_ratio``, ``mac``, ``agrees``, ``text``; None where there is no partner.
    """
    orders, f, z, v, used = pyoma_poles(data, sampling_hz, rows, max_order, references, "cov")
    other = select_modes(classify(orders, f, z, v, tolerances), band=band, tolerances=tolerances)
    likeness = mac(shapes, np.nan_to_num(other.selected_vectors, posinf=0.0, neginf=0.0))
    free = np.ones(other.selected_hz.size, bool)
    out: list[dict[str, Any]] = []
    for i in range(hz.size):
        near = free & (np.abs(other.selected_hz - hz[i]) < 0.03 * hz[i]) & (likeness[i] > 0.5)
        if not near.any():
            out.append(_row(hz[i], None, zeta[i], None, None, False, "pyOMA-2 does not find this mode"))
            continue
        j = int(np.argmax(np.where(near, likeness[i], -1)))
        free[j] = False
        apart = other.selected_hz[j] - hz[i]
        allowed = max(AGREE_STD * float(std_hz[i]) if std_hz is not None else 0.0, AGREE_HZ * hz[i])
        agrees = bool(abs(apart) <= allowed and likeness[i, j] >= AGREE_MAC)
        damping = 100 * (other.selected_damping[j] / zeta[i] - 1)
        text = f"pyOMA-2 (SSI-cov, {used} samples): {apart:+.3g} Hz, damping ratio {damping:+.3g} %, MAC {likeness[i, j]:.3f}"
        out.append(_row(hz[i], other.selected_hz[j], zeta[i], other.selected_damping[j], likeness[i, j], agrees, text))
    for k in np.flatnonzero(free):
        out.append(_row(None, other.selected_hz[k], None, other.selected_damping[k], None, False, "only pyOMA-2 finds this mode"))
    return tuple(out)


def _row(f: Any, f2: Any, z: Any, z2: Any, likeness: Any, agrees: bool, text: str) -> dict[str, Any]:
    number = lambda x: None if x is None else float(x)  # noqa: E731
    return {
        "frequency_hz": number(f),
        "other_frequency_hz": number(f2),
        "damping_ratio": number(z),
        "other_damping_ratio": number(z2),
        "mac": number(likeness),
        "agrees": agrees,
        "text": text,
    }


__all__: Sequence[str] = ["contained_pyoma", "pyoma_poles", "second_opinion"]

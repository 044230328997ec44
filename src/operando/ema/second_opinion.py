"""sdypy-EMA for comparison with the poles of a fitted model: another program, another estimator (common-denominator LSCF)."""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data import Frf, ModalModel
from operando.errors import DataError, MissingError
from operando.indicators import mac

__all__ = ["second_opinion"]

_Pole = tuple[float, float, Any]
"""Frequency, damping ratio, and where it stands in that program's lists."""

FREQUENCY_TOLERANCE = 0.005
DAMPING_TOLERANCE = 0.1
"""Largest relative differences that count as agreement."""


def second_opinion(
    frequencies_hz: ArrayLike,
    H: ArrayLike,
    mode_hz: ArrayLike,
    zeta: ArrayLike,
    *,
    references: Sequence[object] | None = None,
    shapes: ArrayLike | None = None,
    quantity: str = "accelerance",
    max_order: int | None = None,
    max_lines: int = 8000,
    frequency_tolerance: float = FREQUENCY_TOLERANCE,
    damping_tolerance: float = DAMPING_TOLERANCE,
) -> list[dict[str, Any]]:
    """Poles that sdypy-EMA finds next to those of a model, reference by reference.

    Parameters
    ----------
    frequencies_hz : (n_lines,) array
        Evenly spaced. Where they do not start at a multiple of their spacing (which biases that program), the FRFs are interpolated;
        lines from 0 on are added here, since that program sometimes adds one too many.
    H : (n_resp, n_ref, n_lines) complex array
        A copy is handed over: that program changes its input. Responses with values that are not finite are left out.
    mode_hz, zeta : (n,) arrays
        The model to compare with.
    references : sequence, optional
        Labels of the references.
    shapes : (n_resp, n) array, optional
        Shapes of the model at the responses, for the MAC with that program's.
    quantity : {"accelerance", "mobility", "receptance"}
    max_order : int, optional
        Highest polynomial order (number of poles); default 3 for each mode, between 20 and 80.
    max_lines : int
        Every n-th line is used above this number.
    frequency_tolerance, damping_tolerance : float
        Largest relative differences that count as agreement.

    Returns
    -------
    list of dict
        One for each mode and reference: ``mode``, ``reference``, ``frequency_hz``, ``damping_ratio`` (of the model),
        ``second_frequency_hz``, ``second_damping_ratio`` (None where nothing stable lies within half the distance to the next mode),
        ``frequency_difference_percent``, ``damping_difference_percent``, ``mac`` (None without shapes), ``agrees`` and a ``note``. A mode
        that a reference does not excite may well be missing there; disagreement at all references is what deserves a look.

    Raises
    ------
    DataError
        If shapes disagree or the lines are not even.
    MissingError
        If sdypy-EMA is not installed.

    Examples
    --------
    >>> import numpy as np, operando
    >>> idle = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> frf = idle.frf(np.arange(5, 80, 0.1))
    >>> from operando.ema import second_opinion
    >>> told = second_opinion(frf.frequencies_hz, frf.data[:, :1], [45.0], [0.02])
    >>> round(told[0]["second_frequency_hz"], 2), told[0]["agrees"]
    (45.0, True)
    """
    f, data = np.asarray(frequencies_hz, float), np.asarray(H, complex)
    hz, damping = np.atleast_1d(np.asarray(mode_hz, float)), np.atleast_1d(np.asarray(zeta, float))
    if data.ndim != 3 or data.shape[2] != f.size or hz.shape != damping.shape:
        raise DataError(f"FRFs {data.shape}, {f.size} lines, {hz.size} frequencies and {damping.size} dampings do not fit together")
    labels = [str(k) for k in range(data.shape[1])] if references is None else [str(r) for r in references]
    f, data = _on_multiples(f, data, max_lines)
    order = max_order or int(np.clip(3 * hz.size, 20, 80))
    # The program averages stable poles within 2 Hz whatever the scale: stretch the axis until that is a narrow window.
    window = _windows(hz, damping)
    stretch = 2 / max(float(np.min(window)), 1e-9 * float(f[-1]))
    out = []
    with _contained() as model_class:
        for k, label in enumerate(labels):
            rows = np.all(np.isfinite(data[:, k]), axis=1) & np.any(data[:, k] != 0, axis=1)
            found, model = _poles(model_class, f * stretch, data[rows, k], order, quantity, hz * stretch)
            seen = [
                _compared(r, label, hz[r], damping[r], found[r], stretch, window[r], frequency_tolerance, damping_tolerance)
                for r in range(hz.size)
            ]
            if shapes is not None:
                kept = [r for r in range(hz.size) if seen[r]["second_frequency_hz"] is not None]
                for r, likeness in zip(kept, _macs(model, [found[r] for r in kept], np.asarray(shapes)[rows][:, kept]), strict=True):
                    seen[r]["mac"] = likeness
            out += seen
    return out


def opinion_on(frf: Frf, model: ModalModel) -> tuple[dict[str, Any], ...]:
    """The same of a fitted model and its FRFs."""
    # That program knows nothing of the window: it is compared with the damping that the FRFs carry.
    damping = model.damping_ratios + frf.exponential_window_rate / (2 * np.pi * model.frequencies_hz)
    return tuple(second_opinion(frf.frequencies_hz, frf.data, model.frequencies_hz, damping, references=[str(r) for r in frf.references]))


def _on_multiples(f: NDArray[np.float64], data: NDArray[np.complex128], max_lines: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Lines at multiples of their spacing."""
    step = (f[-1] - f[0]) / (f.size - 1)
    if not np.allclose(np.diff(f), step, rtol=1e-4):
        raise DataError("the comparison with sdypy-EMA needs evenly spaced lines")
    stride = int(np.ceil(f.size / max_lines))
    step *= stride
    offset = f[0] / step - np.round(f[0] / step)
    if abs(offset) < 1e-3 and stride == 1:
        return f.copy(), data.copy()
    from scipy.interpolate import CubicSpline

    wanted = step * np.arange(np.ceil(f[0] / step - 1e-9), np.floor(f[-1] / step + 1e-9) + 1)
    finite = np.all(np.isfinite(data), axis=2)
    out = np.full((*data.shape[:2], wanted.size), np.nan, complex)
    out[finite] = CubicSpline(f, data[finite], axis=-1)(wanted)
    return wanted, out


def _windows(hz: NDArray[np.float64], zeta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Half the distance to the next mode, at most 2 % of the frequency, at least a tenth of the half-power width."""
    apart = np.abs(hz[:, None] - hz[None, :]) + np.where(np.eye(hz.size, dtype=bool), np.inf, 0)
    return np.asarray(np.clip(0.5 * apart.min(axis=1), 0.2 * zeta * hz, 0.02 * hz))


@contextmanager
def _contained() -> Iterator[Any]:
    """The class of the other program, without its side effects on plotting, NumPy's error state and warnings."""
    backend = os.environ.get("MPLBACKEND")
    state = np.geterr()
    os.environ["MPLBACKEND"] = backend or "Agg"
    try:
        # it also draws progress bars on stderr when asked not to
        with warnings.catch_warnings(), redirect_stderr(io.StringIO()):
            warnings.simplefilter("ignore")
            try:
                from sdypy import EMA
            except ImportError as error:
                raise MissingError("sdypy-EMA cannot be imported", hint="pip install sdypy-EMA") from error
            yield EMA.Model
    finally:
        np.seterr(**state)
        if backend is None:
            os.environ.pop("MPLBACKEND", None)


def _poles(
    model_class: Any, f: NDArray[np.float64], column: NDArray[np.complex128], order: int, quantity: str, hz: NDArray[np.float64]
) -> tuple[list[_Pole | None], Any]:
    """Pole next to each frequency, or None; and that program's model."""
    if column.shape[0] == 0:
        return [None] * hz.size, None
    step = (f[-1] - f[0]) / (f.size - 1)
    before = round(f[0] / step)
    axis = step * np.arange(before + f.size)
    padded = np.concatenate([np.zeros((column.shape[0], before), complex), column], axis=1)
    model = model_class(frf=padded, freq=axis, lower=float(f[0]), upper=float(f[-1]), pol_order_high=order, frf_form=quantity)
    model.get_poles(show_progress=False)
    out: list[_Pole | None] = []
    for target in hz:
        try:
            model.select_closest_poles([float(target)], f_window=4)
            out.append((float(model.nat_freq[0]), float(model.nat_xi[0]), model.pole_ind[0]))
        except (ValueError, IndexError):
            # it cannot choose where no pole at all is stable
            out.append(None)
    return out, model


def _macs(model: Any, poles: Sequence[_Pole | None], shapes: NDArray[Any]) -> list[float]:
    """MAC of that program's shapes, from residues at all these poles together, with those of the model, one by one."""
    found = [pole for pole in poles if pole is not None]
    if not found:
        return []
    model.pole_ind = np.array([pole[2] for pole in found])
    model.get_constants(method="lsfd")
    found_shapes = np.nan_to_num(model.A, posinf=0.0, neginf=0.0)  # values that are no numbers are like no motion
    return [float(mac(found_shapes[:, [i]], shapes[:, [i]])[0, 0]) for i in range(len(found))]


def _compared(
    mode: int,
    reference: str,
    hz: float,
    zeta: float,
    found: _Pole | None,
    stretch: float,
    window: float,
    frequency_tolerance: float,
    damping_tolerance: float,
) -> dict[str, Any]:
    out: dict[str, Any] = {"mode": mode, "reference": reference, "frequency_hz": float(hz), "damping_ratio": float(zeta)}
    near = found is not None and np.isfinite(found[0]) and abs(found[0] / stretch - hz) <= window
    if found is None or not near:
        return out | {
            "second_frequency_hz": None,
            "second_damping_ratio": None,
            "frequency_difference_percent": None,
            "damping_difference_percent": None,
            "mac": None,
            "agrees": False,
            "note": f"no stable pole within {window:.3g} Hz",
        }
    other_hz, other_zeta = found[0] / stretch, found[1]
    df, dz = other_hz / hz - 1, other_zeta / zeta - 1
    agrees = abs(df) <= frequency_tolerance and abs(dz) <= damping_tolerance
    return out | {
        "second_frequency_hz": float(other_hz),
        "second_damping_ratio": float(other_zeta),
        "frequency_difference_percent": float(100 * df),
        "damping_difference_percent": float(100 * dz),
        "mac": None,
        "agrees": bool(agrees),
        "note": "" if agrees else f"differs by {100 * df:.2g} % in frequency, {100 * dz:.2g} % in damping",
    }

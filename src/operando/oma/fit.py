"""Operational modal analysis of output-only records."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from operando.data import ModalModel, TimeRecord
from operando.errors import ConfigError, IdentificationError
from operando.oma.conditioning import Responses, gather_responses, resample
from operando.oma.correlation import BlockCorrelations, block_hankel, correlate, pool
from operando.oma.details import OmaDetails
from operando.oma.spectra import output_spectra
from operando.oma.subspace import factorise, poles_of_orders, realise
from operando.stabilization import Tolerances, classify, select_modes

METHODS = ("ssi-cov", "ssi-dat")


def fit_oma(
    record: TimeRecord | Sequence[TimeRecord],
    *,
    band: tuple[float, float] | None = None,
    max_order: int | None = None,
    references: object = None,
    known_harmonics_hz: Sequence[float] = (),
    select_hz: Sequence[float] = (),
    reject_hz: Sequence[float] = (),
    method: str = "ssi-cov",
    block_rows: int | None = None,
    tolerances: Tolerances | None = None,
) -> ModalModel:
    """Modes of a running structure from its responses alone.

    Parameters
    ----------
    record : TimeRecord or sequence of TimeRecord
        One run or several (their correlations are averaged). Forces are ignored.
    band : (low, high), optional
        Analysis band [Hz]; default from ten periods in a run to 0.4 of the sampling rate.
    max_order : int, optional
        Largest model order (states).
    references : DOF labels, optional
        Channels correlated with; default all.
    known_harmonics_hz : sequence of float
        Rotor orders known to the user [Hz].
    select_hz, reject_hz : sequences of float
        Choice by hand.
    method : {"ssi-cov", "ssi-dat"}
    block_rows : int, optional
        Block rows (and columns) of the Hankel matrix.

    Returns
    -------
    ModalModel
        Complex shapes of unit norm with the largest component real and positive, "unscaled"; ``details`` is an ``OmaDetails``.

    Raises
    ------
    DataError, DofError, IdentificationError, ConfigError
    """
    if method not in METHODS:
        raise ConfigError(f"method {method!r} is none of {', '.join(METHODS)}")
    responses = gather_responses(record)
    band = _band(band, responses)
    with threadpool_limits(1, "blas"):
        runs, rate = _at_suitable_rate(responses, band)
        r = len(responses.dofs)
        refs = _reference_rows(references, responses)
        rows = block_rows or int(np.clip(round(800 / r), 30, 120))
        order = max_order or int(min(80, (rows - 1) * r, rows * refs.size))
        correlations = _correlations(runs, refs, 2 * rows, 1)
        factors = factorise(block_hankel(correlations.mean, rows, rows), order)
        realisation = realise(factors, r)
        orders = list(range(4, factors.s.size + 1, 2))
        poles = poles_of_orders(realisation, orders, rate)
        table = classify(orders, [p.hz for p in poles], [p.zeta for p in poles], [p.shapes for p in poles], tolerances)
        spectra = output_spectra(responses.runs, responses.sampling_hz, band)
        stabilization = select_modes(
            table,
            band=band,
            tolerances=tolerances,
            select_hz=select_hz,
            reject_hz=reject_hz,
            indicator_hz=spectra.frequencies_hz,
            indicator=spectra.singular_values,
        )
    shapes = normalise_shapes(
        to_displacement(stabilization.selected_vectors, stabilization.selected_hz, stabilization.selected_damping, responses)
    )
    settings: dict[str, Any] = {
        "method": method,
        "band": list(band),
        "block_rows": rows,
        "max_order": int(factors.s.size),
        "sampling_hz": rate,
    }
    details = OmaDetails(stabilization, np.asarray(known_harmonics_hz, float), spectra, settings=settings)
    return ModalModel(
        stabilization.selected_hz,
        stabilization.selected_damping,
        shapes,
        responses.dofs,
        "unscaled",
        band_hz=band,
        findings=responses.findings,
        provenance=responses.provenance.then(f"fit_oma(method={method!r}, band={band}, block_rows={rows}, max_order={order})"),
        details=details,
    )


def normalise_shapes(shapes: NDArray[Any]) -> NDArray[np.complex128]:
    """Unit norm, largest component real and positive."""
    out = np.array(shapes, complex)
    for column in out.T:
        peak = column[np.argmax(np.abs(column))]
        if peak != 0:
            column *= abs(peak) / peak / np.linalg.norm(column)
    return out


def to_displacement(
    shapes: NDArray[Any], hz: NDArray[np.float64], zeta: NDArray[np.float64], responses: Responses
) -> NDArray[np.complex128]:
    """Shapes in proportions of displacement where channels measure different quantities (each divided by its power of λ)."""
    if np.all(responses.derivative == responses.derivative[0]):
        return np.asarray(shapes, complex)
    w = 2 * np.pi * hz
    lam = -zeta * w + 1j * w * np.sqrt(1 - zeta**2)
    return np.asarray(shapes / lam[None, :] ** responses.derivative[:, None])


def _band(band: tuple[float, float] | None, responses: Responses) -> tuple[float, float]:
    rate = responses.sampling_hz
    duration = min(run.shape[1] for run in responses.runs) / rate
    if band is None:
        return 10 / duration, 0.4 * rate
    low, high = float(band[0]), float(band[1])
    if not 0 <= low < high:
        raise ConfigError(f"band {band} Hz is empty", hint="give [low, high] in Hz")
    if high >= rate / 2:
        raise ConfigError(f"band reaches {high:g} Hz, half the sampling rate is {rate / 2:g} Hz")
    return low, high


def _at_suitable_rate(responses: Responses, band: tuple[float, float]) -> tuple[list[NDArray[Any]], float]:
    """Resample to two and a half times the upper band limit where the record is much faster."""
    wanted = 2.5 * band[1]
    if responses.sampling_hz < 1.3 * wanted:
        return list(responses.runs), responses.sampling_hz
    done = [resample(run, responses.sampling_hz, 1.05 * band[1], wanted) for run in responses.runs]
    return [d[0] for d in done], done[0][1]


def _reference_rows(references: object, responses: Responses) -> NDArray[np.int_]:
    from operando.dof import match_dofs, parse_dofs

    if references is None:
        return np.arange(len(responses.dofs))
    return np.array(match_dofs(parse_dofs(references), responses.dofs)[0])


def _correlations(runs: list[NDArray[Any]], refs: NDArray[np.int_], n_lags: int, n_blocks: int) -> BlockCorrelations:
    shortest = min(run.shape[1] for run in runs)
    if shortest < 4 * n_lags:
        raise IdentificationError(
            f"{shortest} samples are too few for {n_lags} correlation lags", hint="take longer runs, or fewer block_rows (keyword)"
        )
    samples = [run.shape[1] for run in runs]
    centred = [run - run.mean(axis=1, keepdims=True) for run in runs]
    return pool([correlate(run, refs, n_lags, n_blocks, n_blocks > 1) for run in centred], samples)

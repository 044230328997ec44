"""Operational modal analysis of output-only records."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from operando.data import Finding, ModalModel, TimeRecord
from operando.errors import ConfigError, IdentificationError
from operando.oma.conditioning import Responses, gather_responses, resample
from operando.oma.correlation import BlockCorrelations, correlate, pool
from operando.oma.details import OmaDetails
from operando.oma.estimate import Estimate, best_orders, estimate_modes
from operando.oma.harmonics import Harmonic, find_harmonics
from operando.oma.spectra import output_spectra
from operando.oma.subspace import Factors, factorise_weighted, poles_of_orders, realise
from operando.stabilization import Stabilization, Tolerances, classify, demote, select_modes

METHODS = ("ssi-cov", "ssi-dat")
WEIGHTINGS = ("cva", "none")
MAX_ORDER = 120
UNCERTAIN = 4.0


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
    weighting: str = "cva",
    uncertainty: bool = True,
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
    r = len(responses.dofs)
    refs = _reference_rows(references, responses)
    rows = block_rows or int(np.clip(round(800 / r), 30, 120))
    with threadpool_limits(1, "blas"):
        spectra = output_spectra(responses.runs, responses.sampling_hz, band)
        runs, rate = _at_suitable_rate(responses, band)
        runs, harmonics = _without_harmonics(runs, rate, band, known_harmonics_hz)
        correlations = _correlations(runs, refs, 2 * rows, uncertainty)
        samples = sum(run.shape[1] for run in runs)
        factors = factorise_weighted(correlations.mean, refs, rows, 2 * (max_order or MAX_ORDER), samples, weighting)
        order = max_order or default_order(factors, samples, weighting)
        order = min(order, factors.s.size - 1, (rows - 1) * r)
        realisation = realise(factors, r)
        orders = list(range(4, order + 1, 2))
        poles = poles_of_orders(realisation, orders, rate)
        table = classify(orders, [p.hz for p in poles], [p.zeta for p in poles], [p.shapes for p in poles], tolerances)
        stabilization = select_modes(
            table,
            band=band,
            tolerances=tolerances,
            select_hz=select_hz,
            reject_hz=reject_hz,
            indicator_hz=spectra.frequencies_hz,
            indicator=spectra.singular_values,
        )
        stabilization = demote(stabilization, harmonic_poles(stabilization, harmonics, select_hz))
        for _ in range(2):
            groups = best_orders(stabilization, orders)
            estimate = estimate_modes(groups, poles, orders, correlations, factors, realisation, responses.derivative, rows, rate, table)
            doubtful = uncertain_modes(estimate, samples / rate, select_hz)
            if not doubtful:
                break
            stabilization = demote(stabilization, doubtful)
    settings: dict[str, Any] = {
        "method": method,
        "weighting": weighting,
        "band": list(band),
        "block_rows": rows,
        "max_order": order,
        "sampling_hz": rate,
        "references": [str(responses.dofs[i]) for i in refs],
        "blocks": int(correlations.weights.size),
    }
    details = OmaDetails(stabilization, np.array([h.hz for h in harmonics]), spectra, model_orders=estimate.orders, settings=settings)
    return ModalModel(
        estimate.hz,
        estimate.zeta,
        estimate.shapes,
        responses.dofs,
        "unscaled",
        covariance=estimate.covariance,
        band_hz=band,
        findings=(*responses.findings, *[_finding(h) for h in harmonics]),
        provenance=responses.provenance.then(f"fit_oma(method={method!r}, band={band}, block_rows={rows}, max_order={order})"),
        details=details,
    )


def default_order(factors: Factors, samples: int, weighting: str) -> int:
    """Largest model order worth looking at: a third beyond the canonical correlations that exceed what white noise gives."""
    if weighting != "cva":
        return min(80, factors.s.size)
    level = np.sqrt(factors.left.shape[0] / samples) + np.sqrt(factors.right.shape[0] / samples)
    signal = int(np.sum(factors.s > level))
    return int(np.clip(2 * round(1.3 * signal / 2), 20, MAX_ORDER))


def _without_harmonics(
    runs: list[NDArray[Any]], rate: float, band: tuple[float, float], known_hz: Sequence[float]
) -> tuple[list[NDArray[Any]], list[Harmonic]]:
    """Runs without their sinusoids, and all sinusoids found in any of them (each frequency once, the strongest)."""
    out, found = [], []
    for run in runs:
        harmonics, clean = find_harmonics(run, rate, (0.9 * band[0], min(1.05 * band[1], 0.48 * rate)), known_hz)
        out.append(clean)
        found += harmonics
    union: list[Harmonic] = []
    for h in sorted(found, key=lambda h: h.hz):
        if union and h.hz - union[-1].hz < max(0.002 * h.hz, h.spread_hz):
            union[-1] = max(union[-1], h, key=lambda x: x.energy_share)
        else:
            union.append(h)
    return out, union


def harmonic_poles(stabilization: Stabilization, harmonics: list[Harmonic], keep_hz: Sequence[float]) -> dict[int, tuple[str, str]]:
    """Selected modes that are what is left of a sinusoid: at its frequency and hardly damped."""
    out = {}
    for i, (hz, zeta) in enumerate(zip(stabilization.selected_hz, stabilization.selected_damping, strict=True)):
        for h in harmonics:
            near = max(0.002 * hz, h.spread_hz)
            if abs(hz - h.hz) < near and zeta < 0.001 and not any(abs(hz - f) < 0.01 * f for f in keep_hz):
                text = f"{hz:.5g} Hz with damping ratio {100 * zeta:.2g} % lies on the sinusoid of {h.hz:.5g} Hz"
                out[i] = ("harmonic", f"{text} (envelope kurtosis {h.kurtosis:.2f})")
    return out


def uncertain_modes(estimate: Estimate, seconds: float, keep_hz: Sequence[float]) -> dict[int, tuple[str, str]]:
    """Modes far less certain than a resonance of that frequency and damping would be in so long a record.

    A mode under white excitation has a relative standard deviation of damping of at least 1/√(2πζfT) (long-data
    asymptotics at high signal-to-noise ratio, Au 2014). Poles that model noise or the flank of a filter are several times worse.
    """
    if estimate.covariance is None:
        return {}
    out = {}
    n = estimate.hz.size
    std = np.sqrt(np.diag(estimate.covariance))
    for i in range(n):
        hz, zeta = float(estimate.hz[i]), float(estimate.zeta[i])
        bound = 1 / np.sqrt(2 * np.pi * abs(zeta) * hz * seconds)
        relative = float(std[n + i] / abs(zeta))
        if relative > max(0.5, UNCERTAIN * bound) and not any(abs(hz - f) < 0.01 * f for f in keep_hz):
            value = f"damping ratio {100 * zeta:.3g} % ± {100 * float(std[n + i]):.3g} %"
            out[i] = ("uncertain", f"{value}: {relative / bound:.1f} times the scatter of a mode at {hz:.4g} Hz in {seconds:.4g} s")
    return out


def _finding(h: Harmonic) -> Finding:
    kind = "steady" if h.spread_hz == 0 else f"drifting within {h.spread_hz:.2g} Hz"
    return Finding(
        "harmonic",
        f"sinusoid at {h.hz:.5g} Hz, {kind}, up to {100 * h.energy_share:.2g} % of a channel's mean square",
        "info",
        band_hz=(h.hz - max(h.spread_hz, 1e-3 * h.hz) / 2, h.hz + max(h.spread_hz, 1e-3 * h.hz) / 2),
        consequence="taken out of the operating records before identification, so that it is not taken for a mode",
        action="name rotor orders as known_harmonics_hz to be sure of them",
    )


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
    return np.unique(match_dofs(parse_dofs(references), responses.dofs)[0])


def _correlations(runs: list[NDArray[Any]], refs: NDArray[np.int_], n_lags: int, uncertainty: bool) -> BlockCorrelations:
    """Pooled correlations in blocks of at least four times the lags, about a hundred at most: neighbours hardly depend on each other."""
    samples = [run.shape[1] for run in runs]
    if min(samples) < 5 * n_lags:
        raise IdentificationError(
            f"{min(samples)} samples are too few for {n_lags} correlation lags", hint="take longer runs, or fewer block_rows (keyword)"
        )
    length = max(4 * n_lags, sum(samples) // 100)
    parts = []
    for run, n in zip(runs, samples, strict=True):
        centred = run - run.mean(axis=1, keepdims=True)
        parts.append(correlate(centred, refs, n_lags, max(1, (n - n_lags) // length) if uncertainty else 1, uncertainty))
    return pool(parts, samples)

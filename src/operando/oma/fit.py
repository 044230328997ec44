"""Operational modal analysis of output-only records."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from operando.data import Finding, ModalModel, TimeRecord
from operando.dof import match_dofs, parse_dofs
from operando.errors import ConfigError, IdentificationError
from operando.oma.conditioning import Responses, gather_responses, resample
from operando.oma.details import OmaDetails
from operando.oma.diagram import MIN_BLOCKS, CovDiagram, DatDiagram, Prepared, ssi_cov_diagram, ssi_dat_diagram
from operando.oma.estimate import best_orders
from operando.oma.harmonics import Harmonic, find_harmonics
from operando.oma.pyoma import second_opinion as pyoma_opinion
from operando.oma.spectra import output_spectra
from operando.oma.verdicts import harmonic_finding, harmonic_poles, stationarity_findings, uncertain_modes
from operando.stabilization import Tolerances, demote, select_modes

METHODS = ("ssi-cov", "ssi-dat")
WEIGHTINGS = ("cva", "none")


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
    second_opinion: bool = False,
) -> ModalModel:
    """Modes of a running structure from its responses alone.

    Covariance-driven stochastic subspace identification (Van Overschee & De Moor 1996; Peeters & De Roeck 1999) with
    canonical-variate weights on unwindowed FFT correlations. Sinusoids are found and taken out first; modes are chosen
    automatically, and every candidate that is not taken keeps its reason; standard deviations come from the scatter between blocks
    of the record (``operando.oma.uncertainty``).

    Parameters
    ----------
    record : TimeRecord or sequence of TimeRecord
        One run or several over the same sensors (their correlations are averaged). Only response channels with a DOF are used;
        displacement, velocity and acceleration may be mixed.
    band : (low, high), optional
        Analysis band [Hz]; default from ten periods in a run to 0.4 of the sampling rate.
    max_order : int, optional
        Largest model order (states); default from the canonical correlations.
    references : DOF labels, optional
        Channels correlated with; default all.
    known_harmonics_hz : sequence of float
        Rotor orders known to the user [Hz]: taken out whether or not they stand out.
    select_hz, reject_hz : sequences of float
        Choice by hand [Hz]: taken beside the automatic choice, or left out (``operando.stabilization.select_modes``).
    method : {"ssi-cov", "ssi-dat"}
        ``ssi-dat`` is run by pyOMA-2, on the longest run, without uncertainty.
    block_rows : int, optional
        Block rows (and columns) of the Hankel matrix.
    tolerances : Tolerances, optional
        Of the stabilisation diagram.
    weighting : {"cva", "none"}
        ``none`` is plain SSI-cov.
    uncertainty : bool
        False leaves the covariance out (faster).
    second_opinion : bool
        Also run pyOMA-2's SSI-cov and list where it disagrees (``details.second_opinion``).

    Returns
    -------
    ModalModel
        "unscaled", complex shapes in proportions of displacement, each of unit norm with its largest component real and positive (also
        in the covariance); ``details`` is an ``OmaDetails``.

    Raises
    ------
    DataError, DofError
        If the record cannot be used (no response DOF, samples that are not finite, runs that do not fit together).
    ConfigError
        If an option is out of range.
    IdentificationError
        If the record is too short, no mode is found, or one chosen by hand is absent.
    """
    if method not in METHODS:
        raise ConfigError(f"method {method!r} is none of {', '.join(METHODS)}")
    if weighting not in WEIGHTINGS:
        raise ConfigError(f"weighting {weighting!r} is none of {', '.join(WEIGHTINGS)}")
    responses = gather_responses(record)
    band = _band(band, responses)
    refs = _reference_rows(references, responses)
    with threadpool_limits(1, "blas"):
        runs, rate = _at_suitable_rate(responses, band)
        rows = block_rows or default_block_rows(len(responses.dofs), [run.shape[1] for run in runs])
        runs, harmonics = _without_harmonics(runs, rate, band, known_harmonics_hz)
        prepared = Prepared(runs, rate, rows, refs, responses.derivative)
        diagram: CovDiagram | DatDiagram
        if method == "ssi-cov":
            diagram = ssi_cov_diagram(prepared, max_order, weighting, uncertainty, tolerances)
        else:
            diagram = ssi_dat_diagram(prepared, max_order, tolerances)
        spectra = output_spectra(responses.runs, responses.sampling_hz, band)
        stabilization = select_modes(
            diagram.table,
            band=band,
            tolerances=tolerances,
            select_hz=select_hz,
            reject_hz=reject_hz,
            indicator_hz=spectra.frequencies_hz,
            indicator=spectra.singular_values,
        )
        stabilization = demote(stabilization, harmonic_poles(stabilization, harmonics, select_hz))
        if stabilization.selected_hz.size == 0:
            raise IdentificationError(
                f"no mode found between {band[0]:g} and {band[1]:g} Hz in {diagram.orders[-1]} states",
                hint="look at the spectra; widen the band, raise max_order, or choose poles by hand with select_hz",
            )
        estimate = diagram.estimate(best_orders(stabilization, diagram.orders))
        doubtful = uncertain_modes(estimate, prepared.seconds, select_hz)
        keep = [i for i in range(estimate.hz.size) if i not in doubtful]
        stabilization = demote(stabilization, doubtful)
        opinion = None
        if second_opinion:
            std = None if estimate.covariance is None else np.sqrt(np.diag(estimate.covariance))[: estimate.hz.size][keep]
            longest = max(runs, key=lambda run: run.shape[1])
            opinion = pyoma_opinion(
                estimate.hz[keep],
                estimate.zeta[keep],
                estimate.shapes[:, keep],
                std,
                longest,
                rate,
                band,
                rows,
                diagram.orders[-1],
                refs,
                tolerances,
            )
    settings: dict[str, Any] = {
        "method": method,
        "weighting": weighting if method == "ssi-cov" else "pyOMA-2",
        "band": list(band),
        "block_rows": rows,
        "max_order": diagram.orders[-1],
        "sampling_hz": rate,
        "references": [str(responses.dofs[i]) for i in refs],
        "known_harmonics_hz": [float(f) for f in known_harmonics_hz],
        "select_hz": [float(f) for f in select_hz],
        "reject_hz": [float(f) for f in reject_hz],
        "blocks": diagram.blocks,
        "runs": len(runs),
    }
    details = OmaDetails(stabilization, np.array([h.hz for h in harmonics]), spectra, opinion, estimate.orders[keep], settings)
    call = ", ".join(f"{k}={v!r}" for k, v in settings.items())
    model = ModalModel(
        estimate.hz,
        estimate.zeta,
        estimate.shapes,
        responses.dofs,
        "unscaled",
        in_band=(estimate.hz >= band[0]) & (estimate.hz <= band[1]),
        covariance=estimate.covariance,
        band_hz=band,
        findings=(
            *responses.findings,
            *stationarity_findings(runs, rate),
            *[harmonic_finding(h) for h in harmonics],
            *_statistics_findings(diagram, method),
        ),
        provenance=responses.provenance.then(f"fit_oma({call})"),
        details=details,
    )
    return model.select_modes(keep)


def _statistics_findings(diagram: CovDiagram | DatDiagram, method: str) -> list[Finding]:
    if method == "ssi-dat":
        text = f"SSI-dat by pyOMA-2 on {diagram.samples} samples of one run gives no uncertainty"
        return [Finding("no_uncertainty", text, "info", action="use method='ssi-cov' for standard deviations")]
    if diagram.blocks < MIN_BLOCKS:
        text = f"record too short for an uncertainty: {diagram.blocks} blocks"
        return [Finding("no_uncertainty", text, "warning", action="measure longer")]
    return []


def default_block_rows(n_channels: int, samples: Sequence[int]) -> int:
    """Block rows that make a Hankel matrix of about 800 rows, fewer in short records: a twelfth of the samples at most."""
    rows = int(np.clip(round(800 / n_channels), 30, 120))
    total = sum(samples)
    return max(4, min(rows, max(total // (12 * n_channels), 15), total // 40, min(samples) // 12))


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
    if references is None:
        return np.arange(len(responses.dofs))
    return np.unique(match_dofs(parse_dofs(references), responses.dofs)[0])

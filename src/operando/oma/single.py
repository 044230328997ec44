"""One set-up: stabilisation diagram, choice of modes, covariance; the same diagram asked again for a mode another set-up has seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, ModalModel, TimeRecord
from operando.dof import match_dofs, parse_dofs
from operando.errors import DataError, IdentificationError
from operando.oma.conditioning import Responses, at_suitable_rate, gather_responses
from operando.oma.decay import DecayDiagram, decay_diagram, decay_findings, uncertain_decays
from operando.oma.decay_detect import find_decays
from operando.oma.details import OmaDetails
from operando.oma.diagram import MIN_BLOCKS, CovDiagram, DatDiagram, Prepared, ssi_cov_diagram, ssi_dat_diagram
from operando.oma.estimate import best_orders
from operando.oma.harmonics import Harmonic, find_harmonics
from operando.oma.pyoma import second_opinion as pyoma_opinion
from operando.oma.spectra import Spectra, output_spectra
from operando.oma.verdicts import harmonic_finding, harmonic_poles, short_record_findings, stationarity_findings, uncertain_modes
from operando.stabilization import Stabilization, Tolerances, demote, select_modes

Band = tuple[float, float]
Diagram = CovDiagram | DatDiagram | DecayDiagram


@dataclass(frozen=True)
class Options:
    """What ``fit_oma`` was asked for, the band chosen; see there."""

    band: Band
    band_source: str = "given"
    max_order: int | None = None
    references: object = None
    known_harmonics_hz: tuple[float, ...] = ()
    select_hz: tuple[float, ...] = ()
    reject_hz: tuple[float, ...] = ()
    method: str = "ssi-cov"
    block_rows: int | None = None
    tolerances: Tolerances | None = None
    weighting: str = "cva"
    uncertainty: bool = True
    second_opinion: bool = False


@dataclass(frozen=True)
class Identification:
    """Everything up to the stabilisation diagram of one set-up; ``modes`` concludes. Runs are at the rate used, without sinusoids."""

    responses: Responses
    prepared: Prepared
    diagram: Diagram
    harmonics: list[Harmonic]
    spectra: Spectra
    options: Options

    def selection(self, extra_hz: Sequence[float] = ()) -> Stabilization:
        """The automatic choice, with what was chosen by hand and ``extra_hz`` besides, without what remains of sinusoids."""
        o = self.options
        by_hand = (*o.select_hz, *extra_hz)
        stabilization = select_modes(
            self.diagram.table,
            band=o.band,
            tolerances=o.tolerances,
            select_hz=by_hand,
            reject_hz=o.reject_hz,
            indicator_hz=self.spectra.frequencies_hz,
            indicator=self.spectra.singular_values,
        )
        return demote(stabilization, harmonic_poles(stabilization, self.harmonics, by_hand))

    def modes(self, extra_hz: Sequence[float] = ()) -> ModalModel:
        """Modes with covariance; at ``extra_hz`` a pole is taken beside the automatic choice, within 1 %."""
        band, options = self.options.band, self.options
        stabilization = self.selection(extra_hz)
        if stabilization.selected_hz.size == 0:
            raise IdentificationError(
                f"no mode found between {band[0]:g} and {band[1]:g} Hz in {self.diagram.orders[-1]} states",
                hint="look at the spectra; widen the band, raise max_order, or choose poles by hand with select_hz",
            )
        estimate = self.diagram.estimate(best_orders(stabilization, self.diagram.orders))
        doubtful = (
            uncertain_decays(estimate, options.select_hz)
            if isinstance(self.diagram, DecayDiagram)
            else uncertain_modes(estimate, self.prepared.seconds, options.select_hz)
        )
        keep = [i for i in range(estimate.hz.size) if i not in doubtful]
        stabilization = demote(stabilization, doubtful)
        if not keep:
            raise IdentificationError(
                f"none of the {estimate.hz.size} candidates between {band[0]:g} and {band[1]:g} Hz is certain enough to be a mode",
                hint="look at the spectra; measure longer, widen the band, or choose poles by hand with select_hz",
            )
        opinion = None
        if options.second_opinion:
            std = None if estimate.covariance is None else np.sqrt(np.diag(estimate.covariance))[: estimate.hz.size][keep]
            opinion = self._second_opinion(estimate.hz[keep], estimate.zeta[keep], estimate.shapes[:, keep], std)
        details = OmaDetails(
            stabilization,
            np.array([h.hz for h in self.harmonics]),
            self.spectra,
            opinion,
            estimate.orders[keep],
            self.settings(),
        )
        call = ", ".join(f"{k}={v!r}" for k, v in details.settings.items())
        model = ModalModel(
            estimate.hz,
            estimate.zeta,
            estimate.shapes,
            self.responses.dofs,
            "unscaled",
            in_band=(estimate.hz >= band[0]) & (estimate.hz <= band[1]),
            covariance=estimate.covariance,
            band_hz=band,
            findings=(
                *self.responses.findings,
                *self._kind_findings(),
                *[harmonic_finding(h) for h in self.harmonics],
                *_statistics_findings(self.diagram, options.method),
                *self._short(estimate.hz[keep], estimate.zeta[keep]),
            ),
            provenance=self.responses.provenance.then(f"fit_oma({call})"),
            details=details,
        )
        return model.select_modes(keep)

    def _kind_findings(self) -> list[Finding]:
        """What the records are: decays, or not stationary."""
        if isinstance(self.diagram, DecayDiagram):
            return decay_findings(self.diagram, self.responses.names)
        return stationarity_findings(self.prepared.runs, self.prepared.rate)

    def _short(self, hz: NDArray[np.float64], zeta: NDArray[np.float64]) -> list[Finding]:
        """That the records are short for the modes; decays say all by their standard deviations."""
        return [] if isinstance(self.diagram, DecayDiagram) else short_record_findings(hz, zeta, self.prepared.seconds)

    def settings(self) -> dict[str, Any]:
        """All settings as used."""
        o = self.options
        return {
            "method": "free-decay" if isinstance(self.diagram, DecayDiagram) else o.method,
            "weighting": o.weighting if o.method == "ssi-cov" else "pyOMA-2",
            "band": list(o.band),
            "band_source": o.band_source,
            "block_rows": self.prepared.rows,
            "max_order": self.diagram.orders[-1],
            "sampling_hz": self.prepared.rate,
            "references": [str(self.responses.dofs[i]) for i in self.prepared.references],
            "known_harmonics_hz": [float(f) for f in o.known_harmonics_hz],
            "select_hz": [float(f) for f in o.select_hz],
            "reject_hz": [float(f) for f in o.reject_hz],
            "blocks": self.diagram.blocks,
            "runs": len(self.prepared.runs),
        }

    def _second_opinion(
        self, hz: NDArray[Any], zeta: NDArray[Any], shapes: NDArray[Any], std: NDArray[Any] | None
    ) -> tuple[dict[str, Any], ...]:
        p, o = self.prepared, self.options
        longest = max(p.runs, key=lambda run: run.shape[1])
        return pyoma_opinion(hz, zeta, shapes, std, longest, p.rate, o.band, p.rows, self.diagram.orders[-1], p.references, o.tolerances)


def prepare(responses: Responses, runs: list[NDArray[Any]], rate: float, options: Options) -> tuple[Prepared, list[Harmonic]]:
    """Runs without sinusoids, and these."""
    refs = reference_rows(options.references, responses)
    rows = options.block_rows or default_block_rows(len(responses.dofs), [run.shape[1] for run in runs])
    runs, harmonics = _without_harmonics(runs, rate, options.band, options.known_harmonics_hz)
    return Prepared(runs, rate, rows, refs, responses.derivative), harmonics


def identify(records: Sequence[TimeRecord], options: Options) -> Identification:
    """Stabilisation diagram of one set-up."""
    responses = gather_responses(records)
    runs, rate = at_suitable_rate(responses, options.band)
    decays = [find_decays(run, rate, options.band[0]) for run in runs]
    spectra = output_spectra(responses.runs, responses.sampling_hz, options.band)
    if any(decays) and not all(decays):
        steady = [r for r, d in zip(records, decays, strict=True) if not d]
        rest = identify(steady, options)
        said = tuple(_decay_among(r.name) for r, d in zip(records, decays, strict=True) if d)
        return replace(rest, responses=replace(rest.responses, findings=(*rest.responses.findings, *said)))
    if options.method == "ssi-cov" and all(decays):
        prepared = Prepared(runs, rate, 0, reference_rows(options.references, responses), responses.derivative)
        found = decay_diagram(prepared, decays, options.max_order, options.tolerances)
        return Identification(responses, replace(prepared, rows=found.rows), found, [], spectra, options)
    prepared, harmonics = prepare(responses, runs, rate, options)
    diagram: Diagram
    if options.method == "ssi-cov":
        diagram = ssi_cov_diagram(prepared, options.max_order, options.weighting, options.uncertainty, options.tolerances)
    else:
        diagram = ssi_dat_diagram(prepared, options.max_order, options.tolerances)
    return Identification(responses, prepared, diagram, harmonics, spectra, options)


def _decay_among(name: str) -> Finding:
    """A record of decays beside stationary ones of the same sensors."""
    return Finding(
        "free_decay",
        "the record holds free decays, the others of these sensors stationary vibration",
        "warning",
        file=name or None,
        consequence="it is left out",
        action="analyse the decays by themselves",
    )


def _statistics_findings(diagram: Diagram, method: str) -> list[Finding]:
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
    runs: list[NDArray[Any]], rate: float, band: Band, known_hz: Sequence[float]
) -> tuple[list[NDArray[Any]], list[Harmonic]]:
    """Runs without their sinusoids, and all sinusoids found in any of them."""
    out, found = [], []
    for run in runs:
        harmonics, clean = find_harmonics(run, rate, (0.9 * band[0], min(1.05 * band[1], 0.48 * rate)), known_hz)
        out.append(clean)
        found += harmonics
    return out, each_once(found)


def each_once(harmonics: Sequence[Harmonic]) -> list[Harmonic]:
    """Sinusoids of several runs, each frequency once, the strongest."""
    union: list[Harmonic] = []
    for h in sorted(harmonics, key=lambda h: h.hz):
        if union and h.hz - union[-1].hz < max(0.002 * h.hz, h.spread_hz):
            union[-1] = max(union[-1], h, key=lambda x: x.energy_share)
        else:
            union.append(h)
    return union


def reference_rows(references: object, responses: Responses) -> NDArray[np.int_]:
    """Rows of the reference channels; all where none are named."""
    if references is None:
        return np.arange(len(responses.dofs))
    rows = match_dofs(parse_dofs(references), responses.dofs)[0]
    if not rows:
        raise DataError(f"references {references!r:.60} names no DOF", hint="leave it out to take all sensors")
    return np.unique(rows)

"""The files of the results folder: which stage each stands on, and how it is written."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from operando.atomic import write_json
from operando.data import Finding, Frf, ModalModel, node_motion
from operando.dof import Dof, DofIndex
from operando.errors import MissingError
from operando.results import Results

DESCRIPTIONS = {
    "idle_frf.uff": "idle FRFs as measured",
    "idle_modes.uff": "idle modes and residual terms",
    "operating_modes.uff": "operational modes, unscaled",
    "ofrf.uff": "operational FRFs, hybrid route",
    "ofrf_effect.uff": "operational FRFs, idle model with accepted effects",
}
"""What the header of each UFF file says that it holds."""

MAX_BYTES = 1_000_000_000
"""Beyond this size ``ofrf.uff`` holds the columns of the measured references only."""


Writer = Callable[[Path, Results], list[Finding]]
"""Writes a file of results; returns what there is to say about it."""


@dataclass(frozen=True)
class Output:
    """A file of the results folder."""

    name: str
    write: Writer
    stage: str | None = None  # stage without which there is no such file; None: there always is
    whole: bool = False  # whether it tells of the settings, the findings and what was left out, besides what the stages made

    def of(self, results: Results) -> Callable[[Path], list[Finding]]:
        """What writes this file of these results."""
        return lambda path: self.write(path, results)


def _idle_frf(path: Path, results: Results) -> list[Finding]:
    frf = results.idle_frf
    return _uff(path, results, frf, single=None if frf is None else np.array_equal(frf.data, frf.data.astype(np.complex64), equal_nan=True))


def _ofrf(path: Path, results: Results) -> list[Finding]:
    findings: list[Finding] = []
    return _uff(path, results, ofrf(results, findings), single=True) + findings


def _ofrf_effect(path: Path, results: Results) -> list[Finding]:
    from operando.diagnosis.stored import effect_model

    dofs = None if results.idle is None else results.idle.dofs
    frf = effect_model(results).structure().frf(ofrf_lines(results), dofs, dofs, "accelerance", variance=False)
    return _uff(path, results, frf, single=True)


def _json(document: Callable[[Results], Any]) -> Writer:
    """What writes a document of the results."""

    def write(path: Path, results: Results) -> list[Finding]:
        write_json(path, document(results))
        return []

    return write


def _report(path: Path, results: Results) -> list[Finding]:
    from operando.report import write_report

    write_report(results, path)
    return []


def _summary(results: Results) -> dict[str, Any]:
    from operando.pipeline.summary import summary

    return summary(results)


def _model(path: Path, results: Results) -> list[Finding]:
    from operando.store import save_results

    save_results(results, path)
    return []


OUTPUTS = (
    Output("idle_frf.uff", _idle_frf, "frf"),
    Output("idle_modes.uff", lambda path, results: _modes(path, results, results.idle), "ema"),
    Output("operating_modes.uff", lambda path, results: _modes(path, results, results.operating), "oma"),
    Output("ofrf.uff", _ofrf, "ofrf"),
    Output("comparison.json", _json(lambda results: (results.comparison or {}) | {"settings": results.settings}), "compare", whole=True),
    Output("diagnosis.json", _json(lambda results: results.diagnosis or {}), "diagnose"),
    Output("ladder.json", _json(lambda results: (results.diagnosis or {}).get("ladder", [])), "diagnose"),
    Output("ofrf_effect.uff", _ofrf_effect, "diagnose"),
    Output("report.html", _report, whole=True),
    Output("summary.json", _json(_summary), whole=True),
    Output("model.h5", _model, whole=True),
    Output("timings.json", _json(lambda results: {"schema": "operando/timings/1", "seconds": results.timings_s}), whole=True),
)
"""In the order they are written: what cannot be written is a finding, which those behind tell of."""

STEP_OUTPUTS = tuple(o for o in OUTPUTS if o.stage == "diagnose" or o.name in ("comparison.json", "model.h5", "report.html"))
"""What ``add`` and ``remove`` change."""


def _uff(path: Path, results: Results, content: Any, node_set: int = 2411, single: bool | None = None) -> list[Finding]:
    """One UFF file: what it holds in words (set 151), the geometry, the content.

    What was measured keeps all its digits: seven where a run estimated it. So many has what a model says line by line (``single``), which
    is far below its own deviation.
    """
    from operando.io import FileHeader, write_uff

    # When the data were measured, no time of writing: equal results make equal files.
    date = "" if content is None else content.provenance.measured
    header = FileHeader(results.name, DESCRIPTIONS[path.name], "operando", date, date, "operando", date)
    write_uff(path, *(o for o in (results.geometry, content) if o is not None), header=header, node_set=node_set, single=single)
    return []


def _modes(path: Path, results: Results, model: ModalModel | None) -> list[Finding]:
    """Modes and residual terms along the axes; set 15 stands beside them, the other files have nodes in double precision."""
    findings: list[Finding] = []
    if model is not None:
        model = along_axes(replace(model, details=None), _directions(results), path.name, findings)
    return _uff(path, results, model, node_set=15) + findings


def _directions(results: Results) -> dict[str, Any]:
    """Directions declared in the test file, by DOF; also without a geometry."""
    given: dict[str, Any] = results.settings.get("directions", {})
    return given


def along_axes(model: ModalModel, directions: Mapping[str, Sequence[float]], name: str, findings: list[Finding]) -> ModalModel:
    """The model with X, Y, Z motion at nodes whose measured directions are no axes: UFF knows no others."""
    skewed = {d.node for d in model.dofs if d.named or str(d.unsigned) in directions}
    if not skewed:
        return model
    kept = [i for i, d in enumerate(model.dofs) if d.node not in skewed]
    turned = [i for i, d in enumerate(model.dofs) if d.node in skewed]
    all_shapes = model.terms.shapes
    motion = node_motion([model.dofs[i] for i in turned], all_shapes[turned], directions)
    dofs = [model.dofs[i] for i in kept] + [Dof(node, axis) for node in motion for axis in ("X", "Y", "Z")]
    shapes = np.concatenate([all_shapes[kept], *motion.values()])
    findings.append(
        Finding(
            "directions_resolved",
            f"{name} holds X, Y, Z motion of {len(motion)} nodes that were measured along other directions",
            "info",
            consequence="where a node has fewer than three independent directions, what they do not see stands as zero",
            action="model.h5 and summary.json have the values as measured",
        )
    )
    return model.with_terms(shapes=shapes, dofs=tuple(dofs), covariance=None, std=None, coupling=None)


def ofrf_lines(results: Results) -> Any:
    """Lines of the idle FRFs [Hz]."""
    if results.idle_frf is None:
        raise MissingError(
            "there are no idle FRFs whose lines the operational FRFs could lie on", hint="give the lines: --frequencies A:B:STEP"
        )
    return results.idle_frf.frequencies_hz


def ofrf(results: Results, findings: list[Finding]) -> Frf:
    """Operational accelerance over all measured DOFs, on the lines of the idle FRFs."""
    if results.hybrid is None:
        raise MissingError("there is no hybrid model")
    lines = ofrf_lines(results)
    dofs = results.hybrid.modal.dofs
    references: tuple[Any, ...] | None = None
    if len(dofs) ** 2 * lines.size * 24 > MAX_BYTES and results.idle_frf is not None:
        known = DofIndex(dofs)
        references = tuple(d for d in results.idle_frf.references if d in known)
        findings.append(
            Finding(
                "partial_output",
                f"ofrf.uff holds the columns of the {len(references)} measured references, not of all {len(dofs)} DOFs: "
                f"it would exceed {MAX_BYTES / 1e9:g} GB",
                "info",
                action="`operando ofrf DIR --references DOFS` makes any column",
            )
        )
    # One set a pair, for programs that take each set for an FRF; `operando ofrf` writes the standard deviations too.
    frf: Frf = results.hybrid.modal.frf(lines, None, references, "accelerance", variance=False)
    return frf

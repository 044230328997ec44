"""The files of the results folder that one stage makes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from operando.data import Finding, Frf, ModalModel, node_motion
from operando.dof import Dof
from operando.errors import MissingError
from operando.pipeline.cache import whole, write_json
from operando.results import Results

OUTPUTS = {
    "frf": ("idle_frf.uff",),
    "ema": ("idle_modes.uff",),
    "oma": ("operating_modes.uff",),
    "ofrf": ("ofrf.uff",),
    "compare": ("comparison.json",),
    "diagnose": ("diagnosis.json", "ladder.json", "comparison.json", "ofrf_effect.uff"),
}
"""Stage → files it makes."""

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


MAX_BAND_VALUES = 2_000_000
"""Pairs times lines up to which ``ofrf.uff`` holds the standard deviation of all of them: measured on the example, 1.2 million take 4 s."""


def write_output(name: str, out: Path, results: Results) -> list[Finding]:
    """Write one file of the results folder, whole or not at all; returns what there is to say about it."""
    if name == "comparison.json":
        if results.comparison is not None:
            write_json(out / name, results.comparison)
        return []
    if name in ("diagnosis.json", "ladder.json"):
        document = results.diagnosis or {}
        write_json(out / name, document if name == "diagnosis.json" else document.get("ladder", []))
        return []
    from operando.io import write_uff

    findings: list[Finding] = []
    objects: list[Any] = []
    if name == "idle_frf.uff":
        objects = [results.idle_frf]
    elif name in ("idle_modes.uff", "operating_modes.uff"):
        model = results.idle if name == "idle_modes.uff" else results.operating
        if model is not None:
            objects.append(along_axes(replace(model, details=None), _directions(results), name, findings))
    elif name == "ofrf.uff":
        objects = [ofrf(results, findings)]
    elif name == "ofrf_effect.uff":
        dofs = None if results.idle is None else results.idle.dofs
        objects = [effect_model(results).frf(ofrf_lines(results), dofs, dofs, "accelerance", variance=False)]
    written = [o for o in (results.geometry, *objects) if o is not None]
    # The contract wants set 15 beside the modes; the other files have the nodes in double precision.
    node_set = 15 if name.endswith("_modes.uff") else 2411
    with whole(out / name) as beside:
        write_uff(beside, *written, header=_header(results, DESCRIPTIONS[name], objects), node_set=node_set)
    return findings


def _header(results: Results, description: str, objects: Sequence[Any]) -> Any:
    """Set 151: what the file holds, and when its data were measured; no time of writing, so that equal results make equal files."""
    from operando.io import FileHeader

    date = max((o.provenance.measured for o in objects if o is not None), default="")
    return FileHeader(results.name, description, "operando", date, date, "operando", date)


def effect_model(results: Results, changes: Sequence[tuple[int, str, float]] = ()) -> Any:
    """The second route to the operational FRFs: the idle model with the accepted effects, channel faults left out.

    An effect that depends on the level stands in it as the spring and damper it is equivalent to at the lowest level measured.

    Parameters
    ----------
    results : Results
    changes : sequence of (int, str, float), optional
        Step of the ladder, parameter and another value of it [SI]: a state that was not measured.

    Raises
    ------
    MissingError
        If there is no diagnosis.
    ConfigError
        If there is no such step or parameter.
    """
    from operando.diagnose import Model
    from operando.diagnose.from_records import standing

    if results.diagnosis is None or results.idle is None:
        raise MissingError("there is no model with accepted effects", hint="run the test to the stage diagnose")
    effects = tuple(standing(results.diagnosis))
    model = Model(results.effect_idle or results.idle, effects, results.geometry, results.effect_covariance)
    for step, name, value in changes:
        model = model.with_values(step, **{name: value})
    return model.structure()


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
    return model.with_terms(shapes=shapes, dofs=tuple(dofs), covariance=None, std=None)


def ofrf_lines(results: Results) -> Any:
    """Lines of the idle FRFs [Hz].

    Raises
    ------
    MissingError
        If there are none.
    """
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
        known = {(d.node, d.axis) for d in dofs}
        references = tuple(d for d in results.idle_frf.references if (d.node, d.axis) in known)
        findings.append(
            Finding(
                "partial_output",
                f"ofrf.uff holds the columns of the {len(references)} measured references, not of all {len(dofs)} DOFs: "
                f"it would exceed {MAX_BYTES / 1e9:g} GB",
                "info",
                action="`operando ofrf DIR --references DOFS` makes any column",
            )
        )
    modal = results.hybrid.modal
    frf: Frf = modal.frf(lines, None, references, "accelerance", variance=False)
    return frf if modal.covariance is None else replace(frf, variance=_band(modal, frf, results, findings))


def _band(modal: ModalModel, frf: Frf, results: Results, findings: list[Finding]) -> Any:
    """Variance of each line; where all pairs would take long, of the columns of the measured references, NaN elsewhere."""
    known = {(d.node, d.axis) for d in ([] if results.idle_frf is None else results.idle_frf.references)}
    columns = list(range(len(frf.references)))
    if frf.data.size > MAX_BAND_VALUES:
        columns = [j for j, d in enumerate(frf.references) if (d.node, d.axis) in known]
        findings.append(
            Finding(
                "partial_output",
                f"ofrf.uff holds the standard deviation of {len(columns)} of {len(frf.references)} columns: those measured at rest",
                "info",
                action="`operando ofrf DIR --references DOFS` makes it for any column",
            )
        )
    variance = np.full(frf.data.shape, np.nan)
    if columns:
        some = modal.frf(frf.frequencies_hz, None, tuple(frf.references[j] for j in columns), "accelerance")
        variance[:, columns] = some.variance
    return variance

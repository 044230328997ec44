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

MAX_BYTES = 1_000_000_000
"""Beyond this size ``ofrf.uff`` holds the columns of the measured references only."""


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
        objects = [results.geometry]
        if model is not None:
            proper = replace(model.without_residuals(), details=None)
            objects.append(along_axes(proper, _directions(results), name, findings))
    elif name == "ofrf.uff":
        objects = [ofrf(results, findings)]
    elif name == "ofrf_effect.uff":
        dofs = None if results.idle is None else results.idle.dofs
        objects = [effect_model(results).frf(ofrf_lines(results), dofs, dofs, "accelerance", variance=False)]
    with whole(out / name) as beside:
        write_uff(beside, *(o for o in objects if o is not None))
    return findings


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
    motion = node_motion([model.dofs[i] for i in turned], model.shapes[turned], directions)
    dofs = [model.dofs[i] for i in kept] + [Dof(node, axis) for node in motion for axis in ("X", "Y", "Z")]
    shapes = np.concatenate([model.shapes[kept], *motion.values()])
    findings.append(
        Finding(
            "directions_resolved",
            f"{name} holds X, Y, Z motion of {len(motion)} nodes that were measured along other directions",
            "info",
            consequence="where a node has fewer than three independent directions, what they do not see stands as zero",
            action="model.h5 and summary.json have the values as measured",
        )
    )
    return replace(model, dofs=tuple(dofs), shapes=shapes, covariance=None, std=None)


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
    if len(dofs) ** 2 * lines.size * 16 > MAX_BYTES and results.idle_frf is not None:
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
    # UFF 58 has no place for the variance of each line, and it costs far more than the FRFs: model.h5 and `operando ofrf` have it
    bare = replace(results.hybrid.modal, covariance=None, std=None)
    return bare.frf(lines, None, references, "accelerance")

"""What the sections on mode shapes, MAC matrices, pairing, scale and conditioning show."""

from __future__ import annotations

from typing import Any

import numpy as np
from markupsafe import Markup

from operando.dof import DofIndex
from operando.errors import DofError
from operando.indicators import mac
from operando.plots.modes import mode_labels
from operando.report import derive, figures_compare, figures_modes, live
from operando.report.assessment import scope
from operando.report.class_words import class_words
from operando.report.idle_check import one_state
from operando.report.parts import Numbering
from operando.report.text import count, finite, fixed
from operando.results import Results
from operando.scaling.methods import IN_WORDS

MOST_SHAPES = 24
LONG_TEXT = 140
SMALL_KAPPA = 10.0
"""Below, the doubling of shape errors in the condensed mass is no worse than some ten times."""


def shapes(results: Results, page: Numbering) -> dict[str, Any]:
    """Shapes at rest and running on the geometry, then MAC matrices."""
    model = results.idle if results.idle is not None else results.operating
    pairs = _shape_pairs(results)
    geometry = results.geometry
    on_nodes = geometry is not None and model is not None and any(geometry.position(d.node) is not None for d in model.dofs)
    drawn = None
    if pairs and model is not None:
        drawn = figures_modes.mode_shapes(results.geometry, model.dofs, pairs[:MOST_SHAPES])
        drawn.csv = figures_modes.shapes_csv(model.dofs, pairs)
    return {
        "model": model, "alone": scope(results) != "all", "one_state": one_state(results),
        "on_nodes": on_nodes, "drawn": drawn, "n_pairs": len(pairs), "most": MOST_SHAPES, "live": live.shapes(results),
    } | _mac(results)  # fmt: skip


def _shape_pairs(results: Results) -> list[figures_modes.ShapePair]:
    """One entry a mode, in order of frequency; operating shapes on the DOFs of the idle ones, in their sense."""
    idle, operating = results.idle, results.operating
    at_rest = None if idle is None else derive.real_shapes(idle)
    running = None if operating is None else derive.real_shapes(operating)
    if idle is not None and operating is not None:
        running = _on_dofs(running, operating, idle)
    made = []
    for p in derive.mode_pairs(results):
        if p.operating is None and idle is not None and operating is not None and not np.asarray(idle.in_band)[p.idle]:
            continue
        first = None if at_rest is None or p.idle is None else at_rest[:, p.idle]
        second = None if running is None or p.operating is None else running[:, p.operating]
        if first is not None and second is not None and float(first @ second) < 0:
            second = -second
        label = f"Idle {p.idle}" if second is None else f"Operating {p.operating}"
        if first is not None and second is not None:
            label = f"Idle {p.idle} → operating {p.operating}   MAC {fixed(p.row.get('mac'), 2)}"
        texts = [f"{word} {f:.2f} Hz" if f is not None else "" for word, f in (("idle", p.idle_hz), ("operating", p.operating_hz))]
        made.append(figures_modes.ShapePair(label, first, second, *texts))
    return made


def _on_dofs(values: Any, source: Any, target: Any) -> Any:
    """Rows of one model's shapes on the DOFs of another, NaN-free: zero where not measured."""
    out = np.zeros((len(target.dofs), values.shape[1]))
    for row, i, sign in DofIndex(target.dofs).common(source.dofs):
        out[row] = sign * values[i]
    return out


def _mac(results: Results) -> dict[str, Any]:
    """The MAC matrices, the two idle modes that are least distinct, and why there is no cross MAC."""
    idle, operating = results.idle, results.operating
    axis = "{} mode: frequency [Hz]".format
    matrices: list[Any] = []
    out: dict[str, Any] = {"matrices": None, "least": None, "no_cross": ""}
    if idle is not None and idle.n_modes:
        values, names = mac(idle.shapes), mode_labels(idle)
        matrices.append(("Idle × idle (AutoMAC)", values, names, names, axis("Idle"), axis("Idle")))
        off = values - np.diag(np.diag(values))
        if off.size > 1 and off.max() > 0.05:
            a, b = sorted(int(v) for v in np.unravel_index(int(np.argmax(off)), off.shape))
            out["least"] = (a, b, float(off.max()))
    if idle is not None and operating is not None and idle.n_modes and operating.n_modes:
        try:
            values = mac(idle.shapes, operating.rows(idle.dofs))
        except DofError as error:
            out["no_cross"] = error.message
        else:
            matrices.append(("Idle × operating", values, mode_labels(idle), mode_labels(operating), axis("Idle"), axis("Operating")))
    elif operating is not None and operating.n_modes:
        names = mode_labels(operating)
        matrices.append(("Operating × operating (AutoMAC)", mac(operating.shapes), names, names, axis("Operating"), axis("Operating")))
    return out | {"matrices": figures_modes.mac_matrices(matrices) if matrices else None}


def scaling(results: Results, page: Numbering) -> dict[str, Any]:
    """Pairing, method and reason, κ and what makes it large, alternatives."""
    info = derive.scaling_of(results)
    pairing = derive.pairing_of(results)
    modal = getattr(results.hybrid, "modal", None)
    residuals = str(info.get("residuals") or "").rstrip(".")
    if not 0 < len(residuals) <= LONG_TEXT:
        residuals = ""
        if modal is not None and modal.residuals is not None:
            where = derive.range_text(modal.residuals.frequencies_hz)
            residuals = f"{count(modal.n_residuals, 'mode')} of the idle model beyond the operating ones ({where})"
    notes = [f"Operational mode {p['operating']}: {str(p['note']).rstrip('.')}." for p in pairing if p.get("note")]
    notes += [f"{str(c).rstrip('.')}." for c in info.get("conflicts") or []]
    refused = (info.get("evidence") or {}).get("refused") or {}
    others = [(name, v, refused.get(name)) for name, v in (info.get("alternatives") or {}).items() if name != info.get("method")]
    return {
        "info": info, "methods": IN_WORDS, "residuals": residuals, "pairs": [p for p in derive.mode_pairs(results) if p.row],
        "notes": list(dict.fromkeys(notes)), "changes": _changes(results), "class_words": class_words, "scale": _polar,
        "others": sorted(others, key=lambda o: float(o[1]) if finite(o[1]) else np.inf),
    } | _condition(results)  # fmt: skip


def _polar(scale: Any) -> tuple[Any, Any]:
    """Modulus and phase [°] of a scale factor given as two parts."""
    if not scale or not all(finite(s) for s in scale):
        return None, None
    return float(np.hypot(*scale)), float(np.degrees(np.arctan2(scale[1], scale[0])))


def _changes(results: Results) -> Markup | None:
    """Frequency and damping of each paired mode from rest to operation."""
    idle, operating = results.idle, results.operating
    columns: list[tuple[str, float, float, float, float]] = []
    spread = lambda values, i: float(values[i]) if values is not None else float("nan")  # noqa: E731
    for p in sorted(derive.mode_pairs(results), key=lambda p: -1 if p.idle is None else p.idle):
        if idle is None or operating is None or p.idle is None or p.operating is None:
            continue
        a, b = p.idle, p.operating
        f0, f1, z0, z1 = idle.frequencies_hz[a], operating.frequencies_hz[b], idle.damping_ratios[a], operating.damping_ratios[b]
        if f0 <= 0 or z0 <= 0:
            continue
        f_std = 100 * float(np.hypot(spread(operating.frequency_std_hz, b) / f0, spread(idle.frequency_std_hz, a) * f1 / f0**2))
        z_std = 100 * float(np.hypot(spread(operating.damping_ratio_std, b) / z0, spread(idle.damping_ratio_std, a) * z1 / z0**2))
        columns.append((f"{f0:.1f}", 100 * float(f1 / f0 - 1), 100 * float(z1 / z0 - 1), f_std, z_std))
    return figures_compare.frequency_changes(*zip(*columns, strict=True)) if columns else None


def _condition(results: Results) -> dict[str, Any]:
    """The sensors and idle modes in the weakest direction of the idle shapes that carry the mass."""
    idle = results.idle
    if idle is None:
        return {"condition": None}
    basis = getattr(results.hybrid, "basis", None)
    rows = np.flatnonzero(np.asarray(idle.in_band)) if basis is None else np.asarray(basis.modes, int)
    shape = None if np.iscomplexobj(idle.shapes) else derive.sensor_redundancy(np.asarray(idle.shapes[:, rows], float), idle.dofs)
    if shape is None:
        return {"condition": None}
    order = [i for i in np.argsort(-shape["dofs"])[:4] if shape["dofs"][i] > 0.08]
    weak = [i for i in np.argsort(-shape["modes"])[:4] if shape["modes"][i] > 0.08]
    least = int(np.nanargmax(shape["without"])) if np.any(np.isfinite(shape["without"])) else None
    names = [f"{a}: {idle.frequencies_hz[a]:.1f}" for a in rows]
    return {
        "condition": shape, "small": shape["kappa"] < SMALL_KAPPA, "n_rows": rows.size, "sensors": [shape["labels"][i] for i in order],
        "share": 100 * float(np.sum(shape["dofs"][order])), "weak": [(int(rows[i]), float(idle.frequencies_hz[rows[i]])) for i in weak],
        "hardest": None if least is None else (shape["labels"][least], float(shape["without"][least])),
        "condition_figure": figures_modes.conditioning(shape["labels"], shape["dofs"], names, shape["modes"]),
    }  # fmt: skip

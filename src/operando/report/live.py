"""What the script of the page draws by itself: FRFs of any pair, poles, shapes that move. Each has a still picture beside it."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import ArrayLike

from operando.data import Frf, ModalModel
from operando.dof import DofIndex
from operando.plots.mesh import Mesh
from operando.plots.style import GREEN, IDLE, MEASURED, MODEL, SKY, thin
from operando.printable import printable
from operando.report import derive, derive_diagnosis
from operando.report.parts import Numbering, render
from operando.report.text import finite, fixed, number
from operando.results import Results
from operando.stabilization import stability_letters

MOST_VALUES = 45_000
"""Complex values embedded of one measurement: some 0.2 MB of the page. More are thinned, extremes kept."""

MOST_SHAPES = 40
POWERS = {"accelerance": 0, "mobility": 1, "receptance": 2}
"""Times iω to accelerance."""

LETTERS = {
    "o": ("not stable", "#4b5762"), "f": ("frequency", "#7a5200"), "d": ("frequency and damping", "#00664a"),
    "v": ("frequency and vector", "#8a3f77"), "s": ("stable", "#00558a"), "": ("not physical", "#a33a00"),
}  # fmt: skip
"""Letter of a pole, what of it agrees with a pole of the order below, and its colour."""


def frfs(results: Results, page: Numbering) -> Markup | None:
    """FRFs of every pair, measured and by each model; None where there is no FRF or it has no scale to be set beside."""
    run, _, _ = derive.validation(results, page)
    idle, hybrid = derive.scaled_idle(results), getattr(results.hybrid, "modal", None)
    after = None
    found = results.diagnosis or {}
    if run is not None and found.get("effects") and "check_records" not in (found.get("data") or ()):
        model = page.once("effect model", lambda: derive_diagnosis.effect_model(results))
        after = page.once("effect on check", lambda: derive.model_frf(model, run.frf))
    measured = [f for f in (results.idle_frf, None if run is None else run.frf) if f is not None and f.quantity in POWERS]
    base = next((m.dofs for m in (idle, hybrid) if m is not None), None) or (measured[0].responses if measured else ())
    band = derive.analysis_band(results)
    if (not measured and hybrid is None) or band is None or not base:
        return None
    dofs = tuple(dict.fromkeys([*base, *(d for f in measured for d in f.references if d not in DofIndex(base))]))
    series: list[dict[str, Any]] = []
    lines = ((results.idle_frf, "idle, measured", SKY, None), (None if run is None else run.frf, "operating, measured", MEASURED, None),
             (after, "idle model + effects", GREEN, [2, 2]))  # fmt: skip
    for frf, name, color, dash in lines:
        if frf is not None and frf.quantity in POWERS:
            series.append(_lines(frf, dofs, band) | {"name": name, "color": color, "dash": dash})
    for modal, name, color, dash in ((idle, "idle model", IDLE, [6, 3]), (hybrid, "operational FRF", MODEL, None)):
        if modal is not None and np.isrealobj(modal.terms.shapes):
            series.append(_modal(modal, dofs) | {"name": name, "color": color, "dash": dash})
    first, full = _first(measured, dofs), max((f.data.size for f in measured), default=0)
    note = "FRFs of any pair; models follow from their modes."
    note += " Measured lines are thinned, extremes kept; the files hold all." if full > MOST_VALUES else ""
    unit = "Accelerance [dB re 1 (m/s²)/N]" if all(f.si for f in measured) else "Level [dB, units of the file]"
    return _embedded("frfs", {"band": list(band), "dofs": [printable(d) for d in dofs], "series": series, "modes": _modes(results),
                              "unit": unit, "first": first}, note)  # fmt: skip


def _first(measured: Sequence[Frf], dofs: Sequence[Any]) -> list[int]:
    """A drive point of the last measurement, else its first pair."""
    if not measured:
        return [0, 0]
    frf = measured[-1]
    i, j = (frf.drive_points() or [(0, 0)])[0]
    index = DofIndex(dofs)
    return [(index.find(d) or (-1, 1))[0] for d in (frf.responses[i], frf.references[j])]


def _lines(frf: Frf, dofs: Sequence[Any], band: Sequence[float]) -> dict[str, Any]:
    """A measured FRF as levels of 16 bit, phases and coherence of 8 bit, on lines that keep its look."""
    f = frf.frequencies_hz
    inside = np.flatnonzero((f >= band[0]) & (f <= band[1]) & (f > 0))
    with np.errstate(divide="ignore", invalid="ignore"):
        total = np.log(np.sqrt(np.nanmean(np.abs(frf.data[:, :, inside]) ** 2, axis=(0, 1))))
    most = MOST_VALUES // max(frf.data.shape[0] * frf.data.shape[1], 1)
    keep = inside[thin(f[inside], total, max(most // 2, 50))] if inside.size > most else inside
    index = DofIndex(dofs)
    outs, ins = ([index.find(d) or (-1, 1) for d in names] for names in (frf.responses, frf.references))
    signs = np.outer([s for _, s in outs], [s for _, s in ins])[:, :, None]
    data = frf.data[:, :, keep] * signs * (2j * np.pi * f[keep]) ** POWERS[frf.quantity]
    with np.errstate(divide="ignore", invalid="ignore"):
        level, phase = 20 * np.log10(np.abs(data)), np.degrees(np.angle(data))
    good = np.isfinite(level)
    low, high = (float(np.min(level[good])), float(np.max(level[good]))) if good.any() else (0.0, 1.0)
    high = max(high, low + 1e-6)
    coherence = None if frf.coherence is None else _coherence(frf, keep)
    return {
        "kind": "lines", "responses": [i for i, _ in outs], "references": [j for j, _ in ins], "hz": _packed(f[keep], "<f4"),
        "low": low, "high": high, "level": _packed(np.where(good, np.round((level - low) / (high - low) * 65534), 65535), "<u2"),
        "phase": _packed(np.where(good, np.round((phase + 180) / 360 * 254), 255), "u1"), "coherence": coherence,
    }  # fmt: skip


def _coherence(frf: Frf, keep: Any) -> str | None:
    values = np.asarray(frf.coherence)
    if values.ndim == 2:
        values = np.repeat(values[:, None, :], frf.data.shape[1], axis=1)
    if values.shape != frf.data.shape:
        return None
    part = values[:, :, keep]
    return _packed(np.where(np.isfinite(part), np.round(np.clip(np.nan_to_num(part), 0, 1) * 254), 255), "u1")


def _modal(modal: ModalModel, dofs: Sequence[Any]) -> dict[str, Any]:
    """A model by its modes and residual terms: the page makes the FRF of any pair."""
    terms = modal.terms
    shapes = np.zeros((len(dofs), terms.frequencies_hz.size))
    known, have = DofIndex(modal.dofs), []
    for i, dof in enumerate(dofs):
        if (at := known.find(dof)) is not None:
            shapes[i] = at[1] * np.asarray(terms.shapes[at[0]], float)
            have.append(i)
    # the page takes ω²/(ω_r² − ω²) with frequencies in Hz: both squares hold (2π)², which cancels
    return {
        "kind": "modes", "dofs": len(have), "responses": have, "references": have, "hz": _packed(terms.frequencies_hz, "<f4"),
        "damping": _packed(terms.damping_ratios, "<f4"), "shapes": _packed(shapes[have].T, "<f4"),
    }  # fmt: skip


def _modes(results: Results) -> list[dict[str, Any]]:
    """Modes for the cursor: operating ones with their partner, else idle ones."""
    rows = []
    for p in derive.mode_pairs(results):
        state, model, i = ("operating", results.operating, p.operating) if p.operating is not None else ("idle", results.idle, p.idle)
        if model is None or i is None:
            continue
        text = f"{state} mode {i}: {number(model.frequencies_hz[i], 5)} Hz, damping {number(100 * model.damping_ratios[i], 3)} %"
        if state == "operating" and p.idle is not None:
            text += f", idle {number(p.idle_hz, 5)} Hz" + (f", MAC {fixed(p.row.get('mac'), 3)}" if finite(p.row.get("mac")) else "")
        rows.append({"hz": float(model.frequencies_hz[i]), "text": text})
    return rows


def poles(model: ModalModel, band: Sequence[float] | None, which: str) -> Markup | None:
    """The poles of a stabilisation diagram; None where none were kept."""
    stabilization = getattr(model.details, "stabilization", None)
    if band is None or stabilization is None or not stabilization.table.order.size:
        return None
    table = stabilization.table
    keep = (table.frequency_hz >= band[0]) & (table.frequency_hz <= band[1])
    modes = [{"hz": float(f), "text": f"{which} mode {i}: {number(f, 5)} Hz, damping {number(100 * z, 3)} %"}
             for i, (f, z) in enumerate(zip(model.frequencies_hz, model.damping_ratios, strict=True))]  # fmt: skip
    letters = stability_letters(table, stabilization.tolerances)[keep]
    names, colors = zip(*LETTERS.values(), strict=True)
    return _embedded("poles", {
        "band": list(map(float, band)), "hz": _packed(table.frequency_hz[keep], "<f4"), "order": _packed(table.order[keep], "<u2"),
        "damping": _packed(table.damping_ratio[keep], "<f4"), "status": _packed([list(LETTERS).index(s) for s in letters], "u1"),
        "letters": [s or "×" for s in LETTERS], "names": names, "colors": colors, "modes": modes,
    })  # fmt: skip


def shapes(results: Results) -> Markup | None:
    """Shapes of both states on the geometry; None without a geometry on which two nodes move."""
    models = [m for m in (results.idle, results.operating) if m is not None]
    if results.geometry is None or not models:
        return None
    meshes = {id(m): Mesh(results.geometry, m.dofs) for m in models}
    mesh = meshes[id(models[0])]
    if not mesh.drawable:
        return None
    modes = []
    for p in derive.mode_pairs(results)[:MOST_SHAPES]:
        sides: dict[str, dict[str, Any] | None] = {}
        text: list[str] = []
        for state, model, i in (("idle", results.idle, p.idle), ("operating", results.operating, p.operating)):
            if model is None or i is None:
                sides[state] = None
                continue
            sides[state] = _moving(meshes[id(model)], model.shapes[:, i])
            text.append(f"{state} {number(model.frequencies_hz[i], 5)} Hz, damping {number(100 * model.damping_ratios[i], 3)} %")
        if finite(p.row.get("mac")):
            text.append(f"MAC {fixed(p.row['mac'], 3)}")
        names = [f"{state} {i}" for state, i in (("idle", p.idle), ("operating", p.operating)) if i is not None]
        modes.append({"name": f"{' → '.join(names)}, {number(p.idle_hz or p.operating_hz, 4)} Hz", "text": "; ".join(text), **sides})
    low, high = mesh.xyz.min(axis=0), mesh.xyz.max(axis=0)
    xyz = (mesh.xyz - (low + high) / 2) / mesh.span
    return _embedded("shapes", {
        "xyz": _packed(xyz, "<f4"), "edges": [list(map(int, e)) for e in sorted(mesh.edges)], "modes": modes,
        "faces": [list(map(int, f)) for f in mesh.faces], "measured": [int(i) for i in np.flatnonzero(mesh.measured)],
    })  # fmt: skip


def _moving(mesh: Mesh, shape: Any) -> dict[str, Any]:
    """Displacements of the nodes, turned to the real axis as far as they go, the greatest of length one."""
    v = np.asarray(shape)
    if np.iscomplexobj(v):
        v = v * np.exp(-0.5j * np.angle(np.sum(v**2)))
    moved = mesh.displacements(v)
    moved = moved / (float(np.max(np.linalg.norm(moved, axis=1))) or 1.0)
    return {"re": _packed(moved.real, "<f4"), "im": _packed(moved.imag, "<f4") if np.iscomplexobj(moved) else None}


def _packed(values: ArrayLike, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(np.asarray(values), kind).tobytes()).decode()


def _embedded(kind: str, data: dict[str, Any], note: str = "") -> Markup:
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return render("live.html.j2", kind=kind, data=escape(text), note=note)  # as it is: a long word is no label here

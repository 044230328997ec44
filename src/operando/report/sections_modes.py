"""Sections on mode shapes, MAC matrices, pairing, scale and conditioning."""

from __future__ import annotations

from typing import Any

import numpy as np

from operando.dof import match_dofs
from operando.errors import DofError
from operando.indicators import mac
from operando.report import derive, figures_compare, figures_modes, tables
from operando.report.parts import Numbering, left_out, missing, paragraph
from operando.report.text import count, esc, finite, fixed, listing, number
from operando.results import Results
from operando.scaling.methods import IN_WORDS

MOST_SHAPES = 24
LONG_TEXT = 140
SMALL_KAPPA = 10.0
"""Below, the doubling of shape errors in the condensed mass is no worse than some ten times."""


def shapes(results: Results, numbering: Numbering) -> str:
    """Shapes at rest and running on the geometry, then MAC matrices."""
    model = results.idle if results.idle is not None else results.operating
    if model is None:
        return missing("There are no mode shapes, since no modes were identified.")
    pairs = _shape_pairs(results)
    out = []
    if results.geometry is None:
        out.append(missing("There is no geometry; shapes are drawn as bars by DOF."))
    elif not any(results.geometry.position(d.node) is not None for d in model.dofs):
        out.append(missing("No measured DOF lies on a node of the geometry; shapes are drawn as bars by DOF."))
    if results.idle is not None and results.operating is None:
        out.append(missing("There are no operating modes to set beside the idle ones."))
    elif results.idle is None:
        out.append(missing("There are no idle modes to set beside the operating ones."))
    if len(pairs) > MOST_SHAPES:
        out.append(paragraph(f"The first {MOST_SHAPES} of {len(pairs)} modes are drawn."))
    if pairs:
        caption = (
            "Mode shapes at rest (left, orange) and running (right, blue), each to its own greatest value, turned to the real axis and to "
            "equal sense; grey: undeformed. Colour: displacement along the main direction of motion, purple positive, brown negative."
        )
        out.append(numbering.figure(figures_modes.mode_shapes(results.geometry, model.dofs, pairs[:MOST_SHAPES]), caption))
    out.append("<h3>MAC matrices</h3>" + _mac_figure(results, numbering))
    return "".join(out)


def _shape_pairs(results: Results) -> list[figures_modes.ShapePair]:
    """One entry a mode, in order of frequency; operating shapes on the DOFs of the idle ones, in their sense."""
    idle, operating = results.idle, results.operating
    if idle is None and operating is None:
        return []
    at_rest = None if idle is None else derive.real_shapes(idle)
    running = None if operating is None else derive.real_shapes(operating)
    if idle is not None and operating is not None and running is not None:
        running = _on_dofs(running, operating, idle)
    idle_rows, operating_rows = derive.mode_rows(idle), derive.mode_rows(operating)
    partner = {int(p["operating"]): p for p in derive.pairing_of(results) if p.get("idle") is not None}
    entries: list[tuple[float, figures_modes.ShapePair]] = []
    used: set[int] = set()
    for k, b in enumerate(operating_rows):
        assert operating is not None  # it has rows
        assert running is not None
        p = partner.get(k)
        f = float(operating.frequencies_hz[b])
        if p is None or idle is None or at_rest is None or p["idle"] >= idle_rows.size:
            entries.append((f, figures_modes.ShapePair(f"Operating {k}", None, running[:, b], "", f"running {f:.2f} Hz")))
            continue
        j = int(p["idle"])
        used.add(j)
        a = idle_rows[j]
        turn = 1.0 if float(at_rest[:, a] @ running[:, b]) >= 0 else -1.0
        f0 = float(idle.frequencies_hz[a])
        label = f"Idle {j} → operating {k}   MAC {fixed(p.get('mac'), 2)}"
        entries.append(
            (f0, figures_modes.ShapePair(label, at_rest[:, a], turn * running[:, b], f"idle {f0:.2f} Hz", f"running {f:.2f} Hz"))
        )
    if idle is not None and at_rest is not None:
        for j, a in enumerate(idle_rows):
            if j not in used and (bool(np.asarray(idle.in_band)[a]) or operating is None):
                f0 = float(idle.frequencies_hz[a])
                entries.append((f0, figures_modes.ShapePair(f"Idle {j}", at_rest[:, a], None, f"idle {f0:.2f} Hz", "")))
    return [pair for _, pair in sorted(entries, key=lambda e: e[0])]


def _on_dofs(values: Any, source: Any, target: Any) -> Any:
    """Rows of one model's shapes on the DOFs of another, NaN-free: zero where not measured."""
    out = np.zeros((len(target.dofs), values.shape[1]))
    for row, dof in enumerate(target.dofs):
        try:
            i, sign = match_dofs((dof,), source.dofs)
        except DofError:
            continue
        out[row] = values[i[0]] * sign[0]
    return out


def _labels(model: Any, rows: Any) -> list[str]:
    return [f"{k}: {model.frequencies_hz[i]:.1f}" for k, i in enumerate(rows)]


def _mac_figure(results: Results, numbering: Numbering) -> str:
    idle, operating = results.idle, results.operating
    matrices: list[Any] = []
    text = []
    idle_rows, operating_rows = derive.mode_rows(idle), derive.mode_rows(operating)
    if idle is not None and idle_rows.size:
        values = mac(idle.shapes[:, idle_rows])
        names = _labels(idle, idle_rows)
        matrices.append(("Idle × idle (AutoMAC)", values, names, names, "Idle mode: frequency [Hz]", "Idle mode: frequency [Hz]"))
        off = values - np.diag(np.diag(values))
        if off.size > 1 and off.max() > 0.05:
            a, b = sorted(int(v) for v in np.unravel_index(int(np.argmax(off)), off.shape))
            text.append(
                f"Least distinct at the sensors are idle modes {a} and {b} (MAC {off.max():.2f})"
                + ("; more or better placed sensors would tell them apart." if off.max() > 0.3 else ".")
            )
    if idle is not None and operating is not None and idle_rows.size and operating_rows.size:
        try:
            values = mac(idle.shapes[:, idle_rows], operating.rows(idle.dofs)[:, operating_rows])
        except DofError as error:
            text.append(f"Idle and operating DOFs differ, so there is no cross MAC ({error.message}).")
        else:
            across = (_labels(idle, idle_rows), _labels(operating, operating_rows))
            matrices.append(("Idle × operating", values, *across, "Idle mode: frequency [Hz]", "Operating mode: frequency [Hz]"))
    elif operating is not None and operating_rows.size:
        names = _labels(operating, operating_rows)
        values = mac(operating.shapes[:, operating_rows])
        matrices.append(
            ("Operating × operating (AutoMAC)", values, names, names, "Operating mode: frequency [Hz]", "Operating mode: frequency [Hz]")
        )
    if not matrices:
        return missing("There are no modes to compare by MAC.")
    caption = "MAC matrices with values; blank below 0.005. Small values off the diagonal mean that the sensors tell the modes apart."
    return numbering.figure(figures_modes.mac_matrices(matrices), caption) + "".join(paragraph(t) for t in text)


def scaling(results: Results, numbering: Numbering) -> str:
    """Pairing, method and reason, κ and what makes it large, alternatives."""
    if results.hybrid is None:
        return missing(left_out(results, "ofrf", "Operating shapes were not scaled"))
    info = derive.scaling_of(results)
    out = []
    method = info.get("method")
    text = f"Method “{method}”{_in_words(method)}." if method else "The method was not stated."
    if info.get("reason"):
        text += f" Reason: {str(info['reason']).rstrip('.')}."
    if finite(info.get("threshold")):
        text += f" A mode counts as unchanged from MAC {number(info['threshold'], 2)} on."
    residuals = str(info.get("residuals") or "").rstrip(".")
    modal = getattr(results.hybrid, "modal", None)
    if 0 < len(residuals) <= LONG_TEXT:
        text += f" Residuals: {residuals}."
    elif modal is not None and modal.residuals is not None:
        where = derive.range_text(modal.residuals.frequencies_hz)
        text += f" Residuals: {count(modal.n_residuals, 'mode')} of the idle model beyond the operating ones ({where})."
    out.append(paragraph(text))
    out.append(tables.pairing_table(results))
    notes = [f"Operating mode {p['operating']}: {str(p['note']).rstrip('.')}." for p in derive.pairing_of(results) if p.get("note")]
    notes += [f"{str(c).rstrip('.')}." for c in info.get("conflicts") or []]
    if notes:
        out.append("<ul>" + "".join(f"<li>{esc(n)}</li>" for n in dict.fromkeys(notes)) + "</ul>")
    out.append(_changes(results, numbering))
    out.append("<h3>Condition of the idle shapes</h3>" + _condition(results, info, numbering))
    alternatives = info.get("alternatives") or {}
    out.append("<h3>Other methods</h3>")
    out.append(
        tables.alternatives_table(alternatives, (info.get("evidence") or {}).get("refused") or {}, method)
        if alternatives
        else missing("No other scaling method was tried.")
    )
    return "".join(out)


def _in_words(method: Any) -> str:
    return f": {IN_WORDS[method]}" if method in IN_WORDS else ""


def _changes(results: Results, numbering: Numbering) -> str:
    idle, operating = results.idle, results.operating
    if idle is None or operating is None:
        return ""
    idle_rows, operating_rows = derive.mode_rows(idle), derive.mode_rows(operating)
    columns: list[tuple[str, float, float, float, float]] = []
    spread = lambda values, i: float(values[i]) if values is not None else float("nan")  # noqa: E731
    pairs = [
        p
        for p in derive.pairing_of(results)
        if p.get("idle") is not None and p["idle"] < idle_rows.size and p["operating"] < operating_rows.size
    ]
    for p in sorted(pairs, key=lambda p: int(p["idle"])):
        a, b = idle_rows[p["idle"]], operating_rows[p["operating"]]
        f0, f1, z0, z1 = idle.frequencies_hz[a], operating.frequencies_hz[b], idle.damping_ratios[a], operating.damping_ratios[b]
        if f0 <= 0 or z0 <= 0:
            continue
        f_std = 100 * float(np.hypot(spread(operating.frequency_std_hz, b) / f0, spread(idle.frequency_std_hz, a) * f1 / f0**2))
        z_std = 100 * float(np.hypot(spread(operating.damping_ratio_std, b) / z0, spread(idle.damping_ratio_std, a) * z1 / z0**2))
        columns.append((f"{f0:.1f}", 100 * float(f1 / f0 - 1), 100 * float(z1 / z0 - 1), f_std, z_std))
    if not columns:
        return ""
    labels, frequency, damping, f_spread, z_spread = zip(*columns, strict=True)
    svg = figures_compare.frequency_changes(labels, frequency, damping, f_spread, z_spread)
    return numbering.figure(svg, "Change of each paired mode from rest to operation, with 95 % intervals from both identifications.")


def _condition(results: Results, info: dict[str, Any], numbering: Numbering) -> str:
    kappa, idle = info.get("kappa"), results.idle
    text = (
        f"Condition number κ = {number(kappa, 3)} of the idle shape matrix used for scaling. "
        if finite(kappa)
        else "No condition number was given. "
    )
    text += "An error of the idle shapes may grow by up to 2κ in the condensed mass that scales changed modes."
    out = [paragraph(text)]
    if idle is None:
        return "".join(out)
    basis = getattr(results.hybrid, "basis", None)
    rows = np.flatnonzero(np.asarray(idle.in_band)) if basis is None else np.asarray(basis.modes, int)
    shape = None if np.iscomplexobj(idle.shapes) else derive.sensor_redundancy(np.asarray(idle.shapes[:, rows], float), idle.dofs)
    if shape is None:
        out.append(missing("There are fewer sensors than idle modes, so the sensors' part in κ is not defined."))
        return "".join(out)
    order = [i for i in np.argsort(-shape["dofs"])[:4] if shape["dofs"][i] > 0.08]
    weak = [i for i in np.argsort(-shape["modes"])[:4] if shape["modes"][i] > 0.08]
    sensors, share = listing(shape["labels"][i] for i in order), fixed(100 * float(np.sum(shape["dofs"][order])), 0)
    modes = listing(f"{rows[i]} ({number(idle.frequencies_hz[rows[i]], 4)} Hz)" for i in weak)
    text = f"For the {count(rows.size, 'idle mode')} that carry the mass κ is {number(shape['kappa'], 3)}. "
    if shape["kappa"] < SMALL_KAPPA:
        text += f"That is small: the sensors tell these modes apart well; least by {sensors}, and least idle modes {modes}."
    else:
        text += (
            f"It is made large by the sensors {sensors} ({share} % of the weakest direction), whose signals are nearly made of the "
            f"others; told apart least are idle modes {modes}. More sensors, or these moved, would lower it."
        )
    if np.any(np.isfinite(shape["without"])):
        least = int(np.nanargmax(shape["without"]))
        text += f" The sensor hardest to do without is {shape['labels'][least]}: κ would be {number(shape['without'][least], 3)}."
    out.append(paragraph(text))
    names = [f"{a}: {idle.frequencies_hz[a]:.1f}" for a in rows]
    svg = figures_modes.conditioning(shape["labels"], shape["dofs"], names, shape["modes"])
    caption = "Where the condition number comes from: the sensors and the idle modes in the direction of the least singular value."
    out.append(numbering.figure(svg, esc(caption)))
    return "".join(out)

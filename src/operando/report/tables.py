"""Tables of the report as HTML: modes, findings, pairing, comparison, rejected poles, settings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import PurePath
from typing import Any

import numpy as np

from operando.data import Finding, ModalModel, phase_collinearity
from operando.report.assessment import MODEL_NAMES, Assumption
from operando.report.derive import mode_rows, pairing_of
from operando.report.text import DASH, band_text, decibel, esc, finite, fixed, listing, number, plain, plus_minus, short_names
from operando.results import Results
from operando.scaling.methods import IN_WORDS

CLASS_WORDS = {
    "unchanged": ("unchanged", "good"),
    "changed": ("shape changed", "fair"),
    "beyond_idle_band": ("beyond idle band", "fair"),
    "unpaired": ("no idle partner", "poor"),
}
STATE_WORDS = {"holds": ("holds", "good"), "doubtful": ("doubtful", "fair"), "fails": ("fails", "poor"), "untested": ("not tested", "none")}
SEVERITY_WORDS = {"error": ("error", "poor"), "warning": ("warning", "fair"), "info": ("note", "none")}


def tag(word: str, grade: str) -> str:
    """A small framed word; the colour only repeats what the word says."""
    return f'<span class="tag {grade}">{esc(word)}</span>'


def table(
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    numeric: Iterable[int] = (),
    caption: str = "",
    wide: bool = False,
    mine: Iterable[int] = (),
) -> str:
    """HTML table; cells are HTML already.

    Parameters
    ----------
    head : sequence of str
        Column headings (HTML).
    rows : iterable of sequences of str
    numeric : iterable of int
        Columns aligned to the right.
    caption : str
    wide : bool
        Fill the width.
    mine : iterable of int
        Rows set off.
    """
    right, special = set(numeric), set(mine)
    cls = lambda k: ' class="n"' if k in right else ""  # noqa: E731
    out = ['<div class="scroll"><table' + (' class="wide"' if wide else "") + ">"]
    if caption:
        out.append(f"<caption>{caption}</caption>")
    out.append("<thead><tr>" + "".join(f'<th scope="col"{cls(k)}>{h}</th>' for k, h in enumerate(head)) + "</tr></thead><tbody>")
    for i, row in enumerate(rows):
        opening = '<tr class="mine">' if i in special else "<tr>"
        out.append(opening + "".join(f"<td{cls(k)}>{cell}</td>" for k, cell in enumerate(row)) + "</tr>")
    out.append("</tbody></table></div>")
    return "".join(out)


def _at(values: Any, i: int) -> Any:
    return None if values is None else values[i]


def percent(share: Any, digits: int = 2) -> str:
    """A share as per cent without the sign, a dash where there is none."""
    if not finite(share):
        return DASH
    return "&lt; 0.01" if abs(float(share)) < 1e-4 else number(100 * float(share), digits)


def mode_table(results: Results) -> str:
    """Modes from rest to operation with uncertainties, class and MAC; modes of one state alone stand with a dash."""
    idle, operating = results.idle, results.operating
    idle_rows, operating_rows = mode_rows(idle), mode_rows(operating)
    pairing = {int(p["operating"]): p for p in pairing_of(results) if p.get("operating") is not None}
    entries: list[tuple[float, list[str]]] = []
    used: set[int] = set()
    for k, b in enumerate(operating_rows):
        p = pairing.get(k, {})
        j = p.get("idle")
        a = int(idle_rows[j]) if j is not None and 0 <= j < idle_rows.size else None
        if j is not None:
            used.add(int(j))
        word, grade = CLASS_WORDS.get(str(p.get("class")), ("not paired", "none"))
        f = float(operating.frequencies_hz[b]) if operating is not None else 0.0
        f0 = None if a is None or idle is None else float(idle.frequencies_hz[a])
        shift = "" if f0 is None or f0 <= 0 else fixed(100 * (f / f0 - 1), 2, sign=True)
        cells = [DASH if j is None else str(j), *_idle_cells(idle, a), str(k), *_mode_cells(operating, int(b))]
        entries.append((f0 if f0 is not None else f, [*cells, shift or DASH, fixed(p.get("mac"), 3), tag(word, grade)]))
    if idle is not None:
        for j, a in enumerate(idle_rows):
            if j not in used:
                inside = bool(np.asarray(idle.in_band)[a])
                word = "not seen running" if operating is not None and inside else "outside band" if not inside else "idle only"
                entries.append(
                    (float(idle.frequencies_hz[a]), [str(j), *_idle_cells(idle, int(a)), DASH, DASH, DASH, DASH, DASH, tag(word, "none")])
                )
    entries.sort(key=lambda e: e[0])
    head = [
        "Idle<br>no.",
        "Idle frequency<br>[Hz]",
        "Idle damping<br>[%]",
        "Oper.<br>no.",
        "Operating frequency<br>[Hz]",
        "Operating damping<br>[%]",
    ]
    head += ["Frequency<br>change [%]", "MAC", "Class"]
    caption = "<b>Modes at rest and running</b>; ± is the 95 % interval. Numbers count from 0, as in the result files."
    return table(head, [row for _, row in entries], numeric=range(8), caption=caption, wide=True)


def _idle_cells(model: ModalModel | None, i: int | None) -> list[str]:
    return [DASH, DASH] if model is None or i is None else _mode_cells(model, i)


def _mode_cells(model: ModalModel | None, i: int) -> list[str]:
    if model is None:
        return [DASH, DASH]
    return [
        plus_minus(model.frequencies_hz[i], _at(model.frequency_std_hz, i), 6),
        plus_minus(model.damping_ratios[i], _at(model.damping_ratio_std, i), 3, factor=100.0),
    ]


def modal_table(model: ModalModel, caption: str) -> str:
    """Every mode of one model: frequency, damping, collinearity, greatest shape entry."""
    scaled, std = model.scaling == "unit_modal_mass", model.shape_std
    head = [
        "No.",
        "Frequency<br>[Hz]",
        "Damping<br>[%]",
        "Phase<br>collinearity",
        "Shape std<br>[% of rms]",
        "In band",
        "Greatest<br>at DOF",
    ]
    head += ["Shape value there<br>[kg<sup>−1/2</sup>]"] if scaled else []
    rows = []
    for i in range(model.n_modes):
        shape = np.asarray(model.shapes[:, i])
        top = int(np.argmax(np.abs(shape)))
        relative = None if std is None or not np.any(shape) else float(np.linalg.norm(std[:, i]) / np.linalg.norm(shape))
        cells = [str(i), *_mode_cells(model, i), fixed(phase_collinearity(shape), 4), percent(relative)]
        cells += ["yes" if bool(np.asarray(model.in_band)[i]) else "no", esc(model.dofs[top])]
        rows.append(cells + ([number(shape[top], 4)] if scaled else []))
    return table(head, rows, numeric=(0, 1, 2, 3, 4, 7), caption=caption)


def assumption_table(items: Sequence[Assumption]) -> str:
    """Assumptions of the method with their state and evidence."""
    rows = [[esc(a.name), tag(*STATE_WORDS[a.state]), esc(a.text)] for a in items]
    return table(
        ["Assumption", "State", "Evidence"], rows, caption="<b>What the method assumes</b>, and what these data say about it.", wide=True
    )


def findings_table(findings: Sequence[Finding]) -> str:
    """Findings grouped where only the place differs, the gravest first."""
    groups: dict[tuple[str, ...], list[Finding]] = {}
    for f in findings:
        groups.setdefault((f.severity, f.kind, f.consequence, f.action), []).append(f)
    rows = []
    for (severity, kind, consequence, action), group in groups.items():
        message = esc(group[0].message)
        if len(group) > 1:
            rest = "".join(f"<li>{esc(g.message)} <span class='pm'>{esc(_where(g))}</span></li>" for g in group[1:])
            message += f"<details><summary>and {len(group) - 1} more of this kind</summary><ul>{rest}</ul></details>"
        where = listing(dict.fromkeys(_where(g) for g in group if _where(g)), 4)
        rows.append([tag(*SEVERITY_WORDS[severity]), esc(kind.replace("_", " ")), message, esc(where), esc(consequence), esc(action)])
    return table(["Severity", "Kind", "What was found", "Where", "Consequence", "What to do"], rows, wide=True)


def _where(f: Finding) -> str:
    parts = [PurePath(f.file).name if f.file else "", f"set {f.set}" if f.set is not None else "", f.dof or ""]
    if f.time_s is not None:
        parts.append(f"{plain(f.time_s[0])}–{plain(f.time_s[1])} s")
    if f.band_hz is not None:
        parts.append(band_text(f.band_hz))
    return ", ".join(p for p in parts if p)


def pairing_table(results: Results) -> str:
    """Pairing and scale factor of each operating mode."""
    operating, idle = results.operating, results.idle
    operating_rows, idle_rows = mode_rows(operating), mode_rows(idle)
    outside = (results.hybrid.to_dict().get("scaling") or {}).get("outside_span") or []
    rows = []
    for p in pairing_of(results):
        k, j = int(p["operating"]), p.get("idle")
        f = operating.frequencies_hz[operating_rows[k]] if operating is not None and k < operating_rows.size else None
        f0 = idle.frequencies_hz[idle_rows[j]] if idle is not None and j is not None and j < idle_rows.size else None
        scale = p.get("scale")
        size = phase = DASH
        if scale and all(finite(s) for s in scale):
            size, phase = number(np.hypot(*scale), 4), fixed(np.degrees(np.arctan2(scale[1], scale[0])), 1)
        std = p.get("scale_std")
        word, grade = CLASS_WORDS.get(str(p.get("class")), (str(p.get("class")), "none"))
        beyond = outside[k] if k < len(outside) else None
        rows.append(
            [
                *(
                    str(k),
                    number(f, 5),
                    DASH if j is None else str(j),
                    number(f0, 5),
                    fixed(p.get("mac"), 3),
                    tag(word, grade),
                    size,
                    phase,
                ),
                *(percent(std), percent(beyond), percent(p.get("imaginary_share"))),
            ]
        )
    head = ["Oper.<br>no.", "Operating<br>[Hz]", "Idle<br>no.", "Idle<br>[Hz]", "MAC", "Class", "Scale<br>modulus", "Scale<br>phase [°]"]
    caption = "<b>Pairing and scale factors</b>; outside the span: part of the shape that no combination of idle shapes makes; "
    caption += "imaginary part: what is dropped in making the shape real."
    return table(
        [*head, "Scale<br>std [%]", "Outside the<br>span [%]", "Imaginary<br>part [%]"],
        rows,
        numeric=(0, 1, 2, 3, 4, 6, 7, 8, 9, 10),
        caption=caption,
    )


def comparison_table(models: Mapping[str, Mapping[str, Any]]) -> str:
    """Error measures of every model against the check."""
    order = [k for k in MODEL_NAMES if k in models] + [k for k in models if k not in MODEL_NAMES]
    rows = []
    for key in order:
        m = models[key]
        share = m.get("model_share")
        rows.append(
            [
                esc(MODEL_NAMES.get(key, key)),
                fixed(m.get("error_db"), 2),
                percent(m.get("relative_error"), 3),
                number(m.get("misfit"), 3),
                fixed(m.get("noise_floor_db"), 2),
                fixed(None if share is None else 100 * float(share), 0),
            ]
        )
    head = [
        "Model",
        "Level error<br>[dB rms]",
        "Relative error<br>[%]",
        "Misfit<br>[1 = noise]",
        "Noise floor<br>[dB]",
        "Of it the model's<br>own variance [%]",
    ]
    mine = [order.index("ofrf")] if "ofrf" in order else []
    caption = "<b>Models against the check measurement</b> (running, force measured), over all lines and pairs."
    return table(head, rows, numeric=range(1, 6), caption=caption, mine=mine)


def by_run_table(by_run: Sequence[Mapping[str, Any]]) -> str:
    """Level errors by check run."""
    keys = [k for k in MODEL_NAMES if any(k in _models_of(row) for row in by_run)]
    rows = []
    for n, row in enumerate(by_run):
        name = row.get("run") or row.get("name") or n
        level = row.get("level")
        rows.append(
            [
                esc(short_names(str(name))),
                esc(DASH if level is None else level),
                *(fixed(_models_of(row).get(k, {}).get("error_db"), 2) for k in keys),
            ]
        )
    head = ["Run", "Level", *(f"{esc(MODEL_NAMES[k])}<br>[dB]" for k in keys)]
    return table(head, rows, numeric=range(2, 2 + len(keys)), caption="<b>Level error by check run.</b>")


def _models_of(row: Mapping[str, Any]) -> Mapping[str, Any]:
    models = row.get("models")
    return models if isinstance(models, Mapping) else {k: v for k, v in row.items() if isinstance(v, Mapping)}


def by_mode_table(models: Mapping[str, Mapping[str, Any]]) -> str:
    """Frequency, peak height and damping error of the operating FRFs and the idle model, by mode of the check."""
    chosen = [k for k in ("ofrf", "idle_shapes", "idle") if (models.get(k) or {}).get("by_mode")]
    if not chosen:
        return ""
    rows: dict[float, list[str]] = {}
    blank = [DASH] * 3
    for n, key in enumerate(chosen):
        for entry in models[key]["by_mode"]:
            if not finite(entry.get("frequency_hz")):
                continue
            f = round(float(entry["frequency_hz"]), 6)
            row = rows.setdefault(f, [number(f, 5), *blank * len(chosen)])
            row[1 + 3 * n] = fixed(entry.get("frequency_error_percent"), 3, sign=True)
            row[2 + 3 * n] = fixed(entry.get("height_error_db"), 2, sign=True)
            row[3 + 3 * n] = fixed(entry.get("damping_error_percent"), 1, sign=True)
    names = {"ofrf": "operating FRFs", "idle_shapes": "idle shapes", "idle": "idle model"}
    head = ["Mode of the<br>check [Hz]"]
    for key in chosen:
        head += [f"{names[key]}:<br>frequency [%]", "peak height<br>[dB]", "damping<br>[%]"]
    caption = "<b>Errors by mode</b>, model minus check; modes from a refit of the check measurement."
    return table(head, [rows[f] for f in sorted(rows)], numeric=range(len(head)), caption=caption)


_OPINION_HEAD = {
    "frequency_hz": "Here<br>[Hz]",
    "other_frequency_hz": "Other<br>[Hz]",
    "damping_ratio": "Here<br>[%]",
    "other_damping_ratio": "Other<br>[%]",
    "mac": "MAC",
    "agrees": "Agrees",
    "text": "In words",
}


def second_opinion_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Modes of this identification beside those of an independent program."""
    keys = [k for k in _OPINION_HEAD if any(k in r for r in rows)]
    keys += [k for k in dict.fromkeys(k for r in rows for k in r) if k not in _OPINION_HEAD]
    cells = [[_opinion_cell(k, r.get(k)) for k in keys] for r in rows]
    right = [i for i, k in enumerate(keys) if k in ("frequency_hz", "other_frequency_hz", "damping_ratio", "other_damping_ratio", "mac")]
    heads = [_OPINION_HEAD.get(k, esc(k.replace("_", " ").capitalize())) for k in keys]
    return table(heads, cells, numeric=right)


def _opinion_cell(key: str, value: Any) -> str:
    if isinstance(value, bool | np.bool_):
        return tag("yes", "good") if value else tag("no", "poor")
    if key.endswith("damping_ratio"):
        return percent(value, 3)
    if key == "mac":
        return fixed(value, 3)
    return number(value, 6) if finite(value) else DASH if value is None else esc(value)


def rejected_table(rejected: Sequence[Any]) -> str:
    """Candidates that were not taken with their reasons, folded where there are many."""
    rows = [
        [number(r.frequency_hz, 5), fixed(100 * r.damping_ratio, 2), esc(r.code.replace("_", " ")), esc(r.reason)]
        for r in sorted(rejected, key=lambda r: r.frequency_hz)
    ]
    body = table(["Frequency [Hz]", "Damping [%]", "Why", "Reason"], rows, numeric=(0, 1), wide=True)
    codes: dict[str, int] = {}
    for r in rejected:
        codes[r.code] = codes.get(r.code, 0) + 1
    summary = listing(f"{n} {code.replace('_', ' ')}" for code, n in sorted(codes.items(), key=lambda c: -c[1]))
    opened = " open" if len(rows) <= 6 else ""
    return f"<details{opened}><summary>{len(rows)} candidates rejected: {esc(summary)}</summary>{body}</details>"


def evidence_table(linear: Any) -> str:
    """Poles of the linear stage of the EMA with what speaks for each, and doubts; folded."""
    rows = [
        [
            plus_minus(h, s),
            plus_minus(100 * z, 100 * d),
            number(e.evidence, 3),
            fixed(100 * e.rank_share, 1),
            fixed(e.collinearity, 2),
            fixed(100 * e.quadrature, 1),
            fixed(100 * e.drift, 3),
            esc("; ".join(text for _, text in e.doubts)) or "a mode",
        ]
        for h, s, z, d, e in zip(
            linear.frequencies_hz,
            linear.frequency_std_hz,
            linear.damping_ratios,
            linear.damping_ratio_std,
            linear.evidence,
            strict=True,
        )
    ]
    head = ["Frequency [Hz]", "Damping [%]", "Evidence [lines]", "One shape [%]", "Collinearity", "Quadrature [%]", "Drift [%]", "Verdict"]
    body = table(head, rows, numeric=tuple(range(7)), wide=True)
    title = f"Evidence of each pole in the linear stage ({len(rows)} poles; ± is the 95 % interval)"
    return f"<details><summary>{title}</summary>{body}</details>"


def alternatives_table(alternatives: Mapping[str, Any], refused: Mapping[str, Any], taken: str | None) -> str:
    """What the other named methods give, as the greatest difference from the one taken; why one was refused."""
    rows = []
    for name, value in sorted(alternatives.items(), key=lambda item: float(item[1]) if finite(item[1]) else np.inf):
        if name == taken:
            continue
        reason = f"not possible: {refused[name]}" if name in refused else "not possible" if value is None else value
        rows.append(
            [f'<span class="mono">{esc(name)}</span>', esc(IN_WORDS.get(name, "")), decibel(value) if finite(value) else esc(reason)]
        )
    caption = "<b>Other ways to scale</b>: greatest difference of the FRFs from those of the method taken, over all lines and pairs."
    return table(["Method", "What it does", "Greatest difference"], rows, caption=caption)

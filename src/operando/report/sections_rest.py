"""Sections on the measurements, the diagnosis, and how the results were made."""

from __future__ import annotations

from pathlib import PurePath
from typing import Any

from operando.data import Frf
from operando.report import derive, figures_frf, tables, tables_files
from operando.report.parts import Numbering, left_out, missing, paragraph
from operando.report.text import band_text, count, esc, finite, fixed, listing, number, plain, short_names
from operando.results import CheckRun, Results


def measured(results: Results, numbering: Numbering) -> str:
    """Inventory of files and findings about the data."""
    out = [_frf_inventory(results)]
    out.append(tables_files.inventory_table(results.inventory) if results.inventory else missing("No inventory of files was kept."))
    found = derive.all_findings(results)
    out.append("<h3>What is wrong with the data</h3>")
    if found:
        n = {s: sum(f.severity == s for f in found) for s in ("error", "warning", "info")}
        heavy = ", ".join((count(n["error"], "error"), count(n["warning"], "warning"), count(n["info"], "note")))
        out.append(paragraph(f"{heavy[:1].upper()}{heavy[1:]}; the gravest first."))
        out.append(tables.findings_table(found))
    else:
        out.append(missing("Nothing was found to be wrong with the data."))
    return "".join(out)


def _frf_inventory(results: Results) -> str:
    rows = []
    if results.idle_frf is not None:
        rows.append(["idle FRF", *_frf_cells(results.idle_frf)])
    rows += [[_check_cell(run), *_frf_cells(run.frf)] for run in results.check]
    if results.operating is not None:
        dofs = ", ".join(esc(d) for d in results.operating.dofs)
        rows.append(["operating, output only", dofs, "force not known", band_text(results.operating.band_hz), "–", "–", "–"])
    if not rows:
        return missing("No measurement has been processed yet.")
    head = ["State", "Responses", "References (forces)", "Lines", "Spacing [Hz]", "Effective<br>averages", "Units"]
    return tables.table(head, rows, numeric=(4, 5), caption="<b>What was measured.</b>", wide=True)


def _check_cell(run: CheckRun) -> str:
    return f"check, {esc(short_names(run.name))}" + (f" (level {esc(run.level)})" if run.level else "")


def _frf_cells(frf: Frf) -> list[str]:
    f = frf.frequencies_hz
    step = frf.axis.step
    responses = ", ".join(str(d) for d in frf.responses[:24]) + (f", … ({len(frf.responses)})" if len(frf.responses) > 24 else "")
    unit = figures_frf.UNITS[frf.quantity] if frf.si else "not known: numbers as in the file, no mass scaling"
    return [
        f"{len(frf.responses)}: {esc(responses)}",
        f"{len(frf.references)}: {esc(', '.join(str(d) for d in frf.references))}",
        f"{len(f)} from {plain(f[0])} to {plain(f[-1])} Hz",
        plain(step) if step else "uneven",
        number(frf.averages, 3),
        esc(unit),
    ]


def diagnosis(results: Results, numbering: Numbering) -> str:
    """Room for what the idle model lacks; a short account of ``diagnosis.json`` where there is one."""
    found = results.diagnosis
    if not found:
        return missing(left_out(results, "diagnose", "No diagnosis was made"))
    out = [paragraph(f"Verdict: {str(found.get('verdict', 'none')).replace('_', ' ')}.")]
    effects = found.get("effects") or []
    if effects:
        rows = [
            [
                esc(str(e.get("kind")).replace("_", " ")),
                esc(listing(e.get("location") or [])),
                _parameters(e),
                esc(e.get("explanation", "")),
                esc(e.get("confirm", "")),
            ]
            for e in effects
        ]
        out.append(tables.table(["Effect", "Place", "Size", "Explanation", "How to confirm"], rows, wide=True))
    if found.get("ambiguous_with"):
        others = listing(f"{str(e.get('kind')).replace('_', ' ')} at {listing(e.get('location') or [])}" for e in found["ambiguous_with"])
        out.append(paragraph(f"The data cannot tell the accepted effects from: {others}."))
    if found.get("proposed_measurement"):
        out.append(paragraph(f"Measurement that would decide: {found['proposed_measurement']}"))
    ladder = found.get("ladder") or []
    if ladder:
        rows = [
            [
                str(s.get("step")),
                esc(_effect_name(s.get("added"))),
                fixed(s.get("error_db"), 2),
                fixed(s.get("heldout_error_db"), 2),
                number(s.get("heldout_misfit"), 3),
            ]
            for s in ladder
        ]
        head = ["Step", "Added", "Error [dB]", "Held-out error [dB]", "Held-out misfit"]
        out.append(tables.table(head, rows, numeric=(0, 2, 3, 4), caption="<b>Error ladder.</b>"))
    return "".join(out)


def _effect_name(effect: Any) -> str:
    if not isinstance(effect, dict):
        return "idle model" if effect is None else str(effect)
    return f"{str(effect.get('kind')).replace('_', ' ')} at {listing(effect.get('location') or [])}"


def _parameters(effect: dict[str, Any]) -> str:
    parts = []
    for name, p in (effect.get("parameters") or {}).items():
        value = p if isinstance(p, dict) else {"value": p}
        parts.append(f"{esc(name)} {tables.plus_minus(value.get('value'), value.get('std'))} {esc(value.get('unit', ''))}")
    return "; ".join(parts)


def provenance(results: Results, numbering: Numbering) -> str:
    """Settings, stages left out, timings, versions, inputs with their hashes, processing calls."""
    import platform
    from importlib.metadata import PackageNotFoundError, version

    from operando import __version__
    from operando.data import Provenance

    out = [tables_files.settings_table(results.settings) if results.settings else missing("No settings were kept.")]
    if results.left_out:
        rows = [[esc(stage), esc(reason)] for stage, reason in results.left_out.items()]
        out.append(tables.table(["Stage", "Why"], rows, caption="<b>Stages left out.</b>"))
    if results.timings_s:
        rows = [[esc(stage), fixed(seconds, 2)] for stage, seconds in results.timings_s.items()]
        rows.append(["together", fixed(sum(v for v in results.timings_s.values() if finite(v)), 2)])
        out.append(tables.table(["Stage", "Wall time [s]"], rows, numeric=(1,), caption="<b>Timings.</b>", mine=[len(rows) - 1]))
    names = [("operando", __version__), ("Python", platform.python_version())]
    for package in ("numpy", "scipy", "matplotlib"):
        try:
            names.append((package, version(package)))
        except PackageNotFoundError:  # pragma: no cover
            continue
    out.append(paragraph("Versions: " + ", ".join(f"{n} {v}" for n, v in names) + "."))
    parts = [results.idle_frf, results.idle, results.operating, *(run.frf for run in results.check), results.geometry]
    merged = Provenance.merge(*(p.provenance for p in parts if p is not None))
    inputs = {str(row["sha256"]): "/".join(PurePath(str(row.get("file"))).parts[-2:]) for row in results.inventory if row.get("sha256")}
    inputs |= {digest: short_names(path) for path, digest in merged.inputs if digest not in inputs}
    if inputs:
        rows = [[f'<span class="mono">{esc(path)}</span>', f'<span class="mono">{esc(digest)}</span>'] for digest, path in inputs.items()]
        out.append(tables.table(["Input", "SHA-256"], rows, caption="<b>Inputs.</b>"))
    else:
        out.append(missing("No input hashes were kept."))
    if merged.calls:
        calls = "".join(f'<li class="mono">{esc(c)}</li>' for c in merged.calls)
        out.append(f"<details><summary>Processing calls ({len(merged.calls)})</summary><ol>{calls}</ol></details>")
    return "".join(out)

"""Sections on the measurements, and on how the results were made."""

from __future__ import annotations

from pathlib import PurePath

from operando.data import Frf, unit_of
from operando.report import derive, tables, tables_files
from operando.report.parts import Numbering, missing, paragraph
from operando.report.text import band_text, count, esc, number, plain, short_names
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
    unit = unit_of(frf.quantity) if frf.si else "not known: numbers as in the file, no mass scaling"
    return [
        f"{len(frf.responses)}: {esc(responses)}",
        f"{len(frf.references)}: {esc(', '.join(str(d) for d in frf.references))}",
        f"{len(f)} from {plain(f[0])} to {plain(f[-1])} Hz",
        plain(step) if step else "uneven",
        number(frf.averages, 3),
        esc(unit),
    ]


def provenance(results: Results, numbering: Numbering) -> str:
    """Settings, stages left out, versions, inputs with their hashes, processing calls."""
    import platform
    from importlib.metadata import PackageNotFoundError, version

    from operando import __version__
    from operando.data import Provenance

    out = [tables_files.settings_table(results.settings) if results.settings else missing("No settings were kept.")]
    if results.left_out:
        rows = [[esc(stage), esc(reason)] for stage, reason in results.left_out.items()]
        out.append(tables.table(["Stage", "Why"], rows, caption="<b>Stages left out.</b>"))
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

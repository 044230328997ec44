"""What a finished run says: the answer first, then tables."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from operando.cli.answer import Answer, say, table
from operando.cli.progress import following

if TYPE_CHECKING:
    from operando.config import Test
    from operando.results import Results

MODEL_NAMES = {
    "ofrf": "operational FRF (hybrid)",
    "effect": "operational FRF (idle model + effects)",
    "idle": "idle model as it is",
    "idle_shapes": "idle shapes, operational poles",
    "msf_all": "all shapes by MSF",
}


def run_to(test: Test, out: Path, until: str | None = None, report: bool | None = None) -> Results:
    """Run a test with its progress on stderr; see :func:`operando.pipeline.run`."""
    from operando.pipeline import run

    with following(_asked(until, report), out) as progress:
        return run(test, out, until=until, progress=progress, report=report)


def _asked(until: str | None, report: bool | None) -> tuple[str, ...]:
    """Stages that a run will come to."""
    from operando.pipeline import STAGES

    asked = STAGES if until is None else STAGES[: STAGES.index(until) + 1]
    return (*asked, "report") if report and "report" not in asked else asked


def open_report(path: Path) -> None:
    """Open a report in the browser; where none can be started, where the report is."""
    import webbrowser

    if not path.is_file():
        say(f"operando: there is no report to open at {path}")
    elif not webbrowser.open(path.resolve().as_uri()):
        say(f"operando: no browser could be started; the report is {path}")


def run_answer(test: Test, out: Path, until: str | None = None, report: bool | None = None, *, show: bool) -> Answer:
    """Run a test with its progress on stderr and answer, the report open in the browser if asked; an error if a stage failed."""
    from operando.jsonable import jsonable
    from operando.pipeline.again import run_and_tell

    def tell(results: Results) -> dict[str, Any]:
        return {"document": jsonable(run_document(results, out, until)), "text": run_text(results, out)}

    with following(_asked(until, report), out) as progress:
        said = run_and_tell(test, out, tell, until=until, progress=progress, report=report)
    if show:
        open_report(out / "report.html")
    if said.results is None:  # nothing had changed, and nothing heavy is loaded
        return Answer(said.told["document"], said.told["text"])
    from operando.pipeline.summary import failure

    return Answer(said.told["document"], said.told["text"], failure(said.results, out))


def run_document(results: Results, out: Path, until: str | None) -> dict[str, Any]:
    """``summary.json`` with the folder and the comparison."""
    from operando.compare import recommended
    from operando.pipeline.summary import summary

    document = summary(results) | {"results": str(out), "until": until, "comparison": results.comparison, "timings_s": results.timings_s}
    route = recommended(results.comparison, results.diagnosis, results.hybrid is not None)
    return document | {"verdict": (results.diagnosis or {}).get("verdict"), "route": None if route is None else route.to_dict()}


def run_text(results: Results, out: Path) -> str:
    """Short text: errors of the models, modes, findings, what was left out, where the files are."""
    from operando.pipeline.summary import failure

    failed = failure(results, out)
    parts = [f"{results.name}: {failed.message}" + (f" ({failed.hint})" if failed.hint else "")] if failed is not None else []
    parts.append(headline(results))
    if results.comparison is not None:
        parts.append(comparison_table(results.comparison))
    if results.idle is not None:
        parts.append(f"Idle modes ({_scaling(results)}):\n" + mode_table(results.idle))
    if results.operating is not None:
        parts.append("Operational modes:\n" + mode_table(results.operating, results.hybrid, results.idle))
    if said := _intervals(results):
        parts.append(said)
    if results.diagnosis is not None:
        from operando.cli.diagnose import text_of

        parts.append("Diagnosis:\n" + text_of(None, results.diagnosis))
    parts.append(findings_text(results))
    left = [f"  {stage}: {reason}" for stage, reason in results.left_out.items()]
    if left:
        parts.append("Left out:\n" + "\n".join(left))
    report = out / "report.html"
    parts.append(f"Report: {report}" if report.exists() else f"Results: {out}")
    return "\n\n".join(p for p in parts if p)


def headline(results: Results) -> str:
    """The answer first: verdict and recommended route where there is a diagnosis, else how far the run came."""
    from operando.data import counted
    from operando.report.assessment import route_words

    if results.diagnosis is not None:
        from operando.report.words_diagnosis import diagnosis_words

        words = diagnosis_words(results.diagnosis)
        title = f"{words.title[:1].lower()}{words.title[1:]}"
        cause = words.found[0] if words.verdict == "explained" and len(words.found) == 1 else ""
        return " ".join(part for part in (f"{results.name}: {words.verdict} - {title}.", cause, route_words(results)) if part)
    if results.hybrid is not None:
        count, method = len(results.hybrid.modal.dofs), results.hybrid.method
        route = route_words(results) if results.comparison is not None else ""
        made = f"{results.name}: operational FRFs of {count} DOFs by method {method}"
        if route:
            return f"{made}. {route}"
        return f"{made}; there is no validation measurement."
    if results.operating is not None and results.idle is not None:
        why = results.left_out.get("ofrf", "")
        return (
            f"{results.name}: {_count(results.idle)} idle and {counted(_count(results.operating), 'operational mode')} in band; "
            "no operational FRFs" + (f" ({why})." if why else ".")
        )
    if results.idle is not None:
        idle = ((results.comparison or {}).get("models") or {}).get("idle") or {}
        off = idle.get("error_db")
        error = "" if off is None else f" The idle model is off by {off:.2f} dB from the validation measurement."
        return f"{results.name}: {counted(_count(results.idle), 'idle mode')} in band.{error}"
    if results.operating is not None:
        return f"{results.name}: {counted(_count(results.operating), 'operational mode')} in band."
    if results.idle_frf is not None:
        f = results.idle_frf
        band = f"{f.frequencies_hz[0]:.4g} … {f.frequencies_hz[-1]:.4g} Hz"
        return f"{results.name}: FRFs of {counted(len(f.responses), 'response')} to {counted(len(f.references), 'reference')}, {band}."
    return f"{results.name}: {len(results.inventory)} files read." if results.inventory else ""


def comparison_table(comparison: dict[str, Any]) -> str:
    """Error measures of all models."""
    from operando.compare.verdict import FLOOR_DB, floor_text

    beyond = any((m["noise_floor_db"] or 0) > FLOOR_DB for m in comparison["models"].values())
    rows = [
        [MODEL_NAMES.get(name, name), _fixed(m["error_db"], 2), _percent(m["relative_error"]), m["misfit"], floor_text(m["noise_floor_db"])]
        for name, m in sorted(
            comparison["models"].items(), key=lambda item: list(MODEL_NAMES).index(item[0]) if item[0] in MODEL_NAMES else 99
        )
    ]
    on = comparison.get("judged_on") or {}
    head = table(rows, ["model", "error dB", "relative %", "reduced χ²", "floor dB"])
    if beyond:
        head += f"\nfloor > {FLOOR_DB:g} dB: uncertainties so large have no meaning in dB; the reduced χ² says whether there is an error"
    return head + (f"\nagainst {', '.join(on['runs'])}, level {on['level_name']}, {_lines(comparison)}" if on else "")


def _lines(comparison: dict[str, Any]) -> str:
    band = comparison["judged_on"]["band_hz"]
    counts = sorted({m["n_lines"] for m in comparison["models"].values()})
    text = " … ".join(map(str, dict.fromkeys((counts[0], counts[-1])))) + " complex values"
    return text + (f" in {band[0]:.4g} … {band[1]:.4g} Hz" if band else "")


def mode_table(model: Any, hybrid: Any = None, idle: Any = None) -> str:
    """Frequency and damping with 95 % intervals (±); the idle partner of operational modes, and the change of frequency from it."""
    from operando.report.class_words import class_words
    from operando.report.text import plus_minus

    rows = []
    none = [None] * model.n_modes
    f_std, z_std = (none if std is None else std for std in (model.frequency_std_hz, model.damping_ratio_std))
    pairs = {p["operating"]: p for p in hybrid.to_dict()["pairing"]} if hybrid is not None else {}
    for i in range(model.n_modes):
        row: list[Any] = [
            i,
            *plus_minus(model.frequencies_hz[i], f_std[i], 6).partition(" ± ")[::2],
            *plus_minus(model.damping_ratios[i], z_std[i], 3, 100.0).partition(" ± ")[::2],
            "" if model.in_band[i] else "no",
        ]
        if hybrid is not None:
            p = pairs.get(i, {"idle": None, "mac": None})
            j = p["idle"]
            row += [
                "" if j is None else str(j),
                "" if j is None or idle is None else f"{100 * (model.frequencies_hz[i] / idle.frequencies_hz[j] - 1):+.2f}",
                "" if p["mac"] is None else f"{p['mac']:.3f}",
                class_words(p)[0] if i in pairs else "",
            ]
        rows.append(row)
    head = ["mode", "Hz", "± Hz", "damping %", "± %", "band"]
    return table(rows, head + (["idle", "Hz changed by %", "MAC", "class"] if hybrid is not None else []))


def _intervals(results: Results) -> str:
    """What ± means in the tables of modes, said once; nothing where no mode has an interval."""
    idle, operating = (
        model is not None and model.n_modes > 0 and model.frequency_std_hz is not None for model in (results.idle, results.operating)
    )
    if not idle and not operating:
        return ""
    of_idle = " Of idle modes it is that of one measurement (noise, error of the fit): another day or mounting may differ by more."
    return "± is the 95 % interval." + (of_idle if idle else "")


def findings_text(results: Results, most: int = 12) -> str:
    """Warnings and errors, the rest counted."""
    from operando.data import counted

    ranked = sorted((f for f in results.findings if f.severity != "info"), key=lambda f: f.severity != "error")
    if not results.findings:
        return "Findings: none"
    lines = []
    for f in ranked[:most]:
        todo = f" ({f.action})" if f.action and f.severity != "error" else ""
        lines.append(f"  {f.severity}: {'' if f.file is None else f.file + ': '}{f.message}{todo}")
        if f.severity == "error":  # what it does to the results, and what to do, stand beside it
            lines += [f"    {text}" for text in (f.consequence, f.action) if text]
    rest = len(results.findings) - len(ranked[:most])
    if rest:
        lines.append(
            f"  and {rest} more in the report and in summary.json"
            if lines
            else f"  {counted(rest, 'remark')} in the report and in summary.json"
        )
    return f"Findings ({len(results.findings)}):\n" + "\n".join(lines)


def _count(model: Any) -> int:
    return int(model.in_band.sum())


def _scaling(results: Results) -> str:
    from operando.scaling.no_scale import no_scale

    cause = None if results.idle is None else no_scale(results.idle, results.findings)
    return "unit modal mass" if cause is None else f"no mass scaling: {cause[0]}"


def _fixed(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.2f}"

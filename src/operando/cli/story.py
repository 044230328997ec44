"""What a finished run says: the answer first, then tables."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from operando.cli.answer import Answer, say, table
from operando.errors import IdentificationError, OperandoError

if TYPE_CHECKING:
    from operando.results import Results

MODEL_NAMES = {
    "ofrf": "operational FRF (hybrid)",
    "effect": "operational FRF (idle model + effects)",
    "idle": "idle model as it is",
    "idle_shapes": "idle shapes, operational poles",
    "msf_all": "all shapes by MSF",
}


class Clock:
    """Progress on stderr: seconds since the start, stage, message."""

    def __init__(self) -> None:
        self.start = time.perf_counter()

    def __call__(self, stage: str, message: str) -> None:
        say(f"[{time.perf_counter() - self.start:6.1f} s] {stage:8s} {message}")


def run_answer(results: Results, out: Path, until: str | None) -> Answer:
    """Answer of a run: ``summary.json`` with the folder and the comparison, tables, and an error if a stage failed."""
    from operando.pipeline import summary

    document = summary(results) | {"results": str(out), "until": until, "comparison": results.comparison, "timings_s": results.timings_s}
    return Answer(document, run_text(results, out), failure(results, out))


def failure(results: Results, out: Path) -> OperandoError | None:
    """The first stage that failed, as an error."""
    for stage, reason in results.left_out.items():
        if reason.startswith("failed: "):
            for finding in results.findings:
                if finding.kind == "stage_failed" and finding.message.startswith(f"stage {stage}: "):
                    hint = finding.action or f"what the other stages found stands in {out}"
                    return IdentificationError(finding.message, where=finding.file, hint=hint)
            return IdentificationError(f"stage {stage}: {reason.removeprefix('failed: ')}")
    return None


def run_text(results: Results, out: Path) -> str:
    """Short text: errors of the models, modes, findings, what was left out, where the files are."""
    failed = failure(results, out)
    parts = [f"{results.name}: {failed.message}" + (f" ({failed.hint})" if failed.hint else "")] if failed is not None else []
    parts.append(headline(results))
    if results.comparison is not None:
        parts.append(comparison_table(results.comparison))
    if results.idle is not None:
        parts.append(f"Idle modes ({_scaling(results.idle)}):\n" + mode_table(results.idle))
    if results.operating is not None:
        parts.append("Operational modes:\n" + mode_table(results.operating, results.hybrid))
    if results.diagnosis is not None:
        from operando.cli.diagnose import text_of

        parts.append("What is missing in the idle model - " + text_of(results.name, results.diagnosis))
    parts.append(findings_text(results))
    left = [f"  {stage}: {reason}" for stage, reason in results.left_out.items()]
    if left:
        parts.append("Left out:\n" + "\n".join(left))
    report = out / "report.html"
    parts.append(f"Report: {report}" if report.exists() else f"Results: {out}")
    return "\n\n".join(p for p in parts if p)


def headline(results: Results) -> str:
    """One sentence: how well the operational FRFs predict the check."""
    models = {} if results.comparison is None else results.comparison["models"]
    ofrf, idle = models.get("ofrf"), models.get("idle")
    if ofrf and idle and ofrf["error_db"] is not None and idle["error_db"] is not None:
        floor = f"; the noise floor is {ofrf['noise_floor_db']:.2g} dB" if ofrf["noise_floor_db"] is not None else ""
        return (
            f"{results.name}: the operational FRFs miss the check measurement by {ofrf['error_db']:.2f} dB, "
            f"the idle model by {idle['error_db']:.2f} dB{floor}."
        )
    if results.hybrid is not None:
        count, method = len(results.hybrid.modal.dofs), results.hybrid.method
        return f"{results.name}: operational FRFs of {count} DOFs by method {method}; no check measurement judged them."
    if results.operating is not None and results.idle is not None:
        return (
            f"{results.name}: {_count(results.idle)} idle and {_count(results.operating)} operational modes in band; no operational FRFs."
        )
    if results.idle is not None:
        return f"{results.name}: {_count(results.idle)} idle modes in band."
    if results.operating is not None:
        return f"{results.name}: {_count(results.operating)} operational modes in band."
    if results.idle_frf is not None:
        f = results.idle_frf
        band = f"{f.frequencies_hz[0]:.4g} … {f.frequencies_hz[-1]:.4g} Hz"
        return f"{results.name}: FRFs of {len(f.responses)} responses to {len(f.references)} references, {band}."
    return f"{results.name}: {len(results.inventory)} files looked at." if results.inventory else ""


def comparison_table(comparison: dict[str, Any]) -> str:
    """Error measures of all models."""
    rows = [
        [MODEL_NAMES.get(name, name), _fixed(m["error_db"], 2), _percent(m["relative_error"]), m["misfit"], _fixed(m["noise_floor_db"], 2)]
        for name, m in sorted(
            comparison["models"].items(), key=lambda item: list(MODEL_NAMES).index(item[0]) if item[0] in MODEL_NAMES else 99
        )
    ]
    return table(rows, ["model", "error dB", "relative %", "misfit", "floor dB"])


def mode_table(model: Any, hybrid: Any = None) -> str:
    """Frequency and damping with standard deviations; the idle partner of operational modes."""
    rows = []
    f_std, z_std = model.frequency_std_hz, model.damping_ratio_std
    pairs = {p["operating"]: p for p in hybrid.to_dict()["pairing"]} if hybrid is not None else {}
    for i in range(model.n_modes):
        row: list[Any] = [
            i,
            f"{model.frequencies_hz[i]:.4f}",
            "" if f_std is None else f"{f_std[i]:.2g}",
            f"{100 * model.damping_ratios[i]:.4f}",
            "" if z_std is None else f"{100 * z_std[i]:.2g}",
            "" if model.in_band[i] else "outside",
        ]
        if hybrid is not None:
            p = pairs.get(i)
            row += [
                "" if p is None or p["idle"] is None else str(p["idle"]),
                "" if p is None or p["mac"] is None else f"{p['mac']:.3f}",
                "" if p is None else p["class"],
            ]
        rows.append(row)
    head = ["mode", "Hz", "± Hz", "damping %", "± %", "band"]
    return table(rows, head + (["idle", "MAC", "class"] if hybrid is not None else []))


def findings_text(results: Results, most: int = 12) -> str:
    """Warnings and errors, the rest counted."""
    ranked = sorted((f for f in results.findings if f.severity != "info"), key=lambda f: f.severity != "error")
    if not results.findings:
        return "Findings: none"
    lines = [f"  {f.severity}: {'' if f.file is None else f.file + ': '}{f.message}" for f in ranked[:most]]
    rest = len(results.findings) - len(lines)
    if rest:
        lines.append(
            f"  and {rest} more in the report and in summary.json" if lines else f"  {rest} remarks in the report and in summary.json"
        )
    return f"Findings ({len(results.findings)}):\n" + "\n".join(lines)


def _count(model: Any) -> int:
    return int(model.in_band.sum())


def _scaling(model: Any) -> str:
    return "unit modal mass" if model.scaling == "unit_modal_mass" and model.si else "no mass scaling: units or drive point missing"


def _fixed(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.2f}"

"""``operando ofrf``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from operando.cli.answer import Answer, answers, apart_from_runs, own_option, say, table
from operando.cli.sources import not_made

if TYPE_CHECKING:
    from operando.data import Frf

UNITS = {"accelerance": "(m/s2)/N", "mobility": "(m/s)/N", "receptance": "m/N"}
MOST_VALUES = 2_000_000
"""Complex values beyond which the JSON document refers to the file instead of holding them."""


@click.command(
    "ofrf", epilog="Example: operando ofrf pump-results --responses 12+Z,13+Z --references 1+Z --frequencies 5:220:0.25 -o pair.uff"
)
@click.argument("folder", metavar="DIR", type=click.Path())
@click.option("--responses", metavar="DOFS", help="Comma-separated DOFs, as in 12+Z,7-X (default: all).")
@click.option("--references", metavar="DOFS", help="Comma-separated DOFs (default: all).")
@click.option("--frequencies", metavar="A:B:STEP", help="Lines in Hz (default: the lines of the idle FRFs).")
@click.option("--quantity", type=click.Choice(["accelerance", "mobility", "receptance"]), default="accelerance", show_default=True)
@click.option(
    "--route",
    type=click.Choice(["hybrid", "effect", "idle"]),
    default=None,
    help="hybrid: scaled operational modes; effect: idle model + accepted effects; idle: idle model (default: as the results recommend).",
)
@click.option(
    "--level",
    type=float,
    metavar="N",
    help="Route effect: FRFs under a random force of this rms [N], even over the band (default: the lowest level measured).",
)
@click.option(
    "--set",
    "changes",
    multiple=True,
    metavar="STEP.NAME=VALUE",
    help="Route effect: another value of an accepted effect, as in 1.stiffness=2e5 (SI); may be repeated.",
)
@click.option("-o", "--output", type=click.Path(dir_okay=False), help="File to write: .uff, .h5, .mat or .csv by its ending.")
@own_option
@answers
def ofrf(
    folder: str,
    responses: str | None,
    references: str | None,
    frequencies: str | None,
    quantity: str,
    route: str | None,
    level: float | None,
    changes: tuple[str, ...],
    output: str | None,
) -> Answer:
    """Operational FRFs of any response-reference pair, with the standard deviation of each line.

    DIR is a results folder or its model.h5. A DOF asked for in the other sense (12-Z) changes sign.
    """
    import warnings

    import numpy as np

    from operando.atomic import writing
    from operando.compare import recommended
    from operando.dof import check_dofs
    from operando.errors import DataError
    from operando.io.convert import format_of, losses
    from operando.store import load_results

    if level is not None and not 0 < level < float("inf"):
        raise click.UsageError("--level is a force in N, more than 0")
    values = [parse_change(text) for text in changes]
    apart_from_runs(output, "ofrf", folder, Path(folder) / "model.h5")
    wanted, driven = _dofs(responses, "--responses"), _dofs(references, "--references")
    lines = None if frequencies is None else parse_lines(frequencies)
    results = load_results(folder, only=("comparison", "diagnosis", "hybrid", "idle_frf", "left_out", "settings", "geometry"))
    advised = recommended(results.comparison, results.diagnosis, results.hybrid is not None)
    warning = why = None
    if route is None:
        why = None if advised is None else f"Route {advised.name}, as the results recommend: {advised.reason}."
        route = advised.name if advised is not None else "hybrid"
    elif advised is not None and advised.name != route and not changes and level is None:
        warning = f"the results recommend --route {advised.name}: {advised.reason}"
        say(f"warning: {warning}")
    if route != "effect" and (changes or level is not None):
        option = "--set" if changes else "--level"
        raise click.UsageError(f"{option} belongs to --route effect, and this is --route {route}: {why or 'as asked'}")
    if route != "hybrid":
        more = load_results(folder, only=("idle", "effect_idle", "effect_covariance"))
        results = replace(results, idle=more.idle, effect_idle=more.effect_idle, effect_covariance=more.effect_covariance)
        if route == "effect" and results.diagnosis is None:
            raise not_made("there is no model with accepted effects", "diagnose", results, folder)
    elif results.hybrid is None:
        raise not_made("there are no operational FRFs", "ofrf", results, folder)
    if lines is None:
        from operando.pipeline.outputs import ofrf_lines

        lines = ofrf_lines(results)
    elif results.idle_frf is not None:
        check_lines(lines, results.idle_frf, f"{folder}, --frequencies")
    known = results.hybrid.modal if route == "hybrid" else results.idle
    for option, dofs in (("--responses", wanted), ("--references", driven)):
        if known is not None and dofs is not None:
            check_dofs(dofs, known.dofs, f"{folder}, {option}")
    model: Any
    if route == "effect" and level is None:
        from operando.diagnosis.at_level import lowest_force

        level = lowest_force(results.diagnosis or {})
    if level is not None:
        from operando.diagnosis.at_level import LevelModel

        model = LevelModel.of(results, level, values)
        method, own = f"idle model + {', '.join(str(e) for e in model.effects) or 'no effect'} at {level:g} N", ()
        if any(effect.definition.level_dependent for effect in model.effects):
            why = "\n".join((*(() if why is None else (why,)), f"note: {model.words}"))
    elif route == "idle":
        if results.idle is None:
            raise not_made("there is no idle model", "ema", results, folder)
        model, method, own = results.idle, "idle model", ()
    elif route == "effect":
        from operando.diagnosis.stored import effect_model

        model = effect_model(results, values).structure()
        method, own = "idle model + " + (", ".join(str(e) for e in model.effects) or "no effect"), ()
    else:
        model, method, own = results.hybrid, results.hybrid.method, results.hybrid.findings
    frf = model.frf(np.asarray(lines, float), wanted, driven, quantity)
    document: dict[str, Any] = {
        "schema": "operando/ofrf/1",
        "route": route,
        "method": method,
        "recommended": None if advised is None else advised.to_dict(),
        "warning": warning,
        "level_n": level,
        "changed": [{"step": step, "parameter": name, "value": value} for step, name, value in values],
        "settings": results.settings,
        "responses": [str(d) for d in frf.responses],
        "references": [str(d) for d in frf.references],
        "quantity": quantity,
        "unit": UNITS[quantity],
        "file": output,
        "findings": [f.to_dict() for f in (*own, *frf.findings)],
    }
    if output is not None:
        with writing(output):
            Path(output).parent.mkdir(parents=True, exist_ok=True)
        with warnings.catch_warnings(action="ignore"):  # the answer says the same
            frf.save(output)
        # findings and provenance stand in the answer itself
        document["lost"] = [text for text in losses(frf, format_of(output)) if text != "findings and provenance"]
    elif frf.data.size > MOST_VALUES:
        raise DataError(f"{frf.data.size} values are too many to print", hint="name a file with -o, or ask for fewer pairs or lines")
    else:
        data = np.stack([frf.data.real, frf.data.imag], axis=-1)
        document |= {"frequencies_hz": frf.frequencies_hz, "data": data, "std": None if frf.variance is None else np.sqrt(frf.variance)}
    text = "\n".join((_text(frf, method, output), *(f"lost in {output}: {lost}" for lost in document.get("lost", ()))))
    return Answer(document, text if why is None else f"{text}\n{why}")


def _dofs(text: str | None, option: str) -> Any:
    from operando.dof import parse_dofs
    from operando.errors import DofError

    if text is None:
        return None
    try:
        found = parse_dofs(text)
    except DofError as error:
        raise click.BadParameter(str(error), param_hint=option) from None
    if not found:
        raise click.BadParameter("names no DOF", param_hint=option)
    return found


def parse_change(text: str) -> tuple[int, str, float]:
    """Step, parameter and value of ``STEP.NAME=VALUE``.

    Raises a click.BadParameter if the text is no such change.
    """
    import math

    where, _, value = text.partition("=")
    step, _, name = where.partition(".")
    try:
        out = int(step), name.strip(), float(value)
    except ValueError:
        out = 0, "", math.nan
    if out[0] < 1 or not out[1] or not math.isfinite(out[2]):
        raise click.BadParameter(f"{text!r} is not STEP.NAME=VALUE, as in 1.stiffness=2e5", param_hint="--set")
    return out


def parse_lines(text: str) -> Any:
    """Lines [Hz] of ``A:B:STEP``, both ends included.

    Raises a click.BadParameter if the text is no such range.
    """
    import numpy as np

    try:
        low, high, step = (float(part) for part in text.split(":"))
    except ValueError:
        raise click.BadParameter(f"{text!r} is not A:B:STEP in Hz, as in 5:220:0.25", param_hint="--frequencies") from None
    if not (0 <= low <= high < float("inf") and 0 < step < float("inf")):
        raise click.BadParameter(f"{text!r}: 0 <= A <= B and STEP > 0 are needed", param_hint="--frequencies")
    count = int(np.floor((high - low) / step * (1 + 1e-12) + 1e-9)) + 1
    if count > 10_000_000:
        raise click.BadParameter(f"{text!r} makes {count} lines", param_hint="--frequencies")
    return low + step * np.arange(count)


def check_lines(lines: Any, measured: Frf, where: str) -> None:
    """Lines asked for must lie within those of the idle FRFs: nothing beyond them was ever compared with a measurement."""
    from operando.errors import ConfigError

    low, high = float(measured.frequencies_hz[0]), float(measured.frequencies_hz[-1])
    slack = 1e-6 * high
    if lines[0] < low - slack or lines[-1] > high + slack:
        out = lines[0] if lines[0] < low - slack else lines[-1]
        step = float(lines[1] - lines[0]) if len(lines) > 1 else 1.0
        a, b = max(low, float(lines[0])), min(high, float(lines[-1]))
        hint = f"did you mean {a:.6g}:{b:.6g}:{step:.6g}?" if a <= b else f"frequencies are in Hz, within {low:.6g} and {high:.6g}"
        if lines[0] == 0:
            what = f"FRFs at 0 Hz (accelerance, mobility, receptance) are not computed; the idle FRFs have {low:.6g} to {high:.6g} Hz"
            raise ConfigError(what, where=where, hint=hint)
        raise ConfigError(f"{out:g} Hz is none of the lines of the idle FRFs, {low:.6g} to {high:.6g} Hz", where=where, hint=hint)


def _text(frf: Frf, method: str, output: str | None) -> str:
    import numpy as np

    from operando.data import counted
    from operando.indicators import INTERVAL

    f, count = frf.frequencies_hz, len(frf.responses) * len(frf.references)
    head = f"{counted(count, 'operational FRF')} ({frf.quantity}, {UNITS[frf.quantity]}, method {method})"
    head += f", {f[0]:.6g} … {f[-1]:.6g} Hz, {f.size} lines."
    rows: list[list[str]] = []
    for i, response in enumerate(frf.responses):
        for j, reference in enumerate(frf.references):
            if len(rows) == 20:
                break
            size = np.abs(frf.data[i, j])
            top = int(np.nanargmax(size))
            own = None if frf.variance is None else np.sqrt(frf.variance[i, j] / 2) / np.maximum(size, 1e-300)
            std = None if own is None else float(8.686 * INTERVAL * np.median(own))
            rows.append([str(response), str(reference), f"{f[top]:.4f}", f"{size[top]:.4g}", "" if std is None else f"{std:.2g}"])
    parts = [head, table(rows, ["response", "reference", "peak Hz", "peak", "± dB (95 %, median)"])]
    if count > len(rows):
        parts.append(f"… and {count - len(rows)} more pairs")
    parts.append(f"{output} written." if output else "Nothing written: -o FILE keeps them, --json prints the values.")
    return "\n".join(parts)

"""``operando compare``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from operando.cli.answer import Answer, answers, apart_from_runs, own_option, table
from operando.errors import ConfigError, DataError

if TYPE_CHECKING:
    from operando.results import CheckRun


@click.command("compare", epilog="Example: operando compare pump-results check/run1.uff -o comparison.json")
@click.argument("model", type=click.Path())
@click.argument("measured", type=click.Path())
@click.option(
    "--route",
    type=click.Choice(["hybrid", "effect", "idle"]),
    default=None,
    help="Of a results folder: scaled operational modes, idle model + accepted effects, or the idle model (default: hybrid, else idle).",
)
@click.option(
    "--level",
    type=float,
    metavar="N",
    help="Route effect: level-dependent effects under a random force of this rms [N] (default: that of the measurement).",
)
@click.option("--band", nargs=2, type=float, metavar="LOW HIGH", help="Hz (default: the band of the model, else all measured lines).")
@click.option("-o", "--output", type=click.Path(dir_okay=False), help="JSON file to write.")
@own_option
@answers
def compare(
    model: str, measured: str, route: str | None, level: float | None, band: tuple[float, float] | None, output: str | None
) -> Answer:
    """Any model (results folder, model.h5, UFF FRFs or modes) against any measurement (FRFs, or records with force).

    The errors stand under the key "model" of the JSON document.
    """
    from operando.cli.sources import load_measured, load_model
    from operando.compare import compare_all

    apart_from_runs(output, "compare", model, Path(model) / "model.h5", measured)
    if band is not None and not 0 <= band[0] < band[1] < float("inf"):
        raise ConfigError(f"--band {band[0]:g} {band[1]:g} is no band", hint="give its lower end and then its upper end in Hz")
    if level is not None and (route != "effect" or not 0 < level < float("inf")):
        raise click.UsageError("--level is a force in N, more than 0, and belongs to --route effect")
    source = load_model(model, route, level)
    runs = [replace(run, frf=run.frf.without_bands(source.exclude_bands)) for run in load_measured(measured)]
    warning = _check_shared(source.model, runs, f"{model} and {measured}")
    band = band or source.band_hz
    found: dict[str, Any] = compare_all({"model": source.model}, runs, band_hz=band)
    errors = found["models"]["model"]
    document = found | {"model": errors, "model_source": f"{model}: {source.what}", "measured_source": measured, "band_hz": band}
    if output is not None:
        from operando.atomic import write_json

        write_json(Path(output), document)
    text = warning + _text(source.what, errors, output)
    return Answer(document, f"{text}\n{source.advice}" if source.advice and route is None else text)


def _check_shared(model: Any, runs: list[CheckRun], where: str) -> str:
    """A warning where sensors of the measurement are not in the model.

    Raises a DataError if fewer than half of the sensors of the measurement and fewer than half of those of the model are in both: numbers
    that two structures share by chance. A model of few sensors that were all measured is compared.
    """
    from operando.compare.common import shared_dofs
    from operando.data import counted, names_text

    of_model, of_measured, shared = shared_dofs(model, [run.frf for run in runs])
    if not shared or len(shared) == len(of_measured):
        return ""
    text = f"{counted(len(shared), 'sensor')} of {len(of_measured)} measured and {len(of_model)} in the model are in both"
    text += f" ({names_text(map(str, shared))})"
    if 2 * len(shared) < min(len(of_measured), len(of_model)):
        hint = "are they of one structure, with the same numbers? else give the FRFs of the sensors that both have"
        raise DataError(f"{text}: too few to compare", where=where, hint=hint)
    return f"Warning: {text}; the figures are of these alone.\n\n"


def _text(what: str, errors: dict[str, Any], output: str | None) -> str:
    from operando.compare.verdict import floor_text

    number = lambda v, digits=2: "-" if v is None else f"{v:.{digits}f}"  # noqa: E731
    low, high = errors["by_band"][0]["band_hz"][0], errors["by_band"][-1]["band_hz"][1]
    head = f"{what}, {low:.4g} to {high:.4g} Hz: error {number(errors['error_db'])} dB"
    head += (
        f", noise floor {floor_text(errors['noise_floor_db'])} dB"
        if errors["noise_floor_db"] is not None
        else ", no noise floor stated by the data"
    )
    head += f", relative error {number(None if errors['relative_error'] is None else 100 * errors['relative_error'])} %"
    head += "." if errors["misfit"] is None else f". Reduced chi-square {errors['misfit']:.3g}."
    dofs = table([[d["dof"], number(d["error_db"]), d["misfit"]] for d in errors["by_dof"]], ["DOF", "error dB", "reduced χ²"])
    bands = table(
        [[f"{b['band_hz'][0]:.4g} … {b['band_hz'][1]:.4g}", number(b["error_db"]), b["misfit"]] for b in errors["by_band"]],
        ["band Hz", "error dB", "reduced χ²"],
    )
    notes = "\n".join(f"note: {n}" for n in errors.get("notes", ()))
    return "\n\n".join(p for p in (head, dofs, bands, notes, f"{output} written." if output else "") if p)

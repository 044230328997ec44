"""``operando compare``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from operando.cli.answer import Answer, answers, apart_from_runs, own_option, table
from operando.errors import ConfigError


@click.command("compare", epilog="Example: operando compare pump-results check/run1.uff -o comparison.json")
@click.argument("model", type=click.Path())
@click.argument("measured", type=click.Path())
@click.option(
    "--route",
    type=click.Choice(["hybrid", "effect"]),
    default=None,
    help="Of a results folder: scaled operational modes, or idle model + accepted effects (default: hybrid, without one the idle model).",
)
@click.option("--band", nargs=2, type=float, metavar="LOW HIGH", help="Hz (default: the band of the model, else all measured lines).")
@click.option("-o", "--output", type=click.Path(dir_okay=False), help="JSON file to write.")
@own_option
@answers
def compare(model: str, measured: str, route: str | None, band: tuple[float, float] | None, output: str | None) -> Answer:
    """Any model (results folder, model.h5, UFF FRFs or modes) against any measurement (FRFs, or records with force).

    The errors stand under the key "model" of the JSON document.
    """
    from operando.cli.sources import load_measured, load_model
    from operando.compare import compare_all

    apart_from_runs(output, "compare")
    if band is not None and not 0 <= band[0] < band[1] < float("inf"):
        raise ConfigError(f"--band {band[0]:g} {band[1]:g} is no band", hint="give its lower end and then its upper end in Hz")
    source = load_model(model, route)
    runs = [replace(run, frf=run.frf.without_bands(source.exclude_bands)) for run in load_measured(measured)]
    band = band or source.band_hz
    found: dict[str, Any] = compare_all({"model": source.model}, runs, band_hz=band)
    errors = found["models"]["model"]
    document = found | {"model": errors, "model_source": f"{model}: {source.what}", "measured_source": measured, "band_hz": band}
    if output is not None:
        from operando.atomic import write_json

        write_json(Path(output), document)
    text = _text(source.what, errors, output)
    return Answer(document, f"{text}\n{source.advice}" if source.advice and route is None else text)


def _text(what: str, errors: dict[str, Any], output: str | None) -> str:
    number = lambda v, digits=2: "-" if v is None else f"{v:.{digits}f}"  # noqa: E731
    low, high = errors["by_band"][0]["band_hz"][0], errors["by_band"][-1]["band_hz"][1]
    head = f"{what}, {low:.4g} to {high:.4g} Hz: error {number(errors['error_db'])} dB"
    head += (
        f", noise floor {number(errors['noise_floor_db'])} dB"
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

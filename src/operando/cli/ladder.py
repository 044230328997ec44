"""What ``add`` and ``remove`` share: the effects of a results folder, changed, refitted and written back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from operando.cli.answer import Answer
from operando.cli.diagnose import ladder_table
from operando.cli.story import Clock
from operando.effects import Effect
from operando.errors import MissingError
from operando.results import CheckRun, Results


def present(folder: str) -> Results:
    """Results of the folder, with idle model and check.

    Raises
    ------
    MissingError
        If either is missing.
    """
    from operando.store import load_results

    results = load_results(folder)
    if results.idle is None:
        raise MissingError("there is no idle model", where=folder, hint="run `operando run test.toml` first")
    if not results.check:
        raise MissingError(
            "there is no check measurement to judge an added effect by",
            where=folder,
            hint="measure the running machine with a known force and name the files in [check]",
        )
    return results


def judging(results: Results) -> tuple[list[CheckRun], tuple[float, float] | None]:
    """Check runs without the bands that the test leaves out, and its band."""
    from operando.pipeline.stages import without_bands

    band, left_out = results.settings.get("band"), results.settings.get("exclude_bands") or ()
    runs = [replace(run, frf=without_bands(run.frf, [tuple(b) for b in left_out])) for run in results.check]
    return runs, (float(band[0]), float(band[1])) if band else None


def accepted(results: Results) -> list[Effect]:
    """Effects in the model now, in order."""
    return [Effect.from_dict(e) for e in (results.diagnosis or {}).get("effects", [])]


def suggestion(folder: str, results: Results) -> list[Effect]:
    """What the diagnosis accepts by itself, found again from the data (the folder may hold effects added by hand)."""
    from operando.diagnose import diagnose

    say = Clock()
    runs, band = judging(results)
    found = diagnose(
        results.idle,  # type: ignore[arg-type]
        check=runs,
        geometry=results.geometry,
        band=band,
        progress=lambda message: say("diagnose", message),
    )
    if not found.effects:
        raise MissingError(f"the diagnosis suggests no effect (verdict {found.verdict})", where=folder)
    return list(found.effects)


def change(folder: str, results: Results, effects: list[Effect]) -> Answer:
    """Refit with these effects, rewrite the folder's ladder and model, and tell what it did."""
    from operando.compare import with_effect
    from operando.diagnose import Model, apply_effects
    from operando.pipeline.outputs import write_output
    from operando.store import save_results

    say = Clock()
    idle = results.idle
    assert idle is not None  # present() saw to it
    runs, band = judging(results)
    applied = apply_effects(
        idle,
        effects,
        check=runs,
        geometry=results.geometry,
        band=band,
        progress=lambda message: say("refit", message),
    )
    done = applied.to_dict()
    before = results.diagnosis or {}
    # What the diagnosis found by itself stays on record, so that the report never takes a change by hand for its verdict.
    by_hand = {"found": (before.get("by_hand") or {}).get("found", before.get("effects", [])), "words": done["words"]}
    results.diagnosis = before | {"effects": done["effects"], "ladder": done["ladder"], "by_hand": by_hand}
    results.effect_idle, results.effect_covariance = applied.model.idle, applied.model.covariance
    if results.comparison is not None:
        made = replace(applied.model.idle, covariance=None, std=None)  # the idle model's variance judges
        shown = Model(made, applied.model.effects, applied.model.geometry) if applied.effects else None
        results.comparison = with_effect(results.comparison, idle, shown, runs, band or idle.band_hz)
    out = Path(folder) if Path(folder).is_dir() else Path(folder).parent
    save_results(results, out / "model.h5")
    for name in ("diagnosis.json", "ladder.json", "comparison.json", "ofrf_effect.uff"):
        write_output(name, out, results)
    from operando.pipeline.cache import whole
    from operando.report import write_report

    with whole(out / "report.html") as beside:
        write_report(results, beside)
    words = list(applied.words) or ["the idle model alone"]
    return Answer({"schema": "operando/ladder/1", **done}, "\n".join([*words, "", ladder_table(done["ladder"])]))

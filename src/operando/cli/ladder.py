"""What ``add`` and ``remove`` share: the effects of a results folder, changed, refitted and written back."""

from __future__ import annotations

from pathlib import Path

from operando.cli.answer import Answer
from operando.cli.diagnose import ladder_table
from operando.cli.story import Clock
from operando.effects import Effect
from operando.errors import MissingError
from operando.results import Results


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


def accepted(results: Results) -> list[Effect]:
    """Effects in the model now, in order."""
    return [Effect.from_dict(e) for e in (results.diagnosis or {}).get("effects", [])]


def suggestion(folder: str, results: Results) -> list[Effect]:
    """What the diagnosis accepts by itself, found again from the data (the folder may hold effects added by hand)."""
    from operando.diagnose import diagnose

    say = Clock()
    found = diagnose(
        results.idle,  # type: ignore[arg-type]
        check=results.check,
        geometry=results.geometry,
        progress=lambda message: say("diagnose", message),
    )
    if not found.effects:
        raise MissingError(f"the diagnosis suggests no effect (verdict {found.verdict})", where=folder)
    return list(found.effects)


def change(folder: str, results: Results, effects: list[Effect]) -> Answer:
    """Refit with these effects, rewrite the folder's ladder and model, and tell what it did."""
    from operando.diagnose import apply_effects
    from operando.pipeline.outputs import write_output
    from operando.store import save_results

    say = Clock()
    applied = apply_effects(
        results.idle,  # type: ignore[arg-type]
        effects,
        check=results.check,
        geometry=results.geometry,
        progress=lambda message: say("refit", message),
    )
    done = applied.to_dict()
    before = results.diagnosis or {}
    # What the diagnosis found by itself stays on record, so that the report never takes a change by hand for its verdict.
    by_hand = {"found": (before.get("by_hand") or {}).get("found", before.get("effects", [])), "words": done["words"]}
    results.diagnosis = before | {"effects": done["effects"], "ladder": done["ladder"], "by_hand": by_hand}
    results.effect_idle, results.effect_covariance = applied.model.idle, applied.model.covariance
    out = Path(folder) if Path(folder).is_dir() else Path(folder).parent
    save_results(results, out / "model.h5")
    for name in ("diagnosis.json", "ladder.json", "ofrf_effect.uff"):
        write_output(name, out, results)
    from operando.pipeline.cache import whole
    from operando.report import write_report

    with whole(out / "report.html") as beside:
        write_report(results, beside)
    words = list(applied.words) or ["the idle model alone"]
    return Answer({"schema": "operando/ladder/1", **done}, "\n".join([*words, "", ladder_table(done["ladder"])]))

"""The effects of a results folder changed by hand, refitted and written back: on the command line and in the browser."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from operando.dof import check_dofs
from operando.errors import ConfigError, MissingError
from operando.pipeline.again import Progress
from operando.pipeline.folder import ResultsFolder, changing
from operando.results import CheckRun, Results
from operando.structure.effects import Effect, parse_effect

if TYPE_CHECKING:
    from operando.data import TimeRecord
    from operando.diagnosis import Applied


@dataclass(frozen=True)
class Refit:
    """The model after a change by hand: ``document`` holds effects and errors by step, ``words`` what the change did."""

    document: dict[str, Any]
    words: tuple[str, ...]


def add_effects(folder: str, texts: Sequence[str], *, fix: bool = False, progress: Progress) -> Refit:
    """Add effects, as ``operando add`` takes them, to the idle model of a results folder and refit all of them; see :func:`present`.

    With ``fix`` the values given are held. No effect may stand in the model twice.
    """

    def more(state: Results) -> list[Effect]:
        band, dofs = (None, ()) if state.idle is None else (state.idle.band_hz, state.idle.dofs)
        new = [parse_effect(text, band, fixed=fix) for text in texts]
        for text, effect in zip(texts, new, strict=True):
            check_dofs(effect.location, dofs, f"effect {text!r:.200}")
        together = [*accepted(state), *new]
        not_twice(together, folder)
        return together

    return _changed(folder, "add", more, progress)


def add_candidate(folder: str, number: int, *, progress: Progress) -> Refit:
    """Add a candidate of the diagnosis by its number in ``diagnosis.json``, from 0; see :func:`add_effects`."""

    def more(state: Results) -> list[Effect]:
        candidates = (state.diagnosis or {}).get("candidates") or []
        if not 0 <= number < len(candidates):
            raise MissingError(f"there is no candidate {number}", where=folder, hint=f"the diagnosis holds {len(candidates)}")
        together = [*accepted(state), Effect.from_dict(candidates[number])]
        not_twice(together, folder)
        return together

    return _changed(folder, "add", more, progress)


def add_suggested(folder: str, *, progress: Progress) -> Refit:
    """Give the model the effects that the diagnosis accepts by itself, and refit them; see :func:`add_effects`."""
    return _changed(folder, "add", lambda state: suggestion(folder, state, progress), progress)


def remove_effect(folder: str, step: int, *, progress: Progress) -> Refit:
    """Take the effect of a step back and refit the others (step 0 is the idle model); see :func:`add_effects`."""

    def less(state: Results) -> list[Effect]:
        effects = accepted(state)
        if not 1 <= step <= len(effects):
            have = f"1 to {len(effects)}" if effects else "none: no effect has been added"
            said = "step 0 is the idle model, no effect to remove" if step == 0 else f"there is no step {step} to remove"
            raise ConfigError(said, where=folder, hint=f"steps with an effect: {have}")
        return [e for i, e in enumerate(effects, 1) if i != step]

    return _changed(folder, "remove", less, progress)


def _changed(folder: str, doing: str, effects: Callable[[Results], list[Effect]], progress: Progress) -> Refit:
    with changing(folder, doing) as out:
        state = present(folder)
        return change(out, state, effects(state), progress)


def present(folder: str) -> Results:
    """Results of the folder, with idle model and check."""
    from operando.store import load_results

    results = load_results(folder)
    if results.idle is None:
        raise MissingError("there is no idle model", where=folder, hint="run `operando run test.toml` first")
    if not results.check:
        raise MissingError(
            "there is no validation measurement ([check]) for an added effect",
            where=folder,
            hint="measure the operating state with a known force and name the files in [check]",
        )
    return results


def judging(results: Results) -> tuple[list[CheckRun], tuple[float, float] | None]:
    """Validation measurements without the bands that the test leaves out, and its band."""
    band = results.settings.get("band")
    runs = [replace(run, frf=run.frf.without_bands(left_out(results))) for run in results.check]
    return runs, (float(band[0]), float(band[1])) if band else None


def left_out(results: Results) -> list[tuple[float, float]]:
    """Bands that the test leaves out [Hz]."""
    return [(float(low), float(high)) for low, high in results.settings.get("exclude_bands") or ()]


def check_records(folder: str, results: Results) -> list[TimeRecord]:
    """The check's records, read again from the files that the check FRFs were made of."""
    from operando.data import file_hash
    from operando.io import read
    from operando.io.quantities import Asked
    from operando.quality import check_record

    hint = "run `operando run test.toml` again where the files are"
    units, channels = results.settings.get("units") or None, Asked(results.settings.get("channels"))
    out = []
    for path, sha in dict.fromkeys(pair for run in results.check for pair in run.frf.provenance.inputs):
        if not Path(path).is_file():
            raise MissingError("a level-dependent effect is fitted to the records of [check], and one is not there", where=path, hint=hint)
        if file_hash(Path(path)) != sha:
            raise MissingError("a record of [check] is not the one that the results were made of", where=path, hint=hint)
        records = [part for r in read(path, units=units, channels=channels).records for part in _parts(r, path, results)]
        out += [replace(check_record(r), name=Path(path).name) for r in records if r.force_indices and r.response_indices]
    if not out:
        raise MissingError("a level-dependent effect is fitted to records, and [check] holds FRFs alone", where=folder, hint=hint)
    return out


def _parts(record: TimeRecord, path: str, results: Results) -> list[TimeRecord]:
    """The parts of a check record that the test file says count."""
    given = [p for p in results.settings.get("parts_of_records") or () if p["state"] == "check" and Path(path).match(p["file"])]
    return [record.cut(p["start_s"], p["stop_s"]) for p in given] or [record]


def accepted(results: Results) -> list[Effect]:
    """Effects in the model now, in order."""
    return [Effect.from_dict(e) for e in (results.diagnosis or {}).get("effects", [])]


def suggestion(folder: str, results: Results, progress: Progress) -> list[Effect]:
    """What the diagnosis accepts by itself, found again from the data (the folder may hold effects added by hand)."""
    from operando.diagnosis import diagnose

    runs, band = judging(results)
    looked_at_records = "check_records" in ((results.diagnosis or {}).get("data") or ())
    progress("diagnose", "…")
    found = diagnose(
        results.idle,  # type: ignore[arg-type]
        check=runs,
        geometry=results.geometry,
        band=band,
        progress=lambda message: progress("diagnose", f"  {message}"),
        records=check_records(folder, results) if looked_at_records else (),
        idle_frf=None if results.idle_frf is None else results.idle_frf.without_bands(left_out(results)),
        exclude_bands=left_out(results),
        between=results.settings.get("between") or {},
    )
    if not found.effects:
        raise MissingError(f"the diagnosis suggests no effect (verdict {found.verdict})", where=folder)
    return list(found.effects)


def change(folder: ResultsFolder, results: Results, effects: list[Effect], progress: Progress) -> Refit:
    """Refit with these effects, rewrite the folder's errors by step and model, and tell what it did."""
    from operando.compare import with_effect
    from operando.diagnosis import RecordsApplied, apply_effects
    from operando.diagnosis.at_level import following
    from operando.diagnosis.from_records import need_records, with_levels
    from operando.diagnosis.with_frfs import apply_with_frfs
    from operando.pipeline.outputs import STEP_OUTPUTS

    idle = results.idle
    assert idle is not None  # present() saw to it
    runs, band = judging(results)
    applied: Applied
    before = results.diagnosis or {}
    progress("refit", "…")
    options: dict[str, Any] = {"geometry": results.geometry, "progress": lambda message: progress("refit", f"  {message}")}
    at_rest = None if results.idle_frf is None else results.idle_frf.without_bands(left_out(results))
    frf_options: dict[str, Any] = {"idle_frf": at_rest, "between": results.settings.get("between") or None}
    if need_records(effects, before.get("data") or ()):
        records, bands = check_records(str(folder.path), results), left_out(results)
        applied = apply_with_frfs(idle, effects, records, runs, bands, frf_options, band=band or idle.band_hz, **options)
    else:
        applied = apply_effects(idle, effects, check=runs, band=band, **frf_options, **options)
    done = applied.to_dict()
    # What the diagnosis found by itself stays on record, so that the report never takes a change by hand for its verdict.
    by_hand = {"found": (before.get("by_hand") or {}).get("found", before.get("effects", [])), "words": done["words"]}
    more = {key: done[key] for key in ("picture", "simulation", "between", "discrepancy") if done.get(key) is not None}
    if isinstance(applied, RecordsApplied):
        more["picture"], notes = with_levels(applied, idle, runs, band or idle.band_hz)
        by_hand["words"] = [*done["words"], *notes]
    results.diagnosis = (
        before | {"effects": done["effects"], "ladder": done["ladder"], "judged_on": done["judged_on"], "by_hand": by_hand} | more
    )
    results.effect_idle, results.effect_covariance = replace(applied.model.idle, details=None), applied.model.covariance
    if results.comparison is not None:
        shown = following(applied.model, done, band or idle.band_hz) if applied.effects else None
        results.comparison = with_effect(results.comparison, shown, runs, band or idle.band_hz)
    for output in STEP_OUTPUTS:
        if output.name != "comparison.json" or results.comparison is not None:
            folder.stage(output.name, None, output.of(results))
    folder.commit()
    words = [*applied.words, "", *model_now(done["effects"])] if applied.words else ["the idle model alone"]
    return Refit(done, tuple(words))


def model_now(effects: list[dict[str, Any]]) -> list[str]:
    """The effects in the model with the sizes of the refit, by the step that ``remove`` takes."""
    from operando.report.words_diagnosis import effect_words

    if not effects:
        return []
    rows = [(effect_words(effect), " (held)" if effect.get("fixed") else "") for effect in effects]
    return ["in the model now (± is the 95 % interval):", *(f"  {i} {w.label}: {w.size}{held}" for i, (w, held) in enumerate(rows, 1))]


def not_twice(effects: list[Effect], folder: str) -> None:
    """Two effects of one kind at one location are one effect where their sizes add up: no data tell the two apart.

    Sizes add up in the kinds of operando with one parameter, excitation aside. Of a user's own kinds that is not known.
    """
    seen: dict[tuple[str, str], int] = {}
    for step, effect in enumerate(effects, 1):
        kind, place = effect.definition, (effect.kind, effect.place)
        adds_up = len(kind.parameters) < 2 and kind.acts != "excitation" and type(kind).__module__.startswith("operando.")
        if adds_up and place in seen:
            what = f"{effect.kind} at {effect.place}" if effect.place else effect.kind
            raise ConfigError(
                f"{what} would be in the model twice",
                where=f"{folder}, step {seen[place]}",
                hint=f"`operando remove {folder} {seen[place]}` takes the first one back",
            )
        seen[place] = step

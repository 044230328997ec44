"""Models and measurements of the command line: from a results folder, ``model.h5``, or any file operando reads."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from operando.errors import FormatError, MissingError

if TYPE_CHECKING:
    from operando.results import CheckRun, Results


@dataclass(frozen=True)
class Source:
    """A model with what it is in words, the band it is meant for, the bands its test leaves out, and which other model is recommended."""

    model: Any
    what: str
    band_hz: tuple[float, float] | None = None
    exclude_bands: tuple[tuple[float, float], ...] = ()
    advice: str = ""


def load_model(path: str, route: str | None = None, level: float | None = None) -> Source:
    """The model of a results folder or ``model.h5`` by a route (``hybrid``, ``effect`` or ``idle``); else the FRFs or modes of a file.

    Without a route it is the hybrid one, or the idle model where there is no hybrid one. By the route ``effect``, level-dependent effects
    follow the force of the measurement, unless a level [N rms] is given.
    """
    results = _results(path)
    if results is not None:
        from operando.scaling.no_scale import no_scale

        band = results.settings.get("band") or (None if results.idle is None else results.idle.band_hz)
        band = None if band is None else (float(band[0]), float(band[1]))
        without = tuple((float(low), float(high)) for low, high in results.settings.get("exclude_bands") or ())
        if route == "effect":
            if results.diagnosis is None:
                raise not_made("there is no model with accepted effects", "diagnose", results, path)
            from operando.diagnosis.at_level import LevelModel, following
            from operando.diagnosis.stored import effect_model
            from operando.structure.effects import Effect

            model: Any = effect_model(results).structure()
            effects = [Effect.from_dict(e) for e in (results.diagnosis or {}).get("effects") or []]
            shown = [e for e in effects if e.definition.group in ("structure", "idle")]
            what = " + ".join(("idle model", *(str(e) for e in shown)))
            if level is not None:
                return Source(LevelModel.of(results, level), f"{what}, at {level:g} N rms", band, without)
            return Source(following(model, results.diagnosis or {}, band), what, band, without)
        if results.hybrid is not None and route != "idle":
            return Source(results.hybrid, "operational FRFs by the hybrid route", band, without, _advice(results))
        if route == "hybrid":
            raise not_made("there are no operational FRFs", "ofrf", results, path)
        if results.idle is not None and results.idle.scaling == "unit_modal_mass" and results.idle.si:
            return Source(results.idle, "idle modes", band, without)
        cause = None if results.idle is None else no_scale(results.idle, results.findings)
        text, hint = cause[:2] if cause else ("there are no idle modes", "`operando run` the test to the stage ema or further")
        raise MissingError(f"holds no model of unit modal mass: {text}", where=path, hint=hint)
    if route is not None:
        raise MissingError("is a file, and --route belongs to a results folder", where=path, hint="leave --route out")
    content = _read(path)
    if content.frfs:
        from operando.frf import merge_frfs

        return Source(merge_frfs(content.frfs), "FRFs of the file")
    scaled = [m for m in content.models if m.scaling == "unit_modal_mass"]
    if scaled:
        return Source(scaled[0], "modes of the file (unit modal mass)", scaled[0].band_hz)
    what = "modes of arbitrary scale" if content.models else "no FRFs and no modes"
    raise MissingError(f"holds {what}: nothing that predicts FRFs", where=path, hint="give a results folder, model.h5, or FRFs as UFF 58")


def not_made(what: str, stage: str, results: Results, path: str) -> MissingError:
    """That results lack what a stage makes: why, and what to do."""
    if stage in results.left_out:
        return MissingError(f"{what}: {results.left_out[stage]}", where=path, hint="once that is mended, run the test again")
    from operando.pipeline.folder import source_of

    folder = Path(path) if Path(path).is_dir() else Path(path).parent
    command = shlex.join(["operando", "run", str(source_of(folder) or "test.toml"), "-o", str(folder), "--until", stage])
    return MissingError(f"{what}: the run ended before it", where=path, hint=f"`{command}` makes it")


def _advice(results: Results) -> str:
    """A sentence where the results recommend the other route."""
    from operando.compare import recommended

    advised = recommended(results.comparison, results.diagnosis, results.hybrid is not None)
    if advised is None or advised.name == "hybrid":
        return ""
    return f"The results recommend --route {advised.name}: {advised.reason}."


def load_measured(path: str) -> list[CheckRun]:
    """Measured FRFs of a file; records with a force are estimated first; of a results folder its validation measurements."""
    from operando.results import CheckRun

    results = _results(path)
    if results is not None:
        if results.check:
            return list(results.check)
        raise MissingError("holds no validation measurement", where=path, hint="give FRFs or records with force as the measurement")
    content = _read(path)
    name = Path(path).name
    if content.frfs:
        from operando.frf import merge_frfs

        return [CheckRun(name, "as given", merge_frfs(content.frfs))]
    records = [r for r in content.records if r.force_indices and r.response_indices]
    if records:
        from operando.frf import estimate_frf
        from operando.pipeline.levels import check_frfs

        return check_frfs(records, estimate_frf)
    raise MissingError("holds no FRFs and no record with force and responses", where=path, hint="`operando inspect` shows what it holds")


def _results(path: str) -> Any:
    """Results of a folder or results file, or None for any other file."""
    from operando.store import load_results

    place = Path(path)
    if not place.exists():
        raise MissingError("there is no such file or folder", where=path)
    if place.is_dir():
        return load_results(place)
    with open(place, "rb") as stream:
        if stream.read(8) != b"\x89HDF\r\n\x1a\n":
            return None
    try:
        return load_results(place)
    except FormatError as error:
        if "no results of operando" in error.message:
            return None
        raise


def _read(path: str) -> Any:
    from operando.io import read

    return read(path)

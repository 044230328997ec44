"""What the sections on the answer show: the headline, and the operational FRFs against the check and the idle model."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from operando.compare import clear_lines, error_map, level_error_db, rms_over
from operando.compare.verdict import FLOOR_DB
from operando.data import Frf
from operando.report import derive, figures_compare, figures_frf, live
from operando.report.assessment import MODEL_NAMES, assumptions, headline, route_words, scope, shifted
from operando.report.class_words import class_words
from operando.report.idle_check import idle_peaks, one_state
from operando.report.parts import Numbering
from operando.report.text import decibel, finite, fixed, number
from operando.results import Results

STATE_WORDS = {"holds": ("holds", "good"), "doubtful": ("doubtful", "fair"), "fails": ("fails", "poor"), "untested": ("not tested", "none")}
BY_MODE_WORDS = {"ofrf": "operational FRFs", "idle_shapes": "idle shapes", "idle": "idle model"}


class Tile(NamedTuple):
    """One number of the answer; ``main`` stands out."""

    value: str
    text: str
    main: bool = False


def answer(results: Results, page: Numbering) -> dict[str, Any]:
    """The answer first: verdict, numbers, the best picture, the mode table, the assumptions."""
    models = derive.comparison_models(results)
    keys = [k for k in MODEL_NAMES if k in models and finite(models[k].get("error_db"))]
    bars = pair = None
    if "ofrf" in keys:
        floor: Any = models["ofrf"].get("noise_floor_db")
        errors = [float(models[k]["error_db"]) for k in keys]
        bars = figures_compare.error_bars([MODEL_NAMES[k] for k in keys], keys, errors, float(floor) if finite(floor) else None)
    run, hybrid_frf, rest = derive.validation(results, page)
    if run is not None and hybrid_frf is not None:
        pairs = derive.choose_pairs(run.frf, _pair_error(hybrid_frf, run.frf, results), 1, 0)[:1]
        pair = _drawn(results, run.frf, hybrid_frf, rest, pairs)
    alone, route = scope(results) != "all", "" if results.diagnosis else route_words(results)  # with a diagnosis, its answer names it
    tested = [a for a in assumptions(results) if not alone or a.state != "untested"]
    return {
        "head": headline(results), "route": route, "alone": alone, "tiles": [] if alone else _tiles(results), "bars": bars, "pair": pair,
        "pairs": derive.mode_pairs(results), "one_state": one_state(results), "peaks": idle_peaks(results),
        "class_words": class_words, "assumptions": tested, "state_words": STATE_WORDS,
    }  # fmt: skip


def _drawn(results: Results, measured: Frf, model: Frf, rest: Frf | None, pairs: list[tuple[int, int, str]]) -> Markup:
    """Operational FRFs with their band at some pairs; the idle model's where there are none."""
    source, label = (results.hybrid, "operational FRF") if results.hybrid is not None else (derive.scaled_idle(results), "idle model")
    banded = derive.with_variance(source, model, pairs)
    return figures_frf.ofrf_pairs(measured, banded, rest, pairs, derive.analysis_band(results), label)


def _pair_error(model: Frf, measured_frf: Frf, results: Results) -> Any:
    mask = clear_lines(measured_frf, derive.analysis_band(results))
    return rms_over(level_error_db(model, measured_frf), mask, axis=2)


def _tiles(results: Results) -> list[Tile]:
    models = derive.comparison_models(results)
    level = lambda key, what="error_db": (models.get(key) or {}).get(what)  # noqa: E731
    tiles = [Tile(decibel(level("ofrf")), "operational FRFs against the validation measurement", True)] if finite(level("ofrf")) else []
    tiles += [Tile(decibel(level(k)), MODEL_NAMES[k]) for k in ("effect", "idle", "idle_shapes", "msf_all") if finite(level(k))]
    floor: Any = level("ofrf", "noise_floor_db")
    if finite(floor) and floor <= FLOOR_DB:
        tiles.append(Tile(decibel(floor), "noise floor"))
    if tiles:
        return tiles
    if results.idle is not None:
        tiles.append(Tile(str(results.idle.n_modes), "idle modes"))
        if finite(results.idle.misfit):
            tiles.append(Tile(number(results.idle.misfit, 3), "reduced chi-square of the idle model (1 = as good as the noise allows)"))
    if results.operating is not None:
        tiles.append(Tile(str(results.operating.n_modes), "operational modes"))
    if moved := shifted(results):
        worst = max(moved, key=lambda p: abs(p.percent or 0.0))
        tiles.append(Tile(f"{fixed(worst.percent, 2, sign=True)} %", f"greatest frequency change, at {number(worst.idle_hz, 4)} Hz"))
    return tiles


def ofrf(results: Results, page: Numbering) -> dict[str, Any]:
    """Operational FRFs with band, check and idle model; errors by DOF, band, mode and run. Without them those of the idle model."""
    models, band = derive.comparison_models(results), derive.analysis_band(results)
    run, model, rest = derive.validation(results, page)
    made = results.hybrid is not None
    if not made:
        model, rest = rest, None
    chosen = [k for k in BY_MODE_WORDS if (models.get(k) or {}).get("by_mode")]
    named = [(MODEL_NAMES.get(k, k), k, models[k]) for k in _ordered(models)]
    out: dict[str, Any] = {
        "run": run, "model": model, "models": named, "drawn": None, "maps": None,
        "by_run": _by_run(results), "chosen": [BY_MODE_WORDS[k] for k in chosen], "by_mode": _by_mode(models, chosen), "unchecked": None,
        "explorer": live.frfs(results, page) if made or run is not None else None,
    }  # fmt: skip
    if run is None and not made:
        return out
    if run is None:
        drawn, reason = _unchecked(results)
        return out | {"unchecked": drawn, "reason": reason}
    if model is None:
        return out
    pairs = derive.choose_pairs(run.frf, _pair_error(model, run.frf, results), 2, 4)
    out["drawn"] = _drawn(results, run.frf, model, rest, pairs)
    if band is not None:
        edges = derive.band_edges(band)
        maps = [("Operational FRFs" if made else "Idle model", error_map(model, run.frf, edges))]
        if rest is not None:
            maps.append(("Idle model", error_map(rest, run.frf, edges)))
        out["maps"] = figures_compare.error_maps(maps, [str(d) for d in run.frf.responses], edges)
    return out


def _ordered(models: Any) -> list[str]:
    return [k for k in MODEL_NAMES if k in models] + [k for k in models if k not in MODEL_NAMES]


def _by_run(results: Results) -> tuple[list[str], list[tuple[str, Any, list[Any]]]]:
    """Names of the models, and name, level and errors of each validation measurement."""
    rows = (results.comparison or {}).get("by_run") or []
    found = [row.get("models") or {} for row in rows]
    keys = [k for k in MODEL_NAMES if any(k in models for models in found)]
    errors = [[(models.get(k) or {}).get("error_db") for k in keys] for models in found]
    names = [str(row.get("run") or row.get("name") or n) for n, row in enumerate(rows)]
    return [MODEL_NAMES[k] for k in keys], [(n, row.get("level_name"), e) for n, row, e in zip(names, rows, errors, strict=True)]


def _by_mode(models: Any, chosen: list[str]) -> list[tuple[float, float | None, list[dict[str, Any]]]]:
    """Frequency of each mode of the check with its standard deviation, and its errors by each model chosen."""
    rows: dict[float, list[dict[str, Any]]] = {}
    for n, key in enumerate(chosen):
        for entry in models[key]["by_mode"]:
            if finite(entry.get("frequency_hz")):
                rows.setdefault(round(float(entry["frequency_hz"]), 6), [{} for _ in chosen])[n] = entry
    return [(hz, next((e.get("frequency_std_hz") for e in rows[hz] if e), None), rows[hz]) for hz in sorted(rows)]


def _unchecked(results: Results) -> tuple[Markup | None, str]:
    """Operational FRFs beside the idle model without a check: at the idle drive points and the pairs that changed most; or why not."""
    frf = results.idle_frf
    if frf is None:
        return None, "There are no idle FRFs to show them beside."
    model, rest = derive.model_frf(results.hybrid, frf), derive.model_frf(derive.scaled_idle(results), frf)
    if model is None or rest is None:
        return None, "The operational FRFs cannot be made for the pairs of the idle FRFs."
    blank = Frf(np.full(frf.data.shape, np.nan), frf.axis, frf.responses, frf.references, frf.quantity, si=frf.si)
    change = rms_over(level_error_db(model, rest), clear_lines(rest, derive.analysis_band(results)), axis=2)
    pairs = [(i, j, why.replace("worst pair", "most changed")) for i, j, why in derive.choose_pairs(frf, change)]
    return _drawn(results, blank, model, rest, pairs), ""

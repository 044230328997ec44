"""What ``diagnosis.json`` says of a search: differences between the days, the error by step, what would have been seen, pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.case import Case
from operando.diagnosis.corrected import effects_of
from operando.diagnosis.criteria import EXPLAINED, UNUSUAL, tolerated
from operando.diagnosis.found import Found
from operando.diagnosis.joints import no_more_than_days
from operando.diagnosis.posterior import State, fit, left_on
from operando.diagnosis.problem import Problem
from operando.diagnosis.rival import score
from operando.diagnosis.terms import IN_FRFS, Term, added
from operando.diagnosis.unseen import UNSEEN
from operando.diagnosis.verdict import Verdict, unlike_neighbours
from operando.results import CheckRun
from operando.structure.effects.registry import catalogue, is_own

Array = NDArray[Any]

MOST_ODDS = 40.0
"""Log odds above which texts name no figure (one in 10¹⁷): the JSON has it as ``log_odds``."""
_PLACES = 20  # of the kind-free ranking
_UNITS = {
    "point_mass": ("mass", "kg"), "ground_spring": ("stiffness", "N/m"), "ground_damper": ("damping", "N s/m"),
    "coupling_spring": ("stiffness", "N/m"), "coupling_damper": ("damping", "N s/m"),
    "gyroscopic": ("coefficient", "N s/m"), "circulatory": ("coefficient", "N/m"),
}  # fmt: skip
_PAIRS_TOLD = 20  # DOFs up to which what would have been seen is told for every pair


def another_day(state: State) -> bool:
    """Whether the measurements are of two days, not of one set-up."""
    return "stiffness" in state.case.between.spreads


def between_rows(state: State) -> list[dict[str, Any]]:
    """What differs between the two measurements, with standard deviations; ``unusual`` beyond four of the prior's. None of one set-up.

    Gains and damping as factors, stiffness as a relative change, offsets as rms shares of a shape, the skew in seconds.
    """
    case, between, forward = state.case, state.case.between, state.case.forward
    std_d, std_own = state.std()
    d, own = state.x.d, state.x.own[:, forward.n_shape :]
    std_own = std_own[:, forward.n_shape :]
    if not another_day(state):
        return []
    rows: list[dict[str, Any]] = []

    def put(what: str, location: list[str], value: float, std: float, unusual: bool) -> None:
        rows.append({"what": what, "location": location, "value": float(value), "std": float(std), "unusual": bool(unusual)})

    part = between.own["sensor"]
    if part.stop > part.start:
        column = part.start
        for i in forward.responses:
            spread = between.own_spread[i, column]
            log = own[i, column] * spread
            std = np.exp(log) * std_own[i, column] * spread
            usual = between.spreads["sensor"] * between.sensor_gains[i]
            put("sensor_gain", [str(case.dofs[i])], np.exp(log), std, abs(log) > UNUSUAL * usual)
    scale = {"force": "force_gain", "stiffness": "stiffness", "damping_whole": "damping", "late": "skew"}
    for name, what in scale.items():
        where = between.shared[name]
        for number, at in enumerate(range(where.start, where.stop)):
            spread = between.shared_spread[at]
            value, std = d[at] * spread, std_d[at] * spread
            usual = between.spreads[name] * (between.force_gains[number] if name == "force" else 1.0)
            unusual = abs(value) > UNUSUAL * usual
            location = [str(case.dofs[forward.references[number]])] if name == "force" else []
            if name == "force":
                # H is divided by the gain of the force
                value, std = np.exp(-value), np.exp(-value) * std
            elif name == "damping_whole":
                value, std = np.exp(value), np.exp(value) * std
            put(what, location, value, std, unusual)
    where = between.shared["driven"]
    if where.stop > where.start:
        m = case.idle.modes.size
        for j, dof in enumerate(forward.references):
            of_point = slice(where.start + j * m, where.start + (j + 1) * m)
            unit = between.shared_spread[of_point] / between.rms
            share, spread = d[of_point] * unit, std_d[of_point] * unit
            rms = float(np.sqrt(np.mean(share**2)))
            std = float(np.sqrt(np.mean((share * spread) ** 2))) / max(rms, 1e-300)
            put("offset", [str(case.dofs[dof])], rms, std, rms > UNUSUAL * between.spreads["driven"])
    return rows


def discrepancy_of(document: Mapping[str, Any] | None) -> float:
    """Discrepancy in the variance of the model with the effects of ``diagnosis.json``; 0 without one."""
    return tolerated(float(((document or {}).get("discrepancy") or {}).get("value") or 0.0))


def ladder(best: State) -> list[dict[str, Any]]:
    """Error and reduced chi-square of each step, under noise and discrepancy of the last one.

    Step 0 is the idle model as it is, whatever is added to it; later steps have what differs between the days (``with_between``), and are
    fitted without the effects to come. Where what differs alone explains the lines, and no effect is in the model, step 0 has that.

    A discrepancy beyond what an explanation may leave is no reason to lower the chi-square: it is that of noise then.
    """
    as_it_is = bool(best.terms) or best.alpha > EXPLAINED
    return [step_row(best, number, as_it_is and not number) for number in range(len(best.terms) + 1)]


def step_row(state: State, number: int, as_it_is: bool = False) -> dict[str, Any]:
    """One step: the idle model as it is, or a state with its first effects, fitted without the others.

    The others may have been made up for by what else was fitted: a mass of 3 ± 4 g taken away from a fit with gains of sensors raised the
    chi-square from 0.9 to 25, which falls to 0.9 again when the gains are fitted without it.
    """
    if as_it_is:
        x = state.case.forward.start
    else:
        x = state.x if number == len(state.terms) else fit(state.case, state.carried(state.terms[:number]), state.alpha).x
    alpha = tolerated(state.alpha)
    lines = state.case.lines
    share = lines.validation.size / (lines.validation.size + lines.fit.size)
    (chi, db), (chi_fit, db_fit) = (left_on(state.case, x, alpha, at) for at in (lines.validation, lines.fit))
    return {
        "step": number,
        "added": effects_of(state)[number - 1].to_dict() if number else None,
        "error_db": float(np.sqrt(share * db**2 + (1 - share) * db_fit**2)),
        "heldout_error_db": db,
        "misfit": share * chi + (1 - share) * chi_fit,
        "heldout_misfit": chi,
        "with_between": another_day(state) and not as_it_is,
    }


def judged_on(state: State, run: CheckRun) -> dict[str, Any]:
    """State, level and lines of the figures on lines that were never fitted."""
    case = state.case
    return {
        "state": "operating",
        "measured": "FRF lines",
        "runs": [run.name],
        **run.stated_level(),
        "band_hz": list(case.band),
        "n_lines": int(case.lines.validation.size * case.lines.there.sum()),
        "whole_run": False,
        "ranges_hz": [list(r) for r in case.lines.validation_hz],
    }


def floor_db(state: State, discrepancy: float | None = None) -> float:
    """rms error [dB] that noise, discrepancy and what is not known of the model leave on the validation lines.

    The discrepancy is that of the state unless another one is given: where nothing explains the lines it stands for what is missing.
    """
    case = state.case
    at = case.lines.validation
    problem = Problem(case, state.terms, at)
    prediction = problem.predict(problem.packed(state.x))
    variance = case.lines.variance[at] + ((state.alpha if discrepancy is None else discrepancy) * case.lines.level[at]) ** 2
    shared = np.concatenate([prediction.shared.real, prediction.shared.imag], 0)
    mine = np.concatenate([prediction.own.real, prediction.own.imag], 0)
    lay = lambda v: np.moveaxis(v, 1, 0).reshape(v.shape[1], -1, v.shape[3])  # noqa: E731
    spread = state.factor.of_rows(lay(shared), lay(mine)).reshape(mine.shape[1], 2, at.size, -1).sum(1)
    total = variance + np.moveaxis(spread, 0, 1)
    there = case.lines.there
    return float(8.685889638 * np.sqrt(np.mean(total[:, there] / 2 / np.abs(problem.measured[:, there]) ** 2)))


def detectable_rows(state: State, verdict: Verdict) -> list[dict[str, Any]]:
    """Smallest size of each kind at each place that would have been found in 95 % of tests like this one."""
    dofs = state.case.dofs
    out = []
    for (kind, places), size in verdict.least.items():
        if kind not in _UNITS or (len(places) == 2 and kind != "point_mass" and len(dofs) > _PAIRS_TOLD):
            continue
        name, unit = _UNITS[kind]
        where = places[:1] if kind == "point_mass" else places
        out.append({"kind": kind, "location": [str(dofs[i]) for i in where], "parameter": name, "value": size, "unit": unit})
    return out


def restricted(case: Case, *usual: Sequence[str]) -> list[str]:
    """That only some kinds were looked for, or only at some DOFs, where the test asks for it; ``usual`` are the sets looked for else."""
    notes = []
    if set(case.kinds) not in [set(kinds) for kinds in usual]:
        notes.append(f"only these kinds of effects were looked for, as the test asks: {', '.join(case.kinds)}")
    own = [k for k, kind in catalogue().items() if is_own(kind) and kind.acts in IN_FRFS and k not in case.kinds]
    if own:
        notes.append(f"kinds of your own were not looked for in the FRFs: {', '.join(own)}; name them in [analysis] kinds to look for them")
    sensors = [i for i in range(len(case.dofs)) if i not in case.idle.midway]
    if not set(sensors) <= set(case.allowed):
        asked = ", ".join(str(case.dofs[i]) for i in sensors if i in case.allowed)
        notes.append(f"effects were looked for at these DOFs alone, as the test asks: {asked}")
    return notes


def odds_text(nats: float) -> str:
    """``log odds 17.1``, in words for people: beyond 40 (one in 10¹⁷) the figure says how wrong the model is, not how unlikely."""
    return f"log odds {nats:.1f}" if nats <= MOST_ODDS else f"log odds above {MOST_ODDS:.0f}"


def candidate_rows(found: Found) -> list[dict[str, Any]]:
    """Effects that were tried, best first: those of the best state, with the odds against doing without, then the others.

    ``selection_misfit`` is the reduced chi-square on the lines that they were chosen by, under noise and the discrepancy of the best state.
    """
    best, out, seen = found.best, [], set()
    nats: float | None
    for state in [best, *sorted(found.pool.values(), key=lambda s: -score(s))]:
        for effect, term in zip(effects_of(state), state.terms, strict=True):
            if term.key in seen:
                continue
            seen.add(term.key)
            if state is best:
                without = (score(s) for s in (found.empty, *found.pool.values()) if term.key not in s.key)
                nats = score(best) - max(without, default=score(found.empty))
                evidence = f"{odds_text(nats)} for it"
            elif no_more_than_days(state.case, term, state.x.d):
                nats, evidence = None, "no more than what a joint loses on another day"
            else:
                nats = score(state) - score(best)
                evidence = f"{odds_text(-nats)} against it"
            evidence += " with what is found beside it" if len(state.terms) > 1 else ""
            evidence += "" if state is best else _special_case(term, best)
            left = left_on(state.case, state.x, best.alpha, state.case.lines.fit)[0]
            out.append(effect.to_dict() | {"selection_misfit": left, "evidence": evidence, "log_odds": nats})
    return out


def _special_case(term: Term, best: State) -> str:
    """Where an effect found is what a candidate becomes for some of its values: why it fits as well, and is not taken."""
    held = [t for t in best.terms if t.places == term.places and t.kind in term.definition.contains]
    if not held:
        return ""
    return f"; it contains the effect found ({held[0].definition.plain}) as a special case: what it has beyond improves too little"


def picture(state: State) -> dict[str, Any]:
    """Places ranked by what a force of any kind there leaves of the error; δz(ω) at each structural effect.

    With e = H0·f − x, one force s(ω) at a place b explains s = bᴴH0ᴴWe/(bᴴH0ᴴWH0b) of it, line by line; δz(ω) = s/(bᵀx) is the
    dynamic stiffness a linear effect there would have: flat for a spring, −ω² for a mass, iω for a damper.
    """
    case = state.case
    at = np.sort(np.concatenate([case.lines.fit, case.lines.validation]))
    order = np.argsort(case.lines.w[at])
    at = at[order]
    w, measured = case.lines.w[at], case.lines.h[at]
    weight = 1 / (case.lines.variance[at] + (0.01 * case.lines.level[at]) ** 2)
    bare = case.forward.scannable(state.carried(()), w)
    error = (bare.h - measured) / bare.channel
    weight_here = weight * np.abs(bare.channel) ** 2
    total = float(np.sum(weight_here * np.abs(error) ** 2))
    ranked = []
    real = [i for i in range(len(case.dofs)) if i not in case.idle.midway]
    for places in [(i,) for i in real] + list(combinations(real, 2)):
        u = bare.columns[:, bare.order, places[0]] - (bare.columns[:, bare.order, places[1]] if len(places) == 2 else 0)
        _, rest = _explained(u, error, weight_here)
        ranked.append({"location": [str(case.dofs[i]) for i in places], "remains": float(rest / max(total, 1e-300))})
    ranked.sort(key=lambda row: float(row["remains"]))  # type: ignore[arg-type]
    pictures = [p for term in state.terms for p in [_stiffness(state, term, w, measured, weight)] if p]
    return {"places": ranked[:_PLACES], "dynamic_stiffness": pictures}


def _explained(u: Array, error: Array, weight: Array) -> tuple[Array, float]:
    """Force spectrum (lines, references) of one place with columns u (lines, responses), and what remains of the weighted error."""
    power = np.einsum("nij,ni->nj", weight, np.abs(u) ** 2)
    force = np.einsum("nij,ni,nij->nj", weight, u.conj(), error) / np.maximum(power, 1e-300)
    return force, float(np.sum(weight * np.abs(error - u[:, :, None] * force[:, None]) ** 2))


def _stiffness(state: State, term: Term, w: Array, measured: Array, weight: Array) -> dict[str, Any] | None:
    """δz(ω) at one effect's place with the others in the model, and the fitted law."""
    case, definition = state.case, term.definition
    if not term.structural or definition.coordinates == "separate" or case.idle.midway.keys() & set(term.places):
        return None
    others = [t for t in state.terms if t is not term]
    bare = case.forward.scannable(state.carried(others), w)
    places = list(term.places[:1] if definition.coordinates == "node" else term.places)
    signs = term.along[: len(places)]
    error = (bare.h - measured) / bare.channel
    inside = weight * np.abs(bare.channel) ** 2
    u = bare.columns[:, bare.order][:, :, places] @ signs
    force, _ = _explained(u, error, inside)
    full = case.forward.scannable(state.x, w)
    x = np.einsum("nkj,k->nj", full.structure[:, places], signs)
    gain = np.einsum("nij,ni->nj", inside, np.abs(u) ** 2)
    z = np.sum(gain * x.conj() * force, axis=1) / np.maximum(np.sum(gain * np.abs(x) ** 2, axis=1), 1e-300)
    law = added(term, w, case.band)[:, 0, 0]
    return {
        "location": case.ends(term)[: len(places)],
        "frequency_hz": (w / 2 / np.pi).tolist(),
        "real": z.real.tolist(),
        "imag": z.imag.tolist(),
        "law_real": law.real.tolist(),
        "law_imag": law.imag.tolist(),
        "unit": "N/m",
    }


def proposal(found: Found, verdict: Verdict, others: Sequence[State], poor: bool) -> str | None:
    """Which measurement would decide; ``poor``: the idle model differs from the idle FRFs, and that counts as noise."""
    best = found.best
    case = best.case
    if others and verdict.name in ("ambiguous", "explained", "partial", "inconclusive"):
        w = case.lines.w[case.lines.fit]
        one = case.forward.scannable(best.x, w).columns
        size = np.abs(one)
        texts = []
        for state in list(others)[:2]:
            two = case.forward.scannable(state.x, w).columns
            loud = size > np.median(size, axis=0, keepdims=True)
            gap = np.where(loud, np.abs(two - one) / np.maximum(size, 1e-300), 0)
            gap[..., list(case.idle.midway)] = 0
            j = int(np.argmax(np.median(gap, axis=(0, 1))))
            line = int(np.argmax(np.median(gap[:, :, j], axis=1)))
            decibel = float(np.max(20 * np.abs(np.log10(np.abs(two[line, :, j]) / np.maximum(size[line, :, j], 1e-300)))))
            new = [t for t in state.terms if t.key not in {o.key for o in best.terms}]
            name = " and ".join(f"{t.kind} at {', '.join(case.place(i) for i in t.places) or 'no location'}" for t in new) or "nothing"
            texts.append(
                f"to tell it from {name}: excite {case.dofs[j]} while it runs; near {w[line] / 2 / np.pi:.4g} Hz the two predictions "
                f"differ by up to {decibel:.2g} dB"
            )
        return "; ".join(texts)
    if verdict.name == "unexplained" and unlike_neighbours(best):
        return "put sensors in all directions between those beside the location, idle and in operation: they show what moves there"
    if verdict.name in ("partial", "unexplained"):
        return "measure this state at another level and with the force at another point: does the rest depend on level?"
    if verdict.name == "inconclusive" and poor:
        return (
            "what the idle model leaves of the idle FRFs themselves hides it: measure these again without what the findings on them name, "
            "as drift, offsets or hits that are not alike"
        )
    if verdict.name == "inconclusive":
        problem = best.problem
        shared, mine = problem.derived(problem.packed(best.x))[0].whole()
        g, shape = case.forward.n_g, case.forward.n_shape
        own = float(np.mean(2 * np.sum(shared[..., :g] ** 2, 2)))
        own += float(np.mean(2 * np.sum(mine[..., :shape] ** 2, 2)))
        alone = float(np.mean(problem.variance(best.alpha)))
        if own > alone:
            return "what is not known of the idle model hides it: measure the idle FRFs again with more averages and force at more points"
        if noise_hides(case, best.alpha):
            return "the noise of the validation measurement hides it: measure this state again with a larger force or more averages"
        return "what no parameter explains hides it: measure idle and in operation in one set-up, without touching sensors or shaker"
    return None


def noise_hides(case: Case, alpha: float) -> bool:
    """Whether the noise is larger at most of the fitted lines than what no parameter explains, a part of the FRFs.

    A few lines between peaks may have any noise: an effect is seen at the others.
    """
    at, there = case.lines.fit, case.lines.there
    return bool(np.median(case.lines.variance[at][:, there] / case.lines.level[at][:, there] ** 2) > alpha**2)


def law_proposal(law: State) -> str:
    """The measurement that would confirm a force law that is no kind of the catalogue."""
    if law.case.idle.midway:
        return UNSEEN
    where = " and ".join(law.case.ends(law.terms[0]))
    at = f"connects {where}" if len(law.terms[0].places) > 1 else f"acts at {where}"
    return f"take away what {at}, or measure the force in it while the machine runs: the error must go with it"

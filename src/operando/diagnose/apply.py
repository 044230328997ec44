"""Effects added and taken away by hand: refit of all, the ladder of errors on lines the fit has not seen, and honest words about each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Geometry, ModalModel
from operando.diagnose.diagnosis import effects_of, judged_on, ladder, make_problem, with_what_was_learnt
from operando.diagnose.model import Model
from operando.diagnose.predict import Term
from operando.diagnose.problem import Problem, choose, scan, step
from operando.diagnose.refit import Fit
from operando.diagnose.result import model_of
from operando.effects import Effect, parse_effect
from operando.errors import DataError, MissingError
from operando.results import CheckRun
from operando.threads import one_blas_thread

Array = NDArray[Any]

ENOUGH = 1.5
"""A judge misfit above this after an effect was added is held against the best candidate of its step."""

DONE = 0.01
"""Part of the idle model's misfit below which its own errors are what is left."""

LITTLE = 0.1
"""One that lowers it by less than this part has no support in the data."""


@dataclass(frozen=True)
class Applied:
    """A model with effects chosen by hand.

    Parameters
    ----------
    model : Model
        Idle model (shapes at the effects' places refitted) and all effects.
    effects : tuple of Effect
        In the order they were added, refitted together.
    ladder : tuple of dict
        One row a step, as in ``diagnosis.json``.
    words : tuple of str
        What each effect did to the error, and where the data do not support it.
    judged_on : mapping
        State, level and lines of the held-out figures.
    """

    model: Model
    effects: tuple[Effect, ...]
    ladder: tuple[dict[str, Any], ...]
    words: tuple[str, ...]
    judged_on: Mapping[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """JSON object: effects, ladder, words, and what the held-out figures stand on."""
        return {
            "effects": [e.to_dict() for e in self.effects],
            "ladder": [dict(r) for r in self.ladder],
            "words": list(self.words),
            "judged_on": dict(self.judged_on),
        }


def apply_effects(
    idle: ModalModel,
    effects: Sequence[Effect | str],
    *,
    check: Sequence[CheckRun],
    geometry: Geometry | None = None,
    band: tuple[float, float] | None = None,
    refit: bool = True,
    progress: Callable[[str], None] | None = None,
) -> Applied:
    """Put effects into the idle model, refit all of them together, and judge each step on lines that were not fitted.

    Parameters
    ----------
    idle : ModalModel
        Of unit modal mass.
    effects : sequence of Effect or str
        In order; values are starting values unless an effect fixes them.
    check : sequence of CheckRun
        FRFs of the running structure.
    geometry : Geometry, optional
        For effects at places without a sensor.
    band : (float, float), optional
        Lines used [Hz]; default the idle model's band.
    refit : bool
        False holds all values as they are given.
    progress : callable, optional

    Raises
    ------
    DataError
        If the idle model has no scale.
    MissingError
        If there is no check.
    """
    if idle.scaling != "unit_modal_mass" or not idle.si:
        raise DataError("the idle model has no scale, so no effect has a size in it", hint="give the units of force and acceleration")
    if not check:
        raise MissingError("no check FRFs to judge an added effect by", hint="measure the running structure with a known force")
    wanted = [parse_effect(e, band or idle.band_hz) if isinstance(e, str) else e for e in effects]
    with one_blas_thread():
        problem = make_problem(idle, check, None, None, band or idle.band_hz, progress)
        span = (float(problem.lines.hz.min()), float(problem.lines.hz.max()))
        terms = [Term.of(e if refit else _held(e), idle, span, geometry) for e in wanted]
        start = [t.inward(e.values) for t, e in zip(terms, wanted, strict=True)]
        fits: list[Fit] = [problem.empty()]
        words: list[str] = []
        q: list[Array] = []
        for k, term in enumerate(terms):
            if progress:
                progress(f"refit with {term.kind.kind}")
            terms[k], begin = best_start(problem, fits[-1], term, start[k])
            fits.append(problem.settled(problem.joint(terms[: k + 1], [*q, begin])))
            q = list(fits[-1].q)
        rows, fits = ladder(problem, fits)
        if rows[-1]["heldout_misfit"] < max(ENOUGH, DONE * rows[0]["heldout_misfit"]):
            rows, fits = with_what_was_learnt(problem, rows, fits)
        for k, fit in enumerate(fits[1:], 1):
            words.append(words_of(effects_of(fit)[-1], rows[k - 1]["heldout_misfit"], rows[k]["heldout_misfit"]))
            if rows[k]["heldout_misfit"] > ENOUGH and rows[k - 1]["heldout_misfit"] > ENOUGH:
                tried, _ = step(problem, fits[k - 1])
                if tried:
                    best = problem.settled(choose(tried).fit)
                    other = ladder(problem, [problem.empty(), best])[0][1]["heldout_misfit"]
                    if other < 0.5 * rows[k]["heldout_misfit"]:
                        words.append(
                            f"the data speak for another one: {effects_of(best)[-1]} would lower it to {other:.4g}; "
                            f"`operando remove` takes step {k} back"
                        )
        return Applied(
            model_of(problem, fits[-1], geometry), tuple(effects_of(fits[-1])), tuple(rows), tuple(words), judged_on(problem, check)
        )


def best_start(problem: Problem, fit: Fit, term: Term, q: Array) -> tuple[Term, Array]:
    """The values given, or those the scan sees at this place if they fit better after a first refit of sizes."""
    if not term.size or term.kind.acts == "added_mode":
        return term, q
    alone = Problem(problem.idle, problem.lines, problem.own, [replace(term, sign=1)])
    seen = scan(alone, fit)
    options = [(term, q), *((c.term, c.q) for c in seen)]
    costs = [problem.joint([*fit.terms, t], [*fit.q, x], shapes=False).cost for t, x in options]
    return options[int(np.argmin(costs))]


def _held(effect: Effect) -> Effect:
    return replace(effect, fixed=effect.definition.names)


def words_of(effect: Effect, before: float, after: float) -> str:
    """What an effect did to the misfit on lines the fit has not seen, and where the data do not support it."""
    fall = 1 - after / before
    start = f"{effect.kind}{f' at {effect.place}' if effect.place else ''}: misfit on lines the fit has not seen {before:.4g} → {after:.4g}"
    if fall < 0:
        return f"{start}: it makes the prediction worse; nothing in the data speaks for it"
    if fall < LITTLE:
        return f"{start}: lower by only {100 * fall:.1f} %; the data do not support it"
    if before < 1:
        return f"{start}: lower by {100 * fall:.0f} %, but it was no more than the data allow: nothing was left to explain"
    if fall < 0.5 and after > 1.5:
        return f"{start}: lower by {100 * fall:.0f} %; most of the misfit remains, so something else is missing"
    return f"{start}: lower by {100 * fall:.{1 if fall < 0.99 else 3}f} %"

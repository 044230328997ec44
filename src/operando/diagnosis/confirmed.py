"""Effects that lines which were not fitted speak against."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from operando.diagnosis.corrected import effects_of
from operando.diagnosis.found import Found
from operando.diagnosis.posterior import State, left_on, on_validation_lines
from operando.diagnosis.rival import fitted_if_can_be, score
from operando.diagnosis.terms import Term
from operando.diagnosis.verdict import explains_lines
from operando.processes import side_by_side

AGAINST = 3.0
"""Nats by which the validation lines may be less probable with an effect than without it. With an effect that is there the difference is
normal, its mean half of its variance; below −t it falls with a probability of Φ(−√2t) at most, whatever the variance: 0.7 %. Of 36 effects
that are there in simulated measurements none made these lines less probable; an absorber of 15 g that is not there did by 10 nats."""


def confirmed(found: Found, say: Callable[[str], None]) -> Found:
    """Without effects that validation lines speak against, where noise is all that is left of these lines.

    They are asked at the end, once for each effect of an answer. The most probable answer that is left is asked again.
    """
    while found.best.terms and explains_lines(found.best):
        best = found.best
        without = side_by_side(partial(_without, found), best.terms)
        rows = [(_nats(best, state), term, state) for term, state in zip(best.terms, without, strict=True) if state is not None]
        against, term, state = max(rows, key=lambda row: row[0], default=(0.0, None, None))
        if state is None or term is None or against <= AGAINST:
            return found
        # Where valleys are flat a fit with the effect may end elsewhere when it begins where that without it ended.
        again = fitted_if_can_be(best.case, state.carried(best.terms), best.alpha)
        if again is not None and again.log_evidence > best.log_evidence - AGAINST and _nats(again, state) <= AGAINST:
            return found
        (effect,) = effects_of(best, [term])
        where = f" at {effect.place}" if effect.place else ""
        words = f"{effect.kind}{where} is left out: validation lines, which were not fitted, are less probable with it ({against:.2g} nats)"
        say(f"  {words}")
        pool = {key: s for key, s in found.pool.items() if key != best.key} | {state.key: state}
        left = max((s for s in pool.values() if s.case is best.case), key=score)
        found = replace(found, best=left, pool=pool, left_out=(*found.left_out, words))
    return found


def _without(found: Found, term: Term) -> State | None:
    best = found.best
    x = best.carried([t for t in best.terms if t is not term])
    known = found.pool.get(tuple(sorted(t.key for t in x.terms)))
    return known if known is not None and known.case is best.case else fitted_if_can_be(best.case, x, best.alpha)


def _nats(best: State, without: State) -> float:
    """How much less probable the validation lines are with an effect than without, under the same noise and discrepancy."""
    lines = best.case.lines
    more = on_validation_lines(best)[0] - left_on(best.case, without.x, best.alpha, lines.validation)[0]
    return lines.validation.size * int(lines.there.sum()) * more  # real and imaginary parts, half a nat each

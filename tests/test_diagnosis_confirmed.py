"""Lines that were not fitted have the last word on each effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import norm

import test_diagnosis as chain
from operando.diagnosis import confirmed as room
from operando.diagnosis.confirmed import AGAINST, confirmed
from operando.diagnosis.found import Found
from operando.diagnosis.posterior import fit
from operando.diagnosis.terms import Term
from operando.diagnosis.verdict import verdict_and_reason
from test_diagnosis_spreads import started

MASS = Term("point_mass", (1,), (np.log(0.4),))
SECOND = Term("point_mass", (3,), (np.log(0.3),))


def add_both(m, c, k):
    chain.add_mass(m, c, k)
    m[3, 3] += 0.3


@pytest.mark.parametrize("part", [0.8, 1.2])
def test_an_effect_that_lines_not_fitted_speak_against_is_left_out(part):
    """By ``AGAINST``; an absorber of 15 g beside a gyroscopic coupling that alone was hidden (rotor 10386)."""
    one = chain.case(add_both)
    both, mass, empty = (fit(one, started(one, *terms), 0.01) for terms in ((MASS, SECOND), (MASS,), ()))
    assert confirmed(Found(both, empty, {s.key: s for s in (both, mass, empty)}), print).best is both  # both are there
    found = Found(both, empty, {s.key: s for s in (both, empty)})
    # The validation lines as they would be with so much less of the second one.
    second = next(t for t in both.terms if t.places == SECOND.places)
    at, without = one.lines.validation, room._without(found, second)
    less = [one.forward.predict(s.x, one.lines.w[at], derivatives=False).h for s in (without, both)]
    change, as_measured = less[0] - less[1], one.lines.h[at]

    def beyond(share):
        one.lines.h[at] = as_measured + share * change
        return room._nats(replace(both), without) - part * AGAINST

    beyond(brentq(beyond, 0.0, 5.0))
    said = []
    both = replace(both)  # nothing is known of its validation lines
    made = confirmed(replace(found, best=both, pool=found.pool | {both.key: both}), said.append)
    left_out = part > 1
    assert made.best.key == (mass if left_out else both).key
    assert len(made.left_out) == len(said) == left_out
    if left_out:
        assert "point_mass at 4" in made.left_out[0]
        assert both.key not in made.pool


def test_an_effect_that_is_there_is_left_out_no_more_often_than_is_said():
    means = np.linspace(0.01, 100, 5000)
    assert norm.cdf((-AGAINST - means) / np.sqrt(2 * means)).max() == pytest.approx(norm.cdf(-np.sqrt(2 * AGAINST)), rel=1e-3)
    assert norm.cdf(-np.sqrt(2 * AGAINST)) < 0.01


def test_nothing_is_not_said_to_be_missing_where_lines_fitted_and_others_disagree_about_an_effect():
    one = chain.case()
    empty = fit(one, one.forward.start, 0.01)
    found = Found(empty, empty, {(): empty})
    assert verdict_and_reason(found, None)[0] == "no_misfit"
    assert verdict_and_reason(replace(found, left_out=("a mass is left out",)), None) == ("inconclusive", "a mass is left out")

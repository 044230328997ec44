"""Values of an accepted law moved together, and the intervals stated with them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from nonlinear_truth import Strip, measure, place
from operando.nonlinear.laws import LawFit, law_cost
from operando.nonlinear.polish import bounded, polished, std_of
from operando.nonlinear.search import Field, examine, make_case, settled
from operando.nonlinear.steps import Tried, weighed

STRIP = Strip()
TRUE = {"stiffness": 4e3, "yield_force": 2.0, "exponent": 2.0, "ratio": 0.3}


@cache
def start():
    """The place of a hysteresis, and a law there whose values lean on each other as a grid leaves them."""
    records = measure(STRIP, [(place(STRIP, 3), "hysteresis", TRUE)], seconds=12.0, run_in=3.0)
    case = weighed(make_case(STRIP.idle(), records, places=[(3,)]), (3,))
    law = LawFit("hysteresis", 1.0, {"stiffness": 4.3e3, "yield_force": 1.9, "exponent": 1.6, "ratio": 0.25}, 0.0, 4)
    spot = settled(examine(Field.of(case), (3,)), case, law)
    cost, count = law_cost(law, spot.select)
    validation, n = law_cost(law, spot.validation)
    return case, Tried(spot, law, cost / count, validation / n)


@cache
def polished_start():
    return polished(*start())


def test_values_that_lean_on_each_other_come_right_together():
    _, rough = start()
    better = polished_start()
    assert better.selection < 0.5 * rough.selection
    assert better.validation < rough.validation
    errors = {n: abs(better.law.values[n] / v - 1) for n, v in TRUE.items()}
    assert errors["stiffness"] < 0.02
    assert errors["yield_force"] < 0.02
    assert errors["exponent"] < 0.15
    assert errors["ratio"] < 0.1


def test_intervals_hold_the_truth_and_say_something():
    better = polished_start()
    std = std_of(better)
    for name, value in TRUE.items():
        assert abs(better.law.values[name] - value) < 3 * std[name], name
        assert std[name] < 0.3 * value, name


def test_what_is_left_beyond_noise_widens_the_intervals():
    _, rough = start()
    off = replace(rough, law=replace(rough.law, values=rough.law.values | {"stiffness": 6e3, "yield_force": 3.0}))
    assert std_of(off)["stiffness"] / 6e3 > 2 * std_of(polished_start())["stiffness"] / 4e3


def test_values_stay_inside_the_bounds_of_their_kind():
    wild = LawFit("hysteresis", 1.0, {"stiffness": 4e3, "yield_force": 2.0, "exponent": 40.0, "ratio": 1.4}, 0.0, 4)
    kept = bounded(wild).values
    assert kept["exponent"] == 10.0
    assert kept["ratio"] == 0.95
    assert np.isclose(kept["stiffness"], 4e3)

"""Values of an accepted law moved together, and the intervals stated with them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from nonlinear_truth import Strip, measure, place
from operando.diagnosis.records import Sets, Tried, examine, make_case, refined, std_of, stepped, weighed
from operando.structure import ForceLaw

STRIP = Strip()
TRUE = {"stiffness": 4e3, "yield_force": 2.0, "exponent": 2.0, "ratio": 0.3}


@cache
def start():
    """The place of a hysteresis, and a law there whose values lean on each other as a grid leaves them."""
    records = measure(STRIP, [(place(STRIP, 3), "hysteresis", TRUE)], seconds=12.0, run_in=3.0)
    case = weighed(make_case(STRIP.idle(), records, places=[(3,)]), (3,))
    law = ForceLaw("hysteresis", {"stiffness": 4.3e3, "yield_force": 1.9, "exponent": 1.6, "ratio": 0.25})
    return Tried.of(examine(Sets.of(case), (3,)).settled(law), law)


@cache
def refined_start():
    return refined(start())


def test_values_that_lean_on_each_other_come_right_together():
    rough = start()
    better = refined_start()
    assert better.selection < 0.5 * rough.selection
    assert better.validation < rough.validation
    errors = {n: abs(better.law.values[n] / v - 1) for n, v in TRUE.items()}
    assert errors["stiffness"] < 0.02
    assert errors["yield_force"] < 0.02
    assert errors["exponent"] < 0.15
    assert errors["ratio"] < 0.1


def test_intervals_hold_the_truth_and_say_something():
    better = refined_start()
    std = std_of(better)
    for name, value in TRUE.items():
        assert abs(better.law.values[name] - value) < 3 * std[name], name
        assert std[name] < 0.3 * value, name


def test_what_is_left_beyond_noise_widens_the_intervals():
    rough = start()
    off = replace(rough, law=rough.law.moved(stiffness=6e3, yield_force=3.0))
    assert std_of(off)["stiffness"] / 6e3 > 2 * std_of(refined_start())["stiffness"] / 4e3


def test_values_stay_inside_the_bounds_of_their_kind():
    law = ForceLaw("hysteresis", {"stiffness": 4e3, "yield_force": 2.0, "exponent": 2.0, "ratio": 0.3})
    kept = stepped(law, ["exponent", "ratio"], np.array([3.0, 2.0])).values
    assert kept["exponent"] == 10.0
    assert kept["ratio"] == 0.95
    assert np.isclose(kept["stiffness"], 4e3)

"""Laws in the closed loop in place of the motion seen, against structures integrated by other code."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.optimize import brentq

from nonlinear_truth import Strip, measure, measure_many, place
from operando.diagnosis import apply_to_records, diagnose_records
from operando.diagnosis.records import (
    Sets,
    closed_loop_force,
    examine,
    fit_law,
    followed,
    groups,
    loop_for,
    make_case,
    recorded,
    refined,
    settle_law,
    std_of,
    weighed,
)
from operando.structure.effects import Effect
from operando.structure.step_laws import SlipLaw

STRIP = Strip()
FORCE = 1.0


@cache
def records():
    return tuple(measure(STRIP, [(place(STRIP, 3, 6), "coulomb_friction", {"force": FORCE, "speed": 3e-3})]))


@cache
def before_and_after():
    """The case, and friction at its place with the force of the motion seen and with that of the loop."""
    case = weighed(make_case(STRIP.idle(), records()), (3, 6))
    spot = examine(Sets.of(case), (3, 6))
    tried = refined(settle_law(spot, fit_law(spot.fit, "coulomb_friction")))
    return case, tried, closed_loop_force(case, tried)


def test_the_slip_law_holds_at_the_end_of_each_step():
    rng = np.random.default_rng(0)
    level, speed, v = rng.uniform(0.1, 5, 60), 10 ** rng.uniform(-5, -1, 60), rng.normal(0, 0.1, 60)
    near = 3e-3
    s = SlipLaw(level, speed).solve(np.zeros(60), v, 1e-6, near)
    for k in range(60):
        wanted = brentq(lambda f, k=k: f - level[k] * np.tanh((v[k] - near * f) / speed[k]), -level[k], level[k], xtol=1e-14)
        assert s[k] == pytest.approx(wanted, rel=1e-5)


def test_the_loop_finds_friction_that_sticks_where_the_motion_seen_does_not():
    _, seen, made = before_and_after()
    # Nothing was fitted to the lower level, at which it sticks most of the time.
    assert made.validation < 0.4 * seen.validation
    assert abs(made.law.values["force"] - FORCE) < 0.3 * abs(seen.law.values["force"] - FORCE)
    assert abs(made.law.values["force"] - FORCE) < 2 * std_of(made)["force"] < 0.05
    assert made.law.values["slip_speed"] == seen.law.values["slip_speed"]


def test_the_force_of_the_loop_stands_for_its_law_alone():
    _, seen, made = before_and_after()
    motion = made.spot.whole[0]
    own = motion.spectrum(made.law)
    assert own is motion.closed[made.law.key]
    other = made.law.moved(force=2 * made.law.values["force"])
    assert np.allclose(motion.spectrum(other), motion.crossing.lines(other.force(motion.x, motion.v, motion.step)))
    assert not seen.spot.whole[0].closed
    settled = motion.settled(made.law)
    assert not settled.closed


def test_values_held_stay_and_laws_that_follow_the_motion_are_left():
    case, seen, _ = before_and_after()
    held = closed_loop_force(case, seen, fitted=False)
    assert held.law.values == seen.law.values
    assert held.validation < seen.validation
    spring = fit_law(seen.spot.fit, "ground_damper")
    tried = replace(seen, law=spring)
    assert closed_loop_force(case, tried) is tried


def test_diagnosis_and_add_give_the_same_friction():
    found = diagnose_records(STRIP.idle(), records())
    (effect,) = found.effects
    added = apply_to_records(STRIP.idle(), [Effect("coulomb_friction", ("4+Z", "7+Z"), {"force": 1.0})], records())
    assert added.effects[0].values["force"] == pytest.approx(effect.values["force"], rel=2e-3)
    assert added.ladder[-1]["heldout_misfit"] == pytest.approx(found.ladder[-1]["heldout_misfit"], rel=0.2)
    assert effect.values["force"] == pytest.approx(FORCE, rel=0.01)


def test_long_records_are_followed_one_after_the_other():
    assert groups([5, 5, 5], 15) == [[0, 1, 2]]
    assert groups([5, 5, 5], 1) == [[0], [1], [2]]
    case, seen, _ = before_and_after()
    loop = recorded(loop_for(case, [seen]), 512.0)
    assert np.all(np.abs(loop.poles) < 2 * np.pi * 256)
    forces = [m.spectrum(seen.law) for m in seen.spot.whole]
    at_once = followed(case, seen.spot, seen.law, ["force"], forces, loop)
    in_turn = followed(case, seen.spot, seen.law, ["force"], forces, loop, most=1)
    for a, b in zip(at_once.whole, in_turn.whole, strict=True):
        assert a.spectrum(seen.law) == pytest.approx(b.spectrum(seen.law), rel=1e-6, abs=1e-6)


def test_friction_that_sticks_nearly_always_is_told_from_a_damper():
    # Its speed is smoothed over more than the rms velocity: F/v₀ alone is all that a damper would say.
    held = {"friction": ("coulomb_friction", {"force": 8.0, "speed": 0.06}), "damper": ("ground_damper", {"damping": 130.0})}
    made = measure_many(STRIP, {name: [(place(STRIP, 4), *law)] for name, law in held.items()})
    for name, (kind, values) in held.items():
        (effect,) = diagnose_records(STRIP.idle(), made[name]).effects
        assert (effect.kind, effect.place) == (kind, "5+Z")
        first = next(iter(values))
        assert effect.values[first] == pytest.approx(values[first], rel=0.02)
        assert abs(effect.values[first] - values[first]) < 3 * effect.std[first]

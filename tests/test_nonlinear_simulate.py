"""The model with effects in the closed loop, against an integrator of the tests' own."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from nonlinear_truth import RATE, Strip, band_force, place, respond
from operando.data import Channel, TimeRecord
from operando.dof import Dof
from operando.errors import ConfigError, DataError
from operando.structure import simulate
from operando.structure.effects import Effect

STRIP = Strip()
HYSTERESIS = {"stiffness": 4e3, "yield_force": 3.0, "exponent": 1.5, "ratio": 0.3}
# Not so stiff that two integrators part company: that structures forget their state is no fault of either.
PAIR = [("one_sided_contact", (4,), {"stiffness": 3e3, "gap": 1e-3}), ("cubic_stiffness", (2,), {"coefficient": 2e7})]
CASES = {
    "nothing": [],
    "spring": [("ground_spring", (3,), {"stiffness": 3e3})],
    "cubic": [("cubic_stiffness", (2,), {"coefficient": 2e7})],
    "quadratic damping": [("quadratic_damping", (5,), {"coefficient": 3.0})],
    "clearance": [("clearance", (4,), {"stiffness": 2e3, "gap": 1e-3})],
    "saturating": [("saturating_spring", (3, 6), {"stiffness": 5e3, "knee": 1e-3})],
    "friction": [("coulomb_friction", (3, 6), {"force": 1.0, "speed": 3e-3})],
    "hysteresis": [("hysteresis", (5,), HYSTERESIS)],
    "two": PAIR,
}


@cache
def truth():
    """Accelerations of all cases side by side, from rest."""
    rng = np.random.default_rng(5)
    force = band_force(rng, int(5 * RATE))
    force[: int(0.1 * RATE)] *= np.linspace(0, 1, int(0.1 * RATE))
    force[-int(0.1 * RATE) :] *= np.linspace(1, 0, int(0.1 * RATE))
    effects = []
    for number, parts in enumerate(CASES.values()):
        own = np.arange(len(CASES)) == number
        effects += [(np.outer(place(STRIP, *rows), own), kind, p) for kind, rows, p in parts]
    return force, respond(STRIP, [1] * len(CASES), np.tile(force, (len(CASES), 1)), effects)


def record(force):
    return TimeRecord(force[None], RATE, (Channel(Dof(2, "Z", 1), "force", "N"),), name="run")


def effect(kind, rows, values):
    named = {"coefficient": "coefficient", "speed": "slip_speed"}
    return Effect(kind, tuple(f"{r + 1}+Z" for r in rows), {named.get(k, k): v for k, v in values.items()})


@pytest.mark.parametrize("name", CASES)
def test_simulation_follows_the_integrator(name):
    force, answers = truth()
    answer = answers[list(CASES).index(name)]
    made = simulate(STRIP.idle(), [effect(*part) for part in CASES[name]], record(force))
    assert made.sampling_hz == RATE
    assert [str(c.dof) for c in made.channels] == [str(d) for d in STRIP.idle().dofs]
    linear = answers[0]
    error = np.linalg.norm(made.data - answer) / np.linalg.norm(answer)
    assert error < 0.02
    if CASES[name]:
        assert np.linalg.norm(linear - answer) > 10 * np.linalg.norm(made.data - answer)


def test_signs_of_dofs_count():
    force, _ = truth()
    values = PAIR[0][2]
    one, turned = simulate(STRIP.idle(), [effect(*PAIR[0])], record(force), ["7+Z", "7-Z"]).data
    np.testing.assert_array_equal(one, -turned)
    other = simulate(STRIP.idle(), [Effect("one_sided_contact", ("5-Z",), values)], record(force), ["5+Z"])
    mirrored = simulate(STRIP.idle(), [Effect("one_sided_contact", ("5+Z",), values)], record(-force), ["5+Z"])
    np.testing.assert_allclose(other.data, -mirrored.data, atol=1e-9 * np.abs(other.data).max())


def test_a_stiff_stop_stays_bounded():
    force, answers = truth()
    made = simulate(STRIP.idle(), [Effect("clearance", ("5+Z",), {"stiffness": 1e7, "gap": 1e-4})], record(force))
    assert np.isfinite(made.data).all()
    assert made.data.std() < 20 * answers[0].std()


def test_what_cannot_be_simulated_is_refused():
    force, _ = truth()
    with pytest.raises(ConfigError, match="gyroscopic"):
        simulate(STRIP.idle(), [Effect("gyroscopic", ("5+Z", "3+Z"), {"coefficient": 1.0})], record(force))
    silent = TimeRecord(force[None], RATE, (Channel(Dof(2, "Z", 1), "acceleration", "m/s2"),))
    with pytest.raises(DataError, match="no force"):
        simulate(STRIP.idle(), [], silent)

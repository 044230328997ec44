"""A law that the catalogue lacks: the place is right and the verdict says that the law is not; and a user's own law of a few lines."""

from __future__ import annotations

from functools import cache

import pytest
from tests.nonlinear_truth import Strip, measure, place

import operando
from operando.effects.registry import unregister
from operando.nonlinear import diagnose_records

STRIP = Strip()
COEFFICIENT = 3e13


@cache
def records():
    return measure(STRIP, [(place(STRIP, 2), "quintic", {"coefficient": COEFFICIENT})], seconds=12.0, run_in=3.0)


def test_a_law_outside_the_catalogue_is_placed_and_not_called_explained():
    found = diagnose_records(STRIP.idle(), records())
    assert [str(d) for d in found.effects[0].location] == ["3+Z"]
    assert found.verdict in ("partial", "unexplained")
    assert any("none of the catalogue" in note for note in found.notes)


@pytest.fixture
def power_spring():
    @operando.register
    class PowerSpring(operando.EffectKind):
        kind = "power_spring"
        plain = "a spring whose force grows with a power of its deflection"
        acts = "pseudo_force"
        places, alternative_places = 1, (2,)
        level_dependent = True
        parameters = (
            operando.Parameter("coefficient", "", 1e-3, 1e30, "log", 1e9, "force at 1 m"),
            operando.Parameter("power", "", 1.2, 9.0, "log", 4.0, "power"),
        )

        def pseudo_force(self, x, v, values):
            return values["coefficient"] * abs(x) ** values["power"] * ((x > 0) * 2.0 - 1.0)

    yield PowerSpring
    unregister("power_spring")


def test_a_law_of_ones_own_is_found_and_sized(power_spring):
    found = diagnose_records(STRIP.idle(), records(), places=["3+Z", "5+Z"])
    (effect,) = found.effects
    assert (effect.kind, str(effect.location[0])) == ("power_spring", "3+Z")
    assert effect.values["power"] == pytest.approx(5, rel=0.03)
    assert found.verdict == "explained"
    # At a deflection of 1 mm, where it acts: the coefficient alone is the force at a metre.
    force = effect.values["coefficient"] * 1e-3 ** effect.values["power"]
    assert force == pytest.approx(COEFFICIENT * 1e-15, rel=0.05)

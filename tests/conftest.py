"""Fixtures that several test files share."""

from __future__ import annotations

import pytest

from operando.structure.effects import EffectKind, Parameter, catalogue, register, unregister


@pytest.fixture
def inerter():
    """Name of a kind of the user's own that says its dynamic stiffness alone."""

    class Inerter(EffectKind):
        kind = "inerter_for_test"
        plain = "an inerter between two points"
        places = 2
        parameters = (Parameter("inertance", "kg", 1e-3, 1e4, "log", 1.0),)

        def dynamic_stiffness(self, s, values):
            return values["inertance"] * s**2

    register(Inerter)
    yield Inerter.kind
    unregister(Inerter.kind)


@pytest.fixture
def own_kinds_gone():
    """Takes kinds of effects that a test registers out of the catalogue again."""
    before = set(catalogue())
    yield
    for name in set(catalogue()) - before:
        unregister(name)

"""FRFs at levels that were not measured, against structures integrated by code of the tests' own and measured there."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from nonlinear_truth import Strip, measure_many, place
from operando.diagnosis.at_level import level_frf
from operando.errors import DataError
from operando.frf import estimate_frf
from operando.structure import at_level
from operando.structure.effects import Effect, EffectKind, Parameter, register, unregister

STRIP = Strip(sensors=6, count=8)
BAND = (3.0, 180.0)
EFFECTS = {
    "cubic_stiffness": ((place(STRIP, 2), "3+Z"), {"coefficient": 4e7}),
    "clearance": ((place(STRIP, 4), "5+Z"), {"stiffness": 5e3, "gap": 1e-3}),
    "coulomb_friction": ((place(STRIP, 1, 3), "2+Z,4+Z"), {"force": 0.5, "speed": 3e-3}),
    "hysteresis": ((place(STRIP, 3), "4+Z"), {"stiffness": 4e3, "yield_force": 2.0, "exponent": 2.0, "ratio": 0.3}),
    "one_sided_contact": ((place(STRIP, 2), "3+Z"), {"stiffness": 6e3, "gap": 3e-4}),
}


@cache
def measured():
    """FRFs from the first DOF at two levels, by the local rational estimate: lines, and {(kind, level): (m, L)}."""
    cases = {kind: [(where[0], kind, values)] for kind, (where, values) in EFFECTS.items()}
    levels = (2.0, 0.5)
    records = measure_many(STRIP, cases, seconds=20.0, drive_at=(0,), levels=levels, run_in=3.0, fine=4)
    frfs = {(k, s): estimate_frf([r], estimator="lrm") for k, runs in records.items() for s, r in zip(levels, runs, strict=True)}
    hz = next(iter(frfs.values())).frequencies_hz
    inside = (hz > 5) & (hz < 90)
    return hz[inside], {key: frf.data[:, 0, inside] for key, frf in frfs.items()}


def effect_of(kind):
    (_, where), values = EFFECTS[kind]
    stated = {k: v for k, v in values.items() if k != "speed"}
    if "speed" in values:
        stated["slip_speed"] = values["speed"]
    from operando.dof import parse_dofs

    return Effect(kind, tuple(parse_dofs(where)), stated)


def apart(kind, level, model):
    """Relative distance of a model (m, L) from what is measured, on the lines of the modes."""
    known = measured()[1][kind, level]
    return np.linalg.norm(model - known) / np.linalg.norm(known)


@pytest.mark.parametrize("kind", EFFECTS)
def test_frfs_at_two_levels_come_near_what_is_measured_there(kind):
    hz = measured()[0]
    idle = STRIP.idle()
    model = {s: level_frf(idle, [effect_of(kind)], 10 * s, hz, None, ["1+Z"], band=BAND).data[:, 0] for s in (2.0, 0.5)}
    bare = idle.frf(hz, idle.dofs, ["1+Z"], "accelerance", variance=False).data[:, 0]
    for level in model:
        other = 2.5 - level
        assert apart(kind, level, model[level]) < 0.5 * apart(kind, level, bare), "far better than without the effect"
        if kind != "one_sided_contact":  # its gap is small for these motions, so it is nearly the same at both
            assert apart(kind, level, model[level]) < 0.75 * apart(kind, level, model[other]), "and than at the other level"


def test_a_cubic_spring_has_three_times_its_mean_square():
    idle = STRIP.idle()
    (spring,) = [e for e in at_level(idle, [effect_of("cubic_stiffness")], 5.0, "1+Z", BAND) if "spring" in e.kind]
    hz = np.linspace(*BAND, 4000)
    from operando.structure import Model

    h = Model(idle, (spring,)).frf(hz, ["3+Z"], ["1+Z"], "receptance", variance=False).data[0, 0]
    square = 25.0 * np.mean(np.abs(h) ** 2)
    assert spring.values["stiffness"] == pytest.approx(3 * 4e7 * square, rel=0.05)


def test_a_linear_effect_stays_what_it_is():
    spring = Effect("ground_spring", effect_of("cubic_stiffness").location, {"stiffness": 2e3})
    assert at_level(STRIP.idle(), [spring], 5.0, "1+Z", BAND) == [spring]
    assert at_level(STRIP.idle(), [], 5.0, "1+Z", BAND) == []
    with pytest.raises(DataError):
        at_level(STRIP.idle(), [spring], 0.0, "1+Z", BAND)


class Quintic(EffectKind):
    """A user's own law."""

    kind = "quintic_stiffness"
    plain = "a spring that stiffens with the fifth power of its deflection"
    acts = "pseudo_force"
    places = 1
    alternative_places = (2,)
    level_dependent = True
    parameters = (Parameter("coefficient", "N/m5", 1e-3, 1e30, "log", 1e12),)

    def pseudo_force(self, x, v, values):
        return values["coefficient"] * x**5


def test_a_law_of_ones_own_has_a_level_too():
    register(Quintic)
    try:
        own = Effect("quintic_stiffness", effect_of("cubic_stiffness").location, {"coefficient": 1e13})
        low, high = (
            sum(e.values["stiffness"] for e in at_level(STRIP.idle(), [own], level, "1+Z", BAND) if "spring" in e.kind)
            for level in (2.0, 4.0)
        )
        assert 6 * low < high <= 16 * low
    finally:
        unregister("quintic_stiffness")

"""The catalogue: every kind of the contract, its words, parameters, bounds, nesting; effects as text and JSON; a user's own kind."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from operando.errors import ConfigError, DofError
from operando.structure.effects import Effect, EffectKind, Parameter, catalogue, kind_of, parse_effect, register, unregister

BAND = (10.0, 110.0)
# The contract's table of linear, sensor and operating kinds: places, parameters with units.
CONTRACT = {
    "point_mass": (1, {"mass": "kg"}),
    "ground_spring": (1, {"stiffness": "N/m"}),
    "ground_damper": (1, {"damping": "N s/m"}),
    "ground_hysteretic_spring": (1, {"stiffness": "N/m", "loss_factor": ""}),
    "ground_rubber": (1, {"stiffness": "N/m", "exponent": ""}),
    "coupling_spring": (2, {"stiffness": "N/m"}),
    "coupling_damper": (2, {"damping": "N s/m"}),
    "tuned_absorber": (1, {"mass": "kg", "frequency": "Hz", "damping_ratio": ""}),
    "gyroscopic": (2, {"coefficient": "N s/m"}),
    "circulatory": (2, {"coefficient": "N/m"}),
    "global_stiffness": (0, {"change": ""}),
    "global_damping": (0, {"change": ""}),
    "missing_mode": (0, {"frequency": "Hz", "damping_ratio": ""}),
    "sensor_gain": (1, {"gain": ""}),
    "sensor_polarity": (1, {}),
    "sensor_delay": (1, {"delay": "s"}),
    "channel_swap": (2, {}),
    "sensor_mass": (1, {"mass": "kg"}),
    "force_gain": (1, {"gain": ""}),
    "force_delay": (1, {"delay": "s"}),
    "harmonic_excitation": (0, {}),
}
PLACES = ("", "@12+Z", "@12+Z,7-X")


def example(kind):
    return parse_effect(kind + PLACES[CONTRACT[kind][0]], BAND)


@pytest.mark.parametrize("kind", CONTRACT)
def test_the_kind_is_as_the_contract_writes_it(kind):
    definition = catalogue()[kind]
    places, parameters = CONTRACT[kind]
    assert definition.kind == kind
    assert definition.places == places
    assert {p.name: p.unit for p in definition.parameters} == parameters


@pytest.mark.parametrize("kind", CONTRACT)
def test_bounds_enclose_the_start_and_the_search_scale_turns_back(kind):
    definition, effect = catalogue()[kind], example(kind)
    for p in definition.parameters:
        low, high = (p.inward(v) for v in p.bounds(BAND))
        inward = p.inward(effect.values[p.name])
        assert low <= inward <= high > low
        assert p.outward(inward) == pytest.approx(effect.values[p.name], rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("kind", CONTRACT)
def test_words_name_place_and_size_and_a_test(kind):
    effect = example(kind)
    for text in (effect.explanation, effect.confirm):
        assert len(text) > 25
        assert "{" not in text
    for place in effect.location:
        assert str(place) in effect.explanation
        assert str(place) in effect.confirm
    if effect.definition.group in ("sensor", "force"):
        assert "measurement, not structure" in effect.explanation


@pytest.mark.parametrize("kind", CONTRACT)
def test_text_and_json_give_the_effect_back(kind):
    effect = example(kind)
    assert parse_effect(str(effect)) == effect
    document = json.loads(json.dumps(effect.to_dict(), allow_nan=False))
    assert Effect.from_dict(document) == effect
    assert {"kind", "location", "parameters", "explanation", "confirm"} <= set(document)
    for entry in document["parameters"].values():
        assert set(entry) == {"value", "unit", "std"}


def test_simpler_kinds_are_limits_of_those_that_contain_them():
    s = 2j * np.pi * np.linspace(10, 100, 7)
    assert all(inner in catalogue() for k in catalogue().values() for inner in k.contains)
    spring = kind_of("ground_spring").dynamic_stiffness(s, {"stiffness": 5.0})
    hysteretic = kind_of("ground_hysteretic_spring").dynamic_stiffness(s, {"stiffness": 5.0, "loss_factor": 1e-9})
    rubber = kind_of("ground_rubber").dynamic_stiffness(s, {"stiffness": 5.0, "exponent": 1e-9, "reference_hz": 30.0})
    mass = kind_of("point_mass").dynamic_stiffness(s, {"mass": 2.0})
    stiff = kind_of("tuned_absorber").dynamic_stiffness(s, {"mass": 2.0, "frequency": 1e6, "damping_ratio": 0.01})
    soft = kind_of("tuned_absorber").dynamic_stiffness(s, {"mass": 5e6, "frequency": np.sqrt(1e-6) / 2 / np.pi, "damping_ratio": 1e-13})
    for found, truth in ((hysteretic, spring), (rubber, spring), (stiff, mass), (soft, spring)):
        assert np.allclose(found, truth, rtol=1e-5)
    assert {"ground_spring", "ground_hysteretic_spring"} <= set(kind_of("ground_rubber").contains)
    assert {"point_mass", "ground_spring"} <= set(kind_of("tuned_absorber").contains)


@pytest.mark.parametrize("kind", [k for k, (places, _) in CONTRACT.items() if places])
def test_dynamic_stiffness_is_real_in_time(kind):
    """Z(s*) = Z(s)*: a real force for a real motion."""
    definition = catalogue()[kind]
    if definition.acts != "dynamic_stiffness":
        return
    s = np.array([3 + 40j, -2 + 300j, 5j])
    values = example(kind).values
    k = 2 if definition.coordinates == "separate" else 1
    assert np.allclose(definition.matrix(s.conj(), values, k), definition.matrix(s, values, k).conj(), rtol=1e-12)


@pytest.mark.parametrize("kind", CONTRACT)
def test_passive_kinds_give_no_power(kind):
    definition = catalogue()[kind]
    if definition.acts != "dynamic_stiffness" or kind == "circulatory":
        return
    w = 2 * np.pi * np.linspace(1, 200, 300)
    k = 2 if definition.coordinates == "separate" else 1
    z = definition.matrix(1j * w, example(kind).values, k)
    loss = (z - z.conj().transpose(0, 2, 1)) / 2j
    assert np.linalg.eigvalsh(loss).min() >= -1e-9 * np.abs(z).max()


def test_the_contracts_examples_read():
    mass = parse_effect("point_mass@272+Z=mass:0.2")
    assert (mass.kind, [str(d) for d in mass.location], mass.values) == ("point_mass", ["272+Z"], {"mass": 0.2})
    assert parse_effect("point_mass@272+Z").values["mass"] > 0
    gyro = parse_effect("gyroscopic@3+Z,7+Z=coefficient:20")
    assert gyro.values == {"coefficient": 20.0}
    assert parse_effect("global_stiffness").location == ()
    between = parse_effect("ground_spring@0.3, 0.1, 0:+Z=stiffness:100")
    assert between.position == (0.3, 0.1, 0.0)
    assert (between.direction, between.location) == ("+Z", ())
    assert between.to_dict()["position"] == [0.3, 0.1, 0.0]
    assert parse_effect("point_mass@272+Z=mass:0.2", fixed=True).fixed == ("mass",)
    assert parse_effect("harmonic_excitation=frequencies:24.5;49").values["frequencies"] == (24.5, 49.0)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("point_mas@3+Z", "did you mean 'point_mass'"),
        ("point_mass", "1 DOFs, 0 given"),
        ("gyroscopic@3+Z", "2 DOFs, 1 given"),
        ("coupling_spring@3+Z,3-Z", "two different DOFs"),
        ("point_mass@3+Z=weight:2", "no parameter 'weight'"),
        ("point_mass@3+Z=mass:heavy", "no number"),
        ("point_mass@3+Z=mass", "no name:value"),
        ("point_mass@3+Z=mass:0", "must be positive"),
        ("point_mass@3+Z=mass:nan", "must be positive"),
        ("tuned_absorber@3+Z=mass:1,frequency:-5", "must be positive"),
        ("point_mass@3+Z=mass:1,mass:2", "mass of point_mass is given twice"),
        ("point_mass@", "is no effect"),
        ("point_mass@3+Z=", "is no effect"),
        ("sensor_gain@0,0,0:+Z", "without a sensor"),
        ("ground_spring@0,a,0:+Z", "no position"),
        ("ground_rubber@3+Z", "centre of the analysis band"),
    ],
)
def test_what_cannot_be_read_says_why(text, says):
    with pytest.raises(ConfigError, match=says):
        parse_effect(text)


def test_a_place_that_is_no_dof():
    with pytest.raises(DofError):
        parse_effect("point_mass@here")


def test_a_negative_size_is_the_effect_taken_away():
    effect = parse_effect("point_mass@3+Z=mass:-0.2")
    assert effect.removed
    assert effect.values == {"mass": 0.2}
    assert effect.to_dict()["parameters"]["mass"]["value"] == -0.2
    assert "missing" in effect.explanation
    with pytest.raises(ConfigError):
        Effect("sensor_gain", ("3+Z",), {"gain": 2.0}, removed=True)
    with pytest.raises(ConfigError):
        parse_effect("sensor_gain@3+Z=gain:-1")


def test_size_with_its_spread():
    effect = parse_effect("point_mass@272+Z=mass:0.2").with_std({"mass": 0.004})
    assert effect.explanation == "A mass of 200 ± 8 g sits on 272+Z"  # ± is the 95 % interval
    assert effect.with_values(mass=0.3).std == {}
    assert parse_effect("global_stiffness=change:-0.08").with_std({"change": 0.0012}).size == "-8.0 ± 0.2 %"
    assert parse_effect("ground_spring@3+Z=stiffness:1e6").with_std({"stiffness": 3e3}).size == "1.000 ± 0.006 MN/m"


def test_a_kind_of_the_users_own():
    class Stop(EffectKind):
        kind = "magnet_for_test"
        plain = "a magnet that pushes away"
        parameters = (Parameter("stiffness", "N/m", 1.0, 1e6, "log", 100.0),)

        def dynamic_stiffness(self, s, values):
            return -values["stiffness"] * np.ones(np.shape(s))

    assert register(Stop) is Stop
    try:
        effect = parse_effect("magnet_for_test@3+Z=stiffness:50")
        assert effect.explanation == "A magnet that pushes away at 3+Z: 50 N/m"
        assert Effect.from_dict(effect.to_dict()) == effect
    finally:
        unregister("magnet_for_test")
    assert "magnet_for_test" not in catalogue()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"kind": ""}, "one word"),
        ({"plain": ""}, "plain words"),
        ({"acts": "magic"}, "acts"),
        ({"acts": "sensor_map"}, "does not define"),
        ({"places": 3}, "DOFs"),
        ({"places": 0}, "takes no DOF"),
        ({"coordinates": "node", "places": 2}, "coordinates"),
        ({"parameters": (Parameter("a", "", 0.0, 1.0, "linear"),) * 2}, "two parameters"),
        ({"parameters": ("a",)}, "expected a tuple of Parameter"),
        ({"parameters": Parameter("a", "", 0.0, 1.0, "linear")}, "expected a tuple of Parameter"),
        ({"constants": "a"}, "the constants of bad_for_test are 'a'"),
    ],
)
def test_a_kind_that_cannot_work_is_refused_at_once(changes, says):
    body = {"kind": "bad_for_test", "plain": "bad", "dynamic_stiffness": lambda self, s, values: s} | changes
    with pytest.raises(ConfigError, match=says):
        register(type("Bad", (EffectKind,), body))
    assert "bad_for_test" not in catalogue()


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (("a b,", "", 1.0, 2.0), "give one word"),
        (("", "", 1.0, 2.0), "give one word"),
        (("a", "", 2.0, 1.0), "the bounds 2 and 1"),
        (("a", "", 0.0, 1.0), "lower bound 0 on a logarithmic scale"),
        (("a", "", -1.0, 1.0, "log"), "lower bound -1 on a logarithmic scale"),
        (("a", "", 1.0, 2.0, "log", 3.0), "the default of a is 3, expected 1 to 2"),
    ],
)
def test_a_parameter_that_cannot_be_is_refused(given, says):
    with pytest.raises(ConfigError, match=says):
        Parameter(*given)


def test_parameters_know_their_scale():
    with pytest.raises(ConfigError, match="transform"):
        Parameter("a", "", 0.0, 1.0, "cubic")
    p = Parameter("f", "Hz", None, None, "log", None)
    assert p.bounds(BAND) == BAND
    assert p.start(BAND) == 60.0
    with pytest.raises(ConfigError):
        p.bounds()
    signed = Parameter("c", "", -1e7, 1e7, "signed_log")
    for v in (-3e5, -1.0, 0.0, 2e-3, 4e6):
        assert signed.outward(signed.inward(v)) == pytest.approx(v, rel=1e-9, abs=1e-12)
        h = 1e-6
        slope = (signed.outward(signed.inward(v) + h) - signed.outward(signed.inward(v) - h)) / (2 * h)
        assert signed.slope(v) == pytest.approx(slope, rel=1e-6)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("clearance@3+Z=stiffness:5e5,gap:7.593e-6", "below 7.6 µm: the effect must vanish"),
        ("one_sided_contact@3+Z=stiffness:5e5,gap:1.2e-4", "away by 0.12 mm"),
        ("saturating_spring@3+Z=stiffness:5e5,knee:7.4e-7", "well below 0.74 µm"),
        ("hysteresis@3+Z=stiffness:5e5,yield_force:0.25,exponent:2,ratio:0.1", "close at 250 mN"),
    ],
)
def test_sizes_in_the_test_that_would_confirm_an_effect_have_units_as_written(text, words):
    assert words in parse_effect(text).confirm


def test_equal_effects_are_one_in_a_set():
    text = "tuned_absorber@3+Z=mass:2,frequency:30"
    one, same, other = parse_effect(text), parse_effect(text).with_std({"mass": 0.1}), parse_effect("harmonic_excitation=frequencies:5;6")
    assert {one, parse_effect(text), replace(other)} == {one, other}
    assert hash(one) == hash(parse_effect(text)) == hash(same)


@pytest.mark.parametrize("data", [{}, {"kind": "point_mass", "parameters": {"mass": 3}}, {"kind": "point_mass", "parameters": 3}, 3, None])
def test_what_describes_no_effect_is_refused(data):
    with pytest.raises(ConfigError, match="describes no effect"):
        Effect.from_dict(data)

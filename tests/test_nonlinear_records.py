"""Level-dependent effects from records with measured force, against structures integrated by code of the tests' own."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from nonlinear_truth import Strip, measure_many, place
from operando.diagnosis import diagnose_records, measured_distortion
from operando.diagnosis.from_records import diagnose_levels
from operando.diagnosis.result import Diagnosis
from operando.diagnosis.suspicion import FAINT
from operando.dof import Dof
from operando.errors import DataError, MissingError
from operando.structure import linear_effects

STRIP = Strip()
CASES = {
    "clearance": [(place(STRIP, 4), "clearance", {"stiffness": 6e3, "gap": 1e-3})],
    "cubic": [(place(STRIP, 2), "cubic_stiffness", {"coefficient": 1e8})],
    "coulomb": [(place(STRIP, 3, 6), "coulomb_friction", {"force": 1.0, "speed": 3e-3})],
    "quadratic": [(place(STRIP, 2), "quadratic_stiffness", {"coefficient": 5e4})],
    "spring": [(place(STRIP, 3), "ground_spring", {"stiffness": 3e3})],
    "none": [],
}


@cache
def records():
    return measure_many(STRIP, CASES, seconds=12.0, run_in=3.0)


@cache
def found(name):
    return diagnose_records(STRIP.idle(), records()[name])


def first(name):
    effect = found(name).effects[0]
    return effect.kind, [str(d) for d in effect.location], effect.values


def test_clearance_is_named_placed_and_sized():
    kind, location, values = first("clearance")
    assert (kind, location) == ("clearance", ["5+Z"])
    assert values["stiffness"] == pytest.approx(6e3, rel=0.01)
    assert values["gap"] == pytest.approx(1e-3, rel=0.02)
    assert found("clearance").verdict == "explained"
    assert len(found("clearance").effects) == 1


def test_cubic_stiffness_is_named_placed_and_sized():
    kind, location, values = first("cubic")
    assert (kind, location) == ("cubic_stiffness", ["3+Z"])
    assert values["coefficient"] == pytest.approx(1e8, rel=0.02)
    assert found("cubic").verdict == "explained"
    assert len(found("cubic").effects) == 1, "what the errors of the motion leave is no second law"


def test_dry_friction_between_two_points():
    kind, location, values = first("coulomb")
    assert kind == "coulomb_friction"
    assert sorted(location) == ["4+Z", "7+Z"]
    assert values["force"] == pytest.approx(1.0, rel=0.02)
    assert found("coulomb").verdict in ("explained", "partial")
    assert len(found("coulomb").effects) == 1


def test_a_linear_spring_stays_linear():
    kind, location, values = first("spring")
    assert (kind, location) == ("ground_spring", ["4+Z"])
    assert values["stiffness"] == pytest.approx(3e3, rel=0.01)
    assert found("spring").nonlinear == ()
    assert found("spring").verdict == "explained"


def test_nothing_hidden_nothing_found():
    assert found("none").verdict == "no_misfit"
    assert found("none").effects == ()


def test_the_ladder_falls_on_the_level_that_nothing_was_fitted_to():
    for name in ("clearance", "cubic", "spring"):
        before, after = found(name).ladder[:2]
        assert after["heldout_misfit"] < 0.01 * before["heldout_misfit"]
        assert after["heldout_error_db"] < 0.25 * before["heldout_error_db"]


def test_levels_are_compared_before_anything_is_named():
    assert found("cubic").detection.level_dependent
    assert found("coulomb").detection.level_dependent
    assert not found("spring").detection.level_dependent
    assert not found("none").detection.level_dependent


def test_levels_of_a_linear_structure_leave_the_same_share():
    assert 0.5 < measured_distortion(STRIP.idle(), records()["none"]) < 0.7 * FAINT


def test_what_few_lines_hold_says_little_about_the_level():
    """A spring the idle model lacks: the lines about one sharp resonance hold three times as much at one level (``SURELY``)."""
    assert measured_distortion(STRIP.idle(), records()["spring"]) < 1


def test_a_law_of_even_order_is_found_where_frfs_see_nothing():
    idle, own = STRIP.idle(), records()["quadratic"]
    assert measured_distortion(idle, own) > 2 * FAINT
    silent = Diagnosis("no_misfit", (), (), None, (), (), {}, None, ("check_frf",), {}, (), idle, None)
    effect = diagnose_levels(lambda: silent, idle, (), own).effects[0]
    assert (effect.kind, str(effect.location[0])) == ("quadratic_stiffness", "3+Z")
    assert effect.values["coefficient"] == pytest.approx(5e4, rel=0.02)
    assert diagnose_levels(lambda: silent, idle, (), records()["none"]) is silent


def test_one_level_alone_has_no_distortion_to_compare():
    assert measured_distortion(STRIP.idle(), records()["none"][:2]) is None


def test_the_document_is_plain_json():
    document = found("clearance").to_dict()
    assert json.loads(json.dumps(document, allow_nan=False))["schema"] == "operando/diagnosis/2"
    assert document["data"] == ["check_records"]
    (picture,) = document["picture"]["restoring_force"]
    assert picture["location"] == ["5+Z"]
    assert picture["goodness"] > 0.95
    assert len(picture["binned"]["force"]) == len(picture["binned"]["law"])


def test_a_clearance_is_stiffer_at_higher_levels_and_friction_damps_less():
    (rows,) = found("clearance").equivalents
    stiffness = [row.stiffness for row in rows]
    assert stiffness[0] < stiffness[-1] < 6e3
    damping = [row.damping for row in found("coulomb").equivalents[0]]
    assert damping[0] > 2 * damping[-1] > 0
    springs = linear_effects(found("clearance").effects[0], rows)
    assert {e.kind for e in springs} == {"ground_spring", "ground_damper"}


def test_the_closed_loop_follows_the_record_that_judges():
    for name in ("clearance", "cubic", "coulomb"):
        made = found(name).simulation
        assert made["gain_db"] > 8
        assert {r["name"] for r in made["records"]} == {r.name for r in records()[name] if "0.25" in r.name}
        figure = made["figure"]
        assert len(figure["time_s"]) == len(figure["measured"]) == len(figure["simulated"]) == len(figure["idle"])
        away = {k: np.std(np.subtract(figure[k], figure["measured"])) for k in ("idle", "simulated")}
        assert away["simulated"] < 0.5 * away["idle"]
    assert found("spring").simulation == {}


def test_a_place_and_kinds_can_be_asked_for():
    made = diagnose_records(STRIP.idle(), records()["cubic"], kinds=["clearance", "cubic_stiffness"], places=["3+Z", ("5+Z", "7+Z")])
    assert [e.kind for e in made.effects] == ["cubic_stiffness"]
    assert {c["kind"] for c in made.candidates} <= {"clearance", "cubic_stiffness", "ground_spring", "coupling_spring"}


def test_what_cannot_be_diagnosed_is_refused():
    with pytest.raises(MissingError):
        diagnose_records(STRIP.idle(), [])
    record = records()["none"][0]
    elsewhere = (replace(record.channels[0], dof=Dof(99, "Z", 1)), *record.channels[1:])
    with pytest.raises(DataError, match="not at a DOF"):
        diagnose_records(STRIP.idle(), [replace(record, channels=elsewhere)])
    with pytest.raises(DataError, match="no scale"):
        diagnose_records(replace(STRIP.idle(), scaling="unscaled"), [record])

"""What may be given to a diagnosis, and how what cannot be meant is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import operando
from operando.diagnosis.arguments import UNKNOWN_UNITS, validation_runs
from operando.errors import ConfigError, DataError, DofError, ObjectError

SHAPES = np.array([[0.85, 0.53], [0.53, -0.85]])
KNOWN = np.diag(np.repeat([1e-6, 1e-4], [2, 6]) ** 2)
IDLE = operando.ModalModel([12.0, 31.0], [0.01, 0.01], SHAPES, "1+Z, 2+Z", "unit_modal_mass", covariance=KNOWN)
RUNNING = operando.Model(IDLE).add("point_mass@2+Z=mass:0.1")
CHECK = RUNNING.frf(np.arange(5, 45, 0.2), variance=False)
OPERATING = replace(RUNNING.modes(), scaling="unscaled", covariance=np.diag(np.repeat([1e-6, 1e-4], [2, 10]) ** 2))


@pytest.mark.parametrize("check", [CHECK, [CHECK], operando.CheckRun("run 1", "20 N", CHECK)], ids=["frf", "list", "run"])
def test_frfs_are_a_validation_measurement(check):
    found = operando.diagnose(IDLE, check=check, kinds="point_mass")
    assert found.verdict == "explained"
    assert found.effects[0].values["mass"] == pytest.approx(0.1, rel=1e-3)


def test_frfs_are_named_by_their_file():
    assert [r.name for r in validation_runs([CHECK, replace(CHECK, name="run.uff")])] == ["check 1", "run.uff"]
    assert validation_runs(CHECK)[0].name == "check"
    with pytest.raises(ObjectError, match="check takes validation measurements, not ModalModel"):
        operando.diagnose(IDLE, check=IDLE)


def test_one_effect_by_hand_is_no_list_of_letters():
    assert operando.apply_effects(IDLE, "point_mass@2+Z", check=CHECK).effects[0].kind == "point_mass"
    with pytest.raises(ObjectError, match="effects are added, not int"):
        operando.apply_effects(IDLE, 3, check=CHECK)


def test_one_kind_is_no_list_of_letters():
    assert operando.diagnose(IDLE, operating=OPERATING, kinds="point_mass").effects[0].kind == "point_mass"
    for data in ({"check": CHECK}, {"operating": OPERATING}):
        with pytest.raises(ConfigError, match="unknown kind of effect 'point_mas'"):
            operando.diagnose(IDLE, kinds="point_mas", **data)


@pytest.mark.parametrize("data", [{"check": CHECK}, {"operating": OPERATING}], ids=["check", "operating"])
def test_locations_that_are_not_there(data):
    with pytest.raises(DofError, match="DOF 22\\+Z is not measured") as raised:
        operando.diagnose(IDLE, places=["22+Z"], **data)
    assert raised.value.hint.startswith("did you mean '2+Z'?")


@pytest.mark.parametrize("between", [{"gain": 1.0}, {"stiffness": -0.1}, {"stiffness": "little"}])
def test_differences_between_days_that_are_not_known(between):
    with pytest.raises(ConfigError, match="between: ") as raised:
        operando.diagnose(IDLE, check=CHECK, between=between)
    assert raised.value.hint
    with pytest.raises(ConfigError, match="between: "):
        operando.apply_effects(IDLE, "point_mass@2+Z", check=CHECK, between=between)


def test_bands_without_lines():
    said = "the band of 200 to 300 Hz holds 0 lines of the validation FRFs, which lie at 5 to 44.8 Hz"
    with pytest.raises(DataError, match=said):
        operando.diagnose(IDLE, check=CHECK, band=(200, 300))
    with pytest.raises(DataError, match=said):
        operando.apply_effects(IDLE, "point_mass@2+Z", check=CHECK, band=(200, 300))


def test_unknown_units_of_the_measurement_are_said():
    unknown = replace(CHECK, si=False)
    assert operando.diagnose(IDLE, check=unknown, kinds="point_mass").notes[0] == UNKNOWN_UNITS
    assert UNKNOWN_UNITS in operando.apply_effects(IDLE, "point_mass@2+Z", check=unknown).words
    assert UNKNOWN_UNITS not in operando.diagnose(IDLE, check=CHECK, kinds="point_mass").notes

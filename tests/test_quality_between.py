"""Checks between files: each injected fault is found and named, and good data stay silent."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

import measurements
from operando.data import FrequencyAxis, Frf, ModalModel
from operando.dof import Dof
from operando.quality import check_gains, check_record, check_shapes, check_states
from operando.quality.between import GAIN_DB, OPPOSITE, TREND
from operando.quality.record import DRIVEN

HZ = np.arange(5.0, 100.0, 0.5)
DOFS = tuple(Dof(i + 1, "Z") for i in range(4))


def frf(chain, refs=(0, 2)):
    return Frf(chain.accelerance(HZ, ref=refs), FrequencyAxis(HZ), DOFS, tuple(DOFS[r] for r in refs), "accelerance", name="check")


def model(chain, complex_=False):
    shapes = chain.phi.astype(complex) * np.exp(0.7j) if complex_ else chain.phi
    return ModalModel(chain.hz, np.full(4, 0.01), shapes, DOFS, "unscaled" if complex_ else "unit_modal_mass")


@pytest.fixture(scope="module")
def states():
    return frf(measurements.idle_chain()), frf(measurements.running_chain())


def test_thresholds_stand_clear_of_good_data_and_below_the_smallest_fault():
    assert 4 < GAIN_DB < 20 * np.log10(2)  # 4 dB: above all good pairs; a factor of 2: smallest amplifier step
    assert 0.68 < OPPOSITE < 1  # 0.68: largest share of opposite lines in good pairs
    assert 0.5 <= DRIVEN < 0.84  # 0.84: smallest of 28 good records of four structures and the example


def test_a_changed_structure_is_no_gain(states):
    assert check_gains(*states) == []
    assert check_gains(states[0], states[0]) == []
    finer = np.arange(5.0, 100.0, 0.3)
    chain = measurements.running_chain()
    other = Frf(chain.accelerance(finer, ref=(0,)), FrequencyAxis(finer), DOFS, DOFS[:1], "accelerance")
    assert check_gains(states[0], other, band=(10.0, 90.0)) == []


@pytest.mark.parametrize("factor", [2.0, 9.80665, 4.448, 1e-3])
def test_the_gain_of_one_sensor(states, factor):
    idle, check = states
    data = check.data.copy()
    data[1] *= factor
    (found,) = check_gains(idle, replace(check, data=data), "check/run1.uff")
    assert (found.kind, found.severity, found.dof, found.file) == ("gain_differs", "warning", "2+Z", "check/run1.uff")
    stated = float(re.search(r"\(([-+.0-9]+) dB\)", found.message)[1])
    assert stated == pytest.approx(20 * np.log10(factor), abs=1.5)
    assert "change of the structure" in found.consequence
    assert "[channels]" in found.action


@pytest.mark.parametrize(("part", "seen"), [(0.8, True), (1.2, False)])
def test_a_tail_over_low_frequencies_at_one_sensor_is_no_gain(states, part, seen):
    """A response that drifts away after a hit adds over 1/f: its ratio follows a line over log f; by ``TREND``."""
    idle, _ = states
    gain = 20 * np.log10(10.0)
    change = part * TREND * gain  # dB over the band, about the gain
    level = gain + change * (0.5 - np.log(HZ / HZ[0]) / np.log(HZ[-1] / HZ[0]))
    data = idle.data.copy()
    data[1] *= 10 ** (level / 20)
    assert [f.kind for f in check_gains(idle, replace(idle, data=data))] == (["gain_differs"] if seen else [])


def test_the_gain_of_a_force_is_one_finding(states):
    idle, check = states
    data = check.data.copy()
    data[:, 1] /= 4.448
    (found,) = check_gains(idle, replace(check, data=data))
    assert (found.kind, found.dof) == ("gain_differs", "3+Z")
    assert "force at 3+Z" in found.message


def test_the_polarity_of_one_sensor_whatever_the_label(states):
    idle, check = states
    data = check.data.copy()
    data[2] *= -1
    (found,) = check_gains(idle, replace(check, data=data))
    assert (found.kind, found.dof) == ("inverted", "3+Z")
    turned = replace(check, data=data, responses=(*DOFS[:2], Dof(3, "Z", -1), DOFS[3]))  # the label says so: no fault
    assert check_gains(idle, turned) == []


def pairs():
    return [(r, r) for r in range(4)]


def test_shapes_of_a_changed_structure_are_no_gain():
    idle, running = model(measurements.idle_chain()), model(measurements.running_chain(), complex_=True)
    assert check_shapes(idle, running, pairs()) == []
    assert check_shapes(idle, model(measurements.idle_chain(), complex_=True), pairs()) == []


@pytest.mark.parametrize(("factor", "kind"), [(3.0, "gain_differs"), (0.1, "gain_differs"), (-1.0, "inverted"), (-9.81, "gain_differs")])
def test_one_sensor_in_operation_has_another_gain_or_sense(factor, kind):
    from structures import Chain

    chain = Chain(n=8, mass=2.0, stiffness=1.2e5, zeta=0.01, seed=3)
    dofs = tuple(Dof(i + 1, "Z") for i in range(8))
    idle = ModalModel(chain.hz, np.full(8, 0.01), chain.phi, dofs, "unit_modal_mass")
    shapes = chain.phi.astype(complex) * np.exp(0.7j)
    shapes[4] *= factor
    (found,) = check_shapes(idle, replace(idle, shapes=shapes, scaling="unscaled"), [(r, r) for r in range(8)])
    assert (found.kind, found.dof) == (kind, "5+Z")
    assert ("opposite" in found.message) is (factor < 0)


@pytest.fixture(scope="module")
def record():
    return measurements.record(measurements.idle_chain(), [0], 5.0, 1, "run1")


def test_good_records_of_three_states_are_silent(record):
    running = measurements.record(measurements.running_chain(), [0], 5.0, 4, "check")
    operating = measurements.record(measurements.running_chain(), range(4), 5.0, 3, "operating", force_known=False)
    assert check_states({"idle": [record], "operating": [operating], "check": [running, running]}) == []
    assert {f.kind for r in (record, running) for f in check_record(r).findings} & {"force_unrelated", "unmeasured_excitation"} == set()


def test_rates_that_differ_between_states(record):
    (found,) = check_states({"idle": [record], "check": [replace(record, sampling_hz=128.0, name="slow")]})
    assert (found.kind, found.severity) == ("unequal_rate", "info")
    assert "[idle] 256 Hz, [check] 128 Hz" in found.message
    assert "64 Hz" in found.consequence
    mixed = check_states({"idle": [record, replace(record, sampling_hz=128.0, name="slow")]})
    assert [(f.kind, f.severity, f.file) for f in mixed if f.kind == "unequal_rate"] == [("unequal_rate", "warning", "slow")]


def test_units_known_in_some_files_only(record):
    channels = tuple(replace(c, unit="") if c.name == "acc2" else c for c in record.channels)
    (found,) = check_states({"idle": [record], "check": [replace(record, channels=channels, name="check")]})
    assert (found.kind, found.file, found.dof) == ("unit_differs", "check", "2Z")
    assert "[units]" in found.action


def test_quantities_that_differ(record):
    channels = tuple(replace(c, quantity="velocity", unit="m/s") if c.name == "acc2" else c for c in record.channels)
    (found,) = check_states({"idle": [record], "check": [replace(record, channels=channels, name="check")]})
    assert (found.kind, found.dof) == ("quantity_differs", "2Z")
    assert "acceleration in run1 and velocity in check" in found.message


def test_a_force_of_another_run(record):
    data = record.data.copy()
    data[0] = measurements.record(measurements.idle_chain(), [0], 5.0, 77, "other").data[0]
    (found,) = [f for f in check_record(replace(record, data=data)).findings if f.kind == "force_unrelated"]
    assert (found.severity, found.dof) == ("error", "1+Z")
    assert "same run" in found.action


def test_responses_driven_by_something_else_as_well(record):
    other = measurements.record(measurements.idle_chain(), [1], 12.0, 55, "other").data[1:]
    data = record.data.copy()
    data[1:] += other
    (found,) = [f for f in check_record(replace(record, data=data)).findings if f.kind == "unmeasured_excitation"]
    assert found.severity == "warning"
    assert "follows the force" in found.message

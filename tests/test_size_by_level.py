"""Whether the size of an effect found in FRFs of several levels is the same at each."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from operando.data import ModalModel
from operando.diagnosis import from_records, records_and_days
from operando.diagnosis.criteria import LEVEL_CHANGE, UNUSUAL
from operando.diagnosis.result import Diagnosis
from operando.diagnosis.size_by_level import SizeByLevel, sizes_by_level
from operando.dof import Dof
from operando.errors import DataError
from operando.structure import Model
from operando.structure.effects import Effect
from structures import Chain, modified
from test_frf_estimate import FS, make_record

BAND = (10.0, 160.0)
SPRING = Effect("ground_spring", (Dof(2, "Z"),), {"stiffness": 2000.0}, {"stiffness": 20.0})
IDLE = Chain(4)


def model() -> Model:
    labels = ", ".join(f"{i}+Z" for i in range(1, 5))
    return Model(ModalModel(IDLE.hz, IDLE.zeta, IDLE.phi, labels, scaling="unit_modal_mass"), (SPRING,))


def records(stiffness_low: float, stiffness_high: float, gain: float = 1.0):
    """Random forces at the first mass, of 1 and 4 N, while a spring of some size holds the second one."""
    rng, n = np.random.default_rng(3), 40 * FS
    out = []
    for level, stiffness in ((1.0, stiffness_low), (4.0, stiffness_high)):
        chain = modified(IDLE, spring=(1, stiffness), zeta=IDLE.zeta)
        force = np.zeros((4, int(n)))
        force[0] = level * rng.standard_normal(int(n))
        acceleration = chain.respond(force, FS)
        noise = 1e-3 * acceleration.std(axis=1, keepdims=True) * rng.standard_normal(acceleration.shape)
        out.append(make_record(force[:1] * (gain if level > 1 else 1.0), acceleration + noise, FS, [1], name=f"run at {level} N"))
    return out


@pytest.mark.parametrize(("high", "gain"), [(2000.0, 1.0), (3000.0, 1.0), (2000.0, 1.05)])
def test_a_size_is_compared_between_levels_beside_gains_of_the_forces(high, gain):
    [row] = sizes_by_level(model(), records(2000.0, high, gain), BAND)
    assert row.effect is SPRING
    assert row.levels == pytest.approx((1.0, 4.0 * gain), rel=0.02)
    assert abs(row.change - (high / 2000.0 - 1)) < max(4 * row.std, 0.02)
    assert row.changes == (high != 2000.0)
    assert "ground spring at 2+Z changes by" in str(row)


def test_nothing_is_compared_with_one_level_or_without_a_size():
    low, high = records(2000.0, 2000.0)
    assert sizes_by_level(model(), [low], BAND) == []
    assert sizes_by_level(Model(model().idle), [low, high], BAND) == []


def test_a_size_is_another_one_by_more_than_its_noise_and_than_a_share_of_it():
    """``LEVEL_CHANGE``, and ``UNUSUAL`` standard deviations."""
    for change, std, changes in (
        (1.1 * LEVEL_CHANGE, 0.001, True),
        (0.9 * LEVEL_CHANGE, 0.001, False),
        (-0.5, 0.9 * 0.5 / UNUSUAL, True),
        (-0.5, 1.1 * 0.5 / UNUSUAL, False),
    ):
        assert SizeByLevel(SPRING, (1.0, 4.0), change, std).changes == changes


@pytest.mark.parametrize("records_give", ["nothing", "cubic", "fails"])
def test_an_effect_whose_size_changes_with_the_level_is_looked_for_in_the_records(records_give, monkeypatch):
    """Where FRFs of all levels agree within their noise: what the records name, or no more than ``partial``."""
    found = Diagnosis("explained", (SPRING,), (), None, (), (), {}, None, model=model())
    row = SizeByLevel(SPRING, (1.0, 4.0), 0.5, 0.03)
    seen = SimpleNamespace(nonlinear=records_give == "cubic", verdict="explained", ladder=({"heldout_misfit": 1.0},))

    def look(*args, **how):
        if records_give == "fails":
            raise DataError("too short")
        return seen

    monkeypatch.setattr(records_and_days, "diagnose_records", look)
    monkeypatch.setattr(from_records, "measured_distortion", lambda *args: None)
    monkeypatch.setattr(from_records, "sizes_by_level", lambda *args: [row])
    monkeypatch.setattr(from_records, "merged", lambda seen, *rest: (seen, rest[-1]))
    monkeypatch.setattr(from_records, "with_days", lambda seen, *rest, **options: seen)
    out = from_records.diagnose_levels(lambda: found, model().idle, [], [])
    if records_give == "cubic":
        assert out == (seen, (str(row),))
        return
    assert out.verdict == "partial"
    assert str(row) in out.reason
    assert any(str(row) in note for note in out.notes)
    monkeypatch.setattr(from_records, "sizes_by_level", lambda *args: [replace(row, change=0.01)])
    assert from_records.diagnose_levels(lambda: found, model().idle, [], []) is found


def test_that_levels_could_not_be_compared_is_a_note(monkeypatch):
    found = Diagnosis("explained", (SPRING,), (), None, (), (), {}, None, model=model())

    def none(*args):
        raise DataError("too short")

    monkeypatch.setattr(from_records, "measured_distortion", lambda *args: None)
    monkeypatch.setattr(from_records, "sizes_by_level", none)
    out = from_records.diagnose_levels(lambda: found, model().idle, [], [])
    assert out.verdict == "explained"
    assert out.notes == ("sizes of effects were not compared between levels: too short",)

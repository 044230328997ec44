"""The motion across a place: at the ends of a record, below the band, and under laws that no structure could bear."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from nonlinear_truth import Strip, measure_many, place
from operando.compare.verdict import GOOD
from operando.data import ModalModel, TimeRecord
from operando.diagnosis import diagnose_records
from operando.diagnosis.records import (
    DISCREPANCY,
    Detection,
    SearchStep,
    Sets,
    Tried,
    conclude,
    contradicted,
    examine,
    linear_law,
    make_case,
    rank_places,
    too_fast,
    weighed,
)
from operando.diagnosis.records.conclude import is_allowed
from operando.diagnosis.records.hold_out import Discrepancy
from operando.structure import ForceLaw
from operando.structure.effects import Effect

spot_module, conclude_module = (sys.modules[f"operando.diagnosis.records.{name}"] for name in ("spot", "conclude"))
STRIP = Strip(seed=3)
STIFFNESS, GAP = 8e3, 6e-4


@cache
def records():
    hidden = [(place(STRIP, 4), "one_sided_contact", {"stiffness": STIFFNESS, "gap": GAP})]
    return measure_many(STRIP, {"contact": hidden}, seconds=12.0, run_in=3.0)["contact"]


@cache
def case():
    first = make_case(STRIP.idle(), records())
    return weighed(first, (4,))


@cache
def spot():
    return examine(Sets.of(case()), (4,))


def with_low_residuals(idle: ModalModel, size: float) -> ModalModel:
    """Residual modes far below the band, as an identification may leave them: hardly anything in the band."""
    rng = np.random.default_rng(5)
    low = np.array([0.07, 0.07, 2.0])
    shapes = size * rng.standard_normal((idle.shapes.shape[0], 3))
    return idle.with_terms(
        frequencies_hz=np.append(idle.terms.frequencies_hz, low),
        damping_ratios=np.append(idle.terms.damping_ratios, np.full(3, 0.01)),
        shapes=np.concatenate([idle.terms.shapes, shapes], axis=1),
    )


@pytest.mark.parametrize("coefficient", [1e13, 1e40, 1e200])
def test_a_law_that_runs_away_leaves_the_last_motion_that_can_be(coefficient):
    law = ForceLaw("cubic_stiffness", {"coefficient": coefficient})
    moved = spot().settled(law)
    for before, after in zip(spot().whole, moved.whole, strict=True):
        assert np.all(np.isfinite(after.x))
        assert np.all(np.isfinite(after.v))
        assert after.x.std() < 2 * before.x.std()


def test_the_motion_settles_under_the_law_that_acts():
    law = ForceLaw("one_sided_contact", {"stiffness": STIFFNESS, "gap": GAP})
    once = spot().settled(law)
    again = once.settled(law)
    for one, two in zip(once.whole, again.whole, strict=True):
        assert np.std(one.x - two.x) < 0.01 * np.std(one.x)
        assert one.x.mean() < 0, "a stop on one side pushes the mean to the other"


def test_the_ends_of_a_motion_are_no_larger_than_the_rest():
    crossing = spot().whole[0].crossing
    motion = np.sin(0.1 * np.arange(spot().whole[0].x.size))
    spoilt = motion.copy()
    spoilt[:3], spoilt[-2:], spoilt[5000] = 20.0, -30.0, 1.5
    mended = crossing.within(spoilt)
    assert np.max(np.abs(mended)) == 1.5
    inside = slice(3, -2)
    assert np.array_equal(mended[inside], spoilt[inside])


def test_residual_modes_far_below_the_band_say_nothing_there():
    idle = with_low_residuals(STRIP.idle(), 0.02)
    found = diagnose_records(idle, records(), places=["5+Z", "3+Z"])
    effect = found.effects[0]
    assert (effect.kind, str(effect.location[0])) == ("one_sided_contact", "5+Z")
    assert effect.values["stiffness"] == pytest.approx(STIFFNESS, rel=0.02)
    assert effect.values["gap"] == pytest.approx(GAP, rel=0.02)
    assert found.simulation["gain_db"] > 15


def moved_as(idle: ModalModel, record: TimeRecord) -> TimeRecord:
    """The record with the responses that the model makes of its force."""
    hz = np.fft.rfftfreq(record.n_samples, 1 / record.sampling_hz)
    force = record.data[record.force_indices[0]]
    frf = idle.frf(hz, idle.dofs, [record.channels[record.force_indices[0]].dof], "accelerance").data[:, 0]
    noise = 0.02 * np.random.default_rng(2).standard_normal((frf.shape[0], record.n_samples))
    moved = np.fft.irfft(np.nan_to_num(frf) * np.fft.rfft(force), record.n_samples)
    return replace(record, data=np.vstack([force, moved + noise]))


def test_residual_modes_that_carry_the_structure_count():
    b = place(STRIP, 4)
    for size in (2.0, 0.02):
        idle = with_low_residuals(STRIP.idle(), size)
        stands = make_case(idle, records()[:2]).modes
        assert np.any(stands.spurious(b, 5.0))
        assert np.any(replace(stands, grounded=False).spurious(b, 5.0)) == (size < 1)
    floats = with_low_residuals(STRIP.idle(), 2.0)
    assert not np.any(make_case(floats, [moved_as(floats, r) for r in records()[:2]]).modes.spurious(b, 5.0))


def test_lines_below_the_band_say_whether_the_structure_stands(monkeypatch):
    """``SURE_Z`` standard errors of the lines down to ``LOWEST`` decide; where both predictions are alike there is nothing to decide."""
    false = with_low_residuals(STRIP.idle(), 2.0)
    case = make_case(false, records()[:2])
    assert case.modes.grounded
    assert contradicted(case.runs, case.modes)
    true = make_case(STRIP.idle(), records()[:2])
    assert not true.modes.grounded
    floats = make_case(false, [moved_as(false, r) for r in records()[:2]])
    assert not contradicted(floats.runs, floats.modes)
    limits = "operando.diagnosis.records.case."
    for name, value in (("SURE_Z", 1e6), ("LOWEST", 1.0)):  # surer than any lines can be, and without a line
        with monkeypatch.context() as other:
            other.setattr(limits + name, value)
            assert not contradicted(case.runs, case.modes)
    monkeypatch.setattr(limits + "SURE_Z", -1e6)
    assert contradicted(floats.runs, floats.modes)


def test_the_best_linear_law_is_bounded_where_bands_have_no_fitted_lines():
    """The linear force of a spring is found in bands without fitted lines, too."""
    whole = spot()
    spring = ForceLaw("ground_spring", {"stiffness": 500.0})

    def sprung(motions):
        out = []
        for m in motions:
            error = m.along.weighted.with_error(-m.along.h * m.under(spring))
            along = replace(m.along, weighted=error)
            out.append(replace(m, along=along.on(error, slice(None))))
        return out

    fit, select = sprung(whole.fit), sprung(whole.select)
    none = sum(m.along.weighted.total for m in select)
    assert linear_law(fit, select) < 0.01 * none


def test_places_are_compared_with_what_lies_outside_the_band():
    bare = make_case(STRIP.idle(residual=False), records())
    assert rank_places(bare, bare.places)[0][1] == (4,)


@pytest.mark.parametrize(("lines", "knots"), [(600, 9), (300, 9), (600, 5), (600, 17)])
def test_places_are_compared_alike_with_fewer_lines_and_other_pieces(monkeypatch, lines, knots):
    """RANK_LINES and RANK_KNOTS: half the lines, half or twice the pieces leave the location the first by as much."""
    bare = make_case(STRIP.idle(), records())
    assert (spot_module.RANK_LINES, spot_module.RANK_KNOTS) == (600, 9)
    monkeypatch.setattr(spot_module, "RANK_LINES", lines)
    monkeypatch.setattr(spot_module, "RANK_KNOTS", knots)
    (left, best), (second, _) = rank_places(bare, bare.places)[:2]
    assert best == (4,)
    assert left < 0.9 * second


@pytest.mark.parametrize(("gap", "allowed"), [(5.5e-3, True), (4.5e-3, False)])
def test_where_the_hold_out_set_leaves_a_gap_open_the_louder_runs_speak(monkeypatch, gap, allowed):
    """As in frame 10425. At 4.5 mm the gap is closed so often that 3.3 is left of the louder runs with the discrepancy that is allowed."""
    asked, verdict_of = [], conclude_module.verdict_of

    def spied(validation, within, **options):
        asked.append((validation, within))
        return verdict_of(validation, within=within, **options)

    monkeypatch.setattr(conclude_module, "verdict_of", spied)
    hidden = [(place(STRIP, 4), "clearance", {"stiffness": STIFFNESS, "gap": gap})]
    open_below = measure_many(STRIP, {"contact": hidden}, seconds=12.0, run_in=3.0)["contact"]
    places = [(STRIP.idle().dofs[i],) for i in range(8)]
    made = diagnose_records(STRIP.idle(), open_below, kinds=["clearance", "ground_spring", "one_sided_contact"], places=places)
    validation, within = asked[0]
    assert [e.kind for e in made.effects] == ["clearance"]
    assert validation[0] < 1.2
    assert within == allowed


def faster(motion, part, hz=235.0):
    """The same motion with a tone near the end of the recorded band, of a part of its rms, added."""
    t = motion.step * np.arange(motion.x.size)
    tone = part * motion.x.std() * np.sqrt(2)
    w = 2 * np.pi * hz
    return replace(motion, x=motion.x + tone * np.cos(w * t), v=motion.v - w * tone * np.sin(w * t), made={})


def test_motion_at_the_end_of_the_recorded_band_counts_where_a_law_has_a_knee():
    contact = ForceLaw("one_sided_contact", {"stiffness": STIFFNESS, "gap": GAP})
    spring = ForceLaw("ground_spring", {"stiffness": STIFFNESS})
    motion = spot().whole[0]
    change = [faster(motion, part).without_fastest(contact, 0.8) for part in (0.0, 0.3, 1.0)]
    assert 2 * change[0] < change[1] < change[2]
    assert faster(motion, 1.0).without_fastest(spring, 0.8) < 1e-2 * change[2], "a linear law mixes no frequencies"


def test_records_too_slow_for_the_motion_are_said_to_be():
    effect = Effect("one_sided_contact", ("5+Z",), {"stiffness": STIFFNESS, "gap": GAP})
    law = ForceLaw("one_sided_contact", dict(effect.values))
    quick = replace(spot(), whole=tuple(faster(m, 1.0) for m in spot().whole))
    (note,) = too_fast([effect], [Tried(quick, law, 5.0, 5.0)], 2, 5.0)
    assert "7.0 dB above the floor" in note
    assert "record at 2048 samples a second or more" in note
    assert too_fast([effect], [Tried(quick, law, 1.5, 1.5)], 2, 1.5) == [], "nothing is left to explain"
    assert too_fast([effect], [Tried(spot(), law, 5.0, 5.0)], 2, 5.0) == [], "what is left has another reason"


@pytest.mark.parametrize(("stiffer", "verdict"), [(1.03, "explained"), (1.06, "partial")])
def test_a_law_may_leave_so_much_of_the_responses_beyond_the_noise(stiffer, verdict):
    """DISCREPANCY: a contact taken for too stiff leaves 2.1 and 3.2 %, with 26 and 72 times the chi-square that noise allows."""
    law = ForceLaw("one_sided_contact", {"stiffness": STIFFNESS, "gap": GAP})
    moved = spot().settled(law).settled(law)
    tried = Tried(moved, law.moved(stiffness=stiffer * STIFFNESS), 1.2, 1.2)
    found = conclude(case(), [SearchStep(case(), tried.spot.place, 50.0, 50.0, [tried])], [tried], None, Detection(), None)
    assert found.verdict == verdict
    assert found.ladder[-1]["heldout_misfit"] > 10 * GOOD
    assert (found.discrepancy["value"] <= DISCREPANCY) == (verdict == "explained")
    assert DISCREPANCY / 2 < found.discrepancy["value"] < 1.5 * DISCREPANCY


@pytest.mark.parametrize(
    ("idle", "left", "allowed"), [(1.4, 1.4, False), (1.6, 1.4, True), (1.4, 0.27, True), (1.4, 0.29, False), (9.0, 1.6, False)]
)
def test_what_the_idle_model_may_be_off_by_as_well_is_no_ground(idle, left, allowed):
    """With DISCREPANCY allowed, chi-squares of so much, and without it ten times as much: GOOD and PARTLY."""
    level = np.full((2, 40), (3.0 / DISCREPANCY) ** 2)  # what is allowed is three times the noise

    def leaves(chi_square):
        return Discrepancy([np.full((2, 40), 10 * chi_square)], [level], [np.zeros(40, int)])

    assert is_allowed(leaves(left), leaves(idle)) == allowed


def test_where_no_sensor_is_a_location_comes_last():
    bare = make_case(STRIP.idle(), records())
    run = bare.fitted[0]
    blind = [replace(r, rows=r.rows[1:], responses=r.responses[1:], error=r.error[1:], variance=r.variance[1:], own=r.own[1:],
             shapes=r.shapes[1:], nuisance_shapes=r.nuisance_shapes[1:], beside=r.beside[1:]) for r in bare.runs]  # fmt: skip
    ranked = rank_places(bare.with_runs(blind), [(int(run.rows[0]),), (4,)])
    assert [place for _, place in ranked] == [(4,), (int(run.rows[0]),)]
    assert ranked[1][0] == np.inf

"""When the diagnosis turns from FRFs to records, and what it says then."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from operando.diagnosis import another_day, by_hand, diagnose, from_records, records_and_days
from operando.diagnosis.criteria import EXPLAINED
from operando.diagnosis.from_records import standing
from operando.diagnosis.records import Detection, FoundLaws, beside_others, diagnose_records, steps
from operando.diagnosis.suspicion import DISTORTION, FAINT, LOUDEST, beyond_rest, suspicion, suspicion_at
from operando.dof import Dof
from operando.errors import DataError
from operando.frf import estimate_frf
from operando.pipeline.levels import check_frfs
from operando.results import CheckRun
from operando.structure import ForceLaw, LinearEquivalent, Model
from operando.structure.effects import Effect, parse_effect
from test_nonlinear_records import STRIP, records

SHARED = Path(__file__).resolve().parents[1].parent / "shared"
BAND = (5.0, 95.0)


@cache
def frfs(name):
    return tuple(check_frfs(records()[name], lambda part: estimate_frf(part, estimator="lrm")))


@cache
def at_rest():
    return estimate_frf(records()["none"], estimator="lrm")


@cache
def found(name):
    return diagnose(
        STRIP.idle(),
        check=list(frfs(name)),
        records=records()[name],
        idle_frf=at_rest(),
        band=BAND,
        kinds=["ground_spring", "clearance", "cubic_stiffness", "coulomb_friction"],
    )


def test_levels_that_disagree_are_suspicious():
    assert "level" in suspicion(frfs("clearance"))
    assert suspicion(frfs("spring"), at_rest()) is None
    assert suspicion(frfs("none"), at_rest()) is None


def test_distortion_is_suspicious_even_where_levels_agree():
    (run,) = frfs("none")
    loud = type(run)(run.name, run.level, type(run.frf)(**{**run.frf.__dict__, "variance": 3 * DISTORTION * run.frf.variance}))
    assert "proportional" in suspicion([loud], at_rest())
    assert suspicion([loud]) is None


def test_distortion_at_some_responses_is_suspicious_and_at_one_it_is_not():
    (run,) = frfs("none")
    assert len(run.frf.responses) == 8
    loudest = int((1 - LOUDEST) * 8)
    for count, suspicious in ((loudest + 1, True), (loudest - 1, False)):
        factor = np.ones((8, 1, 1))
        factor[:count] = 4 * DISTORTION
        loud = replace(run, frf=replace(run.frf, variance=factor * run.frf.variance))
        assert (suspicion([loud], at_rest()) is not None) == suspicious


@pytest.mark.parametrize(
    ("share", "kind", "suspicious"), [(1.1, "ground_spring", True), (0.9, "ground_spring", False), (1.1, "sensor_gain", False)]
)
def test_distortion_at_the_location_of_an_effect_is_suspicious(share, kind, suspicious):
    """A bilinear stiffness has the FRFs of a spring at all levels; what it adds beside is largest where it is (frame 10206)."""
    (run,) = frfs("spring")
    dof = run.frf.responses[2]
    factor = np.ones((8, 1, 1))
    factor[2] = share * DISTORTION / beyond_rest([run], at_rest())[0][dof.key]
    loud = replace(run, frf=replace(run.frf, variance=factor * run.frf.variance))
    assert suspicion([loud], at_rest()) is None
    here, elsewhere = (
        Effect(kind, (str(d),), {"stiffness" if kind == "ground_spring" else "gain": 1.1}) for d in (dof, run.frf.responses[5])
    )
    said = suspicion_at([here], [loud], at_rest())
    assert (said is not None) == suspicious
    assert said is None or f"the response at {dof} holds" in said
    assert suspicion_at([elsewhere], [loud], at_rest()) is None
    assert suspicion_at([here], [loud]) is None


@pytest.mark.parametrize("nonlinear", [True, False])
def test_where_the_location_of_an_effect_is_distorted_the_records_are_looked_at(monkeypatch, nonlinear):
    linear, seen = (
        found("spring"),
        SimpleNamespace(nonlinear=("bilinear_stiffness",) * nonlinear, effects=(), equivalents=(), verdict="partial"),
    )
    monkeypatch.setattr(records_and_days, "day_of", lambda *a, **k: None)
    monkeypatch.setattr(from_records, "suspicion", lambda check, idle_frf: None)
    monkeypatch.setattr(from_records, "suspicion_at", lambda effects, check, idle_frf: "the response at 4+Z holds 5 times as much")
    monkeypatch.setattr(records_and_days, "diagnose_records", lambda *a, **k: seen)
    monkeypatch.setattr(from_records, "merged", lambda seen, *rest: seen)
    monkeypatch.setattr(from_records, "with_days", lambda seen, *rest, **options: seen)
    made = from_records.diagnose_levels(lambda: linear, STRIP.idle(), frfs("spring"), records()["spring"])
    if nonlinear:
        assert made is seen
    else:
        assert (made.verdict, made.effects) == (linear.verdict, linear.effects)
        assert any("4+Z holds 5 times" in note and "no level-dependent effect" in note for note in made.notes)


@pytest.mark.parametrize(
    ("name", "rest", "share", "looked"),
    [("none", True, 0.9, False), ("none", True, 1.1, True), ("none", False, 0.9, True), ("quadratic", True, None, True)],
)
def test_records_in_which_nothing_depends_on_the_level_are_not_searched_for_a_law(monkeypatch, name, rest, share, looked):
    """Levels agree in FRFs, and in what is not proportional to the force up to ``FAINT``; that is also held against the idle FRFs."""
    looks = []
    seen = SimpleNamespace(nonlinear=(), effects=(), equivalents=(), verdict="no_misfit", ladder=({"heldout_misfit": 1.0},))
    monkeypatch.setattr(records_and_days, "diagnose_records", lambda *a, **k: looks.append(1) or seen)
    monkeypatch.setattr(from_records, "suspicion", lambda check, idle_frf: None)
    monkeypatch.setattr(records_and_days, "day_of", lambda *a, **k: None)
    if share is not None:
        monkeypatch.setattr(from_records, "measured_distortion", lambda *a: share * FAINT)
    linear = replace(found("spring"), verdict="unexplained", effects=(), model=None)
    idle_frf = at_rest() if rest else None
    made = from_records.diagnose_levels(lambda: linear, STRIP.idle(), frfs("spring"), records()[name], idle_frf=idle_frf)
    assert (made.verdict, made.effects) == ("unexplained", ())
    assert bool(looks) is looked
    assert any("at least" in note for note in made.notes) == (share != 0.9)


@pytest.mark.parametrize(("count", "share", "looked"), [(1, 1.5, False), (2, 1.5, True), (2, 0.9, False)])
def test_records_are_searched_where_two_responses_hold_more_than_at_rest(monkeypatch, count, share, looked):
    """Linear effects explain nothing, and levels agree; what one response alone holds is its sensor's (``DISTORTION``)."""
    looks = []
    seen = SimpleNamespace(nonlinear=(), effects=(), equivalents=(), verdict="no_misfit", detection=Detection(location=("3+Z",)))
    monkeypatch.setattr(records_and_days, "diagnose_records", lambda *a, **k: looks.append(1) or seen)
    monkeypatch.setattr(records_and_days, "day_of", lambda *a, **k: None)
    monkeypatch.setattr(from_records, "measured_distortion", lambda *a: 1.0)
    (run,) = frfs("none")
    keys = [dof.key for dof in run.frf.responses]
    factor = np.ones((len(keys), 1, 1))
    factor[:count, 0, 0] = [share * DISTORTION / beyond_rest([run], at_rest())[0][key] for key in keys[:count]]
    loud = replace(run, frf=replace(run.frf, variance=factor * run.frf.variance))
    assert suspicion([loud], at_rest()) is None
    linear = replace(found("spring"), verdict="unexplained", effects=(), model=None)
    from_records.diagnose_levels(lambda: linear, STRIP.idle(), [loud], records()["none"], idle_frf=at_rest())
    assert bool(looks) is looked


def test_a_clearance_is_found_from_the_records():
    made = found("clearance")
    assert [e.kind for e in made.effects] == ["clearance"]
    assert made.data == ("check_frf", "check_records")
    assert made.verdict == "explained"
    assert {row["dof"] for row in made.where["by_dof"]} == {str(d) for d in STRIP.idle().dofs}
    document = json.loads(json.dumps(made.to_dict(), allow_nan=False))
    assert document["picture"]["restoring_force"][0]["kind"] == "clearance"
    assert document["detection"]["level_dependent"]


def test_the_linear_model_holds_the_equivalent_of_a_clearance():
    made = found("clearance")
    assert {e.kind for e in made.model.effects} == {"ground_spring", "ground_damper"}
    again = standing(json.loads(json.dumps(made.to_dict())))
    assert [e.kind for e in again] == [e.kind for e in made.model.effects]
    lowest = next(run.frf for run in frfs("clearance"))
    hz = lowest.frequencies_hz
    inside = (hz > BAND[0]) & (hz < BAND[1])
    with_it = made.model.frf(hz[inside], lowest.responses, lowest.references, "accelerance", variance=False).data
    without = STRIP.idle().frf(hz[inside], lowest.responses, lowest.references, "accelerance", variance=False).data
    measured = lowest.data[:, :, inside]
    assert np.linalg.norm(with_it - measured) < 0.7 * np.linalg.norm(without - measured)


def test_a_linear_spring_is_left_to_the_frfs():
    made = found("spring")
    assert made.data == ("check_frf",)
    assert [e.kind for e in made.effects] == ["ground_spring"]


def test_records_alone_will_do():
    made = diagnose(STRIP.idle(), records=records()["cubic"], kinds=["cubic_stiffness"], places=["3+Z"])
    assert made.data == ("check_records",)
    assert [e.kind for e in made.effects] == ["cubic_stiffness"]


@pytest.mark.slow
@pytest.mark.skipif(not (SHARED / "cases" / "p2").is_dir(), reason="the practice cases are not here")
def test_the_practice_case_with_a_clearance_from_raw_files(tmp_path):
    from operando.pipeline import run

    results = run(SHARED / "cases" / "p2" / "test.toml", tmp_path)
    (effect,) = results.diagnosis["effects"]
    assert (effect["kind"], effect["location"]) == ("clearance", ["546+Z"])
    assert effect["parameters"]["stiffness"]["value"] == pytest.approx(25_000, rel=0.05)
    assert effect["parameters"]["gap"]["value"] == pytest.approx(4e-4, rel=0.03)
    assert results.diagnosis["verdict"] == "explained"
    assert (tmp_path / "ofrf_effect.uff").is_file()
    assert not [f for f in results.findings if f.severity == "error"]


@pytest.mark.parametrize(("left", "levels", "verdict"), [(0.8, False, "explained"), (0.8, True, "partial")])
def test_more_noise_than_at_rest_does_not_belittle_a_linear_effect(monkeypatch, left, levels, verdict):
    """Where the records show nothing that depends on the level, what the linear effect leaves decides."""
    linear = found("spring")  # before anything is patched: it is made once for all tests
    assert linear.verdict == "explained"
    said = "runs of different level disagree" if levels else "the responses hold more than at rest"
    monkeypatch.setattr(from_records, "suspicion", lambda check, idle_frf: said)
    monkeypatch.setattr(from_records, "levels_disagree", lambda check: levels)
    monkeypatch.setattr(
        records_and_days,
        "diagnose_records",
        lambda *a, **k: SimpleNamespace(nonlinear=(), effects=(), equivalents=(), verdict="unexplained"),
    )
    monkeypatch.setattr(records_and_days, "day_of", lambda *a, **k: None)
    ladder = (*linear.ladder[:-1], {**linear.ladder[-1], "heldout_misfit": left})
    made = from_records.diagnose_levels(lambda: replace(linear, ladder=ladder), STRIP.idle(), frfs("spring"), records()["spring"])
    assert made.verdict == verdict
    assert any(said in note for note in made.notes)


@pytest.mark.parametrize(
    ("of_laws", "left", "free", "at_first", "tried"),
    [
        ((3,), 20.0, 1.0, 1.0, True),
        ((1, 3), 20.0, 1.0, 1.0, True),
        ((1, 3), 1.1 * steps.FLOOR * 0.3, 0.3, 1.0, True),
        ((1, 3), 0.9 * steps.FLOOR * 0.3, 0.3, 1.0, False),
        ((1, 3), 381.0, 0.9, 0.9 * 381.0 / steps.NEARLY, True),
        ((1, 3), 381.0, 0.9, 1.1 * 381.0 / steps.NEARLY, False),
    ],
)
def test_hysteresis_is_tried_where_the_best_law_is_as_well(monkeypatch, of_laws, left, free, at_first, tried):
    """Any force explains most between two DOFs, the best law of one displacement is at the second: what remembers is tried at both.

    By ``FLOOR``, where any force leaves less than noise as well, and by ``NEARLY`` of what there was.
    """
    spots = {place: SimpleNamespace(place=place, free=free, fit=[], select=[], validation=[]) for place in ((1, 3), (3,))}
    laws, walked = {}, []

    def fit_law(motions, kind):
        walked.append(next(place for place, spot in spots.items() if spot.fit is motions))
        return steps.ForceLaw(kind, {}, 1.0)

    def settle_law(spot, law, turns=0):
        return steps.Tried(spot, law, left / 4 if law.kind == "hysteresis" else laws[spot.place], 1.0)

    def roughly(spot, kind, side):
        laws[spot.place] = left if spot.place == of_laws else 1.5 * left
        return laws[spot.place], spot, steps.ForceLaw(kind, {}, side)

    monkeypatch.setattr(steps, "rank_places", lambda case, places: [(1.0, (1, 3)), (1.01, (3,))])
    monkeypatch.setattr(steps, "Sets", SimpleNamespace(of=lambda case: None))
    monkeypatch.setattr(steps, "baseline", lambda sets: (100.0, 100.0))
    monkeypatch.setattr(steps, "examine", lambda sets, place: spots[place])
    monkeypatch.setattr(steps, "each", lambda do, rows: [do(row) for row in rows])
    for name, stub in (("fit_law", fit_law), ("settle_law", settle_law), ("roughly", roughly)):
        monkeypatch.setattr(steps, name, stub)
    case = SimpleNamespace(places=((1, 3), (3,)))
    made = steps.search_step(case, ("cubic_stiffness", "hysteresis"), None, at_first)
    assert set(walked) == ({(1, 3), of_laws} if tried else set())
    assert len(walked) == len(set(walked))
    assert (made.tried[0].law.kind == "hysteresis") == tried


def remounted(record, sensor, force):
    """The record as one sensor and all force sensors of other gains give it."""
    data = np.array(record.data, float)
    data[record.response_indices[2]] *= sensor
    data[list(record.force_indices)] *= force
    return replace(record, data=data)


def test_what_differs_between_the_days_is_stated_beside_a_clearance():
    """Of the FRFs at the highest level, with the mean spring and damper there."""
    measured = [remounted(r, 1.02, 0.99) for r in records()["clearance"]]
    runs = check_frfs(measured, lambda part: estimate_frf(part, estimator="lrm"))
    days = {"sensor_gain": 0.02, "force_gain": 0.01, "stiffness": 0.003, "damping": 0.1}
    options = {"band": BAND, "kinds": ["ground_spring", "clearance"], "places": ["5+Z", "2+Z"], "idle_frf": at_rest()}
    made = diagnose(STRIP.idle(), check=runs, records=measured, between=days, **options)
    assert [e.kind for e in made.effects] == ["clearance"]
    rows = {(row["what"], *row["location"]): row for row in made.to_dict()["between"]}
    true = {("sensor_gain", str(d)): 1.02 if k == 2 else 1.0 for k, d in enumerate(STRIP.idle().dofs)}
    true |= {("force_gain", "2+Z"): 0.99, ("force_gain", "6+Z"): 0.99, ("stiffness",): 0.0, ("damping",): 1.0}
    for key, value in true.items():
        assert abs(rows[key]["value"] - value) < 2.5 * rows[key]["std"], key
    assert rows["sensor_gain", "3+Z"]["value"] > 1 + 2 * rows["sensor_gain", "3+Z"]["std"]
    assert not any("what differs" in note for note in made.notes)


def test_where_frfs_do_not_tell_what_differs_it_is_said(monkeypatch):
    seen = found("clearance")
    assert seen.between is not None
    bare = replace(seen, between=None, notes=())
    of = partial(from_records.with_days, bare, STRIP.idle())
    assert of(()).notes == (
        "what differs between the two measurements is not known: it is estimated from FRFs of the validation "
        "measurement, and there are none",
    )
    for left, known in ((0.031, False), (0.029, True)):
        monkeypatch.setattr(from_records, "between_beside", lambda *a, left=left, **k: ((), left))
        made = of(frfs("clearance"))
        assert (made.between == ()) == known
        (note,) = made.notes
        assert note == from_records.UNTOUCHED if known else "3.1 % of the FRFs" in note


GAINS = 1 + 0.05 * np.random.default_rng(8).standard_normal(8)


def with_gains(name):
    out = []
    for record in records()[name]:
        data = np.array(record.data, float)
        data[list(record.response_indices)] *= GAINS[:, None]
        out.append(replace(record, data=data))
    return out


def test_a_day_shows_what_its_sensors_show(monkeypatch):
    idle = STRIP.idle()
    (run,) = check_frfs(with_gains("none"), lambda part: estimate_frf(part, estimator="lrm"))
    options = {"band": BAND, "geometry": None, "idle_frf": at_rest(), "between": {"sensor_gain": 0.05}}
    day = another_day.day_of(idle, (), run, **options)
    hz, rows = np.linspace(*BAND, 50), np.arange(8)
    wanted = GAINS[:, None] * idle.frf(hz, references=("2+Z",), quantity="accelerance", variance=False).data[:, 0]
    sensor, force = day.sensor_gains, day.force_gains[1]
    shown = day.seen(hz, rows, (1,))[:, :, 0].T * sensor[:, None] / force
    assert np.linalg.norm(shown - wanted) < 0.1 * np.linalg.norm(wanted - wanted / GAINS[:, None])
    ratio = (sensor[:, None] / force) / GAINS[:, None]
    assert np.abs(ratio - 1).max() < 0.01
    first = with_gains("none")[0]
    np.testing.assert_allclose(day.corrected(first).data[first.response_indices[0]] * sensor[0], first.data[first.response_indices[0]])
    assert day.seen(hz, rows, (0,)) is None
    with monkeypatch.context() as patch:  # residual terms of 7000 % ended the diagnosis (frame 10452)
        patch.setattr(another_day._Bare, "uncoupled", lambda self, moved: (moved.f, np.full_like(moved.zeta, 1.2), np.eye(day.modes.size)))
        assert another_day.day_of(idle, (), run, **options) is None
    # A law is another spring under each force, and the FRFs are fitted with one for all: each record finds the modes again.
    np.testing.assert_array_equal(day.covariance, another_day.usual_day(idle, options["between"]).covariance)
    assert another_day.day_of(idle, (), frfs("none")[0], **options | {"between": None}) is None


def test_a_day_is_found_with_all_effects_at_once(monkeypatch):
    """One after the other they end where they did, later, or farther off: residual terms damped by 7000 % (frame 10452)."""
    (run,) = check_frfs(with_gains("none"), lambda part: estimate_frf(part, estimator="lrm"))
    options = {"band": BAND, "geometry": None, "idle_frf": at_rest(), "between": {"sensor_gain": 0.05}}
    effects = [parse_effect("point_mass@5+Z=mass:0.001", BAND)]
    stepped, _ = by_hand.fitted_to(STRIP.idle(), effects, run, print, **options)
    monkeypatch.setattr(by_hand, "_steps", lambda *a: pytest.fail("one after the other"))
    direct = by_hand.fitted_at_once(STRIP.idle(), effects, run, print, may_strain=True, **options)
    assert len(stepped) == 2
    assert direct.terms[0].kind == "point_mass"
    assert direct.log_evidence == pytest.approx(stepped[-1].log_evidence, abs=1)
    monkeypatch.setattr(by_hand, "fitted_if_can_be", lambda *a: None)
    with pytest.raises(DataError, match="cannot be fitted") as refused:
        by_hand.fitted_at_once(STRIP.idle(), effects, run, print, **options)
    assert "point_mass at 5+Z" in refused.value.where


class DayOf(tuple):
    """A day by the words that tell it from others, of which nothing else is known."""

    between, unexplained = (), float("inf")


@pytest.mark.parametrize("another", [True, False])
def test_where_frfs_of_another_day_lead_to_no_law_the_day_is_left_open(monkeypatch, another):
    """FRFs of a structure with dry friction give a day that stands for the friction (rotor 10332 of the benchmark)."""
    law = found("clearance")
    monkeypatch.setattr(from_records, "with_days", lambda seen, *rest, **options: seen)
    monkeypatch.setattr(from_records, "merged", lambda seen, *rest: seen)
    monkeypatch.setattr(records_and_days, "day_of", lambda *a, **k: DayOf(("of FRFs",)) if another else None)
    monkeypatch.setattr(records_and_days, "usual_day", lambda idle, between: DayOf(("left open", between)))
    asked = []

    def looked(idle, records, day=None, **options):
        asked.append(day)
        now = law
        return now if day and day[0] == "left open" else replace(now, verdict="unexplained", effects=(), equivalents=(), notes=())

    monkeypatch.setattr(records_and_days, "diagnose_records", looked)
    made = from_records.diagnose_levels(None, STRIP.idle(), frfs("clearance"), ["run"], between={"damping": 0.2})
    assert asked[0] is None
    if another:  # beside nothing, at each location, again where a law was found, with all locations, and left open at last
        count = 3 + len(law.found.locations)
        assert asked[1:] == [("of FRFs",)] * count + [("left open", {"damping": 0.2})]
    else:
        assert asked == [None]
    assert made.verdict == ("explained" if another else "unexplained")
    assert any("may differ as between two days" in note for note in made.notes) == another


def test_a_day_that_hides_a_law_is_found_again_beside_spring_and_damper_where_it_acts(monkeypatch):
    """FRFs of the lowest level hold the mean spring and damper of a law, and a day beside nothing takes them (frame 10333)."""
    law = found("clearance")
    monkeypatch.setattr(from_records, "with_days", lambda seen, *rest, **options: seen)
    monkeypatch.setattr(from_records, "merged", lambda seen, *rest: seen)
    monkeypatch.setattr(records_and_days, "day_of", lambda idle, effects, *a, **k: DayOf(map(str, effects)))
    asked = []
    assert law.detection.location == ("5+Z",)

    def looked(idle, records, day=None, **options):
        asked.append(day)
        return law if day else replace(law, verdict="unexplained", effects=(), equivalents=(), notes=())

    monkeypatch.setattr(records_and_days, "diagnose_records", looked)
    made = from_records.diagnose_levels(None, STRIP.idle(), frfs("clearance"), ["run"])
    assert made.verdict == "explained"
    assert asked[:2] == [None, ()]
    assert [text.split("@")[0] for text in asked[2]] == ["ground_spring", "ground_damper"]
    assert all("5+Z" in text for text in asked[2])


def test_the_locations_that_are_looked_at_on_a_day_of_their_own():
    """OF_THEIR_OWN_DAY: that of any force, and so many of those where laws leave least, in this order."""
    tried = [SimpleNamespace(spot=SimpleNamespace(place=(row,))) for row in (4, 1, 1, 0, 2, 3)]
    case = SimpleNamespace(located=lambda place: tuple(STRIP.idle().dofs[i] for i in place))
    step = SimpleNamespace(place=(1,), tried=tried)
    law = sys.modules["operando.diagnosis.records.conclude"].found_laws(case, [], [], [], step, None)
    assert sys.modules["operando.diagnosis.records.conclude"].OF_THEIR_OWN_DAY == 3
    assert law.locations == tuple((STRIP.idle().dofs[row],) for row in (1, 4, 0))


def elsewhere(law, more, node="2"):
    """The same law at another location, where the records leave so much more (mean logarithm)."""
    effects = tuple(Effect(e.kind, (f"{node}+Z",), e.values, std=e.std) for e in law.effects)
    return replace(law, effects=effects, found=replace(law.found, log_score=law.found.log_score + more))


@pytest.mark.parametrize(("more", "verdict"), [(0.9 * np.log1p(steps.ALIKE), "ambiguous"), (1.1 * np.log1p(steps.ALIKE), "explained")])
def test_a_force_law_as_probable_on_a_day_of_its_own_stands_beside_the_one_that_is_found(more, verdict):
    """Saturating spring 10554: at another location the records were as probable, which a search on the day of one cannot see."""
    law = found("clearance")
    made = beside_others(law, [law, elsewhere(law, more)], None)
    assert made.verdict == verdict
    assert [str(e.location[0]) for e in made.ambiguous_with] == (["2+Z"] if verdict == "ambiguous" else [])
    assert ("2+Z" in made.proposed_measurement) == (verdict == "ambiguous")
    other_kind = replace(law, effects=(Effect("cubic_stiffness", law.effects[0].location, {"coefficient": 1e9}),))
    assert beside_others(law, [other_kind], None) is law  # which kind it is a search at all locations says
    partial = replace(law, verdict="partial")
    assert beside_others(partial, [elsewhere(law, more)], None) is partial


@pytest.mark.parametrize(("left", "verdict"), [(6.5, "unexplained"), (1.4, "no_misfit")])
def test_records_of_which_the_quiet_level_alone_fits_are_not_without_misfit(monkeypatch, left, verdict):
    """Saturating spring 10554: a day of the lower level took its spring, and left the higher one at 6.5."""
    module = sys.modules["operando.diagnosis.records.conclude"]
    step_row = module.step_row
    monkeypatch.setattr(module, "step_row", lambda *a: step_row(*a) | {"misfit": left})
    made = diagnose_records(STRIP.idle(), records()["none"])
    assert made.verdict == verdict
    assert ("a reduced chi-square of 6.5, where less than 1.5 is asked" in (made.reason or "")) == (verdict == "unexplained")


def test_such_a_day_is_found_beside_each_location_where_a_force_may_act(monkeypatch):
    """A force law may be found elsewhere than where any force explains most (rotor 10397): what leaves less stands."""
    law, there = found("clearance"), (Dof.parse("5+Z"),)
    monkeypatch.setattr(from_records, "with_days", lambda seen, *rest, **options: seen)
    monkeypatch.setattr(from_records, "merged", lambda seen, *rest: seen)
    monkeypatch.setattr(records_and_days, "day_of", lambda idle, effects, *a, **k: DayOf(map(str, effects)))
    assert law.found.locations[0] == there
    worse = replace(law.found, log_score=law.found.log_score + 0.1)

    def looked(idle, records, day=None, **options):
        if not day:
            first = replace(law.found, locations=((Dof.parse("3+Z"),), there))
            return replace(law, verdict="unexplained", effects=(), equivalents=(), found=first)
        return law if any("5+Z" in text for text in day) else replace(law, found=worse, notes=("elsewhere",))

    monkeypatch.setattr(records_and_days, "diagnose_records", looked)
    made = from_records.diagnose_levels(None, STRIP.idle(), frfs("clearance"), ["run"])
    assert made.ladder == law.ladder
    assert "elsewhere" not in made.notes


@pytest.mark.parametrize(
    ("told", "times", "wanted"),
    [
        ((), 0.9, "hysteresis"),
        (("coulomb_friction",), 0.9, "coulomb_friction"),
        (("coulomb_friction",), 1.1, "hysteresis"),
        (("hysteresis",), 0.9, "hysteresis"),
    ],
)
def test_a_law_whose_values_stay_open_gives_way_to_one_that_it_contains(monkeypatch, told, times, wanted):
    """Hysteresis that slips at once is dry friction: 4 % nearer, of a stiffness that nothing tells (rotor 10395); by ``ALIKE_AT_MOST``."""
    module = sys.modules["operando.diagnosis.records.diagnose"]
    spots = [SimpleNamespace(place=place) for place in ((4,), (4,), (5,), (4,))]
    kinds = ("hysteresis", "saturating_spring", "coulomb_friction", "coulomb_friction")
    tried = [
        steps.Tried(spot, ForceLaw(kind, {}), 1.0 + k / 3 * times * steps.ALIKE_AT_MOST, 1.0)
        for k, (spot, kind) in enumerate(zip(spots, kinds, strict=True))
    ]
    step = steps.SearchStep(None, (4,), 50.0, 50.0, tried)
    monkeypatch.setattr(module, "effect_of", lambda case, t: SimpleNamespace(determined=t.law.kind in told))
    monkeypatch.setattr(module, "refined", lambda t: t)
    monkeypatch.setattr(module, "closed_loop_force", lambda case, t: t)
    monkeypatch.setattr(module, "improves", lambda step, t, before: True)
    made = module.as_far_as_known(None, step, tried[0], [])
    assert made is {"hysteresis": tried[0], "coulomb_friction": tried[3]}[wanted]


@pytest.mark.parametrize(("times", "verdict"), [(0.9, "explained"), (1.1, "partial")])
def test_linear_effects_do_not_explain_what_depends_on_the_level(monkeypatch, times, verdict):
    """FRFs of the lowest level may hold an effect that is not there, where no law is found (rotor 10303); by ``FAINT``."""
    linear = found("spring")
    monkeypatch.setattr(from_records, "suspicion", lambda check, idle_frf: None)
    monkeypatch.setattr(from_records, "measured_distortion", lambda *a: times * FAINT)
    monkeypatch.setattr(records_and_days, "day_of", lambda *a, **k: None)
    monkeypatch.setattr(
        records_and_days,
        "diagnose_records",
        lambda *a, **k: SimpleNamespace(nonlinear=(), effects=(), equivalents=(), verdict="unexplained"),
    )
    made = from_records.diagnose_levels(lambda: linear, STRIP.idle(), frfs("spring"), records()["spring"])
    assert (made.verdict, made.effects) == (verdict, linear.effects)
    assert (verdict == "explained") == (made.reason is None)


A_DAY = SimpleNamespace(between=({"what": "stiffness"},), unexplained=0.9 * EXPLAINED)


@pytest.mark.parametrize(("verdict", "again"), [("no_misfit", False), ("unexplained", True)])
def test_where_a_day_explains_all_levels_no_force_law_is_looked_for(monkeypatch, verdict, again):
    """A mass of 8 kg stood in the day of one level and in all levels (frame 10452: 113 s of computing, half of it for nothing)."""
    linear, days = found("spring"), []
    looked = replace(found("clearance"), verdict="unexplained", effects=(), equivalents=())
    monkeypatch.setattr(from_records, "suspicion", lambda check, idle_frf: "runs of different level disagree")
    monkeypatch.setattr(
        records_and_days.RecordsAndDays, "diagnosis", lambda self, day=None: replace(looked, verdict=verdict if day else "unexplained")
    )
    monkeypatch.setattr(records_and_days, "day_of", lambda idle, effects, *a, **k: days.append(tuple(effects)) or A_DAY)
    from_records.diagnose_levels(lambda: linear, STRIP.idle(), frfs("spring"), records()["spring"])
    assert (len(days) > 1) == again


@pytest.mark.parametrize(("part", "verdict", "another"), [(0.9, "explained", False), (1.1, "explained", True), (0.9, "partial", True)])
def test_records_that_the_idle_model_explains_leave_no_room_for_another_day(monkeypatch, part, verdict, another):
    """A day fitted all the same takes part of the law (frame 10284); by ``ONE_DAY``."""
    now, days = found("clearance"), []
    ladder = (now.ladder[0], now.ladder[-1] | {"heldout_misfit": part * records_and_days.ONE_DAY})
    monkeypatch.setattr(records_and_days, "diagnose_records", lambda *a, **k: replace(now, verdict=verdict, ladder=ladder))
    monkeypatch.setattr(records_and_days, "day_of", lambda *a, **k: days.append(1))
    records_and_days.RecordsAndDays(STRIP.idle(), frfs("clearance"), ["run"]).look()
    assert bool(days) == another


def test_a_day_of_which_nothing_is_known_is_open_as_days_in_laboratories_are():
    idle = STRIP.idle()
    n = idle.frequencies_hz.size
    for stated, factor in (({}, 1.0), ({"stiffness": 0.03, "damping": 0.05}, 10.0)):
        day = another_day.usual_day(idle, stated)
        frequency, damping = day.covariance[:n, :n], day.covariance[n:, n:]
        np.testing.assert_allclose(np.diag(frequency), factor**2 * (0.0015**2 + 0.001**2))
        np.testing.assert_allclose(frequency[0, 1:], (factor * 0.0015) ** 2)
        np.testing.assert_allclose(np.diag(damping), (0.5 if stated else 1.0) ** 2 * 2 * 0.07**2)
        np.testing.assert_array_equal(day.sensor_gains, 1)
        assert (day.idle, day.seen(np.ones(3), np.arange(2), [0])) == (idle, None)


@pytest.mark.parametrize(
    ("verdict", "score", "taken"),
    [("explained", 0.9, True), ("partial", 0.4, True), ("partial", 0.6, False), ("unexplained", None, False)],
)
def test_records_are_held_against_another_day_while_that_says_more(monkeypatch, verdict, score, taken):
    """First a law with which the records have a score of 0.5, `partial`; then on the day of the lowest level, and beside its spring."""
    now, mean = found("clearance"), Effect("ground_spring", ("5+Z",), {"stiffness": 2e3})
    law = replace(now.found, locations=now.found.locations[:1])
    monkeypatch.setattr(records_and_days, "linear_at", lambda seen, run: [mean])
    monkeypatch.setattr(from_records, "with_days", lambda seen, *rest, **options: seen)
    monkeypatch.setattr(from_records, "merged", lambda seen, *rest: seen)
    asked = []

    def day_of(idle, effects, run, progress, **options):
        asked.append((list(effects), run.force_n))
        return A_DAY

    def looked(idle, records, day=None, **options):
        if day is None:
            return replace(now, verdict="partial", found=replace(law, log_score=0.5), notes=())
        assert day is A_DAY
        effects = now.effects if score is not None else ()
        return replace(now, verdict=verdict, effects=effects, found=replace(law, log_score=score or 0.5), notes=())

    monkeypatch.setattr(records_and_days, "day_of", day_of)
    monkeypatch.setattr(records_and_days, "diagnose_records", looked)
    monkeypatch.setattr(records_and_days, "usual_day", lambda *a: pytest.fail("a law is known, so nothing is asked without FRFs"))
    made = from_records.diagnose_levels(None, STRIP.idle(), frfs("clearance"), ["run"])
    assert (made.verdict, bool(made.notes)) == ((verdict, True) if taken else ("partial", False))
    assert {force for _, force in asked} == {min(run.force_n for run in frfs("clearance"))}
    assert [[e.kind for e in effects] for effects, _ in asked] == [[], ["ground_spring"], ["ground_spring"]]
    assert asked[1][0] == asked[2][0] == [mean]


@pytest.mark.parametrize(("share", "known"), [(0.9, True), (1.1, False)])
def test_what_differs_is_what_the_day_differs_in_that_the_records_are_held_against(monkeypatch, share, known):
    """It was asked of the FRFs of the highest level once more, which a clearance left unexplained (frame 10553); by ``EXPLAINED``."""
    now = found("clearance")
    day = SimpleNamespace(between=({"what": "stiffness"},), unexplained=share * EXPLAINED)
    monkeypatch.setattr(records_and_days, "day_of", lambda *a, **k: day)
    monkeypatch.setattr(
        records_and_days, "diagnose_records", lambda *a, day=None, **k: replace(now, verdict="explained" if day else "partial")
    )
    monkeypatch.setattr(from_records, "merged", lambda seen, *rest: seen)
    monkeypatch.setattr(from_records, "between_beside", lambda *a, **k: ((), 0.0))
    made = from_records.diagnose_levels(None, STRIP.idle(), frfs("clearance"), ["run"])
    assert made.between == (day.between if known else ())


@pytest.mark.parametrize("measured", [True, False])
def test_frfs_become_those_of_one_spring_for_all_forces(measured):
    """Each column is of a model with a spring and damper of its own: with them taken to their mean it is that of the mean."""
    idle, hz = STRIP.idle(), np.r_[0.0, np.linspace(8.0, 90.0, 60)]
    sizes = {"2+Z": (2e3, 3.0), "6+Z": (6e3, 1.0)}

    def frf(stiffness, damping, reference):
        texts = (f"coupling_spring@5+Z,3+Z=stiffness:{stiffness}", f"coupling_damper@5+Z,3+Z=damping:{damping}")
        return Model(idle, tuple(parse_effect(text, BAND) for text in texts)).frf(hz, idle.dofs, reference, variance=False)

    law = Effect("clearance", ("5+Z", "3+Z"), {"stiffness": 1e4, "gap": 1e-4})
    rows = tuple(LinearEquivalent(2.0, 1e-4, 1e-2, k, c, 1.0, (name,)) for name, (k, c) in sizes.items())
    mean = tuple(parse_effect(f"coupling_{text}", BAND) for text in ("spring@5+Z,3+Z=stiffness:4e3", "damper@5+Z,3+Z=damping:2"))
    found = FoundLaws((law,), (rows,), model=Model(idle, mean))
    columns = [frf(k, c, name) for name, (k, c) in sizes.items()]
    apart = columns[0].beside(columns[1])
    apart = apart if measured else apart.select(responses=["1+Z", "3+Z"])  # the motion at 5+Z is not known
    made = records_and_days.as_beside_one(CheckRun("run", "2 N", apart, 2.0), found).frf.data
    wanted = frf(4e3, 2.0, list(sizes)).data if measured else apart.data
    np.testing.assert_allclose(made, wanted, atol=1e-9 * np.abs(wanted).max())
    assert measured == (np.max(np.abs(made - apart.data)) > 0.01 * np.abs(wanted).max())

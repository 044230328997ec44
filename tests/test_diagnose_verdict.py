"""Verdicts need power, a search for one more effect and intervals free of zero; one route is recommended; one thing has one number."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from operando.cli.diagnose import steps_table
from operando.compare import compare_all, gets_worse, recommended
from operando.compare.route import ALIKE_DB, CLOSE_DB, WITHIN, is_good
from operando.compare.verdict import FLOOR_DB, GOOD, PARTLY, floor_reason, verdict_of
from operando.data import Finding, Frf, ModalModel
from operando.diagnosis import apply_effects, diagnose, verdict
from operando.diagnosis.criteria import SUPPORTED, UNUSUAL
from operando.diagnosis.document import noise_hides
from operando.diagnosis.found import Found
from operando.diagnosis.terms import Term
from operando.diagnosis.verdict import moved_peaks, peaks_text, with_sizes
from operando.results import CheckRun
from operando.scaling.no_scale import no_scale
from operando.structure.effects import parse_effect
from test_diagnose_check import DOFS, HZ, N, at, chain, idle, running  # noqa: F401  (fixtures and the hand-written chain)


@pytest.mark.parametrize(
    ("judge", "more", "ambiguous", "verdict"),
    [
        ([1.2], None, False, "no_misfit"),
        ([5.0], None, False, "unexplained"),
        ([50.0, 1.2], None, False, "explained"),
        ([50.0, 1.2], None, True, "ambiguous"),
        ([50.0, 1.2], "no search was made", False, "partial"),
        ([5000.0, 5.9], None, False, "partial"),  # 99.9 % explained, and a second effect swallowed: not explained
        ([5000.0, 5.9], None, True, "partial"),  # ambiguous is as explained, but for the place or kind
        ([50.0, 20.0], None, False, "unexplained"),
    ],
)
def test_verdicts_of_the_contract(judge, more, ambiguous, verdict):
    assert verdict_of(judge, more=more, ambiguous=ambiguous)[0] == verdict


@pytest.mark.parametrize(("explained", "verdict"), [(PARTLY + 0.01, "partial"), (PARTLY - 0.01, "unexplained")])
def test_effects_of_a_partial_verdict_explain_most_of_the_misfit(explained, verdict):
    assert verdict_of([100.0, 100.0 * (1 - explained)])[0] == verdict


def test_a_discrepancy_that_is_allowed_counts_as_agreement():
    judge = [5000.0, 40.0]
    assert verdict_of(judge, within=True) == ("explained", None)
    assert verdict_of(judge, within=True, ambiguous=True) == ("ambiguous", None)
    assert verdict_of(judge, within=True, more="no search was made") == ("partial", "no search was made")
    assert verdict_of([50.0, 40.0], within=True, more="no search was made")[0] == "partial"
    assert verdict_of([5.0, 4.0], within=True, more="no search was made")[0] == "unexplained"


def test_no_verdict_of_agreement_without_power():
    assert verdict_of([0.9], unseen="noise") == ("inconclusive", "noise")
    assert verdict_of([1.4, 0.9], unseen="noise") == ("inconclusive", "noise")  # effects in noise are candidates
    assert verdict_of([50.0, 0.9], unseen="noise") == ("partial", "noise")  # something is missing for sure
    assert floor_reason(FLOOR_DB) is None
    assert "778 dB" in floor_reason(778.0)


def test_every_interval_leaves_out_the_value_that_says_nothing():
    def effect(text, **std):
        return parse_effect(text).with_std(std)

    assert effect("point_mass@1+Z=mass:0.2", mass=0.1).supported
    assert not effect("point_mass@1+Z=mass:0.2", mass=0.11).supported
    assert not effect("sensor_gain@1+Z=gain:1.1", gain=0.06).supported
    uncertain = effect("ground_hysteretic_spring@1+Z=stiffness:2e4,loss_factor:0.01", stiffness=10.0, loss_factor=0.01)
    assert uncertain.supported  # a spring in any case
    assert not uncertain.determined
    assert not effect("point_mass@1+Z=mass:0.2", mass=np.inf).supported
    assert effect("coulomb_friction@1+Z=force:1.0,slip_speed:0.01", force=0.01, slip_speed=0.1).determined  # may be 0
    bent = "hysteresis@1+Z=stiffness:4e3,yield_force:1.0,exponent:1.2,ratio:0.1"
    assert effect(bent, stiffness=100.0, exponent=0.7).determined  # an exponent of 0 is no absence
    assert effect(bent, yield_force=0.6).supported
    assert not effect(bent, yield_force=0.6).determined


def test_a_change_that_noise_would_hide_is_inconclusive(chain, idle):  # noqa: F811
    """Noise of 500 % of each FRF's rms: the idle model agrees, and would with some modes anywhere."""
    found = diagnose(idle, check=[running(chain, [0, 3], noise=5.0)])
    assert found.verdict == "inconclusive"
    assert found.effects == ()
    assert "half-power" in found.reason
    assert "noise of the validation measurement" in found.proposed_measurement


def test_what_many_lines_tell_is_no_matter_of_their_noise_in_db(chain, idle):  # noqa: F811
    """Noise of 200 %, 17 dB: masses of the sizes stated are seen all the same, so agreement says something."""
    asked = {"kinds": ["point_mass"]}
    found = diagnose(idle, check=[running(chain, [0, 3], noise=2.0)], **asked)
    assert found.verdict == "no_misfit"
    assert found.noise_floor_db > FLOOR_DB
    [size] = [row["value"] for row in found.detectable if row["kind"] == "point_mass" and row["location"] == ["5+Z"]]
    seen = [diagnose(idle, check=[running(chain, [0, 3], noise=2.0, mass=size * at(4), seed=s)], **asked).verdict for s in range(1, 5)]
    assert seen.count("no_misfit") <= 1  # each is seen in 95 of 100


def test_noise_that_is_not_stated_is_estimated_from_neighbouring_lines(chain, idle):  # noqa: F811
    """FRFs without coherence: as 1 % of each value, the noise beside the peaks counted as an error of the model, of 100 %."""
    run = running(chain, [0, 3], mass=0.15 * at(4), noise=5e-3)
    stated = diagnose(idle, check=[run])
    found = diagnose(idle, check=[replace(run, frf=replace(run.frf, variance=None))])
    assert [found.verdict, stated.verdict] == ["explained", "explained"]
    [effect], [known] = found.effects, stated.effects
    assert effect.kind == "point_mass"
    assert effect.values["mass"] == pytest.approx(0.15, abs=3 * effect.std["mass"])
    assert effect.std["mass"] == pytest.approx(known.std["mass"], rel=0.5)
    assert any("state neither variance nor coherence" in note for note in found.notes)
    assert not any("state neither" in note for note in stated.notes)


def hardly_known(idle):  # noqa: F811
    """The idle model with standard deviations 100 000 times as large."""
    terms = idle.frequencies_hz, idle.damping_ratios, idle.shapes, DOFS
    return ModalModel(*terms, scaling="unit_modal_mass", covariance=idle.covariance * 1e10)


def test_an_unknown_idle_model_is_named_as_what_hides(chain, idle):  # noqa: F811
    vague = hardly_known(idle)
    found = diagnose(vague, check=[running(chain, [0, 3])])
    assert found.verdict == "inconclusive"
    assert "what is not known of the idle model" in found.proposed_measurement


@pytest.mark.parametrize("weak", [8.0, 0.8])
def test_a_weak_effect_beside_a_strong_one_is_not_swallowed(chain, idle, weak):  # noqa: F811
    """A mass of 0.15 kg and a damper of 8 N·s/m beside it, and weaker ones."""
    found = diagnose(idle, check=[running(chain, [0, 3], mass=0.15 * at(4), damping=weak * at(4))])
    kinds = {e.kind for e in found.effects}
    assert found.verdict != "explained" or kinds == {"point_mass", "ground_damper"}
    assert "point_mass" in kinds


def test_effects_without_support_are_candidates_only(chain, idle):  # noqa: F811
    """Random mass, damping and stiffness between all DOFs, each with each: no effect asked for is one of them."""
    kinds = ["point_mass", "ground_spring", "ground_damper", "coupling_spring", "sensor_gain"]
    rng = np.random.default_rng(3)
    root, damp, stiff = rng.standard_normal((3, N, N))
    change = {"mass": 0.04 * root @ root.T, "damping": 2 * damp @ damp.T, "stiffness": 2e4 * stiff @ stiff.T}
    found = diagnose(idle, check=[running(chain, [0, 3], **change)], kinds=kinds)
    assert found.verdict in ("partial", "unexplained")
    if found.verdict == "unexplained":
        assert found.effects == ()
        assert len(found.ladder) == 1
    assert all(e.supported for e in found.effects)
    assert found.reason or found.verdict == "unexplained"
    assert found.candidates


@pytest.mark.parametrize(("share", "seen"), [(0.99, False), (1.01, True)])
def test_peaks_have_moved_where_they_lie_beyond_days_and_their_width(share, seen):
    def row(moved, zeta):
        return {"frequency_hz": 50.0, "damping_ratio": zeta, "frequency_error_percent": 100 * (1 / (1 + moved) - 1)}

    spreads = {"stiffness": 0.006, "mode": 0.004}
    days = UNUSUAL * 0.005
    assert bool(moved_peaks([row(-share * days, 0.001)], spreads)) is seen
    assert bool(moved_peaks([row(share * 2 * 0.02, 0.02)], spreads)) is seen
    assert bool(moved_peaks([row(share * 2 * 0.001, 0.001)], {})) is seen  # nothing was touched
    assert moved_peaks([row(0.5, 0.001) | {"frequency_error_percent": None}], spreads) == []
    [(hz, percent, std)] = moved_peaks([row(-0.1, 0.001)], spreads)
    assert (hz, percent, std) == (50.0, pytest.approx(-10), None)
    one = peaks_text([(hz, percent, None)])
    assert "1 peak has moved" in one
    assert "farthest" not in one
    assert "to 50 Hz by −10 %" in peaks_text([(hz, percent, None)])
    [known] = moved_peaks([row(-0.1, 0.001) | {"frequency_std_hz": 0.025}], spreads)
    assert "to 50.00 ± 0.05 Hz by −10 % (± is the 95 % interval)" in peaks_text([known])


@pytest.mark.parametrize(("changed", "verdict"), [(False, "inconclusive"), (True, "unexplained")])
def test_peaks_that_moved_are_no_open_question_though_the_idle_model_is_a_poor_one(chain, idle, changed, verdict):  # noqa: F811
    rng = np.random.default_rng(5)

    def poor(frf):
        """A third of each FRF off, smoothly over frequency, as no set of modes is."""
        phase = np.exp(
            2j * np.pi * (rng.uniform(size=frf.data.shape[:2])[..., None] + HZ / rng.uniform(8, 20, frf.data.shape[:2])[..., None])
        )
        return Frf(frf.data * (1 + 0.4 * phase), HZ, frf.responses, frf.references, variance=frf.variance)

    run = running(chain, [0, 3], stiffness=-0.1 * changed * chain.K)
    run = CheckRun(run.name, run.level, poor(run.frf))
    found = diagnose(idle, check=[run], idle_frf=poor(running(chain, [0, 3]).frf), kinds=["sensor_polarity"])
    assert "idle FRFs themselves" in found.reason
    assert found.verdict == verdict
    assert ("peaks have moved" in found.reason) is changed


def test_what_differs_between_the_days_is_no_merit_of_an_effect(chain, idle):  # noqa: F811
    """Gains alone: they explain the lines, and step 0 has them; with a needless effect step 0 is the idle model as it is."""
    run = running(chain, [0, 3])
    gains = np.linspace(0.7, 1.3, len(run.frf.responses))[:, None, None]
    run, may = replace(run, frf=replace(run.frf, data=run.frf.data * gains)), {"sensor_gain": 0.2}
    none, added = (apply_effects(idle, effects, check=[run], between=may) for effects in ([], ["point_mass@5+Z"]))
    assert [row["with_between"] for row in (*none.ladder, *added.ladder)] == [True, False, True]
    assert max(none.ladder[0]["heldout_error_db"], added.ladder[1]["heldout_error_db"]) < 0.3 * added.ladder[0]["heldout_error_db"]
    assert "with what differs between the two measurements, " in added.words[0]
    assert added.words[0].endswith(("the data do not support it", "nothing in the data speaks for it"))
    assert "with what differs between the two measurements: step 1" in steps_table(list(added.ladder))


def test_one_comparison_has_one_number(chain, idle):  # noqa: F811
    """Comparison, diagnosis, effects added or all removed by hand: the idle model's figures agree, and name state, level and lines."""
    run = running(chain, [0, 3], mass=0.15 * at(4))
    errors = compare_all({"idle": idle}, [run])["models"]["idle"]
    found, by_hand, none = diagnose(idle, check=[run]), *(apply_effects(idle, e, check=[run]) for e in (["point_mass@5+Z"], []))
    for key in ("by_dof", "by_band", "by_mode"):
        assert found.where[key] == errors[key]
    assert by_hand.effects
    for step in (by_hand.ladder[0], none.ladder[0]):
        assert [step[key] for key in ("error_db", "heldout_error_db")] == [found.ladder[0][key] for key in ("error_db", "heldout_error_db")]
        for key in ("misfit", "heldout_misfit"):
            assert step[key] == pytest.approx(found.ladder[0][key], rel=1e-3)  # under the discrepancy of each fit
    assert by_hand.judged_on == found.judged_on
    assert found.judged_on["state"] == "operating"
    assert found.judged_on["level_name"] == "1 N rms"
    assert 0 < found.judged_on["n_lines"] < 2 * N * HZ.size


def model(error, misfit=0.9, floor=0.2, by_dof=()):
    return {"error_db": error, "misfit": misfit, "noise_floor_db": floor, "by_dof": [{"dof": d, "error_db": e} for d, e in by_dof]}


def test_the_route_is_the_one_that_predicts_better():
    models = {"ofrf": model(0.7), "idle": model(4.0, 900.0), "effect": model(0.2)}
    said = {"verdict": "explained", "effects": [{"kind": "point_mass"}]}
    route = recommended({"models": models}, said, hybrid=True)
    assert (route.name, route.model, route.error_db, route.idle_error_db, route.good) == ("effect", "effect", 0.2, 4.0, True)
    assert recommended({"models": models | {"effect": model(2.0)}}, said, True).name == "hybrid"
    # As close as each other: the found cause decides, else the measured modes do.
    alike = {"models": models | {"effect": model(0.75)}}
    assert recommended(alike, said, True).name == "effect"
    assert recommended(alike, said | {"verdict": "partial"}, True).name == "hybrid"
    assert recommended({"models": models}, {"verdict": "no_misfit", "effects": []}, True).model == "ofrf"
    assert recommended(None, said, True).name == "effect"
    assert recommended(None, {"verdict": "unexplained", "effects": []}, True).name == "hybrid"
    assert recommended(None, None, False) is None


def test_the_idle_model_alone_is_recommended_where_it_predicts_better_than_both_routes():
    models = {"ofrf": model(5.3), "idle": model(0.93), "effect": model(2.19)}
    said = {"verdict": "partial", "effects": [{"kind": "clearance"}]}
    route = recommended({"models": models}, said, hybrid=True)
    assert (route.name, route.model, route.error_db) == ("idle", "idle", 0.93)
    assert route.reason.startswith("the idle model alone is closer to the validation FRFs, 0.93 dB")
    # as close as the effect: the effect is no harm, and predicts other states
    assert recommended({"models": models | {"effect": model(0.93 + 0.99 * ALIKE_DB)}}, said, hybrid=True).name == "effect"


def test_no_red_for_a_fifth_of_a_decibel_and_no_green_above_a_high_floor():
    assert is_good(model(0.20, 3.0, 0.10))
    assert not is_good(model(2.0, 0.4, 778.0))
    assert is_good(model(1.5, 1.2, 1.4))
    assert is_good({}) is None


@pytest.mark.parametrize(("apart", "name"), [(0.99, "effect"), (1.01, "hybrid")])
def test_a_route_that_is_as_close_gives_way_to_the_cause(apart, name):
    """ALIKE_DB: by that the effect route may be farther off and is taken still, as the cause is known."""
    models = {"ofrf": model(2.0), "effect": model(2.0 + apart * ALIKE_DB), "idle": model(5.0)}
    said = {"verdict": "explained", "effects": [{"kind": "point_mass"}]}
    assert recommended({"models": models}, said, hybrid=True).name == name


def test_a_model_is_good_where_it_is_close_or_the_noise_allows_no_better():
    far, high = 2 * GOOD, 0.8 * FLOOR_DB
    assert is_good(model(CLOSE_DB - 0.01, far, 0.01))
    assert not is_good(model(CLOSE_DB + 0.01, far, 0.01))
    assert is_good(model((WITHIN - 0.01) * high, far, high))
    assert not is_good(model((WITHIN + 0.01) * high, far, high))


def test_a_map_that_gets_worse_is_found():
    before, after = model(3.0, by_dof=[("1+Z", 3.0), ("2+Z", 0.5)]), model(0.5, by_dof=[("1+Z", 0.3), ("2+Z", 0.9)])
    assert "2+Z (0.50 → 0.90 dB)" in gets_worse({"idle": before, "effect": after})
    after["by_dof"][1]["error_db"] = 0.69  # within the noise floor of 0.2 dB
    assert gets_worse({"idle": before, "effect": after}) is None
    # as far off as the noise of an antiresonance makes it
    after["by_dof"][1] |= {"error_db": 0.9, "misfit": 0.99 * GOOD}
    assert gets_worse({"idle": before, "effect": after}) is None
    after["by_dof"][1]["misfit"] = 1.01 * GOOD
    assert gets_worse({"idle": before, "effect": after}) is not None


def test_the_true_cause_of_a_missing_scale():
    shapes = np.eye(2)
    bare = ModalModel(np.array([5.0, 9.0]), np.array([0.01, 0.01]), shapes, ("1+Z", "2+Z"))
    swapped = Finding("swapped", "channels 1+Z and 2+Z are exchanged", "error", consequence="no drive point", action="exchange the labels")
    text, advice, fault = no_scale(bare, [swapped])
    assert "exchanged" in text
    assert advice == "exchange the labels"
    assert fault
    assert "unit" not in advice
    assert no_scale(bare, [])[2] is False


def test_frfs_without_variance_are_exact(chain, idle):  # noqa: F811
    run = running(chain, [0, 3])
    plain = CheckRun("check", "as given", Frf(run.frf.data, HZ, DOFS, run.frf.references))
    assert compare_all({"idle": idle}, [plain])["models"]["idle"]["misfit_meas"] is None


def state_of(*terms, score, std):
    """A stand-in: effects, log probability, and the standard deviations of their values on the search scale."""
    return SimpleNamespace(terms=terms, key=tuple(sorted(t.key for t in terms)), score=score, covariance=np.diag(np.square(std)))


def test_an_effect_of_unknown_size_takes_nothing_from_one_that_is_sure(monkeypatch):
    monkeypatch.setattr(verdict, "score", lambda state: state.score)
    damper, spring = Term("ground_damper", (1,), (7.0,)), Term("ground_spring", (3,), (9.0,))
    empty, sure = state_of(score=-300.0, std=[]), state_of(damper, score=-21.0, std=[0.03])
    both = state_of(damper, spring, score=-18.0, std=[0.03, SUPPORTED + 0.1])
    pool = {s.key: s for s in (empty, sure, both)}
    assert with_sizes(Found(both, empty, pool)).best is sure
    known = state_of(damper, spring, score=-18.0, std=[0.03, SUPPORTED - 0.1])
    assert with_sizes(Found(known, empty, pool | {known.key: known})).best is known
    alone = state_of(spring, score=-18.0, std=[SUPPORTED + 0.1])
    assert with_sizes(Found(alone, empty, {s.key: s for s in (empty, alone)})).best is alone
    weak = state_of(damper, score=-299.0, std=[0.03])  # no more than nothing is
    assert with_sizes(Found(both, empty, pool | {weak.key: weak})).best is both


def test_noise_hides_an_effect_only_where_most_lines_are_noisy():
    """Lines between peaks may have any noise; the rest decides whether noise or the error of the model is larger."""
    level, variance = np.ones((10, 1, 1)), np.full((10, 1, 1), 0.01**2)
    variance[:3] = 1.0
    lines = SimpleNamespace(fit=np.arange(10), there=np.array([[True]]), variance=variance, level=level)
    case = SimpleNamespace(lines=lines)
    assert not noise_hides(case, 0.02)
    assert noise_hides(case, 0.005)
    variance[:6] = 1.0
    assert noise_hides(case, 0.02)

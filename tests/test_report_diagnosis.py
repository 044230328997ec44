"""The diagnosis in the report: words and figures of every verdict, missing pieces, the numbers behind the figures."""

from __future__ import annotations

import copy
import re
import time
from dataclasses import replace

import numpy as np
import pytest

from operando.compare import compare_all, error_map
from operando.compare.verdict import FLOOR_DB, GOOD
from operando.data import FrequencyAxis, Frf, Geometry, ModalModel
from operando.dof import Dof
from operando.report import assumptions, derive, derive_diagnosis, render_report, sections_diagnosis
from operando.report.assessment import RECIPROCITY, route_words
from operando.report.figures_compare import error_maps
from operando.report.figures_diagnosis import places_figure, running_median, steps_figure, stiffness_figure, stiffness_span
from operando.report.figures_records import force_figure, level_figure, simulation_figure
from operando.report.parts import Numbering, render
from operando.report.sections import build
from operando.report.words_diagnosis import (
    BY_HAND,
    FAULT,
    VERDICTS,
    between_words,
    diagnosis_words,
    effect_words,
    error_by_step,
    found_intro,
)
from operando.results import CheckRun, Results
from operando.structure import LinearEquivalent, Model
from operando.structure.effects import Effect
from structures import Chain

N = 8
BAND = (8.0, 140.0)
LINES = np.arange(6.0, 150.0, 0.25)
MASS = {
    "kind": "point_mass",
    "location": ["103+Z"],
    "parameters": {"mass": {"value": 0.2, "unit": "kg", "std": 0.001}},
    "explanation": "A mass of 200 ± 1 g sits on 103+Z",
    "confirm": "weigh what was put there",
}


RANGES = [[a, a + 8.0] for a in (10.0, 32.0, 54.0, 76.0, 98.0, 120.0)]
JUDGED = {"state": "operating", "measured": "FRF lines", "runs": ["check/run1.uff"], "whole_run": False, "ranges_hz": RANGES}
"""What the engine says of the hold-out set."""


def spring(value=-900.0, std=10.0, place="105+Z"):
    return {
        "kind": "ground_spring",
        "location": [place],
        "parameters": {"stiffness": {"value": value, "unit": "N/m", "std": std}},
        "explanation": "a spring",
        "confirm": "loosen it",
    }


def rung(step, added, heldout_db, heldout_misfit):
    db = None if heldout_db is None else 1.1 * heldout_db
    row = {"step": step, "added": added, "error_db": db, "heldout_error_db": heldout_db}
    return row | {"misfit": 1.2 * heldout_misfit, "heldout_misfit": heldout_misfit}


def document(verdict="explained", effects=(MASS,), decibels=(3.93, 0.15), misfits=(5000.0, 0.9), **more):
    added = [None, *effects]
    ladder = [rung(i, a, d, m) for i, (a, d, m) in enumerate(zip(added, decibels, misfits, strict=True))]
    hz = np.linspace(8, 140, 90)
    law = -0.2 * (2 * np.pi * hz) ** 2
    out = {
        "schema": "operando/diagnosis/2",
        "data": ["check_frf"],
        "verdict": verdict,
        "effects": list(effects),
        "ambiguous_with": [],
        "proposed_measurement": None,
        "ladder": ladder,
        "candidates": [MASS | {"selection_misfit": 1.1, "evidence": "misfit 2.516e+04 → 1.1"}]
        + [spring(k) | {"selection_misfit": 900.0 + k, "evidence": "misfit"} for k in range(1, 11)],
        "where": {"by_dof": [], "by_band": [], "by_mode": []},
        "noise_floor_db": 0.14,
        "picture": {
            "places": [{"location": ["103+Z"], "remains": 0.02}, {"location": ["105+Z", "101+Z"], "remains": 0.4}],
            "dynamic_stiffness": [
                {"location": ["103+Z"], "frequency_hz": hz.tolist(), "real": (law * 1.01).tolist(), "imag": (0 * hz).tolist(),
                 "law_real": law.tolist(), "law_imag": (0 * hz).tolist(), "unit": "N/m"}
            ],
        },
        "notes": ["18 contiguous blocks of lines: fit, select and judge in turn"],
    }  # fmt: skip
    return out | more


def output_only(verdict="explained", effects=(MASS,)):
    modes = [{"frequency_hz": f, "misfit": 0.8, "idle_misfit": m} for f, m in ((12.0, 40.0), (31.5, 300.0), (77.0, 5.0))]
    more = {"data": ["operating_modes"], "noise_floor_db": None, "picture": {}, "where": {"by_dof": [], "by_band": [], "by_mode": modes}}
    misfits = (144.0, 0.81)[: 1 + len(effects)]
    return document(verdict, effects, (None, None)[: 1 + len(effects)], misfits, **more)


def dofs():
    return tuple(Dof(100 + i, "Z") for i in range(N))


def measured(model, noise, seed, references=(0, 5)):
    rng = np.random.default_rng(seed)
    refs = tuple(dofs()[j] for j in references)
    data = model.frf(LINES, dofs(), refs, variance=False).data
    variance = (noise * np.sqrt(np.mean(np.abs(data) ** 2, axis=2, keepdims=True)) * np.ones(LINES.size)) ** 2
    data = data + np.sqrt(variance / 2) * (rng.standard_normal(data.shape) + 1j * rng.standard_normal(data.shape))
    return Frf(data, LINES, dofs(), refs, variance=variance, averages=20.0)


@pytest.fixture(scope="module")
def whole():
    """Results whose check has the mass of the document at 103+Z; no hybrid model."""
    chain = Chain(N, mass=1.0, stiffness=2e5, zeta=0.008, seed=1)
    std = np.r_[1e-4 * chain.hz, 0.01 * chain.zeta, 2e-4 * np.ones(N * N)]
    idle = ModalModel(chain.hz, chain.zeta, chain.phi, dofs(), "unit_modal_mass", covariance=np.diag(std**2), band_hz=BAND, misfit=1.0)
    truth = Model(idle).add("point_mass@103+Z=mass:0.2")
    check = [CheckRun("check/run1.uff", "5 N", measured(truth, 0.002, 2))]

    comparison = compare_all({"idle": idle, "effect": truth}, check, BAND)
    xyz = np.array([[0.3 * i, 0.0, 0.0] for i in range(N)])
    geometry = Geometry(tuple(100 + i for i in range(N)), xyz, tuple((100 + i, 101 + i) for i in range(N - 1)))
    found = document(judged_on=JUDGED)
    return Results(
        "chain", {"band": list(BAND)}, [], [], geometry, measured(Model(idle), 0.002, 3), idle, None, None, check, comparison, found
    )


def text_of(html):
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", re.sub(r"<title>.*?</title>", "", html)))


def sections(results):
    """The two sections of the diagnosis."""
    page = Numbering()
    makers = {"missing": sections_diagnosis.answer, "diagnosis": sections_diagnosis.diagnosis}
    return {name: render(f"{name}.html.j2", page, results=results, **make(results, page)) for name, make in makers.items()}


# Words.


def test_answer_says_what_where_how_large_and_how_much_it_helps():
    words = diagnosis_words(document())
    assert words.found == ("A mass of 200 ± 2 g (95 %) sits on 103+Z; the idle model does not have it.",)
    assert "the error of the idle model is 3.93 dB, with the effect 0.15 dB" in words.sentences[0]
    assert "0.14 dB" in words.sentences[0]
    assert words.sentences[1] == "Nothing else in the catalogue does as well."
    assert words.decide == (f"To confirm: {Effect.from_dict(MASS).confirm}.",)
    assert (words.title, words.grade) == VERDICTS["explained"]


def test_intervals_are_1_96_standard_deviations():
    wide = copy.deepcopy(MASS)
    wide["parameters"]["mass"]["std"] = 0.01
    assert effect_words(wide).size == "200 ± 20 g"
    assert effect_words(MASS).size == "200 ± 2 g"


def test_what_was_taken_away_is_still_in_the_idle_model():
    e = effect_words(spring(-900.0))
    assert e.removed
    words = diagnosis_words(document(effects=(spring(-900.0),)))
    assert "is missing at 105+Z; the idle model still has it" in words.found[0]


def test_size_within_its_interval_of_zero_is_told():
    words = diagnosis_words(document(effects=(spring(15.0, 10.0),)))
    assert "reaches zero" in words.found[0]
    assert "reaches zero" not in diagnosis_words(document(effects=(spring(25.0, 10.0),))).found[0]


def test_output_only_counts_in_standard_deviations():
    words = diagnosis_words(output_only())
    assert words.output_only
    assert not words.ladder.decibel
    assert words.ladder.floor == 1.0
    assert "the error of the idle model is 12 standard deviations, with the effect 0.90 standard deviations" in words.sentences[0]
    assert "dB" not in words.sentences[0]


def test_one_measurement_that_confirms_and_decides_is_named_once():
    once = diagnosis_words(document("explained", (MASS,))).decide
    [confirm] = [s.removeprefix("To confirm: ").removesuffix(".") for s in once if s.startswith("To confirm")]
    again = diagnosis_words(document("explained", (MASS,), proposed_measurement=confirm)).decide
    assert [s for s in again if confirm in s] == [f"To confirm: {confirm}."]


@pytest.mark.parametrize("verdict", VERDICTS)
def test_each_verdict_has_its_words(verdict):
    effects = () if verdict == "no_misfit" else (MASS,)
    n = 1 + len(effects)
    words = diagnosis_words(document(verdict, effects, (3.0, 2.0)[:n], (90.0, 30.0)[:n], proposed_measurement="turn it off?"))
    assert words.title == VERDICTS[verdict][0]
    assert "What would decide: turn it off?" in words.decide
    expected = {"unexplained": "too little to be believed", "ambiguous": "likeliest"}.get(verdict, "")
    assert expected in found_intro(words)
    if verdict in ("unexplained", "ambiguous"):
        assert not any(s.startswith("To confirm") for s in words.decide)


def test_wrong_effect_added_by_hand_is_never_told_as_the_diagnosis(whole):
    said = ["ground_spring at 105+Z: misfit 7.292e+04 → 1.89e+04: lower by 74.1 %", "the data speak for another one"]
    found = document(effects=(spring(500.0),), decibels=(3.93, 4.1), misfits=(5000.0, 900.0), by_hand={"found": [MASS], "words": said})
    words = diagnosis_words(found)
    assert (words.verdict, words.title, words.grade) == BY_HAND
    assert found_intro(words) == "In the model now:"
    assert "Ground spring at 105+Z: misfit 72920 → 18900: lower by 74.1 %." in words.sentences
    assert "The data speak for another one." in words.sentences
    assert "The diagnosis by itself (explained) found: A mass of 200 ± 2 g (95 %) sits on 103+Z." in words.sentences
    assert "Nothing else" not in " ".join(words.sentences)
    assert not words.decide
    results = replace(whole, diagnosis=found)
    assert "effect" not in derive.comparison_models(results)
    assert "effect" in derive.comparison_models(whole)
    assert "added by hand" in sections(results)["diagnosis"]
    # taken back to what was found, it is the diagnosis again
    again = document(by_hand={"found": [MASS], "words": ["back"]})
    assert diagnosis_words(again).verdict == "explained"


def test_effects_removed_by_hand_are_told():
    words = diagnosis_words(document(effects=(), decibels=(3.93,), misfits=(5000.0,), by_hand={"found": [MASS], "words": []}))
    assert words.sentences[0] == "No effect is in the model now."
    assert words.verdict == BY_HAND[0]


def test_channel_fault_is_no_missing_structure():
    late = {"kind": "sensor_delay", "location": ["103+Z"], "parameters": {"delay": {"value": 1.1e-3, "unit": "s", "std": 5e-8}}}
    words = diagnosis_words(document(effects=(late,), decibels=(0.15, 0.15), misfits=(9000.0, 1.0)))
    assert words.title == FAULT
    assert "idle model" not in words.found[0]
    assert "e-0" not in words.found[0]
    # levels say nothing of a delay, so the ladder is in misfits
    assert words.ladder.by_phase
    assert not words.ladder.decibel
    assert [r.heldout for r in words.ladder.rows] == [9000.0, 1.0]
    assert "phase" in words.sentences[0]


def test_levels_stay_where_they_tell():
    assert not error_by_step(document()).by_phase
    assert not error_by_step(document(decibels=(3.0, 2.9), misfits=(90.0, 80.0))).by_phase


def test_ladder_takes_the_sizes_of_the_last_refit_and_says_when_nothing_was_held_out():
    found = document()
    final = copy.deepcopy(MASS)
    final["parameters"]["mass"]["value"] = 0.25
    found["effects"] = [final]
    assert "250" in error_by_step(found).rows[1].effect.size
    for row in found["ladder"]:
        row["heldout_error_db"] = None
    ladder = error_by_step(found)
    assert not ladder.on_hold_out
    assert ladder.rows[0].heldout == pytest.approx(1.1 * 3.93)
    assert "On all lines of the validation measurement" in diagnosis_words(found).sentences[0]


def test_unknown_kind_and_bare_documents_are_told_as_they_stand():
    strange = {"kind": "flux_capacitor", "location": ["103+Z"], "parameters": {"power": {"value": 1.21, "unit": "GW", "std": 0.01}}}
    words = effect_words(strange | {"explanation": "A flux capacitor sits on 103+Z"})
    assert words.sentence == "A flux capacitor sits on 103+Z"
    assert words.size.startswith("1.21")
    assert words.label == "flux capacitor at 103+Z"
    bare = diagnosis_words({"verdict": "explained"})
    assert bare.ladder.rows == ()
    assert diagnosis_words({}).title.startswith("Diagnosis")


def test_ambiguous_effects_are_named_and_counted():
    words = diagnosis_words(document("ambiguous", ambiguous_with=[spring(k, place=f"{100 + k}+Z") for k in range(1, 7)]))
    assert any("ground spring at 101+Z" in s and "and 2 more" in s for s in words.sentences)


def test_command_line_says_it_in_the_same_words():
    from operando.cli.diagnose import text_of

    found = document("ambiguous", ambiguous_with=[spring()])
    words = diagnosis_words(found)
    text = text_of("pump", found)
    for sentence in (*words.found, *words.sentences, *words.decide):
        assert sentence in text
    assert text.startswith("pump: ambiguous")
    assert "noise floor 0.14 dB" in text


# Figures.


def test_ladder_figure_holds_values_labels_floor_and_verdict():
    words = diagnosis_words(document(effects=(MASS, spring(-900.0)), decibels=(3.93, 1.2, 0.15), misfits=(5000.0, 90.0, 0.9)))
    text = text_of(steps_figure(words.ladder, "explained", "good"))
    for piece in ("3.93 dB", "1.20 dB", "0.15 dB", "−2.73 dB", "−1.05 dB", "noise floor 0.14 dB", "explained", "idle model"):
        assert piece in text, piece
    for piece in ("+ point mass", "103+Z", "200 ± 2 g", "+ ground spring (taken away)", "105+Z", "900 ± 20 N/m"):
        assert piece in text, piece


def test_ladder_figure_in_misfits_has_the_noise_at_one():
    words = diagnosis_words(output_only())
    text = text_of(steps_figure(words.ladder, "explained", "good"))
    for piece in ("144", "0.810", "÷180", "1: as good as the noise allows", "reduced χ²"):
        assert piece in text, piece
    assert "dB" not in text


def test_worse_step_is_drawn_upwards():
    words = diagnosis_words(document("unexplained", (MASS,), (0.94, 4.73), (200.0, 1000.0)))
    assert "+3.79 dB" in text_of(steps_figure(words.ladder, "unexplained", "poor"))


def test_stiffness_figure_spans_the_law_and_scales_units():
    picture = document()["picture"]["dynamic_stiffness"][0]
    low, high = stiffness_span(picture["real"], picture["law_real"])
    assert low < min(picture["law_real"])
    assert high > 0
    wild = [*picture["real"][:-1], 1e12]
    assert stiffness_span(wild, picture["law_real"])[1] < 1e6
    text = text_of(stiffness_figure([picture], ["103+Z: point mass"]))
    assert "[kN/m]" in text
    assert "103+Z: point mass" in text
    assert stiffness_figure([picture | {"imag": None, "law_imag": None}], ["103+Z"]).startswith("<svg")


def test_running_median_ignores_spikes_and_gaps():
    x = np.ones(50)
    x[10], x[20] = 1e9, np.nan
    np.testing.assert_allclose(running_median(x), 1.0)
    assert np.isnan(running_median(np.full(30, np.nan))).all()
    assert running_median(np.array([2.0])).tolist() == [2.0]


def test_places_figure_ranks_what_a_force_explains():
    text = text_of(places_figure(document()["picture"]["places"], [frozenset({"103+Z"})]))
    assert "98.0 %" in text
    assert "60.0 %" in text
    assert "105+Z and 101+Z" in text


def test_map_writes_each_value_once_and_a_dash_for_none():
    svg = error_maps([("A & B", np.array([[1.25, np.nan], [0.5, 100.4]]))], ["r1", "r2"], [1, 2, 3], "dB")
    text = text_of(svg)
    assert "A &amp; B" in svg
    for piece in ("1.2", "–", "0.5", "100"):
        assert f" {piece} " in text


# The report.


def test_the_machine_and_the_error_by_step_are_the_first_figures_and_the_answer_the_first_section(whole):
    html = render_report(whole)
    assert html.index('id="missing"') < html.index('id="answer"')
    machine, first = (part.split("</figure>")[0] for part in html.split("<figure>")[1:3])
    assert "where the effect acts" in machine
    assert "Error by step, verdict explained" in first
    assert "3.93 dB" in first
    assert "A mass of 200 ± 2 g (95 %) sits on 103+Z" in html
    assert "<script>" not in html.replace("<script>addEventListener", "")


def test_evidence_has_maps_stiffness_places_frfs_and_candidates(whole):
    made = sections(whole)["diagnosis"]
    text = text_of(made)
    for piece in (
        "The error of the idle model is largest at",
        "With the effects",
        "Noise floor",
        "103+Z: point mass 200 ± 2 g",
        "the real part falls as the square of frequency",
        "hold-out lines",
        "103+Z from",
        "accepted",
        "3 more candidates",
        "misfit 25160 → 1.1",
        "18 contiguous blocks",
    ):
        assert piece in text, piece
    assert made.count("<svg") == 4


def test_effects_lower_the_map_to_the_noise(whole):
    model = derive_diagnosis.effect_model(whole)
    run = derive.validation_run(whole)
    edges = derive.band_edges(BAND)
    before = error_map(derive.model_frf(whole.idle, run.frf), run.frf, edges)
    after = error_map(derive.model_frf(model, run.frf), run.frf, edges)
    noise = derive_diagnosis.noise_by_dof_band(run.frf, edges)
    assert np.nanmax(before) > 3.0
    # the check was made with just this mass: what is left is the noise the map states
    assert np.nanmedian(after / noise) == pytest.approx(1.0, abs=0.1)


def test_relative_map_of_a_known_phase_is_exact(whole):
    run = derive.validation_run(whole)
    late = replace(run.frf, data=run.frf.data * np.exp(0.1j))
    edges = derive.band_edges(BAND)
    share = derive_diagnosis.relative_by_dof_band(np.abs(late.data - run.frf.data) ** 2, run.frf, edges)
    np.testing.assert_allclose(share[np.isfinite(share)], 100 * abs(np.exp(0.1j) - 1), rtol=1e-9)


def test_held_out_ranges_are_the_blocks_that_judge(whole):
    run = derive.validation_run(whole)
    ranges, everything = derive_diagnosis.hold_out_ranges(whole, run)
    assert not everything
    assert ranges == [tuple(r) for r in RANGES]
    assert all(BAND[0] <= a < b <= BAND[1] for a, b in ranges)
    another = replace(whole, diagnosis=document(judged_on=JUDGED | {"whole_run": True, "ranges_hz": []}))
    assert derive_diagnosis.hold_out_ranges(another, run) == ([], True)
    assert derive_diagnosis.hold_out_ranges(whole, CheckRun("check/run2.uff", "20 N", run.frf)) == ([], False)


class Louder:
    """A hybrid route to the operational FRFs: the idle model, too high by one gain everywhere."""

    def __init__(self, model, gain):
        self.modal = replace(model, shapes=model.shapes * np.sqrt(gain), covariance=None)

    def frf(self, *args):
        return self.modal.frf(*args)

    def to_dict(self):
        return {"pairing": [], "scaling": {}}


def test_routes_differ_by_a_known_level(whole):
    gain = 10 ** (0.8 / 20)
    with_hybrid = replace(whole, hybrid=Louder(whole.idle, gain), diagnosis=document("no_misfit", (), (0.2,), (1.0,)))
    two = derive_diagnosis.routes(with_hybrid, derive_diagnosis.effect_model(with_hybrid))
    np.testing.assert_allclose(two.rms_db, 0.8, rtol=1e-6)
    np.testing.assert_allclose(two.difference_db[np.isfinite(two.difference_db)], 0.8, rtol=1e-6)
    assert two.references == ("100+Z", "105+Z")
    text = text_of(sections(with_hybrid)["diagnosis"])
    assert "They differ by 0.80 dB rms (from 100+Z 0.80 dB and from 105+Z 0.80 dB)" in text
    assert "0.40 dB, or more" in text


@pytest.mark.parametrize(
    ("errors", "verdict", "text"),
    [
        ((0.35, 0.13, 12.34), "explained",
         "; idle model + effects: 0.13 dB against 0.35 dB of the hybrid route on the validation FRFs (idle model: 12.3 dB; level 5 N)."),
        ((12.34, 21.5, 30.0), "unexplained",
         "; idle model + effects: 21.50 dB against 12.34 dB of the hybrid route on the validation FRFs (idle model: 30.0 dB; level 5 N)."),
        ((0.35, None, 5.01), "explained",
         ", off by 0.35 dB from the validation measurement in operation, level 5 N (idle model: 5.01 dB); no diagnosis was made."),
        ((0.35, None, 0.13), "no_misfit",
         "; idle model: 0.13 dB against 0.35 dB of the hybrid route on the validation FRFs (level 5 N)."),
    ],
)  # fmt: skip
def test_each_error_of_the_recommended_route_is_stated_once(errors, verdict, text):
    effects = [] if verdict == "no_misfit" else [{}]
    models = {key: {"error_db": error} for key, error in zip(("ofrf", "effect", "idle"), errors, strict=True) if error is not None}
    found = None if "no diagnosis" in text else {"verdict": verdict, "effects": effects}
    results = Results("x", comparison={"models": models, "judged_on": {"level_name": "5 N"}}, diagnosis=found, hybrid=object())
    words = route_words(results)
    assert words.endswith(f"){text}"), words
    for error in filter(None, errors):
        assert len(re.findall(rf"\b{error:.2f} dB|\b{error:.1f} dB", words)) == 1


def test_route_with_the_effect_is_told_nearer_to_the_check(whole):
    text = text_of(sections(replace(whole, hybrid=Louder(whole.idle, 1.0)))["diagnosis"])
    assert "the second route is nearer" in text


def test_gyroscopic_effect_speaks_against_the_hybrid_route(whole):
    spin = {
        "kind": "gyroscopic",
        "location": ["101+Z", "104+Z"],
        "parameters": {"coefficient": {"value": 2.0, "unit": "N s/m", "std": 0.1}},
    }
    found = document(effects=(spin,))
    text = text_of(sections(replace(whole, hybrid=Louder(whole.idle, 1.0), diagnosis=found))["diagnosis"])
    assert "trust the second" in text
    assert "no dynamic stiffness" not in text or "(a channel, a rotor, or the whole)" in text


def test_channel_fault_excuses_reciprocity_in_the_check(whole):
    skew = whole.check[0].frf.data.copy()
    skew[5, 0] *= 3.0
    check = [CheckRun("check/run1.uff", "5 N", replace(whole.check[0].frf, data=skew))]
    gain = {"kind": "force_gain", "location": ["105+Z"], "parameters": {"gain": {"value": 3.0, "unit": "", "std": 0.01}}}
    state = lambda d: next(a for a in assumptions(replace(whole, check=check, diagnosis=d)) if a.name == RECIPROCITY)  # noqa: E731
    assert state(None).state == "fails"
    assert state(document(effects=(gain,))).state == "doubtful"
    assert "force gain at 105+Z" in state(document(effects=(gain,))).text


def test_effect_that_depends_on_the_level_draws_no_frf(whole):
    cubic = Effect("cubic_stiffness", ("103+Z",)).to_dict()
    results = replace(whole, diagnosis=document("partial", (cubic,)))
    assert derive_diagnosis.effect_model(results) is None
    made = sections(results)
    assert "cubic stiffness" in made["missing"]
    assert "an effect depends on the level" in made["diagnosis"]


def restoring(kind="cubic_stiffness"):
    x = np.linspace(-1e-3, 1e-3, 30)
    rows = {"force": (1e9 * x**3).tolist(), "force_std": [0.01] * 30, "law": (1e9 * x**3).tolist()}
    cloud = {"displacement": x.tolist(), "velocity": (100 * x[::-1]).tolist(), "force": (1e9 * x**3).tolist(), "goodness": 0.987}
    return cloud | {
        "kind": kind, "location": ["103+Z"], "binned": rows | {"displacement": x.tolist()},
        "binned_velocity": rows | {"velocity": (100 * x).tolist()},
    }  # fmt: skip


def test_restoring_force_is_drawn_with_its_law_and_levels(whole):
    levels = [LinearEquivalent(f, 1e-4 * f, 0.1, 100 * f * f, 0.0, 0.9).to_dict() for f in (1.0, 4.0)]
    cubic = Effect("cubic_stiffness", ("103+Z",)).to_dict() | {"equivalents": levels}
    found = document("explained", (cubic,)) | {"detection": {"levels_n": [1.0, 4.0], "coherence": [0.9, 0.5], "inhomogeneity": 12.0}}
    found["picture"] = found["picture"] | {"restoring_force": [restoring()]}
    time = np.linspace(0, 1, 50)
    wave = np.sin(20 * time)
    figure = {"record": "low", "dof": "103+Z", "time_s": time.tolist()}
    figure |= {name: (f * wave).tolist() for name, f in (("measured", 1), ("idle", 2), ("simulated", 1.1))}
    found["simulation"] = {"gain_db": 12.3, "horizon_s": 0.5, "records": [{"name": "low", "gain_db": 12.3}], "figure": figure}
    results = replace(whole, diagnosis=found)
    model = derive_diagnosis.effect_model(results)
    (spring,) = model.effects
    assert spring.kind == "ground_spring"
    assert spring.values["stiffness"] == pytest.approx(100)
    made = sections(results)
    assert "98.70 % of the force" in made["diagnosis"]
    assert "differ by 12" in made["diagnosis"]
    assert made["diagnosis"].count("Restoring force that the records ask for") == 1
    assert "falls by 12.3 dB" in made["diagnosis"]
    assert "Acceleration at 103+Z" in text_of(simulation_figure(figure))
    text = text_of(level_figure(levels, "103+Z: cubic stiffness"))
    assert "1.00 N" in text
    assert force_figure(restoring() | {"binned_velocity": {}}, "103+Z").startswith("<svg")


def test_effect_between_sensors_is_named_by_its_position(whole):
    between = {k: v for k, v in MASS.items() if k != "location"} | {"location": [], "position": [0.45, 0.0, 0.0], "direction": "+Z"}
    found = document(effects=(between,))
    found["picture"]["dynamic_stiffness"][0]["location"] = []
    assert "(0.45, 0, 0) m, +Z" in diagnosis_words(found).found[0]
    made = sections(replace(whole, diagnosis=found))
    assert "(0.45, 0, 0) m, +Z" in text_of(made["missing"][made["missing"].index("<figure>") :])
    assert "(0.45, 0, 0) m, +Z: point mass 200 ± 2 g" in text_of(made["diagnosis"])
    assert "acts on the whole" not in made["diagnosis"]
    everywhere = {"kind": "global_stiffness", "location": [], "parameters": {"change": {"value": 0.01, "unit": "", "std": 1e-4}}}
    assert "acts on the whole" in sections(replace(whole, diagnosis=document(effects=(everywhere,))))["diagnosis"]


def test_covariance_of_other_effects_is_not_used(whole):
    model = derive_diagnosis.effect_model(replace(whole, effect_covariance=np.eye(3)))
    assert model is not None
    assert model.covariance is None


@pytest.mark.parametrize("verdict", VERDICTS)
@pytest.mark.parametrize("kind", ["check", "modes"])
def test_every_verdict_renders(whole, verdict, kind):
    effects = () if verdict == "no_misfit" else (MASS,)
    n = 1 + len(effects)
    if kind == "check":
        alike = [spring()] if effects else []
        results = replace(whole, diagnosis=document(verdict, effects, (3.0, 2.0)[:n], (90.0, 30.0)[:n], ambiguous_with=alike))
    else:
        results = replace(whole, diagnosis=output_only(verdict, effects), check=[], comparison=None)
    made = sections(results)
    text = text_of(made["missing"] + made["diagnosis"])
    assert VERDICTS[verdict][0] in text
    assert verdict.replace("_", " ") in text
    assert not re.search(r"\bnan\b|\bNone\b", text)
    if kind == "modes":
        assert "operational modes alone count. The error of the idle model is largest at 31.50 Hz: reduced chi-square 300" in text
        assert "There is no validation measurement to draw FRFs before and after against" in text


MISSING = (
    "data",
    "effects",
    "ambiguous_with",
    "proposed_measurement",
    "ladder",
    "candidates",
    "where",
    "noise_floor_db",
    "picture",
    "notes",
)


@pytest.mark.parametrize("key", MISSING)
def test_missing_keys_are_said_or_left_out(whole, key):
    found = {k: v for k, v in document().items() if k != key}
    made = sections(replace(whole, diagnosis=found))
    assert text_of(made["missing"])
    said = {
        "ladder": "holds no error by step",
        "candidates": "No candidates were kept",
        "picture": "no dynamic stiffness",
        "effects": "There is no effect in the model",
    }
    if key in said:
        assert said[key] in text_of(made["missing"] + made["diagnosis"])


def test_results_without_models_still_tell_the_diagnosis():
    bare = Results("bare", diagnosis=document())
    made = sections(bare)
    assert "A mass of 200" in made["missing"]
    assert "Only one route" in made["diagnosis"]
    anchors = [s.anchor for s in build(bare)]
    assert anchors[:2] == ["missing", "answer"]
    without = {s.anchor: s.html for s in build(Results("bare"))}
    assert "missing" not in without
    assert "No diagnosis was made" in without["diagnosis"]


def test_diagnosis_sections_are_quick(whole):
    sections(whole)
    start = time.process_time()
    sections(whole)
    assert time.process_time() - start < 2.0


def test_every_line_keeps_its_place():
    frf = Frf(np.ones((1, 1, 10), complex), FrequencyAxis(np.arange(1.0, 11.0)), (Dof(1, "Z"),), (Dof(1, "Z"),))
    assert derive_diagnosis.every(frf, 20) is frf
    assert derive_diagnosis.every(frf, 4).frequencies_hz.tolist() == [1.0, 4.0, 7.0, 10.0]


@pytest.mark.parametrize(
    ("floor", "said", "drawn"),
    [
        (0.1, "noise and the model's own uncertainty explain 0.10 dB of it.", True),
        (0.6, "no larger than what noise and the model's own uncertainty make (0.60 dB), so nothing is left to explain.", True),
        (121.0, f"alone may make more than {FLOOR_DB:g} dB, so how much of it is an error of the model cannot be stated.", False),
    ],
)
def test_no_more_than_all_of_an_error_is_explained_by_noise(floor, said, drawn):
    words = diagnosis_words(document(noise_floor_db=floor))
    [sentence] = [s for s in words.sentences if "own uncertainty" in s]
    assert sentence.endswith(said)
    assert (words.ladder.shown_floor == floor) == drawn


def test_a_floor_above_the_error_does_not_outweigh_the_chi_square():
    words = diagnosis_words(document(noise_floor_db=0.6, misfits=(5000.0, GOOD)))
    [sentence] = [s for s in words.sentences if "own uncertainty" in s]
    assert sentence.endswith("make (0.60 dB), but the reduced chi-square says that something is left.")


def test_what_differs_farther_than_days_do_may_be_what_has_changed():
    rows = [{"what": "stiffness", "location": [], "value": -0.024, "std": 0.0007, "unusual": True}]
    assert between_words({"between": rows}).endswith("Farther than days in a laboratory: stiffness; that may be part of what has changed.")
    gains = [{"what": "sensor_gain", "location": [f"{i}+Z"], "value": 1.2, "std": 0.01, "unusual": True} for i in range(6)]
    assert "Farther than days in a laboratory: stiffness, sensor gain 0+Z," in between_words({"between": [*gains, *rows]})
    usual = between_words({"between": [rows[0] | {"unusual": False}]})
    assert usual == "Between the two measurements differ, as days in a laboratory do: stiffness by −2.4 ± 0.1 %."
    rows = [{"what": what, "location": [], "value": v, "std": 0.0009} for what, v in (("damping", 1.02), ("stiffness", -0.02))]
    assert between_words({"between": rows}).endswith("stiffness by −2.0 ± 0.2 % and damping by +2.0 ± 0.2 %.")


@pytest.mark.parametrize(("days", "said"), [
    ((False, False), "the error of the idle model is 3.00 dB, with the effect 0.15 dB"),
    ((False, True), "the error of the idle model is 3.00 dB, with the effect and what differs between the two measurements 0.15 dB"),
    ((True,), "the error of the idle model with what differs between the two measurements is 3.00 dB"),
])  # fmt: skip
def test_what_an_error_has_beside_the_effect_is_said(days, said):
    rows = [{"step": i, "added": None, "heldout_error_db": (3.0, 0.15)[i], "with_between": w} for i, w in enumerate(days)]
    assert said in diagnosis_words({"verdict": "explained", "ladder": rows, "data": ["check_frf"]}).sentences[0]

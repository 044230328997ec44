"""What check lines tell of the idle model once the effect is known: a chain whose idle model is in error as its covariance says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from operando.data import ModalModel
from operando.diagnose import diagnose
from operando.diagnose.diagnosis import make_problem, with_what_was_learnt
from operando.diagnose.learn import learn, on_all_lines
from operando.diagnose.predict import Term
from operando.diagnose.result import effects_of, model_of
from operando.effects import Effect
from structures import Chain
from test_diagnose_check import DOFS, HZ, N, at, running

SIZE = 0.15
PLACE = 4


@pytest.fixture(scope="module")
def chain():
    return Chain(N)


def drawn_idle(chain, seed):
    """Modal parameters with errors drawn from the covariance that is stated."""
    rng = np.random.default_rng(seed)
    std = np.r_[2e-5 * chain.hz, 0.02 * chain.zeta, (0.01 * np.sqrt(np.mean(chain.phi**2, axis=0))[None] * np.ones((N, 1))).T.ravel()]
    error = std * rng.standard_normal(std.size)
    shapes = chain.phi + error[2 * N :].reshape(N, N).T
    return ModalModel(
        chain.hz + error[:N],
        chain.zeta + error[N : 2 * N],
        shapes,
        DOFS,
        scaling="unit_modal_mass",
        covariance=np.diag(std**2),
        band_hz=(float(HZ[0]), float(HZ[-1])),
    )


def settled(idle, check):
    """The mass of known place fitted with what its place leaves open."""
    problem = make_problem(idle, check)
    term = Term.of(Effect("point_mass", (DOFS[PLACE],), {"mass": 0.1}), idle, (float(HZ[0]), float(HZ[-1])))
    return problem, problem.settled(problem.joint([term], [term.inward({"mass": 0.1})]))


def check_of(chain, seed):
    """Two runs: only their difference tells how many lines share their noise."""
    return [replace(running(chain, [0], mass=SIZE * at(PLACE), seed=2 * seed + k), name=f"run {k}") for k in range(2)]


def error_db(model, exact):
    made = model.frf(HZ, DOFS, exact.references, "accelerance", variance=True)
    return float(np.sqrt(np.mean((20 * np.log10(np.abs(made.data) / np.abs(exact.data))) ** 2))), made


def test_prediction_and_size_get_better_and_the_intervals_hold(chain):
    exact = running(chain, [0], mass=SIZE * at(PLACE), noise=0.0).frf
    before, after, z, held, widths, last, z_last, held_last = [], [], [], [], [], [], [], []
    for seed in range(40):
        problem, fit = settled(drawn_idle(chain, seed), check_of(chain, 100 + seed))
        told = learn(problem, fit)
        assert told.learnt is not None
        before.append(error_db(model_of(problem, fit), exact)[0])
        size, made = error_db(model_of(problem, told), exact)
        after.append(size)
        effect = effects_of(told)[0]
        z.append((effect.values["mass"] - SIZE) / effect.std["mass"])
        widths.append(effect.std["mass"] / effects_of(fit)[0].std["mass"])
        held.append(np.mean(np.abs(made.data - exact.data) ** 2 < 3.0 * made.variance))
        # Once they have judged, the judge lines tell, too.
        every = on_all_lines(problem, told)
        size, made = error_db(model_of(problem, every), exact)
        last.append(size)
        effect = effects_of(every)[0]
        z_last.append((effect.values["mass"] - SIZE) / effect.std["mass"])
        held_last.append(np.mean(np.abs(made.data - exact.data) ** 2 < 3.0 * made.variance))
    assert np.median(after) < 0.5 * np.median(before)
    assert np.median(widths) < 1
    assert 0.85 <= np.mean(np.abs(z) < 1.96) <= 1.0
    assert 0.6 < np.std(z) < 1.4
    assert np.median(last) < np.median(after)
    assert np.mean(np.abs(z_last) < 1.96) >= 0.85
    assert 0.6 < np.std(z_last) < 1.4
    # |complex normal|² over its variance is below 3 in 95 % of cases.
    assert 0.88 < np.mean(held) <= 0.99
    assert 0.88 < np.mean(held_last) <= 0.99


def test_an_idle_model_that_agrees_is_left_alone(chain):
    exact = ModalModel(
        chain.hz,
        chain.zeta,
        chain.phi,
        DOFS,
        scaling="unit_modal_mass",
        covariance=np.diag(np.r_[1e-6 * chain.hz, 1e-4 * chain.zeta, np.full(N * N, 1e-4)] ** 2),
        band_hz=(float(HZ[0]), float(HZ[-1])),
    )
    problem, fit = settled(exact, check_of(chain, 0))
    assert learn(problem, fit).learnt is None
    assert learn(problem, replace(fit, terms=(), q=())).learnt is None


def test_the_diagnosis_says_so_and_the_last_step_shows_it(chain):
    found = diagnose(drawn_idle(chain, 1), check=check_of(chain, 101))
    assert [e.kind for e in found.effects] == ["point_mass"]
    assert any("corrected the frequencies" in note for note in found.notes)
    assert any("lines of the judge set counted" in note for note in found.notes)
    assert found.model is not None
    assert not np.allclose(found.model.idle.frequencies_hz, found.idle.frequencies_hz, rtol=1e-9)
    assert found.ladder[-1]["added"]["parameters"]["mass"]["value"] == pytest.approx(found.effects[0].values["mass"])


def test_nothing_is_kept_that_predicts_unseen_lines_worse(chain):
    problem, fit = settled(drawn_idle(chain, 2), check_of(chain, 102))
    rows = [{"heldout_misfit": 1e9}, {"heldout_misfit": 0.0}]
    assert with_what_was_learnt(problem, rows, [problem.empty(), fit])[1][-1] is fit


def test_where_nothing_was_learnt_the_last_fit_has_all_lines_too(chain):
    problem, fit = settled(drawn_idle(chain, 3), check_of(chain, 103))
    every = on_all_lines(problem, fit)
    assert every.learnt is None
    assert on_all_lines(problem, replace(fit, excess=9.0)).excess == 9.0, "no surer than the judge lines let it be"
    assert every.std[0][0] < 1.05 * fit.std[0][0]
    assert every.q[0][0] != fit.q[0][0]
    assert abs(every.q[0][0] - fit.q[0][0]) < 4 * fit.std[0][0]

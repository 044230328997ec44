"""One reference that hardly drives a mode: the columns of all other places hang on a factor that nothing has shown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from effect_truth import at, chain_and_idle, receptance
from operando.data import Frf
from operando.diagnose import diagnose
from operando.diagnose.afar import from_afar, hardly_known
from operando.diagnose.diagnosis import make_problem
from operando.diagnose.problem import scan
from operando.diagnose.search import Search, from_everywhere
from operando.diagnose.sets import SELECT
from operando.results import CheckRun

N, DRIVEN, AT, SIZE = 9, 4, 2, 2500.0
HZ = np.arange(6, 130, 0.1)
SPREAD = {1: 0.4, 3: 0.6}
OFF = {1: 1.5, 3: 0.4}
"""Factors that the shapes of modes with a node near the driven DOF are wrong by, at all others."""


@pytest.fixture(scope="module")
def known():
    """Idle model from one DOF alone, some modal masses wrong as its covariance says; the check from there."""
    chain, true = chain_and_idle(N)
    phi, root = np.array(true.shapes), []
    for mode in range(N):
        f = OFF.get(mode, 1.0)
        others = np.arange(N) != DRIVEN
        phi[:, mode] *= np.where(others, f, 1 / f)
        direction = np.zeros((N, N))
        direction[mode] = phi[:, mode] * np.where(others, 1, -1)
        root.append(SPREAD.get(mode, 1e-3) * direction.ravel())
    small = np.r_[1e-6 * chain.hz, 1e-4 * chain.zeta, 1e-4 * np.abs(phi).T.ravel()]
    covariance = np.diag(small**2)
    covariance[2 * N :, 2 * N :] += np.array(root).T @ np.array(root)
    idle = replace(true, shapes=phi, covariance=covariance, band_hz=(HZ[0], HZ[-1]))
    h = receptance(chain, HZ, damping=SIZE * at(N, AT))[:, [DRIVEN]] * -((2 * np.pi * HZ) ** 2)
    spread = 2e-3 * np.sqrt(np.mean(np.abs(h) ** 2, axis=2, keepdims=True))
    rng = np.random.default_rng(3)
    data = h + spread * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    frf = Frf(data, HZ, idle.dofs, (idle.dofs[DRIVEN],), variance=np.broadcast_to(spread**2, h.shape).copy())
    return idle, CheckRun("check", "1 N rms", frf)


def test_places_are_hardly_known_where_nothing_drove(known):
    idle, check = known
    problem = make_problem(idle, [check], None, None, idle.band_hz)
    assert set(hardly_known(problem, np.arange(N)).tolist()) == set(range(N)) - {DRIVEN}
    sure = replace(idle, covariance=np.diag(np.full(len(idle.covariance), 1e-12)), std=None)
    problem = make_problem(sure, [check], None, None, idle.band_hz)
    assert hardly_known(problem, np.arange(N)).size == 0
    assert from_afar(problem, scan(problem, problem.empty())) == []


def test_each_candidate_is_fitted_together_with_what_its_place_leaves_open(known):
    idle, check = known
    problem = make_problem(idle, [check], None, None, idle.band_hz)
    found = scan(problem, problem.empty())
    assert found[0].term.kind.kind != "ground_damper"
    best, *others = from_afar(problem, found)
    (term,) = best.terms
    assert (term.kind.kind, term.dofs) == ("ground_damper", (idle.dofs[AT],))
    assert term.values(best.q[0])["damping"] == pytest.approx(SIZE, rel=0.01)
    assert best.cost < 1.2 * 2 * problem.sets[0].data.size < min(f.cost for f in others)


def test_what_no_drive_point_saw_does_not_hide_the_effect(known):
    idle, check = known
    answer = diagnose(idle, check=[check])
    assert [(e.kind, str(e.location[0])) for e in answer.effects] == [("ground_damper", str(idle.dofs[AT]))]
    assert answer.effects[0].values["damping"] == pytest.approx(SIZE, rel=0.02)


def test_a_search_that_ended_wrong_starts_again_from_every_candidate(known):
    idle, check = known
    problem = make_problem(idle, [check], None, None, idle.band_hz)
    spring = next(c for c in scan(problem, problem.empty()) if c.term.kind.kind == "ground_spring")
    wrong = problem.joint([spring.term], [spring.q])
    before = [problem.misfit(SELECT, problem.empty()), problem.misfit(SELECT, wrong)]
    ended = Search([problem.empty(), wrong], [(problem.tried(wrong), [problem.tried(wrong)])], before)
    again = from_everywhere(problem, ended, 1)
    assert [(t.kind.kind, t.dofs) for t in again.fits[-1].terms] == [("ground_damper", (idle.dofs[AT],))]
    assert problem.misfit(SELECT, again.fits[-1]) < 0.1 * before[-1]
    assert from_everywhere(problem, again, 1) is again  # nothing better than the right one

"""A mode the idle model lacks, the mass of a sensor, and one mode in band: diagnosis against matrices written by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from operando.data import Frf, ModalModel
from operando.diagnose import diagnose
from operando.diagnose.diagnosis import lowering, make_problem, rises
from operando.diagnose.law import alone_by_free_law, gain_by_free_law
from operando.results import CheckRun
from structures import Chain

N = 7
HZ = np.arange(10, 160, 0.15)
DOFS = tuple(f"{i + 1}+Z" for i in range(N))


@pytest.fixture(scope="module")
def chain():
    return Chain(N)


def model(hz, zeta, phi, residual=None, band=None):
    n = hz.size
    std = np.r_[1e-6 * hz, 1e-4 * zeta, np.full(N * n, 1e-4)]
    return ModalModel.from_terms(hz, zeta, phi, DOFS, "unit_modal_mass", covariance=np.diag(std**2), residual=residual, band_hz=band)


def check_of(chain, mass, lines=HZ, noise=2e-3, law=None):
    """Accelerance at two references of M + mass (and a stiffness over lines at the fifth DOF), and noise of known variance."""
    law = np.zeros(lines.size) if law is None else law
    c = chain.M @ chain.phi @ np.diag(4 * np.pi * chain.zeta * chain.hz) @ chain.phi.T @ chain.M
    w = 2 * np.pi * lines
    z = [chain.K + lump(4, k) + 1j * x * c - x**2 * (chain.M + mass) for x, k in zip(w, law, strict=True)]
    h = np.array([-(x**2) * np.linalg.inv(matrix)[:, [0, 3]] for x, matrix in zip(w, z, strict=True)])
    h = np.moveaxis(h, 0, 2)
    spread = noise * np.sqrt(np.mean(np.abs(h) ** 2, axis=2, keepdims=True))
    rng = np.random.default_rng(5)
    data = h + spread * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    frf = Frf(data, lines, DOFS, (DOFS[0], DOFS[3]), variance=np.broadcast_to(spread**2, h.shape).copy())
    return CheckRun("check", "1 N rms", frf)


def lump(i, mass):
    out = np.zeros((N, N))
    out[i, i] = mass
    return out


def poles_with(chain, mass):
    """Operational modes of M + mass, unscaled, with standard deviations of 2e-4."""
    from scipy.linalg import eigh

    values, vectors = eigh(chain.K, chain.M + mass)
    hz = np.sqrt(values) / 2 / np.pi
    std = {"frequencies_hz": 2e-4 * hz}
    return ModalModel(hz, chain.zeta, vectors.astype(complex), DOFS, "unscaled", std=std)


def test_a_missing_mode_is_found_with_its_pole(chain):
    lacks = 2
    keep = [r for r in range(N) if r != lacks]
    idle = model(chain.hz[keep], chain.zeta[keep], chain.phi[:, keep])
    found = diagnose(idle, check=[check_of(chain, np.zeros((N, N)))])
    assert found.verdict == "explained"
    assert [e.kind for e in found.effects] == ["missing_mode"]
    (effect,) = found.effects
    assert effect.values["frequency"] == pytest.approx(chain.hz[lacks], rel=1e-4)
    assert effect.values["damping_ratio"] == pytest.approx(chain.zeta[lacks], rel=0.01)
    shape = np.array([effect.shape[str(d)] for d in idle.dofs])
    error = min(np.abs(shape - s * chain.phi[:, lacks]).max() for s in (1, -1))
    assert error < 0.01 * np.abs(chain.phi[:, lacks]).max()


@pytest.mark.parametrize(("there", "kind"), [(False, "sensor_mass"), (True, "point_mass")])
def test_a_mass_that_the_operating_record_does_not_know_is_a_sensor(chain, there, kind):
    mass = lump(4, 0.15)
    idle = model(chain.hz, chain.zeta, chain.phi)
    operating = poles_with(chain, mass if there else np.zeros((N, N)))
    found = diagnose(idle, check=[check_of(chain, mass)], operating=operating)
    assert [(e.kind, str(e.location[0])) for e in found.effects] == [(kind, "5+Z")]
    assert found.effects[0].values["mass"] == pytest.approx(0.15, rel=0.01)


def test_one_mode_in_band_leaves_kinds_apart_undecided(chain):
    residual = np.arange(N) != 1
    low, high = np.sqrt(chain.hz[0] * chain.hz[1]), np.sqrt(chain.hz[1] * chain.hz[2])
    idle = model(chain.hz, chain.zeta, chain.phi, residual, (low, high))
    found = diagnose(idle, check=[check_of(chain, lump(4, 0.15), np.arange(low, high, 0.02))], band=(low, high))
    assert found.verdict == "ambiguous"
    assert len({e.kind for e in (*found.effects, *found.ambiguous_with)}) >= 2
    assert "point_mass" in {e.kind for e in (*found.effects, *found.ambiguous_with)}
    assert found.proposed_measurement


@pytest.mark.parametrize(("power", "least", "most"), [(0.0, 0.97, 1.0), (1.3, 0.0, 0.5)])
def test_a_law_that_no_kind_has_shows_when_it_may_bend(chain, power, least, most):
    law = 2e4 * (HZ / 60) ** power
    problem = make_problem(model(chain.hz, chain.zeta, chain.phi), [check_of(chain, lump(4, 0.0), law=law)], None, None, (12.0, 150.0))
    term = next(t for t in problem.templates if t.kind.kind == "ground_spring" and str(t.dofs[0]) == "5+Z")
    gain, which = gain_by_free_law(problem, problem.joint([term], [term.inward({"stiffness": 2e4})]))
    assert least <= gain <= most
    assert which is None or which is term


@pytest.mark.parametrize(("power", "mass", "alone"), [(0.0, 0.15, False), (1.3, 0.0, True)])
def test_several_effects_must_earn_their_place_beside_one_of_another_law(chain, power, mass, alone):
    law = 2e4 * (HZ / 60) ** power
    check = check_of(chain, lump(1, mass), law=law)
    problem = make_problem(model(chain.hz, chain.zeta, chain.phi), [check], None, None, (12.0, 150.0))
    spring = next(t for t in problem.templates if t.kind.kind == "ground_spring" and str(t.dofs[0]) == "5+Z")
    lump_mass = next(t for t in problem.templates if t.kind.kind == "point_mass" and str(t.dofs[0]) == "2+Z")
    start = [spring.inward({"stiffness": 2e4}), lump_mass.inward({"mass": 0.1})]
    firsts = [problem.tried(problem.joint([t], [q])) for t, q in zip((spring, lump_mass), start, strict=True)]
    found = alone_by_free_law(problem, problem.joint([spring, lump_mass], start), firsts)
    assert (found is spring) if alone else (found is None)
    assert alone_by_free_law(problem, firsts[0].fit, firsts) is None


@pytest.mark.parametrize(
    ("judge", "kept"),
    [
        ([9.0], 1),
        ([9.0, 1.0], 2),
        ([9.0, 1.0, 1.05], 3),
        ([9.0, 5.0, 80.0], 2),
        ([9.0, 50.0, 12.0, 1.0], 4),
        ([0.9, 2.0, 3.0], 1),
        ([9.0, 5.0, 5.1], 2),
        ([9.0, 9.5], 2),
        ([9.0, 14.0], 1),
        ([9.0, 20.0, 12.0], 1),
    ],
)
def test_last_steps_that_predict_unseen_lines_worse_are_taken_back(judge, kept):
    assert lowering(judge) == kept


def test_two_effects_can_be_told_in_the_other_order(chain):
    from operando.diagnose.search import other_orders

    problem = make_problem(
        model(chain.hz, chain.zeta, chain.phi), [check_of(chain, lump(1, 0.15), law=np.full(HZ.size, 2e4))], None, None, (12.0, 150.0)
    )
    spring = next(t for t in problem.templates if t.kind.kind == "ground_spring" and str(t.dofs[0]) == "5+Z")
    mass = next(t for t in problem.templates if t.kind.kind == "point_mass" and str(t.dofs[0]) == "2+Z")
    first = problem.tried(problem.joint([spring], [spring.inward({"stiffness": 2e4})]))
    both = problem.tried(problem.joint([spring, mass], [first.fit.q[0], mass.inward({"mass": 0.1})]))
    ((fits, history),) = other_orders(problem, both.fit, [(first, [first]), (both, [both])])
    assert [[t.kind.kind for t in f.terms] for f in fits] == [[], ["point_mass"], ["point_mass", "ground_spring"]]
    assert [best.term.kind.kind for best, _ in history] == ["point_mass", "ground_spring"]
    assert fits[-1].cost == pytest.approx(both.fit.cost, rel=0.01)
    assert history[-1][1] == [first]


@pytest.mark.parametrize(
    ("judge", "up"), [([9.0, 12.0, 1.0], True), ([9.0, 5.0, 1.0], False), ([9.0, 12.0], False), ([9.0, 5.0, 6.0, 1.0], True)]
)
def test_a_ladder_rises_where_a_step_before_the_last_does(judge, up):
    assert rises([{"heldout_misfit": v} for v in judge]) is up


def test_the_own_compliance_of_a_place_is_fitted_before_everything_else(chain):
    from operando.diagnose.shapes import own_compliances, shape_prior

    alone = np.zeros((N, 2))
    alone[4, 0], alone[5, 1] = 0.3, 0.2
    hz, zeta = np.r_[chain.hz, 400.0, 400.0], np.r_[chain.zeta, 1e-3, 1e-3]
    idle = model(hz, zeta, np.c_[chain.phi, alone], np.r_[np.zeros(N, bool), True, True])
    variance = np.diag(idle.covariance).copy()
    at = 2 * (N + 2) + N * N
    variance[at:] = np.where(alone.T.ravel() != 0, (0.5 * alone.T.ravel()) ** 2, 0.0)
    idle = replace(idle, covariance=np.diag(variance), std=None)
    prior = shape_prior(idle, np.array([4]))
    own = own_compliances(prior, np.array([4]))
    assert own.shape == (prior.size, 1)
    moved = prior.turned(own).moved(np.array([1.0])) - prior.base
    assert abs(moved[4, N]) == pytest.approx(0.15)
    moved[4, N] = 0
    assert np.abs(moved).max() < 1e-3
    assert own_compliances(prior, np.array([0])).shape == (prior.size, 0)

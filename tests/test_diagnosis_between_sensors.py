"""What acts between sensors: products of its shapes were not measured, in band or beyond it, and are those of the shapes."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from operando.diagnosis import hypotheses, sizes
from operando.diagnosis.arrow import Factor
from operando.diagnosis.case import AsItIs, Case
from operando.diagnosis.corrected import model_of
from operando.diagnosis.criteria import EXPLAINED, LOOSE
from operando.diagnosis.found import Found
from operando.diagnosis.hypotheses import Hypotheses
from operando.diagnosis.idle import Idle
from operando.diagnosis.midway import located, with_midway
from operando.diagnosis.posterior import State
from operando.diagnosis.problem import Problem, Step
from operando.diagnosis.rival import started
from operando.diagnosis.terms import Term
from test_diagnosis import BAND, DOFS, N, identified, matrices, measured, modes
from test_diagnosis_elsewhere import LINE

DAMPER = 40.0  # N·s/m


def with_a_damper(kind="ground_damper", size=DAMPER):
    """The chain with two modes as residual terms, a place between its sensors with shapes far from the suggested ones, what acts there."""
    idle = Idle.of(identified(residual=2), BAND, [DOFS[0], DOFS[3]])
    wider = with_midway(idle, LINE)
    mass, stiff = matrices()
    band = (BAND[0], float(modes()[0][N - 2] / 2 / np.pi) - 1)
    one = Case(wider, measured(mass, modes()[3], stiff, (0, 3), 2e-4, 0), band, {}, correlated=1.0)
    place = N + 1
    terms = (Term(kind, (place,), (float(np.log(size)),)),)
    forward = one.forward
    x = started(one, terms)
    x.own[place, : forward.n_shape] = 1.5 * np.random.default_rng(3).standard_normal(forward.n_shape)
    return one, place, x


@pytest.mark.parametrize("size", [DAMPER, 1e4])
def test_frfs_are_those_of_all_shapes_there(size):
    """A damper that all but holds the place: what residual terms add to its own motion is the sum of squares of their shapes there."""
    one, place, x = with_a_damper(size=size)
    made, w = one.forward.moved(x), one.lines.w[::7]
    assert made.phi[place, -1] != pytest.approx(one.idle.phi[place, -1], rel=0.1)  # of a residual term
    for row, line in enumerate(w):
        wr = 2 * np.pi * made.f
        dynamic = np.diag(wr**2 - line**2 + 2j * made.zeta * wr * line) + 1j * line * size * np.outer(made.phi[place], made.phi[place])
        wanted = made.phi[:N] @ np.linalg.solve(dynamic, made.phi[[0, 3]].T)
        np.testing.assert_allclose(one.forward.predict(x, w[row : row + 1], derivatives=False).h[0], wanted, rtol=1e-9)


def test_derivatives_there_are_those_of_the_frfs():
    one, place, x = with_a_damper()
    rng = np.random.default_rng(5)
    x = replace(x, g=rng.standard_normal(x.g.size), u=0.3 * rng.standard_normal(x.u.size))
    x.own[:N] = rng.standard_normal(x.own[:N].shape)
    problem = Problem(one, x.terms, one.lines.fit[::9])
    packed = problem.packed(x)
    exact = problem.predict(packed)
    for i in range(problem.n_shared):
        width = 1e-3 if i < one.forward.n_g else 1e-5  # the idle model moves the FRFs by little more than rounding
        move = Step(width * np.eye(problem.n_shared)[i], np.zeros_like(packed.own))
        up, down = (problem.predict(packed + move * side, False).h for side in (1, -1))
        wanted = (up - down) / (2 * width)
        np.testing.assert_allclose(exact.shared[..., i], wanted, rtol=2e-3, atol=5e-5 * np.abs(wanted).max() + 1e-17, err_msg=str(i))
    assert [dof for dof, _, _ in problem.reaching] == [place]


def test_the_model_handed_out_has_the_same_products():
    one, _, x = with_a_damper("ground_spring", 3e4)
    problem = Problem(one, x.terms, one.lines.fit)
    information = problem.derived(problem.packed(x))[0].information(problem.weights(0.01))
    factor = Factor.of(information, problem.precision, problem.own_precision)
    state = State(x, 0.01, 0.0, factor, problem)
    found = replace(model_of(identified(residual=2), state, located(LINE, one.idle)), discrepancy=0.0)
    lines = one.lines.w[one.lines.fit]
    got = found.frf(lines / 2 / np.pi, list(DOFS), [DOFS[0], DOFS[3]], "receptance")
    wanted = np.moveaxis(one.forward.predict(x, lines, derivatives=False).h, 0, 2)
    np.testing.assert_allclose(got.data, wanted, rtol=1e-3, atol=1e-3 * np.abs(wanted).max())
    made = one.forward.predict(x, lines)
    root = factor.root()
    variance = np.zeros(wanted.shape)
    for row in range(N):
        mine = slice(problem.n_shared + row * one.forward.n_own, problem.n_shared + (row + 1) * one.forward.n_own)
        along = made.shared[:, row] @ root[: problem.n_shared] + made.own[:, row] @ root[mine]
        variance[row] = np.sum(np.abs(along) ** 2, axis=-1).T
    np.testing.assert_allclose(got.variance, variance, rtol=0.03)


@pytest.mark.parametrize(
    ("fall", "step", "low", "high"),
    [(sizes._FALL, sizes._FINE, 1.0, 1.03), (1.0, sizes._FINE, 0.7, 0.97), (sizes._FALL, 2 * sizes._FINE, 1.03, 1.3)],
)
def test_steps_and_sides_of_held_sizes_are_fine_and_far_enough(monkeypatch, fall, step, low, high):
    """Of a normal law of unit standard deviation, begun anywhere: cut off 1 nat below it looks narrow, in twice the steps wide."""
    monkeypatch.setattr(sizes, "_FALL", fall)
    starts = step * np.linspace(-0.5, 0.5, 9)
    found = [sizes._moments(sizes._walked(lambda x: -0.5 * x**2, float(start), step)) for start in starts]
    std = np.array([std for _, std, _ in found])
    assert low < np.sqrt(np.mean(std**2)) < high
    if (low, high) == (1.0, 1.03):
        assert max(abs(mean) for mean, _, _ in found) < 0.01
        np.testing.assert_allclose([whole for _, _, whole in found], 0.5 * np.log(2 * np.pi), atol=0.03)


@pytest.mark.parametrize(("alpha", "searches"), [(1.01 * LOOSE, 1), (0.99 * LOOSE, 3)])
def test_locations_between_sensors_are_searched_once_where_none_leaves_little(monkeypatch, alpha, searches):
    """What a state has to score does not change what it leaves; a lower bar ends a search later, so that one is run again.

    Locations are laid and scanned once.
    """
    idle = SimpleNamespace(midway={9: (0.5, 0.0, 0.0)})
    case = SimpleNamespace(uncompressed=None, idle=idle, at_rest=AsItIs(), forward=SimpleNamespace(start=None))
    ended = SimpleNamespace(alpha=alpha, log_evidence=-50.0, terms=())
    ran, laid, scans = [], [], []
    monkeypatch.setattr(hypotheses, "with_midway", lambda uncompressed, geometry: laid.append(1) or idle)
    rows = [(-1.0, Term("ground_spring", (9,), (1.0,)), False)]
    monkeypatch.setattr(hypotheses, "robust_scan", lambda case, x: scans.append(1) or rows)
    monkeypatch.setattr(hypotheses, "Rival", lambda days, alone: SimpleNamespace(score=0.0))
    monkeypatch.setattr(hypotheses, "score", lambda state: state.log_evidence)
    monkeypatch.setattr(hypotheses, "search", lambda *args, **how: ran.append(args) or SimpleNamespace(best=ended))
    monkeypatch.setattr(hypotheses, "fit", lambda case, x: SimpleNamespace(log_evidence=-10.0))
    found, both = SimpleNamespace(empty=SimpleNamespace(case=case)), Hypotheses(case, case, again=lambda idle: (None, case), geometry=LINE)
    for bar in (-5.0, -5.0, 0.0):
        assert both.one_between_sensors(found, bar) is None
    assert len(ran) == searches
    both.one_between_sensors(found, -7.0)
    assert len(ran) == searches + 1
    assert (len(laid), len(scans)) == (1, 1)


@pytest.mark.parametrize(("alpha", "count"), [(0.99 * EXPLAINED, 2), (EXPLAINED, 1)])
def test_sizes_beside_what_explains_nothing_are_not_held(monkeypatch, alpha, count):
    case, terms = SimpleNamespace(idle=SimpleNamespace(midway=dict.fromkeys((9, 10)))), {"a": 9, "b": 10}
    pool = {
        key: SimpleNamespace(key=key, terms=(Term("ground_spring", (at,), (1.0,)),), alpha=alpha, case=case, log_evidence=float(at))
        for key, at in terms.items()
    }
    asked = []
    monkeypatch.setattr(sizes, "at_likely_size", lambda state, number: asked.append(state.key) or state)
    monkeypatch.setattr(sizes, "score", lambda state: state.log_evidence)
    monkeypatch.setattr(sizes, "names", lambda case, terms: [])
    sizes.with_likely_sizes(Found(pool["b"], pool["a"], pool))
    assert asked == ["b", "a"][:count]


@dataclass
class Held:
    """A state whose evidence is a normal law of its size, ten times as narrow as the steps it is first looked at in."""

    terms: tuple
    alpha: float
    log_evidence: float
    case: Any = field(
        default_factory=lambda: SimpleNamespace(prior=lambda term: (np.zeros(1), np.ones(1)), idle=SimpleNamespace(midway={}))
    )
    problem: Any = field(default_factory=lambda: SimpleNamespace(n_values=1))
    sizes: dict = field(default_factory=dict)
    covariance = np.eye(1)


@pytest.mark.parametrize(("alpha", "finer"), [(0.99 * EXPLAINED, True), (EXPLAINED, False)])
def test_sizes_are_held_in_finer_steps_only_where_lines_are_explained(monkeypatch, alpha, finer):
    asked = []

    def fitted(case, x, alpha, **how):
        asked.append(x.terms[0].values[0])
        return Held(x.terms, alpha, -50 * x.terms[0].values[0] ** 2)

    monkeypatch.setattr(sizes, "fitted_if_can_be", fitted)
    monkeypatch.setattr(sizes, "side_by_side", lambda function, items: [function(item) for item in items])
    monkeypatch.setattr(sizes, "_along_valley", lambda state, number, size: Held(state.terms, alpha, 0.0))
    sizes.at_likely_size(Held((Term("ground_spring", (9,), (0.0,)),), alpha, 0.0), 0)
    assert any(1e-9 < abs(size) < 0.5 * np.log(2) for size in asked) == finer

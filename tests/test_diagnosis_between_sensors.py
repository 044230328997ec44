"""What acts between sensors: products of its shapes were not measured, in band or beyond it, and are those of the shapes."""

from dataclasses import replace

import numpy as np
import pytest

from operando.diagnosis import sizes
from operando.diagnosis.arrow import Factor
from operando.diagnosis.case import Case
from operando.diagnosis.corrected import model_of
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
    shared, own, _ = problem.derived(problem.packed(x))
    factor = Factor.of(problem.information(shared, own, problem.weights(0.01)), problem.precision, problem.own_precision)
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

"""Directions in which the idle model's shapes may move: what the driven columns have shown must stay, however far they move."""

from __future__ import annotations

import numpy as np
import pytest

from operando.data import ModalModel
from operando.diagnose.refit import Fit
from operando.diagnose.result import given_shapes
from operando.diagnose.shapes import Scales, driven_rows, shape_prior
from operando.dof import Dof

M, DRIVEN = 6, [0, 4]
HZ = np.r_[12.0, 31.0, 58.0, np.geomspace(90, 1500, 12)]
RESIDUAL = np.arange(HZ.size) >= 3
LINES = np.linspace(5, 75, 30)


@pytest.fixture(scope="module")
def idle():
    """Shapes fitted to two driven columns under a prior, as a linear fit given by its covariance."""
    rng = np.random.default_rng(5)
    shapes = rng.normal(0, 0.3, (M, HZ.size))
    gain = 1 / ((2 * np.pi) ** 2 * (HZ[:, None] ** 2 - LINES**2))
    size = HZ.size * M
    information = np.diag(np.where(np.repeat(RESIDUAL, M), 1 / 0.3**2, 1e8))
    spread = 1e-2 * np.abs(shapes[0] ** 2 @ gain).mean()
    for k in DRIVEN:
        for j in range(M):
            design = np.zeros((size, LINES.size))
            design[np.arange(HZ.size) * M + j] += shapes[k][:, None] * gain
            design[np.arange(HZ.size) * M + k] += shapes[j][:, None] * gain
            information += design @ design.T / spread**2
    covariance = np.zeros((2 * HZ.size + size,) * 2)
    covariance[2 * HZ.size :, 2 * HZ.size :] = np.linalg.inv(information)
    dofs = tuple(Dof.parse(f"{i + 1}+Z") for i in range(M))
    zeta = np.full(HZ.size, 0.01)
    model = ModalModel.from_terms(HZ, zeta, shapes, dofs, "unit_modal_mass", residual=RESIDUAL, covariance=covariance)
    return model, gain, spread


def test_driven_dofs_are_known_by_their_compliance(idle):
    assert driven_rows(idle[0]).tolist() == DRIVEN


def test_far_moves_leave_the_driven_columns(idle):
    model, gain, spread = idle
    prior = shape_prior(model, np.array([2, 3]))
    rng = np.random.default_rng(0)
    column = lambda phi, k: (phi * phi[k]) @ gain  # noqa: E731
    moved_most = 0.0
    for _ in range(20):
        phi = prior.moved(2 * rng.standard_normal(prior.size))
        for k in DRIVEN:
            assert np.max(np.abs(column(phi, k) - column(model.terms.shapes, k))) < 6 * spread
        moved_most = max(moved_most, float(np.max(np.abs(column(phi, 2)[2] - column(model.terms.shapes, 2)[2]))))
    # while the compliance of a DOF that nothing drove moves by far more:
    assert moved_most > 10 * spread


def test_a_driven_place_moves_nowhere_outside_the_band(idle):
    prior = shape_prior(idle[0], np.array([0]))
    assert np.all(prior.root[DRIVEN][:, RESIDUAL] == 0)


def test_a_local_mode_tells_an_undriven_dof_however_well_its_compliance_is_known(idle):
    model = idle[0]
    undriven = [i for i in range(M) if i not in DRIVEN]
    local = np.zeros((M, len(undriven)))
    local[undriven, np.arange(len(undriven))] = 0.3
    n, more = model.terms.n, len(undriven)
    old = np.asarray(model.covariance)[2 * n :, 2 * n :]
    covariance = np.zeros(((n + more) * (2 + M),) * 2)
    covariance[2 * (n + more) :, 2 * (n + more) :][: n * M, : n * M] = 1e-6 * old
    position = 2 * (n + more) + n * M + np.arange(more) * M + undriven
    covariance[position, position] = 1e-8
    dofs = model.dofs
    hz, residual = np.r_[HZ, np.full(more, 150.0)], np.r_[RESIDUAL, np.full(more, True)]
    shapes = np.concatenate([model.terms.shapes, local], axis=1)
    wider = ModalModel.from_terms(hz, np.full(hz.size, 0.01), shapes, dofs, "unit_modal_mass", residual=residual, covariance=covariance)
    assert driven_rows(wider).tolist() == DRIVEN


def scale_unknown(spread):
    """One reference that hardly drives the second mode: φ_i·φ_j is known well with j driven, the scale to ``spread``."""
    rng = np.random.default_rng(8)
    shapes = rng.normal(0, 0.4, (M, 3))
    sense = np.where(np.arange(M) == DRIVEN[0], 1.0, -1.0)
    common = np.zeros((3, M))
    common[1] = spread * sense * shapes[:, 1]
    covariance = np.diag(np.full(6 + 3 * M, 1e-12))
    covariance[6:, 6:] += np.outer(common, common)
    dofs = tuple(Dof.parse(f"{i + 1}+Z") for i in range(M))
    return ModalModel(HZ[:3], np.full(3, 0.01), shapes, dofs, "unit_modal_mass", covariance=covariance)


@pytest.mark.parametrize("far", [-2.0, 0.3, 2.0])
def test_a_scale_that_nothing_has_shown_moves_by_a_factor(far):
    model = scale_unknown(0.8)
    prior = shape_prior(model, np.array([2]))
    z = np.zeros(prior.size)
    z[int(np.argmax(np.abs(prior.root[2, 1])))] = far
    phi = prior.moved(z)
    factor = phi[2, 1] / model.terms.shapes[2, 1]
    assert factor == pytest.approx(np.exp(np.sign(np.log(factor)) * 0.8 * abs(far)), rel=1e-3)
    others = np.arange(M) != DRIVEN[0]
    assert (phi * phi[DRIVEN[0]])[others] == pytest.approx((model.terms.shapes * model.terms.shapes[DRIVEN[0]])[others], rel=1e-4)


def test_the_slope_of_moved_shapes_is_theirs():
    model = scale_unknown(0.8)
    rng = np.random.default_rng(9)
    moves = 0.1 * rng.standard_normal((M, 3, 2))
    scales = Scales.of(model)
    assert np.any(scales.sense != 0, axis=0)[1]
    gone, step = np.array([0.7, -0.4]), 1e-6
    made = scales.slope(np.asarray(model.terms.shapes), moves, moves @ gone)
    for k in range(2):
        ends = [scales.moved(np.asarray(model.terms.shapes), moves @ (gone + s * step * np.eye(2)[k])) for s in (1, -1)]
        assert made[:, :, k] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-6, abs=1e-8)


def test_the_move_of_moved_shapes_is_found_again():
    model = scale_unknown(0.8)
    base, scales = np.asarray(model.terms.shapes), Scales.of(model)
    move = 0.2 * np.random.default_rng(10).standard_normal(base.shape)
    assert scales.move(base, scales.moved(base, move)) == pytest.approx(move, abs=1e-12)


def test_what_lies_outside_is_held_at_driven_dofs_when_the_idle_model_learns(idle):
    """Else products of two values that move would change columns which the check does not drive."""
    model = idle[0]
    fit = Fit((), (), np.asarray(model.terms.shapes), shape_prior(model, np.zeros(0, int)))
    n = model.terms.n
    held = 2 * n + (np.flatnonzero(RESIDUAL)[:, None] * M + np.array(DRIVEN)).ravel()
    assert np.all(given_shapes(model, fit, driven=True)[held] == 0)
    assert np.all(np.diag(given_shapes(model, fit))[held] > 0)

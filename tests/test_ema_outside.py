"""What lies outside the band: modes beyond the lines that next to nothing drives belong to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from operando.data import Frf
from operando.dof import Dof
from operando.ema.outside import (
    INDEPENDENT,
    LOCAL,
    LOCAL_SHAPE,
    MOST_DAMPING,
    MOST_TOLERANCE,
    N_LINES,
    SHIFT,
    TOLERANCE,
    UPPER,
    make_up,
    outside_modes,
    without_modes,
)
from operando.ema.polish import Polished
from operando.ema.polish_model import Parameters
from operando.ema.spectra import frf_spectra
from structures import Chain

N, INSIDE, REFS = 9, 6, (0, 3)
BAND = (4.0, 112.0)


@pytest.fixture(scope="module")
def chain():
    return Chain(N)


@pytest.fixture(scope="module")
def runs(chain):
    dofs = tuple(Dof.parse(f"{i + 1}+Z") for i in range(N))
    hz = np.arange(2.0, 118.0, 0.25)
    frf = Frf(chain.accelerance(hz, ref=REFS), hz, dofs, tuple(dofs[r] for r in REFS), variance=np.full((N, len(REFS), hz.size), 1e-8))
    return frf_spectra(frf, dofs, (float(hz[0]), float(hz[-1])))


def fitted(chain, runs, odd_shape, odd_std, outside_hz=(140.0, 170.0), local=1e-3):
    """The modes inside as they are, and one beyond the lines that holds part of the driven columns, driven by next to nothing."""
    n = INSIDE + 1
    shapes = np.c_[chain.phi[:, :INSIDE], odd_shape]
    std = np.full((n, N), 1e-3)
    std[-1] = odd_std
    hz = np.r_[chain.hz[:INSIDE], 121.0]
    outside_hz = np.array(outside_hz)
    theta = Parameters(
        hz,
        np.full(n, 0.01),
        shapes,
        outside_hz,
        np.full(outside_hz.size, 0.01),
        tuple(np.zeros((2, 0)) for _ in runs),
        tuple(np.tile(np.broadcast_to(local, (N, outside_hz.size)), run.force_rows.size) for run in runs),
    )
    information = [(np.zeros(0), 1e12 * np.eye(N * outside_hz.size * run.force_rows.size)) for run in runs]
    variance = np.r_[np.full(2 * n, 1e-8), (std**2).ravel()]
    return Polished(theta, np.diag(variance), tuple(information), 0.0, 1, 1, True)


def odd(scale):
    shape = np.linspace(-1, 1, N) * scale
    shape[list(REFS)] = 0.01 / scale
    return shape


def test_a_mode_driven_by_next_to_nothing_is_found(chain, runs):
    usual = float(np.sqrt(np.mean(chain.phi**2)))
    assert make_up(runs, fitted(chain, runs, odd(20 * usual), 20 * usual)).tolist() == [INSIDE]
    assert make_up(runs, fitted(chain, runs, odd(usual), 20 * usual)).tolist() == [INSIDE]
    # A mode beyond the lines that is known well is a mode, however large; and so is a vague one among the lines.
    assert make_up(runs, fitted(chain, runs, odd(20 * usual), 1e-3)).size == 0
    assert make_up(runs, fitted(chain, runs, odd(usual), 1e-3)).size == 0
    inside = fitted(chain, runs, odd(usual), 1e-3)
    inside.covariance[2 * (INSIDE + 1) + 2 * N, 2 * (INSIDE + 1) + 2 * N] = 100.0
    assert make_up(runs, inside).size == 0


def test_the_others_stay_with_their_covariance(chain, runs):
    fit = fitted(chain, runs, odd(5.0), 1e-3)
    fit.covariance[np.diag_indices(len(fit.covariance))] = np.arange(1.0, len(fit.covariance) + 1)
    fewer = without_modes(fit, np.array([INSIDE]))
    n = INSIDE + 1
    assert np.array_equal(fewer.parameters.shapes, chain.phi[:, :INSIDE])
    expected = np.r_[np.arange(1, n), n + np.arange(1, n), 2 * n + np.arange(1, INSIDE * N + 1)]
    assert np.array_equal(np.diag(fewer.covariance), expected)


def test_its_share_of_the_driven_columns_stays_and_no_shape_is_out_of_size(chain, runs):
    usual = float(np.sqrt(np.mean(chain.phi[:, :INSIDE] ** 2)))
    fit = fitted(chain, runs, odd(20 * usual), 20 * usual)
    gone = make_up(runs, fit)
    made = outside_modes(runs, fit, BAND, False, gone=gone)
    f = np.linspace(*BAND, 60)[:, None]
    kernel = lambda hz, zeta: np.real(-(f**2) / (hz**2 - f**2 + 2j * zeta * hz * f))  # noqa: E731
    theta = fit.parameters
    local = sum(kernel(h, 0.01) * 1e-3 for h in theta.outside_hz)
    for row in REFS:
        wanted = local + kernel(theta.hz[-1], theta.zeta[-1]) * (theta.shapes[:, -1] * theta.shapes[row, -1])[None]
        found = kernel(made.hz, made.zeta) @ (made.shapes * made.shapes[row]).T
        # Not exact: that a place is moved by forces which hardly move where they act is what no shape of usual size does.
        assert np.sqrt(np.mean((found - wanted) ** 2)) < 0.15 * np.sqrt(np.mean(wanted**2))
    assert np.max(np.abs(made.shapes)) < 8 * usual
    assert np.max(np.abs(theta.shapes[:, -1])) > 15 * usual


def test_driven_columns_are_known_no_better_than_the_pseudo_modes_make_them(chain, runs):
    """What they leave is smooth over the band: its lines tell no more than INDEPENDENT of them."""
    usual = float(np.sqrt(np.mean(chain.phi[:, :INSIDE] ** 2)))
    hz = np.array([125.0, 150.0, 190.0, 300.0])  # what lies there at each pair is no product of two shapes
    local = 1e-3 * np.random.default_rng(1).uniform(0.5, 1.5, (N, hz.size))
    fit = fitted(chain, runs, odd(20 * usual), 20 * usual, hz, local)
    made = outside_modes(runs, fit, BAND, False, gone=make_up(runs, fit), local_terms=False)
    f = np.linspace(*BAND, 60)[:, None]
    kernel = lambda hz, zeta: np.real(-(f**2) / (hz**2 - f**2 + 2j * zeta * hz * f))  # noqa: E731
    theta, g = fit.parameters, kernel(made.hz, made.zeta)
    assert (N_LINES, INDEPENDENT) == (40, 2)
    ratios = []
    for row in REFS:
        wanted = kernel(hz, 0.01) @ local.T
        wanted = wanted + kernel(theta.hz[-1], theta.zeta[-1]) * (theta.shapes[:, -1] * theta.shapes[row, -1])[None]
        found = g @ (made.shapes * made.shapes[row]).T
        for i in range(N):
            by = np.zeros((f.size, made.hz.size, N))
            by[:, :, i] += g * made.shapes[row]
            by[:, :, row] += g * made.shapes[i]
            by = by.reshape(f.size, -1)
            std = np.sqrt(np.einsum("lp,pq,lq->l", by, made.covariance, by))
            ratios.append(np.sqrt(np.mean((found[:, i] - wanted[:, i]) ** 2) / np.mean(std**2)))
    assert 0.4 < np.median(ratios) < 1.5  # two pairs are made to 2 % of it, the others to 0.2 %, and share the driven shapes with them
    assert np.quantile(ratios, 0.8) < 2


def test_what_the_fit_errs_by_is_asked_of_no_pseudo_mode(chain, runs):
    """TOLERANCE where noise limits the fit, up to MOST_TOLERANCE where a model error does."""
    hz = np.array([125.0, 150.0, 190.0, 300.0])
    local = 1e-3 * np.random.default_rng(1).uniform(0.5, 1.5, (N, hz.size))
    fit = without_modes(fitted(chain, runs, odd(1.0), 1e-3, hz, local), np.array([INSIDE]))
    f = np.linspace(*BAND, 60)[:, None]
    kernel = lambda hz, zeta: np.real(-(f**2) / (hz**2 - f**2 + 2j * zeta * hz * f))  # noqa: E731
    wanted = kernel(hz, 0.01) @ local.T
    left, size = [], []
    assert (TOLERANCE, MOST_TOLERANCE) == (0.01, 0.02)
    for error in (0.0, 0.1):
        made = outside_modes(runs, fit, BAND, False, local_terms=False, model_error=error)
        found = [kernel(made.hz, made.zeta) @ (made.shapes * made.shapes[row]).T for row in REFS]
        left.append(np.sqrt(np.mean((found - wanted) ** 2) / np.mean(wanted**2)))
        size.append(np.sqrt(np.mean(made.shapes**2)))
    assert left[0] < 3 * TOLERANCE  # no products of shapes lie there
    assert left[1] < 2 * MOST_TOLERANCE
    assert size[1] < size[0]


def of_modes(chain, runs, poles, shapes):
    """A fit whose kernels outside the band stand for some modes as they are: hz and damping, shapes (N, modes)."""
    hz, zeta = (np.array(v) for v in zip(*poles, strict=True))
    fit = fitted(chain, runs, odd(1.0), 1e-3, hz, 0.0)
    fit = without_modes(fit, np.array([INSIDE]))
    columns = [np.hstack([shapes * shapes[row] for row in run.force_rows]) for run in runs]
    theta = replace(fit.parameters, outside_zeta=zeta, local=tuple(columns))
    return replace(fit, parameters=theta)


def compliance(hz, shapes):
    return (shapes / hz) @ (shapes / hz).T


def test_pseudo_modes_move_to_where_a_mode_is(chain, runs):
    """A mode three hundredths above the lines, nearer than the first pseudo-mode: at undriven DOFs it is no larger than it is."""
    usual = float(np.sqrt(np.mean(chain.phi**2)))
    shapes = usual * np.random.default_rng(4).standard_normal((N, 3))
    hz = np.array([1.03, 1.3, 2.0]) * runs[0].top_hz
    assert hz[0] < UPPER[0] * runs[0].top_hz
    made = outside_modes(runs, of_modes(chain, runs, [(h, 0.01) for h in hz], shapes), BAND, False, local_terms=False)
    moved = np.abs(np.log((made.hz / runs[0].top_hz - 1) / (np.array(UPPER) - 1)))
    assert 0.1 * SHIFT < moved.max() < 5 * SHIFT
    undriven = np.setdiff1d(np.arange(N), REFS)
    true, found = (np.diag(c)[undriven] for c in (compliance(hz, shapes), compliance(made.hz, made.shapes)))
    assert np.all(found < 2 * np.maximum(true, np.median(true)))


def test_local_terms_are_sized_by_what_lies_above_alone(chain, runs):
    """Mass lines have the opposite sense, and may be the larger part."""
    usual = float(np.sqrt(np.mean(chain.phi**2)))
    shapes = usual * np.random.default_rng(5).standard_normal((N, 4))
    shapes[:, 2:] = usual  # free to move as a whole
    top, bottom = runs[0].top_hz, float(runs[0].frequencies_hz[0])
    poles = [(1.3 * top, 0.01), (2 * top, 0.01), (0.02 * bottom, 0.01), (0.3 * bottom, 0.05)]
    made = outside_modes(runs, of_modes(chain, runs, poles, shapes), BAND, True)
    undriven = np.setdiff1d(np.arange(N), REFS)
    local = made.shapes[:, -undriven.size :]
    above = np.diag(compliance(np.array([p[0] for p in poles[:2]]), shapes[:, :2]))
    size = LOCAL_SHAPE * LOCAL * top * np.sqrt(np.median(above[list(REFS)]))
    assert np.diag(local[undriven]) == pytest.approx(np.full(undriven.size, size), rel=0.3)


@pytest.mark.parametrize("damping", [0.03, 0.05, 0.2])
def test_terms_below_the_band_lag_as_the_suspension_does(chain, runs, damping):
    """ζ f of a suspension at three tenths of the lowest line, from the imaginary part of the driven columns."""
    usual = float(np.sqrt(np.mean(chain.phi**2)))
    bottom = float(runs[0].frequencies_hz[0])
    swing = 0.3 * bottom
    made = outside_modes(runs, of_modes(chain, runs, [(swing, damping)], np.full((N, 1), usual)), BAND, True, local_terms=False)
    below = made.hz < bottom
    product = (made.zeta * made.hz)[below]
    free = made.zeta[below] < MOST_DAMPING  # a mass line far below cannot lag so much
    assert free.any()
    assert product[free] == pytest.approx(np.full(free.sum(), damping * swing), rel=0.3)

"""First-order perturbations against finite differences of the whole identification; coverage in a small Monte Carlo."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from operando.oma.correlation import BlockCorrelations, block_hankel, correlate
from operando.oma.estimate import normalise_shapes
from operando.oma.subspace import Factors, factorise, factorise_weighted, poles_of_order, realise, whitening_factor
from operando.oma.uncertainty import covariance_of_mean, normalised_changes, perturb
from test_oma_fit import CHAIN, FS, simulate

ROWS, ORDER = 20, 12


def identify(mean, whiten=None):
    """Poles of one order from correlations, the whitening factors held (that is what is linearised)."""
    hankel = block_hankel(mean, ROWS, ROWS)
    if whiten is not None:
        hankel = np.linalg.solve(whiten[0], np.linalg.solve(whiten[1], hankel.T).T)
    plain = factorise(hankel, 100)
    factors = plain if whiten is None else Factors(plain.left, plain.s, plain.right, *whiten)
    realisation = realise(factors, mean.shape[1])
    return factors, realisation, poles_of_order(realisation, ORDER, FS)


def parameters(poles, columns, derivative):
    lam = np.log(poles.mu[columns]) * FS
    shapes = normalise_shapes(poles.shapes[:, columns] / lam ** derivative[:, None])
    flat = shapes.T.ravel()
    return np.concatenate([np.abs(lam) / 2 / np.pi, -lam.real / np.abs(lam), flat.real, flat.imag])


@pytest.mark.parametrize("weighting", ["none", "cva"])
def test_perturbations_match_finite_differences(weighting):
    x = simulate(CHAIN, 60.0, FS, 3)
    c = correlate(x, np.arange(5), 2 * ROWS, 6)
    f = factorise_weighted(c.mean, np.arange(5), ROWS, 100, x.shape[1], weighting)
    whiten = None if weighting == "none" else (f.left_factor, f.right_factor)
    factors, realisation, poles = identify(c.mean, whiten)  # all singular vectors kept: the linearisation is exact
    columns = np.array([int(np.argmin(np.abs(poles.hz - f))) for f in CHAIN.hz])
    derivative = np.array([0, 0, 2, 1, 0])
    change = perturb(c, factors, realisation, poles, columns, ROWS, FS)
    lam = np.log(poles.mu[columns]) * FS
    linear = normalised_changes(lam, poles.shapes[:, columns], change, derivative)
    for b in range(6):
        moved = []
        for step in (3e-4, -3e-4):
            p = identify(c.mean + step * (c.blocks[b] - c.mean), whiten)[2]
            cols = np.array([int(np.argmin(np.abs(p.hz - poles.hz[k]))) for k in columns])
            moved.append(parameters(p, cols, derivative))
        numeric = (moved[0] - moved[1]) / 6e-4
        for part in (slice(0, 5), slice(5, 10), slice(10, None)):
            assert np.linalg.norm(linear[b, part] - numeric[part]) < 2e-3 * np.linalg.norm(numeric[part])


def test_covariance_of_mean_is_that_of_independent_blocks():
    rng = np.random.default_rng(0)
    values = rng.standard_normal((4000, 3)) @ np.array([[1, 0, 0], [0.5, 1, 0], [0, 0, 2.0]])
    got = covariance_of_mean(values - values.mean(axis=0), np.full(4000, 1 / 4000))
    np.testing.assert_allclose(got, np.cov(values.T) / 4000, rtol=2e-3, atol=1e-7)
    few = covariance_of_mean(values[:10] - values[:10].mean(axis=0), np.full(10, 0.1))
    np.testing.assert_allclose(few / (np.cov(values[:10].T) / 10), (2.2622 / 1.95996) ** 2, rtol=0.01)  # Student's t, 9 degrees


def test_blocks_are_needed():
    c = BlockCorrelations(np.zeros((3, 1, 1)), None, np.ones(1))
    with pytest.raises(ValueError, match="blocks"):
        perturb(c, None, None, None, [], 1, 1.0)


@pytest.mark.slow
def test_intervals_cover():
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
    from coverage_oma import coverage, study

    result = study(200)
    cover_f, cover_z = coverage(result)
    assert 0.90 <= np.mean([cover_f, cover_z]) <= 0.98
    assert min(cover_f.min(), cover_z.min()) >= 0.85
    assert np.isnan(result["error_f"]).sum() <= 2  # modes missed, of 1800
    assert result["extra"].sum() <= 2
    for name in "fz":
        ratio = np.nanmedian(result[f"std_{name}"], axis=0) / np.nanstd(result[f"error_{name}"], axis=0)
        assert np.all((ratio < 1.5) & (ratio > 1 / 1.5))


def test_whitening_keeps_weak_modes_and_raises_no_empty_band(monkeypatch):
    """``REGULARISATION``: less of it and bands without energy are raised a thousandfold, more of it and weak modes lose their weight."""
    rows, lags = 30, np.arange(62)
    set_to = lambda value: monkeypatch.setattr("operando.oma.subspace.REGULARISATION", value)  # noqa: E731
    low_passed = np.sinc(lags / 8)[:, None, None]  # white up to an eighth of half the sampling rate
    raised = lambda: 1 / np.linalg.svd(whitening_factor(low_passed, rows, 10**9, False), compute_uv=False).min()  # noqa: E731
    assert raised() == pytest.approx(1 / np.sqrt(1e-3), rel=0.01)
    set_to(1e-7)
    assert raised() > 3000

    def weights(value: float) -> np.ndarray:
        """Canonical correlations of a strong mode, and of one with 1 % of the mean square."""
        set_to(value)
        modes = [part * np.exp(-0.01 * w * lags) * np.cos(w * lags) for part, w in ((0.99, 0.5), (0.01, 1.7))]
        return factorise_weighted(np.sum(modes, axis=0)[:, None, None], np.array([0]), rows, 4, 10**9).s[:4]

    best, used, much = (weights(value) for value in (1e-7, 1e-3, 1.0))
    assert np.all(used > 0.9 * best)
    assert np.min(much) < 0.5 * np.min(best)

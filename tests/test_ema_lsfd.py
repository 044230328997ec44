"""Residues and real shapes against the analytic chain."""

from __future__ import annotations

import numpy as np
import pytest

from operando.ema.lsfd import lsfd
from operando.errors import DataError
from structures import Chain

F = np.arange(10.0, 160, 0.125)


@pytest.fixture(scope="module")
def chain():
    return Chain(8, zeta=np.linspace(0.004, 0.015, 8), seed=3)


def labels(n):
    return [f"{k + 1}+Z" for k in range(n)]


def poles_of(chain):
    return 2 * np.pi * chain.hz * (-chain.zeta + 1j * np.sqrt(1 - chain.zeta**2))


def noise(H, level, seed=0):
    rng = np.random.default_rng(seed)
    sigma = level * np.mean(np.abs(H))
    return sigma * (rng.standard_normal(H.shape) + 1j * rng.standard_normal(H.shape)) / np.sqrt(2), sigma**2


@pytest.mark.parametrize("with_participation", [False, True])
@pytest.mark.parametrize("quantity", ["receptance", "mobility", "accelerance"])
def test_exact_residues(chain, quantity, with_participation):
    power = {"receptance": 0, "mobility": 1, "accelerance": 2}[quantity]
    lam = poles_of(chain)
    truth = np.einsum("ir,jr->ijr", chain.phi, chain.phi[[0, 3]]) / (2j * lam.imag)
    lower, upper = np.full((8, 2), 0.3), np.full((8, 2), 1e-5)
    w = 2 * np.pi * F
    receptance = chain.accelerance(F, ref=[0, 3]) / -(w**2) - lower[..., None] / w**2 + upper[..., None]
    H = receptance * (1j * w) ** power
    out = lsfd(F, H, lam, quantity=quantity, participation=chain.phi[[0, 3]] if with_participation else None)
    np.testing.assert_allclose(out.residues, truth, atol=1e-9 * np.abs(truth).max())
    np.testing.assert_allclose(out.lower, lower, rtol=1e-6)
    np.testing.assert_allclose(out.upper, upper, rtol=1e-6)
    np.testing.assert_allclose(out.frf(F, quantity), H, atol=1e-9 * np.abs(H).max())
    assert out.relative_error.max() < 1e-9


def test_residual_terms_stand_for_modes_outside_the_band(chain):
    f = np.arange(30.0, 100, 0.125)
    H = chain.accelerance(f, ref=[0])
    inside = (chain.hz > 30) & (chain.hz < 100)
    with_terms = lsfd(f, H, poles_of(chain)[inside])
    without = lsfd(f, H, poles_of(chain)[inside], lower=False, upper=False)
    # the next modes stand right beside the band, where a mass line and a constant do least
    assert np.median(with_terms.relative_error) < 0.4 * np.median(without.relative_error)
    assert not without.lower.any()
    assert not without.upper.any()


def test_weights_and_missing_lines(chain):
    H = chain.accelerance(F, ref=[0, 3])
    e, _ = noise(H, 0.01)
    bad = H + e
    bad[2, 1, 300:330] = np.nan
    bad[5, :, 600:620] = 1e3
    w = np.ones(H.shape)
    w[5, :, 600:620] = 0
    out = lsfd(F, bad, poles_of(chain), weights=w)
    truth = np.einsum("ir,jr->ijr", chain.phi, chain.phi[[0, 3]]) / (2j * poles_of(chain).imag)
    assert np.max(np.abs(out.residues - truth)) < 0.01 * np.abs(truth).max()
    with pytest.raises(DataError, match="do not fit"):
        lsfd(F, H, poles_of(chain), weights=np.ones((3, 2, F.size)))
    with pytest.raises(DataError, match="positive imaginary"):
        lsfd(F, H, poles_of(chain).conj())
    with pytest.raises(DataError, match="none of"):
        lsfd(F, H, poles_of(chain), quantity="compliance")

"""How much of the data is worked on at a time decides the time that it takes, never the answer."""

from __future__ import annotations

import importlib

import numpy as np
import pytest

from operando.ema.discrepancy import fit_variance
from operando.ema.plscf import plscf
from operando.frf.rational import local_rational
from operando.oma.correlation import correlate
from operando.oma.uncertainty import perturb
from structures import Chain
from test_oma_uncertainty import CHAIN, FS, ROWS, identify, simulate

LINES = np.arange(200, 700)


def windows():
    rng = np.random.default_rng(0)
    force, noise = (rng.standard_normal((k, LINES.size)) + 1j * rng.standard_normal((k, LINES.size)) for k in (1, 3))
    found = local_rational(force, 2 * force + 0.01 * noise, LINES, np.arange(230, 670))
    return [found.data, found.variance]


def normal_equations():
    chain = Chain(4, zeta=0.01)
    hz = np.linspace(0.5 * chain.hz[0], 1.2 * chain.hz[-1], 300)
    frf = chain.accelerance(hz, ref=[0])
    noise = np.random.default_rng(3).standard_normal((2, *frf.shape)) * 0.01 * np.abs(frf).max()
    found = plscf(hz, frf + noise[0] + 1j * noise[1], max_order=8)[-1]
    return [found.poles[found.physical]]


def discrepancy():
    error, power = np.random.default_rng(1).standard_normal((2, 6, 200))
    found = fit_variance(0.1 * error + 0j, np.exp(power), np.full(power.shape, 1e-4), False)
    return [found.alpha, found.kappa]


def correlations():
    found = correlate(np.random.default_rng(2).standard_normal((4, 40_000)), np.arange(2), 50, 3)
    return [found.mean, found.blocks]


def perturbations():
    c = correlate(simulate(CHAIN, 60.0, FS, 3), np.arange(5), 2 * ROWS, 6)
    factors, realisation, poles = identify(c.mean, None)
    found = perturb(c, factors, realisation, poles, np.arange(4), ROWS, FS)
    return [found.lam, found.shapes]


@pytest.mark.parametrize(
    ("module", "made"),
    [
        ("frf.rational", windows),
        ("ema.plscf", normal_equations),
        ("ema.discrepancy", discrepancy),
        ("oma.correlation", correlations),
        ("oma.uncertainty", perturbations),
    ],
)
def test_answers_do_not_depend_on_the_size_of_the_pieces(module, made, monkeypatch):
    """``CACHE_VALUES`` of each module: one piece at a time, and all at once."""
    at = importlib.import_module(f"operando.{module}")
    usual = made()
    assert usual[0].size > 3
    for size in (1, 10**9):
        monkeypatch.setattr(at, "CACHE_VALUES", size)
        for one, other in zip(made(), usual, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())

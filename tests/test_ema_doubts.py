"""Poles that are told as doubtful: one mode in several places, and what only a few pairs speak for."""

import numpy as np
import pytest

from operando.data import Frf
from operando.dof import Dof
from operando.ema.doubts import FLAG_MAC, judge_modes
from operando.ema.fit import model_dofs
from operando.ema.linear import FEW_PLACES, NOISE_LIMITED, fit_linear
from operando.ema.pairs import frf_pairs
from operando.ema.projection import Poles

F = np.arange(60.0, 160.0, 0.1)
BAND = (70.0, 150.0)


def accelerance(hz, zeta):
    s, w = 2j * np.pi * F, 2 * np.pi * hz
    return s**2 / (w**2 + s**2 + 2 * zeta * w * s)


def codes(hz, zeta, shapes, error, seed=0, step=5.0):
    """Doubts of each pole, fitted to one column of FRFs with an error of a share of the FRF, smooth over ``step`` Hz."""
    rng = np.random.default_rng(seed)
    h = sum(np.outer(shape, accelerance(f, z)) for f, z, shape in zip(hz, zeta, shapes, strict=True))
    count = len(h)
    nodes = np.arange(F[0] - step, F[-1] + 2 * step, step)
    bend = rng.standard_normal((2, count, nodes.size))
    smooth = np.array([[np.interp(F, nodes, row) for row in part] for part in bend])
    h = h * (1 + error * (smooth[0] + 1j * smooth[1])) + 1e-4 * np.abs(h).mean() * (
        rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)
    )
    dofs = tuple(Dof.parse(f"{i}+Z") for i in range(1, count + 1))
    frf = Frf(h[:, None], F, dofs, dofs[:1])
    pairs = frf_pairs(frf, model_dofs(frf), BAND)
    n = len(hz)
    poles = Poles(np.array(hz), np.array(zeta), np.full(n, 0.05), np.full(n, 2e-4))
    fit = fit_linear(pairs, poles, (float(F[0]), float(F[-1])), rounds=5)
    assert fit.n_modes == n
    assert (fit.model_error < NOISE_LIMITED) == (error < NOISE_LIMITED)
    return [[code for code, _ in evidence.doubts] for evidence in judge_modes(fit)]


def shapes(places, seed=1):
    """A strong mode, a weak one, and a third that has the weak one's shape."""
    rng = np.random.default_rng(seed)
    strong, weak = rng.standard_normal((2, places))
    return 10 * strong, 0.8 * weak, weak


def test_one_shape_at_two_frequencies_is_one_mode_where_the_model_error_rules():
    # the two are four half bandwidths apart, and the strong mode rules at both
    hz, zeta = (100.0, 108.0, 112.0), (0.01, 0.01, 0.01)
    assert codes(hz, zeta, shapes(FEW_PLACES + 6), error=0.03) == [[], ["twin"], []]


@pytest.mark.parametrize(
    ("places", "error", "strong"),
    [(FEW_PLACES - 8, 0.03, 1.0), (FEW_PLACES + 6, 0.001, 1.0), (FEW_PLACES + 6, 0.03, 0.02)],
    ids=["few places tell nothing", "the noise limits", "both rule at their resonances"],
)
def test_one_shape_at_two_frequencies_stays_two_modes(places, error, strong):
    first, second, third = shapes(places)
    hz, zeta = (100.0, 108.0, 112.0), (0.01, 0.004, 0.004) if strong < 1 else (0.01, 0.01, 0.01)
    assert not any("twin" in found for found in codes(hz, zeta, (strong * first, second, third), error))


def test_shapes_less_alike_than_the_limit_are_two_modes():
    first, second, third = shapes(FEW_PLACES + 6)
    other = np.random.default_rng(5).standard_normal(second.size)
    mixed = third + 1.2 * other
    assert (mixed @ second) ** 2 / (mixed @ mixed) / (second @ second) < FLAG_MAC
    assert codes((100.0, 108.0, 112.0), (0.01,) * 3, (first, second, mixed), error=0.03) == [[], [], []]


@pytest.mark.parametrize(("size", "told"), [(0.003, True), (0.1, False)], ids=["weak", "strong"])
def test_what_a_few_pairs_alone_speak_for_is_told(size, told):
    first, second, _ = shapes(FEW_PLACES + 6)
    local = np.zeros(first.size)
    local[:3] = size
    found = codes((100.0, 120.0, 135.0), (0.01, 0.01, 0.006), (first, 2 * second, local), error=0.03, step=0.2)
    assert found[:2] == [[], []]
    assert ("few_pairs" in found[2]) == told

"""Poles that are told as doubtful: one mode in several places, what only a few pairs speak for, and each limit from both sides."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from operando.data import Frf
from operando.dof import Dof
from operando.ema.doubts import (
    BACKGROUND_COLLINEARITY,
    BACKGROUND_DAMPING,
    FLAG_MAC,
    GOOD_COLLINEARITY,
    HALF,
    HALF_COLLINEARITY,
    HIDDEN_ERRORS,
    MAX_LOG_DAMPING_STD,
    MIN_COLLINEARITY,
    MIN_RANK_SHARE,
    SAME_SHARE,
    evidence_of_modes,
    unknown_to,
)
from operando.ema.findings import NOTABLE_RESIDUE, drive_residues
from operando.ema.fit import model_dofs
from operando.ema.linear import FEW_PLACES, NOISE_LIMITED, fit_linear
from operando.ema.pairs import frf_pairs
from operando.ema.projection import Poles, basis

F = np.arange(60.0, 160.0, 0.1)
BAND = (70.0, 150.0)


def accelerance(hz, zeta):
    s, w = 2j * np.pi * F, 2 * np.pi * hz
    return s**2 / (w**2 + s**2 + 2 * zeta * w * s)


def codes(*made, **how):
    """Doubts of each pole of :func:`fitted`."""
    return doubts(fitted(*made, **how))


def doubts(fit):
    return [[code for code, _ in evidence.doubts] for evidence in evidence_of_modes(fit)]


def fitted(hz, zeta, shapes, error, seed=0, step=5.0):
    """Poles fitted to one column of FRFs with an error of a share of the FRF, smooth over ``step`` Hz."""
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
    return fit


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


def test_pairs_of_several_references_are_no_further_places():
    rng = np.random.default_rng(2)
    strong, weak = (np.outer(rng.standard_normal(6), rng.standard_normal(5)).ravel() for _ in range(2))
    fit = fitted((100.0, 108.0, 112.0), (0.01,) * 3, (10 * strong, 0.8 * weak, weak), error=0.03)
    assert fit.projection.a.shape[0] >= FEW_PLACES
    assert doubts(fit) == [[], ["twin"], []]
    grid = np.stack(np.unravel_index(np.arange(30), (6, 5)), axis=1)
    assert doubts(replace(fit, pairs=replace(fit.pairs, grid=grid))) == [[], [], []]


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


PLACES = 8


@pytest.fixture(scope="module")
def sound():
    """Three modes far apart in eight pairs, none in doubt."""
    fit = fitted((85.0, 110.0, 135.0), (0.01,) * 3, np.random.default_rng(1).standard_normal((3, PLACES)), error=0.03)
    assert doubts(fit) == [[], [], []]
    return fit


def with_residues(fit, residues, zeta=(0.01, 0.01, 0.01)):
    """The fit with other residues (pairs, modes), all equally certain, and other damping."""
    projection = replace(fit.projection, a=np.real(residues), b=np.imag(residues), a_std=np.ones(residues.shape))
    return replace(fit, projection=projection, poles=replace(fit.poles, zeta=np.array(zeta)))


def with_last_mode(fit, collinearity, share=1.0, zeta=0.01):
    """The last mode with this collinearity and share of the power at its own resonance, both alike in all pairs."""
    angle = np.arccos(np.sqrt(collinearity)) / 2  # residues at ± this angle: cos²(2·angle)
    poles = replace(fit.poles, zeta=np.array([0.01, 0.01, zeta]))
    size = np.abs(basis(poles.hz[2:], poles, 0.0)[0][:, 0])
    other = 0.0 if share == 1 else size[2] / size[0] * np.sqrt((1 - share) / share)
    turns = np.exp(1j * angle * np.where(np.arange(PLACES) % 2, 1, -1))
    return with_residues(fit, np.c_[np.full(PLACES, other), np.full(PLACES, 1e-9), turns], poles.zeta)


@pytest.mark.parametrize("off", [-0.01, 0.01])
def test_residues_that_one_shape_does_not_explain_are_no_mode(sound, off):
    """MIN_RANK_SHARE: singular values of the residue matrix with this part of their squares in the first."""
    share = MIN_RANK_SHARE + off
    u, _, v = np.linalg.svd(np.random.default_rng(2).standard_normal((PLACES // 2, 2)), full_matrices=False)
    residues = sound.residues()
    residues[:, 0] = ((u * np.sqrt([share, 1 - share])) @ v).ravel()
    grid = np.argwhere(np.ones((PLACES // 2, 2)))
    found = evidence_of_modes(with_residues(replace(sound, pairs=replace(sound.pairs, grid=grid)), residues))[0]
    assert found.rank_share == pytest.approx(share, abs=1e-3)
    assert ("not_one_shape" in dict(found.doubts)) == (off < 0)


@pytest.mark.parametrize(
    ("share", "collinearity", "told"),
    [
        (HALF + 0.02, HALF_COLLINEARITY - 0.02, False),
        (HALF - 0.02, HALF_COLLINEARITY - 0.02, True),
        (HALF - 0.02, HALF_COLLINEARITY + 0.02, False),
        (HALF + 0.02, MIN_COLLINEARITY + 0.02, False),
        (HALF + 0.02, MIN_COLLINEARITY - 0.02, True),
    ],
)
def test_a_pole_that_rules_nowhere_must_be_nearer_to_phase(sound, share, collinearity, told):
    fit = with_last_mode(sound, collinearity, share)
    evidence = evidence_of_modes(fit)[2]
    assert (evidence.collinearity, evidence.dominance) == pytest.approx((collinearity, share), abs=0.01)
    assert ("complex_shape" in doubts(fit)[2]) == told


@pytest.mark.parametrize("times", [0.9, 1.1])
def test_a_mode_below_the_model_error_of_the_others_is_hidden(sound, times):
    """HIDDEN_ERRORS: amplitude at its resonance over the model error of all modes there."""
    assert sound.model_error > NOISE_LIMITED
    fit = with_last_mode(sound, 1.0, (times * HIDDEN_ERRORS * sound.model_error) ** 2)
    assert ("hidden" in doubts(fit)[2]) == (times < 1)


@pytest.mark.parametrize(
    ("times", "collinearity", "told"),
    [
        (BACKGROUND_DAMPING + 0.1, BACKGROUND_COLLINEARITY - 0.02, True),
        (BACKGROUND_DAMPING - 0.1, BACKGROUND_COLLINEARITY - 0.02, False),
        (BACKGROUND_DAMPING + 0.1, BACKGROUND_COLLINEARITY + 0.02, False),
    ],
)
def test_a_curved_background_is_damped_far_beyond_the_modes_and_not_quite_real(sound, times, collinearity, told):
    assert ("background" in doubts(with_last_mode(sound, collinearity, zeta=0.01 * times))[2]) == told


@pytest.mark.parametrize(("collinearity", "told"), [(GOOD_COLLINEARITY - 0.02, True), (GOOD_COLLINEARITY + 0.02, False)])
def test_what_is_typical_of_damping_the_modes_that_are_clearly_real_say(sound, collinearity, told):
    """One clearly real mode of 1 %, one of 0.09 in doubt or not: it is 9 times the one alone, 1.8 times the median of both."""
    fit = with_last_mode(sound, collinearity, zeta=0.09)
    residues = fit.residues()
    residues[:, 1] = np.exp(1j * np.linspace(0, np.pi, PLACES, endpoint=False))
    assert ("background" in doubts(with_residues(fit, residues, fit.poles.zeta))[2]) == told


@pytest.mark.parametrize("times", [0.99, 1.01])
def test_a_pole_of_uncertain_damping_is_no_mode(sound, times):
    covariance = sound.covariance.copy()
    covariance[4, 4] = (times * MAX_LOG_DAMPING_STD) ** 2
    assert doubts(replace(sound, covariance=covariance)) == [[], ["uncertain"] if times > 1 else [], []]


@pytest.mark.parametrize("zeta", [SAME_SHARE / 4, 4 * SAME_SHARE])
def test_a_mode_is_known_within_a_half_bandwidth_and_no_closer_than_a_test_drifts(sound, zeta):
    still = replace(sound.projection, shift=np.zeros_like(sound.projection.shift))
    fit = replace(sound, projection=still, poles=replace(sound.poles, zeta=np.full(3, zeta)))
    limit = max(SAME_SHARE, zeta)
    near, far = (fit.poles.hz[1] * (1 + times * limit) for times in (0.99, 1.01))
    assert unknown_to(fit, [near, far], BAND) == [far]


@pytest.mark.parametrize("times", [0.9, 1.1])
def test_a_drive_point_near_a_node_blames_no_sensor(sound, times):
    """NOTABLE_RESIDUE: a residue that is surely negative, of this part of the largest of its mode."""
    residues = np.ones((PLACES, 3))
    residues[0, 1] = -times * NOTABLE_RESIDUE
    fit = with_residues(sound, residues)
    mass = SimpleNamespace(drive=((0, np.array([99.0, -99.0, 99.0])),), scaled=np.array([True, False, True]))
    found = drive_residues(fit, mass, np.ones(3, bool))
    at = (fit.mean_hz[1],)
    assert (found.negative_hz, found.absent_hz) == ((at, ()) if times > 1 else ((), at))

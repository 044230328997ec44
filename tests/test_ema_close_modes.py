"""Modes closer than their bandwidth: two by several references, one mode that moves between rows, or a pair that nothing separates."""

from dataclasses import replace

import numpy as np
import pytest

from operando.data import Frf
from operando.dof import Dof
from operando.ema import fit_ema
from operando.ema.choose import is_twin
from operando.ema.close_pairs import APART_STD, RULES, _pencil, separated
from operando.ema.doubts import evidence_of_modes
from operando.ema.fit import model_dofs
from operando.ema.linear import fit_linear
from operando.ema.pairs import frf_pairs
from operando.ema.projection import Poles, basis
from operando.ema.residue_matrix import MIN_RANK_SHARE, OTHER_MAC, best_shape, residue_matrix, two_shapes

DOFS = ("1+X", "2+X", "3+X", "4+X")
BAND = (10.0, 110.0)
F = np.arange(1.0, 120.0, 0.05)
SEEDS = [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))]


def pairs_of_modes(coupling, zeta):
    """Frequencies and shapes of unit modal mass of two equal halves that a spring couples: two pairs of modes with a MAC of 0 each."""
    stiffness = np.diag([1e5, 0.5e5, 0.5e5, 1.001e5])
    for i, k in enumerate((1e5, coupling, 1e5)):
        stiffness[i : i + 2, i : i + 2] += k * np.array([[1, -1], [-1, 1]])
    squares, shapes = np.linalg.eigh(stiffness / 2.0)
    return np.sqrt(squares) / 2 / np.pi, zeta, shapes / np.sqrt(2.0)


def accelerance(hz, zeta, shapes, drive):
    """(n_dofs, n_driven, lines)."""
    s, w = 2j * np.pi * F, 2 * np.pi * hz[:, None]
    return np.einsum("or,dr,rl->odl", shapes, shapes[drive], s**2 / (s**2 + 2 * zeta * w * s + w**2))


def measured(coupling, zeta, seed, drive=(0, 3), noise=0.005, variance=False):
    """Frequencies, and FRFs with noise of a share of the rms of each."""
    hz, zeta, shapes = pairs_of_modes(coupling, zeta)
    h = accelerance(hz, zeta, shapes, list(drive))
    rng = np.random.default_rng(seed)
    std = np.broadcast_to(noise * np.sqrt(np.mean(np.abs(h) ** 2, axis=2, keepdims=True)), h.shape)
    noisy = h + std * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    return hz, Frf(noisy, F, DOFS, [DOFS[d] for d in drive], variance=std**2 if variance else None)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("zeta", "coupling"), [(0.03, 4000.0), (0.01, 1000.0)])
def test_close_modes_of_different_shapes_are_two_without_a_variance_too(zeta, coupling, seed):
    """0.56 and 0.43 half-power widths apart: each pair was called one mode at two frequencies."""
    hz, frf = measured(coupling, zeta, seed)
    model = fit_ema(frf, band=BAND)
    assert model.frequencies_hz == pytest.approx(hz, rel=5e-4)
    assert not [finding for finding in model.findings if finding.kind == "doubtful_pole"]


def moved(seed, by, drive=2, rows=8):
    """A linear fit of two poles to one mode of 2 % that rows see at 60 Hz (1 ± ``by``), and its number of twins."""
    rng = np.random.default_rng(seed)
    f = np.arange(50.0, 72.0, 0.05)
    shape = rng.choice([-1, 1], rows) * rng.uniform(0.4, 1.5, rows)
    hz = 60.0 * (1 + by * rng.choice([-1.0, 1.0], rows))
    hz[:2] = 60.0 * (1 + by * np.array([-1.0, 1.0]))  # both are there
    s, w = 2j * np.pi * f, 2 * np.pi * hz[:, None]
    column = s**2 / (s**2 + 0.04 * w * s + w**2)
    h = np.einsum("ol,o,d->odl", column, shape, shape[:drive])
    h += 1e-3 * np.abs(h).max() * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape))
    dofs = tuple(Dof.parse(f"{i}+Z") for i in range(1, rows + 1))
    frf = Frf(h, f, dofs, dofs[:drive])
    pairs = frf_pairs(frf, model_dofs(frf), (50.0, 72.0))
    poles = Poles(60.0 * (1 + by * np.array([-1.0, 1.0])), np.full(2, 0.02))
    return fit_linear(pairs, poles, (50.0, 72.0), rounds=3)


@pytest.mark.parametrize("by", [0.002, 0.004])
@pytest.mark.parametrize("drive", [2, 3])
def test_one_mode_that_moves_between_rows_is_no_two_modes_by_several_references(drive, by):
    """Twelve tests of 8 roved rows, by 0.2 and 0.4 half bandwidths apart: the sum of the residues is of rank one."""
    assert not [seed for seed in range(12) if two_shapes(moved(seed, by, drive), 0, 1)]
    assert is_twin(moved(0, by, drive), 0)


@pytest.fixture(scope="module")
def two():
    return moved(0, 0.004, drive=3)


def with_residues(fit, first, second):
    """The fit with these residue matrices (rows, references), all equally certain."""
    a = np.stack([np.asarray(part)[tuple(fit.pairs.grid.T)] for part in (first, second)], axis=1)
    return replace(fit, projection=replace(fit.projection, a=a, b=np.zeros_like(a), a_std=np.ones_like(a)))


@pytest.mark.parametrize("off", [-0.01, 0.01])
def test_the_sum_of_two_residues_of_one_mode_is_of_rank_one(two, off):
    """MIN_RANK_SHARE: of the sum, whatever the two are against each other."""
    u, _, v = np.linalg.svd(np.random.default_rng(2).standard_normal((8, 3)), full_matrices=False)
    total = (u * np.sqrt([MIN_RANK_SHARE + off, 1 - MIN_RANK_SHARE - off, 0])) @ v
    against = 5 * np.random.default_rng(3).standard_normal(total.shape)
    fit = with_residues(two, 0.5 * total + against, 0.5 * total - against)
    assert best_shape(*residue_matrix(fit, 0, 1))[0] == pytest.approx(MIN_RANK_SHARE + off, abs=1e-3)
    assert two_shapes(fit, 0, 1) == (off < 0)


@pytest.mark.parametrize("off", [-0.05, 0.05])
@pytest.mark.parametrize("side", ["rows", "references", "both"])
def test_a_weak_mode_beside_a_strong_one_has_shapes_of_its_own_on_both_sides(two, side, off):
    """OTHER_MAC: one mode whose rows differ has one shape over the references, and the other way round."""
    mac = OTHER_MAC + off
    rows, references = np.eye(8)[:2], np.eye(3)[:2]
    turned = np.array([np.sqrt(mac), np.sqrt(1 - mac)])
    left = turned @ rows if side != "references" else rows[0]
    right = turned @ references if side != "rows" else references[0]
    fit = with_residues(two, np.outer(rows[0], references[0]), 0.1 * np.outer(left, right))
    assert two_shapes(fit, 0, 1) == (side == "both" and off < 0)


@pytest.mark.parametrize("alike", [True, False])
def test_a_close_pole_that_one_reference_cannot_tell_is_not_said_to_be_of_one_shape(alike):
    fit = moved(0, 0.004, drive=1)
    rows = np.eye(8)[:2]
    found = evidence_of_modes(with_residues(fit, rows[:1].T, 0.5 * rows[:1].T if alike else 0.5 * rows[1:].T))
    said = [reason for evidence in found for code, reason in evidence.doubts if code == "twin"]
    assert len(said) == 1
    assert ("its shape is that of" in said[0]) == alike


def frf_error(model, coupling, zeta, drive=(0, 3)):
    """Of the driven FRFs in band, over their norm."""
    truth = accelerance(*pairs_of_modes(coupling, zeta), list(drive))
    low, high = BAND
    inside = (low < F) & (high > F)
    found = model.frf(F[inside], DOFS, [DOFS[d] for d in drive]).data
    return np.linalg.norm(found - truth[..., inside]) / np.linalg.norm(truth[..., inside])


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("coupling", [200.0, 500.0])
def test_pairs_within_a_hundredth_of_their_width_have_frequencies_of_their_own(coupling, seed):
    """0.03 and 0.005 half-power widths (0.07 and 0.01) apart; it was said that there is no mode."""
    hz, frf = measured(coupling, 0.03, seed)
    model = fit_ema(frf, band=BAND)
    assert model.n_modes == 4
    assert np.max(np.abs(model.frequencies_hz - hz) / model.frequency_std_hz) < 3
    assert np.max(np.abs(model.damping_ratios - 0.03) / model.damping_ratio_std) < 4
    assert frf_error(model, coupling, 0.03) < 0.005


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("zeta", [0.03, 0.01])
def test_a_pair_that_nothing_separates_is_one_mode_and_a_residual_term(zeta, seed):
    """The upper pair, 7 mHz apart, under 0.5 % noise: the mode covers both, the FRFs are those of both, and a finding says so."""
    hz, frf = measured(20.0, zeta, seed)
    model = fit_ema(frf, band=BAND)
    assert model.n_modes == 3
    assert np.all(np.abs(model.frequencies_hz[2] - hz[2:]) < 3 * model.frequency_std_hz[2])
    assert [finding.band_hz for finding in model.findings if finding.kind == "close_pair"]
    assert "close_pair" in {pole.code for pole in model.details.rejected}
    assert frf_error(model, 20.0, zeta) < 0.005


@pytest.mark.parametrize("times", [0.9, 1.1])
def test_two_poles_are_apart_by_three_standard_deviations_of_their_distance(two, times):
    """APART_STD, with residues that are as uncertain as makes them so far apart."""
    u, _, v = np.linalg.svd(np.random.default_rng(2).standard_normal((8, 3)), full_matrices=False)
    turn = np.array([[1.0, 0.3], [-0.2, 0.9]])
    parts = [u[:, :2] @ np.diag(d) @ turn @ v[:2] for d in ([0.7, 0.3], [0.3, 0.7])]
    fit = with_residues(two, *parts)
    fit = replace(fit, projection=replace(fit.projection, shifted=np.zeros_like(fit.projection.shifted)))
    pair = _pencil(fit, (0, 1))
    distance, std = np.abs(pair.poles[1] - pair.poles[0]), np.hypot(*pair.std)
    assert distance == pytest.approx(0.4 * np.diff(two.poles.hz)[0], rel=1e-3)
    scaled = fit.projection.a_std * distance / std / APART_STD / times
    found = separated(replace(fit, projection=replace(fit.projection, a_std=scaled)))
    assert found.n_modes == 2
    assert found.second_shapes == (() if times > 1 else (1,))
    assert np.diff(found.poles.hz)[0] == pytest.approx(distance if times > 1 else 0.0, rel=1e-3, abs=1e-9)


@pytest.mark.parametrize("times", [0.9, 1.1])
def test_a_pole_of_two_shapes_is_a_pair_only_where_it_rules(times):
    """RULES: share of the power of all modes at its own resonance; a background has residues of many shapes, too."""
    far = moved(0, 0.03, drive=3)
    u, _, v = np.linalg.svd(np.random.default_rng(2).standard_normal((8, 3)), full_matrices=False)
    parts = u[:, :2] @ v[:2], np.outer(u[:, 2], v[2])
    size = np.abs(basis(far.poles.hz[:1], far.poles, 0.0)[0][:, 0])
    share = times * RULES
    other = np.sqrt((1 - share) / share * 2) * size[0] / size[1]
    found = separated(with_residues(far, parts[0], other * parts[1]))
    assert found.second_shapes == ((1,) if times > 1 else ())
    assert found.n_modes == 2 + len(found.second_shapes)

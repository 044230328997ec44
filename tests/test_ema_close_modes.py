"""Modes closer than their bandwidth: two by several references, one mode that moves between rows, or a pair that nothing separates."""

from dataclasses import replace

import numpy as np
import pytest

from operando.data import Frf
from operando.dof import Dof
from operando.ema import fit_ema
from operando.ema.choose import is_twin
from operando.ema.doubts import evidence_of_modes
from operando.ema.fit import model_dofs
from operando.ema.linear import fit_linear
from operando.ema.pairs import frf_pairs
from operando.ema.projection import Poles
from operando.ema.residue_matrix import MIN_RANK_SHARE, OTHER_MAC, best_shape, residue_matrix, two_shapes

DOFS = ("1+X", "2+X", "3+X", "4+X")
BAND = (10.0, 110.0)
F = np.arange(1.0, 120.0, 0.05)


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


@pytest.mark.parametrize("seed", range(3))
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

"""Poly-reference LSCF against the analytic chain, sdynpy's PolyPy and direct evaluation."""

from __future__ import annotations

import contextlib
import io
import os
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from operando.ema.indicator_functions import cmif
from operando.ema.plscf import plscf
from operando.errors import DataError, IdentificationError
from operando.indicators import mac
from structures import Chain


def noisy(H, level, seed=0):
    rng = np.random.default_rng(seed)
    return H + level * np.abs(H) * (rng.standard_normal(H.shape) + 1j * rng.standard_normal(H.shape)) / np.sqrt(2)


def nearest(order, hz):
    return [int(np.argmin(np.abs(order.frequency_hz - h))) for h in hz]


@pytest.fixture(scope="module")
def chain():
    return Chain(8, zeta=np.linspace(0.004, 0.015, 8), seed=3)


F = np.arange(10.03, 160, 0.125)


@pytest.mark.parametrize("constraint", ["lowest", "highest"])
@pytest.mark.parametrize("quantity_power", [0, 2])
def test_exact_poles_and_participation_without_noise(chain, constraint, quantity_power):
    H = chain.accelerance(F, ref=[0, 3]) / (2j * np.pi * F) ** (2 - quantity_power)
    best = plscf(F, H, max_order=12, constraint=constraint)[-1]
    k = nearest(best, chain.hz)
    assert len(set(k)) == 8
    np.testing.assert_allclose(best.frequency_hz[k], chain.hz, rtol=1e-7)
    np.testing.assert_allclose(best.damping_ratio[k], chain.zeta, rtol=1e-5)
    assert best.physical[k].all()
    assert np.min(np.diag(mac(best.vectors[:, k], chain.phi[[0, 3]]))) > 1 - 1e-9
    np.testing.assert_allclose(np.linalg.norm(best.vectors, axis=0), 1)


def test_signs_between_references_survive(chain):
    best = plscf(F, chain.accelerance(F, ref=[0, 3]), max_order=12)[-1]
    v = best.vectors[:, nearest(best, chain.hz)]
    np.testing.assert_allclose((v[1] / v[0]).real, chain.phi[3] / chain.phi[0], rtol=1e-5)


def test_lowest_constraint_makes_spurious_poles_unstable(chain):
    H = noisy(chain.accelerance(F, ref=[0, 3]), 0.01)
    low, high = (plscf(F, H, max_order=20, constraint=c)[-1] for c in ("lowest", "highest"))
    assert low.physical.sum() <= 10 < high.physical.sum()


def test_weights_take_noisy_lines_back(chain):
    clean = chain.accelerance(F, ref=[0, 3])
    # a band of strong noise without a mode, as from a mains harmonic or a weak force
    sigma = 0.002 * np.mean(np.abs(clean)) * np.where(np.abs(F - 37) < 4, 1e4, 1.0) * np.ones(clean.shape)
    errors = {"weighted": [], "plain": []}
    for seed in range(6):
        rng = np.random.default_rng(seed)
        H = clean + sigma * (rng.standard_normal(clean.shape) + 1j * rng.standard_normal(clean.shape))
        for name, weights in (("weighted", 1 / sigma), ("plain", None)):
            best = plscf(F, H, max_order=16, weights=weights)[-1]
            errors[name].append(best.damping_ratio[nearest(best, chain.hz)] / chain.zeta - 1)
    rms = {name: np.sqrt(np.mean(np.square(e))) for name, e in errors.items()}
    assert rms["weighted"] < 0.02
    assert rms["weighted"] < 0.2 * rms["plain"]


def test_weights_by_reference_reduce_to_those_by_response(chain):
    H = noisy(chain.accelerance(F, ref=[0, 3]), 0.01)
    w = np.random.default_rng(0).uniform(0.5, 2, (8, F.size))
    a = plscf(F, H, max_order=6, weights=w)[-1]
    b = plscf(F, H, max_order=6, weights=np.repeat(w[:, None], 2, axis=1))[-1]
    np.testing.assert_allclose(a.poles, b.poles, rtol=1e-9)
    # a line of weight 0 may hold anything
    w0, H0 = w.copy(), H.copy()
    w0[:, 100:105], H0[:, :, 100:105] = 0, 1e6
    c = plscf(F, H0, max_order=6, weights=w0)[-1]
    w0[:, 100:105] = 1e-12
    d = plscf(F, H, max_order=6, weights=w0)[-1]
    np.testing.assert_allclose(c.poles, d.poles, rtol=1e-6)


def test_any_grid_gives_the_same_poles(chain):
    rng = np.random.default_rng(2)
    uneven = np.sort(rng.uniform(10, 160, 900))
    for f in (uneven, np.arange(10.0, 160, 0.11), F[::2]):
        best = plscf(f, chain.accelerance(f, ref=[0, 3]), max_order=14)[-1]
        np.testing.assert_allclose(best.frequency_hz[nearest(best, chain.hz)], chain.hz, rtol=1e-6)


def test_single_reference_and_band():
    chain = Chain(6, zeta=0.01)
    order = plscf(F, chain.accelerance(F, ref=[0]), max_order=30, frequency_range=(15, 110))[-1]
    inside = chain.hz[(chain.hz > 15) & (chain.hz < 110)]
    np.testing.assert_allclose(order.frequency_hz[nearest(order, inside)], inside, rtol=1e-6)
    assert order.vectors.shape[0] == 1
    assert np.all(order.frequency_hz[order.physical] < 112)


def test_roving_hammer_solves_the_transposed_problem(chain):
    H = chain.accelerance(F, resp=[1, 4])
    order = plscf(F, H, max_order=12)[-1]
    assert order.side == "response"
    k = nearest(order, chain.hz)
    np.testing.assert_allclose(order.frequency_hz[k], chain.hz, rtol=1e-7)
    assert np.min(np.diag(mac(order.vectors[:, k], chain.phi[[1, 4]]))) > 1 - 1e-9


def test_two_close_modes_are_separated_by_references():
    rng = np.random.default_rng(5)
    hz, zeta = np.array([50.0, 50.02]), np.array([0.005, 0.005])
    phi = rng.standard_normal((6, 2))
    f = np.arange(30, 70, 0.05)
    w, wr = 2 * np.pi * f, 2 * np.pi * hz
    kernel = -(w**2) / (wr[:, None] ** 2 - w**2 + 2j * zeta[:, None] * wr[:, None] * w)
    H = np.einsum("ir,jr,rk->ijk", phi, phi[:2], kernel)
    order = plscf(f, noisy(H, 1e-4), max_order=8)[-1]
    stable = order.physical & (np.abs(order.frequency_hz - 50) < 0.5)
    assert stable.sum() == 2
    np.testing.assert_allclose(order.frequency_hz[stable], hz, atol=0.003)
    assert np.min(np.diag(mac(order.vectors[:, stable], phi[:2]))) > 0.999


def test_references_of_very_different_size(chain):
    H = chain.accelerance(F, ref=[0, 3]) * np.array([1e-9, 1.0])[None, :, None]
    order = plscf(F, H, max_order=12)[-1]
    np.testing.assert_allclose(order.frequency_hz[nearest(order, chain.hz)], chain.hz, rtol=1e-6)


def test_input_is_not_changed_and_scale_does_not_matter(chain):
    H = chain.accelerance(F, ref=[0, 3])
    H.setflags(write=False)
    a, b = plscf(F, H, max_order=6)[-1], plscf(F, 1e-6 * H, max_order=6)[-1]
    np.testing.assert_allclose(a.poles[a.physical], b.poles[b.physical], rtol=1e-6)


def test_orders_are_nested_in_one_factor(chain):
    H = noisy(chain.accelerance(F, ref=[0, 3]), 0.01)
    orders = plscf(F, H, max_order=12, min_order=3)
    assert [o.order for o in orders] == list(range(3, 13))
    alone = plscf(F, H, max_order=12, min_order=8)[0]
    np.testing.assert_allclose(orders[5].poles, alone.poles, rtol=1e-9)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.002, 0.03), st.integers(1, 3))
def test_random_chains_are_identified(seed, zeta, n_ref):
    chain = Chain(5, zeta=zeta, seed=seed)
    f = np.arange(15, 160, 0.2)
    order = plscf(f, chain.accelerance(f, ref=range(n_ref)), max_order=24 // n_ref)[-1]
    k = nearest(order, chain.hz)
    np.testing.assert_allclose(order.frequency_hz[k], chain.hz, rtol=1e-5)
    np.testing.assert_allclose(order.damping_ratio[k], chain.zeta, rtol=1e-3)


def test_wrong_input_is_explained(chain):
    H = chain.accelerance(F, ref=[0])
    with pytest.raises(DataError, match="do not fit"):
        plscf(F[:-1], H, max_order=4)
    with pytest.raises(DataError, match="finite"):
        plscf(F, np.where(F > 50, np.nan, H), max_order=4)
    with pytest.raises(IdentificationError, match="no lines"):
        plscf(F, H, max_order=4, frequency_range=(300, 400))
    with pytest.raises(IdentificationError, match="too few"):
        plscf(F[:20], H[:, :, :20], max_order=12)
    with pytest.raises(IdentificationError, match="no weight or no content"):
        plscf(F, 0 * H, max_order=4)
    with pytest.raises(DataError, match="rise"):
        plscf(F[::-1], H, max_order=4)


def test_cmif_peaks_and_matches_svd(chain):
    H = chain.accelerance(F, ref=[0, 3])
    curves = cmif(H)
    assert curves.shape == (2, F.size)
    np.testing.assert_allclose(curves[:, 7], np.linalg.svd(H[:, :, 7], compute_uv=False))
    peaks = F[1:-1][(curves[0, 1:-1] > curves[0, :-2]) & (curves[0, 1:-1] > curves[0, 2:])]
    assert all(np.min(np.abs(peaks - h)) < 0.5 for h in chain.hz[:4])
    np.testing.assert_allclose(cmif(H.transpose(1, 0, 2)), curves)


def polypy(f, H, order):
    os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
    os.environ.setdefault("MPLBACKEND", "Agg")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sdpy = pytest.importorskip("sdynpy", reason="sdynpy is not installed", exc_type=ImportError)
        n, m, _ = H.shape
        coordinates = np.stack(
            np.broadcast_arrays(
                sdpy.coordinate_array(np.arange(1, n + 1), 3)[:, None], sdpy.coordinate_array(np.arange(1, m + 1), 3)[None, :]
            ),
            -1,
        )
        data = sdpy.data.data_array(sdpy.data.FunctionTypes.FREQUENCY_RESPONSE_FUNCTION, f, H.copy(), coordinates)
        fit = sdpy.modal.PolyPy(data)
        with contextlib.redirect_stdout(io.StringIO()):
            fit.compute_poles(np.arange(2, order + 1))
    return fit.pole_list[0]


def test_real_basis_equals_polypy(chain):
    H = noisy(chain.accelerance(F, ref=[0, 3]), 0.02)
    theirs = polypy(F, H, 16)
    ours = plscf(F, H, max_order=16, basis="real", arc=1.0, numerator_extra=0)[-1]
    # PolyPy keeps |λ − 2πi f₀| + 2πf₀ as frequency of the shifted problem: compare in its terms
    shifted = ours.poles - 2j * np.pi * F[0]
    omega = np.abs(shifted) + 2 * np.pi * F[0]
    keep = (shifted.real < 0) & (shifted.imag > 0)
    rank = np.argsort(omega[keep])
    np.testing.assert_allclose(omega[keep][rank], theirs["omega"], rtol=1e-8)
    np.testing.assert_allclose((-shifted.real / omega)[keep][rank], theirs["zeta"], rtol=1e-5)


def test_default_is_closer_to_the_truth_than_polypy(chain):
    H = noisy(chain.accelerance(F, ref=[0, 3]), 0.02)
    theirs = polypy(F, H, 24)
    ours = plscf(F, H, max_order=12)[-1]
    error_ours = np.abs(ours.damping_ratio[nearest(ours, chain.hz)] / chain.zeta - 1)
    error_theirs = np.abs(theirs["zeta"][[np.argmin(np.abs(theirs["omega"] / 2 / np.pi - h)) for h in chain.hz]] / chain.zeta - 1)
    assert np.median(error_ours) < np.median(error_theirs)
    assert np.max(error_ours) < 0.05

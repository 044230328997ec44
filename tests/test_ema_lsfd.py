"""Residues and real shapes against the analytic chain."""

from __future__ import annotations

import time

import numpy as np
import pytest

from operando.ema.lsfd import lsfd
from operando.ema.start_shapes import default_pseudo_hz, real_shapes_start
from operando.errors import DataError, IdentificationError
from operando.synthesis import synthesise
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


def sign_aligned(shapes, truth):
    return shapes * np.sign(np.sum(shapes * truth, axis=0))


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


def test_exact_shapes_of_unit_modal_mass(chain):
    out = real_shapes_start(F, chain.accelerance(F, ref=[0, 3]), labels(8), ["1+Z", "4+Z"], chain.hz, chain.zeta)
    assert out.scaled
    assert (out.wrong_sign, out.unseen, out.inverted_references, out.findings()) == ((), (), (), ())
    np.testing.assert_allclose(sign_aligned(out.shapes[:, :8], chain.phi), chain.phi, atol=1e-6)
    assert out.residual.sum() == 6
    assert out.residual[:8].sum() == 0


def test_sensor_sense_is_kept_and_references_may_be_labelled_the_other_way(chain):
    sense = np.array([1, -1, 1, 1, 1, -1, 1, 1])
    H = chain.accelerance(F, ref=[0, 3]) * sense[:, None, None] * np.array([1, -1])[None, :, None]
    names = [f"{k + 1}{'+' if s > 0 else '-'}Z" for k, s in enumerate(sense)]
    out = real_shapes_start(F, H, names, ["1+Z", "4-Z"], chain.hz, chain.zeta)
    truth = chain.phi * sense[:, None]
    np.testing.assert_allclose(sign_aligned(out.shapes[:, :8], truth), truth, atol=1e-6)
    assert not out.findings()


def test_noise_level_of_modal_masses_and_their_stated_scale(chain):
    H = chain.accelerance(F, ref=[0, 3])
    z = []
    for seed in range(20):
        e, var = noise(H, 0.05, seed)
        out = real_shapes_start(F, H + e, labels(8), ["1+Z", "4+Z"], chain.hz, chain.zeta, variance=np.full(H.shape, var), pseudo_hz=())
        at_refs = np.linalg.norm(out.shapes[[0, 3]], axis=0) / np.linalg.norm(chain.phi[[0, 3]], axis=0)
        z.append((at_refs - 1) / out.scale_std[:8])
        assert 0.9 < out.misfit < 1.1
    # the stated scale uncertainty is the scatter
    assert 0.8 < np.sqrt(np.mean(np.square(z))) < 1.25


def test_pseudo_modes_predict_columns_that_were_never_driven():
    chain = Chain(12, zeta=0.008, seed=1)
    inside = chain.hz < 85
    f = np.arange(8, 85, 0.1)
    H = chain.accelerance(f, ref=[0, 5])
    e, var = noise(H, 0.002)
    truth = chain.accelerance(f)

    def worst_columns(pseudo):
        out = real_shapes_start(
            f, H + e, labels(12), ["1+Z", "6+Z"], chain.hz[inside], chain.zeta[inside], variance=np.full(H.shape, var), pseudo_hz=pseudo
        )
        model = synthesise(f, out.mode_hz, out.zeta, out.shapes, out.shapes)
        return np.sqrt(np.sum(np.abs(model - truth) ** 2, axis=(0, 2)) / np.sum(np.abs(truth) ** 2, axis=(0, 2)))

    with_pseudo, without = worst_columns(None), worst_columns(())
    driven, undriven = [0, 5], np.setdiff1d(np.arange(12), [0, 5])
    assert np.max(with_pseudo[driven]) < 0.003 < 0.05 < np.min(without[driven])
    assert np.median(with_pseudo[undriven]) < 0.85 * np.median(without[undriven])
    assert np.max(with_pseudo) < 0.2


def test_inverted_drive_point_is_flagged_and_the_rest_kept(chain):
    H = chain.accelerance(F, ref=[0, 3])
    H[:, 1] *= -1
    out = real_shapes_start(F, H, labels(8), ["1+Z", "4+Z"], chain.hz, chain.zeta)
    assert out.inverted_references == (1,)
    assert [x.kind for x in out.findings()] == ["drive_point_sign"]
    assert out.findings()[0].dof == "4+Z"
    np.testing.assert_allclose(sign_aligned(out.shapes[:, :8], chain.phi), chain.phi, atol=1e-6)


def test_mode_of_negative_modal_mass_is_flagged(chain):
    H = chain.accelerance(F, ref=[0])
    # one mode turned into one of negative mass
    H -= 2 * synthesise(F, chain.hz[2:3], chain.zeta[2:3], chain.phi[:, 2:3], chain.phi[:1, 2:3])
    out = real_shapes_start(F, H, labels(8), ["1+Z"], chain.hz, chain.zeta)
    assert out.wrong_sign == (2,)
    assert not out.inverted_references
    assert any(x.kind == "drive_point_sign" and x.band_hz for x in out.findings())


def test_mode_with_a_node_at_the_reference_is_unseen():
    chain = Chain(3, spread=0.0, zeta=0.01)  # the middle mass stands still in the second mode
    f = np.arange(30.0, 150, 0.25)
    H = chain.accelerance(f, ref=[1])
    e, var = noise(H, 0.01)
    out = real_shapes_start(f, H + e, labels(3), ["2+Z"], chain.hz, chain.zeta, variance=np.full(H.shape, var))
    assert out.unseen == (1,)
    np.testing.assert_allclose(np.abs(out.shapes[:, [0, 2]]), np.abs(chain.phi[:, [0, 2]]), rtol=0.02)


def test_without_drive_points_shapes_have_no_scale(chain):
    H = chain.accelerance(F, resp=[0, 1, 2, 3], ref=[6, 7])
    out = real_shapes_start(F, H, labels(4), ["7+Z", "8+Z"], chain.hz, chain.zeta)
    assert not out.scaled
    assert out.findings()[0].kind == "missing_drive_point"
    assert [str(d) for d in out.dofs] == ["1+Z", "2+Z", "3+Z", "4+Z", "7+Z", "8+Z"]
    model = synthesise(F, out.mode_hz, out.zeta, out.shapes[:4], out.shapes[4:])
    np.testing.assert_allclose(model, H, atol=1e-4 * np.abs(H).max())


def test_roving_hammer_by_reciprocity(chain):
    H = chain.accelerance(F, resp=[2, 5])
    out = real_shapes_start(F, H, ["3+Z", "6-Z"], labels(8), chain.hz, chain.zeta)
    assert [str(d) for d in out.dofs] == ["3+Z", "6-Z", "1+Z", "2+Z", "4+Z", "5+Z", "7+Z", "8+Z"]
    assert [str(out.references[k]) for k in out.inverted_references] == ["6-Z"]
    H[1] *= -1
    out = real_shapes_start(F, H, ["3+Z", "6-Z"], labels(8), chain.hz, chain.zeta)
    rows = [2, 5, 0, 1, 3, 4, 6, 7]
    truth = chain.phi[rows] * np.array([1, -1, 1, 1, 1, 1, 1, 1])[:, None]
    np.testing.assert_allclose(sign_aligned(out.shapes[:, :8], truth), truth, atol=1e-5)


def test_pairs_that_were_not_measured(chain):
    H = chain.accelerance(F, ref=[0, 3])
    H[5:, 1] = np.nan
    out = real_shapes_start(F, H, labels(8), ["1+Z", "4+Z"], chain.hz, chain.zeta)
    np.testing.assert_allclose(sign_aligned(out.shapes[:, :8], chain.phi), chain.phi, atol=1e-5)


def test_exact_variance_of_zero_is_no_trap(chain):
    H = chain.accelerance(F, ref=[0, 3])
    out = real_shapes_start(F, H, labels(8), ["1+Z", "4+Z"], chain.hz, chain.zeta, variance=np.zeros(H.shape))
    np.testing.assert_allclose(sign_aligned(out.shapes[:, :8], chain.phi), chain.phi, atol=1e-5)


def test_speed_of_a_usual_test():
    chain = Chain(20, zeta=0.006)
    f = np.linspace(5, 150, 4000)
    H = chain.accelerance(f, resp=range(12), ref=[0, 4, 9])
    e, var = noise(H, 0.01)
    start = time.process_time()
    out = real_shapes_start(f, H + e, labels(12), ["1Z", "5Z", "10Z"], chain.hz, chain.zeta, variance=np.full(H.shape, var))
    assert time.process_time() - start < 1.0
    assert np.median(np.abs(np.sum(out.shapes[:, :20] * chain.phi[:12], axis=0) / np.sum(chain.phi[:12] ** 2, axis=0)) - 1) < 0.01


def test_wrong_input_is_explained(chain):
    H = chain.accelerance(F, ref=[0, 3])
    with pytest.raises(DataError, match="do not fit"):
        real_shapes_start(F, H, labels(7), ["1Z", "4Z"], chain.hz, chain.zeta)
    with pytest.raises(IdentificationError, match="no modes"):
        real_shapes_start(F, H, labels(8), ["1Z", "4Z"], [], [])
    with pytest.raises(IdentificationError, match="finite"):
        real_shapes_start(F, H * np.nan, labels(8), ["1Z", "4Z"], chain.hz, chain.zeta)
    assert default_pseudo_hz(0, 100) == pytest.approx((107, 125, 160, 250, 500))

"""Complex operational shapes: gyroscopic truth is flagged, damping and noise are not."""

import numpy as np
import pytest

from operando.data import ModalModel
from operando.scaling import scale_operational
from structures import Chain

LABELS = tuple(f"{i}+Z" for i in range(1, 9))


def complex_modes(chain, damping):
    """State-space modes of the chain with any damping matrix."""
    n = len(chain.hz)
    inverse = np.linalg.inv(chain.M)
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ chain.K, -inverse @ damping]])
    value, vector = np.linalg.eig(a)
    up = value.imag > 0
    value, vector = value[up], vector[:n, up]
    order = np.argsort(np.abs(value))
    return np.abs(value[order]) / 2 / np.pi, -value[order].real / np.abs(value[order]), vector[:, order]


def modal_damping(chain):
    m_phi = chain.M @ chain.phi
    return m_phi @ np.diag(2 * chain.zeta * 2 * np.pi * chain.hz) @ m_phi.T


def hybrid_of(chain, damping, noise=0.0, seed=0, covariance=True):
    hz, zeta, shapes = complex_modes(chain, damping)
    rng = np.random.default_rng(seed)
    m = shapes.shape[0]
    sd = noise * np.sqrt(np.mean(np.abs(shapes) ** 2, axis=0)) / np.sqrt(2)
    shapes = shapes + sd * (rng.normal(size=shapes.shape) + 1j * rng.normal(size=shapes.shape))
    diag = np.concatenate([(3e-4 * hz) ** 2, (0.05 * zeta) ** 2, np.repeat(sd**2, m), np.repeat(sd**2, m)])
    idle = ModalModel(chain.hz, chain.zeta, chain.phi, LABELS, "unit_modal_mass")
    return scale_operational(idle, ModalModel(hz, zeta, shapes, LABELS, covariance=np.diag(diag) if covariance and noise else None))


def flagged(hybrid):
    return [f for f in hybrid.findings if f.kind == "not_reciprocal"]


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_gyroscopic_coupling_is_flagged(noise):
    chain = Chain(8, zeta=0.006)
    skew = np.zeros((8, 8))
    skew[1, 5], skew[5, 1] = 120.0, -120.0
    found = flagged(hybrid_of(chain, modal_damping(chain) + skew, noise))
    assert len(found) == 1
    assert "it cannot be represented by a symmetric OFRF; only the effect route can" in found[0].consequence


@pytest.mark.parametrize("covariance", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_noise_alone_is_not(seed, covariance):
    chain = Chain(8, zeta=0.006)
    assert not flagged(hybrid_of(chain, modal_damping(chain), 0.04 if covariance else 0.02, seed, covariance))


@pytest.mark.parametrize("place", range(8))
def test_a_local_damper_is_not(place):
    """A damper makes shapes complex too, but within what its damping ratios allow."""
    chain = Chain(8, zeta=0.006)
    damper = np.zeros((8, 8))
    damper[place, place] = 60.0
    hybrid = hybrid_of(chain, modal_damping(chain) + damper, 0.01)
    assert np.max(hybrid.imaginary_share) > 0.03
    assert not flagged(hybrid)

"""A mode the idle model lacks, the mass of a sensor, and one mode in band: diagnosis against matrices written by hand."""

from __future__ import annotations

import numpy as np
import pytest

from operando.data import Frf, ModalModel
from operando.diagnosis import diagnose
from operando.results import CheckRun
from structures import Chain

N = 7
HZ = np.arange(10, 160, 0.15)
DOFS = tuple(f"{i + 1}+Z" for i in range(N))


@pytest.fixture(scope="module")
def chain():
    return Chain(N)


def model(hz, zeta, phi, residual=None, band=None):
    n = hz.size
    std = np.r_[1e-6 * hz, 1e-4 * zeta, np.full(N * n, 1e-4)]
    return ModalModel.from_terms(hz, zeta, phi, DOFS, "unit_modal_mass", covariance=np.diag(std**2), residual=residual, band_hz=band)


def check_of(chain, mass, lines=HZ, noise=2e-3, law=None):
    """Accelerance at two references of M + mass (and a stiffness over lines at the fifth DOF), and noise of known variance."""
    law = np.zeros(lines.size) if law is None else law
    c = chain.M @ chain.phi @ np.diag(4 * np.pi * chain.zeta * chain.hz) @ chain.phi.T @ chain.M
    w = 2 * np.pi * lines
    z = [chain.K + lump(4, k) + 1j * x * c - x**2 * (chain.M + mass) for x, k in zip(w, law, strict=True)]
    h = np.array([-(x**2) * np.linalg.inv(matrix)[:, [0, 3]] for x, matrix in zip(w, z, strict=True)])
    h = np.moveaxis(h, 0, 2)
    spread = noise * np.sqrt(np.mean(np.abs(h) ** 2, axis=2, keepdims=True))
    rng = np.random.default_rng(5)
    data = h + spread * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    frf = Frf(data, lines, DOFS, (DOFS[0], DOFS[3]), variance=np.broadcast_to(spread**2, h.shape).copy())
    return CheckRun("check", "1 N rms", frf)


def lump(i, mass):
    out = np.zeros((N, N))
    out[i, i] = mass
    return out


def poles_with(chain, mass):
    """Operational modes of M + mass, unscaled, with standard deviations of 2e-4."""
    from scipy.linalg import eigh

    values, vectors = eigh(chain.K, chain.M + mass)
    hz = np.sqrt(values) / 2 / np.pi
    std = {"frequencies_hz": 2e-4 * hz}
    return ModalModel(hz, chain.zeta, vectors.astype(complex), DOFS, "unscaled", std=std)


def test_a_missing_mode_is_found_with_its_pole(chain):
    lacks = 2
    keep = [r for r in range(N) if r != lacks]
    idle = model(chain.hz[keep], chain.zeta[keep], chain.phi[:, keep])
    found = diagnose(idle, check=[check_of(chain, np.zeros((N, N)))])
    assert found.verdict == "explained"
    assert [e.kind for e in found.effects] == ["missing_mode"]
    (effect,) = found.effects
    assert effect.values["frequency"] == pytest.approx(chain.hz[lacks], rel=1e-4)
    assert effect.values["damping_ratio"] == pytest.approx(chain.zeta[lacks], rel=0.01)
    shape = np.array([effect.shape[str(d)] for d in idle.dofs])
    error = min(np.abs(shape - s * chain.phi[:, lacks]).max() for s in (1, -1))
    assert error < 0.01 * np.abs(chain.phi[:, lacks]).max()


@pytest.mark.parametrize(("there", "kind"), [(False, "sensor_mass"), (True, "point_mass")])
def test_a_mass_that_the_operating_record_does_not_know_is_a_sensor(chain, there, kind):
    mass = lump(4, 0.15)
    idle = model(chain.hz, chain.zeta, chain.phi)
    operating = poles_with(chain, mass if there else np.zeros((N, N)))
    found = diagnose(idle, check=[check_of(chain, mass)], operating=operating)
    assert [(e.kind, str(e.location[0])) for e in found.effects] == [(kind, "5+Z")]
    assert found.effects[0].values["mass"] == pytest.approx(0.15, rel=0.01)


def test_one_mode_in_band_is_undecided_or_right(chain):
    residual = np.arange(N) != 1
    low, high = np.sqrt(chain.hz[0] * chain.hz[1]), np.sqrt(chain.hz[1] * chain.hz[2])
    idle = model(chain.hz, chain.zeta, chain.phi, residual, (low, high))
    found = diagnose(idle, check=[check_of(chain, lump(4, 0.15), np.arange(low, high, 0.02))], band=(low, high))
    told = {e.kind for e in (*found.effects, *found.ambiguous_with)}
    assert "point_mass" in told
    assert found.verdict == "explained" or (found.verdict == "ambiguous" and len(told) >= 2 and found.proposed_measurement)

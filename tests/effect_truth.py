"""Truth for tests of effects: a chain with the effect written into its matrices by hand. Shares no code with operando's effects."""

from __future__ import annotations

import numpy as np

from operando.data import ModalModel
from structures import Chain


def chain_and_idle(n=6, seed=3, **kw):
    """A chain, its viscous damping matrix, and the complete modal model of unit modal mass."""
    chain = Chain(n=n, mass=2.0, stiffness=3e5, zeta=np.linspace(0.01, 0.02, n), seed=seed, **kw)
    w = 2 * np.pi * chain.hz
    chain.C = chain.M @ chain.phi @ np.diag(2 * chain.zeta * w) @ chain.phi.T @ chain.M
    idle = ModalModel(chain.hz, chain.zeta, chain.phi, [f"{i + 1}+Z" for i in range(n)], "unit_modal_mass", band_hz=(5.0, 130.0))
    return chain, idle


def receptance(chain, hz, added=None, mass=0.0, damping=0.0, stiffness=0.0):
    """(K + iωC − ω²M + added(iω))⁻¹, (n, n, lines); ``added`` is a function of s giving a matrix."""
    out = []
    for f in hz:
        s = 2j * np.pi * f
        d = s**2 * (chain.M + mass) + s * (chain.C + damping) + chain.K + stiffness
        out.append(np.linalg.inv(d if added is None else d + added(s)))
    return np.moveaxis(np.array(out), 0, -1)


def at(n, i, j=None):
    """b bᵀ with b = e_i, or e_i − e_j (DOFs count from 0)."""
    b = np.zeros(n)
    b[i] = 1
    if j is not None:
        b[j] = -1
    return np.outer(b, b)


def skew(n, i, j):
    """e_i e_jᵀ − e_j e_iᵀ."""
    out = np.zeros((n, n))
    out[i, j], out[j, i] = 1, -1
    return out


def pole_list(m, c, k):
    """Poles above the real axis of M s² + C s + K by the generalised eigenproblem, by modulus."""
    from scipy.linalg import eig

    n = len(m)
    zero, one = np.zeros((n, n)), np.eye(n)
    values = eig(np.block([[zero, one], [-k, -c]]), np.block([[one, zero], [zero, m]]), right=False)
    values = values[values.imag > 1e-6]
    return values[np.argsort(np.abs(values))]

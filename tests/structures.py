"""Analytic structures for tests: a damped chain of masses, its modes, FRFs and sampled responses. Shares no code with operando."""

from __future__ import annotations

import numpy as np
from scipy.linalg import eigh
from scipy.signal import cont2discrete, lfilter


class Chain:
    """n masses between springs to ground at both ends; modal damping."""

    def __init__(self, n=6, mass=1.0, stiffness=2e5, zeta=0.01, spread=0.1, seed=0):
        rng = np.random.default_rng(seed)
        m = mass * (1 + spread * rng.uniform(-1, 1, n))
        k = stiffness * (1 + spread * rng.uniform(-1, 1, n + 1))
        self.M = np.diag(m)
        self.K = np.diag(k[:-1] + k[1:]) - np.diag(k[1:-1], 1) - np.diag(k[1:-1], -1)
        w2, self.phi = eigh(self.K, self.M)
        self.hz = np.sqrt(w2) / 2 / np.pi
        self.zeta = np.full(n, zeta) if np.isscalar(zeta) else np.asarray(zeta)

    def accelerance(self, f, resp=None, ref=None):
        w = 2 * np.pi * np.asarray(f)
        wr = 2 * np.pi * self.hz
        resp = range(len(self.hz)) if resp is None else resp
        ref = range(len(self.hz)) if ref is None else ref
        out = np.zeros((len(resp), len(ref), w.size), complex)
        for r in range(len(wr)):
            g = -(w**2) / (wr[r] ** 2 - w**2 + 2j * self.zeta[r] * wr[r] * w)
            out += np.multiply.outer(np.outer(self.phi[list(resp), r], self.phi[list(ref), r]), g)
        return out

    def respond(self, force, fs, x0=None):
        """Accelerations (n, samples) to forces (n, samples), forces linear between samples, exact per mode."""
        wr = 2 * np.pi * self.hz
        q_force = self.phi.T @ force
        acc = np.zeros_like(force, dtype=float)
        for r in range(len(wr)):
            A = np.array([[0, 1], [-(wr[r] ** 2), -2 * self.zeta[r] * wr[r]]])
            B = np.array([[0.0], [1.0]])
            C = A[1:2]
            D = np.array([[1.0]])
            Ad, Bd, Cd, Dd, _ = cont2discrete((A, B, C, D), 1 / fs, method="foh")
            # As a recursion (much faster than a state loop): C (zI - A)^-1 = C (z I - adj A) / (z² - tr A z + det A).
            den = np.array([1.0, -np.trace(Ad), np.linalg.det(Ad)])
            adj = np.array([[Ad[1, 1], -Ad[0, 1]], [-Ad[1, 0], Ad[0, 0]]])
            num = np.array([0.0, (Cd @ Bd)[0, 0], -(Cd @ adj @ Bd)[0, 0]]) + Dd[0, 0] * den
            y = lfilter(num, den, q_force[r])
            if x0 is not None:
                start = np.zeros(force.shape[1])
                start[0] = 1.0
                y = y + lfilter([(Cd @ x0[r])[0], -(Cd @ adj @ x0[r])[0]], den, start)
            acc += np.outer(self.phi[:, r], y)
        return acc


def modified(chain, spring=None, mass=None, coupling=None, global_stiffness=0.0, zeta=None):
    """A chain with a ground spring (dof, N/m), a mass (dof, kg), a coupling spring (dof, dof, N/m) or all stiffness scaled."""
    out = object.__new__(Chain)
    out.M, out.K = chain.M.copy(), chain.K * (1 + global_stiffness)
    if spring:
        out.K[spring[0], spring[0]] += spring[1]
    if mass:
        out.M[mass[0], mass[0]] += mass[1]
    if coupling:
        i, j, k = coupling
        b = np.zeros(len(chain.hz))
        b[i], b[j] = 1, -1
        out.K += k * np.outer(b, b)
    w2, out.phi = eigh(out.K, out.M)
    out.hz = np.sqrt(w2) / 2 / np.pi
    out.zeta = chain.zeta if zeta is None else np.full(len(out.hz), zeta)
    return out

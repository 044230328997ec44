"""The model behind the maximum-likelihood fit: responses of real modes to measured forces, with end-state transients.

Each response of a run is X_j = Σ_r φ_jr Q_r + p_j + noise, with the modal acceleration
Q_r = G_r Σ_k φ_kr F_k + T_r. G_r is the accelerance kernel, T_r the transform of the sampled free decay that the state at the
record's beginning and end leaves (two real unknowns a mode and run). p_j is linear in its unknowns: what modes outside the
band add to the FRFs of this run, Σ_q c_jqk G_q F_k over a few fixed kernels G_q above (and, if need be, below) the band, and a few smooth
functions for their transients. Because it is linear and free in each response, nothing out of band can bend the modes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operando.ema.spectra import RunSpectra

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

END_FACTORS = (1.06, 1.2)
N_END = 2 * len(END_FACTORS) + 3
OUTSIDE_DAMPING = 0.01


@dataclass(frozen=True)
class Parameters:
    """Unknowns of the fit.

    Parameters
    ----------
    hz, zeta : (n,) arrays
        Poles.
    shapes : (M, n) array
        Real shapes of unit modal mass.
    outside_hz : (q,) array
        Frequencies of the fixed kernels that stand for modes outside the band.
    transients : tuple of (2, n) arrays
        Amplitudes of T_r for each run (empty for FRF columns).
    local : tuple of (m, b) arrays
        Coefficients of p_j for each run: outside kernels for each force (q·k), then the polynomial (3, where there is a transient).
    """

    hz: Real
    zeta: Real
    shapes: Real
    outside_hz: Real
    transients: tuple[Real, ...]
    local: tuple[Real, ...]


@dataclass(frozen=True)
class RunBasis:
    """Functions of frequency that model and Jacobian of one run are made of; rows of ``stack`` in the order of ``slices``."""

    kernel: Complex  # G (n, L)
    modal: Complex  # Q (n, L)
    stack: Complex  # (K, L)
    outside: Complex  # G_q (q, L)


def kernels(f: Real, hz: Real, zeta: Real, rate: float = 0.0) -> tuple[Complex, Complex, Complex]:
    """Accelerance kernels s²/(s² + 2ζω₀s + ω₀²) and their derivatives with respect to ln f_r and ln ζ_r, each (n, L).

    s = iω + β: an exponential window of rate β moves the numerator with the poles.
    """
    s = 2j * np.pi * f[None, :] + rate
    w0 = 2 * np.pi * hz[:, None]
    damping = 2 * zeta[:, None] * w0 * s
    denominator = w0**2 + s**2 + damping
    g = s**2 / denominator
    ratio = g / denominator
    return np.asarray(g), np.asarray(-ratio * (2 * w0**2 + damping)), np.asarray(-ratio * damping)


def decays(f: Real, hz: Real, zeta: Real, step: float) -> tuple[Complex, Complex, Complex, Complex, Complex, Complex]:
    """Transforms of sampled free decays (real and imaginary amplitude) and derivatives by ln f_r and ln ζ_r.

    Returns
    -------
    t1, t2, dt1_f, dt2_f, dt1_z, dt2_z : (n, L) complex arrays
        T = a·t1 + b·t2 for an amplitude a + ib.
    """
    z1 = np.exp(-2j * np.pi * f * step)[None, :]
    w0 = 2 * np.pi * hz
    root = np.sqrt(1 - zeta**2)
    pole = w0 * (-zeta + 1j * root)
    by_zeta = zeta * w0 * (-1 - 1j * zeta / root)
    scale = np.sqrt(step)  # keeps the amplitudes near the size of the spectra
    decay = np.exp(pole * step)[:, None] * z1
    decay_c = np.exp(pole.conj() * step)[:, None] * z1
    u, v = scale / (1 - decay), scale / (1 - decay_c)
    du, dv = step * decay * u**2 / scale, step * decay_c * v**2 / scale
    fu, fv = du * pole[:, None], dv * pole.conj()[:, None]
    zu, zv = du * by_zeta[:, None], dv * by_zeta.conj()[:, None]
    return u + v, 1j * (u - v), fu + fv, 1j * (fu - fv), zu + zv, 1j * (zu - zv)


def end_basis(f: Real, top_hz: float, step: float) -> Complex:
    """Transients of modes outside the lines: decays a little above the last line, and 1, cos ωΔ, i·sin ωΔ (short real sequences)."""
    angle = 2 * np.pi * f * step
    outside = np.minimum(np.array(END_FACTORS) * top_hz, 0.499 / step)
    t1, t2 = decays(f, outside, np.full(outside.size, OUTSIDE_DAMPING), step)[:2]
    # Unit size keeps the normal equations well scaled.
    parts = np.concatenate([t1, t2])
    parts *= np.abs(1 - np.exp(2j * np.pi * (outside - top_hz) * step))[np.r_[: outside.size, : outside.size], None] / np.sqrt(step)
    return np.concatenate([parts, np.stack([np.ones_like(angle, complex), np.cos(angle) + 0j, 1j * np.sin(angle)])])


def n_local(run: RunSpectra, n_outside: int) -> int:
    """Local basis functions of one run: outside kernels for each force, and the polynomial."""
    return n_outside * run.forces.shape[0] + (0 if run.step_s is None else N_END)


def n_nuisance(run: RunSpectra, n: int, n_outside: int) -> int:
    """Nuisance unknowns of one run: transients, then local coefficients response by response."""
    return (0 if run.step_s is None else 2 * n) + n_local(run, n_outside) * run.response_rows.size


def run_basis(run: RunSpectra, theta: Parameters, index: int, forces: Complex) -> RunBasis:
    """Basis functions of one run.

    Parameters
    ----------
    run : RunSpectra
    theta : Parameters
    index : int
        Number of the run.
    forces : (k, L) complex array
        Forces to use (measured, or cleaned of their noise by the model).

    Returns
    -------
    RunBasis
        stack rows: Q (n), ∂Q/∂ln f (n), ∂Q/∂ln ζ (n), G·F_k (k·n), t1 (n), t2 (n) where there is a transient, local functions.
    """
    f = run.frequencies_hz
    g, gf, gz = kernels(f, theta.hz, theta.zeta, run.window_rate)
    drive = theta.shapes[run.force_rows].T @ forces  # (n, L)
    modal, qf, qz = g * drive, gf * drive, gz * drive
    parts = [modal, qf, qz, *(g * force for force in forces)]
    outside = kernels(f, theta.outside_hz, np.full(theta.outside_hz.size, OUTSIDE_DAMPING), run.window_rate)[0]
    local = [outside * force for force in forces]
    if run.step_s is not None:
        t1, t2, f1, f2, z1, z2 = decays(f, theta.hz, theta.zeta, run.step_s)
        a, b = theta.transients[index][:, :, None]
        modal += a * t1 + b * t2
        qf += a * f1 + b * f2
        qz += a * z1 + b * z2
        parts += [t1, t2]
        local.append(end_basis(f, run.top_hz, run.step_s))
    return RunBasis(g, modal, np.concatenate(parts + local), outside)


def parameter_map(run: RunSpectra, theta: Parameters, offset: int) -> tuple[NDArray[np.int_], Real]:
    """Which parameter each basis row belongs to, and with which factor, for each response.

    Returns
    -------
    index : (m, K) int array
        Position in the parameter vector [ln f (n), ln ζ (n), shapes mode by mode, …, nuisance of this run from ``offset``].
    factor : (m, K) array
    """
    m_dofs, n = theta.shapes.shape
    m = run.response_rows.size
    phi = theta.shapes[run.response_rows]  # (m, n)
    mode = np.arange(n)
    spread = lambda v: np.broadcast_to(v, (m, v.size))  # noqa: E731
    index = [2 * n + mode[None, :] * m_dofs + run.response_rows[:, None], spread(mode), spread(n + mode)]
    factor = [np.ones((m, n)), phi, phi]
    for row in run.force_rows:
        index.append(spread(2 * n + mode * m_dofs + row))
        factor.append(phi)
    base = offset
    if run.step_s is not None:
        index += [spread(base + mode), spread(base + n + mode)]
        factor += [phi, phi]
        base += 2 * n
    b = n_local(run, theta.outside_hz.size)
    index.append(base + np.arange(m)[:, None] * b + np.arange(b)[None, :])
    factor.append(np.ones((m, b)))
    return np.concatenate(index, axis=1), np.concatenate(factor, axis=1)


def predict(run: RunSpectra, theta: Parameters, index: int, basis: RunBasis) -> Complex:
    """Modelled responses (m, L)."""
    b = theta.local[index].shape[1]
    out = theta.shapes[run.response_rows] @ basis.modal
    return np.asarray(out + theta.local[index] @ basis.stack[basis.stack.shape[0] - b :])


def transfer(run: RunSpectra, theta: Parameters, index: int, basis: RunBasis) -> Complex:
    """FRFs of the run's responses and forces, (k, m, L)."""
    phi = theta.shapes[run.response_rows]
    q = theta.outside_hz.size
    out = []
    for i, row in enumerate(run.force_rows):
        h = (phi * theta.shapes[row][None, :]) @ basis.kernel
        out.append(h + theta.local[index][:, i * q : (i + 1) * q] @ basis.outside)
    return np.stack(out)

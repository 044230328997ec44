"""The model behind the maximum-likelihood fit: responses of real modes to measured forces, with end-state transients.

Each response of a run is X_j = Σ_r φ_jr Q_r + p_j + noise, with the modal acceleration
Q_r = G_r Σ_k φ_kr F_k + T_r. G_r is the accelerance kernel, T_r the transform of the sampled free decay that the state at the
record's beginning and end leaves (two real unknowns a mode and run). p_j is linear in its unknowns: what modes outside the
band add to the FRFs of this run, Σ_q c_jqk G_q F_k over a few fixed kernels G_q above (and, if need be, below) the band, and a few smooth
functions for their transients. Because it is linear and free in each response, nothing out of band can bend the modes.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.ema.spectra import RunSpectra
from operando.synthesis import combined, kernel_derivatives, modal_kernel, row_blocks

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

END_FACTORS = (1.06, 1.2)
N_END = 2 * len(END_FACTORS) + 3
OUTSIDE_DAMPING = 0.01

KEPT = 2
"""Sets of lines whose functions are kept: columns of one FRF matrix share one."""


@dataclass(frozen=True)
class Parameters:
    """Unknowns of the fit.

    ``hz`` and ``zeta`` (n,) are poles, ``shapes`` (M, n) real shapes of unit modal mass, ``outside_hz`` and ``outside_zeta`` (q,) the poles
    of the fixed kernels that stand for modes outside the band. For each run ``transients`` are amplitudes of T_r (2, n) (empty for FRF
    columns), and ``local`` coefficients of p_j (m, b): outside kernels for each force (q·k), then the polynomial (3, where there is a
    transient).
    """

    hz: Real
    zeta: Real
    shapes: Real
    outside_hz: Real
    outside_zeta: Real
    transients: tuple[Real, ...]
    local: tuple[Real, ...]
    _known: dict[tuple[Any, ...], LineFunctions] = field(default_factory=dict, init=False, repr=False, compare=False)

    def modes(self, which: NDArray[np.int_]) -> Parameters:
        """The parameters with some of the modes, in the order given; transients and local terms stay as they are."""
        n = self.hz.size
        return replace(
            self,
            hz=self.hz[which],
            zeta=self.zeta[which],
            shapes=self.shapes[:, which],
            transients=tuple(t[:, which] if t.shape[1] == n else t for t in self.transients),
        )

    def functions(self, run: RunSpectra) -> LineFunctions:
        """What the poles make of the lines of a run; kept for the next one, because runs mostly share their lines."""
        key = (run.window_rate, run.step_s, run.top_hz, run.frequencies_hz.tobytes())
        if key not in self._known:
            while len(self._known) >= KEPT:
                self._known.pop(next(iter(self._known)))
            self._known[key] = _line_functions(run, self)
        return self._known[key]


@dataclass(frozen=True)
class LineFunctions:
    """Functions of frequency that depend on poles and lines alone."""

    kernels: tuple[Complex, Complex, Complex]  # G and its derivatives by ln f and ln ζ, (n, L)
    outside: Complex  # G_q (q, L)
    decays: tuple[Complex, ...]  # see ``decays``; empty where there is no transient
    ends: Complex  # (N_END or 0, L)


@dataclass(frozen=True)
class RunModel:
    """What the responses of one run are a sum of."""

    kernel: Complex  # G (n, L)
    modal: Complex  # Q (n, L)
    local: Complex  # (b, L)
    outside: Complex  # G_q (q, L)


def decays(f: Real, hz: Real, zeta: Real, step: float) -> tuple[Complex, ...]:
    """Transforms of sampled free decays and derivatives by ln f_r and ln ζ_r: t1, t2, dt1_f, dt2_f, dt1_z, dt2_z, each (n, L).

    T = a·t1 + b·t2 for an amplitude a + ib.
    """
    z1 = np.exp(-2j * np.pi * f * step)
    w0 = 2 * np.pi * hz
    root = np.sqrt(1 - zeta**2)
    pole = w0 * (-zeta + 1j * root)
    by_zeta = zeta * w0 * (-1 - 1j * zeta / root)
    scale = np.sqrt(step)  # keeps the amplitudes near the size of the spectra
    out = np.empty((6, hz.size, f.size), complex)
    for rows in row_blocks(hz.size, f.size):
        p, z = pole[rows, None], by_zeta[rows, None]
        decay, decay_c = np.exp(p * step) * z1, np.exp(p.conj() * step) * z1
        u, v = scale / (1 - decay), scale / (1 - decay_c)
        du, dv = step / scale * decay * u**2, step / scale * decay_c * v**2
        for k, (a, b) in enumerate([(u, v), (du * p, dv * p.conj()), (du * z, dv * z.conj())]):
            np.add(a, b, out=out[2 * k, rows])
            np.multiply(1j, a - b, out=out[2 * k + 1, rows])
    return tuple(out)


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


def _line_functions(run: RunSpectra, theta: Parameters) -> LineFunctions:
    f = run.frequencies_hz
    return LineFunctions(
        kernel_derivatives(f, theta.hz, theta.zeta, run.window_rate),
        modal_kernel(f, theta.outside_hz, theta.outside_zeta, "accelerance", run.window_rate),
        () if run.step_s is None else decays(f, theta.hz, theta.zeta, run.step_s),
        np.zeros((0, f.size), complex) if run.step_s is None else end_basis(f, run.top_hz, run.step_s),
    )


def run_model(run: RunSpectra, theta: Parameters, index: int, forces: Complex) -> RunModel:
    """Modal accelerations and local functions of run ``index`` under forces (k, L), measured or cleaned of their noise by the model."""
    known = theta.functions(run)
    g = known.kernels[0]
    modal = g * combined(theta.shapes[run.force_rows].T, forces)
    if known.decays:
        a, b = theta.transients[index][:, :, None]
        modal += a * known.decays[0] + b * known.decays[1]
    local = np.concatenate([*(known.outside * force for force in forces), known.ends])
    return RunModel(g, modal, local, known.outside)


def jacobian_functions(run: RunSpectra, theta: Parameters, index: int, forces: Complex) -> Complex:
    """What the Jacobian of one run is made of, (K, L): Q (n), ∂Q/∂ln f (n), ∂Q/∂ln ζ (n), G·F_k (k·n), t1 (n), t2 (n) where there is a
    transient, local functions."""
    model, known = run_model(run, theta, index, forces), theta.functions(run)
    drive = combined(theta.shapes[run.force_rows].T, forces)
    g, gf, gz = known.kernels
    qf, qz = gf * drive, gz * drive
    if known.decays:
        a, b = theta.transients[index][:, :, None]
        qf += a * known.decays[2] + b * known.decays[3]
        qz += a * known.decays[4] + b * known.decays[5]
    return np.concatenate([model.modal, qf, qz, *(g * force for force in forces), *known.decays[:2], model.local])


def parameter_map(run: RunSpectra, theta: Parameters, offset: int) -> tuple[NDArray[np.int_], Real]:
    """Which parameter each basis row belongs to, and with which factor, for each response, (m, K).

    Positions are in the parameter vector [ln f (n), ln ζ (n), shapes mode by mode, …, nuisance of this run from ``offset``].
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


def predict(run: RunSpectra, theta: Parameters, index: int, model: RunModel) -> Complex:
    """Modelled responses (m, L)."""
    return combined(
        np.concatenate([theta.shapes[run.response_rows], theta.local[index]], axis=1), np.concatenate([model.modal, model.local])
    )


def transfer(run: RunSpectra, theta: Parameters, index: int, model: RunModel) -> Complex:
    """FRFs of the run's responses and forces, (k, m, L)."""
    phi = theta.shapes[run.response_rows]
    q = theta.outside_hz.size
    functions = np.concatenate([model.kernel, model.outside])
    local = theta.local[index]
    parts = [np.concatenate([phi * theta.shapes[row], local[:, i * q : (i + 1) * q]], axis=1) for i, row in enumerate(run.force_rows)]
    return np.stack([combined(part, functions) for part in parts])

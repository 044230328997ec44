"""One record with measured force against the idle model: spectra of the whole record, nuisance, and what the model leaves.

The running structure is the idle one under one force more: X = H0·(F − b·S) + T + noise, where S is the transform of the restoring
force s of the effect along b and T the free decays that the states at the beginning and the end of the record leave. The idle model
is linear and known, so this holds on every line of an unwindowed record.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as sfft
from scipy.linalg import block_diag

from operando.data import ModalModel, TimeRecord
from operando.diagnosis.records.day import Day
from operando.dof import Dof, match_dofs
from operando.errors import DataError
from operando.structure.modal_space import Complex, Modes, Real

START_NOISE = 0.003
"""Noise over rms of a response assumed before anything is known of it."""

VARIANCE_LINES, EVEN_LINES = 48, 16
"""Lines over which the noise is averaged, and over which it is even."""

SLACK = 5.0
"""Standard deviation of the free decays over the rms state of their modes."""

EXACT = 1e-7
"""Relative standard deviation of a frequency or damping ratio that counts as exact, so that covariances with a zero have an inverse: less
than a hundredth of a line of ten minutes at 100 Hz (2 mHz)."""

OWN_STRIDE = 4
"""The idle model's own variance is computed on one line of so many: resonances are wider."""


@dataclass(frozen=True)
class Run:
    """A record of N samples in the frequency domain, all senses as in the idle model of m DOFs; L lines are compared with the model."""

    name: str
    sampling_hz: float
    n_samples: int
    rows: NDArray[np.int_]  # of the idle model that were measured (q,)
    forces_at: tuple[int, ...]  # rows of the idle model that were driven with a measured force
    drives: Real  # forces on the modes per unit of each force (k, terms); known restoring forces stand behind the measured forces
    forces: Complex  # spectra on all lines (k, N//2+1)
    responses: Complex  # accelerations on all lines (q, N//2+1)
    lines: NDArray[np.int_]  # (L,)
    hz: Real
    kernel: Complex  # receptance kernels of the modes on these lines (n, L)
    moving: Complex  # modal accelerations under the measured forces, on another day under all that act (n, L)
    error: Complex  # X − H0·F: what the idle model leaves, transients still in it (q, L)
    variance: Real  # E|error|² of each line: noise, and the idle model's own
    own: Real  # variance of H0·F that the covariance of the idle model leaves; 0 where it has none
    nuisance: Complex  # modal accelerations: free decays (two real amplitudes a ringing mode), then what another day leaves open (J, L)
    nuisance_shapes: Real  # (q, J)
    nuisance_prior: Real  # inverse covariance of their amplitudes (J, J)
    ringing: int  # r, of J = 2r + 2n
    shapes: Real  # of all modes, as the sensors show them (q, terms)
    beside: Complex  # accelerations that the sensors show beside those of their DOFs (q, L)
    changing: NDArray[np.int_]  # modes whose frequency, then damping, the columns after the decays change (2n,)
    force_level: float  # rms of all forces [N]
    springs: dict[tuple[int, ...], tuple[float, float]]  # of :class:`Day`; empty on the day of the idle model

    @property
    def all_hz(self) -> Real:
        """Frequencies of all lines [Hz]."""
        return np.asarray(sfft.rfftfreq(self.n_samples, 1 / self.sampling_hz))

    @property
    def omega(self) -> Real:
        """Angular frequencies of the lines compared [rad/s]."""
        return 2 * np.pi * self.hz

    def on(self, keep: NDArray[Any] | slice) -> Run:
        """The run on some of its lines."""
        some = {
            name: getattr(self, name)[..., keep]
            for name in ("lines", "hz", "kernel", "moving", "error", "variance", "own", "nuisance", "beside")
        }
        return replace(self, **some)

    def without(self, bands: Sequence[tuple[float, float]]) -> Run:
        """The run without the lines inside the bands [Hz]."""
        keep = np.ones(self.hz.size, bool)
        for low, high in bands:
            keep &= (self.hz < low) | (self.hz > high)
        return self if keep.all() else self.on(keep)

    @property
    def modal_forces(self) -> Complex:
        """On all lines, (terms, N//2+1)."""
        return np.asarray(self.drives.T @ self.forces)

    def with_force(self, drive: Real, accelerance: Complex, force: Complex) -> Run:
        """The run with one more known force of such a drive: its spectrum on all lines, and the accelerances (q, L) it acts through."""
        return replace(
            self,
            drives=np.concatenate([self.drives, drive[None]]),
            forces=np.concatenate([self.forces, force[None]]),
            error=self.error - accelerance * force[self.lines],
        )

    def accelerance(self, drive: Real) -> Complex:
        """Accelerations of the measured rows per unit of a force with a drive (terms,), (q, L)."""
        return np.asarray(-(self.omega**2) * (self.shapes @ (self.kernel * drive[:, None])))

    def fallen(self, amplitudes: Real) -> Complex:
        """What amplitudes of free decays and of another day make at the responses, (q, L)."""
        return np.asarray(self.nuisance_shapes @ (amplitudes[:, None] * self.nuisance))


def make_run(record: TimeRecord, idle: ModalModel, modes: Modes, band: tuple[float, float], day: Day | None = None) -> Run:
    """Spectra of one record and what the idle model (``modes``: as arrays) leaves of its responses on the lines of a band [Hz].

    Velocities and displacements are brought to accelerations by powers of iω. On another day sensors show something else than shapes of the
    idle model, and its frequencies and damping are found anew beside each force, as the free decays are.
    """
    known = {d.key for d in idle.dofs}
    where = record.name or None

    def usable(channels: Sequence[int]) -> dict[int, Dof]:
        return {i: d for i in channels if (d := record.channels[i].dof) is not None and d.key in known}

    driven, measured = usable(record.force_indices), usable(record.response_indices)
    if not driven or len(driven) < len(record.force_indices):
        raise DataError(
            "a force of the record is not at a DOF of the idle model", where=where, hint="measure the drive point in the idle state, too"
        )
    if not measured:
        raise DataError("no response of the record is a DOF of the idle model", where=where)
    n = record.n_samples
    if n / record.sampling_hz * (band[1] - band[0]) < 100:
        raise DataError(f"{record.duration_s:g} s are too short for a diagnosis in {band[0]:g} … {band[1]:g} Hz", where=where)
    while sfft.next_fast_len(n, real=True) != n:
        n -= 1
    data = np.asarray(record.data[:, :n], float)
    rows, signs = match_dofs(tuple(measured.values()), idle.dofs)
    at, force_signs = match_dofs(tuple(driven.values()), idle.dofs)
    forces = sfft.rfft(data[list(driven)] * np.asarray(force_signs, float)[:, None], axis=1)
    responses = sfft.rfft(data[list(measured)] * np.asarray(signs, float)[:, None], axis=1)
    hz = sfft.rfftfreq(n, 1 / record.sampling_hz)
    power = {"acceleration": 0, "velocity": 1, "displacement": 2}
    for k, i in enumerate(measured):
        responses[k] *= (2j * np.pi * hz) ** power[record.channels[i].quantity]
    lines = np.flatnonzero((hz >= max(band[0], 1.5 * hz[1])) & (hz <= min(band[1], 0.47 * record.sampling_hz)))
    f = hz[lines]
    kernel = modes.receptance_kernel(f)
    rows_ = np.asarray(rows)
    drives = modes.phi[np.asarray(at)] if day is None else np.stack([day.driven.get(int(i), modes.phi[i]) for i in at])
    moving = -((2 * np.pi * f) ** 2) * kernel * (drives.T @ forces[:, lines])
    shapes = (modes.phi if day is None else day.shown)[rows_]
    seen = None if day is None else day.seen(f, rows_, at)
    predicted = shapes @ moving if seen is None else np.einsum("lqk,kl->ql", seen, forces[:, lines])
    error = responses[:, lines] - predicted
    ringing = modes.ringing(record.sampling_hz)
    nuisance = free_decays(f, modes.poles[ringing], 1 / record.sampling_hz)
    prior = np.diag(1 / np.maximum(decay_sizes(modes, ringing, drives, forces, hz, float(f[0])), 1e-150) ** 2)
    changing, beside = np.zeros(0, int), np.zeros(error.shape, complex)
    level = np.mean(np.abs(responses[:, lines]) ** 2, axis=1, keepdims=True)
    if day is not None:
        changing = np.concatenate([day.modes, day.modes])
        moving = moving_modes(shapes, moving, error, START_NOISE**2 * level)
        beside = (shapes - modes.phi[rows_]) @ moving
        nuisance = np.concatenate([nuisance, day.slopes(modes, kernel, moving, f)])
        prior = block_diag(prior, np.linalg.inv(day.covariance + EXACT**2 * np.eye(changing.size)))
    # FRFs of the day itself say what the forces do, and hold the errors of the idle model no more.
    own = np.zeros(error.shape) if seen is not None else own_variance(idle, rows_, tuple(int(i) for i in at), forces[:, lines], f)
    return Run(
        record.name,
        record.sampling_hz,
        n,
        rows_,
        tuple(int(i) for i in at),
        drives,
        forces,
        responses,
        lines,
        f,
        kernel,
        moving,
        error,
        START_NOISE**2 * level + own,
        own,
        nuisance,
        shapes[:, [*ringing, *ringing, *changing]],
        prior,
        ringing.size,
        shapes,
        beside,
        changing,
        float(np.sqrt(np.mean(data[list(driven)] ** 2))),
        {} if day is None else day.springs,
    )


def moving_modes(shapes: Real, predicted: Complex, error: Complex, noise: Real) -> Complex:
    """Modal accelerations (terms, L) under all forces: those predicted under the measured ones, and what the errors (q, L) show of others.

    Weighted by the variance of the responses (q, 1), and by the mean power of what is predicted.
    """
    weighted = shapes / noise
    gram = weighted.T @ shapes + np.diag(1 / np.maximum(np.mean(np.abs(predicted) ** 2, axis=1), 1e-300))
    return np.asarray(predicted + np.linalg.solve(gram, weighted.T @ error))


def own_variance(idle: ModalModel, rows: NDArray[np.int_], driven: Sequence[int], forces: Complex, hz: Real) -> Real:
    """Variance (q, L) of the accelerations that the idle model predicts under measured forces (k, L), from its covariance.

    Its errors stand at its resonances, where what it predicts may be many times what the running structure does. Even over some lines.
    """
    if idle.covariance is None:
        return np.zeros((rows.size, hz.size))
    few = np.arange(0, hz.size, OWN_STRIDE)
    frf = idle.frf(hz[few], [idle.dofs[i] for i in rows], [idle.dofs[i] for i in driven], "accelerance")
    if frf.variance is None:
        return np.zeros((rows.size, hz.size))
    power = np.sum(frf.variance * np.mean(np.abs(forces) ** 2, axis=1)[None, :, None], axis=1)
    return evened(power, hz.size, EVEN_LINES // OWN_STRIDE, EVEN_LINES)


def evened(values: Real, count: int, width: int, lines: int) -> Real:
    """Means (q, ·) over so many values each, repeated over so many lines each until there are ``count``."""
    starts = np.arange(0, values.shape[1], width)
    size = np.diff(np.append(starts, values.shape[1]))
    return np.asarray(np.repeat(np.add.reduceat(values, starts, axis=1) / size, lines, axis=1)[:, :count])


def decay_sizes(modes: Modes, ringing: NDArray[np.int_], drives: Real, forces: Complex, hz: Real, low_hz: float) -> Real:
    """Sizes (2r,) of the free decays in modal acceleration: some times the state (rms) that forces (k, N//2+1) from ``low_hz`` on keep up.

    A mode beyond the band rings as others do, but hardly shows in it: left free it would take any size, and move the place by any
    distance. Forces that are not measured drive modes, too, so each mode counts as driven where it moves as usual at least.
    """
    n = 2 * (hz.size - 1)
    w0 = 2 * np.pi * modes.hz[ringing]
    keep = hz >= low_hz
    w = 2 * np.pi * hz[keep]
    here = modes.only(ringing)
    gain = np.abs(here.receptance_kernel(hz[keep])) ** 2 * (w0[:, None] ** 2 + w**2)
    usual = np.mean(modes.phi[:, ringing] ** 2, axis=0)
    power = np.zeros(ringing.size)
    for drive, f in zip(drives[:, ringing], forces, strict=True):
        power += np.maximum(drive**2, usual) * (gain @ np.abs(f[keep]) ** 2)
    size = SLACK * w0 * np.sqrt(power) / n
    return np.concatenate([size, size])


def free_decays(hz: Real, poles: Complex, step: float) -> Complex:
    """Transforms of sampled free decays: for amplitude a + ib the decay is a·first + b·second; (2r, L), first ones first."""
    z = np.exp(-2j * np.pi * hz * step)[None, :]
    up, down = 1 / (1 - np.exp(poles * step)[:, None] * z), 1 / (1 - np.exp(poles.conj() * step)[:, None] * z)
    return np.concatenate([up + down, 1j * (up - down)])


def running_mean(power: Real) -> Real:
    """Mean of (…, L) over neighbouring lines."""
    count = power.shape[-1]
    width = min(VARIANCE_LINES, max(8, count // 12))
    total = np.cumsum(power, axis=-1)
    total = np.concatenate([np.zeros_like(total[..., :1]), total], axis=-1)
    index = np.arange(count)
    low, high = np.maximum(index - width // 2, 0), np.minimum(index + width // 2 + 1, count)
    return np.asarray((total[..., high] - total[..., low]) / (high - low))


def smoothed_variance(residual: Complex, floor: Real, freedom: float) -> Real:
    """Noise of each line from residuals (q, L): mean square over neighbours, corrected for what was fitted, above a floor (q, 1)."""
    power = np.abs(residual) ** 2 / freedom
    smooth = np.maximum(running_mean(power), floor)
    # Even over a few lines: then the normal equations of the free decays are cheap.
    return evened(smooth, power.shape[1], EVEN_LINES, EVEN_LINES)

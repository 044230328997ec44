"""The motion across a place in one record: in the band as the model under the forces has it, above as measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy import fft as sfft

from operando.diagnosis.records.place import Along
from operando.structure.force_law import ForceLaw
from operando.structure.modal_space import Complex, Modes, Real, decay_in_time

FINE_BELOW = 8.0
"""Motions are brought to twice the rate where a record has fewer samples than this in a period of the last line."""

EDGE = 8.0
"""Periods of the last line at each end of a record in which the motion may be no larger than elsewhere."""

SLOPE_STEP, SLOPES = 0.01, 2
"""Relative change of the motion for the slope of a law; turns in which it is taken anew."""

TURNS, WALKED = 12, 4
"""Turns in which motion and law are brought together; where the law remembers: each walks through the whole record."""

MADE = 8
"""Spectra of laws that a motion keeps."""


@dataclass(frozen=True)
class PlaceDrive:
    """What moves a place in one run: x = base − H_bb·S on all lines, with the free decays in time.

    In the band and below it the model under the measured force: displacement noise of an accelerometer grows with 1/ω², that of the
    model does not. Above the band the measured acceleration takes over, and on another day in the band, too, as far as less is known of the
    model than of the sensors: under a stiff contact base and H_bb·S nearly cancel at the resonances of the idle model.
    """

    base: Complex  # displacement under the measured force; above the band as measured (N//2+1,)
    compliance: Complex  # H_bb; 0 above the band
    fall_x: Real  # free decays (N·fine,)
    fall_v: Real
    omega: Real  # (N//2+1,)
    fine: int  # steps a sample: a force with kinks has a wider spectrum than the motion, and would fold back
    edge: int = 1  # steps at each end where the motion is doubtful

    @classmethod
    def of(cls, along: Along, modes: Modes, amplitudes: Real, extra: Complex | None = None) -> PlaceDrive:
        """From amplitudes (J,) of the nuisance; ``extra`` is receptance across the place that the modes lack, on all lines."""
        run = along.run
        hz = run.all_hz
        w = 2 * np.pi * hz
        top = int(run.lines[-1]) + 1
        across = modes.phi.T @ along.b
        first_hz = float(run.hz[0])
        spurious = modes.spurious(along.b, first_hz)
        kernel = modes.bounded_kernel(hz[:top], spurious, first_hz) * across[:, None]
        base, compliance = np.zeros(hz.size, complex), np.zeros(hz.size, complex)
        for shape, force in zip(run.drives, run.forces, strict=True):
            base[:top] += (shape @ kernel) * force[:top]
        compliance[:top] = across @ kernel
        if extra is not None:
            compliance[:top] += extra[:top]
        ringing = modes.ringing(run.sampling_hz)
        poles = modes.poles[ringing]
        weights = np.where(spurious, 0.0, across)[ringing] * (amplitudes[: run.ringing] + 1j * amplitudes[run.ringing : 2 * run.ringing])
        fine = 2 if run.sampling_hz < FINE_BELOW * run.hz[-1] else 1
        decays = np.stack([weights / poles**2, weights / poles, weights])
        fall = decay_in_time(poles, decays, run.n_samples * fine, 1 / (run.sampling_hz * fine))
        measured = np.flatnonzero(along.b[run.rows])
        if measured.size == np.count_nonzero(along.b):
            a = along.b[run.rows[measured]] @ run.responses[measured] - sfft.rfft(fall[2, ::fine])
            base[top:] = -a[top:] / w[top:] ** 2
            if run.changing.size:
                at = run.rows[measured]
                share = measured_share(along, across, along.b[at] ** 2 @ run.variance[measured])
                seen = -(a[run.lines] - along.b[at] @ run.beside[measured]) / run.omega**2
                base[run.lines] += share * (seen - base[run.lines])
                compliance[run.lines] *= 1 - share
        edge = max(1, int(EDGE * run.sampling_hz * fine / run.hz[-1]))
        return cls(base, compliance, fall[0], fall[1], w, fine, edge)

    def lines(self, signal: Real, fine: int | None = None) -> Complex:
        """Transform of a signal on the fine grid, or one of so many steps a sample, on all lines of the record."""
        return np.asarray(sfft.rfft(signal)[..., : self.omega.size] / (fine or self.fine))

    def in_time(self, spectrum: Complex) -> Real:
        """A spectrum on the record's lines in time, on the fine grid."""
        full = np.zeros((*spectrum.shape[:-1], self.fall_x.size // 2 + 1), complex)
        full[..., : spectrum.shape[-1]] = spectrum * self.fine
        return np.asarray(sfft.irfft(full, self.fall_x.size, axis=-1))

    def move(self, force: Complex) -> tuple[Real, Real]:
        """Displacement and velocity across the place under a restoring force given on all lines."""
        return self.moved(self.base - self.compliance * force)

    def moved(self, x: Complex) -> tuple[Real, Real]:
        """Displacement and velocity of a spectrum of displacement and the decays, the ends no larger than the rest."""
        displacement, velocity = self.in_time(np.stack([x, 1j * self.omega * x]))
        return self.within(displacement + self.fall_x), self.within(velocity + self.fall_v)

    def within(self, motion: Real) -> Real:
        """The motion with its ends no larger than the rest.

        States at the ends are known as far as the band shows them; what is wrong there, a law of high order would make into the largest
        force of all. A wrong force of usual size at the ends is but a free decay.
        """
        edge = min(self.edge, motion.size // 8)
        reach = float(np.max(np.abs(motion[edge:-edge])))
        out = motion.copy()
        for part in (slice(None, edge), slice(-edge, None)):
            out[part] = np.clip(motion[part], -reach, reach)
        return out


def measured_share(along: Along, across: Real, noise: Real) -> Real:
    """Weight (L,) of the measured motion against the model's, whose variance is what another day leaves open.

    ``across`` (terms,) are the shapes across the place, ``noise`` (L,) is the variance of its measured acceleration.
    """
    run = along.run
    columns = across[run.changing, None] * run.nuisance[2 * run.ringing :]
    prior = run.nuisance_prior[2 * run.ringing :, 2 * run.ringing :]
    of_model = np.sum(columns.conj() * np.linalg.solve(prior, columns), axis=0).real
    return np.asarray(of_model / (of_model + noise))


@dataclass(frozen=True)
class Motion:
    """Motion across a place in one run, and the run seen along it on the lines of one set."""

    x: Real  # (N·fine,)
    v: Real
    step: float
    along: Along
    crossing: PlaceDrive
    force: Complex  # restoring force without a law, on all lines of the run (L,)
    taken: Real  # how far the data decide about it (L,)
    made: dict[Any, Complex] = field(default_factory=dict, compare=False, repr=False)
    """Spectra on all lines of laws taken along this motion: the sets of lines share it."""
    closed: Mapping[Any, Complex] = field(default_factory=dict, compare=False, repr=False)
    """Spectra that laws made in the closed loop, by :attr:`ForceLaw.key`: they stand for the law along the motion."""

    def spectrum(self, law: ForceLaw) -> Complex:
        """Transform of a law's restoring force on all lines of the record, (N//2+1,)."""
        known = self.closed.get(law.key)
        if known is not None:
            return known
        whole = self.made.get(law.key)
        if whole is None:
            whole = self.crossing.lines(law.force(self.x, self.v, self.step))
            if len(self.made) >= MADE:
                self.made.clear()
            self.made[law.key] = whole
        return whole

    def under(self, law: ForceLaw) -> Complex:
        """Transform of a law's restoring force (L,) on the lines."""
        return np.asarray(self.spectrum(law)[self.along.run.lines])

    def beside(self, law: ForceLaw) -> Complex:
        """The same with what open springs at the place add to it."""
        return self.along.beside(self.under(law))

    def spectra(self, forces: Real) -> Complex:
        """Transforms of restoring forces (…, N·fine) on the lines."""
        return np.asarray(self.crossing.lines(forces)[..., self.along.run.lines])

    def unfine(self, signal: Real) -> Complex:
        """Transform on the lines of a signal at the record's own rate."""
        return np.asarray(sfft.rfft(signal)[self.along.run.lines])

    @property
    def own_x(self) -> Real:
        """Displacement at the record's own rate."""
        return self.x[:: self.crossing.fine]

    @property
    def own_rise(self) -> Real:
        """Velocity at the record's own rate times its step."""
        return self.v[:: self.crossing.fine] * self.step * self.crossing.fine

    @property
    def coarse(self) -> Motion:
        """The motion at the record's own rate, for comparing laws: what a kink folds back is small beside what tells them apart."""
        fine = self.crossing.fine
        if fine == 1:
            return self
        crossing = replace(self.crossing, fine=1)
        return replace(self, x=self.own_x, v=self.v[::fine], step=self.step * fine, crossing=crossing, made={}, closed={})

    def without_fastest(self, law: ForceLaw, part: float) -> float:
        """Mean weighted square by which the responses change if the law is taken without the motion above a part of the recorded band."""
        n = self.x.size
        slow = sfft.rfftfreq(n, self.step) < part * self.along.run.sampling_hz / 2
        x, v = (sfft.irfft(sfft.rfft(motion) * slow, n) for motion in (self.x, self.v))
        change = self.spectra(law.force(x, v, self.step) - law.force(self.x, self.v, self.step))
        return float(np.sum(np.abs(self.along.gain * change) ** 2) / self.along.weighted.root.size)

    def above_noise(self, part: float) -> float:
        """Power of the acceleration measured across the place above a part of the recorded band, over that of the noise."""
        run = self.along.run
        rows = np.flatnonzero(self.along.b[run.rows])
        weights = self.along.b[run.rows[rows]]
        fast = run.all_hz > part * run.sampling_hz / 2
        noise = float(np.sum(weights**2 * np.median(run.variance[rows], axis=1)))
        return float(np.mean(np.abs(weights @ run.responses[np.ix_(rows, fast)]) ** 2)) / noise

    def settled(self, law: ForceLaw) -> Motion:
        """The motion with the law in place of the restoring force on the lines the data say nothing about (the mean among them)."""
        crossing, lines = self.crossing, self.along.run.lines
        share = np.zeros(crossing.base.size)
        share[lines] = self.taken
        share[lines[-1] + 1 :] = 1.0
        seen = np.zeros(crossing.base.size, complex)
        seen[lines] = self.force
        now = crossing.lines(self.x - crossing.fall_x)
        kept, best, change, slope = (self.x, self.v), now, np.zeros_like(now), 0.0
        relax, least = 1.0, np.inf
        with np.errstate(over="ignore", invalid="ignore"):
            for turn in range(WALKED if law.remembers else TURNS):
                x, v = kept if turn == 0 else crossing.moved(now)
                s = law.force(x, v, self.step)
                # Newton's step with the law's slope, weighted with the motion: the plain substitution diverges where the contact is
                # stiffer than the structure. Of a law that walks through the whole record the secant stands for its slope.
                if turn < SLOPES:
                    faster = (x * (1 + SLOPE_STEP), v)
                    grown = s if law.remembers else (law.force(*faster, self.step) - s) / SLOPE_STEP
                    slope = float(x @ grown) / max(float(x @ x), 1e-300)
                target = crossing.base - crossing.compliance * (share * seen + (1 - share) * crossing.lines(s))
                miss = float(np.sum(np.abs(target - now) ** 2))
                if not miss < least:
                    # Went too far, or beyond all bounds: half as far, from where it was.
                    relax *= 0.5
                    change *= 0.5
                    now = best + change
                    continue
                kept, best, least = (x, v), now, miss
                if miss < 1e-8 * np.sum(np.abs(now) ** 2):
                    break
                change = relax / (1 + crossing.compliance * (1 - share) * max(slope, 0.0)) * (target - now)
                now = best + change
        return replace(self, x=kept[0], v=kept[1], made={}, closed={})

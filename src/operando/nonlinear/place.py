"""One place and one record: the restoring force without a law, the motion across the place, and regressions on pseudo-forces.

On each line the weighted error is split into its part along h_b = H0·b, a scalar that a force at the place can make, and the rest, which no
force there can. The free decays are eliminated through their normal equations, which do not depend on the place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import fft as sfft
from scipy.linalg import cho_factor, cho_solve

from operando.nonlinear.run import Complex, Modes, Real, Run, decay_in_time

FINE_BELOW = 8.0
"""Motions are brought to twice the rate where a record has fewer samples than this in a period of the last line."""

EDGE = 8.0
"""Periods of the last line at each end of a record in which the motion may be no larger than elsewhere."""

SLOPE_STEP, SLOPES = 0.01, 2
"""Relative change of the motion for the slope of a law; turns in which it is taken anew."""


@dataclass(frozen=True)
class Weighted:
    """A run with its weights, and the normal equations of its free decays.

    Parameters
    ----------
    run : Run
    root : (q, L) array
        1/σ of each line.
    error : (q, L) complex array
        Error over σ.
    gram : (J, J) array
        Normal matrix of the decays.
    right : (J,) array
        Its right side.
    total : float
        Σ|error/σ|².
    """

    run: Run
    root: Real
    error: Complex
    gram: Real
    right: Real
    total: float

    @classmethod
    def of(cls, run: Run, error: Complex | None = None, gram: Real | None = None) -> Weighted:
        """Weights from the run's variance; another error of the same run where given, with the Gram matrix known."""
        root = 1 / np.sqrt(run.variance)
        weighted = (run.error if error is None else error) * root
        # Decay j at response i is decay_shapes[i, j]·decays[j].
        pulled = run.decay_shapes.T @ (weighted * root)
        right = np.sum(run.decays.real * pulled.real + run.decays.imag * pulled.imag, axis=1)
        if gram is None:
            j = run.decays.shape[0]
            gram = decay_gram(run.decays, run.decay_shapes, root)
            gram[np.diag_indices(j)] *= 1 + 1e-10
            gram[np.diag_indices(j)] += 1 / np.maximum(run.decay_size, 1e-150) ** 2
        return cls(run, root, weighted, gram, right, float(np.sum(np.abs(weighted) ** 2)))

    def with_error(self, error: Complex) -> Weighted:
        """The same run and weights with another (unweighted) error."""
        return Weighted.of(self.run, error, self.gram)

    def ringing(self) -> tuple[Real, float]:
        """Amplitudes of the free decays alone, and Σ|error/σ|² with them."""
        amplitudes = cho_solve(cho_factor(self.gram), self.right)
        return amplitudes, self.total - float(self.right @ amplitudes)


def decay_gram(decays: Complex, shapes: Real, root: Real) -> Real:
    """Normal matrix Σ Re(d_j·d_k*)·Σ_i φ_ij·φ_ik/σ_i² of free decays (J, L) with shapes (q, J) and weights 1/σ (q, L)."""
    j, count = decays.shape
    # Where the noise is even over some lines they share the sum over responses.
    edges = np.concatenate([[0], 1 + np.flatnonzero(np.any(np.diff(root, axis=1) != 0, axis=0)), [count]])
    gram = np.zeros((j, j))
    if edges.size - 1 < count / 4:
        for a, b in pairwise(edges):
            d = np.concatenate([decays[:, a:b].real, decays[:, a:b].imag], axis=1)
            weighted = shapes * root[:, a, None]
            gram += (d @ d.T) * (weighted.T @ weighted)
        return gram
    for shape, r in zip(shapes, root, strict=True):
        d = decays * r
        both = np.concatenate([d.real, d.imag], axis=1)
        gram += (both @ both.T) * np.outer(shape, shape)
    return gram


@dataclass(frozen=True)
class Along:
    """A weighted run seen along one place.

    Parameters
    ----------
    weighted : Weighted
    b : (m,) array
        Place: x = b·displacements.
    h : (q, L) complex array
        Accelerations per unit force along b.
    gain : (L,) array
        |h/σ| over all responses: how strongly a force at the place shows on a line.
    error : (L,) complex array
        Part of the weighted error along h.
    decays : (J, L) complex array
        Parts of the decays along h.
    """

    weighted: Weighted
    b: Real
    h: Complex
    gain: Real
    error: Complex
    decays: Complex

    @classmethod
    def of(cls, weighted: Weighted, b: Real, h: Complex) -> Along:
        """Split the run along b."""
        run = weighted.run
        seen = h * weighted.root
        gain = np.maximum(np.sqrt(np.sum(np.abs(seen) ** 2, axis=0)), 1e-300)
        u = seen / gain
        error = np.sum(u.conj() * weighted.error, axis=0)
        decays = run.decays * ((u.conj() * weighted.root).T @ run.decay_shapes).T
        return cls(weighted, b, h, gain, error, decays)

    @property
    def run(self) -> Run:
        """The run."""
        return self.weighted.run

    def taken(self, spread: Real | float) -> Real:
        """How far the data decide about the force on each line, 0 … 1, if its spectrum is expected to be of size ``spread``."""
        strength = np.minimum((self.gain * np.minimum(spread, 1e150)) ** 2, 1e30)
        return np.asarray(strength / (1 + strength))

    def free_force(self, spread: Real | float = np.inf, mean: Complex | None = None) -> tuple[Complex, Real, float]:
        """Restoring force on each line without a law.

        Parameters
        ----------
        spread : (L,) array or float
            Standard deviation of the force's spectrum about ``mean``; infinite where nothing is known.
        mean : (L,) complex array, optional
            What the force is expected to be (0).

        Returns
        -------
        force : (L,) complex array
        amplitudes : (J,) array
            Of the free decays.
        remaining : float
            Σ|weighted error|² that no force at the place explains.
        """
        weight = self.weighted
        expected = 0.0 if mean is None else mean
        error = self.error + self.gain * expected
        # Along h the error has variance 1 + strength, across it 1.
        taken = self.taken(spread)
        both = np.concatenate([self.decays.real, self.decays.imag], axis=1)
        gram = weight.gram - (both * np.tile(taken, 2)) @ both.T
        gram[np.diag_indices_from(gram)] += 1e-9 * np.diag(weight.gram)
        pull = error * (1 - taken) - self.error
        right = weight.right + both @ np.concatenate([pull.real, pull.imag])
        amplitudes = cho_solve(cho_factor(gram), right)
        rest = error - amplitudes @ self.decays
        force = expected - rest * taken / self.gain
        total = weight.total + float(np.sum(np.abs(error) ** 2 * (1 - taken) - np.abs(self.error) ** 2))
        return force, amplitudes, total - float(amplitudes @ right)

    def normal(self, forces: Complex) -> tuple[Real, Real, float]:
        """Normal equations of a regression of the error on restoring forces (c, L), free decays eliminated.

        Returns
        -------
        gram : (c, c) array
        right : (c,) array
        total : float
            Σ|weighted error|² with decays alone.
        """
        columns = -forces * self.gain
        both = np.concatenate([columns.real, columns.imag], axis=1)
        ring = np.concatenate([self.decays.real, self.decays.imag], axis=1)
        cross = both @ ring.T
        inner = cho_solve(cho_factor(self.weighted.gram), np.column_stack([cross.T, self.weighted.right]))
        gram = both @ both.T - cross @ inner[:, :-1]
        right = both @ np.concatenate([self.error.real, self.error.imag]) - cross @ inner[:, -1]
        return gram, right, self.weighted.total - float(self.weighted.right @ inner[:, -1])

    def on(self, part: Weighted, keep: Any) -> Along:
        """The same on some of the lines; ``part`` is the run on them, with its Gram matrix."""
        error = (self.weighted.error / self.weighted.root)[:, keep]
        return replace(
            self,
            weighted=part.with_error(error),
            h=self.h[:, keep],
            gain=self.gain[keep],
            error=self.error[keep],
            decays=self.decays[:, keep],
        )


@dataclass(frozen=True)
class Crossing:
    """What moves a place in one run: x = base − H_bb·S on all lines, with the free decays in time.

    In the band and below it the model under the measured force: displacement noise of an accelerometer grows with 1/ω², that of the
    model does not. Above the band the measured acceleration takes over.

    Parameters
    ----------
    base : (N//2+1,) complex array
        Displacement under the measured force; above the band as measured.
    compliance : (N//2+1,) complex array
        H_bb; 0 above the band.
    fall_x, fall_v : (N·fine,) arrays
        Free decays.
    omega : (N//2+1,) array
    fine : int
        Steps a sample: a force with kinks has a wider spectrum than the motion, and would fold back.
    edge : int
        Steps at each end where the motion is doubtful.
    """

    base: Complex
    compliance: Complex
    fall_x: Real
    fall_v: Real
    omega: Real
    fine: int
    edge: int = 1

    @classmethod
    def of(cls, along: Along, modes: Modes, amplitudes: Real, extra: Complex | None = None) -> Crossing:
        """From the free decays' amplitudes (J,); ``extra`` is receptance across the place that the modes lack, on all lines."""
        run = along.run
        hz = run.all_hz
        w = 2 * np.pi * hz
        top = int(run.lines[-1]) + 1
        across = modes.phi.T @ along.b
        first_hz = float(run.hz[0])
        kernel = modes.bounded_kernel(hz[:top], modes.spurious(along.b, first_hz), first_hz) * across[:, None]
        base, compliance = np.zeros(hz.size, complex), np.zeros(hz.size, complex)
        for shape, force in zip(run.directions @ modes.phi, run.forces, strict=True):
            base[:top] += (shape @ kernel) * force[:top]
        compliance[:top] = across @ kernel
        if extra is not None:
            compliance[:top] += extra[:top]
        ringing = modes.ringing(run.sampling_hz)
        poles = modes.poles[ringing]
        weights = across[ringing] * (amplitudes[: ringing.size] + 1j * amplitudes[ringing.size :])
        fine = 2 if run.sampling_hz < FINE_BELOW * run.hz[-1] else 1
        decays = np.stack([weights / poles**2, weights / poles, weights])
        fall = decay_in_time(poles, decays, run.n_samples * fine, 1 / (run.sampling_hz * fine))
        measured = np.flatnonzero(along.b[run.rows])
        if measured.size == np.count_nonzero(along.b):
            a = along.b[run.rows[measured]] @ run.responses[measured] - sfft.rfft(fall[2, ::fine])
            base[top:] = -a[top:] / w[top:] ** 2
        edge = max(1, int(EDGE * run.sampling_hz * fine / run.hz[-1]))
        return cls(base, compliance, fall[0], fall[1], w, fine, edge)

    def in_time(self, x: Complex) -> tuple[Real, Real]:
        """Displacement and velocity of a spectrum of displacement, without the decays."""
        n = self.fall_x.size
        spectra = np.zeros((2, n // 2 + 1), complex)
        spectra[0, : x.size] = x * self.fine
        spectra[1, : x.size] = 1j * self.omega * spectra[0, : x.size]
        both = sfft.irfft(spectra, n, axis=-1)
        return both[0], both[1]

    def lines(self, signal: Real) -> Complex:
        """Transform of a signal on the fine grid, on all lines of the record."""
        return np.asarray(sfft.rfft(signal)[: self.omega.size] / self.fine)

    def move(self, force: Complex) -> tuple[Real, Real]:
        """Displacement and velocity across the place under a restoring force given on all lines."""
        return self.moved(self.base - self.compliance * force)

    def moved(self, x: Complex) -> tuple[Real, Real]:
        """Displacement and velocity of a spectrum of displacement and the decays, the ends no larger than the rest."""
        displacement, velocity = self.in_time(x)
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


def settle(
    along: Along,
    crossing: Crossing,
    force: Complex,
    taken: Real,
    law: Callable[[Real, Real], Real],
    start: tuple[Real, Real],
    turns: int = 12,
    remembers: bool = False,
) -> tuple[Real, Real]:
    """Motion where the law stands in for the restoring force on the lines the data say nothing about (the mean among them).

    Parameters
    ----------
    along : Along
    crossing : Crossing
    force : (L,) complex array
        Restoring force as seen in the data.
    taken : (L,) array
        How far the data decide, 0 … 1.
    law : callable
        (x, v) → restoring force in time.
    start : (x, v)
    turns : int
    remembers : bool
        Of a law that walks through the whole record the secant stands for its slope: a second walk costs as much as a turn.

    Returns
    -------
    x, v : (N,) arrays
    """
    share = np.zeros(crossing.base.size)
    share[along.run.lines] = taken
    share[along.run.lines[-1] + 1 :] = 1.0
    seen = np.zeros(crossing.base.size, complex)
    seen[along.run.lines] = force
    now = crossing.lines(start[0] - crossing.fall_x)
    kept, best, change, slope = start, now, np.zeros_like(now), 0.0
    relax, least = 1.0, np.inf
    with np.errstate(over="ignore", invalid="ignore"):
        for turn in range(turns):
            x, v = start if turn == 0 else crossing.moved(now)
            s = law(x, v)
            # Newton's step with the law's slope, weighted with the motion: the plain substitution diverges where the contact is stiffer
            # than the structure.
            if turn < SLOPES:
                grown = s if remembers else (law(x * (1 + SLOPE_STEP), v) - s) / SLOPE_STEP
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
    return kept

"""Periodic excitation: the best linear approximation, with the variance of noise and that of nonlinear distortion apart.

A periodic force repeats its distortions in each period, noise does not. What changes from period to period is noise; what varies from line
to line beyond it, or stands at lines that were not excited, is distortion (Pintelon & Schoukens, System Identification, 2nd ed. 2012).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft as sfft

from operando.errors import DataError
from operando.nonlinear.run import Complex, Real

EXCITED = 0.05
"""A line is excited where the force has this part of its median excited amplitude, at least."""

ALIKE = 0.95
"""Correlation of a force with itself one period later, at least."""

SETTLED = 2.0
"""Periods at the beginning whose distance from the last is more than this many times the usual one still hold a transient."""

HALF_WINDOW, UNKNOWNS = 6, 5
"""Local rational fit: lines on either side, and complex unknowns (order two over two)."""

SEEN = 4.0
"""Distortion counts as seen where its power is this many times the noise's, in the median over lines."""


@dataclass(frozen=True)
class PeriodicResponse:
    """Responses to a periodic force.

    Parameters
    ----------
    period : int
        Samples.
    periods : int
        Steady periods used.
    frequencies_hz : (L,) array
        Excited lines.
    frf : (q, L) complex array
        Best linear approximation, response over force.
    noise, distortion : (q, L) arrays
        Variance of that from noise, and from nonlinear distortion: what a repetition with other phases of the force would scatter by; seen
        in one realisation of the force from how far each line is off a rational function through its neighbours.
    distortion_db : (q,) array
        Size of the distortion over the response, median over lines [dB].
    over_noise_db : (q,) array
        Power of distortion over that of noise, median over lines [dB].
    odd_db, even_db : (q,) arrays or None
        Power over noise at odd and even lines between the excited ones [dB]; None where all lines there are excited.
    above_db : (q,) array or None
        Power over noise at lines above the excited ones, up to twice the highest [dB].
    """

    period: int
    periods: int
    frequencies_hz: Real
    frf: Complex
    noise: Real
    distortion: Real
    distortion_db: Real
    over_noise_db: Real
    odd_db: Real | None
    even_db: Real | None
    above_db: Real | None

    @property
    def nonlinear(self) -> bool:
        """Whether any response shows distortion beyond noise."""
        limit = 10 * np.log10(SEEN)
        found = [self.over_noise_db, self.odd_db, self.even_db, self.above_db]
        return any(f is not None and bool(np.any(f > limit)) for f in found)

    def words(self) -> tuple[str, ...]:
        """What can be said, and what cannot."""
        limit, out = 10 * np.log10(SEEN), []
        if not self.nonlinear:
            return (
                f"no distortion beyond the noise of {self.periods} periods: at this level the response is linear as far as can be seen",
            )
        k = int(np.argmax(self.distortion_db))
        out.append(
            f"nonlinear: distortion repeats in {self.periods} periods, {self.over_noise_db[k]:.0f} dB above the noise and "
            f"{-self.distortion_db[k]:.0f} dB below the response where it is largest"
        )
        if self.odd_db is None or self.even_db is None:
            out.append(
                "all lines of the band are excited, so odd and even distortion fall on the same lines: leave out all even and some odd "
                "lines of the force to tell springs and friction from contacts and preloaded joints"
            )
        else:
            parts = [("odd", self.odd_db), ("even", self.even_db)]
            seen = [f"{name} ({np.max(v):.0f} dB above noise)" for name, v in parts if np.max(v) > limit]
            out.append("distortion is " + " and ".join(seen) if seen else "lines that were not excited show no distortion")
        if self.above_db is not None and np.max(self.above_db) > limit:
            out.append(f"harmonics above the excited band stand {np.max(self.above_db):.0f} dB above the noise")
        out.append("one level cannot tell how it grows with the level, so neither a law nor its size: measure at a second level")
        return tuple(out)


def best_linear_approximation(force: ArrayLike, responses: ArrayLike, sampling_hz: float, period: int | None = None) -> PeriodicResponse:
    """Best linear approximation of responses to a periodic force; noise and nonlinear distortion apart.

    Parameters
    ----------
    force : (N,) array
    responses : (q, N) or (N,) array
    sampling_hz : float
    period : int, optional
        Samples of a period; found from the force where not given.

    Returns
    -------
    PeriodicResponse

    Raises
    ------
    DataError
        If the signals differ in length, the force is not periodic, or fewer than two steady periods are left.
    """
    f, x = np.asarray(force, float), np.atleast_2d(np.asarray(responses, float))
    if f.ndim != 1 or x.shape[1] != f.size:
        raise DataError("force and responses need the same number of samples")
    n = period_of(f) if period is None else int(period)
    whole = f.size // n
    if whole < 3:
        raise DataError(f"{f.size} samples hold {f.size / n:.2g} periods of {n}", hint="three periods at least")
    # The last whole periods: the transient stands at the beginning.
    cut = np.vstack([f[None], x])[:, f.size - whole * n :].reshape(1 + x.shape[0], whole, n)
    spectra = sfft.rfft(cut, axis=2)
    spectra = spectra[:, transient(spectra) :]
    count = spectra.shape[1]
    mean, scatter = spectra.mean(axis=1), spectra.var(axis=1, ddof=1) / count
    hz = sfft.rfftfreq(n, 1 / sampling_hz)
    amplitude = np.abs(mean[0])
    strong = amplitude > 0.3 * amplitude.max()
    excited = amplitude > EXCITED * np.median(amplitude[strong])
    excited[0] = False
    lines = np.flatnonzero(excited)
    if lines.size < 2 * HALF_WINDOW + 1:
        raise DataError(f"{lines.size} excited lines are too few to tell distortion from the shape of the response")
    frf = mean[1:, lines] / mean[0, lines]
    noise = (scatter[1:, lines] + np.abs(frf) ** 2 * scatter[0, lines]) / amplitude[lines] ** 2
    total = roughness(frf, hz[lines])
    distortion = np.maximum(total - noise, 0.0)
    db = lambda power: 10 * np.log10(np.maximum(power, 1e-30))  # noqa: E731
    between = np.zeros_like(excited)
    between[lines[0] : lines[-1] + 1] = ~excited[lines[0] : lines[-1] + 1]
    above = np.zeros_like(excited)
    above[lines[-1] + 1 : 2 * lines[-1] + 1] = True
    odd = np.arange(hz.size) % 2 == 1

    def over_noise(which: np.ndarray) -> Real | None:
        if not which.any():
            return None
        # The mean over periods holds noise once by itself.
        power = np.abs(mean[1:][:, which]) ** 2 / np.maximum(scatter[1:][:, which], 1e-300)
        return np.asarray(db(np.maximum(np.mean(power, axis=1) - 1, 0.0)))

    return PeriodicResponse(
        n,
        count,
        hz[lines],
        frf,
        noise,
        distortion,
        db(np.median(distortion / np.abs(frf) ** 2, axis=1)),
        db(np.median(distortion / np.maximum(noise, 1e-300), axis=1)),
        over_noise(between & odd),
        over_noise(between & ~odd),
        over_noise(above),
    )


def period_of(force: Real) -> int:
    """Samples after which a force repeats itself.

    Raises
    ------
    DataError
        If it does not within half the record.
    """
    f = force - force.mean()
    n = f.size
    size = sfft.next_fast_len(2 * n, real=True)
    product = sfft.irfft(np.abs(sfft.rfft(f, size)) ** 2, size)[: n // 2 + 1]
    energy = np.concatenate([[0.0], np.cumsum(f**2)])
    lag = np.arange(product.size)
    both = np.sqrt((energy[n] - energy[lag]) * energy[n - lag])
    like = product / np.maximum(both, 1e-300)
    # The first lag that is as good as any, beyond the width of the peak at 0.
    start = int(np.argmax(like < 0.5 * ALIKE))
    best = float(np.max(like[start:])) if start else 0.0
    if best < ALIKE:
        raise DataError(f"the force does not repeat itself (likeness {best:.2f})", hint="state the period, or treat it as random")
    first = start + int(np.argmax(like[start:] > best - 0.3 * (1 - ALIKE)))
    around = slice(first, min(first + 3, like.size))
    return first + int(np.argmax(like[around]))


def transient(spectra: Complex) -> int:
    """Periods (of spectra (channels, periods, lines)) at the beginning that are not steady yet; two are left at least."""
    last = spectra[:, -1:]
    apart = np.mean(np.abs(spectra[:, :-1] - last) ** 2, axis=2) / np.maximum(np.mean(np.abs(last) ** 2, axis=2), 1e-300)
    away = np.sqrt(apart.max(axis=0))
    usual = float(np.median(away[away.size // 2 :]))
    steady = np.flatnonzero(away > SETTLED * usual)
    return int(min(steady[-1] + 1 if steady.size else 0, spectra.shape[1] - 2))


def roughness(frf: Complex, hz: Real) -> Real:
    """Variance of each line (q, L) about a rational function of order two over two through its neighbours."""
    q, count = frf.shape
    width = 2 * HALF_WINDOW + 1
    first = np.clip(np.arange(count) - HALF_WINDOW, 0, count - width)
    index = first[:, None] + np.arange(width)
    r = hz[index] - hz[:, None]
    r = r / np.max(np.abs(r), axis=1, keepdims=True)
    out = np.empty((q, count))
    for k in range(q):
        h = frf[k][index]
        scale = np.sqrt(np.mean(np.abs(h) ** 2, axis=1, keepdims=True))
        h = h / np.maximum(scale, 1e-300)
        table = np.stack([np.ones_like(h), r + 0j, r**2 + 0j, -h * r, -h * r**2], axis=2)
        left = table.conj().transpose(0, 2, 1)
        gram = left @ table + 1e-12 * width * np.eye(UNKNOWNS)
        rest = h - (table @ np.linalg.solve(gram, left @ h[..., None]))[..., 0]
        out[k] = np.sum(np.abs(rest) ** 2, axis=1) / (width - UNKNOWNS) * scale[:, 0] ** 2
    return out

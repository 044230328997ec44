"""Periodic excitation: what the noise and the distortion of a periodic test say about nonlinearity.

A periodic force repeats its distortions in each period, noise does not. What changes from period to period is noise; what varies from line
to line beyond it, or stands at lines that were not excited, is distortion (Pintelon & Schoukens, System Identification, 2nd ed. 2012).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.contrib.signals import checked_signals
from operando.data.objects import Short, counted
from operando.errors import DataError
from operando.frf.periodic import period_of, periodic_frf, steady_periods

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

SEEN = 4.0
"""Distortion counts as seen where its power is this many times the noise's, in the median over lines."""


@dataclass(frozen=True, repr=False, eq=False)
class PeriodicResponse(Short):
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

    def facts(self) -> dict[str, str]:
        """What the short form says."""
        hz = self.frequencies_hz
        return {
            "Responses": counted(len(self.frf), "response"),
            "Lines": f"{hz.size} excited lines, {hz[0]:.4g} to {hz[-1]:.4g} Hz",
            "Periods": f"{counted(self.periods, 'steady period')} of {self.period} samples",
            "Linearity": self.words()[0],
        }

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
        out.append("one level cannot tell how it grows with the level, so neither a force law nor its size: measure at a second level")
        return tuple(out)


def best_linear_approximation(force: ArrayLike, responses: ArrayLike, sampling_hz: float, period: int | None = None) -> PeriodicResponse:
    """Best linear approximation of responses to a periodic force; noise and nonlinear distortion apart.

    Parameters
    ----------
    force : (N,) array
        Periodic, some periods long.
    responses : (q, N) or (N,) array
        Sampled with it.
    sampling_hz : float
        Samples a second.
    period : int, optional
        Samples of a period; found from the force where not given.

    Returns
    -------
    PeriodicResponse

    Raises
    ------
    DataError
        If a sample is not finite, the signals differ in length, the force is not periodic or has another period than given, or there are
        fewer than three whole periods.

    Examples
    --------
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> force = np.tile(rng.standard_normal(1024), 8)
    >>> best_linear_approximation(force, 3 * force + 0.01 * rng.standard_normal(force.size), 1024.0).period
    1024
    """
    f, x = checked_signals(sampling_hz, several="responses", force=force, responses=responses)
    if period is not None:
        _check_period(f, period)
    steady = steady_periods(np.vstack([f[None], x]), [0], range(1, 1 + x.shape[0]), sampling_hz, period)
    found = periodic_frf([steady])
    hz, excited = steady.frequencies_hz, steady.excited
    lines = np.flatnonzero(excited)
    frf, noise, distortion = found.data[:, 0], found.noise[:, 0], found.distortion[:, 0]
    mean = steady.responses.mean(axis=1)
    scatter = steady.responses.var(axis=1, ddof=1) / steady.count
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
        power = np.abs(mean[:, which]) ** 2 / np.maximum(scatter[:, which], 1e-300)
        return np.asarray(db(np.maximum(np.mean(power, axis=1) - 1, 0.0)))

    return PeriodicResponse(
        steady.period,
        steady.count,
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


def _check_period(force: Real, period: int) -> None:
    """Refuse a period after which the force does not repeat itself: what is left of it then counts as noise, and hides the distortion."""
    try:
        found = period_of(force)
    except DataError:
        raise DataError(
            f"the force repeats itself neither after {period} samples nor after any other number up to half the record",
            hint="give a force that repeats; the responses to a random one are for estimate_frf",
        ) from None
    times = round(period / found)
    if period != int(period) or times < 1 or 2 * abs(period - times * found) > times:
        raise DataError(
            f"the force does not repeat after {period} samples: its period seems to be {found}",
            hint=f"give period={found}, or leave it out: it is then found from the force",
        )

"""Periodic excitation (multisine, periodic chirp, repeated noise): steady periods, excited lines, FRFs with noise and distortion apart.

A periodic force repeats its nonlinear distortions in each period, noise does not. What changes from period to period is noise; what varies
from line to line beyond it is distortion (Pintelon & Schoukens, System Identification, 2nd ed. 2012). Over whole steady periods there is
no leakage, and a line without force says nothing of the FRF.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as sfft

from operando.data import row_statistics
from operando.data.mapped import PIECE
from operando.errors import DataError
from operando.frf.rational import roughness_variance, smooth

Array = NDArray[Any]

ALIKE = 0.95
"""Correlation of a force with itself one period later, at least."""

QUIET = 0.3
"""What is below this part of the rms at both ends of a force is silence before and after the signal."""

EXCITED = 0.05
"""A line is excited where the force has this part of the amplitude of the strongest line beside it, at least."""

EXCITED_ANYWHERE = 0.002
"""... and this part of the median excited amplitude: the force of a shaker may fall by 40 dB at a sharp resonance, not by more."""

DRIFT = 0.1
"""Samples by which the last period may begin off the sample grid: at a tenth of the rate its lines are then turned by 4 degrees."""

FINER = 4
"""Oversampling before splines, and of the lags at which a force is compared with itself."""

LONG = 2_000_000
"""Samples from which whole lags must do (memory)."""

LONGEST = 2 * LONG
"""Samples of a force in which a period is looked for: half as many are the longest period that is found. Its correlation takes 0.25 GB."""

NEAR = 8
"""Lines of a group that shows a transient; and half the widest gap between lines of one multisine, at least."""

SETTLED = 4.0
"""A period is not steady where what it differs by has this many times the usual power at least (a mean over eight lines or more: noise
alone exceeds it with a probability below 1e-4), and more than the number of periods: it then biases their mean by more than noise does."""

WINDOW = 17
"""Lines of the local rational models whose residual is the distortion. Against the scatter of 40 realisations of a chain with a cubic
spring (tests/test_frf_periodic.py) the median of the variance is right within 1 % and 93 % of errors lie within the 95 % interval; 9 and 13
lines give 91 and 93 %, smoothing over neighbouring windows doubles the scatter of the variance."""

LEAST_LINES = 17
"""Excited lines below which a force is a few tones and not a multisine: one window of the local rational models, so ``WINDOW``."""

FREEDOM = 8
"""Degrees of freedom to which the variance of a line is smoothed: its standard deviation is then within 25 %."""


@dataclass(frozen=True)
class SteadyPeriods:
    """Spectra of the steady periods of a record with periodic forces.

    Parameters
    ----------
    period : int
        Samples.
    whole, discarded : int
        Whole periods in the record, and those not used: bad samples, or a transient at the beginning.
    frequencies_hz : (L,) array
        All lines of a period, 0 Hz first.
    forces, responses : (n_f, P, L), (n_x, P, L) complex arrays
        Spectra of each steady period.
    excited : (L,) bool array
        Lines where a force has power.
    """

    period: int
    whole: int
    discarded: int
    frequencies_hz: Array
    forces: Array
    responses: Array
    excited: NDArray[np.bool_]

    @property
    def count(self) -> int:
        """Steady periods."""
        return int(self.forces.shape[1])


@dataclass(frozen=True)
class PeriodicFrf:
    """FRFs at the excited lines of one or several experiments with periodic forces.

    Parameters
    ----------
    frequencies_hz : (L,) array
    data : (n_x, n_f, L) complex array
        Best linear approximation.
    noise : array like ``data``
        Variance from the scatter between periods.
    distortion : array like ``data``
        Variance from what repeats in each period and is not smooth from line to line; 0 where there are too few lines to see it.
    gain : (n_f, L) array
        Information: 1/gain is the variance at unit noise of one period.
    """

    frequencies_hz: Array
    data: Array
    noise: Array
    distortion: Array
    gain: Array

    @property
    def variance(self) -> Array:
        """Noise and distortion together: the variance against the FRF of the underlying linear structure."""
        return np.asarray(self.noise + self.distortion)


def period_of(force: Array) -> int:
    """Samples after which a force repeats itself; silence before and after it is passed over.

    Of a force longer than ``LONGEST`` the part in the middle is looked at.
    """
    first, last = _loud_span(np.asarray(force))
    if last - first > LONGEST:
        first = (first + last - LONGEST) // 2
        last = first + LONGEST
    f = np.asarray(force[first:last], float) - float(np.mean(force, dtype=float))
    n = f.size
    size = sfft.next_fast_len(2 * n, real=True)
    finer = FINER if n < LONG else 1
    count = (n // 2) * finer + 1
    product = sfft.irfft(np.abs(sfft.rfft(f, size)) ** 2, size * finer)[:count] * finer
    energy = np.concatenate([[0.0], np.cumsum(f**2)])
    lag = np.arange(count) // finer
    both = np.sqrt((energy[n] - energy[lag]) * energy[n - lag])
    like = product / np.maximum(both, 1e-300)
    # The first lag that is as good as any, beyond the width of the peak at 0.
    start = int(np.argmax(like < 0.5 * ALIKE))
    best = float(np.max(like[start:])) if start else 0.0
    if best < ALIKE:
        raise DataError(f"the force does not repeat itself (likeness {best:.2f})", hint="state the period, or treat it as random")
    first = start + int(np.argmax(like[start:] > best - 0.3 * (1 - ALIKE)))
    around = slice(first, min(first + 3 * finer, like.size))
    return round((first + int(np.argmax(like[around]))) / finer)


def _loud_span(force: Array) -> tuple[int, int]:
    """Where the signal begins and ends (one past its last sample), silence left out; the whole where nothing is loud."""
    known = row_statistics(force[np.newaxis])
    mean, least = float(known.mean[0]), QUIET * float(known.std[0])
    loud = [(k, np.flatnonzero(np.abs(force[k : k + PIECE] - mean) > least)) for k in range(0, force.size, PIECE)]
    ends = [(k + int(where[0]), k + int(where[-1]) + 1) for k, where in loud if where.size]
    return (ends[0][0], ends[-1][1]) if ends else (0, int(force.size))


def excited_lines(amplitude: Array) -> NDArray[np.bool_]:
    """Lines of a period at which a periodic force has power, by the force amplitude of each line, 0 Hz first."""
    from scipy import ndimage

    strong = amplitude > 0.3 * amplitude[1:].max(initial=0.0)
    strong[0] = False
    if not strong.any():
        return strong
    level = float(np.median(amplitude[strong]))
    clear = np.flatnonzero(amplitude > EXCITED * level)
    clear = clear[clear > 0]
    gaps = np.diff(clear)
    widest = max(2 * NEAR, 4 * float(np.median(gaps)), 0.05 * clear.size) if gaps.size else 0.0
    # As near as excited lines are to each other: a line left out has one beside it, a line in a dip of the force has its like.
    reach = max(1, int(np.ceil(np.median(gaps)))) if gaps.size else 1
    near = ndimage.maximum_filter1d(amplitude, 2 * reach + 1)
    out = np.zeros(amplitude.size, bool)
    # A hum line far from the rest (a part of its own) must not make the lines between look excited.
    for part in np.split(clear, np.flatnonzero(gaps > widest) + 1):
        if part.size >= 0.05 * clear.size:
            span = slice(int(part[0]), int(part[-1]) + 1)
            out[span] = (amplitude[span] > EXCITED * near[span]) & (amplitude[span] > EXCITED_ANYWHERE * level)
    return out


def steady_periods(
    data: NDArray[np.floating[Any]],
    force_rows: Sequence[int],
    response_rows: Sequence[int],
    sampling_hz: float,
    period: int | None = None,
    bad: Sequence[tuple[int, int]] = (),
) -> SteadyPeriods:
    """Spectra of the periods of a record after the transient of the start has gone.

    Parameters
    ----------
    data : (n_channels, n_samples) array
        Samples (rows, n_samples).
    force_rows, response_rows : sequences of int
        Rows of the forces.
    sampling_hz : float
        Sampling rate [Hz].
    period : int, optional
        Samples; found from the forces where not given.
    bad : sequence of (first, last)
        Sample spans that no period may touch.

    Returns
    -------
    SteadyPeriods

    Raises
    ------
    DataError
        If a force is not periodic, or fewer than three whole periods are there.

    Examples
    --------
    >>> import numpy as np
    >>> force = np.tile(np.random.default_rng(0).normal(size=256), 5)
    >>> steady_periods(np.array([force, 2 * force]), [0], [1], 256.0).period
    256
    """
    n = int(period) if period is not None else max(period_of(np.asarray(data[row], float)) for row in force_rows)
    last = _end_of_force(np.asarray(data[list(force_rows)], float))
    exact = n + (clock_drift(np.asarray(data[force_rows[0], :last], float), n) if period is None else 0.0)
    whole = int(last // exact)
    if whole < 3:
        raise DataError(f"{last} samples hold {last / exact:.2g} periods of {exact:g}", hint="three periods at least")
    # The last whole periods: the transient stands at the beginning.
    first = int(last - np.ceil(whole * exact))
    edges = first + np.arange(whole + 1) * exact
    touched = [any(a <= edges[k + 1] and b >= edges[k] for a, b in bad) for k in range(whole)]
    good = np.flatnonzero(~np.array(touched))
    if good.size < 3:
        raise DataError(f"{good.size} of {whole} periods are free of bad samples", hint="three periods at least")

    def spectra(rows: Sequence[int]) -> Array:
        out = np.empty((len(rows), whole, n // 2 + 1), complex)
        for i, row in enumerate(rows):
            x = np.asarray(data[row, :last], float)
            x = x[first : first + whole * n] if exact == n else _resampled(x, first + np.arange(whole * n) * (exact / n))
            out[i] = sfft.rfft(x.reshape(whole, n), axis=1)
        return out if good.size == whole else out[:, good]

    forces, responses = spectra(force_rows), spectra(response_rows)
    late = forces[:, good.size // 2 :].mean(axis=1)
    excited = excited_lines(np.sqrt(np.sum(np.abs(late) ** 2, axis=0)))
    lines = np.flatnonzero(excited)
    discarded = transient(forces[:, :, lines], responses[:, :, lines]) if lines.size else 0
    return SteadyPeriods(
        n,
        whole,
        discarded + whole - good.size,
        sfft.rfftfreq(n, exact / n / sampling_hz),
        forces[:, discarded:],
        responses[:, discarded:],
        excited,
    )


def clock_drift(force: Array, period: int) -> float:
    """What a period is longer than a whole number of samples [samples], 0 where that does not matter.

    A generator and a recorder with clocks of their own: each period begins a little later in its samples, and its lines turn by 2π·k·δ/n.
    """
    whole = force.size // period
    spectra = sfft.rfft(force[: whole * period].reshape(whole, period), axis=1)
    product = np.sum(spectra[1:] * spectra[:-1].conj(), axis=0)
    k = np.arange(product.size)
    weight = np.abs(product) * (np.abs(product) > EXCITED * np.abs(product[1:]).max(initial=0.0))
    weight[0] = 0.0
    if not weight.any():
        return 0.0
    drift = -float(np.sum(weight * k * np.angle(product)) / np.sum(weight * k.astype(float) ** 2)) * period / (2 * np.pi)
    return drift if abs(drift) * whole > DRIFT else 0.0


def _resampled(x: Array, at: Array) -> Array:
    """Values of a band-limited signal between its samples: cubic splines through four times as many (within 1e-4 below 0.4 of the rate)."""
    # here, not at the top: they take half a second to import, and few measurements need them
    from scipy.interpolate import CubicSpline
    from scipy.signal import resample_poly

    fine = resample_poly(x, FINER, 1)
    return np.asarray(CubicSpline(np.arange(fine.size), fine)(np.minimum(at * FINER, fine.size - 1)))


def _end_of_force(forces: Array) -> int:
    """One past the last sample at which a force is on; all samples where it is on to the end (but for a zero crossing)."""
    power = np.max(np.abs(forces - forces.mean(axis=1, keepdims=True)) / np.maximum(forces.std(axis=1, keepdims=True), 1e-300), axis=0)
    loud = np.flatnonzero(power > QUIET)
    end = int(loud[-1]) + 1 if loud.size else forces.shape[1]
    # Silence is longer than what a low tone of the signal itself stays small for.
    gaps = np.diff(loud)
    return forces.shape[1] if loud.size < 2 or forces.shape[1] - end <= 2 * int(gaps.max()) else end


def transient(forces: Array, responses: Array) -> int:
    """Periods at the beginning that are not steady yet; two are left at least.

    What a period differs by from the mean of the later half is compared with what is usual there, in groups of eight lines: a transient
    stands near the resonances alone. With one force it is X − H·F with H from the later half: a force that drifts takes its response along.
    Spectra (n_f, P, L) and (n_x, P, L) at the excited lines.
    """
    periods, n_lines = forces.shape[1:]
    if not responses.shape[0]:
        return 0
    late = slice(max(1, periods // 2), None)
    edges = np.linspace(0, n_lines, max(1, n_lines // NEAR) + 1).astype(int)[:-1]
    middle = responses[:, late].mean(axis=1, keepdims=True)
    change = forces / forces[:, late].mean(axis=1, keepdims=True) if forces.shape[0] == 1 else 1.0
    power = np.add.reduceat(np.abs(responses - middle * change) ** 2, edges, axis=2)
    usual = np.mean(power[:, late], axis=1, keepdims=True) * _leave_one_out(periods - late.start)
    floor = 1e-20 * np.add.reduceat(np.abs(middle) ** 2, edges, axis=2)
    away = np.mean(power / np.maximum(usual, floor), axis=0).max(axis=1)
    rough = np.flatnonzero(away[: late.start] > max(SETTLED, periods))
    return int(min(rough[-1] + 1 if rough.size else 0, periods - 2))


def _leave_one_out(count: int) -> float:
    """Mean square distance of a further period from the mean of ``count`` over that of one of them: (1 + 1/n)/(1 − 1/n)."""
    return (count + 1) / (count - 1) if count > 1 else 2.0


def periodic_frf(experiments: Sequence[SteadyPeriods]) -> PeriodicFrf:
    """FRFs from one experiment with one force, or from at least as many experiments as forces.

    H = X Fᴴ (F Fᴴ)⁻¹ over the mean spectra of the experiments. Noise is what the spectra of single periods differ by from H·F of the same
    period, beyond the mean; distortion what H differs by from local rational models, beyond noise.

    Parameters
    ----------
    experiments : sequence of SteadyPeriods
        Steady periods of each experiment.

    Returns
    -------
    PeriodicFrf

    Raises
    ------
    DataError
        If there are fewer experiments than forces, periods differ, the forces of the experiments cannot be told apart, or too few lines
        are excited.

    Examples
    --------
    >>> import numpy as np
    >>> force = np.tile(np.random.default_rng(0).normal(size=256), 5)
    >>> found = periodic_frf([steady_periods(np.array([force, 2 * force]), [0], [1], 256.0)])
    >>> bool(np.allclose(found.data, 2))
    True
    """
    base = experiments[0]
    n_f = base.forces.shape[0]
    if any(e.period != base.period or e.forces.shape[0] != n_f for e in experiments):
        raise DataError("the experiments have different periods or forces", hint="use the same multisine grid for all runs")
    if len(experiments) < n_f:
        raise DataError(
            f"{n_f} forces repeat together in {len(experiments)} run(s): their columns cannot be distinguished",
            hint="repeat the run with other phases, once for each force, or drive the shakers with independent noise",
        )
    lines = np.flatnonzero(np.all([e.excited for e in experiments], axis=0))
    if lines.size < LEAST_LINES:
        raise DataError(f"{lines.size} excited lines are too few for frequency response functions")
    force = np.stack([e.forces[:, :, lines].mean(axis=1) for e in experiments], axis=1)  # (n_f, E, L)
    response = np.stack([e.responses[:, :, lines].mean(axis=1) for e in experiments], axis=1)
    gram = np.einsum("iel,jel->lij", force, force.conj())
    size = np.sqrt(np.real(np.einsum("lii->li", gram)))
    scaled = gram / np.maximum(size[:, :, None] * size[:, None, :], 1e-300)
    if np.median(np.linalg.cond(scaled)) > 1e6:
        raise DataError("the forces of the runs are the same but for a factor", hint="change their phases between the runs")
    inverse = np.linalg.inv(scaled) / (size[:, :, None] * size[:, None, :])
    h = np.einsum("xel,jel,ljk->xkl", response, force.conj(), inverse)
    hz = base.frequencies_hz[lines]
    power = np.zeros((response.shape[0], lines.size))
    freedom = 0
    for e in experiments:
        rest = e.responses[:, :, lines] - np.einsum("xjl,jpl->xpl", h, e.forces[:, :, lines])
        power += np.sum(np.abs(rest - rest.mean(axis=1, keepdims=True)) ** 2, axis=1)
        freedom += e.count - 1
    count = sum(e.count for e in experiments) / len(experiments)
    power = smooth(power / max(freedom, 1), 2 * (int(np.ceil(FREEDOM / max(freedom, 1))) // 2) + 1)
    diagonal = np.maximum(np.real(np.einsum("ljj->jl", inverse)), 1e-300)
    noise = power[:, None, :] * diagonal[None] / count
    total = roughness_variance(h, WINDOW, hz, smoothed=False)
    distortion = np.maximum(np.where(np.isfinite(total), total, 0.0) - smooth(noise, WINDOW), 0.0)
    return PeriodicFrf(hz, h, noise, distortion, count / diagonal)

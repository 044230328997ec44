"""Which poles of the linear stage are modes: evidence, uncertainty, neighbours that are one mode, and modes still missing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from operando.ema.discrepancy import line_correlation
from operando.ema.linear import MAX_DAMPING, LinearFit, fit_linear, keep_modes
from operando.ema.pairs import Pairs, Real, informative_lines
from operando.ema.projection import CURVED_SHARE, Poles, basis, shift_curvature
from operando.ema.residue_matrix import residue_mac, two_shapes
from operando.errors import IdentificationError
from operando.frf.leakage import lowest_towards_higher
from operando.stabilization import RejectedPole
from operando.synthesis import modal_kernel, power_of, real_inner

MAX_ROUNDS, SEARCH_ROUNDS = 24, 9
"""Rounds in all, and those that look for a missing mode: of 26 starting poles of a plate, thirteen rounds left some out and joined others
before one was looked for (tests/test_measured.py)."""

SETTLE_ROUNDS = 10
"""Rounds of the last fit, and of one with a mode more, at most: twice the five after which one with drifts of 0.35 ζ has settled
(tests/test_ema_linear.py). What a broad mode is shows late: judged after two rounds, modes of 3.5 to 8 % beside narrow ones were lost."""

MOST_HIDDEN = 2
"""Modes without a peak that are added at once. Of 144 chains with a mode of 6 % damping near six narrow ones 32 lost it, or another, before
any were; now 6 (three of them within a bandwidth of two narrow modes)."""

MAX_LOG_DAMPING_STD = 0.5
"""A damping ratio unknown to half of itself determines no mode."""

MAX_PHASE_DEG = 45.0
"""Residues further from the real axis than from the imaginary one belong to a curved background."""

SAME_WIDTHS, NEAR_WIDTHS, TWIN_WIDTHS, TWIN_MAC, CLOSE_TWIN_MAC = 0.5, 1.2, 3.0, 0.85, 0.5
"""Neighbours within so many half bandwidths (the first: of the narrower, the others: of the broader) are asked whether one mode does; with
alike residues (MAC) also further apart."""

TWIN_SHARE = 0.02
"""One mode instead of two alike ones where that costs less of the mode's evidence: a mode that moves between rows, or bends."""

NOISE_LEFT = 3.0
"""Two poles are two modes, however alike, where they leave less than so many times the noise, and one so many times what they leave.

A mode that bends is no sum of two poles: where the bend stands well above the noise, two leave more than noise as well; nearer the noise
this cannot tell. A local damper brings two modes to nearly one pole and one shape: of 4.2 and 8.6 % damping at 21.55 and 21.69 Hz, two left
1.2 times the noise, one 37 times."""

BEYOND = 1.1
"""Where a pole above the lines is looked for, in units of the highest line, and below them in units of the inverse of the lowest: from
1.05, 1.1 and 1.67 the same poles were found, 0.8 to 0.98 of the lowest line. They need no bound further out: from there they stay near, or
pay nothing (benchmarks/README.md, "A mode just beyond the lines")."""

DIP = 0.8
"""A dip of 1 dB (power 0.8) between two peaks shows two modes."""

LOCAL_WIDTHS, N_TAILS = 12.0, 10
"""Lines within so many half bandwidths decide between one mode and two; at least four times as many as there are tails."""


@dataclass
class ChoiceLog:
    """What was not taken and why, and one line a round."""

    rejected: list[RejectedPole] = field(default_factory=list)
    rounds: list[str] = field(default_factory=list)


def choose_modes(
    pairs: Pairs,
    start: Poles,
    band: tuple[float, float],
    *,
    progress: Callable[[str], None] | None = None,
) -> tuple[LinearFit, ChoiceLog]:
    """Fit the starting poles, by rising frequency, and settle which are modes; missing ones are looked for inside the band."""
    log = ChoiceLog()
    f = pairs.frequencies_hz
    ends = float(f[0]), float(f[-1])
    peaks = visible_peaks(pairs)
    thinned = pairs.lines(informative_lines(f, start.hz, start.zeta))
    log.rounds.append(f"{start.hz.size} starting poles, {thinned.frequencies_hz.size} of {f.size} lines")
    fit = fit_linear(thinned, start, ends, rounds=5)
    for below in (True, False):
        fit = _with_mode_beyond(fit, below, log)
    tried: list[tuple[float, float]] = []
    merged: list[tuple[float, float]] = []
    searched = 0
    for number in range(MAX_ROUNDS):
        if progress is not None:
            progress(f"EMA linear stage, round {number + 1}: {fit.n_modes} poles, model error {100 * np.median(fit.variance.alpha):.2g} %")
        out = poor_poles(fit)
        # a pole that looks poor beside the error of a missing one may be a mode
        grown = _all_that_is_missing(fit, band, tried) if number == 0 and out else None
        if grown is None and out:
            if len(out) == fit.n_modes:
                out = out[:-1]
            if not out:
                break
            for k, code, reason in out:
                log.rejected.append(RejectedPole(float(fit.poles.hz[k]), float(fit.poles.zeta[k]), code, reason))
                tried.append((float(fit.poles.hz[k]), 0.5 * float(fit.poles.zeta[k])))
            log.rounds.append("out: " + ", ".join(f"{fit.poles.hz[k]:.5g} Hz ({code})" for k, code, _ in out))
            fit = _refitted(fit, np.setdiff1d(np.arange(fit.n_modes), [k for k, _, _ in out]))
            continue
        joined = _one_for_two(fit, merged, log) if grown is None else None
        if joined is not None:
            tried.append((log.rejected[-1].frequency_hz, 1.5 * log.rejected[-1].damping_ratio))
            fit = joined
            continue
        if searched == SEARCH_ROUNDS:
            break
        searched += 1
        if grown is None:
            new = _missing_mode(fit, band, peaks, tried)
            grown = (_with_mode(fit, *new), [new]) if new is not None else _all_that_is_missing(fit, band, tried)
        if grown is None:
            break
        fit, added = grown
        log.rounds.append("in: " + ", ".join(f"{hz:.5g} Hz" for hz, _ in added))
        tried += [(hz, 0.5 * zeta) for hz, zeta in added]
    if fit.n_modes == 0:
        raise IdentificationError("no mode is left that the FRFs speak for", hint="widen the band, or check the FRFs")
    fit = _settled(fit)
    # what was two modes by half-settled spreads may be one by settled ones
    while (joined := _one_for_two(fit, merged, log)) is not None:
        fit = _settled(joined)
    return _without_offset(fit, log), log


def _settled(fit: LinearFit) -> LinearFit:
    return fit_linear(fit.pairs, fit.poles, fit.ends_hz, start=fit.projection, before=fit.variance, rounds=SETTLE_ROUNDS)


def _without_offset(fit: LinearFit, log: ChoiceLog) -> LinearFit:
    """The fit without the term 1/s of an offset of the sensors, where that loses less than its unknowns cost, one in each pair.

    The lag of a mode below the lines looks like one: where such a pole does better, it stands.
    """
    pairs = replace(fit.pairs, offset=False)
    without = fit_linear(pairs, fit.poles, fit.ends_hz, start=fit.projection, hold=fit.variance)
    loss, cost = _loss(fit, without), 0.5 * len(fit.projection.cost) * float(np.log(fit.information_lines))
    log.rounds.append(f"an offset of the sensors lowers the cost by {loss:.3g}, its unknowns cost {cost:.3g}")
    if loss < cost:
        return _settled(without)
    inside = np.flatnonzero(fit.poles.hz >= fit.ends_hz[0])
    if not inside.size:
        return fit
    alone = _refitted(without, inside)  # a pole below went where the offset left it
    below = _with_mode_beyond(alone, True, log)
    held = fit_linear(below.pairs, below.poles, fit.ends_hz, start=below.projection, hold=fit.variance)
    # its residues are as many unknowns as the offsets, and the pole two more
    most = cost if inside.size < fit.n_modes else -float(np.log(fit.information_lines))
    return _settled(below) if below is not alone and _loss(fit, held) < most else fit


def _loss(fit: LinearFit, held: LinearFit) -> float:
    """Rise of the cost to a fit under the same variance, in independent lines."""
    return float(held.projection.cost.sum() - fit.projection.cost.sum()) / fit.correlation


def _refitted(fit: LinearFit, keep: NDArray[np.int_]) -> LinearFit:
    poles, start = keep_modes(fit, keep)
    return fit_linear(fit.pairs, poles, fit.ends_hz, start=start, before=fit.variance, rounds=2)


def _with_mode(fit: LinearFit, hz: float, zeta: float) -> LinearFit:
    poles, at = fit.poles, int(np.searchsorted(fit.poles.hz, hz))
    grown = Poles(
        np.insert(poles.hz, at, hz),
        np.insert(poles.zeta, at, zeta),
        np.insert(poles.quadrature, at, float(np.median(poles.quadrature))),
        np.insert(poles.drift, at, float(np.median(poles.drift))),
    )
    a, b, shift = (np.insert(values, at, 0.0, axis=1) for values in fit.projection.coefficients)
    return fit_linear(fit.pairs, grown, fit.ends_hz, start=(a, b, shift), before=fit.variance, rounds=SETTLE_ROUNDS)


def _with_mode_beyond(fit: LinearFit, below: bool, log: ChoiceLog) -> LinearFit:
    """The fit with a pole below the lines, or above, where none is there and it lowers the cost by more than its unknowns do.

    A mode just beyond adds most to the last lines, with a lag of its own damping. The tails have that of one damping ratio to give, below
    that of an offset: what is left is taken for shifts of the last modes. Where a model error rules, that of the whole band and so there
    before, a flank tells no mode from it.
    """
    end, side = (fit.ends_hz[0], -1) if below else (fit.ends_hz[1], 1)
    k, poles = (0 if below else -1), fit.poles
    if not fit.noise_limited or np.any(side * (poles.hz - end) > 0):
        return fit
    grown = _settled(_with_mode(fit, end * BEYOND**side, float(np.median(poles.zeta))))
    gain = float(grown.evidence[:, k].sum()) - grown.penalty()
    if side * (grown.poles.hz[k] - end) <= 0 or grown.poles.zeta[k] >= MAX_DAMPING or gain <= 0:
        return fit
    log.rounds.append(f"{'below' if below else 'above'} the lines: {grown.poles.hz[k]:.5g} Hz ({gain:.3g} nats)")
    return grown


def _all_that_is_missing(
    fit: LinearFit, band: tuple[float, float], tried: Sequence[tuple[float, float]]
) -> tuple[LinearFit, list[tuple[float, float]]] | None:
    """The fit with one or two more modes that show no peak, where they leave noise alone and the fit without them does not; else None.

    A broad mode among narrow ones may have no peak, and the fit without it a model error that its own absence makes. Poles were left out
    of such a fit by that error, so places that were tried are tried again.
    """
    if not fit.pairs.noise_known:
        return None
    before = _over_noise(fit)
    for known in (tried, ()):
        grown, left = fit, before
        added: list[tuple[float, float]] = []
        while left > NOISE_LEFT and len(added) < MOST_HIDDEN:
            new = _missing_mode(grown, band, None, [*known, *added])
            if new is None:
                break
            grown = _with_mode(grown, *new)
            added.append(new)
            left, last = _over_noise(grown), left
            if left > 0.5 * last:  # the modes that are missing make most of what is left: no need to go on
                break
        if added and left < NOISE_LEFT < before / left:
            return grown, added
        if not tried:
            break
    return None


def _over_noise(fit: LinearFit) -> float:
    """Power of what a fit leaves over that of the noise, mean of all lines."""
    return float(np.mean(power_of(fit.projection.error) / fit.pairs.noise))


def poor_poles(fit: LinearFit) -> list[tuple[int, str, str]]:
    """Poles to leave out in this round, worst first: number, code, reason. At most a third of them, and no two neighbours."""
    n, n_pairs = fit.projection.a.shape[1], fit.projection.a.shape[0]
    hz, zeta = fit.poles.hz, fit.poles.zeta
    std, log_std = fit.frequency_std_hz, fit.log_damping_std
    evidence = fit.evidence
    weights = 1 / np.maximum(fit.projection.a_std, 1e-300) ** 2
    phase = np.degrees(0.5 * np.angle(np.sum(weights * fit.residues() ** 2, axis=0)))
    step = float(np.median(np.diff(fit.pairs.frequencies_hz)))
    few = max(1, n_pairs // 8)
    found = []
    for k in range(n):
        strong = np.sort(evidence[:, k])[::-1][:few]
        # all pairs together, or a few of them alone (a local mode), chosen among all
        everywhere = evidence[:, k].sum() - fit.penalty()
        local = strong.sum() - fit.penalty(pairs=few) - few * np.log(n_pairs / few + 1)
        score = float(max(everywhere, local))
        distance = float(np.min(np.abs(np.delete(hz, k) - hz[k]))) if n > 1 else np.inf
        width = zeta[k] * hz[k]
        code = reason = ""
        beside = not fit.ends_hz[0] <= hz[k] <= fit.ends_hz[1]  # a residual term, whatever its damping is
        if score < 0:
            short = f" (by {-score:.0f} nats)" if score <= -0.5 else ""  # nearer, a number would read as none
            code, reason = "no_evidence", f"it improves the fit by less than its unknowns cost{short}"
        elif log_std[k] > MAX_LOG_DAMPING_STD and not beside:
            code, reason = "uncertain", f"its damping {100 * zeta[k]:.3g} % is uncertain by {100 * log_std[k]:.0f} % of itself"
        elif std[k] > 0.5 * width and not beside:
            code, reason = "uncertain", f"its frequency is uncertain by {std[k]:.3g} Hz, its half bandwidth is {width:.3g} Hz"
        elif std[k] > 0.5 * distance:
            code, reason = "uncertain", f"its frequency is uncertain by {std[k]:.3g} Hz, the next pole is {distance:.3g} Hz away"
        elif zeta[k] > MAX_DAMPING:
            code, reason = "too_damped", f"damping {100 * zeta[k]:.3g} % is a curved background, not a mode"
        elif abs(phase[k]) > MAX_PHASE_DEG and not fit.noise_limited:
            code, reason = "complex_shape", f"its residues are {abs(phase[k]):.0f}° off those of a mode"
        elif width < 0.05 * step:
            code, reason = "too_narrow", f"its half bandwidth {width:.2g} Hz is far below the line spacing of {step:.2g} Hz"
        if code:
            found.append((score, k, code, reason))
    out: list[tuple[int, str, str]] = []
    for _, k, code, reason in sorted(found):
        if all(abs(k - j) > 1 for j, _, _ in out) and len(out) < max(1, n // 3):
            out.append((k, code, reason))
    return out


def two_peaks(fit: LinearFit, k: int) -> bool:
    """Whether the power of modes k and k+1, summed over the pairs, has a maximum at each and a dip between."""
    hz, zeta = fit.poles.hz[k : k + 2], fit.poles.zeta[k : k + 2]
    width = zeta * hz
    f = np.linspace(hz[0] - width[0], hz[1] + width[1], 200)
    g, h = basis(f, Poles(hz, zeta), fit.pairs.window_rate)[:2]
    scale = 1 / np.sqrt(np.mean(np.abs(fit.projection.error) ** 2, axis=1) + 1e-300)
    a, b = fit.projection.a[:, k : k + 2] * scale[:, None], fit.projection.b[:, k : k + 2] * scale[:, None]
    power = np.sum(np.abs((a @ g + b @ h) / f**2) ** 2, axis=0)
    top = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:])) + 1
    return top.size >= 2 and float(power[top[0] : top[-1] + 1].min()) < DIP * min(power[top[0]], power[top[-1]])


def _apart(fit: LinearFit) -> Real:
    """Distance of neighbours [Hz]: of their poles, or of the means of what each is in the pairs where these are closer."""
    return np.minimum(np.diff(fit.poles.hz), np.abs(np.diff(fit.mean_hz)))


def is_twin(fit: LinearFit, k: int) -> bool:
    """Whether modes k and k+1 have alike residues close together, with no dip between them, or nearly one frequency.

    Two poles well within the bandwidth of each may as well be one mode that stands elsewhere in other pairs, whatever their residues; so
    may two that their drift between the pairs brings together, where residues are alike as far as a trade of places leaves them so. Not
    where several references show a shape of its own for each: no movement of one mode makes that.
    """
    width = fit.poles.zeta[k : k + 2] * fit.poles.hz[k : k + 2]
    apart = float(_apart(fit)[k])
    if apart < SAME_WIDTHS * min(width):  # no drift takes a narrow mode over the width of a broad one
        return not two_shapes(fit, k, k + 1)
    gap = apart / float(max(width))
    mac = residue_mac(fit, k, k + 1)
    bridged = fit.poles.hz[k + 1] / fit.poles.hz[k] - 1 < fit.poles.drift[k : k + 2].sum()
    alike = (mac > TWIN_MAC and gap < TWIN_WIDTHS) or (mac > CLOSE_TWIN_MAC and (gap < NEAR_WIDTHS or bridged))
    return alike and not two_peaks(fit, k) and not two_shapes(fit, k, k + 1)


def _one_for_two(fit: LinearFit, asked: list[tuple[float, float]], log: ChoiceLog) -> LinearFit | None:
    """One mode in place of two close ones where that loses less than the second one costs, or little of alike ones' evidence."""
    n = fit.n_modes
    if n < 2:
        return None
    hz, zeta = fit.poles.hz, fit.poles.zeta
    gap = _apart(fit) / np.maximum(zeta[1:] * hz[1:], zeta[:-1] * hz[:-1])
    for k in np.argsort(gap):
        if gap[k] > TWIN_WIDTHS:
            break
        twin = is_twin(fit, int(k))
        key = (round(float(hz[k]), 3), round(float(hz[k + 1]), 3))
        if (gap[k] > NEAR_WIDTHS and not twin) or key in asked:
            continue
        asked.append(key)
        one, loss, evidence, noise_alone = _merged(fit, int(k))
        if loss < fit.penalty() or (twin and not noise_alone and loss < TWIN_SHARE * evidence):
            extra = "" if loss < fit.penalty() else ", of one shape: a mode that moves between rows or bends with level"
            reason = f"one mode with {hz[k]:.5g} Hz explains both{extra}"
            log.rejected.append(RejectedPole(float(hz[k + 1]), float(zeta[k + 1]), "twin", reason))
            log.rounds.append(f"one for two: {hz[k]:.5g} and {hz[k + 1]:.5g} Hz (loss {loss:.3g}, evidence {evidence:.3g})")
            poles, start = keep_modes(fit, np.setdiff1d(np.arange(n), [k + 1]))
            poles = replace(poles, hz=poles.hz.copy(), zeta=poles.zeta.copy(), drift=poles.drift.copy())
            poles.hz[k], poles.zeta[k], poles.drift[k] = one.poles.hz[0], one.poles.zeta[0], one.poles.drift[0]
            for values, own in zip(start, one.projection.coefficients, strict=True):
                values[:, k] = own[:, 0]
            return fit_linear(fit.pairs, poles, fit.ends_hz, start=start, before=fit.variance, rounds=2)
    return None


def _merged(fit: LinearFit, k: int) -> tuple[LinearFit, float, float, bool]:
    """One mode for k and k+1, from their mean, the stronger alone, or the peak of both; what that loses, and the mode's evidence.

    Asked on the lines around the two, with what the other modes add taken off: the tails follow what these would still adapt. The last
    says whether two leave nothing but noise where one leaves more.
    """
    pair, n = np.array([k, k + 1]), fit.n_modes
    hz, zeta = fit.poles.hz[pair], fit.poles.zeta[pair]
    f = fit.pairs.frequencies_hz
    reach = LOCAL_WIDTHS * float(np.max(zeta * hz)) + hz[1] - hz[0]
    near = np.abs(f - hz.mean()) < reach
    if near.sum() < 4 * N_TAILS:
        near = np.isin(np.arange(f.size), np.argsort(np.abs(f - hz.mean()))[: 4 * N_TAILS])
    poles, start = keep_modes(fit, pair)
    g, h, gf, hf = (column[:, near] for column in basis(f, poles, fit.pairs.window_rate)[:4])
    both = np.concatenate([pair, n + pair])
    own = start[0] @ g + start[1] @ h + fit.projection.shifted[:, both] @ np.concatenate([gf, hf])
    own += shift_curvature(f[near], poles, start, fit.pairs.window_rate, CURVED_SHARE * fit.model_error)
    part = fit.pairs.lines(near)
    part = replace(part, accelerance=fit.projection.error[:, near] + own)
    ends = float(part.frequencies_hz[0]), float(part.frequencies_hz[-1])
    hold = replace(fit.variance, total=fit.variance.total[:, near])
    two = fit_linear(part, poles, ends, start=start, rounds=1, hold=hold)
    share = fit.projection.evidence[:, pair].sum(axis=0)
    share = share / share.sum()
    # a mode that moves by what the two are apart
    drift = max(float(poles.drift.max()), float(0.5 * (hz[1] - hz[0]) / hz.mean()))
    by_pair = start[0] ** 2 + start[1] ** 2
    centre = by_pair @ hz / np.maximum(by_pair.sum(axis=1), 1e-300) / (share @ hz) - 1
    strong = int(np.argmax(share))
    # where their sum stands, as if nothing were known of either: residues that stood against each other start no one mode
    top = f[near][np.argmax(np.sum(np.abs(own) ** 2 / fit.variance.plain[:, near], axis=0))]
    alone = Poles(np.array([top]), np.array([share @ zeta]), poles.quadrature.max(keepdims=True), np.array([drift]))
    ones = [fit_linear(part, alone, ends, rounds=6, steps=2, hold=hold)]
    for weight, shift in ((share, centre), (np.eye(2)[strong], start[2][:, strong])):
        pole = Poles(np.array([weight @ hz]), np.array([weight @ zeta]), poles.quadrature.max(keepdims=True), np.array([drift]))
        a, b = (values @ (weight > 0)[:, None] for values in start[:2])
        ones.append(fit_linear(part, pole, ends, start=(a, b, shift[:, None]), rounds=6, steps=2, hold=hold))
    best = min(ones, key=lambda one: float(one.projection.cost.sum()))
    loss = float(best.projection.cost.sum() - two.projection.cost.sum()) / fit.correlation
    loss += fit.projection.a.shape[0] * np.log(drift / float(poles.drift.max()))  # of the wider prior
    evidence = float(best.projection.evidence.sum()) / fit.correlation
    left = [float(np.mean(power_of(error) / part.noise)) for error in (fit.projection.error[:, near], best.projection.error)]
    return best, loss, evidence, part.noise_known and left[0] < NOISE_LEFT and left[1] > NOISE_LEFT * left[0]


def visible_peaks(pairs: Pairs) -> Real:
    """Frequencies [Hz] of the peaks of the summed power of all pairs, each at its own size."""
    from scipy.ndimage import uniform_filter1d

    h = pairs.accelerance
    power = uniform_filter1d(np.sum(np.abs(h) ** 2 / np.mean(np.abs(h) ** 2, axis=1, keepdims=True), axis=0), 3)
    tops = np.flatnonzero((power[1:-1] >= power[:-2]) & (power[1:-1] > power[2:])) + 1
    stands = [k for k in tops if max(lowest_towards_higher(power, int(k), side) for side in (-1, 1)) < DIP * power[k]]
    return np.asarray(pairs.frequencies_hz[stands])


def _missing_mode(
    fit: LinearFit, band: tuple[float, float], peaks: Real | None, tried: Sequence[tuple[float, float]]
) -> tuple[float, float] | None:
    """Frequency and damping of one more mode whose gain is twice its unknowns, or None.

    The gain is taken under the model error of all pairs: that of a pair has grown around the mode it misses. Where the model error rules,
    only visible peaks that no pole explains are asked (if given), since the residuals of a moving or bending mode look like another one.
    """
    f = fit.pairs.frequencies_hz
    hz, width = fit.poles.hz, fit.poles.zeta * fit.poles.hz
    allowed = (f > band[0]) & (f < band[1])
    for h, z in tried:
        allowed &= np.abs(f - h) > max(z * h, 0.002 * h)
    allowed &= np.min(np.abs(f[None] - hz[:, None]) / width[:, None], axis=0) > 0.5
    if not fit.noise_limited and peaks is not None:
        step = float(np.median(np.diff(f)))
        near = np.zeros(f.size, bool)
        for p in peaks:
            if np.min(np.abs(hz - p) / width) > 0.5:
                near |= np.abs(f - p) < max(0.01 * p, 3 * step)
        allowed &= near
    if not allowed.any():
        return None
    weight = 1 / fit.variance.pooled
    weighted = fit.projection.error * weight
    best, best_hz, best_zeta = 0.0, 0.0, 0.0
    typical = float(np.median(fit.poles.zeta))
    for zeta in np.unique(np.clip([typical / 3, typical, 3 * typical], 3e-4, 0.08)):
        grid = f[allowed]
        g = modal_kernel(f, grid, np.full(grid.size, zeta), "accelerance", fit.pairs.window_rate)
        gain = np.zeros(grid.size)
        # a free complex residue in each pair
        for column in (g, g * 1j * f[None, :] / grid[:, None]):
            gain += np.sum(real_inner(weighted, column) ** 2 / (weight @ power_of(column).T), axis=0)
        k = int(np.argmax(gain))
        if gain[k] > best:
            best, best_hz, best_zeta = float(gain[k]), float(grid[k]), float(zeta)
    nu = max(fit.correlation, line_correlation(fit.projection.error, fit.variance.pooled))
    need = 2 * 0.5 * (2 * fit.pairs.accelerance.shape[0] + 2) * np.log(max(f.size / nu, 8.0))
    return (best_hz, best_zeta) if best / nu > need else None

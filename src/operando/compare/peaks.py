"""Resonance peaks of a set of FRFs, refitted one by one: frequency, damping, height."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data.arrays import ByContent
from operando.synthesis import power_of

PROMINENCE_DB = 3.0
"""How far a peak must stand out of the averaged curve on both sides."""

WINDOW = 4.0
"""Half-width of the fitted window in half-power bandwidths of the peak."""

LARGEST_SHIFT = 0.15
"""Frequencies further apart (natural logarithm) are not the same mode."""

SPLIT_GAIN = 0.3
"""A second pole under one peak must bring the squared residual below this part."""

SPLIT_TRIED = 0.02
"""Relative residual of a single mode above which two are tried."""

OWN_POLES = 2.5
"""What two poles leave (geometric mean over the pairs) must be this much less than what a pole of its own for each pair leaves: a mode
that drifts while a hammer roves looks like two under one peak. The measured plate: 0.6 to 2.1 where rows of points follow each other;
two modes 0.3 % apart under noise: from 2.8."""

LARGEST_REST, CHANCE = 0.6, 1e-3
"""A pole must bring the squared residual of its window below this part of that without it, and below what a pole makes of noise alone in
so small a part of windows."""

LEAST_MAC = 0.3
"""Residue patterns less alike are not the same mode."""


@dataclass(frozen=True, eq=False)
class Peak(ByContent):
    """One refitted resonance.

    Parameters
    ----------
    frequency_hz, damping_ratio : float
    height : float
        ‖R‖/(−Re λ) over all pairs: the size of the modal contribution at resonance.
    residue : (n_pairs,) complex array
    frequency_std_hz, damping_ratio_std : float, optional
        From what the fit leaves, and from how far the pairs differ where the mode drifts between them; NaN where lines are too few.
    """

    frequency_hz: float
    damping_ratio: float
    height: float
    residue: NDArray[np.complex128]
    frequency_std_hz: float = float("nan")
    damping_ratio_std: float = float("nan")


def _half_width(level_db: NDArray[np.float64], f: NDArray[np.float64], k: int) -> float:
    """Half of the −3 dB width [Hz], from the narrower side, at least half a line."""
    below = level_db < level_db[k] - 3.0103
    left, right = np.flatnonzero(below[:k]), np.flatnonzero(below[k + 1 :])
    sides = []
    if left.size:
        sides.append(f[k] - f[left[-1]])
    if right.size:
        sides.append(f[k + 1 + right[0]] - f[k])
    step = float(np.median(np.diff(f)))
    return max(min(sides) if sides else step, 0.5 * step)


def fit_peaks(
    data: NDArray[Any], f: NDArray[np.float64], weight: NDArray[np.float64] | None = None, variance: NDArray[np.float64] | None = None
) -> list[Peak]:
    """Find the peaks of all pairs together and fit each with its near neighbours; by rising frequency.

    In the window of a group of peaks H ≈ Σ R/(iω − λ) + a + bω + cω² for each pair, poles common to all pairs; the poles by Gauss–Newton on
    the projected residual (variable projection, Golub & Pereyra 1973). ``data`` (n_pairs, n_lines) have no NaN; ``weight`` (n_pairs,) is
    the factor of each pair in curve and fit, 1/rms where not given; ``variance`` E|ΔH|² serves the standard deviations alone, which without
    it are of what the fit leaves.
    """
    from scipy.signal import find_peaks

    if f.size < 8 or data.size == 0:
        return []
    size = np.sqrt(np.mean(np.abs(data) ** 2, axis=1))
    w = np.divide(1, size, out=np.zeros_like(size), where=size > 0) if weight is None else weight
    y = data * w[:, None]
    known = None if variance is None else np.nan_to_num(variance * w[:, None] ** 2, nan=0.0, posinf=0.0)
    level = 10 * np.log10(np.maximum(np.mean(np.abs(y) ** 2, axis=0), 1e-300))
    tops = find_peaks(level, prominence=PROMINENCE_DB)[0].tolist()
    if known is not None:
        # The largest of n values of noise is above its mean by more than log(n/p) with probability p (exponential distribution).
        noise = 10 * np.log10(np.log(f.size / CHANCE) * np.maximum(np.mean(known, axis=0), 1e-300))
        tops = [k for k in tops if level[k] > noise[k]]
    widths = [_half_width(level, f, k) for k in tops]
    groups: list[list[int]] = []
    for i in range(len(tops)):
        if groups and f[tops[i]] - f[tops[groups[-1][-1]]] < WINDOW * (widths[i] + widths[groups[-1][-1]]) / 2 and len(groups[-1]) < 3:
            groups[-1].append(i)
        else:
            groups.append([i])
    peaks: list[Peak] = []
    for group in groups:
        first, last = group[0], group[-1]
        low, high = f[tops[first]] - WINDOW * widths[first], f[tops[last]] + WINDOW * widths[last]
        # Half way to the next peak outside the group belongs to that peak.
        if first > 0:
            low = max(low, (f[tops[first]] + f[tops[first - 1]]) / 2)
        if last + 1 < len(tops):
            high = min(high, (f[tops[last]] + f[tops[last + 1]]) / 2)
        lines = np.flatnonzero((f >= low) & (f <= high))
        # Of fewer lines a pole must explain nearly all: with four less, modes 20 dB above the noise were found 87 times in 100, not 93.
        need = 2 * len(group) + 9
        if lines.size < need:
            a = max(int(tops[first]) - (need - 1) // 2, 0)
            lines = np.arange(a, min(max(a + need, int(tops[last]) + 3), f.size))
        start = [complex(-2 * np.pi * widths[i], 2 * np.pi * f[tops[i]]) for i in group]
        peaks += _fit_window(y[:, lines], f[lines], np.array(start), w, None if known is None else known[:, lines])
    return sorted(peaks, key=lambda p: p.frequency_hz)


def _basis(poles: NDArray[np.complex128], f: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Functions of one or several sets of poles (…, n) on the lines, (…, n_lines, n + 3)."""
    middle, half = (f[0] + f[-1]) / 2, (f[-1] - f[0]) / 2
    x = (f - middle) / half
    out = np.empty((*poles.shape[:-1], f.size, poles.shape[-1] + 3), complex)
    out[..., :-3] = 2 * np.pi * half / (2j * np.pi * f[:, None] - poles[..., None, :])
    out[..., -3:] = np.stack([np.ones_like(x), x, x**2], axis=1)
    return out


def _rest(poles: NDArray[np.complex128], f: NDArray[np.float64], y: NDArray[Any]) -> NDArray[Any]:
    """What one or several sets of poles (…, n) leave of y (n_lines, n_pairs), (…, n_lines, n_pairs)."""
    q = np.linalg.qr(_basis(poles, f))[0]
    return np.asarray(y - q @ (q.conj().swapaxes(-1, -2) @ y))


def _fit_window(
    y: NDArray[Any], f: NDArray[np.float64], start: NDArray[np.complex128], w: NDArray[np.float64], variance: NDArray[np.float64] | None
) -> list[Peak]:
    """Peaks of one window; one peak may turn out to be two close modes, or one mode that drifts from pair to pair."""
    poles, cost = _fit_poles(y, f, start)
    drift = np.zeros(2)
    # One mode and a smooth rest fit to within noise; a poor fit may be two modes.
    if start.size == 1 and f.size >= 12 and y.shape[0] > 1 and cost > SPLIT_TRIED**2 * float(np.sum(np.abs(y) ** 2)):
        apart = 0.5j * abs(poles[0].real)
        pair, pair_cost = _fit_poles(y, f, np.array([poles[0] - apart, poles[0] + apart]))
        inside = np.all((pair.imag > 2 * np.pi * f[0]) & (pair.imag < 2 * np.pi * f[-1])) and np.all(-pair.real < 0.5 * pair.imag)
        # Two poles of a very different width are one mode and a slope.
        if pair_cost < SPLIT_GAIN * cost and inside and max(pair.real / pair.real[::-1]) < 3:
            own, left = _own_poles(y, f, poles[0])
            left_by_pair = np.sum(power_of(_rest(pair, f, y.T)), axis=0)
            if np.mean(np.log(np.maximum(left, 1e-300) / np.maximum(left_by_pair, 1e-300))) < np.log(OWN_POLES):
                drift = np.std([np.abs(own) / 2 / np.pi, -own.real / np.abs(own)], axis=1)
            else:
                poles = pair
    poles = _improves(y, f, poles)
    std = np.hypot(_spread(y, f, poles, variance), drift[:, None])
    return _peaks_of(y, f, poles, w, std)


def _own_poles(y: NDArray[Any], f: NDArray[np.float64], start: complex) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """A pole for each pair, and what it leaves of its square: Gauss–Newton side by side, steps of at most half a half-width."""
    columns, half = y[..., None], abs(start.real)

    def rest_of(poles: NDArray[np.complex128]) -> NDArray[np.complex128]:
        return _rest(poles[:, None], f, columns)[..., 0]

    poles = np.full(y.shape[0], start)
    rest = rest_of(poles)
    left = power_of(rest).sum(axis=1)
    for _ in range(10):
        slope = np.stack([(rest_of(poles + 1e-5 * half * way) - rest) / 1e-5 for way in (1, 1j)], axis=1)
        gram = (slope.conj() @ slope.swapaxes(1, 2)).real + 1e-300 * np.eye(2)
        step = np.clip(-np.linalg.solve(gram, (slope.conj() @ rest[..., None]).real)[..., 0], -0.5, 0.5)
        trial = poles + half * (step[:, 0] + 1j * step[:, 1])
        new_rest = rest_of(trial)
        new = power_of(new_rest).sum(axis=1)
        better = (new < left) & (trial.real < 0)
        poles, rest, left = np.where(better, trial, poles), np.where(better[:, None], new_rest, rest), np.where(better, new, left)
    return poles, left


def largest_rest(lines: int, poles: int) -> float:
    """Part of the squared residual of so many lines that the weakest of some poles may leave.

    Of noise with d complex values a pair left, one more direction takes a share with the density of Beta(1, d − 1): it leaves less than t
    with probability t^(d − 1). A pole is the best of some two directions a line. The pairs count as one series: noise of the force, and
    what a nonlinear location answers, is common to them.
    """
    left = lines - 3 - (poles - 1)
    return min(LARGEST_REST, float((CHANCE / (2 * lines)) ** (1 / max(left - 1, 1))))


def _improves(y: NDArray[Any], f: NDArray[np.float64], poles: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Drop poles that explain little: what noise makes of a peak."""
    while poles.size:
        cost = float(np.sum(power_of(_rest(poles, f, y.T))))
        without = [float(np.sum(power_of(_rest(np.delete(poles, k), f, y.T)))) for k in range(poles.size)]
        weakest = int(np.argmin(without))
        if cost <= largest_rest(f.size, poles.size) * without[weakest]:
            break
        poles = np.delete(poles, weakest)
        if poles.size:
            poles = _fit_poles(y, f, poles)[0]
    return poles


def _fit_poles(y: NDArray[Any], f: NDArray[np.float64], start: NDArray[np.complex128]) -> tuple[NDArray[np.complex128], float]:
    """Poles of one window and the squared residual."""
    columns = np.ascontiguousarray(y.T)
    n = start.size
    theta = np.concatenate([start.real, start.imag])
    scale = np.concatenate([-start.real, -start.real])
    poles = lambda t: t[..., :n] + 1j * t[..., n:]  # noqa: E731
    rest = _rest(poles(theta), f, columns)
    cost, damping = float(np.sum(power_of(rest))), 1e-3
    for _ in range(25):
        change = (_rest(poles(theta + 1e-5 * np.diag(scale)), f, columns) - rest) / 1e-5
        jacobian = change.reshape(2 * n, -1).view(float)
        gram = jacobian @ jacobian.T
        step = np.linalg.solve(gram + damping * np.diag(np.diag(gram) + 1e-300), -jacobian @ rest.ravel().view(float))
        trial = theta + scale * step
        new_rest = _rest(poles(trial), f, columns)
        new = float(np.sum(power_of(new_rest)))
        if np.all(trial[:n] < 0) and new < cost:
            gain = cost - new
            theta, rest, cost, damping = trial, new_rest, new, max(damping / 5, 1e-9)
            if gain < 1e-10 * cost or np.max(np.abs(step)) < 1e-7:
                break
        else:
            damping *= 6
            if damping > 1e6:
                break
    return poles(theta), cost


def _peaks_of(
    y: NDArray[Any], f: NDArray[np.float64], final: NDArray[np.complex128], w: NDArray[np.float64], std: NDArray[np.float64]
) -> list[Peak]:
    """Peaks at given poles, with the standard deviations of frequencies and damping (2, n); a pole that left the window is dropped."""
    columns = y.T
    n = final.size
    solution = np.linalg.lstsq(_basis(final, f), columns, rcond=None)[0]
    half = 2 * np.pi * (f[-1] - f[0]) / 2
    out = []
    for k in range(n):
        hz = abs(final[k]) / 2 / np.pi
        if not f[0] <= final[k].imag / 2 / np.pi <= f[-1]:
            continue
        residue = solution[k] * half / np.where(w > 0, w, np.inf)
        height = float(np.linalg.norm(residue) / -final[k].real)
        out.append(Peak(float(hz), float(-final[k].real / abs(final[k])), height, residue, float(std[0, k]), float(std[1, k])))
    return out


def _spread(
    y: NDArray[Any], f: NDArray[np.float64], poles: NDArray[np.complex128], variance: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Standard deviations of each pole's frequency [Hz] and damping ratio (2, n), from what the fit leaves, and from the variance of the
    FRFs where that is more.

    Pairs share noise (that of the force), and lines near a peak may have more of it (noise in proportion to the FRF): lines alone
    are taken as independent, each with what it leaves over one minus its leverage. The variance of few lines is itself uncertain: that
    of Student's distribution. An error that is smooth over the lines goes into the residues and leaves nothing: of it the variance alone
    knows. What the rest has along the FRFs (beyond what chance has) is the part of it that all pairs share.
    """
    n = poles.size
    free = 2 * (f.size - n - 3) - 2 * n
    if free < 3:
        return np.full((2, n), np.nan)
    if n == 0:
        return np.zeros((2, 0))
    columns, scale = y.T, -poles.real
    rest = _rest(poles, f, columns)
    ways = np.concatenate([np.diag(scale), 1j * np.diag(scale)])
    slope = (_rest(poles + 1e-5 * ways, f, columns) - rest) / 1e-5
    q = np.linalg.qr(_basis(poles, f))[0]
    share = np.maximum(1 - power_of(q).sum(axis=1), 1e-3)
    gram = np.einsum("alp,blp->ab", slope.conj(), slope).real
    by_line = np.einsum("alp,lp->al", slope.conj(), rest).real / share
    inverse = np.linalg.pinv(gram)
    middle = [by_line @ by_line.T * free / (free - 2)]
    if variance is not None:
        middle.append(_of_variance(columns, slope, rest, variance.T))
    size = np.abs(poles)
    of_hz = np.concatenate([np.diag(poles.real * scale), np.diag(poles.imag * scale)]) / size / 2 / np.pi
    of_damping = np.concatenate([np.diag(-(poles.imag**2) * scale), np.diag(poles.real * poles.imag * scale)]) / size**3
    gradients = np.stack([of_hz, of_damping])
    each = [np.einsum("gak,ab,gbk->gk", gradients, inverse @ m @ inverse, gradients) for m in middle]
    return np.asarray(np.sqrt(np.max(each, axis=0)))


def _of_variance(y: NDArray[Any], slope: NDArray[Any], rest: NDArray[Any], variance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance of the slopes' products with noise of a variance (lines, pairs), a part of it the same share of all FRFs of a line."""
    alone = np.einsum("alp,blp,lp->ab", slope.conj(), slope, variance / 2).real
    size, pairs = np.maximum(power_of(y), 1e-300), y.shape[1]
    along = power_of(np.sum(y.conj() * rest, axis=1)) / size.sum(axis=1)
    share = (along.sum() / max(float(power_of(rest).sum()), 1e-300) - 1 / pairs) / (1 - 1 / pairs) if pairs > 1 else 0.0
    shared = np.einsum("alp,lp->al", slope.conj(), y) * np.sqrt(np.median(variance / size, axis=1) / 2)
    share = min(max(float(share), 0.0), 1.0)
    return np.asarray((1 - share) * alone + share * (shared @ shared.conj().T).real)


def match_peaks(measured: list[Peak], model: list[Peak]) -> list[int | None]:
    """Model peak of each measured one, one to one by frequency and residue pattern; None where there is none."""
    if not measured or not model:
        return [None] * len(measured)
    from scipy.optimize import linear_sum_assignment

    a = np.array([p.residue for p in measured])
    b = np.array([p.residue for p in model])
    alike = np.abs(a.conj() @ b.T) ** 2 / np.outer(np.sum(np.abs(a) ** 2, axis=1), np.sum(np.abs(b) ** 2, axis=1))
    shift = np.abs(np.log([[q.frequency_hz / p.frequency_hz for q in model] for p in measured]))
    cost = (1 - alike) + np.minimum(shift / LARGEST_SHIFT, 2)
    rows, columns = linear_sum_assignment(cost)
    out: list[int | None] = [None] * len(measured)
    for i, j in zip(rows, columns, strict=True):
        if shift[i, j] <= LARGEST_SHIFT and alike[i, j] >= LEAST_MAC:
            out[i] = int(j)
    return out


def by_mode(measured: list[Peak], model: list[Peak]) -> list[dict[str, float | None]]:
    """Rows of ``by_mode``: errors of the model at each measured peak, None where the model has no such peak."""
    rows: list[dict[str, float | None]] = []
    for peak, j in zip(measured, match_peaks(measured, model), strict=True):
        q = None if j is None else model[j]
        rows.append(
            {
                "frequency_hz": peak.frequency_hz,
                "frequency_std_hz": peak.frequency_std_hz if np.isfinite(peak.frequency_std_hz) else None,
                "damping_ratio": peak.damping_ratio,
                "damping_ratio_std": peak.damping_ratio_std if np.isfinite(peak.damping_ratio_std) else None,
                "frequency_error_percent": None if q is None else 100 * (q.frequency_hz / peak.frequency_hz - 1),
                "height_error_db": None if q is None or peak.height == 0 else float(20 * np.log10(q.height / peak.height)),
                "damping_error_percent": None if q is None else 100 * (q.damping_ratio / peak.damping_ratio - 1),
            }
        )
    return rows

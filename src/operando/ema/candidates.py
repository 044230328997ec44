"""Candidate poles from many linear fits: the whole band and parts of it, several weightings, both constraints, merged by support.

One fit over a wide band in accelerance buries weak modes at low frequency. Each fit here is cheap, sees another part of the data best, and
follows its poles through the model orders; a mode shows in most fits that can see it, a mathematical pole in few.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.ema.indicator_functions import cmif
from operando.ema.plscf import OrderPoles, plscf
from operando.errors import IdentificationError
from operando.stabilization import PoleTable, Stabilization, Tolerances, classify, select_modes, track_poles

__all__ = ["Candidate", "candidate_poles", "stabilization_diagram"]

_TOLERANCES = Tolerances(frequency=0.003, damping=0.25, mac=0.9, max_damping=0.15)


@dataclass(frozen=True)
class Candidate:
    """A pole that several fits agree on.

    Parameters
    ----------
    frequency_hz, damping_ratio : float
        Weighted medians over the fits.
    vector : (n,) complex array
        Participation vector of the fit that follows it through most orders.
    seen, possible : int
        Fits that found it, and fits whose band holds it.
    stability : float
        Mean share of the model orders that hold it, over the fits that found it.
    frequency_spread : float
        Relative median absolute deviation between the fits.
    prominent : bool
        Whether it deserves to be a starting mode by itself.
    """

    frequency_hz: float
    damping_ratio: float
    vector: NDArray[Any]
    seen: int
    possible: int
    stability: float
    frequency_spread: float
    prominent: bool

    @property
    def support(self) -> float:
        """Share of the possible fits, times the mean share of orders: 0 to 1."""
        return self.seen / max(self.possible, 1) * self.stability


@dataclass(frozen=True)
class _Chain:
    """A pole followed through the orders of one fit."""

    fit: int
    hz: float
    zeta: float
    vector: NDArray[Any]
    share: float


def candidate_poles(
    frequencies_hz: ArrayLike,
    H: ArrayLike,
    weights: ArrayLike | None = None,
    band: tuple[float, float] | None = None,
    *,
    modes_per_fit: int | None = None,
    max_damping: float = 0.15,
    window_rate: float = 0.0,
) -> list[Candidate]:
    """Poles that the linear fits of a band and of its parts agree on, by rising frequency.

    Parameters
    ----------
    frequencies_hz : (n_lines,) array
        Lines [Hz].
    H : (n_resp, n_ref, n_lines) complex array
        Accelerance (other quantities work; the weightings then differ by powers of ω).
    weights : (n_resp, n_ref, n_lines) or (n_resp, n_lines) array, optional
        1/standard deviation of the lines, where known.
    band : (low, high), optional
        Hz; default all lines.
    modes_per_fit : int, optional
        Poles at the largest order of the fit of the whole band, default 90; parts of the band get 45 % of it.
    max_damping : float
        Poles above it are left out.
    window_rate : float
        Rate β [1/s] of the exponential window the FRFs carry.

    Returns
    -------
    list of Candidate
        Also weakly supported ones; ``prominent`` marks those worth a start.

    Raises
    ------
    IdentificationError
        If no fit is possible in the band.

    Examples
    --------
    >>> import numpy as np, operando
    >>> from operando.ema import candidate_poles
    >>> model = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> found = candidate_poles(np.arange(5, 80, 0.1), model.frf(np.arange(5, 80, 0.1)).data)
    >>> min(round(abs(float(c.frequency_hz) - 45.0), 3) for c in found)
    0.0
    """
    f = np.asarray(frequencies_hz, float)
    data = np.asarray(H, complex)
    low, high = (float(f[0]), float(f[-1])) if band is None else (max(band[0], float(f[0])), min(band[1], float(f[-1])))
    given = None if weights is None else np.asarray(weights, float)
    if given is not None and given.ndim == 2:
        given = np.broadcast_to(given[:, None, :], data.shape)
    n_in = min(data.shape[:2])
    total = modes_per_fit or 90
    chains: list[_Chain] = []
    bands: list[tuple[float, float]] = []
    for a, b in _sub_bands(low, high):
        part = (f >= a) & (f <= b)
        lines = int(np.count_nonzero(part))
        share = 1.0 if (a, b) == (low, high) else 0.45
        order = min(int(np.ceil(share * total / n_in)), 60, lines // 6)
        if order < 4:
            continue
        fp, hp = f[part], data[:, :, part]
        gp = None if given is None else given[:, :, part]
        for weight, constraint in _weightings(fp, hp, gp):
            try:
                orders = plscf(
                    fp,
                    hp,
                    max_order=order,
                    weights=weight,
                    constraint=constraint,
                    max_damping=max_damping,
                    step=1 + order // 24,
                    window_rate=window_rate,
                )
            except IdentificationError:
                continue
            chains += _chains(orders, len(bands), max_damping)
            bands.append((a, b))
    if not bands:
        raise IdentificationError(
            f"no fit possible between {low:g} and {high:g} Hz ({f.size} lines)", hint="widen the band or use a longer block"
        )
    return _merge(chains, bands)


def _sub_bands(low: float, high: float) -> list[tuple[float, float]]:
    """The band, linear thirds and geometric parts of about an octave, overlapping by half."""
    bands = [(low, high)]
    width = (high - low) / 3
    bands += [(low + k * width / 2, low + k * width / 2 + width) for k in range(5)]
    start = max(low, 1e-3 * high)
    octaves = np.log2(high / start)
    if octaves > 1.5:
        n = int(np.ceil(2 * (octaves - 1)))
        step = (octaves - 1) / max(n, 1)
        bands += [(start * 2 ** (k * step), start * 2 ** (k * step + 1)) for k in range(n + 1)]
    return [(float(a), min(float(b), high)) for a, b in bands]


def _weightings(
    f: NDArray[np.float64], H: NDArray[np.complex128], given: NDArray[np.float64] | None
) -> Iterator[tuple[NDArray[np.float64] | None, Any]]:
    """Weights and constraint of each fit of one band."""
    level = np.sqrt(np.mean(np.abs(H) ** 2, axis=(0, 1)))
    flat = np.broadcast_to(1 / np.maximum(level, 1e-6 * level.max()), (H.shape[0], f.size))
    receptance = np.broadcast_to((f[-1] / np.maximum(f, 1e-3 * f[-1])) ** 2, (H.shape[0], f.size))
    yield receptance, "lowest"
    yield np.sqrt(flat), "lowest"
    if given is not None:
        yield given, "lowest"
        yield given, "highest"
    else:
        yield None, "lowest"
        yield None, "highest"


def _physical(orders: Sequence[OrderPoles]) -> PoleTable:
    """The physical poles of all orders, by frequency within each; what is followed through the orders needs no status."""
    hz = [o.frequency_hz[o.physical] for o in orders]
    rank = [np.flatnonzero(o.physical)[np.argsort(f)] for o, f in zip(orders, hz, strict=True)]
    return PoleTable(
        np.repeat([o.order for o in orders], [r.size for r in rank]),
        np.concatenate([np.sort(f) for f in hz]),
        np.concatenate([o.damping_ratio[r] for o, r in zip(orders, rank, strict=True)]),
        np.concatenate([o.vectors[:, r] for o, r in zip(orders, rank, strict=True)], axis=1),
        np.zeros(sum(r.size for r in rank), int),
    )


def _chains(orders: Sequence[OrderPoles], fit: int, max_damping: float) -> list[_Chain]:
    """Poles of one fit followed through its orders; the values come from the upper half of the chain."""
    table = _physical(orders)
    n_orders = len(orders)
    out = []
    for rows in track_poles(table, _TOLERANCES, max_gap=3):
        if rows.size < max(3, 0.15 * n_orders):
            continue
        upper = rows[rows.size // 2 :]
        hz, zeta = float(np.median(table.frequency_hz[upper])), float(np.median(table.damping_ratio[upper]))
        if zeta > max_damping:
            continue
        # a mode found late is no worse than one found early: the share counts from its first order on, at least half of all orders
        first = int(np.searchsorted([o.order for o in orders], table.order[rows[0]]))
        share = rows.size / max(n_orders - first, 0.5 * n_orders)
        out.append(_Chain(fit, hz, zeta, table.vectors[:, upper[-1]], min(share, 1.0)))
    return out


def _merge(chains: Sequence[_Chain], bands: Sequence[tuple[float, float]]) -> list[Candidate]:
    """Chains of different fits that mean the same pole, joined from the strongest on; each fit counts once."""
    ranked = sorted(chains, key=lambda c: -c.share)
    groups: list[list[_Chain]] = []
    centres = np.zeros(len(ranked))
    for c in ranked:
        best, distance = None, 1.0
        for k in np.flatnonzero(np.abs(centres[: len(groups)] - c.hz) < 0.1 * c.hz):
            g = groups[k]
            width = max(0.0015, 0.35 * min(g[0].zeta, c.zeta)) * centres[k]
            d = abs(c.hz - centres[k]) / width
            if d < distance and all(m.fit != c.fit for m in g) and abs(np.vdot(g[0].vector, c.vector)) ** 2 > 0.7:
                best, distance = k, d
        if best is None:
            centres[len(groups)] = c.hz
            groups.append([c])
        else:
            groups[best].append(c)
            centres[best] = float(np.median([m.hz for m in groups[best]]))
    out = []
    for g in _joined(groups):
        hz = np.array([c.hz for c in g])
        zeta = np.array([c.zeta for c in g])
        share = np.array([c.share for c in g])
        centre = _weighted_median(hz, share)
        damping = _weighted_median(zeta, share)
        # a fit can see a mode that lies inside its band by two half-power widths
        margin = 2 * damping * centre
        fits = {c.fit for c in g}
        possible = sum(1 for k, (a, b) in enumerate(bands) if k in fits or a + margin < centre < b - margin)
        spread = float(np.median(np.abs(hz - centre)) / centre)
        stability = float(np.mean(share))
        support = len(g) / possible * stability
        prominent = len(g) >= 3 and support > 0.25 and spread < max(1e-3, 0.2 * damping)
        out.append(Candidate(centre, damping, g[0].vector, len(g), possible, stability, spread, bool(prominent)))
    return sorted(out, key=lambda c: c.frequency_hz)


def _joined(groups: list[list[_Chain]]) -> list[list[_Chain]]:
    """Groups closer than 0.7 half bandwidths that hardly ever occur in the same fit are one mode that some fits put a little elsewhere.

    Two true modes, however close, are seen side by side by the same fits.
    """
    kept: list[list[_Chain]] = []
    centres: list[tuple[float, float]] = []
    for g in sorted(groups, key=lambda g: -sum(c.share for c in g)):
        hz, zeta = float(np.median([c.hz for c in g])), float(np.median([c.zeta for c in g]))
        fits = {c.fit for c in g}
        for k, (other_hz, other_zeta) in zip(kept, centres, strict=True):
            if abs(hz - other_hz) > 0.7 * min(zeta, other_zeta) * hz or abs(np.vdot(g[0].vector, k[0].vector)) ** 2 < 0.7:
                continue
            both = fits & {c.fit for c in k}
            if len(both) <= 0.5 * len(fits):
                k += [c for c in g if c.fit not in both]
                break
        else:
            kept.append(g)
            centres.append((hz, zeta))
    return kept


def _weighted_median(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    rank = np.argsort(values)
    total = np.cumsum(weights[rank])
    return float(values[rank][np.searchsorted(total, 0.5 * total[-1])])


def stabilization_diagram(
    frequencies_hz: ArrayLike,
    H: ArrayLike,
    *,
    max_order: int,
    weights: ArrayLike | None = None,
    band: tuple[float, float] | None = None,
    tolerances: Tolerances | None = None,
    select_hz: Sequence[float] = (),
    reject_hz: Sequence[float] = (),
    window_rate: float = 0.0,
) -> Stabilization:
    """The diagram of one fit over the band, with automatic selection and the CMIF behind it.

    Parameters
    ----------
    frequencies_hz : (n_lines,) array
        Lines [Hz].
    H : (n_resp, n_ref, n_lines) complex array
        FRFs.
    max_order : int
        Highest polynomial order.
    weights : array, optional
        As in :func:`operando.ema.plscf.plscf`.
    band : (float, float), optional
        Lines used [Hz]. Default: all.
    tolerances : Tolerances, optional
        What counts as stable.
    select_hz, reject_hz : sequences of float
        Choice by hand [Hz], as in :func:`operando.stabilization.select_modes`.
    window_rate : float
        Decay rate [1/s] of an exponential window.

    Returns
    -------
    Stabilization

    Examples
    --------
    >>> import numpy as np, operando
    >>> idle = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> frf = idle.frf(np.arange(5, 80, 0.1))
    >>> from operando.ema import stabilization_diagram
    >>> stabilization_diagram(frf.frequencies_hz, frf.data, max_order=20).selected_hz.round(2).tolist()
    [20.0, 45.0]
    """
    f = np.asarray(frequencies_hz, float)
    low, high = (float(f[0]), float(f[-1])) if band is None else band
    orders = plscf(f, H, max_order=max_order, weights=weights, frequency_range=(low, high), window_rate=window_rate)
    part = (f >= low) & (f <= high)
    return select_modes(
        classify(
            [o.order for o in orders],
            [o.frequency_hz for o in orders],
            [o.damping_ratio for o in orders],
            [o.vectors for o in orders],
            tolerances or Tolerances(),
        ),
        band=(low, high),
        tolerances=tolerances,
        select_hz=select_hz,
        reject_hz=reject_hz,
        indicator_hz=f[part],
        indicator=cmif(np.asarray(H)[:, :, part]),
    )

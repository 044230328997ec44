"""Automatic choice of modes from a stabilisation diagram, with a reason for whatever is not taken."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.errors import IdentificationError
from operando.stabilization.classify import pole_differences, unit_vectors
from operando.stabilization.table import PoleTable, RejectedPole, Stabilization, Tolerances

Members = NDArray[np.int_]

HAND_TOLERANCE = 0.01
"""Relative distance up to which a frequency of ``select_hz`` or ``reject_hz`` means a mode."""


def track_poles(table: PoleTable, tolerances: Tolerances, max_gap: int = 3) -> list[Members]:
    """Chains of poles that agree from order to order, at most one pole of an order in a chain.

    Going up the orders, pairs (chain, pole) are joined nearest first, by the sum of the differences of frequency, damping and
    vector in units of their tolerance; a chain may miss up to ``max_gap − 1`` orders in a row. Because an order gives at most
    one pole to a chain, close modes stay apart however close they are.

    Parameters
    ----------
    table : PoleTable
        Poles of all orders.
    tolerances : Tolerances
        What counts as stable; default: those of the field.
    max_gap : int, optional
        Orders in a row that a chain may miss.

    Returns
    -------
    list of int arrays
        Rows of the table of each chain, single poles included.

    Examples
    --------
    >>> import numpy as np
    >>> from operando.stabilization import classify, track_poles, Tolerances
    >>> shape = np.array([[1.0], [0.5]])
    >>> table = classify([2, 4, 6, 8, 10], [[20.0], [20.01], [20.0], [20.0], [20.0]], [[0.01]] * 5, [shape] * 5)
    >>> [len(members) for members in track_poles(table, Tolerances())]
    [5]
    """
    levels = np.unique(table.order)
    unit = unit_vectors(np.where(np.isfinite(table.vectors), table.vectors, 0))
    f, z = table.frequency_hz, table.damping_ratio
    finite = np.flatnonzero(np.isfinite(f) & np.isfinite(z) & (f > 0))
    chains: list[list[int]] = []
    last_seen: list[int] = []
    for step, level in enumerate(levels):
        new = finite[table.order[finite] == level]
        active = [c for c in range(len(chains)) if step - last_seen[c] <= max_gap]
        free = np.ones(new.size, bool)
        if active and new.size:
            tips = np.array([chains[c][-1] for c in active])
            df, dz, dv = pole_differences(f[tips], z[tips], unit[:, tips], f[new], z[new], unit[:, new])
            fits = (df <= tolerances.frequency) & (dz <= 3 * tolerances.damping) & (dv <= 1 - tolerances.mac)
            cost = df / tolerances.frequency + dz / tolerances.damping + dv / max(1 - tolerances.mac, 1e-3)
            i, j = np.nonzero(fits)
            rank = np.argsort(cost[i, j])
            open_tip = np.ones(tips.size, bool)
            for a, b in zip(i[rank], j[rank], strict=True):
                if open_tip[a] and free[b]:
                    open_tip[a] = free[b] = False
                    chains[active[a]].append(int(new[b]))
                    last_seen[active[a]] = step
        for row in new[free]:
            chains.append([int(row)])
            last_seen.append(step)
    return [np.array(c) for c in chains]


def size_threshold(sizes: NDArray[np.int_], n_orders: int) -> int:
    """Smallest chain that counts as a mode: the two-means split of the sizes, held between a quarter and half of the orders."""
    values = np.sort(np.append(sizes, 0)).astype(float)
    best, cut = np.inf, 0.0
    for k in range(1, values.size):
        spread = values[:k].var() * k + values[k:].var() * (values.size - k)
        if spread < best:
            best, cut = spread, (values[k - 1] + values[k]) / 2
    return int(np.ceil(np.clip(cut, 0.25 * n_orders, 0.5 * n_orders)))


def centre(table: PoleTable, members: Members) -> tuple[float, float, NDArray[Any]]:
    """Median frequency, median damping, and the vector of the member most like all others."""
    unit = unit_vectors(table.vectors[:, members])
    if unit.shape[1] == 1:
        return float(table.frequency_hz[members][0]), float(table.damping_ratio[members][0]), unit[:, 0]
    likeness = (np.abs(unit.conj().T @ unit) ** 2).sum(axis=1)
    return float(np.median(table.frequency_hz[members])), float(np.median(table.damping_ratio[members])), unit[:, int(np.argmax(likeness))]


def select_modes(
    table: PoleTable,
    *,
    band: tuple[float, float] | None = None,
    tolerances: Tolerances | None = None,
    min_size: int | None = None,
    max_gap: int = 3,
    select_hz: Sequence[float] = (),
    reject_hz: Sequence[float] = (),
    hand_tolerance: float = HAND_TOLERANCE,
    indicator_hz: NDArray[np.float64] | None = None,
    indicator: NDArray[np.float64] | None = None,
) -> Stabilization:
    """Choose the modes of a stabilisation diagram without looking at it.

    Chains of poles are followed through the orders (``track_poles``); a chain in band, physically damped and long enough is a
    mode. The length asked for comes from the diagram itself (two-means split of the chain lengths, in the spirit of the cluster
    stage of Reynders, Houbrechts & De Roeck 2012), unless ``min_size`` says it.

    Parameters
    ----------
    table : PoleTable
        Poles of all orders.
    band : (low, high), optional
        Only modes in this band [Hz]; default all.
    tolerances : Tolerances, optional
        What counts as stable; default: those of the field.
    min_size : int, optional
        Smallest number of orders a mode must appear in.
    max_gap : int
        A chain ends when it is not seen for this many orders.
    select_hz, reject_hz : sequences of float
        Choice by hand [Hz]: the chain named by each ``select_hz`` (to six digits, else the longest within ``hand_tolerance``, relative) is
        taken, beside what is chosen automatically; the modes nearest to each ``reject_hz`` are not.
    hand_tolerance : float
        Largest relative distance of a pole from a frequency chosen by hand.
    indicator_hz, indicator : arrays, optional
        Passed through for the drawing.

    Returns
    -------
    Stabilization
        Modes by increasing frequency; ``rejected`` holds each chain of three or more poles that was not taken, with code and reason
        (shorter ones are the unstable poles of the table).

    Raises
    ------
    IdentificationError
        If a frequency of ``select_hz`` has no pole within the tolerance.

    Examples
    --------
    >>> import numpy as np
    >>> from operando.stabilization import classify, select_modes
    >>> shape = np.array([[1.0], [0.5]])
    >>> table = classify([2, 4, 6, 8, 10], [[20.0], [20.01], [20.0], [20.0], [20.0]], [[0.01]] * 5, [shape] * 5)
    >>> select_modes(table, band=(5, 50)).selected_hz.round(2).tolist()
    [20.0]
    """
    tol = tolerances or Tolerances()
    n_orders = int(np.unique(table.order).size)
    low, high = band if band is not None else (0.0, np.inf)
    chains = track_poles(table, tol, max_gap)
    chains.sort(key=len, reverse=True)
    centres = [centre(table, c) for c in chains]
    hz = np.array([c[0] for c in centres])
    zeta = np.array([c[1] for c in centres])
    size = np.array([c.size for c in chains], int)
    usable = (hz >= low) & (hz <= high) & (zeta > 0) & (zeta <= tol.max_damping) & (size >= 2)
    needed = min_size if min_size is not None else size_threshold(size[usable], n_orders)
    chosen: list[int] = []
    rejected: list[RejectedPole] = []
    by_hand = _picked_by_hand(hz, zeta, size, select_hz, hand_tolerance)
    for c in range(len(chains)):
        verdict = None
        if c not in by_hand:
            verdict = _verdict(table, chains, centres, c, chosen, (low, high), needed, n_orders, tol)
        if verdict is None:
            chosen.append(c)
        elif size[c] >= 3:
            rejected.append(RejectedPole(float(hz[c]), float(zeta[c]), *verdict))
    for f in reject_hz:
        near = [c for c in chosen if abs(hz[c] - f) <= hand_tolerance * f]
        if near:
            c = min(near, key=lambda k: abs(hz[k] - f))
            chosen.remove(c)
            rejected.append(RejectedPole(float(hz[c]), float(zeta[c]), "by_hand", f"rejected by hand ({f:g} Hz)"))
        else:
            rejected.append(RejectedPole(float(f), float("nan"), "by_hand", f"rejection by hand of {f:g} Hz: no mode was selected there"))
    chosen.sort(key=lambda k: hz[k])
    vectors = np.column_stack([centres[c][2] for c in chosen]) if chosen else np.zeros((table.vectors.shape[0], 0), table.vectors.dtype)
    return Stabilization(
        table,
        hz[chosen] if chosen else np.zeros(0),
        zeta[chosen] if chosen else np.zeros(0),
        vectors,
        tuple(chains[c] for c in chosen),
        tuple(sorted(rejected, key=lambda r: r.frequency_hz)),
        indicator_hz,
        indicator,
        tol,
    )


def demote(stabilization: Stabilization, verdicts: Mapping[int, tuple[str, str]]) -> Stabilization:
    """The selection without some of its modes, each rejected with a code and a reason.

    ``verdicts`` say of modes selected (by index) why they are none after all (known only after the diagram: a sinusoid, too uncertain,
    negative modal mass, …).
    """
    keep = [i for i in range(stabilization.selected_hz.size) if i not in verdicts]
    gone = [
        RejectedPole(float(stabilization.selected_hz[i]), float(stabilization.selected_damping[i]), code, reason)
        for i, (code, reason) in verdicts.items()
    ]
    return replace(
        stabilization,
        selected_hz=stabilization.selected_hz[keep],
        selected_damping=stabilization.selected_damping[keep],
        selected_vectors=stabilization.selected_vectors[:, keep],
        selected_members=tuple(stabilization.selected_members[i] for i in keep),
        rejected=tuple(sorted((*stabilization.rejected, *gone), key=lambda r: r.frequency_hz)),
    )


SIX_DIGITS = 5e-6
"""Largest relative difference that six digits leave, as the workbench and the report state frequencies."""


def _picked_by_hand(
    hz: NDArray[np.float64], zeta: NDArray[np.float64], size: NDArray[np.int_], select_hz: Sequence[float], tolerance: float
) -> set[int]:
    """Chain of each frequency chosen by hand: the one named to six digits, else the longest within the tolerance.

    Chains that another choice is nearer to are left to that one.
    """
    picked: set[int] = set()
    for f in select_hz:
        others = np.array([g for g in select_hz if g != f])
        near = [
            c
            for c in range(hz.size)
            if abs(hz[c] - f) <= tolerance * f
            and zeta[c] > 0
            and c not in picked
            and (others.size == 0 or np.abs(others - hz[c]).min() >= abs(hz[c] - f))
        ]
        if not near:
            where = f"nearest is {hz[np.abs(hz - f).argmin()]:.4g} Hz" if hz.size else "there is no pole at all"
            raise IdentificationError(
                f"no pole within {100 * tolerance:g} % of {f:g} Hz, chosen by hand; {where}",
                hint="correct select_hz, widen the band or raise the model order",
            )
        exact = min(near, key=lambda c: abs(hz[c] - f))
        if abs(hz[exact] - f) <= SIX_DIGITS * f:  # no frequency read off a plot: this chain is meant, however short
            picked.add(exact)
            continue
        # Long chains count more than exact frequency, which a user reads off a plot.
        picked.add(max(near, key=lambda c: size[c] * (1 - abs(hz[c] - f) / (tolerance * f + 1e-300) / 2)))
    return picked


def _verdict(
    table: PoleTable,
    chains: list[Members],
    centres: list[tuple[float, float, NDArray[Any]]],
    c: int,
    chosen: list[int],
    band: tuple[float, float],
    needed: int,
    n_orders: int,
    tol: Tolerances,
) -> tuple[str, str] | None:
    """Code and reason for not taking chain ``c``, or None; longer chains were tested before."""
    f, z, vector = centres[c]
    n = chains[c].size
    if not band[0] <= f <= band[1]:
        return "outside_band", f"{f:.4g} Hz lies outside the band {band[0]:g} to {band[1]:g} Hz"
    if z <= 0:
        return "negative_damping", f"damping ratio {100 * z:.3g} % is not positive: not a decaying vibration"
    if z > tol.max_damping:
        return "too_damped", f"damping ratio {100 * z:.3g} % is above {100 * tol.max_damping:.3g} %"
    if n < needed:
        spread = float(np.std(table.frequency_hz[chains[c]])) if n > 1 else 0.0
        return "small_cluster", f"stable in {n} of {n_orders} orders, {needed} needed (frequency scatter {spread:.2g} Hz)"
    for k in chosen:
        fk, zk, vk = centres[k]
        likeness = abs(np.vdot(vector, vk)) ** 2
        widths = abs(f - fk) / (z * f + zk * fk)
        if likeness > 0.9 and (widths < 0.1 or (widths < 0.5 and n < 0.8 * chains[k].size)):
            apart = f"MAC {likeness:.3f}, {abs(f - fk):.2g} Hz apart, in {n} orders against {chains[k].size}"
            return "duplicate", f"splits off the mode at {fk:.5g} Hz: {apart}"
    return None

"""Which operational mode belongs to which idle mode: one to one, by MAC and frequency."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data.arrays import ByContent
from operando.errors import ConfigError
from operando.indicators import mac

FREQUENCY_WEIGHT = 0.5
"""Cost of a frequency ratio of e against one MAC unit, before it is cut off at ``FREQUENCY_COST_LIMIT``."""

FREQUENCY_COST_LIMIT = 0.3
"""Largest cost of a frequency distance: shapes decide, frequencies break ties."""

UNRELATED_MAC = 0.1
"""Below this MAC a partner says nothing about the mode."""

UNRELATED_RATIO = 1.25
"""... unless the frequencies lie within this ratio."""


@dataclass(frozen=True)
class Pair:
    """One operational mode and its idle partner.

    Parameters
    ----------
    operating : int
        Index of the operational mode.
    idle : int or None
        Index of the idle mode; None where there is none.
    mac : float
        MAC with the partner (Shen & Lu 2024, Eq 1); the best with any idle mode where there is no partner.
    kind : {"unchanged", "changed", "beyond_idle_band", "unpaired"}
        ``class`` in ``summary.json``.
    note : str
        Conflict or reason in words; empty where there is nothing to say.
    """

    operating: int
    idle: int | None
    mac: float
    kind: str
    note: str = ""


@dataclass(frozen=True, eq=False)
class Pairing(ByContent):
    """All pairs, one an operational mode, in its order.

    Parameters
    ----------
    pairs : tuple of Pair
    mac : (n_idle, n_operating) array
    conflicts : tuple of str
        Operational modes that wanted the same idle mode, in words.
    """

    pairs: tuple[Pair, ...]
    mac: NDArray[np.float64]
    conflicts: tuple[str, ...] = ()

    def of_kind(self, *kinds: str) -> list[int]:
        """Operational indices of the given classes."""
        return [p.operating for p in self.pairs if p.kind in kinds]

    @property
    def partners(self) -> NDArray[np.int_]:
        """Idle index of each operational mode, −1 where there is none."""
        return np.array([-1 if p.idle is None else p.idle for p in self.pairs], int)

    @property
    def idle_without_partner(self) -> list[int]:
        """Idle indices no operational mode is paired with."""
        taken = set(self.partners.tolist())
        return [j for j in range(self.mac.shape[0]) if j not in taken]


def pair_modes(
    idle_shapes: ArrayLike,
    idle_hz: ArrayLike,
    operating_shapes: ArrayLike,
    operating_hz: ArrayLike,
    threshold: float = 0.7,
    in_band: ArrayLike | None = None,
) -> Pairing:
    """Pair modes one to one and class them (Shen & Lu 2024, Eq 1 and Section 2; assignment is this project's).

    The sum of (1 − MAC) + a bounded frequency distance is made smallest over all pairs at once. A mode is *unchanged* if
    the MAC with its partner is at least ``threshold``, else *changed*; *beyond_idle_band* if that partner is an idle mode
    outside the analysis band; *unpaired* if no idle mode is left or none has anything to do with it.

    Parameters
    ----------
    idle_shapes : (m, n_idle) real array
        Idle shapes in columns.
    idle_hz : (n_idle,) array [Hz]
        Idle frequencies [Hz].
    operating_shapes : (m, n_operating) complex array of arbitrary scale
        Operational shapes in columns, at the same DOFs.
    operating_hz : (n_operating,) array [Hz]
        Operational frequencies [Hz].
    threshold : float
        ε, between 0 and 1.
    in_band : (n_idle,) bool array, optional
        Idle modes inside the analysis band; default all.

    Returns
    -------
    Pairing

    Raises
    ------
    ConfigError
        If the threshold is not between 0 and 1.

    Examples
    --------
    >>> import numpy as np
    >>> from operando.scaling import pair_modes
    >>> pairing = pair_modes(np.eye(2), [20.0, 45.0], np.eye(2)[:, ::-1], [21.0, 46.0])
    >>> [(pair.operating, pair.idle) for pair in pairing.pairs]
    [(0, 1), (1, 0)]
    """
    if not 0 < threshold <= 1:
        raise ConfigError(f"threshold {threshold} is not between 0 and 1", hint="the paper uses 0.7 (plate) and 0.8 (experiment)")
    from scipy.optimize import linear_sum_assignment

    fe, fo = np.asarray(idle_hz, float), np.asarray(operating_hz, float)
    table = np.asarray(mac(idle_shapes, operating_shapes), float)
    inside = np.ones(fe.size, bool) if in_band is None else np.asarray(in_band, bool)
    distance = np.abs(np.log(np.maximum(fo, 1e-12)[None, :] / np.maximum(fe, 1e-12)[:, None]))
    cost = 1 - table + np.minimum(FREQUENCY_WEIGHT * distance, FREQUENCY_COST_LIMIT)
    rows, columns = linear_sum_assignment(cost)
    partner = dict(zip(columns.tolist(), rows.tolist(), strict=True))
    holder = {j: r for r, j in partner.items()}
    pairs: list[Pair] = []
    conflicts: list[str] = []
    for r in range(fo.size):
        j = partner.get(r)
        best = int(np.argmax(table[:, r])) if fe.size else -1
        note = ""
        if best >= 0 and j != best and table[best, r] >= threshold and best in holder:
            other = holder[best]
            note = (
                f"operational modes {fo[r]:.2f} Hz (MAC {table[best, r]:.2f}) and {fo[other]:.2f} Hz (MAC {table[best, other]:.2f}) "
                f"both pair with idle mode {fe[best]:.2f} Hz; given to {fo[other]:.2f} Hz"
            )
            conflicts.append(note)
        best_mac = float(table[best, r]) if best >= 0 else 0.0
        if j is None:
            pairs.append(Pair(r, None, best_mac, "unpaired", note or "more operational than idle modes"))
            continue
        if table[j, r] < UNRELATED_MAC and distance[j, r] > np.log(UNRELATED_RATIO):
            reason = f"the idle mode left over ({fe[j]:.2f} Hz) has MAC {table[j, r]:.2f} and lies far off"
            pairs.append(Pair(r, None, best_mac, "unpaired", note or reason))
            continue
        unchanged = table[j, r] >= threshold
        kind = ("unchanged" if inside[j] else "beyond_idle_band") if unchanged else "changed"
        pairs.append(Pair(r, j, float(table[j, r]), kind, note))
    return Pairing(tuple(pairs), table, tuple(conflicts))

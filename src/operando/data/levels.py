"""What counts as one level of a force."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from operando.data.time import TimeRecord
from operando.dof import Node

LEVEL_RATIO = 1.4
"""Forces within this factor count as one level, wherever runs are split by level. It lies just under 3 dB (1.413), the smallest step in
which an excitation is set by hand; two random records of one setting differ by 1/√(2BT), under 5 % from B·T = 200 on, and the means of
some hammer hits by 20 %."""


def one_level(first: float, second: float) -> bool:
    """Whether two forces (rms or peak) are of one level.

    Parameters
    ----------
    first : float
        One force [N].
    second : float
        Another force [N], of the same measure.

    Returns
    -------
    bool

    Examples
    --------
    >>> one_level(5.0, 5.2), one_level(5.0, 20.0)
    (True, False)
    """
    low, high = sorted((first, second))
    return high == low or high < LEVEL_RATIO * low


def force_rms(record: TimeRecord) -> float:
    """Rms of the forces of a record about their mean (an offset of the sensor is no force), root mean square over its force channels.

    Parameters
    ----------
    record : TimeRecord
        With one force channel or several.

    Returns
    -------
    float
        N.

    Examples
    --------
    >>> import numpy as np, operando
    >>> channels = [operando.Channel("1+Z", "force", "N"), operando.Channel("2+Z", "acceleration", "m/s2")]
    >>> force_rms(operando.TimeRecord(np.array([[5.0, -1.0], [0.1, 0.2]]), 100.0, channels))
    3.0
    """
    return float(np.sqrt(np.mean(np.square(record.statistics.std[list(record.force_indices)]))))


def level_groups(records: Sequence[TimeRecord]) -> list[list[TimeRecord]]:
    """Runs of one level, lowest level first.

    Runs of the same references are ranked by their force; a step of more than ``LEVEL_RATIO`` starts a new level. The groups
    of all references are joined by rank, so that the lowest level holds every reference.

    Parameters
    ----------
    records : sequence of TimeRecord
        With forces.

    Returns
    -------
    list of list of TimeRecord

    Examples
    --------
    >>> import numpy as np, operando
    >>> channels = [operando.Channel("1+Z", "force", "N"), operando.Channel("2+Z", "acceleration", "m/s2")]
    >>> runs = [operando.TimeRecord([[size, -size], [1, 2]], 100.0, channels) for size in (10.0, 1.0, 10.5)]
    >>> [len(group) for group in level_groups(runs)]
    [1, 2]
    """
    by_reference: dict[frozenset[tuple[Node, str]], list[TimeRecord]] = {}
    for record in records:
        dofs = (record.channels[i].dof for i in record.force_indices)
        by_reference.setdefault(frozenset(d.key for d in dofs if d is not None), []).append(record)
    groups: list[list[TimeRecord]] = []
    for runs in by_reference.values():
        ranked = sorted(runs, key=force_rms)
        rank = 0
        for previous, run in zip([None, *ranked], ranked, strict=False):
            if previous is not None and not one_level(force_rms(previous), force_rms(run)):
                rank += 1
            while len(groups) <= rank:
                groups.append([])
            groups[rank].append(run)
    return groups

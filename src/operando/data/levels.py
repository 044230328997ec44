"""What counts as one level of a force."""

from __future__ import annotations

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

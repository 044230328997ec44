"""What every function on bare signals asks of them: one rate, one length, finite samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data import number_of, numbers_of
from operando.errors import DataError

Real = NDArray[np.float64]


def checked_signals(sampling_hz: float, several: str = "", **signals: ArrayLike) -> list[Real]:
    """Signals as arrays of equal length.

    Parameters
    ----------
    sampling_hz : float
        Samples a second.
    several : str, optional
        Name of the signal that may have several rows; it comes back with two axes.
    **signals : array_like
        By the names that messages give them.

    Examples
    --------
    >>> checked_signals(100.0, force=[0, 1], response=[2, 3])[1].tolist()
    [2.0, 3.0]
    """
    rate = "give the samples a second, more than 0"
    if not number_of(sampling_hz, "sampling_hz", rate) > 0:
        raise DataError(f"sampling_hz is {sampling_hz}", hint=rate)
    out = []
    for name, given in signals.items():
        x = numbers_of(given, name, "give one row of samples")
        if name == several:
            x = np.atleast_2d(x)
        if x.ndim != (2 if name == several else 1):
            raise DataError(f"{name} has the shape {x.shape}", hint="give one row of samples")
        bad = ~np.isfinite(x)
        if bad.any():
            where = np.argwhere(bad)[0]
            row = f" in row {where[0]}" if name == several and len(x) > 1 else ""
            raise DataError(
                f"{name}: {bad.sum()} of {x.size} samples are not finite, the first at {where[-1]}{row}",
                hint="use a part of the record without them: what they were cannot be known",
            )
        out.append(x)
    if len({x.shape[-1] for x in out}) > 1:
        *first, last = signals
        raise DataError(
            f"{', '.join(first)} and {last} have {', '.join(str(x.shape[-1]) for x in out)} samples",
            hint="they need the same number of samples",
        )
    return out

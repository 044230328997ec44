"""Frequency lines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from operando.data.arrays import frozen, numbers_of
from operando.data.objects import Shown, counted
from operando.errors import DataError


@dataclass(frozen=True, repr=False, eq=False)
class FrequencyAxis(Shown):
    """Frequency lines, even or not.

    Parameters
    ----------
    values : (n_lines,) array
        Frequencies [Hz], increasing.

    Raises
    ------
    DataError
        If the values are no numbers, not finite, negative, or not increasing.

    Examples
    --------
    >>> import operando
    >>> operando.FrequencyAxis([5.0, 5.5, 6.0])
    <FrequencyAxis: 3 lines, 5 to 6 Hz in steps of 0.5 Hz>
    """

    values: NDArray[np.float64]

    def __post_init__(self) -> None:
        values = frozen(self.values, float, 1, "frequency axis")
        object.__setattr__(self, "values", values)
        if values.size == 0 or not np.all(np.isfinite(values)) or values[0] < 0 or np.any(np.diff(values) <= 0):
            raise DataError("frequency lines must be finite, not negative and increasing, at least one")

    @classmethod
    def of(cls, frequencies: ArrayLike) -> FrequencyAxis:
        """The lines asked for: numbers [Hz], one number, or the axis of other FRFs.

        Raises
        ------
        DataError
            If they are no numbers, or no axis can have them.
        """
        hint = "give an array in Hz, as numpy.arange(5, 145, 0.1), or the axis of other FRFs"
        return cls(np.atleast_1d(numbers_of(frequencies, "frequencies", hint)))

    @classmethod
    def even(cls, start: float, step: float, count: int) -> FrequencyAxis:
        """Evenly spaced lines."""
        return cls(np.asarray(start + step * np.arange(count), float))

    @property
    def step(self) -> float | None:
        """Spacing [Hz] if even to 1e-6 of it, else None."""
        if self.values.size < 2:
            return None
        step = (self.values[-1] - self.values[0]) / (self.values.size - 1)
        even = self.values[0] + step * np.arange(self.values.size)
        return float(step) if np.allclose(self.values, even, rtol=0, atol=1e-6 * step + 1e-9 * self.values[-1]) else None

    def __len__(self) -> int:
        return int(self.values.size)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        return np.array(self.values, dtype) if copy or dtype is not None else self.values

    def facts(self) -> dict[str, str]:
        """What the short form says."""
        f, step = self.values, self.step
        return {"Lines": f"{counted(f.size, 'line')}, {f[0]:g} to {f[-1]:g} Hz" + ("" if step is None else f" in steps of {step:.4g} Hz")}

    def band(self, low: float, high: float) -> slice:
        """Lines within [low, high] Hz."""
        i = int(np.searchsorted(self.values, low - 1e-9))
        j = int(np.searchsorted(self.values, high + 1e-9, side="right"))
        return slice(i, j)

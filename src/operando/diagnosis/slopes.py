"""Derivatives of the rows of a least-squares problem, some responses at a time, and the sums over them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.arrow import Factor, Information

Array = NDArray[Any]
Block = tuple[slice, Array, Array]

AT_ONCE = 1 << 21
"""Values at a time of derivatives and of products that they are made of: so few megabytes of memory are used again and again."""

KEPT = 1 << 28
"""Values of derivatives that are kept, 2 GB; more are made again each time they are asked for, which takes three times as long."""


def in_blocks(count: int, each: int) -> list[slice]:
    """So many responses, each with so many values, in blocks of about ``AT_ONCE`` values."""
    step = max(1, AT_ONCE // max(each, 1))
    return [slice(start, min(start + step, count)) for start in range(0, count, step)]


class Slopes:
    """Derivatives of rows by unknowns that all responses share, (responses, rows, n), and by each response's own, (responses, rows, k).

    ``make`` gives blocks of all responses in their order: which they are, and both kinds of derivatives; ``values`` is how many numbers all
    blocks have together.
    """

    def __init__(self, make: Callable[[], Iterable[Block]], values: int = 0) -> None:
        self.made, self._values = make, values  # made: for one use, nothing is kept
        self._kept: list[Block] | None = None

    def __iter__(self) -> Iterator[Block]:
        if self._kept is None and self._values <= KEPT:
            self._kept = list(self.made())
        return iter(self.made() if self._kept is None else self._kept)

    def whole(self) -> tuple[Array, Array]:
        """Both for all responses."""
        shared, own = zip(*((shared, own) for _, shared, own in self), strict=True)
        return np.concatenate(shared), np.concatenate(own)

    def information(self, weights: Array | None = None) -> Information:
        """JᵀWJ with weights (responses, rows) of the squares."""
        total: Array | float = 0.0
        parts = []
        for at, shared, own in self:
            root = 1.0 if weights is None else np.sqrt(weights[at])[..., None]
            part = Information.of(shared * root, own * root)
            total = total + part.shared
            parts.append((part.across, part.own))
        across, each = zip(*parts, strict=True)
        return Information(np.asarray(total), np.concatenate(across), np.concatenate(each))

    def along(self, weighted: Callable[[slice], Array], some: slice = slice(None)) -> tuple[Array, Array]:
        """Jᵀ of weighted rows (responses, rows, m), zero but for some, given by responses: (n, m) and (responses, k, m)."""
        total: Array | float = 0.0
        each = []
        for at, shared, own in self:
            right = weighted(at)
            total = total + np.tensordot(shared[:, some], right, ((0, 1), (0, 1)))
            each.append(np.swapaxes(own[:, some], 1, 2) @ right)
        return np.asarray(total), np.concatenate(each)

    def moved(self, by_shared: Array, by_own: Array) -> Array:
        """J of a step (n,) and (responses, k): (responses, rows)."""
        return np.concatenate([shared @ by_shared + (own @ by_own[at, :, None])[..., 0] for at, shared, own in self])

    def variance(self, factor: Factor, some: Array | slice) -> Array:
        """Posterior variance of some rows, (responses, rows)."""
        return np.concatenate([factor.of_rows(shared[:, some], own[:, some], at) for at, shared, own in self])

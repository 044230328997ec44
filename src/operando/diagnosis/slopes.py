"""Derivatives of the rows of a least-squares problem, some responses at a time, and the sums over them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.arrow import Factor, Information
from operando.threads import each

Array = NDArray[Any]
Block = tuple[slice, Array, Array]
Result = TypeVar("Result")

AT_ONCE = 1 << 21
"""Values at a time of derivatives and of products that they are made of: so few megabytes of memory are used again and again."""

KEPT = 1 << 28
"""Values of derivatives that are kept, 2 GB; more are made again each time they are asked for, which takes three times as long."""


def in_blocks(count: int, each: int) -> list[slice]:
    """So many responses, each with so many values, in alike blocks of ``AT_ONCE`` values at most: an even number, for two threads."""
    blocks = -(-count // max(1, AT_ONCE // max(each, 1)))
    blocks = min(blocks + (blocks > 1) * blocks % 2, count)
    return [slice(count * n // blocks, count * (n + 1) // blocks) for n in range(blocks)]


class Slopes:
    """Derivatives of rows by unknowns that all responses share, (responses, rows, n), and by each response's own, (responses, rows, k).

    ``make`` gives both kinds of derivatives of a block of responses; ``blocks`` are all of them in their order, and ``values`` is how many
    numbers they have together.
    """

    def __init__(self, make: Callable[[slice], tuple[Array, Array]], blocks: Sequence[slice] = (slice(None),), values: int = 0) -> None:
        self.make, self.blocks, self._values = make, blocks, values
        self._kept: dict[int, Block] = {}

    def of_each(self, function: Callable[[slice, Array, Array], Result], keep: bool = True) -> list[Result]:
        """What a function makes of each block, in threads; of derivatives for one use nothing is kept."""
        keep = keep and self._values <= KEPT

        def of(number: int) -> Result:
            if number in self._kept:
                return function(*self._kept[number])
            made = (self.blocks[number], *self.make(self.blocks[number]))
            if keep:
                self._kept[number] = made
            return function(*made)

        return each(of, range(len(self.blocks)))

    def whole(self) -> tuple[Array, Array]:
        """Both for all responses."""
        shared, own = zip(*self.of_each(lambda _, shared, own: (shared, own)), strict=True)
        return np.concatenate(shared), np.concatenate(own)

    def information(self, weights: Array | None = None) -> Information:
        """JᵀWJ with weights (responses, rows) of the squares."""

        def of(at: slice, shared: Array, own: Array) -> Information:
            root = 1.0 if weights is None else np.sqrt(weights[at])[..., None]
            return Information.of(shared * root, own * root)

        parts = self.of_each(of)
        across, own = (np.concatenate(v) for v in ([p.across for p in parts], [p.own for p in parts]))
        return Information(np.asarray(sum(p.shared for p in parts)), across, own)

    def along(self, weighted: Callable[[slice], Array], some: slice = slice(None)) -> tuple[Array, Array]:
        """Jᵀ of weighted rows (responses, rows, m), zero but for some, given by responses: (n, m) and (responses, k, m)."""

        def of(at: slice, shared: Array, own: Array) -> tuple[Array, Array]:
            right = weighted(at)
            return np.tensordot(shared[:, some], right, ((0, 1), (0, 1))), np.swapaxes(own[:, some], 1, 2) @ right

        by_shared, by_own = zip(*self.of_each(of), strict=True)
        return np.asarray(sum(by_shared)), np.concatenate(by_own)

    def moved(self, by_shared: Array, by_own: Array) -> Array:
        """J of a step (n,) and (responses, k): (responses, rows)."""
        return np.concatenate(self.of_each(lambda at, shared, own: shared @ by_shared + (own @ by_own[at, :, None])[..., 0]))

    def variance(self, factor: Factor, some: Array | slice) -> Array:
        """Posterior variance of some rows, (responses, rows)."""
        return np.concatenate(self.of_each(lambda at, shared, own: factor.of_rows(shared[:, some], own[:, some], at)))

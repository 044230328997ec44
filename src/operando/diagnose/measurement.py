"""Which measurement would decide between candidates that the data cannot tell apart."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from operando.diagnose.refit import Fit

if TYPE_CHECKING:
    from operando.diagnose.problem import Problem, Tried


def propose(problem: Problem, fit: Fit, alternatives: Sequence[Tried], verdict: str) -> str | None:
    """The force position and frequency where the models differ most, or the accepted effect's confirming test."""
    from operando.diagnose.problem import full_receptance
    from operando.diagnose.result import effects_of

    if not alternatives:
        if verdict in ("partial", "unexplained"):
            return "measure the running structure at another level and with the force at another point: does the rest depend on level?"
        return None
    lines = problem.lines
    one = full_receptance(problem.arrays, lines, fit)[0]
    size = np.abs(one)
    texts = []
    for t in alternatives[:2]:
        two = full_receptance(problem.arrays, lines, t.fit)[0]
        loud = size > np.median(size, axis=0, keepdims=True)
        if two.shape != one.shape:  # one of them at a place that the other does not know
            continue
        gap = np.where(loud, np.abs(two - one) / np.maximum(size, 1e-300), 0)
        j = int(np.argmax(np.median(gap, axis=(0, 1))[: problem.lines.responses.max() + 1]))
        line = int(np.argmax(np.median(gap[:, :, j], axis=1)))
        decibel = float(np.max(20 * np.abs(np.log10(np.abs(two[line, :, j]) / np.maximum(size[line, :, j], 1e-300)))))
        other = effects_of(t.fit)[-1]
        texts.append(
            f"to tell it from {other.kind} at {other.place or 'no place'}: excite {problem.idle.dofs[j]} while it runs; "
            f"near {lines.hz[line]:.4g} Hz the two predictions differ by up to {decibel:.2g} dB"
        )
    return "; ".join(texts)

"""What chooses an output-only effect, what judges it, and what it takes to be accepted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from operando.compare.verdict import GOOD
from operando.data import ModalModel
from operando.diagnosis.output_only_fit import FOLDS, Fit, counts, mean_square
from operando.diagnosis.output_only_forward import Action, Basis
from operando.diagnosis.output_only_residuals import Target, compress, model_variance, residuals, target_of, whiteners
from operando.errors import DataError

Real = NDArray[np.float64]

EARN, EARN_MORE = 0.10, 0.40
"""Share of the selection misfit that the first effect, and any further one, must take away. What is left after the first is mostly
the idle model's own error, for which a wrong second effect can stand in."""

DETECT = 12.0
"""Fall of the summed squared residuals of the first half from which the second half is asked. Useless candidates pass now and then; of
those the second half, which shares none of their noise, refuses nearly all."""

CONFIRM = 0.05
"""Share of its misfit that what judges must lose where it is not a record of its own."""

CONFIRM_FALL, CONFIRM_SHARE = 8.0, 0.25
"""Fall of the summed squared residuals of the second half that confirms an effect: at least so much, and at least this share of what the
first half lost (per row). Falls are compared, not misfits: a mode that nothing fits adds the same before and after."""

CONFIRM_PART = 0.12
"""Share of its misfit that the second half must lose too: falls of less, however sure, are what the idle model and the modes have wrong
(7 and 10 % seen with nothing hidden, 14 % and more with something). Of a misfit above ``GOOD`` that share of ``GOOD``: a mode that nothing
fits adds the same before and after. Twice that where the halves have changed places: a second chance."""

WEAK, WEAK_SHARE = 50.0, 2 / 3
"""A fall of the second half below ``WEAK`` shows that something is there, hardly what: candidates with this share of the best one's fall
count as alike."""

ALIKE = 12.0
"""Candidates whose summed squared residuals differ by less are not told apart: odds of 400 to 1 under normal errors."""

RIVAL_SHARE = 0.9
"""Candidates with this share of the best one's fall count as alike where the second half prefers them."""

PARTNER_LOG_HZ, PARTNER_MAC = 0.03, 0.6
"""A mode of half the record stands for one of the whole if it lies no farther from it, with a MAC above this."""


def judge_rows(target: Target) -> NDArray[np.bool_]:
    """Rows that judge: of each mode one of frequency, damping and shape, in turn; fixed by the order of the modes alone.

    With fewer than ``FOLDS`` modes nothing can be spared, and all rows are judged that were fitted.
    """
    out = np.zeros((target.n, target.per_mode), bool)
    if target.n < FOLDS:
        return ~out
    for k in range(target.n):
        piece = k % 3
        out[k, (slice(2, None), slice(0, 1), slice(1, 2))[piece]] = True
    return out


def chance(candidates: int) -> float:
    """Fall of the summed squared residuals that the best of so many useless candidates of one size stays below, but for 1 in 300 times."""
    return 2 * float(np.log(max(candidates, 1))) + 10.0


@dataclass(frozen=True)
class Sets:
    """What chooses, what judges, and all of it, with the rows of each.

    Parameters
    ----------
    choose, judge, whole : Target
    use, held : bool arrays
        Rows of ``choose`` that choose and of ``judge`` that judge.
    apart : bool
        Whether what judges is a record of its own.
    note : str
    part : float
        Share of its misfit that a record of its own must lose.
    """

    choose: Target
    use: NDArray[np.bool_]
    judge: Target
    held: NDArray[np.bool_]
    whole: Target
    apart: bool
    note: str
    part: float = CONFIRM_PART

    def exchanged(self) -> Sets:
        """The half that judged chooses, and the other way round."""
        note = self.note.replace("first half", "SECOND").replace("the second,", "the first,").replace("SECOND", "second half")
        return replace(self, choose=self.judge, use=self.held, judge=self.choose, held=self.use, note=note, part=2 * CONFIRM_PART)

    @property
    def rows(self) -> float:
        """Degrees of freedom of what chooses."""
        return float(counts(self.use).sum())

    @property
    def held_rows(self) -> float:
        """Degrees of freedom of what judges."""
        return float(counts(self.held).sum())

    def misfit(self, basis: Basis, found: Fit) -> float:
        """Of a fit, on what judges."""
        return judged(self.judge, basis, found, self.held)

    def shows(self, before: float, after: float, candidates: int, step: int) -> bool:
        """Whether the fall of the selection misfit is worth asking what judges."""
        least = DETECT if self.apart else chance(candidates)
        return after < (1 - (EARN if step == 1 else EARN_MORE)) * before and (before - after) * self.rows >= least

    def confirms(self, before: float, after: float, gain: float) -> bool:
        """Whether what judges falls too.

        Parameters
        ----------
        before, after : float
            Misfits of what judges.
        gain : float
            Fall of the summed squared residuals of what chooses.
        """
        if not self.apart:
            return after <= (1 - CONFIRM) * before
        if before - after < self.part * min(before, GOOD):
            return False
        return (before - after) * self.held_rows >= max(CONFIRM_FALL, CONFIRM_SHARE * gain * self.held_rows / self.rows)

    def alike(self, before: float, best: Fit, others: Sequence[Fit], judge_before: float, judge: Sequence[float]) -> list[Fit]:
        """Fits the data cannot tell from the best one.

        Those are fits whose summed squared residuals lie within ``ALIKE`` of its, or whose misfit within 2 %; nearly as good ones that
        what judges prefers; and, where what judges fell little, all that did most of what the best did. What judges widens the
        set but never changes who is best.

        Parameters
        ----------
        before : float
            Selection misfit without any of them.
        best : Fit
        others : sequence of Fit
        judge_before : float
            Misfit of what judges without any of them.
        judge : sequence of float
            The same with the best and with each of the others.
        """
        limit = max(ALIKE * max(1.0, best.misfit) / self.rows, 0.02 * best.misfit)
        gain = before - best.misfit
        weak = self.apart and (judge_before - judge[0]) * self.held_rows < WEAK
        out = []
        for other, seen in zip(others, judge[1:], strict=True):
            share = (before - other.misfit) / gain
            preferred = self.apart and seen < judge[0] and share >= RIVAL_SHARE
            if other.misfit - best.misfit < limit or preferred or (weak and share >= WEAK_SHARE):
                out.append(other)
        return out


def sets_of(idle: ModalModel, operating: ModalModel, halves: Sequence[ModalModel]) -> Sets:
    """The halves of the record where both show modes, else the values of the whole in turn."""
    whole = target_of(idle, operating)
    every = lambda t: np.ones((t.n, t.per_mode), bool)  # noqa: E731
    if len(halves) == 2:
        kept = [half.select_modes(partners(half, operating)) for half in halves]
        try:
            first, second = (target_of(idle, half) for half in kept)
        except DataError:
            pass
        else:
            note = "the first half of the record chose the effects, the second, identified apart, judged them, the whole gave the sizes"
            left_out = sum(half.n_modes for half in halves) - sum(half.n_modes for half in kept)
            if left_out:
                note += f"; {left_out} mode{'s' if left_out > 1 else ''} that one half alone showed stayed out"
            return Sets(first, every(first), second, every(second), whole, True, note)
    rows = judge_rows(whole)
    if whole.n < FOLDS:
        few = f"{whole.n} operating modes are too few to set some apart: what judges was fitted"
        return Sets(whole, rows, whole, rows, whole, False, few)
    spared = "one third of the values (of each mode its frequency, damping or shape, in turn) judged and chose nothing"
    return Sets(whole, ~rows, whole, rows, whole, False, spared)


def partners(half: ModalModel, whole: ModalModel) -> NDArray[np.bool_]:
    """Modes of half the record that the whole shows too, one each: the others are spurious, and no effect would explain them.

    Parameters
    ----------
    half, whole : ModalModel
        On the same DOFs.
    """
    if tuple(half.dofs) != tuple(whole.dofs):
        return np.ones(half.n_modes, bool)
    a, b = np.asarray(half.shapes), np.asarray(whole.shapes)
    norms = np.linalg.norm(a, axis=0)[:, None] * np.linalg.norm(b, axis=0)
    mac = np.abs(a.conj().T @ b / np.maximum(norms, 1e-300)) ** 2
    apart = np.abs(np.log(half.frequencies_hz[:, None] / whole.frequencies_hz))
    near = (apart < PARTNER_LOG_HZ) & (mac > PARTNER_MAC)
    one, other = linear_sum_assignment(np.where(near, apart / PARTNER_LOG_HZ + 1 - mac, 1e3))
    out = np.zeros(half.n_modes, bool)
    out[one] = near[one, other]
    return out


def judged(target: Target, basis: Basis, found: Fit, use: NDArray[np.bool_]) -> float:
    """Misfit of a fit, as it is, on modes it may not have seen."""
    near = basis.touched(rows_of(found.actions, basis))
    plain = whiteners(target)
    _, index, scale = residuals(target, found.modes, plain)
    white = whiteners(target, model_variance(near, target, found.modes, index, scale, found.prior.dofs))
    return mean_square(compress(residuals(target, found.modes, white)[0]), use)


def rows_of(actions: Sequence[Action], basis: Basis) -> Real:
    """Coordinates of all actions over the measured DOFs."""
    return np.vstack([np.zeros((0, basis.shapes.shape[0])), *(a.rows for a in actions)])

"""Effects chosen by hand: what they did to the error, and what stands behind it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from operando.data import Short
from operando.errors import IdentificationError
from operando.structure import Model
from operando.structure.effects import Effect

FAILED = 1.5
"""Times the chi-square of the fitted lines without an effect, from which on a refit with it has failed: priors alone make less."""

_LITTLE = 0.1  # an effect that lowers the misfit by less than this part has no support in the data


@dataclass(frozen=True, repr=False, eq=False)
class Applied(Short):
    """A model with effects chosen by hand.

    Parameters
    ----------
    model : Model
        Idle model as the check leaves it, and all effects.
    effects : tuple of Effect
        In the order they were added, refitted together.
    ladder : tuple of dict
        One row a step, as in ``diagnosis.json``.
    words : tuple of str
        What each effect did to the error, and where the data do not support it.
    judged_on : mapping
        State, level and lines of the figures on lines that were never fitted.
    between, discrepancy : tuple of dict and dict, optional
        What differs between the two measurements, and what no parameter explains, as in ``diagnosis.json``; of FRFs alone.
    """

    model: Model
    effects: tuple[Effect, ...]
    ladder: tuple[dict[str, Any], ...]
    words: tuple[str, ...]
    judged_on: Mapping[str, Any] = field(default_factory=dict)
    between: tuple[dict[str, Any], ...] | None = None
    discrepancy: dict[str, Any] | None = None

    def facts(self) -> dict[str, str]:
        """What the short form says; ± is the 95 % interval."""
        errors = [row.get("heldout_error_db") for row in self.ladder]
        known = len(errors) > 1 and errors[0] is not None and errors[-1] is not None
        return {
            "Effects": " + ".join(e.short for e in self.effects) or "no effect",
            "Validation": f"{errors[0]:.2f} dB before, {errors[-1]:.2f} dB after on the hold-out set" if known else "",
        }

    def to_dict(self) -> dict[str, Any]:
        """JSON object: effects, errors by step, words, what the figures on lines never fitted stand on, and what else differs."""
        return {
            "effects": [e.to_dict() for e in self.effects],
            "ladder": [dict(r) for r in self.ladder],
            "words": list(self.words),
            "judged_on": dict(self.judged_on),
            "between": None if self.between is None else [dict(row) for row in self.between],
            "discrepancy": self.discrepancy,
        }


def failed(before: float, after: float) -> bool:
    """Whether a refit with an effect leaves more of the lines it was fitted to than that without it: no optimum does."""
    return after > FAILED * max(before, 1.0)


def refuse_failed(effect: Effect, before: float, after: float) -> None:
    """The refit with an effect must come as near to the fitted lines as that without it."""
    if failed(before, after):
        raise IdentificationError(
            f"the refit failed: with {effect.kind} it leaves a reduced chi-square of {after:.4g} of the lines fitted, "
            f"without it {before:.4g}",
            where=effect.place or None,
            hint="give other start values, or hold them with --fix; nothing was changed",
        )


def words_of(effect: Effect, before: float, after: float, days: bool = False) -> str:
    """What an effect did to the reduced chi-square on validation lines, and where the data do not support it.

    ``days``: both have what differs between the two measurements, which the idle model as it is does not have.
    """
    fall = 1 - after / before
    what = f"{'removed ' if effect.removed else ''}{effect.kind}{f' at {effect.place}' if effect.place else ''}"
    both = ", with what differs between the two measurements," if days else ""
    start = f"{what}: reduced chi-square on validation lines{both} {before:.4g} → {after:.4g}"
    if fall < 0:
        return f"{start}: it makes the prediction worse; nothing in the data speaks for it"
    if fall < _LITTLE:
        return f"{start}: lower by only {100 * fall:.1f} %; the data do not support it"
    if before < 1:
        return f"{start}: lower by {100 * fall:.0f} %, but it was no more than the data allow: nothing was left to explain"
    if fall < 0.5 and after > 1.5:
        return f"{start}: lower by {100 * fall:.0f} %; most of the error remains, so something else is missing"
    return f"{start}: lower by {100 * fall:.{1 if fall < 0.99 else 3}f} %"

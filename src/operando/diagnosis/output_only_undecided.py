"""What operating modes neither show nor exclude: candidates that both halves of a record speak for, too faintly to be accepted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from operando.diagnosis.output_only_fit import Fit, fit
from operando.diagnosis.output_only_forward import Action, Basis
from operando.diagnosis.output_only_sets import Sets, rows_of
from operando.effects import Effect

FAINT = 0.05
"""Share of the misfit of both halves that a candidate must take away, each time from the half it was not fitted to. Two dampers that
change the FRFs by 0.6 dB took away 7 and 11 %; of 24 records with nothing hidden six had one that did as much as 5 to 9 %, so nothing of
this is accepted."""

TRIED, NAMED = 5, 4
"""Candidates of each half that are asked; those that are named."""


@dataclass(frozen=True)
class Undecided:
    """A candidate that is neither shown nor excluded.

    Parameters
    ----------
    found : Fit
        On the half that speaks for it more.
    share : float
        Part of the misfit of both halves that it takes away, each time from the half it was not fitted to.
    """

    found: Fit
    share: float


def undecided(sets: Sets, basis: Basis, bare: Fit, other: Fit, ranked: Sequence[Fit], turned: Sequence[Fit]) -> list[Undecided]:
    """Candidates that lower the misfit of either half when fitted to the other, best first.

    Parameters
    ----------
    sets : Sets
        With halves of a record.
    basis : Basis
    bare, other : Fit
        Without effects, on the half that chooses and on the one that judges.
    ranked, turned : sequences of Fit
        Candidates of the half that chooses, and of the one that judges, best first.
    """
    back = sets.exchanged()
    before = (sets.misfit(basis, bare), back.misfit(basis, other))
    total = before[0] * sets.held_rows + before[1] * sets.rows
    have: list[dict[tuple[str, tuple], Fit]] = [{_key(f.actions[-1]): f for f in fits} for fits in (ranked, turned)]
    keys = list(dict.fromkeys(_key(f.actions[-1]) for fits in (ranked[:TRIED], turned[:TRIED]) for f in fits))
    out = []
    for key in keys:
        seed = have[0].get(key) or have[1][key]
        one = have[0].get(key) or _fitted(sets, basis, seed)
        two = have[1].get(key) or _fitted(back, basis, seed)
        if one is None or two is None or float(one.sizes[-1]) * float(two.sizes[-1]) <= 0:
            continue
        falls = (
            (before[0] - sets.misfit(basis, one)) * sets.held_rows,
            (before[1] - back.misfit(basis, two)) * sets.rows,
        )
        if min(falls) > 0 and sum(falls) >= FAINT * total:
            out.append(Undecided(one if falls[0] >= falls[1] else two, sum(falls) / total))
    return sorted(out, key=lambda u: -u.share)[:NAMED]


def words(candidates: Sequence[Undecided], effects: Sequence[Effect]) -> str:
    """What is said of them."""
    first = f"{effects[0].kind}" + (f" at {effects[0].place}" if effects[0].place else "")
    more = f" and {len(effects) - 1} more" if len(effects) > 1 else ""
    return (
        f"the operating modes do not tell {first}{more} from nothing: fitted to either half of the record it lowers the other's misfit, "
        f"by {100 * candidates[0].share:.0f} % together, too little to be accepted"
    )


def _key(action: Action) -> tuple[str, tuple]:
    return action.kind, tuple(d.unsigned for d in action.effect.location)


def _fitted(sets: Sets, basis: Basis, seed: Fit) -> Fit | None:
    near = basis.touched(rows_of(seed.actions, basis))
    return fit(sets.choose, near, seed.actions, list(seed.sizes), sets.use)

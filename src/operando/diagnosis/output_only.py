"""Diagnosis from output-only data: which effect turns the idle modes into the operating ones."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.compare.verdict import shift_reason, verdict_of
from operando.data import Geometry, ModalModel
from operando.diagnosis.output_only_fit import Fit, counts, fit
from operando.diagnosis.output_only_forward import Action, Basis, action_of
from operando.diagnosis.output_only_idle import settled
from operando.diagnosis.output_only_scan import REFINED, best_of, candidate_effects, refine, scan
from operando.diagnosis.output_only_sets import Sets, judge_rows, rows_of, sets_of
from operando.diagnosis.output_only_undecided import Undecided, undecided, words
from operando.diagnosis.result import Diagnosis, spacing
from operando.dof import Dof
from operando.effects import Effect
from operando.errors import DataError
from operando.structure import Model, joint_covariance

Real = NDArray[np.float64]
Progress = Callable[[str], None]

TRIES = 4
"""Candidates shown to what judges, best first, until it accepts one."""

MOST_EFFECTS = 3
"""Effects looked for one after the other."""


def _far(a: Effect, b: Effect, geometry: Geometry | None) -> bool:
    """Whether another kind, or a place more than one sensor spacing away."""
    if a.kind != b.kind:
        return True
    if {d.unsigned for d in a.location} == {d.unsigned for d in b.location}:
        return False
    if geometry is None:
        return True

    def apart(p: Dof, q: Dof) -> float:
        x, y = geometry.position(p.node), geometry.position(q.node)
        return np.inf if x is None or y is None else float(np.linalg.norm(x - y))

    orders = [b.location, b.location[::-1]] if len(b.location) == 2 else [b.location]
    return min(max(apart(p, q) for p, q in zip(a.location, order, strict=True)) for order in orders) > 1.05 * spacing(geometry)


def _step(step: int, added: Effect | None, f: Fit, judge_misfit: float) -> dict[str, Any]:
    return {
        "step": step,
        "added": None if added is None else added.to_dict(),
        "error_db": None,
        "heldout_error_db": None,
        "misfit": float(f.misfit),
        "heldout_misfit": judge_misfit,
    }


def _propose(best: Effect, other: Effect) -> str:
    here, there = best.place or "the whole structure", other.place or "the whole structure"
    return (
        f"operating modes alone do not tell {best.kind} at {here} from {other.kind} at {there}: measure FRFs in operation with a force at "
        f"{best.place or other.place or 'two points'}; or {best.confirm}"
    )


def diagnose_output_only(
    idle: ModalModel,
    operating: ModalModel,
    *,
    halves: Sequence[ModalModel] | None = None,
    kinds: Iterable[str] | None = None,
    places: Iterable[Any] | None = None,
    geometry: Geometry | None = None,
    band: tuple[float, float] | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Name the effect that turns the idle modes into the operating ones.

    Each kind at each DOF and pair is added to the idle model; poles and complex shapes of the exact state-space
    eigenproblem (residual modes included) are matched to the operating ones, and the size is fitted to ln f, ln ζ and
    shape, each over its standard deviation, while the idle shapes at the effect's DOFs float under their covariance.
    The first half of the record chooses, the second half, identified apart, judges, and the whole gives the sizes. Where nothing is
    confirmed the halves change places; of candidates that the choosing half cannot tell apart both halves name one. Where there are no
    halves, one third of the values judges and chooses nothing.

    Parameters
    ----------
    idle : ModalModel
        Unit modal mass, residual modes and covariance included.
    operating : ModalModel
        Complex shapes of arbitrary scale, with covariance.
    halves : (ModalModel, ModalModel), optional
        Operating modes of the first and of the second half of the record (``operando.oma.fit_halves``). Default: those that
        ``operating.details`` carries, if any.
    kinds : iterable of str, optional
        Kinds to look for.
    places : iterable of DOF labels, optional
        DOFs to look at.
    geometry : Geometry, optional
        Sensor positions, so that neighbouring places do not count as ambiguity.
    band : (float, float), optional
        Use only operating modes in this band [Hz].
    progress : callable, optional
        Takes a text.

    Returns
    -------
    Diagnosis

    Raises
    ------
    DataError
        If the idle model is not scaled, or nothing in common is measured.
    ConfigError
        If no kind asked for can be told from modes.
    """
    from operando.threads import one_blas_thread

    if idle.scaling != "unit_modal_mass":
        raise DataError("the idle shapes have no scale: no effect can be sized", hint="give units to the idle test")
    with one_blas_thread():
        parts = tuple(getattr(operating.details, "halves", ()) if halves is None else halves)
        inside = [model if band is None else _within(model, band) for model in (operating, *parts)]
        return _diagnose(idle, inside[0], inside[1:], kinds, places, geometry, progress)


@dataclass
class _Search:
    """Effects found one after the other: the start and the last fit, the steps, candidates of the first step, and what is alike."""

    first: Fit
    fit: Fit
    ladder: list[dict[str, Any]]
    ranked: list[Fit] = field(default_factory=list)
    rivals: list[tuple[Effect, Effect]] = field(default_factory=list)
    more: str | None = None


def _search(sets: Sets, basis: Basis, bare: Basis, actions: Sequence[Action], progress: Progress | None) -> _Search:
    first = fit(sets.choose, bare, (), (), sets.use)
    if first is None:
        raise DataError("the idle model has no poles")
    out = _Search(first, first, [_step(0, None, first, sets.misfit(basis, first))])
    for step in range(1, MOST_EFFECTS + 1):
        if progress is not None:
            progress(f"looking for effect {step}")
        current = out.fit
        taken = {(a.kind, a.effect.location) for a in current.actions}
        open_actions = [a for a in actions if (a.kind, a.effect.location) not in taken]
        scanned = scan(sets.choose, basis, current.actions, list(current.sizes), open_actions, sets.use, progress)
        fits = refine(sets.choose, basis, current.actions, list(current.sizes), best_of(scanned, REFINED, 3), sets.use)
        if step == 1:
            out.ranked = fits
        judge_before = float(out.ladder[-1]["heldout_misfit"])
        judge = [sets.misfit(basis, f) for f in fits]
        for place, found in enumerate(fits[:TRIES]):
            gain = (current.misfit - found.misfit) * sets.rows
            shown = sets.shows(current.misfit, found.misfit, len(open_actions), step)
            if shown and sets.confirms(judge_before, judge[place], gain):
                break
        else:
            break
        others = fits[:place] + fits[place + 1 :]
        seen = [judge[place], *judge[:place], *judge[place + 1 :]]
        alike = sets.alike(current.misfit, found, others, judge_before, seen)
        found, alike = likeliest(sets, basis, found, alike)
        heldout = sets.misfit(basis, found)
        if not sets.confirms(judge_before, heldout, (current.misfit - found.misfit) * sets.rows):
            break
        added = effects_of(found)[-1]
        out.rivals += [(added, effects_of(f)[-1]) for f in alike]
        out.fit = found
        out.ladder.append(_step(step, added, found, heldout))
    else:
        out.more = f"no search for more than {MOST_EFFECTS} effects is made"
    return out


def likeliest(sets: Sets, basis: Basis, best: Fit, alike: Sequence[Fit]) -> tuple[Fit, list[Fit]]:
    """Of those that the choosing half cannot tell apart, the one that both halves, each fitted, find likeliest; and the others."""
    if not sets.apart or not alike:
        return best, list(alike)
    every = [best, *alike]
    total = []
    for one in every:
        near = basis.touched(rows_of(one.actions, basis))
        other = fit(sets.judge, near, one.actions, list(one.sizes), sets.held)
        total.append(one.misfit * sets.rows + (np.inf if other is None else other.misfit * sets.held_rows))
    k = int(np.argmin(total))
    return every[k], every[:k] + every[k + 1 :]


def _on_the_whole(sets: Sets, basis: Basis, found: Fit, everything: NDArray[np.bool_]) -> Fit:
    """The same effects fitted to the whole record; as they stand where that fails."""
    near = basis.touched(rows_of(found.actions, basis))
    return fit(sets.whole, near, found.actions, list(found.sizes), everything) or found


def _without(sets: Sets, basis: Basis, found: _Search, k: int) -> _Search:
    """The search without one of its effects, the others fitted again step by step."""
    gone = effects_of(found.fit)[k]
    actions, sizes = ([v for i, v in enumerate(values) if i != k] for values in (found.fit.actions, found.fit.sizes))
    rivals = [pair for pair in found.rivals if (pair[0].kind, pair[0].location) != (gone.kind, gone.location)]
    out = _Search(found.first, found.first, found.ladder[:1], found.ranked, rivals, found.more)
    for step in range(1, len(actions) + 1):
        near = basis.touched(rows_of(actions[:step], basis))
        again = fit(sets.choose, near, actions[:step], list(sizes[:step]), sets.use)
        if again is None:
            break
        out.fit = again
        out.ladder.append(_step(step, effects_of(again)[-1], again, sets.misfit(basis, again)))
    return out


def shifted(sets: Sets, basis: Basis, bare: Fit) -> dict[float, float]:
    """Misfit of all values with each operating mode [Hz] moved by its half-power width: the least of up and down."""
    whole, out = sets.whole, {}
    every = np.ones((whole.n, whole.per_mode), bool)
    for k, log_hz in enumerate(whole.log_hz):
        seen = []
        for way in (1, -1):
            moved = np.array(whole.log_hz)
            moved[k] += way * 2 * np.exp(whole.log_zeta[k])
            seen.append(replace(sets, judge=replace(whole, log_hz=moved), held=every).misfit(basis, bare))
        out[float(np.exp(log_hz))] = min(seen)
    return out


def _within(model: ModalModel, band: tuple[float, float]) -> ModalModel:
    return model.select_modes((model.frequencies_hz >= band[0]) & (model.frequencies_hz <= band[1]))


def _diagnose(
    given: ModalModel,
    operating: ModalModel,
    halves: Sequence[ModalModel],
    kinds: object,
    places: object,
    geometry: Geometry | None,
    progress: Progress | None,
) -> Diagnosis:
    idle = settled(given)
    sets, basis = sets_of(idle, operating, halves), Basis.of(idle)
    actions = [action_of(e, idle) for e in candidate_effects(idle, kinds, places)]
    bare = basis.touched(rows_of((), basis))
    found = _search(sets, basis, bare, actions, progress)
    faint: list[Undecided] = []
    if sets.apart and len(found.ladder) == 1:
        # The half that chose may be the poorer one of the two.
        changed = sets.exchanged()
        other = _search(changed, basis, bare, actions, progress)
        if len(other.ladder) > 1:
            found, sets = other, changed
        else:
            faint = undecided(sets, basis, found.first, other.first, found.ranked, other.ranked)
    everything = np.ones((sets.whole.n, sets.whole.per_mode), bool)
    unsupported: list[Effect] = []
    full = _on_the_whole(sets, basis, found.fit, everything)
    while (weak := next((k for k, e in enumerate(effects_of(full)) if not e.supported), None)) is not None:
        unsupported.append(effects_of(full)[weak])
        found = _without(sets, basis, found, weak)
        found.more = f"{unsupported[-1].kind} at {unsupported[-1].place or 'the whole'} is a candidate only: its 95 % interval holds zero"
        full = _on_the_whole(sets, basis, found.fit, everything)
    before = fit(sets.whole, bare, (), (), everything) or found.first
    judge = [float(row["heldout_misfit"]) for row in found.ladder]
    far = any(_far(one, other, geometry) for one, other in found.rivals)
    verdict, reason = verdict_of(judge, unseen=shift_reason(shifted(sets, basis, found.first)), more=found.more, ambiguous=far)
    if verdict not in ("explained", "ambiguous", "partial") and full.actions:
        unsupported += effects_of(full)
        found, full = replace(found, fit=found.first, ladder=found.ladder[:1], rivals=[]), before
    ladder, rivals, effects = found.ladder, found.rivals, tuple(effects_of(full))
    candidates = (*(unsupported_row(e, judge) for e in unsupported), *(_candidate(f, found.first.misfit) for f in found.ranked))
    by_mode = tuple(
        {
            "frequency_hz": float(np.exp(sets.whole.log_hz[k])),
            "misfit": float(np.sum(full.residuals[k] ** 2) / counts(everything)[k]),
            "idle_misfit": float(np.sum(before.residuals[k] ** 2) / counts(everything)[k]),
        }
        for k in range(sets.whole.n)
    )
    others = tuple(effects_of(u.found)[-1] for u in faint) or tuple(other for _, other in rivals)
    proposal = _propose(*rivals[0]) if rivals else None
    if faint:
        proposal = f"measure FRFs in operation with a force at {others[0].place or 'two points'}; or {others[0].confirm}"
    return Diagnosis(
        verdict,
        effects,
        others,
        proposal,
        tuple(ladder),
        candidates,
        {"by_dof": [], "by_band": [], "by_mode": list(by_mode)},
        None,
        ("operating_modes",),
        notes=(sets.note, *([words(faint, others)] if faint else [])),
        idle=given,
        model=_model(idle, basis, full, geometry) if effects else Model(given, (), geometry),
        judged_on={"state": "operating", "measured": sets.note},
        reason=reason,
    )


def effects_of(found: Fit) -> list[Effect]:
    """The fitted actions as effects with values and standard deviations."""
    out = []
    for action, size, std in zip(found.actions, found.sizes, found.std, strict=True):
        effect = action.sized(float(size))
        out.append(effect.with_std({action.name: float(std)}))
    return out


def _model(idle: ModalModel, basis: Basis, found: Fit, geometry: Geometry | None) -> Model:
    """Idle model with the shapes at the effects' places moved, the effects, and the covariance of both."""
    effects = tuple(effects_of(found))
    if idle.covariance is None or not found.covariance.size:
        return Model(idle, effects, geometry)
    n, m = idle.terms.n, len(idle.dofs)
    # The fit left out local modes that the effects do not touch.
    modes = np.flatnonzero(basis.involved(rows_of(found.actions, basis)))
    index = (2 * n + modes[None, :] * m + found.prior.dofs[:, None]).ravel()
    # Values of effects taken away are kept positive.
    senses = np.r_[[e.sign for e in effects], np.ones(found.eta.size)]
    posterior = found.covariance * senses[:, None] * senses
    updated, joint = joint_covariance(idle, index, found.prior.root, posterior)
    shapes = np.array(idle.terms.shapes, float)
    shapes[np.ix_(found.prior.dofs, modes)] += (found.prior.root @ found.eta).reshape(found.prior.dofs.size, modes.size)
    return Model(updated.with_terms(shapes=shapes), effects, geometry, joint)


def _candidate(found: Fit, idle_misfit: float) -> dict[str, Any]:
    fall = 100 * (1 - found.misfit / idle_misfit)
    text = f"misfit of the operating modes {idle_misfit:.4g} → {found.misfit:.4g} ({fall:.1f} % lower), the one size fitted"
    return effects_of(found)[-1].to_dict() | {"selection_misfit": found.misfit, "evidence": text}


__all__ = ["candidate_effects", "diagnose_output_only", "judge_rows"]


def unsupported_row(effect: Effect, judge: Sequence[float]) -> dict[str, Any]:
    """An entry of ``candidates`` for what was found and is not supported."""
    evidence = (
        f"found, but not supported: reduced chi-square on the validation lines {judge[0]:.4g} → {judge[-1]:.4g} with all that was found"
    )
    return effect.to_dict() | {"selection_misfit": None, "evidence": evidence}

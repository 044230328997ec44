"""Diagnosis from output-only data: which effect turns the idle modes into the operating ones."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Geometry, ModalModel
from operando.diagnose.diagnosis import Diagnosis
from operando.diagnose.model import Model, joint_covariance
from operando.diagnose.output_only_fit import FOLDS, Fit, counts, fit, mean_square
from operando.diagnose.output_only_forward import LINEAR_KINDS, Action, Basis, action_of, solve
from operando.diagnose.output_only_idle import settled
from operando.diagnose.output_only_residuals import Target, compress, model_variance, residuals, target_of, whiteners
from operando.diagnose.verdict import spacing, verdict_of
from operando.dof import Dof, parse_dofs
from operando.effects import Effect, kind_of
from operando.errors import ConfigError, DataError

Real = NDArray[np.float64]
Progress = Callable[[str], None]

EARN = 0.10
"""Share of the selection misfit an effect must take away to be accepted."""

CONFIRM = 0.05
"""Share of its misfit that what judges must lose too, or the effect is not accepted: the judge ranks nothing, but it may refuse."""

ENOUGH = 1.0
"""Misfit of what chooses, or of what judges, at which nothing is left for a further effect."""

GRID = (0.003, 0.03, 0.2, 1.0)
"""Sizes tried first, as the change of the most affected mode's modal mass, stiffness or damping over its own."""

POLISHED = 40
"""Places whose size is polished after the coarse grid."""

REFINED = 12
"""Places refined with floating shapes, after the scan."""

ALIKE = 12.0
"""Candidates whose summed squared residuals differ by less are not told apart: odds of 400 to 1 under normal errors."""

MOST_EFFECTS = 3
"""Effects looked for one after the other."""


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


def candidate_effects(idle: ModalModel, kinds: object = None, places: object = None) -> list[Effect]:
    """All kinds at all single DOFs and pairs.

    Parameters
    ----------
    idle : ModalModel
    kinds : iterable of str, optional
        Default: ``LINEAR_KINDS``; other kinds of the catalogue are left out.
    places : iterable of DOF labels, optional
        DOFs looked at, alone and in pairs. Default: all of the idle model.

    Raises
    ------
    ConfigError
        If none of the kinds can be told from modes.
    """
    wanted: Sequence[str] = LINEAR_KINDS if kinds is None else [str(k) for k in kinds]  # type: ignore[attr-defined]
    dofs = idle.dofs if places is None else parse_dofs(places)
    out: list[Effect] = []
    for kind in wanted:
        definition = kind_of(kind)
        if kind not in LINEAR_KINDS:
            continue
        if definition.places == 0:
            out.append(Effect(kind))
        elif definition.places == 1:
            # A mass acts on all directions of its node: one DOF stands for them.
            seen: set[int] = set()
            for dof in dofs:
                if definition.coordinates == "node":
                    if dof.node in seen:
                        continue
                    seen.add(dof.node)
                out.append(Effect(kind, (dof,)))
        else:
            out.extend(Effect(kind, pair) for pair in combinations(dofs, 2) if not pair[0].same_axis(pair[1]))
    if not out:
        raise ConfigError("none of the kinds asked for can be told from operating modes", hint="kinds: " + ", ".join(LINEAR_KINDS))
    return out


def chance(candidates: int) -> float:
    """Fall of the summed squared residuals that the best of so many useless candidates of one size stays below, but for 1 in 300 times."""
    return 2 * float(np.log(max(candidates, 1))) + 10.0


def unit_change(basis: Basis, action: Action, top: float) -> float:
    """Largest relative change of a mode's own mass, stiffness or damping force (over its stiffness) by an effect of unit size."""
    if action.kind in ("global_stiffness", "global_damping"):
        return 1.0
    low = basis.omega < 1.2 * top
    b, w = action.rows @ basis.shapes[:, low], basis.omega[low]
    z = np.abs(action.mass) * w[:, None, None] ** 2 + np.abs(action.damping) * w[:, None, None] + np.abs(action.stiffness)
    own = np.einsum("ir,rij,jr->r", np.abs(b), z, np.abs(b)) / w**2
    return float(own.max()) if own.size and own.max() > 0 else 1.0


def start_sizes(basis: Basis, action: Action, top: float) -> list[float]:
    """Sizes to try first, both senses where they make sense."""
    if action.kind == "global_stiffness":
        return [-0.2, -0.05, 0.05, 0.2]
    if action.kind == "global_damping":
        return [-0.5, 0.5, 2.0]
    unit = unit_change(basis, action, top)
    sizes = [g / unit for g in GRID]
    definition = action.effect.definition
    signed = definition.removable or not definition.symmetric
    return sizes + ([-s for s in sizes[:3]] if definition.removable else [-s for s in sizes] if signed else [])


def _allowed(action: Action, size: float) -> bool:
    definition = action.effect.definition
    if definition.removable or not definition.symmetric:
        return size != 0
    if definition.places == 0:
        p = definition.parameters[0]
        low, high = p.bounds()
        return low <= size <= high
    return size > 0


def scan(
    target: Target,
    basis: Basis,
    accepted: Sequence[Action],
    sizes: Sequence[float],
    actions: Sequence[Action],
    use: NDArray[np.bool_],
    progress: Progress | None = None,
) -> list[tuple[float, Action, float]]:
    """Best size of each candidate on a coarse grid, then refined with the idle shapes held: (misfit, action, size), best first."""
    white = whiteners(target)
    top = float(np.exp(target.log_hz.max())) * 2 * np.pi
    rows = [a.rows for a in accepted]
    coarse: list[tuple[float, Action, float]] = []
    for count, action in enumerate(actions):
        if progress is not None and count % 50 == 0:
            progress(f"candidate {count + 1} of {len(actions)}")
        near = basis.touched(np.vstack([*rows, action.rows]))
        best = (np.inf, action, 0.0)
        for size in start_sizes(basis, action, top):
            modes = solve(near, [*accepted, action], [*sizes, size])
            if modes is None:
                continue
            misfit = mean_square(compress(residuals(target, modes, white)[0]), use)
            if misfit < best[0]:
                best = (misfit, action, size)
        if np.isfinite(best[0]):
            coarse.append(best)
    coarse.sort(key=lambda item: item[0])
    fine = []
    for _, action, size in best_of(coarse, POLISHED, 6):
        near = basis.touched(np.vstack([*rows, action.rows]))
        found = fit(target, near, [*accepted, action], [*sizes, size], use, floating=False, own_variance=False, iterations=6, folds=False)
        if found is not None and _allowed(action, float(found.sizes[-1])):
            fine.append((found.misfit, action, float(found.sizes[-1])))
    return sorted(fine, key=lambda item: item[0])


def best_of(scanned: list[tuple[float, Action, float]], number: int, of_each: int) -> list[tuple[float, Action, float]]:
    """The best of a sorted list, and the best of each kind."""
    out, seen = [], dict.fromkeys(LINEAR_KINDS, 0)
    for rank, item in enumerate(scanned):
        kind = item[1].kind
        if rank < number or seen[kind] < of_each:
            out.append(item)
        seen[kind] += 1
    return out


def refine(
    target: Target,
    basis: Basis,
    accepted: Sequence[Action],
    sizes: Sequence[float],
    short: list[tuple[float, Action, float]],
    use: NDArray[np.bool_],
) -> list[Fit]:
    """Exact fits with floating shapes of all effects, ranked by misfit, moves of the shapes included."""
    out = []
    for _, action, size in short:
        rows = np.vstack([*(a.rows for a in accepted), action.rows])
        found = fit(target, basis.touched(rows), [*accepted, action], [*sizes, size], use)
        if found is not None and all(_allowed(a, float(s)) for a, s in zip(found.actions, found.sizes, strict=True)):
            out.append(found)
    return sorted(out, key=lambda f: f.misfit)


def indistinct(best: Fit, others: Sequence[Fit], rows: float) -> list[Fit]:
    """Fits the rows cannot tell from the best: summed squared residuals within ``ALIKE`` of its, or misfit within 2 %."""
    limit = max(ALIKE * max(1.0, best.misfit) / rows, 0.02 * best.misfit)
    return [other for other in others if other.misfit - best.misfit < limit]


def judged(target: Target, basis: Basis, found: Fit, use: NDArray[np.bool_]) -> float:
    """Misfit of a fit, as it is, on modes it may not have seen."""
    near = basis.touched(_rows(found.actions, basis))
    plain = whiteners(target)
    _, index, scale = residuals(target, found.modes, plain)
    white = whiteners(target, model_variance(near, target, found.modes, index, scale, found.prior.dofs))
    return mean_square(compress(residuals(target, found.modes, white)[0]), use)


def _rows(actions: Sequence[Action], basis: Basis) -> Real:
    return np.vstack([np.zeros((0, basis.shapes.shape[0])), *(a.rows for a in actions)])


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
    The first half of the record chooses, the second half, identified apart, judges, and the whole gives the sizes. Where there are
    no halves, one third of the values judges and chooses nothing.

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
    from threadpoolctl import threadpool_limits

    if idle.scaling != "unit_modal_mass":
        raise DataError("the idle shapes have no scale: no effect can be sized", hint="give units to the idle test")
    with threadpool_limits(1, "blas"):
        parts = tuple(getattr(operating.details, "halves", ()) if halves is None else halves)
        inside = [model if band is None else _within(model, band) for model in (operating, *parts)]
        return _diagnose(idle, inside[0], inside[1:], kinds, places, geometry, progress)


def _within(model: ModalModel, band: tuple[float, float]) -> ModalModel:
    return model.select_modes((model.frequencies_hz >= band[0]) & (model.frequencies_hz <= band[1]))


@dataclass(frozen=True)
class Sets:
    """What chooses, what judges, and all of it, with the rows of each."""

    choose: Target
    use: NDArray[np.bool_]
    judge: Target
    held: NDArray[np.bool_]
    whole: Target
    note: str

    @property
    def rows(self) -> float:
        """Degrees of freedom of what chooses."""
        return float(counts(self.use).sum())

    def misfit(self, basis: Basis, found: Fit) -> float:
        """Of a fit, on what judges."""
        return judged(self.judge, basis, found, self.held)


def sets_of(idle: ModalModel, operating: ModalModel, halves: Sequence[ModalModel]) -> Sets:
    """The halves of the record where both show modes, else the values of the whole in turn."""
    whole = target_of(idle, operating)
    every = lambda t: np.ones((t.n, t.per_mode), bool)  # noqa: E731
    if len(halves) == 2:
        try:
            first, second = (target_of(idle, half) for half in halves)
        except DataError:
            pass
        else:
            note = "the first half of the record chose the effects, the second, identified apart, judged them, the whole gave the sizes"
            return Sets(first, every(first), second, every(second), whole, note)
    rows = judge_rows(whole)
    if whole.n < FOLDS:
        few = f"{whole.n} operating modes are too few to set some apart: what judges was fitted"
        return Sets(whole, rows, whole, rows, whole, few)
    spared = "one third of the values (of each mode its frequency, damping or shape, in turn) judged and chose nothing"
    return Sets(whole, ~rows, whole, rows, whole, spared)


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
    bare = basis.touched(_rows((), basis))
    current = fit(sets.choose, bare, (), (), sets.use)
    if current is None:
        raise DataError("the idle model has no poles")
    first = current
    ladder = [_step(0, None, current, sets.misfit(basis, current))]
    ranked: list[Fit] = []
    rivals: list[tuple[Effect, Effect]] = []
    further = 1.0
    for step in range(1, MOST_EFFECTS + 1):
        if progress is not None:
            progress(f"looking for effect {step}")
        taken = {(a.kind, a.effect.location) for a in current.actions}
        open_actions = [a for a in actions if (a.kind, a.effect.location) not in taken]
        scanned = scan(sets.choose, basis, current.actions, list(current.sizes), open_actions, sets.use, progress)
        fits = refine(sets.choose, basis, current.actions, list(current.sizes), best_of(scanned, REFINED, 2), sets.use)
        if step == 1:
            ranked = fits
        further = fits[0].misfit / current.misfit if fits else 1.0
        gain = (current.misfit - fits[0].misfit) * sets.rows if fits else 0.0
        if further >= 1 - EARN or gain < chance(len(open_actions)):
            break
        confirmed = sets.misfit(basis, fits[0])
        if confirmed > (1 - CONFIRM) * ladder[-1]["heldout_misfit"]:
            break
        current, further = fits[0], 1.0
        added = effects_of(current)[-1]
        rivals += [(added, effects_of(f)[-1]) for f in indistinct(current, fits[1:], sets.rows)]
        ladder.append(_step(step, added, current, confirmed))
        if min(current.misfit, confirmed) < ENOUGH:
            break
    everything = np.ones((sets.whole.n, sets.whole.per_mode), bool)
    near = basis.touched(_rows(current.actions, basis))
    full = fit(sets.whole, near, current.actions, list(current.sizes), everything) or current
    before = fit(sets.whole, bare, (), (), everything) or first
    effects = tuple(effects_of(full))
    far = any(_far(one, other, geometry) for one, other in rivals)
    verdict = verdict_of([float(row["heldout_misfit"]) for row in ladder], bool(effects), far, further)
    candidates = tuple(_candidate(f, first.misfit) for f in ranked)
    by_mode = tuple(
        {
            "frequency_hz": float(np.exp(sets.whole.log_hz[k])),
            "misfit": float(np.sum(full.residuals[k] ** 2) / counts(everything)[k]),
            "idle_misfit": float(np.sum(before.residuals[k] ** 2) / counts(everything)[k]),
        }
        for k in range(sets.whole.n)
    )
    return Diagnosis(
        verdict,
        effects,
        tuple(other for _, other in rivals),
        _propose(*rivals[0]) if rivals else None,
        tuple(ladder),
        candidates,
        {"by_dof": [], "by_band": [], "by_mode": list(by_mode)},
        None,
        ("operating_modes",),
        notes=(sets.note,),
        idle=given,
        model=_model(idle, basis, full, geometry) if effects else Model(given, (), geometry),
    )


def effects_of(found: Fit) -> list[Effect]:
    """The fitted actions as effects with values and standard deviations."""
    out = []
    for action, size, std in zip(found.actions, found.sizes, found.std, strict=True):
        effect = action.sized(float(size))
        out.append(effect.with_std({action.name: float(std)}) if np.isfinite(std) else effect)
    return out


def _model(idle: ModalModel, basis: Basis, found: Fit, geometry: Geometry | None) -> Model:
    """Idle model with the shapes at the effects' places moved, the effects, and the covariance of both."""
    effects = tuple(effects_of(found))
    if idle.covariance is None or not found.covariance.size:
        return Model(idle, effects, geometry)
    n, m = idle.n_modes, len(idle.dofs)
    # The fit left out local modes that the effects do not touch.
    modes = np.flatnonzero(basis.involved(_rows(found.actions, basis)))
    index = (2 * n + modes[None, :] * m + found.prior.dofs[:, None]).ravel()
    # Values of effects taken away are kept positive.
    senses = np.r_[[e.sign for e in effects], np.ones(found.eta.size)]
    posterior = found.covariance * senses[:, None] * senses
    updated, joint = joint_covariance(idle, index, found.prior.root, posterior)
    shapes = np.array(idle.shapes, float)
    shapes[np.ix_(found.prior.dofs, modes)] += (found.prior.root @ found.eta).reshape(found.prior.dofs.size, modes.size)
    return Model(replace(updated, shapes=shapes), effects, geometry, joint)


def _candidate(found: Fit, idle_misfit: float) -> dict[str, Any]:
    fall = 100 * (1 - found.misfit / idle_misfit)
    text = f"misfit of the operating modes {idle_misfit:.4g} → {found.misfit:.4g} ({fall:.1f} % lower), the one size fitted"
    return effects_of(found)[-1].to_dict() | {"selection_misfit": found.misfit, "evidence": text}


__all__ = ["candidate_effects", "diagnose_output_only", "judge_rows"]

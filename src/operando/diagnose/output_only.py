"""Diagnosis from output-only data: which effect turns the idle modes into the operating ones."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Geometry, ModalModel
from operando.diagnose.diagnosis import Diagnosis
from operando.diagnose.model import Model, joint_covariance
from operando.diagnose.output_only_fit import FOLDS, Fit, counts, fit, mean_square
from operando.diagnose.output_only_forward import LINEAR_KINDS, Action, Basis, action_of, solve
from operando.diagnose.output_only_residuals import Target, compress, residuals, target_of, whiteners
from operando.diagnose.verdict import spacing, verdict_of
from operando.dof import Dof, parse_dofs
from operando.effects import Effect, kind_of
from operando.errors import ConfigError, DataError

Real = NDArray[np.float64]
Progress = Callable[[str], None]

EARN = 0.10
"""Share of the selection misfit an effect must take away to be accepted."""

ENOUGH = 1.0
"""Selection misfit at which nothing is left for a further effect."""

GRID = (0.003, 0.03, 0.2, 1.0)
"""Sizes tried first, as the change of the most affected mode's modal mass, stiffness or damping over its own."""

POLISHED = 60
"""Places whose size is polished after the coarse grid."""

REFINED = 20
"""Places refined with floating shapes, after the scan."""

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
    """Exact fits with floating shapes of all effects, ranked by selection misfit."""
    out = []
    for _, action, size in short:
        rows = np.vstack([*(a.rows for a in accepted), action.rows])
        found = fit(target, basis.touched(rows), [*accepted, action], [*sizes, size], use)
        if found is not None and all(_allowed(a, float(s)) for a, s in zip(found.actions, found.sizes, strict=True)):
            out.append(found)
    return sorted(out, key=lambda f: f.selection)


def indistinct(best: Fit, others: Sequence[Fit]) -> list[Fit]:
    """Fits the rows cannot tell from the best: within 2 %, or within 15 % and less than two paired standard errors over modes."""
    out = []
    n = len(best.by_mode)
    for other in others:
        difference = other.by_mode - best.by_mode
        spread = float(np.std(difference, ddof=1) * np.sqrt(n)) if n > 1 else np.inf
        z = float(difference.sum()) / spread if spread > 0 else np.inf
        if other.selection < 1.02 * best.selection or (z < 2 and other.selection < 1.15 * best.selection):
            out.append(other)
    return out


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


def _step(step: int, added: Effect | None, f: Fit, judge: NDArray[np.bool_]) -> dict[str, Any]:
    return {
        "step": step,
        "added": None if added is None else added.to_dict(),
        "error_db": None,
        "heldout_error_db": None,
        "misfit": float(f.misfit),
        "heldout_misfit": mean_square(f.residuals, judge),
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
    One third of the rows judges and chooses nothing.

    Parameters
    ----------
    idle : ModalModel
        Unit modal mass, residual modes and covariance included.
    operating : ModalModel
        Complex shapes of arbitrary scale, with covariance.
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
        if band is not None:
            operating = operating.select_modes((operating.frequencies_hz >= band[0]) & (operating.frequencies_hz <= band[1]))
        return _diagnose(idle, operating, kinds, places, geometry, progress)


def _diagnose(
    idle: ModalModel, operating: ModalModel, kinds: object, places: object, geometry: Geometry | None, progress: Progress | None
) -> Diagnosis:
    target, basis = target_of(idle, operating), Basis.of(idle)
    judge = judge_rows(target)
    use = ~judge if target.n >= FOLDS else judge
    everything = np.ones_like(use)
    actions = [action_of(e, idle) for e in candidate_effects(idle, kinds, places)]
    current = fit(target, basis, (), (), use)
    if current is None:
        raise DataError("the idle model has no poles")
    first = current
    ladder = [_step(0, None, current, judge)]
    ranked: list[Fit] = []
    rivals: list[tuple[Effect, Effect]] = []
    further = 1.0
    for step in range(1, MOST_EFFECTS + 1):
        if progress is not None:
            progress(f"looking for effect {step}")
        taken = {(a.kind, a.effect.location) for a in current.actions}
        open_actions = [a for a in actions if (a.kind, a.effect.location) not in taken]
        scanned = scan(target, basis, current.actions, list(current.sizes), open_actions, use, progress)
        fits = refine(target, basis, current.actions, list(current.sizes), best_of(scanned, REFINED, 2), use)
        if step == 1:
            ranked = fits
        further = fits[0].selection / current.selection if fits else 1.0
        gain = (current.selection - fits[0].selection) * counts(use).sum() if fits else 0.0
        if further >= 1 - EARN or gain < chance(len(open_actions)):
            break
        current, further = fits[0], 1.0
        added = effects_of(current)[-1]
        rivals += [(added, effects_of(f)[-1]) for f in indistinct(current, fits[1:])]
        ladder.append(_step(step, added, current, judge))
        if current.selection < ENOUGH:
            break
    full = current
    if current.actions:
        full = fit(target, basis, current.actions, list(current.sizes), everything) or current
    effects = tuple(effects_of(full))
    far = any(_far(one, other, geometry) for one, other in rivals)
    verdict = verdict_of([float(row["heldout_misfit"]) for row in ladder], bool(effects), far, further)
    candidates = tuple(_candidate(f, first.selection) for f in ranked)
    by_mode = tuple(
        {
            "frequency_hz": float(np.exp(target.log_hz[k])),
            "misfit": float(np.sum(full.residuals[k] ** 2) / counts(everything)[k]),
            "idle_misfit": float(np.sum(first.residuals[k] ** 2) / counts(everything)[k]),
        }
        for k in range(target.n)
    )
    where = {"by_dof": [], "by_band": [], "by_mode": list(by_mode)}
    decide = _propose(*rivals[0]) if rivals else None
    alike = tuple(other for _, other in rivals)
    spared = "one third of the values (of each mode its frequency, damping or shape, in turn) judged and chose nothing"
    few = f"{target.n} operating modes are too few to set some apart: what judges was fitted"
    notes = (spared if target.n >= FOLDS else few,)
    return Diagnosis(
        verdict,
        effects,
        alike,
        decide,
        tuple(ladder),
        candidates,
        where,
        None,
        ("operating_modes",),
        notes=notes,
        idle=idle,
        model=_model(idle, basis, full, geometry),
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
    index = (2 * n + np.arange(n)[None, :] * m + found.prior.dofs[:, None]).ravel()
    # Values of effects taken away are kept positive.
    senses = np.r_[[e.sign for e in effects], np.ones(found.eta.size)]
    posterior = found.covariance * senses[:, None] * senses
    updated, joint = joint_covariance(idle, index, found.prior.root, posterior)
    return Model(replace(updated, shapes=found.prior.shapes(basis, found.eta)), effects, geometry, joint)


def _candidate(found: Fit, idle_selection: float) -> dict[str, Any]:
    fall = 100 * (1 - found.selection / idle_selection)
    text = f"misfit of modes left out {idle_selection:.4g} → {found.selection:.4g} ({fall:.1f} % lower)"
    return effects_of(found)[-1].to_dict() | {"selection_misfit": found.selection, "evidence": text}


__all__ = ["candidate_effects", "diagnose_output_only", "judge_rows"]

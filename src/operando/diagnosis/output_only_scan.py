"""Search of all kinds at all places for what turns the idle modes into the operating ones: a grid of sizes, polish, exact fits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel
from operando.diagnosis.output_only_fit import Fit, Prior, counts, fit, jacobian, mean_square
from operando.diagnosis.output_only_forward import LINEAR_KINDS, Action, Basis, solve
from operando.diagnosis.output_only_residuals import Target, compress, compress_slope, residuals, whiteners
from operando.dof import Node, parse_dofs
from operando.effects import Effect, kind_of
from operando.errors import ConfigError

Progress = Callable[[str], None]

GRID = (0.003, 0.03, 0.2, 1.0)
"""Sizes tried first, as the change of the most affected mode's modal mass, stiffness or damping over its own."""

POLISHED, OF_EACH = 120, 24
"""Candidates whose size is polished after the coarse grid: so many of all, and so many of each kind. Where modes are known well, a size
that is wrong by a factor of two looks worse than none, and the grid ranks the right place among the last. Half as many once an effect is
accepted: what is left is small."""

REMOVED = 4.6
"""Added to the summed squared residuals of an effect taken away (a mass, a spring to ground, …): odds of ten to one that something was
added, which decide between candidates that fit alike."""

REFINED = 20
"""Places refined with floating shapes, after the scan."""


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
            seen: set[Node] = set()
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
    still = Prior(np.zeros(0, int), np.zeros((0, 0)))

    def first_step(near: Basis, action: Action) -> list[float]:
        """Size after one Gauss–Newton step from none: where a small effect lies, and which sense it has."""
        every, start = [*accepted, action], np.r_[np.asarray(sizes, float), 0.0]
        modes = solve(near, every, start, derivatives=True)
        if modes is None:
            return []
        raw, index, _ = residuals(target, modes, white)
        slope = compress_slope(raw)
        j = (jacobian(target, near, every, start, still, modes, index, white) * slope[..., None])[use]
        step = float(-np.linalg.lstsq(j, compress(raw)[use], rcond=1e-10)[0][-1])
        return [size for size in (step, 2 * step) if _allowed(action, size)]

    coarse: list[tuple[float, Action, float]] = []
    for count, action in enumerate(actions):
        if progress is not None and count % 50 == 0:
            progress(f"candidate {count + 1} of {len(actions)}")
        near = basis.touched(np.vstack([*rows, action.rows]))
        best = (np.inf, action, 0.0)
        for size in [*start_sizes(basis, action, top), *first_step(near, action)]:
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
    share = 2 if accepted else 1
    for _, action, size in best_of(coarse, POLISHED // share, OF_EACH // share):
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
    """Exact fits with floating shapes of all effects, ranked by misfit, moves of the shapes (and ``REMOVED``) included."""
    out = []
    for _, action, size in short:
        rows = np.vstack([*(a.rows for a in accepted), action.rows])
        found = fit(target, basis.touched(rows), [*accepted, action], [*sizes, size], use)
        if found is not None and all(_allowed(a, float(s)) for a, s in zip(found.actions, found.sizes, strict=True)):
            if action.effect.definition.removable and found.sizes[-1] < 0:
                found = replace(found, misfit=found.misfit + REMOVED / float(counts(use).sum()))
            out.append(found)
    return sorted(out, key=lambda f: f.misfit)

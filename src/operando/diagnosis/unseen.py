"""What acts on a motion that no sensor shows, as one more hypothesis: a mass, spring or damper whose shape values are not known.

A rotation, a direction that no sensor has, or a part without one: over the modes such an effect changes the dynamic stiffness by z(ω) B Bᵀ,
with the law z of its kind and B (modes, motions) of low rank. Three motions are as many as one node has in translation, or in rotation.
More columns than the rank leave fewer local minima (Burer & Monteiro, Math. Program. 95, 2003, 329–357).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from operando.diagnosis.case import COLUMNS, Case
from operando.diagnosis.criteria import EXPLAINED, ROBUST
from operando.diagnosis.idle import Idle
from operando.diagnosis.posterior import State, approach, leaves_noise
from operando.diagnosis.rival import fitted_if_can_be, score, started
from operando.diagnosis.scan import Say
from operando.diagnosis.terms import Term, added
from operando.dof import Dof, split_node
from operando.indicators import INTERVAL
from operando.processes import side_by_side
from operando.structure.effects import with_spread

Array = NDArray[Any]

_KINDS = (("point_mass", 1), ("ground_spring", 1), ("ground_damper", 1), ("point_mass", -1), ("ground_spring", -1))
_MOTIONS = 3
_LAWS, _STARTS = 2, 4  # laws followed beyond one motion, and starts of the least squares of each motion
_GAIN = 1e-3  # of the cost, below which a step is the last: a fit with all unknowns follows
_SIZES = np.array([0.03, 0.1, 0.3, 1.0, 3.0])  # of a start, over what stops the motion of its sensor
_COST = 0.5  # of the cost without motions, above which none explains it: 0.04 to 0.31 in 31 of 32 of benchmark ``unseen``, else 0.58
_NEAR = 1.5  # times the least cost, up to which a law and a number of motions are fitted with all unknowns
_TOLD = 3  # modes that are named
_LIKE = 0.5  # part of the motion of a sensor from which it is named as one that moves alike


@dataclass(frozen=True)
class Way:
    """A law (kind, sign) on some motions, ``b`` (modes, motions) for a unit of its size, and the robust cost that it leaves."""

    law: tuple[str, int]
    b: Array
    cost: float


class LowRank:
    """FRFs with z(ω) B Bᵀ added to the dynamic stiffness of the modes, against those measured; nothing else is freed."""

    def __init__(self, case: Case) -> None:
        forward, idle, lines = case.forward, case.forward.idle, case.lines
        at, self.modes, self.band = lines.fit[:: lines.stride], idle.modes, case.band
        self.w = lines.w[at]
        w0 = 2 * np.pi * idle.f[self.modes]
        self.k = 1 / (w0**2 - self.w[:, None] ** 2 + 2j * idle.zeta[self.modes] * w0 * self.w[:, None])
        self.phi = idle.phi[:, self.modes]
        self.seen, self.driven = self.phi[forward.responses] * self.k[:, None], self.phi[forward.references] * self.k[:, None]
        self.left = forward.predict(forward.start, self.w, derivatives=False).h - lines.h[at]
        self.root = 1 / np.sqrt(lines.variance[at] + ROBUST**2 * lines.level[at] ** 2)

    def law(self, kind: str, sign: int) -> Array:
        """z(ω) of a unit of size, (lines,)."""
        return added(Term(kind, (0,), (0.0,), sign), self.w, self.band)[:, 0, 0]

    def _inner(self, z: Array, b: Array) -> tuple[Array, Array, Array]:
        """z (1 + z Bᵀ k B)⁻¹, and what the motions make of responses and references."""
        own = np.swapaxes(b[None] * self.k[:, :, None], 1, 2) @ b
        inner = z[:, None, None] * np.linalg.inv(np.eye(b.shape[1]) + z[:, None, None] * own)
        return inner, self.seen @ b, self.driven @ b

    def error(self, z: Array, b: Array) -> Array:
        """Over the noise, (lines, responses, references)."""
        inner, seen, driven = self._inner(z, b)
        return (self.left - seen @ inner @ np.swapaxes(driven, 1, 2)) * self.root

    def slope(self, z: Array, b: Array) -> Array:
        """Of the error by B, (lines, responses, references, modes × motions)."""
        inner, seen, driven = self._inner(z, b)
        after = inner @ np.swapaxes(self.k[:, :, None] * b, 1, 2)
        seen, driven = self.seen - seen @ after, self.driven - driven @ after
        by_seen, by_driven = seen @ b, driven @ b
        made = seen[:, :, None, :, None] * by_driven[:, None, :, None] + by_seen[:, :, None, None] * driven[:, None, :, :, None]
        return (-z * self.root.T).T[..., None] * made.reshape(*made.shape[:3], -1)

    def cost(self, z: Array, b: Array) -> float:
        cost = float(np.sum(np.log1p(np.abs(self.error(z, b)) ** 2)))
        return cost if np.isfinite(cost) else np.inf

    def solved(self, z: Array, b: Array) -> tuple[float, Array]:
        """The least robust squares near a start: their cost, and where they are."""

        def flat(values: Array, *more: int) -> Array:
            return np.concatenate([values.real.reshape(-1, *more), values.imag.reshape(-1, *more)])

        def error(x: Array) -> Array:
            return flat(self.error(z, x.reshape(b.shape)))

        def slope(x: Array) -> Array:
            return flat(self.slope(z, x.reshape(b.shape)), b.size)

        scale = np.maximum(np.abs(b).ravel(), 0.3 * np.sqrt(np.mean(b**2)))
        end = least_squares(error, b.ravel(), jac=slope, loss="cauchy", max_nfev=40, ftol=_GAIN, x_scale=scale)
        there = end.x.reshape(b.shape)
        return self.cost(z, there), there

    def one_more(self, way: Way) -> Way:
        """With one motion more: from those of sensors, in several sizes."""
        z = self.law(*way.law)
        rows = self.phi[np.unique(np.linspace(0, len(self.phi) - 1, min(COLUMNS, len(self.phi))).round().astype(int))]
        stops = 1 / np.median(np.abs(z[:, None] * (self.k @ (rows**2).T)), axis=0)
        starts = [np.column_stack([way.b, np.sqrt(size * stop) * row]) for row, stop in zip(rows, stops, strict=True) for size in _SIZES]
        costs = np.array([self.cost(z, b) for b in starts])
        near = [starts[i] for i in np.argsort(costs)[:_STARTS] if np.isfinite(costs[i])]
        cost, b = min((self.solved(z, b) for b in near), key=lambda row: row[0], default=(np.inf, starts[0]))
        return Way(way.law, b, cost)

    def followed(self, way: Way) -> list[Way]:
        """Up to as many motions as there may be, and down again: with more of them there are fewer valleys to be caught in."""
        ways = [way]
        while len(ways) < _MOTIONS:
            ways.append(self.one_more(ways[-1]))
        for less in range(len(ways) - 2, -1, -1):
            left, sizes, _ = np.linalg.svd(ways[less + 1].b, full_matrices=False)
            cost, b = self.solved(self.law(*way.law), left[:, : less + 1] * sizes[: less + 1])
            if cost < ways[less].cost:
                ways[less] = Way(way.law, b, cost)
        return ways


def with_unseen_motion(case: Case, again: Callable[[Idle], Sequence[Case]], floor: float, say: Say = lambda text: None) -> State | None:
    """The best state with one law on motions that no sensor shows; None where none explains the lines.

    In ``case`` nothing was touched. ``again`` gives the same check with another idle model; its last case is the one where nothing was
    touched. ``floor`` is the log evidence of a state that it has to come near to.
    """
    if not case.idle.modes.size:
        return None
    with np.errstate(all="ignore"):
        model = LowRank(case)
        nothing = Way(("", 1), np.zeros((model.modes.size, 0)), float(np.sum(np.log1p(np.abs(model.left * model.root) ** 2))))
        firsts = side_by_side(lambda law: model.one_more(replace(nothing, law=law)), [law for law in _KINDS if law[0] in case.kinds])
        followed = side_by_side(model.followed, sorted(firsts, key=lambda way: way.cost)[:_LAWS])
    best_of = [min(way.cost for way in ways) for ways in followed]
    least = min(best_of, default=np.inf)
    if not least < _COST * nothing.cost:
        return None
    # the best of each law, too: with the idle model as it is one law may be caught in a valley that a fit with all unknowns leaves
    near = [way for ways, its in zip(followed, best_of, strict=True) for way in ways if way.cost < _NEAR * least or way.cost == its]
    best: State | None = None
    for way in sorted((way for way in near if way.cost < _COST * nothing.cost), key=lambda way: way.cost):
        state = _fitted(case, again, way, floor if best is None else max(floor, best.log_evidence))
        best = state if best is None or (state is not None and score(state) > score(best)) else best
    if best is None or best.alpha > EXPLAINED or not leaves_noise(best):
        return None
    say(f"{_what(best)}: {best.log_evidence:.1f}, discrepancy {best.alpha:.4f}")
    return best


def _fitted(case: Case, again: Callable[[Idle], Sequence[Case]], way: Way, floor: float) -> State | None:
    """The fit with all unknowns. Shape values of the motions are about zero, with the rms of the mode over the sensors."""
    known, (kind, sign) = case.uncompressed, way.law
    spread = np.sqrt(np.mean(known.phi**2, axis=0))
    size = float(np.mean(np.sum(way.b**2, axis=1) / spread[known.modes] ** 2))
    wider = again(with_motions(known, way.b.T / np.sqrt(size)))[-1]
    new = range(len(known.dofs), len(wider.dofs))
    terms = tuple(Term(kind, (i,), (float(np.log(size)),), sign, fixed=(0,)) for i in new)
    near = approach(wider, started(wider, terms))[1]  # the idle model is as it was till now, and of modes in band alone
    state = fitted_if_can_be(wider, near, 0.03, floor=floor)
    if state is None:
        return None
    # the fit had them about where it began: what that is worth is taken back
    own = state.x.own[list(new), : wider.forward.n_shape]
    prior = np.sum((_shapes(state) / spread) ** 2) - np.sum(own**2)
    return replace(state, log_evidence=state.log_evidence - 0.5 * float(prior))


def with_motions(idle: Idle, starts: Array) -> Idle:
    """The idle model with DOFs that no sensor shows (``midway``: without a position), at start values of their shapes (motions, modes)."""
    more, spread = len(starts), np.sqrt(np.mean(idle.phi**2, axis=0))
    phi = np.zeros((more, idle.f.size))
    phi[:, idle.modes] = starts
    node = max(split_node(dof.node)[1] for dof in idle.dofs)
    dofs = [Dof(node + 1 + i, "", 1) for i in range(more)]
    return idle.with_dofs(dofs, np.zeros((more, len(idle.dofs))), phi, np.array([np.diag(spread)] * more), [None] * more)


def _shapes(state: State) -> Array:
    """Shape values of the motions, (motions, terms)."""
    forward = state.case.forward
    phi, _ = forward.idle.shape(state.x.g, state.x.own[:, : forward.n_shape])
    return phi[[term.places[0] for term in state.terms]]


def _what(state: State) -> str:
    count, term = len(state.terms), state.terms[0]
    plain = {"point_mass": "a mass", "ground_spring": "a spring", "ground_damper": "a damper"}[term.kind]
    less = " taken away" if term.sign < 0 else ""
    return f"{plain}{less} on {'a motion' if count == 1 else f'{count} motions'} that no sensor shows"


def unseen_share(state: State) -> tuple[Array, Array]:
    """What acts, over what each mode in band has [%], with standard deviations: of its mass, stiffness or damping."""
    idle, term = state.case.forward.idle, state.terms[0]
    modes, moved = idle.modes, state.case.forward.moved(state.x)
    w0, zeta = 2 * np.pi * moved.f[modes], moved.zeta[modes]
    f_root, zeta_root = moved.by_f[modes] / moved.f[modes, None], moved.by_zeta[modes] / zeta[:, None]
    whole, by_g = {
        "point_mass": (np.ones(modes.size), 0 * f_root),
        "ground_spring": (w0**2, 2 * f_root),
        "ground_damper": (2 * zeta * w0, f_root + zeta_root),
    }[term.kind]
    unit = 100 * term.sign * float(np.exp(term.values[0])) / whole
    at = [t.places[0] for t in state.terms]
    shapes = _shapes(state)[:, modes]
    share = unit * np.sum(shapes**2, axis=0)
    # by the unknowns of the idle model, and by the shape values of the motions
    slope = np.concatenate(
        [-share[:, None] * by_g, *(2 * (unit * row)[:, None] * idle.shapes.own[i, modes] for i, row in zip(at, shapes, strict=True))],
        axis=1,
    )
    own = {dof: shared.start + np.arange(state.case.forward.n_shape) for dof, _, shared in state.problem.reaching}
    unknowns = np.concatenate([np.arange(idle.f_root.shape[1]), *(own[i] for i in at)])
    covariance = state.factor.shared_covariance(0)[np.ix_(unknowns, unknowns)]
    return share, np.sqrt(np.einsum("mi,ij,mj->m", slope, covariance, slope))


def unseen_text(state: State) -> str:
    """What acts, and the modes that it changes most."""
    idle = state.case.forward.idle
    share, std = unseen_share(state)
    told = sorted(np.argsort(-np.abs(share))[:_TOLD])
    hz = idle.f[idle.modes]
    parts = [f"{with_spread(float(share[r]), INTERVAL * float(std[r]))} % at {hz[r]:.4g} Hz".replace("-", "−") for r in told]
    whole = {"point_mass": "mass", "ground_spring": "stiffness", "ground_damper": "damping"}[state.terms[0].kind]
    shares = f"of the modal {whole} it is {', '.join(parts)} (± is the 95 % interval)"
    return f"what acts like {_what(state)} explains the FRFs: {shares}{_alike(state)}"


def _alike(state: State) -> str:
    """Sensors that move as the motions do."""
    shapes = _shapes(state)[:, state.case.forward.idle.modes]
    basis = np.linalg.qr(shapes.T)[0]
    phi = state.case.forward.idle.phi[:, state.case.forward.idle.modes]
    sensors = [i for i in range(len(phi)) if i not in state.case.idle.midway]
    part = np.sum((phi[sensors] @ basis) ** 2, axis=1) / np.sum(phi[sensors] ** 2, axis=1)
    order = [i for i in np.argsort(-part)[:2] if part[i] > _LIKE]
    if not order:
        return ""
    names = " and ".join(state.case.place(sensors[i]) for i in order)
    return f"; most like it moves {names}"


UNSEEN = (
    "put sensors where and in the directions in which none stands, rotations as well (two sensors close to each other), first beside those "
    "that move alike; measure idle and in operation: they show what moves there"
)
"""The measurement that would show the motion."""

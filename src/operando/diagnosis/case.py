"""One check of one idle model: its lines, its model of the FRFs, and the priors of the effects that may be missing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Frf
from operando.diagnosis.between import SPREADS, Between
from operando.diagnosis.criteria import CHANGES_DB, FIT_LINES, LEAST_MOVE, REMOVED
from operando.diagnosis.forward import Forward, Scannable
from operando.diagnosis.idle import Idle
from operando.diagnosis.idle_lines import FittedAtRest, IdleLines
from operando.diagnosis.lines import Lines
from operando.diagnosis.products import Rows
from operando.diagnosis.terms import FREE_LAW, SEARCHED, Term, added, candidates, changes_by
from operando.errors import DofError
from operando.structure.effects import kind_of

Array = NDArray[Any]
_DECADES = np.linspace(-5, 3, 25)  # of sizes about that which stops a place
_AT_ONCE = 2  # columns of all DOFs at a time
HELD = 1e-7  # standard deviation of a value that no fit moves, on its search scale
COLUMNS = 24
"""Columns that tell the directions of an idle model as all do: of 81 points of a plate as many were kept, the evidence equal to 1e-9."""


@dataclass
class AsItIs:
    """What was looked for about the idle model as it is: the same whatever the spreads.

    ``robust`` are rows of the robust scan, ``grown`` models with a mode more, ``wider`` cases with locations between sensors. ``no_mode``
    are models with a mode that reached no score, and that score; ``no_location`` is the score that no location between sensors reached.
    """

    robust: list[tuple[float, Term, bool]] = field(default_factory=list)
    grown: list[Idle] = field(default_factory=list)
    wider: Sequence[Case] | None = None
    no_mode: list[tuple[Idle, float]] = field(default_factory=list)
    no_location: float = np.inf
    idle_lines: IdleLines | None = None


class Case:
    """What a search works on.

    Parameters
    ----------
    idle : Idle
    frf : Frf
        Of the check; DOFs that the idle model does not have are left out.
    band : (float, float)
        Hz.
    spreads : dict, optional
        Standard deviations of what differs between the days; empty for FRFs of the same day.
    number : int
        Lines to fit.
    kinds : sequence of str
        Kinds of effects looked for.
    places : sequence of int, optional
        DOFs where effects may be; default all.
    correlated : float, optional
        Neighbouring lines over which the noise is alike; default from the check itself.
    between : bool
        Whether lines validate that lie between those that are fitted.
    like : Case, optional
        The same check and model with other spreads: lines, told directions of the model, and sizes of effects are taken over.
    fitted : FittedAtRest, optional
        The fit of the model to the idle FRFs, where what makes modes complex was fitted.

    Raises
    ------
    DofError
        If the check and the idle model have no response or no reference in common.
    """

    lines: Lines
    elsewhere = True
    """Whether places without a sensor, and force laws of no kind, are looked for."""

    fitted: FittedAtRest | None = None
    idle_lines: IdleLines | None = None
    """What the idle FRFs themselves say of the idle model, beside its prior; None where the prior is taken for all that they say."""

    def __init__(
        self,
        idle: Idle,
        frf: Frf,
        band: tuple[float, float],
        spreads: dict[str, float] | None = None,
        number: int = FIT_LINES,
        kinds: Sequence[str] = SEARCHED,
        places: Sequence[int] | None = None,
        correlated: float | None = None,
        between: bool = False,
        like: Case | None = None,
        fitted: FittedAtRest | None = None,
    ) -> None:
        responses = [i for i, d in enumerate(idle.dofs) if any(d.same_axis(o) for o in frf.responses)]
        references = [i for i, d in enumerate(idle.dofs) if any(d.same_axis(o) for o in frf.references)]
        if not responses or not references:
            raise DofError(
                "the check and the idle model have no DOF in common",
                hint="name responses and references of the check as in the measurement at rest",
            )
        self.dofs = idle.dofs
        self.uncompressed = idle
        chosen = frf.select([idle.dofs[i] for i in responses], [idle.dofs[i] for i in references]).to_quantity("receptance")
        modes = idle.modes
        self.lines = Lines(chosen.band(*band), idle.f[modes], idle.zeta[modes], number, correlated, between) if like is None else like.lines
        self.band = self.lines.band
        self._look_for(kinds, places, like)
        self.fitted = fitted if like is None else like.fitted
        driven = np.array(references)
        spreads = SPREADS.copy() if spreads is None else spreads
        self.between = Between(idle, driven, self.band, spreads)
        rough = Forward(idle, self.between, np.array(responses), driven, self.band)
        told = self._compressed(rough) if like is None else like.idle
        self.forward = replace(rough, idle=told)
        self.between.idle = self.forward.idle

    def _look_for(self, kinds: Sequence[str], places: Sequence[int] | None, like: Case | None) -> None:
        """Kinds and places of the effects, and what is known of their sizes."""
        self.kinds = tuple(kinds)
        nodes: dict[Any, list[int]] = {}
        for i, dof in enumerate(self.dofs):
            nodes.setdefault((dof.node, dof.axis.startswith("R")), []).append(i)
        self.nodes = [tuple(v) for v in nodes.values()]
        self.allowed = tuple(range(len(self.dofs))) if places is None else tuple(places)
        self._ranges: dict[tuple[str, tuple[int, ...]], tuple[float, float]] = {} if like is None else like._ranges
        self._priors: dict[tuple[str, tuple[int, ...], int], tuple[Array, Array]] = {}
        self.like = like
        self.at_rest: AsItIs = AsItIs() if like is None else like.at_rest
        self.law_in_vain = np.inf  # log evidence that no smooth force law came near to
        self._base: tuple[Array, Scannable] | None = None
        self._places: Counter[str] = Counter()

    @property
    def idle(self) -> Idle:
        return self.forward.idle

    def exactly(self) -> Case:
        """The same case with the lines of the idle FRFs beside the prior made of them, where these are known and damping ties modes."""
        if self.fitted is None or self.idle_lines is not None or not self.idle.between_root.any():
            return self
        case, idle = copy(self), replace(self.idle, first_order=False, exact=True)  # their rows hold the products of residual terms
        if self.at_rest.idle_lines is None:
            self.at_rest.idle_lines = IdleLines(idle, self.fitted)
        case.idle_lines = self.at_rest.idle_lines
        case.forward = replace(self.forward, idle=idle)
        case.between = copy(self.between)
        case.between.idle, case.forward.between = idle, case.between
        return case

    def widened(self, by: Array) -> Case:
        """The same case with spreads larger by exp(by) of each group of what differs between the days."""
        case = copy(self)
        case.between = self.between.widened(by)
        case.forward = replace(self.forward, between=case.between)
        return case

    def _compressed(self, forward: Forward) -> Idle:
        """Directions of the idle model that the FRFs of all pairs, driven or not, could tell: effects see places that were not driven."""
        idle, lines = forward.idle, self.lines
        at = lines.fit[:: lines.stride]
        w, dofs, g = lines.w[at], len(idle.dofs), idle.f_root.shape[1]
        noise = np.sqrt(np.median(lines.variance[at][:, lines.there], axis=1) * lines.correlated / 2)
        noise = np.maximum(noise, 1e-3 * lines.level[at][:, lines.there].mean(1)) / np.sqrt(lines.stride)
        whole, each = np.zeros((g, g)), np.zeros((dofs, forward.n_shape, forward.n_shape))
        taken = np.unique(np.linspace(0, dofs - 1, min(COLUMNS, dofs)).round().astype(int))
        for columns in np.array_split(taken, -(-taken.size // _AT_ONCE)):
            plain = Between(idle, columns, self.band, {})
            some = Forward(idle, plain, np.arange(dofs), columns, self.band)
            alike = np.broadcast_to(1 / noise[:, None, None], (w.size, dofs, columns.size))
            slopes = some.derived(replace(some.start, terms=idle.lacking_term), w, Rows(weights=alike))[1]
            reaching = some.reaching_dofs(())

            def of(block: slice, shared: Array, own: Array, reaching: Sequence[int] = reaching) -> Array:
                by_g = shared[..., :g].reshape(-1, g)
                # of a driven DOF its shape stands among what reaches all channels; each pair counts once more as its mirror
                each[block] += 2 * np.swapaxes(own, 1, 2) @ own
                for number, dof in enumerate(reaching):
                    if block.start <= dof < block.stop:
                        start = g + number * forward.n_shape
                        far = shared[dof - block.start, :, start : start + forward.n_shape]
                        each[dof] += far.T @ far
                return np.asarray(by_g.T @ by_g)

            whole += sum(slopes.of_each(of, keep=False))
        values, vectors = np.linalg.eigh(whole * dofs / taken.size)
        values_own, vectors_own = np.linalg.eigh(each * dofs / taken.size)
        own = vectors_own * (values_own > LEAST_MOVE)[:, None, :]
        kept = max(1, int((values_own > LEAST_MOVE).sum(axis=1).max()))
        told = values > LEAST_MOVE
        told[-1] = True
        return idle.along(vectors[:, told], own[:, :, own.shape[2] - kept :])

    def place(self, dof: int) -> str:
        """In words."""
        if dof in self.idle.midway:
            position = self.idle.midway[dof]
            if position is None:
                return "a motion that no sensor shows"
            return f"({', '.join(f'{v:.4g}' for v in position)}) m, {str(self.dofs[dof])[-2:]}"
        return str(self.dofs[dof])

    def ends(self, term: Term) -> list[str]:
        """Places of an effect in words; where it acts on the sum of two, the second in the opposite sense."""
        places = [self.place(i) for i in term.places]
        if term.along[1:].sum() > 0:
            places[1] = str(self.dofs[term.places[1]].opposite)
        return places

    # priors of effects

    def candidates(self, terms: Sequence[Term]) -> list[Term]:
        """Kinds at places that are not there yet; channels only where one was measured."""
        measured, driven = set(self.forward.responses.tolist()), set(self.forward.references.tolist())
        out = []
        for term in candidates(self.nodes, terms, self.kinds, self.allowed):
            group, where = term.definition.group, set(term.places)
            unlike = term.definition.acts == "sensor_map" and not where <= measured
            pair_without_sensor = len(where) > 1 and term.definition.coordinates != "node" and where & self.idle.midway.keys()
            if (group == "force" and not where <= driven) or unlike or pair_without_sensor:
                continue
            out.append(term)
        return out

    def base(self) -> tuple[Array, Scannable]:
        """Every second line to fit [rad/s], and the idle model there."""
        if self._base is None:
            w = self.lines.w[self.lines.fit[::2]]
            self._base = w, self.forward.scannable(self.forward.start, w)
        return self._base

    def size_range(self, kind: str, places: tuple[int, ...]) -> tuple[float, float]:
        """Logarithms of sizes that change the FRFs at rest by 0.1 and 10 dB (rms over lines and pairs)."""
        if kind == "global_stiffness":
            return float(np.log(5e-4)), float(np.log(0.2))
        if kind == "missing_mode":
            return float(np.log(self.band[0])), float(np.log(self.band[1]))
        kind = {"tuned_absorber": "point_mass", "sensor_mass": "point_mass"}.get(kind, kind)
        key = kind, tuple(sorted(places))
        if key not in self._ranges:
            w, base = self.base()
            trial = Term(kind, places, (0.0, *self._further(kind)[0]))
            unit = added(trial, w, self.band)
            own = np.mean([np.abs(base.columns[:, i, i]) for i in places], axis=0)
            grid = np.log(1 / np.median(np.abs(unit).max(axis=(1, 2)) * own)) + np.log(10) * _DECADES
            patterns, factors = changes_by(base.columns, base.structure, trial, unit[..., None] * np.exp(grid))
            relative = (patterns / base.structure[..., None]).reshape(w.size, -1, patterns.shape[-1]) @ factors
            relative += 1
            level = np.log(relative.real**2 + relative.imag**2)
            db = 10 / np.log(10) * np.maximum.accumulate(np.sqrt(np.mean(level**2, axis=(0, 1))))
            low, high = (np.interp(np.log(v), np.log(db), grid) for v in (CHANGES_DB[0], min(CHANGES_DB[1], 0.9 * db[-1])))
            self._ranges[key] = float(low), float(max(high, low + 2))
        return self._ranges[key]

    def _further(self, kind: str) -> tuple[list[float], list[float]]:
        """Means and standard deviations of the values after the first, on the search scale."""
        a, b = np.log(self.band)
        if kind == "tuned_absorber":
            return [(a + b) / 2, float(np.log(0.02))], [(b - a) / np.sqrt(12), 1.0]
        if kind == "missing_mode":
            return [float(np.log(0.01))], [1.0]
        if kind == "ground_hysteretic_spring":
            return [float(np.log(0.1))], [1.0]
        if kind == "ground_rubber":
            return [0.25], [0.15]
        others = kind_of(kind).parameters[1:]
        return [p.inward(p.start(self.band)) for p in others], [1.0] * len(others)

    def prior(self, term: Term) -> tuple[Array, Array]:
        """Means and standard deviations of the values; those that are held are known."""
        key = term.kind, term.places, len(term.values)
        if key not in self._priors:
            self._priors[key] = self._prior(term)
        mean, std = (v.copy() for v in self._priors[key])
        for number in term.fixed:
            mean[number], std[number] = term.values[number], HELD
        return mean, std

    def _prior(self, term: Term) -> tuple[Array, Array]:
        if term.kind.endswith("_gain"):
            return np.zeros(1), np.array([0.3])
        if term.kind.endswith("_delay"):
            return np.zeros(1), np.array([0.3 / (2 * np.pi * self.band[1])])
        if term.kind == "global_damping":
            return np.zeros(1), np.array([0.5])
        if not term.definition.parameters or term.definition is FREE_LAW:
            return np.zeros(len(term.values)), np.ones(len(term.values))
        low, high = self.size_range(term.kind, term.places)
        means, stds = self._further(term.kind)
        return np.array([(low + high) / 2, *means]), np.array([(high - low) / 4, *stds])

    def places(self, kind: str) -> int:
        """Number of places where a kind may be."""
        if not self._places:
            self._places.update(t.kind for t in self.candidates(()))  # shared with copies of other spreads
        return self._places[kind]

    def log_place(self, term: Term) -> float:
        """Logarithm of the probability of a kind at a place: both uniform."""
        n = len(self.allowed)
        places = n * (n + 1) // 2 if term.definition is FREE_LAW else self.places(term.kind)
        return float(-np.log(max(places, 1)) - np.log(len(self.kinds)))

    def log_prior(self, term: Term) -> float:
        """Place and kind uniform, sizes log-normal, the opposite of a kind one in seven."""
        return float(self.log_priors([term])[0])

    def log_priors(self, terms: Sequence[Term]) -> Array:
        """The same of some terms of one kind and place."""
        first = terms[0]
        value = np.full(len(terms), self.log_place(first))
        if first.values:
            mean, std = self.prior(first)
            x = np.array([term.values for term in terms])
            value += np.sum(-0.5 * ((x - mean) / std) ** 2 - np.log(std) - 0.5 * np.log(2 * np.pi), axis=1)
            if first.kind in ("gyroscopic", "circulatory", "global_stiffness"):
                value += np.log(0.5)
            elif first.definition.removable:
                value += np.log(np.where([term.sign > 0 for term in terms], 1 - REMOVED, REMOVED))
        return value

"""The idle model with effects added in order: its FRFs by the exact update, with variance, and its poles and shapes."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data import (
    Finding,
    FrequencyAxis,
    Frf,
    Geometry,
    ModalModel,
    Receptances,
    Short,
    counted,
    expect,
    number_of,
    numbers_of,
    quantity_named,
    several,
)
from operando.data.undriven import undriven_variance
from operando.dof import Dof, match_dofs, named_dofs, parse_dofs
from operando.errors import ConfigError, DataError, IdentificationError
from operando.structure.effects import Effect, parse_effect, place_weights
from operando.structure.eigenproblem import running_modes, with_spread
from operando.structure.low_rank import update_variance, woodbury_core
from operando.synthesis import POWER
from operando.threads import one_blas_thread

Array = NDArray[Any]


@dataclass(frozen=True, repr=False, eq=False)
class Model(Short):
    """The idle modal model plus effects in the order they were added.

    Parameters
    ----------
    idle : ModalModel
        Unit modal mass, residual terms included.
    effects : tuple of Effect
    geometry : Geometry, optional
        Sensor positions, for effects at places without a sensor.
    covariance : (p, p) array, optional
        Of all values of the effects, one after the other; or joint with the idle parameters θ = [f (Hz), ζ, shapes mode by mode],
        which then come first. Default: the squares of the values' standard deviations.
    discrepancy : float
        Share of an FRF that no parameter explains, as a diagnosis found it: counts in the variance of FRFs.

    Raises
    ------
    DataError
        If the idle model is not of unit modal mass, or the covariance has another size.
    DofError
        If an effect stands at a DOF that the idle model does not have.

    Examples
    --------
    >>> import numpy as np, operando
    >>> idle = operando.ModalModel([10.0], [0.01], np.array([[1.0]]), "1+Z", scaling="unit_modal_mass")
    >>> model = operando.Model(idle).add("ground_spring@1+Z=stiffness:1000")
    >>> model
    <Model: 1 idle mode at 1 DOF; ground_spring at 1+Z, 1 kN/m>
    >>> float(model.modes().frequencies_hz[0].round(2))
    11.2
    """

    idle: ModalModel
    effects: tuple[Effect, ...] = ()
    geometry: Geometry | None = None
    covariance: NDArray[np.float64] | None = None
    discrepancy: float = 0.0

    def __post_init__(self) -> None:
        expect(self.idle, ModalModel, "effects are added to idle modes", "fit_ema(frf) gives them")
        expect(self.geometry, Geometry | None, "effects stand on a geometry", "read(file).geometry is one")
        hint = 'parse_effect("point_mass@12+Z=mass:0.2") reads one, and Model.add takes the text'
        effects = several(self.effects, Effect, "a model is made of effects", hint)
        object.__setattr__(self, "effects", tuple(effects))
        if self.covariance is not None:
            object.__setattr__(self, "covariance", numbers_of(self.covariance, "covariance", "give that of all values of the effects"))
        share = number_of(self.discrepancy, "discrepancy", "give the share of an FRF that no parameter explains", 0.0)
        object.__setattr__(self, "discrepancy", share)
        super().__post_init__()
        if self.idle.scaling != "unit_modal_mass":
            raise DataError("effects need an idle model of unit modal mass", hint="give the EMA the units, and a response at a force")
        size = sum(len(e.definition.parameters) for e in self.effects)
        allowed = ((size, size), (size + self.idle.n_parameters,) * 2)
        if self.covariance is not None and np.shape(self.covariance) not in allowed:
            raise DataError(f"covariance of the effects has shape {np.shape(self.covariance)}, they have {size} values")
        for e in self.effects:
            if e.definition.places:
                place_weights(e, self.idle, self.geometry)
            if e.kind == "missing_mode" and e.shape is None:
                raise ConfigError("a missing mode needs its shape", hint="let the diagnosis fit it: operando add DIR missing_mode")

    def facts(self) -> dict[str, str]:
        """What the short form says; ± is the 95 % interval."""
        return {
            "Idle": f"{counted(self.idle.n_modes, 'idle mode')} at {counted(len(self.idle.dofs), 'DOF')}",
            "Effects": " + ".join(e.short for e in self.effects) or "no effect",
        }

    # The list of effects.

    def add(self, effect: Effect | str) -> Model:
        """The model with one effect more (an Effect, or text as on the command line)."""
        added = parse_effect(effect, self.idle.band_hz) if isinstance(effect, str) else effect
        expect(added, Effect, "an effect is added", 'write an Effect or a text as "point_mass@3+Z"')
        return replace(self, effects=(*self.effects, added), covariance=None)

    def remove(self, step: int) -> Model:
        """The model without the effect of a step; steps count from 1, step 0 is the idle model.

        Raises
        ------
        ConfigError
            If there is no such step.
        """
        self._check(step)
        return replace(self, effects=self.effects[: step - 1] + self.effects[step:], covariance=None)

    def with_values(self, step: int, **values: float) -> Model:
        """The model with other values of the effect of a step: a state that was not measured.

        The new values count as known; what is not known of the idle model and of the other values stays.

        Raises
        ------
        ConfigError
            If there is no such step or parameter, or a value lies outside its bounds.
        """
        self._check(step)
        effect = self.effects[step - 1]
        names = [p.name for p in effect.definition.parameters]
        for name, value in values.items():
            if name not in names:
                known = ", ".join(names) or "no parameter"
                raise ConfigError(f"{effect.kind} has no parameter {name!r}", hint=f"it has {known}")
            p = effect.definition.parameter(name)
            low, high = 0.0 if p.low is None else p.low, np.inf if p.high is None else p.high
            number = np.asarray(value)
            if number.ndim or number.dtype.kind not in "biuf":
                hint = "give one number" + (f" [{p.unit}]" if p.unit else "")
                raise ConfigError(f"{name} of {effect.kind} is {value!r:.60}", hint=hint)
            if not low <= number <= high:
                raise ConfigError(f"{name} of {effect.kind} cannot be {number:g} {p.unit}", hint=f"it lies between {low:g} and {high:g}")
        covariance = self.covariance
        if covariance is not None:
            first = len(covariance) - sum(len(e.definition.parameters) for e in self.effects[step - 1 :])
            known_now = [first + names.index(name) for name in values]
            covariance = np.array(covariance)
            covariance[known_now] = 0
            covariance[:, known_now] = 0
        return replace(self._moved(step - 1, values), covariance=covariance)

    def structure(self) -> Model:
        """Only the effects on the running structure: faults of sensors and forces left out, as an OFRF wants it."""
        kept = [i for i, e in enumerate(self.effects) if e.definition.group in ("structure", "idle")]
        columns = np.concatenate([[], *(np.arange(a, b) for i, (a, b) in enumerate(self._spans()) if i in kept)]).astype(int)
        covariance = None
        if self.covariance is not None:
            before = len(self.covariance) - sum(len(e.definition.parameters) for e in self.effects)
            columns = np.r_[np.arange(before), before + columns].astype(int)
            covariance = np.asarray(self.covariance)[np.ix_(columns, columns)]
        return replace(self, effects=tuple(self.effects[i] for i in kept), covariance=covariance)

    def _check(self, step: int) -> None:
        if not 1 <= step <= len(self.effects):
            known = f"steps 1 to {len(self.effects)}" if self.effects else "no effect was added"
            raise ConfigError(f"there is no added effect at step {step}", hint=f"{known}; step 0 is the idle model")

    def _spans(self) -> list[tuple[int, int]]:
        ends = np.cumsum([0] + [len(e.definition.parameters) for e in self.effects])
        return [(int(a), int(b)) for a, b in itertools.pairwise(ends)]

    # What it predicts.

    def frf(
        self,
        frequencies: ArrayLike,
        responses: object = None,
        references: object = None,
        quantity: str = "accelerance",
        variance: bool = True,
    ) -> Frf:
        """FRFs as they would be measured, faults of the channels included (leave them out by :meth:`structure`).

        Effects that depend on the level of the force are left out; a finding says so.

        H = H0 − H0_B (I + δZ H0_BB)⁻¹ δZ H0_Bᵀ in receptance (Sherman–Morrison–Woodbury), exact also for skew δZ.

        Parameters
        ----------
        frequencies : array
            Lines [Hz].
        responses, references : DOF labels, optional
            Default: all DOFs of the idle model.
        quantity : {"accelerance", "mobility", "receptance"}
        variance : bool
            Fill the variance of each line, to first order in the idle parameters and the effects' values, where their spread is known, with
            the discrepancy.

        Raises
        ------
        DataError
            If the quantity is unknown.
        DofError
            If a DOF is not in the idle model.
        """
        quantity = quantity_named(quantity, reciprocals=False)
        resp, refs = named_dofs(responses, self.idle.dofs), named_dofs(references, self.idle.dofs)
        axis = FrequencyAxis.of(frequencies)
        with one_blas_thread():
            data = self._receptance(axis.values, resp, refs)
            own = self._variance(axis.values, resp, refs) if variance else None
        power = POWER[quantity]
        if power:
            factor = (2j * np.pi * axis.values) ** power
            data *= factor
            if own is not None:
                own *= np.abs(factor) ** 2
        if own is not None:
            own += (self.discrepancy * np.abs(data)) ** 2
        made = self.idle.provenance.then("Model.frf")
        return Frf(data, axis, resp, refs, quantity, variance=own, si=self.idle.si, findings=self._not_acting(), provenance=made)

    def modes(self, variance: bool = False) -> ModalModel:
        """Poles and complex shapes of the running structure: by :mod:`operando.structure.eigenproblem`.

        Shapes are as the channels show them: scaled, turned, late or swapped where an effect says so.

        Parameters
        ----------
        variance : bool
            Fill ``std`` of frequencies and damping ratios, to first order in the idle parameters and the effects' values.

        Raises
        ------
        IdentificationError
            If the effects' dynamic stiffness is no finite number.
        """
        base = self._base()
        placed = [(e, place_weights(e, base, self.geometry)) for e in self._acting()]
        with one_blas_thread():
            try:
                modes = running_modes(base, placed)
            except np.linalg.LinAlgError as error:
                names = ", ".join(e.short for e, _ in placed)
                text = f"the modes cannot be computed: {error}"
                raise IdentificationError(text, where=names or None, hint="is the dynamic stiffness finite with these values?") from error
            if variance:
                modes = with_spread(modes, base, placed, self._pole_changes(modes))
        shown = self._shown(modes, base)
        return replace(shown, findings=(*shown.findings, *self._not_acting()))

    def _not_acting(self) -> tuple[Finding, ...]:
        """Says which effects depend on the level: FRFs and modes, which know of none, are without them."""
        action = "operando.structure.at_level gives the spring and damper that it is equivalent to at a level"
        return tuple(
            Finding(
                "level_dependent",
                f"left out, for it depends on the level of the force: {e}",
                consequence="the FRFs and modes lack it",
                action=action,
            )
            for e in self.effects
            if e.definition.level_dependent
        )

    def _shown(self, modes: ModalModel, base: ModalModel) -> ModalModel:
        """Shapes through the response channels; a delay acts at each pole."""
        seen = replace(self, effects=tuple(e for e in self.effects if e.definition.group != "force"), covariance=None)
        carried, factor = seen._channels(base.dofs, base.dofs[:1], modes.terms.poles / 2j / np.pi)
        return modes if factor is None else modes.with_terms(shapes=modes.terms.rows(carried) * factor[:, 0])

    def _pole_changes(self, modes: ModalModel) -> Array | None:
        """Changes of the poles [rad/s] by independent directions of the effects' values, one standard deviation each."""
        spread = self._spread()
        if spread is None:
            return None
        slopes = np.zeros((len(spread), modes.terms.n), complex)
        for at, ends, step in self._neighbours(np.sqrt(np.diag(spread))):
            poles = [m.modes().terms.poles for m in ends]
            # So small a change leaves each pole nearest to itself.
            near = [p[np.abs(p[None] - modes.terms.poles[:, None]).argmin(axis=1)] for p in poles]
            slopes[at] = (near[0] - near[1]) / (2 * step)
        size, directions = np.linalg.eigh(spread)
        return np.asarray((directions * np.sqrt(np.maximum(size, 0))).T @ slopes)

    # How.

    def _base(self) -> ModalModel:
        """The idle model under the kinds that change it as a whole."""
        base = self.idle
        # A mode that the idle model lacks is told as it is in operation: it comes last, and no change of the whole moves it.
        for e in sorted(self.effects, key=lambda e: e.definition.acts == "added_mode"):
            if e.definition.acts == "modal_change":
                base = e.definition.modal_change(base, e.values)
            elif e.definition.acts == "added_mode":
                shape = dict(e.shape or {})
                index, signs = match_dofs(parse_dofs(list(shape)), base.dofs)
                vector = np.zeros(len(base.dofs))
                vector[index] = np.array(list(shape.values())) * signs
                base = e.definition.added_mode(base, e.values, vector)
        return base

    def _acting(self) -> list[Effect]:
        return [e for e in self.effects if e.definition.acts == "dynamic_stiffness"]

    def _channels(self, resp: tuple[Dof, ...], refs: tuple[Dof, ...], hz: Array) -> tuple[tuple[Dof, ...], Array | None]:
        """DOF that each response channel truly carries, and the factor of measured over true (o, j, lines)."""
        maps = [e for e in self.effects if e.definition.acts == "sensor_map"]
        if not maps:
            return resp, None
        carried, rows, columns = [], np.ones((len(resp), hz.size), complex), np.ones((len(refs), hz.size), complex)
        for o, asked in enumerate(resp):
            now = asked
            for e in reversed(maps):
                if e.definition.group == "force":
                    continue
                at = [i for i, d in enumerate(e.location) if d.same_axis(now)]
                if not at:
                    continue
                rows[o] *= e.definition.sensor_map(hz, e.values)
                if len(e.location) == 2:
                    other = e.location[1 - at[0]]
                    now = other if now.sign == e.location[at[0]].sign else other.opposite
            carried.append(now)
        for j, asked in enumerate(refs):
            for e in maps:
                if e.definition.group == "force" and e.location[0].same_axis(asked):
                    columns[j] /= e.definition.sensor_map(hz, e.values)
        return tuple(carried), rows[:, None] * columns[None]

    def _receptance(self, hz: Array, resp: tuple[Dof, ...], refs: tuple[Dof, ...]) -> Array:
        base = self._base()
        lines = Receptances(base.terms, hz)
        carried, factor = self._channels(resp, refs, hz)
        h = lines.between(lines.rows(carried), lines.rows(refs))
        acting = self._acting()
        if acting:
            weights, z = self._added(base, acting, hz)
            core, from_o, to_j = self._update(lines, weights, z, carried, refs)
            for a in range(core.shape[0]):
                seen = np.einsum("bl,bjl->jl", core[a], to_j)
                h -= from_o[:, a, None] * seen[None]
        return h if factor is None else np.asarray(h * factor)

    def _added(self, base: ModalModel, acting: list[Effect], hz: Array) -> tuple[Array, Array]:
        """Places (k, n_dofs) and δZ (lines, k, k) of all acting effects."""
        weights = [place_weights(e, base, self.geometry) for e in acting]
        size = sum(w.shape[0] for w in weights)
        z = np.zeros((hz.size, size, size), complex)
        start = 0
        for e, w in zip(acting, weights, strict=True):
            stop = start + w.shape[0]
            z[:, start:stop, start:stop] = e.sign * e.definition.matrix(2j * np.pi * hz, e.values, w.shape[0])
            start = stop
        return np.concatenate(weights), z

    @staticmethod
    def _update(lines: Receptances, weights: Array, z: Array, resp: tuple[Dof, ...], refs: tuple[Dof, ...]) -> tuple[Array, Array, Array]:
        """(I + δZ H_BB)⁻¹ δZ, H0_oB and H0_Bj, lines last."""
        at = lines.placed(weights)
        k = at.shape[0]
        both = lines.between(np.concatenate([lines.rows(resp), lines.rows(refs), at]), at)
        return woodbury_core(z, both[-k:]), both[: len(resp)], both[len(resp) : -k].transpose(1, 0, 2)

    def _variance(self, hz: Array, resp: tuple[Dof, ...], refs: tuple[Dof, ...]) -> Array | None:
        base = self._base()
        spread = self._spread()
        if base.covariance is None and spread is None:
            return None
        out = np.zeros((len(resp), len(refs), hz.size))
        carried, factor = self._channels(resp, refs, hz)
        gradient: Array | None = None if spread is None else self._by_values(hz, resp, refs, np.sqrt(np.diag(spread)))
        cross = self._cross(base)
        if base.covariance is not None:
            acting = self._acting()
            shape = (len(resp), 0, hz.size)
            weights, left, right = np.zeros((0, len(base.dofs))), np.zeros(shape, complex), np.zeros((0, len(refs), hz.size), complex)
            if acting:
                weights, z = self._added(base, acting, hz)
                core, from_o, to_j = self._update(Receptances(base.terms, hz), weights, z, carried, refs)
                left, right = np.einsum("oal,abl->obl", from_o, core), np.einsum("abl,bjl->ajl", core, to_j)
            shared: tuple[Array, Array] | None = None
            if cross is not None and gradient is not None:
                shared = cross, np.asarray(gradient if factor is None else gradient / factor)
            rows, columns = match_dofs(carried, base.dofs), match_dofs(refs, base.dofs)
            out += update_variance(base, hz, rows, columns, weights, left, right, shared)
            out += undriven_variance(base.terms, rows[0], columns[0], np.flatnonzero(weights.any(axis=0)))[..., None]
            if factor is not None:
                out *= np.abs(factor) ** 2
        if spread is not None and gradient is not None:
            out += np.einsum("aojl,ab,bojl->ojl", gradient.conj(), spread, gradient).real
        return np.maximum(out, 0)

    def _spread(self) -> Array | None:
        """Covariance of all values, None where none is known."""
        if self.covariance is not None:
            size = sum(len(e.definition.parameters) for e in self.effects)
            return np.asarray(self.covariance)[len(self.covariance) - size :, len(self.covariance) - size :]
        std = np.array([e.std.get(p.name, 0.0) for e in self.effects for p in e.definition.parameters])
        std = np.where(np.isfinite(std), std, 0.0)  # what the lines do not tell moves no prediction of them
        return np.diag(std**2) if np.any(std > 0) else None

    def _cross(self, base: ModalModel) -> Array | None:
        """Covariance of the base's parameters (rows) and the values, None without one."""
        n = self.idle.n_parameters
        if self.covariance is None or len(self.covariance) < n or not self.effects or base.n_parameters != n:
            return None  # with a mode added the idle parameters no longer stand one to one: counted as independent
        # A kind that changes the whole model scales each idle parameter; so does it with an identity in place of its covariance.
        plain = replace(self, idle=replace(self.idle, covariance=np.eye(n), std=None), covariance=None)
        factors = np.sqrt(np.diag(np.asarray(plain._base().covariance)))
        return np.asarray(factors[:, None] * np.asarray(self.covariance)[:n, n:])

    def _by_values(self, hz: Array, resp: tuple[Dof, ...], refs: tuple[Dof, ...], std: Array) -> Array:
        """∂H/∂value by central differences over a hundredth of each standard deviation (0 where that is 0)."""
        out = np.zeros((std.size, len(resp), len(refs), hz.size), complex)
        for at, (more, less), step in self._neighbours(std):
            out[at] = (more._receptance(hz, resp, refs) - less._receptance(hz, resp, refs)) / (2 * step)
        return out

    def _neighbours(self, std: Array) -> Iterator[tuple[int, tuple[Model, Model], float]]:
        """For each value that has a spread: its number, the models a little above and below, and the step."""
        for number, (start, _) in enumerate(self._spans()):
            e = self.effects[number]
            for i, p in enumerate(e.definition.parameters):
                value = float(e.values[p.name])
                step = 0.01 * min(float(std[start + i]), abs(value) if p.transform == "log" else np.inf)
                if step > 0:
                    more, less = (self._moved(number, {p.name: value + sign * step}) for sign in (1, -1))
                    yield start + i, (more, less), step

    def _moved(self, number: int, values: Mapping[str, float]) -> Model:
        """Other values of one effect, within its bounds or not, for derivatives: without a covariance."""
        changed = self.effects[number].with_values(**values)
        return replace(self, effects=(*self.effects[:number], changed, *self.effects[number + 1 :]), covariance=None)

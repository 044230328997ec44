"""Another day than that of the idle model, from the FRFs of a validation measurement."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import linear_sum_assignment

from operando.data import ModalModel
from operando.diagnosis.between import spreads_of
from operando.diagnosis.by_hand import estimated, fitted_at_once
from operando.diagnosis.corrected import effects_of
from operando.diagnosis.derivatives import Moved
from operando.diagnosis.document import between_rows
from operando.diagnosis.forward import Point
from operando.diagnosis.posterior import State
from operando.diagnosis.records import Day
from operando.results import CheckRun
from operando.structure.effects import Effect
from operando.structure.force_law import LINEAR
from operando.threads import one_blas_thread

Array = NDArray[Any]


def day_of(
    idle: ModalModel, effects: Sequence[Effect], run: CheckRun, progress: Callable[[str], None] | None = None, **options: Any
) -> Day | None:
    """The day of FRFs, beside linear effects fitted with it; None where the FRFs are as probable with nothing touched.

    What differs may be more than days have: the effects known so far need not be all, and the records say whether the day helps.

    ``options`` are of :func:`operando.diagnosis.by_hand.fitted_at_once`.
    """
    with one_blas_thread():
        state = _beside(idle, effects, run, progress, may_strain=True, **options)
        bare = _Bare(state, replace(state.x, u=np.zeros(0), terms=()))
        differs = tuple(between_rows(state))
        return bare.day(idle, spreads_of(options["between"] or {}), differs) if differs else None


def between_beside(
    idle: ModalModel, effects: Sequence[Effect], run: CheckRun, progress: Callable[[str], None] | None = None, **options: Any
) -> tuple[tuple[dict[str, Any], ...], float]:
    """What differs between the measurements, as ``between`` of ``diagnosis.json``, and the share of the FRFs that stays unexplained.

    By FRFs of a run beside linear effects fitted with it; ``options`` as for :func:`day_of`.
    """
    with one_blas_thread():
        state = _beside(idle, effects, run, progress, **options)
        return tuple(between_rows(state)), float(state.alpha)


def _beside(
    idle: ModalModel, effects: Sequence[Effect], run: CheckRun, progress: Callable[[str], None] | None = None, **options: Any
) -> State:
    return estimated(fitted_at_once(idle, effects, run, progress or (lambda text: None), **options))


def usual_day(idle: ModalModel, between: Mapping[str, float]) -> Day:
    """Another day of which no FRFs speak: the idle model as it is, open by what differs between days in laboratories.

    ``between`` is what a test states of that, as for :func:`operando.diagnose`.
    """
    spread = spreads_of(between)
    modes, m = np.arange(idle.frequencies_hz.size), len(idle.dofs)
    shapes, one = np.asarray(idle.terms.shapes, float), np.ones(m)
    seen = np.tile(spread["seen"] * np.sqrt(np.mean(shapes[:, modes] ** 2, axis=0)), (m, 1))
    covariance = _usual(modes.size, spread)
    return Day(
        idle, shapes, seen, modes, covariance, one, spread["sensor"] * one, {}, {}, spread["force"], {}, lambda hz, rows, driven: None
    )


def _usual(n: int, spread: Mapping[str, float]) -> Array:
    """Covariance of ln f, then of ln ζ, of n modes (2n, 2n) as between two days in laboratories."""

    def of_modes(whole: float, each: float) -> Array:
        return whole**2 + each**2 * np.eye(n)

    return block_diag(of_modes(spread["stiffness"] / 2, spread["mode"]), of_modes(spread["damping_whole"], spread["damping"]))


@dataclass(frozen=True)
class _Bare:
    """A state, and its unknowns without effects."""

    state: State
    x: Point

    def day(self, idle: ModalModel, spread: Mapping[str, float], differs: tuple[dict[str, Any], ...]) -> Day | None:
        """The idle model on that day, which ``differs`` by so much; None where it has other terms or DOFs, or residual terms that do not
        vibrate: no day makes those.

        A law is another spring and damper under each force, and the FRFs are fitted with one for all: each record finds the modes again, by
        what days differ in. With what the FRFs alone leave open hysteresis was lost or took what the day was taken to differ in (rotor
        10350, frame 10356).
        """
        forward = self.state.case.forward
        moved, modes = forward.moved(self.x), np.asarray(forward.modes)
        if moved.phi.shape != idle.terms.shapes.shape:
            return None
        between, (std_d, std_own) = forward.between, self.state.std()
        f, zeta, turn = self.uncoupled(moved)
        if np.any(zeta >= 1):
            return None
        shown = np.array(moved.phi, float)
        shown[:, modes] += between.across(between.own_parts(self.x.own[:, forward.n_shape :])["seen"])
        sensor, force = between.own["sensor"], between.shared["force"]
        own_std = std_own[:, forward.n_shape :] * between.own_spread
        seen = between.own["seen"]
        seen_std = own_std[:, seen] if seen.stop > seen.start else np.zeros((len(own_std), modes.size))
        driven = np.array(moved.phi[forward.references])
        driven[:, modes] += between.across(between.shared_parts(self.x.d)["driven"].reshape(-1, modes.size), forward.references)
        shapes = np.array(moved.phi, float)
        for rows in (shapes, shown, driven):
            rows[:, modes] = rows[:, modes] @ turn
        force_std = (std_d * between.shared_spread)[force]
        sensors, forces = self.gains()
        return Day(
            idle.with_terms(frequencies_hz=f, damping_ratios=zeta, shapes=shapes),
            shown,
            between.across_std(seen_std),
            modes,
            _usual(modes.size, spread),
            sensors,
            np.sqrt(np.sum(own_std[:, sensor] ** 2, axis=1)),
            dict(zip(forward.references.tolist(), forces.tolist(), strict=True)),
            dict(zip(forward.references.tolist(), driven, strict=True)),
            float(np.sqrt(np.mean(force_std**2))) if force_std.size else 0.0,
            self.springs(),
            self.accelerance,
            differs,
            float(self.state.alpha),
        )

    def uncoupled(self, moved: Moved) -> tuple[Array, Array, Array]:
        """Frequencies and damping of all terms with the stiffness between modes, and the modes (n, n) with it in terms of those without."""
        forward = self.state.case.forward
        between, modes = forward.between, np.asarray(forward.modes)
        one, two = (np.searchsorted(modes, part) for part in (between.first, between.second))
        stiffness = np.diag((2 * np.pi * moved.f[modes]) ** 2)
        stiffness[one, two] = stiffness[two, one] = between.shared_parts(self.x.d)["stiffness_between"] * between.stiffness_scale
        squares, vectors = np.linalg.eigh(stiffness)
        order = linear_sum_assignment(-(vectors**2))[1]  # each mode where the one was that it comes from
        turn = vectors[:, order] * np.sign(np.diag(vectors[:, order]))
        f, zeta = np.array(moved.f), np.array(moved.zeta)
        f[modes] = np.sqrt(squares[order]) / (2 * np.pi)
        zeta[modes] = (moved.zeta[modes] * moved.f[modes]) @ turn**2 / f[modes]
        return f, zeta, turn

    def springs(self) -> dict[tuple[int, ...], tuple[float, float]]:
        """Standard deviations of spring and damper where both were fitted, by the rows of their location in order."""
        std: dict[tuple[int, ...], dict[str, float]] = {}
        for effect, term in zip(effects_of(self.state), self.state.terms, strict=True):
            if effect.kind in LINEAR and len(effect.std) == 1:
                std.setdefault(tuple(sorted(term.places)), {}).update(effect.std)
        return {place: (found["stiffness"], found["damping"]) for place, found in std.items() if len(found) == 2}

    def gains(self) -> tuple[Array, Array]:
        """Of the sensors at all DOFs, (DOFs,), and of the forces, (references,): what they show over what there is."""
        forward = self.state.case.forward
        sensor = forward.between.own_parts(self.x.own[:, forward.n_shape :])["sensor"][:, 0]
        return np.exp(sensor), np.exp(-forward.between.shared_parts(self.x.d)["force"])

    def accelerance(self, hz: Array, rows: Array, driven: Sequence[int]) -> Array | None:
        """Accelerances (lines, rows, driven) through sensors and forces as they were put back, without their gains."""
        forward = self.state.case.forward
        shown, forced = forward.responses.tolist(), forward.references.tolist()
        if not {*rows.tolist()} <= {*shown} or not {*driven} <= {*forced}:
            return None
        w = 2 * np.pi * hz
        at = np.ix_([shown.index(i) for i in rows.tolist()], [forced.index(j) for j in driven])
        sensors, forces = self.gains()
        h = forward.predict(self.x, w, derivatives=False).h[(slice(None), *at)]
        return np.asarray(-(w[:, None, None] ** 2) * h * forces[at[1][0]] / sensors[rows][:, None])

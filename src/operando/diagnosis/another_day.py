"""Records of another day: the idle model as it is then, and what its sensors show with nothing missing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel, TimeRecord
from operando.diagnosis.by_hand import estimated, fitted_to
from operando.diagnosis.document import between_rows
from operando.diagnosis.posterior import State
from operando.results import CheckRun
from operando.structure.effects import Effect
from operando.threads import one_blas_thread

Array = NDArray[Any]


@dataclass(frozen=True)
class Day:
    """The idle model on the day of a validation measurement: its stiffness and damping, and shapes as its FRFs have them.

    Attributes
    ----------
    idle : ModalModel
    state : State
        Fitted to the FRFs of that day; its effects are left out here.
    """

    idle: ModalModel
    state: State

    @property
    def gains(self) -> tuple[Array, Array]:
        """Of the sensors at all DOFs, (DOFs,), and of the forces, (references,): what they show over what there is."""
        forward, x = self.state.case.forward, self.state.x
        sensor = forward.between.own_parts(x.own[:, forward.n_shape :])["sensor"][:, 0]
        return np.exp(sensor), np.exp(-forward.between.shared_parts(x.d)["force"])

    def corrected(self, record: TimeRecord) -> TimeRecord:
        """A record without the gains of its channels."""
        forward, (sensor, force) = self.state.case.forward, self.gains
        known = {d.key: i for i, d in enumerate(self.state.case.dofs)}
        of_force = {int(j): g for j, g in zip(forward.references, force, strict=True)}
        forces, gains = set(record.force_indices), np.ones(len(record.channels))
        for k, channel in enumerate(record.channels):
            at = None if channel.dof is None else known.get(channel.dof.key)
            if at is not None:
                gains[k] = of_force.get(at, 1.0) if k in forces else sensor[at]
        return replace(record, data=np.asarray(record.data, float) / gains[:, None])

    def seen(self, hz: Array, rows: Array, driven: Sequence[int]) -> Array | None:
        """Accelerances (lines, rows, driven) through sensors and forces as they were put back, without their gains.

        None where no FRF shows one of them.
        """
        forward = self.state.case.forward
        shown, forced = forward.responses.tolist(), forward.references.tolist()
        if not {*rows.tolist()} <= {*shown} or not {*driven} <= {*forced}:
            return None
        bare = replace(self.state.x, u=np.zeros(0), terms=())
        w = 2 * np.pi * hz
        at = np.ix_([shown.index(i) for i in rows.tolist()], [forced.index(j) for j in driven])
        sensor, force = self.gains
        gain = sensor[rows][:, None] / force[at[1][0]]
        h = forward.predict(bare, w, derivatives=False).h[(slice(None), *at)]
        return np.asarray(-(w[:, None, None] ** 2) * h / gain)


def day_of(
    idle: ModalModel, effects: Sequence[Effect], run: CheckRun, progress: Callable[[str], None] | None = None, **options: Any
) -> Day | None:
    """The day of FRFs that linear effects explain as well as they can; None where they are as probable with nothing touched.

    Without effects what is missing strains the day: its priors hold it near, until the effects are known.

    ``options`` are of :func:`operando.diagnosis.by_hand.fitted_to`.
    """
    with one_blas_thread():
        states, _ = fitted_to(idle, effects, run, progress or (lambda text: None), may_strain=not effects, **options)
        state = estimated(states[-1])
        if not between_rows(state):
            return None
        moved = state.case.forward.moved(replace(state.x, u=np.zeros(0), terms=()))
        same = moved.phi.shape == idle.terms.shapes.shape
        return Day(idle.with_terms(frequencies_hz=moved.f, damping_ratios=moved.zeta, shapes=moved.phi), state) if same else None

"""Records of another day: the idle model as it is then, and what its sensors show with nothing missing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel
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

    def seen(self, hz: Array, rows: Array, driven: Sequence[int]) -> Array | None:
        """Accelerances (lines, rows, driven) through sensors and forces as they were put back; None where no FRF shows one of them."""
        forward = self.state.case.forward
        shown, forced = forward.responses.tolist(), forward.references.tolist()
        if not {*rows.tolist()} <= {*shown} or not {*driven} <= {*forced}:
            return None
        bare = replace(self.state.x, u=np.zeros(0), terms=())
        w = 2 * np.pi * hz
        at = np.ix_([shown.index(i) for i in rows.tolist()], [forced.index(j) for j in driven])
        h = forward.predict(bare, w, derivatives=False).h[(slice(None), *at)]
        return np.asarray(-(w[:, None, None] ** 2) * h)


def day_of(
    idle: ModalModel, effects: Sequence[Effect], run: CheckRun, progress: Callable[[str], None] | None = None, **options: Any
) -> Day | None:
    """The day of FRFs that linear effects explain as well as they can; None where they are as probable with nothing touched.

    ``options`` are of :func:`operando.diagnosis.by_hand.fitted_to`.
    """
    with one_blas_thread():
        states, _ = fitted_to(idle, effects, run, progress or (lambda text: None), **options)
        state = estimated(states[-1])
        if not between_rows(state):
            return None
        moved = state.case.forward.moved(replace(state.x, u=np.zeros(0), terms=()))
        same = moved.phi.shape == idle.terms.shapes.shape
        return Day(idle.with_terms(frequencies_hz=moved.f, damping_ratios=moved.zeta, shapes=moved.phi), state) if same else None

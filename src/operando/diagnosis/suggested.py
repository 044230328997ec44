"""What operational modes suggest for a search in FRFs: effects to begin with.

Natural frequencies and damping hold nothing of the driven points. Where a mode is hardly driven at rest and well in operation, no step of
first order from the idle model leads to the FRFs, and what shifted the mode is still told by its shift.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from operando.data import ModalModel
from operando.diagnosis.between import spreads_of
from operando.diagnosis.case import Case
from operando.diagnosis.idle import Idle
from operando.diagnosis.modes_case import TOLD_BY_MODES, ModesCase
from operando.diagnosis.operating_modes import OperatingModes
from operando.diagnosis.posterior import State, approach, unfitted
from operando.diagnosis.rival import fitted_if_can_be, started
from operando.diagnosis.scan import LinearScan, Say
from operando.diagnosis.terms import Term
from operando.errors import DataError
from operando.processes import side_by_side

_COUNT = 3  # effects that are tried
_ROUGH = 0.03  # discrepancy that scan and fits begin with


def suggested_by_modes(
    idle: Idle, operating: ModalModel, band: tuple[float, float], kinds: Sequence[str], places: Sequence[int] | None, say: Say
) -> list[Term]:
    """Effects that would shift the modes as operation does, at first order; the best first.

    The band is in Hz. Kinds that modes do not tell are left out; ``places`` are DOFs where effects may be (default all). ``say`` is told
    why there are none.
    """
    inside = (operating.frequencies_hz >= band[0]) & (operating.frequencies_hz <= band[1])
    asked = [kind for kind in TOLD_BY_MODES if kind in kinds]
    if not inside.any() or not asked:
        return []
    try:
        case = ModesCase(idle, OperatingModes(idle, operating.select_modes(inside), []), band, spreads_of({}), asked, places)
    except DataError as error:  # fewer than two DOFs in common
        say(f"the operational modes suggest no effect: {error.message}")
        return []
    try:
        with np.errstate(all="ignore"):
            found, _ = LinearScan(unfitted(case, case.forward.start, _ROUGH)).run()
    except np.linalg.LinAlgError as error:
        say(f"the operational modes suggest no effect: {error}")
        return []
    return [row.term for row in found[:_COUNT]]


def begun_with(case: Case, terms: Sequence[Term]) -> State | None:
    """The fit of the effect that comes nearest to the FRFs, with all unknowns free and robustly."""
    ways = side_by_side(partial(approach, case), [started(case, (term,)) for term in terms])
    cost, nearest = min(ways, key=lambda way: way[0], default=(np.inf, case.forward.start))
    return fitted_if_can_be(case, nearest, _ROUGH) if np.isfinite(cost) else None

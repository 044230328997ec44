"""Dampers that are no more than what joints lose on another day."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.case import Case
from operando.diagnosis.criteria import UNUSUAL
from operando.diagnosis.terms import Term, added


def no_more_than_days(case: Case, term: Term, d: NDArray[Any] | None = None) -> bool:
    """Whether an effect is what a joint that loses more, or less, on another day is: told as a difference of days, and no effect.

    Where days differ, one joint may lose more than the others, and a normal law of all joints has no place for it: a damper there is
    the more probable the less the others differ. It counts as a difference of days while it changes the damping of no mode, in band or near
    it, by more than four standard deviations of what a joint does, and frequencies by less of theirs, one at most. What couples two
    directions without reciprocity, as a rotor does, is nothing a joint does, and at first order it changes no mode: it is an effect at
    any size. A damper changed a mode of 133 Hz most, 3 Hz above the band, from 0.4 to 2.9 % (frame 10613).

    What days take back of the damping of a mode is no change of it: where a damper is undone mode by mode it stands for damping that
    ties modes to each other, of which days differ by more now and then than a normal law has it.

    Where nothing was touched no effect is one. The effect is taken at first order in what it adds to each mode of the idle model; ``d`` are
    the differences between the days that were found beside it (:class:`~operando.diagnosis.forward.Point`).
    """
    spreads, idle = case.between.spreads, case.idle
    if not (term.structural and term.definition.symmetric and spreads.get("damping_local") and spreads.get("mode")):
        return False
    modes = [r for r in idle.modes if r != idle.lacking]
    w = 2 * np.pi * idle.f[modes]
    phi = idle.phi[np.ix_(list(term.places), modes)]
    with np.errstate(all="ignore"):
        change = np.einsum("ir,rij,jr->r", phi, added(term, w, case.band), phi) / w**2
    damping = change.imag / 2 / idle.zeta[modes]
    if d is not None:
        by_days = case.between.shared_parts(d)["damping"][np.searchsorted(idle.modes, modes)]
        damping += np.sign(damping) * np.clip(np.sign(damping) * by_days, -np.abs(damping), 0)
    by_damping = np.abs(damping).max(initial=0.0) / spreads["damping_local"]
    by_frequency = np.abs(change.real / 2).max(initial=0.0) / spreads["mode"]
    return bool(by_frequency < by_damping <= UNUSUAL and by_frequency <= 1)

"""Why a running structure may not be linear: levels that disagree, and responses that hold what is not proportional to the force."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from operando.data import Frf
from operando.diagnosis.size_by_level import levels_disagree
from operando.dof import Node
from operando.results import CheckRun
from operando.structure.effects import Effect

DISTORTION, LOUDEST = 3.0, 0.75
"""What FRFs leave unexplained in the check may be this many times what they leave at rest, at the quantile of the responses that follows;
over 119 linear cases it was 0.3 to 2.9 times. Responses far from a contact show little of it, so the median says too little. At the
locations of linear effects that were found it was 2.9 times at most in 228 cases; 4.9 where a bilinear stiffness had been taken for a
spring."""

FAINT = 1.5
"""And where they agree, what is not proportional to the force may surely be this many times as much at the higher level as at the lower:
one linear system leaves no more than 1, and noise may grow faster than the force. 0.5 to 1.15 in 159 linear cases; 2.1 to 130 000 in 54
cases with hysteresis, gaps, friction and laws of powers; 0.5 to 1.1 in 17 with what scales with the level, a bilinear stiffness above all,
which is left to ``DISTORTION``."""


def suspicion(check: Sequence[CheckRun], idle_frf: Frf | None = None) -> str | None:
    """Why the running structure may not be linear, or None.

    Runs of different level that disagree carry a finding ``nonlinear``. What the responses of ``idle_frf`` leave unexplained at rest is
    noise; what is beyond it in operation is distortion. A stiffness that changes with the sign of the motion shows only there: it scales
    with the level.
    """
    if levels_disagree(check):
        return "runs of different level disagree"
    loudest = [float(np.quantile(list(times.values()), LOUDEST)) for times in beyond_rest(check, idle_frf) if times]
    return _held("the responses in operation hold", max(loudest, default=0.0))


def suspicion_at(effects: Sequence[Effect], check: Sequence[CheckRun], idle_frf: Frf | None = None) -> str | None:
    """Why linear effects may stand for one that is not linear, or None: by the responses at their own locations.

    A stiffness that changes with the sign of the motion has the FRFs of a spring at every level; what it adds beside is largest at its own
    location.
    """
    here = {dof.key: dof for effect in effects if effect.definition.group not in ("sensor", "force") for dof in effect.location}
    at = [(times, here[key]) for run in beyond_rest(check, idle_frf) for key, times in run.items() if key in here]
    most, dof = max(at, key=lambda row: row[0], default=(0.0, None))
    return _held(f"the response at {dof} holds", most)


def distorted_at_two(check: Sequence[CheckRun], idle_frf: Frf | None) -> bool:
    """Whether more than one response holds so much that is not proportional to the force, or what they hold at rest is not known.

    One alone held up to 4.8 times as much in six of 159 linear cases, two in one (a force that is late); three did with a bilinear
    stiffness that linear effects left unexplained (rotor 10334).
    """
    return any(not run or sorted(run.values())[-2:][0] > DISTORTION for run in beyond_rest(check, idle_frf))


def _held(what: str, times: float) -> str | None:
    if not times > DISTORTION:
        return None
    return f"{what} {times:.3g} times as much as in the idle state that is not proportional to the force"


def beyond_rest(check: Sequence[CheckRun], idle_frf: Frf | None) -> list[dict[tuple[Node, str], float]]:
    """Of each run and response: how many times as much is not proportional to the force as at rest."""
    quiet = {} if idle_frf is None else unexplained(idle_frf)
    return [{dof: value / quiet[dof] for dof, value in unexplained(run.frf).items() if quiet.get(dof, 0) > 0} for run in check]


def unexplained(frf: Frf) -> dict[tuple[Node, str], float]:
    """Share of each response's power that is not proportional to the forces, in the median over lines."""
    if frf.variance is None:
        return {}
    size = np.abs(frf.data) ** 2
    out = {}
    for dof, variance, power in zip(frf.responses, frf.variance, size, strict=True):
        good = np.isfinite(variance) & np.isfinite(power) & (power > 0)
        if good.any():
            out[dof.key] = float(np.median(variance[good] / power[good]) * (frf.averages or 1.0))
    return out

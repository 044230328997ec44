"""The choice ``auto``: which scaling method the evidence speaks for, and the reason in words."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding
from operando.scaling.condensed import CondensedBasis
from operando.scaling.doubt import scale_doubt
from operando.scaling.expansion import expand, orthogonality, participation_spread
from operando.scaling.methods import IN_WORDS, Task, real_shapes

ORTHOGONALITY_RATIO = 1.5
"""Mass counts as changed where the operational modes are this much less orthogonal in the idle mass than in the idle stiffness."""

ORTHOGONALITY_LEAST = 0.008
"""... and the rms off-diagonal is at least this."""

NOISE_SHARE = 0.5
"""... and at least this part of the relative shape noise."""

BOTH_CHANGED = 0.06
"""Rms off-diagonals of mass and stiffness both above this: the span of the idle modes does not hold the operational ones."""

WORTH_TELLING = 2.0
"""Per cent that the scale of the operational shapes is in doubt by, below which a change of mass is not spoken of."""

MASS_SURE = 0.008
"""Rms off-diagonal of the mass beyond what noise explains, from which mass is said to have changed though it is kept for the scale."""


@dataclass(frozen=True)
class Choice:
    """A method, why, and the figures behind it."""

    method: str
    reason: str
    evidence: dict[str, Any]
    findings: tuple[Finding, ...] = ()


def choose_method(
    idle: NDArray[np.float64],
    operating: NDArray[Any],
    task: Task,
    basis: CondensedBasis | None,
    mac_values: NDArray[np.float64],
    available: set[str],
) -> Choice:
    """Choose the scaling method by evidence.

    The expansion uses every idle mode (m, n_idle), residual ones included, and the frequencies, and beats the paper's methods in the median
    and the worst case of random plates (``benchmarks/scaling_rules.py``); what must be decided is what stayed the same, mass or stiffness:
    modes of the running machine are orthogonal in whichever did.
    """
    turned = real_shapes(operating)[0]
    q = expand(idle, turned, task.prior)[0]
    by_mass, by_stiffness = orthogonality(q, task.idle_hz, participation_spread(idle, turned, task.prior))
    noise = float(np.median(np.sqrt(np.trace(task.prior.noise, axis1=1, axis2=2))))
    changed = int(np.sum(~task.keep_msf))
    evidence: dict[str, Any] = {
        "kappa": None if basis is None or not np.isfinite(basis.kappa) else basis.kappa,
        "off_diagonal_mass": by_mass,
        "off_diagonal_stiffness": by_stiffness,
        "shape_noise": noise,
        "changed_modes": changed,
        "smallest_mac": float(np.min(mac_values)) if mac_values.size else None,
    }
    figures = (
        f"in the idle modes the operational ones are off orthogonality by {by_mass:.3f} in mass and {by_stiffness:.3f} in stiffness "
        f"(shape noise {noise:.3f}, {changed} of {mac_values.size} modes changed"
        + (f", κ {basis.kappa:.1f})" if basis is not None else ", no condensed mass)")
    )
    if "expansion" not in available:
        return Choice("msf_all", f"no expansion of the operational shapes was possible: {IN_WORDS['msf_all']}", evidence)
    least = max(ORTHOGONALITY_LEAST, NOISE_SHARE * noise)
    if by_mass > ORTHOGONALITY_RATIO * by_stiffness and by_mass > least and "expansion_stiffness" in available:
        finding = Finding(
            "mass_changed",
            f"the operating mass is not the idle one: {figures}",
            "warning",
            consequence="assumption 3 of the method (same mass) fails; the shapes are scaled by their modal stiffness instead",
            action="check for added or moved masses; diagnose the effect",
        )
        return Choice(
            "expansion_stiffness", f"{figures}: mass changed, stiffness did not; {IN_WORDS['expansion_stiffness']}", evidence, (finding,)
        )
    findings: tuple[Finding, ...] = ()
    doubt = scale_doubt(idle, operating, task, "mass")
    evidence["off_diagonal_mass_beyond_noise"] = doubt.mass
    evidence["off_diagonal_stiffness_beyond_noise"] = doubt.stiffness
    percent = 50 * float(np.sqrt(np.mean(doubt.common**2 + doubt.own**2)))
    both = min(by_mass, by_stiffness) > max(BOTH_CHANGED, 3 * noise)
    if both or (doubt.mass > MASS_SURE and percent > WORTH_TELLING):
        findings = (
            Finding(
                "mass_changed",
                f"mass is not the idle one (nor stiffness), or the idle modes do not span the operational ones: {figures}",
                "warning",
                consequence="assumption 3 of the method (same mass) is in doubt: the operational shapes may be scaled wrongly by "
                f"{percent:.1f} % rms, which the bands include",
                action="weigh what differs in operation; measure at more DOFs, identify idle modes in a wider band; diagnose the effect",
            ),
        )
    return Choice("expansion", f"{figures}: nothing speaks for a changed mass; {IN_WORDS['expansion']}", evidence, findings)

"""What is as at rest, mass or stiffness, is an assumption: how far the shapes contradict it, and what that leaves of their scale.

Operational modes are orthogonal in whichever of mass and stiffness did not change. What they are off orthogonality in the idle mass is the
off-diagonal of the change of mass in these modes; its diagonal, which no orthogonality shows, is the error of their scale.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data.arrays import ByContent
from operando.scaling.expansion import ORTHOGONALITY_NOISE, expand, participation_spread
from operando.scaling.methods import Task, real_shapes

DIAGONAL = 3.0
"""Mean square of a diagonal element over that of an off-diagonal one, for a change at one place: E b⁴ over (E b²)² of normal values."""


@dataclass(frozen=True, eq=False)
class ScaleDoubt(ByContent):
    """Standard deviations (n,) of ln φ̂² of each operational mode from what may have changed.

    ``common`` is common to all modes, with its sign: a change of mass that goes with the change of stiffness the frequencies show; ``own``
    of each mode by itself: a change at a place. ``mass`` and ``stiffness`` are rms off-diagonals of the operational modes in the idle mass
    and stiffness beyond what noise explains.
    """

    common: NDArray[np.float64]
    own: NDArray[np.float64]
    mass: float
    stiffness: float

    @property
    def mass_share(self) -> float:
        """Part of what changed that is mass, by mean square; 0 where nothing shows."""
        total = self.mass**2 + self.stiffness**2
        return self.mass**2 / total if total else 0.0


def scale_doubt(idle: NDArray[np.float64], operating: NDArray[Any], task: Task, kept: str) -> ScaleDoubt:
    """How far mass and stiffness can both have changed, where the scale assumes one of them (``kept``) to be as at rest.

    The scale from the modal mass and that from the modal stiffness differ by the change of stiffness less the change of mass of each mode,
    d = κ − μ. With μ and κ normal about zero and their sizes as the off-diagonals show them, the second moment of μ given d is d²·r²/(1 +
    r²), r² the ratio of the two mean squares. Idle shapes (m, n_idle) include residual modes.
    """
    turned = real_shapes(operating)[0]
    q = expand(idle, turned, task.prior)[0]
    n = q.shape[1]
    if n < 2:
        return ScaleDoubt(np.zeros(n), np.zeros(n), 0.0, 0.0)
    spread = participation_spread(idle, turned, task.prior)
    noise = spread + spread.T
    trust = 1 / (noise + ORTHOGONALITY_NOISE**2)
    np.fill_diagonal(trust, 0)
    excess = {}
    sizes = {}
    for name, part in (("mass", q), ("stiffness", q * task.idle_hz[:, None] / task.operating_hz)):
        sizes[name] = np.linalg.norm(part, axis=0)
        unit = part / np.maximum(sizes[name], 1e-300)
        excess[name] = trust * ((unit.T @ unit) ** 2 - noise)
    total = {name: max(float(np.sum(e) / np.sum(trust)), 0.0) for name, e in excess.items()}
    own = np.sqrt(np.maximum(np.sum(excess[kept], axis=0) / np.sum(trust, axis=0), 0) * DIAGONAL)
    both = total["mass"] + total["stiffness"]
    share = total[kept] / both if both else 0.0
    difference = 2 * np.log(np.maximum(sizes["mass"], 1e-300) / np.maximum(sizes["stiffness"], 1e-300))
    return ScaleDoubt(np.sqrt(share) * difference, own, float(np.sqrt(total["mass"])), float(np.sqrt(total["stiffness"])))

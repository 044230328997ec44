"""What a level-dependent effect looks like to a linear model at each level: a spring and a damper, best in the mean square."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from operando.data import one_level
from operando.effects import Effect
from operando.nonlinear.laws import LawFit, Motion
from operando.nonlinear.run import Real


def slopes(s: Real, x: Real, v: Real) -> tuple[float, float]:
    """Stiffness k and damping c of the line s = k·x + c·v nearest to a restoring force in the mean square.

    Statistical linearisation (Caughey 1963), with the motion as it is instead of a Gaussian one.

    Parameters
    ----------
    s, x, v : (N,) arrays
        Restoring force, displacement and velocity; their means do not count.
    """
    s, x, v = (a - np.mean(a) for a in (s, x, v))
    gram = np.array([[x @ x, x @ v], [x @ v, v @ v]])
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    k, c = np.linalg.solve(gram / np.outer(scale, scale) + 1e-12 * np.eye(2), np.array([x @ s, v @ s]) / scale) / scale
    return float(k), float(c)


def equivalents(law: LawFit, motions: Sequence[Motion], levels: Sequence[float]) -> list[dict[str, Any]]:
    """Equivalent spring and damper of an accepted law in each run.

    Parameters
    ----------
    law : LawFit
    motions : sequence of Motion
        One a run.
    levels : sequence of float
        Force of each run [N rms].

    Returns
    -------
    list of dict
        ``force_n``, ``displacement_m``, ``velocity_m_s`` (rms across the place), ``stiffness``, ``damping``, ``explains`` (share of the
        restoring force that the line explains); lowest level first.
    """
    rows = []
    for m, level in zip(motions, levels, strict=True):
        edge = max(8, m.x.size // 50)
        x, v = m.x[edge:-edge], m.v[edge:-edge]
        s = law.force(m.x, m.v, m.step)[edge:-edge]
        k, c = slopes(s, x, v)
        rest = (s - s.mean()) - k * (x - x.mean()) - c * (v - v.mean())
        rows.append(
            {
                "force_n": float(level),
                "displacement_m": float(x.std()),
                "velocity_m_s": float(v.std()),
                "stiffness": k,
                "damping": c,
                "explains": float(1 - np.mean(rest**2) / max(np.var(s), 1e-300)),
            }
        )
    return sorted(rows, key=lambda r: r["force_n"])


def linear_effects(effect: Effect, rows: Sequence[dict[str, Any]]) -> list[Effect]:
    """Spring and damper at the place of a level-dependent effect: the mean of its equivalents in the records of the lowest level."""
    lowest = min(r["force_n"] for r in rows)
    same = [r for r in rows if one_level(r["force_n"], lowest)]
    return as_linear(effect, *(float(np.mean([r[name] for r in same])) for name in ("stiffness", "damping")))


def as_linear(effect: Effect, stiffness: float, damping: float) -> list[Effect]:
    """Spring and damper of these sizes at the place of an effect; a negative one is taken away."""
    name = "coupling" if len(effect.location) == 2 else "ground"
    out = []
    for kind, parameter, size in ((f"{name}_spring", "stiffness", stiffness), (f"{name}_damper", "damping", damping)):
        if size != 0:
            out.append(Effect(kind, effect.location, {parameter: abs(float(size))}, removed=size < 0))
    return out

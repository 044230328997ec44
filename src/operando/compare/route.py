"""Which of the two routes to the operational FRFs is recommended, and how good it is: diagnosis and comparison taken together."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from operando.compare.verdict import FLOOR_DB, GOOD

ALIKE_DB = 0.1
"""Routes whose errors differ by less (1 % of abs(H)) are as good as each other: below it lie noise and the choice of lines."""

CLOSE_DB = 1.0
"""Error below which operational FRFs are close, whatever the noise (12 % of abs(H)): that of references such as the paper's example has."""

WITHIN = 1.2
"""Error over noise floor up to which the data allow no better: small errors in dB go with the root of chi-square, √GOOD = 1.22."""

FOUND = ("explained", "ambiguous")


@dataclass(frozen=True)
class Route:
    """A route to the operational FRFs.

    Parameters
    ----------
    name : {"hybrid", "effect", "idle"}
        As ``operando ofrf --route`` takes it.
    reason : str
    model : str
        Its key in ``comparison.json``: ``idle`` where the effect route has no effect, or makes the idle model worse.
    error_db, idle_error_db : float or None
        Its error and that of the idle model on the same lines.
    good : bool or None
        Whether the data allow no better, or it is close; None where nothing validated it.
    """

    name: str
    reason: str
    model: str
    error_db: float | None = None
    idle_error_db: float | None = None
    good: bool | None = None

    def to_dict(self) -> dict[str, Any]:
        """JSON object."""
        return {"name": self.name, "reason": self.reason, "model": self.model, "error_db": self.error_db}


def is_good(errors: Mapping[str, Any]) -> bool | None:
    """Whether a model is as good as the data allow, or close; None without an error. A noise floor too high makes nothing good."""
    error, misfit, floor = (errors.get(key) for key in ("error_db", "misfit", "noise_floor_db"))
    if error is None:
        return None
    if error < CLOSE_DB:
        return True
    if floor is None or floor > FLOOR_DB:
        return False
    return bool((misfit is not None and misfit < GOOD) or error <= WITHIN * floor)


def gets_worse(models: Mapping[str, Any]) -> str | None:
    """Where the idle model with its effects is farther off than without them, by more than noise makes; None where nowhere.

    Parameters
    ----------
    models : mapping
        ``models`` of ``comparison.json``.

    Returns
    -------
    str or None
        The sentence.

    Examples
    --------
    >>> idle = {"by_dof": [{"dof": "1+Z", "error_db": 1.0}]}
    >>> gets_worse({"idle": idle, "effect": {"by_dof": [{"dof": "1+Z", "error_db": 2.5}]}})
    'with the effects the model is farther off at 1+Z (1.00 → 2.50 dB)'
    >>> gets_worse({"idle": idle, "effect": idle}) is None
    True
    """
    idle, effect = models.get("idle") or {}, models.get("effect") or {}
    floor = effect.get("noise_floor_db") or 0.0
    before = {_where(row): row["error_db"] for key in ("by_dof", "by_band") for row in idle.get(key) or []}
    worse = []
    for row in (row for key in ("by_dof", "by_band") for row in effect.get(key) or []):
        then, now = before.get(_where(row)), row["error_db"]
        seen = row.get("misfit") is None or row["misfit"] > GOOD  # at an antiresonance noise alone makes some dB
        if then is not None and now is not None and now > then + floor and seen:
            worse.append(f"{_where(row)} ({then:.2f} → {now:.2f} dB)")
    return f"with the effects the model is farther off at {', '.join(worse[:4])}" if worse else None


def _where(row: Mapping[str, Any]) -> str:
    return str(row["dof"]) if "dof" in row else f"{row['band_hz'][0]:.4g} … {row['band_hz'][1]:.4g} Hz"


def recommended(comparison: Mapping[str, Any] | None, diagnosis: Mapping[str, Any] | None, hybrid: bool) -> Route | None:
    """The route to take: by the errors on the validation lines where there are any, else by the verdict; None where there is neither.

    Parameters
    ----------
    comparison : mapping or None
        ``comparison.json``.
    diagnosis : mapping or None
        ``diagnosis.json``.
    hybrid : bool
        Whether operational modes were scaled.

    Returns
    -------
    Route or None

    Examples
    --------
    >>> route = recommended({"models": {"ofrf": {"error_db": 0.3}, "idle": {"error_db": 5.0}}}, None, hybrid=True)
    >>> route.name, route.reason
    ('hybrid', 'no diagnosis was made')
    """
    models = (comparison or {}).get("models") or {}
    verdict, effects = (diagnosis or {}).get("verdict"), (diagnosis or {}).get("effects") or []
    second = "effect" if effects else "idle"
    errors = {key: models[key]["error_db"] for key in ("ofrf", second, "idle") if (models.get(key) or {}).get("error_db") is not None}

    def route(name: str, reason: str) -> Route:
        key = {"hybrid": "ofrf", "effect": second, "idle": "idle"}[name]
        return Route(name, reason, key, errors.get(key), errors.get("idle"), is_good(models.get(key) or {}))

    if not hybrid:
        # an idle model that fails in operation is no route to it
        return None if not effects and verdict != "no_misfit" else route("effect", "there are no scaled operational modes")
    if diagnosis is None:
        return route("hybrid", "no diagnosis was made")
    if "ofrf" in errors and second in errors:
        said = f"{errors[second]:.2f} dB against {errors['ofrf']:.2f} dB of the hybrid route on the validation FRFs"
        if effects and errors.get("idle", math.inf) < min(errors[second], errors["ofrf"]) - ALIKE_DB:
            closer = f"the idle model alone is closer to the validation FRFs, {errors['idle']:.2f} dB"
            return route("idle", f"{closer}: with effects {said}")
        if abs(errors["ofrf"] - errors[second]) > ALIKE_DB:
            return route("effect" if errors[second] < errors["ofrf"] else "hybrid", f"idle model{' + effects' if effects else ''}: {said}")
        causal = verdict in (*FOUND, "no_misfit")
        return route("effect" if causal else "hybrid", f"both are as close ({said}), and the verdict is {str(verdict).replace('_', ' ')}")
    if verdict in FOUND:
        return route("effect", "the cause is found, and no validation measurement says otherwise")
    return route("hybrid", "there is no validation measurement of either route, and the diagnosis names no sure cause")

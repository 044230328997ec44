"""The answer of a case: modes, which of them can be seen in what was measured, faults. Shares no code with operando."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from lab_structures import Point, Structure

NOISE_MARGIN = 3.0  # a mode is visible where its peak is this many times the noise (both in amplitude) …
POWER_SHARE = 0.02  # … and holds this share of the power of all modes, in one measured FRF or response at least


def visible(contributions: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, list[str | None]]:
    """Which modes stand out somewhere, and why the others do not.

    ``contributions`` (modes asked, modes, places): amplitude of each mode at the frequency of each mode asked; ``noise`` (modes asked,
    places): amplitude of the noise there. The mode asked must be at the same index in both.
    """
    power = np.abs(contributions) ** 2
    own = power[np.arange(len(power)), np.arange(len(power))]
    share = own / np.maximum(power.sum(axis=1), 1e-300)
    ratio = np.sqrt(own) / noise
    seen = ((ratio >= NOISE_MARGIN) & (share >= POWER_SHARE)).any(axis=1)
    reasons = [
        None if s else f"at most {r:.1f} times the noise, at most {100 * p:.1f} % of the power where it is largest"
        for s, r, p in zip(seen, ratio.max(axis=1), share.max(axis=1), strict=True)
    ]
    return seen, reasons


def answer(
    structure: Structure,
    dofs: Sequence[Point],
    seen: np.ndarray,
    reasons: Sequence[str | None],
    *,
    frequencies: np.ndarray | None = None,
    plain: np.ndarray | None = None,
    hit_rows: np.ndarray | None = None,
    **more: object,
) -> dict[str, object]:
    """The JSON document. Where modes drift, ``frequencies`` (pairs,) are means over the test weighted by power, ``plain`` unweighted.

    With ``hit_rows`` (DOFs, of the structure) each mode also has the shape at the places that were hit, ``shape_as_hit``.
    """
    modal = structure.modal
    hz = modal.frequencies if frequencies is None else frequencies
    even = hz if plain is None else plain
    shapes = structure.rows(list(dofs)) @ modal.shapes
    as_hit = None if hit_rows is None else hit_rows @ modal.shapes
    low, high = structure.band
    chosen = set(structure.in_band.tolist())
    modes = []
    for r in np.flatnonzero((modal.frequencies > 0.5 * low) & (modal.frequencies < 1.5 * high)):
        modes.append(
            {
                "frequency_hz": float(hz[r]),
                "frequency_plain_mean_hz": float(even[r]),
                "damping_ratio": float(modal.ratios[r]),
                "in_band": r in chosen,
                "visible": bool(seen[r]),
                "why_not_visible": reasons[r],
                "shape": {p.name: [float(v.real), float(v.imag)] for p, v in zip(dofs, shapes[:, r], strict=True)},
            }
        )
        if as_hit is not None:
            modes[-1]["shape_as_hit"] = {p.name: [float(v.real), float(v.imag)] for p, v in zip(dofs, as_hit[:, r], strict=True)}
    return {"schema": "laboratory/truth/1", "structure": structure.kind, "band_hz": list(structure.band), **more, "modes": modes}

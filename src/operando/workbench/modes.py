"""Modes chosen by hand: the stabilisation diagram as data, and what a choice changes in the test file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from operando.data import ModalModel
from operando.errors import ConfigError, MissingError
from operando.plots.style import thin
from operando.report.derive import analysis_band
from operando.report.live import LETTERS
from operando.results import Results
from operando.stabilization import HAND_TOLERANCE, Stabilization, stability_letters, track_poles
from operando.workbench.edits import AddTo, Edit, TakeFrom

STATES = {"idle": "", "operating": "oma_"}
"""State → what stands before ``select_hz`` and ``reject_hz`` in its keys of [analysis]."""
LEAST_ORDERS = 3
"""Model orders in a row that make a chain of poles of the OMA worth naming: that of the reasons in the report."""
MOST_POINTS = 900
SAME = 2e-3
"""Relative distance up to which a reason or a fit of a part of the band speaks of the same pole."""

Table = Mapping[str, Any]


def take(results: Results, table: Table, state: str, hz: float) -> tuple[Edit, str]:
    """What takes a pole near a frequency [Hz] as a mode beside the automatic ones, and that in words.

    ``table`` is [analysis] of the test file with its changes.
    """
    model, keys = model_of(results, state), STATES[state]
    poles = stable_poles(results, state)
    near = _nearest(poles, hz)
    if near is None or abs(near - hz) > HAND_TOLERANCE * hz:
        hint = "run the test again" if near is None else f"the nearest is at {near:.5g} Hz"
        raise ConfigError(f"no stable pole of the fit lies near {hz:.5g} Hz", where=f"{state} state", hint=hint)
    for refused in table.get(f"{keys}reject_hz") or ():
        if _nearest(poles, refused) == near:
            return TakeFrom(f"{keys}reject_hz", float(refused)), f"{near:.5g} Hz is a mode again"
    marks = marked(results, table, state)
    if any(_nearest(poles, m["hz"]) == near and m["now"] != "left out" for m in marks) or any(
        abs(float(f) - near) < 1e-4 * near for f in model.frequencies_hz
    ):
        raise ConfigError(
            f"{near:.5g} Hz is a mode already", where=f"{state} state", hint="to leave it out, choose it in the table of modes"
        )
    key = "modes_hz" if state == "idle" and table.get("modes_hz") else f"{keys}select_hz"
    return AddTo(key, float(f"{near:.6g}")), f"{near:.5g} Hz is taken as a mode"


def leave(results: Results, table: Table, state: str, hz: float) -> tuple[Edit, str]:
    """What leaves a mode out, or does not take one any more that was chosen by hand; see :func:`take`."""
    model, keys = model_of(results, state), STATES[state]
    poles = stable_poles(results, state)
    # the fit may have moved a mode that was taken by hand away from the pole that was chosen
    automatic = results.automatic.frequencies_hz if state == "idle" and results.automatic is not None else model.frequencies_hz
    added = bool(np.any(model.frequencies_hz == hz)) and not np.any(automatic == hz)
    for key in (*(("modes_hz",) if state == "idle" else ()), f"{keys}select_hz"):
        entries = [float(f) for f in table.get(key) or ()]
        near = _nearest(entries, hz)
        if near is not None and (added or _nearest(poles, near) == _nearest(poles, hz)):
            if key == "modes_hz" and len(entries) == 1:
                raise ConfigError(f"{near:.5g} Hz is the only mode of modes_hz", hint="take another one first")
            return TakeFrom(key, near), f"{near:.5g} Hz is not taken by hand any more"
    mode = _nearest([float(f) for f in model.frequencies_hz], hz)
    if mode is None or abs(mode - hz) > HAND_TOLERANCE * hz:
        raise ConfigError(f"there is no mode near {hz:.5g} Hz", where=f"{state} state", hint="choose one of the modes taken")
    return AddTo(f"{keys}reject_hz", float(f"{mode:.6g}")), f"{mode:.5g} Hz is left out"


def model_of(results: Results, state: str) -> ModalModel:
    """The modes of a state."""
    model = {"idle": results.idle, "operating": results.operating}.get(state)
    if model is None:
        raise MissingError(f"there are no modes of the {state} state", hint="the test lacks its data, or the run ended before")
    return model


def stable_poles(results: Results, state: str) -> list[float]:
    """Poles that may be named by hand [Hz]: modes and candidates of the EMA; chains of poles and modes of the OMA."""
    model = model_of(results, state)
    diagram = getattr(model.details, "stabilization", None)
    if diagram is None:
        return []
    if state == "idle":
        from operando.ema import poles_by_hand

        return [hz for hz, _, _ in poles_by_hand(results.automatic or model)]
    return [hz for hz, _, _ in _chains(diagram)]


def _chains(diagram: Stabilization) -> list[tuple[float, float, float]]:
    """Frequency, damping and share of the orders of each chain of physical poles."""
    table = diagram.table
    if diagram.tolerances is None:
        return [(float(f), float(z), 1.0) for f, z in zip(diagram.selected_hz, diagram.selected_damping, strict=True)]
    chains = [rows for rows in track_poles(table, diagram.tolerances) if rows.size >= LEAST_ORDERS]
    orders = np.unique(table.order).size
    middle = [(float(np.median(table.frequency_hz[r])), float(np.median(table.damping_ratio[r])), r.size / orders) for r in chains]
    return [(hz, zeta, share) for hz, zeta, share in middle if zeta > 0]


def marked(results: Results, table: Table, state: str) -> list[dict[str, Any]]:
    """Modes in the results, and those that the next run takes besides (without ``number``).

    ``now`` is what becomes of each in the next run: ``taken``, ``left out``, ``to come``.
    """
    model, poles = model_of(results, state), stable_poles(results, state)
    keys, used = STATES[state], results.settings
    names = [f"{keys}select_hz", *(["modes_hz"] if state == "idle" else [])]
    gone = {_nearest(poles, float(f)) for f in table.get(f"{keys}reject_hz") or ()}
    for key in names:
        gone |= {_nearest(poles, float(f)) for f in set(used.get(key) or ()) - set(table.get(key) or ())}
    wanted = [float(f) for key in names for f in table.get(key) or () if f not in (used.get(key) or ())]
    wanted += [float(f) for f in used.get(f"{keys}reject_hz") or () if f not in (table.get(f"{keys}reject_hz") or ())]
    rows: list[dict[str, Any]] = []
    for i, (hz, zeta) in enumerate(zip(model.frequencies_hz, model.damping_ratios, strict=True)):
        now = "left out" if _nearest(poles, float(hz)) in gone else "taken"
        rows.append(
            {
                "number": i,
                "hz": float(hz),
                "damping_ratio": float(zeta),
                "in_band": model.in_band is None or bool(model.in_band[i]),
                "now": now,
            }
        )
    have = {_nearest(poles, row["hz"]) for row in rows}
    for hz in wanted:
        if _nearest(poles, hz) not in have:
            rows.append({"number": None, "hz": hz, "damping_ratio": None, "in_band": True, "now": "to come"})
    return sorted(rows, key=lambda row: row["hz"])


def candidates(results: Results, table: Table, state: str) -> list[dict[str, Any]]:
    """Poles in band that may be taken and are no modes, best supported first.

    ``support`` is the share of the fits and orders that see one, ``reason`` why it was not taken, if known.
    """
    model = model_of(results, state)
    kept: Stabilization | None = getattr(model.details, "stabilization", None)
    if kept is None:
        return []
    if state == "idle":
        from operando.ema import poles_by_hand

        automatic = results.automatic or model
        seen = [(c.frequency_hz, c.support) for c in automatic.details.candidates]
        support = {hz: max((s for f, s in seen if abs(f - hz) < SAME * hz), default=0.0) for hz, _, _ in poles_by_hand(automatic)}
        known = [(hz, zeta, support[hz]) for hz, zeta, _ in poles_by_hand(automatic)]
    else:
        known = _chains(kept)
    poles, band = [hz for hz, _, _ in known], model.band_hz or (0.0, np.inf)
    modes = {_nearest(poles, m["hz"]) for m in marked(results, table, state)}
    reasons = [r for r in (*getattr(model.details, "rejected", ()), *kept.rejected) if r.damping_ratio > 0]  # others are no such poles
    rows = []
    for hz, zeta, share in sorted(known, key=lambda pole: -pole[2]):
        if hz not in modes and band[0] <= hz <= band[1]:
            why = min(reasons, key=lambda r: abs(r.frequency_hz - hz), default=None)
            reason = why.reason if why is not None and abs(why.frequency_hz - hz) < SAME * hz else ""
            rows.append({"hz": hz, "damping_ratio": zeta, "support": share, "reason": reason})
    return rows


def diagram(results: Results, table: Table, state: str) -> dict[str, Any]:
    """The stabilisation diagram as plain values, for the page to draw: poles by column, curves ``behind``, modes by :func:`marked`."""
    model = model_of(results, state)
    kept: Stabilization | None = getattr(model.details, "stabilization", None)
    if kept is None:
        raise MissingError(f"no stabilisation diagram of the {state} state was kept", hint="run the test again")
    band = model.band_hz or analysis_band(results) or (float(np.min(kept.table.frequency_hz)), float(np.max(kept.table.frequency_hz)))
    margin = 0.04 * (band[1] - band[0])
    low, high = max(float(band[0]) - margin, 0.0), float(band[1]) + margin
    t = kept.table
    inside = np.flatnonzero((t.frequency_hz >= low) & (t.frequency_hz <= high))
    letters = stability_letters(t, kept.tolerances)[inside]
    columns = {"hz": t.frequency_hz[inside], "damping": np.nan_to_num(t.damping_ratio[inside]), "order": t.order[inside]}
    rejected = [{"hz": r.frequency_hz, "reason": r.reason} for r in kept.rejected if low <= r.frequency_hz <= high]
    return {
        "state": state, "limits": [low, high], "band": [float(band[0]), float(band[1])],
        "poles": {name: values.tolist() for name, values in columns.items()} | {"letter": [str(c) for c in letters]},
        "letters": {letter: {"name": name, "color": color} for letter, (name, color) in LETTERS.items()},
        "behind": _behind(results, kept, state, low, high), "modes": marked(results, table, state), "rejected": rejected,
        "harmonics": [float(f) for f in getattr(model.details, "harmonics_hz", ()) if low <= f <= high],
    }  # fmt: skip


def _behind(results: Results, kept: Stabilization, state: str, low: float, high: float) -> list[dict[str, Any]]:
    """Mode indicators: CMIF and MMIF of the idle FRFs, singular values of the operating spectra."""
    frf = results.idle_frf
    if state == "idle" and frf is not None:
        from operando.ema import cmif, mmif

        inside = (frf.frequencies_hz >= low) & (frf.frequencies_hz <= high)
        hz, data = frf.frequencies_hz[inside], frf.data[:, :, inside]
        return [*_curves("CMIF", hz, cmif(data)[:3], True), *_curves("MMIF", hz, mmif(data, frf.quantity)[:2], False)]
    if kept.indicator is None or kept.indicator_hz is None:
        return []
    shown = (kept.indicator_hz >= low) & (kept.indicator_hz <= high)
    return _curves("Singular values of the spectra", kept.indicator_hz[shown], np.atleast_2d(kept.indicator)[:3, shown], True)


def _curves(name: str, hz: ArrayLike, rows: Sequence[Any] | Any, logarithmic: bool) -> list[dict[str, Any]]:
    """Curves between 0 and 1: of the logarithm over five decades at most, or as they are."""
    f, values = np.asarray(hz, float), np.atleast_2d(np.asarray(rows, float))
    if f.size < 2:
        return []
    if logarithmic:
        with np.errstate(divide="ignore", invalid="ignore"):
            values = np.log10(values)
        top = float(np.max(values[np.isfinite(values)], initial=-300.0))
        bottom = max(float(np.min(values[0][np.isfinite(values[0])], initial=top)), top - 5.0)
        values = np.clip((values - bottom) / ((top - bottom) or 1.0), 0.0, 1.0)
    out = []
    for row in values:
        ok = np.isfinite(row)
        if ok.sum() > 1:
            keep = thin(f[ok], row[ok], MOST_POINTS)
            out.append({"name": name, "hz": np.round(f[ok][keep], 5).tolist(), "values": np.round(row[ok][keep], 4).tolist()})
    return out


def _nearest(values: Sequence[float], hz: float) -> float | None:
    return min(values, key=lambda v: abs(v - hz), default=None)

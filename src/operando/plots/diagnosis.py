"""Figures of a diagnosis: error by step, where the idle model fails, dynamic stiffness at the location found."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from operando.errors import DataError
from operando.plots.errors import document_of, draw_errors
from operando.plots.style import GREEN, GREY, IDLE, INK, MEASURED, MODEL, new_axes, style
from operando.structure.effects import place_words

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DRAWN = "a diagnosis is drawn", "diagnose(idle, check=frf) makes one"
"""What figures say of what is none, and what to do."""


def plot_steps(diagnosis: Any, axes: Axes | None = None) -> Axes:
    """Error by step on the hold-out set: the idle model, then with each effect added; the noise floor as a line.

    Where the data are responses alone, and so no error in dB is known, the reduced chi-square on a logarithmic scale.

    Parameters
    ----------
    diagnosis : Diagnosis or mapping
        A diagnosis, or ``diagnosis.json``.
    axes : matplotlib Axes, optional
        Default: of a new figure.

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    DataError
        If the diagnosis has no steps.

    Examples
    --------
    >>> import operando
    >>> spring = {"kind": "ground_spring", "location": ["2+Z"]}
    >>> steps = [{"step": 0, "added": None, "heldout_error_db": 8.8}, {"step": 1, "added": spring, "heldout_error_db": 0.2}]
    >>> ax = operando.plots.plot_steps({"ladder": steps, "noise_floor_db": 0.26})
    >>> [t.get_text() for t in ax.get_xticklabels()]
    ['idle model', '+ ground_spring\\n2+Z']
    """
    told = document_of(diagnosis, *DRAWN)
    rows = list(told.get("ladder") or ())
    if not rows:
        raise DataError("the diagnosis has no steps", hint=told.get("reason"))
    decibel = all(r.get("heldout_error_db") is not None for r in rows)
    values = np.array([float(v) if (v := r.get("heldout_error_db" if decibel else "heldout_misfit")) is not None else np.nan for r in rows])
    if not np.any(np.isfinite(values)):
        raise DataError("the diagnosis has no error on the hold-out set", hint=told.get("reason"))
    floor = told.get("noise_floor_db") if decibel else 1.0
    with style():
        axes = new_axes(max(4.0, 1.6 + 1.1 * values.size), 3.4) if axes is None else axes
        axes.bar(np.arange(values.size), values, color=[IDLE] + [GREEN] * (values.size - 1), width=0.6)
        for i, v in enumerate(values):
            if np.isfinite(v):
                words = f"{v:.2f} dB" if decibel else f"{v:.3g}"
                axes.annotate(words, (i, v), (0, 3), textcoords="offset points", ha="center", fontsize=8.5, fontweight="bold")
        if floor is not None:
            axes.axhline(floor, color=INK, lw=1.0, ls=(0, (3, 2)), label=f"noise floor {floor:.2f} dB" if decibel else "noise")
            axes.legend(loc="best")
        axes.set_xticks(np.arange(values.size), [_added(r.get("added")) for r in rows])
        if decibel:
            axes.set_ylim(0, 1.15 * max(float(np.nanmax(values)), floor or 0.0, 1e-9))
        else:
            axes.set_yscale("log")
        axes.set_ylabel("Level error on the hold-out set, rms [dB]" if decibel else "Reduced χ² on the hold-out set (1 = noise)")
        axes.tick_params(axis="x", length=0)
    return axes


def plot_where(diagnosis: Any, axes: Axes | None = None, *, by: str = "dof") -> Axes:
    """Where the idle model fails in operation: its error by response DOF, by frequency band, or by mode.

    Parameters
    ----------
    diagnosis : Diagnosis or mapping
        A diagnosis, or ``diagnosis.json``.
    axes : matplotlib Axes, optional
        Default: of a new figure.
    by : {"dof", "band", "mode"}

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    DataError
        If ``by`` is something else, or there is nothing to draw.

    Examples
    --------
    >>> import operando
    >>> where = {"by_dof": [{"dof": "1+Z", "error_db": 4.3}, {"dof": "2+Z", "error_db": 8.1}]}
    >>> [float(bar.get_height()) for bar in operando.plots.plot_where({"where": where}).patches]
    [4.3, 8.1]
    """
    told = document_of(diagnosis, *DRAWN)
    rows = [dict(r) for r in (told.get("where") or {}).get(f"by_{by}") or ()]
    return draw_errors(rows, axes, by=by, floor=None, hint=told.get("reason"))


def plot_dynamic_stiffness(diagnosis: Any, axes: Axes | None = None, *, number: int = 0) -> Axes:
    """Dynamic stiffness that the data ask for at the location found, free of any kind, and that of the effect taken.

    Parameters
    ----------
    diagnosis : Diagnosis or mapping
        A diagnosis, or ``diagnosis.json``.
    axes : matplotlib Axes, optional
        Default: of a new figure.
    number : int
        Which location, 0 for the first.

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    DataError
        If the diagnosis has no dynamic stiffness there.

    Examples
    --------
    >>> import operando
    >>> curve = {"location": ["2+Z"], "frequency_hz": [5, 10], "real": [1e5, 1e5], "imag": [0, 10], "unit": "N/m"}
    >>> operando.plots.plot_dynamic_stiffness({"picture": {"dynamic_stiffness": [curve]}}).get_title("left")
    'Dynamic stiffness at 2+Z'
    """
    told = document_of(diagnosis, *DRAWN)
    curves = list((told.get("picture") or {}).get("dynamic_stiffness") or ())
    if not 0 <= number < len(curves):
        raise DataError(f"the diagnosis has dynamic stiffness at {len(curves)} locations, not number {number}", hint=told.get("reason"))
    curve = curves[number]
    hz = np.asarray(curve["frequency_hz"], float)
    with style():
        axes = new_axes(7.0, 3.4) if axes is None else axes
        for part, words, color in (("real", "real part", MEASURED), ("imag", "imaginary part", GREY)):
            axes.plot(hz, np.asarray(curve[part], float), ".", ms=3, color=color, label=f"{words}, from the data")
            if curve.get(f"law_{part}") is not None:
                axes.plot(hz, np.asarray(curve[f"law_{part}"], float), color=MODEL if part == "real" else GREEN, label=f"{words}, effect")
        axes.axhline(0, color=GREY, lw=0.6)
        axes.set_xlabel("Frequency [Hz]")
        axes.set_ylabel(f"Dynamic stiffness [{curve.get('unit') or 'N/m'}]")
        axes.set_title(f"Dynamic stiffness at {', '.join(map(str, curve['location']))}")
        axes.legend(loc="best")
    return axes


def _added(effect: Mapping[str, Any] | None) -> str:
    """What a step adds, in two lines."""
    if effect is None:
        return "idle model"
    return "\n".join(part for part in (f"+ {effect['kind']}", place_words(effect)) if part)

"""Stabilisation diagrams with the usual symbols over mode indicators, and singular values of operating spectra."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data import Frf, ModalModel, expect, ordered_band, unit_of
from operando.errors import DataError
from operando.plots.style import (
    GREEN,
    GREY,
    IDLE,
    INK,
    MODEL,
    ORANGE,
    PALE,
    PURPLE,
    SKY,
    dots,
    log_axis,
    mode_numbers,
    new_axes,
    style,
    thin,
)  # fmt: skip
from operando.stabilization import Stabilization, Tolerances, stability_letters

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LETTERS = (
    ("o", "o  new pole", "#9aa5b0"),
    ("f", "f  frequency stable", ORANGE),
    ("d", "d  frequency and damping", GREEN),
    ("v", "v  frequency and vector", SKY),
    ("s", "s  all stable", MODEL),
)
"""Symbol, words and colour of each class of poles."""

NOT_PHYSICAL = ("not physical", "#d3d9df")
LEGEND_WIDTH = 1.85
"""Width of one column of the legend [inches]."""

LETTERS_FROM, LETTERS_TO = 2.0, 3.8
"""Heights of the symbols [points]: as large as orders do not overlap, but readable."""


def plot_stabilization(
    stabilization: Stabilization,
    axes: Axes | None = None,
    *,
    frf: Frf | None = None,
    band: Sequence[float] | None = None,
    modes_hz: ArrayLike | None = None,
    harmonics_hz: Sequence[float] = (),
    indicator_name: str = "Mode indicator",
    tolerances: Tolerances | None = None,
    legend: bool = True,
) -> Axes:
    """Stabilisation diagram: poles by model order with the usual symbols, mode indicators behind, modes taken as lines.

    Symbols are ``o`` (new pole), ``f`` (frequency stable), ``d`` (frequency and damping), ``v`` (frequency and vector), ``s`` (all);
    crosses below are candidates that were rejected.

    Parameters
    ----------
    stabilization : Stabilization
        ``model.details.stabilization`` of a fitted model.
    axes : matplotlib Axes, optional
        Default: of a new figure. The indicator has axes of its own behind them.
    frf : Frf, optional
        FRFs at rest, whose CMIF and multivariate mode indicator (MMIF, down at a mode) are drawn behind; else the indicator that the
        identification kept.
    band : (float, float), optional
        Analysis band [Hz].
    modes_hz : array, optional
        Final frequencies of the modes (after refinement); default: those selected in the diagram.
    harmonics_hz : sequence of float
        Harmonics of rotation [Hz], dashed.
    indicator_name : str
        What the identification kept is.
    tolerances : Tolerances, optional
        What counted as stable; default: what the diagram keeps.
    legend : bool
        Whether the symbols are explained.

    Returns
    -------
    matplotlib Axes
        Of the poles.

    Raises
    ------
    ObjectError
        If something else than a stabilisation diagram is given.

    Examples
    --------
    >>> import numpy as np, operando
    >>> from operando.stabilization import classify, select_modes
    >>> one = np.ones((1, 1))
    >>> table = classify([2, 4, 6], [[10.0], [10.01], [10.01]], [[0.01]] * 3, [one] * 3)
    >>> ax = operando.plots.plot_stabilization(select_modes(table))
    >>> ax.get_ylabel()
    'Model order [poles]'
    """
    expect(stabilization, Stabilization, "a stabilisation diagram can be drawn here", "model.details.stabilization is one")
    table = stabilization.table
    modes = np.asarray(stabilization.selected_hz if modes_hz is None else modes_hz, float)
    low, high = _limits(table.frequency_hz, band)
    tol = tolerances or stabilization.tolerances
    with style():
        axes = new_axes(9.5, 5.0) if axes is None else axes
        behind = _behind(axes)
        if frf is not None:
            expect(frf, Frf, "mode indicators are drawn of FRFs", "read(file).frfs and estimate_frf(records) give FRFs")
            from operando.ema import cmif, mmif

            hz = frf.frequencies_hz
            inside = (hz >= low) & (hz <= high)
            _indicator(behind, hz[inside], cmif(frf.data[:, :, inside]), low, high, f"CMIF [{_unit(frf)}]")
            if band is not None:
                inside &= (hz >= band[0]) & (hz <= band[1])
            _mmif(axes, hz[inside], mmif(frf.data[:, :, inside], frf.quantity))
        else:
            _indicator(behind, stabilization.indicator_hz, stabilization.indicator, low, high, indicator_name)
        inside = (table.frequency_hz >= low) & (table.frequency_hz <= high)
        top = int(table.order.max()) if table.order.size else 1
        bottom = int(table.order.min()) if table.order.size else 0
        foot = bottom - 0.09 * (top - bottom + 1)
        _poles(axes, stabilization, inside, tol)
        for f in modes[(modes >= low) & (modes <= high)]:
            axes.axvline(f, color=IDLE, lw=0.8, zorder=2, alpha=0.85)
        mode_numbers(axes, modes, low, high)
        rejected = np.array([r.frequency_hz for r in stabilization.rejected if low <= r.frequency_hz <= high])
        if rejected.size:
            axes.plot(rejected, np.full(rejected.size, foot), ls="none", marker="x", ms=4.5, mew=1.0, color=PURPLE, label="rejected")
        for k, f in enumerate(h for h in harmonics_hz if low <= h <= high):
            axes.axvline(f, color=INK, lw=0.9, ls=(0, (2, 2)), zorder=1, label="harmonic" if k == 0 else None)
        axes.plot([], [], color=IDLE, lw=1.2, label="mode taken")
        if frf is not None:
            axes.plot([], [], color=GREEN, lw=0.9, ls=(0, (1, 1)), label="MMIF, 0 to 1")
        axes.set_xlim(low, high)
        axes.set_ylim(foot - 0.06 * (top - bottom + 1), top + 0.03 * (top - bottom + 1))
        axes.set_xlabel("Frequency [Hz]")
        axes.set_ylabel("Model order [poles]")
        axes.locator_params(axis="y", integer=True)
        if tol is not None:
            words = f"stable: Δf ≤ {100 * tol.frequency:g} %, Δζ ≤ {100 * tol.damping:g} %, MAC ≥ {tol.mac:g}"
            look: dict[str, Any] = {"ha": "right", "va": "top", "fontsize": 7.5, "color": GREY}
            axes.annotate(words, (1.0, 0.0), (0, -22), xycoords="axes fraction", textcoords="offset points", **look)
        if legend:
            box = (0.0, 1.05, 1.0, 0.1)
            figure = axes.get_figure(root=True)
            wide = axes.get_position().width * (figure.get_figwidth() if figure is not None else 9.0)
            columns = int(np.clip(wide / LEGEND_WIDTH, 1, 5))
            axes.legend(loc="lower left", bbox_to_anchor=box, ncols=columns, handletextpad=0.3, columnspacing=1.2, borderaxespad=0)
    return axes


def plot_stabilization_of(model: ModalModel, axes: Axes | None = None, *, frf: Frf | None = None) -> Axes:
    """The stabilisation diagram that an identification kept, with the modes it ended with and the harmonics it found.

    Parameters
    ----------
    model : ModalModel
        Of :func:`operando.fit_ema` or :func:`operando.fit_oma`.
    axes : matplotlib Axes, optional
        Default: of a new figure.
    frf : Frf, optional
        FRFs at rest, whose CMIF and MMIF are drawn behind.

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    DataError
        If the model keeps no diagram.

    Examples
    --------
    >>> import numpy as np, operando
    >>> model = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> found = operando.fit_ema(model.frf(np.arange(5, 80, 0.1), references="1+Z"), band=(10, 70))
    >>> operando.plots.plot_stabilization_of(found).get_ylabel()
    'Model order [poles]'
    """
    expect(model, ModalModel, "the stabilisation diagram of modes is drawn", "fit_ema(frf) and fit_oma(record) keep theirs")
    kept = getattr(model.details, "stabilization", None)
    if kept is None:
        raise DataError("the model keeps no stabilisation diagram", hint="those of fit_ema and fit_oma do")
    harmonics = getattr(model.details, "harmonics_hz", None)
    name = "Mode indicator (CMIF)" if harmonics is None else f"First singular values [{spectra_unit(model)}]"
    return plot_stabilization(
        kept, axes, frf=frf, band=model.band_hz, modes_hz=model.frequencies_hz, indicator_name=name,
        harmonics_hz=() if harmonics is None else [float(h) for h in harmonics],
    )  # fmt: skip


def _unit(frf: Frf) -> str:
    return unit_of(frf.quantity) if frf.si else "units of the file"


def _behind(axes: Axes) -> Axes:
    """Axes of the indicator at the same place, behind, with their numbers on the right."""
    behind = axes.twinx()
    behind.set_zorder(axes.get_zorder() - 1)
    axes.patch.set_visible(False)
    behind.yaxis.tick_right()
    behind.yaxis.set_label_position("right")
    behind.spines["right"].set_visible(True)
    behind.grid(False)
    return behind


def _poles(axes: Axes, stabilization: Stabilization, inside: NDArray[np.bool_], tol: Tolerances | None) -> None:
    table = stabilization.table
    letters = stability_letters(table, tol)
    odd = inside & (letters == "")
    if odd.any():
        dots(axes, table.frequency_hz[odd], table.order[odd], NOT_PHYSICAL[1], 1.4, NOT_PHYSICAL[0])
    figure = axes.get_figure(root=True)
    height = 72 * axes.get_position().height * (figure.get_figheight() if figure else 5.0)
    size = float(np.clip(0.62 * height / max(np.unique(table.order).size, 1), LETTERS_FROM, LETTERS_TO))
    for letter, words, color in LETTERS:
        rows = inside & (letters == letter)
        if rows.any():
            ring = letter == "o"
            axes.plot(
                table.frequency_hz[rows], table.order[rows], ls="none", marker="o" if ring else glyph(letter),
                ms=0.75 * size if ring else 1.5 * size, mew=0.5 if ring else 0.3, mec=color, mfc="none" if ring else color,
                zorder=3, label=words,
            )  # fmt: skip


@lru_cache
def glyph(letter: str) -> Any:
    """A letter as a marker: its outline, centred, of height 1."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.path import Path
    from matplotlib.textpath import TextPath

    outline = TextPath((0, 0), letter, size=1, prop=FontProperties(family="DejaVu Sans"))
    box = outline.get_extents()
    return Path(np.asarray(outline.vertices) - [(box.x0 + box.x1) / 2, (box.y0 + box.y1) / 2], outline.codes)


def _limits(frequencies: NDArray[Any], band: Sequence[float] | None) -> tuple[float, float]:
    if band is not None:
        low, high = ordered_band(band)
        return max(low - 0.08 * (high - low), 0.0), high + 0.08 * (high - low)
    good = frequencies[np.isfinite(frequencies)]
    return (float(good.min()), float(good.max()) * 1.02) if good.size and good.max() > good.min() else _around(good)


def _around(values: NDArray[Any]) -> tuple[float, float]:
    return (0.5 * float(values[0]), 1.5 * float(values[0])) if values.size else (0.0, 1.0)


def _indicator(axes: Axes, hz: ArrayLike | None, curves: ArrayLike | None, low: float, high: float, name: str) -> None:
    if hz is None or curves is None:
        axes.set_yticks([])
        return
    f, values = np.asarray(hz, float), np.atleast_2d(np.asarray(curves, float))
    shown = (f >= low) & (f <= high)
    if shown.sum() < 2:
        axes.set_yticks([])
        return
    axes.set_yscale("log")
    first = None
    for row in values[: min(4, values.shape[0])]:
        y = row[shown]
        ok = np.isfinite(y) & (y > 0)
        if not ok.any():
            continue
        keep = thin(f[shown][ok], np.log(y[ok]), 600)
        axes.plot(f[shown][ok][keep], y[ok][keep], color="#9fabb6" if first is None else PALE, lw=1.0 if first is None else 0.8)
        first = y[ok] if first is None else first
    if first is not None:
        axes.set_ylim(max(first.min() * 0.3, first.max() * 1e-8), first.max() * 3)
    axes.set_ylabel(name, color="#5b6670")
    axes.tick_params(axis="y", colors="#5b6670")
    log_axis(axes.yaxis)


def _mmif(axes: Axes, hz: NDArray[np.float64], values: NDArray[np.float64]) -> None:
    """MMIF between 0 (bottom) and 1 (top of the frame), dotted; each curve that dips at a frequency stands for a mode there."""
    place = axes.inset_axes((0, 0, 1, 1), sharex=axes, zorder=axes.get_zorder() - 1)
    place.set_axis_off()
    place.set_ylim(0, 1.02)
    for k, row in enumerate(values[:3]):
        keep = thin(hz, row, 600)
        place.plot(hz[keep], row[keep], color=GREEN, lw=0.7 if k == 0 else 0.5, ls=(0, (1, 1)), alpha=0.8)


def spectra_unit(model: ModalModel) -> str:
    """Of the singular values of the spectra that operational modes are identified from."""
    return "(m/s²)²/Hz" if model.si else "units of the file squared per Hz"


def plot_singular_values(
    frequencies_hz: ArrayLike,
    values: ArrayLike,
    axes: Axes | None = None,
    *,
    band: Sequence[float] | None = None,
    modes_hz: ArrayLike = (),
    harmonics_hz: Sequence[float] = (),
    unit: str = "(m/s²)²/Hz",
    legend: bool = True,
) -> Axes:
    """Singular values of operating spectra (or any mode indicator) with modes and harmonics marked.

    Parameters
    ----------
    frequencies_hz : (k,) array
        Lines [Hz].
    values : (n_curves, k) array
        Positive, the greatest first.
    axes : matplotlib Axes, optional
        Default: of a new figure.
    band : (float, float), optional
        Analysis band [Hz].
    modes_hz : array
        Modes marked by lines and numbers [Hz].
    harmonics_hz : sequence of float
        Harmonics of rotation [Hz], dashed.
    unit : str
        Of the values.
    legend : bool
        Whether the curves are named.

    Returns
    -------
    matplotlib Axes

    Examples
    --------
    >>> import numpy as np, operando
    >>> f = np.arange(1.0, 50.0)
    >>> ax = operando.plots.plot_singular_values(f, 1 / (1 + (f - 20) ** 2), modes_hz=[20.0])
    >>> ax.get_ylabel()
    'Singular value [(m/s²)²/Hz]'
    """
    f, curves = np.asarray(frequencies_hz, float), np.atleast_2d(np.asarray(values, float))
    if curves.shape[0] == f.size and curves.shape[1] != f.size:
        curves = curves.T
    low, high = _limits(f, band)
    with style():
        axes = new_axes(9.5, 4.0) if axes is None else axes
        axes.set_yscale("log")
        shown = (f >= low) & (f <= high)
        modes = np.asarray(modes_hz, float)
        for k, m in enumerate(modes[(modes >= low) & (modes <= high)]):
            axes.axvline(m, color=IDLE, lw=0.8, alpha=0.85, zorder=1, label="mode taken" if k == 0 else None)
        for k, h in enumerate(h for h in harmonics_hz if low <= h <= high):
            axes.axvline(h, color=INK, lw=1.0, ls=(0, (2, 2)), zorder=1, label="harmonic" if k == 0 else None)
        colors = (MODEL, SKY, GREY)
        for k, row in enumerate(curves[:6]):
            y = row[shown]
            ok = np.isfinite(y) & (y > 0)
            if ok.sum() < 2:
                continue
            keep = thin(f[shown][ok], np.log(y[ok]), 700)
            label = ("first", "second", "third and on")[k] if k < 3 else None
            axes.plot(f[shown][ok][keep], y[ok][keep], color=colors[min(k, 2)], lw=1.2 if k == 0 else 0.8, label=label)
        axes.set_xlim(low, high)
        axes.grid(True)
        axes.set_xlabel("Frequency [Hz]")
        axes.set_ylabel(f"Singular value [{unit}]")
        log_axis(axes.yaxis)
        mode_numbers(axes, modes, low, high)
        if legend:
            axes.legend(loc="best", ncols=2)
    return axes

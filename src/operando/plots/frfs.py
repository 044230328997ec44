"""Figures of FRFs: overlay of magnitude, phase and coherence, all pairs together, operational FRFs with their band."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data import Frf, expect, ordered_band, quantity_named, unit_of
from operando.dof import Dof
from operando.errors import DataError, ObjectError
from operando.plots.style import (
    CYCLE,
    DASHES,
    GREEN,
    IDLE,
    INK,
    MEASURED,
    SKY,
    frequency_axis,
    log_axis,
    new_stack,
    short_name,
    stack_of,
    style,
    thin,
)  # fmt: skip

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PARTS = ("magnitude", "phase", "coherence")
HEIGHTS = {"magnitude": 3.0, "phase": 1.0, "coherence": 0.8}

MOST_CURVES = 8
"""Curves drawn at most of one FRF matrix; the title says how many pairs there are."""

Pair = tuple[Dof, Dof]
"""Response and reference."""

_titled: WeakKeyDictionary[Axes, tuple[Pair, ...]] = WeakKeyDictionary()
"""Pairs that :func:`title_pairs` has named in the title of axes."""

MARGIN = 0.15
"""Part of the analysis band that is shown beyond it on either side."""


def magnitude_label(frf: Frf, quantity: str | None = None) -> str:
    """Axis label of a magnitude: the quantity with its unit, or that the unit is not known."""
    name = quantity or frf.quantity
    words = name.replace("_", " ").capitalize()
    return f"{words} [{unit_of(name) if frf.si else 'units of the file'}]"


def shown_lines(frf: Frf, band: Sequence[float] | None) -> slice:
    """Lines that are drawn: the band with a margin of 15 %, all without a band."""
    if band is None:
        return slice(0, len(frf.axis))
    low, high = ordered_band(band)
    margin = MARGIN * (high - low)
    return frf.axis.band(max(low - margin, 0), high + margin)


def plot_frf(
    frfs: Frf | Sequence[Frf],
    axes: Axes | Sequence[Axes] | None = None,
    *,
    responses: object = None,
    references: object = None,
    quantity: str | None = None,
    band: tuple[float, float] | None = None,
    labels: Sequence[str] | None = None,
    noise: bool = False,
    difference: bool = False,
    parts: str | Sequence[str] = PARTS,
    legend: bool = True,
) -> Axes:
    """FRFs over one another: magnitude, phase, and coherence where there is one.

    Parameters
    ----------
    frfs : Frf or sequence of Frf
        Drawn in this order; several are overlaid, in the quantity of the first.
    axes : matplotlib Axes or sequence of Axes, optional
        Where to draw: axes that this function returned (more curves in the same figure), axes of your own (the magnitude alone), or one
        for each of ``parts``. Default: a new figure.
    responses, references : DOF labels, optional
        Pairs drawn. Default: all where they are eight at most; else the drive points, or the first eight.
    quantity : str, optional
        ``accelerance``, ``mobility``, ``receptance``, one of their other names, or ``dynamic_stiffness``, ``impedance``,
        ``apparent_mass`` (the reciprocal of each pair). Default: that of the first.
    band : (float, float), optional
        Analysis band [Hz]: 15 % more is shown on either side, shaded.
    labels : sequence of str, optional
        One word for each of ``frfs``. Default: their names.
    noise : bool
        Draw the standard deviation of the first pair drawn (of the first FRF), dotted.
    difference : bool
        Draw the size of the difference of the second FRF from the first, where they are on the same lines.
    parts : sequence of {"magnitude", "phase", "coherence"}, or one of them
        What is drawn, from the top.
    legend : bool
        Whether the curves are named.

    Returns
    -------
    matplotlib Axes
        Of the magnitude (or of the first of ``parts``).

    Raises
    ------
    DataError
        If labels and FRFs differ in number, a part is unknown or none is named, or the band holds no lines.
    ObjectError
        If something else than FRFs is given.
    DofError
        If a DOF is not measured.

    Examples
    --------
    >>> import numpy as np, operando
    >>> line = np.linspace(5, 50, 200)
    >>> frf = operando.Frf((1 / (30.0**2 - line**2 + 18j * line))[None, None], line, "1+Z", "1+Z")
    >>> operando.plots.plot_frf(frf, band=(10, 45)).get_ylabel()
    'Accelerance [(m/s²)/N]'
    """
    given = _frfs(frfs)
    wanted = quantity_named(quantity) if quantity is not None else given[0].quantity
    chosen = [_chosen(frf, responses, references) for frf in given]
    words = [short_name(f.name) or ("" if len(given) == 1 else f"FRF {k}") for k, f in enumerate(given)] if labels is None else list(labels)
    if len(words) != len(given):
        raise DataError(f"{len(words)} labels for {len(given)} FRFs")
    asked = [parts] if isinstance(parts, str) else list(parts)
    named = [p for p in asked if p != "coherence" or any(f.coherence is not None for f, _ in chosen)]
    if not named:
        raise DataError("no part of the figure is named that can be drawn", hint=f"of {', '.join(PARTS)}; coherence where it is known")
    seen = [f for f, _ in chosen if f.frequencies_hz[shown_lines(f, band)].size]
    if not seen and band is not None:
        chosen[0][0].band(*band)  # the error says where its lines are
    with style():
        places, own = places_of(axes, named)
        done = sum(not str(line.get_label()).startswith("_") for line in next(iter(places.values())).lines)
        curves = [(f, i, j, words[k]) for k, (f, _) in enumerate(chosen) for i, j in np.ndindex(f.data.shape[:2])]
        single = len(curves) == len(given)
        if noise and chosen[0][0].variance is not None and "magnitude" in places:
            first = chosen[0][0]
            part = shown_lines(first, band)
            level = np.sqrt(first.variance[0, 0, part] * _slope(first, wanted)[0, 0, part])  # type: ignore[index]
            curve(places["magnitude"], first.frequencies_hz[part], level, color=INK, lw=1.0, ls=":", label="noise level (1 σ)", zorder=4)
        if difference and len(chosen) > 1 and "magnitude" in places:
            _difference(places["magnitude"], chosen[0][0], chosen[1][0], wanted, band)
        sizes = []
        for n, (frf, i, j, word) in enumerate(curves):
            k = done + n
            look: dict[str, Any] = {"color": CYCLE[k % len(CYCLE)], "lw": 1.5 if k == 0 else 1.1, "ls": DASHES[k % len(DASHES)]}
            look["ls"] = "-" if len(curves) > 3 else look["ls"]
            pair = f"{frf.responses[i]} from {frf.references[j]}"
            # One matrix needs no name beside its pairs; words of the caller need no pair where each has one curve.
            named_alone = word if single or len(given) > 1 else ""
            label = " ".join(w for w in (named_alone, "" if single and labels is not None else pair) if w)
            part = shown_lines(frf, band)
            values = frf.values(wanted)[i, j, part]
            f = frf.frequencies_hz[part]
            sizes.append(np.abs(values))
            if "magnitude" in places:
                curve(places["magnitude"], f, np.abs(values), label=label, count=1100, **look)
            if "phase" in places:
                keep = thin(f, np.abs(values), 500)
                places["phase"].plot(f[keep], degrees(values[keep]), label=label, **look | {"lw": 0.8 * look["lw"]})
            if "coherence" in places and frf.coherence is not None:
                keep = thin(f, frf.coherence[i, j, part], 400)
                color = GREEN if len(curves) == 1 and not done else look["color"]
                places["coherence"].plot(f[keep], frf.coherence[i, j, part][keep], color=color, lw=0.8)
        _dress(places, chosen[0][0], wanted, sizes, [f.frequencies_hz[shown_lines(f, band)] for f in seen], band)
        top = next(iter(places.values()))
        _title(top, chosen, single, own or labels is None)
        if legend:
            top.legend(loc="best", ncols=1 if len(curves) < 5 else 2)
    return top


def _frfs(frfs: Frf | Sequence[Frf]) -> list[Frf]:
    given = [frfs] if isinstance(frfs, Frf) else list(frfs) if isinstance(frfs, list | tuple) else None
    if not given or not all(isinstance(f, Frf) for f in given):
        found = type(frfs).__name__ if given is None else ", ".join(type(f).__name__ for f in given) or "nothing"
        raise ObjectError(f"FRFs can be drawn here, not {found}", hint="give an Frf or a list of them")
    return given


def _chosen(frf: Frf, responses: object, references: object) -> tuple[Frf, int]:
    """The pairs that are drawn, and how many there are."""
    part = frf.select(responses, references)
    total = part.data.shape[0] * part.data.shape[1]
    if total <= MOST_CURVES:
        return part, total
    drive = part.drive_points()
    if drive and responses is None:
        i, j = drive[0]
        return part.select((part.responses[i],), (part.references[j],)), total
    if len(part.references) > 1:
        part = part.select(None, part.references[:1])
    return part.select(part.responses[:MOST_CURVES]), total


def places_of(axes: Axes | Sequence[Axes] | None, parts: Sequence[str]) -> tuple[dict[str, Axes], bool]:
    """Axes of each part, and whether they are of a new figure."""
    for part in parts:
        if part not in PARTS:
            raise DataError(f"{part!r} is no part of an FRF figure", hint="use " + ", ".join(PARTS))
    if isinstance(axes, np.ndarray):  # as pyplot.subplots gives several
        axes = list(axes.ravel())
    if axes is None:
        made = new_stack([HEIGHTS[p] for p in parts], parts, 8.0, 1.0 + sum(HEIGHTS[p] for p in parts))
        return dict(zip(parts, made, strict=True)), True
    if isinstance(axes, list | tuple):
        return dict(zip(parts, axes, strict=False)), False
    return stack_of(axes, parts), False  # type: ignore[arg-type]


def _slope(frf: Frf, quantity: str) -> NDArray[np.float64]:
    """|d value/dH|² of each pair and line: what the variance is multiplied with in another quantity."""
    values = np.abs(frf.values(quantity))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((values / np.abs(frf.data)) ** 2)


def _difference(axes: Axes, first: Frf, second: Frf, quantity: str, band: Sequence[float] | None) -> None:
    if first.data.shape != second.data.shape or not np.allclose(first.frequencies_hz, second.frequencies_hz):
        raise DataError("the difference of FRFs needs the same pairs and lines", hint="synthesise the model on the measured lines")
    part = shown_lines(first, band)
    gap = np.abs(second.values(quantity)[0, 0, part] - first.values(quantity)[0, 0, part])
    curve(axes, first.frequencies_hz[part], gap, color=SKY, lw=0.7, label="difference")


def curve(
    axes: Axes, f: NDArray[Any], y: NDArray[Any], *, color: str, lw: float, label: str, ls: Any = "-", count: int = 700, zorder: float = 2
) -> None:
    """A positive curve on a logarithmic axis, thinned without a change of its look."""
    with np.errstate(divide="ignore", invalid="ignore"):
        keep = thin(f, np.log(np.maximum(y, 1e-300)), count)
    axes.plot(f[keep], np.where(y[keep] > 0, y[keep], np.nan), color=color, lw=lw, ls=ls, label=label, zorder=zorder)


def degrees(h: ArrayLike) -> NDArray[np.float64]:
    """Phase [°] with gaps where it wraps, so that no vertical line is drawn."""
    angle = np.degrees(np.angle(np.asarray(h, complex)))
    angle = np.where(np.isfinite(angle), angle, np.nan)
    with np.errstate(invalid="ignore"):
        jump = np.flatnonzero(np.abs(np.diff(angle)) > 180)
    angle[jump] = np.nan
    return angle


def magnitude_limits(axes: Axes, sizes: Sequence[NDArray[Any]], below: float = 1e-2, reach: float = 1e-6) -> None:
    """Limits of a logarithmic magnitude: all that is finite, but no deeper than ``reach`` of the largest."""
    values = np.concatenate([np.ravel(s) for s in sizes]) if sizes else np.ones(1)
    positive = values[np.isfinite(values) & (values > 0)]
    axes.set_yscale("log")
    if positive.size:
        axes.set_ylim(max(positive.min() * below, positive.max() * reach), positive.max() * 2)
    log_axis(axes.yaxis)


def _dress(
    places: dict[str, Axes], first: Frf, quantity: str, sizes: list[NDArray[Any]], lines: list[NDArray[Any]], band: Sequence[float] | None
) -> None:
    low, high = min(float(f[0]) for f in lines), max(float(f[-1]) for f in lines)
    last = list(places)[-1]
    for name, axes in places.items():
        drawn = [x for line in axes.lines if (x := np.asarray(line.get_xdata(), float)).size > 2]
        if not band and drawn:  # more curves in a figure that was there
            low, high = min(low, *(float(np.min(x)) for x in drawn)), max(high, *(float(np.max(x)) for x in drawn))
        frequency_axis(axes, low, high, band, label=name == last)
        if name == "magnitude":
            axes.set_ylabel(magnitude_label(first, quantity))
            before = [np.asarray(line.get_ydata(), float) for line in axes.lines if line.get_label() != "noise level (1 σ)"]
            level = any(line.get_label() in ("noise level (1 σ)", "difference") for line in axes.lines)
            magnitude_limits(axes, sizes + [b for b in before if b.size > 2] if not level else sizes, 1e-2 if level else 0.5)
        elif name == "phase":
            axes.set_ylim(-200, 200)
            axes.set_yticks([-180, -90, 0, 90, 180] if _tall(axes) else [-180, 0, 180])
            axes.set_ylabel("Phase [°]")
        else:
            axes.set_ylim(0, 1.05)
            axes.set_yticks([0, 0.5, 1] if _tall(axes) else [0, 1])
            axes.set_ylabel("Coherence [–]" if _tall(axes) else "Coh. [–]")


def _tall(axes: Axes) -> bool:
    """Whether axes have room for five numbers and a long word."""
    figure = axes.get_figure(root=True)
    return figure is None or axes.get_position().height * figure.get_figheight() > 0.62


def _pairs_text(pairs: Sequence[Pair]) -> str:
    return "; ".join(f"{response} from {reference}" for response, reference in pairs)


def titled_pairs(axes: Axes) -> tuple[Pair, ...]:
    """The pairs that the title of axes names; none where the caller has given them another title since."""
    pairs = _titled.get(axes, ())
    return pairs if axes.get_title(loc="left") == _pairs_text(pairs) else ()


def title_pairs(axes: Axes, pairs: Sequence[Pair]) -> None:
    """Name the pairs of the curves in axes, each once, after those that the title names already."""
    _titled[axes] = tuple(dict.fromkeys([*titled_pairs(axes), *pairs]))
    axes.set_title(_pairs_text(_titled[axes]), loc="left")


def _title(axes: Axes, chosen: list[tuple[Frf, int]], single: bool, anew: bool) -> None:
    """Name the pairs; with ``anew`` False only where the title of curves drawn before would leave out a new one."""
    frf, total = chosen[0]
    count = frf.data.shape[0] * frf.data.shape[1]
    if anew and count < total:
        axes.set_title(f"{count} of {total} pairs; choose others by frf[responses, references]", fontsize=9, fontweight="normal")
    elif single and (anew or titled_pairs(axes)):
        title_pairs(axes, [(f.responses[0], f.references[0]) for f, _ in chosen])


def plot_frf_rms(
    measured: Frf, model: Frf | None = None, axes: Axes | None = None, *, band: Sequence[float] | None = None, legend: bool = True
) -> Axes:
    """Root mean square over all pairs, measured and synthesised, with their difference and the noise level.

    Parameters
    ----------
    measured : Frf
        Measured FRFs.
    model : Frf, optional
        On the same lines and pairs.
    axes : matplotlib Axes, optional
        Default: of a new figure.
    band : (float, float), optional
        Analysis band [Hz].
    legend : bool
        Whether the curves are named.

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    DataError
        If the model is on other lines or pairs.

    Examples
    --------
    >>> import numpy as np, operando
    >>> frf = operando.Frf(np.ones((2, 1, 50)), np.arange(1.0, 51.0), "1+Z, 2+Z", "1+Z")
    >>> operando.plots.plot_frf_rms(frf).get_ylabel()
    'rms accelerance [(m/s²)/N]'
    """
    expect(measured, Frf, "FRFs are drawn", "read(file).frfs and estimate_frf(records) give FRFs")
    expect(model, Frf | None, "synthesised FRFs are drawn beside them", "model.frf(frequencies) makes some")
    if model is not None and model.data.shape != measured.data.shape:
        raise DataError(f"the model has FRFs {model.data.shape}, the measurement {measured.data.shape}", hint="synthesise it on its lines")
    with style():
        place = new_stack([1.0], ["rms"], 8.0, 4.0)[0] if axes is None else axes
        shown = shown_lines(measured, band)
        f = measured.frequencies_hz[shown]
        rms = lambda values: np.sqrt(np.nanmean(np.abs(values[:, :, shown]) ** 2, axis=(0, 1)))  # noqa: E731
        place.set_yscale("log")
        if measured.variance is not None:
            curve(place, f, rms(np.sqrt(measured.variance)), color=INK, lw=1.1, ls=":", label="noise level (1 σ)", zorder=4)
        if model is not None:
            curve(place, f, rms(model.data - measured.data), color=SKY, lw=0.8, label="difference")
        curve(place, f, rms(measured.data), color=MEASURED, lw=1.6, label="measured", count=1200)
        if model is not None:
            curve(place, f, rms(model.data), color=IDLE, lw=1.0, ls=DASHES[1], label="synthesised", count=1200)
        frequency_axis(place, float(f[0]), float(f[-1]), band)
        words = magnitude_label(measured)
        place.set_ylabel(f"rms {words[0].lower()}{words[1:]}")
        log_axis(place.yaxis)
        if legend:
            place.legend(loc="best")
    return place

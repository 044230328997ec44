"""Figures of how a modal model fits its FRFs: Nyquist circles and the correlation of each FRF with its synthesis."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data import Frf, ModalModel, expect, ordered_band
from operando.errors import DataError
from operando.indicators import frf_correlation
from operando.plots.frfs import magnitude_label
from operando.plots.matrix import draw_matrix
from operando.plots.style import CYCLE, GREY, IDLE, INK, MEASURED, MODEL, WHITE_BLUE, new_axes, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTHS = 6.0
"""Half-power widths on either side of a mode that its Nyquist figure shows, where no other mode is near: nine tenths of the circle."""

FIT_WIDTHS = 1.5
"""Half-power widths on either side of a mode that its circle is fitted to: most of the circle, and little of other modes."""

FINE = 400
"""Points of the synthesised curve."""

FEW_REFERENCES = 4
"""References up to which the correlation is drawn as bars by response."""


def fit_circle(points: ArrayLike) -> tuple[complex, float]:
    """Centre and radius of the circle nearest to points of the complex plane (linear least squares; Kåsa 1976).

    Parameters
    ----------
    points : (k,) complex array
        Three or more that are finite.

    Returns
    -------
    centre : complex
    radius : float

    Raises
    ------
    DataError
        If there are fewer than three points.

    Examples
    --------
    >>> centre, radius = fit_circle([1 + 2j, 3 + 0j, 1 - 2j])
    >>> round(radius, 6), round(centre.real, 6)
    (2.0, 1.0)
    """
    z = np.asarray(points, complex).ravel()
    z = z[np.isfinite(z)]
    if z.size < 3:
        raise DataError(f"{z.size} points give no circle", hint="three at least")
    middle, size = z.mean(), float(np.max(np.abs(z - z.mean()))) or 1.0
    w = (z - middle) / size
    left = np.column_stack([w.real, w.imag, np.ones(w.size)])
    a, b, c = np.linalg.lstsq(left, np.abs(w) ** 2, rcond=None)[0]
    radius = np.sqrt(max(c + (a**2 + b**2) / 4, 0.0))
    return complex(middle + size * (a + 1j * b) / 2), float(size * radius)


def plot_nyquist(
    frf: Frf,
    model: ModalModel | None = None,
    axes: Axes | None = None,
    *,
    mode: int | None = None,
    response: object = None,
    reference: object = None,
    band: tuple[float, float] | None = None,
    quantity: str | None = None,
) -> Axes:
    """An FRF in the complex plane: measured lines, the synthesis of the model, and the circle of a mode.

    Parameters
    ----------
    frf : Frf
        Measured.
    model : ModalModel, optional
        Of unit modal mass; its synthesis is drawn.
    axes : matplotlib Axes, optional
        Default: of a new figure.
    mode : int, optional
        Mode of the model whose surroundings are shown, with a circle through the measured lines near it. Default: the whole band.
    response, reference : DOF label, optional
        The pair; default: the first drive point, else the first pair.
    band : (float, float), optional
        Lines shown [Hz]; default: around the mode, else the band of the model, else all.
    quantity : str, optional
        Default: that of the FRF.

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    ObjectError
        If something else than an FRF is given.
    DataError
        If there is no such mode, or a band holds no line.
    DofError
        If the pair is not measured.

    Examples
    --------
    >>> import numpy as np, operando
    >>> model = operando.ModalModel([20.0], [0.02], np.array([[1.0]]), "1+Z", "unit_modal_mass")
    >>> frf = model.frf(np.linspace(15, 25, 200))
    >>> operando.plots.plot_nyquist(frf, model, mode=0).get_title(loc="left")
    '1+Z from 1+Z, mode 0: 20.00 Hz, ζ 2.00 %'
    """
    expect(frf, Frf, "an FRF can be drawn here", "model.frf(...) and read(file).frfs give them")
    i, j = next(iter(frf.drive_points()), (0, 0))
    pair = (frf.responses[i] if response is None else response, frf.references[j] if reference is None else reference)
    part = frf.select((pair[0],), (pair[1],)).to_quantity(quantity or frf.quantity)
    title = f"{part.responses[0]} from {part.references[0]}"
    if mode is not None:
        if model is None or not 0 <= mode < model.n_modes:
            raise DataError(
                f"there is no mode {mode}", hint="give a model, and one of its modes" if model is None else f"0 to {model.n_modes - 1}"
            )
        hz, zeta = float(model.frequencies_hz[mode]), float(model.damping_ratios[mode])
        width = 2 * zeta * hz
        apart = np.abs(np.delete(model.frequencies_hz, mode) - hz)
        reach = max(min(WIDTHS * width, 0.5 * float(apart.min(initial=np.inf))), FIT_WIDTHS * width)  # short of the circles beside it
        band = (hz - reach, hz + reach) if band is None else band
        title += f", mode {mode}: {hz:.2f} Hz, ζ {100 * zeta:.2f} %"
    elif band is None and model is not None:
        band = model.band_hz
    inside = part if band is None else part.band(*ordered_band(band))
    h = inside.data[0, 0]
    with style():
        axes = new_axes(6.0, 5.6) if axes is None else axes
        axes.plot(h.real, h.imag, ls="none", marker="o", ms=3.2, color=MEASURED, label="measured lines", zorder=3)
        if model is not None:
            fine = np.linspace(inside.frequencies_hz[0], inside.frequencies_hz[-1], FINE if mode is not None else 10 * FINE)
            made = model.frf(fine, inside.responses, inside.references, inside.quantity, variance=False).data[0, 0]
            axes.plot(made.real, made.imag, color=IDLE, lw=1.2, label="synthesised", zorder=2)
        if mode is not None:
            _circle(axes, inside, hz, width)
        axes.axhline(0, color=GREY, lw=0.6, zorder=0)
        axes.axvline(0, color=GREY, lw=0.6, zorder=0)
        axes.set_aspect("equal", adjustable="datalim")
        axes.grid(True)
        words = magnitude_label(inside)
        axes.set_xlabel(f"Real part of {words[0].lower()}{words[1:]}")
        axes.set_ylabel("Imaginary part")
        axes.set_title(title)
        axes.legend(loc="upper left", fontsize=7.5, borderaxespad=0.1)
    return axes


def _circle(axes: Axes, frf: Frf, hz: float, width: float) -> None:
    """The circle through the lines near a mode, and the frequencies of some of them."""
    near = frf.axis.band(hz - FIT_WIDTHS * width, hz + FIT_WIDTHS * width)
    f, h = frf.frequencies_hz[near], frf.data[0, 0, near]
    if np.isfinite(h).sum() >= 3:
        centre, radius = fit_circle(h)
        turn = np.exp(2j * np.pi * np.linspace(0, 1, 200))
        axes.plot(
            (centre + radius * turn).real,
            (centre + radius * turn).imag,
            color=MODEL,
            lw=0.9,
            ls=(0, (4, 2)),
            label="circle fitted",
            zorder=1,
        )
        axes.plot([centre.real], [centre.imag], marker="+", color=MODEL, ms=7, ls="none")
    for target in (hz - width, hz - width / 2, hz, hz + width / 2, hz + width):
        if f.size:
            k = int(np.argmin(np.abs(f - target)))
            where = (float(h[k].real), float(h[k].imag))
            axes.annotate(f"{f[k]:.4g} Hz", where, (6, 4), textcoords="offset points", fontsize=7.5, color=INK)


def plot_synthesis_correlation(
    frf: Frf, model: ModalModel | Frf, axes: Axes | None = None, *, band: tuple[float, float] | None = None
) -> Axes:
    """How well each measured FRF is what the model makes: correlation over the lines, 100 % where they agree but for a factor.

    Parameters
    ----------
    frf : Frf
        Measured.
    model : ModalModel or Frf
        The model, or its FRFs on the same lines and pairs.
    axes : matplotlib Axes, optional
        Default: of a new figure.
    band : (float, float), optional
        Lines that count [Hz]; default: the band of the model.

    Returns
    -------
    matplotlib Axes
        Bars by response with up to four references, else a matrix of responses and references.

    Raises
    ------
    DataError
        If the shapes of the model have no scale, or the FRFs are on other lines or pairs.

    Examples
    --------
    >>> import numpy as np, operando
    >>> model = operando.ModalModel([20.0], [0.02], np.array([[1.0], [0.5]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> frf = model.frf(np.linspace(15, 25, 200), references="1+Z")
    >>> operando.plots.plot_synthesis_correlation(frf, model).get_title(loc="left")
    'Synthesis correlation, mean 100.0 %, least 100.0 % at 1+Z from 1+Z'
    """
    expect(frf, Frf, "measured FRFs are compared", "read(file).frfs and estimate_frf(records) give FRFs")
    expect(model, ModalModel | Frf, "a model or its FRFs are compared", "fit_ema(frf) gives a model")
    given = None if isinstance(model, Frf) else model.band_hz
    band = given if band is None else band
    measured = frf if band is None else frf.band(*ordered_band(band))
    made = (model if band is None else model.band(*band)) if isinstance(model, Frf) else None
    if made is None:
        made = model.frf(measured.frequencies_hz, measured.responses, measured.references, measured.quantity, variance=False)  # type: ignore[union-attr]
    values = 100 * frf_correlation(measured, made)
    if not np.any(np.isfinite(values)):
        raise DataError("no pair has a line to compare")
    i, j = np.unravel_index(int(np.nanargmin(values)), values.shape)
    worst = f"least {values[i, j]:.1f} % at {measured.responses[i]} from {measured.references[j]}"
    with style():
        if len(measured.references) <= FEW_REFERENCES:
            axes = new_axes(float(np.clip(1.5 + 0.22 * values.size, 6.0, 11.0)), 3.6) if axes is None else axes
            _bars(axes, measured, values)
        else:
            size = (min(2.0 + 0.4 * values.shape[1], 11), min(1.5 + 0.26 * values.shape[0], 10))
            axes = new_axes(*size) if axes is None else axes
            rows, columns = [str(d) for d in measured.responses], [str(d) for d in measured.references]
            draw_matrix(axes, values, rows, columns, colors=WHITE_BLUE, top=115, dark=60, text="{:.0f}".format, square=False)
            axes.set_xlabel("Reference")
            axes.set_ylabel("Response")
        axes.set_title(f"Synthesis correlation, mean {np.nanmean(values):.1f} %, {worst}", fontsize=9, pad=20)
    return axes


def _bars(axes: Axes, frf: Frf, values: NDArray[np.float64]) -> None:
    n, m = values.shape
    wide = 0.8 / m
    for j, reference in enumerate(frf.references):
        axes.bar(np.arange(n) + (j - (m - 1) / 2) * wide, values[:, j], width=0.95 * wide, color=CYCLE[j + 1], label=f"from {reference}")
    every = -(-n // 45)
    axes.set_xticks(np.arange(0, n, every), [str(d) for d in frf.responses][::every], rotation=90 if n > 8 else 0)
    axes.set_ylim(0, 105)
    axes.set_ylabel("Correlation [%]")
    axes.set_xlabel("Response")
    axes.grid(True, axis="y")
    axes.tick_params(axis="x", length=0)
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, borderaxespad=0.2)

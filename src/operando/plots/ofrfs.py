"""Figures of operational FRFs with their 95 % band."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data import Frf, ModalModel
from operando.dof import DofIndex
from operando.errors import DataError, ObjectError
from operando.indicators import INTERVAL
from operando.plots.frfs import PARTS, curve, degrees, magnitude_label, magnitude_limits, places_of, shown_lines, title_pairs, titled_pairs
from operando.plots.style import DASHES, IDLE, MEASURED, MODEL, frequency_axis, style, thin

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from operando.scaling import HybridModel


def plot_ofrf(
    ofrf: Frf | None,
    measured: Frf | None = None,
    idle: Frf | None = None,
    axes: Axes | Sequence[Axes] | None = None,
    *,
    response: object = None,
    reference: object = None,
    band: Sequence[float] | None = None,
    label: str = "operational FRF",
    parts: Sequence[str] = PARTS[:2],
    legend: bool = True,
) -> Axes:
    """An operational FRF with its 95 % band in magnitude and phase, beside a validation measurement and the model at rest.

    Parameters
    ----------
    ofrf : Frf or None
        Its variance gives the band.
    measured, idle : Frf, optional
        The validation measurement; the FRF of the idle model. They have the pair, on lines of their own.
    axes : matplotlib Axes or sequence of Axes, optional
        One for the magnitude alone, or one for each of ``parts``. Default: of a new figure.
    response, reference : DOF label, optional
        The pair drawn; default: the first of the first FRF given.
    band : (float, float), optional
        Analysis band [Hz], shaded outside.
    label : str
        What the FRF with the band is.
    parts : sequence of {"magnitude", "phase"}
        What is drawn, from the top.
    legend : bool
        Whether the curves are named.

    Returns
    -------
    matplotlib Axes
        Of the magnitude.

    Raises
    ------
    DataError
        If no FRF is given.
    DofError
        If an FRF does not have the pair.

    Examples
    --------
    >>> import numpy as np, operando
    >>> line = np.linspace(5, 50, 200)
    >>> h = (1 / (30.0**2 - line**2 + 18j * line))[None, None]
    >>> frf = operando.Frf(h, line, "1+Z", "1+Z", variance=0.01 * abs(h) ** 2)
    >>> [t.get_text() for t in operando.plots.plot_ofrf(frf).get_legend().get_texts()]
    ['95 % band', 'operational FRF']
    """
    kinds = ((idle, "idle model", IDLE, DASHES[1], 1.0), (measured, "validation (measured running)", MEASURED, "-", 1.5))
    given = [f for f in (ofrf, measured, idle) if f is not None]
    if not given:
        raise DataError("no FRF to draw", hint="give at least one of ofrf, measured, idle")
    first = given[0]
    pair = (first.responses[0] if response is None else response, first.references[0] if reference is None else reference)
    one = lambda frf: frf.select((pair[0],), (pair[1],)).to_quantity(first.quantity)  # noqa: E731
    with style():
        places, own = places_of(axes, list(parts))
        sizes: list[NDArray[Any]] = []
        lines: list[NDArray[Any]] = []
        for frf, words, color, dash, width in kinds:
            if frf is None or not np.any(np.isfinite(frf.data)):
                continue
            _one_curve(places, one(frf), band, words, color, dash, width, sizes, lines)
        if ofrf is not None:
            part = one(ofrf)
            if part.variance is not None:
                _interval(places, part, band)
            _one_curve(places, part, band, label, MODEL, "-", 1.1, sizes, lines)
        low, high = min(float(f[0]) for f in lines), max(float(f[-1]) for f in lines)
        last = list(places)[-1]
        for name, place in places.items():
            frequency_axis(place, low, high, band, label=name == last)
        if "magnitude" in places:
            places["magnitude"].set_ylabel(magnitude_label(first))
            magnitude_limits(places["magnitude"], sizes, 0.5, 1e-5)
        if "phase" in places:
            places["phase"].set_ylim(-200, 200)
            places["phase"].set_yticks([-180, 0, 180])
            places["phase"].set_ylabel("Phase [°]")
        top = next(iter(places.values()))
        if own or titled_pairs(top):
            named = one(first)
            title_pairs(top, [(named.responses[0], named.references[0])])
        if legend:
            top.legend(loc="best")
    return top


def plot_hybrid(
    hybrid: HybridModel,
    axes: Axes | None = None,
    *,
    response: object = None,
    reference: object = None,
    measured: Frf | None = None,
    frequencies: ArrayLike | None = None,
) -> Axes:
    """One operational FRF of a hybrid model with its 95 % band, beside the idle model and a validation measurement.

    Parameters
    ----------
    hybrid : HybridModel
        Model to draw.
    axes : matplotlib Axes, optional
        Default: of a new figure.
    response, reference : DOF label, optional
        Default: the first pair of the measurement that the model has, else the DOF that takes part in the modes most, with itself.
    measured : Frf, optional
        Running, force measured; its lines are used.
    frequencies : array, optional
        Lines [Hz]; default: the band in steps that resolve every mode.

    Returns
    -------
    matplotlib Axes
        Of the magnitude.

    Raises
    ------
    ObjectError
        If it is no hybrid model.
    DofError
        If the model, or the measurement, does not have the pair.

    Examples
    --------
    >>> import numpy as np, operando
    >>> idle = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> operating = operando.ModalModel([21.0, 45.0], [0.01, 0.02], np.array([[2, 3], [2, -3]]), "1+Z, 2+Z", "unscaled")
    >>> hybrid = operando.scale_operational(idle, operating)
    >>> operando.plots.plot_hybrid(hybrid, response="2+Z", reference="1+Z", frequencies=np.arange(10, 60, 0.1)).get_ylabel()
    'Accelerance [(m/s²)/N]'
    """
    if not isinstance(modal := getattr(hybrid, "modal", None), ModalModel):
        raise ObjectError(f"a hybrid model is drawn, not {type(hybrid).__name__}", hint="scale_operational(idle, operating) makes one")
    known = DofIndex(modal.dofs)
    most = modal.dofs[int(np.argmax(np.sum(np.abs(modal.shapes) / np.max(np.abs(modal.shapes), axis=0), axis=1)))]
    first = lambda dofs: next((d for d in dofs if d in known), most)  # noqa: E731
    out = (most if measured is None else first(measured.responses)) if response is None else response
    into = (most if measured is None else first(measured.references)) if reference is None else reference
    band = hybrid.operating.band_hz or hybrid.idle.band_hz
    if frequencies is None:
        low, high = band or (0.8 * float(modal.frequencies_hz[0]), 1.1 * float(modal.frequencies_hz[-1]))
        lines = measured.frequencies_hz if measured is not None else resolving_lines(modal, low, high)
    else:
        lines = np.atleast_1d(np.asarray(frequencies, float))
    ofrf = hybrid.frf(lines, (out,), (into,))
    idle = hybrid.idle.frf(lines, (out,), (into,), variance=False)
    return plot_ofrf(ofrf, measured, idle, axes, response=out, reference=into, band=band if frequencies is None else None)


def resolving_lines(model: ModalModel, low: float, high: float) -> NDArray[np.float64]:
    """Even lines from low to high [Hz], six in the half-power width of the narrowest mode there (20 000 at most)."""
    inside = (model.frequencies_hz >= low) & (model.frequencies_hz <= high) & (model.damping_ratios > 0)
    widths = 2 * model.damping_ratios[inside] * model.frequencies_hz[inside]
    step = float(widths.min()) / 6 if widths.size else (high - low) / 1000
    return np.linspace(low, high, int(np.clip((high - low) / step, 400, 20_000)))


def _one_curve(
    places: dict[str, Axes],
    frf: Frf,
    band: Sequence[float] | None,
    words: str,
    color: str,
    dash: Any,
    width: float,
    sizes: list[NDArray[Any]],
    lines: list[NDArray[Any]],
) -> None:
    part = shown_lines(frf, band)
    f, h = frf.frequencies_hz[part], frf.data[0, 0, part]
    sizes.append(np.abs(h))
    lines.append(f)
    if "magnitude" in places:
        curve(places["magnitude"], f, np.abs(h), color=color, lw=width, ls=dash, label=words, count=1000)
    if "phase" in places:
        keep = thin(f, np.abs(h), 500)
        places["phase"].plot(f[keep], degrees(h[keep]), color=color, lw=0.8 * width, ls=dash)


def _interval(places: dict[str, Axes], frf: Frf, band: Sequence[float] | None) -> None:
    """95 % of magnitude and phase: a complex error of variance E|ΔH|² has half of it along H and half across."""
    assert frf.variance is not None
    part = shown_lines(frf, band)
    f, h, variance = frf.frequencies_hz[part], frf.data[0, 0, part], frf.variance[0, 0, part]
    size = np.abs(h)
    known = np.flatnonzero(np.isfinite(variance) & (size > 0))  # it is dear, so some lines have none
    keep = known[thin(f[known], np.log(size[known]), 450)] if known.size else known
    half = INTERVAL * np.sqrt(np.maximum(variance[keep], 0) / 2)
    if "magnitude" in places:
        low = np.maximum(size[keep] - half, size[keep] * 1e-2)
        places["magnitude"].fill_between(f[keep], low, size[keep] + half, color=MODEL, alpha=0.25, linewidth=0, label="95 % band")
    if "phase" in places:
        middle = degrees(h[keep])
        spread = np.degrees(np.minimum(half / size[keep], np.pi))
        places["phase"].fill_between(f[keep], middle - spread, middle + spread, color=MODEL, alpha=0.25, linewidth=0)

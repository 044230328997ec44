"""Figures of modal models: MAC, participation, complexity, sensors that are nearly redundant, changes from rest to operation."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from operando.data import ModalModel, expect
from operando.errors import DataError, ObjectError
from operando.indicators import INTERVAL, common_shapes, mac, mean_phase_deviation, phase_collinearity
from operando.plots.matrix import draw_matrix
from operando.plots.style import GREY, IDLE, INK, MODEL, PALE, WHITE_BLUE, new_axes, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LEAST_MAC = 0.005
"""Below, a cell of a MAC matrix has no number."""


def plot_mac(
    first: ModalModel | ArrayLike,
    second: ModalModel | None = None,
    axes: Axes | None = None,
    *,
    labels: tuple[Sequence[str], Sequence[str]] | None = None,
    names: tuple[str, str] | None = None,
    title: str | None = None,
) -> Axes:
    """MAC matrix with values in the cells: AutoMAC of one model, or cross-MAC of two.

    Parameters
    ----------
    first : ModalModel or (n1, n2) array
        A model, or MAC values that are there already.
    second : ModalModel, optional
        Default: the first (AutoMAC).
    axes : matplotlib Axes, optional
        Default: of a new figure.
    labels : (sequence of str, sequence of str), optional
        Of rows and columns; default: number and frequency of each mode.
    names : (str, str), optional
        Words beside the rows and under the columns.
    title : str, optional
        Default: what it is, and over how many DOFs.

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    ObjectError
        If the second is no model.
    DataError
        If the models have fewer than two DOFs in common.

    Examples
    --------
    >>> import numpy as np, operando
    >>> model = operando.ModalModel([10.0, 20.0], [0.01, 0.01], np.array([[1.0, 1.0], [1.0, -1.0]]), "1+Z, 2+Z")
    >>> operando.plots.plot_mac(model).get_title(loc="left")
    'AutoMAC over 2 DOFs'
    """
    if second is not None and not isinstance(second, ModalModel):
        raise ObjectError(f"MAC of a {type(second).__name__} cannot be drawn", hint="give a ModalModel")
    if isinstance(first, ModalModel):
        other = first if second is None else second
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the title says over how many DOFs
            values = mac(first, other)
        labels = (mode_labels(first), mode_labels(other)) if labels is None else labels
        if title is None:
            n = len(first.dofs) if second is None else len(common_shapes(first, other)[2])
            title = f"{'AutoMAC' if second is None else 'Cross-MAC'} over {n} DOFs"
    else:
        values = np.atleast_2d(np.asarray(first, float))
        labels = tuple([str(k) for k in range(n)] for n in values.shape) if labels is None else labels  # type: ignore[assignment]
    assert labels is not None
    if values.size == 0:
        raise DataError("a model without modes has no MAC")
    if names is None:
        one = "Mode: frequency [Hz]"
        names = (one, one) if second is None else (f"First model, {one.lower()[:-4]}[Hz]", f"Second model, {one.lower()[:-4]}[Hz]")
    rows, columns = values.shape
    with style():
        axes = new_axes(min(1.6 + 0.42 * columns, 11), min(1.4 + 0.42 * rows, 10)) if axes is None else axes
        words = lambda v: "" if v < LEAST_MAC else "1" if v > 0.995 else f"{v:.2f}"[1:]  # noqa: E731
        draw_matrix(axes, np.clip(values, 0, 1), *labels, text=words)
        axes.set_ylabel(names[0])
        axes.set_xlabel(names[1])
        axes.set_title(title or "MAC")
    return axes


def mode_labels(model: ModalModel) -> list[str]:
    """Number and frequency [Hz] of each mode."""
    return [f"{k}: {f:.1f}" for k, f in enumerate(model.frequencies_hz)]


def plot_participation(model: ModalModel, axes: Axes | None = None, *, dofs: object = None) -> Axes:
    """How strongly each DOF takes part in each mode: size of the shape there over its greatest, in per cent.

    A force at a DOF of small participation hardly drives the mode, and a sensor there hardly sees it.

    Parameters
    ----------
    model : ModalModel
        Model to draw.
    axes : matplotlib Axes, optional
        Default: of a new figure.
    dofs : DOF labels, optional
        Rows; default: all (for the references of a test, name them).

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    DofError
        If a DOF is not in the model.

    Examples
    --------
    >>> import numpy as np, operando
    >>> model = operando.ModalModel([10.0], [0.01], np.array([[1.0], [0.2]]), "1+Z, 2+Z")
    >>> [t.get_text() for t in operando.plots.plot_participation(model).texts]
    ['100', '20']
    """
    _check(model)
    _check_axes(axes)
    wanted = model.dofs if dofs is None else model[dofs].dofs
    peak = np.max(np.abs(model.shapes), axis=0, initial=0)
    share = 100 * np.abs(model.rows(wanted)) / np.where(peak > 0, peak, 1)
    with style():
        axes = new_axes(1.4 + 0.5 * max(model.n_modes, 4), min(1.3 + 0.26 * max(len(wanted), 3), 11)) if axes is None else axes
        columns = mode_labels(model)
        draw_matrix(axes, share, [str(d) for d in wanted], columns, colors=WHITE_BLUE, top=115, dark=60, text="{:.0f}".format, square=False)
        axes.set_ylabel("DOF")
        axes.set_xlabel("Mode: frequency [Hz]")
        axes.set_title("Participation, % of the greatest DOF")
    return axes


def plot_complexity(model: ModalModel, axes: Axes | None = None) -> Axes:
    """Modal phase collinearity (MPC) and mean phase deviation (MPD) of each mode: 100 % and 0° for a real one.

    Parameters
    ----------
    model : ModalModel
        Model to draw.
    axes : matplotlib Axes, optional
        Default: of a new figure. The deviation has an axis of its own on the right.

    Returns
    -------
    matplotlib Axes
        Of the collinearity.

    Raises
    ------
    DataError
        If the shapes are real by construction, as those of :func:`operando.fit_ema`: there is nothing to draw.

    Examples
    --------
    >>> import numpy as np, operando
    >>> model = operando.ModalModel([10.0], [0.01], np.array([[1.0], [1.0j]]), "1+Z, 2+Z")
    >>> operando.plots.plot_complexity(model).get_ylabel()
    'MPC [%]'
    """
    _check(model)
    _check_axes(axes)
    if model.real_shapes:
        raise DataError(
            "the shapes are real by construction, so that each has a phase collinearity of 100 %",
            hint="operational modes (fit_oma) have complex shapes",
        )
    x = np.arange(model.n_modes)
    shapes = model.complex_shapes
    collinear = [100 * phase_collinearity(shapes[:, k]) for k in x]
    deviation = [float(np.degrees(mean_phase_deviation(shapes[:, k]))) for k in x]
    with style():
        axes = new_axes(max(5.0, 1.5 + 0.5 * x.size), 3.6) if axes is None else axes
        right = axes.twinx()
        first = axes.bar(x - 0.2, collinear, width=0.38, color=MODEL, label="MPC")
        second = right.bar(x + 0.2, deviation, width=0.38, color=IDLE, label="MPD")
        axes.set_ylim(0, 105)
        right.set_ylim(0, max(10.0, 1.15 * max(deviation, default=0.0)))
        axes.set_ylabel("MPC [%]")
        right.set_ylabel("MPD [°]")
        right.spines["right"].set_visible(True)
        axes.set_xticks(x, mode_labels(model), rotation=90 if x.size > 6 else 0)
        axes.tick_params(axis="x", length=0)
        axes.set_xlabel("Mode: frequency [Hz]")
        axes.grid(True, axis="y")
        axes.legend(handles=[first, second], loc="lower left", bbox_to_anchor=(0, 1.0), ncols=2)
    return axes


def plot_shares(labels: Sequence[str], share: ArrayLike, axes: Axes | None = None, *, title: str = "", color: str = MODEL) -> Axes:
    """Shares as bars: which sensors, or which modes, make the condition number of the shapes large.

    Parameters
    ----------
    labels : sequence of str
        One label for each bar.
    share : (n,) array
        Between 0 and 1.
    axes : matplotlib Axes, optional
        Default: of a new figure.
    title : str
        Words above the axes.
    color : str
        Colour of the bars.

    Returns
    -------
    matplotlib Axes

    Examples
    --------
    >>> import operando
    >>> operando.plots.plot_shares(["1+Z", "2+Z"], [0.3, 0.7]).get_ylabel()
    'Share [%]'
    """
    with style():
        axes = new_axes(7.0, 2.6) if axes is None else axes
        heights = 100 * np.asarray(share, float)
        axes.bar(np.arange(heights.size), heights, color=color, width=0.7)
        every = max(1, heights.size // 24)
        axes.set_xticks(np.arange(0, heights.size, every), list(labels)[::every], rotation=90, fontsize=7)
        axes.set_ylabel("Share [%]")
        axes.set_title(title)
        axes.grid(True, axis="y")
        axes.tick_params(axis="x", length=0)
        axes.spines["left"].set_color(PALE)
    return axes


def plot_changes(
    labels: Sequence[str], percent: ArrayLike, std: ArrayLike | None = None, axes: Axes | None = None, *, title: str = ""
) -> Axes:
    """Change of each paired mode in per cent, with 95 % intervals.

    Parameters
    ----------
    labels : sequence of str
        Frequency of each mode before [Hz].
    percent : (n,) array
        Change of frequency, or of damping ratio.
    std : (n,) array, optional
        Standard deviations [%]; NaN where not known.
    axes : matplotlib Axes, optional
        Default: of a new figure.
    title : str
        Words above the axes.

    Returns
    -------
    matplotlib Axes

    Examples
    --------
    >>> import operando
    >>> operando.plots.plot_changes(["10.0", "20.0"], [1.5, -0.2]).get_ylabel()
    'Change [%]'
    """
    with style():
        axes = new_axes(6.0, 3.0) if axes is None else axes
        y = np.asarray(percent, float)
        spread = np.zeros(y.size) if std is None else INTERVAL * np.nan_to_num(np.asarray(std, float))
        x = np.arange(y.size)
        axes.bar(x, y, color=MODEL, width=0.62)
        axes.errorbar(x, y, yerr=spread, fmt="none", ecolor=INK, elinewidth=0.9, capsize=2.0)
        axes.axhline(0, color=GREY, lw=0.8)
        axes.set_xticks(x, list(labels), rotation=90 if y.size > 10 else 0, fontsize=7)
        axes.set_title(title)
        axes.set_ylabel("Change [%]")
        axes.set_xlabel("Idle frequency [Hz]")
        axes.grid(True, axis="y")
        axes.tick_params(axis="x", length=0)
    return axes


def _check_axes(axes: object) -> None:
    from matplotlib.axes import Axes

    if axes is not None:
        expect(axes, Axes, "the figure is drawn on matplotlib Axes", "all modes are drawn; leave it out for a new figure")


def _check(model: object) -> None:
    if not isinstance(model, ModalModel):
        raise ObjectError(f"modes of a {type(model).__name__} cannot be drawn", hint="give a ModalModel; of a hybrid model its .modal")
    if not model.n_modes:
        raise DataError("the model has no modes")

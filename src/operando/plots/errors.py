"""Figures of comparisons: error maps by DOF and band, error of each model, errors of one comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from operando.errors import DataError, ObjectError
from operando.plots.matrix import draw_matrix
from operando.plots.style import GREEN, GREY, IDLE, INK, MODEL, ORANGE, PURPLE, SKY, YELLOW_BROWN, new_axes, number, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MODEL_COLORS = {"ofrf": MODEL, "idle": IDLE, "idle_shapes": ORANGE, "msf_all": SKY, "effect": GREEN}
"""One colour a model, in every figure."""

LEAST_TOP = 0.5
"""The colour scale of an error map reaches at least so far [dB]."""


def document_of(found: Any, what: str, hint: str) -> dict[str, Any]:
    """A result as its document; one that is a document already is taken as it is."""
    if isinstance(found, Mapping):
        return dict(found)
    if not hasattr(found, "to_dict"):
        raise ObjectError(f"{what}, not {type(found).__name__}", hint=hint)
    return dict(found.to_dict())


def plot_error_map(
    values: ArrayLike,
    dofs: Sequence[object],
    edges_hz: ArrayLike,
    axes: Axes | None = None,
    *,
    top: float | None = None,
    measure: str = "Level error, rms [dB]",
    title: str = "",
) -> Axes:
    """Error by response DOF (rows) and frequency band (columns), the number in each cell.

    Parameters
    ----------
    values : (n_dofs, n_bands) array
        Of :func:`operando.compare.error_map`; NaN (a dash) where no line stands clear of the noise.
    dofs : sequence of Dof or str
        One DOF for each row.
    edges_hz : (n_bands + 1,) array
        Limits of the bands [Hz].
    axes : matplotlib Axes, optional
        Default: of a new figure, with a colour scale beside it.
    top : float, optional
        End of the colour scale; default: the greatest value. One scale for several maps makes them comparable.
    measure : str
        What the numbers are.
    title : str
        Words above the axes.

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    DataError
        If values and labels do not belong together.

    Examples
    --------
    >>> import operando
    >>> ax = operando.plots.plot_error_map([[0.5, 2.0]], ["1+Z"], [5, 20, 80])
    >>> [t.get_text() for t in ax.texts]
    ['0.5', '2.0']
    """
    table, edges = np.atleast_2d(np.asarray(values, float)), np.asarray(edges_hz, float)
    if table.shape != (len(dofs), edges.size - 1):
        raise DataError(f"errors {table.shape} do not belong to {len(dofs)} DOFs and {edges.size - 1} bands")
    top = error_top([table]) if top is None else top
    with style():
        own = axes is None
        axes = new_axes(7.0, min(1.2 + 0.27 * max(len(dofs), 3), 11)) if axes is None else axes
        draw_matrix(
            axes, table, [str(d) for d in dofs], [number(f, 3) for f in edges], colors=YELLOW_BROWN, top=top, dark=0.55 * top,
            text=lambda v: f"{v:.1f}" if v < 99.95 else f"{v:.0f}", square=False, limits=True,
        )  # fmt: skip
        axes.set_xlabel("Band limits [Hz]")
        axes.set_ylabel("Response DOF")
        axes.set_title(title)
        figure = axes.get_figure(root=True)
        if own and figure is not None:
            error_scale(figure.colorbar(axes.collections[0], ax=axes, pad=0.02, aspect=25), measure)
    return axes


def error_top(maps: Sequence[ArrayLike]) -> float:
    """End of one colour scale for several error maps."""
    values = np.concatenate([np.ravel(np.asarray(m, float)) for m in maps])
    finite = values[np.isfinite(values)]
    return max(float(finite.max()) if finite.size else 1.0, LEAST_TOP)


def error_scale(bar: Any, measure: str) -> None:
    """Words and numbers of the colour scale of error maps."""
    bar.set_label(measure)
    low, high = bar.mappable.get_clim()
    bar.set_ticks([low, (low + high) / 2, high], labels=[f"{v:.2g}" for v in (low, (low + high) / 2, high)])
    bar.outline.set_visible(False)


def plot_errors(
    names: Sequence[str],
    error_db: ArrayLike,
    axes: Axes | None = None,
    *,
    keys: Sequence[str] | None = None,
    noise_floor_db: float | None = None,
    label: str = "Level error, rms over lines and pairs [dB]",
) -> Axes:
    """Level error of each model as a bar, with the noise floor as a line.

    Parameters
    ----------
    names : sequence of str
        Words for each model.
    error_db : (n,) array [dB]
        Level error of each model [dB].
    axes : matplotlib Axes, optional
        Default: of a new figure.
    keys : sequence of str, optional
        Keys of ``comparison.json``, which give each model its colour.
    noise_floor_db : float, optional
        What noise and model uncertainty explain [dB].
    label : str
        Words under the axis.

    Returns
    -------
    matplotlib Axes

    Examples
    --------
    >>> import operando
    >>> ax = operando.plots.plot_errors(["operational FRFs", "idle model"], [0.3, 5.0], noise_floor_db=0.2)
    >>> [t.get_text().strip() for t in ax.texts]
    ['0.30 dB', '5.00 dB', 'noise floor 0.20 dB']
    """
    values = np.asarray(error_db, float)
    keys = list(names) if keys is None else list(keys)
    with style():
        axes = new_axes(7.6, 0.8 + 0.34 * values.size) if axes is None else axes
        axes.barh(np.arange(values.size), values, color=[MODEL_COLORS.get(k, PURPLE) for k in keys], height=0.66)
        for i, v in enumerate(values):
            white = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}  # over the line of the noise floor
            axes.annotate(
                f"{v:.2f} dB", (v, i), (4, 0), textcoords="offset points", va="center", fontsize=8.5,
                fontweight="bold" if keys[i] == "ofrf" else "normal", bbox=white, zorder=5,
            )  # fmt: skip
        if noise_floor_db is not None:
            axes.axvline(noise_floor_db, color=INK, lw=1.0, ls=(0, (3, 2)))
            words, where = f"noise floor {noise_floor_db:.2f} dB", (noise_floor_db, 1.0)
            axes.annotate(words, where, (2, 1), xycoords=("data", "axes fraction"), textcoords="offset points", fontsize=7.5)
        axes.set_yticks(np.arange(values.size), list(names), fontsize=8.5)
        axes.invert_yaxis()
        axes.set_xlim(0, 1.18 * max(float(np.nanmax(values)), 1e-9))
        axes.set_xlabel(label)
        axes.tick_params(axis="y", length=0)
    return axes


def plot_comparison(comparison: Any, axes: Axes | None = None, *, by: str = "dof") -> Axes:
    """Level error of one comparison by response DOF, by frequency band, or by mode.

    Parameters
    ----------
    comparison : Comparison or mapping
        A comparison, or one of the models of ``comparison.json``.
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
    >>> import numpy as np, operando
    >>> line = np.linspace(5, 50, 200)
    >>> one = operando.Frf((1 / (30.0**2 - line**2 + 18j * line))[None, None], line, "1+Z", "1+Z")
    >>> other = operando.Frf(1.1 * one.data, line, "1+Z", "1+Z")
    >>> operando.plots.plot_comparison(operando.compare(other, one)).get_ylabel()
    'Level error, rms [dB]'
    """
    told = document_of(comparison, "a comparison is drawn", "compare(model, measured) makes one")
    rows = [dict(r) for r in told.get(f"by_{by}") or ()]
    axes = draw_errors(rows, axes, by=by, floor=told.get("noise_floor_db"), hint="; ".join(told.get("notes") or ()) or None)
    if told.get("error_db") is not None:
        with style():
            axes.set_title(f"Level error {told['error_db']:.2f} dB over all lines and pairs")
    return axes


def draw_errors(rows: Sequence[dict[str, Any]], axes: Axes | None, *, by: str, floor: float | None, hint: str | None = None) -> Axes:
    """One bar for each row of ``by_dof``, ``by_band`` or ``by_mode``: the level error, or the reduced chi-square where there is none."""
    if by not in ("dof", "band", "mode"):
        raise DataError(f"errors by {by!r} are not known", hint="use dof, band or mode")
    if not rows:
        raise DataError(f"the comparison has no errors by {by}", hint=hint)
    key = "height_error_db" if by == "mode" else "error_db"
    chi = all(r.get(key) is None for r in rows) and any(r.get("misfit") is not None for r in rows)
    values = np.array([np.nan if (v := r.get("misfit" if chi else key)) is None else float(v) for r in rows])
    words = {"dof": "Response DOF", "band": "Frequency band [Hz]", "mode": "Mode of the measurement [Hz]"}[by]
    if by == "dof":
        labels = [str(r["dof"]) for r in rows]
    elif by == "band":
        labels = ["{}–{}".format(*(number(f, 3) for f in r["band_hz"])) for r in rows]
    else:
        labels = [number(r["frequency_hz"], 4) for r in rows]
    with style():
        axes = new_axes(max(5.0, 1.5 + 0.34 * values.size), 3.4) if axes is None else axes
        axes.bar(np.arange(values.size), values, color=MODEL, width=0.66)
        axes.axhline(1 if chi else 0, color=GREY, lw=0.8)
        if floor is not None and by != "mode" and not chi:
            axes.axhline(floor, color=INK, lw=1.0, ls=(0, (3, 2)), label=f"noise floor {floor:.2f} dB")
            axes.legend(loc="best")
        axes.set_xticks(np.arange(values.size), labels, rotation=90 if values.size > 8 or by != "dof" else 0)
        axes.set_xlabel(words)
        axes.set_ylabel("Reduced χ² (1 = noise)" if chi else "Height error [dB]" if by == "mode" else "Level error, rms [dB]")
        if chi:
            axes.set_yscale("log")
        axes.tick_params(axis="x", length=0)
        axes.grid(True, axis="y")
    return axes

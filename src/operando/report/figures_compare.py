"""Figures of the comparison: error of each model, error by DOF and band, frequency and height by mode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.report.maps import value_maps
from operando.report.svg import GREEN, GREY, IDLE, INK, MODEL, ORANGE, PURPLE, SKY, drawn, new_figure
from operando.report.text import number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLORS = {"ofrf": MODEL, "idle": IDLE, "idle_shapes": ORANGE, "msf_all": SKY, "effect": GREEN}


def error_bars(names: Sequence[str], keys: Sequence[str], error_db: ArrayLike, noise_floor_db: float | None) -> str:
    """SVG: rms dB error of each model as a bar, with the noise floor as a line.

    Parameters
    ----------
    names, keys : sequences of str
        Words and key of each model.
    error_db : array [dB]
    noise_floor_db : float or None
        What noise and model uncertainty explain [dB].
    """
    return _error_bars(names, keys, error_db, noise_floor_db)


@drawn
def _error_bars(names: Sequence[str], keys: Sequence[str], error_db: ArrayLike, noise_floor_db: float | None) -> tuple[Figure, str]:
    values = np.asarray(error_db, float)
    height = 0.62 + 0.3 * values.size
    figure = new_figure(7.6, height)
    axes = figure.add_axes((0.36, 0.42 / height, 0.56, (height - 0.58) / height))
    axes.barh(np.arange(values.size), values, color=[_COLORS.get(k, PURPLE) for k in keys], height=0.66)
    for i, v in enumerate(values):
        axes.text(v, i, f" {v:.2f} dB", va="center", fontsize=8.5, fontweight="bold" if keys[i] == "ofrf" else "normal")
    if noise_floor_db is not None:
        axes.axvline(noise_floor_db, color=INK, lw=1.0, ls=(0, (3, 2)))
        axes.annotate(
            f"noise floor {noise_floor_db:.2f} dB",
            (noise_floor_db, 1.0),
            (2, 1),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            fontsize=7.5,
        )
    axes.set_yticks(np.arange(values.size), list(names), fontsize=8.5)
    axes.invert_yaxis()
    axes.set_xlim(0, 1.18 * max(float(np.nanmax(values)), 1e-9))
    axes.set_xlabel("Level error against the check, rms over lines and pairs [dB]")
    axes.tick_params(axis="y", length=0)
    return figure, "Error of each model in dB: " + ", ".join(f"{n} {v:.2f}" for n, v in zip(names, values, strict=True))


def error_maps(
    maps: Sequence[tuple[str, NDArray[np.float64]]], rows: Sequence[str], edges: ArrayLike, measure: str = "Level error, rms [dB]"
) -> str:
    """SVG: error by response DOF (rows) and frequency band (columns), one map a model, one colour scale.

    Parameters
    ----------
    maps : sequence of (title, (n_rows, n_bands) array); NaN where no line stands clear of the noise
    rows : sequence of str
    edges : (n_bands + 1,) array [Hz]
    measure : str
        What the numbers are.
    """
    limits = [number(f, 3) for f in np.asarray(edges, float)]
    alt = "Error by response DOF and frequency band: " + ", ".join(title for title, _ in maps)
    return value_maps(maps, rows, limits, measure, ("Band limits [Hz]", "Response DOF"), alt)


def frequency_changes(
    labels: Sequence[str], frequency_percent: ArrayLike, damping_percent: ArrayLike, frequency_std: ArrayLike, damping_std: ArrayLike
) -> str:
    """SVG: change of frequency and of damping ratio from rest to operation for each paired mode, with 95 % intervals.

    Parameters
    ----------
    labels : sequence of str
    frequency_percent, damping_percent : arrays [%]
    frequency_std, damping_std : arrays [%]
        Standard deviations; NaN where not known.
    """
    return _frequency_changes(labels, frequency_percent, damping_percent, frequency_std, damping_std)


@drawn
def _frequency_changes(
    labels: Sequence[str], frequency_percent: ArrayLike, damping_percent: ArrayLike, frequency_std: ArrayLike, damping_std: ArrayLike
) -> tuple[Figure, str]:
    figure = new_figure(10.2, 2.5)
    for left, values, std, title, unit in (
        (0.06, frequency_percent, frequency_std, "Frequency, operating against idle", "Change [%]"),
        (0.56, damping_percent, damping_std, "Damping ratio, operating against idle", "Change [%]"),
    ):
        axes = figure.add_axes((left, 0.3, 0.43, 0.57))
        y = np.asarray(values, float)
        spread = 1.96 * np.nan_to_num(np.asarray(std, float))
        x = np.arange(y.size)
        axes.bar(x, y, color=MODEL, width=0.62)
        axes.errorbar(x, y, yerr=spread, fmt="none", ecolor=INK, elinewidth=0.9, capsize=2.0)
        axes.axhline(0, color=GREY, lw=0.8)
        axes.set_xticks(x, list(labels), rotation=90 if y.size > 10 else 0, fontsize=7)
        axes.set_title(title)
        axes.set_ylabel(unit)
        axes.set_xlabel("Idle frequency [Hz]")
        axes.grid(True, axis="y")
        axes.tick_params(axis="x", length=0)
    return figure, "Change of frequency and damping ratio of each mode from rest to operation"

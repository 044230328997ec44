"""Figures of diagnoses from records: the restoring force at the place found, what it is equivalent to at each level, the simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from operando.indicators import INTERVAL
from operando.report.svg import GREEN, GREY, IDLE, MEASURED, SKY, dots, drawn, new_figure
from operando.report.text import number
from operando.units import engineering_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@drawn
def force_figure(picture: Mapping[str, Any], title: str) -> tuple[Figure, str]:
    """SVG: restoring force at a place over displacement and over velocity, as the records show it, with the fitted law.

    Parameters
    ----------
    picture : dict
        One entry of ``picture.restoring_force`` in ``diagnosis.json``.
    """
    figure = new_figure(10.2, 3.3)
    force = np.asarray(picture["force"], float)
    for k, (name, unit) in enumerate((("displacement", "m"), ("velocity", "m/s"))):
        axes = figure.add_axes((0.085 + 0.495 * k, 0.155, 0.4, 0.66))
        over = np.asarray(picture[name], float)
        factor, written = engineering_unit(float(np.max(np.abs(over))), unit)
        rows = picture.get("binned" if k == 0 else "binned_velocity") or {}
        at, mean, spread = (np.asarray(rows.get(key) or [], float) for key in (name, "force", "force_std"))
        axes.axhline(0, color=GREY, lw=0.8)
        dots(axes, over / factor, force, SKY, 2.0, "from the records, sample by sample")
        axes.errorbar(at / factor, mean, INTERVAL * spread, color=MEASURED, lw=0, elinewidth=0.9, marker="o", ms=3, label="mean, ± 95 %")
        if rows.get("law"):
            axes.plot(at / factor, np.asarray(rows["law"], float), color=IDLE, lw=1.8, ls=(0, (4, 2)), label="force law fitted, mean")
        axes.set_xlabel(f"{name.capitalize()} [{written}]")
        axes.set_ylabel("Restoring force [N]")
        axes.set_title(title if k == 0 else "", fontsize=9.5)
        axes.grid(True)
        if k == 0:
            figure.legend(*axes.get_legend_handles_labels(), loc="upper right", ncols=3, bbox_to_anchor=(0.985, 1.01))
    return figure, f"Restoring force over displacement and velocity with the fitted force law: {title}"


@drawn
def level_figure(rows: Sequence[Mapping[str, Any]], title: str) -> tuple[Figure, str]:
    """SVG: spring and damper that a level-dependent effect is equivalent to, over the motion across its place.

    Parameters
    ----------
    rows : sequence of dict
        ``equivalents`` of an effect in ``diagnosis.json``.
    """
    figure = new_figure(10.2, 2.5)
    order = sorted(rows, key=lambda r: r["displacement"])
    x = np.array([r["displacement"] for r in order])
    factor, length = engineering_unit(float(x.max()), "m")
    for k, (name, unit, color) in enumerate((("stiffness", "N/m", GREEN), ("damping", "N s/m", IDLE))):
        axes: Axes = figure.add_axes((0.085 + 0.495 * k, 0.2, 0.4, 0.64))
        axes.plot(x / factor, [r[name] for r in order], color=color, marker="o", ms=4, lw=1.2)
        for r in order:
            at = (r["displacement"] / factor, r[name])
            axes.annotate(f"{number(r['level'], 3)} {r['unit']}", at, (4, 5), textcoords="offset points", fontsize=8)
        axes.axhline(0, color=GREY, lw=0.8)
        axes.margins(0.12, 0.2)
        if name == "damping":  # an elastic law damps nothing: its figures are rounding beside what its stiffness would make of velocity
            least = 0.1 * max(abs(r["stiffness"]) * r["displacement"] / max(r["velocity"], 1e-300) for r in order)
            low, high = axes.get_ylim()
            axes.set_ylim(min(low, -least), max(high, least))
        axes.set_xlabel(f"Displacement across the location, rms [{length}]")
        axes.set_ylabel(f"Equivalent {name} [{unit}]")
        axes.set_title(title if k == 0 else "", fontsize=9.5)
        axes.grid(True)
    return figure, f"Equivalent stiffness and damping at each level: {title}"


@drawn
def frf_figure(levels: Mapping[str, Any]) -> tuple[Figure, str]:
    """SVG: one FRF of the model with effects at the levels measured and at twice the highest, and what was measured.

    Parameters
    ----------
    levels : dict
        ``picture.levels`` of ``diagnosis.json``.
    """
    figure = new_figure(10.2, 3.4)
    axes = figure.add_axes((0.075, 0.15, 0.91, 0.74))
    db = lambda values: 20 * np.log10(np.maximum(np.asarray(values, float), 1e-12))  # noqa: E731
    for run in levels.get("runs") or []:
        dots(
            axes, np.asarray(run["frequencies_hz"], float), db(run["magnitude"]), SKY, 2.0, f"measured, {run['level_name'] or run['name']}"
        )
    hz = np.asarray(levels["frequencies_hz"], float)
    colors = (GREEN, MEASURED, IDLE)
    for curve, color in zip(levels["curves"], colors[-len(levels["curves"]) :], strict=False):
        style = "-" if curve["measured"] else (0, (4, 2))
        words = "model" if curve["measured"] else "model, not measured"
        axes.plot(hz, db(curve["magnitude"]), color=color, lw=1.3, ls=style, label=f"{words}, {number(curve['force_n'], 3)} N")
    axes.set_xlim(hz[0], hz[-1])
    axes.set_xlabel("Frequency [Hz]")
    axes.set_ylabel("Accelerance [dB re 1 (m/s²)/N]")
    axes.set_title(f"{levels['response']} under a force at {levels['reference']}", fontsize=9.5)
    axes.grid(True)
    axes.legend(loc="best", ncols=2)
    return figure, f"FRF {levels['response']} over {levels['reference']} at several levels of the force"


@drawn
def simulation_figure(figure: Mapping[str, Any]) -> tuple[Figure, str]:
    """SVG: measured and simulated response side by side, the idle model's beside them.

    Parameters
    ----------
    figure : dict
        ``simulation.figure`` of ``diagnosis.json``: ``time_s``, ``measured``, ``idle``, ``simulated`` [m/s²], ``dof``, ``record``.
    """
    sheet = new_figure(10.2, 3.8)
    time = np.asarray(figure["time_s"], float)
    measured = np.asarray(figure["measured"], float)
    span = 1.1 * float(np.max(np.abs(measured)))
    for k, (name, color, words) in enumerate((("idle", IDLE, "idle model"), ("simulated", GREEN, "idle model with the effects"))):
        axes = sheet.add_axes((0.075, 0.53 - 0.4 * k, 0.91, 0.35))
        axes.plot(time, measured, color=MEASURED, lw=1.5, label="measured")
        axes.plot(time, np.asarray(figure[name], float), color=color, lw=1.1, ls=(0, (4, 2)), label=words)
        axes.set_xlim(time[0], time[-1])
        axes.set_ylim(-span, span)
        axes.set_ylabel("[m/s²]")
        axes.grid(True)
        axes.legend(loc="upper right", ncols=2)
        if k == 0:
            axes.set_title(f"Acceleration at {figure['dof']}", fontsize=9.5)
            axes.tick_params(labelbottom=False)
        else:
            axes.set_xlabel("Time in the record [s]")
    return sheet, f"Measured and simulated acceleration at {figure['dof']}, without and with the effects"

"""One small drawing for each kind of effect, made from what the kind itself computes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

LINES = np.linspace(4.0, 60.0, 450)
MASSES = np.array([4.0, 3.0, 3.0, 2.0])
SPRINGS = np.array([3e4, 9e4, 9e4, 6e4])
DAMPING = 4e-4
"""A chain of four masses; damping in proportion to stiffness [s]."""
WHERE, OTHER = 3, 1
"""Masses at which an effect of one, or of two DOFs acts; the FRF drawn is that of ``WHERE`` driven at ``OTHER``."""
SIZES = {"kg": 0.8, "N/m": 3e4, "N s/m": 60.0, "Hz": 31.0, "s": 2e-3, "m": 1e-3, "N": 8.0, "N/m3": 6e10, "N/m2": 3e7, "N s2/m2": 700.0}
"""Parameter values that can be seen on the chain, by unit; without a unit by name, else the kind's own start."""
RATIOS = {"change": 0.3, "gain": 1.6, "damping_ratio": 0.05}
STROKE, SPEED_HZ = 2e-3, 5.0
"""Amplitude [m] and frequency of the motion along which a restoring force is drawn."""
BEFORE, AFTER = "#8a8f98", "#d9480f"


def matrices() -> tuple[np.ndarray, np.ndarray]:
    """Mass and stiffness matrix of the chain."""
    k = np.diag(SPRINGS + np.r_[SPRINGS[1:], 0.0]) - np.diag(SPRINGS[1:], 1) - np.diag(SPRINGS[1:], -1)
    return np.diag(MASSES), k


def values_of(kind: Any) -> dict[str, float]:
    """Values of all parameters that show on the chain."""
    out = {}
    for p in (*kind.parameters, *kind.constants):
        size = SIZES.get(p.unit) if p.unit else RATIOS.get(p.name)
        if p.name == "slip_speed":
            size = 0.0
        value = p.start((LINES[0], LINES[-1])) if size is None else size
        low, high = p.bounds((LINES[0], LINES[-1]))
        out[p.name] = float(np.clip(value, low, high))
    return out


def frf(added: np.ndarray | None = None, rows: np.ndarray | None = None) -> np.ndarray:
    """Accelerance of the chain, with a dynamic stiffness (lines, p, p) over the rows (p, 4) added."""
    mass, stiffness = matrices()
    omega = 2 * np.pi * LINES
    dynamic = stiffness * (1 + 1j * omega[:, None, None] * DAMPING) - omega[:, None, None] ** 2 * mass
    if added is not None and rows is not None:
        dynamic = dynamic + rows.T @ added @ rows
    return -(omega[:, None, None] ** 2) * np.linalg.inv(dynamic)


def chain_model() -> Any:
    """The chain as a modal model."""
    import operando

    mass, stiffness = matrices()
    root = np.sqrt(np.diag(mass))
    values, vectors = np.linalg.eigh(stiffness / root[:, None] / root)
    omega = np.sqrt(values)
    dofs = tuple(operando.Dof.parse(f"{i + 1}+Z") for i in range(len(root)))
    return operando.ModalModel(omega / 2 / np.pi, DAMPING * omega / 2, vectors / root[:, None], dofs, "unit_modal_mass")


def _rows(kind: Any) -> np.ndarray:
    unit = np.eye(len(MASSES))
    if kind.places == 2:
        return unit[[WHERE, OTHER]] if kind.coordinates == "separate" else unit[[WHERE]] - unit[[OTHER]]
    return unit[[WHERE]]


def curves(kind: Any) -> tuple[np.ndarray, np.ndarray | None, np.ndarray, str, str]:
    """Abscissa, curve before (or None), curve after, and the names of both axes."""
    values, idle = values_of(kind), frf()[:, WHERE, OTHER]
    decibel = lambda h: 20 * np.log10(np.abs(h))  # noqa: E731
    hz, level = "frequency [Hz]", "accelerance [dB]"
    if kind.acts == "pseudo_force":
        t = np.arange(0, 2 / SPEED_HZ, 1e-5)
        x, v = STROKE * np.sin(2 * np.pi * SPEED_HZ * t), STROKE * 2 * np.pi * SPEED_HZ * np.cos(2 * np.pi * SPEED_HZ * t)
        force, half = kind.over_steps(x, v, values, 1e-5), t.size // 2
        if getattr(kind, "uses_velocity", False) and not getattr(kind, "has_state", False):
            return v[half:], None, force[half:], "velocity [m/s]", "force [N]"
        return 1e3 * x[half:], None, force[half:], "displacement [mm]", "force [N]"
    if kind.acts == "dynamic_stiffness":
        rows = _rows(kind)
        added = kind.matrix(2j * np.pi * LINES, values, rows.shape[0])
        return LINES, decibel(idle), decibel(frf(added, rows)[:, WHERE, OTHER]), hz, level
    if kind.acts in ("modal_change", "added_mode"):
        model = chain_model()
        changed = model
        if kind.acts == "modal_change":
            changed = kind.modal_change(model, values)
        else:
            changed = kind.added_mode(model, values, 0.5 * np.ones(len(MASSES)))
        names = {"responses": f"{WHERE + 1}+Z", "references": f"{OTHER + 1}+Z"}
        before, after = (m.frf(LINES, variance=False, **names).data[0, 0] for m in (model, changed))
        return LINES, decibel(before), decibel(after), hz, level
    if kind.acts == "sensor_map":
        if kind.places == 2:
            return LINES, decibel(idle), decibel(frf()[:, OTHER, OTHER]), hz, level
        factor = kind.sensor_map(LINES, values)
        if np.ptp(np.abs(factor)) < 1e-9 and abs(abs(factor[0]) - 1) < 1e-9:
            turn = lambda h: np.degrees(np.angle(h))  # noqa: E731
            return LINES, turn(idle), turn(idle * factor), hz, "phase [°]"
        return LINES, decibel(idle), decibel(idle * factor), hz, level
    spectrum = decibel(idle) + 3 * np.random.default_rng(2).standard_normal(LINES.size)
    lined = spectrum.copy()
    for order in (12.5, 25.0, 37.5, 50.0):
        lined[np.argmin(np.abs(LINES - order))] += 35
    return LINES, spectrum, lined, hz, "response spectrum [dB]"


def draw(kind: Any, file: Path) -> None:
    """The drawing of a kind as SVG."""
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    x, before, after, along, up = curves(kind)
    with mpl.rc_context({"svg.hashsalt": kind.kind, "svg.fonttype": "none", "font.size": 8, "font.family": "sans-serif"}):
        figure = Figure(figsize=(3.4, 2.0), layout="constrained")
        FigureCanvasSVG(figure)
        axes = figure.add_subplot()
        if before is not None:
            axes.plot(x, before, color=BEFORE, lw=1.2)
        axes.plot(x, after, color=AFTER, lw=1.2)
        axes.set_xlabel(along)
        axes.set_ylabel(up)
        axes.spines[["top", "right"]].set_visible(False)
        figure.savefig(file, format="svg", metadata={"Date": None})

"""Draws docs/operando.png of the README from the results folder of `make demo`.

    python benchmarks/readme_figure.py [demo-results]

One pair of the example in its running state: measured on the shaker, by operando from output-only data, and by the model
at rest; beside it the errors over all measured pairs from comparison.json.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import NullFormatter

from operando.store import load_results

ROOT = Path(__file__).resolve().parents[1]
RESPONSE, REFERENCE = "13+Z", "12+Z"
COLOURS = {"measured": "#222222", "ofrf": "#d55e00", "idle": "#0072b2", "idle_shapes": "#8aa9c4", "msf_all": "#b9a58c"}
OWN = "operando: idle model + accelerations of the running machine"
NAMES = {"idle": "idle model", "idle_shapes": "idle shapes,\noperational poles", "msf_all": "all shapes\nby MSF", "ofrf": "operando"}


def magnitude(values: np.ndarray) -> np.ndarray:
    """dB re 1 (m/s²)/N."""
    return 20 * np.log10(np.abs(values))


def main(folder: Path) -> None:
    """Draw and save."""
    results = load_results(folder)
    comparison = json.loads((folder / "comparison.json").read_text(encoding="utf-8"))
    low, high = results.settings.get("band") or results.idle.band_hz
    frequencies = np.linspace(low, high, 3000)
    plt.rcParams.update({"font.size": 10, "font.family": "DejaVu Sans", "axes.spines.top": False, "axes.spines.right": False})
    figure, (left, right) = plt.subplots(1, 2, figsize=(11.5, 4.0), width_ratios=(3.3, 1), layout="constrained")

    check = results.check[0].frf.select(responses=(RESPONSE,), references=(REFERENCE,))
    lines = check.axis.values
    inside = (lines >= low) & (lines <= high)
    left.plot(
        lines[inside],
        magnitude(check.data[0, 0, inside]),
        color=COLOURS["measured"],
        lw=3.2,
        alpha=0.35,
        label="measured with a shaker (validation)",
    )
    idle = results.idle.frf(frequencies, RESPONSE, REFERENCE).data[0, 0]
    left.plot(frequencies, magnitude(idle), color=COLOURS["idle"], lw=1.2, ls=(0, (4, 2)), label="idle model")
    running = results.hybrid.frf(frequencies, RESPONSE, REFERENCE)
    if running.variance is not None:
        spread = 1.96 * np.sqrt(running.variance[0, 0] / 2)
        size = np.abs(running.data[0, 0])
        bounds = magnitude(np.maximum(size - spread, 0.05 * size)), magnitude(size + spread)
        left.fill_between(frequencies, *bounds, color=COLOURS["ofrf"], alpha=0.25, lw=0)
    left.plot(
        frequencies,
        magnitude(running.data[0, 0]),
        color=COLOURS["ofrf"],
        lw=1.3,
        label="operando: idle model + accelerations of the running machine",
    )
    left.set(xlim=(low, high), xlabel="Frequency [Hz]", ylabel="Accelerance [dB re 1 (m/s²)/N]")
    left.set_title(f"The running machine, response {RESPONSE}, force {REFERENCE}", loc="left", fontsize=11)
    left.set_ylim(left.get_ylim()[0] - 24, None)
    left.set_xscale("log")
    left.set_xticks([5, 10, 20, 50, 100], ["5", "10", "20", "50", "100"])
    left.xaxis.set_minor_formatter(NullFormatter())
    left.grid(alpha=0.25, lw=0.5)
    left.legend(frameon=False, loc="lower left", fontsize=9)

    models = [name for name in ("idle", "idle_shapes", "msf_all", "ofrf") if name in comparison["models"]]
    errors = [comparison["models"][name]["error_db"] for name in models]
    bars = right.barh([NAMES[name] for name in models], errors, color=[COLOURS[name] for name in models], height=0.62)
    right.bar_label(bars, [f"{error:.2f} dB" for error in errors], padding=3, fontsize=9)
    right.set_xlim(0, 1.35 * max(errors))
    right.invert_yaxis()
    right.set_xticks([])
    right.spines["bottom"].set_visible(False)
    right.tick_params(axis="y", length=0)
    right.set_title("Error against the validation\nmeasurement, all pairs", loc="left", fontsize=11)

    target = ROOT / "docs" / "operando.png"
    target.parent.mkdir(exist_ok=True)
    figure.savefig(target, dpi=110, metadata={"Software": None})
    print(f"{target.relative_to(ROOT)}: {target.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "demo-results")

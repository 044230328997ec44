"""The experiment in kind in the report: tables and figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import figures
import legs
import numpy as np
import published
from checks import Check
from experiment import BAND, INPUTS, LINES, OUTPUTS, SELECTIONS, THRESHOLD, Experiment, frf
from legs import DOFS, State
from tables import esc, table

from operando.indicators import mac
from operando.report.figures_modes import mac_matrices

Array = np.ndarray

SHOWN = (("3+Z", "1+Z"), ("5+Z", "9+Z"), ("8+Z", "1+Z"), ("11+Z", "9+Z"))
"""Output and input of the OFRFs drawn."""


def experiment_checks(study: Experiment) -> list[Check]:
    """What the experiment in kind must show."""
    auto, others = study.errors["auto"], {k: v for k, v in study.errors.items() if k != "auto"}
    worst = lambda e: max(e["A"], e["B"])  # noqa: E731
    best = min(others, key=lambda k: worst(others[k]))
    found = found_modes(study)
    inside = min(study.inside["A"], study.inside["B"])
    return [
        Check(
            "experiment in kind, modes",
            "; ".join(f"{name} {good} of {all_}, {extra} spurious" for name, (good, all_, extra) in found.items()),
            "every mode in band, none spurious",
            all(good == all_ and extra == 0 for good, all_, extra in found.values()),
        ),
        Check(
            "experiment in kind, OFRFs",
            f"auto {auto['A']:.2f} (A), {auto['B']:.2f} (B) dB; best {worst(others[best]):.2f} ({best}), "
            f"msf_all {worst(others['msf_all']):.2f}, idle_shapes {worst(others['idle_shapes']):.2f}",
            "auto ≤ best + 0.2, ≤ msf_all, < idle_shapes",
            worst(auto) <= worst(others[best]) + 0.2
            and worst(auto) <= worst(others["msf_all"])
            and worst(auto) < worst(others["idle_shapes"]),
        ),
        Check(
            "experiment in kind, OFRFs from A against those from B",
            f"{auto['between']:.2f} dB; errors {auto['A']:.2f} and {auto['B']:.2f} dB",
            "less than either error",
            auto["between"] < min(auto["A"], auto["B"]),
        ),
        Check("experiment in kind, 95 % bands", f"{100 * inside:.0f} % of lines (the less of A and B)", "90 %", inside >= 0.9),
    ]


def found_modes(study: Experiment) -> dict[str, tuple[int, int, int]]:
    """EMA results and OMA → exact modes found in band, how many there are, and modes too many."""
    out = {}
    for name, state, model in (
        ("A", study.at_rest, study.idle["A"]),
        ("B", study.at_rest, study.idle["B"]),
        ("OMA", study.running, study.operating),
    ):
        hz = model.frequencies_hz
        hz = hz[(hz > BAND[0]) & (hz < BAND[1])]
        exact = in_band(state)
        good = int(np.sum([np.any(np.abs(hz / f - 1) < 0.01) for f in exact]))
        out[name] = good, exact.size, max(hz.size - good, 0)
    return out


def in_band(state: State) -> Array:
    """Exact frequencies in the band."""
    return state.hz[(state.hz > BAND[0]) & (state.hz < BAND[1])]


def experiment_section(study: Experiment, say: Callable[[str], str], draw: Callable[[str, str], str]) -> str:
    """The whole section; ``draw`` makes a numbered figure of an SVG and a caption."""
    side, thickness = 1000 * legs.SIDE, 1000 * legs.THICKNESS
    text = say(
        "The paper's experiment cannot be repeated without its plate. This one is <b>simulated</b> in kind: a steel plate of "
        f"{side:.0f} × {side:.0f} × {thickness:.0f} mm on three legs, {study.at_rest.total_mass:.1f} kg. At rest two feet are bolted down "
        "and the third only stands on the floor; in operation it is bolted too, and an exciter pushes obliquely with a force that nobody "
        "records. Twelve accelerometers, one tri-axial: 14 DOFs; 0.5 % noise. What the paper does not print (legs, places, contact) is "
        "chosen here, so the frequencies are of the kind of Table A4, not equal to them."
    ) + say(
        f"The EMA is made twice from different FRFs: A from hammer strikes at {', '.join(SELECTIONS['A'])}, B at "
        f"{', '.join(SELECTIONS['B'])}. The paper could hold its OFRFs against each other only; here they can be held against the exact "
        "ones too."
    )
    return text + _frequencies(study) + _errors(study, say) + _figures(study, draw)


def _frequencies(study: Experiment) -> str:
    rest, running = in_band(study.at_rest), in_band(study.running)
    columns = {
        "paper, at rest": published.EXPERIMENT_A4[:, 0],
        "exact, at rest": rest,
        "EMA A": _nearest(study.idle["A"].frequencies_hz, rest),
        "EMA B": _nearest(study.idle["B"].frequencies_hz, rest),
        "paper, operating": published.EXPERIMENT_A4[:, 1],
        "exact, operating": running,
        "OMA": _nearest(study.operating.frequencies_hz, running),
    }
    rows = []
    for k in range(max(len(v) for v in columns.values())):
        rows.append([str(k + 1), *("" if k >= len(v) else "missed" if not np.isfinite(v[k]) else f"{v[k]:.2f}" for v in columns.values())])
    caption = "Natural frequencies [Hz] beside the paper's Table A4 (another plate: alike in kind only)."
    return table(["Mode", *columns], rows, range(8), caption, wide=True)


def _nearest(found: Array, exact: Array) -> Array:
    """The found frequency within 1 % of each exact one, or NaN."""
    out = np.full(exact.size, np.nan)
    for k, f in enumerate(exact):
        j = int(np.argmin(np.abs(found / f - 1)))
        if abs(found[j] / f - 1) < 0.01:
            out[k] = found[j]
    return out


def _errors(study: Experiment, say: Callable[[str], str]) -> str:
    words: Mapping[str, str] = {
        "idle_shapes": "idle shapes",
        "msf_all": "MSF for all",
        "sqrt_mac": "MSF over √MAC for all",
        "eq13": "Eq 13 on the changed",
        "eq15": "Eq 15 on the changed",
        "eq20": "Eq 20 on all, changed columns",
        "expansion": "expansion, mass as at rest",
        "expansion_stiffness": "expansion, stiffness as at rest",
        "auto": "operando, auto",
    }
    rows = [
        [esc(text), *(f"{study.errors[name][key]:.2f}" for key in ("A", "B", "between"))]
        for name, text in words.items()
        if name in study.errors
    ]
    caption = (
        f"Error of OFRFs [dB rms over {LINES[0]:g}–{LINES[-1]:g} Hz, {len(OUTPUTS)} outputs from {len(INPUTS)} inputs], and the difference "
        "between those from A and those from B."
    )
    inside = study.inside
    bands = say(
        f"The 95 % bands hold the exact OFRF on {100 * inside['A']:.0f} % (A) and {100 * inside['B']:.0f} % (B) of all lines; the OFRFs "
        f"from A and B lie within both bands together on {100 * inside['between']:.0f} %. Stability between two EMA results says nothing "
        "of what they have in common: every method is nearly as stable as another, and their errors differ."
    )
    return table(["", "A", "B", "A against B"], rows, range(1, 4), caption, mine=[len(rows) - 1]) + bands


def _figures(study: Experiment, draw: Callable[[str, str], str]) -> str:
    n, m = in_band(study.at_rest).size, in_band(study.running).size
    first = int(np.searchsorted(study.at_rest.hz, BAND[0])), int(np.searchsorted(study.running.hz, BAND[0]))
    rest, running = study.at_rest.shapes[:, first[0] : first[0] + n], study.running.shapes[:, first[1] : first[1] + m]
    rows, columns = ([f"{f:.0f}" for f in in_band(s)] for s in (study.at_rest, study.running))
    changed = [
        f"{study.operating.frequencies_hz[p.operating]:.1f} Hz ({p.mac:.2f})"
        for p in study.hybrid["A"].pairing.pairs
        if p.kind == "changed"
    ]
    out = draw(
        mac_matrices([("two feet bolted, and three", mac(rest, running), rows, columns, "at rest [Hz]", "operating [Hz]")]),
        f"MAC of exact modes. Changed at ε = {THRESHOLD} (as identified, A): {', '.join(changed) or 'none'}.",
    )
    curves: dict[str, Array] = {}
    exact, idle = (frf(s, LINES, INPUTS) for s in (study.running, study.at_rest))
    pick = lambda data: np.array([data[DOFS.index(o), INPUTS.index(i)] for o, i in SHOWN])  # noqa: E731
    curves["exact"], curves["idle"] = pick(exact), pick(idle)
    for name, key in (("A", "auto"), ("B", "from_b")):
        curves[key] = np.array([study.hybrid[name].frf(LINES, (o,), (i,)).data[0, 0] for o, i in SHOWN])
    svg = figures.operational_frfs(curves, [f"{o} from {i}" for o, i in SHOWN], "", BAND, LINES)
    return out + draw(svg, "OFRFs (auto) from the EMA results A and B, and the exact ones, with their errors below.")

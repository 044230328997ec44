"""What the reproduction must show, each point with its figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import published
from exact import ExactStudy
from raw import SOURCES, RawStudy
from tripod import Modes


@dataclass(frozen=True)
class Check:
    """One point: what, what was found, what was asked for, and whether it holds (None: not checked)."""

    what: str
    found: str
    asked: str
    holds: bool | None


def all_checks(
    modes: Mapping[str, Modes], studies: Mapping[str, ExactStudy], runs: Sequence[RawStudy], reference: Mapping[str, float] | None
) -> list[Check]:
    """Every point."""
    out = [*_frequencies(modes)]
    if reference is None:
        out.append(Check("modes of the layout study", "", "its files (../shared/reference) are not here", None))
    else:
        worst = max(reference.values())
        out.append(Check("modes of the layout study", f"{100 * worst:.3f} % apart at most", "0.1 %", worst < 1e-3))
    added = modes["case 2"].total_mass - modes["original"].total_mass
    out.append(Check("mass added in case 2", f"{added:.3f} kg", "6.3 kg", abs(added - 6.3) < 0.01))
    for k, (case, study) in enumerate(studies.items()):
        rows = {}
        for name, asked in published.ERROR_TABLE.items():
            # The layout study's shapes had a largest element of 1 where the result depends on their size.
            key = "root_of_all, largest element 1" if name == "root_of_all" else name
            rows[name] = abs((study.as_stated["idle_by_best_mac"] if name == "idle_shapes" else study.as_stated[key]) - asked[k])
        worst_row = max(rows, key=rows.__getitem__)
        text = f"{rows[worst_row]:.2f} dB apart at most ({worst_row})"
        out.append(Check(f"error table with exact modes, {case}", text, "0.2 dB", rows[worst_row] <= 0.2))
    for r in runs:
        for source in SOURCES:
            out.append(_raw(r, source))
    return out


def _frequencies(modes: Mapping[str, Modes]) -> list[Check]:
    tables = {
        "original": (np.arange(1, 24), published.ORIGINAL_A2),
        "case 1": (np.arange(1, 23), published.TARGET_1),
        "case 2": (published.CASE_2_MODES, published.OMA_A3),
    }
    out = []
    for name, (index, paper) in tables.items():
        error = np.abs(modes[name].hz[index] / paper - 1)
        named = np.isin(index, published.NAMED[name])
        found = f"{100 * error[~named].max():.2f} %; named modes {100 * error[named].max():.2f} %"
        out.append(
            Check(f"frequencies, {name}", found, "1 %; named modes 3 %", bool(error[~named].max() < 0.01 and error[named].max() < 0.03))
        )
    ratio = modes["case 1"].hz[1:23] / modes["original"].hz[1:23] / (published.TARGET_1 / published.ORIGINAL_A2[:22])
    rms = float(np.sqrt(np.mean((ratio - 1) ** 2)))
    out.append(Check("ratios target/original, case 1", f"{100 * rms:.2f} % rms", "0.3 %", rms < 3e-3))
    return out


def _raw(r: RawStudy, source: str) -> Check:
    errors = r.errors[source]
    named = {k: v for k, v in errors.items() if k != "auto"}
    best = min(named, key=named.__getitem__)
    auto = errors["auto"]
    holds = auto <= named[best] + 0.2 and auto <= errors["msf_all"] and auto < errors["idle_shapes"] - 0.5
    return Check(
        f"from raw files, {r.case}, {r.band[0]:g}–{r.band[1]:g} Hz, input {'A' if source == SOURCES[0] else 'O'}",
        f"auto {auto:.2f} dB, best {named[best]:.2f} ({best}), msf_all {errors['msf_all']:.2f}, idle_shapes {errors['idle_shapes']:.2f}",
        "auto ≤ best + 0.2, ≤ msf_all, < idle_shapes − 0.5",
        bool(holds),
    )

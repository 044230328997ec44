"""Merged set-ups in the report: what each one measured and found, and the joint estimate beside the answer."""

from __future__ import annotations

from typing import Any

import numpy as np

from operando.data import ModalModel
from operando.report.parts import paragraph
from operando.report.tables import table
from operando.report.text import count, esc, fixed, listing, number, plus_minus


def setups(model: ModalModel) -> str:
    """Tables of the set-ups and of both estimates; nothing where there was one set-up."""
    details: Any = model.details
    given = tuple(getattr(details, "setups", ()) or ())
    if not given:
        return ""
    used = [s for s in given if not s.failed]
    shared = listing(dict.fromkeys(d for s in used for d in s.shared))
    text = (
        f"{count(len(used), 'set-up')} with {len(model.dofs)} sensors in all were identified one by one and merged by the sensors they "
        f"share ({shared}): frequencies and damping are weighted means, shapes are joined at the shared sensors. This is the answer "
        "everywhere in this report; its intervals hold the scatter between the set-ups."
    )
    return "<h3>Set-ups</h3>" + paragraph(text) + _setup_table(given) + _joint_table(model)


def _setup_table(given: tuple[Any, ...]) -> str:
    rows = []
    for s in given:
        matched = int(np.sum(np.asarray(s.merged) >= 0))
        alone = [f"{number(f, 5)} Hz" for f, reason in zip(s.frequencies_hz, s.reasons, strict=False) if reason]
        words = f"not used: {s.failed}" if s.failed else f"unmatched: {listing(alone)}" if alone else "all matched"
        rows.append([esc(s.name), esc(listing(s.sensors, 12)), str(len(s.frequencies_hz)), str(matched), esc(words)])
    head = ["File", "Sensors", "Modes", "Merged", "What did not match"]
    return table(head, rows, numeric=(2, 3), caption="<b>Set-ups.</b> Modes each one shows by itself, and how many are merged.", wide=True)


def _joint_table(model: ModalModel) -> str:
    joint = getattr(model.details, "joint", None)
    if joint is None:
        return ""
    if not np.any(np.isfinite(joint.frequencies_hz)):
        return paragraph(joint.text)
    rows = []
    f_std, z_std = model.frequency_std_hz, model.damping_ratio_std
    std = lambda values, i, factor=1: None if values is None else factor * values[i]  # noqa: E731
    for i in range(model.n_modes):
        row = [
            str(i),
            plus_minus(model.frequencies_hz[i], std(f_std, i)),
            plus_minus(100 * model.damping_ratios[i], std(z_std, i, 100)),
        ]
        if np.isfinite(joint.frequencies_hz[i]):
            row += [
                plus_minus(joint.frequencies_hz[i], joint.frequency_std_hz[i]),
                plus_minus(100 * joint.damping_ratios[i], 100 * joint.damping_ratio_std[i]),
                fixed(100 * (joint.frequencies_hz[i] / model.frequencies_hz[i] - 1), 3, sign=True),
                fixed(joint.mac[i], 3),
            ]
        else:
            row += ["–", "–", "–", "–"]
        rows.append(row)
    head = [
        "No.",
        "Merged<br>[Hz]",
        "Damping<br>[%]",
        "Joint<br>[Hz]",
        "Damping<br>[%]",
        "Difference<br>[% of Hz]",
        "MAC",
    ]
    caption = f"<b>Merged modes and the joint estimate</b> ({esc(joint.text)}); ± as in the table of modes."
    return table(head, rows, numeric=(0, 1, 2, 3, 4, 5, 6), caption=caption)

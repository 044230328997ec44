"""The catalogue of effects: every registered kind with words, location, parameters, the form for `operando add` and a drawing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import operando
from generators.drawings import draw
from operando.cli.effects import example, law, places_words
from operando.units import written_unit

GROUPS = {
    "structure": ("Effects in the structure", "They change the FRFs of the machine."),
    "idle": ("Shortcomings of the idle model", "The structure is the same; something is missing in the idle model."),
    "sensor": ("Faults of response channels", "They change what is measured, not the structure."),
    "force": ("Faults of force channels", "They change what is measured, not the structure."),
    "excitation": ("Excitation", "Neither structure nor measurement chain."),
}
DRAWN = {
    "dynamic_stiffness": "FRF of a chain of four masses: grey without, orange with the effect.",
    "modal_change": "FRF of a chain of four masses: grey without, orange with the effect.",
    "added_mode": "FRF of a chain of four masses: grey without, orange with the mode.",
    "sensor_map": "What is measured: grey right, orange with the fault.",
    "pseudo_force": "Restoring force over one period of a sinusoidal motion.",
    "excitation": "Spectrum of a response: grey without, orange with the lines.",
}
MOVES = {
    "frequencies": "natural frequencies",
    "damping": "damping",
    "both": "natural frequencies and damping",
    "nothing": "only what is measured",
}


def kinds() -> dict[str, Any]:
    """The kinds of operando itself; those a user registered meanwhile are left out."""
    return {name: kind for name, kind in operando.catalogue().items() if type(kind).__module__.startswith("operando.")}


def _places(kind: Any) -> str:
    return places_words(kind) + (" (acts on all measured directions of its node)" if kind.coordinates == "node" else "")


def entry(kind: Any) -> list[str]:
    """The section of one kind."""
    rows = [f"- Location: {_places(kind)}", f"- Changes: {MOVES.get(kind.moves, kind.moves)}"]
    if kind.level_dependent:
        rows.append("- Nonlinear: found in records with measured force, as a rule of two levels")
    if not kind.symmetric:
        rows.append("- Not reciprocal: H ≠ Hᵀ, which a modal model of real shapes cannot represent")
    if kind.removable:
        rows.append("- May be negative: what was there in the idle state and is missing in operation")
    table = []
    if kind.parameters or kind.constants:
        table = ["| parameter | unit | meaning |", "| --- | --- | --- |"]
        table += [f"| `{p.name}` | {written_unit(p.unit) or '–'} | {p.plain} |" for p in kind.parameters]
        table += [f"| `{p.name}` | {written_unit(p.unit) or '–'} | {p.plain} (stated, never fitted) |" for p in kind.constants]
        table.append("")
    where = {0: "", 1: "7+Z", 2: "7+Z and 12+Z"}[kind.places]
    confirm = kind.confirm(where, kind.defaults((5.0, 145.0))) if not kind.constants or kind.parameters else kind.confirm(where, {})
    return [
        f"### `{kind.kind}`: {kind.plain}",
        "",
        f"![{DRAWN.get(kind.acts, '')}](../_made/effects/{kind.kind}.svg)",
        "",
        f"*{DRAWN.get(kind.acts, '')}*",
        "",
        law(kind).replace("|", r"\|"),
        "",
        *rows,
        f"- As an argument: `{example(kind)}`",
        "",
        *table,
        f"To confirm it (for example): {confirm}.",
        "",
    ]


def page(folder: Path) -> str:
    """The page without its title; the drawings go into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    known, out = kinds(), []
    groups = dict.fromkeys((*GROUPS, *(kind.group for kind in known.values())))
    for group in groups:
        mine = [kind for kind in known.values() if kind.group == group]
        if not mine:
            continue
        title, words = GROUPS.get(group, (group, ""))
        out += [f"## {title}", "", words, ""]
        for kind in mine:
            draw(kind, folder / f"{kind.kind}.svg")
            out += entry(kind)
    return "\n".join(out)

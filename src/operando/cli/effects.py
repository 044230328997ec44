"""``operando effects``: the catalogue of effects, and the user's own."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from operando.cli.answer import Answer, answers, own_option, table
from operando.units import written_unit

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

    from operando.structure.effects import EffectKind

_BAND = (5.0, 145.0)
"""Band [Hz] of pictures and examples, whose values may start at its centre."""
_WIDTH, _HEIGHT = 41, 11


def kinds_like(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Kinds for the completion of the shell."""
    from click.shell_completion import CompletionItem

    from operando.structure.effects import catalogue

    return [CompletionItem(name, help=kind.plain) for name, kind in catalogue().items() if name.startswith(incomplete)]


@click.command("effects", epilog="Example: operando effects clearance")
@click.argument("kind", required=False, shell_complete=kinds_like)
@own_option
@answers
def effects(kind: str | None) -> Answer:
    """The catalogue of effects: what each is, where it acts, its parameters with units, and how `operando add` takes it.

    With KIND also the force law, a small picture of it, and the test that confirms it.
    """
    from operando.structure.effects import catalogue, kind_of

    if kind is not None:
        definition = kind_of(kind)
        return Answer({"schema": "operando/effects/1", "kinds": [described(definition)]}, _text(definition))
    known = list(catalogue().values())
    rows = [[k.kind, places_words(k), ", ".join(_parameter(p) for p in k.parameters) or "-", k.plain] for k in known]
    text = table(rows, ["kind", "location", "parameters", "what it is"])
    document = {"schema": "operando/effects/1", "kinds": [described(k) for k in known]}
    return Answer(document, f"{text}\n\n`operando effects KIND` shows one of them with its force law and an example.")


def described(kind: EffectKind) -> dict[str, Any]:
    """A kind as a JSON document."""
    entry = lambda p: {  # noqa: E731
        "name": p.name, "unit": p.unit, "low": p.low, "high": p.high, "default": p.default, "meaning": p.plain
    }  # fmt: skip
    return {
        "kind": kind.kind,
        "plain": kind.plain,
        "law": law(kind),
        "group": kind.group,
        "locations": sorted({kind.places, *kind.alternative_places}),
        "parameters": [entry(p) for p in kind.parameters],
        "constants": [entry(p) for p in kind.constants],
        "level_dependent": kind.level_dependent,
        "reciprocal": kind.symmetric,
        "own": not type(kind).__module__.startswith("operando."),
        "example": example(kind),
    }


def law(kind: EffectKind) -> str:
    """The law in one line, as the class states it."""
    return (type(kind).__doc__ or "").strip().split("\n")[0].replace("``", "")


def places_words(kind: EffectKind) -> str:
    """How many DOFs a kind takes, in words."""
    words = {0: "none", 1: "one DOF", 2: "two DOFs"}
    return " or ".join(words[n] for n in sorted({kind.places, *kind.alternative_places}))


def example(kind: EffectKind) -> str:
    """The effect as `operando add` takes it."""
    at = {0: "", 1: "@7+Z", 2: "@7+Z,12+Z"}[kind.places]
    values = [f"{p.name}:{p.start(_BAND) or (p.high or 1.0) / 100:g}" for p in kind.parameters]
    return kind.kind + at + ("=" + ",".join(values) if values else "")


def _parameter(p: Any) -> str:
    return f"{p.name} [{written_unit(p.unit) or '–'}]"


def _text(kind: EffectKind) -> str:
    own = "" if type(kind).__module__.startswith("operando.") else " (own)"
    lines = [f"{kind.kind}{own}: {kind.plain}", f"force law: {law(kind)}" if law(kind) else "", f"location: {places_words(kind)}"]
    if kind.level_dependent:
        lines.append("nonlinear: found in records with measured force, as a rule of two levels")
    if not kind.symmetric:
        lines.append("not reciprocal: H differs from its transpose")
    parts = ["\n".join(line for line in lines if line)]
    rows = [[p.name, written_unit(p.unit) or "–", _ends(p), p.plain] for p in kind.parameters]
    rows += [[p.name, written_unit(p.unit) or "–", _ends(p), f"{p.plain} (stated, never fitted)"] for p in kind.constants]
    if rows:
        parts.append(table(rows, ["parameter", "unit", "range", "meaning"]))
    drawn = picture(kind)
    if drawn:
        parts.append(drawn)
    parts.append(f"operando add DIR {example(kind)}")
    return "\n\n".join(parts)


def _ends(p: Any) -> str:
    words = lambda value: "band edge" if value is None else f"{value:g}"  # noqa: E731
    return f"{words(p.low)} … {words(p.high)}"


def picture(kind: EffectKind) -> str:
    """The law drawn with characters: restoring force over the motion, or dynamic stiffness over frequency; "" for any other kind."""
    import numpy as np

    values = kind.defaults(_BAND)
    if kind.acts == "pseudo_force":
        # a motion of which the law's own length, where it has one, is seen
        own = values["yield_force"] / values["stiffness"] if {"yield_force", "stiffness"} <= set(values) else 4e-4
        stroke = 2.5 * next((values[p.name] for p in kind.parameters if p.unit == "m"), own)
        angle = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
        x, v = stroke * np.sin(angle), 2 * np.pi * 5.0 * stroke * np.cos(angle)
        force = np.asarray(kind.over_steps(x, v, values, 1 / 5.0 / angle.size))
        by_velocity = getattr(kind, "uses_velocity", False) and not getattr(kind, "has_state", False)
        return drawing(v if by_velocity else 1e3 * x, force, "velocity [m/s]" if by_velocity else "displacement [mm]", "force [N]")
    if kind.acts == "dynamic_stiffness":
        hz = np.linspace(*_BAND, 400)
        z = np.abs(np.asarray(kind.matrix(2j * np.pi * hz, values, 2 if kind.coordinates == "separate" else 1)))
        return drawing(hz, z.reshape(hz.size, -1).max(axis=1), "frequency [Hz]", "|dynamic stiffness| [N/m]")
    return ""


def drawing(x: Any, y: Any, name_x: str, name_y: str) -> str:
    """A curve in characters, with the ends of both axes."""
    import numpy as np

    x, y = np.asarray(x, float), np.asarray(y, float)
    spread = lambda a: float(np.ptp(a)) or 1.0  # noqa: E731
    low, high = float(y.min()), float(y.max())
    if high - low < 1e-9 * max(abs(high), abs(low), 1e-300):
        low, high = min(low, 0.0), max(high, 0.0)
    columns = np.round((x - x.min()) / spread(x) * (_WIDTH - 1)).astype(int)
    rows = np.round((high - y) / ((high - low) or 1.0) * (_HEIGHT - 1)).astype(int)
    grid = [[" "] * _WIDTH for _ in range(_HEIGHT)]
    for row, column in zip(rows, columns, strict=True):
        grid[row][column] = "*"
    ends = [f"{high:.3g}", f"{low:.3g}"]
    margin = max(map(len, ends))
    lines = [f"{ends[0] if i == 0 else ends[1] if i == _HEIGHT - 1 else '':>{margin}} |{''.join(r).rstrip()}" for i, r in enumerate(grid)]
    left, right = f"{x.min():.3g}", f"{x.max():.3g}"
    foot = " " * (margin + 2) + left + right.rjust(_WIDTH - len(left))
    return "\n".join([name_y, *lines, " " * (margin + 1) + "+" + "-" * _WIDTH, foot, f"{name_x:>{margin + 2 + _WIDTH}}"])

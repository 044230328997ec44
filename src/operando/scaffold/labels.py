"""Guessed labels of channels that have none, and what else the files do not say."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from operando.errors import OperandoError

MOTION = ("acceleration", "velocity", "displacement")
DRIVE_POINT = 0.01
"""Share of the lines at which power flows out of the structure, beyond three standard deviations: no more at the response that is guessed
to sit at the force, twice as much at all others. At a true drive point it is 0 but for noise (0.1 % of lines) and phase errors; F-16
ground vibration test: 0 % at the shaker, 9 and 3 % on the wing."""


@dataclass
class Seen:
    """What the files lack and hold, gathered while reading.

    ``labels`` are guesses, channel name → what [channels] would say of it; ``columns`` of tables without a header line → their files;
    ``loudest`` rms of each force channel; ``bands`` in which each measurement with force has power [Hz]; ``lineless`` files of FRFs without
    frequencies → lines; ``rateless`` files of time histories without a rate; ``unlabelled_force``: FRFs of one reference name no DOFs;
    ``pairs`` of FRFs and their state → files; ``held`` frequencies [Hz] that each record can hold, by its length and its sampling rate;
    ``guessed``: name of a channel in ``labels`` → what of its DOF no file says.
    """

    unitless: dict[str, set[str]] = field(default_factory=dict)
    unlabelled: dict[str, str] = field(default_factory=dict)
    rates: set[float] = field(default_factory=set)
    labels: dict[str, dict[str, Any]] = field(default_factory=dict)
    guesses: list[str] = field(default_factory=list)
    columns: dict[tuple[str, ...], list[Path]] = field(default_factory=dict)
    loudest: dict[str, float] = field(default_factory=dict)
    bands: dict[str, tuple[float, float]] = field(default_factory=dict)
    lineless: dict[str, int] = field(default_factory=dict)
    rateless: list[str] = field(default_factory=list)
    unlabelled_force: bool = False
    pairs: dict[frozenset[tuple[str, str]], list[Path]] = field(default_factory=dict)
    held: dict[str, tuple[float, float]] = field(default_factory=dict)
    guessed: dict[str, str] = field(default_factory=dict)


def labelled(record: Any, seen: Seen) -> Any:
    """The record with guessed DOFs where no channel has one but names or units tell quantities; the guesses go into ``seen``."""
    from dataclasses import replace

    from operando.dof import Dof

    motion = [c for c in record.channels if c.quantity in MOTION]
    if not motion or any(c.dof is not None for c in record.channels) or any(not c.name for c in record.channels):
        return record
    fresh = any(c.name not in seen.labels for c in record.channels)
    for channel in motion:
        taken = {label["dof"] for label in seen.labels.values() if "dof" in label and label["quantity"] in MOTION}
        if channel.name not in seen.labels:
            dof, seen.guessed[channel.name] = _dof_of_name(channel.name, taken)
            seen.labels[channel.name] = {"dof": dof, "quantity": channel.quantity}
    channels = [replace(c, dof=Dof.parse(seen.labels[c.name]["dof"])) if c in motion else c for c in record.channels]
    forces = [c for c in record.channels if c.is_force]
    for force in forces:
        if force.name not in seen.labels:
            dof, why = _dof_of_force(record, channels, force)
            seen.labels[force.name] = {"dof": dof, "quantity": force.quantity}
            if all(dof != str(c.dof) for c in channels):  # a node of its own; a drive point was told by the measurement
                seen.guessed[force.name] = "where the force acts"
            seen.guesses.append(f"{force.name} taken as the force at {dof}: {why}")
    for channel in record.channels:
        if channel not in motion and channel not in forces and channel.quantity != "unknown":
            seen.labels[channel.name] = {"exclude": True, "reason": f"{channel.quantity} is neither a force nor a motion"}
    if fresh:
        seen.guesses.append(
            f"DOFs guessed from the order and the names of the channels ({', '.join(c.name for c in motion[:4])}"
            f"{' …' if len(motion) > 4 else ''}); +Z stands for a direction the file does not say: correct them in [channels]"
        )
    named = {name: Dof.parse(label["dof"]) for name, label in seen.labels.items() if "dof" in label}
    return replace(record, channels=tuple(replace(c, dof=named.get(c.name)) for c in record.channels))


def _dof_of_name(name: str, taken: set[str]) -> tuple[str, str]:
    """A DOF no other channel has, and what of it is guessed, in no file (empty: nothing).

    It is the number in a channel name and a direction at its end, else the next free node along +Z.
    """
    match = re.search(r"(\d+)\D*$", name)
    axis = re.search(r"(?:\d|[_\s:.\-])([+-]?)([xyz])$", name, re.IGNORECASE)
    direction = f"{axis[1] or '+'}{axis[2].upper()}" if axis else "+Z"
    wanted = node = int(match[1]) if match else 1
    while f"{node}{direction}" in taken:
        node += 1
    own = [f"node {node}" + (f" ({wanted}{direction} is taken)" if match else "")] if not match or node != wanted else []
    return f"{node}{direction}", " and ".join([*own, *([] if axis else ["the direction"])])


def _dof_of_force(record: Any, channels: Sequence[Any], force: Any) -> tuple[str, str]:
    """Where a force without a label acts: at the one response into which it puts power at every line, else at a node of its own."""
    from dataclasses import replace

    from operando.dof import Dof
    from operando.frf import estimate_frf, power_signs

    nodes = [c.dof.number for c in channels if c.dof is not None]
    own = Dof(max(nodes, default=0) + 1, "Z")
    rows = [i for i, c in enumerate(channels) if c.dof is not None or c is force or c.name == force.name]
    labelled = tuple(replace(c, dof=own) if c.name == force.name else c for c in channels)
    try:
        frf = estimate_frf(replace(record, channels=labelled, findings=()).select(rows))
    except OperandoError as error:
        return str(own), f"a node of its own, for its FRFs cannot be estimated ({error.message})"
    signs = {str(d): power_signs(frf, i, 0) for i, d in enumerate(frf.responses)}
    drive = [d for d, (inward, outward) in signs.items() if outward <= DRIVE_POINT and inward > 10 * DRIVE_POINT]
    others = [outward for d, (_, outward) in signs.items() if d not in drive]
    if len(drive) == 1 and min(others, default=1.0) > 2 * DRIVE_POINT:
        inward, outward = signs[drive[0]]
        second = f"; at the others it flows out at {100 * min(others):.0f} % or more" if others else ""
        return drive[0], (
            f"as at a drive point, power flows into the structure there at {100 * inward:.0f} % of the lines and out at "
            f"{100 * outward:.0f} %{second}"
        )
    return str(own), "a node of its own: the measurement does not tell one response as its drive point (label them alike if you know it)"

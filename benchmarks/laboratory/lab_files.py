"""Universal files of the laboratory family: FRFs and records as 58b, nodes and lines as 15 and 82. Shares no code with operando."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from lab_structures import Point, Structure

sys.path.append(str(Path(__file__).resolve().parents[1] / "example_data"))
from uff import Trace, time_record

GRAVITY, POUND = 9.80665, 4.4482216152605
DATE = "22-NOV-26 10:00:00"

__all__ = ["DATE", "GRAVITY", "POUND", "Trace", "frf_set", "geometry", "test_file", "time_record"]


def frf_set(response: Point, reference: Point, values: np.ndarray, first: float, step: float, unit: str, name: str) -> bytes:
    """One FRF (function type 4, double precision complex, even abscissa) in (m/s²)/N, written in ``unit``/N with ``unit`` m/s2 or g."""
    values = np.asarray(values) / (GRAVITY if unit == "g" else 1.0)
    payload = np.ascontiguousarray(values, "<c16").tobytes()
    header = [
        f"{-1:6d}",
        f"{58:6d}b{1:6d}{2:6d}{11:12d}{len(payload):12d}{0:6d}{0:6d}{0:12d}{0:12d}",
        f"FRF {response.name}/{reference.name}",
        name,
        DATE,
        "NONE",
        "NONE",
        f"{4:5d}{0:10d}{0:5d}{0:10d}{_entity(response)}{_entity(reference)}",
        f"{6:10d}{len(values):10d}{1:10d}{first:13.5E}{step:13.5E}{0:13.5E}",
        f"{18:10d}    0    0    0 {'Frequency':<20s} {'Hz':<20s}",
        f"{12:10d}    1    0    0 {'Acceleration':<20s} {unit:<20s}",
        f"{13:10d}    0    1    0 {'Force':<20s} {'N':<20s}",
        f"{0:10d}    0    0    0 {'NONE':<20s} {'NONE':<20s}",
    ]
    return "".join(f"{line:<80s}\n" for line in header).encode("ascii") + payload + f"\n{-1:6d}\n".encode("ascii")


def _entity(point: Point) -> str:
    """Response or reference of record 6."""
    return f" {'NONE':<10s}{point.label:10d}{point.direction:4d}"


def geometry(structure: Structure) -> bytes:
    """Nodes (15, metres) and lines between them (82)."""
    text = [f"{-1:6d}", f"{15:6d}"]
    places = {p.label: p.place for p in structure.points}
    text += [f"{n:10d}{0:10d}{0:10d}{7:10d}{x:13.5E}{y:13.5E}{z:13.5E}" for n, (x, y, z) in sorted(places.items())]
    text.append(f"{-1:6d}")
    for number, wire in enumerate(structure.wires, start=1):
        text += [f"{-1:6d}", f"{82:6d}", f"{number:10d}{len(wire):10d}{7:10d}", "line"]
        text += ["".join(f"{n:10d}" for n in wire[i : i + 8]) for i in range(0, len(wire), 8)]
        text.append(f"{-1:6d}")
    return ("\n".join(text) + "\n").encode("ascii")


def test_file(name: str, states: str, band: tuple[float, float]) -> str:
    """Text of test.toml: what a user writes who sets nothing but the band."""
    return f'name = "{name}"\n{states}[geometry]\nfile = "geometry.uff"\nunits = "m"\n[analysis]\nband = [{band[0]}, {band[1]}]\n'

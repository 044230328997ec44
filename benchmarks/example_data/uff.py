"""Writes the few universal-file sets the example needs: 58b time records, 15 and 2412 geometry. Shares no code with operando."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Trace:
    """One channel as a data logger would write it."""

    title: str
    node: int
    direction: int  # 3 is +z, −3 is −z
    quantity: str  # "force" or "acceleration"
    unit: str
    samples: np.ndarray


_TYPES = {"force": (13, "0    1    0", "Force"), "acceleration": (12, "1    0    0", "Acceleration")}


def time_record(traces: list[Trace], rate: float, name: str, date: str) -> bytes:
    """All traces of one run as binary 58b sets: little-endian single precision, even abscissa."""
    out = []
    for trace in traces:
        payload = np.ascontiguousarray(trace.samples, "<f4").tobytes()
        code, exponents, label = _TYPES[trace.quantity]
        other = (trace.node, trace.direction) if trace.quantity == "force" else (0, 0)
        lines = [
            f"{-1:6d}",
            f"{58:6d}b{1:6d}{2:6d}{11:12d}{len(payload):12d}{0:6d}{0:6d}{0:12d}{0:12d}",
            trace.title,
            name,
            date,
            "NONE",
            "NONE",
            f"{1:5d}{0:10d}{0:5d}{0:10d} {'NONE':<10s}{trace.node:10d}{trace.direction:4d} {'NONE':<10s}{other[0]:10d}{other[1]:4d}",
            f"{2:10d}{len(trace.samples):10d}{1:10d}{0:13.5E}{1 / rate:13.5E}{0:13.5E}",
            f"{17:10d}    0    0    0 {'Time':<20s} {'s':<20s}",
            f"{code:10d}    {exponents} {label:<20s} {trace.unit:<20s}",
            f"{0:10d}    0    0    0 {'NONE':<20s} {'NONE':<20s}",
            f"{0:10d}    0    0    0 {'NONE':<20s} {'NONE':<20s}",
        ]
        out.append("".join(f"{line:<80s}\n" for line in lines).encode("ascii") + payload + f"\n{-1:6d}\n".encode("ascii"))
    return b"".join(out)


def geometry(nodes: dict[int, tuple[float, float, float]], triangles: list[tuple[int, ...]], quads: list[tuple[int, ...]]) -> bytes:
    """Nodes (set 15, metres) and flat elements between them (set 2412)."""
    lines = [f"{-1:6d}", f"{15:6d}"]
    lines += [f"{node:10d}{0:10d}{0:10d}{7:10d}{x:13.5E}{y:13.5E}{z:13.5E}" for node, (x, y, z) in nodes.items()]
    lines += [f"{-1:6d}", f"{-1:6d}", f"{2412:6d}"]
    for label, element in enumerate([*triangles, *quads], start=1):
        lines.append(f"{label:10d}{91 if len(element) == 3 else 94:10d}{1:10d}{1:10d}{7:10d}{len(element):10d}")
        lines.append("".join(f"{node:10d}" for node in element))
    lines.append(f"{-1:6d}")
    return ("\n".join(lines) + "\n").encode("ascii")

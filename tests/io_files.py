"""UFF files made by hand for tests: formatted from the text of the standard, sharing no code with operando."""

from __future__ import annotations

import struct
from pathlib import Path

SHARED = Path(__file__).resolve().parents[1].parent / "shared"


def head58(
    *, binary=None, kind=4, points=4, even=1, start=0.0, step=0.01, function=1, response=(12, 3), reference=(0, 0), quantity=12,
    label="Acceleration", unit="m/s2", exponents=(0, 0, 0), denominator=(0, "NONE", "NONE"), abscissa=(17, "Time", "s"),
    ids=("NONE",) * 5, name="NONE",
    reference_name="NONE", n_bytes=0, step_text=None, start_text=None,
):  # fmt: skip
    """Header lines of a set 58; ``binary`` is None, "<" or ">"."""
    first = "    58"
    if binary:
        first += f"b{1 if binary == '<' else 2:6d}{2:6d}{11:12d}{n_bytes:12d}{0:6d}{0:6d}{0:12d}{0:12d}"
    step_text = f"{step:13.5E}" if step_text is None else step_text
    start_text = f"{start:13.5E}" if start_text is None else start_text
    lines = [first, *ids]
    lines.append(
        f"{function:5d}{1:10d}{0:5d}{0:10d} {name:<10}{response[0]:10d}{response[1]:4d}"
        f" {reference_name:<10}{reference[0]:10d}{reference[1]:4d}"
    )
    lines.append(f"{kind:10d}{points:10d}{even:10d}{start_text}{step_text}{0.0:13.5E}")
    axes = [(abscissa[0], (0, 0, 0), abscissa[1], abscissa[2]), (quantity, exponents, label, unit)]
    axes += [(denominator[0], (0, 0, 0), denominator[1], denominator[2]), (0, (0, 0, 0), "NONE", "NONE")]
    for code, e, text, u in axes:
        lines.append(f"{code:10d}{e[0]:5d}{e[1]:5d}{e[2]:5d} {text:<20} {u:<20}")
    return lines


def ascii58(numbers, layout=None, **kw):
    """A whole ASCII set 58; ``layout`` is a list of formats of one line."""
    kind, even = kw.get("kind", 4), kw.get("even", 1)
    if layout is None:
        if kind in (2, 5):
            layout = ["%13.5E"] * 6
        elif even:
            layout = ["%20.12E"] * 4
        else:
            layout = ["%13.5E", "%20.12E"] * 2 if kind == 4 else ["%13.5E", "%20.12E", "%20.12E"]
    lines = head58(**kw)
    n = len(layout)
    for i in range(0, len(numbers), n):
        lines.append("".join(f % v for f, v in zip(layout, numbers[i : i + n], strict=False)))
    return ("\n".join(["    -1", *lines, "    -1", ""])).encode("utf-8")


def binary58(numbers, order="<", eol=b"\n", tail=b"\n    -1\n", stated=None, **kw):
    """A whole binary set 58b."""
    single = kw.get("kind", 4) in (2, 5)
    payload = struct.pack(f"{order}{len(numbers)}{'f' if single else 'd'}", *numbers)
    kw["n_bytes"] = len(payload) if stated is None else stated
    lines = ["    -1", *head58(binary=order, **kw), ""]
    return eol.join(line.encode() for line in lines) + payload + tail


def text_set(number, *lines):
    """A set of text lines."""
    return "\n".join(["    -1", f"{number:6d}", *lines, "    -1", ""]).encode("utf-8")


def units164(length=1.0, force=1.0, name="mm"):
    """A set 164 with D exponents."""
    number = lambda v: f"{v:25.17E}".replace("E", "D")  # noqa: E731
    return text_set(164, f"{5:10d}{name:<20}{2:10d}", number(length) + number(force) + number(1.0), number(273.15))

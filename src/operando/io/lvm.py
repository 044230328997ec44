"""LabVIEW measurement files, ``.lvm``: text with a header for the file and one for each block of samples."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, TimeRecord
from operando.errors import FormatError
from operando.io.content import Content, SetInfo
from operando.io.quantities import ChannelSpecs, Units
from operando.io.sep005 import make_record
from operando.io.uff.increments import tidy_rate
from operando.io.uff.reader import open_file, provenance_of

_END = "***End_of_Header***"


@dataclass
class _Block:
    """One block of samples: its header by key, names of the columns, lines with their numbers (cells as texts would take too much)."""

    header: dict[str, list[str]]
    names: list[str] = field(default_factory=list)
    rows: list[tuple[int, str]] = field(default_factory=list)
    line: int = 0


def read_lvm(path: str | Path, *, units: Units | None = None, channels: ChannelSpecs | None = None) -> Content:
    """Read a LabVIEW measurement file; blocks of the same channels that follow one another in time become one record."""
    path = Path(path)
    where = str(path)
    with open_file(path) as stream:
        text = stream.read().decode("latin-1")
    separator, decimal, axes, blocks, lost = _parse(text, where)
    del text
    findings = [
        Finding("damaged", text, "error", where, consequence="samples may be missing from every result", action="export the file again")
        for text in lost
    ]
    provenance = provenance_of(path)
    infos: list[SetInfo] = []
    found: list[tuple[float, float, list[str], list[str], NDArray[np.float64]]] = []
    for i, block in enumerate(blocks):
        title = f"block from line {block.line}: {len(block.names)} channels, {len(block.rows)} samples"
        kinds = {d.lower() for d in block.header.get("X_Dimension", []) if d}
        if not block.rows or kinds - {"time"}:
            reason = "no samples" if not block.rows else f"its axis is {', '.join(sorted(kinds))}"
            infos.append(SetInfo(i, 0, title, "ignored", reason))
            findings.append(_unused(title, reason, where))
            continue
        step, start = (_number((block.header.get(key) or [""])[0], decimal) for key in ("Delta_X", "X0"))
        values, time = _values(block, separator, axes, decimal, where)
        if not step > 0 and time is not None and len(time) > 1:
            step, start = float(time[-1] - time[0]) / (len(time) - 1), float(time[0])
        if not (np.isfinite(step) and step > 0):
            infos.append(SetInfo(i, 0, title, "ignored", "no step of time"))
            findings.append(_unused(title, "no step of time", where))
            continue
        stated = block.header.get("Y_Unit_Label", [])
        texts = stated if len(stated) == len(block.names) else [""] * len(block.names)
        infos.append(SetInfo(i, 0, title))
        _append(found, (step, start if np.isfinite(start) else 0.0, block.names, texts, values))
    records: list[TimeRecord] = []
    common: dict[str, Any] = {"units": units, "channels": channels, "source": where, "provenance": provenance}
    for step, start, names, texts, values in found:
        records.append(make_record(values, tidy_rate(step), names, texts, start_s=start, **common))
    if not records:
        seen = "; ".join(f"{s.title}: {s.note}" for s in infos[:4]) or "no block"
        raise FormatError(f"no time history ({seen})", where=where, hint="export samples over time")
    findings += [f for record in records for f in record.findings]
    gaps = sum(int(np.count_nonzero(~np.isfinite(record.data))) for record in records)
    if gaps:
        empty = f"{gaps} cells hold no number"
        findings.append(Finding("nan", empty, "warning", where, consequence="they are NaN in the record"))
    return Content(where, "lvm", tuple(records), sets=tuple(infos), findings=tuple(findings))


def _unused(title: str, reason: str, where: str) -> Finding:
    return Finding("unused_block", f"the {title} is not used: {reason}", "warning", where, consequence="no result knows its samples")


def _parse(text: str, where: str) -> tuple[str, str, str, list[_Block], list[str]]:
    """Separator, decimal mark, what X columns there are (no, one, multi), blocks, what belongs to no block in words."""
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    separator = "," if any(re.match(r"Separator,Comma", line) for line in lines[:30]) else "\t"
    head: dict[str, list[str]] = {}
    at = 0
    while at < len(lines) and not lines[at].startswith(_END):
        key, *rest = lines[at].split(separator)
        head[key.strip()] = [r.strip() for r in rest]
        at += 1
    if at == len(lines) or "Channels" in head:  # with it the header of a block begins
        raise FormatError("the header of the LabVIEW file has no end", where=where, hint=f"expected a line {_END}")
    decimal = (head.get("Decimal_Separator") or ["."])[0] or "."
    axes = (head.get("X_Columns") or ["No"])[0].lower()
    blocks: list[_Block] = []
    header: dict[str, list[str]] | None = None
    begun = 0
    outside: list[int] = []
    unended: list[int] = []
    for number, line in enumerate(lines[at + 1 :], start=at + 2):
        cells = [c.strip() for c in line.split(separator)]
        if cells[0] == "Channels":
            unended += [] if header is None else [begun]
            header, begun = {"Multi_Headings": head.get("Multi_Headings", [])}, number
        if header is not None:
            if line.startswith(_END):
                blocks.append(_Block(header, line=number))
                header = None
            else:
                header[cells[0]] = cells[1 : 1 + _count(header, cells, where, number)]
        elif not blocks:
            outside += [number] if any(cells) else []
        elif any(cells):
            block = blocks[-1]
            if not block.names:
                if cells[0] != "X_Value":
                    raise FormatError(f"line {number} should name the columns", where=where, hint="expected X_Value and channel names")
                block.names = _names(cells, len(block.header["Channels"]) and int(block.header["Channels"][0]), axes, where)
            elif cells[0] != "X_Value":
                block.rows.append((number, line))
    unended += [] if header is None else [begun]
    lost = [f"the header of the block from line {line} has no end" for line in unended]
    lost += [f"{len(outside)} lines from line {outside[0]} on belong to no block"] if outside else []
    return separator, decimal, axes, blocks, lost


def _count(header: dict[str, list[str]], cells: list[str], where: str, number: int) -> int:
    """Number of channels of the block whose header is read."""
    text = (header.get("Channels") or cells[1:2] or ["0"])[0]
    if not re.fullmatch(r"\d{1,6}", text) or int(text) < 1:
        raise FormatError(f"line {number}: {text!r} is no number of channels", where=where)
    return int(text)


def _names(cells: list[str], count: int, axes: str, where: str) -> list[str]:
    names = cells[1::2] if axes == "multi" else cells[1:]
    named = names[:-1] if names[-1:] == ["Comment"] or (len(names) > count and not names[-1]) else names
    if len(named) != count:
        raise FormatError(f"{count} channels but {len(named)} names", where=where, hint="the file is damaged: export it again")
    return [name or f"ch{i + 1}" for i, name in enumerate(names[:count])]


def _values(block: _Block, separator: str, axes: str, decimal: str, where: str) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """(n_channels, n_samples) numbers and the time column if there is one; cells left empty are NaN."""
    count = len(block.names)
    columns = [0, *range(1, 2 * count, 2)] if axes == "multi" else list(range(count + 1))
    most = count * (2 if axes == "multi" else 1) + 2  # with the time, and a comment
    table = np.full((len(block.rows), len(columns)), np.nan)
    for i, (number, line) in enumerate(block.rows):
        cells = line.split(separator)
        if len(cells) > most and any(cell.strip() for cell in cells[most:]):
            reason = f"line {number}: {len(cells)} cells, expected {most} at most"
            raise FormatError(reason, where=where, hint="remove damaged rows")
        for k, c in enumerate(columns):
            if c < len(cells):
                table[i, k] = _number(cells[c], decimal)
    stated = [int(_number(s, decimal)) for s in block.header.get("Samples", []) if np.isfinite(_number(s, decimal))]
    # with one heading for all blocks, those after the first follow without a word
    one_heading = block.header["Multi_Headings"][:1] == ["No"] and stated and len(table) % max(1, max(stated)) == 0
    if stated and max(stated) != len(table) and not one_heading:
        raise FormatError(
            f"the block from line {block.line} states {max(stated)} samples and has {len(table)} rows", where=where,
            hint="the file is cut off or damaged: export it again",
        )  # fmt: skip
    return np.ascontiguousarray(table[:, 1:].T), table[:, 0] if axes != "no" and np.all(np.isfinite(table[:, 0])) else None


def _number(text: str, decimal: str) -> float:
    try:
        return float(text.replace(decimal, "."))
    except ValueError:
        return np.nan


def _append(found: list[tuple[float, float, list[str], list[str], NDArray[np.float64]]],
            block: tuple[float, float, list[str], list[str], NDArray[np.float64]]) -> None:  # fmt: skip
    """Join a block to the one before where it goes on in time with the same channels."""
    step, start, names, texts, values = block
    if found:
        before = found[-1]
        goes_on = abs(before[1] + before[0] * before[4].shape[1] - start) < 0.5 * step
        if before[0] == step and before[2] == names and before[3] == texts and goes_on:
            found[-1] = (*before[:4], np.concatenate([before[4], values], axis=1))
            return
    found.append(block)

"""FRFs as a table: a frequency column and two columns a pair, ``12+Z/1+Z real [(m/s2)/N]`` and ``… imag``; coherence beside them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from operando.atomic import replacing
from operando.data import Finding, Frf
from operando.dof import Dof
from operando.errors import DofError, FormatError, UnitError
from operando.io.columns import complex_lines
from operando.io.content import Content, SetInfo
from operando.io.quantities import ChannelSpecs, Units, note_unused, split_ratio
from operando.io.uff.reader import provenance_of
from operando.io.variables import RESPONSES, Source, make_frf
from operando.units import parse_unit

BARE = "frequency of a table without a header line"
_FREQUENCY = re.compile(r"^(f|freq|freqs|frequency|frequencies|frequenz)$", re.IGNORECASE)
_HEAD = re.compile(r"^([^/]+)/([^/]+) (real|imag|magnitude|phase|coherence)$")
_UNITS = {"accelerance": "(m/s2)/N", "mobility": "(m/s)/N", "receptance": "m/N"}
_PARTS = (("real", "imag"), ("magnitude", "phase"))


def write_frf_csv(path: str | Path, frf: Frf) -> None:
    """Write FRFs as CSV with a frequency column; all digits are kept, pairs that were not measured are left out."""
    unit = f" [{_UNITS[frf.quantity]}]" if frf.si else f" [{frf.quantity}]"
    heads, columns = ["frequency [Hz]"], [frf.frequencies_hz]
    for i, response in enumerate(frf.responses):
        for j, reference in enumerate(frf.references):
            h = frf.data[i, j]
            if np.all(np.isnan(h)):
                continue
            heads += [f"{response}/{reference} real{unit}", f"{response}/{reference} imag{unit}"]
            columns += [h.real, h.imag]
            if frf.coherence is not None:
                heads.append(f"{response}/{reference} coherence")
                columns.append(frf.coherence[i, j])
    averages = [] if frf.averages is None else [f"# averages = {frf.averages!r}\n"]
    with replacing(path, "w", encoding="utf-8", newline="\n") as stream:
        stream.writelines([*averages, ",".join(heads) + "\n"])
        np.savetxt(stream, np.column_stack(columns), fmt="%.17g", delimiter=",")


def is_frf_table(names: Sequence[str]) -> bool:
    """Whether the columns of a table are named as those of FRFs."""
    return bool(names) and bool(_FREQUENCY.match(names[0])) and any(_HEAD.match(name) for name in names[1:])


def read_bare_frf(table: NDArray[np.float64], columns: Sequence[str], path: Path, units: Units | None,
                  channels: ChannelSpecs | None) -> Content:  # fmt: skip
    """One FRF of a table without a header line, its columns as the test file states (``columns.check_columns``)."""
    frequencies, values, notes = complex_lines(table, columns, str(path))
    source = _source(path, units, channels)
    frf, findings = make_frf(values[None, None], frequencies, path.name, source, ["ch1"])
    sets = tuple(SetInfo(i, 0, f"column {i + 1}: {text}") for i, text in enumerate(columns))
    return Content(str(path), "csv", frfs=(frf,), sets=sets, findings=(*notes, *findings))


def read_frf_table(names: Sequence[str], texts: Sequence[str], table: NDArray[np.float64], comments: Sequence[str], path: Path,
                   units: Units | None, channels: ChannelSpecs | None) -> Content:  # fmt: skip
    """FRFs of a table (n_columns, n_rows) with a header line of names and units (``texts``), the first column the frequency."""
    where = str(path)
    found: dict[tuple[Dof, Dof], dict[str, int]] = {}
    notes = ["frequency"]
    for i, name in enumerate(names[1:], start=1):
        match = _HEAD.match(name)
        try:
            pair = None if match is None else (Dof.parse(match[1]), Dof.parse(match[2]))
        except DofError:
            pair = None
        notes.append("" if pair is not None else "no FRF by its name: expected RESPONSE/REFERENCE real, as in 12+Z/1+Z real")
        if match is not None and pair is not None:
            found.setdefault(pair, {})[match[3]] = i
    parts = {pair: next((two for two in _PARTS if set(two) <= set(has)), None) for pair, has in found.items()}
    lone = [f"{a}/{b}" for (a, b), kind in parts.items() if kind is None]
    if lone or not found:
        reason = f"{lone[0]} has only one of its two columns" if lone else "no column is named as an FRF"
        hint = "name them 12+Z/1+Z real [(m/s2)/N] and 12+Z/1+Z imag [(m/s2)/N], or magnitude and phase [deg]"
        raise FormatError(reason, where=where, hint=hint)
    frequencies, factor = table[0], 1.0
    if texts[0]:
        try:
            factor = parse_unit(texts[0], "frequency")[1]
        except UnitError as error:
            raise FormatError(f"the frequency column is in {texts[0]!r}: {error.message}", where=where) from error
    responses, references = tuple(dict.fromkeys(p[0] for p in found)), tuple(dict.fromkeys(p[1] for p in found))
    data = np.full((len(responses), len(references), table.shape[1]), np.nan, complex)
    with_coherence = all("coherence" in has for has in found.values())
    coherence = np.full(data.shape, np.nan) if with_coherence else None
    unit_texts = set()
    for pair, has in found.items():
        kind = parts[pair]
        assert kind is not None
        columns = ["Hz", kind[0], "imag" if kind[0] == "real" else "rad" if texts[has[kind[1]]] == "rad" else "deg"]
        at = responses.index(pair[0]), references.index(pair[1])
        _, data[at], _ = complex_lines(table[[0, has[kind[0]], has[kind[1]]]], columns, where)
        if coherence is not None:
            coherence[at] = table[has["coherence"]]
        unit_texts.add(texts[has[kind[0]]])
    empty = int(np.count_nonzero(np.isnan(table[sorted({i for has in found.values() for i in has.values()})])))
    frf, findings = _scaled_frf(data, frequencies * factor, responses, references, coherence, unit_texts, path, units, channels)
    averages = [float(m[1]) for m in (re.match(r"# averages = ([0-9.e+]+)$", c) for c in comments) if m]
    if averages:
        frf = replace(frf, averages=averages[0])
    if empty:
        lost = Finding("nan", f"{empty} cells of the table hold no number", "warning", where, consequence="they are NaN in the FRFs")
        findings = [*findings, lost]
    sets = tuple(SetInfo(i, 0, f"column {name}", "ignored" if notes[i] and i else "used", notes[i]) for i, name in enumerate(names))
    return Content(where, "csv", frfs=(frf,), sets=sets, findings=tuple(findings))


def _scaled_frf(data: NDArray[np.complex128], frequencies: NDArray[np.float64], responses: tuple[Dof, ...], references: tuple[Dof, ...],
                coherence: NDArray[np.float64] | None, unit_texts: set[str], path: Path, units: Units | None,
                channels: ChannelSpecs | None) -> tuple[Frf, list[Finding]]:  # fmt: skip
    """FRFs in SI where the header states one unit, else as [units] and [channels] say."""
    source = _source(path, units, channels)
    text = next(iter(unit_texts)) if len(unit_texts) == 1 else ""
    ratio = split_ratio(text) if text else None
    names = [""] * len(responses)
    if ratio is None:
        stated = text if text in RESPONSES else ""
        return make_frf(data, frequencies, path.name, source, names, responses, references, stated, coherence=coherence)
    (kind, above), (_, below) = parse_unit(ratio[0]), parse_unit(ratio[1], "force")
    quantity = next((name for name, motion in RESPONSES.items() if motion == kind), None)
    if quantity is None:
        hint = "expected acceleration, velocity or displacement over force"
        raise FormatError(f"{text!r} is no unit of an FRF", where=str(path), hint=hint)
    note_unused(units, kind, ratio[0], above, path.name)
    note_unused(units, "force", ratio[1], below, path.name)
    with np.errstate(over="ignore", invalid="ignore"):  # pairs that were not measured are NaN
        data = data * (above / below)
    return make_frf(data, frequencies, path.name, source, names, responses, references, quantity, True, coherence)


def _source(path: Path, units: Units | None, channels: ChannelSpecs | None) -> Source:
    return Source(str(path), [], units, channels, provenance_of(path))

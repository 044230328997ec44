"""Mutants of files: a seeded mutator, what a reader made of a mutant, and whether that is allowed.

A seed is a small good file with its parts: stretches of bytes, each with the pieces of content (a channel with its samples, a pair of
FRFs, a mode, a node) that hang on it. A mutant is refused by a typed error, or read. If it is read, every piece that hangs on no part
that was changed must be there as before, or a finding that the good file does not have must say that something is wrong.
"""

from __future__ import annotations

import os
import random
import re
import resource
import signal
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from operando.data import Geometry, ModalModel, TimeRecord
from operando.errors import OperandoError
from operando.io import Content

TIME_LIMIT_S = 10.0
MEMORY_FACTOR, MEMORY_FREE = 5, 200 << 20
_TOO_LONG = f"no answer within {TIME_LIMIT_S:g} s"

Edit = tuple[int, int, bytes]
"""Bytes from start to stop become others; all places are those of the good file."""


# --- content ----------------------------------------------------------------------------------------------------------------------


def pieces(found: Any, fine: bool = False) -> Counter[Any]:
    """What was read, piece by piece. ``fine``: every sample is a piece of its own."""
    if isinstance(found, Content):
        out: Counter[Any] = Counter()
        for obj in found.objects:
            out += pieces(obj, fine)
        if found.header is not None:
            out["header", plain(found.header)] += 1
        return out
    if isinstance(found, TimeRecord):
        return _of_record(found, fine)
    if isinstance(found, ModalModel):
        return _of_model(found)
    if isinstance(found, Geometry):
        return _of_geometry(found)
    if type(found).__name__ == "Frf":
        return _of_frf(found, fine)
    if is_dataclass(found):
        return Counter(("field", f.name, plain(getattr(found, f.name))) for f in fields(found) if f.name not in ("path", "given"))
    return Counter(("entry", name, plain(value)) for name, value in found.items())


def _of_record(record: TimeRecord, fine: bool) -> Counter[Any]:
    axis = ("axis", record.sampling_hz, record.start_s)
    out: Counter[Any] = Counter()
    for channel, row in zip(record.channels, record.data, strict=True):
        what = ("channel", str(channel.dof), channel.quantity, channel.unit, channel.name)
        if not fine:
            out[(*what, axis, row.astype(float).tobytes())] += 1
            continue
        out[what] += 1
        out.update(("sample", channel.name, float(value).hex()) for value in row)
    if fine:
        out[axis] += 1
    return out


def _of_frf(frf: Any, fine: bool) -> Counter[Any]:
    out: Counter[Any] = Counter()
    lines = frf.frequencies_hz.tobytes()
    for i, response in enumerate(frf.responses):
        for j, reference in enumerate(frf.references):
            what = (frf.quantity, frf.si, str(response), str(reference))
            for name in ("data", "coherence", "variance"):
                table = getattr(frf, name)
                if table is None or np.all(np.isnan(table[i, j])):
                    continue
                if not fine:
                    out[(name, *what, lines, table[i, j].tobytes())] += 1
                    continue
                out[(name, *what)] += 1
                out.update(("sample", name, f, v.item()) for f, v in zip(frf.frequencies_hz.tolist(), table[i, j], strict=True))
    return out


def _of_model(model: ModalModel) -> Counter[Any]:
    out: Counter[Any] = Counter()
    for name, terms in (("mode", model), ("residual", model.residuals)):
        for r in range(0 if terms is None else len(terms.frequencies_hz)):
            shape = tuple(sorted((str(d), complex(v)) for d, v in zip(model.dofs, terms.shapes[:, r], strict=True) if v))
            out[name, float(terms.frequencies_hz[r]), float(terms.damping_ratios[r]), model.scaling, model.si, repr(shape)] += 1
    return out


def _of_geometry(geometry: Geometry) -> Counter[Any]:
    out: Counter[Any] = Counter({("unit", geometry.unit_known): 1})
    for node, position in zip(geometry.nodes, geometry.coordinates, strict=True):
        out["node", node, position.tobytes()] += 1
    out.update(("line", nodes) for nodes in geometry.lines)
    out.update(("face", nodes) for nodes in geometry.faces)
    out.update(("system", plain(system)) for system in geometry.systems)
    return out


def plain(value: Any) -> Any:
    """A value that can be compared and counted, whatever it is made of."""
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.shape, tuple(value.ravel().tolist()) if value.dtype.kind in "OU" else value.tobytes())
    if is_dataclass(value) and not isinstance(value, type):
        return (type(value).__name__, *(plain(getattr(value, f.name)) for f in fields(value)))
    if isinstance(value, dict):
        return tuple((plain(k), plain(v)) for k, v in value.items())
    if isinstance(value, list | tuple):
        return tuple(plain(v) for v in value)
    return value if isinstance(value, str | int | type(None)) else repr(value)


def told(found: Any) -> Counter[Any]:
    """What is said of a file: its findings."""
    return Counter((f.kind, f.message) for f in getattr(found, "findings", ()))


def extent(found: Any) -> Counter[str]:
    """How much was read: samples, values of FRFs, modes, nodes."""
    if isinstance(found, Content):
        return sum((extent(obj) for obj in found.objects), Counter())
    if isinstance(found, Geometry):
        return Counter(nodes=len(found.nodes))
    if isinstance(found, ModalModel):
        return Counter(modes=found.n_modes, values=found.n_modes * len(found.dofs))
    return Counter({type(found).__name__: found.data.size}) if hasattr(found, "data") else Counter()


# --- seeds ------------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Part:
    """Bytes of a good file, and the pieces of its content that hang on them (None: all)."""

    start: int
    stop: int
    depend: Counter[Any] | None = None


@dataclass(frozen=True)
class Seed:
    """A good file.

    Parameters
    ----------
    name : str
    file : str
        Name of the file, whose end some readers look at.
    data : bytes
    read : callable
        From a path to what the file holds.
    parts : tuple of Part
        What lies in none of them is structure, on which all content hangs.
    fine : bool
        Whether every sample is a piece of its own.
    whole : bool
        Whether the format proves its content (a checksum): what is read is all there, or refused.
    fixed : bool
        Whether content is found by its place in the file: what shifts it changes all of it.
    """

    name: str
    file: str
    data: bytes
    read: Callable[[Path], Any]
    parts: tuple[Part, ...] = ()
    fine: bool = False
    whole: bool = False
    fixed: bool = False


def with_parts(seed: Seed, cuts: Iterable[tuple[int, int, bytes]], path: Path) -> Seed:
    """The seed with parts, by what its reader says of the file without each.

    Parameters
    ----------
    seed : Seed
    cuts : iterable of (start, stop, bytes)
        Bytes of a part, and the whole file without its content.
    path : Path
        Where files are written.
    """
    whole = pieces(read_file(seed, seed.data, path), seed.fine)
    parts = []
    for start, stop, without in cuts:
        try:
            parts.append(Part(start, stop, whole - pieces(read_file(seed, without, path), seed.fine)))
        except OperandoError:
            parts.append(Part(start, stop))
    return replace(seed, parts=tuple(parts))


def read_file(seed: Seed, data: bytes, path: Path) -> Any:
    """What the reader of a seed makes of some bytes."""
    path.write_bytes(data)
    return seed.read(path)


# --- mutator ----------------------------------------------------------------------------------------------------------------------

_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[EeDd][-+]?\d+)?")
_EXTREME = (
    b"0", b"-1", b"1", b"nan", b"inf", b"-inf", b"1e400", b"1E-320", b"2147483647", b"2147483648", b"-2147483648", b"9223372036854775807",
    b"9223372036854775808", b"4294967295", b"9" * 30, b"9" * 400, b"1e9", b"1e18", b"1e308", b"-", b"1E", b".", b"0x10", b"1_0", b"1e-9",
    b"99999", b"65536", b"", b"*****", b"1.#QNAN", b"\xef\xbc\x91",
)  # fmt: skip
_SEPARATORS = re.compile(rb"    -1|[,;\t\n\r=\[\]{}\":]|  +")
_TEXTS = (b"    -1\n", b"\n", b" ", b"\x00", b"-1", b"\r", b",", b"\t", b"nan", b'"', b"\xff\xfe", b"\x1b[2J", b"58b", b"]", b"1e999")
_WORDS = (0, 1, -1, 2**31 - 1, -(2**31), 2**16, 2**24, 255, 2**28)


def _span(rng: random.Random, size: int, longest: int) -> tuple[int, int]:
    length = min(size, int(2 ** rng.uniform(0, np.log2(longest))))
    start = rng.randrange(size - length + 1)
    return start, start + length


def _line(rng: random.Random, data: bytes) -> tuple[int, int]:
    at = rng.randrange(len(data))
    stop = data.find(b"\n", at)
    return data.rfind(b"\n", 0, at) + 1, len(data) if stop < 0 else stop + 1


def _found(rng: random.Random, data: bytes, pattern: re.Pattern[bytes]) -> tuple[int, int]:
    match = pattern.search(data, rng.randrange(len(data))) or pattern.search(data)
    return match.span() if match else _span(rng, len(data), 8)


def _flip(rng: random.Random, data: bytes) -> list[Edit]:
    at = rng.randrange(len(data))
    return [(at, at + 1, bytes([data[at] ^ (1 << rng.randrange(8))]))]


def _overwrite(rng: random.Random, data: bytes) -> list[Edit]:
    start, stop = _span(rng, len(data), 32)
    return [(start, stop, rng.choice((rng.randbytes(stop - start), bytes([rng.choice(b"\x00\xff 09")]) * (stop - start))))]


def _delete(rng: random.Random, data: bytes) -> list[Edit]:
    return [(*_span(rng, len(data), max(2, len(data) // 2)), b"")]


def _insert(rng: random.Random, data: bytes) -> list[Edit]:
    at = rng.randrange(len(data) + 1)
    return [(at, at, rng.choice((rng.choice(_TEXTS), rng.randbytes(rng.randrange(1, 20)))))]


def _truncate(rng: random.Random, data: bytes) -> list[Edit]:
    return [(rng.randrange(len(data)), len(data), b"")]


def _drop_line(rng: random.Random, data: bytes) -> list[Edit]:
    return [(*_line(rng, data), b"")]


def _double_line(rng: random.Random, data: bytes) -> list[Edit]:
    start, stop = _line(rng, data)
    return [(start, start, data[start:stop])]


def _number(rng: random.Random, data: bytes) -> list[Edit]:
    start, stop = _found(rng, data, _NUMBER)
    value = rng.choice(_EXTREME)
    return [(start, stop, value.rjust(stop - start)[: stop - start] if rng.random() < 0.6 else value)]


def _digit(rng: random.Random, data: bytes) -> list[Edit]:
    start, stop = _found(rng, data, _NUMBER)
    places = [i for i in range(start, stop) if 48 <= data[i] <= 57]
    at = rng.choice(places) if places else start
    return [(at, at + 1, str(rng.randrange(10)).encode())]


def _separator(rng: random.Random, data: bytes) -> list[Edit]:
    start, stop = _found(rng, data, _SEPARATORS)
    text = data[start:stop]
    return [(start, stop, rng.choice((b"", b" ", text[1:], text + text, b"x" + text[1:], rng.choice(_TEXTS))))]


def _swap(rng: random.Random, data: bytes) -> list[Edit]:
    a, b = _span(rng, len(data), max(2, len(data) // 4)), _span(rng, len(data), max(2, len(data) // 4))
    return [(*a, data[b[0] : b[1]]), (*b, data[a[0] : a[1]])]


def _word(rng: random.Random, data: bytes) -> list[Edit]:
    start = rng.randrange(max(1, len(data) // 4)) * 4
    value = rng.choice(_WORDS).to_bytes(4, rng.choice(("little", "big")), signed=True)
    return [(start, min(len(data), start + 4), value[: len(data) - start])]


MUTATIONS = (
    _flip, _overwrite, _delete, _insert, _truncate, _drop_line, _double_line, _number, _number, _digit, _separator, _swap, _word,
)  # fmt: skip


def edits_of(rng: random.Random, data: bytes) -> list[Edit]:
    """One to four mutations of a file, where they do not meet."""
    found: list[Edit] = []
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        for edit in sorted(rng.choice(MUTATIONS)(rng, data)):
            if all(edit[1] < start or stop < edit[0] for start, stop, _ in found) and data[edit[0] : edit[1]] != edit[2]:
                found.append(edit)
    return sorted(found)


def applied(data: bytes, edits: Iterable[Edit]) -> bytes:
    """The file with its edits."""
    for start, stop, new in sorted(edits, reverse=True):
        data = data[:start] + new + data[stop:]
    return data


# --- judge ------------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """What became of a mutant: ``refused``, ``equal`` (outside what was changed), ``told`` (a finding says so), or ``failure``."""

    what: str
    note: str = ""
    seconds: float = 0.0
    memory: int = 0


class HangError(BaseException):
    """The time limit is over; no reader catches it."""


def _hang(*_: Any) -> None:
    raise HangError


class Fuzzer:
    """Mutants of one seed, by number: the same number is the same mutant.

    Parameters
    ----------
    seed : Seed
    path : Path
        File that mutants are written to.
    series : str
        Mutants of another series are others.
    """

    def __init__(self, seed: Seed, path: Path, series: str = "") -> None:
        self.seed, self.path, self.series = seed, path, series
        good = read_file(seed, seed.data, path)
        self.good, self.said, self.extent = pieces(good, seed.fine), told(good), extent(good)

    def edits(self, number: int) -> list[Edit]:
        """Changes of a mutant."""
        return edits_of(random.Random(f"{self.seed.name}/{self.series}/{number}"), self.seed.data)

    def try_mutant(self, number: int) -> Outcome:
        """Read a mutant and judge what comes of it. One that takes too long is tried again: the machine may have other work."""
        first = self._timed(number)
        return self._timed(number) if first.note == _TOO_LONG else first

    def _timed(self, number: int) -> Outcome:
        edits = self.edits(number)
        data = applied(self.seed.data, edits)
        self.path.write_bytes(data)
        before, start = _peak(), time.perf_counter()
        old = signal.signal(signal.SIGALRM, _hang)
        signal.setitimer(signal.ITIMER_REAL, TIME_LIMIT_S)
        try:
            what, note = self.judge(edits)
        except HangError:
            what, note = "failure", _TOO_LONG
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, old)
        seconds, memory = time.perf_counter() - start, _peak() - before
        if what != "failure" and memory > MEMORY_FACTOR * len(data) + MEMORY_FREE:
            what, note = "failure", f"took {memory >> 20} MB"
        return Outcome(what, note, seconds, memory)

    def judge(self, edits: list[Edit]) -> tuple[str, str]:
        """Read the file that now stands there, the good one with edits; kind of outcome and note."""
        try:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                found = self.seed.read(self.path)
                now = pieces(found, self.seed.fine)
        except OperandoError as error:
            text = str(error)
            return ("refused", text) if len(text) < 2000 else ("failure", f"a message of {len(text)} characters")
        except Exception as error:
            at = traceback.extract_tb(error.__traceback__)[-1]
            return "failure", f"{type(error).__name__}: {str(error)[:150]} ({Path(at.filename).name}:{at.lineno})"
        if caught:
            return "failure", f"warning: {caught[0].message} ({Path(caught[0].filename).name}:{caught[0].lineno})"
        if told(found) - self.said:
            return "told", ""
        required = self.required(edits)
        lost = required - now
        if lost:
            return "failure", f"lost without a word: {str(next(iter(lost)))[:150]}"
        in_place = all(len(new) == stop - start for start, stop, new in edits)
        less = self.extent - extent(found)
        if in_place and less and not (self.seed.fine and required) and all(s.status == "used" for s in getattr(found, "sets", ())):
            return "failure", f"fewer without a word: {dict(less)}"
        return "equal", ""

    def required(self, edits: list[Edit]) -> Counter[Any]:
        """Pieces that hang on nothing that was changed."""
        if self.seed.whole:
            return self.good
        left = Counter(self.good)
        for start, stop, new in edits:
            hit = [
                part for part in self.seed.parts if (start < part.stop and part.start < stop) or part.start <= start == stop <= part.stop
            ]
            inside = sum(min(stop, part.stop) - max(start, part.start) for part in hit)
            shifts = self.seed.fixed and len(new) != stop - start
            if shifts or not hit or inside < stop - start or any(part.depend is None for part in hit):
                return Counter()
            for part in hit:
                assert part.depend is not None
                left -= part.depend
        return left


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def scratch() -> str | None:
    """A folder in memory for the mutants, where the system has one."""
    return "/dev/shm" if os.path.isdir("/dev/shm") and os.access("/dev/shm", os.W_OK) else None

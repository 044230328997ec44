"""Cutting a UFF file into its sets, binary payloads included, by their lengths and never by what they happen to contain."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from operando.errors import FormatError
from operando.io.uff.columns58 import LINES
from operando.io.uff.header58 import Header58, parse_header58
from operando.io.uff.textform import HEAD_BYTES, Buffer, utf16_of

_OPENING = re.compile(rb"(?:\A(?:\xef\xbb\xbf)?|(?<=[\r\n]))([ \t]{0,8})-1[ \t]*\r?\n[ \t\r\n]*\d{1,6}[ \t]*(?:[bB][ \t]|[\r\n]|\Z)")
_END_OF_SEPARATOR = re.compile(rb"-1[ \t]*(?=[\r\n]|\Z)")
_START_OF_SEPARATOR = re.compile(rb"(?:\A(?:\xef\xbb\xbf)?|[\r\n])([ \t]{0,8})\Z")
_NUMBER_LINE = re.compile(rb"[ \t]{0,8}(\d{1,6})[ \t]*([bB]?)(?![^ \t\r\n])")
_REST_OF_LINE = re.compile(rb"[ \t]*(?:\r\n|\n|\r|\Z)")
_BLANK_LINE = re.compile(rb"[ \t]*\r?\n")
_BLANK = re.compile(rb"[\s\x00\x1a]*\Z")
_NOTHING = re.compile(rb"(?:(?:\A|(?<=[\r\n]))[ \t]*-1[ \t]*(?=[\r\n]|\Z)|[\s\x00\x1a]|\xef\xbb\xbf)*")
_NEWLINE, _RETURN, _BLANK_CHARACTER = b"\n\r "


@dataclass(frozen=True)
class RawSet:
    """Where one set lies in its file.

    ``number`` is the set type (58, 15, …), 0 where none is stated. ``start, body, end, stop`` are the offsets of the opening separator, of
    the line with the set type, of the closing separator, and after it; ``payload`` those of the numbers of a measured function, ``header``
    its header where it could be read. ``problem`` says why the set cannot be used, ``notes`` which deviations were put right.
    """

    index: int
    number: int
    binary: bool
    start: int
    body: int
    end: int
    stop: int
    payload: tuple[int, int] | None = None
    header: Header58 | None = None
    problem: str = ""
    notes: tuple[str, ...] = ()

    def raw(self, buffer: Buffer) -> bytes:
        """The bytes of the set with its separators."""
        return bytes(buffer[self.start : self.stop])


def find_first_set(buffer: Buffer) -> re.Match[bytes] | None:
    """The opening separator of the first set near the beginning, with its indentation as group 1, or None where there is no UFF set."""
    head = bytes(buffer[:HEAD_BYTES])
    codec = utf16_of(head)
    if codec is not None:
        head = head.decode(codec, "ignore").lstrip("\ufeff").encode()
    return _OPENING.search(head if b"\n" in head else head.replace(b"\r", b"\n"))


def _separator_of(buffer: Buffer, first: bytes) -> bytes:
    """Indentation of the separators: the most frequent one near both ends of the file; the first separator itself may be damaged."""
    ends = bytes(buffer[:HEAD_BYTES]), bytes(buffer[max(HEAD_BYTES, len(buffer) - HEAD_BYTES) :])
    found = Counter([first, *(indentation for end in ends for indentation in _indentations(end))])
    return found.most_common(1)[0][0]


def _indentations(text: bytes) -> Iterator[bytes]:
    """Blanks before each separator; searched by its end, which is a fixed text and found fast."""
    for end in _END_OF_SEPARATOR.finditer(text):
        start = _START_OF_SEPARATOR.search(text[max(0, end.start() - 12) : end.start()])
        if start is not None:
            yield start[1]


def outside_sets(buffer: Buffer, sets: list[RawSet]) -> list[tuple[int, int]]:
    """Stretches of bytes that belong to no set (start, stop); blanks and separators between the sets do not count."""
    edges = [0, *(edge for raw in sets for edge in (raw.start, raw.stop)), len(buffer)]
    out = []
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        if stop <= start:  # the closing separator of one set opens the next
            continue
        gap = bytes(buffer[start:stop])
        first = _NOTHING.match(gap)
        assert first is not None  # it matches nothing as well
        if first.end() < len(gap):
            out.append((start + first.end(), start + len(gap.rstrip(b" \t\r\n\x00\x1a"))))
    return out


def split_sets(buffer: Buffer, where: str = "") -> list[RawSet]:
    """All sets of a file in their order; ``buffer`` in one form (:func:`operando.io.uff.textform.in_one_form`)."""
    first = find_first_set(buffer)
    if first is None:
        raise FormatError("no UFF set found", where=where, hint="a set starts with a line '    -1' and a line with its number")
    separator = _separator_of(buffer, first[1]) + b"-1"
    position = first.start(1) if separator == first[1] + b"-1" else 0
    sets: list[RawSet] = []
    while True:
        start = _next_separator(buffer, position, separator)
        if start < 0:
            break
        found = _one_set(buffer, start, separator, len(sets))
        if found is None:  # two separators in a row: the second one opens
            position = _line_end(buffer, start)
            continue
        sets.append(found)
        position = found.stop
        if found.end < found.stop and _opens_at_once(buffer, found.stop, separator):
            # The closing separator is the opening one of the next set as well.
            position = found.end
    return sets


def _one_set(buffer: Buffer, start: int, separator: bytes, index: int) -> RawSet | None:
    body = _line_end(buffer, start)
    while body < len(buffer) and (blank := _BLANK_LINE.match(buffer, body)):
        body = blank.end()
    if body >= len(buffer) or _is_separator(buffer, body, separator):
        return None
    match = _NUMBER_LINE.match(buffer, body)
    number, binary = (int(match[1]), bool(match[2])) if match else (0, False)
    bare = RawSet(index, number, binary and number == 58, start, body, body, body)
    if match is None:
        return _closed(buffer, bare, body, separator, "the line after the separator holds no set number")
    if number != 58:
        return _closed(buffer, bare, body, separator, "")
    try:
        header, data = parse_header58(buffer, body)
    except FormatError as error:
        return _closed(buffer, bare, body, separator, error.message)
    if not header.binary:
        numbers = header.points * header.numbers_per_point
        c = _closed(buffer, bare, _after_equal_lines(buffer, data, len(separator), numbers), separator, "")
        characters = c.end - data
        # A number takes a character at least: checked before memory is taken for what the header declares.
        problem = ""
        if numbers > characters:
            problem = f"the header declares {header.points} points ({numbers} numbers), the set holds {characters} characters"
        return RawSet(c.index, c.number, c.binary, c.start, c.body, c.end, c.stop, (data, c.end), header, problem, c.notes)
    return _binary_set(buffer, bare, header, data, separator)


def _binary_set(buffer: Buffer, bare: RawSet, header: Header58, data: int, separator: bytes) -> RawSet:
    """Find the end of a binary payload from the number of points, or from the stated number of bytes."""
    size = len(buffer)
    lengths = [n for n in dict.fromkeys((header.expected_bytes, header.stated_bytes)) if 0 < n <= size - data]
    closing = _closing(separator)
    # A closing separator decides; only without one may the payload end with the file.
    for n_bytes, needs_separator in [(n, True) for n in lengths] + [(n, False) for n in lengths]:
        end = data + n_bytes
        after = closing.match(buffer, end)
        at_eof = not needs_separator and size - end < 4096 and _BLANK.match(buffer, end) is not None
        if after is None and not at_eof:
            continue
        if (after is None or n_bytes != header.stated_bytes) and 0 <= _next_separator(buffer, max(data, end - 12), separator) < end:
            continue  # no count agrees with it, and the closing separator itself would be its last sample
        close = end if after is None else after.start(1)
        stop = size if after is None else after.end()
        problem = _short(header, n_bytes) if n_bytes != header.expected_bytes else ""
        notes = () if problem else tuple(_binary_notes(header, n_bytes, after is not None))
        b = bare  # not by replace, which takes longer than all the rest of a short set
        return RawSet(b.index, b.number, b.binary, b.start, b.body, max(close, end), stop, (data, end), header, problem, notes)
    return _lost_payload(buffer, bare, header, data, separator)


def _after_equal_lines(buffer: Buffer, at: int, width: int, numbers: int) -> int:
    """Where the lines end that are as long as the first one and hold a character right behind ``width`` columns.

    No separator of that width is among them. This tells so in a third of the time of a search for it. It looks no farther than the lines
    that the numbers of the set should take.
    """
    length = buffer.find(b"\n", at, at + 1024) + 1 - at
    if length <= width + 1:
        return at
    left = -(-numbers // max(len(bytes(buffer[at : at + length]).split()), 1))
    while left > 0:
        step = min(LINES, left)
        text = bytes(buffer[at : at + step * length])
        lines = np.frombuffer(text, np.uint8, len(text) // length * length).reshape(-1, length)
        other = np.flatnonzero(lines[:, -1] != _NEWLINE)[:1]
        if other.size:
            lines = lines[: other[0]]
        equal = np.count_nonzero(lines == _NEWLINE) == len(lines) and (
            text.find(b"\r", 0, lines.size) < 0 or np.count_nonzero(lines == _RETURN) == np.count_nonzero(lines[:, -2] == _RETURN)
        )
        if not equal or np.any(lines[:, width] <= _BLANK_CHARACTER):
            return at
        at += lines.size
        if len(lines) < step:
            break
        left -= step
    return at


def _binary_notes(header: Header58, n_bytes: int, closed: bool) -> Iterator[str]:
    if header.stated_bytes != n_bytes:
        yield f"the header states {header.stated_bytes} bytes, {header.points} points are {n_bytes} bytes: read by the points"
    if not closed:
        yield "no closing separator at the end of the file"


@lru_cache(maxsize=16)
def _closing(separator: bytes) -> re.Pattern[bytes]:
    # The whole separator, its blanks included: with a part of it, four of its blanks could pass for one more sample.
    return re.compile(rb"[\r\n]{0,4}(" + re.escape(separator) + rb")[ \t]*(?:\r\n|\n|\r|\Z)")


def _lost_payload(buffer: Buffer, bare: RawSet, header: Header58, data: int, separator: bytes) -> RawSet:
    """No separator follows the payload where it should: take what lies up to the next separator that opens or closes a set.

    The header may state far too much: the sets behind must not be swallowed.
    """
    border = re.compile(
        rb"[ \t]*(?:\r\n|\n|\r|\Z)(?:[\s\x00\x1a]*\Z|(?:" + re.escape(separator) + rb"[ \t]*\r?\n)?[ \t]*\d{1,6}[ \t]*[bB\r\n])"
    )
    end = _next_separator(buffer, data, separator)
    while end >= 0 and border.match(buffer, end + len(separator)) is None:
        end = _next_separator(buffer, end + 1, separator)
    stop = len(buffer) if end < 0 else _line_end(buffer, end)
    end = len(buffer) if end < 0 else end
    found = replace(bare, payload=(data, end), header=header, end=end, stop=stop)
    payload = bytes(buffer[data:end])
    extra = len(payload) - header.expected_bytes
    if extra > 0 and payload.count(b"\r\n") in range(max(extra - 2, 1), extra + 3):
        return replace(found, problem=f"the binary data are {extra} bytes too long: a transfer in text mode put carriage returns into them")
    return replace(found, problem=_short(header, len(payload)))


def _short(header: Header58, n_bytes: int) -> str:
    stated = f" and states {header.stated_bytes} bytes" if header.stated_bytes != header.expected_bytes else ""
    return f"the header declares {header.points} points ({header.expected_bytes} bytes){stated}, the set holds {n_bytes} bytes"


def _closed(buffer: Buffer, bare: RawSet, after: int, separator: bytes, problem: str) -> RawSet:
    """A text set: it ends at the next separator line, or with the file."""
    end = _next_separator(buffer, after, separator)
    if end < 0:
        notes = (*bare.notes, "no closing separator at the end of the file")
        return replace(bare, end=len(buffer), stop=len(buffer), problem=problem, notes=notes)
    b, stop = bare, _line_end(buffer, end)
    return RawSet(b.index, b.number, b.binary, b.start, b.body, end, stop, problem=problem, notes=b.notes)


def _next_separator(buffer: Buffer, position: int, separator: bytes) -> int:
    """Offset of the next line that is a separator, or −1."""
    while (found := buffer.find(separator, position)) >= 0:
        if _is_separator(buffer, found, separator):
            return found
        position = found + 1
    return -1


def _is_separator(buffer: Buffer, at: int, separator: bytes) -> bool:
    if buffer[at : at + len(separator)] != separator:
        return False
    line_start = at == 0 or buffer[at - 1 : at] in (b"\n", b"\r") or (at == 3 and buffer[:3] == b"\xef\xbb\xbf")
    return line_start and _REST_OF_LINE.match(buffer, at + len(separator)) is not None


def _opens_at_once(buffer: Buffer, at: int, separator: bytes) -> bool:
    """Whether a set number follows directly, without a separator of its own."""
    if at >= len(buffer) or _is_separator(buffer, at, separator):
        return False
    line = buffer[at : min(at + 12, len(buffer))]
    return re.match(rb"[ \t]{2,5}\d{1,5}[bB]?[ \t]*[\r\n]", line) is not None


def _line_end(buffer: Buffer, at: int) -> int:
    """Offset of the next line."""
    newline = buffer.find(b"\n", at)
    return len(buffer) if newline < 0 else newline + 1

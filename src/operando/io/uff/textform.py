"""Bringing the text of a UFF file into one form before it is cut into sets: UTF-16, and line ends that are lone carriage returns."""

from __future__ import annotations

import codecs
import mmap
import re

from operando.errors import FormatError

Buffer = bytes | mmap.mmap
"""What can be searched, matched and sliced: a mapped file, or bytes."""

HEAD_BYTES = 1 << 16
_BINARY_SET = re.compile(rb"[\r\n][ \t]{0,8}58[ \t]*[bB](?=[ \t\r\n])")


def utf16_of(head: bytes) -> str | None:
    """Codec of a text in UTF-16, by its byte order mark or by the zeros beside ASCII characters; None where it is none."""
    if head.startswith(codecs.BOM_UTF16_LE) and not head.startswith(codecs.BOM_UTF32_LE):
        return "utf-16-le"
    if head.startswith(codecs.BOM_UTF16_BE):
        return "utf-16-be"
    start = head[:256]
    for codec, zeros in (("utf-16-le", start[1::2]), ("utf-16-be", start[0::2])):
        if "-1".encode(codec) in start and zeros.count(0) == len(zeros):
            return codec
    return None


def in_one_form(buffer: Buffer) -> tuple[Buffer, str]:
    """The file as bytes in an ASCII-like code with line ends that hold a line feed, and what was done to it in words.

    A file that needs nothing is returned as it is, without a copy. Lone carriage returns in a file with binary sets are refused: they
    cannot be told from data.
    """
    head = bytes(buffer[:HEAD_BYTES])
    codec = utf16_of(head)
    note = ""
    if codec is not None:
        whole = bytes(buffer[:])
        try:
            buffer = whole.decode(codec).lstrip("\ufeff").encode("utf-8")
        except UnicodeDecodeError as error:
            raise FormatError(f"the file starts as UTF-16 text but is none from byte {error.start} on") from error
        head, note = buffer[:HEAD_BYTES], "the text is UTF-16"
    if b"\r" in head and b"\n" not in head:
        if _BINARY_SET.search(buffer):
            raise FormatError(
                "lines end with lone carriage returns and sets are binary: the end of a header is not distinguished from the data",
                hint="export the file again with line feeds, or in ASCII",
            )
        buffer = bytes(buffer[:]).replace(b"\r", b"\n")
        note = "; ".join(filter(None, (note, "the line ends are lone carriage returns")))
    return buffer, note

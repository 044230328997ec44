"""How much memory the content of a file may take, from the size of the file."""

from __future__ import annotations

from operando.errors import FormatError

DEFLATE_RATIO = 1032
"""Most bytes that one byte of a deflate stream (zlib, gzip) can become: a copy of 258 bytes takes at least two bits, so 258·8/2.
(Deutsch, RFC 1951: the longest match is 258 bytes; its length and its distance need a code of at least one bit each.)"""
GROWTH = 4
"""Content read may be this many times the file. Samples of 24-bit converters stored as 64-bit numbers compress to 3/8 at best but for
silence; 4 leaves room for that. Readers hold the content at most twice, as stored and as numbers."""
FREE_BYTES = 64 << 20
"""Content that is read whatever the size of the file (bytes): with its copy it keeps below the 200 MB a small file may take."""


def check_growth(needed: int, size: int, where: str, what: str) -> None:
    """Refuse content of ``needed`` bytes that is out of proportion to its file of ``size`` bytes."""
    if needed > GROWTH * size + FREE_BYTES:
        raise FormatError(
            f"{what} would take {needed / 1e6:.0f} MB of memory, the file has {size / 1e6:.3g} MB",
            where=where,
            hint="a damaged file; if it is yours, save it again without compression",
        )


def memory_allowed(size: int) -> int:
    """Bytes that trying a file of a size may take in a process of its own: its content twice, and 64 MB for the library."""
    return 2 * (GROWTH * size + FREE_BYTES) + (64 << 20)

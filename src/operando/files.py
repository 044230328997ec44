"""Files: their order, the hash of their content."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path


def natural_order(path: Path) -> list[int | str]:
    """Sorting key of paths: run2 before run10.

    >>> [p.name for p in sorted([Path("run10.uff"), Path("run2.uff")], key=natural_order)]
    ['run2.uff', 'run10.uff']
    """
    return [int(part) if part.isdecimal() else part.lower() for part in re.split(r"(\d+)", path.as_posix())]


def file_hash(path: str | Path) -> str:
    """SHA-256 of a file, read in chunks."""
    digest = hashlib.sha256()
    with open(path, "rb") as stream:
        while chunk := stream.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()

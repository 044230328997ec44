"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from operando.errors import MissingError


@contextmanager
def replacing(path: str | Path, mode: str = "wb", **kwargs: Any) -> Iterator[IO[Any]]:
    """Open a file beside ``path`` for writing; it takes the name ``path`` when the block ends well, and disappears when it does not.

    Raises
    ------
    MissingError
        If the folder does not exist or cannot be written.
    """
    path = Path(path)
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        stream = open(beside, mode, **kwargs)  # noqa: SIM115
    except OSError as error:
        raise MissingError(f"cannot be written: {error.strerror}", where=str(path), hint="does the folder exist?") from error
    try:
        with stream:
            yield stream
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)

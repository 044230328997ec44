"""Tests in an object store or behind any other URL that fsspec reads: the driver lists them, the worker that runs one copies it.

A copy holds the folder of the test file with all below it, lies where temporary files lie, and goes with the end of the run.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from operando.errors import ConfigError, MissingError

STAMPS = ("ETag", "etag", "md5Hash", "content_hash", "LastModified", "last_modified", "updated", "mtime", "created")
"""What stores say of a file that changes with its content; each has its own words."""


def in_store(path: object) -> bool:
    """Whether a path is a URL."""
    return "://" in str(path)


def matches(pattern: str) -> tuple[str, dict[str, str]]:
    """Files of a URL in which ``*`` stands for any name: the pattern as the store writes paths, and path in the store → URL."""
    with _store(pattern) as (files, path):
        return str(path), {str(p): str(files.unstrip_protocol(p)) for p in sorted(files.glob(path))}


def listing(url: str) -> list[tuple[str, ...]]:
    """Name, size and stamps of the test file and of all files beside and below it: what tells that one has changed, without reading it."""
    with _store(url) as (files, path):
        found = files.find(_folder(path), detail=True)
    if path not in found:
        raise ConfigError("there is no such test file", where=url)
    return [(name, str(info.get("size")), *(str(info[s]) for s in STAMPS if s in info)) for name, info in sorted(found.items())]


@contextmanager
def copied(url: str) -> Iterator[Path]:
    """The test file of a URL as a local one with all its folder holds, for as long as the context lasts."""
    with tempfile.TemporaryDirectory(prefix="operando-") as scratch:
        with _store(url) as (files, path):
            folder = PurePosixPath(_folder(path))
            here = Path(scratch, folder.name or "test")
            for name in files.find(str(folder)):
                target = here / PurePosixPath(name).relative_to(folder)
                target.parent.mkdir(parents=True, exist_ok=True)
                files.get_file(name, str(target))
        yield here / PurePosixPath(path).name


def _folder(path: str) -> str:
    return str(path).rpartition("/")[0]


@contextmanager
def _store(url: str) -> Iterator[tuple[Any, str]]:
    """The file system of a URL and the path in it; what a store says when it fails as one typed error."""
    try:
        from fsspec.core import url_to_fs
    except ImportError:
        raise MissingError("tests in an object store need fsspec", where=url, hint='pip install "operando[store]"') from None
    try:
        yield url_to_fs(url)
    except ImportError as error:  # the package of this kind of store
        raise MissingError(f"this kind of store is not installed: {error}", where=url) from None
    except Exception as error:  # each store has errors of its own
        raise ConfigError(f"cannot be read from its store: {error or type(error).__name__}", where=url) from None

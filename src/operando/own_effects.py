"""Kinds of effects of the user's own: Python files named in the test file or on the command line, registered on import."""

from __future__ import annotations

import hashlib
import importlib.abc
import importlib.util
import sys
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from operando.errors import ConfigError, OperandoError

if TYPE_CHECKING:
    from operando.structure.effects import EffectKind

_HOW = "a kind is a subclass of operando.EffectKind under @operando.register: see the documentation of `register`"


def load_effects(files: Sequence[str | Path], where: str | None = None) -> tuple[str, ...]:
    """Import files that register kinds of effects; a file that is imported again replaces its own kinds.

    Parameters
    ----------
    files : sequence of path
        Python files. Each is run as it stands: name only files whose content you know.
    where : str, optional
        What names the files, for messages.

    Returns
    -------
    tuple of str
        Names of the kinds that the files registered, in order.

    Raises
    ------
    ConfigError
        If a file is missing, cannot be imported, registers no kind, or takes the name of another kind.

    Examples
    --------
    >>> load_effects([])
    ()
    """
    return tuple(name for file in files for name in _load(Path(file), where))


def _load(path: Path, where: str | None) -> list[str]:
    from operando.structure.effects import catalogue, unregister

    name = f"operando_own_{hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:12]}"
    try:
        text = path.read_bytes()
    except FileNotFoundError:
        raise ConfigError(
            f"there is no file {path}", where=where, hint="own effects are Python files; paths are relative to the test file"
        ) from None
    before = {kind: definition for kind, definition in catalogue().items() if type(definition).__module__ != name}
    for kind in set(catalogue()) - set(before):
        unregister(kind)
    loader = _AsItStands(str(path), text)
    spec = importlib.util.spec_from_loader(name, loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        loader.exec_module(module)
    except (KeyboardInterrupt, MemoryError):
        raise
    except BaseException as error:  # whatever the file does, SystemExit too
        _restore(before)
        line = next((f.lineno for f in reversed(traceback.extract_tb(error.__traceback__)) if f.filename == str(path)), None)
        line = line or getattr(error, "lineno", None)
        told = error.message if isinstance(error, OperandoError) else f"{type(error).__name__}: {error}"
        hint = (error.hint if isinstance(error, OperandoError) else None) or _HOW
        raise ConfigError(f"{path}{f', line {line}' if line else ''} cannot be imported: {told}", where=where, hint=hint) from None
    taken = [kind for kind, definition in before.items() if catalogue().get(kind) is not definition]
    if taken:
        _restore(before)
        raise ConfigError(f"{path} registers {taken[0]!r}, which is there already", where=where, hint="give the kind a name of its own")
    own = [kind for kind in catalogue() if kind not in before]
    if not own:
        raise ConfigError(f"{path} registers no kind of effect", where=where, hint=_HOW)
    return own


class _AsItStands(importlib.abc.SourceLoader):
    """Imports a file by its present content: no compiled copy is read, and none is left beside it."""

    def __init__(self, path: str, text: bytes) -> None:
        self._path, self._text = path, text

    def get_filename(self, fullname: str) -> str:
        """Where the file lies, for tracebacks."""
        return self._path

    def get_data(self, path: str) -> bytes:
        """What it says."""
        return self._text


def _restore(before: Mapping[str, EffectKind]) -> None:
    """The catalogue as it was."""
    from operando.structure.effects import catalogue, register, unregister

    for kind in catalogue():
        if kind not in before:
            unregister(kind)
    for definition in before.values():
        if catalogue().get(definition.kind) is not definition:
            register(type(definition))


def effects_hash(files: Sequence[Path]) -> list[tuple[str, str]]:
    """Name and content hash of each file: a diagnosis with other laws is another one."""
    return [(file.name, hashlib.sha256(file.read_bytes()).hexdigest()) for file in files]

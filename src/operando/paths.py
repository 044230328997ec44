"""Paths as they are given: what is no path is refused with the package's own error, what is not there is answered by the nearest name."""

from __future__ import annotations

import difflib
import os
from pathlib import Path
from types import ModuleType

from operando.errors import ObjectError


def path_of(value: object, what: str, hint: str = "give a text or a pathlib.Path") -> Path:
    """A path, or an error that says what needs one; an empty text is none (pathlib would take it for the current folder)."""
    if not isinstance(value, str | os.PathLike) or not os.fspath(value):
        found = "a module" if isinstance(value, ModuleType) else repr(value) if value == "" else type(value).__name__
        raise ObjectError(f"{what}, not {found}", hint=hint)
    return Path(os.fsdecode(value))


def near_path(path: Path) -> str:
    """What to do about a path that is not there: the nearest name beside it, else what relative paths are relative to."""
    try:
        names = sorted(p.name for p in path.parent.iterdir())[:2000]
    except OSError:
        return f"there is no folder {path.parent} either" if not path.parent.exists() else "check the path"
    near = difflib.get_close_matches(path.name, names, 1, 0.6)
    if near:
        return f"did you mean {str(path.parent / near[0])!r}?"
    return "check the path" if path.is_absolute() else f"paths are relative to {Path.cwd()}"


def example_folder() -> Path:
    """Folder of the example data: inside the installed package, else in the source tree."""
    from importlib.resources import files

    import operando
    from operando.errors import MissingError

    packaged = Path(str(files(operando))) / "example_data"
    source = Path(operando.__file__).resolve().parents[2] / "data" / "example"
    for folder in (packaged, source):
        if (folder / "test.toml").is_file():
            return folder
    raise MissingError(
        "the example data are not installed", where=str(packaged), hint="install operando from a wheel, or run from its source tree"
    )

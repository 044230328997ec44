"""The hash of the code that a result depends on, found by following the imports."""

from __future__ import annotations

import hashlib
import platform
import re
from functools import cache
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

import operando

ROOT = Path(operando.__file__).parent
CHECKS = frozenset({"operando.values", "operando.own_effects"})
"""Modules that check the test file and import what it names: that is done in every run, and what they let pass is in the keys of the
stages. What they know of kinds, windows and methods comes from rooms that most stages do not use."""


@cache
def code_hash(module: str) -> str:
    """Hash of a module, of all modules of operando it reaches, and of the versions of the packages they may use.

    Results of older code are not taken for new ones.
    """
    digest = hashlib.sha256("\n".join((operando.__version__, platform.python_version(), *packages())).encode())
    for name in sorted(reached(module)):
        digest.update(source_hash(name))
    return digest.hexdigest()


@cache
def whole_code_hash() -> str:
    """Hash of all code of operando, and of the versions of the packages it needs."""
    digest = hashlib.sha256("\n".join((operando.__version__, platform.python_version(), *packages())).encode())
    for file in sorted(ROOT.rglob("*.py")):
        for part in [file, *(_beside(file.parent) if file.name == "__init__.py" else ())]:
            digest.update(part.relative_to(ROOT).as_posix().encode() + b"\0" + part.read_bytes() + b"\0")
    return digest.hexdigest()


@cache
def source_hash(module: str) -> bytes:
    """Hash of the files of one module; most stages reach the same."""
    digest = hashlib.sha256()
    for file in _files(module):
        digest.update(file.relative_to(ROOT).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.digest()


@cache
def reached(module: str) -> frozenset[str]:
    """A module and all modules of operando that it imports, anywhere in its text, and they in turn.

    A package counts when something is imported from it, not when one of its modules is: its ``__init__`` only gathers names.
    """
    found: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name not in found | CHECKS:
            found.add(name)
            waiting += imported(name)
    return frozenset(found)


@cache
def imported(module: str) -> frozenset[str]:
    """Modules of operando that a module imports itself; what is imported for the type checker alone does not count.

    Of ``from a.b import c`` both ``a.b`` and ``a.b.c`` count where they are modules.
    """
    text = _FOR_THE_CHECKER.sub("", _source(module).read_text(encoding="utf-8"))
    names: set[str] = set()
    for package, parts, plain in _IMPORT.findall(text):
        names |= {plain} if plain else {package, *(f"{package}.{part}" for part in re.findall(r"\w+", parts))}
    return frozenset(name for name in names if _exists(name))


# Found by pattern, not by parsing: that takes seconds for the whole package, and every run does it. A test holds it against the parser.
_IMPORT = re.compile(r"^[ \t]*(?:from (operando[\w.]*) import (\([^)]*\)|[^\n]*)|import (operando[\w.]*))", re.MULTILINE)
_FOR_THE_CHECKER = re.compile(r"^if TYPE_CHECKING:\n(?:[ \t]+[^\n]*\n|\n)+", re.MULTILINE)


@cache
def _source(module: str) -> Path:
    place = ROOT.joinpath(*module.split(".")[1:])
    return place / "__init__.py" if place.is_dir() else place.with_suffix(".py")


@cache
def _exists(module: str) -> bool:
    return _source(module).is_file()


def _files(module: str) -> list[Path]:
    """The source of a module; for a package also what lies beside it and is no code (templates, a style sheet)."""
    source = _source(module)
    return [source, *_beside(source.parent)] if source.name == "__init__.py" else [source]


def _beside(package: Path) -> list[Path]:
    """Files in the folder of a package, and in folders below that are no packages, which are no code; the example's data are not meant."""
    if package == ROOT:
        return []
    below = [p for p in sorted(package.iterdir()) if p.name != "__pycache__" and not (p / "__init__.py").exists()]
    files = [p for p in below if p.is_file() and p.suffix not in (".py", ".pyc")]
    return [*files, *(p for folder in below if folder.is_dir() for p in _beside(folder))]


@cache
def packages() -> tuple[str, ...]:
    """Packages that operando needs, each with the version installed."""
    try:
        needed = [re.split(r"[^\w.-]", text)[0] for text in requires("operando") or () if "extra ==" not in text]
    except PackageNotFoundError:  # run from its source tree
        needed = ["numpy", "scipy", "h5py"]
    found = []
    for name in needed:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"{name} none")
    return tuple(found)

"""API pages from the public names: one a name of `import operando`, one a package for the rest; new names join by themselves."""

from __future__ import annotations

import importlib
import inspect
from pathlib import Path
from types import ModuleType
from typing import Any

import operando

SOURCE = Path(operando.__file__).resolve().parent


def room(name: str) -> ModuleType:
    """A room of the package, also where a function of the same name hides it."""
    return importlib.import_module(f"operando.{name}")


def rooms() -> list[str]:
    """Rooms that name public functions or classes, in alphabetical order."""
    packages = sorted(p.parent.name for p in SOURCE.glob("*/__init__.py"))
    return [name for name in packages if getattr(room(name), "__all__", ())]


def public() -> list[str]:
    """What `import operando` gives, without the version."""
    return [name for name in operando.__all__ if not name.startswith("__")]


def _directive(thing: Any) -> str:
    if inspect.isclass(thing):
        return "autoexception" if issubclass(thing, BaseException) else "autoclass"
    return "autofunction" if callable(thing) else "autodata"


def _entry(module: str, name: str, thing: Any) -> list[str]:
    kind = _directive(thing)
    options = ["   :members:", "   :inherited-members: object, tuple"] if kind == "autoclass" else []
    if kind == "autodata":
        options = ["   :no-value:"]
        if not (getattr(thing, "__doc__", None) and not isinstance(thing, (str, int, float, tuple, dict, frozenset))):
            return [f".. py:data:: {name}", f"   :module: {module}", ""]
    return [f".. {kind}:: {name}", *options, ""]


def _first_line(thing: Any) -> str:
    text = inspect.getdoc(thing) or ""
    return text.split("\n\n")[0].replace("\n", " ").replace("|", r"\|").replace("*", r"\*")


def _title(text: str) -> list[str]:
    return [text, "=" * len(text), ""]


def write(folder: Path) -> None:
    """Write all pages; `index.rst` names them."""
    folder.mkdir(parents=True, exist_ok=True)
    names = public()
    index = [*_title("API"), "What ``import operando`` gives. Objects are frozen and in SI units; frequencies are in Hz.", ""]
    index += [".. list-table::", "   :widths: 30 70", ""]
    for name in names:
        thing = getattr(operando, name)
        index += [f"   * - :doc:`{name} <operando.{name}>`", f"     - {_first_line(thing)}"]
        page = [*_title(f"operando.{name}"), ".. currentmodule:: operando", "", *_entry("operando", name, thing)]
        (folder / f"operando.{name}.rst").write_text("\n".join(page), encoding="utf-8")
    index += ["", ".. toctree::", "   :hidden:", "", *(f"   operando.{name}" for name in names), ""]
    index += ["Packages", "--------", "", "Public names of each package, for who needs the parts.", ""]
    index += [".. toctree::", "   :maxdepth: 1", "", *(f"   room.{name}" for name in rooms()), ""]
    (folder / "index.rst").write_text("\n".join(index), encoding="utf-8")
    for name in rooms():
        module = room(name)
        page = [*_title(f"operando.{name}"), _first_line(module), "", f".. currentmodule:: operando.{name}", ""]
        for member in module.__all__:
            thing = getattr(module, member)
            if member in names and getattr(operando, member) is thing:
                page += [f"- :doc:`{member} <operando.{member}>`", ""]
        for member in module.__all__:
            thing = getattr(module, member)
            if not (member in names and getattr(operando, member) is thing):
                page += _entry(f"operando.{name}", member, thing)
        (folder / f"room.{name}.rst").write_text("\n".join(page), encoding="utf-8")

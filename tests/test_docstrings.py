"""Docstrings of public functions, in numpydoc's form: parameters, what is returned and raised, an example; words of the glossary."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from pathlib import Path

import pytest

import operando

pytest.importorskip("numpydoc", reason="docstrings are checked with the extra: pip install 'operando[dev]'")
from numpydoc.validate import validate

PACKAGES = ("data", "frf", "ema", "oma", "scaling", "compare", "io", "contrib", "plots", "stabilization")
CODES = {
    "GL02": "closing quotes", "GL08": "no docstring", "SS01": "no summary", "PR01": "a parameter is not named",
    "PR02": "a parameter is named that is none", "PR03": "order of parameters", "PR04": "no type", "PR07": "no words", "RT01": "no Returns",
    "YD01": "no Yields",
}  # fmt: skip
"""Checks of numpydoc that count. A description of what is returned (RT03) is left out where the type says it."""

SOURCE = Path(operando.__file__).parent
LEFT = re.compile(
    r"\b(judge[ds]?|judging|held[- ]out|ladder|rungs?|check runs?|second opinion|honest\w*|excus\w+|invented|afar|house|contract|vague\w*"
    r"|earn\w*|learnt)\b|\brooms\b|\broom of\b|(?<!`)\bmisfit\b(?!`| :|_)",
    re.IGNORECASE,
)
"""Left column of the glossary, as far as one word tells it; ``misfit`` and ``ladder`` are names of fields, as in the result files."""

FIELD = re.compile(r"^ladder :.*$|[\"`']ladder[\"`']|``(?:idle_)?misfit``", re.MULTILINE)
TO_COME = {f"diagnosis/{name}.py" for name in (
    "scan",
)}  # fmt: skip
"""Modules whose docstrings still hold words of the left column; the set only grows shorter."""


def functions() -> dict[str, object]:
    """Functions that the packages and operando itself name as public, by where they are defined."""
    found = {}
    for package in PACKAGES:
        module = importlib.import_module(f"operando.{package}")
        for thing in (getattr(module, name) for name in module.__all__):
            if inspect.isfunction(thing) and thing.__module__.split(".")[1] in PACKAGES:
                found[f"{thing.__module__}.{thing.__qualname__}"] = thing
    for name in operando.__all__:
        thing = operando._function(name) if name in operando._WHERE else None
        if inspect.isfunction(thing) and thing.__module__.split(".")[1] not in ("effects", "diagnose", "diagnosis"):
            found[f"{thing.__module__}.{thing.__qualname__}"] = thing
    return dict(sorted(found.items()))


@pytest.mark.parametrize("name", functions())
def test_parameters_and_returns_are_described(name):
    errors = [f"{code} ({CODES[code]}): {text}" for code, text in validate(name)["errors"] if code in CODES]
    assert not errors


def raised(function: object) -> set[str]:
    """Typed errors that the function's own body raises."""
    tree = ast.parse(inspect.getsource(inspect.unwrap(function)))
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and isinstance(node.exc.func, ast.Name):
            names.add(node.exc.func.id)
    return {n for n in names if isinstance(kind := getattr(operando.errors, n, None), type) and issubclass(kind, operando.OperandoError)}


@pytest.mark.parametrize("name", functions())
def test_errors_are_named(name):
    function = functions()[name]
    told = (inspect.getdoc(function) or "").partition("Raises\n")[2]
    assert not {kind for kind in raised(function) if kind not in told}


@pytest.mark.parametrize("path", sorted(SOURCE.rglob("*.py")), ids=lambda p: p.relative_to(SOURCE).as_posix())
def test_docstrings_use_the_words_of_the_glossary(path):
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Module | ast.FunctionDef | ast.ClassDef):
            text = FIELD.sub("", ast.get_docstring(node) or "")
            found += [f"{getattr(node, 'name', '')}: {m[0]}" for m in LEFT.finditer(text)]
    assert bool(found) == (path.relative_to(SOURCE).as_posix() in TO_COME), found


def classes() -> dict[str, type]:
    """Classes that operando itself names, by name."""
    found = {name: getattr(operando, name) for name in operando.__all__ if name != "__version__"}
    return {name: thing for name, thing in found.items() if inspect.isclass(thing) and not issubclass(thing, Exception)}


def test_public_functions_have_an_example():
    """The examples run in ``test_doctests``."""
    things = functions() | {f"{kind.__module__}.{name}": kind for name, kind in classes().items()}
    assert not {name for name, thing in things.items() if ">>> " not in (inspect.getdoc(thing) or "")}

"""The rules of the house: light imports, one direction of data flow, documented public functions, files of one topic."""

from __future__ import annotations

import ast
import graphlib
import importlib
import inspect
import json
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import operando
from operando.data import ModalModel
from operando.io import write_uff

SOURCE = Path(operando.__file__).resolve().parent
HEAVY = (
    "matplotlib",
    "pandas",
    "sdypy",
    "pyoma2",
    "pyuff",
    "h5py",
    "sklearn",
    "plotly",
    "dash",
    "rich",
    "pydantic",
    "flask",
    "werkzeug",
    "tomlkit",
)

# Each room with its level; a room imports only from levels above (smaller numbers) and from itself.
LEVELS = {
    "errors": 0, "printable": 0, "limits": 0, "files": 0, "threads": 0, "children": 0,
    "dof": 1, "paths": 1, "units": 1, "synthesis": 1, "processes": 1,
    "jsonable": 2,
    "data": 3, "atomic": 3,
    "results": 4, "indicators": 4,
    "io": 5,
    "frf": 6,
    "quality": 7, "stabilization": 7,  # the raw-data checks use the hit finder and the spectra of frf; frf uses nothing of quality
    "ema": 8, "oma": 8,
    "scaling": 9,
    "compare": 10,
    "structure": 11, "diagnosis": 12,
    "store": 15, "entries": 15, "plots": 15, "own_effects": 15, "contrib": 15,
    "report": 16, "values": 16,
    "states": 17,
    "config": 18, "scaffold": 18,
    "pipeline": 19,
    "campaign": 20, "workbench": 20,
    "cli": 21,
}  # fmt: skip
NUMERIC = (
    "dof",
    "units",
    "errors",
    "data",
    "indicators",
    "synthesis",
    "threads",
    "processes",
    "quality",
    "frf",
    "stabilization",
    "ema",
    "oma",
    "scaling",
    "compare",
    "structure",
    "diagnosis",
)


def rooms() -> list[str]:
    names = {p.stem for p in SOURCE.glob("*.py")} | {p.parent.name for p in SOURCE.glob("*/__init__.py")}
    return sorted(names - {"__init__", "__main__"})


def loaded_by(code: str) -> set[str]:
    """Top-level modules that a fresh interpreter holds after running the code."""
    script = f"{code}\nimport sys, json\nprint('\\n' + json.dumps(sorted({{m.split('.')[0] for m in sys.modules}})))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout.splitlines()[-1]))


def imported_rooms(path: Path) -> set[str]:
    """Rooms of operando that a file imports anywhere, also inside functions."""
    package = ("operando", *path.relative_to(SOURCE).parent.parts)
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module or "") if part)
            names = [f"{module}.{alias.name}" for alias in node.names] if module == "operando" else [module]
        else:
            continue
        found |= {name.split(".")[1] for name in names if name.startswith("operando.")}
    return found


def test_every_room_has_its_level():
    assert set(rooms()) <= set(LEVELS), "a new room needs its place in the order of the house"


@pytest.mark.parametrize("room", rooms())
def test_rooms_import_only_rooms_above(room):
    files = [SOURCE / f"{room}.py"] if (SOURCE / f"{room}.py").exists() else sorted((SOURCE / room).rglob("*.py"))
    below = {
        f"{path.relative_to(SOURCE)} imports {other}"
        for path in files
        for other in imported_rooms(path) & set(LEVELS)
        if other != room and LEVELS[other] >= LEVELS[room]
    }
    assert not below


def test_importing_operando_and_its_numeric_rooms_is_light():
    code = "import operando\n" + "\n".join(f"import operando.{room}" for room in (*NUMERIC, "io", "config"))
    assert not loaded_by(code) & set(HEAVY)


def test_importing_operando_alone_loads_no_scipy():
    assert "scipy" not in loaded_by("import operando")


def test_help_loads_no_numerics():
    code = "import sys\nsys.argv = ['operando', '--help']\nfrom operando.cli import main\ntry:\n    main()\nexcept SystemExit:\n    pass"
    assert not loaded_by(code) & {"numpy", "scipy", *HEAVY}


@pytest.mark.parametrize("command", [("inspect", "frf.uff"), ("compare", "modes.uff", "frf.uff")], ids=lambda words: words[0])
def test_commands_that_draw_nothing_load_no_drawing(command, tmp_path, monkeypatch):
    model = ModalModel([20.0, 50.0], [0.01, 0.02], np.eye(2), "1+Z, 2+Z", "unit_modal_mass")
    write_uff(tmp_path / "modes.uff", model)
    write_uff(tmp_path / "frf.uff", model.frf(np.arange(5.0, 80.0, 0.5)))
    monkeypatch.chdir(tmp_path)
    code = f"from operando.cli import main\nmain({[*command]}, standalone_mode=False)"
    assert not loaded_by(code) & {"matplotlib", "jinja2", "pandas"}


def test_numeric_rooms_never_print_or_plot():
    """Numerics are functions of arrays: no print, no warning filter set for everybody, no NumPy error state for the process."""
    found = []
    forbidden = {"print", "np.seterr", "numpy.seterr", "warnings.simplefilter", "warnings.filterwarnings", "logging.basicConfig"}
    for room in NUMERIC:
        for path in [SOURCE / f"{room}.py"] if (SOURCE / f"{room}.py").exists() else sorted((SOURCE / room).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call):
                    name = ast.unparse(node.func)
                    restores = name == "np.seterr" and node.keywords and node.keywords[0].arg is None  # np.seterr(**state)
                    scoped = name == "warnings.simplefilter" and "warnings.catch_warnings" in path.read_text(encoding="utf-8")
                    if name in forbidden and not restores and not scoped:
                        found.append(f"{path.relative_to(SOURCE)}:{node.lineno} {name}")
    assert not found


@pytest.mark.parametrize("name", [n for n in operando.__all__ if n != "__version__"])
def test_public_names_exist_and_document_every_parameter(name):
    thing = getattr(operando, name)
    text = inspect.getdoc(thing) or ""
    assert len(text) > 40, f"operando.{name} needs a docstring"
    try:
        parameters = [p for p in inspect.signature(thing).parameters if p not in {"self", "args", "kwargs"}]
    except ValueError:  # built-in exceptions have none
        return
    if issubclass(thing, Exception) if inspect.isclass(thing) else False:
        return
    missing = [p for p in parameters if not re.search(rf"(?<![A-Za-z0-9_]){re.escape(p)}(?![A-Za-z0-9_])", text)]
    assert not missing, f"operando.{name} does not document {missing}"


def test_files_keep_to_one_topic():
    long = {str(p.relative_to(SOURCE)): n for p in SOURCE.rglob("*.py") if (n := len(p.read_text(encoding="utf-8").splitlines())) > 500}
    assert not long


def test_no_circle_between_files():
    """What runs later, inside a function, counts too; the rooms that were put in order keep to it."""
    files = {
        ".".join(("operando", *path.relative_to(SOURCE).with_suffix("").parts)).removesuffix(".__init__"): path
        for room in ("structure", "diagnosis", "contrib")
        for path in (SOURCE / room).rglob("*.py")
    }
    needs = {}
    for name, path in files.items():
        froms = [n for n in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(n, ast.ImportFrom) and n.module]
        asked = {named if (named := f"{n.module}.{alias.name}") in files else n.module for n in froms for alias in n.names}
        needs[name] = (asked & set(files)) - {name}
    graphlib.TopologicalSorter(needs).prepare()


def test_every_module_says_what_it_is():
    silent = [str(p.relative_to(SOURCE)) for p in SOURCE.rglob("*.py") if not ast.get_docstring(ast.parse(p.read_text(encoding="utf-8")))]
    assert not silent


def test_no_test_imports_the_tests_as_a_package():
    """Plain ``pytest`` puts the folder of the tests on the path, not the project's: such an import fails at collection."""
    here = Path(__file__).parent
    pattern = re.compile(r"^\s*(?:from|import) tests\b", re.MULTILINE)
    assert not [p.name for p in here.glob("*.py") if pattern.search(p.read_text(encoding="utf-8"))]


def test_what_benchmarks_import_exists():
    """They are not run by the tests, so a name that moved would be missed until someone runs one."""
    missing = []
    for path in sorted((SOURCE.parents[1] / "benchmarks").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and not node.level and (node.module or "").split(".")[0] == "operando":
                module = importlib.import_module(str(node.module))
                parts = {part.name for part in pkgutil.iter_modules(getattr(module, "__path__", []))}
                names = [alias.name for alias in node.names if alias.name not in parts and not hasattr(module, alias.name)]
                missing += [f"{path.name}:{node.lineno} {node.module}.{name}" for name in names]
    assert not missing

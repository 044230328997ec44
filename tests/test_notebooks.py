"""The notebooks of the documentation run from their first cell to their last, and keep no output."""

from __future__ import annotations

import ast
import json

import pytest

from pages import DOCS, ROOT

NOTEBOOKS = sorted(DOCS.rglob("*.ipynb"))
TASKS = DOCS / "tutorials" / "twelve_tasks.ipynb"


def cells(path, kind="code"):
    """Cells of one kind with all they hold."""
    return [c for c in json.loads(path.read_text(encoding="utf-8"))["cells"] if c["cell_type"] == kind]


@pytest.mark.skipif(not (ROOT / "data" / "example").is_dir(), reason="the example data are not here (data/example)")
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.name)
def test_notebook_runs(path, tmp_path, monkeypatch, own_kinds_gone):
    import matplotlib.pyplot as plt

    if "to_dataframe" in path.read_text(encoding="utf-8"):
        pytest.importorskip("pandas")
    (tmp_path / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for cell in cells(path):
        exec(compile("".join(cell["source"]), path.name, "exec"), names)
    plt.close("all")
    if path == TASKS:
        assert names["again"].frequencies_hz.tolist() == names["idle"].frequencies_hz.tolist()
        assert names["heavier"].frequencies_hz[0] < names["idle"].frequencies_hz[0]
        assert len(names["by_hand"].frequencies_hz) == 2
        assert (tmp_path / "mode.gif").stat().st_size > 5000


def test_each_of_the_twelve_tasks_is_one_line():
    tasks = cells(TASKS)[1:]
    assert len(tasks) == 12
    for cell in tasks:
        (statement,) = ast.parse("".join(cell["source"])).body
        assert len(cell["source"]) == 1 or isinstance(statement, ast.ClassDef)  # an own effect is one class


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.name)
def test_notebook_keeps_no_output(path):
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells(path))

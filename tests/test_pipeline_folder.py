"""The results folder: changes that happen as one, content that is checked, a lock, the code that a result depends on."""

from __future__ import annotations

import ast
import errno
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

import models
import operando
from measurements import running_chain
from operando import atomic
from operando.atomic import replacing
from operando.cli import main
from operando.data import Finding, Frf
from operando.errors import BusyError, MissingError, WriteError
from operando.pipeline.cache import load_stage, save_stage
from operando.pipeline.code import ROOT, code_hash, imported, reached, source_hash
from operando.pipeline.folder import apart_from_runs, results_folder
from operando.pipeline.stages import STEPS


def text(words):
    return lambda path: path.write_text(words)


def filled(tmp_path, **files):
    with results_folder(tmp_path, "test") as folder:
        for name, words in files.items():
            folder.stage(name, "key", text(words))
        folder.commit()


def visible(folder):
    return {p.name: p.read_text() for p in folder.iterdir() if p.is_file()}


def first_value(file: h5py.File) -> int:
    """Where in the file the first packed values of FRFs lie."""
    found: list[int] = []

    def look(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset) and item.ndim == 3:
            found.append(item.id.get_chunk_info(0).byte_offset + 100 if item.chunks else item.id.get_offset())

    file.visititems(look)
    return found[0]


def test_stages_come_back_as_they_were_kept(tmp_path):
    frf: Frf = models.measured(running_chain())
    with results_folder(tmp_path, "test") as folder:
        kept = save_stage(folder, "frf", "key", {"idle_frf": frf, "findings": [Finding("x", "y")]}, 1.5)
        np.testing.assert_array_equal(kept.found["idle_frf"].data, frf.data)
    with results_folder(tmp_path, "test") as folder:
        kept = load_stage(folder, "frf", "key")
        np.testing.assert_array_equal(kept.found["idle_frf"].data, frf.data)
        assert (kept.found["findings"], kept.seconds) == ([Finding("x", "y")], 1.5)
        assert load_stage(folder, "frf", "other") is None
        assert load_stage(folder, "ema", "key") is None
        file = tmp_path / ".stages/frf.h5"
        whole = file.read_bytes()
        with h5py.File(file) as kept_file:
            at = first_value(kept_file)
        for spoilt in (whole[:5000], b"", whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :]):  # cut, emptied, one bit of a value
            file.write_bytes(spoilt)
            assert load_stage(folder, "frf", "key") is None


def test_files_written_aside_take_their_names_together(tmp_path):
    filled(tmp_path, a="old a", b="old b", c="old c")
    with results_folder(tmp_path, "test") as folder:
        folder.stage("a", "new", text("new a"))
        folder.stage("b", "new", text("new b"))
        assert visible(tmp_path) == {"a": "old a", "b": "old b", "c": "old c"}
        folder.commit(drop=["c", "never there"])
        assert visible(tmp_path) == {"a": "new a", "b": "new b"}
        assert folder.entry("a", "new") is not None
        assert folder.entry("a", "key") is None
        assert folder.entry("c", "key") is None
    assert not list((tmp_path / ".stages/new").iterdir())


def test_what_was_not_committed_leaves_nothing(tmp_path):
    filled(tmp_path, a="old")

    def half():
        with results_folder(tmp_path, "test") as folder:
            folder.stage("a", "new", text("new"))
            raise RuntimeError("stopped")

    with pytest.raises(RuntimeError):
        half()
    assert visible(tmp_path) == {"a": "old"}
    assert not list((tmp_path / ".stages/new").iterdir())


def test_a_file_made_by_hand_counts_only_while_it_is_the_same(tmp_path):
    filled(tmp_path, a="content", b="content")
    with results_folder(tmp_path, "test") as folder:
        folder.stage("a", None, text("content"))
        folder.stage("b", None, text("by hand"))
        folder.commit()
        assert folder.entry("a", "key") is not None
        assert folder.entry("b", "key") is None


def test_a_damaged_manifest_vouches_for_nothing(tmp_path):
    filled(tmp_path, a="content")
    path = tmp_path / ".stages/manifest.json"
    for spoilt in ("", "[]", '{"schema": "operando/manifest/9", "files": {}}', path.read_text()[:-40], '{"files": {"a": 3}}'):
        path.write_text(spoilt)
        with results_folder(tmp_path, "test") as folder:
            assert folder.entry("a", "key") is None


def test_left_behind_files_are_removed_and_others_are_not(tmp_path):
    filled(tmp_path, a="content")
    for name in (".model.h5.123.part", ".stages/new/frf.h5", ".stages/.manifest.json.7.part", "mine.part", ".notes"):
        (tmp_path / name).write_text("x")
    with results_folder(tmp_path, "test"):
        pass
    assert set(visible(tmp_path)) == {"a", "mine.part", ".notes"}
    assert not list((tmp_path / ".stages").glob("*.part"))
    assert not list((tmp_path / ".stages/new").iterdir())


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EIO])
@pytest.mark.parametrize("call", ["open", "fsync", "replace"])
def test_a_refused_write_keeps_the_old_file(tmp_path, monkeypatch, code, call):
    path = tmp_path / "a"
    path.write_text("old")

    def refuse(*args, **kwargs):
        raise OSError(code, os.strerror(code))

    def write():
        with replacing(path, "w") as stream:
            stream.write("new")

    with monkeypatch.context() as patch:
        patch.setattr(*(("builtins.open", refuse) if call == "open" else (f"os.{call}", refuse)))
        with pytest.raises(WriteError, match="cannot be written") as caught:
            write()
    assert os.strerror(code) in str(caught.value)
    assert str(path) in str(caught.value)
    assert caught.value.hint
    assert visible(tmp_path) == {"a": "old"}
    assert not atomic.unfinished


def test_content_is_on_the_disk_before_it_takes_the_name(tmp_path, monkeypatch):
    calls = []
    for name in ("fsync", "replace"):
        real = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *a, real=real, name=name: calls.append(name) or real(*a))
    with replacing(tmp_path / "a") as stream:
        stream.write(b"x")
    assert calls == (["fsync", "replace", "fsync"] if os.name != "nt" else ["fsync", "replace"])


HOLD = """
import sys, time
from operando.pipeline.folder import results_folder
with results_folder(sys.argv[1], "run"):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path):
    """A process that holds the lock of ``tmp_path``."""
    filled(tmp_path, a="content")
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def test_a_second_process_is_refused_and_told_by_whom(tmp_path, holder):
    with pytest.raises(BusyError) as caught, results_folder(tmp_path, "add"):
        pass
    assert f"process {holder.pid} on {socket.gethostname()} (operando run" in caught.value.message
    assert caught.value.where == str(tmp_path)
    assert "wait until it has finished" in caught.value.hint
    with pytest.raises(BusyError), apart_from_runs(tmp_path / "pair.uff", "ofrf"):
        pass
    with apart_from_runs(tmp_path / "elsewhere/pair.uff", "ofrf"):
        pass


def test_the_lock_of_a_killed_process_is_taken_without_a_question(tmp_path, holder):
    holder.kill()
    holder.wait()
    assert str(holder.pid) in (tmp_path / ".stages/lock").read_text()
    with results_folder(tmp_path, "run") as folder:
        assert folder.entry("a", "key") is not None


def test_the_lock_holds_within_one_process_too(tmp_path):
    with results_folder(tmp_path, "run"), pytest.raises(BusyError), results_folder(tmp_path, "run"):
        pass


@pytest.mark.parametrize(
    "words",
    [
        ["add", "{}", "point_mass@1+Z"],
        ["remove", "{}", "1"],
        ["report", "{}"],
        ["ofrf", "{}", "-o", "{}/pair.uff"],
        ["run", "test.toml", "-o", "{}"],
    ],
    ids=lambda words: words[0],
)
def test_every_command_that_writes_there_is_refused(tmp_path, words, monkeypatch):
    import measurements
    from operando.store import save_results

    save_results(models.results(), tmp_path / "model.h5")
    (tmp_path / "test").mkdir()
    test = measurements.write_test(tmp_path / "test", operating=False, check=False)
    before = visible_bytes(tmp_path)
    with results_folder(tmp_path, "run"):
        done = CliRunner().invoke(main, [w.format(tmp_path).replace("test.toml", str(test)) for w in words] + ["--json"])
    assert done.exit_code == 1, done.output
    assert f"in use by process {os.getpid()}" in json.loads(done.stdout)["error"]
    assert visible_bytes(tmp_path) == before


def visible_bytes(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}


def test_a_folder_without_results_is_left_as_it_is(tmp_path):
    for words in (["add", str(tmp_path), "point_mass@1+Z"], ["report", str(tmp_path)], ["remove", str(tmp_path), "1"]):
        done = CliRunner().invoke(main, [*words, "--json"])
        assert done.exit_code == 1
        assert "there is no model.h5" in json.loads(done.stdout)["error"]
    assert not list(tmp_path.iterdir())
    with pytest.raises(MissingError, match="no such results folder"), results_folder(tmp_path / "none", "test"):
        pass


# The code that a result depends on


MODULES = sorted(".".join(("operando", *p.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__") for p in ROOT.rglob("*.py"))


def by_the_parser(path):
    """Modules of operando that a file imports, outside of blocks for the type checker, as the parser sees them."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            node.body = []
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports of operando are absolute"
            lazy = {alias.name for alias in node.names} & set(operando._WHERE) if node.module == "operando" else set()
            assert not lazy, f"{path}: imports {lazy} from its room, where the walk finds it"
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return names & set(MODULES)


def test_imports_are_found_as_the_parser_finds_them():
    for module in MODULES:
        place = ROOT.joinpath(*module.split(".")[1:])
        path = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
        assert imported(module) == by_the_parser(path), module


def test_a_stage_reaches_its_own_rooms_and_no_later_ones():
    rooms = {step.name: {name.split(".")[1] for name in reached(step.does.__module__) if "." in name} for step in STEPS}
    assert {"frf", "quality", "io", "data"} <= rooms["frf"]
    assert not rooms["frf"] & {"scaling", "effects", "oma", "compare", "diagnosis", "nonlinear", "report", "cli"}
    assert "ema" not in rooms["frf"]
    assert not rooms["oma"] & {"scaling", "effects"}
    assert "oma" in rooms["oma"] - rooms["ema"]
    assert "compare" in rooms["compare"] - rooms["ofrf"]
    assert {"diagnosis", "structure"} <= rooms["diagnose"]
    assert "operando.report.page" in reached("operando.pipeline.outputs")


LIBRARIES = ("idle_libraries", "operating_libraries")
"""Steps that set other libraries beside; they time both identifications."""


@pytest.mark.parametrize(
    ("file", "stages"),
    [
        ("oma/fit.py", {"oma", *LIBRARIES}),
        ("ema/fit.py", {"automatic", "ema", *LIBRARIES}),
        ("structure/effects/hysteresis.py", {"automatic", "ema", "diagnose", *LIBRARIES}),  # through the package `diagnosis`
        ("values.py", set()),
        ("io/detect.py", {step.name for step in STEPS}),
    ],
)
def test_a_changed_file_changes_the_hash_of_what_reaches_it_alone(file, stages, monkeypatch):
    steps = {step.name: step.does.__module__ for step in STEPS}
    before = {name: code_hash(module) for name, module in steps.items()}
    real, changed = Path.read_bytes, ROOT / file
    monkeypatch.setattr(Path, "read_bytes", lambda self: real(self) + (b"#" if self == changed else b""))
    for known in (code_hash, source_hash):
        known.cache_clear()
    after = {name: code_hash(module) for name, module in steps.items()}
    for known in (code_hash, source_hash):
        known.cache_clear()
    assert {name for name in before if before[name] != after[name]} == stages


def test_a_changed_template_makes_the_report_again(monkeypatch):
    real, changed = Path.read_bytes, ROOT / "report/templates/report.css"
    assert changed.is_file()
    before = code_hash("operando.pipeline.outputs")
    monkeypatch.setattr(Path, "read_bytes", lambda self: real(self) + (b"#" if self == changed else b""))
    for known in (code_hash, source_hash):
        known.cache_clear()
    after = code_hash("operando.pipeline.outputs")
    for known in (code_hash, source_hash):
        known.cache_clear()
    assert before != after


# Ctrl-C


@pytest.mark.skipif(os.name == "nt", reason="needs POSIX signals")
@pytest.mark.parametrize("delay", [0.0, 0.02, 0.1, 0.3, 0.8])
def test_ctrl_c_while_modules_are_imported_is_one_line(tmp_path, delay):
    """From the first line of operando's entry on, whatever is being imported."""
    start = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from operando import __main__ as entry\n"
        "real = signal.signal\n"
        "signal.signal = lambda *a: (real(*a), print('ready', flush=True))\n"
        "sys.argv = ['operando', 'demo', '--json', '-o', sys.argv[1]]\n"
        "entry.main()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", start, str(tmp_path / "o")], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "ready\n"
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == 130, stderr
    assert json.loads(stdout)["error"] == "interrupted"
    assert stderr.splitlines()[-1].startswith("operando: interrupted (finished stages are kept")
    assert "Traceback" not in stderr


def test_nothing_is_loaded_before_ctrl_c_is_minded():
    """Until then the interpreter shows a traceback: operando adds the signals of the standard library to its start, and no more."""
    code = "import sys, os, signal; before = set(sys.modules); import operando.__main__; print(*sorted(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) <= {"__future__", "operando", "operando.__main__"}


def test_the_entry_point_is_the_one_that_minds_ctrl_c():
    import tomllib

    project = Path(operando.__file__).resolve().parents[2] / "pyproject.toml"
    if not project.is_file():
        pytest.skip("an installed package has no pyproject.toml beside it")
    assert tomllib.loads(project.read_text())["project"]["scripts"] == {"operando": "operando.__main__:main"}


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs a folder where nobody can make a folder")
@pytest.mark.parametrize("name", ["/proc/results", "/proc/deep/results"])
def test_a_folder_that_takes_no_folders_is_named(name: str) -> None:
    with (
        pytest.raises(WriteError, match="the folder /proc takes no new files"),
        results_folder(name, "test", make=True),
    ):
        pass
    with pytest.raises(WriteError, match="the folder /proc takes no new files"):
        operando.Results("test").save(name)

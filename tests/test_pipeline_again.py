"""A test run again: where nothing changed what was said is said again, and nothing else is loaded; where anything did, it is found."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys

import pytest
from click.testing import CliRunner

import measurements
from operando.cli import main
from operando.config import load_test
from operando.pipeline import again, run

SCRIPT = """
import atexit, sys
from pathlib import Path
to = Path(sys.argv.pop())
atexit.register(lambda: to.write_text(" ".join(sys.modules)))
from operando.__main__ import main
main()
"""
"""The command line; at the end, what is loaded goes to the file named last."""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A test file, the folder of its FRFs and report, and what was said of them."""
    path = measurements.write_test(tmp_path_factory.mktemp("again"), check=False, operating=False)
    done = CliRunner().invoke(main, ["frf", str(path), "-o", str(path.parent / "out"), "--json"])
    assert done.exit_code == 0, done.stderr
    return path, done


@pytest.fixture
def copy(made, tmp_path):
    """A copy that a test may change, asked for once there: the folder is part of what is said."""
    path, _ = made
    shutil.copytree(path.parent, tmp_path / "t", copy_function=shutil.copy2)
    there = tmp_path / "t/test.toml"
    frf(there)
    return there


def frf(path, *more):
    done = CliRunner().invoke(main, ["frf", str(path), "-o", str(path.parent / "out"), "--json", *more])
    assert done.exit_code == 0, done.stderr
    return done


def kept(path, until="frf", report=True, changes=()):
    """What the folder would say without asking its stages; None where they are asked."""
    out = path.parent / "out"
    with again.results_folder(out, "test") as folder:
        return again._kept(folder, again.key_of_run(load_test(path, changes), until, report, str(out)))


def spoil(file):
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)


def test_an_unchanged_test_says_the_same_and_loads_no_numerics(made, tmp_path):
    path, first = made
    out = path.parent / "out"
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*") if p.is_file() and p.name != "lock"}
    words = ["frf", str(path), "-o", str(out), "--json", str(tmp_path / "loaded")]
    done = subprocess.run([sys.executable, "-c", SCRIPT, *words], capture_output=True, text=True, check=True)
    loaded = {name.split(".")[0] for name in (tmp_path / "loaded").read_text().split()}
    assert "operando" in loaded
    assert not loaded & {"numpy", "scipy", "h5py", "pandas", "matplotlib", "jinja2", "rich"}
    assert json.loads(done.stdout) == json.loads(first.stdout)
    told = [line.split("]")[1].split(maxsplit=1) for line in done.stderr.splitlines()]
    assert told == [[stage, "unchanged, taken from the last run"] for stage in ("inspect", "frf", "report")]
    assert {p: p.stat().st_mtime_ns for p in before} == before


def test_the_text_is_that_of_the_first_run(copy):
    texts = [CliRunner().invoke(main, ["frf", str(copy), "-o", str(copy.parent / "out")]).stdout for _ in range(2)]
    (copy.parent / "out" / again.ANSWER).unlink()
    texts.append(CliRunner().invoke(main, ["frf", str(copy), "-o", str(copy.parent / "out")]).stdout)
    assert texts[0] == texts[1] == texts[2]
    assert texts[0].startswith("chain: FRFs of 4 responses to 2 references")


@pytest.mark.parametrize("name", ["idle/run1.uff", "geometry.uff", "out/model.h5", "out/idle_frf.uff", "out/" + again.ANSWER])
def test_another_content_of_any_file_is_found(copy, name):
    assert kept(copy) is not None
    file = copy.parent / name
    os.utime(file)
    assert kept(copy) is not None
    whole = file.read_bytes()
    spoil(file)
    assert kept(copy) is None
    file.unlink()
    if name.startswith("out/"):
        assert kept(copy) is None
    file.write_bytes(whole)
    assert kept(copy) is not None


@pytest.mark.parametrize("name", ["errors.log", "ofrf.uff"])
def test_a_file_that_these_results_do_not_have_is_found(copy, name):
    (copy.parent / "out" / name).write_text("of another run")
    assert kept(copy) is None
    frf(copy)
    assert not (copy.parent / "out" / name).exists()
    assert kept(copy) is not None


@pytest.mark.parametrize(
    "asked",
    [
        {"until": "ema"},
        {"report": None},
        {"changes": ["analysis.overlap=0.25"]},
        {"changes": ["report.object='pump'"]},
        {"changes": ["units.acceleration='g'"]},
        {"changes": ["geometry.units='mm'"]},
        {"changes": ["idle.frfs=['idle/run1.uff']", "idle.records=[]"]},
        {"changes": ["idle.records=[{file='idle/run1.uff', stop_s=20}, 'idle/run2.uff']"]},
    ],
    ids=str,
)
def test_another_test_is_another_answer(copy, asked):
    assert kept(copy, **asked) is None


def test_other_code_is_another_answer(copy, monkeypatch):
    monkeypatch.setattr(again, "whole_code_hash", lambda: "other")
    assert kept(copy) is None


def test_the_hash_of_the_code_is_of_all_of_it(monkeypatch):
    from pathlib import Path

    from operando.pipeline.code import ROOT, whole_code_hash

    found = [whole_code_hash()]
    real = Path.read_bytes
    for name in ("cli/summary.py", "scaling/model.py", "report/templates/report.css"):
        changed = ROOT / name
        assert changed.is_file()
        monkeypatch.setattr(Path, "read_bytes", lambda self, changed=changed: real(self) + (b"#" if self == changed else b""))
        whole_code_hash.cache_clear()
        found.append(whole_code_hash())
    whole_code_hash.cache_clear()
    assert len(set(found)) == len(found)


def test_what_failed_is_tried_again(copy, monkeypatch):
    from operando.errors import IdentificationError

    def fail(*args, **kwargs):
        raise IdentificationError("no modes today")

    arguments = ["ema", str(copy), "-o", str(copy.parent / "out"), "--json"]
    with monkeypatch.context() as patch:
        patch.setattr("operando.ema.fit_ema", fail)
        done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 1
    assert kept(copy, "ema") is None
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 0
    assert kept(copy, "ema") is not None


def test_a_run_from_python_leaves_an_answer_only_while_it_changes_nothing(copy):
    run(copy, copy.parent / "out", until="frf", report=True)
    assert kept(copy) is not None
    run(load_test(copy).with_analysis(overlap=0.25), copy.parent / "out", until="frf", report=True)
    assert kept(copy) is None


def test_a_damaged_entry_vouches_for_nothing(copy):
    path = copy.parent / "out/.stages/manifest.json"
    manifest = json.loads(path.read_text())
    del manifest["files"][again.ANSWER]["files"]
    path.write_text(json.dumps(manifest))
    assert kept(copy) is None

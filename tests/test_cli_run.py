"""``operando run, frf, ema, oma, demo`` from the shell's side."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from itertools import takewhile

import pytest
from click.testing import CliRunner

import measurements
from operando.cli import main
from operando.config import load_test
from operando.paths import example_folder


def call(*args):
    return CliRunner().invoke(main, [str(a) for a in args])


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return measurements.write_test(tmp_path_factory.mktemp("t"), check=False)


def test_stage_command_json_and_text(path, tmp_path):
    done = call("frf", path, "-o", tmp_path / "out", "--json")
    assert done.exit_code == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["schema"] == "operando/summary/1"
    assert document["idle"]["frf"]["references"] == ["1+Z", "3+Z"]
    assert document["settings"]["used"]["frf"]["lines"] > 100
    assert (tmp_path / "out/idle_frf.uff").exists()
    assert "frf      done in" in done.stderr
    done = call("frf", path, "-o", tmp_path / "out")
    assert done.stdout.startswith("chain: FRFs of 4 responses to 2 references")
    assert "unchanged" in done.stderr


def test_default_folder_and_test_given_as_folder(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = call("run", path.parent, "--until", "inspect")
    assert done.exit_code == 0
    assert (tmp_path / "results/chain/summary.json").exists()


def test_unknown_stage_is_wrong_usage(path):
    done = call("run", path, "--until", "everything")
    assert done.exit_code == 2
    assert "stages: inspect, frf" in done.stderr


def test_a_failed_stage_exits_1_and_keeps_the_rest(path, tmp_path, monkeypatch):
    def fail(*args, **kwargs):
        from operando.errors import IdentificationError

        raise IdentificationError("no mode in the band", hint="widen the band")

    monkeypatch.setattr("operando.ema.fit_ema", fail)
    monkeypatch.setattr("operando.report.write_report", lambda results, path: path.write_text("x"))
    done = call("run", path, "-o", tmp_path / "out", "--json")
    assert done.exit_code == 1
    error = json.loads(done.stdout)
    assert error["schema"] == "operando/error/1"
    assert "no mode in the band" in error["error"]
    assert error["hint"] == "widen the band"
    document = error["partial"]
    assert document["operating"]["modes"]
    assert document["left_out"]["ema"] == "failed: no mode in the band"
    assert "widen the band" in done.stderr
    assert (tmp_path / "out/operating_modes.uff").exists()


@pytest.mark.skipif(os.name == "nt", reason="needs POSIX signals")
def test_ctrl_c_keeps_finished_stages(path, tmp_path):
    out = tmp_path / "out"
    start = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from operando.__main__ import main; main()"
    process = subprocess.Popen(
        [sys.executable, "-c", start, "run", str(path), "-o", str(out), "--json"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    # said once the result is kept; before that an interruption takes it back
    said = list(takewhile(lambda line: "frf      done" not in line, process.stderr))
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=60)
    stderr = "".join(said) + stderr
    assert process.returncode == 130, stderr
    assert json.loads(stdout)["error"] == "interrupted"
    assert "Traceback" not in stderr
    assert not [p for p in out.rglob("*") if ".part" in p.name]
    done = call("frf", path, "-o", out)
    assert "frf      unchanged" in done.stderr


@pytest.mark.skipif(os.name == "nt", reason="needs a POSIX shell")
@pytest.mark.parametrize(
    ("streams", "status", "answered"),
    [("2>&-", 0, True), ("<&-", 0, True), (">&- 2>&-", 0, False), ("2>/dev/full", 0, True), (">/dev/full", 1, False)],
)
def test_a_stream_that_is_closed_or_full_ends_no_run(streams, status, answered, path, tmp_path):
    if "/dev/full" in streams and not os.path.exists("/dev/full"):
        pytest.skip("there is no /dev/full")
    command = f'"$0" -m operando frf "$1" -o "$2" --json {streams}'
    done = subprocess.run(["sh", "-c", command, sys.executable, path, tmp_path / "out"], capture_output=True, text=True)
    assert done.returncode == status, done.stderr
    assert (tmp_path / "out/idle_frf.uff").exists()
    assert (json.loads(done.stdout)["schema"] == "operando/summary/1") if answered else not done.stdout
    assert "Traceback" not in done.stderr
    if status:
        assert done.stderr.endswith("operando: the answer cannot be written to stdout: No space left on device\n")


def test_example_is_there():
    folder = example_folder()
    test = load_test(folder)
    assert test.idle.records
    assert test.operating.records
    assert test.check.records
    assert sum(p.stat().st_size for p in test.files) < 15e6

"""Progress on stderr: share and time left, plain lines, -q and -v, the bar on a terminal; opening the report, completion."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
from click.testing import CliRunner

import measurements
from operando.cli import COMMANDS, main
from operando.pipeline import STAGES
from operando.pipeline.share import TYPICAL_S, Share, duration


def call(*args, **more):
    return CliRunner().invoke(main, [str(a) for a in args], **more)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return measurements.write_test(tmp_path_factory.mktemp("t"), check=False, operating=False)


class Time:
    now = 0.0

    def __call__(self):
        return self.now


def test_share_and_time_left_of_stages_that_take_what_the_last_run_took():
    time = Time()
    share = Share({"frf": 10.0, "ema": 30.0, "report": 10.0}, known=True, now=time)
    assert (share.share, share.left_s) == (0.0, 50.0)
    share.at("frf", "…")
    time.now = 5.0
    assert share.share == pytest.approx(0.1)
    assert share.left_s == pytest.approx(45.0)
    time.now = 20.0
    share.at("ema", "…")  # the first took twice as long, so may the others
    assert share.share == pytest.approx(0.2)
    assert share.left_s == pytest.approx(80.0)
    time.now = 500.0
    assert share.share == pytest.approx(0.2 + 0.95 * 0.6)  # a stage that takes longer than expected is not done
    share.at("report", "…")
    share.at("store", "…")
    assert share.share == 1.0


def test_stages_that_are_taken_over_or_left_out_are_no_work():
    time = Time()
    share = Share({"frf": 10.0, "ema": 30.0, "oma": 20.0, "report": 10.0}, now=time)
    assert share.left_s is None  # proportions alone say nothing of seconds
    share.at("frf", "unchanged, taken from the last run")
    share.at("ema", "…")
    time.now = 60.0
    share.at("oma", "left out: no records")
    assert share.share == pytest.approx(30 / 40)
    assert share.left_s == pytest.approx(20.0)


def test_every_stage_has_its_typical_time():
    assert list(TYPICAL_S) == list(STAGES)
    assert [duration(s) for s in (4.4, 100, 7200)] == ["4 s", "2 min", "2.0 h"]


def test_lines_quiet_and_verbose(path, tmp_path, monkeypatch):
    monkeypatch.setattr("operando.report.write_report", lambda results, path: path.write_text(results.name, encoding="utf-8"))
    plain = call("ema", path, "-o", tmp_path / "plain").stderr
    assert "ema      done in" in plain
    assert "order search" not in plain
    verbose = call("ema", path, "-o", tmp_path / "verbose", "-v").stderr
    assert "order search" in verbose
    done = call("ema", path, "-o", tmp_path / "quiet", "-q")
    assert done.stderr == ""
    assert done.stdout.count("idle modes in band") == 1
    assert call("ema", path, "-q", "-v").exit_code == 2
    assert call("ema", tmp_path / "missing.toml", "-q").stderr.startswith("operando: ")


@pytest.mark.skipif(os.name == "nt", reason="needs a pseudo terminal")
@pytest.mark.parametrize("colour", [True, False])
def test_the_bar_is_on_a_terminal_alone_and_honours_no_color(path, tmp_path, colour):
    ours, theirs = os.openpty()
    env = {k: v for k, v in os.environ.items() if k not in ("NO_COLOR", "FORCE_COLOR")} | {"TERM": "xterm-256color", "COLUMNS": "100"}
    env |= {} if colour else {"NO_COLOR": "1"}
    command = [sys.executable, "-m", "operando", "frf", str(path), "-o", str(tmp_path / "out"), "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=theirs, env=env)
    os.close(theirs)
    shown = b""
    while True:
        try:
            part = os.read(ours, 4096)
        except OSError:
            break
        if not part:
            break
        shown += part
    os.close(ours)
    assert json.loads(process.stdout.read())["schema"] == "operando/summary/1"
    process.stdout.close()
    assert process.wait() == 0
    text = shown.decode()
    assert " %" in text
    assert "idle FRFs" in text or "report" in text
    assert "done in" not in text
    assert ("\x1b[38;" in text) is colour
    assert text.endswith("\x1b[?25h") or "\x1b[?25h" in text[-40:]  # the cursor is back


@pytest.mark.parametrize("stage", ["frf", "ema"])
def test_a_stage_writes_the_report_of_what_there_is_and_opens_it(path, tmp_path, monkeypatch, stage):
    opened = []
    monkeypatch.setattr("webbrowser.open", lambda url: opened.append(url) or True)
    done = call(stage, path, "-o", tmp_path / "out", "--open")
    assert done.exit_code == 0, done.stderr
    report = tmp_path / "out" / "report.html"
    assert report.stat().st_size > 20_000
    assert opened == [report.resolve().as_uri()]
    assert f"Report: {report}" in done.stdout
    monkeypatch.setattr("webbrowser.open", lambda url: False)
    done = call("report", tmp_path / "out", "--open")
    assert done.exit_code == 0
    assert f"the report is {report}" in done.stderr


def test_oma_writes_its_report(tmp_path):
    path = measurements.write_test(tmp_path / "t", check=False, idle=False)
    done = call("oma", path, "-o", tmp_path / "out")
    assert done.exit_code == 0, done.stderr
    assert (tmp_path / "out" / "report.html").exists()


def test_run_until_a_stage_writes_no_report(path, tmp_path):
    assert call("run", path, "-o", tmp_path / "out", "--until", "frf").exit_code == 0
    assert not (tmp_path / "out" / "report.html").exists()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_scripts(shell):
    done = call("completion", shell)
    assert done.exit_code == 0
    assert "_OPERANDO_COMPLETE" in done.stdout
    assert json.loads(call("completion", shell, "--json").stdout)["script"].strip() == done.stdout.strip()
    assert call("completion", "tcsh").exit_code == 2


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        ("operando co", {"compare", "compare-libraries", "convert", "completion"}),
        ("operando run --un", {"--until"}),
        ("operando run --until e", {"ema"}),
        ("operando effects cl", {"clearance"}),
        ("operando add DIR gyro", {"gyroscopic"}),
    ],
)
def test_the_shell_completes(words, wanted, monkeypatch):
    env = {"_OPERANDO_COMPLETE": "bash_complete", "COMP_WORDS": words, "COMP_CWORD": str(len(words.split()) - 1)}
    done = call(env=env, prog_name="operando")
    assert {line.split(",")[1] for line in done.stdout.split()} == wanted


def test_the_nearest_of_a_mistyped_name_is_named(path, tmp_path):
    for args, near in (
        (["effcts"], "'effects'"),
        (["run", path, "--untl", "ema"], "--until"),
        (["effects", "clearence"], "'clearance'"),
        (["run", path, "-o", tmp_path, "--set", "analysis.bnd=[5,20]"], "'band'"),
        (["run", path, "-o", tmp_path, "--set", "analyis.band=[5,20]"], "'analysis'"),
        (["run", path, "-o", tmp_path, "--until", "emma"], "'ema'"),
    ):
        done = call(*args)
        assert done.exit_code in (1, 2)
        assert near in done.stderr, args


def test_set_replaces_an_entry_of_the_test_file(path, tmp_path):
    done = call("frf", path, "-o", tmp_path, "--set", "analysis.band=[20,60]", "--set", "name=other", "--json")
    document = json.loads(done.stdout)
    assert document["test"] == "other"
    assert document["settings"]["band"] == [20.0, 60.0]


def test_every_command_has_quiet_and_verbose():
    for name in COMMANDS:
        assert {"--quiet", "--verbose"} <= set(call(name, "--help").output.replace(",", " ").split()), name

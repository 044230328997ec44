"""The command line as a whole: help, start-up, exit codes, JSON errors, no traceback."""

from __future__ import annotations

import json
import resource
import subprocess
import sys

import click
import pytest
from click.testing import CliRunner

from operando.cli import COMMANDS, main
from operando.cli.answer import Answer, answers, table
from operando.errors import DataError


def call(*args):
    return CliRunner().invoke(main, [str(a) for a in args])


@pytest.mark.parametrize("command", COMMANDS)
def test_each_help_has_an_example_and_the_json_option(command):
    done = call(command, "--help")
    assert done.exit_code == 0
    assert f"Example: operando {command}" in done.output
    assert "--json" in done.output


def test_commands_of_the_contract_are_there():
    done = call("--help")
    assert done.exit_code == 0
    assert list(COMMANDS) == [
        "demo",
        "init",
        "inspect",
        "run",
        "frf",
        "ema",
        "oma",
        "ofrf",
        "compare",
        "compare-libraries",
        "diagnose",
        "add",
        "remove",
        "effects",
        "convert",
        "report",
        "workbench",
        "campaign",
        "completion",
    ]
    assert all(name in done.output for name in COMMANDS)


def test_short_texts_agree_with_the_commands():
    context = click.Context(main)
    for name in COMMANDS:
        command = main.get_command(context, name)
        assert command.name == name
        assert command.help


def test_help_starts_fast():
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, "-m", "operando", "--help"], capture_output=True, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0
    assert "Commands" in done.stdout
    assert after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime < 0.3


@pytest.mark.parametrize("args", [["nonsense"], ["run"], ["run", "x", "--nonsense"], ["convert", "one"], ["ofrf", "x", "--quantity", "y"]])
def test_wrong_usage_is_2(args):
    done = call(*args)
    assert done.exit_code == 2
    assert done.stdout == ""
    assert "Usage" in done.stderr
    done = call(*args, "--json")
    assert done.exit_code == 2
    assert json.loads(done.stdout)["schema"] == "operando/error/1"


@pytest.mark.parametrize(
    "args",
    [
        ["run", "missing.toml"],
        ["frf", "missing.toml"],
        ["ofrf", "missing"],
        ["report", "missing"],
        ["compare", "missing", "missing"],
        ["init", "missing"],
        ["convert", "missing.uff", "out.h5"],
        ["inspect", "missing.uff"],
    ],
)
def test_failure_is_1_with_one_json_document(args, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = call(*args, "--json")
    assert done.exit_code == 1
    document = json.loads(done.stdout)
    assert document["schema"] == "operando/error/1"
    assert set(document) == {"schema", "error", "where", "hint"}
    assert "" not in document.values()
    assert "unexpected" not in document["error"]
    done = call(*args)
    assert done.exit_code == 1
    assert done.stdout == ""
    assert done.stderr.startswith("operando: ")
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


def command_that(action):
    @click.command("try")
    @answers
    def body():
        return action()

    return body


def test_a_fault_is_explained_and_logged(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))

    def fault():
        raise ZeroDivisionError("deep inside")

    done = CliRunner().invoke(command_that(fault), ["--json"], standalone_mode=False)
    assert done.return_value == 1
    document = json.loads(done.stdout)
    assert "ZeroDivisionError" in document["error"]
    log = next(tmp_path.glob("operando-*.log"))
    assert str(log) in document["hint"]
    assert "Traceback" in log.read_text()
    assert "Traceback" not in done.output


def test_prints_of_libraries_do_not_reach_stdout():
    def noisy():
        print("library chatter")
        return Answer({"value": float("nan"), "schema": "x"}, "done")

    done = CliRunner().invoke(command_that(noisy), ["--json"], standalone_mode=False)
    assert json.loads(done.stdout) == {"schema": "x", "value": None}
    assert "chatter" in done.stderr


def test_a_partial_failure_keeps_the_answer_and_exits_1():
    done = CliRunner().invoke(
        command_that(lambda: Answer({"schema": "x"}, "half done", DataError("the rest failed"))), [], standalone_mode=False
    )
    assert done.return_value == 1
    assert done.stdout == "half done\n"
    command = command_that(lambda: Answer({"schema": "x"}, "half done", DataError("the rest failed")))
    document = json.loads(CliRunner().invoke(command, ["--json"], standalone_mode=False).stdout)
    assert (document["schema"], document["error"], document["partial"]) == ("operando/error/1", "the rest failed", {"schema": "x"})
    assert "the rest failed" in done.stderr


def test_interruption_is_130():
    def interrupt():
        raise KeyboardInterrupt

    done = CliRunner().invoke(command_that(interrupt), ["--json"], standalone_mode=False)
    assert done.return_value == 130
    assert json.loads(done.stdout)["error"] == "interrupted"


def test_table_aligns_numbers_to_the_right():
    assert table([["a", 1.5], ["bb", 10]], ["x", "y"]) == "x     y\na   1.5\nbb   10"

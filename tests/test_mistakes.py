"""Ordinary mistakes of a new user: what the answer says, where, what to do, and the exit status."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import measurements
import operando
from operando.cli import main
from operando.data import FrequencyAxis, Frf, Geometry, ModalModel
from operando.dof import Dof
from operando.errors import ConfigError, MissingError, ObjectError, OperandoError
from operando.io import write_uff
from operando.results import CheckRun, Results
from operando.store import save_results

SECONDS = 4.0


def made_results(folder: Path) -> None:
    """A results folder with an idle model and check FRFs, by hand: what ``ofrf``, ``add`` and ``compare`` need, and nothing else."""
    idle, running = measurements.idle_chain(), measurements.running_chain()
    dofs = tuple(Dof(i + 1, "Z") for i in range(4))
    hz = np.arange(5.0, 100.0, 0.5)
    model = ModalModel(idle.hz, np.full(4, 0.01), idle.phi, dofs, "unit_modal_mass", band_hz=(10.0, 90.0))
    check = Frf(running.accelerance(hz, ref=(0,)), FrequencyAxis(hz), dofs, dofs[:1], "accelerance")
    frf = Frf(idle.accelerance(hz, ref=(0,)), FrequencyAxis(hz), dofs, dofs[:1], "accelerance")
    found = {"verdict": "unexplained", "effects": [], "ladder": []}
    results = Results(
        "chain", settings={"band": [10.0, 90.0]}, idle=model, idle_frf=frf, check=[CheckRun("c", "1 N", check)], diagnosis=found
    )
    folder.mkdir()
    save_results(results, folder / "model.h5")


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with a test of short records, a results folder, and files that are none of these."""
    folder = tmp_path_factory.mktemp("home")
    record, chain = measurements.record, measurements.idle_chain()
    for name in ("idle", "operating"):
        (folder / name).mkdir()
    write_uff(folder / "idle/run1.uff", record(chain, [0], 5.0, 1, "run1", seconds=SECONDS))
    write_uff(
        folder / "operating/run1.uff", record(measurements.running_chain(), range(4), 5.0, 3, "run", force_known=False, seconds=SECONDS)
    )
    write_uff(folder / "slow.uff", replace(record(measurements.running_chain(), [0], 5.0, 4, "slow", seconds=SECONDS), sampling_hz=128.0))
    twice = record(chain, [0], 5.0, 1, "twice", seconds=SECONDS)
    twice = replace(twice, channels=(*twice.channels[:-1], replace(twice.channels[-1], dof=Dof(1, "Z"))))
    write_uff(folder / "twice.uff", twice)

    corners = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    write_uff(folder / "geometry.uff", Geometry((1, 2, 3, 4), corners))
    write_uff(folder / "elsewhere.uff", Geometry((101, 102, 103, 104), corners))
    (folder / "README.md").write_text("# Measurements\n\nOf the chain, in May.\n", encoding="utf-8")
    (folder / "table.csv").write_text("time [s], 1+Z [m/s2]\n0, 1\n1, 2\n", encoding="utf-8")
    (folder / "commas.csv").write_text("time [s],1+Z [m/s2]\n0,0,1,5\n0,1,2,5\n", encoding="utf-8")
    (folder / "row.csv").write_text("time [s],1+Z [m/s2]\n0,1\n", encoding="utf-8")
    (folder / "empty").mkdir()
    made_results(folder / "results")
    (folder / "notes.uff").write_text("Measured in May.\nBy two of us.\n", encoding="utf-8")
    whole = (folder / "idle/run1.uff").read_bytes()
    (folder / "short.uff").write_bytes(whole[whole.index(b"    -1\n    58") :][:2000])
    h = chain.accelerance(np.arange(0.5, 60.0, 0.5), ref=(0,))[:2, 0]
    np.savez(folder / "frf.npz", data=h.T)
    text = ["[idle]", 'frfs = ["frf.npz"]', "[units]", "frequency_step_hz = 0.5", 'acceleration = "g"', 'force = "N"', "[channels]"]
    labels = [f'"{name}" = {{dof = "{dof}"}}' for name, dof in (("ch1", "1+Z"), ("ch2", "2+Z"), ("force", "1+Z"))]
    (folder / "array.toml").write_text("\n".join([*text, *labels]), encoding="utf-8")
    text = ['name = "chain"', "", "[idle]", 'records = ["idle/*.uff"]', "", "[operating]", 'records = ["operating/*.uff"]', ""]
    text += ["[geometry]", 'file = "geometry.uff"', "", "[analysis]", "band = [10.0, 90.0]", ""]
    (folder / "test.toml").write_text("\n".join(text), encoding="utf-8")
    (folder / "only_idle.toml").write_text("\n".join(text[:4]), encoding="utf-8")
    (folder / "broken.toml").write_text("\n".join([*text[:4], "[analysis", "band = [10.0, 90.0]"]), encoding="utf-8")
    (folder / "key.toml").write_text("\n".join([*text, "overlapp = 0.5"]), encoding="utf-8")
    (folder / "section.toml").write_text("\n".join(text).replace("[analysis]", "[anlysis]"), encoding="utf-8")
    return folder


def asked(*changes: str) -> list[str]:
    """A run with changes of the test file."""
    return ["run", "test.toml", "-o", "out", "--until", "inspect", *(word for change in changes for word in ("--set", change))]


ANALYSIS = r"test\.toml, --set, \[analysis\] "

# mistake → words of the command, exit status, message, place, hint (regular expressions)
MISTAKES = {
    "wrong path": (["run", "tset.toml"], 1, "there is no such test file", r"tset\.toml", "operando init"),
    "folder without a test file": (["run", "idle"], 1, "there is no such test file", "idle/test.toml", "operando init"),
    "results folder as test file": (["run", "results"], 1, "is a results folder, expected a test file", "^results$", "operando report"),
    "folder in place of files": (asked('idle.records=["idle"]'), 1, "'idle' is a folder", r"\[idle\] records", r"write idle/\*"),
    "file in place of a folder": (["init", "README.md"], 2, "is a file", "command line", "Usage"),
    "results folder that is none": (["report", "idle"], 1, r"there is no model\.h5", "^idle$", "operando run"),
    "file in place of a results folder": (["ofrf", "README.md"], 1, "cannot be read|no results", r"README\.md", "."),
    "data file as test file": (
        ["run", "idle/run1.uff"],
        1,
        "not a text in UTF-8|not valid TOML",
        r"run1\.uff",
        "measurement file .uff.*operando init",
    ),
    "table as test file": (["run", "table.csv"], 1, "not valid TOML", r"table\.csv, line 1", "measurement file .csv.*operando init"),
    "README as test file": (["run", "README.md"], 1, "not valid TOML", r"README\.md, line 3", "operando init"),
    "README as data": (["inspect", "README.md"], 1, ".", r"README\.md", "."),
    "text named as a universal file": (["inspect", "notes.uff"], 1, "table cannot be read", r"notes\.uff", "this file has none"),
    "universal file cut short": (["inspect", "short.uff"], 1, "nothing in the file can be used", r"short\.uff", "cut short"),
    "folder as data": (["inspect", "idle"], 1, "a folder, not a file", "^idle$", r"as in 'idle/\*\.uff'"),
    "README among the records": (
        asked('idle.records=["README.md"]'),
        1,
        r"no file of \[idle\] can be read",
        r"\[idle\] records: README\.md",
        ".",
    ),
    "TOML syntax": (["run", "broken.toml"], 1, "not valid TOML", r"broken\.toml, line 5", r"\[idle\]"),
    "misspelt key": (
        ["run", "key.toml"],
        1,
        "unknown key 'overlapp'",
        r"key\.toml, line 15, \[analysis\] overlapp",
        "did you mean 'overlap'",
    ),
    "misspelt section": (
        ["run", "section.toml"],
        1,
        "unknown key 'anlysis'",
        r"section\.toml, line 12, \[anlysis\]",
        "did you mean 'analysis'",
    ),
    "results folder without a name": (["run", "test.toml", "-o", ""], 1, "results go into a folder, not ''", "^$", "pathlib"),
    "misspelt command": (["inspct", "idle/run1.uff"], 2, "there is no command 'inspct'", "command line", "did you mean 'inspect'"),
    "misspelt stage": (["run", "test.toml", "--until", "emma"], 2, "'emma' is no stage.*did you mean 'ema'", "command line", "Usage"),
    "--set without a value": (asked("analysis.band"), 1, "'analysis.band' names no entry", "--set", "SECTION.KEY=VALUE"),
    "wrong unit": (asked("units.acceleration=gee"), 1, "unknown unit 'gee'", r"\[units\] acceleration", "known: .*g"),
    "unit of the wrong quantity": (asked("units.force=mm"), 1, "unit of displacement, not of force", r"\[units\] force", "for example: n"),
    "unit of the wrong quantity at a channel": (
        asked('channels.acc2={unit="mm"}'),
        1,
        "unit of displacement, not of acceleration .*run1",
        r"\[channels\] acc2",
        "for example: m/s2",
    ),
    "wrong DOF": (asked('channels.acc2={dof="2+Q"}'), 1, "'2.Q' is no DOF label", r"\[channels\] acc2", r"12\+Z"),
    "unknown channel": (asked('channels.acc9={dof="9+Z"}'), 1, "'acc9' names no channel", r"\[channels\] acc9", "did you mean 'acc"),
    "unknown channel, inspected": (
        ["inspect", "test.toml", "--set", 'channels.acc9={dof="9+Z"}'],
        1,
        "'acc9' names no channel",
        r"\[channels\] acc9",
        "did you mean 'acc",
    ),
    "unknown column of an array": (
        ["inspect", "array.toml", "--set", 'channels.ch12={dof="9+Z"}'],
        1,
        "^'ch12' names no channel of any file$",
        r"array\.toml, --set, \[channels\] ch12",
        "did you mean 'ch[12]'",
    ),
    "one DOF for two columns": (
        ["inspect", "array.toml", "--set", 'channels.ch2={dof="1+Z"}'],
        1,
        r"^response DOF 1\+Z appears twice",
        r"frf\.npz",
        r"its own DOF.*\[channels\]",
    ),
    "FRFs under records": (
        ["run", "array.toml", "-o", "out", "--until", "frf", "--set", "idle.frfs=[]", "--set", 'idle.records=["frf.npz"]'],
        1,
        "no file holds a record with force and responses",
        ".",
        "the files hold FRFs: name them in frfs",
    ),
    "records under FRFs": (
        ["run", "only_idle.toml", "-o", "out", "--until", "frf", "--set", "idle.records=[]", "--set", 'idle.frfs=["idle/*.uff"]'],
        1,
        "no file holds frequency response functions",
        ".",
        "the files hold time records: name them in records",
    ),
    "unknown reference": (
        asked('analysis.references=["2+Z"]'),
        1,
        r"no idle force acts at 2\+Z",
        ANALYSIS + "references",
        r"did you mean '1\+Z'",
    ),
    "unknown place": (asked('analysis.places=["4+Y"]'), 1, r"no file has a channel at 4\+Y", ANALYSIS + "places", r"did you mean '4\+Z'"),
    "unknown effect kind": (
        asked('analysis.kinds=["pointmass"]'),
        1,
        "unknown kind of effect 'pointmass'",
        ANALYSIS + "kinds",
        "did you mean 'point_mass'",
    ),
    "unknown scaling": (asked("analysis.scaling=eq133"), 1, "'eq133' is not allowed", ANALYSIS + "scaling", "did you mean 'eq13'"),
    "unknown window": (asked("analysis.window=boxcar"), 1, "'boxcar' is not allowed", ANALYSIS + "window", "did you mean 'rectangular'"),
    "unknown estimator": (asked("analysis.estimator=h4"), 1, "'h4' is not allowed", ANALYSIS + "estimator", "did you mean 'h"),
    "band in kHz": (asked("analysis.band=[0.01,0.09]"), 1, r"holds \d lines", ANALYSIS + "band", r"not kHz: did you mean \[10, 90\]"),
    "band above half the rate": (
        asked("analysis.band=[10,220]"),
        1,
        "220 Hz is beyond 128 Hz, half its sampling rate",
        ANALYSIS + "band",
        r"did you mean \[10, 128\]",
    ),
    "band reversed": (asked("analysis.band=[90,10]"), 1, "low < high", ANALYSIS + "band", r"did you mean \[10, 90\]"),
    "band without a line": (asked("analysis.band=[10.01,10.02]"), 1, "holds 0 lines", ANALYSIS + "band", "widen the band"),
    "exclude_bands over everything": (
        asked("analysis.exclude_bands=[[5,100]]"),
        1,
        r"leave 0 lines of \[idle\]",
        ANALYSIS + "exclude_bands",
        "narrower",
    ),
    "exclude_bands as one band": (asked("analysis.exclude_bands=[49,51]"), 1, "not allowed", ANALYSIS + "exclude_bands", r"\[\[49, 51\]\]"),
    "mode beyond half the rate": (asked("analysis.modes_hz=[500]"), 1, "500 Hz is beyond 128 Hz", ANALYSIS + "modes_hz", "in Hz"),
    "mode outside the band": (
        asked("analysis.modes_hz=[120]"),
        1,
        "outside the band of 10 to 90 Hz",
        ANALYSIS + "modes_hz",
        "widen the band",
    ),
    "harmonic beyond half the rate": (
        asked("analysis.known_harmonics_hz=[200]"),
        1,
        "200 Hz is beyond 128 Hz",
        ANALYSIS + "known_harmonics_hz",
        "in Hz",
    ),
    "negative block_seconds": (asked("analysis.block_seconds=-1"), 1, "expected a positive number", ANALYSIS + "block_seconds", None),
    "overlap of 1": (asked("analysis.overlap=1"), 1, "below 1", ANALYSIS + "overlap", None),
    "overlap in per cent": (asked("analysis.overlap=50"), 1, "below 1", ANALYSIS + "overlap", r"did you mean 0\.5"),
    "empty glob": (asked('idle.records=["idel/*.uff"]'), 1, "matches no file", r"\[idle\] records", "did you mean 'idle/run1.uff'"),
    "geometry missing": (
        asked("geometry.file=geomtry.uff"),
        1,
        "'geomtry.uff' matches no file",
        r"\[geometry\] file",
        "did you mean 'geometry.uff'",
    ),
    "geometry of other nodes": (
        asked("geometry.file=elsewhere.uff"),
        1,
        "none of the measured nodes .1, 2, 3, 4",
        r"\[geometry\] file",
        "its nodes are 101, 102",
    ),
    "diagnose without an operating state": (
        ["diagnose", "only_idle.toml"],
        1,
        r"neither \[check\] nor \[operating\]",
        r"only_idle\.toml",
        "name its files",
    ),
    "oma without an operating state": (["oma", "only_idle.toml"], 1, r"no \[operating\] records", r"only_idle\.toml", "name its files"),
    "output that is a file": (["run", "test.toml", "-o", "README.md"], 1, "is a file, expected a folder", r"README\.md", "-o"),
    "OFRF of a route that is not there": (["ofrf", "results"], 1, "there are no operational FRFs", "results", "operando run"),
    "OFRF frequencies outside": (
        ["ofrf", "results", "--route", "effect", "--frequencies", "10:500:1"],
        1,
        "500 Hz is none of the lines .* 5 to 99.5 Hz",
        "--frequencies",
        "did you mean 10:99.5:1",
    ),
    "OFRF of an unknown DOF": (
        ["ofrf", "results", "--route", "effect", "--responses", "4+Y"],
        1,
        r"DOF 4\+Y is not measured",
        "--responses",
        r"did you mean '4\+Z'",
    ),
    "OFRF of no DOF": (["ofrf", "results", "--responses", "four"], 2, "no DOF label", "command line", "Usage"),
    "effect of an unknown kind": (
        ["add", "results", "pointmass@3+Z"],
        1,
        "unknown kind of effect 'pointmass'",
        "pointmass",
        "did you mean 'point_mass'",
    ),
    "effect parameter misspelt": (["add", "results", "point_mass@3+Z=mas:0.2"], 1, "'mas'", "effect 'point_mass", "it has: mass"),
    "effect parameter out of range": (
        ["add", "results", "point_mass@3+Z=mass:2e7"],
        1,
        "mass of point_mass is 2e.07, expected 1e-06 to 1e.06 kg",
        "effect 'point_mass",
        "did you mean 1e.06",
    ),
    "effect of no value": (
        ["add", "results", "tuned_absorber@3+Z=frequency:-5"],
        1,
        "must be positive, got -5",
        "effect 'tuned_absorber",
        None,
    ),
    "effect at an unknown DOF": (["add", "results", "point_mass@9+Z"], 1, r"DOF 9\+Z", "point_mass", r"[1-4]\+Z"),
    "the idle model to remove": (["remove", "results", "0"], 1, "step 0 is the idle model", "results", "no effect has been added"),
    "no step to remove": (["remove", "results", "3"], 1, "there is no step 3", "results", "no effect has been added"),
    "comparison written over the measurement": (
        ["compare", "results", "idle/run1.uff", "-o", "idle/run1.uff"],
        1,
        "over the file that is read",
        "run1.uff",
        "another name",
    ),
    "OFRFs written over the results": (
        ["ofrf", "results", "-o", "results/model.h5"],
        1,
        "over the file that is read",
        r"model\.h5",
        "another name",
    ),
    "decimal commas between commas": (["inspect", "commas.csv"], 1, "4 columns of numbers but 2 names", r"commas\.csv", "by semicolons"),
    "one row of samples": (["inspect", "row.csv"], 1, "tells no sampling rate", r"row\.csv", "the whole record"),
    "comparison with no measurement": (["compare", "results", "geometry.uff"], 1, "holds no FRFs", r"geometry\.uff", "operando inspect"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_explained(mistake, home, monkeypatch):
    words, status, message, where, hint = MISTAKES[mistake]
    monkeypatch.chdir(home)
    done = CliRunner().invoke(main, [*words, "--json"])
    document = json.loads(done.stdout)
    assert done.exit_code == status, document
    assert document["schema"] == "operando/error/1"
    assert re.search(message, document["error"]), document
    assert re.search(where, document["where"] or ""), document
    assert hint is None or re.search(hint, document["hint"] or ""), document
    assert "unexpected" not in document["error"]
    assert "Traceback" not in done.output


def answer(home, monkeypatch, *words):
    monkeypatch.chdir(home)
    done = CliRunner().invoke(main, [*words, "--json"])
    return done.exit_code, json.loads(done.stdout)


def test_a_dof_twice_in_one_set_up_is_a_finding(home, monkeypatch, tmp_path):
    words = ["frf", "only_idle.toml", "-o", str(tmp_path), "--set", 'idle.records=["twice.uff"]']
    status, document = answer(home, monkeypatch, *words)
    (found,) = [f for f in document["findings"] if f["kind"] == "duplicate_dof"]
    assert status == 0
    assert (found["severity"], found["file"], found["dof"]) == ("warning", "twice.uff", "1+Z")
    assert "[channels]" in found["action"]


def test_results_that_lack_what_a_command_needs_say_why(tmp_path):
    results = Results("chain", left_out={"ofrf": "the test has no [operating] records", "diagnose": "failed: no lines"})
    (tmp_path / "of may").mkdir()
    save_results(results, tmp_path / "of may/model.h5")
    for command, said in (("ofrf", "there are no operational FRFs: the test has no [operating] records"), ("diagnose", "failed: no lines")):
        done = CliRunner().invoke(main, [command, str(tmp_path / "of may"), "--json"])
        document = json.loads(done.stdout)
        assert (done.exit_code, document["hint"]) == (1, "once that is mended, run the test again")
        assert document["error"].endswith(said)
    done = CliRunner().invoke(main, ["compare", str(tmp_path / "of may"), "x.uff", "--route", "effect", "--json"])
    assert json.loads(done.stdout)["error"] == "there is no model with accepted effects: failed: no lines"
    save_results(Results("chain"), tmp_path / "of may/model.h5")
    done = CliRunner().invoke(main, ["diagnose", str(tmp_path / "of may"), "--json"])
    assert json.loads(done.stdout)["hint"] == f"`operando run test.toml -o '{tmp_path}/of may' --until diagnose` makes it"


def test_a_run_says_whose_results_it_replaces(home, monkeypatch, tmp_path):
    monkeypatch.chdir(home)
    for name, said in (("test.toml", False), ("test.toml", False), ("only_idle.toml", True), ("only_idle.toml", False)):
        done = CliRunner().invoke(main, ["run", name, "-o", str(tmp_path), "--until", "inspect"])
        assert done.exit_code == 0
        assert (f"the kept results here are of {home / 'test.toml'}; they are replaced" in done.stderr) is said


def test_the_command_that_init_names_can_be_pasted(home, monkeypatch, tmp_path):
    monkeypatch.chdir(home)
    done = CliRunner().invoke(main, ["init", "idle", "-o", str(tmp_path / "of may.toml")])
    assert done.stdout.splitlines()[-1] == f"Next: operando run '{tmp_path}/of may.toml'"


def test_a_check_of_another_rate_is_a_finding(home, monkeypatch, tmp_path):
    words = ["run", "test.toml", "-o", str(tmp_path), "--until", "inspect", "--set", 'check.records=["slow.uff"]']
    status, document = answer(home, monkeypatch, *words, "--set", "analysis.band=[10,60]")
    (found,) = [f for f in document["findings"] if f["kind"] == "unequal_rate"]
    assert status == 0
    assert found["severity"] == "info"
    assert "[idle] 256 Hz, [operating] 256 Hz, [check] 128 Hz" in found["message"]
    status, document = answer(home, monkeypatch, *words)
    assert (status, document["error"]) == (1, "90 Hz is beyond 64 Hz, half its sampling rate (slow.uff)")


@pytest.mark.parametrize(
    ("changes", "severity", "said"),
    [
        (["check.records='idle/*.uff'"], "error", "the data of [check] are those of [idle]"),
        (["operating.records='idle/*.uff'"], "error", "the data of [operating] are those of [idle]"),
        (["check.records='copy.uff'"], "error", "the data of [check] are those of [idle] in idle/run1.uff"),
        (["idle.records=['idle/*.uff', 'copy.uff']"], "warning", "holds the same data as idle/run1.uff"),
        (["check.records='operating/*.uff'"], None, ""),
        (["idle.records=[{file='copy.uff',stop_s=2}]", "check.records=[{file='copy.uff',start_s=2}]"], None, ""),
    ],
)
def test_data_that_stand_for_two_measurements_are_a_finding(changes, severity, said, home, monkeypatch, tmp_path):
    (home / "copy.uff").write_bytes((home / "idle/run1.uff").read_bytes())
    words = [word for change in changes for word in ("--set", change)]
    status, document = answer(home, monkeypatch, "run", "test.toml", "-o", str(tmp_path), "--until", "inspect", *words)
    found = [(f["severity"], f["message"]) for f in document["findings"] if f["kind"] == "same_data"]
    assert status == 0
    assert found == ([] if severity is None else [(severity, said)])


def test_some_nodes_without_a_position_are_a_finding(home, monkeypatch, tmp_path):
    write_uff(tmp_path / "three.uff", Geometry((1, 2, 3), np.eye(3)))
    words = ["run", "test.toml", "-o", str(tmp_path / "out"), "--until", "inspect", "--set", f"geometry.file='{tmp_path / 'three.uff'}'"]
    status, document = answer(home, monkeypatch, *words)
    (found,) = [f for f in document["findings"] if f["kind"] == "no_position"]
    assert status == 0
    assert "lacks 1 of 4 measured nodes: 4" in found["message"]


def test_a_failed_stage_is_said_first_and_in_the_exit_status(home, monkeypatch, tmp_path):
    monkeypatch.chdir(home)
    done = CliRunner().invoke(main, ["ema", "test.toml", "-o", str(tmp_path), "--set", "analysis.block_seconds=100"])
    assert done.exit_code == 1
    first = done.stdout.splitlines()[0]
    assert first.startswith("chain: stage frf: 1024 samples do not hold a block of 25600 (give a smaller block_seconds")


COMMANDS = ("run", "frf", "ema", "oma", "diagnose", "inspect")


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_that_reads_a_test_file_takes_changes(command, home, monkeypatch):
    status, document = answer(home, monkeypatch, command, "test.toml", "--set", "analysis.window=boxcar")
    assert (status, document["where"]) == (1, "test.toml, --set, [analysis] window")
    status, document = answer(home, monkeypatch, command, "test.toml", "--set", "name=7")
    assert (status, document["error"]) == (1, "name is 7, expected a text")


def test_changes_need_a_test_file(home, monkeypatch):
    assert answer(home, monkeypatch, "inspect", "idle/run1.uff", "--set", "analysis.band=[1,2]")[0] == 2
    assert answer(home, monkeypatch, "diagnose", "results", "--set", "analysis.band=[1,2]")[0] == 2


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: operando.read(3), "a file is read from its path, not int"),
        (lambda: operando.run(operando), "a test is run from its test file, not a module"),
        (lambda: operando.run(3, "out"), "a test is run from its test file, not int"),
        (lambda: operando.load(None), "what was saved is loaded from its path, not NoneType"),
        (lambda: operando.load_test([1]), "a test is loaded from its test file, not list"),
        (lambda: operando.mac(1, 2), "MAC of int and int is not defined"),
        (lambda: operando.Model(3), "effects are added to idle modes, not int"),
        (lambda: operando.diagnose(3), "a diagnosis needs idle modes first, not int"),
        (lambda: operando.Report("results"), "a report is made of results, not str"),
    ],
)
def test_an_object_of_another_kind_is_an_error_of_the_package_with_advice(call, said):
    with pytest.raises(ObjectError, match=said) as error:
        call()
    assert error.value.hint


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda frf, model: operando.fit_ema(frf, band=5), "band 5 is no pair of frequencies"),
        (lambda frf, model: operando.fit_ema(frf, band=("a", "b")), "no numbers"),
        (lambda frf, model: operando.fit_ema(frf, band=(10, 70), modes_hz="ab"), "no numbers"),
        (lambda frf, model: model.frf("a"), "frequencies 'a': no numbers"),
        (lambda frf, model: model.save(3), "an object is saved to a path, not int"),
        (lambda frf, model: frf.plot(3), "a figure is drawn on matplotlib Axes, not int"),
    ],
)
def test_what_is_no_number_path_or_axes_is_an_error_of_the_package_with_advice(call, said):
    model = ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    with pytest.raises(OperandoError, match=re.escape(said)) as error:
        call(model.frf(np.arange(5, 80, 0.1), references="1+Z"), model)
    assert error.value.hint


def test_a_path_that_is_not_there_names_the_nearest(tmp_path):
    (tmp_path / "run1.uff").write_text("")
    (tmp_path / "frame-results").mkdir()
    for call, name in ((operando.read, "run11.uff"), (operando.load, "frame-result")):
        with pytest.raises(MissingError) as error:
            call(tmp_path / name)
        assert error.value.hint.startswith("did you mean")
        assert name[:4] in error.value.hint
        assert error.value.where == str(tmp_path / name)


def test_an_unknown_key_is_answered_once(tmp_path):
    (tmp_path / "test.toml").write_text('[idel]\nfrfs = ["a.uff"]\n')
    with pytest.raises(ConfigError) as error:
        operando.load_test(tmp_path)
    assert str(error.value).count("'idle'") == 1

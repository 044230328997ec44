"""Campaigns on files: run, resumed, with failing tests, killed workers and killed drivers, on local processes and on Dask."""

from __future__ import annotations

import csv
import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
import types
from contextlib import suppress

import pytest
from click.testing import CliRunner

from campaigns import SPEEDS, environment, holder, records_of, started, waited, write_campaign
from operando.campaign import run_campaign
from operando.campaign.cluster import start_cluster
from operando.campaign.config import Workers
from operando.cli import main
from operando.errors import BusyError, MissingError
from operando.pipeline.folder import results_folder
from operando.pipeline.lock import exclusive

NAMES = [f"speed-{speed}" for speed in SPEEDS]


def called(*arguments):
    done = CliRunner().invoke(main, ["campaign", *map(str, arguments), "--json"], catch_exceptions=False)
    return done.exit_code, json.loads(done.stdout), done.stderr


def unharmed(document):
    return {t["name"]: t["state"] for t in document["tests"]} == dict.fromkeys(NAMES, "done")


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    return write_campaign(tmp_path_factory.mktemp("campaign"))


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """The same up to the FRFs: where it is only asked which tests run, and where."""
    return write_campaign(tmp_path_factory.mktemp("short"), until="frf", seconds=32.0)


def test_many_tests_one_table_one_report(tmp_path, campaign):
    out = tmp_path / "out"
    code, document, said = called(campaign, "-o", out, "-p", 1)
    assert (code, document["schema"]) == (0, "operando/campaign/1")
    assert unharmed(document)
    assert document["baseline"] == {"test": "speed-600", "chosen": "the first test; baseline in the campaign file names another"}
    assert document["counts"]["run"] == 3
    assert "3/3 speed-1200: done" in said
    stiffer = document["idle"]["tracks"][0]["points"]
    assert [p["place"] for p in stiffer] == list(SPEEDS)
    assert [p["frequency_hz"] for p in stiffer] == sorted(p["frequency_hz"] for p in stiffer)
    assert [p["changed"] for p in stiffer] == [False, True, True]
    with open(out / "campaign.csv", newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == sum(t["seen"] for t in document["idle"]["tracks"])
    assert float(rows[0]["frequency_hz"]) == stiffer[0]["frequency_hz"]
    assert (out / "campaign.parquet").exists() == (importlib.util.find_spec("pyarrow") is not None)
    assert "speed 900 rpm" in (out / "report.html").read_text()
    assert json.loads((out / "campaign.json").read_text())["tests"] == document["tests"]
    assert {p.name for p in (out / "tests").iterdir()} == set(NAMES)

    before = records_of(out)
    idle = campaign.parent / "runs/900/idle.uff"
    os.utime(idle, ns=(1, 1))  # perhaps changed: this one is looked at again
    code, document, _ = called(campaign, "-o", out, "-p", 1)
    assert (document["counts"]["run"], document["counts"]["unchanged"]) == (1, 2)
    after = records_of(out)
    assert [name for name in NAMES if after[name][1] != before[name][1]] == ["speed-900"]
    code, again, _ = called(campaign, "-o", out, "--set", "analysis.band=[10, 70]", "-p", 2)
    assert again["counts"]["run"] == 3
    assert len(again["idle"]["tracks"]) < len(document["idle"]["tracks"])


def test_tests_that_fail_are_listed_and_tried_again(tmp_path):
    file = write_campaign(tmp_path, until="frf", extra='baseline = "speed-600"')
    good = (tmp_path / "runs/600/idle.uff").read_bytes()
    (tmp_path / "runs/600/idle.uff").write_bytes(b"no measurement at all")
    (tmp_path / "runs/900/test.toml").write_text("[idle]\nrecords = 3\n")
    code, document, _ = called(file, "-o", tmp_path / "out", "-p", 1)
    states = {t["name"]: (t["state"], t["reason"]) for t in document["tests"]}
    assert code == 0
    assert [states[n][0] for n in NAMES] == ["incomplete", "failed", "done"] or [states[n][0] for n in NAMES] == [
        "failed",
        "failed",
        "done",
    ]
    assert all(states[n][1] for n in NAMES[:2])
    page = (tmp_path / "out/report.html").read_text()
    assert "Tests that failed" in page
    (tmp_path / "runs/600/idle.uff").write_bytes(good)
    (tmp_path / "runs/900/test.toml").write_text((tmp_path / "runs/1200/test.toml").read_text())
    code, document, _ = called(file, "-o", tmp_path / "out", "-p", 1)
    assert unharmed(document)
    assert document["counts"]["run"] == 2


def test_settings_that_no_test_can_be_read_with_write_nothing(tmp_path):
    file = write_campaign(tmp_path, speeds=(600, 900), until="inspect")
    (tmp_path / "runs/900/test.toml").write_text("[idle]\nrecords = 3\n")  # fails by itself, and does not hide the mistake
    code, document, _ = called(file, "-o", tmp_path / "out", "-p", 1)
    assert code == 0
    before = {name: (tmp_path / "out" / name).read_bytes() for name in ("campaign.csv", "report.html", "campaign.json")}
    code, document, _ = called(file, "-o", tmp_path / "out", "--set", "analysis.bnd=[1,2]", "-p", 1)
    assert code == 1
    assert document["schema"] == "operando/error/1"
    assert "bnd" in document["error"]
    assert {name: (tmp_path / "out" / name).read_bytes() for name in before} == before


def test_without_modes_nothing_is_said_to_agree(tmp_path):
    file = write_campaign(tmp_path, speeds=(600, 900), until="inspect")
    done = CliRunner().invoke(main, ["campaign", str(file), "-o", str(tmp_path / "out"), "-p", "1"])
    assert "No test has modes or a diagnosis" in done.stdout
    assert "differs from the baseline by more" not in done.stdout


def test_columns_that_no_test_fills_are_left_out(tmp_path):
    file = write_campaign(tmp_path, speeds=(600,), until="inspect")
    done = CliRunner().invoke(main, ["campaign", str(file), "-o", str(tmp_path / "out"), "-p", "1"])
    (head,) = [line for line in done.stdout.splitlines() if line.startswith("no.")]
    assert head.split() == ["no.", "test", "state"]


def test_a_campaign_of_which_nothing_can_be_used_fails(tmp_path):
    file = write_campaign(tmp_path, speeds=(600,), until="inspect")
    (tmp_path / "runs/600/test.toml").write_text("[idle]\nrecords = 3\n")
    code, document, _ = called(file, "-o", tmp_path / "out")
    assert code == 1
    assert document["schema"] == "operando/error/1"
    assert document["partial"]["counts"]["failed"] == 1


def test_one_measurement_at_rest_is_analysed_once(tmp_path):
    file = write_campaign(tmp_path, until="oma", shared_idle=True)
    code, document, _ = called(file, "-o", tmp_path / "out", "-p", 2)
    assert code == 0
    assert unharmed(document)
    assert document["idle"]["same_everywhere"]
    manifests = [tmp_path / "out/tests" / name / ".stages/manifest.json" for name in NAMES]
    entries = [json.loads(path.read_text())["files"] for path in manifests]
    assert len({e[".stages/automatic.h5"]["seconds"] for e in entries}) == 1
    assert len({e[".stages/oma.h5"]["key"] for e in entries}) == 3


def test_where_the_first_of_those_that_share_a_measurement_fails_the_next_begins(tmp_path):
    file = write_campaign(tmp_path, until="frf", shared_idle=True)
    file.write_text(file.read_text().replace("{speed = 600}", "{speed = 600, analysis = {band = [1e5, 2e5]}}"))
    code, document, _ = called(file, "-o", tmp_path / "out", "-p", 2)
    assert code == 0
    assert [t["state"] for t in document["tests"]] == ["failed", "done", "done"]
    assert "1e+05" in document["tests"][0]["reason"] or "200000" in document["tests"][0]["reason"]
    assert document["baseline"]["test"] == "speed-900"
    assert "speed-600, the first test, failed" in document["baseline"]["chosen"]


def test_a_killed_worker_is_replaced_and_its_test_goes_on(tmp_path, short):
    out = tmp_path / "out"
    run = started(short, "-o", out, "-p", 1, "--json")
    worker = waited(lambda: holder(out, NAMES[1]), "the second test to begin")
    os.kill(worker, signal.SIGKILL)
    stdout, stderr = run.communicate(timeout=180)
    document = json.loads(stdout)
    assert run.returncode == 0, stderr
    assert unharmed(document)
    assert document["counts"]["run"] == 3
    records = records_of(out)
    assert records[NAMES[0]][0]["process"] == worker
    assert "worker 1 was lost (signal SIGKILL); the test is tried again" in stderr
    assert records[NAMES[1]][0]["process"] == records[NAMES[2]][0]["process"] != worker


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_a_driver_that_ends_loses_nothing_and_repeats_nothing(tmp_path, short, how):
    out = tmp_path / "out"
    run = started(short, "-o", out, "-p", 1)
    worker = waited(lambda: holder(out, NAMES[1]), "the second test to begin")
    os.killpg(run.pid, how) if how == signal.SIGINT else os.kill(run.pid, how)  # Ctrl-C reaches all processes of the terminal
    _, stderr = run.communicate(timeout=60)
    if how == signal.SIGINT:
        assert (run.returncode, "interrupted" in stderr, "Traceback" in stderr) == (130, True, False)
    waited(lambda: _gone(worker), "the worker to end with its driver", 20)
    before = records_of(out)
    assert set(before) == {NAMES[0]}
    code, document, _ = called(short, "-o", out, "-p", 1)
    assert code == 0
    assert unharmed(document)
    assert (document["counts"]["run"], document["counts"]["unchanged"]) == (2, 1)
    assert records_of(out)[NAMES[0]] == before[NAMES[0]]


def _gone(process):
    try:
        with open(f"/proc/{process}/stat") as stream:
            return True if stream.read().rsplit(")", 1)[1].split()[0] == "Z" else None
    except OSError:
        with suppress(ProcessLookupError):
            os.kill(process, 0)
            return None
        return True


def test_one_campaign_at_a_time_in_a_folder(tmp_path, short):
    with results_folder(tmp_path, "test"), pytest.raises(BusyError):
        run_campaign(short, tmp_path)


def test_a_test_waits_for_a_folder_that_is_in_use_for_a_moment(tmp_path):
    """A lost driver's worker needs a moment to end; the lock is free then."""
    file = write_campaign(tmp_path, speeds=(600,), until="inspect")
    hidden = tmp_path / "out/tests/speed-600/.stages"
    hidden.mkdir(parents=True)
    with exclusive(hidden / "lock", "test"):
        run = started(file, "-o", tmp_path / "out", "-p", 1, "--json")
        waited(lambda: (tmp_path / "out/.stages/logs").exists() or None, "the worker to start")
        with pytest.raises(subprocess.TimeoutExpired):
            run.wait(3)
    stdout, _ = run.communicate(timeout=60)
    assert json.loads(stdout)["counts"]["done"] == 1


def test_usage_is_checked(tmp_path, campaign):
    done = CliRunner().invoke(main, ["campaign", str(campaign), "-p", "1", "--scheduler", "tcp://x:1"])
    assert done.exit_code == 2
    done = CliRunner().invoke(main, ["campaign", str(tmp_path / "none.toml")])
    assert done.exit_code == 1
    assert "there is no such campaign file" in done.stderr


@pytest.mark.skipif(importlib.util.find_spec("distributed") is not None, reason="Dask is installed")
def test_without_dask_the_extra_is_named(tmp_path, campaign):
    code, document, _ = called(campaign, "-o", tmp_path / "out", "--scheduler", "tcp://127.0.0.1:1")
    assert code == 1
    assert "operando[dask]" in document["hint"]


@pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="Dask is not installed (pip install 'operando[dask]')")
def test_a_dask_cluster_that_loses_a_worker(tmp_path, short):
    """Scheduler and one worker on this machine; the worker's process is killed in the second test, and another takes over."""
    address = tmp_path / "scheduler.json"
    quiet = {"env": environment(), "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", str(address)]
    scheduler = subprocess.Popen(command, cwd=tmp_path, **quiet)
    processes = [scheduler]
    try:
        uri = waited(lambda: _address(address), "the scheduler")
        command = [sys.executable, "-m", "distributed.cli.dask_worker", uri, "--nthreads", "1", "--no-dashboard"]
        processes.append(subprocess.Popen(command, cwd=tmp_path, **quiet))
        out = tmp_path / "out"
        run = started(short, "-o", out, "--scheduler", uri, "--json")
        worker = waited(lambda: holder(out, NAMES[1]), "the second test to begin")
        os.kill(worker, signal.SIGKILL)
        stdout, stderr = run.communicate(timeout=180)
        assert run.returncode == 0, stderr
        assert unharmed(json.loads(stdout))
        records = records_of(out)
        assert records[NAMES[0]][0]["process"] == worker
        assert records[NAMES[1]][0]["process"] != worker
    finally:
        for process in processes:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def test_clusters_are_started_with_the_options_given(monkeypatch):
    """What dask-jobqueue and dask-kubernetes are asked for; their own modules are stood in for here."""

    class Cluster:
        def __init__(self, **options):
            self.options = options

        def scale(self, *counts, **jobs):
            self.scaled = (counts, jobs)

    monkeypatch.setitem(sys.modules, "dask_jobqueue", types.SimpleNamespace(SLURMCluster=Cluster))
    monkeypatch.setitem(sys.modules, "dask_kubernetes", types.ModuleType("dask_kubernetes"))
    monkeypatch.setitem(sys.modules, "dask_kubernetes.operator", types.SimpleNamespace(KubeCluster=Cluster))
    slurm = start_cluster(Workers(cluster="slurm", jobs=20, options={"queue": "short", "memory": "8GB"}))
    assert slurm.options == {"cores": 1, "processes": 1, "memory": "8GB", "queue": "short"}
    assert slurm.scaled == ((), {"jobs": 20})
    kubernetes = start_cluster(Workers(cluster="kubernetes", jobs=3, options={"image": "lab/operando"}))
    assert (kubernetes.options["image"], kubernetes.scaled) == ("lab/operando", ((3,), {}))
    monkeypatch.setitem(sys.modules, "dask_jobqueue", None)
    with pytest.raises(MissingError, match=re.escape("operando[slurm]")):
        start_cluster(Workers(cluster="slurm"))


def _address(path):
    with suppress(OSError, ValueError, KeyError):
        return json.loads(path.read_text())["address"]
    return None

"""The workbench over HTTP: who is answered, modes, effects, channels, runs; what it does is what the command line does."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from operando.cli import main
from operando.config import load_test
from operando.errors import BusyError, ConfigError, MissingError
from operando.pipeline.folder import results_folder
from operando.store import load_results
from operando.workbench import Bench
from operando.workbench.app import make_app
from operando.workbench.edits import TakeFrom
from operando.workbench.modes import leave

TOKEN = "token-of-the-test"
HEAD = {"X-Operando-Token": TOKEN}
PAGES = ("/modes/idle", "/modes/operating", "/missing", "/data", "/report", "/panel")


class Site:
    """A workbench without a network."""

    def __init__(self, bench):
        self.bench, self.app = bench, make_app(bench, TOKEN)
        self.app.config.update(PORT=8000, TESTING=True)
        self.client = self.app.test_client()
        self.client.get("/", query_string={"token": TOKEN}, base_url="http://127.0.0.1:8000")

    def get(self, path, **more):
        return self.client.get(path, base_url="http://127.0.0.1:8000", **more)

    def do(self, what, headers=HEAD, **given):
        return self.client.post(f"/do/{what}", json=given, base_url="http://127.0.0.1:8000", headers=headers)

    def done(self, seconds=240):
        """Wait for the work in the background."""
        self.bench.job.wait(seconds)
        return self.bench.state()


@pytest.fixture
def site(chain_test):
    made = Site(Bench(chain_test / "results"))
    yield made
    made.bench.stop()


@pytest.fixture(scope="module")
def reading(chain_results):
    """A site whose test nothing is changed of."""
    return Site(Bench(chain_results / "test.toml", chain_results / "results"))


@pytest.mark.parametrize("path", PAGES)
def test_pages_answer(reading, path):
    answer = reading.get(path)
    assert answer.status_code == 200
    assert "cannot be shown" not in answer.text
    assert answer.headers["Content-Security-Policy"].startswith("default-src 'self'")
    assert "http" not in answer.text.replace("http-equiv", ""), "nothing comes from elsewhere"


@pytest.mark.parametrize("path", [*PAGES, "/report.html", "/diagram/idle", "/workbench.js"])
def test_nothing_is_answered_without_the_token(reading, path):
    stranger = reading.app.test_client()
    assert stranger.get(path, base_url="http://127.0.0.1:8000").status_code == 403
    assert stranger.get("/?token=other", base_url="http://127.0.0.1:8000").status_code == 403
    assert reading.get(path).status_code == 200


def test_a_cookie_alone_changes_nothing(reading):
    assert reading.do("undo", headers={}).status_code == 403
    assert reading.do("undo", headers={"X-Operando-Token": "other"}).status_code == 403
    assert reading.do("undo", headers={**HEAD, "Origin": "http://127.0.0.1:9999"}).status_code == 403
    assert reading.do("undo", headers={**HEAD, "Origin": "http://127.0.0.1:8000"}).status_code == 200


@pytest.mark.parametrize("host", ["example.org", "127.0.0.1", "127.0.0.1:80", "127.0.0.1.example.org:8000", "[::1]:8000"])
def test_other_hosts_are_refused(reading, host):
    assert reading.get("/modes/idle", headers={"Host": host}).status_code == 403


def test_names_of_files_come_from_no_request(reading):
    for path in ("/../test.toml", "/report.html/../model.h5", "/static/app.py", "/model.h5", "/%2e%2e/test.toml"):
        assert reading.get(path).status_code == 404


def test_the_report_is_shown_apart(reading):
    answer = reading.get("/report.html")
    assert "sandbox allow-scripts" in answer.headers["Content-Security-Policy"]
    assert "allow-same-origin" not in answer.headers["Content-Security-Policy"]
    assert answer.data == (reading.bench.folder / "report.html").read_bytes()


@pytest.mark.parametrize("state", ["idle", "operating"])
def test_the_diagram_is_that_of_the_results(reading, state):
    found = reading.get(f"/diagram/{state}").json
    model = getattr(reading.bench.results, state)
    table = model.details.stabilization.table
    low, high = found["limits"]
    assert len(found["poles"]["hz"]) == np.sum((table.frequency_hz >= low) & (table.frequency_hz <= high))
    assert [m["hz"] for m in found["modes"]] == pytest.approx(model.frequencies_hz)
    assert {c["name"] for c in found["behind"]} == ({"CMIF", "MMIF"} if state == "idle" else {"Singular values of the spectra"})
    assert set(found["poles"]["letter"]) <= set(found["letters"])
    for curve in found["behind"]:
        assert 0 <= min(curve["values"]) <= max(curve["values"]) <= 1


def test_a_state_without_modes_has_no_diagram_and_says_so_in_json(reading, monkeypatch):
    monkeypatch.setattr(Bench, "results", replace(reading.bench.results, operating=None))
    answer = reading.get("/diagram/operating")
    assert (answer.status_code, answer.json["error"]) == (404, "there are no modes of the operating state")


@pytest.mark.parametrize(("state", "prefix"), [("idle", ""), ("operating", "oma_")])
def test_a_mode_left_out_stands_in_the_changes_and_can_be_taken_again(site, state, prefix):
    hz = float(getattr(site.bench.results, state).frequencies_hz[1])
    assert site.do("leave", state=state, hz=hz).status_code == 200
    assert f"{prefix}reject_hz = [{hz:.6g}]" in site.get("/panel").text
    assert site.get(f"/diagram/{state}").json["modes"][1]["now"] == "left out"
    assert site.do("take", state=state, hz=hz * 1.0002).status_code == 200
    assert site.bench.draft.lines() == []
    site.do("undo")
    assert "reject_hz" in site.bench.draft.new_text
    site.do("discard")
    assert site.bench.draft.lines() == []


def test_a_pole_that_is_a_mode_is_not_taken_twice(site):
    hz = float(site.bench.results.idle.frequencies_hz[0])
    answer = site.do("take", state="idle", hz=hz)
    assert answer.status_code == 400
    assert "is a mode already" in answer.json["error"]
    assert site.do("take", state="idle", hz=3.0).json["error"].startswith("no stable pole")
    assert site.bench.draft.edits == []


def test_a_mode_that_the_fit_moved_is_the_one_taken_by_hand(chain_results):
    """Its frequency is not that of the pole chosen; leaving it out takes the choice back."""
    results = load_results(chain_results / "results")
    first, second = (float(hz) for hz in results.idle.frequencies_hz[:2])
    chosen = 0.45 * first + 0.55 * second  # the fit moved it to ``first``
    results.automatic = results.idle.select_modes(range(1, results.idle.n_modes))
    edit, words = leave(results, {"select_hz": [chosen]}, "idle", first)
    assert edit == TakeFrom("select_hz", chosen)
    assert "not taken by hand any more" in words


def test_modes_named_exactly_are_a_list_to_change(chain_test):
    path = chain_test / "test.toml"
    first, second = (float(f"{hz:.5g}") for hz in load_results(chain_test / "results").idle.frequencies_hz[:2])
    path.write_text(path.read_text().replace("[analysis]", f"[analysis]\nmodes_hz = [{first}, {second}]"))
    site = Site(Bench(path, chain_test / "results"))
    site.do("leave", state="idle", hz=first)
    assert site.bench.draft.table["analysis"]["modes_hz"] == [second]
    assert "the only mode" in site.do("leave", state="idle", hz=second).json["error"]


def test_a_channel_is_left_out_with_a_reason_and_taken_back(site):
    assert site.do("exclude", channel="2+Z", reason=" ").status_code == 400
    assert site.do("exclude", channel="2+Z", reason="cable").status_code == 200
    assert '"2+Z" = {exclude = true, reason = "cable"}' in site.get("/panel").text.replace("&#34;", '"')
    page = site.get("/data").text
    assert "Take back channel 2+Z" in page
    assert "Leave out 2+Z" not in page
    site.do("include", channel="2+Z")
    assert site.bench.draft.lines() == []


def test_bands_are_changed(site):
    assert site.do("bands", low=12.0, high=80.0, excluded=[[24.0, 25.5]]).status_code == 200
    assert site.bench.draft.table["analysis"] == {"band": [12.0, 80.0], "exclude_bands": [[24.0, 25.5]]}
    answer = site.do("bands", low=80.0, high=12.0, excluded=[])
    assert answer.status_code == 400
    assert "did you mean" in answer.json["hint"]
    assert site.do("bands", low=12.0, high=80.0, excluded=[]).status_code == 200
    assert "exclude_bands" not in site.bench.draft.new_text


def test_save_and_run_writes_the_test_file_and_makes_new_results(site, chain_test):
    hz = float(site.bench.results.idle.frequencies_hz[1])
    count = site.bench.results.idle.n_modes
    site.do("leave", state="idle", hz=hz)
    assert site.do("run").status_code == 200
    assert site.do("run").status_code == 400, "one work at a time"
    state = site.done()
    assert state["error"] is None
    assert state["over"]
    assert "# kept as it is\n" in (chain_test / "test.toml").read_text()
    assert load_test(chain_test / "test.toml").analysis.reject_hz == (float(f"{hz:.6g}"),)
    assert site.bench.results.idle.n_modes == count - 1
    assert site.bench.not_run() == []
    assert any("inspect" in line or "unchanged" in line for line in state["lines"]), "stages that hold are taken from the last run"
    assert "Done." in site.get("/panel").text


def test_settings_saved_but_not_run_are_named(site):
    site.do("bands", low=12.0, high=80.0, excluded=[])
    site.do("save")
    assert site.bench.not_run() == ["band"]
    assert "not in the results shown: band" in site.get("/panel").text


def test_a_run_can_be_stopped(site):
    before = site.bench.results.idle.n_modes
    site.do("bands", low=11.0, high=80.0, excluded=[])
    site.do("run")
    time.sleep(2.0)
    site.do("stop")
    state = site.bench.state()
    assert (state["over"], state["stopped"], state["error"]) == (True, True, None)
    assert site.bench.results.idle.n_modes == before
    with results_folder(site.bench.folder, "test"):
        pass  # the lock is free


def test_a_folder_in_use_is_left_alone(site):
    with results_folder(site.bench.folder, "other work"):
        site.do("remove", step=1)
        state = site.done()
    assert "in use by" in state["error"]["error"]
    assert "What to do" in site.get("/panel").text


def test_what_a_run_finds_wrong_is_explained(site):
    site.do("bands", low=12.0, high=500.0, excluded=[])
    site.do("run")
    error = site.done()["error"]
    assert "band" in error["where"]
    assert error["hint"]


def same(a, b):
    assert a.keys() == b.keys()
    for key in ("effects", "ladder", "judged_on", "by_hand"):
        assert json.dumps(a[key]) == json.dumps(b[key])


def test_effects_taken_back_and_added_are_those_of_the_command_line(site, chain_test, tmp_path, monkeypatch):
    """Through the browser and by ``operando remove`` and ``add``: the same documents; candidates and the suggestion by their buttons."""
    # here, not in the processes of the workbench: the report of a command is not looked at
    monkeypatch.setattr("operando.report.write_report", lambda results, path: path.write_text(results.name, encoding="utf-8"))

    def copied(name):
        shutil.copytree(chain_test / "results", tmp_path / name)
        return str(tmp_path / name)

    def documents(other):
        return [json.loads((folder / "diagnosis.json").read_text()) for folder in (site.bench.folder, tmp_path / other)]

    found, other = site.bench.results.diagnosis, copied("other")
    assert found["effects"]
    site.do("remove", step=1)
    assert site.done()["error"] is None
    assert site.bench.results.diagnosis["effects"] == []
    assert CliRunner().invoke(main, ["remove", other, "1", "-q"]).exit_code == 0
    same(*documents("other"))
    site.do("candidate", number=0)
    assert site.done()["error"] is None
    assert site.bench.results.diagnosis["effects"][0]["kind"] == found["candidates"][0]["kind"]
    site.do("suggested")
    assert site.done()["error"] is None
    suggested = site.bench.results.diagnosis
    assert [e["kind"] for e in suggested["effects"]] == [e["kind"] for e in found["effects"]]
    third = copied("third")
    site.do("add", kind="point_mass", dofs=["2+Z"], values={"mass": "0.1"}, fix=False)
    assert site.done()["error"] is None
    assert CliRunner().invoke(main, ["add", third, "point_mass@2+Z=mass:0.1", "-q"]).exit_code == 0
    ours, theirs = documents("third")
    same(ours, theirs)
    assert len(ours["ladder"]) == len(suggested["ladder"]) + 1
    page = site.get("/missing").text
    assert "point mass at 2+Z" in page
    assert "Effects were added or taken out by hand" in page
    site.do("candidate", number=999)
    assert "no candidate" in site.done()["error"]["error"]


@pytest.mark.parametrize(
    ("what", "given", "said"),
    [
        ("add", {"kind": "point_mas", "dofs": ["2+Z"]}, "point_mass"),
        ("add", {"kind": "point_mass", "dofs": []}, "point_mass"),
        ("add", {"kind": "point_mass", "dofs": ["2+Z"], "values": {"mass": "much"}}, "much"),
        ("add", {"kind": "point_mass", "dofs": ["9+Z"]}, "9+Z"),
        ("take", {"state": "idle"}, "hz is no number"),
        ("take", {"hz": 1.0}, "no state"),
        ("nothing", {}, "no action"),
        ("take", {"state": ["idle"], "hz": 1.0}, "no state"),
        ("add", {"kind": "point_mass", "dofs": 5}, "no list of texts"),
        ("add", {"kind": "point_mass", "dofs": ["2+Z"], "values": "heavy"}, "no list of texts"),
        ("remove", {"step": 1.7}, "step is no whole number"),
        ("bands", {"low": 5.0, "high": None}, "both its limits"),
        ("bands", {"low": None, "high": None, "excluded": [[None, 24.0]]}, "both its limits"),
        ("bands", {"low": None, "high": None, "excluded": {"from": 24.0}}, "both its limits"),
        ("exclude", {"channel": "22+Z", "reason": "cable"}, "no channel '22+Z'"),
        ("exclude", {"channel": "2+Z", "reason": "\ud800"}, "reason is no text"),
        ("exclude", {"channel": "2+Z", "reason": ""}, "reason is empty"),
    ],
)
def test_wrong_requests_are_explained(reading, what, given, said):
    answer = reading.do(what, **given)
    assert answer.status_code == 400
    assert said in str(answer.json)
    assert reading.bench.job is None
    assert reading.bench.draft.edits == []


@pytest.mark.parametrize(
    ("path", "body", "status"),
    [("/do/undo", "[1]", 400), ("/do/undo", "[" * 9000 + "]" * 9000, 400), ("/do/undo", "x" * 70_000, 413), ("/nowhere", "{}", 404)],
)
def test_whatever_is_posted_is_answered_in_json(reading, path, body, status):
    answer = reading.client.post(path, data=body, base_url="http://127.0.0.1:8000", headers=HEAD)
    assert answer.status_code == status
    assert answer.json["schema"] == "operando/error/1"


def test_a_fault_of_the_program_is_said_to_be_one(site, monkeypatch):
    monkeypatch.setattr(site.bench, "exclude", lambda channel, reason: 1 / 0)
    site.app.config.update(TESTING=False)
    answer = site.do("exclude", channel="2+Z", reason="cable")
    assert (answer.status_code, answer.json["where"]) == (500, "operando itself")
    assert "ZeroDivisionError" in answer.json["error"]


def test_results_that_do_not_name_their_test_file_are_shown(chain_test):
    (chain_test / "test.toml").unlink()
    site = Site(Bench(chain_test / "results"))
    assert "Start with the test file" in site.get("/panel").text
    for path in PAGES:
        assert site.get(path).status_code == 200
    assert site.do("leave", state="idle", hz=10.0).status_code == 400
    assert site.do("run").status_code == 400


def test_a_test_file_that_imports_programs_is_read_only_where_it_is_named(chain_test):
    path = chain_test / "test.toml"
    (chain_test / "laws.py").write_text("raise SystemExit('imported')")
    path.write_text(path.read_text() + '[effects]\nmodules = ["laws.py"]\n')
    bench = Bench(chain_test / "results")
    assert bench.draft is None
    assert "imports Python files" in bench.why_not
    with pytest.raises(ConfigError, match="imported"):
        Bench(path, chain_test / "results")


def test_the_packaged_example_is_not_written_to(tmp_path):
    from operando.paths import example_folder

    bench = Bench(example_folder() / "test.toml", tmp_path / "out")
    assert bench.draft is None
    assert bench.test_path is not None
    assert "Copy" in bench.why_not
    with pytest.raises(MissingError):
        bench.writable()


def test_a_test_without_results_has_pages(chain_test):
    site = Site(Bench(chain_test / "test.toml", chain_test / "new"))
    for path in PAGES:
        answer = site.get(path)
        assert answer.status_code == 200
    assert "There are no results yet" in site.get("/missing").text
    assert site.do("bands", low=10.0, high=70.0, excluded=[]).status_code == 200, "a band too wide for the data may be why"


def test_entries_given_by_set_are_used_and_not_written(chain_test):
    bench = Bench(chain_test / "test.toml", chain_test / "results", ["analysis.band=[10,80]"])
    assert bench.not_run() == ["band"]
    site = Site(bench)
    assert "analysis.band=[10,80]" in site.get("/panel").text
    site.do("exclude", channel="2+Z", reason="cable")
    site.do("save")
    assert "90.0" in (chain_test / "test.toml").read_text()


def test_a_test_file_changed_elsewhere_is_read_again_where_nothing_waits(site, chain_test):
    path = chain_test / "test.toml"
    path.write_text(path.read_text().replace("90.0", "85.0"))
    assert "not in the results shown: band" in site.get("/panel").text
    path.write_text("[broken")
    assert "changed by something else" in site.get("/panel").text
    assert "TOML" in site.do("reread").json["error"]


def test_damaged_results_are_said_to_be(site):
    (site.bench.folder / "model.h5").write_bytes(b"no results")
    for path in PAGES:
        answer = site.get(path)
        assert answer.status_code == 200
    assert "cannot be read" in answer.text


def test_responses_and_references_of_measured_frfs_are_channels(tmp_path):
    import operando

    operando.write_uff(tmp_path / "idle.uff", operando.Frf([[range(1, 99)]], range(5, 103), "1+Z", "2+Z"))
    (tmp_path / "test.toml").write_text('name = "pump"\n[idle]\nfrfs = ["idle.uff"]')
    operando.run(tmp_path / "test.toml", tmp_path / "out", until="inspect")
    page = Site(Bench(tmp_path / "out")).get("/data").text
    assert "Leave out 1+Z" in page
    assert "Leave out 2+Z:force" in page


def test_one_work_at_a_time(site):
    site.bench.start(do="remove", step=1)
    with pytest.raises(BusyError):
        site.bench.start(do="remove", step=1)
    site.bench.stop()


def test_names_in_files_are_shown_not_run(chain_test):
    path = chain_test / "test.toml"
    path.write_text(path.read_text().replace('name = "chain"', 'name = "<script>alert(1)</script>"'))
    site = Site(Bench(path, chain_test / "new"))
    assert "<script>alert" not in site.get("/modes/idle").text


def test_the_command_prints_one_document_serves_and_ends_on_ctrl_c(chain_test):
    import signal
    import urllib.request

    command = [sys.executable, "-m", "operando", "workbench", str(chain_test / "results"), "--no-open", "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    text = ""
    while not text.endswith("}\n"):
        text += process.stdout.readline()
    document = json.loads(text)
    assert document["schema"] == "operando/workbench/1"
    assert document["test"] == str((chain_test / "test.toml").resolve())
    assert document["writes"]
    with urllib.request.urlopen(document["address"]) as answer:
        assert answer.status == 200
        assert "SameSite=Strict" in answer.headers["Set-Cookie"]
        assert "HttpOnly" in answer.headers["Set-Cookie"]
    process.send_signal(signal.SIGINT)
    rest, errors = process.communicate(timeout=20)
    assert (process.returncode, rest) == (0, "")
    assert "Traceback" not in errors


def test_wrong_arguments_are_explained(tmp_path):
    asked = CliRunner().invoke(main, ["workbench", str(tmp_path / "nothing"), "--no-open", "--json"])
    assert asked.exit_code == 1
    assert json.loads(asked.stdout)["schema"] == "operando/error/1"

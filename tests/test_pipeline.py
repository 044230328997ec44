"""The pipeline on a small test: results folder, cache, resumption, missing data, failing parts."""

from __future__ import annotations

import copy
import json
import os
import shutil
import sys

import numpy as np
import pytest

import measurements
import operando
from operando import load_test
from operando.errors import ConfigError, IdentificationError
from operando.pipeline import STAGES, run
from operando.store import load_results

CONTRACT_FILES = {
    "summary.json",
    "comparison.json",
    "report.html",
    "idle_frf.uff",
    "idle_modes.uff",
    "operating_modes.uff",
    "ofrf.uff",
    "ofrf_effect.uff",
    "diagnosis.json",
    "ladder.json",
    "model.h5",
    "timings.json",
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Test file and results folder of one complete run."""
    folder = tmp_path_factory.mktemp("chain")
    path = measurements.write_test(folder)
    results = run(path, folder / "out")
    return path, folder / "out", results


@pytest.fixture(autouse=True)
def short_report(request, monkeypatch):
    """The report has its own tests; here a line stands for it, except in the first run."""
    request.getfixturevalue("finished")
    monkeypatch.setattr("operando.report.write_report", lambda results, path: path.write_text(results.name, encoding="utf-8"))


@pytest.fixture
def again(finished, tmp_path):
    """A copy of the finished test that a test may change."""
    path, _, _ = finished
    shutil.copytree(path.parent, tmp_path / "t", copy_function=shutil.copy2)
    return tmp_path / "t/test.toml", tmp_path / "t/out"


def log(messages):
    return lambda stage, message: messages.append((stage, message))


def computed(messages):
    """Stages that were computed, not taken from the last run."""
    return [stage for stage, message in messages if message.startswith("done")]


def strict(path):
    def refuse(text):
        raise AssertionError(f"{text} in {path.name}")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


def test_results_folder_is_that_of_the_contract(finished):
    _, out, results = finished
    assert {p.name for p in out.iterdir() if not p.name.startswith(".")} == CONTRACT_FILES
    assert results.left_out == {}
    summary = strict(out / "summary.json")
    assert summary["schema"] == "operando/summary/1"
    assert {"test", "settings", "findings", "idle", "operating", "pairing", "scaling"} <= set(summary)
    assert summary["settings"]["threshold"] == 0.7
    assert {"references", "responses", "averages", "reciprocity_error"} <= set(summary["idle"]["frf"])
    mode = summary["idle"]["modes"][0]
    assert {"frequency_hz", "frequency_std_hz", "damping_ratio", "damping_ratio_std", "modal_phase_collinearity"} <= set(mode)
    assert list(mode["shape"]) == ["1+Z", "2+Z", "3+Z", "4+Z"]
    assert len(summary["operating"]["modes"][0]["shape"]["1+Z"]) == 2
    assert {"method", "reason", "threshold", "kappa", "outside_span", "residuals", "alternatives"} <= set(summary["scaling"])
    comparison = strict(out / "comparison.json")
    assert comparison["schema"] == "operando/comparison/1"
    assert set(comparison["models"]) == {"idle", "idle_shapes", "msf_all", "ofrf", "effect"}
    assert comparison["settings"] == summary["settings"]


def test_identified_modes_are_those_of_the_chain(finished):
    _, out, _ = finished
    summary = strict(out / "summary.json")
    for key, chain, tolerance in (("idle", measurements.idle_chain(), 3e-4), ("operating", measurements.running_chain(), 5e-3)):
        found = [m["frequency_hz"] for m in summary[key]["modes"] if m["in_band"]]
        np.testing.assert_allclose(found, chain.hz, rtol=tolerance, err_msg=key)


def test_operational_frf_beats_the_idle_model(finished):
    _, out, _ = finished
    models = strict(out / "comparison.json")["models"]
    assert models["ofrf"]["error_db"] < 0.5 * models["idle"]["error_db"]


def test_ofrf_file_holds_all_pairs_on_the_lines_of_the_idle_frf(finished):
    _, out, results = finished
    made = operando.read(out / "ofrf.uff").frfs[0]
    assert made.data.shape[:2] == (4, 4)
    np.testing.assert_allclose(made.frequencies_hz, results.idle_frf.frequencies_hz, rtol=1e-9, atol=1e-9)
    band = made.axis.band(10, 90)
    exact = measurements.running_chain().accelerance(made.frequencies_hz, ref=(0, 2))[:, :, band]
    error = np.linalg.norm(made.select(references="1+Z,3+Z").data[:, :, band] - exact) / np.linalg.norm(exact)
    assert error < 0.15


def test_frfs_estimated_in_a_run_have_seven_digits(finished):
    _, out, results = finished
    for frf in (results.idle_frf, results.check[0].frf):
        for values, single in ((frf.data, np.complex64), (frf.variance, np.float32), (frf.coherence, np.float32)):
            np.testing.assert_array_equal(values, values.astype(single))
    np.testing.assert_array_equal(operando.read(out / "idle_frf.uff").frfs[0].data, results.idle_frf.data)


def test_second_run_takes_everything_from_the_first(again):
    path, out = again
    before = {p.name: p.stat().st_mtime_ns for p in out.iterdir() if p.name in CONTRACT_FILES}
    messages = []
    results = run(path, out, progress=log(messages))
    assert computed(messages) == []
    assert {p.name: p.stat().st_mtime_ns for p in out.iterdir() if p.name in before} == before
    assert results.hybrid is not None
    assert results.timings_s["frf"] > 0


def test_a_setting_reruns_only_what_depends_on_it(again):
    path, out = again
    messages = []
    results = run(load_test(path).with_analysis(threshold=0.9), out, progress=log(messages))
    assert set(computed(messages)) == {"ofrf", "compare", "diagnose", "report"}
    assert results.hybrid.threshold == 0.9
    assert strict(out / "summary.json")["settings"]["threshold"] == 0.9


def test_a_changed_file_reruns_what_reads_it(again):
    path, out = again
    from operando.io import write_uff

    chain = measurements.running_chain()
    write_uff(path.parent / "check/run1b.uff", measurements.record(chain, [0], 2.0, 55, "run1b"))
    messages = []
    run(path, out, progress=log(messages))
    assert set(computed(messages)) == {"inspect", "compare", "diagnose", "report"}
    # a touched file of the same content is the same file
    os.utime(path.parent / "idle/run1.uff")
    messages.clear()
    run(path, out, progress=log(messages))
    assert computed(messages) == []


def test_until(again, tmp_path):
    path, out = again
    messages = []
    results = run(path, tmp_path / "new", until="frf", progress=log(messages))
    assert computed(messages) == ["inspect", "frf"]
    assert results.idle is None
    assert {p.name for p in (tmp_path / "new").iterdir() if not p.name.startswith(".")} == {
        "summary.json",
        "idle_frf.uff",
        "model.h5",
        "timings.json",
    }
    # going back keeps later results that still hold
    messages.clear()
    results = run(path, out, until="frf", progress=log(messages))
    assert computed(messages) == []
    assert results.idle is not None
    assert (out / "idle_modes.uff").exists()
    # and takes away those that do not
    results = run(load_test(path).with_analysis(band=(12.0, 80.0)), out, until="frf")
    assert results.idle is None
    assert not (out / "idle_modes.uff").exists()


def test_interrupted_run_keeps_finished_stages_and_old_results(again, monkeypatch):
    path, out = again
    old = {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()}

    def interrupt(*args, **kwargs):
        raise KeyboardInterrupt

    changed = load_test(path).with_analysis(block_seconds=3.0)
    with monkeypatch.context() as patch:
        patch.setattr("operando.ema.fit_ema", interrupt)
        with pytest.raises(KeyboardInterrupt):
            run(changed, out)
    assert {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()} == old
    assert not list((out / ".stages/new").iterdir())
    messages = []
    run(changed, out, until="frf", progress=log(messages))
    assert computed(messages) == []
    assert load_results(out).settings["block_seconds"] == 3.0
    assert load_results(out).idle is None
    assert not (out / "idle_modes.uff").exists()  # it would be of another block length


@pytest.mark.parametrize(
    ("sections", "left_out", "files"),
    [
        (("operating", "check"), {"oma", "ofrf", "compare", "diagnose"}, {"idle_frf.uff", "idle_modes.uff"}),
        (("idle", "check"), {"frf", "ema", "ofrf", "compare", "diagnose"}, {"operating_modes.uff"}),
    ],
)
def test_a_stage_without_data_is_left_out_and_said(again, sections, left_out, files):
    path, out = again
    text = path.read_text()
    for section in sections:
        text = text.replace(f'[{section}]\nrecords = ["{section}/*.uff"]\n', "")
    path.write_text(text)
    messages = []
    results = run(path, out, progress=log(messages))
    assert computed(messages) == ["inspect", "report"]
    assert set(results.left_out) == left_out
    assert all(any(stage == name and "left out" in text for stage, text in messages) for name in left_out)
    assert {p.name for p in out.iterdir() if not p.name.startswith(".")} == files | {
        "summary.json",
        "model.h5",
        "report.html",
        "timings.json",
    }
    assert strict(out / "summary.json")["left_out"] == results.left_out


def test_without_a_band_both_states_use_that_of_the_idle_modes(again, monkeypatch):
    path, out = again
    seen = []

    def see(records, *, band=None, **settings):
        seen.append(band)
        raise IdentificationError("enough seen")

    monkeypatch.setattr("operando.oma.fit_oma", see)
    path.write_text(path.read_text().replace("band = [10.0, 90.0]", ""))
    results = run(path, out, until="oma")
    assert seen == [results.idle.band_hz]
    assert results.settings["used"]["ema"]["band"] == list(results.idle.band_hz)


def test_comparison_of_an_earlier_run_does_not_survive_its_check(again):
    path, out = again
    text = path.read_text()
    path.write_text(text.replace('[check]\nrecords = ["check/*.uff"]\n', ""))
    results = run(path, out, until="compare")
    assert results.comparison is None
    assert not (out / "comparison.json").exists()
    assert (out / "ofrf.uff").exists()


def test_a_broken_check_file_takes_nothing_else_away(again):
    path, out = again
    for name in ("run1a", "run1b"):
        (path.parent / f"check/{name}.uff").write_bytes(b"    -1\n    58\nrubbish\n")
    results = run(path, out, until="compare")
    assert [f.severity for f in results.findings if f.kind == "stage_failed"] == ["error"]
    assert results.left_out["inspect"].startswith("failed")
    assert results.left_out["compare"] == "not run because no file of [check] can be read"
    assert results.hybrid is not None
    assert (out / "ofrf.uff").exists()
    assert not (out / "comparison.json").exists()


def test_a_fault_in_one_stage_is_a_finding_with_a_log_until_it_is_gone(again, monkeypatch):
    """The comparison judges whatever models there are: one that was missing for a while must not stay missing."""
    path, out = again

    def fault(*args, **kwargs):
        raise ZeroDivisionError("sum of nothing")

    changed = load_test(path).with_analysis(threshold=0.8)
    with monkeypatch.context() as patch:
        patch.setattr("operando.scaling.scale_operational", fault)
        results = run(changed, out)
    assert results.left_out["ofrf"].startswith("failed: unexpected ZeroDivisionError")
    assert results.comparison is not None
    assert set(results.comparison["models"]) - {"effect"} == {"idle"}
    assert not (out / "ofrf.uff").exists()
    assert "sum of nothing" in (out / "errors.log").read_text()
    results = run(changed, out)
    assert "ofrf" in results.comparison["models"]
    assert not (out / "errors.log").exists()


def test_the_log_of_a_file_that_cannot_be_written_is_kept(again, monkeypatch):
    path, out = again
    monkeypatch.setattr("operando.report.write_report", lambda *given: 1 / 0)
    (out / "report.html").unlink()
    results = run(path, out, report=True)
    said = [f for f in results.findings if f.kind == "stage_failed"]
    assert [f.message for f in said] == ["stage report: report.html cannot be written: unexpected ZeroDivisionError: division by zero"]
    assert str(out / "errors.log") in said[0].action
    assert "division by zero" in (out / "errors.log").read_text()


def test_without_operational_modes_no_ofrfs_are_made_and_nothing_failed(again, monkeypatch):
    from operando.oma import fit_oma
    from operando.report.assessment import assumptions

    path, out = again
    monkeypatch.setattr("operando.oma.fit_oma", lambda records, **settings: fit_oma(records, **settings).select_modes([]))
    results = run(load_test(path).with_analysis(oma_max_order=40), out, until="ofrf")
    assert results.left_out["ofrf"].startswith("the operational records show no mode in the band")
    assert not [f for f in results.findings if f.kind == "stage_failed"]
    assert results.operating is not None
    assert "One of the two models has no mode." in [a.text for a in assumptions(results)]


def test_a_changed_geometry_reaches_the_files_that_hold_it(again):
    path, out = again
    from operando.data import Geometry
    from operando.io import write_uff

    before = {name: (out / name).read_bytes() for name in CONTRACT_FILES}
    nodes = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0.5]])
    write_uff(path.parent / "geometry.uff", Geometry((1, 2, 3, 4), nodes, ((1, 2, 3, 4),)))
    messages = []
    run(path, out, progress=log(messages))
    assert set(computed(messages)) == {"inspect", "diagnose", "report"}
    changed = {name for name in CONTRACT_FILES if (out / name).read_bytes() != before[name]}
    assert {"idle_frf.uff", "idle_modes.uff", "operating_modes.uff", "ofrf.uff", "model.h5"} <= changed


def test_a_run_gives_the_results_of_the_test_file_again(again):
    """Effects added by hand are in the folder until then; that they go is said."""
    from click.testing import CliRunner

    from operando.cli import main

    path, out = again
    before = {name: (out / name).read_bytes() for name in CONTRACT_FILES - {"timings.json"}}
    done = CliRunner().invoke(main, ["remove", str(out), "1"])
    assert done.exit_code == 0, done.output
    by_hand = {name for name in before if (out / name).read_bytes() != before[name]}
    assert by_hand == {"diagnosis.json", "ladder.json", "comparison.json", "ofrf_effect.uff", "model.h5", "report.html"}
    messages = []
    run(path, out, progress=log(messages))
    assert computed(messages) == ["report"]
    said = {message.split(" is missing or changed")[0] for _, message in messages if "missing or changed since the last run" in message}
    assert said == by_hand
    assert {name for name in before if (out / name).read_bytes() != before[name]} <= {"report.html"}  # here another stands for it


def test_stored_results_come_back(finished):
    _, out, results = finished
    back = load_results(out)
    np.testing.assert_array_equal(back.idle.shapes, results.idle.shapes)
    np.testing.assert_array_equal(back.idle.covariance, results.idle.covariance)
    lines = np.linspace(10, 90, 50)
    np.testing.assert_array_equal(back.hybrid.frf(lines).data, results.hybrid.frf(lines).data)
    assert back.findings == results.findings
    assert back.comparison == results.comparison
    assert back.settings == results.settings
    assert load_results(out / "model.h5", only=("hybrid",)).idle is None


def test_wrong_calls_are_refused(finished, tmp_path):
    path, _, _ = finished
    with pytest.raises(ConfigError, match="unknown stage"):
        run(path, tmp_path / "o", until="everything")
    (tmp_path / "file").write_text("x")
    with pytest.raises(ConfigError, match="is a file"):
        run(path, tmp_path / "file")
    assert STAGES[-1] == "report"
    assert issubclass(IdentificationError, operando.OperandoError)


def test_diagnosis_names_the_spring_and_hands_it_over(finished, tmp_path, monkeypatch):
    """The whole story from the command line: named, taken back, a wrong one added and called wrong, the right one suggested."""
    from click.testing import CliRunner

    from operando.cli import main

    _, out, _ = finished
    folder = tmp_path / "out"
    shutil.copytree(out, folder)

    def call(*words):
        done = CliRunner().invoke(main, [*words, "--json"])
        assert done.exit_code == 0, done.output
        return json.loads(done.stdout)

    opened = []
    monkeypatch.setattr("webbrowser.open", lambda url: opened.append(url) or True)
    found = call("diagnose", str(folder), "--open")
    assert found["schema"] == "operando/diagnosis/2"
    assert found["verdict"] in ("explained", "ambiguous")
    right = found["effects"][0]
    # The running chain keeps its modal damping ratios although the spring stiffens it: a little damping comes with the spring.
    assert right["kind"] in ("ground_spring", "ground_hysteretic_spring")
    assert right["location"] == ["3+Z"]
    assert strict(folder / "ladder.json") == found["ladder"]
    before, after = (row["heldout_misfit"] for row in found["ladder"][:2])
    assert after < 0.1 * before
    good = strict(folder / "comparison.json")
    assert len(call("remove", str(folder), "1", "--open")["ladder"]) == 1
    bare = strict(folder / "comparison.json")
    assert "effect" not in bare["models"]
    assert not any("effect" in run["models"] for run in bare["by_run"])
    assert bare["models"]["idle"] == good["models"]["idle"]
    wrong = call("add", str(folder), "point_mass@1+Z=mass:0.01", "--open")
    assert opened == [(folder / "report.html").resolve().as_uri()] * 3
    assert wrong["ladder"][1]["heldout_misfit"] > 100 * after
    assert any("the data speak for another one" in word and "3+Z" in word for word in wrong["words"])
    bad = strict(folder / "comparison.json")
    assert good["models"]["effect"]["misfit"] < 0.1 * bad["models"]["effect"]["misfit"] < bare["models"]["idle"]["misfit"]
    twice = CliRunner().invoke(main, ["add", str(folder), "point_mass@1+Z=mass:0.5", "--json"])
    assert twice.exit_code == 1
    refused = json.loads(twice.stdout)
    assert refused["error"] == "point_mass at 1+Z would be in the model twice"
    assert f"operando remove {folder} 1" in refused["hint"]
    call("remove", str(folder), "1")
    again = call("add", str(folder), "--suggested")
    assert [e["kind"] for e in again["effects"]] == [e["kind"] for e in found["effects"]]
    told = CliRunner().invoke(main, ["add", str(folder), "point_mass@1+Z=mass:0.01"])
    now = told.stdout.split("in the model now")[1].splitlines()[1:3]  # with the sizes of the refit
    assert "at 3+Z: " in now[0]
    assert " ± " in now[0]
    assert now[1].startswith("  2 point mass at 1+Z: ")
    assert len(call("remove", str(folder), "2")["effects"]) == 1
    refused = CliRunner().invoke(main, ["remove", str(folder), "9", "--json"])
    assert refused.exit_code == 1
    assert json.loads(refused.stdout)["schema"] == "operando/error/1"


def watched(thing, read):
    """A copy of a dataclass instance that notes which of its fields are read (but not those that ``replace`` carries over)."""

    def noting(self, name):
        if sys._getframe(1).f_globals.get("__name__") != "dataclasses" and not name.startswith("_"):
            read.add(name)
        return object.__getattribute__(self, name)

    copied = copy.copy(thing)
    object.__setattr__(copied, "__class__", type("Watched", (type(thing),), {"__getattribute__": noting}))
    return copied


def test_a_stage_reads_only_what_its_key_is_made_of(finished):
    """Settings and results of other stages: what is read and not declared would leave old results standing."""
    from operando.pipeline.inputs import Inputs
    from operando.pipeline.stages import STEPS, Work

    path, _, results = finished
    test = load_test(path)
    fills = {
        "inspect": {"inventory", "geometry", "raw"},
        "frf": {"idle_frf"},
        "automatic": {"automatic"},
        "ema": {"idle"},
        "oma": {"operating"},
    }
    fills |= {
        "ofrf": {"hybrid"},
        "check": {"check"},
        "compare": {"comparison"},
        "diagnose": {"diagnosis", "effect_idle", "effect_covariance"},
        "idle_libraries": {"idle_libraries"},
        "operating_libraries": {"operating_libraries"},
    }
    upstream: dict = {}
    for step in STEPS:
        upstream[step.name] = {*step.upstream, *(far for near in step.upstream for far in upstream[near])}
        settings, fields = set(), set()

        class Analysed(Work):
            analysis = watched(test.analysis, settings)

        work = Analysed(test, Inputs(test), watched(results, fields))
        found = step.does(work)
        assert set(found) - {"findings", "geometry", "comparison"} <= fills[step.name], step.name
        known = set().union(*(fills[name] for name in upstream[step.name])) if upstream[step.name] else set()
        allowed = known | ({"idle"} if step.name == "oma" else set())  # in its key where the band is that of the idle modes
        allowed |= {"timings_s"} if step.name.endswith("_libraries") else set()  # a time is no result: it is said as it was measured
        allowed |= {"findings"}  # why a stage lacks something: such a stage keeps nothing
        assert fields <= allowed, f"{step.name} reads {fields - allowed} and does not name the stage that makes it as upstream"
        of_upstream = {name for other in STEPS if other.name in upstream[step.name] for name in other.settings}
        assert settings <= set(step.settings) | of_upstream, f"{step.name} reads settings {settings - set(step.settings) - of_upstream}"

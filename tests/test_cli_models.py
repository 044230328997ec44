"""``operando ofrf, compare, report, convert`` on a finished results folder."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

import models
from measurements import record, running_chain
from operando import read
from operando.cli import main
from operando.cli.ofrf import parse_lines
from operando.store import save_results


def call(*args):
    return CliRunner().invoke(main, [str(a) for a in args])


def answer(*args):
    done = call(*args, "--json")
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout, parse_constant=lambda text: pytest.fail(text))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("results")
    save_results(models.results(), place / "model.h5")
    return place


def test_ofrf_values_are_those_of_the_hybrid_model(folder):
    document = answer(
        "ofrf", folder, "--responses", "2+Z,3-Z", "--references", "1Z", "--frequencies", "10:12:0.5", "--quantity", "mobility"
    )
    assert document["schema"] == "operando/ofrf/1"
    assert document["responses"] == ["2+Z", "3-Z"]
    assert document["references"] == ["1+Z"]
    assert document["unit"] == "(m/s)/N"
    np.testing.assert_allclose(document["frequencies_hz"], [10, 10.5, 11, 11.5, 12])
    made = models.results().hybrid.frf(np.arange(10, 12.1, 0.5), "2+Z,3+Z", "1+Z", "mobility")
    values = np.array(document["data"]) @ [1, 1j]
    np.testing.assert_allclose(values[0], made.data[0])
    np.testing.assert_allclose(values[1], -made.data[1])  # the other sense
    assert np.array(document["std"]).shape == (2, 1, 5)


def test_ofrf_defaults_and_files(folder, tmp_path):
    document = answer("ofrf", folder, "-o", tmp_path / "all.uff")
    assert "data" not in document
    made = read(tmp_path / "all.uff").frfs[0]
    assert made.data.shape == (4, 4, 381)
    np.testing.assert_allclose(made.frequencies_hz, models.results().idle_frf.frequencies_hz)
    for name, lost in (("pair.csv", ["variance of the FRF lines"]), ("pair.mat", ["variance of the FRF lines"]), ("pair.uff", [])):
        words = ["ofrf", folder, "--responses", "2+Z", "--references", "1+Z", "-o", tmp_path / name]
        assert answer(*words)["lost"] == lost
        assert (f"lost in {tmp_path / name}: variance of the FRF lines" in call(*words).stdout) is bool(lost)
    for name in ("pair.h5", "pair.mat", "pair.uff"):
        done = call("ofrf", folder / "model.h5", "--responses", "2+Z", "--references", "1+Z", "-o", tmp_path / name)
        assert done.exit_code == 0, done.output
        assert read(tmp_path / name).frfs[0].data.shape == (1, 1, 381)
    text = call("ofrf", folder).stdout
    assert text.startswith("16 operational FRFs")
    assert "Nothing written" in text


@pytest.mark.parametrize(
    ("args", "code", "message"),
    [
        (["--responses", "99+Z"], 1, "99+Z is not measured"),
        (["--responses", "2+Q"], 2, "no DOF label"),
        (["--frequencies", "5:2:1"], 2, "A <= B"),
        (["--frequencies", "5-20"], 2, "A:B:STEP"),
        (["--frequencies", "0:20:0"], 2, "STEP > 0"),
        (["--frequencies", "0:20:1"], 1, "FRFs at 0 Hz (accelerance, mobility, receptance) are not computed"),
        (["--route", "effect"], 1, "no model with accepted effects"),
        (["-o", "file.xyz"], 1, "tells no format"),
    ],
)
def test_ofrf_refusals(folder, args, code, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = call("ofrf", folder, *args)
    assert done.exit_code == code
    assert message in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def with_effect(tmp_path_factory):
    """Results whose diagnosis accepted a faulty sensor and a spring of 2e4 ± 300 N/m."""
    from operando.structure.effects import Effect

    spring = Effect("ground_spring", ("3+Z",), {"stiffness": 2e4}).with_std({"stiffness": 300.0})
    found = [Effect("sensor_gain", ("2+Z",), {"gain": 1.1}).to_dict(), spring.to_dict()]
    results = models.results()
    parameters = results.idle.n_parameters
    covariance = np.zeros((parameters + 2, parameters + 2))
    covariance[-1, -1] = 300.0**2
    place = tmp_path_factory.mktemp("effect")
    made = replace(results, diagnosis={"effects": found, "ladder": []}, effect_covariance=covariance)
    save_results(made, place / "model.h5")
    return place


def test_ofrf_of_a_state_that_was_not_measured(with_effect):
    pair = ("--route", "effect", "--responses", "3+Z", "--references", "1+Z", "--frequencies", "12:60:0.5")
    as_found = answer("ofrf", with_effect, *pair)
    same, other = (answer("ofrf", with_effect, *pair, "--set", f"2.stiffness={v}") for v in ("2e4", "5e4"))
    np.testing.assert_allclose(same["data"], as_found["data"])
    ratio = np.array(same["std"]) / np.array(as_found["std"])  # what is set is known, the idle model no better than before
    assert ratio.max() <= 1
    assert 0 < ratio.min() < 0.6
    assert other["changed"] == [{"step": 2, "parameter": "stiffness", "value": 5e4}]
    from operando.structure import Model

    direct = Model(models.results().idle).add("ground_spring@3+Z=stiffness:5e4").frf(np.arange(12, 60.1, 0.5), "3+Z", "1+Z")
    np.testing.assert_allclose(np.array(other["data"]) @ [1, 1j], direct.data, rtol=1e-9)


@pytest.mark.parametrize(
    ("change", "code", "message"),
    [
        ("2.stiffness", 2, "STEP.NAME=VALUE"),
        ("0.stiffness=1", 2, "STEP.NAME=VALUE"),
        ("3.stiffness=1", 1, "no added effect at step 3"),
        ("2.mass=1", 1, "it has stiffness"),
        ("2.stiffness=-5", 1, "cannot be -5 N/m"),
    ],
)
def test_ofrf_refuses_states_that_are_none(with_effect, change, code, message):
    done = call("ofrf", with_effect, "--route", "effect", "--set", change)
    assert done.exit_code == code
    assert message in done.stderr


def test_ofrf_sets_values_of_the_effect_route_alone(with_effect):
    done = call("ofrf", with_effect, "--set", "2.stiffness=1e4")
    assert done.exit_code == 2
    assert "--route effect" in done.stderr


def test_ofrf_options_of_the_effect_route_follow_the_recommended_route(with_effect, tmp_path):
    from operando.store import load_results

    results = load_results(with_effect)
    better = {"models": {"ofrf": {"error_db": 0.5}, "effect": {"error_db": 0.1}, "idle": {"error_db": 5.0}}}
    save_results(replace(results, comparison=better), tmp_path / "model.h5")
    pair = ("--responses", "3+Z", "--references", "1+Z", "--frequencies", "12:60:0.5")
    for option in (("--set", "2.stiffness=1e4"), ("--level", "20")):
        assert answer("ofrf", tmp_path, *pair, *option)["route"] == "effect"
        done = call("ofrf", tmp_path, *pair, *option, "--route", "hybrid")
        assert done.exit_code == 2
        assert f"{option[0]} belongs to --route effect, and this is --route hybrid" in done.stderr


def test_ofrf_of_the_idle_model(with_effect):
    document = answer("ofrf", with_effect, "--route", "idle", "--responses", "3+Z", "--references", "1+Z", "--frequencies", "12:60:0.5")
    direct = models.results().idle.frf(np.arange(12, 60.1, 0.5), "3+Z", "1+Z")
    np.testing.assert_allclose(np.array(document["data"]) @ [1, 1j], direct.data, rtol=1e-9)


def test_lines():
    np.testing.assert_allclose(parse_lines("5:5:1"), [5])
    lines = parse_lines("0:220:0.1")
    assert lines.size == 2201
    assert lines[-1] == pytest.approx(220)


def test_compare_results_with_a_measurement(folder, tmp_path):
    from operando.io import write_uff

    write_uff(tmp_path / "check.uff", models.measured(running_chain(), "check"))
    document = answer("compare", folder, tmp_path / "check.uff", "-o", tmp_path / "comparison.json")
    assert document["schema"] == "operando/comparison/1"
    assert document["models"]["model"] == document["model"]
    assert document["model"]["error_db"] < 1
    assert [d["dof"] for d in document["model"]["by_dof"]] == ["1+Z", "2+Z", "3+Z", "4+Z"]
    assert len(document["model"]["by_band"]) == 8
    assert document["band_hz"] == [10.0, 90.0]
    assert json.loads((tmp_path / "comparison.json").read_text()) == document
    text = call("compare", folder, tmp_path / "check.uff").stdout
    assert text.startswith("operational FRFs by the hybrid route, 10 to 90 Hz: error")
    narrow = answer("compare", folder, tmp_path / "check.uff", "--band", "20", "60")
    assert narrow["band_hz"] == [20.0, 60.0]
    assert narrow["model"]["n_lines"] < document["model"]["n_lines"]
    for band in (("60", "20"), ("500", "900")):
        done = call("compare", folder, tmp_path / "check.uff", "--band", *band)
        assert done.exit_code == 1
        assert f"{band[0]} " in done.stderr


def test_compare_by_the_other_route(with_effect, folder, tmp_path):
    from operando.io import write_uff
    from operando.structure import Model

    spring = Model(models.results().idle).add("ground_spring@3+Z=stiffness:2e4")
    write_uff(tmp_path / "check.uff", spring.frf(np.arange(12, 88, 0.5), references="1+Z"))
    document = answer("compare", with_effect, tmp_path / "check.uff", "--route", "effect")
    assert document["model"]["error_db"] < 1e-3 < answer("compare", with_effect, tmp_path / "check.uff")["model"]["error_db"]
    assert "ground_spring@3+Z" in document["model_source"]
    done = call("compare", folder, tmp_path / "check.uff", "--route", "effect")
    assert done.exit_code == 1
    assert "no model with accepted effects" in done.stderr
    done = call("compare", tmp_path / "check.uff", tmp_path / "check.uff", "--route", "effect")
    assert done.exit_code == 1
    assert "--route belongs to a results folder" in done.stderr


def test_compare_says_which_route_is_recommended(with_effect, tmp_path):
    from operando.store import load_results

    results = load_results(with_effect)
    better = {"models": {"ofrf": {"error_db": 0.5}, "effect": {"error_db": 0.1}, "idle": {"error_db": 5.0}}}
    save_results(replace(results, comparison=better), tmp_path / "model.h5")
    said = "The results recommend --route effect: idle model + effects: 0.10 dB against 0.50 dB of the hybrid route"
    assert said in call("compare", tmp_path, tmp_path).stdout
    assert said not in call("compare", tmp_path, tmp_path, "--route", "hybrid").stdout


def test_compare_takes_any_model_and_any_measurement(folder, tmp_path):
    from operando.io import write_uff

    chain = running_chain()
    write_uff(tmp_path / "frf.uff", models.measured(chain, "frf", "mobility", references=(0, 1), noise=0.0))
    write_uff(tmp_path / "record.uff", record(chain, [0], 5.0, 11, "record"))
    # FRFs of a file against the same FRFs: no error
    same = answer("compare", tmp_path / "frf.uff", tmp_path / "frf.uff")
    assert same["model"]["error_db"] == pytest.approx(0, abs=1e-9)
    # exact FRFs of another factor: 20·log10(2)
    from dataclasses import replace

    frf = models.measured(chain, "twice", noise=0.0)
    write_uff(tmp_path / "twice.uff", replace(frf, data=2 * frf.data))
    assert answer("compare", tmp_path / "twice.uff", tmp_path / "frf.uff")["model"]["error_db"] == pytest.approx(20 * np.log10(2), rel=1e-6)
    # records with force are estimated; results judge themselves by their own check runs
    assert answer("compare", folder, tmp_path / "record.uff")["model"]["error_db"] < 1
    assert answer("compare", folder, folder)["model"]["error_db"] < 1


def test_compare_refusals(folder, tmp_path):
    from operando.io import write_uff

    write_uff(tmp_path / "geometry.uff", models.results().geometry)
    done = call("compare", folder, tmp_path / "geometry.uff", "--json")
    assert done.exit_code == 1
    assert "no FRFs and no record" in json.loads(done.stdout)["error"]
    done = call("compare", tmp_path / "geometry.uff", folder)
    assert done.exit_code == 1
    assert "nothing that predicts FRFs" in done.stderr


def test_compare_of_two_structures_is_refused_and_of_some_sensors_told_first(folder, tmp_path):
    from operando.io import write_uff

    frf = models.measured(running_chain(), "check")
    other = [f"{n}+Z" for n in (101, 102, 103)]
    write_uff(tmp_path / "other.uff", replace(frf, responses=(*frf.responses[:1], *other)))
    done = call("compare", folder, tmp_path / "other.uff")
    assert done.exit_code == 1
    assert "1 sensor of 4 measured and 4 in the model are in both (1+Z): too few to compare" in " ".join(done.stderr.split())
    write_uff(tmp_path / "half.uff", replace(frf, responses=(*frf.responses[:2], *other[:2])))
    done = call("compare", folder, tmp_path / "half.uff")
    assert done.exit_code == 0
    assert done.stdout.startswith(
        "Warning: 2 sensors of 4 measured and 4 in the model are in both (1+Z, 2+Z); the figures are of these alone"
    )


def test_inspect_of_a_file_without_measurement_says_what_is_read(tmp_path):
    (tmp_path / "summary.json").write_text('{"a": [1, 2]}')
    done = call("inspect", tmp_path / "summary.json")
    assert done.exit_code == 1
    assert "holds no measurement" in done.stderr
    assert "UFF" in done.stderr


def test_report_is_rebuilt(folder):
    document = answer("report", folder)
    assert document["bytes"] > 10_000
    assert (folder / "report.html").read_text(encoding="utf-8").startswith("<!DOCTYPE html>")


def test_convert_says_what_it_wrote(tmp_path):
    from operando.io import write_uff

    write_uff(tmp_path / "record.uff", record(running_chain(), [0], 5.0, 11, "record"))
    document = answer("convert", tmp_path / "record.uff", tmp_path / "record.h5")
    assert document["format_out"] == "hdf5"
    assert read(tmp_path / "record.h5").records[0].n_samples == read(tmp_path / "record.uff").records[0].n_samples


def test_inspect_takes_the_unit_of_coordinates_from_the_test_file(tmp_path):
    from operando.io import write_uff

    write_uff(tmp_path / "idle.uff", models.measured(running_chain(), "idle"))
    write_uff(tmp_path / "all.uff", models.results().geometry)
    sets = (tmp_path / "all.uff").read_text().split("    -1\n    -1\n")
    bare = [s if s.endswith("    -1\n") else s + "    -1\n" for s in sets if "   164\n" not in s]  # nodes without a unit
    (tmp_path / "geometry.uff").write_text("".join(s if s.startswith("    -1\n") else "    -1\n" + s for s in bare))
    text = '[idle]\nfrfs = ["idle.uff"]\n[geometry]\nfile = "geometry.uff"\n'
    for more, unclear in (("", True), ('units = "mm"\n', False)):
        (tmp_path / "test.toml").write_text(text + more)
        said = call("inspect", tmp_path / "test.toml")
        assert said.exit_code == 0, said.output
        assert ("in which unit its coordinates are" in said.stdout) == unclear


def test_inspect_tells_damage_first_and_advises_nothing_from_it(tmp_path):
    """A force set whose header declares more than it holds, or whose first separator is broken; FRFs cut short."""
    from operando import Frf
    from operando.io import read_uff_sets, write_uff

    measured = record(running_chain(), [0], 5.0, 11, "record")
    write_uff(tmp_path / "record.uff", measured.select([*measured.force_indices, *measured.response_indices]))
    whole = (tmp_path / "record.uff").read_bytes()
    assert "damaged" not in call("inspect", tmp_path / "record.uff").stdout
    start = next(raw.start for raw, _ in read_uff_sets(tmp_path / "record.uff") if raw.number == 58)
    size = f"{measured.n_samples:10d}".encode()
    assert size in whole[start:]
    more = whole[:start] + whole[start:].replace(size, f"{measured.n_samples + 1:10d}".encode(), 1)
    broken = whole[:start] + whole[start:].replace(b"-1", b"x1", 1)
    write_uff(tmp_path / "frf.uff", Frf([[range(1, 99)], [range(1, 99)]], range(5, 103), ["2+Z", "1+Z"], "1+Z"))
    short = (tmp_path / "frf.uff").read_bytes()[:-300]
    words = {"1 of 6 sets not used: set 1": more, "belong to no set": broken, "not used: set 2 (frequency response": short}
    for told, raw in words.items():
        (tmp_path / "damaged.uff").write_bytes(raw)
        done = call("inspect", tmp_path / "damaged.uff")
        assert done.exit_code == 0, done.output
        lines = done.stdout.splitlines()
        assert lines[1].startswith("  damaged  ")
        assert told in lines[1]
        assert done.stdout.count(told) == 1
        for advice in ("no force channel", "no drive point", "no response", "no coherence"):
            assert advice not in done.stdout
        assert "they may be in the damaged part" in done.stdout
        entry = answer("inspect", tmp_path / "damaged.uff")["files"][0]
        assert told in entry["damage"][0]
        assert any(f["severity"] == "error" for f in entry["findings"])


def test_inspect_says_what_is_there(tmp_path):
    from operando.io import write_uff

    write_uff(tmp_path / "record.uff", record(running_chain(), [0], 5.0, 11, "record"))
    (tmp_path / "broken.uff").write_bytes(b"\0\1\2")
    document = answer("inspect", tmp_path / "record.uff", tmp_path / "broken.uff")
    assert document["schema"] == "operando/inspect/1"
    assert document["files"][1]["error"] is not None
    text = call("inspect", tmp_path / "record.uff").stdout
    assert "1 force and 4 response channels" in text
    assert "4+Z  acceleration  m/s2" in text
    done = call("inspect", tmp_path / "broken.uff", "--json")
    assert done.exit_code == 1
    assert json.loads(done.stdout)["schema"] == "operando/error/1"

"""Parts of the pipeline: levels of check runs, FRFs of several files, excluded bands, atomic files."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import models
from measurements import record, running_chain
from operando.atomic import write_json
from operando.config import Analysis, State, Test
from operando.data import Finding, ModalModel, Provenance, force_rms, level_groups
from operando.errors import DataError, WriteError
from operando.frf import merge_frfs
from operando.io import write_uff
from operando.pipeline import run
from operando.pipeline.folder import key_of
from operando.pipeline.inputs import Inputs
from operando.pipeline.levels import check_frfs
from operando.pipeline.stages import Work, runs_behind
from operando.pipeline.stages.compare import comparison
from operando.pipeline.stages.oma import operational_modes
from operando.results import Results


def runs(*levels_and_masses):
    return [record(running_chain(), [m], level, i, f"run{i}", seconds=2.0) for i, (level, m) in enumerate(levels_and_masses)]


def test_levels_of_each_reference_are_ranked_and_joined():
    records = runs((8.0, 0), (2.0, 0), (3.0, 2), (12.0, 2), (2.1, 0))
    groups = level_groups(records)
    assert [[r.name for r in g] for g in groups] == [["run1", "run4", "run2"], ["run0", "run3"]]
    assert force_rms(records[0]) == pytest.approx(4 * force_rms(records[1]), rel=0.2)


def test_one_check_where_levels_agree_else_one_a_level_lowest_first():
    records = runs((8.0, 0), (2.0, 0), (8.0, 2), (2.0, 2))
    frf = models.measured(running_chain())
    finding = Finding("nonlinear", "levels differ")

    def linear(part):
        return replace(frf, name=str(len(part)))

    def nonlinear(part):
        return replace(linear(part), findings=(finding,) if len(part) == 4 else ())

    together = check_frfs(records, linear)
    assert [(run.frf.name, run.levels_agree) for run in together] == [("4", True)]
    apart = check_frfs(records, nonlinear)
    assert [run.frf.name for run in apart] == ["2", "2"]
    assert [run.name for run in apart] == ["run1, run3", "run0, run2"]
    assert [run.force_n for run in apart] == [min(force_rms(records[i]) for i in pair) for pair in ((1, 3), (0, 2))]
    assert apart[0].frf.findings == (finding,)
    # the lowest level judges
    from operando.compare import compare_all

    assert compare_all({"idle": models.idle_model()}, apart)["judged_on"]["level"] == apart[0].force_n


def test_frfs_of_several_files_become_one_matrix():
    first, second = models.measured(running_chain(), references=(0,)), models.measured(running_chain(), references=(2,))
    turned = replace(second, data=-second.data[:3], responses=tuple(d.opposite for d in second.responses[:3]), variance=second.variance[:3])
    made = merge_frfs([first, turned.to_quantity("mobility")])
    assert [str(d) for d in made.references] == ["1+Z", "3+Z"]
    assert made.quantity == "accelerance"
    np.testing.assert_allclose(made.data[:3, 1], second.data[:3, 0], rtol=1e-12)
    assert np.isnan(made.data[3, 1]).all()
    assert [(f.kind, f.message[:50]) for f in made.findings] == [("missing_pair", "1 of 8 response/reference pairs were not measured ")]
    twice = merge_frfs([first, replace(first, data=2 * first.data)])
    np.testing.assert_array_equal(twice.data, first.data)
    assert [(f.kind, f.severity) for f in twice.findings] == [("duplicate_pair", "warning")]
    assert "differ by up to 63 % of |H|" in twice.findings[0].message  # |2H − H| over the rms of the two
    with pytest.raises(DataError, match="different lines"):
        merge_frfs([first, models.measured(running_chain(), step=0.5)])


def test_pairs_given_twice_are_averaged_where_they_agree():
    frf = models.measured(running_chain(), references=(0,))
    rng = np.random.default_rng(0)

    def again(name, factor=1.0, noise=1.0):
        """Another measurement of the same pairs, with noise of its own."""
        variance = noise * frf.variance
        error = np.sqrt(variance / 2) * (rng.normal(size=frf.data.shape) + 1j * rng.normal(size=frf.data.shape))
        return replace(frf, data=factor * frf.data + error, variance=variance, name=name)

    first, second = again("a"), again("b", noise=3.0)
    made = merge_frfs([first, second])
    np.testing.assert_allclose(made.data, 0.75 * first.data + 0.25 * second.data, rtol=1e-9)
    np.testing.assert_allclose(made.variance, 0.75 * frf.variance, rtol=1e-9)
    assert [(f.kind, f.severity) for f in made.findings] == [("duplicate_pair", "info")]
    assert (made.name, merge_frfs([first, again("a")]).name) == ("", "a")
    wrong = merge_frfs([first, again("c", factor=1.1)])
    np.testing.assert_array_equal(wrong.data, first.data)
    [finding] = wrong.findings
    assert finding.file == "c"
    assert "differ by up to 9.5 % of |H|" in finding.message  # 0.1 over the rms of 1 and 1.1
    bare = merge_frfs([first, replace(second, variance=None)])  # nothing to judge by: the first one
    np.testing.assert_array_equal(bare.data, first.data)


def test_excluded_bands_are_cut_out():
    frf = models.measured(running_chain())
    cut = frf.without_bands([(20.0, 30.0), (50.0, 50.2)])
    lines = cut.frequencies_hz
    assert not np.any((lines >= 20) & (lines <= 30))
    assert 50.0 not in lines
    assert cut.variance.shape == cut.data.shape
    np.testing.assert_array_equal(cut.data[:, :, -1], frf.data[:, :, -1])
    assert frf.without_bands([]) is frf


def test_runs_set_aside_do_not_come_back():
    records = [replace(r, provenance=Provenance(((r.name, "hash"),))) for r in runs((8.0, 0), (2.0, 0))]
    frf = replace(models.measured(running_chain()), provenance=Provenance((("run1", "hash"),)))
    assert runs_behind(frf, records) == [records[1]]
    assert runs_behind(replace(frf, provenance=Provenance()), records) == records


def test_settings_without_effect_are_said(monkeypatch):
    monkeypatch.setattr("operando.oma.fit_oma", lambda records, **settings: settings)
    test = Test("pump", analysis=Analysis(exclude_bands=((20.0, 30.0),)))
    inputs = SimpleNamespace(records=lambda state, force: [])
    [finding] = operational_modes(Work(test, inputs, Results("pump")))["findings"]
    assert (finding.kind, "exclude_bands" in finding.message) == ("setting_unused", True)


def test_records_beyond_the_memory_limit_are_read_again(tmp_path, monkeypatch):
    from operando.io import write_uff

    for name, item in zip("ab", runs((8.0, 0), (2.0, 0)), strict=True):
        write_uff(tmp_path / f"{name}.uff", item)
    monkeypatch.setattr("operando.pipeline.inputs.KEEP_BYTES", 0)
    inputs = Inputs(Test("t", idle=State(records=(tmp_path / "a.uff", tmp_path / "b.uff"))))
    first = inputs.records(inputs.test.idle, force=True)
    again = inputs.records(inputs.test.idle, force=True)
    assert [r.name for r in first] == ["a.uff", "b.uff"]
    assert again[0] is not first[0]
    np.testing.assert_array_equal(again[0].data, first[0].data)


def test_keys_depend_on_order_and_content():
    assert key_of("a", {"x": 1, "y": 2}) == key_of("a", {"y": 2, "x": 1})
    assert len({key_of("a", 1), key_of("a", 2), key_of("b", 1), key_of("a", [1]), key_of("a", None)}) == 5


def test_json_has_null_where_there_is_no_value(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"x": float("nan"), "y": np.array([1.0, np.inf]), "z": 1 + 2j, "n": np.int64(3), "b": np.bool_(True)})
    assert json.loads(path.read_text()) == {"x": None, "y": [1.0, None], "z": [1.0, 2.0], "n": 3, "b": True}


@pytest.mark.skipif(os.name == "nt", reason="Windows has no pipes among the files")
def test_a_file_takes_the_name_of_no_pipe_or_device_and_a_link_stays(tmp_path):
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("folder/a.json")
    with pytest.raises(WriteError, match="is a device or a pipe, expected a file"):
        write_json(tmp_path / "pipe", {})
    assert (tmp_path / "pipe").is_fifo()
    write_json(tmp_path / "link", {"x": 1})
    assert (tmp_path / "link").is_symlink()
    assert json.loads((tmp_path / "folder/a.json").read_text()) == {"x": 1}


def test_what_depends_on_unread_files_is_not_run_and_only_the_cause_is_stated(tmp_path):
    """Files that the first stage finds unreadable fail once; states that are there are still analysed."""
    (tmp_path / "broken.uff").write_text("no data")
    write_uff(tmp_path / "running.uff", models.measured(running_chain(), step=0.5))
    (tmp_path / "test.toml").write_text('[idle]\nrecords = ["broken.uff"]\n[check]\nfrfs = ["running.uff"]\n')
    results = run(tmp_path / "test.toml", tmp_path / "out", until="compare", report=False)
    [failed] = [f.message for f in results.findings if f.kind == "stage_failed"]
    assert failed.startswith("stage inspect: no file of [idle] can be read")
    assert results.left_out["frf"] == "not run because no file of [idle] can be read"
    assert results.left_out["ema"] == "it needs the idle FRFs"
    assert len(results.check) == 1


def test_what_two_validation_runs_say_unlike_names_its_level():
    from operando.pipeline.stages.check import of_check
    from operando.results import CheckRun

    frf = models.measured(running_chain())
    said = lambda percent: Finding("not_reciprocal", f"H differ by {percent} %", "warning", dof="1+Z,2+Z")  # noqa: E731
    own = Finding("overload", "1+Z is cut", "warning", file="a.uff")
    runs = [
        CheckRun("a", "5 N rms", replace(frf, findings=(said(19), own))),
        CheckRun("b", "20 N rms", replace(frf, findings=(said(21), own))),
    ]
    told = [[f.message for f in run.frf.findings] for run in of_check(runs)]
    assert told[0] == ["validation measurement at 5 N rms: H differ by 19 %", "validation measurement: 1+Z is cut"]
    assert told[1][0] == "validation measurement at 20 N rms: H differ by 21 %"
    assert of_check(runs[:1])[0].frf.findings[0].message == "validation measurement: H differ by 19 %"
    given = [replace(run, level="as given") for run in runs]
    assert of_check(given)[0].frf.findings[0].message.startswith("validation measurement a: ")


@pytest.mark.parametrize(("dofs", "compared"), [("3+Z", False), ("1-Z", True)])
def test_a_model_without_a_measured_pair_does_not_stop_the_comparison(dofs, compared):
    """Such as OFRFs of one sensor that is left of a damaged operating record."""
    found = models.results()
    whole = found.hybrid.modal
    (row,) = whole.rows(dofs)
    one = ModalModel(whole.frequencies_hz, whole.damping_ratios, row[None], dofs, "unit_modal_mass", band_hz=whole.band_hz)
    found.hybrid = SimpleNamespace(modal=one, alternative_models={})
    work = SimpleNamespace(results=found, analysis=SimpleNamespace(band=None, exclude_bands=()))
    made = comparison(work)
    assert list(made["comparison"]["models"]) == ["idle", "ofrf"][: 1 + compared]
    told = [f.message for f in made["findings"] if f.kind == "baseline_failed"]
    assert ("ofrf holds no response–reference pair of the validation measurement (its DOFs: 3+Z)" in told) is not compared

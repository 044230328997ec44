"""Level-dependent effects added and taken away by hand, from records; and from the command line on a results folder."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from functools import cache

import pytest
from click.testing import CliRunner

from operando.cli import main
from operando.compare import compare_all
from operando.data.levels import force_rms
from operando.diagnosis import apply_to_records
from operando.diagnosis.at_level import following
from operando.diagnosis.stored import effect_model
from operando.errors import ConfigError, IdentificationError, MissingError
from operando.frf import estimate_frf
from operando.io import read, write_uff
from operando.pipeline.by_hand import check_records
from operando.results import CheckRun, Results
from operando.store import load_results, save_results
from operando.structure.effects import parse_effect
from test_diagnose_records import BAND, frfs
from test_nonlinear_records import STRIP, records


@cache
def applied(name, *texts, **how):
    return apply_to_records(STRIP.idle(), [parse_effect(t, BAND) for t in texts], records()[name], **how)


def test_the_right_effect_is_sized_and_the_error_falls():
    made = applied("cubic", "cubic_stiffness@3+Z")
    assert made.effects[0].values["coefficient"] == pytest.approx(1e8, rel=0.02)
    assert made.effects[0].std["coefficient"] > 0
    before, after = made.ladder
    assert after["heldout_misfit"] < 0.01 * before["heldout_misfit"]
    assert made.better == ()
    assert made.picture["restoring_force"][0]["goodness"] > 0.95
    assert made.simulation["gain_db"] > 8


def test_the_wrong_effect_is_told_from_a_better_one():
    made = apply_to_records(STRIP.idle(), [parse_effect("clearance@6+Z", BAND)], records()["cubic"])
    assert made.ladder[1]["heldout_misfit"] > 0.2 * made.ladder[0]["heldout_misfit"]
    ((step, better, _),) = made.better
    assert (step, better.kind, [str(d) for d in better.location]) == (1, "cubic_stiffness", ["3+Z"])
    assert any("the data speak for another one: cubic_stiffness" in w for w in made.words)


def test_values_that_are_held_stay():
    made = applied("cubic", "cubic_stiffness@3+Z=coefficient:7e7", refit=False)
    assert made.effects[0].values["coefficient"] == 7e7
    right = applied("cubic", "cubic_stiffness@3+Z")
    assert made.ladder[1]["misfit"] > 2 * right.ladder[1]["misfit"]
    partly = replace(parse_effect("clearance@5+Z=stiffness:6e3,gap:1e-3", BAND), fixed=("gap",))
    with pytest.raises(ConfigError, match="all of its values or none"):
        apply_to_records(STRIP.idle(), [partly], records()["clearance"])


def test_a_fit_that_fails_is_refused(monkeypatch):
    """As on FRFs: what leaves more of the fitted lines than the model without the effect is no fit."""
    monkeypatch.setattr("operando.diagnosis.records.apply.fit_law", lambda fit, kind: None)
    far = "cubic_stiffness@3+Z=coefficient:2e9"
    with pytest.raises(IdentificationError, match="the refit failed: with cubic_stiffness it leaves") as refused:
        applied("cubic", far)
    assert "--fix" in refused.value.hint
    monkeypatch.setattr("operando.diagnosis.applied.FAILED", 1e12)
    assert applied("cubic", far).effects[0].values["coefficient"] == 2e9


def test_a_needless_spring_beside_it_earns_nothing():
    made = applied("cubic", "cubic_stiffness@3+Z", "ground_spring@7+Z")
    assert made.effects[0].values["coefficient"] == pytest.approx(1e8, rel=0.03)
    assert made.ladder[2]["heldout_misfit"] > 0.8 * made.ladder[1]["heldout_misfit"]


def test_what_has_no_force_in_time_is_refused():
    with pytest.raises(ConfigError, match="restoring force"):
        applied("cubic", "point_mass@3+Z")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A results folder whose check came from raw files, with what `operando run` would have found in it."""
    from operando.diagnosis import diagnose

    tmp_path = tmp_path_factory.mktemp("strip")
    files = []
    for i, record in enumerate(records()["cubic"]):
        files.append(tmp_path / f"run{i}.uff")
        write_uff(files[-1], record)
    again = [read(f).records[0] for f in files]
    check = [CheckRun(r.name, f"{k}", estimate_frf([r], estimator="lrm")) for k, r in enumerate(again)]
    found = diagnose(STRIP.idle(), check=list(frfs("cubic")), records=again, band=BAND, kinds=["cubic_stiffness"], places=["3+Z", "5+Z"])
    results = Results(
        "a strip", {"band": list(BAND)}, idle=STRIP.idle(), check=check, idle_frf=check[0].frf, diagnosis=found.to_dict(),
    )  # fmt: skip
    save_results(results, tmp_path / "model.h5")
    return tmp_path


@pytest.fixture
def folder(made, tmp_path):
    """A copy of it to change."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True, copy_function=shutil.copy2)
    return tmp_path


def asked(*arguments):
    done = CliRunner().invoke(main, [*map(str, arguments), "--json"])
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def test_from_the_command_line(folder, monkeypatch):
    stored = load_results(folder).diagnosis
    assert [e["kind"] for e in stored["effects"]] == ["cubic_stiffness"]
    levels = stored["picture"]["levels"]
    assert [c["measured"] for c in levels["curves"]] == [True, True, False]
    assert levels["curves"][2]["force_n"] == pytest.approx(2 * levels["curves"][1]["force_n"])
    # Taken back: the idle model; another one in its place: the tool says what would do better.
    with monkeypatch.context() as patch:  # the last report is looked at
        patch.setattr("operando.report.write_report", lambda results, path: path.write_text(results.name, encoding="utf-8"))
        assert [row["step"] for row in asked("remove", folder, 1)["ladder"]] == [0]
        wrong = asked("add", folder, "clearance@6+Z")
        assert wrong["ladder"][1]["heldout_misfit"] > 0.2 * wrong["ladder"][0]["heldout_misfit"]
        assert any("cubic_stiffness" in w for w in wrong["words"])
        asked("remove", folder, 1)
    right = asked("add", folder, "cubic_stiffness@3+Z")
    assert right["effects"][0]["parameters"]["coefficient"]["value"] == pytest.approx(1e8, rel=0.02)
    assert right["ladder"][1]["heldout_misfit"] < 0.01 * right["ladder"][0]["heldout_misfit"]
    assert load_results(folder).diagnosis["picture"]["levels"]["curves"]
    assert (folder / "ofrf_effect.uff").is_file()
    assert "cubic stiffness" in (folder / "report.html").read_text()
    # What happens at another level.
    low, high = (
        asked("ofrf", folder, "--route", "effect", "--level", n, "--responses", "3+Z", "--references", "2+Z", "--frequencies", "5:90:0.5")
        for n in (1, 20)
    )
    assert low["level_n"] == 1
    peak = lambda d: max(range(len(d["frequencies_hz"])), key=lambda i: abs(complex(*d["data"][0][0][i])))  # noqa: E731
    assert high["frequencies_hz"][peak(high)] != low["frequencies_hz"][peak(low)]


@pytest.fixture
def gone(made):
    """One of the records is not where the results were made from it."""
    record = (made / "run1.uff").rename(made / "aside.uff")
    yield
    record.rename(made / "run1.uff")


def test_a_record_that_is_gone_is_named(folder, gone):
    done = CliRunner().invoke(main, ["add", str(folder), "clearance@6+Z", "--json"])
    assert done.exit_code == 1
    assert "run1.uff" in json.loads(done.stdout)["where"]
    with pytest.raises(MissingError, match="not there"):
        check_records(str(folder), load_results(folder))


def test_a_level_dependent_effect_is_compared_at_the_level_of_the_measurement(folder):
    forces = [min(force_rms(r) for r in read(folder / f"run{k}.uff").records) for k in range(4)]
    for k, other in ((0, 2), (2, 0)):
        own = asked("compare", folder, folder / f"run{k}.uff", "--route", "effect")["model"]
        far = asked("compare", folder, folder / f"run{k}.uff", "--route", "effect", "--level", forces[other])["model"]
        assert f"level-dependent effects are linearised under {forces[k]:.4g} N rms, for each reference by itself" in own["notes"]
        assert own["error_db"] < 0.7 * far["error_db"]
    pair = ("--responses", "3+Z", "--references", "2+Z", "--frequencies", "5:90:0.5", "--route", "effect")
    lowest, softer = asked("ofrf", folder, *pair), asked("ofrf", folder, *pair, "--set", "1.coefficient=1")
    assert lowest["level_n"] == pytest.approx(min(forces), rel=0.02)
    assert softer["data"] != lowest["data"]
    assert "coefficient:1" in softer["method"]


def test_by_run_takes_the_effect_at_the_level_of_each_run(folder):
    results = load_results(folder)
    runs = [replace(run, force_n=force_rms(read(folder / run.name).records[0])) for run in results.check]
    model = following(effect_model(results), results.diagnosis, BAND)
    both = compare_all({"effect": model}, runs, BAND)["by_run"]
    standing = compare_all({"effect": model.standing}, runs, BAND)["by_run"]
    errors = [[row["models"]["effect"]["error_db"] for row in rows] for rows in (both, standing)]
    assert max(errors[0]) < 0.7 * max(errors[1])
    unknown = compare_all({"effect": model}, [replace(run, force_n=None) for run in runs], BAND)["models"]["effect"]
    assert any("at the lowest level measured" in note and "states no force" in note for note in unknown["notes"])

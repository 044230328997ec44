"""sdypy-EMA and pyOMA-2 beside operando: from objects, the test file and the command line."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

import measurements
import operando
from operando.cli import main
from operando.contrib import LibraryComparison, compare_libraries, library_rows
from operando.ema.second_opinion import DAMPING_TOLERANCE, FREQUENCY_TOLERANCE
from operando.errors import DataError
from operando.oma.pyoma import AGREE_HZ, AGREE_MAC, AGREE_STD
from operando.pipeline import run


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return measurements.write_test(tmp_path_factory.mktemp("t"), check=False)


@pytest.fixture(scope="module")
def made(path, tmp_path_factory):
    """A results folder made without the libraries and then with them, what came of it, and what the second run said."""
    out, said = tmp_path_factory.mktemp("out"), []
    run(path, out, until="oma")
    test = operando.load_test(path).with_analysis(second_opinion=True)
    found = run(test, out, until="oma", report=True, progress=lambda stage, message: said.append(message))
    return out, found, said


@pytest.fixture(scope="module")
def results(made):
    return made[1]


def by_state(results):
    found = [LibraryComparison.from_dict(entry) for entry in results.libraries]
    assert [c.to_dict() for c in found] == results.libraries
    return {c.state: c for c in found}


def test_both_libraries_find_the_modes_of_the_chain(results):
    truth = {"idle": measurements.idle_chain().hz, "operating": measurements.running_chain().hz}
    for state, compared in by_state(results).items():
        assert compared.library.startswith({"idle": "sdypy-EMA", "operating": "pyOMA-2"}[state])
        own = [m for m in compared.modes if m.frequency_hz is not None]
        assert len(own) == 4
        for mode, hz in zip(own, truth[state], strict=True):
            assert mode.other_frequency_hz == pytest.approx(hz, rel=5e-3)
            assert mode.mac > 0.98
        assert compared.seconds > 0
        assert compared.own_seconds > 0
    assert set(by_state(results)) == {"idle", "operating"}


def test_asking_for_the_libraries_makes_no_other_stage_again(path, made, tmp_path):
    out, again, said = made
    assert sum("unchanged" in m for m in said) == 5  # inspect, frf, two of ema, oma
    assert len(again.libraries) == 2
    shutil.copytree(out, tmp_path / "out")
    assert run(path, tmp_path / "out", until="oma").libraries == []


def test_objects_are_fitted_and_timed_here(results):
    frf = results.idle_frf.band(10, 90)
    compared = compare_libraries(frf, band=(10, 90))[0]
    assert compared.own_seconds > 0
    assert [m.frequency_hz for m in compared.modes] == pytest.approx(results.idle.frequencies_hz, rel=1e-3)
    assert "agrees on" in repr(compared)
    assert f"frequency within {100 * FREQUENCY_TOLERANCE:g} %, damping within {100 * DAMPING_TOLERANCE:g} %" in compared.rule
    in_operation = replace(compared, state="operating").rule
    assert f"{AGREE_STD:g} standard deviations or {100 * AGREE_HZ:g} %, MAC {AGREE_MAC:g} at least" in in_operation
    assert compared._repr_html_().startswith("<table>")
    with pytest.raises(DataError, match="nothing to compare"):
        compare_libraries()


def test_what_cannot_be_compared_is_said(results):
    compared = compare_libraries(results.idle_frf.without_bands([(40, 45)]), idle=results.idle)[0]
    assert compared.modes == ()
    assert "evenly spaced" in compared.note
    told = library_rows([compared.to_dict()], "idle")
    assert told["text"] == f"There is no comparison: {compared.note}."
    assert library_rows([compared.to_dict()], "operating") is None


def test_damping_of_an_exponential_window_is_compared_as_the_frfs_carry_it():
    idle = operando.ModalModel([20.0, 45.0], [0.01, 0.01], np.array([[1.0, 1.0], [1.0, -1.0]]), "1+Z, 2+Z", "unit_modal_mass")
    hz = np.arange(5.0, 80.0, 0.05)
    mode = compare_libraries(idle.frf(hz, references="1+Z"), idle=idle)[0].modes[1]
    assert mode.other_damping_ratio == pytest.approx(0.01, rel=1e-2)
    assert mode.reference == "1+Z"
    assert mode.agrees


def test_report_has_the_tables(results, tmp_path):
    from operando.report import write_report

    write_report(results, tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    for c in by_state(results).values():
        assert c.library in text
        assert c.method in text


def test_command(path, made, tmp_path):
    shutil.copytree(made[0], tmp_path / "out")
    done = CliRunner().invoke(main, ["compare-libraries", str(path), "-o", str(tmp_path / "out"), "--json"])
    assert done.exit_code == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["schema"] == "operando/libraries/1"
    assert [c["state"] for c in document["libraries"]] == ["idle", "operating"]
    done = CliRunner().invoke(main, ["compare-libraries", str(path), "-o", str(tmp_path)])
    assert done.stdout.startswith("chain: sdypy-EMA")
    assert "MAC" in done.stdout
    assert "time: pyOMA-2" in done.stdout
    assert (tmp_path / "report.html").exists()
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert [c["library"].split()[0] for c in summary["libraries"]] == ["sdypy-EMA", "pyOMA-2"]

"""Tables of comparisons and hybrid models, figures of results that were loaded, and what a file does not keep."""

from __future__ import annotations

import numpy as np
import pytest

import operando
from operando.errors import DataError, MissingError

SHAPES = np.array([[1.0, 1.0], [1.0, -1.0]])
STD = {"frequencies_hz": np.array([0.01, 0.02]), "damping_ratios": np.array([1e-4, 2e-4])}
IDLE = operando.ModalModel([20.0, 45.0], [0.01, 0.02], SHAPES, "1+Z, 2+Z", "unit_modal_mass", std=STD, band_hz=(5.0, 60.0), misfit=1.1)
OPERATING = operando.ModalModel([21.0, 45.0], [0.01, 0.02], 2 * SHAPES, "1+Z, 2+Z")
STEPS = [{"step": 0, "added": None, "heldout_error_db": 8.8}]
ERRORS = {"by_dof": [{"dof": "1+Z", "error_db": 4.0}, {"dof": "2+Z", "error_db": 8.0}], "error_db": 6.0, "noise_floor_db": 0.1}


def test_a_table_of_two_models_states_standard_deviations():
    pytest.importorskip("pandas")
    table = operando.compare(IDLE, OPERATING).to_dataframe()
    assert table["frequency_std_hz_first"].tolist() == [0.01, 0.02]
    assert table["damping_ratio_std_first"].tolist() == [1e-4, 2e-4]
    assert table["frequency_std_hz_second"].isna().all()


def test_a_comparison_is_a_table():
    pytest.importorskip("pandas")
    found = operando.compare(IDLE, IDLE.frf(np.arange(10, 60, 0.1), references="1+Z", variance=False))
    assert found.to_dataframe()["dof"].tolist() == ["1+Z", "2+Z"]
    assert len(found.to_dataframe("band")) == 8
    assert found.to_dataframe("mode").attrs["n_lines"] == found.n_lines
    with pytest.raises(DataError, match="errors by 'line' are not known"):
        found.to_dataframe("line")


def test_a_hybrid_model_is_a_table():
    pytest.importorskip("pandas")
    table = operando.scale_operational(IDLE, OPERATING).to_dataframe()
    assert table[["idle_mode", "class"]].values.tolist() == [[0, "unchanged"], [1, "unchanged"]]
    assert table["frequency_hz"].tolist() == [21.0, 45.0]


def test_results_draw_their_diagnosis_and_comparison():
    results = operando.Results(
        "pump", diagnosis={"verdict": "partial", "ladder": STEPS, "where": ERRORS}, comparison={"models": {"idle": ERRORS}}
    )
    assert [t.get_text() for t in results.plot_ladder().get_xticklabels()] == ["idle model"]
    for axes in (results.plot_where(), results.plot_comparison("idle")):
        assert [float(bar.get_height()) for bar in axes.patches] == [4.0, 8.0]
    with pytest.raises(MissingError, match="the comparison has no model 'ofrf'") as raised:
        results.plot_comparison()
    assert raised.value.hint == "it has idle"
    empty = operando.Results("pump", left_out={"diagnose": "no idle modes"})
    with pytest.raises(MissingError, match="the results hold no diagnosis") as raised:
        empty.plot_where()
    assert raised.value.hint == "no idle modes"


def test_what_a_file_does_not_keep_is_said_at_the_line_that_saves(tmp_path):
    with pytest.warns(UserWarning, match="lost in x.uff") as said:
        IDLE.save(tmp_path / "x.uff")
    assert {w.filename for w in said} == {__file__}
    texts = [str(w.message) for w in said]
    assert "lost in x.uff: band of the analysis, 5 to 60 Hz" in texts
    assert "lost in x.uff: reduced chi-square, 1.1" in texts

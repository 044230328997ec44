"""Figures of diagnoses from records that need no results folder."""

from __future__ import annotations

import numpy as np

from operando.report.figures_records import frf_figure


def test_frfs_at_several_levels_are_drawn_with_what_was_measured():
    hz = np.linspace(5, 50, 40)
    curve = lambda f, measured: {"force_n": f, "measured": measured, "magnitude": (1 + f / hz).tolist()}  # noqa: E731
    levels = {
        "response": "3+Z",
        "reference": "2+Z",
        "frequencies_hz": hz.tolist(),
        "curves": [curve(2.5, True), curve(10.0, True), curve(20.0, False)],
        "runs": [
            {
                "name": "low",
                "level": 2.5,
                "unit": "N",
                "level_name": "2.50 N rms",
                "frequencies_hz": hz.tolist(),
                "magnitude": (1 + 2 / hz).tolist(),
            }
        ],
    }
    drawn = frf_figure(levels)
    assert drawn.startswith("<svg")
    for words in ("measured, 2.50 N rms", "model, 10.0 N", "model, not measured, 20.0 N", "3+Z under a force at 2+Z"):
        assert words in drawn
    one = levels | {"curves": levels["curves"][1:], "runs": []}
    assert "not measured, 20.0 N" in frf_figure(one)

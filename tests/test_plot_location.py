"""The picture of the machine with the effects of a diagnosis marked at their locations."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

import operando
from operando.plots.location import marks

PLATE = operando.Geometry((1, 2, 3, 4), np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), (), ((1, 2, 3, 4),))
SPRING = {"kind": "ground_spring", "location": ["2+Z"]}
BETWEEN = {"kind": "point_mass", "location": [], "position": [0.5, 0.5, 0.0], "direction": "+X"}


@pytest.fixture(autouse=True)
def no_figure_stays_open():
    yield
    plt.close("all")


def test_marks_lie_at_nodes_and_positions_and_point_along_the_dof():
    (pair,) = marks([{"kind": "coupling_spring", "location": ["1-X", "3+Y"]}], PLATE)
    assert pair.name == "coupling spring at 1-X and 3+Y"
    assert pair.points.tolist() == [[0, 0, 0], [1, 1, 0]]
    assert pair.directions.tolist() == [[-1, 0, 0], [0, 1, 0]]
    (free,) = marks([BETWEEN], PLATE)
    assert (free.points.tolist(), free.directions.tolist()) == ([[0.5, 0.5, 0.0]], [[1, 0, 0]])


def test_what_has_no_location_on_the_geometry_is_not_marked():
    assert marks([{"kind": "global_stiffness", "location": []}, {"kind": "point_mass", "location": ["77+Z"]}], PLATE) == []
    with pytest.raises(operando.errors.DataError, match="no effect of the diagnosis has a location"):
        operando.plots.plot_location({"effects": []}, PLATE)
    with pytest.raises(operando.errors.ObjectError, match="no geometry"):
        operando.plots.plot_location({"effects": [SPRING]}, None)


def test_found_and_not_excluded_locations_are_told_apart():
    axes = operando.plots.plot_location({"effects": [SPRING], "ambiguous_with": [BETWEEN]}, PLATE)
    words = {t.get_text() for t in axes.get_legend().get_texts()}
    assert words == {"ground spring at 2+Z", "not excluded: point mass at (0.5, 0.5, 0) m"}


def test_flat_axes_are_refused():
    with pytest.raises(operando.errors.ObjectError, match="flat axes"):
        operando.plots.plot_location({"effects": [SPRING]}, PLATE, plt.figure().add_subplot())

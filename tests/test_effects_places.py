"""Places of effects in modal coordinates, and shapes between sensors."""

from __future__ import annotations

import numpy as np
import pytest

from operando.data import Geometry, ModalModel
from operando.errors import DataError, DofError
from operando.structure.effects import parse_effect, place_weights, position_weights, spline_weights


def beam(n=11, modes=4):
    """Pinned beam along x, sensors +Z except one in the other sense."""
    x = np.linspace(0.05, 0.95, n)
    shapes = np.sin(np.pi * np.outer(x, np.arange(1, modes + 1)))
    dofs = [f"{i + 1}+Z" for i in range(n)]
    dofs[3] = "4-Z"
    shapes[3] *= -1
    idle = ModalModel(np.arange(1, modes + 1) ** 2 * 10.0, np.full(modes, 0.01), shapes, dofs, "unit_modal_mass")
    return idle, Geometry(tuple(range(1, n + 1)), np.c_[x, np.zeros(n), np.zeros(n)])


def test_weights_follow_senses_and_differences():
    idle, _ = beam()
    spring = place_weights(parse_effect("coupling_spring@1+Z,4+Z"), idle)
    assert spring.shape == (1, 11)
    assert spring[0, 0] == 1
    assert spring[0, 3] == 1  # −(4+Z) = +(4−Z)
    pair = place_weights(parse_effect("gyroscopic@1+Z,4+Z"), idle)
    assert pair.shape == (2, 11)
    assert (pair[0, 0], pair[1, 3]) == (1, -1)
    assert np.allclose(place_weights(parse_effect("ground_spring@4+Z"), idle)[0] @ idle.shapes, np.sin(np.pi * 0.32 * np.arange(1, 5)))
    with pytest.raises(DofError):
        place_weights(parse_effect("ground_spring@77+Z"), idle)


def test_a_mass_takes_the_translations_of_its_node_and_an_inertia_the_rotations():
    idle = ModalModel([10.0], [0.01], np.arange(1.0, 6.0)[:, None], ["1+X", "1-Z", "1+RY", "2+Z", "1+Y"], "unit_modal_mass")
    assert place_weights(parse_effect("point_mass@1+Z"), idle).argmax(axis=1).tolist() == [0, 1, 4]
    assert place_weights(parse_effect("point_mass@1+RY"), idle).argmax(axis=1).tolist() == [2]


def test_shapes_between_sensors_follow_the_structure():
    idle, geometry = beam()
    # A spline is straight beyond its ends, which costs accuracy between the last two sensors.
    for place, close in ((0.11, 0.04), (0.363, 0.01), (0.5, 0.01), (0.82, 0.02)):
        found = position_weights(idle, geometry, (place, 0, 0), "+Z") @ idle.shapes
        truth = np.sin(np.pi * place * np.arange(1, 5))
        assert np.max(np.abs(found - truth)) < close
        assert np.allclose(position_weights(idle, geometry, (place, 0, 0), "-Z") @ idle.shapes, -found)


def test_a_sensors_own_place_gives_its_own_shape_and_linear_fields_are_exact():
    rng = np.random.default_rng(0)
    for points in (np.c_[np.arange(6.0), np.zeros(6), np.zeros(6)], np.c_[rng.random((9, 2)), np.zeros(9)], rng.random((9, 3))):
        weights = spline_weights(points, points)
        assert np.allclose(weights, np.eye(len(points)), atol=1e-8)
        target = points.mean(axis=0)[None] + 0.05 * (points[0] - points[1])
        weights = spline_weights(points, target)
        field = points @ [1.0, -2.0, 0.5] + 3
        assert np.allclose(weights @ field, target @ [1.0, -2.0, 0.5] + 3)


def test_places_that_cannot_be_interpolated():
    idle, geometry = beam()
    with pytest.raises(DofError, match="no sensor"):
        position_weights(idle, geometry, (0.3, 0, 0), "+X")
    with pytest.raises(DataError, match="few"):
        spline_weights(np.array([[0.0, 0, 0], [1, 0, 0]]), [[0.5, 0, 0]])
    with pytest.raises(DataError, match="one position"):
        spline_weights(np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [2, 0, 0]]), [[0.5, 0, 0]])

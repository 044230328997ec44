"""How the idle model moves within its covariance."""

from __future__ import annotations

import numpy as np
import pytest

from operando.diagnosis.idle import Moves

SCALE_STD = 0.5
"""Relative standard deviation of the scale of the mode."""


def shapes():
    """A driven DOF, a response, and a reference that hardly moves, whose small value is told by itself: one mode, two unknowns."""
    base = np.array([[1.0], [2.0], [0.05]])
    shared = np.zeros((3, 1, 2))
    shared[0, 0, 0], shared[1, 0, 0], shared[2, 0, 1] = SCALE_STD, -2 * SCALE_STD, 0.01
    return base, Moves(shared, np.zeros((3, 1, 1)))


def scale(base, moves):
    return moves.scale(base, np.array([True, False, True]))


def test_values_that_the_scale_carries_keep_their_product_and_others_their_value():
    base, moves = shapes()
    for g in (-2.0, 1.0, 2.0):
        values, _ = moves.at(base, moves.ways(base, scale(base, moves)), np.array([g, 0.0]), np.zeros((3, 1)))
        assert values[0, 0] * values[1, 0] == pytest.approx(2.0, rel=0.02)
        assert values[2, 0] == pytest.approx(0.05, rel=0.02)


def test_where_nothing_is_known_a_value_follows_nothing():
    base, moves = shapes()
    alone = Moves(np.zeros_like(moves.shared), np.ones((3, 1, 1)))
    values, after = alone.at(base, alone.ways(base, alone.scale(base, np.array([True, False, True]))), np.zeros(2), np.full((3, 1), 0.1))
    assert values == pytest.approx(base + 0.1)
    assert after.own == pytest.approx(1.0)


@pytest.mark.parametrize("g", [[0.0, 0.0], [1.3, -0.7]])
def test_moves_are_the_derivatives(g):
    base, moves = shapes()
    own, step = np.array([[0.2], [0.1], [0.01]]), 1e-6
    moves = Moves(moves.shared, np.array([[[0.1]], [[0.3]], [[0.02]]]))
    _, slopes = moves.at(base, moves.ways(base, scale(base, moves)), np.array(g), own)
    for number in range(2):
        ends = []
        for sign in (1, -1):
            there = np.array(g)
            there[number] += sign * step
            ends.append(moves.at(base, moves.ways(base, scale(base, moves)), there, own)[0])
        assert slopes.shared[..., number] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-6, abs=1e-9)
    ends = [moves.at(base, moves.ways(base, scale(base, moves)), np.array(g), own + sign * step)[0] for sign in (1, -1)]
    assert slopes.own[..., 0] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-6, abs=1e-9)

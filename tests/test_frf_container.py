"""What the FRF container answers about its own lines."""

from __future__ import annotations

import numpy as np
import pytest

from operando.data import Frf


@pytest.mark.parametrize("count", [1, 2, 3, 40])
def test_nearest_lines(count):
    rng = np.random.default_rng(count)
    lines = np.sort(rng.uniform(1, 10, count))
    frf = Frf(np.zeros((1, 1, count), complex), lines, ("1+Z",), ("1+Z",))
    asked = np.r_[rng.uniform(-1, 12, 100), lines, 0.0, 1e3]
    found = frf.at(asked)
    assert found.dtype.kind == "i"
    np.testing.assert_array_equal(np.abs(lines[found] - asked), np.abs(lines[None] - asked[:, None]).min(axis=1))

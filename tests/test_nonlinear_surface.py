"""Even and odd parts of a restoring force over displacement."""

from __future__ import annotations

import numpy as np
import pytest

from operando.diagnosis.records import parity

X = np.random.default_rng(0).standard_normal(40_000)


@pytest.mark.parametrize(
    ("law", "larger", "none"),
    [
        (lambda x: 3 * x, "linear", ("odd", "even")),
        (lambda x: x**3 - 2 * x, "odd", ("even",)),
        (lambda x: np.maximum(x, 0), "even", ("odd",)),
        (lambda x: x**2, "even", ("linear", "odd")),
    ],
)
def test_parity_tells_even_from_odd(law, larger, none):
    shares = parity(X, law(X) + 0.05 * np.random.default_rng(1).standard_normal(X.size))
    assert sum(shares.values()) == pytest.approx(1)
    assert shares[larger] > 0.15
    assert all(shares[name] < 0.01 for name in none)


def test_no_motion_has_no_parity():
    assert set(parity(np.zeros(100), np.zeros(100)).values()) == {0.0}

"""Variances of the lines that a diagnosis fits, averaged over lines."""

from __future__ import annotations

import numpy as np
import pytest

from operando.diagnosis.lines import _pooled


def test_a_line_without_variance_swallows_no_others():
    """``_LEAST_VARIANCE`` is large enough that the sums of inverses keep the digits of the lines that come later."""
    variance, power = np.ones((4000, 1, 1)), np.ones((4000, 1, 1))
    variance[2000:] = 1e-8
    as_it_is = _pooled(variance, power)
    variance[1000] = 0.0
    with_zero = _pooled(variance, power)
    assert with_zero[:500] == pytest.approx(as_it_is[:500], rel=1e-3)
    assert with_zero[3500:] == pytest.approx(1e-8, rel=1e-3)

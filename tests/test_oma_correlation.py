"""Correlations and Hankel matrices against direct sums."""

from __future__ import annotations

import numpy as np
import pytest

from operando.errors import IdentificationError
from operando.oma.correlation import block_hankel, correlate, pool


def direct(x, refs, n_lags, start, stop):
    return np.array([x[:, start + k : stop + k] @ x[refs, start:stop].T for k in range(n_lags + 1)]) / (stop - start)


@pytest.mark.parametrize("length", [250, 3000])
def test_blocks_equal_direct_sums_and_add_up(length):
    """Blocks of one transform, and of several."""
    x = np.random.default_rng(0).standard_normal((3, 4 * length + 17))
    refs = np.array([2, 0])
    c = correlate(x, refs, 17, 4)
    for b in range(4):
        np.testing.assert_allclose(c.blocks[b], direct(x, refs, 17, b * length, (b + 1) * length), atol=1e-5)
    np.testing.assert_allclose(c.mean, direct(x, refs, 17, 0, 4 * length), atol=1e-6)
    exact = correlate(x, refs, 17, 4, keep_blocks=False)
    assert exact.blocks is None
    np.testing.assert_allclose(exact.mean, direct(x, refs, 17, 0, 4 * length), atol=1e-12)


def test_runs_pool_by_length():
    x = np.random.default_rng(1).standard_normal((2, 500))
    y = np.random.default_rng(2).standard_normal((2, 900))
    a, b = correlate(x, np.arange(2), 10, 2), correlate(y, np.arange(2), 10, 3)
    p = pool([a, b], [500, 900])
    np.testing.assert_allclose(p.mean, (5 * a.mean + 9 * b.mean) / 14)
    np.testing.assert_allclose(np.tensordot(p.weights, p.blocks, 1), p.mean, atol=1e-6)


def test_too_short_is_refused():
    with pytest.raises(IdentificationError, match="too few"):
        correlate(np.zeros((2, 100)), np.arange(2), 40, 4)


def test_hankel_blocks():
    c = np.random.default_rng(0).standard_normal((8, 3, 2))
    h = block_hankel(c, 3, 4)
    for k in range(3):
        for m in range(4):
            np.testing.assert_array_equal(h[3 * k : 3 * k + 3, 2 * m : 2 * m + 2], c[k + m + 1])

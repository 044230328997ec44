"""Variances of the lines that a diagnosis fits, averaged over lines."""

from __future__ import annotations

import numpy as np
import pytest

from operando.data import Frf
from operando.diagnosis.criteria import BLOCKS
from operando.diagnosis.lines import _LEAST_BLOCK, _OWN, Lines, _alike, _blocks, _pooled, alike_lines
from operando.dof import parse_dofs


def test_a_line_without_variance_swallows_no_others():
    """``_LEAST_VARIANCE`` is large enough that the sums of inverses keep the digits of the lines that come later."""
    variance, power = np.ones((4000, 1, 1)), np.ones((4000, 1, 1))
    variance[2000:] = 1e-8
    as_it_is = _pooled(variance, power)
    variance[1000] = 0.0
    with_zero = _pooled(variance, power)
    assert with_zero[:500] == pytest.approx(as_it_is[:500], rel=1e-3)
    assert with_zero[3500:] == pytest.approx(1e-8, rel=1e-3)


def test_blocks_end_at_the_peaks_and_modes_so_that_a_flank_of_each_is_fitted():
    """The two blocks beside a peak are never both among each third one, which validates; none is longer than the band over ``BLOCKS``."""
    count, peaks = 1800, [101, 420, 800, 1240, 1700]
    line = np.arange(count)
    power = sum(1 / (1 + ((line - p) / 6.0) ** 2) for p in peaks) + 1e-3
    modes = np.array([430, 803, 1500])  # one that has moved, one that stands at its peak (``_LEAST_BLOCK``), one that is not seen
    assert 800 + _LEAST_BLOCK > 803
    block = _blocks(np.log(power), modes)
    starts = np.flatnonzero(np.diff(block)) + 1
    near = [int(np.abs(starts - p).min()) for p in [*peaks, 430, 1500]]
    assert max(near) <= 1
    assert 803 not in starts
    assert np.diff(np.r_[0, starts, count]).max() <= 1.5 * count / BLOCKS
    assert np.diff(np.r_[0, starts, count]).min() >= _LEAST_BLOCK
    for p in peaks:
        fitted = block[[p - 4, p + 4]] % 3 != 1
        assert fitted.any()
    # of equal blocks one held the whole of a peak
    equal = line * BLOCKS // count
    assert any((equal[p - 10 : p + 10] % 3 == 1).all() for p in peaks)


@pytest.mark.parametrize("between", [False, True])
def test_lines_of_each_mode_are_fitted_however_narrow(between):
    """A mode at 20 Hz is as wide in hertz as a fifth of one at 100 Hz: by lines of equal spacing it would get none."""
    hz = np.arange(10.0, 120.0, 0.05)
    f, zeta = np.array([14.0, 20.3, 55.0, 100.0]), np.full(4, 0.004)
    rng = np.random.default_rng(0)
    h = np.sum(1 / (f**2 - hz[:, None] ** 2 + 2j * zeta * f * hz[:, None]), axis=1) * 1e-3
    data = h[None, None] * np.ones((3, 1, 1)) + 1e-7 * (rng.standard_normal((3, 1, hz.size)) + 1j * rng.standard_normal((3, 1, hz.size)))
    frf = Frf(data, hz, parse_dofs(["1+Z", "2+Z", "3+Z"]), parse_dofs(["1+Z"]), "receptance", variance=np.full(data.shape, 2e-14))
    lines = Lines(frf, f, zeta, between=between)
    fitted = lines.w[lines.fit] / 2 / np.pi
    for mode in f:
        assert np.sum(np.abs(fitted - mode) < 2 * 0.004 * mode) >= 2


@pytest.mark.parametrize(("count", "least", "most"), [(1, 1, 1.01), (11, 8, 15), (30, 20, 45)])
def test_lines_whose_noise_is_alike_are_told_by_their_differences(count, least, most):
    """White noise, and noise whose correlation falls evenly over so many lines beside a part of its own (``_OWN``, ``_STEPS``)."""
    rng = np.random.default_rng(1)

    def gauss(size):
        return (rng.standard_normal((size, 12)) + 1j * rng.standard_normal((size, 12))) / np.sqrt(2)

    lines = 3000
    # a mean over so many lines has a correlation that falls evenly
    total = np.cumsum(np.concatenate([np.zeros((1, 12)), gauss(lines + count - 1)]), axis=0)
    smooth = (total[count:] - total[:-count]) / np.sqrt(count)
    noise = np.sqrt(1 - _OWN) * smooth + np.sqrt(_OWN) * gauss(lines) if count > 1 else smooth
    hz = np.linspace(10, 100, lines)
    h = 1e3 / (1 - (hz / 55) ** 2 + 0.02j * hz / 55)
    assert least <= alike_lines(h[:, None] + noise, np.ones((lines, 12))) <= most
    assert alike_lines(noise[:4], np.ones((4, 12))) == 1.0
    alike = _alike(np.arange(5), float(count))
    assert alike[0] == 1
    assert alike[1] == pytest.approx((1 - _OWN) * max(0, 1 - 1 / count))
    # FRFs that change from line to line tell nothing of their noise
    assert alike_lines(1e6 * gauss(500), np.ones((500, 12))) == 1.0

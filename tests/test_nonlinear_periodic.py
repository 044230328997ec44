"""Noise and nonlinear distortion apart under a multisine: an oscillator integrated by the tests' own code, and a measured aircraft."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from operando.contrib import best_linear_approximation
from operando.errors import DataError

SHARED = Path(__file__).resolve().parents[1].parent / "shared"
RATE, PERIOD = 128.0, 1024
EXCITED = np.array([k for k in range(41, 200, 2) if k % 8 != 1])  # odd lines, every fourth of them left out


@cache
def shaken(cubic, square, full=False, seed=0):
    """m = 1 kg, 10 Hz, 3 %; six periods of an odd random-phase multisine (or all lines), classical Runge-Kutta at eight steps a sample."""
    rng = np.random.default_rng(seed)
    lines = np.arange(41, 200) if full else EXCITED
    fine, n = 8, PERIOD
    t2 = np.arange(n * fine * 2) / (n * fine * 2)
    f = np.sum(np.cos(2 * np.pi * (np.outer(lines, t2) + rng.uniform(size=lines.size)[:, None])), axis=0)
    f = (f * 20 / f.std()).tolist()
    k, c, h = (20 * np.pi) ** 2, 2 * 0.03 * 20 * np.pi, 1 / (RATE * fine)
    x = v = 0.0
    a = lambda x, v, u: u - c * v - k * x - cubic * x**3 - square * x**2  # noqa: E731
    out = []
    for i in range(6 * n * fine):
        at = 2 * i % len(f)
        f0, f1, f2 = f[at], f[at + 1], f[(at + 2) % len(f)]
        if i % fine == 0:
            out.append(x)
        a1 = a(x, v, f0)
        a2 = a(x + h / 2 * v, v + h / 2 * a1, f1)
        a3 = a(x + h / 2 * (v + h / 2 * a1), v + h / 2 * a2, f1)
        a4 = a(x + h * (v + h / 2 * a2), v + h * a3, f2)
        x, v = x + h * v + h * h / 6 * (a1 + a2 + a3), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    x = np.array(out)
    x = x + 3e-4 * x.std() * rng.standard_normal(x.size)
    return np.tile(f[:: 2 * fine], 6), x


def test_a_linear_oscillator_shows_noise_alone():
    force, x = shaken(0.0, 0.0)
    found = best_linear_approximation(force, x, RATE)
    assert found.period == PERIOD
    assert 3 <= found.periods <= 5, "the transient of the first periods is left out"
    assert not found.nonlinear
    w = 2 * np.pi * found.frequencies_hz
    exact = 1 / ((20 * np.pi) ** 2 - w**2 + 2j * 0.03 * 20 * np.pi * w)
    error = np.abs(found.frf[0] - exact) ** 2 / found.noise[0]
    assert 0.3 < np.median(error) < 3, "the variance stated is that of the error"


def test_a_cubic_spring_makes_odd_distortion():
    found = best_linear_approximation(*shaken(6e5, 0.0), RATE)
    assert found.nonlinear
    assert found.odd_db[0] > 20
    assert found.even_db[0] < 6
    assert "odd" in " ".join(found.words())


def test_a_square_spring_makes_even_distortion():
    found = best_linear_approximation(*shaken(0.0, 1.5e3), RATE)
    assert found.even_db[0] > 20
    assert found.even_db[0] > found.odd_db[0] + 10


def test_with_all_lines_excited_the_kinds_of_distortion_cannot_be_told_apart():
    found = best_linear_approximation(*shaken(6e5, 0.0, True), RATE)
    assert found.nonlinear
    assert found.odd_db is None
    assert found.even_db is None
    assert found.over_noise_db[0] > 10
    assert "all lines" in " ".join(found.words())
    linear = best_linear_approximation(*shaken(0.0, 0.0, True), RATE)
    assert not linear.nonlinear


def test_what_is_not_periodic_is_refused():
    rng = np.random.default_rng(1)
    with pytest.raises(DataError, match="repeat"):
        best_linear_approximation(rng.standard_normal(5000), rng.standard_normal(5000), RATE)
    with pytest.raises(DataError, match="samples"):
        best_linear_approximation(np.zeros(10), np.zeros(9), RATE)


def test_input_that_would_pass_for_a_linear_test_is_refused():
    force, x = shaken(6e5, 0.0)
    bad = x.copy()
    bad[3000] = np.nan
    with pytest.raises(DataError, match="responses: 1 of 6144 samples are not finite, the first at 3000"):
        best_linear_approximation(force, bad, RATE)
    for period in (1000, 1023, 512):
        with pytest.raises(DataError, match="its period seems to be 1024"):
            best_linear_approximation(force, x, RATE, period=period)
    with pytest.raises(DataError, match="neither after 1000"):
        best_linear_approximation(np.random.default_rng(0).standard_normal(6144), x, RATE, period=1000)
    with pytest.raises(DataError, match="sampling_hz is 0"):
        best_linear_approximation(force, x, 0.0)
    assert best_linear_approximation(force, x, RATE, period=2048).period == 2048


def test_it_prints_short():
    text = repr(best_linear_approximation(*shaken(6e5, 0.0), RATE))
    assert "1 response" in text
    assert "of 1024 samples" in text
    assert "nonlinear: distortion repeats" in text
    assert len(text) < 400


@pytest.mark.skipif(not (SHARED / "data" / "f16").is_dir(), reason="the measured data are not here")
def test_one_level_of_the_aircraft_says_that_it_is_not_linear_and_no_more():
    """Full multisine, 2 to 15 Hz, nine periods of 8192 samples; accelerations at the shaker and on both sides of the wing's mounting."""
    data = np.genfromtxt(SHARED / "data" / "f16" / "F16Data_FullMSine_Level1.csv", delimiter=",", skip_header=1, usecols=(0, 2, 3, 4))
    found = best_linear_approximation(data[:, 0], data[:, 1:].T, 400.0)
    assert found.period == 8192
    assert found.periods == 8
    assert found.frequencies_hz[[0, -1]] == pytest.approx([2.0, 15.0], abs=0.05)
    peaks = found.frequencies_hz[np.argmax(np.abs(found.frf), axis=1)]
    assert peaks == pytest.approx(7.3, abs=0.1)
    assert found.nonlinear
    assert np.all(found.over_noise_db > 10)
    # Beside the mounting there is more of it than at the shaker.
    assert np.all(found.distortion_db[1:] > found.distortion_db[0] + 6)
    assert found.odd_db is None
    words = " ".join(found.words())
    assert "one level cannot tell" in words
    assert "all lines of the band are excited" in words

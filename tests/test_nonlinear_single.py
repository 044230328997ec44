"""One force and one response: a Duffing oscillator of the tests' own, and measured ones."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from operando.contrib import fit_single, single_channel
from operando.errors import DataError

SHARED = Path(__file__).resolve().parents[1].parent / "shared"
RATE = 200.0


@cache
def oscillator(cubic, level, seed=0):
    """m = 2, 8 Hz, 2 % damping, under random force; classical Runge-Kutta at eight steps a sample."""
    rng = np.random.default_rng(seed)
    n, fine = 8000, 8
    hz = np.fft.rfftfreq(n * fine * 2, 1 / (RATE * fine * 2))
    f = np.fft.irfft(np.where((hz > 1) & (hz < 30), 1.0, 0) * np.exp(2j * np.pi * rng.uniform(size=hz.size)), n * fine * 2)
    f = [*(f * level / f.std()).tolist(), 0.0, 0.0]
    k, c, m, h = 2.0 * (16 * np.pi) ** 2, 2 * 0.02 * 2.0 * 16 * np.pi, 2.0, 1 / (RATE * fine)
    x = v = 0.0
    out = []

    def a(x, v, u):
        return (u - c * v - k * x - cubic * x**3) / m

    for i in range(n * fine):
        if i % fine == 0:
            out.append(x)
        f0, f1, f2 = f[2 * i : 2 * i + 3]
        a1 = a(x, v, f0)
        a2 = a(x + h / 2 * v, v + h / 2 * a1, f1)
        a3 = a(x + h / 2 * (v + h / 2 * a1), v + h / 2 * a2, f1)
        a4 = a(x + h * (v + h / 2 * a2), v + h * a3, f2)
        x, v = x + h * v + h * h / 6 * (a1 + a2 + a3), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return np.array(f[: n * fine * 2 : fine * 2]), np.array(out)


def noisy(signal, share=1e-4):
    return signal + share * signal.std() * np.random.default_rng(9).standard_normal(signal.size)


def test_duffing_is_named_and_sized():
    force, x = oscillator(4e6, 20.0)
    found = fit_single(force, noisy(x), RATE, (2.0, 28.0))
    assert found.kinds == ("cubic_stiffness",)
    assert found.values[0]["coefficient"] == pytest.approx(4e6, rel=0.02)
    assert abs(found.values[0]["coefficient"] - 4e6) < 5 * found.std["cubic_stiffness.coefficient"] + 0.005 * 4e6
    assert found.mass == pytest.approx(2.0, rel=0.01)
    assert found.frequency_hz == pytest.approx(8.0, rel=0.01)
    assert found.error < 0.2 * found.linear_error


def test_it_holds_at_another_level():
    force, x = oscillator(4e6, 20.0)
    found = fit_single(force, noisy(x), RATE, (2.0, 28.0))
    other = oscillator(4e6, 8.0, seed=3)
    linear = fit_single(force, noisy(x), RATE, (2.0, 28.0), kinds=())
    assert found.error_on(*other, RATE, (2.0, 28.0)) < 0.1 * linear.error_on(*other, RATE, (2.0, 28.0))


def test_a_linear_oscillator_stays_linear():
    force, x = oscillator(0.0, 20.0)
    assert fit_single(force, noisy(x), RATE, (2.0, 28.0)).kinds == ()


def test_signals_of_different_length_are_refused():
    with pytest.raises(DataError, match="5000, 4999 samples"):
        fit_single(np.zeros(5000), np.zeros(4999), RATE, (2.0, 28.0))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"displacement": lambda x: np.where(np.arange(x.size) == 100, np.nan, x)}, "displacement: 1 of 8000 samples are not finite"),
        ({"displacement": lambda x: 0 * x}, "displacement is constant"),
        ({"band": (2.0, 140.0)}, "half the sampling rate"),
        ({"band": (28.0, 2.0)}, "half the sampling rate"),
        ({"sampling_hz": 0.0}, "sampling_hz is 0"),
    ],
)
def test_input_that_can_say_nothing_is_refused(change, says):
    force, x = oscillator(4e6, 20.0)
    given = {"sampling_hz": RATE, "band": (2.0, 28.0)} | change
    given["displacement"] = change.get("displacement", lambda x: x)(x)
    with pytest.raises(DataError, match=says):
        fit_single(force, **given)


@pytest.mark.parametrize(("share", "colour"), [(1e-3, 0.0), (1e-3, 0.95)])
def test_intervals_cover_the_true_sizes_under_coloured_noise(share, colour):
    from scipy.signal import lfilter

    force, x = oscillator(4e6, 20.0)
    truth = {
        "mass": 2.0, "damping": 2 * 0.02 * 2.0 * 16 * np.pi, "stiffness": 2.0 * (16 * np.pi) ** 2, "cubic_stiffness.coefficient": 4e6
    }  # fmt: skip
    inside = []
    for seed in range(12):
        noise = lfilter([1], [1, -colour], np.random.default_rng(seed).standard_normal(x.size + 500))[500:]
        found = fit_single(force, x + share * x.std() * noise / noise.std(), RATE, (2.0, 28.0), kinds=["cubic_stiffness"])
        sizes = {name: getattr(found, name) for name in ("mass", "damping", "stiffness")}
        sizes["cubic_stiffness.coefficient"] = found.values[0]["coefficient"]
        inside += [abs(sizes[name] - true) < 1.96 * found.std[name] for name, true in truth.items()]
    assert np.mean(inside) > 0.9


def test_it_prints_short_and_with_intervals():
    text = repr(fit_single(*oscillator(4e6, 20.0), RATE, (2.0, 28.0), kinds=["cubic_stiffness"]))
    assert "cubic stiffness coefficient 3999999 ± 2" in text
    assert "±" in text
    assert "units of the signals" in text
    assert "\n" not in text
    assert len(text) < 400


@pytest.mark.skipif(not (SHARED / "data" / "silverbox").is_dir(), reason="the measured data are not here")
@pytest.mark.parametrize(("parts", "agree"), [(single_channel.PARTS, True), (8 * single_channel.PARTS, False)])
def test_the_sizes_of_the_measured_circuit_agree_within_their_intervals_over_records_and_bands(monkeypatch, parts, agree):
    monkeypatch.setattr(single_channel, "PARTS", parts)
    v = np.genfromtxt(SHARED / "data" / "silverbox" / "SNLS80mV.csv", delimiter=",", skip_header=1, usecols=(0, 1))
    v -= v[45_000:].mean(axis=0)
    sizes = []
    for part in (v[:40_000], v[45_000:]):
        for band in ((5.0, 150.0), (1.0, 200.0), (30.0, 110.0)):
            found = fit_single(*part.T, 610.35, band, kinds=["cubic_stiffness"])
            sizes.append((found.values[0]["coefficient"], found.std["cubic_stiffness.coefficient"]))
    assert all(abs(a - b) < 1.96 * np.hypot(s, t) for a, s in sizes for b, t in sizes) is agree


@pytest.mark.skipif(not (SHARED / "data" / "silverbox").is_dir(), reason="the measured data are not here")
def test_silverbox_is_a_cubic_spring_and_nothing_else():
    """Trained on the multisine, judged on the part of growing level within the trained range."""
    v = np.genfromtxt(SHARED / "data" / "silverbox" / "SNLS80mV.csv", delimiter=",", skip_header=1, usecols=(0, 1))
    rate, band = 610.35, (5.0, 150.0)
    train, grow = v[45_000:], v[:40_000]
    mean = train.mean(axis=0)
    found = fit_single(*(train - mean).T, rate, band)
    assert found.kinds == ("cubic_stiffness",)
    assert found.values[0]["coefficient"] > 10 * found.std["cubic_stiffness.coefficient"]
    inside = grow[: int(np.argmax(np.abs(grow[:, 1] - mean[1]) > np.abs(train[:, 1] - mean[1]).max()))]
    linear = fit_single(*(train - mean).T, rate, band, kinds=())
    assert found.error_on(*(inside - mean).T, rate, band) < linear.error_on(*(inside - mean).T, rate, band)

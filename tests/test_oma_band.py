"""The default band: where the resonances hold their power."""

from __future__ import annotations

import numpy as np
import pytest

from operando.oma import fit_oma
from operando.oma.band import default_band
from test_oma_fit import CHAIN, FS, record, simulate
from test_oma_measured import DATA, need


def test_band_about_the_resonances():
    """Peaks between 17 and 65 Hz in a record at 2 kHz, with noise and a weak line far above: nothing is looked for there."""
    rate = 2000.0
    x = simulate(CHAIN, 20.0, rate, 1, noise=0.0)
    low = np.fft.rfft(x, axis=1)
    low[:, np.fft.rfftfreq(x.shape[1], 1 / rate) > 150] = 0
    x = np.fft.irfft(low, x.shape[1], axis=1)
    rng = np.random.default_rng(2)
    t = np.arange(x.shape[1]) / rate
    x = x + 0.1 * x.std() * rng.standard_normal(x.shape) + 0.02 * x.std() * np.sin(2 * np.pi * 777 * t)
    choice = default_band([record(x, rate)], 60)
    low_hz, high_hz = choice.band
    assert 5 < low_hz < CHAIN.hz[0]
    assert CHAIN.hz[-1] < high_hz < 120
    assert choice.findings[0].kind == "band_by_default"
    model = fit_oma(record(x, rate))
    assert model.n_modes == 5
    assert model.band_hz == pytest.approx(choice.band)
    assert any(f.kind == "band_by_default" for f in model.findings)
    assert "99 %" in model.details.settings["band_source"]


def test_no_resonance_says_so():
    x = np.random.default_rng(0).standard_normal((3, 20000))
    choice = default_band([record(x, FS)], 60)
    assert choice.findings[0].severity == "warning"
    assert choice.band == pytest.approx((0.1, 80.0))


def test_lags_bound_the_band():
    """A band of eight octaves is cut where the lags do not reach over the lowest period (``LEAST_LAG``)."""
    rng = np.random.default_rng(0)
    rate, n = 2000.0, 120000
    w = 2 * np.pi * np.fft.rfftfreq(n, 1 / rate)
    x = 0
    for hz in (2.0, 500.0):
        force = rng.standard_normal(w.size) + 1j * rng.standard_normal(w.size)
        wr = 2 * np.pi * hz
        x = x + np.fft.irfft(-(w**2) * force / (wr**2 - w**2 + 0.01j * w * wr) * (500 / hz) ** 0.5, n)
    wide = record(x[None] + 0.01 * x.std() * rng.standard_normal((3, n)), rate)
    choice = default_band([wide], 40)
    assert choice.band[1] == pytest.approx(40 * choice.band[0] / 0.6, rel=0.02)
    assert "by itself" in choice.findings[0].action


def test_mast_by_default():
    from operando.data import Channel, TimeRecord
    from operando.dof import Dof

    data = np.load(need(DATA / "mast" / "lumo.npz"))["data"][:, :18].T
    channels = tuple(Channel(Dof(1 + i // 2, "XY"[i % 2]), "acceleration", "m/s2") for i in range(18))
    model = fit_oma(TimeRecord(data, 1651.6, channels, name="mast"))
    for hz in (2.77, 2.82, 13.54, 15.99, 16.33, 42.6, 66.9, 69.7, 72.1, 92.9, 101.4):
        assert np.min(np.abs(model.frequencies_hz / hz - 1)) < 0.006, hz
    assert model.n_modes <= 16


def test_turbines_by_default():
    from operando.data import Channel, TimeRecord
    from operando.dof import Dof

    data = np.loadtxt(need(DATA / "turbine" / "offshore_wind_turbine_parked.csv"), delimiter=",", skiprows=1)
    channels = tuple(Channel(Dof((15, 69, 97)[i // 2], "XY"[i % 2]), "acceleration", "m/s2") for i in range(6))
    model = fit_oma(TimeRecord(9.80665 * data[:, 1:].T, 30.0, channels, name="parked"))
    for hz in (0.23, 0.75, 1.34):
        assert np.min(np.abs(model.frequencies_hz / hz - 1)) < 0.04, (hz, model.frequencies_hz)
    data = np.loadtxt(need(DATA / "turbine" / "offshore_wind_data_rotor_stop.csv"), delimiter=",", skiprows=1)
    stopped = TimeRecord(9.80665 * data[:, 1:].T, 25.0, (Channel(Dof(1, "X"), "acceleration"), Channel(Dof(1, "Y"), "acceleration")))
    model = fit_oma(stopped)
    assert np.min(np.abs(model.frequencies_hz - 0.293)) < 0.002

"""Free decays given as operating records: found, analysed as decays, honest deviations; records that are short for their modes."""

from __future__ import annotations

import numpy as np
import pytest

from operando.oma import fit_oma
from operando.oma.decay_detect import find_decays
from test_oma_fit import BAND, CHAIN, FS, record, simulate


def decays(seed, seconds=15.0, starts=(0.3,), noise=0.01, chain=CHAIN, softening=0.0):
    """Free vibration of the chain after sudden impulses, with white noise of a part of the peak.

    ``softening``: relative change of each frequency at full amplitude; it fades with the square of the amplitude.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(int(seconds * FS)) / FS
    x = np.zeros((len(chain.hz), t.size))
    for start in starts:
        amplitude = rng.uniform(0.4, 1.0, len(chain.hz)) * rng.choice([-1, 1], len(chain.hz))
        after = np.maximum(t - start, 0)
        for r, (hz, zeta) in enumerate(zip(chain.hz, chain.zeta, strict=True)):
            w = 2 * np.pi * hz
            phase = w * np.sqrt(1 - zeta**2) * after - softening * w * (1 - np.exp(-2 * zeta * w * after)) / (2 * zeta * w)
            x += np.outer(chain.phi[:, r] * amplitude[r], np.where(t >= start, np.exp(-zeta * w * after) * np.sin(phase), 0))
    return x + noise * np.abs(x).max() * rng.standard_normal(x.shape)


def test_one_decay():
    model = fit_oma(record(decays(1)), band=BAND)
    assert model.details.settings["method"] == "free-decay"
    assert any(f.kind == "free_decay" for f in model.findings)
    assert model.n_modes == 5
    assert np.all(np.abs(model.frequencies_hz - CHAIN.hz) < 4 * model.frequency_std_hz)
    assert np.all(np.abs(model.damping_ratios - CHAIN.zeta) < 4 * model.damping_ratio_std)
    assert np.all(model.frequency_std_hz < 1e-3 * CHAIN.hz)
    truth = CHAIN.phi / np.linalg.norm(CHAIN.phi, axis=0)
    assert np.min(np.abs(np.sum(truth * model.shapes, axis=0)) ** 2) > 0.99


def test_several_decays_make_surer():
    one = fit_oma(record(decays(2, 12.0)), band=BAND)
    four = fit_oma(record(decays(2, 40.0, (0.3, 10.0, 20.0, 30.0))), band=BAND)
    assert "4 free decays" in next(f.message for f in four.findings if f.kind == "free_decay")
    assert np.median(four.frequency_std_hz / one.frequency_std_hz) < 0.75


@pytest.mark.slow
def test_deviations_of_decays_hold():
    """A small Monte Carlo: 95 % intervals cover (benchmarks/coverage_setups.py has the large one)."""
    hits, found = [], 0
    for seed in range(12):
        model = fit_oma(record(decays(100 + seed, 8.0)), band=BAND)
        near = [int(np.argmin(np.abs(model.frequencies_hz - f))) for f in CHAIN.hz]
        found += sum(abs(model.frequencies_hz[j] / f - 1) < 0.005 for j, f in zip(near, CHAIN.hz, strict=True))
        hits += list(np.abs(model.frequencies_hz[near] - CHAIN.hz) < 1.96 * model.frequency_std_hz[near])
        hits += list(np.abs(model.damping_ratios[near] - CHAIN.zeta) < 1.96 * model.damping_ratio_std[near])
    assert found >= 59  # of 60
    assert 0.87 < np.mean(hits) < 0.995  # 120 draws: 95 % ± 4 %


def test_amplitude_in_the_frequency_is_in_the_deviation():
    model = fit_oma(record(decays(3, noise=0.002, softening=0.004)), band=BAND)
    plain = fit_oma(record(decays(3, noise=0.002)), band=BAND)
    near = [int(np.argmin(np.abs(model.frequencies_hz - f))) for f in CHAIN.hz]
    assert np.median(model.frequency_std_hz[near] / plain.frequency_std_hz) > 3
    off = np.abs(model.frequencies_hz[near] - CHAIN.hz) / model.frequency_std_hz[near]
    assert np.median(off) < 3


@pytest.mark.parametrize("seconds", [3.0, 10.0, 60.0])
def test_stationary_records_are_no_decays(seconds):
    assert not any(find_decays(simulate(CHAIN, seconds, FS, seed), FS, BAND[0]) for seed in range(10))


def test_narrow_band_vibration_is_no_decay():
    """One mode of little damping in a record of a few correlation times: its envelope wanders, but comes back."""
    rng = np.random.default_rng(0)
    false = 0
    for _ in range(100):
        w = 2 * np.pi * np.fft.rfftfreq(16000, 1 / 40.0)
        force = rng.standard_normal(w.size) + 1j * rng.standard_normal(w.size)
        x = np.fft.irfft(force / ((2 * np.pi * 2.0) ** 2 - w**2 + 2j * 0.005 * w * 2 * np.pi * 2.0), 16000)[:1200]
        false += bool(find_decays((x / x.std() + 0.01 * rng.standard_normal(x.size))[None], 40.0, 1.2))
    assert false <= 1


def test_a_machine_that_stops_is_not_all_decay():
    x = simulate(CHAIN, 60.0, FS, 5)
    t = np.arange(x.shape[1]) / FS
    stopped = x * np.where(t > 30, np.exp(-(t - 30)), 1.0)
    assert not find_decays(stopped, FS, BAND[0])
    assert any(f.kind == "nonstationary" for f in fit_oma(record(stopped), band=BAND).findings)


def test_decays_among_stationary_records_are_left_out():
    steady = record(simulate(CHAIN, 100.0, FS, 7), name="steady")
    model = fit_oma([steady, record(decays(4), name="knock")], band=BAND)
    assert model.details.settings["method"] == "ssi-cov"
    assert [f.file for f in model.findings if f.kind == "free_decay"] == ["knock"]
    assert np.allclose(model.frequencies_hz, fit_oma(steady, band=BAND).frequencies_hz)


def test_short_records_say_so():
    model = fit_oma(record(simulate(CHAIN, 2.0, FS, 7)), band=BAND)
    said = [f for f in model.findings if f.kind == "short_record"]
    assert len(said) == 1
    assert "periods" in said[0].message
    assert "measure" in said[0].action
    assert not any(f.kind == "short_record" for f in fit_oma(record(simulate(CHAIN, 60.0, FS, 7)), band=BAND).findings)

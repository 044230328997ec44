"""Sinusoids in operating records: found, taken out, and nothing found where there is none."""

from __future__ import annotations

import numpy as np
import pytest

from operando.oma import find_harmonics, fit_oma
from test_oma_fit import BAND, CHAIN, FS, check_modes, record, simulate


@pytest.fixture(scope="module")
def clean():
    return simulate(CHAIN, 200.0, FS, 1)


def with_lines(x, lines, seed=0, drift_hz=0.0):
    rng = np.random.default_rng(seed)
    t = np.arange(x.shape[1]) / FS
    wander = drift_hz * np.sin(2 * np.pi * t / 70 + 1)
    out = x.copy()
    for hz, size in lines:
        phase = 2 * np.pi * np.cumsum(hz + wander) / FS
        out += size * x.std(axis=1)[:, None] * rng.standard_normal((len(x), 1)) * np.cos(phase + rng.uniform(0, 6, (len(x), 1)))
    return out


def test_steady_lines_are_found_and_the_modes_stay(clean):
    near = 1.02 * CHAIN.hz[1]
    x = with_lines(clean, [(21.37, 0.3), (near, 0.5), (50.0, 1.0)])
    model = fit_oma(record(x), band=BAND)
    np.testing.assert_allclose(model.details.harmonics_hz, [21.37, near, 50.0], atol=0.002)
    assert [f.kind for f in model.findings] == ["harmonic"] * 3
    check_modes(model)
    plain = fit_oma(record(clean), band=BAND)
    assert np.all(np.abs(model.frequencies_hz - plain.frequencies_hz) < 0.3 * plain.frequency_std_hz)
    assert np.all(np.abs(model.damping_ratios - plain.damping_ratios) < 0.3 * plain.damping_ratio_std)


def test_drifting_line_is_followed(clean):
    x = with_lines(clean, [(43.0, 0.7)], drift_hz=0.04)
    found, cleaned = find_harmonics(x, FS, BAND)
    assert [round(h.hz, 1) for h in found] == [43.0]
    assert found[0].spread_hz > 0
    assert np.mean((cleaned - clean) ** 2) < 0.02 * np.mean((x - clean) ** 2)


def test_removal_takes_little_else(clean):
    x = with_lines(clean, [(50.0, 0.5)])
    _, cleaned = find_harmonics(x, FS, BAND)
    assert np.mean((cleaned - clean) ** 2) < 1e-4 * np.mean(clean**2)


def test_known_harmonic_is_taken_out_even_if_weak(clean):
    x = with_lines(clean, [(25.0, 0.004)])
    assert find_harmonics(x, FS, BAND)[0] == []
    found, _ = find_harmonics(x, FS, BAND, known_hz=[25.0])
    assert len(found) == 1
    assert abs(found[0].hz - 25) < 0.02


@pytest.mark.parametrize("seed", range(12))
def test_no_false_alarm_even_with_hardly_damped_modes(seed):
    from structures import Chain

    chain = Chain(5, 1.0, 4e4, np.array([0.0005, 0.002, 0.001, 0.0008, 0.003]))
    x = simulate(chain, 100.0, FS, seed)
    found, cleaned = find_harmonics(x, FS, BAND)
    assert found == []
    assert cleaned is x

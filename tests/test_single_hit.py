"""One hammer hit a record that still rings at its end: window, variance, modes."""

import numpy as np
import pytest

from operando.data import TimeRecord
from operando.data.time import Channel
from operando.dof import Dof
from operando.ema import fit_ema
from operando.frf import estimate_frf
from operando.frf.rational import roughness_variance
from structures import Chain

FS, SECONDS = 512.0, 4.0
HZ = np.array([11.0, 24.0, 39.0, 40.0, 62.0])
DOFS = tuple(Dof.parse(f"{i}+Z") for i in range(1, 6))


def chain():
    """Two modes 1 Hz apart; the lowest keeps 6 % of its amplitude at the end of the record."""
    out = Chain(5, zeta=0.01, spread=0.4, seed=3)
    out.hz = HZ.copy()
    return out


def hit(structure, ref, start, noise=0.0, seed=0):
    """Responses H·F on the lines of a period long enough for everything to decay."""
    n, long = int(SECONDS * FS), int(32 * FS)
    f = np.fft.rfftfreq(long, 1 / FS)
    force = np.zeros(long)
    at = np.arange(4)
    force[round(start * FS) + at] = 50 * np.sin(np.pi * (at + 0.5) / 4)
    spectrum = np.fft.rfft(force) * 0.5 * (1 + np.cos(np.pi * np.clip((f - 130) / 90, 0, 1)))
    h = structure.accelerance(np.maximum(f, 1e-9), ref=[ref])[:, 0]
    data = np.fft.irfft(np.concatenate([spectrum[None], h * spectrum]), long, axis=1)[:, :n]
    rng = np.random.default_rng(seed)
    data[1:] += noise * data[1:].std(axis=1, keepdims=True) * rng.standard_normal((len(DOFS), n))
    channels = [Channel(DOFS[ref], "force", "N")] + [Channel(d, "acceleration", "m/s2") for d in DOFS]
    return TimeRecord(data, FS, tuple(channels), name=f"hit at {DOFS[ref]}")


@pytest.mark.parametrize(("noise", "damping", "scale"), [(0.0, 0.003, 0.001), (0.01, 0.06, 0.02)])
def test_modes_from_one_hit_a_reference(noise, damping, scale):
    truth = chain()
    records = [hit(truth, ref, 0.12, noise, ref) for ref in (0, 3)]
    frf = estimate_frf(records)
    assert frf.exponential_window_rate > 0.5
    said = [f for f in frf.findings if f.kind == "truncated_response"]
    assert [f.severity for f in said] == ["info", "info"]
    model = fit_ema(frf, band=(6, 80), records=records)
    modes = model.select_modes(np.asarray(model.in_band))
    assert modes.n_modes == 5
    assert np.max(np.abs(modes.frequencies_hz / HZ - 1)) < damping / 50
    assert np.max(np.abs(modes.damping_ratios / truth.zeta - 1)) < damping
    size = np.sum(modes.shapes * truth.phi, axis=0) / np.sum(truth.phi**2, axis=0)
    error = np.linalg.norm(modes.shapes * np.sign(size) - truth.phi, axis=0) / np.linalg.norm(truth.phi, axis=0)
    assert np.max(error) < scale


def test_a_record_that_the_hit_triggered_is_used():
    """Ten samples before the pulse instead of the tenth of a second that a block normally begins with."""
    record = hit(chain(), 0, 10 / FS)
    frf = estimate_frf(record)
    assert not any(f.kind == "truncated" for f in frf.findings)
    late = estimate_frf(hit(chain(), 0, 0.12))
    f = (frf.frequencies_hz > 8) & (frf.frequencies_hz < 75)
    other = np.interp(frf.frequencies_hz[f], late.frequencies_hz, np.abs(late.data[0, 0]))
    assert np.median(np.abs(np.abs(frf.data[0, 0][f]) / other - 1)) < 0.05


def test_roughness_is_the_noise_of_frfs_without_averages():
    """Or somewhat more: under noise the local denominators do not quite follow the resonances."""
    f = np.arange(5, 80, 0.05)
    h = chain().accelerance(f, ref=[0])
    clean = roughness_variance(h)
    assert np.sqrt(np.median(clean)) < 1e-4 * np.sqrt(np.mean(np.abs(h) ** 2))
    rng = np.random.default_rng(4)
    sigma = 1e-2 * np.sqrt(np.mean(np.abs(h) ** 2))
    noisy = h + sigma / np.sqrt(2) * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape))
    ratio = np.median(roughness_variance(noisy), axis=2) / sigma**2
    assert np.all((ratio > 0.85) & (ratio < 2)), ratio

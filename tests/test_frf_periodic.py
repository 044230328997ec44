"""Periodic excitation: FRFs of whole steady periods at the excited lines, with noise and distortion apart, against the analytic chain."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from operando import estimate_frf
from operando.data import Channel, TimeRecord
from operando.dof import Dof
from operando.errors import DataError
from operando.frf import check_frf, excitation, is_periodic
from operando.frf.periodic import clock_drift, excited_lines, period_of, periodic_frf, steady_periods
from operando.quality import check_record
from structures import Chain

SHARED = Path(__file__).resolve().parents[1].parent / "shared"
FS, PERIOD = 256.0, 2048
LINES = np.arange(80, 641)  # 10 to 80 Hz
WITHIN_95 = -np.log(0.05)
"""A complex error lies within 95 % where |ΔH|² is below this many times its variance."""


def multisine(rng, lines=LINES, period=PERIOD, rms=10.0, dip=None):
    """One period of a random-phase multisine; ``dip`` scales its lines."""
    spectrum = np.zeros(period // 2 + 1, complex)
    spectrum[lines] = np.exp(2j * np.pi * rng.uniform(size=lines.size)) * (1.0 if dip is None else dip)
    f = np.fft.irfft(spectrum, period)
    return f * rms / f.std()


def shaken(chain, drives, force, periods, rng, noise=0.0, start=0, distortion=0.0, name="run"):
    """Record of a chain that is at rest when periodic forces (drives, period) begin; starts ``start`` samples into a period.

    The response is the steady one, from the exact FRF, and a free decay that makes it begin at rest (near enough: from unit pulses);
    ``distortion`` repeats in each period and is a part of the spectrum line by line.
    """
    n = force.shape[1]
    hz = np.fft.rfftfreq(n, 1 / FS)
    spectrum = np.einsum("ijl,jl->il", chain.accelerance(hz, ref=[d - 1 for d in drives]), np.fft.rfft(force, axis=1))
    extra = rng.normal(size=spectrum.shape) + 1j * rng.normal(size=spectrum.shape)
    spectrum = spectrum + distortion / np.sqrt(2) * extra * np.abs(spectrum)
    steady = np.fft.irfft(spectrum, n, axis=1)
    total = periods * n + start
    x = np.tile(steady, (1, periods + 1))[:, n - start :][:, :total] if start else np.tile(steady, (1, periods))
    t = np.arange(total) / FS
    for r, (w, z) in enumerate(zip(2 * np.pi * chain.hz, chain.zeta, strict=True)):
        free = np.exp(-z * w * t) * np.cos(w * t + rng.uniform(0, 2 * np.pi))
        x = x + np.outer(chain.phi[:, r], free) * 0.5 * x.std() / np.abs(chain.phi[:, r]).max()
    f = np.tile(force, (1, periods + 1))[:, n - start :][:, :total] if start else np.tile(force, (1, periods))
    x = x + noise * x.std(axis=1, keepdims=True) * rng.standard_normal(x.shape)
    channels = [Channel(Dof(d, "Z"), "force", "N") for d in drives]
    channels += [Channel(Dof(i + 1, "Z"), "acceleration", "m/s2") for i in range(x.shape[0])]
    return TimeRecord(np.vstack([f, x]), FS, tuple(channels), name=name)


def inside(frf, exact):
    """Share of the errors within their 95 % interval."""
    return float(np.mean(np.abs(frf.data - exact) ** 2 < WITHIN_95 * frf.variance))


@pytest.mark.parametrize("start", [0, 777])
def test_default_estimate_uses_excited_lines_of_steady_periods(start):
    rng = np.random.default_rng(1)
    chain = Chain(4, zeta=0.006)
    record = shaken(chain, [1], multisine(rng)[None], 7, rng, noise=0.01, start=start)
    frf = estimate_frf(record)
    np.testing.assert_allclose(frf.frequencies_hz, LINES * FS / PERIOD)
    assert "periodic" in frf.provenance.calls[-1]
    told = next(f for f in frf.findings if f.kind == "periodic_excitation")
    assert f"{PERIOD} samples" in told.message
    assert "7 whole periods" in told.message
    assert ("left out at the start" in told.message) == (start == 0)  # the part before the first whole period outlasts the transient
    assert told.band_hz == pytest.approx((10.0, 80.0))
    assert frf.averages == (6 if start == 0 else 7)
    exact = chain.accelerance(frf.frequencies_hz, ref=[0])
    expected = 0.01 * np.sqrt(LINES.size / (PERIOD / 2) / frf.averages)  # the noise of one period falls on all its lines
    assert np.sqrt(np.sum(np.abs(frf.data - exact) ** 2) / np.sum(np.abs(exact) ** 2)) < 1.5 * expected
    kinds = {f.kind for f in check_frf(frf).findings}
    assert not kinds & {"low_coherence", "drive_point_sign", "inverted", "nonlinear", "nonlinear_distortion"}


def test_peaks_that_come_back_in_each_period_are_no_cut_signal():
    for seed in range(12):
        rng = np.random.default_rng(seed)
        force = multisine(rng)
        record = shaken(Chain(4, zeta=0.01), [1], force[None], 20, rng, noise=0.003)
        assert check_record(record).findings == ()
        cut = np.clip(force, -0.5 * np.abs(force).max(), 0.5 * np.abs(force).max())
        found = check_record(replace(record, data=np.vstack([np.tile(cut, 20)[None], record.data[1:]]))).findings
        assert [(f.kind, f.dof) for f in found] == [("overload", "1+Z")]


def test_variance_covers_the_error_against_truth():
    """95 % intervals hold 90 to 98 % of the errors, from four periods as from ten, with noise alone and with distortion."""
    for periods, distortion in ((4, 0.0), (10, 0.0), (10, 0.05)):
        shares = []
        for seed in range(6):
            rng = np.random.default_rng(seed)
            chain = Chain(4, zeta=0.008)
            frf = estimate_frf(shaken(chain, [1], multisine(rng)[None], periods, rng, noise=0.02, distortion=distortion))
            shares.append(inside(frf, chain.accelerance(frf.frequencies_hz, ref=[0])))
        assert 0.90 < np.mean(shares) < 0.98, (periods, distortion, shares)


def test_size_of_the_distortion():
    """Within 20 % of what was put in, and none where there is none."""
    ratios = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        chain = Chain(4, zeta=0.02)
        record = shaken(chain, [1], multisine(rng)[None], 10, rng, noise=0.002, distortion=0.03)
        found = periodic_frf([steady_periods(record.data, [0], range(1, 5), FS)])
        exact = np.abs(chain.accelerance(found.frequencies_hz, ref=[0])) ** 2
        ratios.append(np.sqrt(np.median(found.distortion / exact, axis=2) / 0.03**2))
        frf = estimate_frf(record)
        (told,) = [f for f in frf.findings if f.kind == "nonlinear_distortion"]
        assert told.severity == "warning"
        assert "30 dB below" in told.message or "31 dB below" in told.message or "29 dB below" in told.message, told.message
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.2)


def test_distortion_below_what_sensors_can_tell_is_a_remark():
    """0.5 % of the response, well above the noise."""
    rng = np.random.default_rng(0)
    record = shaken(Chain(4, zeta=0.02), [1], multisine(rng)[None], 10, rng, noise=0.0003, distortion=0.005)
    (told,) = [f for f in estimate_frf(record).findings if f.kind == "nonlinear_distortion"]
    assert told.severity == "info"


@pytest.mark.parametrize(("name", "of_limit", "severity"), [
    ("MATTERS_DB", 3.0, "info"), ("MATTERS_DB", -3.0, "warning"), ("CLEAR", 1.3, "info"), ("CLEAR", 0.7, "warning"),
])  # fmt: skip
def test_distortion_is_a_warning_where_it_is_large_and_clear_of_the_noise(monkeypatch, name, of_limit, severity):
    """3 % of the response, 30 dB below it: either side of each limit."""
    assert (excitation.MATTERS_DB, excitation.CLEAR) == (-40.0, 10.0)
    rng = np.random.default_rng(0)
    record = shaken(Chain(4, zeta=0.02), [1], multisine(rng)[None], 10, rng, noise=0.002, distortion=0.03)
    size = lambda: next(f for f in estimate_frf(record).findings if f.kind == "nonlinear_distortion")  # noqa: E731
    below, above = (float(x.split(" dB")[0].split()[-1]) for x in (size().message, size().message.split("(largest), ")[1]))
    monkeypatch.setattr(excitation, name, -below + of_limit if name == "MATTERS_DB" else of_limit * 10 ** (above / 10))
    assert size().severity == severity


def test_distortion_of_a_nonlinear_chain_is_what_other_phases_scatter_by():
    """The variance of one realisation against the scatter over realisations: a cubic spring between two masses, integrated."""
    rng = np.random.default_rng(0)
    force, motion, hz = cubic_chain(16, rng)
    found = [periodic_frf([steady_periods(np.vstack([f, x]), [0], [1, 2], 64.0, 1024)]) for f, x in zip(force, motion, strict=True)]
    h = np.array([p.data[:, 0] for p in found])
    scatter = h.var(axis=0, ddof=1)
    total = np.median([p.variance[:, 0] for p in found], axis=0)
    assert np.median(np.log10(total / scatter)) == pytest.approx(0.0, abs=0.15)
    assert hz.size == 2


def test_realisations_show_the_distortion_at_peaks_and_repeated_phases_do_not_average_it():
    """Six realisations against the mean of ten others; and three repetitions of one."""
    rng = np.random.default_rng(1)
    force, motion, _ = cubic_chain(16, rng)
    channels = (
        Channel(Dof(1, "Z"), "force", "N"),
        Channel(Dof(1, "Z"), "acceleration", "m/s2"),
        Channel(Dof(2, "Z"), "acceleration", "m/s2"),
    )
    runs = [TimeRecord(np.vstack([f, x]), 64.0, channels, name=f"{k}") for k, (f, x) in enumerate(zip(force, motion, strict=True))]
    some, others = estimate_frf(runs[:6]), estimate_frf(runs[6:])
    assert not any(f.kind == "nonlinear" for f in (*some.findings, *others.findings))
    error = np.abs(some.data - others.data) ** 2
    expected = some.variance + others.variance
    assert 0.90 < np.mean(error < WITHIN_95 * expected) < 0.98
    peaks = np.abs(others.data) > 0.5 * np.abs(others.data).max(axis=2, keepdims=True)
    assert 0.6 < np.sqrt(error[peaks].sum() / expected[peaks].sum()) < 1.6
    again = []
    for k in range(3):
        shifted = np.roll(np.array(runs[0].data), 100 * k, axis=1)
        again.append(replace(runs[0], data=shifted + 1e-3 * shifted.std() * rng.standard_normal(shifted.shape), name=f"again {k}"))
    single, repeated = estimate_frf(again[0]), estimate_frf(again)
    assert np.median(repeated.variance / single.variance) > 0.6


def cubic_chain(realisations, rng):
    """Two masses with a cubic spring between them under a full multisine: (M, N) force, (M, 2, N) accelerations at 64 Hz, modes [Hz]."""
    n, periods, sub, fs = 1024, 4, 6, 64.0
    k = np.array([[2.0, -1.0], [-1.0, 1.0]]) * 1500
    w2, phi = np.linalg.eigh(k)
    c = phi @ np.diag(2 * 0.015 * np.sqrt(w2)) @ phi.T
    spectrum = np.zeros((realisations, n * sub + 1), complex)
    spectrum[:, 32:260] = np.exp(2j * np.pi * rng.uniform(size=(realisations, 228)))
    f = np.fft.irfft(spectrum, 2 * n * sub, axis=1)
    f *= 3.0 / f.std(axis=1, keepdims=True)
    h, e, b = 1 / (fs * sub), np.array([1.0, 0.0]), np.array([1.0, -1.0])
    x, v, out = np.zeros((realisations, 2)), np.zeros((realisations, 2)), np.empty((realisations, 2, periods * n))

    def acceleration(x, v, u):
        return u[:, None] * e - v @ c - x @ k - 3e4 * ((x @ b) ** 3)[:, None] * b

    for i in range(periods * n * sub):
        at = 2 * i % f.shape[1]
        f0, f1, f2 = f[:, at], f[:, at + 1], f[:, (at + 2) % f.shape[1]]
        a1 = acceleration(x, v, f0)
        if i % sub == 0:
            out[:, :, i // sub] = a1
        a2 = acceleration(x + h / 2 * v, v + h / 2 * a1, f1)
        a3 = acceleration(x + h / 2 * (v + h / 2 * a1), v + h / 2 * a2, f1)
        a4 = acceleration(x + h * (v + h / 2 * a2), v + h * a3, f2)
        x, v = x + h * v + h * h / 6 * (a1 + a2 + a3), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    out += 1e-3 * out.std() * rng.standard_normal(out.shape)
    return np.tile(f[:, :: 2 * sub], (1, periods)), out, np.sqrt(w2) / 2 / np.pi


def test_lines_left_out_of_a_multisine_are_left_out_of_the_frf():
    rng = np.random.default_rng(3)
    odd = LINES[(LINES % 2 == 1) & (LINES % 8 != 1)]
    chain = Chain(3, zeta=0.01)
    frf = estimate_frf(shaken(chain, [2], multisine(rng, odd)[None], 6, rng, noise=0.01))
    np.testing.assert_allclose(frf.frequencies_hz, odd * FS / PERIOD)
    assert frf.axis.step is None
    assert inside(frf, chain.accelerance(frf.frequencies_hz, ref=[1])) > 0.9


def test_a_force_that_falls_at_a_resonance_is_still_excited_and_hum_beside_it_is_not():
    amplitude = np.full(1000, 1e-3)
    amplitude[100:600] = 1.0
    k = np.arange(1000)
    amplitude /= 1 + 99 * np.exp(-0.5 * ((k - 300) / 5) ** 2)  # 40 dB
    amplitude[800] = 0.2  # hum
    found = excited_lines(amplitude)
    np.testing.assert_array_equal(np.flatnonzero(found), np.arange(100, 600))


def test_period_is_found_with_noise_and_silence_and_refused_for_noise():
    rng = np.random.default_rng(5)
    f = np.tile(multisine(rng), 6)
    assert period_of(f) == PERIOD
    quiet = np.concatenate([np.zeros(1500), f + 0.1 * f.std() * rng.standard_normal(f.size), np.zeros(900)])
    assert period_of(quiet + 0.01 * rng.standard_normal(quiet.size)) == PERIOD
    with pytest.raises(DataError, match="repeat"):
        period_of(rng.standard_normal(20000))


def test_only_periodic_records_are_called_periodic():
    rng = np.random.default_rng(6)
    chain = Chain(2, zeta=0.02)
    record = shaken(chain, [1], multisine(rng)[None], 4, rng)
    assert is_periodic(record)

    def with_force(force):
        data = np.array(record.data)
        data[0] = force
        return TimeRecord(data, FS, record.channels)

    t = np.arange(record.n_samples) / FS
    assert not is_periodic(with_force(rng.standard_normal(t.size)))
    assert not is_periodic(with_force(np.sin(2 * np.pi * 20 * t)))  # one tone is no multisine
    assert not is_periodic(with_force(np.sin(2 * np.pi * (5 * t + 1.0 * t**2))))  # one sweep
    assert is_periodic(with_force(np.tile(np.sin(2 * np.pi * (5 * t[:PERIOD] + 4.0 * t[:PERIOD] ** 2)), 4)))  # a periodic chirp


def test_two_shakers_need_two_runs():
    rng = np.random.default_rng(7)
    chain = Chain(4, zeta=0.01)
    runs = [shaken(chain, [1, 3], np.stack([multisine(rng), multisine(rng)]), 6, rng, noise=0.01, name=f"phases {i}") for i in range(2)]
    frf = estimate_frf(runs)
    assert "periodic" in frf.provenance.calls[-1]
    assert inside(frf, chain.accelerance(frf.frequencies_hz, ref=[0, 2])) > 0.88
    with pytest.raises(DataError, match="several forces"):
        estimate_frf(runs[:1], estimator="periodic")


def test_references_on_one_grid_are_merged_and_realisations_averaged():
    rng = np.random.default_rng(8)
    chain = Chain(4, zeta=0.01)
    runs = [shaken(chain, [d], multisine(rng)[None], 6, rng, noise=0.02, name=f"{d}{k}") for d in (1, 3) for k in range(2)]
    frf = estimate_frf(runs)
    assert [str(d) for d in frf.references] == ["1+Z", "3+Z"]
    assert not any(f.kind == "nonlinear" for f in frf.findings)
    assert 0.9 < inside(frf, chain.accelerance(frf.frequencies_hz, ref=[0, 2])) < 0.985
    single = estimate_frf([runs[0], runs[2]])
    assert np.median(frf.variance / single.variance) == pytest.approx(0.5, rel=0.3)
    other = shaken(chain, [3], multisine(rng, LINES, 1536)[None], 6, rng)
    with pytest.raises(DataError, match="share"):
        estimate_frf([runs[0], other])


def test_a_random_run_joins_periodic_ones_on_their_lines():
    rng = np.random.default_rng(9)
    chain = Chain(3, zeta=0.02)
    periodic = shaken(chain, [1], multisine(rng)[None], 6, rng, noise=0.005)
    noise = multisine(rng, np.arange(200, 16000), 32768)[None]
    random = shaken(chain, [3], noise, 1, rng, noise=0.005)
    frf = estimate_frf([periodic, random])
    np.testing.assert_allclose(frf.frequencies_hz, LINES * FS / PERIOD)
    exact = chain.accelerance(frf.frequencies_hz, ref=[0, 2])
    assert np.sqrt(np.sum(np.abs(frf.data - exact) ** 2) / np.sum(np.abs(exact) ** 2)) < 0.01


@pytest.mark.parametrize("drift", [0.0, 0.31, -0.4])
def test_a_generator_with_a_clock_of_its_own(drift):
    """A period that is no whole number of samples is resampled: without, its lines leak into each other (last assertion)."""
    rng = np.random.default_rng(12)
    chain = Chain(4, zeta=0.004)
    period = PERIOD + drift
    hz, phase = LINES * FS / period, rng.uniform(0, 2 * np.pi, LINES.size)
    t = np.arange(int(6.5 * PERIOD)) / FS
    tones = np.exp(1j * (2 * np.pi * np.outer(hz, t) + phase[:, None]))
    force = tones.real.sum(axis=0)
    x = np.real(chain.accelerance(hz, ref=[0])[:, 0] @ tones)
    x = x + 1e-3 * x.std(axis=1, keepdims=True) * rng.standard_normal(x.shape)
    record = TimeRecord(
        np.vstack([force[None], x]),
        FS,
        (Channel(Dof(1, "Z"), "force", "N"), *(Channel(Dof(i, "Z"), "acceleration", "m/s2") for i in range(1, 5))),
    )
    frf = estimate_frf(record)
    assert clock_drift(force, PERIOD) == pytest.approx(drift, abs=0.01)
    np.testing.assert_allclose(frf.frequencies_hz, hz, rtol=1e-6)

    def error(hz, h):
        truth = chain.accelerance(hz, ref=[0])
        return np.sqrt(np.sum(np.abs(h - truth) ** 2) / np.sum(np.abs(truth) ** 2))

    assert error(frf.frequencies_hz, frf.data) < 2e-3
    whole = periodic_frf([steady_periods(record.data, [0], range(1, 5), FS, PERIOD)])
    assert drift == 0 or error(whole.frequencies_hz, whole.data) > 5 * error(frf.frequencies_hz, frf.data)


def test_asked_for_without_a_period():
    rng = np.random.default_rng(10)
    record = shaken(Chain(2), [1], rng.standard_normal((1, 4096)), 1, rng)
    with pytest.raises(DataError, match="do not repeat"):
        estimate_frf(record, estimator="periodic")


def test_periods_with_bad_samples_are_left_out():
    rng = np.random.default_rng(11)
    chain = Chain(3, zeta=0.01)
    record = shaken(chain, [1], multisine(rng)[None], 8, rng, noise=0.01)
    steady = steady_periods(record.data, [0], [1, 2, 3], FS, bad=[(5 * PERIOD + 100, 5 * PERIOD + 120)])
    assert steady.whole == 8
    assert steady.count == 8 - steady.discarded
    assert steady.discarded >= 2


def test_the_aircraft_by_default():
    """F-16 ground vibration test, level 1: 2 to 15 Hz, no finding that the lines without force would make."""
    path = SHARED / "data" / "f16" / "F16Data_FullMSine_Level1.csv"
    if not path.exists():
        pytest.skip("the measured data are not here (../shared)")
    data = np.genfromtxt(path, delimiter=",", skip_header=1, usecols=(0, 2, 3, 4)).T
    channels = [Channel(Dof(1, "Z"), "force", "N"), *(Channel(Dof(i, "Z"), "acceleration", "m/s2") for i in (1, 2, 3))]
    frf = check_frf(estimate_frf(TimeRecord(data, 400.0, tuple(channels))))
    assert frf.frequencies_hz[[0, -1]] == pytest.approx([2.0, 15.0], abs=0.05)
    assert {f.kind for f in frf.findings} == {"periodic_excitation", "nonlinear_distortion"}
    assert {f.kind: f.severity for f in frf.findings}["nonlinear_distortion"] == "warning"  # 31 dB below the response
    assert np.median(frf.coherence[0, 0]) > 0.99


def test_the_interval_is_that_of_a_complex_error():
    """|ΔH|² over its variance is exponentially distributed: the limit used above is its 95 % point."""
    assert stats.expon.cdf(WITHIN_95) == pytest.approx(0.95)

"""The excitation as it is: excited band, bursts and sweeps, faulty channels, cut forces, many single hits, findings said once."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import resample_poly

from operando import estimate_frf
from operando.config import load_test
from operando.data import Channel, Finding, TimeRecord, group_findings
from operando.dof import Dof
from operando.ema.spectra import excited_limits
from operando.errors import DataError
from operando.frf import check_frf, find_hits, trimmed, usable_channels
from operando.frf.rational import roughness_variance
from operando.frf.remaining import remaining_share
from operando.io import read, write_uff
from operando.pipeline import run
from operando.pipeline.stages import runs_behind
from operando.quality import check_record, pile_up
from operando.scaffold import scaffold, write_test
from structures import Chain
from test_frf_estimate import make_record, relative, sampled_accelerance, simulate

FS = 512.0
SECONDS = 60
EXAMPLE = Path(__file__).resolve().parents[1] / "data" / "example"
SHARED = Path(__file__).resolve().parents[1].parent / "shared"


def limited(force, low=0.0, high=np.inf):
    """The force without power outside a band, but for slopes of 72 dB an octave."""
    hz = np.fft.rfftfreq(force.size, 1 / FS)
    gain = 1 / np.sqrt(1 + (hz / high) ** 24 + (low / np.maximum(hz, 1e-9)) ** 24)
    return np.fft.irfft(np.fft.rfft(force) * gain, force.size)


def driven(force, chain=None, noise=0.01, force_noise=1e-4, seed=0):
    """Record of a chain at rest that a force at its first mass drives."""
    rng = np.random.default_rng(seed)
    chain = chain or Chain(5, zeta=0.01)
    forces = np.zeros((len(chain.hz), force.size))
    forces[0] = force
    x = chain.respond(forces, FS)
    x = x + noise * x.std(axis=1, keepdims=True) * rng.standard_normal(x.shape)
    return make_record((force + force_noise * force.std() * rng.standard_normal(force.size))[None], x, FS, [1])


def exact(frf, chain=None):
    chain = chain or Chain(5, zeta=0.01)
    return sampled_accelerance(chain, frf.frequencies_hz, FS, range(len(chain.hz)), [0])


@pytest.fixture(scope="module")
def white():
    return np.random.default_rng(3).standard_normal(int(SECONDS * FS))


def test_a_force_over_the_whole_band_leaves_out_no_line(white):
    frf = estimate_frf(driven(white))
    assert not any(f.kind == "excited_band" for f in frf.findings)


@pytest.mark.parametrize("estimator", [None, "h1"])
@pytest.mark.parametrize("low", [0.0, 20.0])
def test_lines_without_force_are_left_out(white, estimator, low):
    """A shaker to 60 Hz: its force is 40 dB down at 88 Hz (24th order), and there the FRF ends."""
    chain = Chain(5, zeta=0.03)
    frf = check_frf(estimate_frf(driven(limited(white, low, 60.0), chain), estimator=estimator))
    (finding,) = [f for f in frf.findings if f.kind == "excited_band"]
    assert finding.severity == "info"
    assert finding.band_hz == pytest.approx((frf.frequencies_hz[0], frf.frequencies_hz[-1]))
    assert 60 < frf.frequencies_hz[-1] < 95
    assert frf.frequencies_hz[0] == pytest.approx(0.0, abs=0.2) if not low else 12 < frf.frequencies_hz[0] < 20
    assert not {f.kind for f in frf.findings} & {"low_coherence", "drive_point_sign", "inverted"}
    assert relative(frf.data, exact(frf, chain)) < 0.04


def test_the_fit_of_records_ends_where_the_force_does(white):
    record = driven(limited(white, 20.0, 60.0))
    low, high = excited_limits(record, (5.0, 150.0))
    assert 14 < low < 20
    assert 60 < high < 75
    assert excited_limits(driven(white), (5.0, 150.0)) == pytest.approx((0.0, 0.92 * FS / 2))


def test_references_with_different_bands_share_the_common_one(white):
    chain = Chain(5, zeta=0.02)
    first = driven(limited(white, 0.0, 60.0), chain)
    second = driven(limited(white, 30.0), chain)
    moved = replace(second, channels=(Channel(Dof(2, "Z"), "force", "N"), *second.channels[1:]))
    frf = estimate_frf([first, moved])
    assert 20 < frf.frequencies_hz[0] < 30
    assert 60 < frf.frequencies_hz[-1] < 95
    assert np.isfinite(frf.data).all()


@pytest.mark.parametrize("kind", ["burst", "sweep", "stepped"])
def test_bursts_sweeps_and_steps_are_estimated_without_leakage(kind, white):
    """Each within the band it excites; the error is that of the noise, and its 95 % intervals hold."""
    n = white.size
    t = np.arange(n) / FS
    run_time = 0.85 * SECONDS  # the response decays before the record ends
    if kind == "burst":
        force = white * (np.arange(n) % int(6 * FS) < 3 * FS)
    elif kind == "sweep":
        force = 10 * np.sin(2 * np.pi * (20 * t + 30 / run_time * t**2)) * ((t > 0.5) & (t < run_time))
    else:
        hz = 20 + np.floor(t / run_time * 60)
        force = 10 * np.sin(2 * np.pi * np.cumsum(hz) / FS) * ((t > 0.5) & (t < run_time))
    frf = estimate_frf(driven(force))
    if kind != "burst":
        # a transient cannot be told from what is swept at the very beginning; steps and abrupt ends have side lobes less than 40 dB down
        assert 17 < frf.frequencies_hz[0] < 28
        assert 74 < frf.frequencies_hz[-1] < 100
    truth = exact(frf)
    assert relative(frf.data, truth) < 0.05
    error = np.abs(frf.data - truth) ** 2
    assert np.sqrt(error.sum() / frf.variance.sum()) < 1.3
    assert np.mean(error < -np.log(0.05) * frf.variance) > 0.88


# --- faulty channels


def test_a_faulty_response_is_left_out_of_all_runs_and_said_once(white):
    runs = [replace(driven(white[:8192], seed=k), name=f"run{k}") for k in range(3)]
    data = np.array(runs[1].data)
    data[3, [10, 11, 4000]] = np.nan
    data[5] = 0.0
    runs[1] = replace(runs[1], data=data)
    usable, findings = usable_channels(runs)
    assert [(f.kind, f.dof, f.file) for f in findings] == [("nan", "3+Z", "run1"), ("flat", "5+Z", "run1")]
    assert "3 of 8192 samples" in findings[0].message
    assert "others of its state" in findings[0].message
    for record in usable:
        assert [c.label for c in record.channels] == ["1+Z", "1+Z", "2+Z", "4+Z"]
    assert usable_channels(usable) == (usable, [])


def test_one_fault_in_many_runs_costs_these_runs_alone(white):
    """SPARED_SHARE: a roving hammer keeps its sensors where one file of a dozen is damaged."""
    runs = [replace(driven(white[:2048], seed=k), name=f"hit{k}") for k in range(12)]
    data = np.array(runs[4].data)
    data[2, 7] = np.nan
    runs[4] = replace(runs[4], data=data)
    usable, (finding,) = usable_channels(runs)
    assert [len(r.channels) for r in usable] == [6] * 4 + [5] + [6] * 7
    assert "others of its state" not in finding.message


def test_a_run_with_a_faulty_force_is_left_out_where_another_has_it(white):
    runs = [replace(driven(white[:4096], seed=k), name=f"run{k}") for k in range(2)]
    data = np.array(runs[0].data)
    data[0, 5] = np.nan
    broken = replace(runs[0], data=data)
    usable, (finding,) = usable_channels([broken, runs[1]])
    assert [r.name for r in usable] == ["run1"]
    assert (finding.kind, finding.file) == ("run_left_out", "run0")
    assert usable_channels([broken]) == ([broken], [])  # nothing else is there: the stages say what they need


def test_ends_without_any_number_are_cut(white):
    record = driven(white[:4096])
    data = np.array(record.data)
    data[:, -100:] = np.nan
    cut, (finding,) = trimmed(replace(record, data=data))
    assert cut.n_samples == 3996
    assert "100 samples" in finding.message
    assert trimmed(record) == (record, [])


def test_records_given_to_the_fit_hold_the_channels_of_the_frfs(white):
    record = driven(white[:8192])
    frf = estimate_frf(record)
    (same,) = runs_behind(frf, [record])
    assert same is record
    (part,) = runs_behind(frf.select(responses="1+Z,2+Z,4+Z"), [record])
    assert [c.label for c in part.channels] == ["1+Z", "1+Z", "2+Z", "4+Z"]


@pytest.mark.skipif(not EXAMPLE.is_dir(), reason="the example is not here")
def test_three_nan_give_the_modes_without_that_channel(tmp_path):
    """Two runs of the example with three NaN in one response of one, against those with that channel excluded by hand."""
    for name in ("nan", "excluded"):
        shutil.copytree(EXAMPLE / "idle", tmp_path / name / "idle", ignore=shutil.ignore_patterns("hammer3.uff"))
        text = 'name = "t"\n[idle]\nrecords = ["idle/*.uff"]\n[analysis]\nband = [5.0, 40.0]\n'
        if name == "excluded":
            text += '[channels]\n"5+Z" = {exclude = true, reason = "to compare"}\n'
        else:
            file = tmp_path / name / "idle" / "hammer2.uff"
            (record,) = read(file).records
            (row,) = [i for i in record.response_indices if record.channels[i].label == "5+Z"]
            data = np.array(record.data)
            data[row, [1000, 1001, 20000]] = np.nan
            write_uff(file, replace(record, data=data))
        (tmp_path / name / "test.toml").write_text(text, encoding="utf-8")
    found = {name: run(tmp_path / name / "test.toml", tmp_path / name / "out", until="ema") for name in ("nan", "excluded")}
    faulty, excluded = found["nan"].idle, found["excluded"].idle
    assert faulty is not None
    assert excluded is not None
    np.testing.assert_allclose(faulty.frequencies_hz, excluded.frequencies_hz, rtol=1e-6)
    np.testing.assert_allclose(faulty.damping_ratios, excluded.damping_ratios, rtol=1e-3)
    assert [f.dof for f in found["nan"].findings if f.kind == "nan"] == ["5+Z"]
    assert "5+Z" not in map(str, faulty.dofs)


# --- forces that are cut


@pytest.mark.parametrize("high", [60.0, 400.0])
def test_a_cut_force_is_found_and_its_effect_stated(white, high):
    """A force cut at 40 % of its peak, with and without noise on top of the cut: the FRF is estimated, and as wrong as stated."""
    force = limited(white, 0.0, high)
    limit = 0.4 * np.abs(force).max()
    record = driven(force)
    for noise in (0.0, 0.003):
        measured = np.clip(force, -limit, limit) + noise * limit * np.random.default_rng(1).standard_normal(force.size)
        checked = check_record(replace(record, data=np.vstack([measured[None], record.data[1:]])))
        (finding,) = [f for f in checked.findings if f.dof == "1+Z" and f.kind == "overload"]
        assert "too large" in finding.consequence
        frf = estimate_frf(checked)
        if high > FS / 2:  # the statement is for a normally distributed force whose distortion falls on all lines alike
            stated = float(finding.consequence.split("about ")[1].split(" dB")[0])
            truth = exact(frf)
            peaks = np.abs(truth) > 5 * np.median(np.abs(truth))
            assert np.median(20 * np.log10(np.abs(frf.data / truth)[peaks])) == pytest.approx(stated, abs=0.1)


def test_tones_sweeps_and_digitised_signals_are_not_called_cut():
    t = np.arange(40000) / FS
    rng = np.random.default_rng(0)
    signals = {
        "sine": np.sin(2 * np.pi * 11.3 * t),
        "sweep": np.sin(2 * np.pi * (5 * t + 1.0 * t**2)),
        "flat-topped wave": np.sin(2 * np.pi * 11.3 * t) + np.sin(2 * np.pi * 33.9 * t) / 9,
        "uniform": rng.uniform(-1, 1, t.size),
        "normal": rng.standard_normal(t.size),
        "two levels": np.sign(rng.standard_normal(t.size)) + 1e-3 * rng.standard_normal(t.size),
    }
    for name, x in signals.items():
        assert pile_up(x) is None, name
        for counts in (30, 1000):
            assert pile_up(np.round(x / np.abs(x).max() * counts)) is None or name == "two levels", (name, counts)
        if name in ("uniform", "normal", "sine"):
            assert pile_up(np.minimum(x, 0.6 * x.max())) is not None, name


@pytest.mark.parametrize("samples", [10, 20])
def test_flat_topped_pulses_are_cut_ones(samples):
    """FLAT_TOP: half sines pass, also with noise; those cut at 70 % of their peak do not."""
    rng = np.random.default_rng(samples)
    force = np.zeros(20000)
    for at in (500, 5500, 10500, 15500):
        force[at : at + samples + 1] += 100 * np.sin(np.pi * np.arange(samples + 1) / samples)
    for noise in (0.0, 0.3):
        top = noise * rng.standard_normal(force.size)
        assert find_hits(force + top, FS).used.all()
        assert set(find_hits(np.minimum(force, 70.0) + top, FS).reasons) == {"overload"}, noise


def test_hits_that_are_all_cut_are_used_and_said():
    force = np.zeros((3, 16384))
    for at in (300, 4400, 8400, 12500):
        force[0, at : at + 11] = 100 * np.sin(np.pi * np.arange(11) / 10)
    x = Chain(3, zeta=0.03).respond(force, FS)
    record = check_record(make_record(np.minimum(force[:1], 40), x, FS, [1]))
    frf = estimate_frf(record)
    assert np.isfinite(frf.data).all()
    assert [f.kind for f in frf.findings if f.severity == "error"] == ["overload"]


# --- single hits in many files


def single_hit(point, sensors, shapes, hz, zeta, rng, fs=1024.0, seconds=3.0, noise=1.0):
    """Accelerations of a beam to one half-sine pulse, with sensor noise, an offset and hum; anti-aliased."""
    n, over = int(fs * seconds), 8
    t = np.arange(n * over) / (fs * over)
    start, length = 0.08 + 0.01 * rng.uniform(), 0.003 * rng.uniform(0.9, 1.1)
    pulse = np.where((t > start) & (t < start + length), 100 * rng.uniform(0.8, 1.2) * np.sin(np.pi * (t - start) / length), 0)
    line = np.fft.rfftfreq(2 * t.size, 1 / (fs * over))
    w, spectrum = 2 * np.pi * line, np.fft.rfft(pulse, 2 * t.size)
    x = np.zeros((len(sensors), t.size))
    for r, (f, z) in enumerate(zip(2 * np.pi * hz, zeta, strict=True)):
        modal = np.fft.irfft(-(w**2) / (f**2 - w**2 + 2j * z * f * w) * spectrum)[: t.size]
        x += np.outer(shapes[sensors, r] * shapes[point, r], modal)
    x, force = resample_poly(x, 1, over, axis=1), resample_poly(pulse, 1, over)
    hum = 0.004 * np.sin(2 * np.pi * 50 * np.arange(n) / fs + rng.uniform(0, 6))
    x = x + noise * (hum + 0.004 * rng.standard_normal(x.shape)) + 0.05 * rng.standard_normal((len(sensors), 1))
    force = force + 0.1 + 0.005 * rng.standard_normal(n)
    channels = [Channel(Dof(point + 1, "Z"), "force", "N"), *(Channel(Dof(s + 1, "Z"), "acceleration", "m/s2") for s in sensors)]
    return TimeRecord(np.vstack([force, x]), fs, tuple(channels))


@pytest.fixture(scope="module")
def beam():
    position = np.linspace(0.03, 0.97, 100)
    shapes = np.sqrt(2 / 6.0) * np.sin(np.outer(position, np.pi * np.arange(1, 5)))
    return shapes, np.array([31.0, 84.0, 171.0, 290.0]), np.array([0.012, 0.009, 0.01, 0.008])


def test_a_hundred_good_hits_in_files_give_few_findings(beam, tmp_path):
    """Roving hammer over 100 points, three accelerometers on three of them: no finding about each file."""
    rng = np.random.default_rng(0)
    (tmp_path / "idle").mkdir()
    for point in range(100):
        write_uff(tmp_path / "idle" / f"hit{point:03d}.uff", single_hit(point, [10, 36, 79], *beam, rng))
    text = 'name = "beam"\n[idle]\nrecords = ["idle/*.uff"]\n[analysis]\nband = [15.0, 400.0]\n'
    (tmp_path / "test.toml").write_text(text, encoding="utf-8")
    results = run(tmp_path / "test.toml", tmp_path / "out", until="frf")
    assert len(results.findings) < 10, [f.message for f in results.findings]
    (drive,) = [f for f in results.findings if f.kind == "missing_drive_point"]
    assert drive.severity == "info"
    assert "97 reference DOFs" in drive.message
    assert not {f.kind for f in results.findings} & {"truncated_response", "not_reciprocal", "nonlinear", "low_coherence"}


def test_hum_is_no_ringing_and_ringing_is(beam):
    shapes, hz, zeta = beam
    rng = np.random.default_rng(1)
    for seconds, damping, rings in ((3.0, zeta, False), (3.0, zeta / 8, True)):
        record = single_hit(20, [10, 36], shapes, hz, damping, rng, seconds=seconds, noise=20.0 if not rings else 1.0)
        share, at = remaining_share(record.data, [1, 2], np.array([0]), record.n_samples, record.sampling_hz, None, 80)
        assert (share > 0.01) is rings
        assert not rings or min(abs(at - f) for f in hz) < 2


def many_rows(beam, hum, noise, slower=1.0, rows=1500):
    """One hit as ``rows`` sensors at one point see it, each with its own hum and noise, as (rows, samples)."""
    shapes, hz, zeta = beam
    clean = single_hit(20, [79], shapes, hz, zeta / slower, np.random.default_rng(1), noise=0.0).data[1]
    rng, t = np.random.default_rng(2), np.arange(clean.size) / 1024
    return clean + hum * np.sin(2 * np.pi * 50 * t + rng.uniform(0, 6, (rows, 1))) + noise * rng.standard_normal((rows, t.size))


def rings(data, rows, quiet=80):
    """Share that one of these rows keeps, with up to 80 samples before the hit to tell what was there."""
    start = min(20, quiet - 1)
    return remaining_share(data[:, 80 - quiet :], rows, np.array([start]), data.shape[1] - 80 + quiet - start, 1024.0, None, quiet)[0]


@pytest.mark.parametrize("hum", [0.002, 0.004])
def test_a_hum_that_noise_hides_before_the_hit_is_no_ringing(beam, hum, monkeypatch):
    """The response keeps 0.1 % of its amplitude. Without HIDES some of 1500 draws rang."""
    data = many_rows(beam, hum, 0.004)
    assert rings(data, range(1500)) < 0.01
    monkeypatch.setattr("operando.frf.remaining.HIDES", 0.0)
    assert rings(data, range(1500)) > 0.05


def test_what_rings_in_noise_stands_above_what_noise_may_hide(beam, monkeypatch):
    """The lowest mode keeps exp(−2.92 s · 2π · 31 Hz · 0.004) = 10 %."""
    data = many_rows(beam, 0.0, 0.1, slower=3.0, rows=50)
    assert [rings(data, [row]) for row in range(50)] == pytest.approx([0.102] * 50, rel=0.25)
    monkeypatch.setattr("operando.frf.remaining.HIDES", 1e3)
    assert rings(data, range(50)) == 0


@pytest.mark.parametrize("quiet", [25, 30, 40])
@pytest.mark.parametrize(("hum", "noise"), [(0.004, 0.004), (0.05, 0.0005), (0.05, 0.02)])
def test_a_hum_of_one_to_two_cycles_before_the_hit_is_no_ringing(beam, hum, noise, quiet):
    """1.2 to 1.95 cycles of 50 Hz. With half a cycle nothing tells it from ringing: the limit."""
    data = many_rows(beam, hum, noise, rows=100)
    assert rings(data, range(100), quiet) < 0.01
    assert rings(data, range(100), 18) > 0.05


@pytest.mark.parametrize("quiet", [36, 45, 60])
@pytest.mark.parametrize("drift", [0.0, 0.5])
def test_what_rings_is_seen_after_one_to_two_cycles_of_noise_and_drift(beam, quiet, drift):
    """1.1 to 1.8 cycles of the mode at 31 Hz, which keeps 10 %; the base line swings at 2.3 Hz by ten times the noise."""
    data = many_rows(beam, 0.0, 0.05, slower=3.0, rows=50)
    data += drift * np.sin(2 * np.pi * 2.3 * np.arange(data.shape[1]) / 1024 + np.linspace(0, 6, 50)[:, None])
    assert min(rings(data, [row], quiet) for row in range(50)) > 0.05


def test_variance_of_a_single_hit_follows_its_force(beam):
    """A pulse of 5 ms has no force at 300 Hz: the FRF is wrong there, and its variance says so."""
    shapes, hz, zeta = beam
    rng = np.random.default_rng(2)
    f = np.arange(1.1, 480.0, 0.25)
    w = 2 * np.pi * f
    truth = sum(
        -(w**2) * shapes[36, r] * shapes[10, r] / ((2 * np.pi * hz[r]) ** 2 - w**2 + 4j * np.pi * zeta[r] * hz[r] * w) for r in range(4)
    )
    force = np.abs(np.cos(np.pi * f * 0.005) / (1 - (2 * f * 0.005) ** 2))
    noise = 1e-3 * (rng.standard_normal((40, f.size)) + 1j * rng.standard_normal((40, f.size)))
    h = (truth + noise / force)[:, None]
    stated = np.median([roughness_variance(h[k : k + 1], force_power=force[None] ** 2)[0, 0] for k in range(40)], axis=0)
    ratio = stated / np.mean(np.abs(h[:, 0] - truth) ** 2, axis=0)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.25)
    notch = force < 0.03
    assert notch.sum() > 3
    assert 0.3 < np.median(ratio[notch]) < 3
    even = np.median([roughness_variance(h[k : k + 1])[0, 0] for k in range(10)], axis=0)
    assert np.median(even[force > 0.5] / stated[force > 0.5]) < 3


def test_hits_in_files_share_one_window(beam):
    """Where one of several single hits rings at the end of its record, all get the exponential window, and can be merged."""
    shapes, hz, zeta = beam
    rng = np.random.default_rng(3)
    runs = [single_hit(p, [10, 36], shapes, hz, z, rng) for p, z in ((10, zeta), (36, zeta / 6))]
    assert estimate_frf(runs[0]).exponential_window_rate == 0
    assert estimate_frf(runs).exponential_window_rate == pytest.approx(estimate_frf(runs[1]).exponential_window_rate, rel=0.01)


# --- findings


def test_findings_alike_become_one():
    found = [Finding("weak_hit", f"hit at {k}.5 s: {k} N", file=f"hit{k}.uff", dof=f"{k}+Z") for k in range(20)]
    other = Finding("flat", "5+Z: no signal", file="a.uff", dof="5+Z")
    grouped = group_findings([*found, other, other])
    assert len(grouped) == 2
    assert (
        grouped[0].message
        == "hit at 0.5 s: 0 N [alike 20 times in 20 files (hit0.uff, hit1.uff, hit2.uff …) and 20 DOFs (0+Z, 1+Z, 2+Z …)]"
    )
    assert (grouped[0].file, grouped[0].dof) == (None, None)
    assert grouped[1] == other
    assert group_findings(found[:2]) == found[:2]
    assert group_findings([*found[:3], replace(found[0], severity="error")])[1].severity == "error"


# --- init


def test_init_labels_channels_that_only_have_names(tmp_path):
    record = driven(np.random.default_rng(0).standard_normal(int(20 * FS)))
    names = ["Force", "Voltage", "Acceleration1", "Acceleration2", "Acceleration3"]
    rows = np.vstack([record.data[0], 0.01 * record.data[0], record.data[1:4]]).T
    text = "\n".join(",".join(f"{v:.8g}" for v in row) for row in rows)
    (tmp_path / "shaker.csv").write_text(f"# sampling_hz = {FS}\n{','.join(names)}\n{text}\n", encoding="utf-8")
    made = scaffold(tmp_path)
    write_test(made, tmp_path / "test.toml")
    assert any("Force taken as the force at 1+Z" in note for note in made.notes)
    test = load_test(tmp_path)
    assert test.channels["Force"] == {"dof": "1+Z", "quantity": "force"}
    assert test.channels["Acceleration3"] == {"dof": "3+Z", "quantity": "acceleration"}
    assert test.channels["Voltage"]["exclude"] is True
    assert [p.name for p in test.idle.records] == ["shaker.csv"]


def test_init_and_run_on_the_aircraft(tmp_path):
    """F-16 ground vibration test, as it comes: labels, drive point, excited band; no finding that the lines without force would make."""
    source = SHARED / "data" / "f16" / "F16Data_FullMSine_Level1.csv"
    if not source.exists():
        pytest.skip("the measured data are not here (../shared)")
    shutil.copy(source, tmp_path)
    made = scaffold(tmp_path)
    write_test(made, tmp_path / "test.toml")
    assert any("Force taken as the force at 1+Z" in note for note in made.notes)
    results = run(tmp_path / "test.toml", tmp_path / "out", until="frf")
    frf = results.idle_frf
    assert frf is not None
    assert [str(d) for d in (*frf.references, *frf.responses)] == ["1+Z", "1+Z", "2+Z", "3+Z"]
    assert frf.frequencies_hz[[0, -1]] == pytest.approx([2.0, 15.0], abs=0.05)
    unwanted = {"low_coherence", "drive_point_sign", "inverted", "swapped", "nonlinear", "missing_drive_point", "soft_clip", "overload"}
    assert not {f.kind for f in results.findings} & unwanted
    assert len(results.findings) < 10


def test_simulated_chain_moves(white):
    """The helper of this file against that of the FRF tests: one chain, one answer."""
    f, x = simulate(Chain(5, zeta=0.01), FS, 8192, [1], np.random.default_rng(3), moving=False)
    frf = estimate_frf(make_record(f, x, FS, [1]), estimator="lrm", band=(20, 150))
    assert relative(frf.data, exact(frf)) < 1e-3
    with pytest.raises(DataError, match="no records"):
        estimate_frf([])


@pytest.mark.parametrize(("rate", "seconds"), [(256.0, 1.0), (500.0, 0.13)], ids=["another number of lines", "other lines"])
def test_runs_on_different_lines_are_not_averaged(rate, seconds):
    channels = [Channel("1+Z", "force", "N"), Channel("1+Z", "acceleration", "m/s2")]
    noise = np.random.default_rng(0).standard_normal((2, 8000))
    runs = [TimeRecord(noise, r, channels) for r in (FS, rate)]
    with pytest.raises(DataError, match="on different lines") as refused:
        estimate_frf(runs, block_seconds=seconds)
    assert "sampling rates" in refused.value.hint
    assert estimate_frf(runs, block_seconds=1.0, band=(5, 100)).axis.step == pytest.approx(1.0)

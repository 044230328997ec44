"""estimate_frf against the analytic chain: sign, bias of H1/H2/Hv, several forces, merging, variance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import cont2discrete

from operando.data import Channel, StoredFile, StoredRow, TimeRecord, force_rms, mapped_rows
from operando.dof import Dof
from operando.ema import fit_ema
from operando.errors import DataError
from operando.frf import cross_spectra, effective_averages, estimate_frf, local_rational, merge_runs, reciprocity_error
from operando.frf.estimators import estimate
from operando.frf.hits import LEAST_BLOCK
from operando.frf.inputs import run_input
from operando.frf.leakage import HANN_DAMPING
from operando.frf.rational import spectrum_lines
from operando.frf.spectra import CrossSpectra
from operando.frf.wholerecord import rational_run
from operando.io import read
from structures import Chain

SHARED = Path(__file__).resolve().parents[1].parent / "shared"


def sampled_accelerance(chain, f, fs, resp, ref):
    """Exact FRF of the sampled chain with forces linear between samples (what Chain.respond simulates)."""
    z = np.exp(2j * np.pi * np.asarray(f) / fs)
    out = np.zeros((len(resp), len(ref), z.size), complex)
    for r in range(len(chain.hz)):
        w = 2 * np.pi * chain.hz[r]
        a, b = np.array([[0, 1], [-(w**2), -2 * chain.zeta[r] * w]]), np.array([[0.0], [1.0]])
        a, b, c, d, _ = cont2discrete((a, b, a[1:2].copy(), np.array([[1.0]])), 1 / fs, method="foh")
        tr, det = np.trace(a), np.linalg.det(a)
        adj = np.array([[a[1, 1], -a[0, 1]], [-a[1, 0], a[0, 0]]])  # C (zI - A)^-1 B = C (z I - adj A) B / det(zI - A)
        g = (z * (c @ b)[0, 0] - (c @ adj @ b)[0, 0]) / (z**2 - tr * z + det) + d[0, 0]
        out += np.multiply.outer(np.outer(chain.phi[list(resp), r], chain.phi[list(ref), r]), g)
    return out


def make_record(force, acc, fs, drives, name="run", nodes=None):
    nodes = range(1, acc.shape[0] + 1) if nodes is None else nodes
    channels = [Channel(Dof(d, "Z"), "force", "N") for d in drives] + [Channel(Dof(n, "Z"), "acceleration", "m/s2") for n in nodes]
    return TimeRecord(np.vstack([force, acc]), fs, tuple(channels), name=name)


def simulate(chain, fs, n, drives, rng, level=10.0, moving=True):
    forces = np.zeros((len(chain.hz), n))
    for d in drives:
        forces[d - 1] = level * rng.standard_normal(n)
    x0 = rng.standard_normal((len(chain.hz), 2)) * np.c_[0.03 * level / (2 * np.pi * chain.hz), np.full(len(chain.hz), 0.03 * level)]
    return forces[[d - 1 for d in drives]], chain.respond(forces, fs, x0 if moving else None)


def relative(h, exact):
    return np.sqrt(np.sum(np.abs(h - exact) ** 2) / np.sum(np.abs(exact) ** 2))


FS = 1024.0


@pytest.mark.parametrize("estimator", ["h1", "h2", "hv", "lrm"])
def test_sign_and_phase(estimator):
    # Low drive frequency: response follows −ω²/k (accelerance real, negative); at resonance Im > 0 at the drive point.
    chain = Chain(4, zeta=0.02)
    rng = np.random.default_rng(2)
    f, x = simulate(chain, FS, 16384, [2], rng)
    frf = estimate_frf(make_record(f, x, FS, [2]), estimator=estimator, band=(5, 150))
    exact = sampled_accelerance(chain, frf.frequencies_hz, FS, range(4), [1])
    assert relative(frf.data, exact) < (0.1 if estimator != "lrm" else 1e-3)
    assert relative(frf.data, exact.conj()) > 1
    k = frf.at(chain.hz[0])[0]
    assert frf.data[1, 0, k].imag > 5 * abs(frf.data[1, 0, k].real)
    assert frf.data[1, 0, 0].real < 0


def test_sampled_truth_tends_to_the_continuous_formula():
    chain = Chain(4, zeta=0.02)
    f = np.linspace(5, 150, 400)
    errors = [relative(sampled_accelerance(chain, f, k * FS, range(4), [1]), chain.accelerance(f, ref=[1])) for k in (4, 16)]
    assert errors[1] < 2e-3
    assert errors[1] < 0.1 * errors[0]


def test_response_and_reference_labels_carry_their_sign():
    chain = Chain(3, zeta=0.03)
    f, x = simulate(chain, FS, 8192, [1], np.random.default_rng(0))
    plus = make_record(f, x, FS, [1])
    channels = list(plus.channels)
    channels[2] = Channel(Dof(2, "Z", -1), "acceleration", "m/s2")
    minus = TimeRecord(np.vstack([f, x[:1], -x[1:2], x[2:]]), FS, tuple(channels))
    a = estimate_frf(plus, estimator="h1")
    b = estimate_frf(minus, estimator="h1").select(a.responses)
    np.testing.assert_allclose(a.data, b.data)
    both = estimate_frf([plus, minus], estimator="h1")
    np.testing.assert_allclose(both.data, a.data)


def test_bias_of_h1_h2_hv_with_known_noise():
    # White force and white response noise: H1 = H/(1+n_f), H2 = H(1 + n_x/|H|²…), Hv their geometric mean (Bendat & Piersol).
    rng = np.random.default_rng(1)
    n, gain = 1 << 17, -2.0
    f = rng.standard_normal((1, n))
    x = gain * f
    noisy_f, noisy_x = f + 0.5 * rng.standard_normal(f.shape), x + 0.6 * rng.standard_normal(x.shape)
    record = make_record(noisy_f, noisy_x, FS, [1])
    mean = {e: np.mean(estimate_frf(record, estimator=e, block_seconds=0.25).data[0, 0, 2:-2]) for e in ("h1", "h2", "hv")}
    h1, h2 = gain / (1 + 0.25), gain * (1 + 0.36 / gain**2)
    assert mean["h1"] == pytest.approx(h1, abs=0.01)
    assert mean["h2"] == pytest.approx(h2, abs=0.01)
    assert mean["hv"] == pytest.approx(-np.sqrt(h1 * h2), abs=0.01)


def test_hv_is_exact_for_several_forces_where_h1_is_biased():
    # Noise on every channel in proportion to its power: the case total least squares is made for.
    rng = np.random.default_rng(3)
    n = 1 << 17
    f = rng.standard_normal((2, n))
    true = np.array([[1.0, 2.0], [0.5, -1.0]])
    x = true @ f
    noise = 0.3
    fm = f + noise * rng.standard_normal(f.shape)
    xm = x + noise * x.std(axis=1, keepdims=True) * rng.standard_normal(x.shape)
    record = make_record(fm, xm, FS, [1, 2])
    hv = np.mean(estimate_frf(record, estimator="hv", block_seconds=0.25).data[:, :, 2:-2], axis=2)
    h1 = np.mean(estimate_frf(record, estimator="h1", block_seconds=0.25).data[:, :, 2:-2], axis=2)
    np.testing.assert_allclose(hv, true, atol=0.03)
    np.testing.assert_allclose(h1, true / (1 + noise**2), atol=0.03)
    with pytest.raises(DataError, match="one force"):
        estimate_frf(record, estimator="h2")


def test_several_forces_at_once_and_multiple_coherence():
    chain = Chain(5, zeta=0.03)
    rng = np.random.default_rng(4)
    f, x = simulate(chain, FS, 32768, [1, 4], rng)
    x = x + 0.01 * x.std(axis=1, keepdims=True) * rng.standard_normal(x.shape)
    record = make_record(f, x, FS, [1, 4])
    for estimator, tolerance in (("h1", 0.05), ("lrm", 0.01)):
        frf = estimate_frf(record, estimator=estimator, band=(10, 180))
        exact = sampled_accelerance(chain, frf.frequencies_hz, FS, range(5), [0, 3])
        assert relative(frf.data, exact) < tolerance
        assert [str(d) for d in frf.references] == ["1+Z", "4+Z"]
        k = frf.at(chain.hz[1])[0]
        assert np.all(frf.coherence[:, :, k] > 0.9)


def test_runs_of_different_references_make_one_matrix():
    chain = Chain(5, zeta=0.03)
    rng = np.random.default_rng(5)
    runs = []
    for d in (1, 3, 5):
        f, x = simulate(chain, FS, 8192, [d], rng)
        runs.append(make_record(f, x, FS, [d], name=f"at {d}"))
    frf = estimate_frf(runs, estimator="lrm", band=(10, 180), line_spacing_hz=0.25)
    exact = sampled_accelerance(chain, frf.frequencies_hz, FS, range(5), [0, 2, 4])
    assert relative(frf.data, exact) < 1e-3
    assert frf.name == "", "made of several files, it is not called after one of them"
    assert estimate_frf(runs, estimator="lrm", band=(10, 180), line_spacing_hz=0.25, references="3+Z").name == "at 3"
    swapped = estimate_frf(runs, estimator="lrm", band=(10, 180), line_spacing_hz=0.25, references="5+Z,1-Z")
    np.testing.assert_allclose(swapped.data, frf.data[:, [2, 0]] * np.array([1, -1])[None, :, None])
    with pytest.raises(DataError, match="no run excites reference 2"):
        estimate_frf(runs, references="2+Z")


def test_roving_sensors_leave_nan_and_say_so():
    chain = Chain(4, zeta=0.03)
    rng = np.random.default_rng(6)
    f, x = simulate(chain, FS, 8192, [1], rng)
    g, y = simulate(chain, FS, 8192, [2], rng)
    frf = estimate_frf([make_record(f, x[:3], FS, [1], nodes=[1, 2, 3]), make_record(g, y[1:], FS, [2], nodes=[2, 3, 4])], estimator="h1")
    assert [str(d) for d in frf.responses] == ["1+Z", "2+Z", "3+Z", "4+Z"]
    assert np.isnan(frf.data[3, 0]).all()
    assert np.isnan(frf.data[0, 1]).all()
    assert np.isfinite(frf.data[1:3]).all()
    assert [x.kind for x in frf.findings].count("missing_pair") == 1


def test_equal_runs_are_averaged_and_others_kept_apart_by_level():
    chain = Chain(3, zeta=0.03)
    rng = np.random.default_rng(7)
    runs = []
    for level in (5.0, 10.0):
        f, x = simulate(chain, FS, 16384, [1], rng, level=level)
        x = x + 0.02 * x.std(axis=1, keepdims=True) * rng.standard_normal(x.shape)
        runs.append(make_record(f, x, FS, [1], name=f"{level:g} N"))
    pooled = estimate_frf(runs, estimator="lrm", band=(10, 180), line_spacing_hz=0.25)
    single = estimate_frf(runs[0], estimator="lrm", band=(10, 180), line_spacing_hz=0.25)
    assert not any(x.kind == "nonlinear" for x in pooled.findings)
    assert (single.name, pooled.name) == ("5 N", "")
    assert np.median(pooled.variance / single.variance) == pytest.approx(0.5, rel=0.3)  # the noise grows with the level: both count alike
    stiff = Chain(3, zeta=0.03, stiffness=2.2e5)
    f, x = simulate(stiff, FS, 16384, [1], rng, level=40.0)
    apart = estimate_frf([make_record(f, x, FS, [1], name="40 N"), *runs], estimator="lrm", band=(10, 180), line_spacing_hz=0.25)
    finding = next(x for x in apart.findings if x.kind == "nonlinear")
    assert finding.file == "40 N"
    np.testing.assert_allclose(apart.data, pooled.data)
    f, x = simulate(stiff, FS, 16384, [1], rng, level=11.0)
    alike = estimate_frf([make_record(f, x, FS, [1], name="11 N"), *runs], estimator="lrm", band=(10, 180), line_spacing_hz=0.25)
    finding = next(x for x in alike.findings if x.kind == "nonlinear")
    assert "N rms, nearly the same" in finding.message
    assert "mounting changed between the runs, or the response depends on the level" in finding.message
    assert "compare the levels" not in finding.action


def test_the_level_of_a_run_is_one_number_whatever_the_offset_of_its_sensor():
    f, x = simulate(Chain(3, zeta=0.03), FS, 4096, [1], np.random.default_rng(3), level=5.0)
    plain, offset = make_record(f, x, FS, [1]), make_record(f + 3.0, x, FS, [1])
    assert force_rms(offset) == pytest.approx(force_rms(plain))
    assert force_rms(offset) == pytest.approx(run_input(offset).level)


def test_bad_force_samples_are_left_out_block_by_block_and_a_bad_response_everywhere():
    chain = Chain(3, zeta=0.03)
    f, x = simulate(chain, FS, 32768, [1], np.random.default_rng(8))
    broken = f.copy()
    broken[0, 5000:5010] = np.nan
    frf = estimate_frf(make_record(broken, x, FS, [1]), estimator="h1", block_seconds=2.0)
    assert np.isfinite(frf.data).all()
    assert any(item.kind == "blocks_left_out" for item in frf.findings)
    exact = sampled_accelerance(chain, frf.frequencies_hz, FS, range(3), [0])
    band = frf.axis.band(10, 150)
    assert relative(frf.data[..., band], exact[..., band]) < 0.1
    x[1, 5000:5010] = np.nan
    for estimator in ("lrm", "h1"):
        whole = estimate_frf(make_record(f, x, FS, [1]), estimator=estimator, band=(10, 150))
        assert [str(d) for d in whole.responses] == ["1+Z", "3+Z"]
        assert [item.dof for item in whole.findings if item.kind == "nan"] == ["2+Z"]


def test_options_are_checked():
    chain = Chain(3)
    f, x = simulate(chain, FS, 4096, [1], np.random.default_rng(9))
    record = make_record(f, x, FS, [1])
    for bad in ({"estimator": "h3"}, {"window": "kaiser", "estimator": "h1"}, {"overlap": 1.0}, {"hits": "some"}, {"band": (5.0, 5.0)}):
        with pytest.raises(DataError):
            estimate_frf(record, **bad)
    with pytest.raises(DataError, match="no records"):
        estimate_frf([])
    with pytest.raises(DataError, match="force"):
        estimate_frf(record.select([1, 2, 3]))


def test_single_precision_and_memory_maps_are_read_in_place(tmp_path):
    chain = Chain(3, zeta=0.03)
    f, x = simulate(chain, FS, 16384, [1], np.random.default_rng(10))
    data = np.vstack([f, x]).astype(np.float32)
    data.tofile(tmp_path / "run.f4")
    mapped = np.memmap(tmp_path / "run.f4", np.float32, "r", shape=data.shape)
    template = make_record(f, x, FS, [1])
    a = estimate_frf(TimeRecord(mapped, FS, template.channels), estimator="h1")
    b = estimate_frf(template, estimator="h1")
    assert relative(a.data, b.data) < 1e-5


def test_lrm_beats_hann_on_a_short_lightly_damped_record_and_is_chosen():
    chain = Chain(6, zeta=0.002)
    rng = np.random.default_rng(11)
    f, x = simulate(chain, FS, 16384, [1], rng)
    x = x + 0.002 * x.std(axis=1, keepdims=True) * rng.standard_normal(x.shape)
    record = make_record(f, x, FS, [1])
    errors = {}
    for estimator in ("h1", "lrm"):
        frf = estimate_frf(record, estimator=estimator, band=(10, 160))
        errors[estimator] = relative(frf.data, sampled_accelerance(chain, frf.frequencies_hz, FS, range(6), [0]))
    assert errors["lrm"] < 0.05 * errors["h1"]
    asked = estimate_frf(record, estimator="h1", band=(10, 160))
    assert any(f.kind == "leakage" and f.severity == "warning" and "lines wide" in f.message for f in asked.findings)
    auto = estimate_frf(record, band=(10, 160))
    assert not any(f.kind == "leakage" for f in auto.findings)
    assert not any(f.kind == "leakage" for f in estimate_frf(record, estimator="h1", window="rectangular", band=(10, 160)).findings)
    assert "lrm" in auto.provenance.calls[-1]
    reason = next(item for item in auto.findings if item.kind == "estimator")
    assert "lines wide" in reason.message
    sharpest = 2 * 0.002 * chain.hz[0]
    assert auto.axis.step <= max(sharpest / 5, FS / 16384) * 1.001


def test_damping_read_from_hann_averages_is_too_large_by_what_the_finding_says():
    """HANN_DAMPING: a share over the lines a peak is wide, here three to seven."""
    chain = Chain(3, zeta=0.01, seed=2)
    f, x = simulate(chain, 512.0, 60 * 2048, [1], np.random.default_rng(1))
    frf = estimate_frf(make_record(f, x, 512.0, [1]), estimator="h1", block_seconds=4.0)
    model = fit_ema(frf, band=(20, 250))
    lines = 2 * chain.zeta * chain.hz / frf.axis.step
    share = (model.damping_ratios[model.in_band] / chain.zeta - 1) * lines
    assert np.all((share > HANN_DAMPING / 3) & (share < 3 * HANN_DAMPING))
    stated = next(item for item in frf.findings if item.kind == "leakage").consequence
    assert float(stated.split(" some ")[1].split(" %")[0]) == pytest.approx(100 * HANN_DAMPING / lines.min(), rel=0.2)


def test_averaging_is_chosen_for_a_long_well_damped_record():
    chain = Chain(4, zeta=0.05)
    rng = np.random.default_rng(12)
    f, x = simulate(chain, FS, 1 << 18, [1], rng)
    frf = estimate_frf(make_record(f, x, FS, [1]))
    assert "'h1'" in frf.provenance.calls[-1]
    assert frf.averages > 25
    band = frf.axis.band(15, 160)
    assert relative(frf.data[..., band], sampled_accelerance(chain, frf.frequencies_hz[band], FS, range(4), [0])) < 0.03


@pytest.mark.parametrize(("overlap", "window"), [(0.0, "rectangular"), (0.5, "hann"), (0.75, "hann")])
def test_effective_averages_by_monte_carlo(overlap, window):
    # Variance of H1 of unrelated noise is 1/n_eff: E|Gxf|²/(Gxx·Gff) = 1/n_eff for independent white signals.
    rng = np.random.default_rng(13)
    block, n, draws = 64, 64 * 12, 150
    lines = slice(3, 30)
    power = []
    for _ in range(draws):
        data = rng.standard_normal((9, n))
        s = cross_spectra(data, [0], range(1, 9), 1.0, block, overlap=overlap, window=window, lines=lines)
        power.append(np.mean(np.abs(s.cross[:, 0]) ** 2))
    expected = (2.0**2) / s.averages  # one-sided density of unit white noise at unit rate is 2
    assert np.mean(power) == pytest.approx(expected, rel=0.05)
    assert s.averages <= s.blocks + 1e-9
    if overlap == 0:
        assert s.averages == s.blocks


def test_effective_averages_of_a_single_block_and_of_touching_blocks():
    assert effective_averages(np.ones(8), [0]) == 1
    assert effective_averages(np.ones(8), [0, 8, 16]) == 3
    assert effective_averages(np.ones(8), [0, 0]) == 1


def test_samples_in_single_precision_are_transformed_with_a_few_times_the_error_of_their_rounding():
    block, effective = 8192, 1e5
    tone = (effective * np.sqrt(2) * np.sin(2 * np.pi * 100.3 / 1024 * np.arange(block * 20))).astype(np.float32)
    data, far = np.array([tone, tone]), slice(block // 4, block // 2)
    floor = [np.sqrt(cross_spectra(x, [0], [1], 1.0, block).response[0, far].mean() / 2) for x in (data, data.astype(float))]
    assert floor[1] == pytest.approx(2.8e-8 * effective, rel=0.1)  # what rounding the samples leaves, as white noise
    assert 2 * floor[1] < floor[0] < 2e-7 * effective


def test_samples_in_their_file_give_the_spectra_of_those_in_memory(tmp_path):
    rng = np.random.default_rng(17)
    samples = rng.standard_normal((3, 5000)).astype(np.float32)
    samples[2, 2100] = np.nan
    path = tmp_path / "samples.bin"
    path.write_bytes(samples.tobytes())
    rows = [StoredRow(4 * 5000 * i, np.dtype("<f4")) for i in range(3)]
    mapped = mapped_rows(StoredFile(path), rows, 5000, np.float32)
    assert mapped.rows_apart
    assert not mapped.changed_by(lambda x, *_: x, np.float32).rows_apart
    for finite, responses in ((True, [1]), (False, [1, 2])):
        for data in (mapped, mapped.changed_by(lambda x, *_: x, np.float32)):
            s, expected = (cross_spectra(x, [0], responses, 1.0, 256, finite=finite) for x in (data, samples))
            assert s.blocks == expected.blocks == (38 if finite else 36)
            np.testing.assert_array_equal(s.cross, expected.cross)
            np.testing.assert_array_equal(s.response, expected.response)


def test_variance_of_averaged_estimates_is_calibrated():
    # No dynamics, so no leakage: only the noise counts.
    rng = np.random.default_rng(14)
    gain = np.array([[1.5, -0.5], [0.2, 3.0], [1.0, 1.0]])
    for drives in (1, 2):
        squares = []
        for _ in range(40):
            f = rng.standard_normal((drives, 4096))
            x = gain[:, :drives] @ f + rng.standard_normal((3, 4096))
            s = cross_spectra(np.vstack([f, x]), range(drives), range(drives, drives + 3), 1.0, 512, lines=slice(5, 250))
            h, variance, *_ = estimate(s, "h1")
            squares.append(np.mean(np.abs(h - gain[:, :drives, None]) ** 2) / np.mean(variance))
        assert 0.8 < np.mean(squares) < 1.25


@pytest.mark.parametrize("kind", ["random", "hammer"])
def test_variance_of_local_rational_estimates_is_calibrated(kind):
    chain = Chain(6, zeta=0.005)
    rng = np.random.default_rng(15)
    n = 8192
    lines, centres = np.arange(1, 1300), np.arange(40, 1280, 3)
    exact = sampled_accelerance(chain, centres * FS / n, FS, range(6), [0])
    squares = []
    for _ in range(6):
        if kind == "random":
            f, x = simulate(chain, FS, n, [1], rng)
        else:
            force = np.zeros((6, n))
            for k in range(10):
                at = int((0.1 + 0.75 * k) * FS) + rng.integers(200)
                force[0, at : at + 3] = np.array([60, 100, 50]) * rng.uniform(0.7, 1.3)
            f, x = force[:1], chain.respond(force, FS)
        x = x + 0.01 * x.std(axis=1, keepdims=True) * rng.standard_normal(x.shape)
        result = local_rational(spectrum_lines(f, [0], lines, n), spectrum_lines(x, range(6), lines, n), lines, centres)
        squares.append(np.abs(result.data - exact) ** 2 / result.variance)
    z = np.mean(squares, axis=(0, 1, 2))
    assert 0.8 < z.mean() < 1.25
    near = np.min(np.abs(centres[:, None] * FS / n - chain.hz), axis=1) < 0.3
    assert 0.7 < z[near].mean() < 1.4


def test_local_rational_is_exact_without_noise_and_between_dft_lines():
    chain = Chain(2, zeta=0.004)
    n = 8192
    f, x = simulate(chain, FS, n, [1], np.random.default_rng(16))
    lines, centres = np.arange(1, 2000), np.arange(100, 1000) + 0.37
    result = local_rational(spectrum_lines(f, [0], lines, n), spectrum_lines(x, [0, 1], lines, n), lines, centres)
    exact = sampled_accelerance(chain, centres * FS / n, FS, range(2), [0])
    assert relative(result.data, exact) < 2e-5


@pytest.mark.skipif(not (SHARED / "cases").is_dir(), reason="the practice cases are not beside the repository")
@pytest.mark.parametrize("case", ["p1", "p4"])
def test_practice_case_against_its_exact_frf(case):
    # Check runs at two levels, merged, on every second frequency of the exact answer: within 1 %, and within the stated variance.
    runs = [run_input(r) for path in sorted((SHARED / "cases" / case / "check").glob("*.uff")) for r in read(path).records]
    answer = np.load(SHARED / "cases" / "answers" / f"{case}.npz")
    f = answer["f"][2:-2:2]
    frf = merge_runs([rational_run(run, f) for run in runs])
    nodes = list(answer["nodes"])
    rows, columns = [nodes.index(d.node) for d in frf.responses], [nodes.index(d.node) for d in frf.references]
    exact = answer["H"][np.ix_(rows, columns)][:, :, 2:-2:2]
    assert relative(frf.data, exact) < 0.01
    assert 0.8 < np.mean(np.abs(frf.data - exact) ** 2 / frf.variance) < 1.25
    assert reciprocity_error(frf) < 0.01


def test_a_block_has_eight_samples_or_more():
    force = np.random.default_rng(0).standard_normal(2000)
    record = TimeRecord(np.stack([force, 2 * force]), 100.0, [Channel("1+Z", "force", "N"), Channel("1+Z", "acceleration", "m/s2")])
    assert estimate_frf(record, estimator="H1", block_seconds=LEAST_BLOCK / 100).frequencies_hz[1] == 100 / LEAST_BLOCK
    with pytest.raises(DataError, match=r"0\.07 is 7 samples at 100 Hz, expected 8 or more") as error:
        estimate_frf(record, block_seconds=0.07)
    assert "0.08 s" in error.value.hint


@pytest.mark.parametrize(
    ("estimator", "n_forces", "on_force", "on_response"),
    [("h1", 2, 0.0, 0.7), ("h2", 1, 1.0, 0.0), ("hv", 1, 0.6, 0.6), ("hv", 2, 0.5, 0.7), ("hv", 3, 0.4, 0.4)],
)
def test_the_variance_of_every_estimator_is_that_of_repeated_measurements(estimator, n_forces, on_force, on_response):
    """That of H1 was stated for H2 and Hv as well: 4 and 1.5 times too small at a coherence of 0.5 by noise on the force."""
    rng, averages, n = np.random.default_rng(0), 60, 3000

    def noise(*shape):
        return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)

    mixing = np.array([[1, 0.4, 0.2], [0.4j, 1, 0.3], [0.1, 0.2, 1]])[:n_forces, :n_forces]
    force = np.einsum("ij,jlk->ilk", mixing, noise(n_forces, n, averages))
    motion = np.einsum("j,jlk->lk", np.array([1, 2j, -0.5])[:n_forces], force)[None]
    motion = motion + on_response * motion.std() * noise(1, n, averages)
    force = force + on_force * force.std() * noise(*force.shape)
    between = [np.einsum("ilk,jlk->ijl", a, force.conj()) / averages for a in (force, motion)]
    spectra = CrossSpectra(np.arange(float(n)), *between, np.mean(np.abs(motion) ** 2, axis=2), averages, float(averages))
    h, variance, *_ = estimate(spectra, estimator)
    np.testing.assert_allclose(np.mean(variance, axis=2), np.var(h, axis=2), rtol=0.08)

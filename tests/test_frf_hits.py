"""Hammer hits: detection, rejection with reasons, windows, overlap; checks of FRF matrices."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from operando.data import Frf
from operando.errors import DataError
from operando.frf import (
    check_drive_points,
    check_frf,
    estimate_frf,
    find_hits,
    in_one_sense,
    is_impact,
    opposed_dofs,
    reciprocity_error,
)
from operando.frf.cut_off import LEAST, cut_off_modes
from operando.frf.hits import rejected_numbers
from operando.frf.impact import REMAINING, impact_blocks
from structures import Chain
from test_frf_estimate import FS, make_record, relative, sampled_accelerance, simulate

SHARED = Path(__file__).resolve().parents[1].parent / "shared"


def hammer(n, times, levels, rng, noise=0.02, width=3.0):
    """Half-sine pulses at given times in white noise."""
    t = np.arange(n) / FS
    f = np.zeros(n)
    for at, level in zip(times, levels, strict=True):
        phase = (t - at) * FS / width
        f += level * np.where((phase >= 0) & (phase <= 1), np.sin(np.pi * np.clip(phase, 0, 1)), 0)
    return f + noise * rng.standard_normal(n)


def test_hits_are_found_with_their_levels():
    rng = np.random.default_rng(0)
    times = [0.5, 3.2, 6.1, 9.4]
    force = hammer(12288, times, [80, 100, 120, 90], rng)
    for sign in (1, -1):
        hits = find_hits(sign * force + 3.0, FS)
        np.testing.assert_allclose(hits.times_s, times, atol=3 / FS)
        np.testing.assert_allclose(hits.levels, [80, 100, 120, 90], rtol=0.15)
        assert hits.used.all()
        assert hits.findings() == []
        assert hits.offset == pytest.approx(3, abs=0.01)


def test_double_weak_and_clipped_hits_are_rejected_with_reasons():
    rng = np.random.default_rng(1)
    force = hammer(16384, [0.5, 3.0, 3.06, 6.0, 9.0, 12.0], [100, 110, 40, 15, 95, 105], rng)
    hits = find_hits(force, FS)
    assert hits.reasons == ("", "double_hit", "weak_hit", "", "")
    assert "60 ms" in hits.messages[1]
    np.testing.assert_array_equal(hits.double, [False, True, False, False, False])
    kinds = [f.kind for f in hits.findings("run", "1+Z")]
    assert kinds == ["double_hit", "weak_hit"]
    clipped = np.minimum(hammer(16384, [0.5, 3.0, 6.0], [100, 100, 200], rng, width=12), 120.0)
    assert find_hits(clipped, FS).reasons == ("", "", "overload")


def test_ringing_of_an_antialias_filter_is_no_double_hit():
    # A band-limited pulse: sinc tails of alternating sign, 22 % of the peak next to it.
    n = 8192
    t = np.arange(n) - 0.37
    force = sum(100 * np.sinc(t - at) for at in (1000, 4000, 7000))
    hits = find_hits(force, FS)
    np.testing.assert_array_equal(hits.indices, [1000, 4000, 7000])
    assert hits.used.all()


def test_random_forces_are_no_impacts():
    rng = np.random.default_rng(2)
    assert not is_impact(rng.standard_normal(20000))
    assert not is_impact(np.sin(np.arange(20000)))
    assert is_impact(hammer(20000, [1.0, 9.0], [50, 60], rng))
    assert not is_impact(np.zeros(100))
    assert find_hits(np.zeros(100), FS).indices.size == 0


def tapped(chain, times, levels, rng, n, at=1, noise=1e-4):
    force = hammer(n, times, levels, rng, noise=0.0)
    forces = np.zeros((len(chain.hz), n))
    forces[at - 1] = force
    x = chain.respond(forces, FS)
    return make_record(
        force[None] + 0.01 * rng.standard_normal(n), x + noise * x.std(axis=1, keepdims=True) * rng.standard_normal(x.shape), FS, [at]
    )


def test_decayed_hits_are_averaged_and_overlapping_ones_use_the_whole_record():
    rng = np.random.default_rng(3)
    times = [0.3, 4.4, 8.4, 12.5]
    damped = tapped(Chain(4, zeta=0.03), times, [100, 90, 110, 95], rng, 16384)
    frf = estimate_frf(damped, band=(10, 160))
    assert "hits=3" in frf.provenance.calls[-1] or "hits=4" in frf.provenance.calls[-1]
    assert not any(f.kind == "overlapping_hits" for f in frf.findings)
    assert relative(frf.data, sampled_accelerance(Chain(4, zeta=0.03), frf.frequencies_hz, FS, range(4), [0])) < 5e-3

    light = Chain(4, zeta=0.0015)
    ringing = tapped(light, times, [100, 90, 110, 95], rng, 16384)
    auto = estimate_frf(ringing, band=(10, 160))
    finding = next(f for f in auto.findings if f.kind == "overlapping_hits")
    assert "whole record" in finding.consequence
    assert "lrm" in auto.provenance.calls[-1]
    of_blocks = lambda record, seconds: [  # noqa: E731
        f.message for f in estimate_frf(record, band=(10, 160), block_seconds=seconds).findings if f.kind == "setting_unused"
    ]
    assert of_blocks(ringing, 1.0) == ["not used: block_seconds = 1.0; whole records are used, without blocks"]
    ignored = [f.message for f in estimate_frf(ringing, overlap=0.3, window="rectangular").findings if f.kind == "setting_unused"]
    assert ignored == ["not used: overlap = 0.3, window = rectangular; whole records are used, without blocks"]
    assert of_blocks(damped, 6.0) == [
        "not used: block_seconds = 6; blocks are 3.5 s long, the time to the next hit or the end of the record"
    ]
    assert of_blocks(damped, 2.0) == of_blocks(ringing, None) == []
    at_hits = [f.message for f in estimate_frf(damped, estimator="h1", overlap=0.5).findings if f.kind == "setting_unused"]
    assert at_hits == ["not used: overlap = 0.5; blocks begin at the hits"]
    off = estimate_frf(damped, estimator="h1", overlap=0.5, hits="off")
    assert not any(f.kind == "setting_unused" for f in off.findings)
    for share in (-0.1, 1.0):
        with pytest.raises(DataError, match=f"overlap = {share:g} is no share of a block"):
            estimate_frf(damped, estimator="h1", overlap=share)
    exact = sampled_accelerance(light, auto.frequencies_hz, FS, range(4), [0])
    forced = estimate_frf(ringing, band=(10, 160), estimator="h1")
    assert next(f for f in forced.findings if f.kind == "overlapping_hits").severity == "warning"
    error = relative(auto.data, exact)
    assert error < 5e-3
    assert relative(forced.data, sampled_accelerance(light, forced.frequencies_hz, FS, range(4), [0])) < 2 * error
    assert "put back" in forced.provenance.calls[-1]


@pytest.mark.parametrize(("zeta", "left"), [(0.005, 0.005), (0.003, 0.04)])
def test_what_blocks_cut_off_and_what_rings_into_them_is_put_right(zeta, left, monkeypatch):
    """To a thirtieth of itself without noise, and within the variance with it: the poles of the peaks and the force tell it."""
    chain = Chain(4, zeta=zeta)
    rng, n = np.random.default_rng(0), int(20.5 * FS)
    times, levels = [0.3, 4.4, 8.4, 12.5, 16.2], [100, 90, 110, 95, 105]
    noisy = tapped(chain, times, levels, rng, n, noise=1e-3)
    force = hammer(n, times, levels, rng, noise=0.0)
    exact = make_record(force[None], chain.respond(np.stack([force, *np.zeros((3, n))]), FS), FS, [1])
    assert left / 2 < impact_blocks(exact, 0, [1, 2, 3, 4], band=(10, 160)).remaining < 2 * left

    def squares(record):
        frf = estimate_frf(record, band=(10, 160), estimator="h1")
        return np.abs(frf.data - sampled_accelerance(chain, frf.frequencies_hz, FS, range(4), [0])) ** 2, frf.variance

    error, variance = squares(noisy)
    assert 0.7 * np.mean(variance) < np.mean(error) < 1.5 * np.mean(variance)
    after = np.sum(squares(exact)[0])
    monkeypatch.setattr("operando.frf.averaged.cut_off_modes", lambda *given: [])
    assert after < 1e-3 * np.sum(squares(exact)[0])
    assert np.mean(squares(noisy)[0]) > 1.3 * np.mean(error)


@pytest.mark.parametrize("gap", [0.002, 0.01, 0.04])
def test_what_two_modes_in_one_peak_leave_is_put_right(gap):
    """To what the model of the whole record errs by: nearer than their half-power widths, one line apart, and as two peaks."""
    chain = Chain(4, zeta=0.003)
    chain.hz[1] = chain.hz[0] * (1 + gap)
    record = tapped(chain, [0.3, 4.4, 8.4, 12.5, 16.2], [100, 90, 110, 95, 105], np.random.default_rng(0), int(20.5 * FS), noise=1e-3)

    def error(estimator):
        frf = estimate_frf(record, band=(10, 160), estimator=estimator)
        return relative(frf.data, sampled_accelerance(chain, frf.frequencies_hz, FS, range(4), [0]))

    assert error("h1") < 1.2 * error("lrm")


@pytest.mark.parametrize(("left", "touched"), [(10 * LEAST, True), (0.1 * LEAST, False)])
def test_a_peak_that_keeps_next_to_nothing_is_left_as_it_is(left, touched):
    """``LEAST``: of its amplitude, at the end of a block of one second."""
    hz = np.arange(1.0, 400.0)
    h = 1 / (2j * np.pi * (hz - 100.3) - np.log(left))[None]
    force = np.zeros(1000)
    force[0] = 1.0
    assert bool(cut_off_modes(hz, h, np.full(h.shape, 1e-12), force, np.array([0]), 1000, 1000.0)) == touched


@pytest.mark.parametrize("seed", range(6))
def test_only_poles_inside_the_lines_they_are_fitted_to_are_put_right(seed):
    """A mode two hertz below a peak bends the lines around it: a second pole describes the bend, and lies where nothing was fitted."""
    rng, fs, block = np.random.default_rng(seed), 512.0, 3262
    hz = np.arange(20 * block // 512, 60 * block // 512) * fs / block
    truth = np.array([-np.pi * width + 2j * np.pi * f for f, width in ((31.91, 0.58), (33.82, 0.31), (36.2, 0.375))])
    residues = rng.standard_normal((12, 3)) * [0.3, 0.5, 0.3]
    h = residues @ (1 / (2j * np.pi * hz - truth[:, None]))
    noise = 1e-3 * np.sqrt(np.mean(np.abs(h) ** 2))
    h = h + noise / np.sqrt(2) * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape))
    starts = 200 + block * np.arange(5)
    force = np.zeros(starts[-1] + block + 200)
    force[starts + 20] = rng.uniform(80, 120, 5)
    found = cut_off_modes(hz, h, np.full(h.shape, noise**2), force, starts, block, fs)
    assert found
    for mode in found:
        assert np.min(np.abs(mode.pole - truth) / np.abs(truth.real)) < 0.05


def test_a_peak_is_one_line_wide_where_a_block_ends_at_the_largest_share():
    """``REMAINING``: exp(−σT) of it, and a half-power bandwidth of σ/π, in lines of 1/T."""
    assert -np.log(REMAINING) / np.pi == pytest.approx(1, abs=0.05)


def test_an_inconsistent_hit_is_rejected():
    rng = np.random.default_rng(4)
    chain = Chain(4, zeta=0.04)
    n = 20480
    times = [0.3, 4.3, 8.3, 12.3, 16.3]
    record = tapped(chain, times, [100, 90, 110, 95, 105], rng, n)
    forces = np.zeros((4, n))
    stray = hammer(n, [8.3], [110], rng, noise=0.0)
    forces[0], forces[2] = -stray, stray  # the third hit went to mass 3
    x = record.data[1:] + chain.respond(forces, FS)
    moved = make_record(record.data[:1], x, FS, [1])
    frf = estimate_frf(moved, band=(10, 160), estimator="h1")
    wrong = [f for f in frf.findings if f.kind == "inconsistent_hit"]
    assert len(wrong) == 1
    assert wrong[0].time_s[0] == pytest.approx(8.3, abs=0.01)
    good = estimate_frf(record, band=(10, 160), estimator="h1")
    assert not any(f.kind == "inconsistent_hit" for f in good.findings)
    exact = sampled_accelerance(chain, frf.frequencies_hz, FS, range(4), [0])
    assert relative(frf.data, exact) < 0.01
    everything = estimate_frf(moved, band=(10, 160), estimator="h1", hits="all")
    assert relative(everything.data, exact) > 0.1


def test_exponential_window_adds_the_damping_it_says():
    # Poles move by −β exactly: the estimate is the FRF of a chain with damping ζ + β/ω (and nearly the same frequency).
    rng = np.random.default_rng(5)
    chain = Chain(1, zeta=0.01, spread=0.0)
    record = tapped(chain, [0.3, 4.3, 8.3, 12.3], [100, 90, 110, 95], rng, 16384, noise=1e-6)
    frf = estimate_frf(record, estimator="h1", window="exponential", exponential_end=0.001)
    beta = frf.exponential_window_rate
    blocks = impact_blocks(record, 0, [1])
    assert beta == pytest.approx(-np.log(0.001) / (blocks.block / FS))
    h = frf.data[0, 0]
    f = frf.frequencies_hz
    band = (f > 0.5 * chain.hz[0]) & (f < 1.5 * chain.hz[0])
    # One mode: G(s)·(s² + c1·s + c0) = b0 + b1·s + b2·s²; the window moves the poles, the numerator is left free.
    s = 2j * np.pi * f[band]
    g = h[band]
    a = np.column_stack([g * s, g, -np.ones(band.sum()), -s, -(s**2)])
    y = -g * s**2
    a, y = np.vstack([a.real, a.imag]), np.concatenate([y.real, y.imag])
    scale = np.abs(a).max(axis=0)
    c1, c0 = (np.linalg.lstsq(a / scale, y, rcond=None)[0] / scale)[:2]
    pole = np.roots([1, c1, c0])[0]
    wr = 2 * np.pi * chain.hz[0]
    assert -pole.real == pytest.approx(0.01 * wr + beta, rel=0.02)
    assert -pole.real - beta == pytest.approx(0.01 * wr, rel=0.05)
    assert abs(pole.imag) == pytest.approx(wr * np.sqrt(1 - 1e-4), rel=1e-3)
    with pytest.raises(DataError, match="exponential"):
        estimate_frf(record, estimator="h1", window="exponential", exponential_end=2.0)


def test_force_window_takes_the_noise_between_hits_away():
    rng = np.random.default_rng(6)
    chain = Chain(3, zeta=0.05)
    record = tapped(chain, [0.3, 4.3, 8.3, 12.3], [100, 90, 110, 95], rng, 16384)
    data = record.data.copy()
    data[0] += 0.5 * rng.standard_normal(record.n_samples)
    noisy = make_record(data[:1], data[1:], FS, [1])
    errors = {}
    for window in ("rectangular", "force"):
        frf = estimate_frf(noisy, estimator="h1", window=window, band=(10, 160))
        errors[window] = relative(frf.data, sampled_accelerance(chain, frf.frequencies_hz, FS, range(3), [0]))
    assert errors["force"] < 0.5 * errors["rectangular"]


def test_hammer_runs_of_different_spacing_share_their_lines():
    rng = np.random.default_rng(7)
    chain = Chain(3, zeta=0.05)
    a = tapped(chain, [0.3, 4.3, 8.3, 12.3], [100, 90, 110, 95], rng, 16384, at=1)
    b = tapped(chain, [0.3, 3.5, 6.8, 10.1, 13.0], [100, 90, 110, 95, 99], rng, 16384, at=3)
    frf = estimate_frf([a, b], band=(10, 160))
    assert relative(frf.data, sampled_accelerance(chain, frf.frequencies_hz, FS, range(3), [0, 2])) < 0.01
    assert reciprocity_error(frf) < 0.01


def test_no_usable_hit_is_an_error():
    record = tapped(Chain(2, zeta=0.05), [15.99], [100], np.random.default_rng(8), 16384)
    with pytest.raises(DataError, match="no usable hit"):
        estimate_frf(record, estimator="h1")


def chain_frf(**changes):
    chain = Chain(4, zeta=0.02)
    f = np.linspace(5, 150, 600)
    h = chain.accelerance(f, ref=[0, 2])
    for (i, j), factor in changes.pop("factors", {}).items():
        h[i, j] = h[i, j] * factor(f) if callable(factor) else h[i, j] * factor
    return Frf(h, f, tuple(f"{n}+Z" for n in range(1, 5)), ("1+Z", "3+Z"), **changes)


def test_what_stays_is_reversed_where_a_drive_point_dissipates_negative_power():
    """The force of a shaker with all of its responses; the accelerometer of a roving hammer with all of its references."""
    right = chain_frf()
    shaker = replace(right, data=right.data * np.array([-1.0, 1.0])[:, None])
    assert [str(d) for d in opposed_dofs(shaker)] == ["1+Z"]
    np.testing.assert_array_equal(in_one_sense(shaker, opposed_dofs(shaker)).data, right.data)
    assert in_one_sense(right, opposed_dofs(right)) is right
    roving = Frf(-np.swapaxes(right.data, 0, 1), right.axis, right.references, right.responses)
    both = in_one_sense(roving, opposed_dofs(roving))
    assert {str(d) for d in opposed_dofs(roving)} == {"1+Z", "3+Z"}
    np.testing.assert_array_equal(both.data, -roving.data)


def test_drive_points():
    assert check_drive_points(chain_frf()) == []
    inverted = check_drive_points(chain_frf(factors={(0, 0): -1}))
    assert [(f.kind, f.dof) for f in inverted] == [("inverted", "1+Z")]
    quarter = check_drive_points(chain_frf(factors={(2, 1): lambda f: np.exp(-2j * np.pi * f * 0.004)}))
    assert [(f.kind, f.dof) for f in quarter] == [("drive_point_sign", "3+Z")]
    missing = check_drive_points(chain_frf().select(responses="1+Z,2+Z,4+Z"))
    assert [(f.kind, f.dof) for f in missing] == [("missing_drive_point", "3+Z")]
    for quantity in ("receptance", "mobility"):
        assert check_drive_points(chain_frf().to_quantity(quantity)) == []
    assert check_drive_points(chain_frf().select(references="1-Z,3+Z")) == []


def test_drive_point_with_an_offset_near_zero():
    frf = chain_frf()
    data, f = np.array(frf.data), np.linspace(0.25, 150, 600)
    data[0, 0, 0] = -5j * np.abs(data[0, 0]).max()
    assert check_drive_points(Frf(data, f, frf.responses, frf.references)) == []


def test_reciprocity():
    assert reciprocity_error(chain_frf()) < 1e-12
    assert reciprocity_error(chain_frf(factors={(2, 0): 1.2})) == pytest.approx(0.2 / np.sqrt(1.22), rel=1e-6)
    assert reciprocity_error(chain_frf().select(references="1+Z")) is None
    assert [f.kind for f in check_frf(chain_frf(factors={(2, 0): 1.2})).findings] == ["not_reciprocal"]
    assert check_frf(chain_frf()).findings == ()


def test_noise_is_not_called_a_lack_of_reciprocity():
    rng = np.random.default_rng(9)
    clean = chain_frf()
    variance = np.full(clean.data.shape, np.mean(np.abs(clean.data) ** 2) * 0.01)
    noise = np.sqrt(variance / 2) * (rng.standard_normal(variance.shape) + 1j * rng.standard_normal(variance.shape))
    noisy = Frf(clean.data + noise, clean.axis, clean.responses, clean.references, variance=variance)
    assert reciprocity_error(noisy) < 0.05


def test_low_coherence_is_reported():
    chain = Chain(3, zeta=0.05)
    rng = np.random.default_rng(10)
    f, x = simulate(chain, FS, 16384, [1], rng)
    x[2] += 5 * x[2].std() * rng.standard_normal(x.shape[1])
    frf = check_frf(estimate_frf(make_record(f, x, FS, [1]), estimator="h1", block_seconds=1.0, band=(10, 200)))
    assert [(item.kind, item.dof) for item in frf.findings if item.kind != "leakage"] == [("low_coherence", "3+Z")]


def test_coherence_counts_where_the_analysis_is():
    lines = np.arange(1.0, 1000.0)
    driven = np.where(lines < 190, 1.0, 0.1)
    frf = Frf(np.ones((1, 1, lines.size)), lines, ["1+Z"], ["1+Z"], coherence=driven[None, None])
    assert [item.kind for item in check_frf(frf).findings] == ["low_coherence"]
    assert check_frf(frf, (5.0, 140.0)).findings == (), "a shaker leaves nothing above its own band"


def free_body(spread=0.0):
    """Accelerance of a free bar of four points: translation, rotation of a given share, one bending mode at 40 Hz."""
    f = np.arange(1.0, 80.0, 0.25)
    w, bend = 2 * np.pi * f, 2 * np.pi * 40
    where = np.linspace(-1, 1, 5)
    shape = np.cos(np.pi * where)
    rigid = np.full((5, 5), 0.04) + spread * np.outer(where, where)
    h = rigid[:, :1, None] + np.multiply.outer(np.outer(shape, shape[:1]), 0.02 * -(w**2) / (bend**2 - w**2 + 0.02j * bend * w))
    return h, f


def test_an_inverted_response_of_a_free_body_is_seen_in_its_rigid_motion():
    h, f = free_body()
    dofs = [f"{n}-Y" for n in range(5)]
    assert check_frf(Frf(h, f, dofs, ["0-Y"])).findings == ()
    h[3] *= -1
    found = check_frf(Frf(h, f, dofs, ["0-Y"])).findings
    assert [(x.kind, x.dof) for x in found] == [("inverted", "3-Y")]
    right = [*dofs[:3], "3+Y", dofs[4]]
    assert check_frf(Frf(h, f, right, ["0-Y"])).findings == ()
    rotating, f = free_body(0.03)
    rotating[4] *= -1
    assert check_frf(Frf(rotating, f, dofs, ["0-Y"])).findings == ()  # sizes differ: no evidence
    assert check_frf(chain_frf(factors={(3, 0): -1, (3, 1): -1})).findings == ()  # on ground: no evidence


@pytest.mark.skipif(not (SHARED / "data" / "bookcase").is_dir(), reason="the measured bookcase is not beside the repository")
def test_bookcase_column_zero_is_inverted():
    h = np.load(SHARED / "data" / "bookcase" / "frf.npz")["data"]
    frf = Frf(h.T[:, None, :], np.arange(h.shape[0]) / 16, [f"{n}-Y" for n in range(9)], ["8-Y"])
    assert [(x.kind, x.dof) for x in check_frf(frf).findings] == [("inverted", "0-Y")]


@pytest.mark.parametrize("wrong", ["run7.uff#1", "run1.uff", "run1.uff#", "run1.uff#x", "run7.uff#9", "#1", "quiet.uff", "run1.uff#7"])
def test_the_hint_about_a_hit_that_is_not_there_names_one_that_is(wrong):
    files, counts = ["run1.uff", "quiet.uff"], [3, 0]
    with pytest.raises(DataError, match="hits_reject names") as refused:
        rejected_numbers(files, counts, [wrong])
    named = re.findall(r"[\w.]+#\d+", refused.value.hint)
    assert named
    rejected_numbers(files, counts, named)

"""Raw-data checks: each fault is found where it is injected, and clean data raise no alarm."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from operando.data import Channel, TimeRecord
from operando.dof import Dof
from operando.frf import check_frf, estimate_frf
from operando.quality import check_record, check_runs, dropouts, overload, soft_clipping
from structures import Chain
from test_frf_estimate import FS, make_record, simulate
from test_frf_hits import tapped

SHARED = Path(__file__).resolve().parents[1].parent / "shared"


@pytest.fixture(scope="module")
def clean():
    rng = np.random.default_rng(0)
    chain = Chain(5, zeta=0.01)
    f, x = simulate(chain, FS, 32768, [2], rng)
    x = x + 0.01 * x.std(axis=1, keepdims=True) * rng.standard_normal(x.shape)
    return make_record(f, x, FS, [2])


def with_row(record, row, values):
    data = np.array(record.data)
    data[row] = values
    return replace(record, data=data)


def kinds(record):
    return [(f.kind, f.dof) for f in check_record(record).findings]


def test_clean_random_and_hammer_data_raise_no_alarm(clean):
    assert kinds(clean) == []
    rng = np.random.default_rng(1)
    tapping = tapped(Chain(4, zeta=0.03), [0.3, 4.4, 8.4, 12.5], [100, 90, 110, 95], rng, 16384 + 1024)
    assert kinds(tapping) == []
    single = replace(clean, data=clean.data.astype(np.float32))
    assert kinds(single) == []


def test_noise_free_and_digitised_data_raise_no_alarm():
    chain = Chain(3, zeta=0.03)
    force = np.zeros((3, 16384))
    for at in (300, 4400, 8400, 12500):
        force[0, at : at + 3] = (60, 100, 50)
    assert kinds(make_record(force[:1], chain.respond(force, FS), FS, [1])) == []
    f, x = simulate(chain, FS, 32768, [1], np.random.default_rng(2), moving=False)
    for counts in (20, 200, 2000):  # full scale in steps of the converter
        step = np.abs(np.vstack([f, x])).max(axis=1, keepdims=True) / counts
        coarse = make_record(np.round(f / step[:1]) * step[:1], np.round(x / step[1:]) * step[1:], FS, [1])
        assert kinds(coarse) == [], counts


def test_tones_and_square_like_signals_of_few_lines_are_not_called_soft_clipping():
    t = np.arange(40000) / FS
    assert soft_clipping(np.sin(2 * np.pi * 50 * t)) is None
    rng = np.random.default_rng(3)
    assert soft_clipping(np.sin(2 * np.pi * 50 * t) + 0.05 * rng.standard_normal(t.size)) is None
    assert soft_clipping(rng.standard_normal(t.size)) is None
    assert soft_clipping(rng.uniform(-1, 1, t.size)) is None
    assert soft_clipping(np.sin(2 * np.pi * (5 * t + 2.5 * t**2))) is None  # a sweep from 5 to 200 Hz
    assert soft_clipping(sum(np.sin(2 * np.pi * 25 * k * t + k * k) for k in (1, 2, 3))) is None  # rotor orders
    assert overload(np.sin(2 * np.pi * 0.01 * t).astype(np.float32)) == []


@pytest.mark.parametrize("row", [0, 3])
def test_overload(clean, row):
    x = clean.data[row]
    limit = 2.2 * x.std()
    checked = check_record(with_row(clean, row, np.clip(x, -limit, limit)))
    found = [f for f in checked.findings if f.kind == "overload"]
    assert found
    assert {f.dof for f in checked.findings} == {clean.channels[row].label}
    first = np.flatnonzero(np.abs(x) >= limit)
    assert f"{limit:.4g}" in found[0].message
    assert min(f.time_s[0] for f in found) >= first[0] / FS - 1e-9
    assert max(f.time_s[1] for f in found) <= first[-1] / FS + 1e-9


def test_bad_samples_say_what_is_done_about_them(clean):
    """Of several responses one is left out; of a force and of the only response the blocks are, as the FRFs are made."""

    def told(record, row):
        x = np.array(record.data[row])
        x[15000] = np.inf
        (found,) = [f for f in check_record(with_row(record, row, x)).findings if f.kind == "nan"]
        assert "1 sample not finite" in found.message
        return found.severity, found.consequence

    assert told(clean, 2) == ("error", "the channel is left out")
    assert told(clean, 0) == ("warning", "blocks with them are left out")
    alone = clean.select([0, 2])
    assert told(alone, 1) == ("warning", "blocks with them are left out")
    x = np.array(alone.data[1])
    x[15000] = np.inf
    frf = estimate_frf(with_row(alone, 1, x))
    assert np.isfinite(frf.data).all()
    assert any(f.kind == "blocks_left_out" for f in frf.findings)


def test_a_line_at_0_hz_gives_no_warning(recwarn):
    frf = estimate_frf(make_record(*simulate(Chain(3, zeta=0.03), FS, 8192, [1], np.random.default_rng(0)), FS, [1]), estimator="h1")
    data = 1e12 * frf.data  # a circuit in volts
    data[..., 0] = 0.0
    check_frf(replace(frf, data=data, variance=None, coherence=None).to_quantity("accelerance"))
    assert not [w for w in recwarn if "overflow" in str(w.message)]


def test_overload_on_one_side_only(clean):
    x = clean.data[2]
    assert ("overload", "2+Z") in kinds(with_row(clean, 2, np.minimum(x, 2 * x.std())))


def test_soft_clipping():
    f, x = simulate(Chain(5, zeta=0.01), FS, 32768, [2], np.random.default_rng(20), moving=False)
    clean = make_record(f, x, FS, [2])
    checked = check_record(with_row(clean, 5, np.tanh(1.5 * x[4] / x[4].std())))
    assert [(f.kind, f.dof) for f in checked.findings] == [("soft_clip", "5+Z")]
    assert "crest factor" in checked.findings[0].message


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nan(clean, value):
    x = clean.data[3].copy()
    x[1000:1005] = value
    (finding,) = check_record(with_row(clean, 3, x)).findings
    assert (finding.kind, finding.severity, finding.dof) == ("nan", "error", "3+Z")
    assert finding.time_s == pytest.approx((1000 / FS, 1004 / FS))
    assert "5 samples" in finding.message


@pytest.mark.parametrize("value", ["zero", "hold"])
def test_dropout(clean, value):
    x = clean.data[4].copy()
    x[7000:7100] = 0.0 if value == "zero" else x[7000]
    (finding,) = check_record(with_row(clean, 4, x)).findings
    assert (finding.kind, finding.dof) == ("dropout", "4+Z")
    assert finding.time_s == pytest.approx((7000 / FS, 7099 / FS))


def test_a_short_hold_is_no_dropout():
    x = np.random.default_rng(4).standard_normal(5000)
    x[100:110] = x[100]
    assert dropouts(x) == []


def test_flat_channel(clean):
    assert kinds(with_row(clean, 4, np.zeros(clean.n_samples))) == [("flat", "4+Z")]
    assert kinds(with_row(clean, 4, 1e-6 * clean.data[4])) == [("flat", "4+Z")]


def test_inverted_force_or_response(clean):
    for row in (0, 2):
        checked = check_record(with_row(clean, row, -clean.data[row]))
        assert [(f.kind, f.dof, f.severity) for f in checked.findings] == [("inverted", "2+Z", "error")]
    relabelled = list(clean.channels)
    relabelled[2] = replace(relabelled[2], dof=Dof(2, "Z", -1))
    assert kinds(replace(with_row(clean, 2, -clean.data[2]), channels=tuple(relabelled))) == []


def test_swapped_channels_need_strong_evidence(clean):
    data = np.array(clean.data)
    data[[2, 5]] = data[[5, 2]]  # drive point 2 and a far one, 5
    (finding,) = check_record(replace(clean, data=data)).findings
    assert (finding.kind, finding.dof, finding.severity) == ("swapped", "2+Z", "warning")
    assert "5+Z" in finding.message
    other = np.array(clean.data)
    other[[4, 5]] = other[[5, 4]]  # away from the drive point nothing can be said
    assert kinds(replace(clean, data=other)) == []


def test_a_drive_point_is_asked_of_the_state_not_of_each_record(clean):
    record = check_record(clean.select([0, 1, 3, 4, 5]))
    assert record.findings == ()
    (finding,) = [f for f in check_frf(estimate_frf(record)).findings if f.kind == "missing_drive_point"]
    assert (finding.dof, finding.severity) == ("2+Z", "warning")
    assert "unit modal mass" in finding.consequence


def test_hits(clean):
    rng = np.random.default_rng(5)
    chain = Chain(4, zeta=0.03)
    record = tapped(chain, [0.3, 4.4, 4.47, 8.4, 12.5, 16.5], [100, 90, 40, 12, 95, 104], rng, 21504)
    found = check_record(record).findings
    assert [(f.kind, f.dof) for f in found] == [("double_hit", "1+Z"), ("weak_hit", "1+Z")]
    assert found[0].time_s[0] == pytest.approx(4.4, abs=0.01)
    ringing = tapped(Chain(4, zeta=0.001), [0.3, 4.4, 8.4, 12.5], [100, 90, 110, 95], rng, 17408)
    assert kinds(ringing) == [("overlapping_hits", "1+Z")]


def test_runs_of_unequal_rate_length_and_channels(clean):
    assert check_runs([clean, clean]) == []
    found = check_runs([clean, replace(clean, sampling_hz=2 * FS, name="fast")])
    assert [f.kind for f in found] == ["unequal_rate", "unequal_length"]
    assert "1024 Hz in 1" in found[0].message
    short = replace(clean, data=clean.data[:, :20000], name="short")
    assert [(f.kind, f.file) for f in check_runs([clean, short])] == [("unequal_length", "short")]
    assert [f.kind for f in check_runs([clean, clean.select([0, 1, 2])])] == ["missing_response"]


def test_checking_twice_adds_nothing_and_data_are_untouched(clean):
    flat = with_row(clean, 4, np.zeros(clean.n_samples))
    once = check_record(flat)
    assert check_record(once).findings == once.findings
    assert once.data is not None
    np.testing.assert_array_equal(once.data, flat.data)


def test_output_only_records_are_checked_too(clean):
    operating = clean.select([1, 2, 3, 4, 5])
    assert kinds(operating) == []
    assert kinds(with_row(operating, 0, np.zeros(clean.n_samples))) == [("flat", "1+Z")]


def read_uff(path):
    pyuff = pytest.importorskip("pyuff")
    sets = pyuff.UFF(str(path)).read_sets()
    channels, rows = [], []
    for s in sets:
        force = s["ordinate_spec_data_type"] == 13
        dof = Dof.from_uff(int(s["rsp_node"]), int(s["rsp_dir"]))
        channels.append(Channel(dof, "force" if force else "acceleration", "N" if force else "m/s2"))
        rows.append(np.asarray(s["data"], np.float32))
    return TimeRecord(np.array(rows), round(1 / sets[0]["abscissa_inc"]), tuple(channels), name=path.name)


@pytest.mark.skipif(not (SHARED / "cases").is_dir(), reason="the practice cases are not beside the repository")
@pytest.mark.parametrize("case", ["p1", "p2", "p3", "p4", "p5"])
def test_practice_cases_raise_no_alarm(case):
    for path in sorted((SHARED / "cases" / case).glob("*/run*.uff")):
        expected = ["overlapping_hits"] if case == "p4" and path.parent.name == "idle" else []
        assert [f.kind for f in check_record(read_uff(path)).findings] == expected, path.name

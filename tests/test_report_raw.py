"""What the report shows of the raw records, and what is kept for it."""

from __future__ import annotations

import re

import numpy as np
import pytest
from matplotlib.markers import MarkerStyle

import measurements
import operando
from operando import Channel, Results, TimeRecord
from operando.pipeline import inputs
from operando.quality import SHOWN_CHANNELS, overview
from operando.quality.overview import PLACES
from operando.report import render_report
from operando.report.figures_raw import raw_hits, raw_records
from operando.report.renderer import LONG_PATH

RATE = 1000.0


def hammer():
    """Three hits, the last of them double."""
    force = np.random.default_rng(0).normal(scale=0.01, size=6000)
    for at, peak in ((500, 100.0), (2500, 80.0), (4500, 90.0), (4525, 60.0)):
        force[at - 1 : at + 2] += [0.4 * peak, peak, 0.4 * peak]
    t = np.arange(6000) / RATE
    ring = sum(np.where(t >= s, np.exp(-6 * (t - s)) * np.sin(200 * (t - s)), 0.0) for s in (0.5, 2.5, 4.5))
    channels = (Channel("3+Z", "force", "N"), Channel("3+Z", "acceleration", "m/s2"), Channel("4+Z", "acceleration", "m/s2"))
    return TimeRecord(np.stack([force, ring, 3 * ring]), RATE, channels, name="idle/hit.uff")


def noise(n_channels=10):
    x = np.random.default_rng(1).normal(size=(n_channels, 20000))
    return TimeRecord(x, RATE, tuple(Channel(f"{i + 1}+Z", "acceleration", "m/s2") for i in range(n_channels)), name="operating/run.uff")


def test_an_overview_keeps_extremes_spectra_and_hits():
    record = hammer()
    seen = overview(record, "idle")
    np.testing.assert_array_equal(seen.outline.data.max(axis=1), record.data.max(axis=1).astype(np.float32))
    np.testing.assert_array_equal(seen.outline.data.min(axis=1), record.data.min(axis=1).astype(np.float32))
    assert seen.outline.duration_s == pytest.approx(record.duration_s)
    assert [(p.number, p.reason) for p in seen.pulses] == [(0, ""), (1, ""), (2, "double hit")]
    assert [p.force[p.peak] for p in seen.pulses] == pytest.approx([100.0, 80.0, 90.0], abs=0.1)
    many = overview(noise(), "operating")
    assert (len(many.outline.channels), many.n_channels, many.pulses) == (SHOWN_CHANNELS, 10, ())
    assert np.sum(many.densities[0]) * many.frequencies_hz[1] == pytest.approx(1.0, rel=0.05)


def test_figures_show_each_record_by_force_and_loudest_response_and_hits_by_number():
    seen = overview(hammer(), "idle")
    time, hits = raw_records([seen]), raw_hits([seen], (5.0, 300.0))
    assert "3+Z of hit.uff" not in time  # labels of curves stand in the data only
    assert "4+Z" in time
    assert "4+Z of idle/hit.uff" in time.csv
    assert "not used: double hit" in hits
    assert "hit.uff; 3+Z: 3 hits, 2 used" in hits


def test_the_report_has_a_part_on_raw_data_and_says_what_it_leaves_out():
    results = Results("pump", raw=[overview(hammer(), "idle"), overview(noise(), "operating")])
    results.inventory = [{"file": f"{k}.uff", "used_for": "operating", "duration_s": 20.0} for k in range(3)]
    html = render_report(results)
    assert "<h3>Raw data</h3>" in html
    assert "Idle state: hits of the hammer over one another" in html
    assert "power spectral densities of 8 of 10 channels" in html
    assert "The first 1 of 3 records." in html
    assert "<h3>Raw data</h3>" not in render_report(Results("pump"))


def test_a_run_keeps_the_look_of_its_records(tmp_path):
    test = measurements.write_test(tmp_path / "pump", check=True)
    operando.run(test, tmp_path / "results", until="inspect", report=False)
    raw = operando.load(tmp_path / "results", Results).raw
    assert [seen.state for seen in raw] == ["idle", "idle", "operating", "check", "check"]
    assert all(seen.outline.n_samples <= 2 * PLACES for seen in raw)


def test_of_many_records_the_first_are_shown(tmp_path, monkeypatch):
    monkeypatch.setattr(inputs, "SHOWN_RECORDS", 1)
    test = measurements.write_test(tmp_path / "pump", check=True)
    assert [seen.state for seen in operando.run(test, tmp_path / "results", until="inspect", report=False).raw] == [
        "idle",
        "operating",
        "check",
    ]


def test_curves_have_tenths_of_a_point_and_marks_hundredths():
    paths = re.findall(r' d="([^"]*)"', raw_records([overview(noise(), "operating")]))
    points = lambda d: len(re.findall(r"[-\d.]+", d)) // 2  # noqa: E731
    digits = {points(d) >= LONG_PATH: max(map(len, re.findall(r"\.(\d+)", d)), default=0) for d in sorted(paths, key=points)}
    assert digits[True] == 1
    straight = [MarkerStyle(mark).get_path() for mark in MarkerStyle.filled_markers if mark not in (".", "o")]
    assert max(len(path.vertices) for path in straight) < LONG_PATH, "no mark of straight sides counts as a curve"

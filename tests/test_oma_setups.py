"""Set-ups of different sensors that share some: matched, merged, a joint estimate beside; one bad set-up spoils none."""

from __future__ import annotations

import csv
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from operando.data import Channel, Geometry, TimeRecord
from operando.dof import Dof
from operando.errors import ConfigError, DofError, IdentificationError
from operando.oma import fit_halves, fit_oma
from operando.oma.matching import match
from operando.oma.merge import mean_with_scatter
from operando.oma.setup_findings import common_ratio
from test_oma_fit import BAND, CHAIN, FS, simulate

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "benchmarks"))
from measured_modes import FRAME_HZ, FRAME_ZETA  # noqa: E402

FRAME = ROOT.parent / "shared" / "data" / "frame"
SENSORS = ((0, 2, 1), (0, 2, 3), (0, 2, 4))
"""Masses each set-up measures; the first two stay."""
QUANTITIES = ("displacement", "velocity", "acceleration")


def setup(masses, seed, level=1.0, seconds=150.0, quantity="acceleration", turned=(), name=None):
    """Record of some masses under forces of its own; sensors of ``turned`` masses look the other way."""
    x = level * simulate(CHAIN, seconds, FS, seed, derivative=(QUANTITIES.index(quantity),))
    channels = tuple(Channel(Dof(m + 1, "Z", -1 if m in turned else 1), quantity, name=f"ch{m}") for m in masses)
    rows = x[list(masses)] * np.array([[-1.0] if m in turned else [1.0] for m in masses])
    return TimeRecord(rows, FS, channels, name=name or f"setup{seed}")


@pytest.fixture(scope="module")
def records():
    return [setup(masses, 10 + k, 10.0**k, turned=(2,) if k == 1 else ()) for k, masses in enumerate(SENSORS)]


@pytest.fixture(scope="module")
def merged(records):
    return fit_oma(records, band=BAND)


def unit(shapes):
    return shapes / np.linalg.norm(shapes, axis=0)


def like_truth(model):
    """MAC of each mode with the truth at the model's DOFs."""
    rows = np.array([d.sign * CHAIN.phi[d.node - 1] for d in model.dofs])
    return np.abs(np.sum(unit(rows) * model.shapes, axis=0)) ** 2


def test_modes_of_all_sensors(merged):
    assert merged.n_modes == 5
    assert [str(d) for d in merged.dofs] == ["1+Z", "3+Z", "2+Z", "4+Z", "5+Z"]
    assert np.all(np.abs(merged.frequencies_hz - CHAIN.hz) < 4 * merged.frequency_std_hz)
    assert np.all(np.abs(merged.damping_ratios - CHAIN.zeta) < 4 * merged.damping_ratio_std)
    assert like_truth(merged).min() > 0.995  # levels 1, 10, 100 and a sensor turned round
    truth = unit(np.array([CHAIN.phi[d.node - 1] for d in merged.dofs]))
    turn = np.sign(np.sum(truth * merged.shapes.real, axis=0))
    assert np.mean(np.abs(merged.shapes.real - turn * truth) < 2 * merged.shape_std) > 0.85


def test_merging_agrees_with_pyoma():
    """pyOMA-2's merging (PoSER) of its own SSI-cov at a fixed order as an oracle: frequencies, dampings, shapes over all sensors."""
    from operando.oma.pyoma import contained_pyoma

    records = [setup(masses, 10 + k) for k, masses in enumerate(SENSORS)]
    with contained_pyoma():
        from pyoma2.algorithms import SSI
        from pyoma2.setup import MultiSetup_PoSER, SingleSetup

        singles = []
        for r in records:
            single = SingleSetup(np.asarray(r.data, float).T, FS)
            single.add_algorithms(SSI(name="ssi", br=30, ordmax=40, method="cov"))
            single.run_by_name("ssi")
            single.mpe("ssi", sel_freq=list(CHAIN.hz), order_in=24)
            singles.append(single)
        other = MultiSetup_PoSER(ref_ind=[[0, 1]] * 3, single_setups=singles, names=["ssi"]).merge_results()["ssi"]
    model = fit_oma(records, band=BAND)
    assert np.all(np.abs(model.frequencies_hz - other.Fn) < 3 * model.frequency_std_hz)
    assert np.all(np.abs(model.damping_ratios - other.Xi) < 3 * model.damping_ratio_std)
    assert np.min(np.abs(np.sum(unit(other.Phi).conj() * model.shapes, axis=0)) ** 2) > 0.999


def test_what_is_stated_of_set_ups(merged, records):
    details = merged.details
    assert [s.name for s in details.setups] == [r.name for r in records]
    assert details.setups[1].sensors == ("1+Z", "3-Z", "4+Z")
    assert details.setups[1].shared == ("1+Z", "3-Z")
    for s in details.setups:
        assert s.merged.tolist() == list(range(5))
    assert details.settings["setups"] == 3
    assert {"setups_merged"} <= {f.kind for f in merged.findings}


def test_more_records_make_surer(merged, records):
    alone = fit_oma(records[0], band=BAND)
    assert np.median(merged.frequency_std_hz / alone.frequency_std_hz) < 0.8  # 1/√3 but for scatter


def test_joint_estimate_stands_beside(merged):
    joint = merged.details.joint
    assert np.all(np.abs(joint.frequencies_hz - CHAIN.hz) < 4 * joint.frequency_std_hz)
    assert np.all(np.abs(joint.damping_ratios - CHAIN.zeta) < 4 * joint.damping_ratio_std)
    assert joint.mac.min() > 0.99
    assert "Döhler" in joint.text


def test_references_of_another_quantity(records):
    """Rovers measure velocity where the sensors that stay measure acceleration."""
    mixed = []
    for k, masses in enumerate(SENSORS):
        acceleration, velocity = setup(masses, 20 + k), setup(masses, 20 + k, quantity="velocity")
        data = np.vstack([acceleration.data[:2], velocity.data[2:]])
        mixed.append(replace(acceleration, data=data, channels=(*acceleration.channels[:2], velocity.channels[2])))
    model = fit_oma(mixed, band=BAND)
    assert model.n_modes == 5
    assert like_truth(model).min() > 0.99


def test_a_bad_set_up_spoils_none(records):
    rng = np.random.default_rng(3)
    noise = replace(records[2], data=rng.standard_normal(records[2].data.shape), name="noise")
    model = fit_oma([*records[:2], noise], band=BAND)
    assert model.n_modes == 5
    assert np.all(np.abs(model.frequencies_hz - CHAIN.hz) < 4 * model.frequency_std_hz)
    said = [f for f in model.findings if f.kind in ("setup_left_out", "setup_mode_unmatched") and f.file == "noise"]
    assert said or all(s.merged.max(initial=-1) < 0 for s in model.details.setups if s.name == "noise")
    dead = replace(records[2], data=np.zeros(records[2].data.shape), name="dead")
    model = fit_oma([*records[:2], dead], band=BAND)
    assert model.n_modes == 5
    left = [f for f in model.findings if f.kind == "setup_left_out"]
    assert [f.file for f in left] == ["dead"]
    assert "constant" in left[0].message
    one_dead = replace(records[2], data=np.vstack([records[2].data[:2], np.zeros((1, records[2].n_samples))]), name="one dead")
    model = fit_oma([*records[:2], one_dead], band=BAND)
    assert len(model.dofs) == 4
    assert [f.file for f in model.findings if f.kind == "channel_left_out"] == ["one dead"]


def test_a_set_up_at_another_rate_in_its_header_does_not_match(records):
    wrong = replace(records[2], sampling_hz=FS * 500 / 480, name="wrong")
    model = fit_oma([*records[:2], wrong], band=BAND)
    assert model.n_modes == 5
    assert np.all(np.abs(model.frequencies_hz - CHAIN.hz) < 4 * model.frequency_std_hz)
    assert any(f.kind == "setup_mode_unmatched" and f.file == "wrong" and f.severity == "warning" for f in model.findings)
    rate = [f for f in model.findings if f.kind == "sampling_rate"]
    assert [f.file for f in rate] == ["wrong"]
    assert "1.04" in rate[0].message


def test_common_ratio_of_modes():
    """``SAME_RATIO``: one factor within 0.3 %, in most modes; other modes are no factor."""
    hz = np.array([3.0, 7.0, 12.0, 19.0])
    assert common_ratio(hz * 0.9766, hz) == pytest.approx(0.9766)
    assert common_ratio(hz, hz) is None
    assert common_ratio(hz * np.array([0.97, 0.98, 0.99, 1.02]), hz) is None


def test_set_ups_without_a_shared_sensor(records):
    apart = [records[0].select([0, 1]), records[1].select([2])]
    with pytest.raises(DofError, match="share none"):
        fit_oma(apart, band=BAND)
    model = fit_oma([*records[:2], records[2].select([2])], band=BAND)
    assert any(f.kind == "setup_left_out" and "shares no sensor" in f.message for f in model.findings)


def test_choice_by_hand_over_set_ups(records):
    f = CHAIN.hz[2]
    without = fit_oma(records, band=BAND, reject_hz=[f])
    assert without.n_modes == 4
    assert np.min(np.abs(without.frequencies_hz / f - 1)) > 0.02
    kept = fit_oma(records, band=BAND, select_hz=[f])
    assert kept.n_modes == 5
    with pytest.raises(IdentificationError, match="no set-up has a pole"):
        fit_oma(records, band=BAND, select_hz=[190.0])
    with pytest.raises(ConfigError, match="standard deviations"):
        fit_oma(records, band=BAND, uncertainty=False)


def test_same_sensors_are_averaged_not_merged():
    runs = [setup((0, 1, 2), 1, seconds=100.0), setup((0, 1, 2), 2, seconds=100.0)]
    model = fit_oma(runs, band=BAND)
    assert model.details.setups == ()
    assert model.details.settings["runs"] == 2


def test_set_ups_chained_by_different_sensors():
    chain = [setup((0, 1, 2), 31), setup((2, 3), 32), setup((3, 4, 1), 33)]
    model = fit_oma(chain, band=BAND)
    assert model.n_modes == 5
    assert like_truth(model).min() > 0.99
    assert "no sensor is in all set-ups" in model.details.joint.text


def test_halves_of_set_ups(records, merged):
    halves = fit_halves(records, merged)
    assert len(halves) == 2
    assert all(h.n_modes == 5 and len(h.dofs) == 5 for h in halves)


def test_matching_tells_close_modes_apart(merged):
    one = merged.select_modes([0, 1])
    shifted = replace(one, frequencies_hz=one.frequencies_hz[[0, 0]] * np.array([1.0, 1.004]), damping_ratios=one.damping_ratios[[0, 0]])
    swapped = replace(shifted, shapes=shifted.shapes[:, ::-1])
    clusters = match([shifted, swapped])
    assert [sorted(c.members.items()) for c in clusters] == [[(0, 0), (1, 1)], [(0, 1), (1, 0)]]


def test_a_mean_is_no_more_certain_than_its_values_can_be():
    """Three values that agree by chance, or those of a steady harmonic: a resonance in so long a record cannot be known so well."""
    values, least = np.array([2.1, 2.1, 2.1]), np.full(3, 4e-6)
    assert mean_with_scatter(values, np.full(3, 1e-10), least).variance == pytest.approx(4e-6 / 3)
    assert mean_with_scatter(values, np.full(3, 9e-6), least).variance == pytest.approx(9e-6 / 3)


def test_mean_with_scatter_covers():
    """95 % intervals of the mean hold with and without scatter between the values, as the docstring says."""
    rng = np.random.default_rng(0)
    for k in (3, 8):
        for tau in (0.0, 1.0, 4.0):
            hits = []
            for _ in range(600):
                std = rng.uniform(0.5, 1.5, k)
                mean = mean_with_scatter(tau * rng.standard_normal(k) + std * rng.standard_normal(k), std**2)
                hits.append(abs(mean.value) < 1.959964 * np.sqrt(mean.variance))
            least = 0.94 if tau == 0 else 0.88 if k == 8 else 0.83  # 600 draws: ± 0.02
            assert least < np.mean(hits) < 0.99, (k, tau)


@pytest.mark.slow
def test_intervals_of_merged_set_ups_cover():
    from coverage_setups import setups, summary

    found = [setups(draw)[0] for draw in range(30)]
    share, cover = summary("merged set-ups", [f[0] for f in found], sum(f[1] for f in found))
    assert share > 0.95
    assert sum(f[1] for f in found) <= 4  # modes too many, of 210
    assert min(cover) >= 0.88
    assert np.mean(cover) <= 0.99  # single set-ups of five sensors are 1.2 to 1.3 times too wide already


def frame_test(folder, band=None):
    """Test file of the frame's eight set-ups, with geometry and the beams' directions."""
    if not FRAME.exists():
        pytest.skip("frame: measured data are not here (../shared)")
    from operando.io import write_uff

    rows = [line.split() for line in (FRAME / "grid.txt").read_text().splitlines()[1:] if line.strip()]
    lines = [tuple(int(v) for v in line.split()[:2]) for line in (FRAME / "lines.txt").read_text().splitlines()[1:] if line.strip()]
    write_uff(
        folder / "geometry.uff", Geometry(tuple(int(r[0]) for r in rows), np.array([[float(v) for v in r[1:4]] for r in rows]), lines)
    )
    text = ['name = "frame"', "[operating]", f'records = ["{FRAME.as_posix()}/setup0*.uff"]', "[geometry]", 'file = "geometry.uff"']
    text += ['units = "m"', "[directions]"]
    with open(FRAME / "directions.csv", encoding="utf-8") as stream:
        beams = {}
        for row in csv.DictReader(stream):
            a, e = np.radians(float(row["azimuth_deg"])), np.radians(float(row["elevation_deg"]))
            beams[row["channel"]] = [round(float(v), 6) for v in (np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e))]
    text += [f'"{dof}" = {vector}' for dof, vector in beams.items()]
    text += [] if band is None else ["[analysis]", f"band = {list(band)}"]
    (folder / "test.toml").write_text("\n".join(text) + "\n", encoding="utf-8")
    return folder / "test.toml"


@pytest.mark.parametrize("band", [None, (0.8, 16.0)])
def test_frame_of_eight_set_ups(tmp_path, band):
    """The published frequencies within 0.1 % (the last within 0.3 %), damping within 15 %, nothing else in the band."""
    from operando.pipeline import run

    results = run(frame_test(tmp_path, band), tmp_path / "out")
    model = results.operating
    assert model is not None, results.left_out
    assert model.n_modes == len(FRAME_HZ)
    off = np.abs(model.frequencies_hz / FRAME_HZ - 1)
    assert off[:-1].max() < 1e-3
    assert off[-1] < 3e-3
    assert np.abs(model.damping_ratios / FRAME_ZETA - 1).max() < 0.15
    assert len(model.dofs) == 26
    assert len(model.details.setups) == 8
    assert not [s for s in model.details.setups if s.failed]
    if band is None:
        assert any(f.kind == "band_by_default" for f in results.findings)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))["operating"]
    assert [len(s["sensors"]) for s in summary["setups"]] == [5] * 8
    assert len(summary["joint"]["modes"]) == len(FRAME_HZ)
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "Mode shapes" in report
    assert "setup03.uff" in report
    # beams of one node give its motion along the axes
    from operando.io import read

    written = read(tmp_path / "out" / "operating_modes.uff").models[0]
    assert {str(d) for d in written.dofs} >= {"5+X", "5+Y", "5+Z"}
    assert any(f.kind == "directions_resolved" for f in results.findings)

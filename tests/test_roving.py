"""Roving tests: sensors that move between files, a hammer that moves, files and hits that do not fit."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from measurements import idle_chain, record, running_chain, write_test
from operando.cli import main
from operando.frf import estimate_frf
from structures import Chain, modified

NODES = (1, 2, 3, 4, 5, 6)


def structure(sensor_mass=0.0, at=()):
    """Six masses of 2 kg; sensors of some mass sit at some of them."""
    chain = Chain(n=6, mass=2.0, stiffness=1.2e5, zeta=0.01, seed=3)
    for node in at:
        chain = modified(chain, mass=(node - 1, sensor_mass))
    return chain


def cut_records(folder):
    """``write_test`` with long idle runs of which a table takes a part."""
    path = write_test(folder, check=False)
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace('["idle/*.uff"]', '["idle/*.uff", {file = "idle/run1.uff", start_s = 4, stop_s = 20}]'), encoding="utf-8")
    return path


def file(name, nodes, seed=1, chain=None, driven=0, level=5.0, seconds=20.0):
    """A run with the sensors at some nodes."""
    whole = record(chain or structure(), [driven], level, seed, name, seconds=seconds)
    return whole.select([i for i, c in enumerate(whole.channels) if c.is_force or c.dof.node in nodes])


def kinds(frf):
    """What the estimates report besides their form; 20 s of these modes leak into blocks however they are cut."""
    return [f.kind for f in frf.findings if f.kind not in ("estimator", "excited_band", "leakage")]


@pytest.mark.parametrize("estimator", ["h1", "lrm"])
def test_sensors_of_all_files_give_the_frfs_of_one_measurement(estimator):
    at_once = estimate_frf(file("all", NODES), estimator=estimator)
    parts = estimate_frf([file("a", (1, 2)), file("b", (3, 4)), file("c", (5, 6))], estimator=estimator)
    assert parts.responses == at_once.responses
    assert kinds(parts) == []
    if estimator == "h1":  # each pair is estimated by itself
        np.testing.assert_allclose(parts.data, at_once.data, rtol=1e-12)
        np.testing.assert_allclose(parts.variance, at_once.variance, rtol=1e-9)
        np.testing.assert_allclose(parts.coherence, at_once.coherence, rtol=1e-9)
    else:  # the local models share a denominator between the sensors of one file: equal within their noise
        lines = np.flatnonzero(np.isin(np.round(at_once.frequencies_hz, 6), np.round(parts.frequencies_hz, 6)))
        assert lines.size > 0.5 * len(parts.axis)
        same = np.flatnonzero(np.isin(np.round(parts.frequencies_hz, 6), np.round(at_once.frequencies_hz, 6)))
        apart = np.abs(parts.data[:, :, same] - at_once.data[:, :, lines]) ** 2
        assert np.mean(apart / (parts.variance[:, :, same] + at_once.variance[:, :, lines])) < 0.5


def test_a_sensor_that_stays_is_averaged_and_the_others_are_kept():
    one, two = file("a", (1, 2, 3), seed=1), file("b", (1, 4, 5, 6), seed=2)
    options = {"estimator": "h1", "block_seconds": 4.0}
    merged, first, second = (estimate_frf(part, **options) for part in ([one, two], one, two))
    assert [d.node for d in merged.responses] == list(NODES)
    assert kinds(merged) == []
    assert np.median(merged.variance[0] / first.variance[0]) == pytest.approx(0.5, abs=0.15)
    np.testing.assert_array_equal(merged.data[1:3], first.data[1:])
    np.testing.assert_array_equal(merged.data[3:], second.data[1:])
    # as if all had been measured in the first file, where nothing but the noise differs
    assert np.isfinite(merged.data).all()


def test_mass_loading_is_found_by_the_sensor_that_stays_and_nothing_is_lost():
    light, heavy = structure(0.05, (1, 2, 3)), structure(0.05, (1, 4, 5, 6))
    merged = estimate_frf([file("a.uff", (1, 2, 3), 1, light), file("b.uff", (1, 4, 5, 6), 2, heavy)])
    assert [d.node for d in merged.responses] == list(NODES)
    assert np.isfinite(merged.data).all()
    [finding] = [f for f in merged.findings if f.kind == "shifted_modes"]
    assert finding.file == "b.uff"
    assert "sensors that only b.uff measured are kept" in finding.consequence
    true = 100 * (heavy.hz / light.hz - 1)
    assert f"{true.min():+.2g}"[:4] in finding.message  # the largest shift, to one digit: -0.37 % in the third mode
    assert "sensors moved; in b.uff" in finding.message
    # the row both measured is that of the first file: two structures are not averaged
    alone = estimate_frf(file("a.uff", (1, 2, 3), 1, light), line_spacing_hz=float(merged.axis.step), estimator="lrm")
    np.testing.assert_allclose(merged.data[0], alone.data[0], rtol=1e-9)


def test_a_level_is_told_only_by_the_same_sensors_at_two_levels():
    light, heavy = structure(0.05, (1, 2, 3)), structure(0.05, (1, 4, 5, 6))
    roving = estimate_frf([file("a", (1, 2, 3), 1, light), file("b", (1, 4, 5, 6), 2, heavy, level=20.0)])
    assert kinds(roving) == ["shifted_modes"]
    assert "and the level changed" in next(f.message for f in roving.findings if f.kind == "shifted_modes")
    again = file("c", (1, 2, 3), 3, heavy, level=20.0)
    both = estimate_frf([file("a", (1, 2, 3), 1, light), file("b", (1, 4, 5, 6), 2, heavy, level=20.0), again])
    [finding] = [f for f in both.findings if f.kind == "nonlinear"]
    assert "the response depends on the level" in finding.message
    assert "1 of 3 runs are left out" in finding.consequence
    assert "only b measured are kept" in finding.consequence
    assert [d.node for d in both.responses] == list(NODES)


def test_shift_is_measured_between_files_without_a_common_sensor():
    from operando.frf.shift import WIDTHS_APART

    assert WIDTHS_APART == 0.05
    light, heavy = structure(0.2, (1, 2, 3)), structure(0.2, (4, 5, 6))
    merged = estimate_frf([file("a.uff", (1, 2, 3), 1, light), file("b.uff", (4, 5, 6), 2, heavy)])
    [finding] = [f for f in merged.findings if f.kind == "shifted_modes"]
    assert finding.file == "b.uff"
    assert "against a.uff" in finding.message
    assert kinds(estimate_frf([file("a.uff", (1, 2, 3), 1), file("b.uff", (4, 5, 6), 2)])) == []


def test_shifts_have_the_size_of_the_truth():
    from operando.frf.shift import frequency_shifts

    f = np.arange(5.0, 80.0, 0.02)
    rng = np.random.default_rng(0)
    one, two = structure(), structure(0.02, (4,))
    sets = []
    for chain in (one, two):
        h = chain.accelerance(f, ref=[0])[:, 0]
        variance = np.full(h.shape, (1e-3 * np.abs(h).mean()) ** 2)
        sets.append((h + np.sqrt(variance / 2) * (rng.normal(size=h.shape) + 1j * rng.normal(size=h.shape)), variance))
    shift = frequency_shifts(f, *sets)
    order = [int(np.argmin(np.abs(one.hz - hz))) for hz in shift.frequencies_hz]
    true = (two.hz / one.hz - 1)[order]
    assert len(order) >= 5
    # neighbouring modes bias both poles alike: a tenth of the shift, or what noise explains, remains
    assert np.all(np.abs(shift.relative - true) < 0.1 * np.abs(true) + 4 * shift.std)


def test_a_mode_that_hardly_shows_does_not_name_the_largest_shift():
    from operando.frf.shift import UNSURE, frequency_shifts

    assert UNSURE == 20.0
    f = np.arange(5.0, 80.0, 0.02)
    rng = np.random.default_rng(1)
    chain, sets = structure(), []
    for _ in range(2):
        h = chain.accelerance(f, ref=[0])[:, 0]
        variance = np.full(h.shape, (1e-4 * np.abs(h).mean()) ** 2)
        low = (f > 15) & (f < 20)  # around the first mode the noise is 1500 times as large
        variance[:, low] *= 1500.0**2
        sets.append((h + np.sqrt(variance / 2) * (rng.normal(size=h.shape) + 1j * rng.normal(size=h.shape)), variance))
    shift = frequency_shifts(f, *sets)
    assert shift.frequencies_hz.min() > 20
    assert np.all(np.abs(shift.relative) < 1e-4)


def test_pairs_not_measured_are_nan_and_named():
    files = [file("a1", (1, 2, 3)), file("b1", (4, 5, 6)), file("a2", (1, 2, 3), 3, driven=2)]
    merged = estimate_frf(files)
    empty = np.isnan(merged.data.real).all(axis=2)
    np.testing.assert_array_equal(empty, [[False, False]] * 3 + [[False, True]] * 3)
    [finding] = [f for f in merged.findings if f.kind == "missing_pair"]
    assert finding.message.startswith("3 of 12 response/reference pairs were not measured (4+Z/3+Z, 5+Z/3+Z, 6+Z/3+Z)")


def test_opposite_senses_and_other_order_of_the_same_sensor():
    one, two = file("a", (1, 2), seed=1), file("b", (1, 4), seed=2)
    turned = replace(
        two,
        data=two.data[::-1] * np.array([[1.0], [-1.0], [1.0]]),
        channels=tuple(replace(c, dof=c.dof.opposite) if c.dof.node == 1 and not c.is_force else c for c in two.channels[::-1]),
    )
    straight, other = (estimate_frf([one, b], estimator="h1", block_seconds=4.0) for b in (two, turned))
    np.testing.assert_allclose(other.data, straight.data, rtol=1e-12)
    assert kinds(other) == []


def test_modes_of_a_roving_test_are_those_of_one_measurement(tmp_path):
    from operando import fit_ema

    chain = idle_chain()
    whole = record(chain, [0], 5.0, 1, "all", seconds=30.0)
    at_once = fit_ema(estimate_frf(whole), band=(10.0, 90.0), records=[whole])
    runs = [record(chain, [0], 5.0, seed, f"run{seed}", seconds=30.0) for seed in (1, 2)]
    parts = [
        r.select([i for i, c in enumerate(r.channels) if c.is_force or c.dof.node in n])
        for r, n in zip(runs, ((1, 2), (3, 4)), strict=True)
    ]
    roving = fit_ema(estimate_frf(parts), band=(10.0, 90.0), records=parts)
    assert roving.dofs == at_once.dofs
    hz, zeta = roving.frequencies_hz[roving.in_band], roving.damping_ratios[roving.in_band]
    np.testing.assert_allclose(hz, chain.hz[(chain.hz > 10) & (chain.hz < 90)], rtol=2e-4)
    np.testing.assert_allclose(zeta, 0.01, rtol=0.02)
    assert roving.scaling == "unit_modal_mass"
    for k in np.flatnonzero(roving.in_band):
        r = int(np.argmin(np.abs(chain.hz - roving.frequencies_hz[k])))
        true = chain.phi[:, r] * np.sign(chain.phi[0, r] * roving.shapes[0, k])
        np.testing.assert_allclose(roving.shapes[:, k], true, atol=0.01 * np.abs(true).max())


def call(*words):
    done = CliRunner().invoke(main, [str(w) for w in words])
    return done.exit_code, done.stderr


def test_parts_of_records_through_the_command_line(tmp_path):
    path = cut_records(tmp_path / "a")
    out = tmp_path / "out"
    code, _ = call("frf", path, "-o", out)
    assert code == 0
    document = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    rows = {row["file"]: row for row in document["inventory"]}
    assert rows["idle/run1.uff"]["duration_s"] == 16.0
    assert (rows["idle/run1.uff"]["start_s"], rows["idle/run1.uff"]["stop_s"]) == (4.0, 20.0)
    assert rows["idle/run2.uff"]["duration_s"] == 24.0
    assert document["settings"]["parts_of_records"] == [{"state": "idle", "file": "idle/run1.uff", "start_s": 4.0, "stop_s": 20.0}]
    assert any(text.startswith("cut(start_s=4, stop_s=20)") for text in document["idle"]["frf"]["calls"])
    # the same again: nothing is made anew; another part: it is
    code, said = call("frf", path, "-o", out)
    assert "unchanged" in said
    path.write_text(path.read_text(encoding="utf-8").replace("stop_s = 20", "stop_s = 21"), encoding="utf-8")
    code, said = call("frf", path, "-o", out)
    assert "unchanged" not in said
    assert "cut(start_s=4, stop_s=21)" in (out / "summary.json").read_text(encoding="utf-8")
    path.write_text(path.read_text(encoding="utf-8").replace("stop_s = 21", "stop_s = 30"), encoding="utf-8")
    code, said = call("frf", path, "-o", out)
    assert code == 1
    assert "stop_s = 30 s lies outside the record, which is 24 s long" in said
    assert "idle/run1.uff" in said


def test_two_parts_of_one_file_are_two_runs(tmp_path):
    from operando.config import Span, State, Test
    from operando.io import write_uff
    from operando.pipeline.inputs import Inputs
    from operando.pipeline.stages import runs_behind

    write_uff(tmp_path / "a.uff", record(idle_chain(), [0], 5.0, 1, "a"))
    file_ = tmp_path / "a.uff"
    test = Test("t", idle=State((file_, file_), spans=(Span(0.0, 10.0), Span(12.0, None))))
    first, second = Inputs(test).records(test.idle, force=True)
    assert (first.name, second.name) == ("a.uff (0 s to 10 s)", "a.uff (12 s to the end)")
    assert (first.duration_s, second.start_s, second.duration_s) == (10.0, 12.0, 12.0)
    frf = estimate_frf(second)
    assert runs_behind(frf, [first, second]) == [second]


def test_roving_files_through_the_command_line(tmp_path):
    """Idle and check with roving sensors, one pair not measured: every stage finishes and every sensor is there."""
    from operando.io import write_uff

    path = write_test(tmp_path / "a")
    for state, name, chain, driven, level, seed in (
        ("idle", "run1", idle_chain(), 0, 5.0, 1),
        ("idle", "run2", idle_chain(), 2, 5.0, 2),
        ("check", "run1a", running_chain(), 0, 8.0, 4),
    ):
        folder = path.parent / state
        (folder / f"{name}.uff").unlink()
        for k, nodes in enumerate(((1, 2, 3), (1, 3, 4))):
            if (name, k) != ("run2", 0):  # the first set of sensors was not measured with the second reference
                whole = record(chain, [driven], level, seed + 10 * k, name)
                write_uff(
                    folder / f"{name}_{k}.uff", whole.select([i for i, c in enumerate(whole.channels) if c.is_force or c.dof.node in nodes])
                )
    (path.parent / "check/run1b.uff").unlink()
    out = tmp_path / "out"
    code, said = call("run", path, "-o", out)
    assert code == 0, said
    document = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert document["left_out"] == {}
    assert document["idle"]["frf"]["responses"] == ["1+Z", "2+Z", "3+Z", "4+Z"]
    assert [f["message"][:60] for f in document["findings"] if f["kind"] == "missing_pair"] == [
        "1 of 8 response/reference pairs were not measured (2+Z/3+Z)"[:60]
    ]
    assert not [f for f in document["findings"] if f["severity"] == "error"]
    modes = [m for m in document["idle"]["modes"] if m["in_band"]]
    hz = idle_chain().hz
    np.testing.assert_allclose([m["frequency_hz"] for m in modes], hz[(hz > 10) & (hz < 90)], rtol=5e-4)
    assert all(set(m["shape"]) == {"1+Z", "2+Z", "3+Z", "4+Z"} for m in modes)
    assert (out / "report.html").stat().st_size > 10000
    comparison = json.loads((out / "comparison.json").read_text(encoding="utf-8"))
    assert {row["dof"] for row in comparison["models"]["idle"]["by_dof"]} == {"1+Z", "2+Z", "3+Z", "4+Z"}


@pytest.mark.parametrize(
    ("line", "message", "hint"),
    [
        ('references = ["1+Z", "33+Z"]', "no idle force acts at 33+Z", "did you mean '3+Z'?"),
        ('oma_references = ["5+X"]', "no operating record has a sensor at 5+X", "'5+Z'|known: |did you mean"),
        ('[channels]\n"acc9" = {exclude = true}', "[channels] acc9: 'acc9' names no channel of any file", "did you mean 'acc"),
    ],
)
def test_names_that_are_in_no_file_end_the_run_with_the_nearest(tmp_path, line, message, hint):
    path = write_test(tmp_path / "a", check=False, extra=line)
    code, said = call("frf", path, "-o", tmp_path / "out")
    assert code == 1
    assert message in said
    assert any(text in said for text in hint.split("|"))
    path.write_text(path.read_text(encoding="utf-8").replace("33+Z", "3-Z").replace("5+X", "2-Z").replace("acc9", "acc4"), encoding="utf-8")
    assert call("frf", path, "-o", tmp_path / "out")[0] == 0


def test_hits_rejected_through_the_command_line(tmp_path):
    from operando.io import write_uff
    from test_roving_hammer import EVERY_8_S, run

    (tmp_path / "idle").mkdir()
    for k in range(2):
        write_uff(tmp_path / f"idle/p{k}.uff", run(EVERY_8_S, k, seconds=41, seed=k, elsewhere=[3] if k else []))
    path = tmp_path / "test.toml"
    path.write_text('[idle]\nrecords = ["idle/*.uff"]\n[analysis]\nhits = "all"\nhits_reject = ["p1.uff#3"]\n', encoding="utf-8")
    out = tmp_path / "out"
    code, said = call("run", path, "-o", out, "--until", "frf")
    assert code == 0, said
    document = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert document["settings"]["hits_reject"] == ["p1.uff#3"]
    hits = document["inventory"][1]["hits"]
    assert [h["number"] for h in hits] == [0, 1, 2, 3, 4]
    assert hits[3]["time_s"] == pytest.approx(24.5, abs=0.02)
    [finding] = [f for f in document["findings"] if f["kind"] == "rejected_hit"]
    assert (finding["file"], finding["message"][:18]) == ("idle/p1.uff", "hit #3 at 24.508 s")
    path.write_text(path.read_text(encoding="utf-8").replace("#3", "#5"), encoding="utf-8")
    code, said = call("run", path, "-o", out, "--until", "frf")
    assert code == 1
    assert "hits_reject names hit #5 of idle/p1.uff, which has hits #0 to #4" in said


def test_hits_stand_numbered_in_the_report():
    from operando.report.parts import render
    from operando.report.sections_rest import inventory

    hits = [{"number": k, "time_s": 1.5 + k, "peak": 100.0, "unit": "N"} for k in range(20)]
    text = render("inventory.html.j2", **inventory([{"file": "idle/p1.uff", "used_for": "idle", "format": "uff", "hits": hits}]))
    assert "#0 1.50 s, 100 N" in text
    assert "#19 20.50 s, 100 N" in text

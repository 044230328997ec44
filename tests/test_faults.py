"""Runs that are stopped at their writes, outputs that are spoilt: the next run gives the same as an undisturbed one, to the bit.

The sweeps over every write and over 200 random times are in ``benchmarks/faults``; here are a few of each.
"""

from __future__ import annotations

import os
import shutil

import pytest

import faults

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Test file, folder of older results, outputs and stages of an undisturbed run, its steps over the older results."""
    from operando.pipeline import run, runner
    from operando.report import page

    base = tmp_path_factory.mktemp("faults")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "STEPS", runner.STEPS)
        patch.setattr(page, "render_report", page.render_report)
        faults.hold_results()
        new = faults.small_test(base / "test")
        old = new.with_name("old.toml")
        old.write_text(new.read_text().replace("band = [10.0, 50.0]", "band = [12.0, 48.0]\nblock_seconds = 2.0"))
        run(old, base / "old")
        run(new, base / "new")
        shutil.copytree(base / "old", base / "out")
        assert faults.run_in_a_fork(new, base / "out", report=base / "steps") == 0
        assert faults.outputs(base / "out") == faults.outputs(base / "new")
        yield new, base / "old", base / "new", (base / "steps").read_text().splitlines()


def points(steps):
    """A write of a stage, of the manifest and of an output, the last file written aside, and a name given when the old files are gone."""
    out = {name: next(i for i, s in enumerate(steps, 1) if s.startswith(f"write .{name}")) for name in ("ema.h5", "report.html")}
    out["manifest"] = [i for i, s in enumerate(steps, 1) if s.startswith("write .manifest")][3]
    names = [i for i, s in enumerate(steps, 1) if s == "rename summary.json"]
    return out | {"aside": names[0], "name": names[-1]}


@pytest.mark.parametrize("fault", faults.FAULTS)
@pytest.mark.parametrize("where", ["ema.h5", "manifest", "report.html", "aside", "name"])
def test_a_fault_at_a_write_leaves_old_results_whole_or_none(small, tmp_path, fault, where):
    test, older, newer, steps = small
    out = tmp_path / "out"
    shutil.copytree(older, out)
    old, new = faults.outputs(older), faults.outputs(newer)
    status = faults.run_in_a_fork(test, out, fault, points(steps)[where])
    if where != "name":
        assert faults.outputs(out) == old
    assert faults.problems(fault, status, out, old, new) == []
    status = faults.run_in_a_fork(test, out)
    assert faults.after_a_clean_run(status, out, new, faults.stage_results(newer)) == []


def test_a_spoilt_output_is_made_again_and_nothing_else(small, tmp_path):
    test, _, newer, _ = small
    out = tmp_path / "out"
    shutil.copytree(newer, out)
    whole = {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()}
    assert len(whole) == 12
    for number, (name, data) in enumerate(whole.items()):
        path, middle = out / name, len(data) // 2
        before = {p.name: p.stat().st_mtime_ns for p in out.iterdir() if p.is_file() and p.name != name}
        spoilt = (None, b"", data[:middle], data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :])[number % 4]
        path.unlink()
        if spoilt is not None:
            path.write_bytes(spoilt)
        assert faults.run_in_a_fork(test, out) == 0
        assert path.read_bytes() == data, name
        assert {p.name: p.stat().st_mtime_ns for p in out.iterdir() if p.is_file() and p.name != name} == before
        log = (tmp_path / "out.log").read_text(encoding="utf-8")
        assert f"{name} is missing or changed since the last run: made again" in log
        assert log.count("unchanged, taken from the last run") == (9 if name == "report.html" else 10)
        assert "done in" not in log.replace("report   done in", "")

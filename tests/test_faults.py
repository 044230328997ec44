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
    """Test file, older results, an undisturbed run, and its steps over the older results."""
    import operando.io
    from operando.pipeline import cache, run, runner
    from operando.report import page

    base = tmp_path_factory.mktemp("faults")
    with pytest.MonkeyPatch.context() as patch:
        for where, name in ((runner, "STEPS"), (page, "render_report"), (cache, "_read"), (operando.io, "write_hdf5")):
            patch.setattr(where, name, getattr(where, name))
        faults.hold_results()
        test = faults.small_test(base / "test")
        run(test, base / "new")
        (base / "old").mkdir()
        for name in faults.outputs(base / "new"):
            (base / "old" / name).write_text(f"older {name}")
        shutil.copytree(base / "old", base / "out")
        assert faults.run_in_a_fork(test, base / "out", report=base / "steps") == 0
        assert faults.outputs(base / "out") == faults.outputs(base / "new")
        yield test, base / "old", base / "new", (base / "steps").read_text().splitlines()


def points(steps):
    """A write of a stage, of the manifest and of an output, and a file that takes its name when the old ones are gone."""
    written = {name: next(i for i, s in enumerate(steps, 1) if s.startswith(f"write .{name}")) for name in ("ema.h5", "report.html")}
    manifest = [i for i, s in enumerate(steps, 1) if s.startswith("write .manifest")][3]
    return written | {"manifest": manifest, "name": max(i for i, s in enumerate(steps, 1) if s == "rename model.h5")}


# each fault at two of the three places where new files are written, and where the old ones go
@pytest.mark.parametrize(
    ("where", "fault"),
    [
        ("ema.h5", "kill"),
        ("ema.h5", "full"),
        ("manifest", "full"),
        ("manifest", "interrupt"),
        ("report.html", "interrupt"),
        ("report.html", "kill"),
        *(("name", fault) for fault in faults.FAULTS),
    ],
)
def test_a_fault_at_a_write_leaves_old_results_whole_or_none(small, tmp_path, where, fault):
    test, older, newer, steps = small
    out = tmp_path / "out"
    shutil.copytree(older, out)
    old, new = faults.outputs(older), faults.outputs(newer)
    status = faults.run_in_a_fork(test, out, fault, points(steps)[where])
    assert where == "name" or faults.outputs(out) == old
    assert faults.problems(fault, status, out, old, new) == []
    status = faults.run_in_a_fork(test, out)
    assert faults.after_a_clean_run(status, out, new, faults.stage_results(newer)) == []


def test_a_folder_that_cannot_be_written_keeps_its_results(small, tmp_path):
    test, older, _, _ = small
    out = tmp_path / "out"
    shutil.copytree(older, out)
    assert faults.run_in_a_fork(test, out, "read-only", 1) == 1
    assert faults.outputs(out) == faults.outputs(older)
    log = (tmp_path / "out.log").read_text(encoding="utf-8")
    assert log.startswith("operando: ")
    assert "Read-only file system (choose another folder" in log
    assert len(log.splitlines()) == 1


@pytest.mark.parametrize("first", [0, 1])
def test_spoilt_outputs_are_made_again_and_nothing_else(small, tmp_path, first):
    """Every other output missing, emptied, cut or altered in one bit."""
    test, _, newer, _ = small
    out = tmp_path / "out"
    shutil.copytree(newer, out)
    whole = faults.outputs(out)
    assert len(whole) == 11
    names = sorted(whole)[first::2]
    for number, name in enumerate(names):
        data, middle = whole[name], len(whole[name]) // 2
        (out / name).unlink()
        if number % 4:
            spoilt = (b"", data[:middle], data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :])[number % 4 - 1]
            (out / name).write_bytes(spoilt)
    others = {name: (out / name).stat().st_mtime_ns for name in whole if name not in names}
    assert faults.run_in_a_fork(test, out) == 0
    assert faults.outputs(out) == whole
    assert {name: (out / name).stat().st_mtime_ns for name in others} == others
    log = (tmp_path / "out.log").read_text(encoding="utf-8")
    assert all(f"{name} is missing or changed since the last run: made again" in log for name in names)
    # what the stages found stands in model.h5 alone
    assert ("done in" in log.replace("report   done in", "")) == ("model.h5" in names)

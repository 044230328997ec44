"""Results of stages stand in ``model.h5`` alone once a run is done; whatever ends it, what a stage found is there once, and read again."""

from __future__ import annotations

import json
import os
import shutil
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

import models
from measurements import running_chain
from operando.data import Finding, Geometry
from operando.pipeline import cache
from operando.pipeline.cache import Kept, apart, in_model, load_stage, save_stage, stage_file
from operando.pipeline.folder import HIDDEN, MODEL, adopt, results_folder
from operando.pipeline.stages.diagnose import missing_physics
from operando.pipeline.stages.work import Lacking
from operando.results import CheckRun, Results
from operando.store import load_results, save_results

FRF, CHECK = stage_file("frf"), stage_file("compare")


@pytest.fixture(scope="module")
def frf():
    return models.measured(running_chain())


def run_of(folder, frf, number=1, stages=("frf", "compare"), **more):
    """What a run does: keep its stages, then the results with what stands nowhere else."""
    found = {"frf": {"idle_frf": frf, "findings": [Finding("x", "of frf")]}, "compare": {"comparison": {"number": number}}}
    kept, keys = {}, {}
    for stage in stages:
        keys[stage] = f"key {stage} {number if stage == 'compare' else ''}"
        kept[stage] = load_stage(folder, stage, keys[stage]) or save_stage(folder, stage, keys[stage], found[stage], 1.5)
    results = Results("chain", comparison={"number": -number})  # the comparison of the stage did not last
    for one in kept.values():
        results.idle_frf = one.found.get("idle_frf", results.idle_frf)
    results.stages = {stage: one.rest(results) for stage, one in kept.items()}
    folder.stage(MODEL, f"model {number} {stages}", lambda path: save_results(results, path))
    standing = in_model(kept, keys, results, folder.model_hash())
    apart(folder, kept)
    folder.commit(standing=standing, **more)
    return keys


def there(tmp_path):
    return sorted(p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*.h5"))


def whole(folder, keys, frf, stage="frf"):
    kept = load_stage(folder, stage, keys[stage])
    if kept is None:
        return False
    if stage == "frf":
        np.testing.assert_array_equal(kept.found["idle_frf"].data, frf.data)
        np.testing.assert_array_equal(kept.found["idle_frf"].variance, frf.variance)
        assert kept.found["findings"] == [Finding("x", "of frf")]
    return kept.seconds == 1.5


def test_a_result_stands_once_and_comes_back(tmp_path, frf):
    with results_folder(tmp_path, "test") as folder:
        keys = run_of(folder, frf)
        assert there(tmp_path) == [MODEL]
    with results_folder(tmp_path, "test") as folder:
        assert whole(folder, keys, frf)
        assert load_stage(folder, "compare", keys["compare"]).found == {"comparison": {"number": 1}}
        assert load_stage(folder, "frf", "other") is None
    back = load_results(tmp_path)
    assert back.comparison == {"number": -1}
    assert back.stages["compare"] == {"comparison": {"number": 1}}


@pytest.mark.parametrize("harm", ["gone", "cut", "bit"])
def test_what_stood_in_a_spoilt_model_is_found_again(tmp_path, frf, harm):
    with results_folder(tmp_path, "test") as folder:
        keys = run_of(folder, frf)
    path = tmp_path / MODEL
    data = bytearray(path.read_bytes())
    if harm == "gone":
        path.unlink()
    else:
        data[len(data) // 2] ^= 1
        path.write_bytes(data[:5000] if harm == "cut" else data)
    with results_folder(tmp_path, "test") as folder:
        assert not whole(folder, keys, frf)
        assert whole(folder, run_of(folder, frf), frf)
        assert there(tmp_path) == [MODEL]


@pytest.mark.parametrize("number", [1, 2])
def test_a_run_that_ends_at_any_call_loses_no_stage(tmp_path, frf, monkeypatch, number):
    """Of the run whose outputs take the place of older ones: at each call that changes the folder, the next process finds both stages."""
    with results_folder(tmp_path / "old", "test", make=True) as folder:
        run_of(folder, frf)
    ended = 0
    for at in range(1, 100):
        out = tmp_path / f"at{at}"
        shutil.copytree(tmp_path / "old", out, copy_function=shutil.copy2)
        with results_folder(out, "test") as folder, monkeypatch.context() as patch:
            done = []
            real_commit = folder.commit

            def commit(*args, **kwargs):
                if kwargs.get("standing"):  # the last one of the run
                    stop_at(patch, at, done)  # noqa: B023
                real_commit(*args, **kwargs)  # noqa: B023

            patch.setattr(folder, "commit", commit)
            try:
                keys = run_of(folder, frf, number)
            except Stopped:
                ended += 1
                keys = {"frf": "key frf ", "compare": f"key compare {number}"}
            else:
                break
            patch.undo()
        with results_folder(out, "test") as folder:
            assert whole(folder, keys, frf), at
            assert whole(folder, keys, frf, "compare"), at
            run_of(folder, frf, number)
            assert there(out) == [MODEL], at
    assert ended >= 4


class Stopped(BaseException):
    """The process ends here."""


def stop_at(patch, at, done):
    """End at the n-th call that changes the folder, and undo nothing."""
    for name in ("replace", "unlink"):
        real = getattr(os, name)

        def counted(*args, real=real, **kwargs):
            done.append(args)
            if len(done) >= at:
                raise Stopped
            return real(*args, **kwargs)

        patch.setattr(os, name, counted)


def test_a_stage_that_is_no_more_in_the_model_gets_a_file_again(tmp_path, frf):
    with results_folder(tmp_path, "test") as folder:
        first = run_of(folder, frf)
        second = run_of(folder, frf, 2, stages=("compare",))
        assert there(tmp_path) == [FRF, MODEL]
        assert whole(folder, first, frf)
        assert whole(folder, second, frf, "compare")
        run_of(folder, frf, 3)
        assert there(tmp_path) == [MODEL]


def test_a_model_changed_by_hand_leaves_the_stages(tmp_path, frf):
    with results_folder(tmp_path, "test") as folder:
        keys = run_of(folder, frf)
        for number in (1, 2):
            results = load_results(tmp_path)
            results.diagnosis = {"by hand": number}
            folder.stage(MODEL, None, lambda path, results=results: save_results(results, path))
            folder.commit()
            assert load_results(tmp_path).diagnosis == {"by hand": number}
            assert there(tmp_path) == [f"{HIDDEN}/{MODEL}", MODEL]
            assert whole(folder, keys, frf)
    with results_folder(tmp_path, "test") as folder:
        assert whole(folder, keys, frf)
        run_of(folder, frf, 2)
        assert there(tmp_path) == [MODEL]


def test_another_folder_begins_with_stages_that_stand_in_a_model(tmp_path, frf):
    with results_folder(tmp_path / "a", "test", make=True) as folder:
        keys = run_of(folder, frf)
    adopt(tmp_path / "a", tmp_path / "b", ("frf", "automatic"))
    with results_folder(tmp_path / "b", "test") as folder:
        assert whole(folder, keys, frf)
        assert load_stage(folder, "compare", keys["compare"]) is None
        run_of(folder, frf, 2)
        assert there(tmp_path / "b") == [MODEL]
    with results_folder(tmp_path / "a", "test") as folder:
        assert whole(folder, keys, frf)


def test_a_folder_of_an_earlier_version_is_read(tmp_path, frf):
    """There each stage has a file besides ``model.h5``, and that holds no ``stages``."""
    with results_folder(tmp_path, "test") as folder:
        save_stage(folder, "frf", "key frf ", {"idle_frf": frf, "findings": [Finding("x", "of frf")]}, 1.5)
        folder.stage(MODEL, "model", lambda path: save_results(Results("chain", idle_frf=frf), path))
        folder.commit()
    with h5py.File(tmp_path / MODEL, "a") as file:
        del file["stages"]
        file.attrs["objects"] = json.dumps([name for name in json.loads(file.attrs["objects"]) if name != "stages"])
    assert load_results(tmp_path).stages == {}
    with results_folder(tmp_path, "test") as folder:
        assert whole(folder, {"frf": "key frf "}, frf)
        run_of(folder, frf)
        assert there(tmp_path) == [MODEL]


def test_what_a_later_stage_replaced_is_kept_by_the_one_that_found_it():
    geometry, other = (Geometry((1,), [[x, 0.0, 0.0]]) for x in (0.0, 1.0))
    results = Results("chain", geometry=other, inventory=[{"file": "a"}])
    kept = Kept({"geometry": geometry, "inventory": results.inventory, "findings": [1]}, 1.0)
    assert kept.standing(results) == ["inventory"]
    assert kept.rest(results) == {"geometry": geometry, "findings": [1]}
    assert {"geometry", "stages"} <= cache._NAMES


def arrays(folder):
    """Hash of the values of each array of some size in HDF5 files, and where it stands."""
    found: dict[bytes, list[str]] = {}
    for path in folder.rglob("*.h5"):
        with h5py.File(path) as file:

            def look(name, item, path=path):
                if isinstance(item, h5py.Dataset) and item.dtype.kind in "fc" and item.size * item.dtype.itemsize >= 4096:
                    found.setdefault(item[()].tobytes(), []).append(f"{path.name}:{name}")

            file.visititems(look)
    return found


def test_no_array_stands_twice_in_a_folder(tmp_path, monkeypatch):
    import measurements
    from operando.pipeline import run

    monkeypatch.setattr("operando.report.write_report", lambda results, path: path.write_text(results.name, encoding="utf-8"))
    path = measurements.write_test(tmp_path)
    messages = []
    run(path, tmp_path / "out", until="compare")
    found = arrays(tmp_path / "out")
    assert len(found) > 5
    assert {places[0]: places for places in found.values() if len(places) > 1} == {}
    assert there(tmp_path / "out") == [MODEL]
    run(path, tmp_path / "out", until="compare", progress=lambda stage, message: messages.append(message))
    assert all(message.startswith("unchanged") for message in messages)


@pytest.mark.parametrize(("state", "checked"), [("check", True), ("operating", False)])
def test_a_measurement_compared_with_itself_is_no_diagnosis(frf, monkeypatch, state, checked):
    """That idle model and operation do not differ says nothing where both are one measurement."""
    monkeypatch.setattr("operando.pipeline.stages.diagnose.scaled", lambda *given: None)
    inventory = [{"file": "a.uff", "sha256": "1", "used_for": f"idle, {state}"}]
    check = [CheckRun("check", "", frf)] if checked else []
    results = SimpleNamespace(idle="idle", check=check, operating="operating", findings=[], inventory=inventory)
    work = SimpleNamespace(results=results, analysis=SimpleNamespace(exclude_bands=()))
    with pytest.raises(Lacking, match=rf"the data of \[{state}\] are those of \[idle\]: one measurement is compared with itself"):
        missing_physics(work)

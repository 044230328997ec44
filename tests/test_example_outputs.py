"""The UFF outputs of a run on the packaged example, as pyuff and sdynpy read them."""

from __future__ import annotations

import os
import warnings

import numpy as np
import pytest

from operando.cli.demo import example_folder
from operando.pipeline import run
from test_io_uff_outputs import IN_BAND_DB, difference_db, pair_of, synthesised, wanted_functions

pytestmark = pytest.mark.slow

NAMES = ("ofrf.uff", "idle_frf.uff", "idle_modes.uff")


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    out = tmp_path_factory.mktemp("example")
    results = run(example_folder() / "test.toml", out, until="ofrf")
    assert results.idle.n_residuals > 0
    return out, results


def pairs_in_band(results):
    """Lines in band, and the FRFs of the idle model there between all its DOFs."""
    low, high = results.idle.band_hz
    lines = results.idle_frf.band(low, high).frequencies_hz
    return lines, results.idle.frf(lines, variance=False).data


def assert_modes_make_the_frfs(results, lines, wanted, frequencies, damping, shapes):
    """Modes and residual terms as another reader found them, shapes by DOF of the model, against the FRFs of the model."""
    made = [[synthesised(lines, frequencies, damping, shapes, i, j) for j in range(len(shapes))] for i in range(len(shapes))]
    assert difference_db(np.array(made), wanted) < IN_BAND_DB
    modes = results.idle.n_modes
    alone = synthesised(lines, frequencies[:modes], damping[:modes], shapes[:, :modes], 0, 0)
    assert difference_db(alone, wanted[0, 0]) > IN_BAND_DB  # the residual terms are needed


def test_pyuff_reads_the_same_numbers_of_the_example(example):
    pyuff = pytest.importorskip("pyuff")
    folder, results = example
    lines = results.idle_frf.frequencies_hz
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sets = {name: pyuff.UFF(str(folder / name)).read_sets() for name in NAMES}
    for name, wanted in wanted_functions(results).items():
        found = {(d["func_type"], *pair_of(d["id1"])): d for d in sets[name] if d["type"] == 58}
        assert set(found) == {key for key, values in wanted.items() if not np.all(np.isnan(values))}
        for key, d in found.items():
            np.testing.assert_array_equal(d["data"][: lines.size], wanted[key])
            np.testing.assert_allclose(d["x"], lines, rtol=1e-5, atol=1e-9)
    modes = [d for d in sets["idle_modes.uff"] if d["type"] == 55]
    assert len(modes) == results.idle.n_modes + results.idle.n_residuals
    rows = {int(n): i for i, n in enumerate(modes[0]["node_nums"])}
    shapes = np.array([[sign_of(d) * mode[f"r{abs(d.uff_code)}"][rows[d.number]] for mode in modes] for d in results.idle.dofs])
    lines, wanted = pairs_in_band(results)
    frequencies, damping = ([mode[key] for mode in modes] for key in ("freq", "modal_damp_vis"))
    assert_modes_make_the_frfs(results, lines, wanted, frequencies, damping, shapes)


def test_sdynpy_reads_the_same_numbers_of_the_example(example, monkeypatch):
    monkeypatch.setitem(os.environ, "QT_QPA_PLATFORM", "offscreen")
    sdpy = pytest.importorskip("sdynpy", reason="sdynpy is not installed")
    folder, results = example
    lines = results.idle_frf.frequencies_hz
    unv = {name: sdpy.unv.readunv(str(folder / name)) for name in NAMES}
    for name, wanted in wanted_functions(results).items():
        arrays = sdpy.data.from_unv(unv[name])
        seen = set()
        for array in arrays if isinstance(arrays, list | tuple) else [arrays]:
            for entry in np.ravel(array):
                text = str(np.ravel(entry.comment1)[0])
                key = ({"acc": 4, "coh": 6, "sta": 0}[text[:3]], *pair_of(text))
                np.testing.assert_array_equal(np.ravel(entry.ordinate), wanted[key])
                np.testing.assert_allclose(np.ravel(entry.abscissa), lines, rtol=1e-5, atol=1e-9)
                seen.add(key)
        assert seen == {key for key, values in wanted.items() if not np.all(np.isnan(values))}
    found = sdpy.shape.from_unv(unv["idle_modes.uff"])
    nodes, directions = found[0].coordinate.node, found[0].coordinate.direction
    where = [int(np.flatnonzero((nodes == d.number) & (abs(directions) == abs(d.uff_code)))[0]) for d in results.idle.dofs]
    signs = np.array([sign_of(d) * np.sign(directions[i]) for d, i in zip(results.idle.dofs, where, strict=True)])
    shapes = signs[:, None] * np.array([shape.shape_matrix[where] for shape in found]).T
    lines, wanted = pairs_in_band(results)
    assert_modes_make_the_frfs(results, lines, wanted, np.ravel(found.frequency), np.ravel(found.damping), shapes)


def sign_of(dof):
    return -1 if dof.uff_code < 0 else 1

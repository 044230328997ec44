"""The UFF outputs of a run on the packaged example, as pyuff and sdynpy read them."""

from __future__ import annotations

import os

import numpy as np
import pytest

from operando.paths import example_folder
from operando.pipeline import run
from test_io_uff_outputs import IN_BAND_DB, assert_functions_of_pyuff, assert_functions_of_sdynpy, difference_db, read_by_pyuff, synthesised

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
    folder, results = example
    sets = read_by_pyuff(folder, NAMES)
    assert_functions_of_pyuff(sets, results)
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
    unv = {name: sdpy.unv.readunv(str(folder / name)) for name in NAMES}
    assert_functions_of_sdynpy(sdpy, unv, results)
    found = sdpy.shape.from_unv(unv["idle_modes.uff"])
    nodes, directions = found[0].coordinate.node, found[0].coordinate.direction
    where = [int(np.flatnonzero((nodes == d.number) & (abs(directions) == abs(d.uff_code)))[0]) for d in results.idle.dofs]
    signs = np.array([sign_of(d) * np.sign(directions[i]) for d, i in zip(results.idle.dofs, where, strict=True)])
    shapes = signs[:, None] * np.array([shape.shape_matrix[where] for shape in found]).T
    lines, wanted = pairs_in_band(results)
    assert_modes_make_the_frfs(results, lines, wanted, np.ravel(found.frequency), np.ravel(found.damping), shapes)


def sign_of(dof):
    return -1 if dof.uff_code < 0 else 1

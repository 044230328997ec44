"""The UFF files of the results folder: complete, the same bytes each time, and the same numbers in other readers."""

from __future__ import annotations

import os
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest

import models
from operando.data import Appearance, ModalModel, Provenance
from operando.dof import Dof
from operando.io import read
from operando.pipeline import outputs
from operando.pipeline.outputs import OUTPUTS

NAMES = ("idle_frf.uff", "idle_modes.uff", "operating_modes.uff", "ofrf.uff")
WHEN = Provenance(measured="2026-11-17T09:15:00")
"""Columns of the references that were driven."""
IN_BAND_DB = 0.05
"""Largest difference of re-synthesised FRFs in band, as the issue wants it."""


def finished():
    """Results of the chain with residual terms, a date, coherence, names and colours."""
    results = models.results()
    idle = results.idle
    rng = np.random.default_rng(3)
    with_residuals = ModalModel.from_terms(
        np.append(idle.frequencies_hz, [140.0, 260.0]), np.append(idle.damping_ratios, [0.01, 0.01]),
        np.column_stack([idle.shapes, rng.normal(size=(4, 2))]), idle.dofs, "unit_modal_mass",
        residual=[False] * 4 + [True] * 2, band_hz=idle.band_hz, provenance=WHEN,
    )  # fmt: skip
    frf = results.idle_frf
    results.idle_frf = replace(frf, coherence=np.full(frf.data.shape, 0.99), provenance=WHEN)
    results.idle = with_residuals
    results.hybrid = replace(results.hybrid, modal=replace(results.hybrid.modal, provenance=WHEN))
    results.geometry = replace(results.geometry, appearance=Appearance(line_names=("rail",), line_colors=(4,)))
    return results


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("results")
    results = finished()
    for name in NAMES:
        assert {o.name: o for o in OUTPUTS}[name].write(path / name, results) == []
    return path, results


def in_band(results):
    low, high = results.idle.band_hz
    return results.idle_frf.band(low, high).frequencies_hz


def difference_db(made, wanted):
    return float(np.max(np.abs(20 * np.log10(np.abs(made / wanted)))))


def synthesised(lines, frequencies, damping, shapes, i, j):
    """Accelerance from what a set 55 states, by the formula in its ID lines (no code of operando)."""
    w, wr = 2 * np.pi * lines[:, None], 2 * np.pi * np.asarray(frequencies)
    return np.sum(-(w**2) * shapes[i] * shapes[j] / (wr**2 - w**2 + 2j * np.asarray(damping) * wr * w), axis=1)


def test_each_file_has_header_units_and_geometry(folder):
    path, _ = folder
    for name in NAMES:
        content = read(path / name)
        assert not content.findings
        assert [s.number for s in content.sets[:4]] == [151, 164, 15 if "modes" in name else 2411, 82]
        assert (content.header.name, content.header.writer) == ("chain", "operando")
        assert content.header.description == outputs.DESCRIPTIONS[name]
        assert content.header.written == ("" if name == "operating_modes.uff" else "17-Nov-26 09:15:00")
        assert (content.geometry.appearance.line_names, content.geometry.appearance.line_colors) == (("rail",), (4,))
        assert all(s.status == "used" for s in content.sets)


def test_writing_again_gives_the_same_bytes(folder, tmp_path):
    path, results = folder
    for name in NAMES:
        {o.name: o for o in OUTPUTS}[name].write(tmp_path / name, results)
        assert (tmp_path / name).read_bytes() == (path / name).read_bytes()


def test_frfs_come_back_with_their_error_and_date(folder):
    path, results = folder
    (back,) = read(path / "idle_frf.uff").frfs
    np.testing.assert_array_equal(back.data, results.idle_frf.data)
    np.testing.assert_allclose(back.variance, results.idle_frf.variance, rtol=1e-14)
    np.testing.assert_array_equal(back.frequencies_hz, results.idle_frf.frequencies_hz)
    assert back.provenance.measured == WHEN.measured
    wanted = results.hybrid.modal.frf(results.idle_frf.frequencies_hz)
    (back,) = read(path / "ofrf.uff").frfs
    np.testing.assert_array_equal(back.data, wanted.data.astype(np.complex64))  # a model's lines: seven digits, all of them in model.h5
    assert back.variance is None
    assert b"standard deviation" not in (path / "ofrf.uff").read_bytes()


def test_modes_make_the_frfs_of_the_model(folder):
    path, results = folder
    (back,) = read(path / "idle_modes.uff").models
    assert (back.n_modes, back.n_residuals, back.scaling) == (4, 2, "unit_modal_mass")
    lines = in_band(results)
    wanted = results.idle.frf(lines).data
    assert difference_db(back.frf(lines, results.idle.dofs, results.idle.dofs).data, wanted) < IN_BAND_DB
    assert difference_db(back.without_residuals().frf(lines, results.idle.dofs, results.idle.dofs).data, wanted) > 1.0
    text = (path / "idle_modes.uff").read_text()
    assert text.count("check H ") == 6
    assert text.count("17-Nov-26 09:15:00") == 6 + 3


def test_frfs_go_to_single_precision_where_that_holds_every_digit(folder, tmp_path):
    path, results = folder
    frf = results.idle_frf
    short = replace(results, idle_frf=replace(frf, data=frf.data.astype(np.complex64)))
    {o.name: o for o in OUTPUTS}["idle_frf.uff"].write(tmp_path / "idle_frf.uff", short)
    (back,) = read(tmp_path / "idle_frf.uff").frfs
    np.testing.assert_array_equal(back.data, short.idle_frf.data)
    assert (tmp_path / "idle_frf.uff").stat().st_size < 0.6 * (path / "idle_frf.uff").stat().st_size


def test_skewed_directions_keep_the_residual_terms(tmp_path):
    results = finished()
    dofs = (Dof(1, "a"), *results.idle.dofs[1:])
    results.idle = replace(results.idle, dofs=dofs)
    results.settings["directions"] = {"1+a": [0.6, 0.0, 0.8]}
    (finding,) = {o.name: o for o in OUTPUTS}["idle_modes.uff"].write(tmp_path / "idle_modes.uff", results)
    assert finding.kind == "directions_resolved"
    (back,) = read(tmp_path / "idle_modes.uff").models
    lines = in_band(results)
    rows = back.frf(lines, ["1+X", "1+Z"], ["2+Z"]).data
    assert difference_db(0.6 * rows[0] + 0.8 * rows[1], results.idle.frf(lines, [dofs[0]], ["2+Z"]).data[0]) < IN_BAND_DB


# --- other readers --------------------------------------------------------------------------------------------------------------


NAMED = {4: "accelerance", 6: "coherence", 0: "standard deviation of accelerance"}


def pair_of(text):
    """Response and reference in the first ID line of a function."""
    return tuple(Dof.parse(label) for label in re.search(r"(\S+)/(\S+)$", text.strip()).groups())


def wanted_functions(results):
    """Kind and pair of DOFs → the numbers that a file should hold."""
    frf = results.idle_frf
    ofrf = results.hybrid.modal.frf(frf.frequencies_hz, variance=False)
    single = np.array_equal(frf.data, frf.data.astype(np.complex64))  # then the file is
    out = {"idle_frf.uff": {}, "ofrf.uff": {}}
    for name, h in (("idle_frf.uff", frf), ("ofrf.uff", ofrf)):
        arrays = {4: h.data, 6: h.coherence, 0: None if h.variance is None else np.sqrt(h.variance)}
        if single and h is frf:
            arrays[0] = arrays[0].astype(np.float32)
        for kind, array in arrays.items():
            if array is not None:
                out[name] |= {(kind, r, c): array[i, j] for i, r in enumerate(h.responses) for j, c in enumerate(h.references)}
    return out


def assert_same(name, found, wanted):
    """Measured FRFs to the bit; those of the model, made again here, to the rounding of single precision."""
    if name == "idle_frf.uff":
        np.testing.assert_array_equal(found, wanted)
    else:
        np.testing.assert_allclose(found, wanted, rtol=2**-24 + 1e-12, atol=1e-14 * np.abs(wanted).max())


def read_by_pyuff(path, names):
    pyuff = pytest.importorskip("pyuff")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return {name: pyuff.UFF(str(path / name)).read_sets() for name in names}


def assert_functions_of_pyuff(sets, results):
    """The FRFs of a run, their coherence and deviations, as pyuff read them."""
    lines = results.idle_frf.frequencies_hz
    for name, wanted in wanted_functions(results).items():
        found = {(d["func_type"], *pair_of(d["id1"])): d for d in sets[name] if d["type"] == 58}
        assert set(found) == set(wanted)
        for key, d in found.items():
            assert_same(name, d["data"][: lines.size], wanted[key])
            np.testing.assert_allclose(d["x"], lines, rtol=1e-9)


def assert_functions_of_sdynpy(sdpy, unv, results):
    """The same as sdynpy read them."""
    lines = results.idle_frf.frequencies_hz
    for name, wanted in wanted_functions(results).items():
        arrays = sdpy.data.from_unv(unv[name])
        seen = set()
        for array in arrays if isinstance(arrays, list | tuple) else [arrays]:
            for entry in np.ravel(array):
                text = str(np.ravel(entry.comment1)[0])
                key = ({"acc": 4, "coh": 6, "sta": 0}[text[:3]], *pair_of(text))
                assert_same(name, np.ravel(entry.ordinate), wanted[key])
                np.testing.assert_allclose(np.ravel(entry.abscissa), lines, rtol=1e-7)  # sdynpy makes axes in single precision
                seen.add(key)
        assert seen == {key for key, values in wanted.items() if not np.all(np.isnan(values))}


def test_pyuff_reads_the_same_numbers(folder):
    path, results = folder
    sets = read_by_pyuff(path, NAMES)
    assert_functions_of_pyuff(sets, results)
    named = [d for name in NAMES for d in sets[name] if d["type"] == 58 and d["func_type"] in NAMED]
    assert named
    assert all(d["id1"].startswith(NAMED[d["func_type"]]) for d in named)
    modes = [d for d in sets["idle_modes.uff"] if d["type"] == 55]
    shapes = np.column_stack([d["r3"] for d in modes])
    inside = in_band(results)
    wanted_data = results.idle.frf(inside).data
    frequencies, damping = [d["freq"] for d in modes], [d["modal_damp_vis"] for d in modes]
    assert {d["modal_m"] for d in modes} == {1.0}
    for i in range(4):
        for j in range(4):
            made = synthesised(inside, frequencies, damping, shapes, i, j)
            assert difference_db(made, wanted_data[i, j]) < IN_BAND_DB
    operating = [d for d in sets["operating_modes.uff"] if d["type"] == 55]
    np.testing.assert_allclose([d["eig"] for d in operating], results.operating.poles, rtol=1e-7)
    np.testing.assert_allclose(np.column_stack([d["r3"] for d in operating]), results.operating.shapes, rtol=1e-5)


def test_sdynpy_reads_the_same_numbers(folder, monkeypatch):
    monkeypatch.setitem(os.environ, "QT_QPA_PLATFORM", "offscreen")
    sdpy = pytest.importorskip("sdynpy", reason="sdynpy is not installed")
    path, results = folder
    unv = {name: sdpy.unv.readunv(str(path / name)) for name in NAMES}
    assert_functions_of_sdynpy(sdpy, unv, results)
    for name in ("idle_frf.uff", "ofrf.uff"):
        geometry = sdpy.geometry.from_unv(unv[name])
        np.testing.assert_array_equal(geometry.node.coordinate, results.geometry.coordinates)
        assert [str(t.description) for t in geometry.traceline] == ["rail"]
    shapes = sdpy.shape.from_unv(unv["idle_modes.uff"])
    where = [int(np.flatnonzero((shapes[0].coordinate.node == n) & (abs(shapes[0].coordinate.direction) == 3))[0]) for n in (1, 2, 3, 4)]
    columns = np.array([shape.shape_matrix[where] for shape in shapes]).T
    inside = in_band(results)
    made = synthesised(inside, shapes.frequency, shapes.damping, columns, 0, 2)
    assert difference_db(made, results.idle.frf(inside).data[0, 2]) < IN_BAND_DB

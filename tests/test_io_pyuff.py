"""``.to_pyuff()``: through pyuff and back, the numbers are the same."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

import models
from operando.data import Appearance, Channel, Frf, Geometry, ModalModel, ResidualTerms, TimeRecord
from operando.dof import Dof
from operando.errors import DataError
from operando.io import read

pyuff = pytest.importorskip("pyuff")

ASCII_DIGITS = 1e-11
"""pyuff writes 12 digits in ASCII, all in binary; x in six digits."""


def through_pyuff(path, sets, binary=0):
    file = str(path / "a.uff")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pyuff.UFF(file).write_sets([d | ({"binary": binary} if d["type"] == 58 else {}) for d in sets], "add")
        back = pyuff.UFF(file).read_sets()
    return (back if isinstance(back, list) else [back]), read(file)


def make_record():
    data = np.random.default_rng(0).normal(size=(3, 50)) * [[1.0], [1e-9], [1e7]]
    channels = (Channel(Dof(1, "Z"), "acceleration", "m/s2", "seat"), Channel(Dof("FRAM:2", "X", -1), "velocity", "m/s"),
                Channel(None, "force", "N", "hammer"))  # fmt: skip
    return TimeRecord(data, 512.0, channels, 0.25)


@pytest.mark.parametrize("binary", [0, 1])
def test_records(tmp_path, binary):
    record = make_record()
    sets = record.to_pyuff()
    back, content = through_pyuff(tmp_path, sets, binary)
    for d, own, row in zip(back, sets, record.data, strict=True):
        np.testing.assert_allclose(d["data"], row, rtol=ASCII_DIGITS if not binary else 0)
        np.testing.assert_allclose(d["x"], record.time_s, rtol=1e-5)
        np.testing.assert_array_equal(own["data"], row)
        for key in ("func_type", "rsp_node", "rsp_dir", "ordinate_spec_data_type", "ordinate_axis_units_lab", "id1"):
            assert d[key] == own[key], key
    assert [d["rsp_ent_name"].strip() for d in back] == ["seat", "FRAM", "hammer"]
    (again,) = content.records
    assert (again.sampling_hz, again.start_s) == (512.0, 0.25)
    assert [c.quantity for c in again.channels] == ["acceleration", "velocity", "force"]
    np.testing.assert_allclose(again.data, record.data, rtol=ASCII_DIGITS if not binary else 0)


@pytest.mark.parametrize("lines", [np.arange(1, 65) * 0.5, np.geomspace(1, 80, 64)], ids=["even", "uneven"])
def test_frfs_with_coherence_and_error(tmp_path, lines):
    made = models.results().idle.frf(lines, ["1+Z", "2-Z"], ["2+Z"])
    frf = replace(made, coherence=np.full(made.data.shape, 0.75), variance=np.abs(made.data) ** 2 * 1e-4)
    sets = frf.to_pyuff()
    assert [d["func_type"] for d in sets] == [4, 6, 0] * 2
    back, content = through_pyuff(tmp_path, sets)
    wanted = {4: frf.data, 6: frf.coherence, 0: np.sqrt(frf.variance)}
    for k, d in enumerate(back):
        # pyuff keeps six digits of uneven lines
        np.testing.assert_allclose(d["data"], wanted[d["func_type"]][k // 3, 0], rtol=ASCII_DIGITS)
        np.testing.assert_allclose(d["x"], lines, rtol=1e-5)
    (again,) = content.frfs
    assert (again.responses, again.references, again.quantity, again.si) == (frf.responses, frf.references, "accelerance", True)
    np.testing.assert_allclose(again.data, frf.data, rtol=ASCII_DIGITS)
    np.testing.assert_allclose(again.variance, frf.variance, rtol=2 * ASCII_DIGITS)


def test_pairs_that_were_not_measured_are_left_out():
    data = np.ones((2, 1, 8), complex)
    data[1] = np.nan
    (only,) = Frf(data, np.arange(8.0), ("1+Z", "2+Z"), ("1+Z",)).to_pyuff()
    assert only["rsp_node"] == 1


def test_modes_and_residual_terms(tmp_path):
    idle = models.results().idle
    rest = ResidualTerms(np.array([140.0]), np.array([0.01]), np.full((len(idle.dofs), 1), 0.3))
    model = replace(idle, residuals=rest, covariance=None, std=None)
    sets = model.to_pyuff()
    back, content = through_pyuff(tmp_path, sets)
    assert len(back) == model.n_modes + 1
    np.testing.assert_allclose([d["freq"] for d in back], model.terms.frequencies_hz, rtol=1e-5)
    np.testing.assert_array_equal([d["freq"] for d in sets], model.terms.frequencies_hz)
    np.testing.assert_array_equal([d["modal_damp_vis"] for d in sets], model.terms.damping_ratios)
    np.testing.assert_allclose(np.column_stack([d["r3"] for d in back]), model.terms.shapes, rtol=1e-5)
    (again,) = content.models
    assert (again.n_modes, again.n_residuals, again.scaling, again.dofs) == (model.n_modes, 1, "unit_modal_mass", model.dofs)
    np.testing.assert_array_equal(again.frequencies_hz, model.frequencies_hz)


def test_complex_modes(tmp_path):
    shapes = np.array([[1 + 2j, -0.5j], [0.25, 3 - 1j]])
    model = ModalModel([10.0, 20.0], [0.01, 0.02], shapes, ("1+X", "1-Y"))
    back, _ = through_pyuff(tmp_path, model.to_pyuff())
    np.testing.assert_allclose([d["eig"] for d in back], model.poles, rtol=1e-5)
    np.testing.assert_allclose([d["r1"][0] for d in back], shapes[0], rtol=1e-5)
    np.testing.assert_allclose([d["r2"][0] for d in back], -shapes[1], rtol=1e-5)
    turned = ModalModel([10.0], [0.01], shapes[:, :1], ("1+X", "1+RZ"))
    with pytest.raises(DataError, match="rotations"):
        turned.to_pyuff()


def test_geometry(tmp_path):
    places = np.random.default_rng(1).normal(size=(4, 3))
    geometry = Geometry(
        (1, 2, 3, 4), places, ((1, 2, 3), (3, 4)), ((1, 2, 3), (1, 2, 3, 4)),
        appearance=Appearance({2: 7}, ("rail", "post"), (4, 5), (6, 8)),
    )  # fmt: skip
    nodes, rail, post, faces = geometry.to_pyuff()
    assert (nodes["type"], faces["type"]) == (2411, 2412)
    back, content = through_pyuff(tmp_path, [nodes, rail, post, faces])
    np.testing.assert_array_equal(np.column_stack([back[0][k] for k in "xyz"]), places)
    assert back[0]["color"].tolist() == [1, 7, 1, 1]
    assert [(d["id"].strip(), d["color"], d["nodes"].tolist()) for d in back[1:3]] == [("rail", 4, [1, 2, 3, 0]), ("post", 5, [3, 4, 0])]
    assert content.geometry.lines == geometry.lines
    assert content.geometry.faces == geometry.faces
    np.testing.assert_array_equal(content.geometry.coordinates, places)

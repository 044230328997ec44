"""Directions that are no axes: labels, motion of nodes from their projections, drawing and export."""

from __future__ import annotations

import numpy as np
import pytest

from measurements import write_test
from operando.data import Geometry, direction_of, node_motion
from operando.dof import Dof
from operando.errors import DofError
from operando.io import read_hdf5, write_hdf5
from operando.pipeline import run
from operando.report.figures_modes import ShapePair, mode_shapes


def test_labels():
    dof = Dof.parse("5-beam1")
    assert (dof.node, dof.axis, dof.sign, str(dof)) == (5, "beam1", -1, "5-beam1")
    assert dof.named
    assert str(dof.unsigned) == "5+beam1"
    assert Dof.parse("12z") == Dof(12, "Z")
    assert not Dof.parse("12+ry").named
    with pytest.raises(DofError, match="no UFF code"):
        _ = dof.uff_code
    for text in ("5a", "5+A", "5+1", "5 kHz"):
        with pytest.raises(DofError, match="no DOF label"):
            Dof.parse(text)


def test_named_dofs_in_files(tmp_path):
    write_hdf5(tmp_path / "x.h5", {"dofs": [Dof.parse("5+a"), Dof.parse("7-X")]})
    assert [str(d) for d in read_hdf5(tmp_path / "x.h5")["dofs"]] == ["5+a", "7-X"]


def test_three_skewed_directions_give_the_motion():
    rng = np.random.default_rng(0)
    vectors = rng.standard_normal((3, 3))
    vectors /= np.linalg.norm(vectors, axis=1)[:, None]
    directions = {f"5+{name}": tuple(v) for name, v in zip("abc", vectors, strict=True)}
    motion = rng.standard_normal((3, 2))
    dofs = (Dof.parse("5+a"), Dof.parse("5-b"), Dof.parse("5+c"))
    values = vectors @ motion * np.array([[1.0], [-1.0], [1.0]])
    assert np.allclose(node_motion(dofs, values, directions)[5], motion)


def test_fewer_directions_give_their_part():
    directions = {"1+a": (0.6, 0.8, 0.0)}
    seen = node_motion((Dof.parse("1+a"), Dof(1, "Z"), Dof(2, "Y", -1)), np.array([[2.0], [3.0], [4.0]]), directions)
    assert np.allclose(seen[1][:, 0], [1.2, 1.6, 3.0])
    assert np.allclose(seen[2][:, 0], [0, -4, 0])
    assert node_motion((Dof(1, "RX"), Dof.parse("9+q")), np.ones((2, 1)), directions) == {}


def test_nearly_equal_directions_do_not_blow_up_noise():
    """``LEAST_INDEPENDENT``: what two beams three degrees apart cannot tell stays at zero."""
    a = np.array([1.0, 0.0, 0.0])
    b = np.array([np.cos(0.05), np.sin(0.05), 0.0])
    found = node_motion((Dof.parse("1+a"), Dof.parse("1+b")), np.array([[1.0], [1.05]]), {"1+a": tuple(a), "1+b": tuple(b)})
    assert np.linalg.norm(found[1]) < 1.2


def test_an_axis_label_can_be_a_vector():
    assert np.allclose(direction_of(Dof(7, "X", -1), {"7+X": (0.0, 1.0, 0.0)}), [0, -1, 0])
    assert np.allclose(direction_of(Dof(8, "X"), {"7+X": (0.0, 1.0, 0.0)}), [1, 0, 0])


def test_shapes_are_drawn_along_the_directions():
    square = Geometry((1, 2, 3, 4), np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), ((1, 2, 3, 4, 1),))
    tilted = Geometry(square.nodes, square.coordinates, square.lines, directions={f"{n}+a": (0.0, 0.0, 1.0) for n in square.nodes})
    shape = np.array([1.0, -1.0, 1.0, -1.0])
    named, along_z = (tuple(Dof(n, axis) for n in square.nodes) for axis in ("a", "Z"))
    pair = [ShapePair("one", None, shape)]
    assert mode_shapes(tilted, named, pair) == mode_shapes(square, along_z, pair)


def test_export_without_a_geometry(tmp_path):
    extra = '[channels]\n"acc2" = {dof = "2+a"}\n[directions]\n"2+a" = [0.0, 0.6, 0.8]'
    path = write_test(tmp_path, check=False, idle=False, extra=extra)
    path.write_text(path.read_text(encoding="utf-8").replace('[geometry]\nfile = "geometry.uff"\n', ""), encoding="utf-8")
    results = run(path, tmp_path / "out", until="oma")
    assert results.geometry is None
    from operando.io import read

    model = read(tmp_path / "out" / "operating_modes.uff").models[0]
    assert {"2+Y", "2+Z"} <= {str(d) for d in model.dofs}  # X, which it does not see, is zero


def test_declared_directions_from_file_to_report(tmp_path):
    """A channel labelled along a named direction: shapes, report, and an export in X, Y, Z."""
    extra = '[channels]\n"acc2" = {dof = "2+a"}\n[directions]\n"2+a" = [0.0, 0.6, 0.8]'
    results = run(write_test(tmp_path, check=False, idle=False, extra=extra), tmp_path / "out")
    assert results.operating is not None, results.left_out
    assert "2+a" in [str(d) for d in results.operating.dofs]
    assert results.geometry.directions == {"2+a": (0.0, 0.6, 0.8)}
    from operando.io import read

    model = read(tmp_path / "out" / "operating_modes.uff").models[0]
    row = [str(d) for d in model.dofs].index("2+Y")
    value = results.operating.rows("2+a")[0, 0]
    assert abs(model.shapes[row, 0]) == pytest.approx(0.6 * abs(value), rel=1e-5)
    assert any(f.kind == "directions_resolved" for f in results.findings)
    assert (tmp_path / "out" / "report.html").exists()

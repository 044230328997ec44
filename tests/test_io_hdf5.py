"""The native HDF5 format: everything written comes back equal."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from operando import load
from operando.data import Channel, Finding, Frf, Geometry, ModalModel, Provenance, TimeRecord
from operando.dof import Dof
from operando.errors import DataError, FormatError
from operando.io import read, read_hdf5, read_objects, write_hdf5, write_uff
from operando.io.hdf5_tree import PACKED_FROM
from operando.stabilization import PoleTable, RejectedPole, Stabilization

h5py = pytest.importorskip("h5py")


def equal(a, b):
    """Deep equality with types, arrays by bytes."""
    if type(a) is not type(b):
        return False
    if dataclasses.is_dataclass(a):
        return all(equal(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and np.array_equal(a, b, equal_nan=a.dtype.kind in "fc")
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[k], b[k]) for k in a)
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(equal(x, y) for x, y in zip(a, b, strict=True))
    return a == b or (isinstance(a, float) and np.isnan(a) and np.isnan(b))


def samples():
    rng = np.random.default_rng(1)
    dofs = (Dof(1, "Z"), Dof(2, "X", -1), Dof(3), Dof(4, "RY"))
    finding = Finding("overload", "too loud", file="a.uff", time_s=(0.1, 0.2), consequence="cut")
    provenance = Provenance((("a.uff", "00"),), ("read",))
    record = TimeRecord(
        rng.normal(size=(2, 30)).astype(np.float32),
        512.0,
        (Channel(dofs[0], "force", "N", "in", "lbf", 0), Channel(None, name="tacho/µ")),
        start_s=-0.5,
        name="run 1",
        findings=(finding,),
        provenance=provenance,
    )
    h = rng.normal(size=(4, 1, 9)) + 1j * rng.normal(size=(4, 1, 9))
    h[1, 0, 3] = np.nan
    frf = Frf(
        h, np.arange(9.0) / 3, dofs, (dofs[0],), "mobility", variance=np.abs(h) ** 2, coherence=np.ones((4, 1, 9)), averages=7.5, si=False
    )
    table = PoleTable(np.array([2, 4]), np.ones(2), np.ones(2), np.ones((3, 2), complex), np.array([0, 3]))
    details = Stabilization(
        table, np.ones(1), np.ones(1), np.ones((3, 1)), (np.array([0, 1]),), (RejectedPole(1.0, 0.2, "unstable", "no"),)
    )
    model = ModalModel.from_terms(
        np.array([1.0, 2.0]), np.array([0.01, 0.02]), rng.normal(size=(4, 2)), dofs, "unit_modal_mass",
        residual=np.array([False, True]), covariance=np.eye(12), band_hz=(0.5, 3.0), misfit=float("nan"), details=details,
    )  # fmt: skip
    geometry = Geometry((1, 2, 3), rng.normal(size=(3, 3)), ((1, 2), (2, 3)), ((1, 2, 3),), "plate")
    plain = {
        "a": [1, 2.5, None, True, "ä"],
        "b": (1, (2, 3)),
        "c": {1: 2j, "x": float("inf")},
        "d": [],
        "e": {},
        "f": tuple(np.arange(40.0).tolist()),
        "g": [b"", b"\0-1\xff", bytes(range(256)) * 40],
    }
    return {"record": record, "frf": frf, "model": model, "geometry": geometry, "plain": plain}


@pytest.mark.parametrize("name", ["record", "frf", "model", "geometry", "plain"])
def test_object_round_trip(tmp_path, name):
    obj = samples()[name]
    write_hdf5(tmp_path / "x.h5", {"deep": obj})
    assert equal(obj, read_hdf5(tmp_path / "x.h5")["deep"])


def test_file_round_trip_and_names(tmp_path):
    path = tmp_path / "model.h5"
    write_hdf5(path, samples())
    assert equal(read_hdf5(path), dict(sorted(samples().items())))
    with h5py.File(path) as file:
        assert file["model/frequencies_hz"][:].tolist() == [1.0]  # readable without operando
        assert file["model/residuals/frequencies_hz"][:].tolist() == [2.0]
        assert file["model/details/table/order"][1] == 4
        assert file["model/dofs"].asstr()[1] == "2-X"
    assert [p.name for p in tmp_path.iterdir()] == ["model.h5"]


def test_foreign_objects_are_refused(tmp_path):
    path = tmp_path / "model.h5"
    with pytest.raises(DataError, match="function"):
        write_hdf5(path, {"a": {"f": lambda: None}})
    assert not list(tmp_path.iterdir())
    with h5py.File(path, "w") as file:
        file.create_group("a")["__tree__"] = '{"__class__": "subprocess:Popen", "fields": {"args": "true"}}'
    with pytest.raises(FormatError, match="no class"):
        read_hdf5(path)
    path.write_bytes(b"\x89HDF\r\n\x1a\nrubbish")
    with pytest.raises(FormatError):
        read_hdf5(path)


def test_large_arrays_are_compressed_and_small_ones_are_not(tmp_path):
    smooth = np.linspace(0, 1, 4096)
    few = np.ones(PACKED_FROM // 8 - 1)
    write_hdf5(tmp_path / "a.h5", {"arrays": {"smooth": smooth, "few": few}})
    with h5py.File(tmp_path / "a.h5") as file:
        assert (file["arrays/smooth"].compression, file["arrays/few"].compression) == ("gzip", None)
        assert file["arrays/smooth"].id.get_storage_size() < 0.6 * smooth.nbytes
    back = read_hdf5(tmp_path / "a.h5")["arrays"]
    assert back["smooth"].tobytes() == smooth.tobytes()
    assert equal(back["few"], few)
    write_hdf5(tmp_path / "b.h5", {"arrays": {"smooth": smooth}}, packed=False)
    with h5py.File(tmp_path / "b.h5") as file:
        assert file["arrays/smooth"].compression is None
    assert equal(read_hdf5(tmp_path / "b.h5")["arrays"]["smooth"], smooth)


def test_a_large_array_of_several_objects_stands_once(tmp_path):
    noise = np.random.default_rng(1).normal(size=(40, 50))
    objects = {"a": {"x": noise, "again": noise.copy(), "transposed": noise.T}, "b": [noise.copy(), noise.astype(np.float32)]}
    write_hdf5(tmp_path / "a.h5", objects)
    with h5py.File(tmp_path / "a.h5") as file:
        assert (set(file["a"]), set(file["b"])) == ({"__tree__", "x", "transposed"}, {"__tree__", "1"})
    back = read_hdf5(tmp_path / "a.h5")
    assert equal(back, objects)
    assert back["b"][0].tobytes() == noise.tobytes()
    assert not np.shares_memory(back["a"]["x"], back["b"][0])
    with h5py.File(tmp_path / "a.h5") as file:
        assert equal(read_objects(file, ["b"])["b"], objects["b"])  # also without the object that holds it


def test_a_symmetric_matrix_is_kept_to_the_bit(tmp_path):
    half = np.random.default_rng(1).normal(size=(60, 60))
    symmetric = half + half.T
    symmetric[3, 5] = symmetric[5, 3] = np.nan
    signed = symmetric.copy()
    signed[1, 2], signed[2, 1] = 0.0, -0.0
    write_hdf5(tmp_path / "a.h5", {"a": [symmetric, signed], "b": symmetric})
    with h5py.File(tmp_path / "a.h5") as file:
        assert [file[f"a/{i}"].shape for i in (0, 1)] == [(60 * 61 // 2,), (60, 60)]
    back = read_hdf5(tmp_path / "a.h5")
    for found, wanted in ((back["a"][0], symmetric), (back["a"][1], signed), (back["b"], symmetric)):
        assert (found.shape, found.tobytes()) == (wanted.shape, wanted.tobytes())


def test_the_block_of_a_matrix_does_not_stand_again(tmp_path):
    half = np.random.default_rng(1).normal(size=(60, 60))
    whole = half + half.T
    block, other = whole[:40, :40].copy(), whole[:40, :40].copy()
    other[39, 39] += 1e-12
    objects = {"a": whole, "b": {"block": block, "other": other, "corner": whole[20:, 20:].copy()}, "c": block.copy()}
    write_hdf5(tmp_path / "a.h5", objects)
    with h5py.File(tmp_path / "a.h5") as file:
        assert set(file["b"]) == {"__tree__", "other", "corner"}
        assert file["c/__tree__"].asstr()[()].count("__block__") == 1
        assert read_objects(file, ["c"])["c"].tobytes() == block.tobytes()  # also without the object that holds it
    back = read_hdf5(tmp_path / "a.h5")
    assert equal(back, objects)
    assert back["b"]["block"].flags.c_contiguous
    assert not np.shares_memory(back["b"]["block"], back["a"])


@pytest.mark.parametrize("version", [2, 3])
def test_files_of_earlier_versions_are_read(tmp_path, version):
    write_hdf5(tmp_path / "a.h5", {"a": np.ones(3)})
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file.attrs["schema"] = f"operando/hdf5/{version}"
    assert equal(read_hdf5(tmp_path / "a.h5")["a"], np.ones(3))


@pytest.mark.parametrize("tree", ['{"__array__": "x"}', '"abc"', "[1, 2]", '{"__bytes__": {"__array__": "y"}}'])
def test_bytes_are_read_from_bytes_only(tmp_path, tree):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        group = file.create_group("a")
        group["__tree__"] = f'{{"__bytes__": {tree}}}'
        group["x"], group["y"] = np.ones(3), np.ones(3, np.uint8)
    with pytest.raises(FormatError, match="no row of bytes"):
        read_hdf5(tmp_path / "a.h5")


def test_what_was_read_of_a_uff_file_can_be_kept(tmp_path):
    write_uff(tmp_path / "a.uff", samples()["record"])
    written = (tmp_path / "a.uff").read_bytes()
    (tmp_path / "a.uff").write_bytes(written + b"    -1\n  9999\nnot known\n    -1\n")
    found = read(tmp_path / "a.uff")
    assert any(s.raw and s.status != "used" for s in found.sets)
    found.save(tmp_path / "a.h5")
    assert load(tmp_path / "a.h5").sets == found.sets
    assert "operando.load" in read(tmp_path / "a.h5").sets[0].note


def test_an_array_named_again_and_again_does_not_fill_the_memory(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        group = file.create_group("a")
        group["__tree__"] = "[" + ", ".join(['{"__same__": {"__array__": "a/x"}}'] * 100) + "]"
        group["x"] = np.ones(1 << 18)  # 2 MB, named for 200
    with pytest.raises(FormatError, match="named again hold would take"):
        read_hdf5(tmp_path / "a.h5")

"""Real files of many programs, and damaged ones: each opens or is refused with a typed error, and nothing is cut silently."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from io_files import SHARED, ascii58, binary58, text_set, units164
from operando.data import Channel, Frf, Geometry, ModalModel, TimeRecord
from operando.errors import FormatError, OperandoError
from operando.io import inspect_files, read, read_uff_sets, write_csv, write_hdf5, write_matlab, write_uff

CORPUS = sorted((SHARED / "data" / "uff-corpus").glob("*")) if (SHARED / "data").is_dir() else []
needs_data = pytest.mark.skipif(not CORPUS, reason="the measured data beside the project are missing")
BRIDGE = SHARED / "data" / "bridge"


@needs_data
@pytest.mark.parametrize("path", CORPUS, ids=lambda p: p.name)
def test_corpus_opens_or_is_refused(path):
    try:
        content = read(path)
    except FormatError as error:
        said = str(error)
    else:
        said = ""
    if said:
        assert path.name.startswith(("meas_point", "dataset_milestone"))
        assert str(path) in said
        return
    sets = read_uff_sets(path)
    assert len(content.sets) == len(sets)
    read_points = {c.set: r.n_samples for r in content.records for c in r.channels}
    for (raw, _), info in zip(sets, content.sets, strict=True):
        if raw.header is not None and raw.header.function_type == 1:
            assert info.status == "used"
            assert read_points[raw.index] == raw.header.points
        if info.status != "used":
            assert info.raw


@needs_data
def test_corpus_against_pyuff():
    """Same numbers as pyuff where pyuff can read the function."""
    pyuff = pytest.importorskip("pyuff")
    compared = 0
    for path in CORPUS:
        try:
            content = read(path)
        except FormatError:
            continue
        for record in content.records:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    sets = pyuff.UFF(str(path)).read_sets()
                except Exception:
                    continue
            sets = sets if isinstance(sets, list) else [sets]
            for row, channel in zip(record.data, record.channels, strict=True):
                factor = 9.80665 if channel.source_unit == "g" else 1.0
                theirs = np.asarray(sets[channel.set]["data"])
                if theirs.size != row.size:  # pyuff counts the line end behind some payloads as data
                    continue
                np.testing.assert_allclose(row, theirs * factor, rtol=1e-6)
                compared += 1
    assert compared >= 5


@needs_data
def test_what_the_corpus_holds():
    by_name = {p.name: p for p in CORPUS}
    raw = read(by_name["MPSTD#Set001_2024_10_08_10_27_07.uff"]).records[0]
    assert (raw.data.shape, raw.sampling_hz, raw.channels[0].unit) == ((4, 222400), 3200.0, "m/s2")
    fixed = read(by_name["MPSTD#Set001_2024_10_08_10_27_07_fixed_test.uff"]).records[0]
    np.testing.assert_array_equal(raw.data, fixed.data)
    text, binary = (read(by_name[n]).records[0] for n in ("Sample_UFF58_ascii.uff", "Sample_UFF58b_bin.uff"))
    assert text.sampling_hz == binary.sampling_hz == 65536.0
    np.testing.assert_allclose(text.data, binary.data, rtol=1e-5)
    sine = read(by_name["binary8byte.uff"]).records[0]
    np.testing.assert_allclose(
        sine.data[0] / 9.80665, np.sin(2 * np.pi * 5 * sine.time_s), atol=1e-5
    )  # its phase was kept in single precision
    assert read(by_name["time-history-not-all-columns-filled.uff"]).records[0].n_samples == 13
    assert read(by_name["non_ascii_header.uff"]).frfs[0].axis.step == 25 / 128
    psd = read(by_name["sample_dataset58_psd.uff"]).sets[0]
    assert (psd.status, psd.title) == ("ignored", "power spectral density Pilot 1")
    assert [len(read(by_name[n]).geometry.nodes) for n in ("simcenter_exported_result.uff", "heat_engine_housing.uff")] == [11520, 10]
    assert [m.n_modes for m in read(by_name["uff55_translation.uff"]).models] == [3]
    with pytest.raises(FormatError, match="2508876 points"):
        read(by_name["dataset_milestone_in_header.uff"])


@needs_data
def test_bridge():
    content = read(BRIDGE / "dam0.unv")
    (frf,) = content.frfs
    assert (frf.data.shape, frf.quantity, frf.si, frf.axis.step) == ((26, 1, 401), "accelerance", False, 1 / 32)
    assert str(frf.references[0]) == "3+X"
    assert "missing_unit" in {f.kind for f in content.findings}
    assert read(BRIDGE / "dam0.unv", units={"acceleration": "g", "force": "lbf"}).frfs[0].si
    geometry = read(BRIDGE / "coords.unv").geometry
    assert (len(geometry.nodes), len(geometry.lines)) == (26, 15)
    other = read(BRIDGE / "UFF58B.FRF")
    assert other.frfs[0].data.shape == (1, 1, 1601)
    assert "missing_dof" in {f.kind for f in other.findings}


@needs_data
def test_practice_cases():
    for name, unit in (("p1", "m/s^2"), ("p4", "g")):
        content = read(SHARED / "cases" / name / "idle" / "run1.uff")
        (record,) = content.records
        assert (record.data.shape, record.sampling_hz, record.data.dtype) == ((13, 32768), 512.0, np.float32)
        assert [c.source_unit for c in record.channels] == ["N"] + [unit] * 12
        assert not content.findings
    assert read(SHARED / "cases" / "p1" / "geometry.uff", units={"length": "m"}).geometry.unit_known


# --- damage ---------------------------------------------------------------------------------------------------------------------


def samples(folder):
    """Small files of every format."""
    rng = np.random.default_rng(0)
    channels = tuple(Channel(d, q, u) for d, q, u in ((None, "voltage", "V"), (None, "force", "N")))
    record = TimeRecord(rng.normal(size=(2, 40)), 512.0, channels)
    frf = Frf(rng.normal(size=(2, 1, 9)) + 1j, np.arange(9.0), ("1Z", "2Z"), ("1Z",), coherence=np.ones((2, 1, 9)), averages=3)
    model = ModalModel(np.array([1.0, 2.0]), np.array([0.01, 0.02]), np.ones((2, 2)), ("1+Z", "2-X"), "unit_modal_mass")
    geometry = Geometry((1, 2, 3), np.ones((3, 3)), ((1, 2),), ((1, 2, 3),))
    write_uff(folder / "binary.uff", record, frf, model, geometry)
    write_uff(folder / "text.uff", record, frf, model, geometry, binary=False)
    (folder / "mixed.uff").write_bytes(
        units164() + ascii58([1.0] * 4) + binary58([2.0] * 4, ">") + text_set(151, *["x"] * 7) + ascii58([1.0, 2.0] * 4, points=4, even=0)
    )
    write_csv(folder / "table.csv", record)
    write_matlab(folder / "data.mat", record, frf)
    write_hdf5(folder / "own.h5", {"record": record, "model": model})
    return sorted(folder.glob("*.*"))


def attempt(path):
    """Reading succeeds or raises a typed error."""
    try:
        content = read(path)
    except OperandoError:
        return None
    return content


@pytest.mark.parametrize("name", ["binary.uff", "text.uff", "mixed.uff", "table.csv", "data.mat", "own.h5"])
def test_corrupted_bytes_never_raise_anything_else(tmp_path, name):
    samples(tmp_path)
    good = (tmp_path / name).read_bytes()
    rng = np.random.default_rng(7)
    path = tmp_path / "bad"
    tries = 30 if name.endswith((".mat", ".h5")) else 100
    opened = 0
    for _ in range(tries):
        raw = bytearray(good)
        for _ in range(int(rng.integers(1, 6))):
            at, length = int(rng.integers(len(raw))), int(rng.integers(1, 9))
            kind = rng.integers(4)
            if kind == 0:
                raw[at : at + length] = rng.integers(0, 256, length, dtype=np.uint8).tobytes()
            elif kind == 1:
                del raw[at : at + length]
            elif kind == 2:
                raw[at:at] = bytes(rng.choice(np.frombuffer(b"0123456789 .-+E\n", np.uint8), length))
            else:
                raw[at : at + 1] = bytes([raw[at % len(raw)] ^ (1 << int(rng.integers(8)))])
        path.write_bytes(bytes(raw))
        opened += attempt(path) is not None
    assert opened > 0


@pytest.mark.parametrize("name", ["binary.uff", "text.uff", "mixed.uff", "table.csv", "data.mat", "own.h5"])
def test_truncation_never_raises_anything_else(tmp_path, name):
    samples(tmp_path)
    good = (tmp_path / name).read_bytes()
    path = tmp_path / "bad"
    for end in np.linspace(0, len(good), 25, dtype=int):
        path.write_bytes(good[:end])
        content = attempt(path)
        if content is not None and name.endswith("uff"):
            declared = {raw.index: raw.header.points for raw, _ in read_uff_sets(path) if raw.header is not None}
            for record in content.records:
                assert all(declared[c.set] == record.n_samples for c in record.channels)


def test_inspect_reports_what_cannot_be_read(tmp_path):
    paths = [*samples(tmp_path), tmp_path / "nothing.uff"]
    (tmp_path / "empty.uff").touch()
    out = inspect_files([*paths, tmp_path / "empty.uff"])
    assert [bool(f["error"]) for f in out["files"]] == [False] * len(paths[:-1]) + [True, True]
    assert [f["kind"] for f in out["findings"]].count("unreadable") == 2

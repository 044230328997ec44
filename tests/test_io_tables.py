"""CSV, MATLAB, SEP005, conversion and inspection."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from io_files import SHARED, ascii58, text_set
from operando.data import Channel, Frf, Geometry, ModalModel, TimeRecord
from operando.dof import Dof
from operando.errors import ConfigError, DataError, FormatError
from operando.io import convert, detect_format, from_sep005, inspect_files, read, read_csv, to_sep005, write_csv, write_matlab, write_uff
from operando.io.csv import LONGEST_NAME
from operando.units import G_STANDARD

DATA = SHARED / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the measured data beside the project are missing")


def table(tmp_path, text, encoding="utf-8", **kw):
    path = tmp_path / "table.txt"
    path.write_bytes(text.encode(encoding))
    return read(path, **kw)


def make_record(dtype=float):
    rng = np.random.default_rng(0)
    channels = (
        Channel(Dof(1, "Z"), "force", "N", "hammer"),
        Channel(Dof(2, "X", -1), "acceleration", "m/s2"),
        Channel(None, "unknown", "", "x"),
    )
    return TimeRecord(rng.normal(size=(3, 40)).astype(dtype), 1651.6, channels, 0.25)


# --- CSV ------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "time [s],12+Z [g],F [lbf]\n0,1,2\n0.25,3,4\n0.5,5,6\n",
        "time [s];12+Z [g];F [lbf]\r\n0;1;2\r\n0,25;3;4\r\n0,5;5;6\r\n",
        "time [s]\t12+Z [g]\tF [lbf]\n0\t1\t2\n0.25\t3\t4\n0.5\t5\t6",
        't [s],"12+Z [g]","F (lbf)"\n0, 1, 2\n0.25, 3, 4\n0.5, 5, 6\n\n',
        "# a comment\n\n  time[s] 12+Z[g] F[lbf]\n 0 1 2\n 0.25 3 4\n 0.5 5 6\n",
        "time [ms],12+Z [g],F [lbf],\n0,1,2,\n250,3,4,\n500,5,6,\n",
        "Fs,12+Z [g],F [lbf]\n4,1,2\n,3,4\n,5,6\n",
        "# sampling_hz = 4\n12+Z [g],F [lbf]\n1,2\n3,4\n5,6\n",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_tables(tmp_path, text, encoding):
    content = table(tmp_path, text, encoding)
    (record,) = content.records
    assert record.sampling_hz == 4.0
    np.testing.assert_allclose(record.data, [[G_STANDARD, 3 * G_STANDARD, 5 * G_STANDARD], np.array([2, 4, 6]) * 4.4482216152605])
    assert [(str(c.dof), c.quantity, c.unit) for c in record.channels] == [("12+Z", "acceleration", "m/s2"), ("None", "force", "N")]
    assert not content.findings


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("1,2\n3,4\n", "no header line"),
        ("time [s],a [g]\n0,1\n0.1,2\n0.1,3\n", "does not increase"),
        ("time [s],a [g]\n0,1\n0.1,2\n0.9,3\n1.0,4\n", "not evenly spaced"),
        ("a [g],b [g]\n1,2\n3,4\n", "no time column and no sampling rate"),
        ("time [s],a [g]\n0,1\n0.1,2,3\n", "cannot be read"),
        ("time [s],a [g]\n0,x\n0.1,y\n", "cannot be read"),
        ("only a line", "no header line and data"),
        ("time [furlong],a [g]\n0,1\n1,2\n", "furlong"),
    ],
)
def test_tables_that_are_refused(tmp_path, text, match):
    with pytest.raises(FormatError, match=match):
        table(tmp_path, text)


def test_the_line_proposed_for_a_missing_unit_keeps_the_quantity(tmp_path):
    content = table(tmp_path, "Force,Voltage,acc1,probe\n1,2,3,4\n4,5,6,7\n", units={"sampling_hz": 10})
    actions = {f.dof: f.action for f in content.findings if f.kind == "missing_unit"}
    assert actions["Force"].endswith('[channels] "Force" = {quantity = "force", unit = "N"}')
    assert actions["acc1"].endswith('[channels] "acc1" = {quantity = "acceleration", unit = "m/s2"}')
    assert '"Voltage" = {quantity = "voltage", unit = "V"}; where a sensor gives this voltage' in actions["Voltage"]
    assert "acceleration" not in actions["Force"] + actions["Voltage"]
    assert actions["probe"].endswith("if it is an acceleration in m/s2")


def test_what_a_table_does_not_say(tmp_path):
    text = "V1,a,b [g]\n1,2,3\n4,,6\n"
    content = table(
        tmp_path,
        text,
        units={"sampling_hz": "0.5 kHz"},
        channels={"V1": {"dof": "3+X", "quantity": "force", "unit": "N", "sensitivity": 2}},
    )
    (record,) = content.records
    assert record.sampling_hz == 500.0
    assert record.data[0].tolist() == [0.5, 2.0]
    assert {f.kind for f in content.findings} == {"missing_unit", "nan"}
    with pytest.raises(DataError, match="sampling rate"):
        table(tmp_path, text, units={"sampling_hz": "fast"})
    with pytest.raises(ConfigError, match="unknown key"):
        table(tmp_path, text, units={"sampling_hz": 1}, channels={"V1": {"gain": 2}})
    content = table(tmp_path, text, units={"sampling_hz": 1}, channels={"a": {"exclude": True, "reason": "broken"}})
    assert [c.name for c in content.records[0].channels] == ["V1", "b"]
    assert [(s.title, s.status) for s in content.sets][1] == ("column a", "ignored")


@pytest.mark.parametrize("dtype", [float, np.float32])
def test_csv_round_trip(tmp_path, dtype):
    record = make_record(dtype)
    write_csv(tmp_path / "a.csv", record)
    (back,) = read_csv(tmp_path / "a.csv").records
    np.testing.assert_array_equal(back.data.astype(dtype), record.data)
    assert (back.sampling_hz, back.start_s) == (record.sampling_hz, record.start_s)
    assert [(c.dof, c.quantity, c.unit) for c in back.channels] == [(c.dof, c.quantity, c.unit) for c in record.channels]


@needs_data
def test_measured_tables():
    parked = read(DATA / "turbine" / "offshore_wind_turbine_parked.csv").records[0]
    assert (parked.sampling_hz, parked.data.shape, parked.channels[0].unit) == (30.0, (6, 18000), "m/s2")
    assert read(DATA / "turbine" / "offshore_wind_data_rotor_stop.csv").records[0].sampling_hz == 25.0
    f16 = read(DATA / "f16" / "F16Data_FullMSine_Level1.csv", units={"force": "N", "acceleration": "m/s2", "voltage": "V"})
    assert (f16.records[0].sampling_hz, f16.records[0].data.shape, f16.findings) == (400.0, (5, 73728), ())
    assert f16.records[0].force_indices == [0]
    silverbox = read(DATA / "silverbox" / "SNLS80mV.csv", units={"sampling_hz": 610.35})
    assert silverbox.records[0].data.shape == (2, 131072)
    for name in ("mast/lumo.npz", "mast/coords_lumo.csv", "friction/1Hz0lbtension1amplitude.json", "bridge/license.txt"):
        with pytest.raises(FormatError):
            read(DATA / name)


# --- MATLAB ---------------------------------------------------------------------------------------------------------------------


def test_matlab_structures(tmp_path):
    from scipy.io import savemat

    rng = np.random.default_rng(0)
    data = rng.normal(size=(100, 3))
    names = np.array(["1+Z", "2+Z", "Force"], dtype=object)
    units = np.array(["g", "m/s^2", "N"], dtype=object)
    path = tmp_path / "a.mat"
    savemat(path, {"test": {"signals": {"acc": data, "fs": 256.0, "channel_names": names, "units": units}, "date": "today"}})
    (record,) = read(path).records
    assert record.sampling_hz == 256.0
    np.testing.assert_allclose(record.data, (data * [G_STANDARD, 1, 1]).T)
    assert [c.label for c in record.channels] == ["1+Z", "2+Z", "Force"]
    for axis in ({"t": np.arange(100) / 51200}, {"dt": 1 / 51200}, {"Fs": 51200}):
        savemat(path, {"x": data.T.astype(np.float32)} | axis)
        (record,) = read(path).records
        assert (record.sampling_hz, record.data.dtype, record.data.shape) == (51200.0, np.float32, (3, 100))
    h = rng.normal(size=(65, 2)) + 1j * rng.normal(size=(65, 2))
    savemat(path, {"H": h, "freq": np.arange(65) / 4})
    content = read(path, units={"acceleration": "g", "force": "N"}, channels={"ch1": {"dof": "12+Z"}})
    np.testing.assert_allclose(content.frfs[0].data[:, 0], h.T * G_STANDARD)
    assert (content.frfs[0].axis.step, str(content.frfs[0].responses[0]), content.frfs[0].si) == (0.25, "12+Z", True)
    savemat(path, {"x": data})
    with pytest.raises(FormatError, match="no sampling rate"):
        read(path)
    savemat(path, {"text": "only"})
    with pytest.raises(FormatError, match="no data"):
        read(path)


@pytest.mark.parametrize("compressed", [False, True])
def test_matlab_variables_are_found_in_structures_and_cells(tmp_path, compressed):
    from scipy.io import savemat

    from operando.io.matlab import read_variables

    rng = np.random.default_rng(0)
    variables = {
        "a": rng.normal(size=(3, 4, 2)), "b": rng.normal(size=(2, 2)) + 1j, "d": np.float32(2.5),
        "s": {"x": np.eye(2), "y": {"z": "text ü", "w": np.array(["one", "three"], dtype=object)}}, "t": "abc",
        "list": np.array([{"k": 1.0}, {"k": 2.0}]), "single": np.ones(3, np.complex64),
    }  # fmt: skip
    savemat(tmp_path / "a.mat", variables, do_compression=compressed)
    found = {v.path: v.value for v in read_variables(tmp_path / "a.mat")[0]}
    assert found.keys() == {"a", "b", "d", "s.x", "s.y.z", "s.y.w", "t", "list0.k", "list1.k", "single"}
    np.testing.assert_array_equal(found["a"], variables["a"])
    np.testing.assert_array_equal(found["b"], variables["b"])
    assert found["single"].dtype == np.complex64
    assert (found["s.y.z"], found["s.y.w"], found["t"], found["list1.k"].item()) == (["text ü"], ["one", "three"], ["abc"], 2.0)


def test_matlab_7_3(tmp_path):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "a.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        file["fs"] = np.array([[100.0]])
        file["x"] = np.arange(60.0).reshape(2, 30)  # MATLAB 30 × 2
        pairs = np.zeros((2, 20), dtype=[("real", "f8"), ("imag", "f8")])
        pairs["imag"] = 1.0
        file["s/H"] = pairs
        file["s/f"] = np.arange(20.0)[None]
    with open(path, "r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    content = read(path)
    assert (content.records[0].data.shape, content.records[0].sampling_hz) == ((2, 30), 100.0)
    assert content.frfs[0].data.shape == (2, 1, 20)
    assert np.all(content.frfs[0].data == 1j)


def test_matlab_round_trip(tmp_path):
    record = make_record(np.float32)
    frf = Frf(np.random.default_rng(0).normal(size=(3, 2, 20)) * 1j, np.arange(20.0), ("1Z", "2-X", "3Y"), ("1Z", "2-X"), "mobility")
    write_matlab(tmp_path / "a.mat", record, frf)
    content = read(tmp_path / "a.mat")
    (back,), (h,) = content.records, content.frfs
    np.testing.assert_array_equal(back.data, record.data)
    assert (back.sampling_hz, back.start_s, back.data.dtype) == (record.sampling_hz, record.start_s, np.float32)
    assert [(c.dof, c.quantity, c.unit) for c in back.channels] == [(c.dof, c.quantity, c.unit) for c in record.channels]
    np.testing.assert_array_equal(h.data, frf.data)
    assert (h.responses, h.references, h.quantity, h.si) == (frf.responses, frf.references, "mobility", True)


@needs_data
def test_ruler():
    content = read(DATA / "ruler" / "ruler_grid_acc_3.mat")
    (frf,) = content.frfs
    assert frf.data.shape == (10, 1, 16385)
    assert frf.frequencies_hz[-1] == 10000.0
    amplitude = np.abs(frf.data).sum(axis=(0, 1))
    for hz in (39.4, 108.5, 212.6, 352.3, 551.0):
        near = np.abs(frf.frequencies_hz - hz) < 0.04 * hz
        peak = frf.frequencies_hz[near][np.argmax(amplitude[near])]
        assert peak == pytest.approx(hz, rel=0.02)


# --- SEP005 ---------------------------------------------------------------------------------------------------------------------


def test_sep005_round_trip():
    record = make_record()
    back = from_sep005(to_sep005(record))
    np.testing.assert_array_equal(back.data, record.data)
    assert (back.sampling_hz, back.start_s) == (record.sampling_hz, record.start_s)
    assert [(c.dof, c.quantity, c.unit) for c in back.channels] == [(c.dof, c.quantity, c.unit) for c in record.channels]
    single = from_sep005({"data": np.ones(4), "name": "12+Z", "unit_str": "g", "fs": 100})
    assert single.data[0, 0] == pytest.approx(G_STANDARD)


@pytest.mark.parametrize(
    "bad",
    [
        [],
        [{"name": "a"}],
        [{"data": np.ones(3)}],
        [{"data": np.ones((2, 3)), "fs": 1}],
        [{"data": np.ones(3), "fs": 1}, {"data": np.ones(4), "fs": 1}],
        [{"data": np.ones(3), "fs": 1}, {"data": np.ones(3), "fs": 2}],
        [{"data": np.ones(3), "time": [0, 1, 5]}],
        [{"data": np.ones(3), "time": [0, 1]}],
    ],
)
def test_sep005_refused(bad):
    with pytest.raises(DataError):
        from_sep005(bad)


# --- conversion -----------------------------------------------------------------------------------------------------------------


def test_uff_to_hdf5_and_back_loses_nothing_it_does_not_say(tmp_path):
    rng = np.random.default_rng(0)
    frf = Frf(rng.normal(size=(2, 1, 9)) + 0j, np.arange(9) / 3, ("1Z", "2Z"), ("1Z",), coherence=np.ones((2, 1, 9)), averages=4)
    model = ModalModel(np.array([1.5]), np.array([0.01]), np.array([[0.5], [-0.25]]), ("1+Z", "2+X"), "unit_modal_mass")
    geometry = Geometry((1, 2), np.eye(3)[:2], ((1, 2),))
    write_uff(tmp_path / "a.uff", make_record(), frf, model, geometry)
    out = convert(tmp_path / "a.uff", tmp_path / "b.h5")
    assert (out["format_in"], out["format_out"], out["lost"]) == ("uff", "hdf5", [])
    assert len(out["written"]) == 4
    a, b = read(tmp_path / "a.uff"), read(tmp_path / "b.h5")
    np.testing.assert_array_equal(a.records[0].data, b.records[0].data)
    assert a.records[0].channels == b.records[0].channels
    convert(tmp_path / "b.h5", tmp_path / "c.uff")
    c = read(tmp_path / "c.uff")
    np.testing.assert_array_equal(c.records[0].data, a.records[0].data)
    np.testing.assert_array_equal(c.frfs[0].data, a.frfs[0].data)
    np.testing.assert_array_equal(c.models[0].shapes, a.models[0].shapes)
    np.testing.assert_array_equal(c.geometry.coordinates, a.geometry.coordinates)


def test_conversion_says_what_is_lost(tmp_path):
    model = ModalModel(np.array([1.5]), np.array([0.01]), np.array([[0.5], [-0.25]]), ("1-Z", "2+X"), std={"frequencies_hz": np.ones(1)})
    frf = Frf(np.ones((1, 1, 9), complex), np.arange(9.0), ("1Z",), ("1Z",), variance=np.ones((1, 1, 9)))
    write_uff(tmp_path / "a.uff", make_record(), model, frf)
    from operando.io import write_hdf5

    write_hdf5(tmp_path / "a.h5", {"model": model, "frf": frf})
    lost = convert(tmp_path / "a.h5", tmp_path / "b.uff")["lost"]
    assert "uncertainty of the modes" in lost
    assert "variance of the FRF lines" not in lost  # a UFF holds it as standard deviations
    assert any("sense of DOFs" in text for text in lost)
    out = convert(tmp_path / "a.uff", tmp_path / "a.csv")
    assert any("modal model" in text for text in out["lost"])
    write_hdf5(tmp_path / "m.h5", {"model": model})
    with pytest.raises(FormatError, match="nothing to write"):
        convert(tmp_path / "m.h5", tmp_path / "b.csv")
    with pytest.raises(FormatError, match="tells no format"):
        convert(tmp_path / "a.uff", tmp_path / "b.xyz")


def test_sets_nobody_understands_are_passed_on(tmp_path):
    unknown = [text_set(1858, "  1 2 3"), text_set(2414, "abc", "   4"), ascii58([1.0] * 4, function=9)]
    (tmp_path / "a.uff").write_bytes(unknown[0] + ascii58([1.0] * 4, unit="g") + unknown[1] + unknown[2])
    out = convert(tmp_path / "a.uff", tmp_path / "b.uff")
    assert [p["type"] for p in out["passed_on"]] == [1858, 2414, 58]
    raw = (tmp_path / "b.uff").read_bytes()
    assert all(u in raw for u in unknown)
    np.testing.assert_allclose(read(tmp_path / "b.uff").records[0].data, G_STANDARD)
    assert "source units: the numbers are in SI now" in out["lost"]
    assert detect_format(tmp_path / "b.uff") == "uff"


# --- inspection -----------------------------------------------------------------------------------------------------------------


def test_inspect(tmp_path):
    force = ascii58([1.0] * 4, quantity=13, unit="N", label="Force", response=(7, 3))
    (tmp_path / "idle.uff").write_bytes(force + ascii58([1.0] * 4, unit="g") + text_set(1858, "x"))
    (tmp_path / "operating.uff").write_bytes(ascii58([1.0] * 4, unit="NONE"))
    out = inspect_files([tmp_path / "idle.uff", tmp_path / "operating.uff"])
    json.dumps(out, allow_nan=False)
    idle, operating = out["files"]
    assert out["schema"] == "operando/inspect/1"
    assert idle["found"] == ["time record: 1 force and 1 response channels of 2, 100 Hz, 0.04 s"]
    assert idle["ignored"] == [
        {
            "set": 2,
            "type": 1858,
            "title": "qualifiers of functions",
            "status": "not understood",
            "reason": "set 1858 has 1 lines, expected at least 4",
        }
    ]
    assert idle["missing"] == []
    assert [f["kind"] for f in idle["findings"]] == ["unknown_set", "missing_drive_point"]
    assert idle["records"][0]["forces"] == ["7+Z"]
    assert "no force channel: usable as operating record only" in operating["missing"]
    assert any("no unit for acceleration" in text for text in operating["missing"])
    assert out["missing"] == ["no geometry: shapes are not drawn on the structure"]
    assert out["dofs"] == ["12+Z"]
    assert inspect_files([tmp_path / "operating.uff"], units={"acceleration": "g"})["files"][0]["findings"] == []


def test_importing_the_room_loads_nothing_heavy():
    code = "import sys, operando.io; print([m for m in ('h5py', 'pyuff', 'scipy', 'matplotlib', 'pandas') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"


@pytest.mark.parametrize(("length", "good"), [(LONGEST_NAME, True), (LONGEST_NAME + 1, False)])
def test_a_column_name_longer_than_any_format_has_is_refused(tmp_path, length, good):
    assert LONGEST_NAME > 256  # characters of a name in UFF or TDMS
    path = tmp_path / "a.csv"
    path.write_text(f"time [s],{'a' * length}\n" + "".join(f"{i / 64},{i % 3}\n" for i in range(20)), encoding="utf-8")
    if good:
        assert read(path).records[0].channels[0].name == "a" * length
    else:
        with pytest.raises(FormatError, match=f"a column name of {length} characters"):
            read(path)


def test_a_table_of_nodes_is_a_geometry(tmp_path):
    geometry = table(tmp_path, "# frame\nNode;x [mm];y;z;colour\n1;0;1,5;2;red\n\n7;100;-3;0;blue\nFRAM:2;0;0;0;red\n").geometry
    assert geometry.nodes == (1, 7, "FRAM:2")
    np.testing.assert_allclose(geometry.coordinates, [[0, 1.5e-3, 2e-3], [0.1, -3e-3, 0], [0, 0, 0]])
    assert geometry.unit_known


def test_a_table_of_nodes_without_a_unit_takes_that_of_the_test_file(tmp_path):
    text = "node_name\t x\t y\t z\n 1 1.8e+01 -1 0\n 2 0 1 0\n"
    content = table(tmp_path, text)
    assert not content.geometry.unit_known
    assert [f.kind for f in content.findings] == ["missing_unit"]
    stated = table(tmp_path, text, units={"length": "in"})
    assert stated.geometry.coordinates[0, 0] == pytest.approx(18 * 0.0254)
    assert not stated.findings


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("a,0,0,0", "line 3: 'a' is no node"),
        ("2.5,0,0,0", "line 3: '2.5' is no node"),
        ("2,0,x,0", "line 3: y is 'x', expected a coordinate"),
        ("2,0,0,nan", "line 3: z is 'nan', expected a coordinate"),
        ("2,0,0", "line 3: 3 cells, but 4 columns"),
        ("1,0,0,0", "line 3: node 1 stands there a second time"),
    ],
)
def test_a_wrong_row_of_a_table_of_nodes_is_named(tmp_path, row, message):
    with pytest.raises(FormatError, match=message):
        table(tmp_path, f"node,x [m],y [m],z [m]\n1,0,0,0\n{row}\n")


def test_channels_called_as_nodes_stay_channels(tmp_path):
    """Two columns of ends are lines where they count nodes; samples change sign or have fractions."""
    for text in ("node 1 [g],node 2 [g]\n0.5,1\n1,2\n", "node_1,node_2\n-1,3\n2,1\n", "time,node,x,y,z\n0,1,1,1,1\n1,2,2,2,3\n"):
        assert table(tmp_path, text, units={"sampling_hz": 10}).records
    with pytest.raises(FormatError, match="a table of lines between nodes"):
        table(tmp_path, "node_1,node_2\n1,3\n2,1\n", units={"sampling_hz": 10})


def test_a_text_called_as_a_universal_file_is_said_to_be_none(tmp_path):
    path = tmp_path / "text.uff"
    path.write_text("hello, this is my measurement\n1 2 3\n")
    with pytest.raises(FormatError, match=r"^[^:]*text\.uff: no UFF file \(no line with -1\), read as a table: 3 columns"):
        read(path)
    path.write_text("time [s],1+Z [g]\n0,1\n1,2\n")
    content = read(path)
    assert content.records[0].n_samples == 2
    assert content.findings[0].message.startswith("no UFF file")


def test_values_of_frfs_that_are_no_numbers_are_counted(tmp_path):
    """Of the FRFs and of their coherence; a pair that was not measured lacks all of them, and is none of these."""
    data, coherence = np.ones((2, 2, 6), complex), np.full((2, 2, 6), 0.9)
    data[0, 0, 2], coherence[1, 0, 3:5], data[1, 1], coherence[1, 1] = np.nan, np.nan, np.nan, np.nan
    write_uff(tmp_path / "frf.uff", Frf(data, np.arange(5.0, 11.0), "1+Z, 2+Z", "1+Z, 2+Z", coherence=coherence, averages=10))
    missing = inspect_files([tmp_path / "frf.uff"])["files"][0]["missing"]
    assert [text.partition(":")[0] for text in missing] == [
        "no number at 1 of 24 values of the FRFs",
        "no number at 2 of 24 values of the coherence",
    ]

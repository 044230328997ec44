"""LVM, TDMS, NumPy, WAV, pairs of axis and values, tables without a header line, FRFs as CSV: each against a file written elsewhere."""

from __future__ import annotations

import io
import re
import struct
import sys
import wave
import zipfile

import numpy as np
import pytest

from operando.data import Channel, Frf, TimeRecord
from operando.dof import Dof
from operando.errors import ConfigError, FormatError, MissingError
from operando.io import convert, detect_format, inspect_files, read
from operando.io.columns import check_columns, propose_columns
from operando.io.csv import LONGEST_NAME
from operando.io.frf_table import write_frf_csv
from operando.io.matlab import write_matlab
from operando.units import G_STANDARD

RNG = np.random.default_rng(0)


# --- LabVIEW text ---------------------------------------------------------------------------------------------------------------

LVM_HEAD = (
    "LabVIEW Measurement\t\nWriter_Version\t2\nReader_Version\t2\nSeparator\tTab\nDecimal_Separator\t{mark}\nMulti_Headings\tYes\n"
    "X_Columns\t{axes}\nTime_Pref\tAbsolute\nOperator\tme\nDate\t2024/05/06\nTime\t10:11:12.3\n***End_of_Header***\t\n\t\n"
)


def lvm_block(data, start, step, dimension="Time", axes="No", mark=".", samples=None):
    count = len(data)
    tabs = lambda word: "\t".join([word] * count)  # noqa: E731
    lines = [
        f"Channels\t{count}\t\t", f"Samples\t{tabs(str(data.shape[1] if samples is None else samples))}\t", f"Date\t{tabs('2024/05/06')}\t",
        "\t".join(["Y_Unit_Label", *["g", "N", ""][:count], ""]), f"X_Dimension\t{tabs(dimension)}\t", f"X0\t{tabs(f'{start:.9E}')}\t",
        f"Delta_X\t{tabs(f'{step:.9f}')}\t", "***End_of_Header***\t\t",
        "X_Value\t" + ("\tX_Value\t" if axes == "Multi" else "\t").join(["12+Z", "Force", "free"][:count]) + "\tComment",
    ]  # fmt: skip
    for i, row in enumerate(data.T):
        time = "" if axes == "No" else f"{start + i * step:.6f}"
        cells = [f"{x:.6f}" for x in row]
        lines.append(time + "\t" + (f"\t{time}\t".join(cells) if axes == "Multi" else "\t".join(cells)))
    text = "\n".join(lines) + "\n\n"
    return text if mark == "." else text.replace(".", mark)


@pytest.mark.parametrize(("axes", "mark"), [("No", "."), ("One", "."), ("Multi", ","), ("No", ",")])
def test_lvm(tmp_path, axes, mark):
    data = np.round(RNG.normal(size=(2, 60)), 6)
    text = LVM_HEAD.format(axes=axes, mark=mark) + lvm_block(data[:, :40], 0.0, 1 / 512, axes=axes, mark=mark)
    text += lvm_block(data[:, 40:], 40 / 512, 1 / 512, axes=axes, mark=mark)
    path = tmp_path / "a.lvm"
    path.write_text(text)
    assert detect_format(path) == "lvm"
    content = read(path)
    (record,) = content.records  # the second block goes on where the first ends
    assert record.sampling_hz == pytest.approx(512, rel=1e-6)
    np.testing.assert_allclose(record.data, data * [[G_STANDARD], [1]], rtol=1e-12)
    assert [(c.label, c.quantity, c.unit) for c in record.channels] == [("12+Z", "acceleration", "m/s2"), ("Force", "force", "N")]
    assert len(content.sets) == 2


def test_lvm_says_what_it_leaves_out_and_refuses_what_is_cut(tmp_path):
    path = tmp_path / "a.lvm"
    head = LVM_HEAD.format(axes="No", mark=".")
    data = RNG.normal(size=(2, 20))
    path.write_text(head + lvm_block(data, 0.0, 0.01) + lvm_block(data, 5.0, 0.01) + lvm_block(data, 0.0, 0.5, "Frequency"))
    content = read(path)
    assert [r.start_s for r in content.records] == [0.0, 5.0]  # a gap in time: two records
    assert content.sets[2].status == "ignored"
    assert "frequency" in content.sets[2].note
    path.write_text(head + lvm_block(data, 0.0, 0.01).replace(f"{data[0, 3]:.6f}", "overrange"))
    assert [f.kind for f in read(path).findings] == ["nan"]
    path.write_text((head + lvm_block(data, 0.0, 0.01, samples=10)).replace("Multi_Headings\tYes", "Multi_Headings\tNo"))
    assert read(path).records[0].n_samples == 20
    for text, match in (
        (head + lvm_block(data, 0.0, 0.01, samples=25), "states 25 samples and has 20 rows"),
        (head.replace("***End_of_Header***", ""), "has no end"),
        (head + lvm_block(data, 0, 0.01).replace("Channels\t2", "Channels\t99999999"), "no number of channels"),
        (head + lvm_block(data, 0, 0.01).replace("X_Value", "Y"), "should name the columns"),
        (head + lvm_block(data, 0.0, 0.5, "Frequency"), "no time history"),
        (head + lvm_block(data, 0.0, 0.01).rstrip() + "\t1.0\t2.0\n", "line 42: 5 cells"),
    ):
        path.write_text(text)
        with pytest.raises(FormatError, match=match):
            read(path)


# --- TDMS -----------------------------------------------------------------------------------------------------------------------


def test_tdms(tmp_path):
    nptdms = pytest.importorskip("nptdms", reason="npTDMS is not installed (the extra tdms)")
    data = RNG.normal(size=(3, 100))
    path = tmp_path / "a.tdms"
    with nptdms.TdmsWriter(str(path)) as writer:
        channels = [
            nptdms.ChannelObject("run", name, row, properties={"wf_increment": 1 / 1024, "wf_start_offset": 0.5, "unit_string": unit})
            for name, row, unit in zip(("12+Z", "Force", "other"), data, ("g", "N", ""), strict=True)
        ]
        h = nptdms.ChannelObject("frf", "H", data[0] + 1j * data[1], properties={"wf_increment": 0.25, "wf_xname": "Frequency"})
        writer.write_segment([*channels, h, nptdms.ChannelObject("run", "notes", ["a", "b"])])
    assert detect_format(path) == "tdms"
    content = read(path, units={"acceleration": "m/s2", "force": "N"})
    (record,), (frf,) = content.records, content.frfs
    np.testing.assert_allclose(record.data, data * [[G_STANDARD], [1], [1]])
    assert (record.sampling_hz, record.start_s) == (1024.0, 0.5)
    assert [(c.label, c.quantity) for c in record.channels] == [("12+Z", "acceleration"), ("Force", "force"), ("other", "unknown")]
    np.testing.assert_array_equal(frf.data[0, 0], data[0] + 1j * data[1])
    assert (frf.axis.step, frf.si) == (0.25, True)
    assert [s.status for s in content.sets].count("ignored") == 1
    raw = path.read_bytes()
    path.write_bytes(raw[:28] + b"\xff" * 40 + raw[68:])
    with pytest.raises(FormatError):
        read(path)


def test_tdms_that_is_cut_off_is_said(tmp_path, capfd):
    nptdms = pytest.importorskip("nptdms", reason="npTDMS is not installed (the extra tdms)")
    with nptdms.TdmsWriter(str(tmp_path / "a.tdms")) as writer:
        writer.write_segment([nptdms.ChannelObject("run", "1+Z", np.ones(100), properties={"wf_increment": 0.01, "unit_string": "g"})])
    (tmp_path / "a.tdms").write_bytes((tmp_path / "a.tdms").read_bytes()[:-40])
    content = read(tmp_path / "a.tdms")
    assert content.records[0].n_samples == 95
    assert {f.kind for f in content.findings} == {"damaged"}
    assert not capfd.readouterr().err  # said as a finding, not by the library on the terminal


def test_tdms_without_the_library_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "nptdms", None)
    (tmp_path / "a.tdms").write_bytes(b"TDSm" + bytes(40))
    with pytest.raises(MissingError, match=r"operando\[tdms\]"):
        read(tmp_path / "a.tdms")


def test_what_belongs_to_no_block_of_lvm_is_told(tmp_path):
    """Damage at the words that open and close a header; each lost a block without a word."""
    data = np.round(RNG.normal(size=(2, 20)), 6)
    blocks = [lvm_block(data[:, :10], 0.0, 1 / 512), lvm_block(data[:, 10:], 10 / 512, 1 / 512)]
    head = LVM_HEAD.format(axes="No", mark=".")
    path = tmp_path / "a.lvm"

    def findings(text):
        path.write_text(text)
        content = read(path)
        assert content.records[0].n_samples == 10
        return [(f.kind, f.severity, f.message) for f in content.findings if f.kind != "missing_unit"]

    end = "***End_of_Header***"
    for first, second in ((blocks[0].replace(end, "***End_of"), blocks[1]), (blocks[0], blocks[1].replace(end, "***End_of"))):
        ((kind, severity, message),) = findings(head + first + second)
        assert (kind, severity, "has no end" in message) == ("damaged", "error", True)
    assert findings(head + blocks[0].replace("Channels", "Chan") + blocks[1])[0][2].endswith("belong to no block")
    ((kind, severity, message),) = findings(head + blocks[0] + blocks[1].replace("Time", "Timf", 1))
    assert (kind, severity, "its axis is time, timf" in message) == ("unused_block", "warning", True)
    for text, match in (
        (head.replace(end, "x") + "".join(blocks), "has no end"),
        (head + blocks[0].replace("Channels\t2", "Channels\t1") + blocks[1], "1 channels but 2 names"),
        (head + blocks[0].replace("12+Z\tForce", "12+Z Force") + blocks[1], "2 channels but 1 names"),
    ):
        path.write_text(text)
        with pytest.raises(FormatError, match=match):
            read(path)


def test_a_block_of_lvm_without_its_step_is_refused(tmp_path):
    data = np.round(RNG.normal(size=(2, 20)), 6)
    for line in ("Delta_X", "X0"):
        text = LVM_HEAD.format(axes="No", mark=".") + re.sub(rf"\n{line}\t.*", rf"\n{line}", lvm_block(data, 0.0, 1 / 512))
        (tmp_path / "a.lvm").write_text(text)
        if line == "X0":
            assert read(tmp_path / "a.lvm").records[0].start_s == 0.0
            continue
        with pytest.raises(FormatError, match="no step of time"):
            read(tmp_path / "a.lvm")


def test_tdms_samples_of_a_channel_that_is_not_listed_are_told(tmp_path):
    nptdms = pytest.importorskip("nptdms", reason="npTDMS is not installed (the extra tdms)")
    path = tmp_path / "a.tdms"
    given = {"wf_increment": 0.01, "unit_string": "g"}
    with nptdms.TdmsWriter(str(path)) as writer:
        writer.write_segment([nptdms.ChannelObject("run", name, np.ones(20), properties=given) for name in ("1+Z", "2+Z")])
    assert not read(path).findings
    path.write_bytes(path.read_bytes().replace(b"'1+Z'", b"'1+Z\x00"))  # its name has no end: the library takes it for a group
    content = read(path)
    assert [c.name for c in content.records[0].channels] == ["2+Z"]
    (finding,) = content.findings
    assert (finding.kind, "320 bytes of samples are stored, the channels take 160" in finding.message) == ("damaged", True)


# --- NumPy ----------------------------------------------------------------------------------------------------------------------


def test_npz_and_npy(tmp_path):
    data = RNG.normal(size=(200, 2))
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", x=data, fs=256.0, channel_names=np.array(["12+Z", "Force"]), units=np.array(["g", "N"]))
        assert detect_format(tmp_path / "a.npz") == "npz"
        (record,) = read(tmp_path / "a.npz").records
        np.testing.assert_allclose(record.data, (data * [G_STANDARD, 1]).T)
        assert [c.label for c in record.channels] == ["12+Z", "Force"]
    h = data[:, 0] + 1j * data[:, 1]
    np.savez(tmp_path / "h.npz", H=h, f=np.arange(200) / 4)
    (frf,) = read(tmp_path / "h.npz").frfs
    np.testing.assert_array_equal(frf.data[0, 0], h)
    np.save(tmp_path / "a.npy", data.astype(np.float32))
    (record,) = read(tmp_path / "a.npy", units={"sampling_hz": 100}).records
    assert (record.data.shape, record.data.dtype, record.sampling_hz) == ((2, 200), np.float32, 100.0)
    np.save(tmp_path / "pair.npy", np.column_stack([np.arange(200) / 64, data[:, 0]]))
    (record,) = read(tmp_path / "pair.npy").records
    assert (record.data.shape, record.sampling_hz) == ((1, 200), 64.0)


def test_numpy_files_bring_no_objects_and_no_false_sizes(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(FormatError, match="pickled objects"):
        read(path)
    np.savez(tmp_path / "a.npz", x=np.array([print], dtype=object))
    with pytest.raises(FormatError, match="pickled objects"):
        read(tmp_path / "a.npz")
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": (1 << 40,)})
    path.write_bytes(stream.getvalue() + bytes(64))
    with pytest.raises(FormatError, match="declares 8796093022208 bytes"):
        read(path)
    path.write_bytes(b"\x93NUMPY\x01\x00" + b"\xff" * 100)
    with pytest.raises(FormatError):
        read(path)
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        stream = io.BytesIO()
        np.save(stream, np.zeros(12_000_000))
        archive.writestr("x.npy", stream.getvalue())
    with pytest.raises(FormatError, match="MB of memory"):
        read(tmp_path / "bomb.npz")


# --- WAV ------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.int32, np.float32, np.float64])
def test_wav(tmp_path, dtype):
    from scipy.io import wavfile

    shape = RNG.uniform(-0.9, 0.9, size=(300, 2))
    kind = np.dtype(dtype)
    full = 1.0 if kind.kind == "f" else 2.0 ** (8 * kind.itemsize - 1)
    stored = shape.astype(kind) if kind.kind == "f" else (np.round(shape * full) + (128 if kind == np.uint8 else 0)).astype(kind)
    wavfile.write(tmp_path / "a.wav", 48000, stored)
    content = read(tmp_path / "a.wav", channels={"ch1": {"dof": "12+Z", "quantity": "acceleration", "unit": "g", "sensitivity": 0.5}})
    (record,) = content.records
    expected = stored.astype(float) if kind.kind == "f" else (stored.astype(float) - (128 if kind == np.uint8 else 0)) / full
    np.testing.assert_allclose(record.data, (expected * [2 * G_STANDARD, 1]).T, rtol=1e-6)
    assert (record.sampling_hz, record.channels[0].label, record.channels[1].quantity) == (48000.0, "12+Z", "unknown")
    assert "knows no units" in content.findings[0].message


def test_wav_of_24_bits_and_damaged_ones(tmp_path):
    values = np.array([0, 1, -1, 8388607, -8388608, 4194304])
    with wave.open(str(tmp_path / "a.wav"), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(3)
        file.setframerate(1000)
        file.writeframes(b"".join(int(v).to_bytes(3, "little", signed=True) for v in values))
    (record,) = read(tmp_path / "a.wav").records
    np.testing.assert_array_equal(record.data[0], values / 8388608)
    raw = (tmp_path / "a.wav").read_bytes()
    for bad, match in (
        (raw[:-4], "cut off"),
        (raw[:40] + struct.pack("<I", 0xFFFFFFF0) + raw[44:], "cut off"),
        (raw[:20] + struct.pack("<H", 85) + raw[22:], "not understood"),
        (raw[:12], "no format"),
    ):
        (tmp_path / "b.wav").write_bytes(bad)
        with pytest.raises(FormatError, match=match):
            read(tmp_path / "b.wav")


# --- arrays beside one axis, pairs ----------------------------------------------------------------------------------------------


def test_vectors_beside_one_time_vector_are_one_record(tmp_path):
    from scipy.io import savemat

    rows = RNG.normal(size=(3, 90))
    savemat(tmp_path / "a.mat", {"time": np.arange(90) / 128, "Force_N": rows[0], "acc1": rows[1], "acc2": rows[2]})
    channels = {"acc1": {"dof": "1+Z", "quantity": "acceleration", "unit": "g"}}
    (record,) = read(tmp_path / "a.mat", channels=channels).records
    assert ([c.name for c in record.channels], record.sampling_hz) == (["Force_N", "acc1", "acc2"], 128.0)
    np.testing.assert_allclose(record.data, rows * [[1], [G_STANDARD], [1]])
    savemat(tmp_path / "b.mat", {"x": rows[0], "y": rows[1]})
    with pytest.raises(FormatError, match="no sampling rate"):
        read(tmp_path / "b.mat")


def test_pairs_of_axis_and_values(tmp_path):
    """As the analysers of Data Physics (SignalCalc) export: X1 time, H1_2 FRF, C1_2 coherence, G1_1 auto spectrum, two columns each."""
    from scipy.io import savemat

    t, f = np.arange(256) / 512.0, np.arange(65) * 2.0
    x = RNG.normal(size=(2, 256))
    h = RNG.normal(size=(2, 65)) + 1j * RNG.normal(size=(2, 65))
    variables = {"X1": np.column_stack([t, x[0]]), "X2": np.column_stack([t, x[1]]), "G1_1": np.column_stack([f, np.abs(h[0])])}
    variables |= {"H1_2": np.column_stack([f, h[0]]), "H1_3": np.column_stack([f, h[1]])}
    variables |= {"C1_2": np.column_stack([f, np.full(65, 0.9)]), "C1_3": np.column_stack([f, np.full(65, 0.8)])}
    savemat(tmp_path / "a.mat", variables)
    content = read(tmp_path / "a.mat", channels={"H1_2": {"dof": "2+Z"}, "H1_3": {"dof": "3+Z"}, "force": {"dof": "1+Z"}})
    (record,), (frf,) = content.records, content.frfs
    np.testing.assert_array_equal(record.data, x)
    assert (record.sampling_hz, [c.name for c in record.channels]) == (512.0, ["X1", "X2"])
    np.testing.assert_array_equal(frf.data[:, 0], h)
    assert ([str(d) for d in frf.responses], [str(d) for d in frf.references], frf.axis.step) == (["2+Z", "3+Z"], ["1+Z"], 2.0)
    assert frf.coherence is not None
    assert frf.coherence[1, 0, 0] == 0.8
    assert {s.title.split()[0]: s.note for s in content.sets}["G1_1"] == "a spectrum without phase"


# --- tables without a header line -----------------------------------------------------------------------------------------------


def bare(tmp_path, *columns, name="a.txt"):
    np.savetxt(tmp_path / name, np.column_stack(columns), fmt="%.12g")
    return tmp_path / name


def mode(f, hz=40.0, zeta=0.02):
    return -(f**2) / (hz**2 - f**2 + 2j * zeta * hz * f)


def test_bare_tables_as_the_test_file_says(tmp_path):
    f = np.arange(1, 200) * 0.5
    h = mode(f)
    db, deg = 20 * np.log10(np.abs(h)), np.degrees(np.angle(h))
    cases = {
        ("Hz", "dB", "deg"): (f, db, deg), ("Hz", "magnitude", "rad"): (f, np.abs(h), np.angle(h)),
        ("Hz", "real", "imag"): (f, h.real, h.imag), ("rad/s", "dB", "deg"): (2 * np.pi * f, db, deg),
    }  # fmt: skip
    channels = {"ch1": {"dof": "12+Z"}, "force": {"dof": "1+Z"}}
    for columns, table in cases.items():
        units = {"columns": list(columns), "acceleration": "g", "force": "N"}
        content = read(bare(tmp_path, *table), units=units, channels=channels)
        (frf,) = content.frfs
        np.testing.assert_allclose(frf.data[0, 0], h * G_STANDARD, rtol=1e-8)
        np.testing.assert_allclose(frf.frequencies_hz, f, rtol=1e-10)
        assert (str(frf.responses[0]), str(frf.references[0]), frf.si, content.findings) == ("12+Z", "1+Z", True, ())
    content = read(bare(tmp_path, f, db), units={"columns": ["Hz", "dB"]})
    assert [x.kind for x in content.findings] == ["missing_phase", "missing_dof", "missing_unit"]
    np.testing.assert_allclose(content.frfs[0].data[0, 0], np.abs(h))
    x = RNG.normal(size=(2, 300))
    (record,) = read(bare(tmp_path, np.arange(300) / 256, *x), units={"columns": ["s", "g", "N"]}).records
    np.testing.assert_allclose(record.data, x * [[G_STANDARD], [1]], rtol=1e-10)
    assert (record.sampling_hz, [c.quantity for c in record.channels]) == (256.0, ["acceleration", "force"])


def test_bare_tables_are_asked_for_with_a_proposal(tmp_path):
    f = np.arange(1, 200) * 0.5
    h = mode(f)
    db, deg = 20 * np.log10(np.abs(h)), np.degrees(np.angle(h))
    with pytest.raises(FormatError, match="no header line") as caught:
        read(bare(tmp_path, f, db, deg))
    assert '["Hz", "dB", "deg"]' in caught.value.hint.split("by the numbers")[1]
    assert propose_columns(np.array([f, np.abs(h), deg])) == ("Hz", "magnitude", "deg")
    assert propose_columns(np.array([f, np.abs(h), np.angle(h)])) == ("Hz", "magnitude", "rad")
    assert propose_columns(np.array([f, h.real, h.imag])) == ("Hz", "real", "imag")
    t = np.arange(500) / 1024
    assert propose_columns(np.array([t, np.sin(t), np.cos(t)])) == ("s", "", "")
    assert propose_columns(np.array([h.real, h.imag])) == ()
    with pytest.raises(FormatError, match="3 columns of numbers, but"):
        read(tmp_path / "a.txt", units={"columns": ["Hz", "dB"]})
    with pytest.raises(FormatError, match="does not increase"):
        read(bare(tmp_path, f[::-1], db, deg), units={"columns": ["Hz", "dB", "deg"]})


@pytest.mark.parametrize(
    "columns",
    [
        ["Hz"],
        ["Hz", "imag", "real"],
        ["Hz", "real"],
        ["kg", "dB"],
        ["s", "furlongs"],
        "Hz,dB",
        ["Hz", "dB", "imag"],
        ["Hz", "dB", "deg", "g"],
    ],
)
def test_columns_are_checked(columns):
    with pytest.raises(ConfigError, match=r"columns|furlongs"):
        check_columns(columns, "[units] columns")


def test_columns_stand_in_the_test_file(tmp_path):
    from operando import load_test

    f = np.arange(1, 50) * 0.5
    bare(tmp_path, f, f, f, name="h.txt")
    (tmp_path / "test.toml").write_text('[idle]\nfrfs = ["h.txt"]\n[units]\ncolumns = ["Hz", "dB", "deg"]\n')
    assert load_test(tmp_path).units == {"columns": ["Hz", "dB", "deg"]}
    (tmp_path / "test.toml").write_text('[idle]\nfrfs = ["h.txt"]\n[units]\ncolumns = ["Hz", "dB", "dB"]\n')
    with pytest.raises(ConfigError, match="says nothing of columns"):
        load_test(tmp_path)


# --- FRFs as CSV ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("quantity", ["accelerance", "mobility", "receptance"])
def test_frf_csv_round_trip(tmp_path, quantity):
    h = RNG.normal(size=(3, 2, 20)) + 1j * RNG.normal(size=(3, 2, 20))
    h[2, 1] = np.nan
    frf = Frf(h, np.arange(20) / 3, ("1Z", "2-X", "3RY"), ("1Z", "2-X"), quantity, coherence=RNG.uniform(0, 1, h.shape), averages=7.5)
    write_frf_csv(tmp_path / "a.csv", frf)
    content = read(tmp_path / "a.csv")
    (back,) = content.frfs
    np.testing.assert_array_equal(back.data, frf.data)
    np.testing.assert_array_equal(back.frequencies_hz, frf.frequencies_hz)
    np.testing.assert_array_equal(back.coherence[:2], frf.coherence[:2])
    assert (back.responses, back.references, back.quantity, back.si, back.averages) == (frf.responses, frf.references, quantity, True, 7.5)
    assert not content.findings
    out = convert(tmp_path / "a.csv", tmp_path / "b.csv")
    assert out["written"] == [f"{quantity} 3 × 2, 20 lines"]
    np.testing.assert_array_equal(read(tmp_path / "b.csv").frfs[0].data, frf.data)
    assert inspect_files([tmp_path / "a.csv"])["files"][0]["frfs"][0]["pairs_measured"] == 5


@pytest.mark.parametrize("shape", [(1, 2, 40), (2, 1, 40), (12, 3, 10), (1, 1, 5), (1, 1, 1)])
def test_frfs_in_matlab_files_keep_rows_columns_and_lines(tmp_path, shape):
    h = RNG.normal(size=shape) + 1j * RNG.normal(size=shape)
    labels = tuple(f"{i + 1}+Z" for i in range(12))
    frf = Frf(h, np.arange(1, shape[2] + 1) / 2, labels[: shape[0]], labels[-shape[1] :], "mobility")
    frf.save(tmp_path / "a.mat")
    content = read(tmp_path / "a.mat")
    (back,) = content.frfs
    np.testing.assert_array_equal(back.data, frf.data)
    assert (back.responses, back.references, back.quantity, back.axis) == (frf.responses, frf.references, frf.quantity, frf.axis)
    assert [s.title for s in content.sets if s.status != "used"] == []


def test_frf_csv_written_elsewhere(tmp_path):
    path = tmp_path / "a.csv"
    rows = "\n".join(f"{0.01 * k},{k},{10 * k},x".replace(",x", "") for k in range(1, 12))
    path.write_text(f"Frequency [kHz];2+Z/1+Z magnitude [g/N];2+Z/1+Z phase [deg]\n{rows.replace(',', ';')}\n")
    (frf,) = read(path).frfs
    k = np.arange(1, 12)
    np.testing.assert_allclose(frf.data[0, 0], G_STANDARD * k * np.exp(1j * np.radians(10 * k)), rtol=1e-12)
    np.testing.assert_allclose(frf.frequencies_hz, 10 * k)
    path.write_text(f"frequency,2+Z/1+Z real,3+Z/1+Z imag\n{rows}\n")
    with pytest.raises(FormatError, match="only one of its two columns"):
        read(path)
    path.write_text(f"frequency,2+Z/1+Z real [N/m],2+Z/1+Z imag [N/m]\n{rows}\n")
    (frf,) = read(path).frfs
    assert not frf.si


def test_members_of_an_archive_that_are_no_arrays_are_told(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        for name, value in (("x.npy", RNG.normal(size=(20, 2))), ("fs.npy", np.array(64.0)), ("channel_names*npy", np.array(["a", "b"]))):
            stream = io.BytesIO()
            np.save(stream, value)
            archive.writestr(name, stream.getvalue())
    (finding,) = [f for f in read(tmp_path / "a.npz").findings if f.kind == "unused_member"]
    assert "channel_names*npy" in finding.message


def test_levels_beyond_all_numbers_make_no_warning(tmp_path):
    rows = "".join(f"{f} {'1e9' if f == 3 else f} {f * 10}\n" for f in range(1, 9))
    (tmp_path / "a.txt").write_text(rows)
    (frf,) = read(tmp_path / "a.txt", units={"columns": ["Hz", "dB", "deg"]}).frfs
    assert np.isinf(frf.data[0, 0, 2].real)
    np.testing.assert_allclose(frf.data[0, 0, 3], 10 ** (4 / 20) * np.exp(1j * np.deg2rad(40)), rtol=1e-14)


def test_empty_cells_of_an_frf_table_are_told(tmp_path):
    data = np.ones((1, 1, 4)) + 1j
    write_frf_csv(tmp_path / "a.csv", Frf(data, np.arange(1.0, 5.0), ("1Z",), ("1Z",), coherence=np.full(data.shape, 0.5)))
    assert not read(tmp_path / "a.csv").findings
    text = (tmp_path / "a.csv").read_text()
    (tmp_path / "b.csv").write_text(text[: text.rindex(",") + 1])
    (finding,) = read(tmp_path / "b.csv").findings
    assert (finding.kind, finding.message) == ("nan", "1 cells of the table hold no number")


def test_variables_of_matlab_7_3_that_are_not_understood_are_told(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.mat", "w", userblock_size=512) as file:
        file["x"], file["fs"] = RNG.normal(size=(2, 20)), 64.0
        file["H"] = np.zeros(4, np.dtype([("reel", "<f8"), ("imag", "<f8")]))
    with open(tmp_path / "a.mat", "r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    (finding,) = [f for f in read(tmp_path / "a.mat").findings if f.kind == "unused_variable"]
    assert "neither numbers nor texts: H" in finding.message


def test_a_column_name_is_no_longer_than_any_format_has(tmp_path):
    for length in (LONGEST_NAME, LONGEST_NAME + 1):
        (tmp_path / "a.csv").write_text(f"t,{'x' * length}\n" + "".join(f"{i},1\n" for i in range(9)))
        if length == LONGEST_NAME:
            assert len(read(tmp_path / "a.csv").records[0].channels[0].name) == length
            continue
        with pytest.raises(FormatError, match=f"at most {LONGEST_NAME} characters"):
            read(tmp_path / "a.csv")
    assert LONGEST_NAME > 256  # the longest names of UFF and TDMS pass


@pytest.mark.parametrize(
    ("beside", "channels"),
    [
        ({"names": np.array([f"ch{i}" for i in range(40)], dtype=object)}, 40),
        ({"units": np.array(["m/s2"] * 40, dtype=object)}, 40),
        ({"t": np.arange(32) / 256.0}, 40),
        ({"fs": 256.0}, 32),  # nothing tells: the long side is the time
    ],
)
@pytest.mark.parametrize("turned", [False, True])
def test_more_channels_than_samples_in_matlab_files(tmp_path, beside, channels, turned):
    from scipy.io import savemat

    data = np.random.default_rng(0).standard_normal((40, 32))
    savemat(tmp_path / "a.mat", {"acc": data.T if turned else data, "fs": 256.0} | beside)
    (record,) = read(tmp_path / "a.mat").records
    np.testing.assert_array_equal(record.data, data if channels == 40 else data.T)


def test_a_short_record_of_many_channels_survives_a_matlab_file(tmp_path):
    channels = tuple(Channel(Dof(i + 1, "Z", 1), "acceleration", "m/s2") for i in range(40))
    record = TimeRecord(np.random.default_rng(0).standard_normal((40, 32)), 256.0, channels)
    write_matlab(tmp_path / "a.mat", record)
    (again,) = read(tmp_path / "a.mat").records
    np.testing.assert_array_equal(again.data, record.data)
    assert [c.dof for c in again.channels] == [c.dof for c in channels]

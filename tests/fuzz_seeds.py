"""Small good files for every reader, made by the writers of the project and of pyuff's, SciPy's, h5py's and npTDMS's formats."""

from __future__ import annotations

import io
import json
import re
import struct
import wave
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from fuzzing import Part, Seed, pieces, with_parts
from io_files import ascii58, binary58, text_set, units164
from operando.config import load_test
from operando.data import Channel, Frf, Geometry, ModalModel, TimeRecord
from operando.dof import Dof
from operando.errors import FormatError
from operando.io import from_sep005, read, read_uff_sets, write_csv, write_hdf5, write_uff
from operando.io.content import FileHeader
from operando.io.frf_table import write_frf_csv
from operando.results import Results
from operando.store import load_results, save_results

RATE = 256.0
Generator = np.random.Generator
Cut = tuple[int, int, bytes]


def small_record(rng: Generator, samples: int = 14) -> TimeRecord:
    """A force and two accelerations."""
    kinds = (("1+Z", "force", "N"), ("1+Z", "acceleration", "m/s2"), ("2-Y", "acceleration", "m/s2"))
    channels = tuple(Channel(Dof.parse(d), q, u, f"sensor {i}") for i, (d, q, u) in enumerate(kinds))
    return TimeRecord(np.round(rng.normal(size=(3, samples)), 6), RATE, channels)


def small_frf(rng: Generator) -> Frf:
    """Two by two, with coherence and variance."""
    data = rng.normal(size=(2, 2, 9)) + 1j * rng.normal(size=(2, 2, 9))
    coherence = rng.uniform(0.5, 1, data.shape)
    return Frf(data, np.arange(1.0, 10.0), ("1Z", "2Z"), ("1Z", "2Z"), coherence=coherence, variance=coherence * 1e-4, averages=8)


def small_model(rng: Generator, complex_shapes: bool = False) -> ModalModel:
    """Three modes, and a residual term where they are real."""
    dofs = ("1+X", "1+Y", "1+Z", "2+X", "2+Y", "2+Z")
    shapes = rng.normal(size=(6, 4)) + (1j * rng.normal(size=(6, 4)) if complex_shapes else 0.0)
    if complex_shapes:
        return ModalModel([10.0, 20.0, 35.0], [0.01, 0.02, 0.015], shapes[:, :3], dofs)
    hz, zeta = [10.0, 20.0, 35.0, 90.0], [0.01, 0.02, 0.015, 0.02]
    return ModalModel.from_terms(hz, zeta, shapes, dofs, "unit_modal_mass", residual=[False] * 3 + [True])


def small_geometry(rng: Generator) -> Geometry:
    """Four nodes with lines and faces."""
    return Geometry((1, 2, 3, 4), np.round(rng.normal(size=(4, 3)), 3), ((1, 2, 3), (3, 4)), ((1, 2, 3), (1, 2, 3, 4)))


def written(path: Path, write: Callable[[Path], Any]) -> bytes:
    """Bytes of a file that something writes."""
    write(path)
    return path.read_bytes()


# --- UFF --------------------------------------------------------------------------------------------------------------------------


def e_format(*numbers: float, width: int = 13, digits: int = 5) -> str:
    """Numbers as Fortran's E format prints them."""
    return "".join(f"{number:{width}.{digits}E}" for number in numbers)


SYSTEMS_18 = (
    f"{7:10d}{0:10d}{0:10d}{8:10d}{0:10d}", "local", e_format(1, 2, 0, 1, 3, 0, width=15, digits=7), e_format(1, 2, 1, width=15, digits=7),
)  # fmt: skip
SYSTEMS_2420 = (
    f"{1:10d}", "part", f"{7:10d}{0:10d}{8:10d}", "local", *(e_format(*row, width=25, digits=16) for row in np.eye(3)),
    e_format(0.5, 0, 0, width=25, digits=16),
)  # fmt: skip
NODES_15 = tuple(f"{n:10d}{7 * (n == 2):10d}{0:10d}{1:10d}{0.5 * n:13.5E}{n * n:13.5E}{0.25:13.5E}" for n in (1, 2, 3))
TRACE_82 = (f"{1:10d}{4:10d}{1:10d}", "beam", f"{1:10d}{2:10d}{0:10d}{3:10d}{1:10d}")
NO_FACTORS = e_format(0, 0, 0, 0, 0, width=15, digits=7)
QUALIFIERS = ("           0" * 6, "     0     2" + "     0" * 10, NO_FACTORS, NO_FACTORS, NO_FACTORS, "X+    X+", "NONE")


def analysis_2414(rng: Generator, number: int) -> bytes:
    """A real normal mode as analysis data."""
    numbers = f"{0.0:13.5E}{10.0 * number:13.5E}{0.0:13.5E}{1.0:13.5E}{0.02:13.5E}{0.0:13.5E}"
    rows = [text for n in (1, 2, 3) for text in (f"{n:10d}", "".join(f"{v:13.5E}" for v in rng.normal(size=3)))]
    return text_set(
        2414, f"{number:10d}", "modes", f"{1:10d}", *["NONE"] * 5, f"{1:10d}{2:10d}{2:10d}{8:10d}{2:10d}{3:10d}",
        f"{0:10d}{0:10d}{0:10d}{0:10d}{1:10d}{number:10d}{0:10d}{0:10d}", f"{0:10d}{0:10d}", numbers, f"{0.0:13.5E}" * 6, *rows,
    )  # fmt: skip


def uff_files(path: Path) -> Iterator[tuple[str, bytes]]:
    """UFF files by name."""
    rng = np.random.default_rng(18)
    record, frf, geometry = small_record(rng), small_frf(rng), small_geometry(rng)
    header = FileHeader("pump", "on its frame", "a program", writer="another")
    made = lambda *objects, **more: written(path, lambda p: write_uff(p, *objects, **more))  # noqa: E731
    yield "uff 58 ascii records", made(record, binary=False)
    yield "uff 58b records", made(record)
    yield "uff 58 ascii frfs", made(frf, binary=False)
    yield "uff 58b frfs", made(frf)
    number = rng.normal
    by_hand = [ascii58(number(size=8), kind=2, points=8, response=(1, 3)), ascii58(number(size=16), points=8, response=(2, -2))]
    axis = {"abscissa": (18, "Frequency", "Hz"), "function": 4, "denominator": (13, "Force", "N"), "step": 0.5}
    by_hand += [ascii58(number(size=16), kind=k, points=8, response=(k, 3), reference=(1, 3), **axis) for k in (5, 6)]
    uneven = [float(f"{v:.6g}") for f in range(1, 7) for v in (f * f, *number(size=2))]
    by_hand += [ascii58(uneven, kind=6, even=0, points=6, response=(9, 3), reference=(1, 3), **axis)]
    yield "uff 58 ascii by hand", b"".join(by_hand)
    values = rng.normal(size=(4, 12)).tolist()
    forms = zip("<><>", (2, 2, 4, 4), values, strict=True)
    mixed = [binary58(row, order, kind=kind, points=12, response=(i, 3)) for i, (order, kind, row) in enumerate(forms, start=1)]
    yield "uff 58b mixed", b"".join([units164(), *mixed[:2], ascii58(number(size=12), points=12, response=(7, 3)), *mixed[2:]])
    modes = made(small_model(rng), header=header)
    yield "uff 55 164 151", modes
    yield "uff 55 complex", made(small_model(rng, complex_shapes=True))
    yield "uff 2414", b"".join(analysis_2414(rng, i) for i in (1, 2, 3))
    yield "uff 2411 82 2412", made(geometry)
    yield "uff 15 18 82", b"".join([units164(), text_set(18, *SYSTEMS_18), text_set(15, *NODES_15), text_set(82, *TRACE_82)])
    yield "uff 15 2420", b"".join([text_set(2420, *SYSTEMS_2420), text_set(15, *NODES_15), text_set(82, *TRACE_82)])
    yield "uff 1858", b"".join([text_set(1858, *QUALIFIERS), *(ascii58(number(size=8), points=8, response=(i, 3)) for i in (1, 2))])
    yield "uff utf-16", b"".join(ascii58(number(size=8), points=8, response=(i, 3)) for i in (1, 2)).decode().encode("utf-16")


def uff_seeds(path: Path) -> Iterator[Seed]:
    """UFF files; their parts are the sets."""
    yield from (uff_seed(name, data, path) for name, data in uff_files(path))


def uff_seed(name: str, data: bytes, path: Path) -> Seed:
    """A UFF file with its parts."""
    seed = Seed(name, "a.uff", data, read)
    if "utf-16" in name:
        return seed
    path.write_bytes(data)
    cuts: list[Cut] = []
    for raw, own in read_uff_sets(path):
        cuts.append((raw.start, raw.stop, data[: raw.start] + data[raw.stop :]))
        if raw.number == 164:  # factors of 1 are missed by nobody: others are
            cuts.append((raw.start, raw.stop, data[: raw.start] + own.replace(b" 1.0", b" 2.0") + data[raw.stop :]))
    return with_parts(seed, cuts, path)


# --- tables -----------------------------------------------------------------------------------------------------------------------


def table_seed(seed: Seed, path: Path, head: int, separator: bytes, time: bool = True) -> Seed:
    """Every row of a table is a part, and every cell of the time, on which the axis hangs; what stands above the rows is structure."""
    path.write_bytes(seed.data)
    axis = Counter({piece: n for piece, n in pieces(seed.read(path), True).items() if piece[0] == "axis"})
    cuts: list[Cut] = []
    times: list[Part] = []
    at = 0
    for number, line in enumerate(seed.data.splitlines(keepends=True)):
        start, at = at, at + len(line)
        if number < head or not line[:1].isdigit():
            continue
        first, *cells = line.split(separator)
        changed = separator.join([first, *(_FIRST_DIGIT.sub(_next_digit, cell) for cell in cells)])
        cuts.append((start, at, seed.data[:start] + changed + seed.data[at:]))
        if time:
            times.append(Part(start, start + len(first), axis))
    made = with_parts(seed, cuts, path)
    return replace(made, parts=(*made.parts, *times))


_FIRST_DIGIT = re.compile(rb"^(\s*-?)(\d)")


def _next_digit(match: re.Match[bytes]) -> bytes:
    return match[1] + str((int(match[2]) + 1) % 10).encode()


def lvm_file(record: TimeRecord) -> bytes:
    """Two blocks of one measurement."""
    lines = [
        "LabVIEW Measurement\t",
        "Writer_Version\t2",
        "Separator\tTab",
        "Decimal_Separator\t.",
        "Multi_Headings\tYes",
        "X_Columns\tOne",
    ]
    lines += ["***End_of_Header***\t", "\t"]
    step, half = 1 / record.sampling_hz, record.n_samples // 2
    for start in (0, half):
        many = lambda text: "\t".join([text] * 3) + "\t"  # noqa: E731
        lines += ["Channels\t3\t\t", f"Samples\t{many(str(half))}", "Y_Unit_Label\tN\tm/s2\tm/s2\t", f"X_Dimension\t{many('Time')}"]
        lines += [
            f"X0\t{many(f'{start * step:.9E}')}",
            f"Delta_X\t{many(f'{step:.9f}')}",
            "***End_of_Header***\t\t",
            "X_Value\tF\t1+Z\t2-Y\tComment",
        ]
        for i in range(start, start + half):
            lines.append("\t".join([f"{i * step:.6f}", *(f"{v:.6f}" for v in record.data[:, i])]))
        lines.append("")
    return "\n".join(lines).encode()


def tables(path: Path) -> Iterator[Seed]:
    """Tables with and without a header line, FRFs, LabVIEW's text."""
    rng = np.random.default_rng(18)
    record = small_record(rng)
    data = written(path, lambda p: write_csv(p, record))
    yield table_seed(Seed("csv", "a.csv", data, read, fine=True), path, 2, b",")
    rows = np.column_stack([record.time_s, record.data.T])
    text = "t;F [N];1+Z [m/s2];2-Y [m/s2]\n" + "".join(";".join(f"{v:.8f}" for v in row).replace(".", ",") + "\n" for row in rows)
    yield table_seed(Seed("csv semicolons", "a.csv", text.encode(), read, fine=True), path, 1, b";")
    bare = "".join("\t".join(f"{v:.8f}" for v in row) + "\n" for row in rows)
    headerless = lambda p: read(p, units={"columns": ["s", "N", "m/s2", "m/s2"]})  # noqa: E731
    yield table_seed(Seed("headerless text", "a.txt", bare.encode(), headerless, fine=True), path, 0, b"\t")
    lines = "".join(f"{f:.2f} {a:.5f} {b:.3f}\n" for f, a, b in zip(np.arange(1, 15), *rng.normal(size=(2, 14)) * 30, strict=True))
    bode = lambda p: read(p, units={"columns": ["Hz", "dB", "deg"]})  # noqa: E731
    yield table_seed(Seed("headerless frf", "a.txt", lines.encode(), bode, fine=True), path, 0, b" ", time=False)
    frf = replace(small_frf(rng), variance=None)
    data = written(path, lambda p: write_frf_csv(p, frf))
    yield table_seed(Seed("csv frf", "a.csv", data, read, fine=True), path, 2, b",", time=False)
    yield table_seed(Seed("lvm", "a.lvm", lvm_file(record), read, fine=True), path, 16, b"\t")


# --- binary arrays ----------------------------------------------------------------------------------------------------------------


def array_seed(seed: Seed, path: Path, arrays: Iterable[np.ndarray]) -> Seed:
    """Every number of arrays that stand in the file as they are in memory is a part; the rest is structure."""
    cuts: list[Cut] = []
    for array in arrays:
        flat = np.ravel(array, order="K")
        start = seed.data.find(flat.tobytes())
        assert start > 0, seed.name
        for i in range(flat.size):
            at = start + i * flat.itemsize
            stop = at + flat.itemsize
            middle = at + max(0, flat.itemsize - 3)  # the last bits may be rounded away by the unit
            cuts.append((at, stop, seed.data[:middle] + bytes([seed.data[middle] ^ 1]) + seed.data[middle + 1 :]))
    return replace(with_parts(replace(seed, fine=True), cuts, path), fixed=True)


def wav_file(values: np.ndarray, width: int) -> bytes:
    """PCM by the standard library."""
    stream = io.BytesIO()
    with wave.open(stream, "wb") as out:
        out.setnchannels(values.shape[1])
        out.setsampwidth(width)
        out.setframerate(4096)
        out.writeframes(values.tobytes())
    return stream.getvalue()


def float_wav(values: np.ndarray) -> bytes:
    """Floats of 32 bits."""
    body = values.tobytes()
    head = struct.pack("<4sIHHIIHH", b"fmt ", 16, 3, values.shape[1], 4096, 4096 * 4 * values.shape[1], 4 * values.shape[1], 32)
    return b"RIFF" + struct.pack("<I", len(head) + len(body) + 12) + b"WAVE" + head + struct.pack("<4sI", b"data", len(body)) + body


def binaries(path: Path) -> Iterator[Seed]:
    """NumPy, WAV, MATLAB, TDMS, HDF5."""
    rng = np.random.default_rng(18)
    import h5py
    from scipy.io import savemat

    data = rng.normal(size=(16, 2))
    sampled = lambda p: read(p, units={"sampling_hz": RATE})  # noqa: E731

    def saved(save: Callable[..., Any], *values: Any, **named: Any) -> bytes:
        stream = io.BytesIO()
        save(stream, *values, **named)
        return stream.getvalue()

    yield array_seed(Seed("npy", "a.npy", saved(np.save, data), sampled), path, [data])
    named = {"x": data, "fs": RATE, "channel_names": np.array(["12+Z", "Force"]), "units": np.array(["g", "N"])}
    yield Seed("npz", "a.npz", saved(np.savez, **named), read, whole=True)
    yield Seed("npz compressed", "a.npz", saved(np.savez_compressed, **named), read, whole=True)
    short = rng.integers(-(2**15), 2**15, (16, 2)).astype("<i2")
    yield array_seed(Seed("wav 16", "a.wav", wav_file(short, 2), read), path, [short])
    floats = rng.normal(size=(16, 2)).astype("<f4")
    yield array_seed(Seed("wav float", "a.wav", float_wav(floats), read), path, [floats])

    def saved_mat(variables: dict[str, Any], **more: Any) -> bytes:
        return b"MATLAB 5.0 MAT-file".ljust(116) + saved(savemat, variables, **more)[116:]  # without the time of writing

    columns = np.asfortranarray(data)
    texts = {"channel_names": np.array(["12+Z", "Force"], object), "units": np.array(["g", "N"], object)}
    mat = {"x": columns, "fs": RATE, **texts}
    yield array_seed(Seed("mat 5", "a.mat", saved_mat(mat), read), path, [columns])
    yield Seed("mat 5 compressed", "a.mat", saved_mat(mat, do_compression=True), read, whole=True)
    f, h = np.arange(12) * 2.0, rng.normal(size=(2, 12)) + 1j * rng.normal(size=(2, 12))
    pairs = {
        "X1": np.column_stack([np.arange(16) / RATE, data[:, 0]]),
        "H1_2": np.column_stack([f, h[0]]),
        "H1_3": np.column_stack([f, h[1]]),
    }
    pairs |= {"C1_2": np.column_stack([f, np.full(12, 0.9)]), "C1_3": np.column_stack([f, rng.uniform(0.5, 1, 12)])}
    yield array_seed(
        Seed("mat 5 SignalCalc", "a.mat", saved_mat(pairs), read), path, [pairs["X1"][:, 1], h[0].real.copy(), h[1].imag.copy()]
    )

    with h5py.File(path, "w", userblock_size=512) as file:
        file["x"], file["fs"] = data.T, np.array([[RATE]])
        h5py.Dataset(file["x"].id).attrs["MATLAB_class"] = np.bytes_("double")
        complex_type = np.dtype([("real", "<f8"), ("imag", "<f8")])
        table = np.zeros((1, 12), complex_type)
        table["real"], table["imag"] = h[0].real, h[0].imag
        file["H"], file["f"] = table, f[None]
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    yield array_seed(Seed("mat 7.3", "a.mat", path.read_bytes(), read), path, [np.ascontiguousarray(data.T), table])

    record = small_record(rng)
    objects = {"record": record, "frf": small_frf(rng), "model": small_model(rng), "geometry": small_geometry(rng)}
    yield Seed("hdf5", "a.h5", written(path, lambda p: write_hdf5(p, objects)), read, whole=True)
    found = {"verdict": "unexplained", "effects": [], "ladder": [{"step": 0, "added": None, "misfit": 3.25}]}
    results = Results(
        "chain", {"band": [10.0, 90.0]}, idle=small_model(rng), idle_frf=small_frf(rng), geometry=small_geometry(rng), diagnosis=found
    )
    yield Seed("model.h5", "model.h5", written(path, lambda p: save_results(results, p)), load_results, whole=True)
    yield from tdms(path, data)


def tdms(path: Path, data: np.ndarray) -> Iterator[Seed]:
    """LabVIEW's binary files, where npTDMS is there."""
    try:
        import nptdms
    except ImportError:
        return
    with nptdms.TdmsWriter(str(path)) as writer:
        given = zip(("12+Z", "Force"), data.T, ("g", "N"), strict=True)
        properties = {"wf_increment": 1 / 1024, "wf_start_offset": 0.5}
        writer.write_segment(
            [nptdms.ChannelObject("run", name, row, properties=properties | {"unit_string": unit}) for name, row, unit in given]
        )
    yield array_seed(Seed("tdms", "a.tdms", path.read_bytes(), read), path, [data[:, 0], data[:, 1]])


# --- texts ------------------------------------------------------------------------------------------------------------------------

TEST = """name = "pump"
[idle]
records = [{file = "idle.uff", start_s = 0.0, stop_s = 0.05}]
[operating]
records = ["op*.uff"]
[geometry]
units = "m"
[units]
acceleration = "g"
force = "lbf"
[channels]
"ch1" = {dof = "12+Z", quantity = "acceleration", unit = "g", sensitivity = 1.0}
"13+Z" = {exclude = true, reason = "cable"}
[analysis]
band = [5.0, 100.0]
overlap = 0.5
known_harmonics_hz = [25.0, 50.0]
exclude_bands = [[49.0, 51.0]]
threshold = 0.8
[directions]
"5+a" = [0.86, 0.47, -0.15]
"""


def texts(path: Path) -> Iterator[Seed]:
    """The test file and SEP005 as JSON."""
    rng = np.random.default_rng(18)
    for name in ("idle.uff", "operating.uff"):
        write_uff(path.with_name(name), small_record(rng))
    data = TEST.encode()
    ends = [0, *(m.end() for m in re.finditer(rb"\n", data))]
    cuts = [(a, b, data[:a] + data[b:]) for a, b in pairwise(ends)]
    yield with_parts(Seed("test.toml", "test.toml", data, load_test), cuts, path)
    rows = rng.normal(size=(3, 8)).round(6).tolist()
    items = [{"data": row, "fs": RATE, "name": f"{i}+Z", "unit_str": "m/s2"} for i, row in enumerate(rows, start=1)]
    lines = [json.dumps(item) for item in items]
    text = "[\n" + ",\n".join(lines) + "\n]\n"
    cuts = []
    for line in lines:
        start = text.index(line)
        left = "[\n" + ",\n".join(other for other in lines if other != line) + "\n]\n"
        cuts.append((start, start + len(line), left.encode()))
    yield with_parts(Seed("sep005", "a.json", text.encode(), read_sep005), cuts, path)


def read_sep005(path: Path) -> TimeRecord:
    """SEP005 knows no file: here its lists and dicts stand as JSON; what is no JSON is no mutant of it."""

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len(dict(pairs)) < len(pairs):
            raise ValueError("a key stands there twice")
        return dict(pairs)

    try:
        measurement = json.loads(path.read_bytes(), object_pairs_hook=once)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"no JSON: {error}") from None
    return from_sep005(measurement)


# --- all --------------------------------------------------------------------------------------------------------------------------

GROUPS = {"uff": uff_seeds, "tables": tables, "binaries": binaries, "texts": texts}


def all_seeds(folder: Path) -> Iterator[Seed]:
    """Seeds of every reader; files are written into the folder."""
    for group in GROUPS.values():
        yield from group(folder / "seed")

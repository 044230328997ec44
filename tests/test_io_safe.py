"""Files that would do harm: sizes, links and hanging libraries are caught before the file is read."""

from __future__ import annotations

import io
import os
import resource
import signal
import struct
import subprocess
import sys
import time
import zlib

import numpy as np
import pytest

from io_files import SHARED
from operando.data import Channel, TimeRecord
from operando.data.declared import is_of
from operando.dof import Dof
from operando.errors import FormatError, MissingError
from operando.io import read, read_hdf5, write_hdf5
from operando.io.safe import DEFLATE_RATIO, FREE_BYTES, GROWTH, guard, memory_allowed

h5py = pytest.importorskip("h5py")
FAULTS = SHARED / "faults"
needs_faults = pytest.mark.skipif(not FAULTS.is_dir(), reason="the folder of files that did harm is missing beside the project")

HANGS = (1, "makes the reader of HDF5 files fail: no progress within 2 s of computing", "export it again")
ANSWERS = {
    "first_separator_damaged.uff": (0, "6103 bytes from byte 3 on (before the first set) belong to no set", "2+Z", "3+Z"),
    "58b_points_36865.uff": (
        0,
        "declares 36865 points (147460 bytes) and states 147456 bytes, the set holds 147456 bytes",
        "13 × time response",
    ),
    "mode55_indexerror.uff": (0, "set 3 of type 55 (data at nodes) is not understood", "modal model: 10 modes", "set 11 of type 55"),
    "terminal_escape.uff": (0, r"\x1b]0;PWNED\x07\x1b[2J\x1b[31mred", "3 × time response"),
    "dof_100000_digits.csv": (1, "a column name of 100009 characters: 99999999999999999999…", "at most 1000 characters"),
    "memory_13kB_to_3.5GB.h5": (
        1,
        "declares 900000000 values, 3600000000 bytes; the 0 bytes stored are too few",
        "the file is damaged",
    ),
    "memory_2kB_to_3.5GB.mat": (
        1,
        "declares 900000000 values, 3600000000 bytes; the 0 bytes stored are too few",
        "the file is damaged",
    ),
    "h6af48a6ad8.h5": HANGS,
    "h7c35f5d29d.h5": HANGS,
    "hd8278fdc4f.h5": HANGS,
    "reads_etc_passwd.mat": (1, "has its data in another file", "copy them into one file"),
    "wrong_class_attributeerror.h5": (
        1,
        "'channels' of TimeRecord is tuple of other things, expected tuple[Channel, ...]",
        "the file is damaged",
    ),
}
"""Exit status of ``operando inspect`` and what it says, for each row of the table beside the files."""
PYTHON_BYTES = 150 << 20
"""What the interpreter with NumPy, h5py and SciPy takes before it reads anything."""


def record():
    channels = (Channel(Dof(1, "Z"), "force", "N"), Channel(Dof(2, "Z"), "acceleration", "m/s2"))
    return TimeRecord(np.arange(20.0).reshape(2, 10), 100.0, channels)


@needs_faults
def test_every_file_that_did_harm_has_its_answer():
    assert {p.name for p in FAULTS.iterdir()} == {*ANSWERS, "README.md"}


LAUNCHER = """
import os, sys
child = os.fork()
if not child:
    out = os.open(sys.argv[1], os.O_WRONLY | os.O_CREAT, 0o600)
    os.dup2(out, 1), os.dup2(out, 2)
    os.execv(sys.argv[2], sys.argv[2:])
_, ended, usage = os.wait4(child, 0)
print(os.waitstatus_to_exitcode(ended), usage.ru_utime + usage.ru_stime, usage.ru_maxrss)
"""


@needs_faults
@pytest.mark.parametrize("name", ANSWERS)
def test_inspect_answers_files_that_did_harm_in_time_and_memory(name, tmp_path):
    status, *said = ANSWERS[name]
    # Started by a small process: the peak memory of a child counts what it had of its parent before it became the command.
    command = [sys.executable, "-m", "operando", "inspect", str(FAULTS / name)]
    launched = subprocess.run([sys.executable, "-S", "-c", LAUNCHER, str(tmp_path / "said"), *command], capture_output=True, check=True)
    code, seconds, kilobytes = map(float, launched.stdout.split())
    text = (tmp_path / "said").read_text(encoding="utf-8")
    assert code == status, text
    assert [part for part in said if part not in text] == []
    assert "Traceback" not in text
    assert "\x1b" not in text
    assert seconds < 10  # the helper's included; how long it waits for that has a test of its own
    assert kilobytes * 1024 < PYTHON_BYTES + 5 * (FAULTS / name).stat().st_size + (200 << 20)


@needs_faults
def test_a_results_file_that_hangs_the_library_is_refused_by_commands(tmp_path):
    from click.testing import CliRunner

    from operando.cli import main

    (tmp_path / "model.h5").write_bytes((FAULTS / "h6af48a6ad8.h5").read_bytes())
    done = CliRunner().invoke(main, ["report", str(tmp_path)])
    assert done.exit_code == 1
    assert "no progress within" in done.stderr
    assert "fault of the program" not in done.stderr


def mat73(path, fill):
    with h5py.File(path, "w", userblock_size=512) as file:
        fill(file)
    with open(path, "r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return path


def test_hdf5_that_reaches_out_is_refused(tmp_path):
    secret = tmp_path / "secret.txt"
    secret.write_bytes(b"0123456789abcdef" * 8)
    other = tmp_path / "other.h5"
    with h5py.File(other, "w") as file:
        file["x"] = np.arange(50.0)
    layout = h5py.VirtualLayout((50,), "f8")
    layout[:] = h5py.VirtualSource(str(other), "x", (50,))
    cases = {
        "another file": lambda f: f.create_dataset("x", (128,), "u1", external=[(str(secret), 0, 128)]),
        "in another file": lambda f: f.create_virtual_dataset("x", layout),
        "is a link to elsewhere": lambda f: f.__setitem__("x", h5py.ExternalLink(str(other), "x")),
        "is a link to": lambda f: (f.__setitem__("y", np.ones(3)), f.__setitem__("x", h5py.SoftLink("/y"))),
        "linked a second time": lambda f: (f.create_group("g"), f["g"].__setitem__("again", f["g"])),
    }
    for i, (match, fill) in enumerate(cases.items()):
        path = mat73(tmp_path / f"{i}.mat", lambda file, fill=fill: (fill(file), file.__setitem__("fs", 10.0)))
        with pytest.raises(FormatError, match=match):
            read(path)


def test_hdf5_sizes_are_checked_before_memory_is_taken(tmp_path):
    unwritten = mat73(tmp_path / "a.mat", lambda f: f.create_dataset("x", (3, 300_000_000), "f4", chunks=(1, 1_000_000)))
    with pytest.raises(FormatError, match="stored are too few"):
        read(unwritten)
    # zeros compress by more than any measurement: within the limit of deflate, beyond that of memory
    big = (FREE_BYTES + (1 << 20)) // 8
    packed = mat73(
        tmp_path / "b.mat",
        lambda f: f.create_dataset("x", (1, big), "f8", chunks=(1, 1 << 20), compression="gzip", data=np.zeros((1, big))),
    )
    assert big * 8 > GROWTH * packed.stat().st_size + FREE_BYTES
    with pytest.raises(FormatError, match=r"would take .* MB of memory"):
        read(packed)
    # what is compressed as measurements are is read
    noise = np.random.default_rng(0).integers(-2000, 2000, (2, 200_000)) / 1024.0
    good = mat73(
        tmp_path / "c.mat", lambda f: (f.create_dataset("x", data=noise, compression="gzip", shuffle=True), f.__setitem__("fs", 10.0))
    )
    np.testing.assert_array_equal(read(good).records[0].data, noise)


def test_deflate_ratio_is_the_limit_of_zlib():
    """RFC 1951: 258 bytes for two bits; zlib comes near and never beyond."""
    for n in (1 << 16, 1 << 22):
        ratio = n / len(zlib.compress(bytes(n), 9))
        assert ratio < DEFLATE_RATIO
    assert ratio > 0.98 * DEFLATE_RATIO


def test_compressed_matlab_5_is_unpacked_with_a_limit(tmp_path):
    from scipy.io import savemat

    stream = io.BytesIO()
    savemat(stream, {"x": np.zeros(10)})
    head = stream.getvalue()[:128]
    bomb = zlib.compress(struct.pack("<II", 14, 200_000_000) + bytes(200_000_000), 9)
    path = tmp_path / "bomb.mat"
    path.write_bytes(head + struct.pack("<II", 15, len(bomb)) + bomb)
    start = time.perf_counter()
    with pytest.raises(FormatError, match=r"would take .* MB of memory"):
        read(path)
    assert time.perf_counter() - start < 5
    path.write_bytes(head + struct.pack("<II", 15, 400) + bomb[:400])
    with pytest.raises(FormatError, match="cut off"):
        read(path)
    path.write_bytes(head + struct.pack("<II", 14, 400) + b"abc")
    with pytest.raises(FormatError, match="longer than the rest"):
        read(path)


@pytest.fixture
def fresh_helper():
    guard._end()
    yield
    guard._end()


def test_a_library_that_hangs_or_dies_is_survived(tmp_path, monkeypatch, fresh_helper):
    path = tmp_path / "a.h5"
    write_hdf5(path, {"a": record()})
    os.utime(path, ns=(1, 1))  # no longer as this process wrote it
    helper = guard._helper()
    os.kill(helper.process.pid, signal.SIGSTOP)  # as in an endless loop
    monkeypatch.setattr(guard, "TIME_LIMIT_S", 0.2)
    start = time.perf_counter()
    with pytest.raises(FormatError, match=r"no progress within"):
        read(path)
    assert time.perf_counter() - start < 4
    monkeypatch.setattr(guard, "TIME_LIMIT_S", 20.0)
    assert read(path).records[0].data.shape == (2, 10)  # a new helper serves the next file
    assert guard._helper() is not helper
    with pytest.raises(MissingError):
        guard.try_apart(tmp_path / "none.h5", "hdf5")


def test_a_small_file_that_hangs_is_given_up_before_the_command_counts_as_hanging(fresh_helper):
    """``WAITING`` times the computing time; ten seconds without a word count as hanging. ``START_LIMIT_S`` is far above a start."""
    assert guard.WAITING * guard.TIME_LIMIT_S < 10.0
    assert guard.WAITING > 2.0  # a machine with twice as many processes as cores
    start = time.perf_counter()
    guard._helper()
    assert time.perf_counter() - start < 0.5 * guard.START_LIMIT_S


def test_a_helper_that_does_not_start_is_told(monkeypatch, fresh_helper):
    monkeypatch.setattr(guard, "START_LIMIT_S", 1e-3)
    with pytest.raises(MissingError, match="does not start"):
        guard._helper()
    assert not guard._running


@needs_faults
def test_the_helper_ends_itself_if_nobody_waits(fresh_helper):
    """Its own limit of computing time: no process is left that computes for ever."""
    helper = guard._helper()
    assert helper.ask({"kind": "hdf5", "path": str(FAULTS / "h6af48a6ad8.h5"), "limit_s": 0.3}, 30.0) is None
    assert helper.process.returncode == -signal.SIGPROF


def test_a_long_trial_goes_on_while_it_moves(tmp_path, monkeypatch, fresh_helper):
    """Many objects take longer than the limit for one; signs of life come in between."""
    from operando.io.safe import helper

    said, clock = [], iter(np.arange(0.0, 100.0, 0.1).tolist())
    monkeypatch.setattr(helper.time, "monotonic", lambda: next(clock))
    watch = helper._Watch(50.0, said.append)
    for _ in range(30):
        watch.alive()
    watch.end()
    assert 5 <= said.count({"alive": True}) == len(said) <= 15


def test_own_files_and_files_tried_before_are_not_tried_again(tmp_path, monkeypatch):
    path = tmp_path / "a.h5"
    write_hdf5(path, {"a": record()})
    asked = []
    monkeypatch.setattr(guard, "_helper", lambda: asked.append(1) or pytest.fail("asked"))
    path = path.rename(tmp_path / "b.h5")  # a rename changes nothing
    assert read_hdf5(path)["a"].sampling_hz == 100.0
    assert not asked
    os.utime(path, ns=(5, 5))
    with pytest.raises(pytest.fail.Exception):
        read_hdf5(path)


def test_only_hdf5_matlab_and_tdms_start_the_helper(tmp_path, monkeypatch):
    from operando.io import write_csv, write_uff

    monkeypatch.setattr(guard, "_helper", lambda: pytest.fail("asked"))
    write_uff(tmp_path / "a.uff", record())
    write_csv(tmp_path / "a.csv", record())
    np.savez(tmp_path / "a.npz", x=np.arange(40.0).reshape(20, 2), fs=10.0)
    for path in tmp_path.iterdir():
        assert read(path).records


def test_a_description_cannot_name_foreign_code_or_one_array_many_times(tmp_path):
    def write(tree, **arrays):
        with h5py.File(tmp_path / "a.h5", "w") as file:
            group = file.create_group("a")
            group["__tree__"] = tree
            for name, value in arrays.items():
                group[name] = value
        return tmp_path / "a.h5"

    for name in ("operando.__main__:main", "operando.cli.answer:Answer", "os:path", "operando.data.time:", "operando..data:x"):
        with pytest.raises(FormatError, match="no class"):
            read_hdf5(write(f'{{"__class__": "{name}", "fields": {{}}}}'))
    assert "operando.__main__" not in sys.modules
    with pytest.raises(FormatError, match="named twice"):
        read_hdf5(write('[{"__array__": "x"}, {"__array__": "x"}]', x=np.ones(3)))
    with pytest.raises(FormatError, match="not there"):
        read_hdf5(write('{"__array__": "/a/x"}', x=np.ones(3)))


def test_values_of_another_type_than_declared_are_refused_at_reading(tmp_path):
    write_hdf5(tmp_path / "a.h5", {"a": record()})
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        text = file["a/__tree__"].asstr()[()]
        del file["a/__tree__"]
        file["a/__tree__"] = text.replace('"__class__": "operando.data.time:Channel"', '"no_class": ""', 1)
        del file["a"].attrs["blake2b"]
        file.attrs["schema"] = "operando/hdf5/1"  # as older versions wrote it, without hashes
    with pytest.raises(FormatError, match=r"'channels' of TimeRecord .* expected tuple\[Channel"):
        read(tmp_path / "a.h5")


def test_what_was_changed_in_an_own_file_is_refused(tmp_path):
    """HDF5 does not notice a changed byte; the hashes of the file do."""
    objects = {"a": record(), "b": record()}
    path = tmp_path / "a.h5"

    def changed(change):
        write_hdf5(path, objects)
        with h5py.File(path, "r+") as file:
            change(file)
        with pytest.raises(FormatError) as caught:
            read_hdf5(path)
        return f"{caught.value.message} ({caught.value.hint})"

    assert "'data' is not what was written" in changed(lambda file: file["a/data"].__setitem__((0, 3), 3.5))
    assert "description of '/b' is not what was written" in changed(lambda file: file["b"].attrs.__setitem__("blake2b", "00"))
    assert "description of '/b' is not what was written" in changed(lambda file: file["b"].attrs.__delitem__("blake2b"))
    assert "object 'b' that the file lists is not in it" in changed(lambda file: file.__delitem__("b"))
    assert "'operando/hdf5/9' is not known (known are" in changed(lambda file: file.attrs.__setitem__("schema", "operando/hdf5/9"))
    assert "object 'b' that the file lists is not in it" in changed(lambda file: file["b"].__delitem__("__tree__"))
    assert "lists no objects" in changed(lambda file: file.attrs.__delitem__("objects"))


def test_numbers_that_lie_plainly_in_the_file_are_not_read_on_trial(tmp_path, monkeypatch):
    from operando.io.safe import hdf5_file

    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["plain"], file["texts"] = np.arange(100.0), np.array(["a", "b"], dtype=object)
        file.create_dataset("packed", data=np.arange(100.0), compression="gzip", chunks=(50,))
        file.create_dataset("missing", (100,), "f8")
    with h5py.File(tmp_path / "a.h5") as file:
        plain = {name: hdf5_file._lies_plainly(item, tmp_path / "a.h5") for name, item in file.items()}
        assert plain == {"plain": True, "texts": False, "packed": False, "missing": False}
        end = file["plain"].id.get_offset() + 800
    raw = (tmp_path / "a.h5").read_bytes()
    with h5py.File(tmp_path / "a.h5") as file:
        (tmp_path / "cut").write_bytes(raw[: end - 8])
        with pytest.raises(FormatError, match="beyond the end"):
            hdf5_file._lies_plainly(file["plain"], tmp_path / "cut")


def test_a_file_that_hangs_is_given_up_before_ten_seconds():
    """The waiting time of a small file; starting the helper takes its second besides."""
    assert guard.WAITING * guard.TIME_LIMIT_S + 1 < 10
    assert guard.TIME_LIMIT_S > 1000 * 0.0005  # an object takes half a millisecond
    # a large file may come from a network drive
    assert 1e9 / guard.SLOWEST_BYTES_PER_S == 50


def test_types_of_fields():
    assert is_of(1, float)
    assert is_of(None, float | None)
    assert is_of((1, "a"), tuple[int, str])
    assert is_of({"a": [1.0]}, dict[str, list[float]])
    assert not is_of(True, float)
    assert not is_of("a", tuple[str, ...])
    assert not is_of((1,), tuple[int, int])
    assert not is_of([1.0], np.ndarray)
    assert not is_of({1: 2}, dict[str, int])


def test_memory_of_the_trial_stays_below_what_a_small_file_may_take():
    assert memory_allowed(0) <= 200 << 20
    assert resource.getrlimit(resource.RLIMIT_AS)  # the system can hold a process to it


def test_source_uses_neither_eval_nor_pickle():
    """No file can bring code with it: nothing in the package evaluates text or unpickles, but what a process of its own has written."""
    import ast
    from pathlib import Path

    import operando

    bad_calls = {"eval", "exec", "compile", "__import__"}
    own = {("processes.py", "pickle")}  # results of forked processes, in files without a name
    bad_modules = {"pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve", "joblib"}
    found = []
    for path in Path(operando.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name.split(".")[0] for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [(node.module or "").split(".")[0]]
            elif isinstance(node, ast.Call):
                if isinstance(node.func, ast.Name) and node.func.id in bad_calls:
                    found.append(f"{path.name}:{node.lineno} {node.func.id}")
                for word in node.keywords:
                    allowed = isinstance(word.value, ast.Constant) and word.value.value is False
                    if (word.arg == "allow_pickle" and not allowed) or (word.arg == "shell" and not allowed):
                        found.append(f"{path.name}:{node.lineno} {word.arg}")
                if ast.unparse(node.func) in ("np.load", "numpy.load") and not any(w.arg == "allow_pickle" for w in node.keywords):
                    found.append(f"{path.name}:{node.lineno} np.load without allow_pickle=False")
            found += [f"{path.name}:{node.lineno} {name}" for name in names if name in bad_modules and (path.name, name) not in own]
    assert not found

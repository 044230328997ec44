"""Reading and writing of UFF 58b: time against a raw read of the same bytes and against pyuff, and peak memory.

Run: python benchmarks/read_uff.py [--channels 64] [--samples 1000000] [--repeat 5]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import numpy as np

from operando.data import Channel, TimeRecord
from operando.dof import Dof
from operando.io import read, write_uff


def make_record(channels: int, samples: int) -> TimeRecord:
    rng = np.random.default_rng(0)
    data = rng.standard_normal((channels, samples))
    return TimeRecord(data, 51200.0, tuple(Channel(Dof(i + 1, "Z"), "acceleration", "m/s2", f"a{i + 1}") for i in range(channels)))


def raw_read(path: Path) -> float:
    """Read the bytes into one fresh buffer of their size, as any reader must at least."""
    start = time.perf_counter()
    buffer = np.empty(path.stat().st_size, np.uint8)
    with open(path, "rb") as stream:
        stream.readinto(buffer.data)
    return time.perf_counter() - start


def own_read(path: Path) -> float:
    start = time.perf_counter()
    content = read(path)
    took = time.perf_counter() - start
    assert content.records[0].data.shape[0] > 0
    return took


def pyuff_read(path: Path) -> float:
    import pyuff

    start = time.perf_counter()
    sets = pyuff.UFF(str(path)).read_sets()
    took = time.perf_counter() - start
    assert sets
    return took


def pyuff_write(path: Path, record: TimeRecord) -> float:
    import pyuff

    axis = {"spec_data_type": 0, "len_unit_exp": 0, "force_unit_exp": 0, "temp_unit_exp": 0, "axis_lab": "NONE", "axis_units_lab": "NONE"}
    axes = {f"{name}_{key}": value for name in ("abscissa", "ordinate", "orddenom") for key, value in axis.items()}
    axes |= {f"z_axis_{key}": value for key, value in axis.items()}
    names = {"rsp_ent_name": "NONE", "ref_ent_name": "NONE", "id1": "a", "id2": "NONE", "id3": "NONE", "id4": "NONE", "id5": "NONE"}
    numbers = {"func_id": 1, "ver_num": 0, "load_case_id": 0, "rsp_dir": 3, "ref_node": 0, "ref_dir": 0, "z_axis_value": 0.0}
    even = {"abscissa_spacing": 1, "abscissa_min": 0.0, "abscissa_inc": 1 / record.sampling_hz, "num_pts": record.n_samples}
    sets = [
        {"type": 58, "binary": 1, "func_type": 1, "rsp_node": i + 1, "ord_data_type": 4, "data": row, "x": record.time_s}
        | axes | names | numbers | even
        for i, row in enumerate(record.data)
    ]  # fmt: skip
    start = time.perf_counter()
    pyuff.UFF(str(path)).write_sets(sets, "add")
    return time.perf_counter() - start


def peak_memory(code: str) -> float:
    """Peak resident memory [MB] of a fresh interpreter that runs the code."""
    # VmHWM starts anew with the program, ru_maxrss does not.
    script = code + "\nprint(next(l.split()[1] for l in open('/proc/self/status') if l.startswith('VmHWM')))"
    out = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return float(out.stdout.split()[-1]) * 1024 / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--channels", type=int, default=64)
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--repeat", type=int, default=5)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "big.uff"
        record = make_record(args.channels, args.samples)
        writes, raw_writes = [], []
        for _ in range(3):
            start = time.perf_counter()
            with open(Path(folder) / "raw.bin", "wb") as stream:
                stream.write(record.data.data)
            raw_writes.append(time.perf_counter() - start)
            start = time.perf_counter()
            write_uff(path, record)
            writes.append(time.perf_counter() - start)
        megabytes = path.stat().st_size / 1e6
        assert np.array_equal(read(path).records[0].data, record.data)
        del record
        raw, own = [], []
        for _ in range(args.repeat + 1):  # in turn, so that a busy machine meets both; the first pass warms the cache
            raw.append(raw_read(path))
            own.append(own_read(path))
        base = peak_memory("import numpy, operando.io")
        peak = peak_memory(f"from operando.io import read; c = read({str(path)!r})")
        print(f"58b double, {args.channels} channels x {args.samples} samples, {megabytes:.0f} MB, median of {args.repeat}")
        print(f"{'raw read':28s} {median(raw[1:]):8.3f} s")
        print(f"{'operando read':28s} {median(own[1:]):8.3f} s   {median(own[1:]) / median(raw[1:]):.2f} x raw (goal <= 3)")
        print(f"{'raw write':28s} {median(raw_writes):8.3f} s")
        print(f"{'operando write':28s} {median(writes):8.3f} s   {median(writes) / median(raw_writes):.2f} x raw")
        print(f"{'peak memory of reading':28s} {peak - base:8.0f} MB  {(peak - base) / megabytes:.2f} x the file")

        small = make_record(8, 100_000)
        mine, theirs = Path(folder) / "small.uff", Path(folder) / "pyuff.uff"
        start = time.perf_counter()
        write_uff(mine, small)
        write_own = time.perf_counter() - start
        write_pyuff = pyuff_write(theirs, small)
        read_own = median(own_read(mine) for _ in range(5))
        read_pyuff = median(pyuff_read(mine) for _ in range(3))
        base_pyuff = peak_memory("import pyuff, operando.io")
        peak_pyuff = peak_memory(f"import pyuff, operando.io; s = pyuff.UFF({str(mine)!r}).read_sets()")
        peak_own = peak_memory(f"import pyuff, operando.io; c = operando.io.read({str(mine)!r})")
        size = mine.stat().st_size / 1e6
        print(f"\n8 channels x 100000 samples, {size:.1f} MB")
        print(f"{'':12s}{'operando':>12s}{'pyuff':>12s}{'ratio':>10s}")
        print(f"{'read [s]':12s}{read_own:12.4f}{read_pyuff:12.4f}{read_pyuff / read_own:9.0f}x")
        print(f"{'write [s]':12s}{write_own:12.4f}{write_pyuff:12.4f}{write_pyuff / write_own:9.0f}x")
        print(f"{'peak [MB]':12s}{peak_own - base_pyuff:12.1f}{peak_pyuff - base_pyuff:12.1f}")

        many = TimeRecord(np.zeros((2000, 64)), 512.0, tuple(Channel(Dof(i + 1, "Z"), "acceleration", "m/s2") for i in range(2000)))
        times = {}
        for n in (500, 1000, 2000):
            part = many.select(range(n))
            start = time.perf_counter()
            write_uff(mine, part)
            middle = time.perf_counter()
            read(mine)
            times[n] = (middle - start, time.perf_counter() - middle)
        print("\nsets      write [s]   read [s]   (linear in the number of sets)")
        for n, (w, r) in times.items():
            print(f"{n:6d} {w:12.3f} {r:10.3f}")


if __name__ == "__main__":
    main()

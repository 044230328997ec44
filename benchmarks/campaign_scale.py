"""What docs/scale.md extrapolates from: the driver's share of a thousand tests, and the cost of one test of 64 channels.

    python benchmarks/campaign_scale.py driver FOLDER [--tests 1000] [--scheduler]   # --scheduler: a Dask cluster here
    python benchmarks/campaign_scale.py test FOLDER                                  # one whole test of 64 channels

The thousand tests are as small as tests can be (four channels, looked at and no more), so that what the driver and the scheduler do shows.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "tests")]
RATE_HZ = 512.0
ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
ENVIRONMENT["PYTHONPATH"] = os.pathsep.join(p for p in (str(ROOT / "src"), os.environ.get("PYTHONPATH", "")) if p)


def cpu_s(process: int) -> float:
    """Processor seconds of a process so far."""
    with suppress(OSError, IndexError):
        fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return 0.0


def resident_mb(process: int) -> float:
    with suppress(OSError, IndexError):
        return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    return 0.0


def thousand(folder: Path, count: int) -> Path:
    """Test files that share few records, so that making them is no work; each is read and hashed all the same."""
    from measurements import idle_chain, record
    from operando.io import write_uff

    (folder / "data").mkdir(parents=True, exist_ok=True)
    for k in range(10):
        if not (folder / f"data/{k}.uff").exists():
            write_uff(folder / f"data/{k}.uff", record(idle_chain(), [0], 5.0, k, "idle", seconds=4.0))
    rows = "\n".join(f"{i},{i % 10}" for i in range(count))
    (folder / "runs.csv").write_text(f"number,file\n{rows}\n")
    (folder / "test.toml").write_text('[operating]\nrecords = ["data/{file}.uff"]  # {number}\n')
    (folder / "campaign.toml").write_text('template = "test.toml"\ntable = "runs.csv"\nuntil = "inspect"\n')
    return folder / "campaign.toml"


def driver(folder: Path, count: int, dask: bool) -> dict:
    """Processor seconds and memory of the driver (and of a Dask scheduler) while tests run."""
    campaign, out = thousand(folder, count), folder / "out"
    shutil.rmtree(out, ignore_errors=True)
    more, others = ["-p", "1"], []
    if dask:
        address = folder / "scheduler.json"
        address.unlink(missing_ok=True)
        start = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", str(address)]
        quiet = {"env": ENVIRONMENT, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        others.append(subprocess.Popen(start, **quiet))
        while not address.exists() or not address.read_text().strip():
            time.sleep(0.1)
        uri = json.loads(address.read_text())["address"]
        worker = [sys.executable, "-m", "distributed.cli.dask_worker", uri, "--nthreads", "1", "--no-dashboard", "--no-nanny"]
        others.append(subprocess.Popen(worker, **quiet))
        more = ["--scheduler", uri]
    command = [sys.executable, "-m", "operando", "campaign", str(campaign), "-o", str(out), *more, "--json"]
    run = subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    marks: dict[int, dict] = {}
    seen, start_wall = 0, time.perf_counter()
    assert run.stderr is not None
    assert run.stdout is not None
    for line in run.stderr:
        seen += ": done in" in line
        if ": done in" in line and seen in (1, count // 10, count // 4, count // 2, count):
            marks[seen] = {"wall_s": time.perf_counter() - start_wall, "driver_s": cpu_s(run.pid), "driver_mb": resident_mb(run.pid)}
            if dask:
                marks[seen] |= {"scheduler_s": cpu_s(others[0].pid), "scheduler_mb": resident_mb(others[0].pid)}
        if line.rstrip().endswith("table and report …"):
            break
    before = resident_mb(run.pid)
    begin = run.stdout.read(1)  # the rest of the document is larger than the pipe: the driver waits
    peak, report = resident_mb(run.pid), cpu_s(run.pid)
    document = json.loads(begin + run.stdout.read())
    run.wait()
    for process in others:
        process.terminate()
        process.wait()
    first, last = marks[1], marks[count]
    again = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([*command[: -len(more) - 1], "-p", "1", "--json"], env=ENVIRONMENT, capture_output=True, check=True)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "tests": count, "done": document["counts"]["done"], "at": marks,
        "driver_s_per_test": (last["driver_s"] - first["driver_s"]) / (count - 1),
        "scheduler_s_per_test": (last["scheduler_s"] - first["scheduler_s"]) / (count - 1) if dask else None,
        "report_s": report - last["driver_s"], "driver_mb_before_report": before, "driver_mb_at_end": peak,
        "resumed_with_nothing_to_do_s": used.ru_utime + used.ru_stime - again.ru_utime - again.ru_stime,
        "campaign_json_mb": (out / "campaign.json").stat().st_size / 1e6,
    }  # fmt: skip


def simulated(chain, driven: list[int], seconds: float, seed: int, name: str, known: bool):
    """Record of 64 accelerations, and of the forces where they are known; by modes, since all pairs of DOFs would fill the memory."""
    from operando.data import Channel, TimeRecord
    from operando.dof import Dof

    rng, samples = np.random.default_rng(seed), int(seconds * RATE_HZ)
    lines = np.arange(samples + 1) * RATE_HZ / (2 * samples)
    forces = 5.0 * np.fft.rfft(rng.normal(size=(len(driven), 2 * samples)), axis=1)
    forces[:, lines > 0.42 * RATE_HZ] = 0
    omega, own = 2 * np.pi * lines, 2 * np.pi * chain.hz[:, None]
    gain = -(omega**2) / (own**2 - omega**2 + 2j * chain.zeta[:, None] * own * omega)
    motion = chain.phi @ (gain * (chain.phi[driven].T @ forces))
    middle = slice(samples // 2, samples // 2 + samples)
    data = np.fft.irfft(motion, 2 * samples, axis=1)[:, middle]
    data += 0.005 * data.std(axis=1, keepdims=True) * rng.normal(size=data.shape)
    channels = [Channel(Dof(i + 1, "Z"), "acceleration", "m/s2", f"acc{i + 1}") for i in range(len(data))]
    if known:
        data = np.vstack([np.fft.irfft(forces, 2 * samples, axis=1)[:, middle], data])
        channels = [*(Channel(Dof(i + 1, "Z"), "force", "N", f"force{i + 1}") for i in driven), *channels]
    return TimeRecord(data, RATE_HZ, tuple(channels), name=name)


def one_test(folder: Path) -> dict:
    """A test of 64 channels: two shaker runs at rest of 60 s, 120 s in operation, a validation run of 60 s, at 512 Hz, to the report."""
    from scipy.linalg import eigh

    from operando.io import write_uff
    from structures import Chain

    idle, running = (Chain(n=64, mass=2.0, stiffness=1.2e7, zeta=0.01, seed=3) for _ in range(2))
    running.K = running.K + np.diag([5e6 if i == 20 else 0.0 for i in range(64)])
    w2, running.phi = eigh(running.K, running.M)
    running.hz = np.sqrt(w2) / 2 / np.pi
    top = float(idle.hz[9] + idle.hz[10]) / 2
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    write_uff(folder / "idle1.uff", simulated(idle, [5], 60, 1, "idle1", True))
    write_uff(folder / "idle2.uff", simulated(idle, [40], 60, 2, "idle2", True))
    write_uff(folder / "running.uff", simulated(running, list(range(64)), 120, 3, "running", False))
    write_uff(folder / "check.uff", simulated(running, [5], 60, 4, "check", True))
    text = '[idle]\nrecords = ["idle*.uff"]\n[operating]\nrecords = ["running.uff"]\n[check]\nrecords = ["check.uff"]\n'
    (folder / "test.toml").write_text(text + f"[analysis]\nband = [{0.5 * float(idle.hz[0]):.2f}, {top:.2f}]\n")
    bytes_in = sum(f.stat().st_size for f in folder.glob("*.uff"))
    command = [sys.executable, "-m", "operando", "run", str(folder / "test.toml"), "-o", str(folder / "out"), "--json"]
    wall = time.perf_counter()
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    document = json.loads(done.stdout)
    files = [f for f in (folder / "out").rglob("*") if f.is_file()]
    kept = {f.name: f.stat().st_size / 1e6 for f in files if ".stages" not in f.parts}
    stages = sum(f.stat().st_size for f in files if ".stages" in f.parts) / 1e6
    return {
        "wall_s": time.perf_counter() - wall,
        "cpu_s": used.ru_utime + used.ru_stime,
        "peak_mb": used.ru_maxrss / 1e3,
        "mb_in": bytes_in / 1e6,
        "mb_results": sum(kept.values()),
        "mb_stages": stages,
        "files_mb": kept,
        "stages_s": document.get("timings_s"),
        "verdict": document.get("verdict"),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("driver", "test"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--tests", type=int, default=1000)
    parser.add_argument("--scheduler", action="store_true", help="on Dask")
    given = parser.parse_args()
    found = driver(given.folder, given.tests, given.scheduler) if given.what == "driver" else one_test(given.folder)
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()

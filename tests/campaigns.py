"""Small campaigns on files: the chain of ``measurements`` at several speeds, at which a spring to ground appears."""

from __future__ import annotations

import copy
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

import operando
from measurements import idle_chain, record

SPEEDS = (600, 900, 1200)


def stiffened(stiffness, at=2):
    """The chain with a spring to ground at one mass."""
    from scipy.linalg import eigh

    chain = copy.copy(idle_chain())
    chain.K = chain.K + np.diag([stiffness if i == at else 0.0 for i in range(4)])
    w2, chain.phi = eigh(chain.K, chain.M)
    chain.hz = np.sqrt(w2) / 2 / np.pi
    return chain


def write_campaign(folder, speeds=SPEEDS, *, springs=None, seconds=8.0, until="ema", extra="", shared_idle=False):
    """One folder a speed with records at rest; returns ``campaign.toml``. With ``shared_idle``, a template over one measurement at rest."""
    from operando.io import write_uff

    springs = springs or [3e3 * i for i in range(len(speeds))]
    text = ['name = "chain"', f'until = "{until}"', 'units = {speed = "rpm"}', extra]
    for i, (speed, spring) in enumerate(zip(speeds, springs, strict=True)):
        here = folder / "runs" / str(speed)
        here.mkdir(parents=True)
        write_uff(here / "idle.uff", record(stiffened(spring), [0], 5.0, 10 + i, "idle", seconds=seconds))
        operating = record(stiffened(spring), range(4), 5.0, 50 + i, "run", force_known=False, seconds=4 * seconds)
        write_uff(here / "operating.uff", operating)
        body = '[idle]\nrecords = ["idle.uff"]\n[analysis]\nband = [10.0, 90.0]\n'
        (here / "test.toml").write_text(body, encoding="utf-8")
    if shared_idle:
        body = f'[idle]\nrecords = ["runs/{speeds[0]}/idle.uff"]\n[operating]\nrecords = ["runs/{{speed}}/operating.uff"]\n'
        (folder / "template.toml").write_text(body + "[analysis]\nband = [10.0, 90.0]\n", encoding="utf-8")
        text += ['template = "template.toml"', "rows = [" + ", ".join(f"{{speed = {s}}}" for s in speeds) + "]"]
    else:
        text.append('tests = ["runs/{speed}/test.toml"]')
    (folder / "campaign.toml").write_text("\n".join(text) + "\n", encoding="utf-8")
    return folder / "campaign.toml"


def environment():
    """What a child process needs to find this package, with one thread."""
    paths = [str(Path(operando.__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")]
    return os.environ | {"PYTHONPATH": os.pathsep.join(p for p in paths if p), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def started(*arguments):
    """The command line in a process and a session of its own."""
    # a process in the background of a shell is started with Ctrl-C ignored
    start = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from operando.__main__ import main; main()"
    command = [sys.executable, "-c", start, "campaign", *map(str, arguments)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, env=environment(), start_new_session=True, **pipes)


def waited(condition, what, limit_s=120.0):
    """What a condition gives once it gives something."""
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        if (found := condition()) is not None:
            return found
        time.sleep(0.01)
    raise AssertionError(f"waited {limit_s} s for {what}")


def records_of(out):
    """Name → record of the tests that ended, and when each was written."""
    files = (out / ".stages" / "records").glob("*.json")
    return {f.stem: (json.loads(f.read_text()), f.stat().st_mtime_ns) for f in files}


def holder(out, name):
    """The process at work in a test's folder, or None."""
    try:
        found = json.loads((out / "tests" / name / ".stages" / "lock").read_text())
    except (OSError, ValueError):
        return None
    return int(found["process"])

"""A small test on files: a chain of masses at rest and in operation, written as UFF. The records come from ``structures``."""

from __future__ import annotations

import copy

import numpy as np

from structures import Chain

FS = 256.0
SECONDS = 24.0


def idle_chain():
    return Chain(n=4, mass=2.0, stiffness=1.2e5, zeta=0.01, seed=3)


def running_chain():
    """The chain with a spring to ground at the third mass."""
    chain = copy.copy(idle_chain())
    chain.K = chain.K + np.diag([0.0, 0.0, 3e4, 0.0])
    from scipy.linalg import eigh

    w2, chain.phi = eigh(chain.K, chain.M)
    chain.hz = np.sqrt(w2) / 2 / np.pi
    return chain


def record(chain, driven, level, seed, name, *, force_known=True, noise=0.005, seconds=SECONDS):
    """Record of random forces at the driven masses; accelerations in m/s² at nodes 1 … n, +Z."""
    from operando.data import Channel, TimeRecord
    from operando.dof import Dof

    rng = np.random.default_rng(seed)
    n, samples = len(chain.hz), int(seconds * FS)
    # exact steady state of a period twice as long, cut: the record begins and ends while the structure moves
    spectrum = np.zeros((n, samples + 1), complex)
    lines = np.arange(2 * samples // 2 + 1) * FS / (2 * samples)
    spectrum[list(driven)] = np.fft.rfft(rng.normal(size=(len(driven), 2 * samples)), axis=1) * level
    spectrum[:, lines > 0.42 * FS] = 0
    force = np.fft.irfft(spectrum, 2 * samples, axis=1)[:, samples // 2 : samples // 2 + samples]
    motion = np.einsum("ijl,jl->il", chain.accelerance(lines), spectrum)
    acc = np.fft.irfft(motion, 2 * samples, axis=1)[:, samples // 2 : samples // 2 + samples]
    acc = acc + noise * acc.std(axis=1, keepdims=True) * rng.normal(size=acc.shape)
    channels = [Channel(Dof(i + 1, "Z"), "acceleration", "m/s2", f"acc{i + 1}") for i in range(n)]
    data = acc
    if force_known:
        channels = [Channel(Dof(i + 1, "Z"), "force", "N", f"force{i + 1}") for i in driven] + channels
        data = np.vstack([force[list(driven)], acc])
    return TimeRecord(data, FS, tuple(channels), name=name)


def write_test(folder, *, check=True, operating=True, idle=True, extra=""):
    """Write the files and ``test.toml``; returns its path."""
    from operando.data import Geometry
    from operando.io import write_uff

    text = ['name = "chain"']
    if idle:
        (folder / "idle").mkdir(parents=True)
        write_uff(folder / "idle/run1.uff", record(idle_chain(), [0], 5.0, 1, "run1"))
        write_uff(folder / "idle/run2.uff", record(idle_chain(), [2], 5.0, 2, "run2"))
        text += ["[idle]", 'records = ["idle/*.uff"]']
    if operating:
        (folder / "operating").mkdir(parents=True)
        operating_record = record(running_chain(), range(4), 5.0, 3, "run", force_known=False, seconds=6 * SECONDS)
        write_uff(folder / "operating/run1.uff", operating_record)
        text += ["[operating]", 'records = ["operating/*.uff"]']
    if check:
        (folder / "check").mkdir(parents=True)
        write_uff(folder / "check/run1a.uff", record(running_chain(), [0], 8.0, 4, "run1a"))
        write_uff(folder / "check/run1b.uff", record(running_chain(), [0], 2.0, 5, "run1b"))
        text += ["[check]", 'records = ["check/*.uff"]']
    write_uff(folder / "geometry.uff", Geometry((1, 2, 3, 4), np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]), ((1, 2, 3, 4),)))
    text += ["[geometry]", 'file = "geometry.uff"', "[analysis]", "band = [10.0, 90.0]", extra]
    (folder / "test.toml").write_text("\n".join(text) + "\n", encoding="utf-8")
    return folder / "test.toml"

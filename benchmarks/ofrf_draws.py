"""Draws for ``ofrf_bands.py``: raw records at rest and in operation, identified as the pipeline does it, and the exact OFRFs.

A set-up at rest is measured and identified once and serves several running states, each with a hidden effect, forces and noise of its own.
"""

from __future__ import annotations

import functools
import json
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
for _folder in ("hidden_effects", "paper"):
    sys.path.append(str(HERE / _folder))

import generate  # noqa: E402
import recordings  # noqa: E402
from exact import EPSILON  # noqa: E402
from hidden import idle  # noqa: E402
from raw import BANDS  # noqa: E402
from records import Logger, forced_run, operating_run  # noqa: E402
from tripod import DOFS, exact_modes  # noqa: E402

from operando.data import Frf, ModalModel  # noqa: E402
from operando.ema import fit_ema  # noqa: E402
from operando.frf import check_frf, estimate_frf  # noqa: E402
from operando.io import read  # noqa: E402
from operando.oma import fit_oma  # noqa: E402
from operando.results import Results  # noqa: E402
from operando.store import load_results, save_results  # noqa: E402

KINDS = (
    "ground_spring", "point_mass", "coupling_spring", "ground_damper", "tuned_absorber", "global_stiffness", "ground_rubber",
    "coupling_damper", "ground_hysteretic_spring", "global_damping", "none", "two", "gyroscopic", "unmeasured",
)  # fmt: skip
SKEW = ("gyroscopic", "circulatory")
"""Effects that no symmetric sum of modes can hold: drawn and told apart."""

REPEATED = ("frame-point_mass-{}-r2-hammer", "rotor-ground_spring-{}-r2-shaker")
"""Cases drawn again and again with new forces and noise at rest and in operation, for the scatter."""

STATES, PAPER_STATES = 6, 8
"""Running states of one set-up at rest."""

NOISE = 0.005
"""Of the paper's structure, over the rms of each channel."""

generate.draw = functools.lru_cache(4)(generate.draw)


@dataclass(frozen=True)
class Draw:
    """One running state: the models identified, and what is exact.

    Parameters
    ----------
    name : str
    idle, operating : ModalModel
    threshold : float
        ε.
    lines : (n,) array [Hz]
    exact : (n_dofs, n_dofs or n_references, n) array
    dofs, references : list of str
    effects : list of str
        Kinds hidden.
    """

    name: str
    idle: ModalModel
    operating: ModalModel
    threshold: float
    lines: np.ndarray
    exact: np.ndarray
    dofs: list[str]
    references: list[str]
    effects: list[str]


def groups(first_seed: int, blocks: int) -> Iterator[list[str]]:
    """Names of the draws that share a set-up at rest, in the order they are made."""
    count = 0
    for block in range(blocks):
        for family in ("frame", "rotor"):
            seed = first_seed + count
            excitation, references = ("shaker", "hammer")[count // 2 % 2], 1 + count % 3
            kinds = [KINDS[(STATES * count + k) % len(KINDS)] for k in range(STATES)]
            yield [f"{family}-{kind}-{seed}-r{references}-{excitation}" for kind in kinds]
            count += 1
        yield [REPEATED[block % 2].format(first_seed) + f"@{block // 2}"]
        if block % 2 == 0:
            yield [f"paper-{1 + k % 2}-{first_seed + block // 2}@{k // 2}" for k in range(PAPER_STATES)]


def identify(folder: Path, band: tuple[float, float]) -> ModalModel:
    """Idle modes of the raw records in a folder, as the pipeline finds them."""
    records = [record for path in sorted(folder.glob("*.uff")) for record in read(path).records]
    frf = check_frf(estimate_frf(records))
    used = {path for path, _ in frf.provenance.inputs}
    return fit_ema(frf, band=band, records=[r for r in records if any(p in used for p, _ in r.provenance.inputs)] or records)


def draw_group(names: list[str], folder: Path) -> Iterator[Draw]:
    """Models of the draws of a group, from raw files written under ``folder``; models kept there are used again."""
    yield from (_paper if names[0].startswith("paper") else _hidden)(names, folder)


def _kept(folder: Path, name: str, make: Any) -> Any:
    """Idle and operational models by name, identified where they are not kept."""
    path = folder / "models" / f"{name}.h5"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        at_rest, running = make()
        save_results(Results(name, idle=at_rest, operating=running), path)
    found = load_results(path, only=("idle", "operating"))
    return found.idle, found.operating


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def _running(path: Path, content: bytes, band: tuple[float, float]) -> ModalModel:
    _write(path, content)
    return fit_oma(list(read(path).records), band=band)


def _hidden(names: list[str], folder: Path) -> Iterator[Draw]:
    where = folder / "raw"
    rest: ModalModel | None = None
    for name in names:
        spec, repeat = generate.parse(name.partition("@")[0]), int(name.partition("@")[2] or 0)
        known = generate.truth(spec)
        sensed = known.state.gain or known.state.delay or known.state.swap is not None or known.state.check_system is not None
        if sensed or known.state.force_gain or known.state.force_delay:
            continue  # a fault of a channel changes what is measured, not the structure
        numbers = [spec.seed, len(spec.family), generate.KINDS.index(spec.kind), spec.references, spec.excitation == "hammer", 4711, repeat]
        rng = np.random.default_rng(numbers)
        logger = Logger(known.structure, rng, ("m/s^2", "N"))

        def make(known: Any = known, logger: Any = logger, spec: Any = spec) -> tuple[ModalModel, ModalModel]:
            nonlocal rest
            if rest is None:
                seconds = 48 if spec.excitation == "hammer" else 40
                for i, reference in enumerate(known.references, start=1):
                    run = forced_run(logger, idle(known.structure), reference, spec.excitation, seconds, generate.FORCE_RMS, f"at rest {i}")
                    _write(where / "idle" / f"run{i}.uff", run)
                rest = identify(where / "idle", known.band)
            return rest, _running(where / "operating.uff", operating_run(logger, known.state, 140, known.orders), known.band)

        try:
            at_rest, running = _kept(folder, name, make)
        finally:
            shutil.rmtree(where, ignore_errors=True)
        rest = at_rest
        lines, rows = np.linspace(*known.band, 400), known.state.rows
        exact = known.state.system.accelerance(lines, rows, rows)
        sensors = [s.name for s in known.structure.sensors]
        yield Draw(
            name, at_rest, running, 0.7, lines, exact, sensors, [sensors[r] for r in known.references],
            [effect["kind"] for effect in known.state.effects],
        )  # fmt: skip


def _paper(names: list[str], folder: Path) -> Iterator[Draw]:
    where, corners = folder / "raw", [f"{c}+Z" for c in recordings.CORNERS]
    original = exact_modes("original", folder / "modes")
    rest: ModalModel | None = None
    for name in names:
        label, _, repeat = name.partition("@")
        _, number, seed = label.split("-")
        case, band = f"case {number}", list(BANDS.values())[int(seed) % 2]
        target = exact_modes(case, folder / "modes")
        start = 1000 * int(seed)

        def make(band: Any = band, target: Any = target, start: int = start, other: int = 10 * int(number) + int(repeat)) -> Any:
            nonlocal rest
            if rest is None:
                for i, corner in enumerate(recordings.CORNERS):
                    _write(where / "idle" / f"hammer{corner}.uff", recordings.hammer_record(original, corner, NOISE, start + i))
                rest = identify(where / "idle", band)
            return rest, _running(where / "operating.uff", recordings.operating_record(target, NOISE, start + 100 + other), band)

        try:
            at_rest, running = _kept(folder, name, make)
        finally:
            shutil.rmtree(where, ignore_errors=True)
        rest = at_rest
        lines = np.linspace(*band, 400)
        exact = recordings.frf(target, lines, [DOFS.index(c) for c in corners])
        yield Draw(name, at_rest, running, EPSILON[case], lines, exact, list(DOFS), corners, [case])


def stored(results: Path, answers: Path) -> Draw:
    """A results folder of a hidden-effect case and its answers."""
    found = load_results(results / "model.h5", only=("idle", "operating"))
    answer = json.loads(answers.with_suffix(".json").read_text())
    with np.load(answers.with_suffix(".npz")) as kept:
        lines, exact, dofs = kept["f"], kept["H"].astype(complex), [str(d) for d in kept["dofs"]]
    kinds = [effect["kind"] for effect in answer["effects"]]
    return Draw(results.name, found.idle, found.operating, 0.7, lines, exact, dofs, answer["references"], kinds)


def estimate_of(frf: Frf, exact: np.ndarray) -> dict[str, np.ndarray]:
    """What the scatter is made of, on every second line."""
    part = slice(None, None, 2)
    return {
        "estimate": frf.data[..., part].astype(np.complex64),
        "variance": np.asarray(frf.variance)[..., part].astype(np.float32),
        "exact": exact[..., part].astype(np.complex64),
    }

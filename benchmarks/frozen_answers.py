"""Two codes on the same raw files: are all answers equal? 60 fixed cases of ``hidden_effects``, through the command line of both.

    python benchmarks/frozen_answers.py --before OLD/operando --after NEW/operando --out FILE.csv
    python benchmarks/frozen_answers.py --before OLD/operando --out FILE.csv --cases 6                  # or names of cases
    python benchmarks/frozen_answers.py --before OLD/operando --out FILE.csv --sigma 0.1 --tolerance 1  # an order of sums has changed

A command may be a script: ``PYTHONPATH=OLD/src exec python -m operando "$@"`` (else it has the PYTHONPATH of this process).
Cases that FILE.csv holds for the same two commits are not run again. Exit status 1 where an answer is not equal.

The same code gives the same answers to the bit. Sums in another order do not: with the kernels of another processor in OpenBLAS
(OPENBLAS_CORETYPE=Haswell for SkylakeX), FRFs of hammer records in single precision move by 4e-7 to 2e-6 in the median, and what is
ill determined and has no deviation by far more; hence ``--sigma``, with a tolerance of its own for numbers without a deviation.

Compared: every number of summary.json, diagnosis.json and comparison.json, every array of model.h5, and the FRFs of ofrf.uff and
ofrf_effect.uff, which are in single precision and have a limit of their own, 1e-4. Names (texts without a blank: verdict, kinds,
DOFs, units, methods) must be the same; sentences that differ are counted but are not an answer. A number in a list, a shape or an
array differs relative to the largest there; one in percent relative to 100 % at least, one in dB to 1 dB, log odds to 1, as these
are differences of nearly equal numbers. Values that only the code after has are counted but are not a difference.

Left out: in JSON ``schema`` and ``sha256`` (versions and hashes); in model.h5 ``details`` (stabilization diagrams, candidates), ``raw``
(pictures of the records), ``stages`` (how far the run is), ``*_libraries``, and the texts; the deviations in the UFF files; timings.json;
ladder.json, idle_frf.uff, idle_modes.uff and operating_modes.uff (copies of what is compared); report.html (not made).
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TextIO

import h5py
import numpy as np
from threadpoolctl import threadpool_limits

sys.path.append(str(Path(__file__).with_name("hidden_effects")))
from generate import Spec, parse
from judge import read_frfs
from paired import group
from score import run_case

NAMES = """
frame-point_mass-9500-r3-hammer rotor-point_mass-9501-r1-shaker frame-ground_spring-9502-r1-hammer panel-ground_spring-9503-r3-shaker
rotor-ground_damper-9504-r3-shaker frame-ground_hysteretic_spring-9505-r3-shaker rotor-ground_rubber-9506-r1-hammer
panel-tuned_absorber-9507-r3-hammer frame-tuned_absorber-9508-r1-shaker rotor-coupling_spring-9509-r3-hammer
frame-coupling_damper-9510-r3-shaker rotor-gyroscopic-9511-r1-shaker rotor-circulatory-9512-r3-hammer
frame-global_stiffness-9513-r1-hammer panel-global_damping-9514-r3-shaker rotor-missing_mode-9515-r1-shaker
frame-sensor_gain-9516-r3-hammer rotor-sensor_polarity-9517-r1-shaker panel-sensor_delay-9518-r3-shaker frame-channel_swap-9519-r1-hammer
rotor-sensor_mass-9520-r3-hammer panel-force_gain-9521-r1-hammer frame-force_delay-9522-r3-shaker frame-two-9523-r3-hammer
rotor-two-9524-r1-shaker panel-two-9525-r3-shaker frame-uneven-9526-r3-shaker rotor-uneven-9527-r1-hammer frame-unmeasured-9528-r3-shaker
rotor-unmeasured-9529-r1-hammer panel-unmeasured-9530-r3-hammer frame-point_mass-9531-r3-hammer-days
rotor-ground_spring-9532-r1-shaker-days frame-coupling_spring-9533-r3-shaker-days frame-none-9534-r3-shaker-days
rotor-ground_damper-9535-r3-shaker-complex frame-none-9536-r3-hammer rotor-none-9537-r1-shaker panel-none-9538-r3-shaker
rotor-orders-9539-r1-hammer frame-ground_spring-9540-r3-shaker-nocheck rotor-coupling_spring-9541-r1-hammer-nocheck
panel-point_mass-9542-r3-hammer-nocheck rotor-gyroscopic-9543-r3-shaker-nocheck frame-global_stiffness-9544-r1-shaker-nocheck
panel-coupling_damper-9545-r3-shaker-nocheck frame-none-9546-r1-hammer-nocheck rotor-ground_damper-9547-r3-shaker-nocheck-orders
frame-cubic_stiffness-9548-r3-shaker rotor-quadratic_stiffness-9549-r3-shaker rotor-quadratic_damping-9550-r1-shaker
frame-coulomb_friction-9551-r3-shaker rotor-hysteresis-9552-r3-shaker frame-clearance-9553-r3-shaker
rotor-one_sided_contact-9554-r1-shaker frame-bilinear_stiffness-9555-r3-shaker frame-saturating_spring-9556-r1-shaker
rotor-quintic-9557-r3-shaker frame-outside-9558-r3-hammer panel-outside-9559-r3-shaker
""".split()  # noqa: SIM905
SINGLE = 1e-4  # limit of the files in single precision
LEAST = {"percent": 100.0, "db": 1.0, "odds": 1.0}  # the least that a difference is relative to, by the end of the name
NOT_IN_JSON, NOT_IN_MODEL = {"schema", "sha256"}, {"details", "raw", "stages", "idle_libraries", "operating_libraries"}
STD = (("/value", "/std"), ("_hz", "_std_hz"), ("/shape", "/shape_std"), ("", "_std"))  # what a deviation is named beside its value
Leaf = np.ndarray | str


@dataclass
class Row:
    """What differs between the two answers of a case: a line of the CSV file."""

    before: str = ""
    after: str = ""
    case: str = ""
    group: str = ""
    seconds_before: float = 0.0
    seconds_after: float = 0.0
    verdict: str = ""
    effects: str = ""  # with those that explain the data as well
    numbers: int = 0  # compared
    names: int = 0  # that differ
    lacking: int = 0  # values that the code after does not have
    new: int = 0  # that it alone has
    sentences: int = 0  # that differ
    relative: float = 0.0  # largest relative difference
    at: str = ""
    no_std: float = 0.0  # the same of numbers without a stated deviation
    sigma: float = 0.0  # largest difference in stated deviations
    sigma_at: str = ""
    single: float = 0.0  # largest relative difference of the files in single precision
    single_at: str = ""

    def level(self, tolerance: float, sigma: float | None = None) -> int:
        """0: equal within the tolerance (numbers with a deviation: in these, where a limit is given); 1: within 1e-4; 2: differs."""
        changed = "→" in self.verdict + self.effects or self.verdict.startswith("failed")
        if changed or self.names or self.lacking or not self.numbers or self.single > max(SINGLE, tolerance):
            return 2
        equal = self.relative <= tolerance if sigma is None else self.no_std <= tolerance and self.sigma <= sigma
        return 0 if equal else 1 if self.relative <= SINGLE else 2

    @property
    def to_the_bit(self) -> bool:
        return self.level(0.0) == 0 and not self.single and not self.sentences and not self.new


def kept(file: Path) -> list[Row]:
    """Rows of the CSV file."""
    kinds = {f.name: {"str": str, "int": int, "float": float}[str(f.type)] for f in fields(Row)}
    rows = csv.DictReader(file.read_text("utf-8").splitlines()) if file.exists() else ()
    return [Row(**{name: kinds[name](text) for name, text in row.items()}) for row in rows]


def write(sink: TextIO, rows: Sequence[Row], header: bool = False) -> None:
    """Adds rows to the CSV file."""
    writer = csv.DictWriter(sink, [f.name for f in fields(Row)], lineterminator="\n")
    if header:
        writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    sink.flush()


def leaves(value: object, path: str) -> Iterator[tuple[str, Leaf]]:
    """What a JSON value holds, by its path: numbers, lists of numbers and shapes as arrays, everything else as texts."""
    if isinstance(value, dict) and path.endswith(("/shape", "/shape_std")):
        yield f"{path}/dofs", ",".join(value)
        yield from leaves(list(value.values()), path)
    elif isinstance(value, dict):
        for key in value.keys() - NOT_IN_JSON:
            yield from leaves(value[key], f"{path}/{key}")
    elif isinstance(value, list) and not all(isinstance(v, str) for v in value):
        try:
            yield path, np.array(value, float)  # null: NaN
        except (TypeError, ValueError):  # not numbers, or lists of several lengths
            for i, inner in enumerate(value):
                yield from leaves(inner, f"{path}/{i}")
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield path, np.array(value, float)
    else:
        yield path, ",".join(value) if isinstance(value, list) else str(value)


def answers(results: Path) -> dict[str, Leaf]:
    """All that is compared of a results folder, by its path there."""
    found: dict[str, Leaf] = {}
    for file in (results / f"{name}.json" for name in ("summary", "diagnosis", "comparison")):
        found |= dict(leaves(json.loads(file.read_text("utf-8")), file.stem)) if file.exists() else {}
    for file in (results / name for name in ("ofrf.uff", "ofrf_effect.uff")):
        found |= {f"{file.name}/{','.join(pair)}": frf for pair, frf in read_frfs(file)[1].items()} if file.exists() else {}

    def take(name: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset) and item.dtype.kind in "biufc" and not NOT_IN_MODEL & set(name.split("/")):
            found[f"model.h5/{name}"] = item[()] if item.dtype.kind in "fc" else item[()].astype(float)

    if (results / "model.h5").exists():
        with h5py.File(results / "model.h5") as model:
            model.visititems(take)
    return found


def effects(answer: Mapping[str, Leaf], where: str) -> str:
    """Kinds with their DOFs."""
    kinds = [key for key in answer if re.fullmatch(rf"diagnosis/{where}/\d+/kind", key)]
    return " + ".join(f"{answer[key]}@{answer.get(key.removesuffix('kind') + 'location', '')}" for key in sorted(kinds)) or "none"


def differences(before: Mapping[str, Leaf], after: Mapping[str, Leaf]) -> Row:
    """The largest differences of the numbers, relative and in stated deviations, and what else is not the same."""
    row = Row(lacking=len(before.keys() - after.keys()), new=len(after.keys() - before.keys()))
    verdicts, named = ([str(a.get("diagnosis/verdict", "no diagnosis")) for a in (before, after)],
                       [f"{effects(a, 'effects')}, alike: {effects(a, 'ambiguous_with')}" for a in (before, after)])  # fmt: skip
    row.verdict, row.effects = (" → ".join(dict.fromkeys(both)) for both in (verdicts, named))
    for path in sorted(before.keys() & after.keys()):
        a, b = before[path], after[path]
        if isinstance(a, str) or isinstance(b, str) or a.shape != b.shape:
            same = isinstance(a, str) and isinstance(b, str) and a == b
            sentence = isinstance(a, str) and isinstance(b, str) and " " in a + b
            row.sentences, row.names = row.sentences + (sentence and not same), row.names + (not sentence and not same)
            continue
        row.numbers += a.size
        gap = np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, np.nan_to_num(np.abs(a - b), nan=np.inf))
        if not gap.any():
            continue
        least = LEAST.get(re.split(r"[_/]", path)[-1], 0.0)
        scale = max(least, float(np.nanmax(np.abs([a, b]))))
        relative = float(gap.max()) / scale
        if path.startswith("ofrf"):
            if relative > row.single:
                row.single, row.single_at = relative, path
            continue
        if relative > row.relative:
            row.relative, row.at = relative, path
        stds = [before.get(path.removesuffix(old) + new) for old, new in STD if path.endswith(old)]
        std = next((s for s in stds if isinstance(s, np.ndarray)), np.zeros(()))
        std = std.reshape((*std.shape, *[1] * (gap.ndim - std.ndim)))  # one of a complex number is that of both its parts
        known = np.broadcast_to(std > 0, gap.shape)
        row.no_std = max(row.no_std, float(np.max(gap, where=~known, initial=0.0)) / scale)
        sigma = float(np.max(np.divide(gap, std, out=np.zeros_like(gap), where=known)))
        if sigma > row.sigma:
            row.sigma, row.sigma_at = sigma, path
    return row


def commit(command: str) -> str:
    """Commit of the code that a command runs; where files of the package are changed, with a hash of all of them behind."""
    verbose = dict(os.environ, PYTHONVERBOSE="1")  # Python then says where its modules are
    said = subprocess.run([command, "--version"], capture_output=True, text=True, env=verbose, check=False).stderr
    found = re.search(r"(?:matches |object from '?)(.*/operando)/__init__\.py", said)
    if found is None:
        raise SystemExit(f"{command} --version runs no operando: {said[-300:]}")
    git, package = ["git", "-C", found[1]], Path(found[1])
    head = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
    changed = subprocess.run([*git, "status", "--porcelain", "."], capture_output=True, text=True, check=False).stdout
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in sorted(package.rglob("*.py")))).hexdigest()
    return head if head and not changed else f"{head}+{digest[:7]}"


def run_both(spec: Spec, commands: Sequence[str], commits: Sequence[str], keep: Path | None) -> Row:
    """Writes the case once, runs both commands on it, compares; the files are deleted unless there is a folder to keep them in."""
    with tempfile.TemporaryDirectory() as folder:
        work = keep / spec.name if keep else Path(folder)
        for part in ("cases", "runs", "before", "after"):
            shutil.rmtree(work / part, ignore_errors=True)
        rows, found = [], []
        for side, command in zip(("before", "after"), commands, strict=True):
            rows.append(run_case(spec, work, command, keep=True, until="diagnose", library=False))
            if rows[-1]["exit"]:
                raise RuntimeError(f"the code {side} ended with {rows[-1]['exit']}: {' '.join(rows[-1]['stderr'].split())[-200:]}")
            shutil.move(work / "runs" / Path(rows[-1]["folder"]).name, work / side)
            found.append(answers(work / side))
    row = differences(*found)
    row.case, row.group, (row.before, row.after) = spec.name, group(rows[0]), commits
    row.seconds_before, row.seconds_after = (round(r["seconds"], 1) for r in rows)
    return row


def table(rows: Sequence[Row], tolerance: float, sigma: float | None = None) -> str:
    """How many are equal, the largest difference, counts of each group, and the cases that differ."""
    levels = {row.case: row.level(tolerance, sigma) for row in rows}
    count = [list(levels.values()).count(n) for n in range(3)]
    largest = {(r, f"{at} of {row.case}") for row in rows for r, at in ((row.relative, row.at), (row.single, row.single_at))}
    worst, where = max(largest, default=(0.0, ""))
    text = f"{count[0]} of {len(rows)} cases equal within {tolerance:g} ({sum(r.to_the_bit for r in rows)} to the bit), "
    text += f"{count[1]} within {SINGLE:g}, {count[2]} differ. Largest difference {worst:.2g}{f': {where}' if worst else ''}.\n"
    lines = [text, "| cases | equal | within 1e-4 | differ | largest, relative | in σ | OFRFs |", "|" + " --- |" * 7]
    for name in dict.fromkeys(row.group for row in rows):
        some = [row for row in rows if row.group == name]
        counts = [str([levels[row.case] for row in some].count(n)) for n in range(3)]
        most = [f"{max(getattr(row, field) for row in some):.2g}" for field in ("relative", "sigma", "single")]
        lines.append(f"| {' | '.join([name, *counts, *most])} |")
    shown = [f.name for f in fields(Row)][6:]
    lines += [f"\n{row.case}: {'; '.join(f'{name} {getattr(row, name)}' for name in shown)}" for row in rows if levels[row.case]]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", required=True, help="the operando command of the code before")
    parser.add_argument("--after", default=str(Path(sys.executable).with_name("operando")), help="and of the code after (installed)")
    parser.add_argument("--out", type=Path, required=True, help="CSV file of one row a case")
    parser.add_argument("--cases", nargs="+", default=[str(len(NAMES))], metavar="N", help="so many cases of all kinds, or names")
    parser.add_argument("--tolerance", type=float, default=1e-9, help="relative difference that counts as equal")
    parser.add_argument("--sigma", type=float, help="limit in stated deviations, of numbers that have one; the tolerance is for the others")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder for the files of the cases and both results")
    options = parser.parse_args()
    commands = (options.before, options.after)
    commits = (commit(options.before), commit(options.after))
    many = int(options.cases[0]) if options.cases[0].isdigit() else 0
    wanted = NAMES[:: max(1, len(NAMES) // many)][:many] if many else options.cases
    there = kept(options.out)
    rows = {row.case: row for row in there if (row.before, row.after) == commits}
    todo = [parse(name) for name in wanted if name not in rows]
    start, progress = time.perf_counter(), lambda text: print(text, file=sys.stderr, flush=True)
    progress(f"{' → '.join(commits)}: {len(wanted)} cases, {len(todo)} to run")
    pool = ProcessPoolExecutor(options.processes, initializer=threadpool_limits, initargs=(1,))
    with pool, options.out.open("a", encoding="utf-8", newline="") as sink:
        write(sink, [], header=not there)
        futures = {pool.submit(run_both, spec, commands, commits, options.keep): spec.name for spec in todo}
        for number, future in enumerate(as_completed(futures), start=1):
            name = futures[future]
            try:
                row = future.result()
                write(sink, [row])
            except Exception as problem:  # one broken case must not end the study; it is run again the next time
                row = Row(case=name, group="broken", verdict=f"failed: {problem!r}")
            rows[name] = row
            said = ("equal", "within 1e-4", "DIFFERS")[row.level(options.tolerance, options.sigma)]
            left = (time.perf_counter() - start) / number * (len(todo) - number) / 60
            progress(f"{number:3d}/{len(todo)} {name:50s} {row.verdict:12s} {said}, {left:.0f} min left")
    chosen = [rows[name] for name in wanted]
    print(table(chosen, options.tolerance, options.sigma))
    raise SystemExit(any(row.level(options.tolerance, options.sigma) for row in chosen))


if __name__ == "__main__":
    main()

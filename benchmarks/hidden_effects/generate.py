"""Writes cases with hidden effects: raw files as a lab would bring them home, and the answers in a folder apart.

    python benchmarks/hidden_effects/generate.py FOLDER --family frame --kind point_mass --seeds 0:6 [--references 3] …
    python benchmarks/hidden_effects/generate.py FOLDER --list        # kinds

A case is fixed by its name, e.g. ``rotor-gyroscopic-3-r2-shaker``; its files go to FOLDER/cases/NAME and what it hides to
FOLDER/answers/NAME.json (and .npz: exact operating accelerance). Nothing here imports operando.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
from contacts import NONLINEAR, Contact, hide_contact
from contacts import RESPONSE_NOISE as CONTACT_NOISE
from days import Days, between_db, mode_shapes, some_days, told, with_dashpot
from families import FAMILIES, Structure, draw
from hidden import LINEAR, OUTSIDE, SENSOR, Hidden, change_db, hide, hide_between, idle
from records import Logger, contact_runs, forced_run, geometry, operating_run, through_faults

SPECIAL = ("none", "orders", "two", "unmeasured", "outside", "one_mode")
KINDS = (*LINEAR, *SENSOR, *SPECIAL, *NONLINEAR, "uneven")  # new ones behind: the number of a kind seeds its cases
PAIRABLE = (
    "point_mass",
    "ground_spring",
    "ground_damper",
    "coupling_spring",
    "gyroscopic",
    "tuned_absorber",
    "global_stiffness",
    "sensor_gain",
)
BETWEEN = ("point_mass", "ground_spring", "ground_damper", "tuned_absorber")
STRONG_DB, UNEVEN = (2.0, 6.0), (3.0, 30.0)  # of an uneven pair: change of the FRFs by the stronger effect, and that over the weaker one's
FORCE_RMS = 12.0


@dataclass(frozen=True)
class Spec:
    """Everything that fixes a case."""

    family: str
    kind: str
    seed: int
    references: int = 3
    excitation: str = "shaker"  # or hammer
    check: bool = True
    orders: bool = False
    rate: int = 512  # samples a second
    days: bool = False  # running state and check on another day than the structure at rest
    complex: bool = False  # a local damper in both states makes modes complex

    @property
    def name(self) -> str:
        ends = ("" if self.check else "-nocheck") + ("-orders" if self.orders else "") + ("" if self.rate == 512 else f"-{self.rate}Hz")
        ends += ("-days" if self.days else "") + ("-complex" if self.complex else "")
        return f"{self.family}-{self.kind}-{self.seed}-r{self.references}-{self.excitation}{ends}"


def parse(name: str) -> Spec:
    """A Spec from its name."""
    family, kind, seed, references, excitation, *more = name.split("-")
    rate = next((int(m[:-2]) for m in more if m.endswith("Hz")), 512)
    flags = ("nocheck" not in more, "orders" in more, rate, "days" in more, "complex" in more)
    return Spec(family, kind, int(seed), int(references[1:]), excitation, *flags)


@dataclass(frozen=True)
class Truth:
    """The case before it is measured."""

    structure: Structure
    references: tuple[int, ...]
    state: Hidden
    band: tuple[float, float]
    orders: tuple[tuple[float, float], ...]
    contact: Contact | None = None
    weaker_than: Hidden | None = None  # of an uneven pair: the state with the stronger effect alone
    days: Days | None = None
    same_day: Hidden | None = None  # of two days: the state with what is hidden and no other difference


def truth(spec: Spec) -> Truth:
    """The structure, its references, and what is hidden; deterministic in the Spec."""
    if spec.family not in FAMILIES or spec.kind not in KINDS or spec.excitation not in ("hammer", "shaker"):
        raise ValueError(f"no such case: {spec}")
    if spec.kind in NONLINEAR and spec.complex:
        raise ValueError(f"{spec.kind} is for a structure with real modes")
    structure = draw(spec.family, spec.seed)
    if spec.complex:
        structure = with_dashpot(structure, np.random.default_rng([spec.seed, FAMILIES.index(spec.family), 33]))
    rng = np.random.default_rng([spec.seed, FAMILIES.index(spec.family), KINDS.index(spec.kind), 77])
    references = _references(structure, spec.references)
    band, contact, stronger = structure.band, None, None
    if spec.kind == "two":
        first, second = (PAIRABLE[i] for i in rng.choice(len(PAIRABLE), 2, replace=False))
        if "sensor_gain" in (first, second) and not spec.check:
            first, second = "point_mass", "coupling_spring"
        state = hide(second, structure, references, rng, hide(first, structure, references, rng))
    elif spec.kind == "uneven":
        first, second = (PAIRABLE[i] for i in rng.choice(len(PAIRABLE) - 1, 2, replace=False))  # structural ones
        strong, ratio = (float(np.exp(rng.uniform(*np.log(ends)))) for ends in (STRONG_DB, UNEVEN))
        stronger = hide(first, structure, references, rng, target_db=strong)
        state = hide(second, structure, references, rng, stronger, target_db=strong / ratio)
    elif spec.kind == "unmeasured":
        state = hide_between(BETWEEN[spec.seed % len(BETWEEN)], structure, references, rng)
    elif spec.kind == "outside":
        state = hide(OUTSIDE[spec.seed % len(OUTSIDE)], structure, references, rng)
    elif spec.kind == "one_mode":
        band = _lonely_band(structure)
        narrow = _with_band(structure, band)
        state = hide(("ground_spring", "point_mass")[spec.seed % 2], narrow, references, rng)
    elif spec.kind in ("none", "orders"):
        state = idle(structure)
    elif spec.kind in NONLINEAR:
        if spec.excitation != "shaker" or not spec.check or spec.orders:
            raise ValueError(f"{spec.kind} needs a shaker, a check and no orders")
        state, contact = hide_contact(spec.kind, structure, references, rng, FORCE_RMS)
    else:
        state = hide(spec.kind, structure, references, rng)
    orders = _orders(state, band, rng) if spec.orders or spec.kind == "orders" else ()
    if not spec.days:
        return Truth(structure, references, state, band, orders, contact, stronger)
    ways = (spec.references, spec.excitation == "hammer", 55)
    rng = np.random.default_rng([spec.seed, FAMILIES.index(spec.family), KINDS.index(spec.kind), *ways])
    days, after = some_days(structure, state, references, rng)
    return Truth(structure, references, after, band, orders, contact, stronger, days, state)


def _with_band(structure: Structure, band: tuple[float, float]) -> Structure:
    return replace(structure, band=band)


def _lonely_band(structure: Structure) -> tuple[float, float]:
    """A band around the mode that is farthest from its neighbours."""
    count = int(structure.in_band.sum())
    hz = structure.hz[: count + 1]
    edges = np.concatenate([[0.5 * hz[0]], np.sqrt(hz[1:] * hz[:-1])])
    i = int(np.argmax([min(hz[k] / edges[k], edges[k + 1] / hz[k]) for k in range(count)]))
    return round(float(edges[i]), 1), round(float(edges[i + 1]), 1)


def _references(structure: Structure, count: int) -> tuple[int, ...]:
    """Sensors to drive at: at least one of them moves well in each mode in band; random among the best few sets (the best one alone)."""
    rows = np.abs(structure.rows[:, structure.in_band])
    seen = rows / rows.max(axis=0)
    sets = list(combinations(range(len(rows)), count))
    worth = np.array([seen[list(s)].max(axis=0).min() for s in sets])
    best = np.argsort(-worth, kind="stable")[: 1 if count == 1 else 8]
    return sets[int(np.random.default_rng([len(rows), count, int(1e3 * structure.hz[0])]).choice(best))]


def _orders(state: Hidden, band: tuple[float, float], rng: np.random.Generator) -> tuple[tuple[float, float], ...]:
    """Running speed and its double [Hz], with their shares of the mean square in the channel they move most; not within 2 % of a mode."""
    values, _ = state.system.poles()
    modes = np.abs(values) / 2 / np.pi
    for _ in range(500):
        speed = rng.uniform(max(12.0, band[0]), 0.48 * band[1])
        if all(np.abs(modes / (n * speed) - 1).min() > 0.02 for n in (1, 2)):
            break
    return (speed, float(np.exp(rng.uniform(*np.log((0.01, 0.3)))))), (2 * speed, float(np.exp(rng.uniform(*np.log((0.005, 0.15))))))


def write(spec: Spec, folder: Path, case: Path | None = None) -> Path:
    """Writes FOLDER/cases/NAME (or the given case folder) and FOLDER/answers/NAME.json, .npz; returns the case folder."""
    case, answers = case or folder / "cases" / spec.name, folder / "answers"
    known = truth(spec)
    structure, state = known.structure, known.state
    if spec.rate != 512 and known.contact is None:
        raise ValueError("another sampling rate is for level-dependent kinds")
    rng = np.random.default_rng(
        [spec.seed, FAMILIES.index(spec.family), KINDS.index(spec.kind), spec.references, spec.excitation == "hammer", 99]
    )
    units = (("m/s^2", "N"), ("g", "N"), ("g", "lbf"))[int(rng.choice(3, p=[0.6, 0.25, 0.15]))]
    logger = Logger(structure, rng, units, CONTACT_NOISE if known.contact else None, float(spec.rate))
    seconds = 48 if spec.excitation == "hammer" else 40
    rest = idle(structure)
    files = {"geometry.uff": geometry(structure), "test.toml": _test_file(spec, known.band).encode()}
    for i, reference in enumerate(known.references, start=1):
        at = structure.sensors[reference].name
        files[f"idle/run{i}.uff"] = forced_run(
            logger, rest, reference, spec.excitation, seconds, FORCE_RMS, f"at rest, {spec.excitation} at {at}"
        )
    if known.contact is not None:
        driven = _check_references(known)
        runs = contact_runs(
            logger,
            state,
            known.contact,
            [r for r in driven for _ in "ab"],
            [FORCE_RMS * share for _ in driven for share in (1.0, 0.25)],
            40,
        )
        names = [f"check/run{i}{level}.uff" for i in range(1, len(driven) + 1) for level in "ab"]
        files |= dict(zip([*names, "operating/run1.uff"], runs, strict=True))
    else:
        files["operating/run1.uff"] = operating_run(logger, state, 140, known.orders)
    if spec.check and known.contact is None:
        for i, reference in enumerate(_check_references(known), start=1):
            for level, share in (("a", 1.0), ("b", 0.25)):
                name = f"running state, {spec.excitation} at {structure.sensors[reference].name}, level {level}"
                files[f"check/run{i}{level}.uff"] = forced_run(
                    logger, state, reference, spec.excitation, 40, FORCE_RMS * share, name, check=True
                )
    for name, content in files.items():
        target = case / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content)
    answers.mkdir(parents=True, exist_ok=True)
    (answers / f"{spec.name}.json").write_text(json.dumps(answer(spec, known), indent=1) + "\n")
    if known.contact is not None:
        return case  # no FRFs of its own: they depend on the level
    hz = np.linspace(*known.band, 400)
    exact = state.system.accelerance(hz, state.rows, state.rows).astype(np.complex64)
    np.savez(answers / f"{spec.name}.npz", f=hz, H=exact, dofs=[s.name for s in structure.sensors])
    return case


def _check_references(known: Truth) -> tuple[int, ...]:
    """Two of the references; a force fault is at one of them."""
    faulty = {*known.state.force_gain, *known.state.force_delay}
    return tuple(sorted(known.references, key=lambda r: (r not in faulty, r)))[:2]


def answer(spec: Spec, known: Truth) -> dict:
    """What the files do not say."""
    structure, state = known.structure, known.state
    inside = int((structure.hz < 250).sum())
    values, vectors = state.system.poles()
    operating = np.abs(values) / 2 / np.pi
    keep = np.flatnonzero(operating < 250)
    shapes = np.hstack([through_faults(state, state.seen @ vectors[:, [k]], operating[[k]]) for k in keep])
    shapes /= np.linalg.norm(shapes, axis=0)
    rest = {
        "frequency_hz": structure.hz[:inside].tolist(),
        "damping_ratio": structure.zeta[:inside].tolist(),
        "shapes_unit_modal_mass": np.round(structure.rows[:, :inside], 9).tolist(),
    }
    if spec.complex:
        poles, complex_shapes = mode_shapes(idle(structure), structure.rows, inside)
        rest = {
            "frequency_hz": (np.abs(poles) / 2 / np.pi).tolist(),
            "damping_ratio": (-poles.real / np.abs(poles)).tolist(),
            "shapes_unit_modal_mass": np.round(complex_shapes.real, 9).tolist(),
            "shapes_imaginary": np.round(complex_shapes.imag, 9).tolist(),
        }
    more: dict = {}
    if known.days is not None:
        seen = _with_band(structure, known.band)
        differences = between_db(seen, known.references, known.days)
        more = {**differences, "between": told(seen, known.references, known.days)}
    alone = known.same_day or state
    return {
        "case": spec.name,
        "family": spec.family,
        "kind": spec.kind,
        "references": [structure.sensors[r].name for r in known.references],
        "excitation": spec.excitation,
        "check": spec.check,
        "harmonics_hz": [f for f, _ in known.orders],
        "effects": list(state.effects),
        "change_db": None
        if known.contact is not None
        else change_db(_with_band(structure, known.band), alone, known.references, system=alone.check_system),
        "weaker_db": None if known.weaker_than is None else change_db(structure, alone, known.references, known.weaker_than),
        "band_hz": list(known.band),
        "sensor_spacing_m": structure.spacing,
        "dofs": [s.name for s in structure.sensors],
        "positions": {s.name: structure.points[s.node].tolist() for s in structure.sensors},
        "idle": rest,
        "operating": {
            "frequency_hz": operating[keep].tolist(),
            "damping_ratio": (-values.real / np.abs(values))[keep].tolist(),
            "shapes_unit_norm": np.round([shapes.real, shapes.imag], 9).tolist(),
        },
        **more,
    }


def _test_file(spec: Spec, band: tuple[float, float]) -> str:
    parts = ['[idle]\nrecords = ["idle/*.uff"]', '[operating]\nrecords = ["operating/*.uff"]']
    if spec.check:
        parts.append('[check]\nrecords = ["check/*.uff"]')
    parts += ['[geometry]\nfile = "geometry.uff"\nunits = "m"', f"[analysis]\nband = [{band[0]}, {band[1]}]"]
    # The name must not give the answer away.
    return f'name = "{spec.family} {spec.seed}"\n\n' + "\n\n".join(parts) + "\n"


def seeds(text: str) -> range:
    first, _, last = text.partition(":")
    return range(int(first), int(last)) if last else range(int(first), int(first) + 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", help="names of cases; else the options below")
    parser.add_argument("--family", choices=FAMILIES, action="append")
    parser.add_argument("--kind", choices=KINDS, action="append")
    parser.add_argument("--seeds", type=seeds, default=range(1))
    parser.add_argument("--references", type=int, default=3)
    parser.add_argument("--excitation", choices=("shaker", "hammer"), default="shaker")
    parser.add_argument("--no-check", action="store_true")
    parser.add_argument("--orders", action="store_true", help="two rotor orders in the operating record")
    parser.add_argument("--days", action="store_true", help="running state and check on another day")
    parser.add_argument("--complex", action="store_true", help="a local damper in both states")
    parser.add_argument("--list", action="store_true")
    options = parser.parse_intermixed_args()
    if options.list:
        print("\n".join(KINDS))
        return
    specs = [parse(name) for name in options.names] or [
        Spec(
            family,
            kind,
            seed,
            options.references,
            options.excitation,
            not options.no_check,
            options.orders,
            days=options.days,
            complex=options.complex,
        )
        for family in options.family or FAMILIES
        for kind in options.kind or KINDS
        for seed in options.seeds
    ]
    for spec in specs:
        start = time.perf_counter()
        case = write(spec, options.folder)
        print(f"{case}  {sum(f.stat().st_size for f in case.rglob('*') if f.is_file()) / 1e6:.1f} MB  {time.perf_counter() - start:.2f} s")


if __name__ == "__main__":
    main()

"""Makes one case of the laboratory family: a folder as a laboratory would hand it over, and the answer beside it, never inside.

    python benchmarks/laboratory/generate.py KIND SEED OUTDIR         # OUTDIR/test.toml, OUTDIR/*.uff, OUTDIR.truth.json

Kinds are listed by ``--help`` and described in README.md. Shares no code with operando.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parent))
import frf_kinds
import multisine_kind
import record_kinds

KINDS: dict[str, Callable[[np.random.Generator, Path], dict[str, object]]] = {
    "roving_hammer": frf_kinds.roving_hammer,
    "single_reference": frf_kinds.single_reference,
    "complex_modes": frf_kinds.complex_modes,
    "roving_hammer_records": record_kinds.roving_hammer_records,
    "roving_accelerometers": record_kinds.roving_accelerometers,
    "operating_setups": record_kinds.operating_setups,
    "multisine": multisine_kind.multisine,
}


def generate(kind: str, seed: int, folder: Path) -> dict[str, object]:
    """Writes a case and its answer; gives the answer. A folder made before is written anew; any other that is not empty is left alone."""
    beside = folder.with_name(folder.name + ".truth.json")
    if folder.exists() and any(folder.iterdir()):
        if not beside.exists():
            raise FileExistsError(f"{folder} is not empty and was not made here")
        shutil.rmtree(folder)
    rng = np.random.default_rng([zlib.crc32(kind.encode()), seed])  # a kind added later changes no other case
    document = {"kind": kind, "seed": seed} | KINDS[kind](rng, folder)
    beside.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    return document


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=tuple(KINDS))
    parser.add_argument("seed", type=int)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    document = generate(options.kind, options.seed, options.folder)
    modes = [m for m in document["modes"] if m["in_band"]]  # type: ignore[attr-defined]
    seen = sum(m["visible"] for m in modes)
    print(f"{options.folder}: {document['structure']}, {len(modes)} modes in band {document['band_hz']} Hz, {seen} visible")


if __name__ == "__main__":
    main()

"""Diagnoses a results folder through the Python interface: for ``score.py --library``, while the command line has no such stage.

python benchmarks/hidden_effects/through_library.py RESULTS
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

from operando.diagnosis import diagnose
from operando.store import load_results


def main() -> None:
    folder = Path(sys.argv[1])
    results = load_results(folder)
    start = time.perf_counter()
    found = diagnose(results.idle, check=results.check, operating=results.operating, geometry=results.geometry)
    document = found.to_dict() | {"seconds": time.perf_counter() - start}
    (folder / "diagnosis.json").write_text(json.dumps(document, default=str))


if __name__ == "__main__":
    main()

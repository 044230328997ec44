"""Coverage-guided fuzzing of the readers that run in this process, by atheris (libFuzzer); it is no dependency of the project.

    pip install atheris
    python benchmarks/fuzz/guided.py "uff 58" --seconds 120      # seeds whose names start so, see tests/fuzz_seeds.py

It looks for what is no typed error, hangs and memory; what is accepted is judged by ``long.py``. HDF5, MATLAB and TDMS are tried in a
helper process, whose coverage nobody sees: ``long.py`` alone is for them.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import warnings
from pathlib import Path

import atheris

HERE = Path(__file__).resolve()
sys.path.insert(0, str(HERE.parents[2] / "tests"))

with atheris.instrument_imports(include=["operando"]):
    import operando.config
    import operando.io.frf_table
    import operando.io.lvm
    import operando.io.numpy_files
    import operando.io.uff.reader
    import operando.io.wav  # noqa: F401
    from operando.errors import OperandoError

from fuzz_seeds import all_seeds  # noqa: E402
from fuzzing import TIME_LIMIT_S  # noqa: E402


def main() -> None:
    """Fuzz one reader from its seeds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seeds", help="beginning of the names of the seeds")
    parser.add_argument("--seconds", type=int, default=60)
    given = parser.parse_args()
    folder = Path(tempfile.mkdtemp())  # libFuzzer ends the process: what it found stays there
    print(f"files in {folder}")
    chosen = [seed for seed in all_seeds(folder) if seed.name.startswith(given.seeds)]
    if not chosen:
        parser.error(f"no seed's name starts with {given.seeds!r}")
    corpus = folder / "corpus"
    corpus.mkdir()
    for i, seed in enumerate(chosen):
        (corpus / str(i)).write_bytes(seed.data)
    path, read = folder / chosen[0].file, chosen[0].read

    def one(data: bytes) -> None:
        path.write_bytes(data)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", RuntimeWarning)
                read(path)
        except OperandoError:
            pass

    limits = [
        f"-max_total_time={given.seconds}",
        f"-timeout={TIME_LIMIT_S:.0f}",
        "-rss_limit_mb=1500",
        "-max_len=20000",
        "-print_final_stats=1",
    ]
    atheris.Setup([sys.argv[0], *limits, f"-artifact_prefix={folder}/", str(corpus)], one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()

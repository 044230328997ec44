"""Reading of files from elsewhere without harm: sizes checked before memory is taken, libraries that can hang tried apart."""

from operando.io.safe.guard import TIME_LIMIT_S, trust, try_apart
from operando.io.safe.hdf5_file import opened_hdf5
from operando.io.safe.limits import DEFLATE_RATIO, FREE_BYTES, GROWTH, check_growth, memory_allowed

__all__ = ["DEFLATE_RATIO", "FREE_BYTES", "GROWTH", "TIME_LIMIT_S", "check_growth", "memory_allowed", "opened_hdf5", "trust", "try_apart"]

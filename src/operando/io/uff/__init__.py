"""Universal File Format: reader and writer of 58 and 58b and of the small sets that modal tests use."""

from operando.io.uff.reader import read_uff, read_uff_sets
from operando.io.uff.split import RawSet, split_sets
from operando.io.uff.writer import write_uff

__all__ = ["RawSet", "read_uff", "read_uff_sets", "split_sets", "write_uff"]

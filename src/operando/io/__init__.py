"""Reading and writing of measurement files: UFF, HDF5, MATLAB, CSV, SEP005."""

from operando.io.content import Content, SetInfo
from operando.io.detect import detect_format, read
from operando.io.hdf5 import read_hdf5, read_object, write_hdf5, write_object
from operando.io.uff import read_uff, read_uff_sets, write_uff

__all__ = [
    "Content",
    "SetInfo",
    "detect_format",
    "read",
    "read_hdf5",
    "read_object",
    "read_uff",
    "read_uff_sets",
    "write_hdf5",
    "write_object",
    "write_uff",
]

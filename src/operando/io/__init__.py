"""Reading and writing of measurement files: UFF, HDF5, MATLAB, CSV, SEP005."""

from operando.io.content import Content, SetInfo
from operando.io.hdf5 import read_hdf5, read_object, write_hdf5, write_object

__all__ = ["Content", "SetInfo", "read_hdf5", "read_object", "write_hdf5", "write_object"]

"""Reading and writing of measurement files: UFF, HDF5, MATLAB, CSV, SEP005."""

from operando.data import explain_arguments
from operando.io.columns import NoHeader, NoLines, NoMeasurement, NoRate
from operando.io.content import Content, FileHeader, SetInfo
from operando.io.convert import convert
from operando.io.csv import read_csv, write_csv
from operando.io.detect import detect_format, read
from operando.io.hdf5 import UNREADABLE, check_objects, read_hdf5, read_objects, write_hdf5
from operando.io.inspect import inspect_content, inspect_files
from operando.io.matlab import read_matlab, write_matlab
from operando.io.objects import load_object, object_names
from operando.io.safe import opened_hdf5
from operando.io.sep005 import from_sep005, make_record, to_sep005
from operando.io.uff import read_uff, read_uff_sets, write_uff

__all__ = [
    "UNREADABLE",
    "Content",
    "FileHeader",
    "NoHeader",
    "NoLines",
    "NoMeasurement",
    "NoRate",
    "SetInfo",
    "check_objects",
    "convert",
    "detect_format",
    "from_sep005",
    "inspect_content",
    "inspect_files",
    "load_object",
    "make_record",
    "object_names",
    "opened_hdf5",
    "read",
    "read_csv",
    "read_hdf5",
    "read_matlab",
    "read_objects",
    "read_uff",
    "read_uff_sets",
    "to_sep005",
    "write_csv",
    "write_hdf5",
    "write_matlab",
    "write_uff",
]

explain_arguments(__name__)

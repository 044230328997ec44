"""Reading and writing of measurement files: UFF, HDF5, MATLAB, CSV, SEP005."""

from operando.data import explain_arguments
from operando.io.columns import NoHeader, NoLines, NoMeasurement, NoRate
from operando.io.content import Content, FileHeader, SetInfo
from operando.io.convert import convert
from operando.io.csv import read_csv, write_csv
from operando.io.detect import detect_format, read
from operando.io.hdf5 import UNREADABLE, read_hdf5, write_hdf5
from operando.io.hdf5 import check_objects as check_objects
from operando.io.hdf5 import read_objects as read_objects
from operando.io.inspect import inspect_content as inspect_content
from operando.io.inspect import inspect_files
from operando.io.matlab import read_matlab, write_matlab
from operando.io.objects import load_object, object_names
from operando.io.safe import opened_hdf5 as opened_hdf5
from operando.io.sep005 import from_sep005, to_sep005
from operando.io.sep005 import make_record as make_record
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
    "convert",
    "detect_format",
    "from_sep005",
    "inspect_files",
    "load_object",
    "object_names",
    "read",
    "read_csv",
    "read_hdf5",
    "read_matlab",
    "read_uff",
    "read_uff_sets",
    "to_sep005",
    "write_csv",
    "write_hdf5",
    "write_matlab",
    "write_uff",
]

explain_arguments(__name__)

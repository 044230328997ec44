"""A first test file from the files in a folder (``operando init``)."""

from operando.data import explain_arguments
from operando.scaffold.look import Scaffold, Taken, scaffold, write_test

__all__ = ["Scaffold", "Taken", "scaffold", "write_test"]

explain_arguments(__name__)

"""What no stage needs: force loops, single channels, periodic tests, and the same data through other libraries."""

from operando.contrib.force_loops import LoopFit, fit_loop
from operando.contrib.libraries import LibraryComparison, LibraryMode, compare_libraries, library_rows
from operando.contrib.periodic import PeriodicResponse, best_linear_approximation
from operando.contrib.single_channel import SingleFit, fit_single
from operando.data import explain_arguments

__all__ = [
    "LibraryComparison",
    "LibraryMode",
    "LoopFit",
    "PeriodicResponse",
    "SingleFit",
    "best_linear_approximation",
    "compare_libraries",
    "fit_loop",
    "fit_single",
    "library_rows",
]

explain_arguments(__name__)

"""What no stage needs: the same data through other libraries."""

from operando.contrib.libraries import LibraryComparison, LibraryMode, compare_libraries, library_rows

__all__ = ["LibraryComparison", "LibraryMode", "compare_libraries", "library_rows"]

"""Small helpers for read-only, checked arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from operando.errors import DataError


def frozen(value: ArrayLike, dtype: DTypeLike | None = None, ndim: int | None = None, name: str = "array") -> NDArray[Any]:
    """Read-only view or copy of ``value``; the caller's array stays writable.

    Raises
    ------
    DataError
        If the number of dimensions is not ``ndim``.
    """
    array = np.asarray(value, dtype=dtype)
    if ndim is not None and array.ndim != ndim:
        raise DataError(f"{name} has {array.ndim} dimensions, expected {ndim}")
    view = array.view()
    view.flags.writeable = False
    return view


def complex_of(real: ArrayLike, imaginary: ArrayLike) -> NDArray[np.complex128]:
    """Complex numbers of two parts; an infinite part leaves the other one as it is, which a product with i would not.

    Parameters
    ----------
    real : array
        Real parts.
    imaginary : array
        Imaginary parts.

    Returns
    -------
    complex array

    Examples
    --------
    >>> complex_of([1.0, 2.0], [0.0, -1.0]).tolist()
    [(1+0j), (2-1j)]
    """
    first = np.asarray(real, float)
    out = np.empty(first.shape, complex)
    out.real, out.imag = first, imaginary
    return out

"""Mode indicator functions of FRF matrices."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.errors import DataError

__all__ = ["cmif"]


def cmif(H: ArrayLike) -> NDArray[np.float64]:
    """Complex mode indicator function: the singular values of the FRF matrix line by line (Shih et al. 1988).

    As many curves peak at one frequency as modes are close there and told apart by the references.

    Parameters
    ----------
    H : (n_resp, n_ref, n_lines) complex array
        Pairs that were not measured (not finite) count as 0.

    Returns
    -------
    (min(n_resp, n_ref), n_lines) array
        Singular values, the largest first.

    Raises
    ------
    DataError
        If H has not three dimensions.
    """
    data = np.asarray(H)
    if data.ndim != 3:
        raise DataError(f"an FRF matrix is (n_resp, n_ref, n_lines), not {data.shape}")
    data = np.where(np.isfinite(data), data, 0)
    if data.shape[1] > data.shape[0]:
        data = data.transpose(1, 0, 2)
    # eigenvalues of the small Hermitian product would lose the small curves below 1e-8 of the largest
    return np.ascontiguousarray(np.linalg.svd(data.transpose(2, 0, 1), compute_uv=False).T)

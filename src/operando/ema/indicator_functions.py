"""Mode indicator functions of FRF matrices."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.errors import DataError

__all__ = ["cmif", "mmif"]


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

    Examples
    --------
    >>> import numpy as np, operando
    >>> idle = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> frf = idle.frf(np.arange(5, 80, 0.1))
    >>> from operando.ema import cmif
    >>> frf.frequencies_hz[cmif(frf.data)[0].argmax()].round(1).tolist()
    20.0
    """
    data = np.asarray(H)
    if data.ndim != 3:
        raise DataError(f"an FRF matrix is (n_resp, n_ref, n_lines), not {data.shape}")
    data = np.where(np.isfinite(data), data, 0)
    if data.shape[1] > data.shape[0]:
        data = data.transpose(1, 0, 2)
    # eigenvalues of the small Hermitian product would lose the small curves below 1e-8 of the largest
    return np.ascontiguousarray(np.linalg.svd(data.transpose(2, 0, 1), compute_uv=False).T)


def mmif(H: ArrayLike, quantity: str = "accelerance") -> NDArray[np.float64]:
    """Multivariate mode indicator function: least part of the response that can be in phase with the forces (Williams et al. 1985).

    Near 1 between resonances; the first curve dips towards 0 at each mode, the second where two modes are close and the references
    tell them apart.

    Parameters
    ----------
    H : (n_resp, n_ref, n_lines) complex array
        Pairs that were not measured (not finite) count as 0.
    quantity : {"accelerance", "mobility", "receptance"}
        At a mode accelerance and receptance are imaginary, mobility is real.

    Returns
    -------
    (n_ref, n_lines) array
        Between 0 and 1, the smallest first; 1 where all of H is zero.

    Raises
    ------
    DataError
        If H has not three dimensions.

    Examples
    --------
    >>> line = np.array([10.0, 20.0, 30.0])
    >>> h = 1 / (20.0**2 - line**2 + 0.4j * line)
    >>> mmif(h[None, None]).round(2)
    array([[1., 0., 1.]])
    """
    data = np.asarray(H)
    if data.ndim != 3:
        raise DataError(f"an FRF matrix is (n_resp, n_ref, n_lines), not {data.shape}")
    data = np.where(np.isfinite(data), data, 0).transpose(2, 0, 1)
    in_phase, across = (data.imag, data.real) if quantity == "mobility" else (data.real, data.imag)
    # λ of A v = λ (A + B) v as squared singular values of the in-phase part in an orthonormal basis of both parts stacked.
    stacked = np.concatenate([in_phase, across], axis=1)
    u, s, _ = np.linalg.svd(stacked, full_matrices=False)
    basis = np.where((s > 1e-12 * s[:, :1])[:, None, :], u, 0)[:, : in_phase.shape[1]]
    values = np.linalg.svd(basis, compute_uv=False)[:, ::-1] ** 2
    dead = (s <= 1e-12 * s[:, :1]) | (s == 0)  # directions without any response say nothing
    out = np.ones((data.shape[0], data.shape[2]))
    out[:, : values.shape[1]] = values
    for line in np.flatnonzero(dead.any(axis=1)):
        n = int(dead[line].sum())
        out[line] = np.r_[out[line, n:], np.ones(n)]
    return np.ascontiguousarray(np.clip(out, 0, 1).T)

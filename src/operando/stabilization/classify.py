"""Stability of each pole against the model order below."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.errors import DataError
from operando.stabilization.table import PoleTable, Tolerances


def pole_differences(
    hz_a: NDArray[Any], zeta_a: NDArray[Any], unit_a: NDArray[Any], hz_b: NDArray[Any], zeta_b: NDArray[Any], unit_b: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Relative frequency difference, relative damping difference and 1 − MAC of all pairs, each (n_a, n_b); vectors have unit norm."""
    frequency = np.abs(hz_a[:, None] - hz_b) / np.maximum(np.maximum(hz_a[:, None], hz_b), np.finfo(float).tiny)
    size = np.maximum(np.abs(zeta_a)[:, None], np.abs(zeta_b))
    damping = np.abs(zeta_a[:, None] - zeta_b) / np.maximum(size, 1e-12)
    return frequency, damping, 1 - np.abs(unit_a.conj().T @ unit_b) ** 2


def unit_vectors(vectors: NDArray[Any]) -> NDArray[Any]:
    """Columns scaled to unit norm (null columns stay null)."""
    norm = np.linalg.norm(vectors, axis=0)
    return vectors / np.where(norm > 0, norm, 1)


def classify(
    orders: Sequence[int],
    hz: Sequence[ArrayLike],
    zeta: Sequence[ArrayLike],
    vectors: Sequence[ArrayLike],
    tolerances: Tolerances | None = None,
) -> PoleTable:
    """Put the poles of all orders into one table, each with its stability against the order below.

    Parameters
    ----------
    orders : sequence of int
        Model orders, increasing, one an entry of the next three.
    hz, zeta : sequences of (p_i,) arrays
        |λ|/2π [Hz] and −Re λ/|λ| of the poles of each order, one of each conjugate pair (real poles left out by the caller).
    vectors : sequence of (m, p_i) arrays
        Mode shape (OMA) or participation vector (EMA) of each pole.
    tolerances : Tolerances, optional
        What counts as stable; default: those of the field.

    Returns
    -------
    PoleTable
        Rows in the order of ``orders``, within one order by frequency. ``status`` says what agrees with any pole of the order
        below: frequency, then damping, then the vector; ``invalid`` is a pole with damping outside (0, ``max_damping``] or a
        value that is not finite.

    Raises
    ------
    DataError
        If the sequences disagree in length or the orders do not increase.

    Examples
    --------
    >>> import numpy as np
    >>> from operando.stabilization import classify
    >>> shape = np.array([[1.0], [0.5]])
    >>> table = classify([2, 4, 6, 8, 10], [[20.0], [20.01], [20.0], [20.0], [20.0]], [[0.01]] * 5, [shape] * 5)
    >>> len(table.frequency_hz)
    5
    """
    tol = tolerances or Tolerances()
    if not (len(orders) == len(hz) == len(zeta) == len(vectors)):
        raise DataError(f"{len(orders)} orders, {len(hz)} frequency, {len(zeta)} damping and {len(vectors)} vector arrays")
    if len(orders) == 0:
        raise DataError("no model order given")
    if np.any(np.diff(np.asarray(orders)) <= 0):
        raise DataError("model orders must increase")
    rows: dict[str, list[NDArray[Any]]] = {"order": [], "hz": [], "zeta": [], "vectors": [], "status": []}
    below: tuple[NDArray[Any], NDArray[Any], NDArray[Any]] | None = None
    for order, f_in, z_in, v_in in zip(orders, hz, zeta, vectors, strict=True):
        f, z, v = np.asarray(f_in, float), np.asarray(z_in, float), np.asarray(v_in)
        if not (f.ndim == 1 and f.shape == z.shape and v.ndim == 2 and v.shape[1] == f.size):
            raise DataError(f"order {order}: {f.shape} frequencies, {z.shape} dampings, vectors {v.shape} do not belong together")
        rank = np.argsort(f)
        f, z, v = f[rank], z[rank], v[:, rank]
        valid = np.isfinite(f) & (z > 0) & (z <= tol.max_damping) & np.all(np.isfinite(v), axis=0)
        unit = unit_vectors(np.where(valid, v, 0))
        status = np.zeros(f.size, int)
        if below is not None and below[0].size and f.size:
            df, dz, dv = pole_differences(np.nan_to_num(f), np.nan_to_num(z), unit, *below)
            same = df <= tol.frequency
            status[same.any(axis=1)] = 1
            same &= dz <= tol.damping
            status[same.any(axis=1)] = 2
            same &= dv <= 1 - tol.mac
            status[same.any(axis=1)] = 3
        status[~valid] = 4
        below = (f[valid], z[valid], unit[:, valid])
        for key, value in (("order", np.full(f.size, order)), ("hz", f), ("zeta", z), ("vectors", v), ("status", status)):
            rows[key].append(value)
    return PoleTable(
        np.concatenate(rows["order"]),
        np.concatenate(rows["hz"]),
        np.concatenate(rows["zeta"]),
        np.concatenate(rows["vectors"], axis=1),
        np.concatenate(rows["status"]),
    )


def stability_letters(table: PoleTable, tolerances: Tolerances | None = None) -> NDArray[np.str_]:
    """The usual letter of each pole: what of it agrees with a pole of the order below.

    Parameters
    ----------
    table : PoleTable
        Poles of all orders.
    tolerances : Tolerances, optional
        Those the table was made with.

    Returns
    -------
    (p,) array of str
        ``o`` nothing, ``f`` frequency, ``d`` frequency and damping, ``v`` frequency and vector, ``s`` all three; empty for a pole that
        is not physical.

    Examples
    --------
    >>> one = np.ones((2, 1))
    >>> table = classify([2, 4], [[10.0], [10.01]], [[0.01], [0.02]], [one, one])
    >>> "".join(stability_letters(table))
    'ov'
    """
    tol = tolerances or Tolerances()
    letters = np.array(["o", "f", "d", "s", ""])[table.status]
    unit = unit_vectors(np.where(np.isfinite(table.vectors), table.vectors, 0))
    levels = np.unique(table.order)
    for below, order in pairwise(levels):
        old = np.flatnonzero((table.order == below) & (table.status != 4))
        new = np.flatnonzero((table.order == order) & (table.status == 1))
        if not old.size or not new.size:
            continue
        part = lambda rows: (table.frequency_hz[rows], table.damping_ratio[rows], unit[:, rows])  # noqa: E731
        df, _, dv = pole_differences(*part(new), *part(old))
        letters[new[np.any((df <= tol.frequency) & (dv <= 1 - tol.mac), axis=1)]] = "v"
    return letters

"""Condensed mass at the measured DOFs, its conditioning, and which DOFs decide it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data.arrays import ByContent
from operando.errors import IdentificationError

KAPPA_LIMIT = 1e6
"""Idle modes are left out of the basis until κ lies below this."""

KAPPA_EXTRA = 30.0
"""Idle modes beyond the band join the basis only while κ stays below this."""


@dataclass(frozen=True, eq=False)
class CondensedBasis(ByContent):
    """Idle modes that carry the condensed mass.

    Parameters
    ----------
    modes : (k,) int array
        Indices of the idle modes used, at most as many as DOFs.
    left_out : tuple of int
        Idle modes in band that could not be used.
    kappa : float
        2-norm condition number of the shapes used (Shen & Lu 2024, Eq 16–19: the relative change of the condensed mass
        is at most 2κ times that of the shapes).
    weak_modes : tuple of int
        Idle modes the sensors tell apart worst (they dominate the right singular vector of the smallest singular value).
    weak_dofs : tuple of int
        DOFs that make κ large: they dominate the left singular vector of the smallest singular value, largest first.
    best_dofs : tuple of int
        The best-conditioned choice of k DOFs (pivoted QR).
    best_kappa : float
        κ of that choice alone.
    """

    modes: NDArray[np.int_]
    left_out: tuple[int, ...]
    kappa: float
    weak_modes: tuple[int, ...]
    weak_dofs: tuple[int, ...]
    best_dofs: tuple[int, ...]
    best_kappa: float


def condition(shapes: NDArray[np.float64]) -> float:
    """κ (2-norm) of a shape matrix; infinite if rank-deficient or empty."""
    if shapes.size == 0:
        return float("inf")
    s = np.linalg.svd(shapes, compute_uv=False)
    return float(s[0] / s[-1]) if s[-1] > 0 else float("inf")


def choose_dofs(shapes: ArrayLike, count: int | None = None) -> list[int]:
    """Best-conditioned choice of DOFs: pivoted QR of Φᵀ.

    Parameters
    ----------
    shapes : (m, n) real array
        Shapes in columns.
    count : int, optional
        How many; default min(m, n).

    Returns
    -------
    list of int
        Row indices, most independent first.

    Examples
    --------
    >>> import numpy as np
    >>> choose_dofs(np.array([[1.0, 0.0], [1.0, 0.1], [0.0, 1.0]]))
    [1, 2]
    """
    from scipy.linalg import qr

    a = np.asarray(shapes, float)
    k = min(a.shape) if count is None else min(count, *a.shape)
    pivots = qr(a.T, mode="r", pivoting=True)[1]
    return [int(i) for i in pivots[:k]]


def condensed_mass(shapes: ArrayLike) -> NDArray[np.float64]:
    """M_m = (Φ†)ᵀ Φ† (Shen & Lu 2024, Eq 9; SEREP).

    Parameters
    ----------
    shapes : (m, n) real array, n ≤ m, unit modal mass [kg^(−1/2)]
        Shapes in columns.

    Returns
    -------
    (m, m) array [kg]

    Raises
    ------
    IdentificationError
        If ΦᵀM_mΦ is not the identity: more modes than DOFs, or dependent shapes.

    Examples
    --------
    >>> import numpy as np
    >>> condensed_mass(np.diag([0.5, 0.25])).tolist()
    [[4.0, 0.0], [0.0, 16.0]]
    """
    a = np.asarray(shapes, float)
    inverse = np.linalg.pinv(a)
    check = np.diag((inverse @ a).T @ (inverse @ a))
    if a.shape[1] > a.shape[0] or not np.allclose(check, 1, atol=1e-6):
        raise IdentificationError(
            f"the condensed mass of {a.shape[1]} modes at {a.shape[0]} DOFs does not give unit modal masses "
            f"(diagonal {check.min():.3f} … {check.max():.3f})",
            hint="use at most as many idle modes as DOFs, with shapes the sensors can tell apart",
        )
    return inverse.T @ inverse


def condensed_basis(shapes: ArrayLike, hz: ArrayLike, in_band: ArrayLike) -> CondensedBasis:
    """Choose at most m idle modes for the condensed mass: in band first, best conditioned.

    Parameters
    ----------
    shapes : (m, n) real array of unit modal mass
        Shapes in columns.
    hz : (n,) array [Hz]
        Frequencies of the modes [Hz].
    in_band : (n,) bool array
        Whether each lies in the band.

    Returns
    -------
    CondensedBasis

    Raises
    ------
    IdentificationError
        If no idle mode can be used.

    Examples
    --------
    >>> import numpy as np
    >>> from operando.scaling import condensed_basis
    >>> condensed_basis(np.eye(2), [20.0, 45.0], [True, True]).modes.tolist()
    [0, 1]
    """
    from scipy.linalg import qr

    a, f, inside = np.asarray(shapes, float), np.asarray(hz, float), np.asarray(in_band, bool)
    m = a.shape[0]
    first = np.flatnonzero(inside)
    if first.size == 0:
        raise IdentificationError("no idle mode lies in the analysis band", hint="widen the band or check the EMA")
    # Unit columns: a pivot order that does not depend on how large a shape is at the sensors.
    unit = a[:, first] / np.maximum(np.linalg.norm(a[:, first], axis=0), 1e-300)
    order = first[qr(unit, mode="r", pivoting=True)[1]]
    keep = list(order[:m])
    while len(keep) > 1 and condition(a[:, keep]) > KAPPA_LIMIT:
        keep.pop()
    for j in sorted(np.flatnonzero(~inside), key=lambda i: min(abs(f[i] - f[first[-1]]), abs(f[i] - f[first[0]]))):
        if len(keep) < m and condition(a[:, [*keep, j]]) <= max(KAPPA_EXTRA, condition(a[:, keep])):
            keep.append(j)
    modes = np.sort(np.array(keep, int))
    used = a[:, modes]
    condensed_mass(used)
    left, _, right = np.linalg.svd(used, full_matrices=False)
    best = choose_dofs(used)
    return CondensedBasis(
        modes,
        tuple(int(j) for j in first if j not in set(modes.tolist())),
        condition(used),
        tuple(int(modes[i]) for i in np.argsort(-np.abs(right[-1]))[:3]),
        tuple(int(i) for i in np.argsort(-np.abs(left[:, -1]))[:3]),
        tuple(best),
        condition(used[best]),
    )


def best_addition(shapes: ArrayLike, rows: ArrayLike, modes: ArrayLike) -> tuple[int, float] | None:
    """The DOF (row) that lowers κ most if it is measured as well, with κ; None where every DOF with a known shape is measured already.

    ``shapes`` (M, n) are at all DOFs whose idle shapes are known, ``rows`` are measured now.
    """
    a, now, chosen = np.asarray(shapes, float), np.asarray(rows, int), np.asarray(modes, int)
    others = np.setdiff1d(np.arange(a.shape[0]), now)
    if others.size == 0:
        return None
    reached = [condition(a[np.append(now, row)][:, chosen]) for row in others]
    best = int(np.argmin(reached))
    return int(others[best]), reached[best]

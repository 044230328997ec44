"""Indicators of modal vectors and FRFs: MAC, MPC, MPD, correlation of FRFs."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data.declared import explain_arguments
from operando.data.frf import Frf
from operando.data.modal import ModalModel, phase_collinearity
from operando.data.objects import counted, names_text
from operando.dof import Dof, DofIndex
from operando.errors import DataError, ObjectError

__all__ = ["common_shapes", "frf_correlation", "left_out", "mac", "mean_phase_deviation", "phase_collinearity"]

INTERVAL = 1.96
"""Standard deviations in the 95 % interval, which is what ± stands for wherever people read it."""


def mac(first: ArrayLike | ModalModel, second: ArrayLike | ModalModel | None = None) -> NDArray[np.float64]:
    """Modal assurance criterion |aᴴb|²/((aᴴa)(bᴴb)) (Shen & Lu 2024, Eq 1).

    Parameters
    ----------
    first : (m, n1) array or ModalModel
        Shapes in columns; of models, at the DOFs that both have, in the sense of the first. A warning names the DOFs that only one
        has.
    second : (m, n2) array or ModalModel, optional
        Default: ``first`` (AutoMAC).

    Returns
    -------
    (n1, n2) array between 0 and 1; 0 where a vector is null.

    Raises
    ------
    ObjectError
        If one is a model and the other is not.
    DataError
        If two models have fewer than two DOFs in common, over which every MAC is 1, or arrays have different numbers of rows
        or values that are not finite.

    Examples
    --------
    >>> import operando
    >>> operando.mac([[1.0, 0.0], [1.0, 1.0]]).round(2)
    array([[1. , 0.5],
           [0.5, 1. ]])
    """
    other = first if second is None else second
    if isinstance(first, ModalModel) or isinstance(other, ModalModel):
        if not (isinstance(first, ModalModel) and isinstance(other, ModalModel)):
            found = f"{type(first).__name__} and {type(other).__name__}"
            raise ObjectError(f"MAC of {found} is not defined", hint="give two models, or two arrays of shapes: model.shapes")
        a, b, dofs = common_shapes(first, other)
        if len(dofs) < 2:
            raise DataError(
                f"the models have only the DOF {dofs[0]} in common: over one DOF every MAC is 1",
                hint="measure both states at two DOFs or more; DOFs of the first: " + ", ".join(map(str, first.dofs[:20])),
            )
        if left := left_out(first, other, dofs):
            warnings.warn(f"MAC {left}", stacklevel=3)
    else:
        a, b = np.asarray(first), np.asarray(other)
    if not (np.issubdtype(a.dtype, np.number) and np.issubdtype(b.dtype, np.number) and a.ndim in (1, 2) and b.ndim in (1, 2)):
        raise ObjectError(
            f"MAC of {type(first).__name__} and {type(other).__name__} is not defined", hint="give models or arrays of shapes"
        )
    if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b))):
        raise DataError("shapes with values that are not finite have no MAC", hint="leave out the DOFs that were not measured")
    a = a[:, None] if a.ndim == 1 else a
    b = b[:, None] if b.ndim == 1 else b
    if a.shape[0] != b.shape[0]:
        raise DataError(f"shapes at {a.shape[0]} and at {b.shape[0]} DOFs have no MAC", hint="models find their common DOFs: mac(a, b)")
    cross = np.abs(a.conj().T @ b) ** 2
    norm = np.outer(np.sum(np.abs(a) ** 2, axis=0), np.sum(np.abs(b) ** 2, axis=0))
    return np.divide(cross, norm, out=np.zeros(norm.shape), where=norm > 0)


def left_out(first: ModalModel, second: ModalModel, dofs: Sequence[Dof]) -> str:
    """Which DOFs two models do not share, in words; empty where they share all.

    Parameters
    ----------
    first, second : ModalModel
        Two models.
    dofs : sequence of Dof
        Those they share.

    Returns
    -------
    str

    Examples
    --------
    >>> import numpy as np, operando
    >>> one, two = (operando.ModalModel([20.0], [0.01], np.ones((2, 1)), dofs) for dofs in ("1+Z, 2+Z", "2+Z, 3+Z"))
    >>> left_out(one, two, common_shapes(one, two)[2])
    'over 1 common DOF; left out: 1+Z of the first, 3+Z of the second'
    """
    shared = DofIndex(dofs)
    alone = [[d for d in model.dofs if d not in shared] for model in (first, second)]
    words = [f"{names_text(names)} of the {which}" for names, which in zip(alone, ("first", "second"), strict=True) if names]
    return f"over {counted(len(dofs), 'common DOF')}; left out: {', '.join(words)}" if words else ""


def common_shapes(first: ModalModel, second: ModalModel) -> tuple[NDArray[Any], NDArray[Any], tuple[Any, ...]]:
    """Shapes of two models at the DOFs that both have, in the sense of the first.

    Parameters
    ----------
    first : ModalModel
        One model.
    second : ModalModel
        Another model.

    Returns
    -------
    (k, n1) array, (k, n2) array, tuple of k Dof

    Raises
    ------
    DataError
        If there is no such DOF.

    Examples
    --------
    >>> import numpy as np, operando
    >>> first = operando.ModalModel([20.0], [0.01], np.array([[1.0], [2.0]]), "1+Z, 2+Z", "unscaled")
    >>> second = operando.ModalModel([20.0], [0.01], np.array([[-2.0]]), "2-Z", "unscaled")
    >>> shapes, others, dofs = common_shapes(first, second)
    >>> shapes.tolist(), others.tolist()
    ([[2.0]], [[2.0]])
    """
    rows = DofIndex(first.dofs).common(second.dofs)
    if not rows:
        raise DataError("the models have no DOF in common", hint="DOFs of the first: " + ", ".join(map(str, first.dofs[:20])))
    i, j, sign = (np.array(column, int) for column in zip(*rows, strict=True))
    return np.asarray(first.shapes)[i], np.asarray(second.shapes)[j] * sign[:, None], tuple(first.dofs[k] for k in i)


def frf_correlation(first: Frf, second: Frf) -> NDArray[np.float64]:
    """Frequency response assurance criterion of each pair: |Σ a* b|²/(Σ|a|² Σ|b|²) over the lines (Heylen & Lammens 1996).

    Parameters
    ----------
    first, second : Frf
        On the same pairs and lines. Lines that are not finite in either are left out.

    Returns
    -------
    (n_responses, n_references) array
        Between 0 and 1; NaN where a pair has no line.

    Raises
    ------
    DataError
        If pairs or lines differ.

    Examples
    --------
    >>> frf = Frf([[[1.0, 2.0j, 3.0]]], [1.0, 2.0, 3.0], "1+Z", "1+Z")
    >>> frf_correlation(frf, frf)
    array([[1.]])
    """
    same = (first.responses, first.references) == (second.responses, second.references) and first.same_lines(second)
    if not same:
        raise DataError("FRFs of other pairs or lines have no correlation", hint="synthesise on the lines and pairs of the measurement")
    a, b = first.data, second.to_quantity(first.quantity).data
    good = np.isfinite(a) & np.isfinite(b)
    a, b = np.where(good, a, 0), np.where(good, b, 0)
    cross = np.abs(np.sum(a.conj() * b, axis=2)) ** 2
    size = np.sum(np.abs(a) ** 2, axis=2) * np.sum(np.abs(b) ** 2, axis=2)
    return np.divide(cross, size, out=np.full(cross.shape, np.nan), where=size > 0)


def mean_phase_deviation(shape: ArrayLike) -> float:
    """Mean phase deviation [rad] of one shape from its principal axis, weighted by magnitude (Reynders et al. 2012).

    Parameters
    ----------
    shape : array
        One mode shape.

    Returns
    -------
    float
        [rad], 0 for a real mode.

    Examples
    --------
    >>> mean_phase_deviation([1.0, -0.5])
    0.0
    """
    v: NDArray[Any] = np.asarray(shape, complex)
    if not np.any(v):
        return 0.0
    axis = np.linalg.svd(np.column_stack([v.real, v.imag]), full_matrices=False)[2][0]
    along = np.abs(v.real * axis[0] + v.imag * axis[1])
    size = np.abs(v)
    angle = np.arccos(np.clip(np.divide(along, size, out=np.ones_like(size), where=size > 0), 0, 1))
    return float(np.sum(size * angle) / np.sum(size))


explain_arguments(__name__)

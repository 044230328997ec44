"""Where a model fails: level error by response DOF and frequency band."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.lib.array_utils import normalize_axis_tuple
from numpy.typing import ArrayLike, NDArray

from operando.compare.measures import SNR_LIMIT, band_masks
from operando.data import Frf
from operando.errors import DataError


def clear_lines(frf: Frf, band: tuple[float, float] | None = None) -> NDArray[np.bool_]:
    """(n_responses, n_references, n_lines) mask of finite lines in band well above the noise.

    Parameters
    ----------
    frf : Frf
        FRFs.
    band : (float, float), optional
        Lowest and highest line [Hz] to keep.

    Returns
    -------
    bool array
        True where a line counts.

    Examples
    --------
    >>> import numpy as np, operando
    >>> idle = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> frf = idle.frf(np.arange(5, 80, 0.1))
    >>> from operando.compare import clear_lines
    >>> clear_lines(frf, (10, 20)).sum(axis=2).tolist()
    [[100, 100], [100, 100]]
    """
    size2 = np.abs(frf.data) ** 2
    mask = np.isfinite(size2) & (size2 > 0)
    if frf.variance is not None:
        with np.errstate(invalid="ignore"):
            mask &= size2 > SNR_LIMIT * frf.variance
    if band is not None:
        f = frf.frequencies_hz
        mask &= ((f >= band[0]) & (f <= band[1]))[None, None, :]
    return mask


def level_error_db(model: Frf, measured: Frf) -> NDArray[np.float64]:
    """20·log10(|H_model|/|H_measured|) for each pair and line [dB]; NaN where either is zero or not finite.

    Parameters
    ----------
    model : Frf
        FRFs of the model.
    measured : Frf
        Measured FRFs on the same lines and pairs.

    Returns
    -------
    array
        One value for each pair and line.

    Examples
    --------
    >>> import operando
    >>> one = operando.Frf([[[1.0, 2.0]]], [5.0, 6.0], "1+Z", "1+Z")
    >>> level_error_db(operando.Frf(10 * one.data, [5.0, 6.0], "1+Z", "1+Z"), one).tolist()
    [[[20.0, 20.0]]]
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(model.data) / np.abs(measured.data)
        out = 20 * np.log10(ratio)
    return np.where(np.isfinite(out), out, np.nan)


def rms_over(values: NDArray[np.float64], mask: NDArray[np.bool_], axis: int | Sequence[int] | None = None) -> Any:
    """Root mean square of the masked finite values along some axes; NaN where there are none.

    Parameters
    ----------
    values : array
        Values of any shape.
    mask : bool array
        Which of them count; same shape.
    axis : int or sequence of int, optional
        Axis or axes to average over; default: all.

    Returns
    -------
    float or array
        One value for each index of the axes that are left.

    Raises
    ------
    DataError
        If the mask has another shape, or an axis is not there or named twice.

    Examples
    --------
    >>> import numpy as np
    >>> float(rms_over(np.array([3.0, 4.0, 100.0]), np.array([True, True, False])).round(3))
    3.536
    """
    values, mask = np.asarray(values), np.asarray(mask)
    if values.shape != mask.shape:
        raise DataError(f"values of shape {values.shape} and a mask of shape {mask.shape}", hint="give both the same shape")
    try:
        over = None if axis is None else normalize_axis_tuple(axis, values.ndim)
    except ValueError as error:
        hint = "give one axis or several, each once, counted from 0"
        raise DataError(f"axis {axis!r} of values with {values.ndim} axes: {error}", hint=hint) from error
    use = mask & np.isfinite(values)
    total = np.sum(np.where(use, values, 0.0) ** 2, axis=over)
    n = np.sum(use, axis=over)
    return np.sqrt(np.divide(total, n, out=np.full(np.shape(total), np.nan), where=n > 0))


def error_map(model: Frf, measured: Frf, edges_hz: ArrayLike) -> NDArray[np.float64]:
    """Level error by response DOF and frequency band, over all references.

    Parameters
    ----------
    model, measured : Frf
        On the same pairs and lines.
    edges_hz : (n_bands + 1,) array
        Limits of the bands [Hz], increasing.

    Returns
    -------
    (n_responses, n_bands) array
        Rms error [dB] over the lines that stand clear of the noise; NaN where there is none.

    Raises
    ------
    DataError
        If pairs or lines differ.

    Examples
    --------
    >>> frf = Frf(np.ones((1, 1, 4)), [1.0, 2.0, 3.0, 4.0], "1+Z", "1+Z")
    >>> error_map(Frf(2 * frf.data, frf.axis, "1+Z", "1+Z"), frf, [1, 2.5, 4]).round(2)
    array([[6.02, 6.02]])
    """
    if model.data.shape != measured.data.shape or not model.same_lines(measured):
        raise DataError(f"FRFs {model.data.shape} and {measured.data.shape} are not on the same pairs and lines")
    error, mask = level_error_db(model, measured), clear_lines(measured)
    bands = band_masks(measured.frequencies_hz, np.asarray(edges_hz, float))
    return np.column_stack([rms_over(error, mask & inside, axis=(1, 2)) for inside in bands])

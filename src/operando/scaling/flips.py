"""Classes near ε: an operational mode whose MAC is not sure to lie on one side may be scaled by the other rule."""

from __future__ import annotations

from dataclasses import replace
from math import erfc, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel
from operando.errors import IdentificationError
from operando.scaling.methods import Task, scaled_shapes

CLASSED = ("eq13", "eq15", "eq20")
"""Methods that treat changed and unchanged modes differently."""

NEGLIGIBLE = 0.01
"""Probability below which a flip is left out."""


def flip_probability(
    idle: NDArray[np.float64],
    turned: NDArray[np.float64],
    partners: NDArray[np.int_],
    noise: NDArray[np.float64] | None,
    model: ModalModel,
    rows: list[int],
    threshold: float,
) -> NDArray[np.float64]:
    """Probability (n,) that the MAC with the partner lies on the other side of ε, to first order in the noise of both shapes.

    Operational shapes are ``turned`` to the real axis and of unit length, ``noise`` (n, m, m) is their covariance; that of the idle shapes
    comes from the model, whose DOFs are ``rows``.
    """
    out = np.zeros(turned.shape[1])
    std = model.terms.shape_std
    for r in np.flatnonzero(partners >= 0):
        e, o = idle[:, partners[r]], turned[:, r]
        length = float(np.linalg.norm(e))
        unit = e / length
        cosine = float(unit @ o)
        variance = 0.0
        if noise is not None:
            along = 2 * cosine * (unit - cosine * o)
            variance += float(along @ noise[r] @ along)
        if std is not None:
            along = 2 * cosine * (o - cosine * unit) / length
            variance += float(np.sum((along * np.asarray(std, float)[rows, partners[r]]) ** 2))
        if variance > 0:
            out[r] = 0.5 * erfc(abs(cosine**2 - threshold) / sqrt(2 * variance))
    return out


def class_flips(
    method: str, idle: NDArray[np.float64], operating: NDArray[Any], task: Task, likely: NDArray[np.float64], size: int, modes: int
) -> NDArray[np.float64]:
    """Covariance (size, size) of [f, ζ, shapes mode by mode] to add: each likely flip by its probability and how far it moves the shapes.

    ``modes`` counts the terms of the scaled model, those carried over included.
    """
    out = np.zeros((size, size))
    flips = np.flatnonzero(likely > NEGLIGIBLE) if method in CLASSED else np.zeros(0, int)
    if flips.size == 0:
        return out
    n, m = operating.shape[1], idle.shape[0]
    at = slice(2 * modes, 2 * modes + n * m)
    now = scaled_shapes(method, idle, operating, task)
    for r in flips:
        other = task.keep_msf.copy()
        other[r] = not other[r]
        try:
            moved = (scaled_shapes(method, idle, operating, replace(task, keep_msf=other)) - now).T.ravel()
        except IdentificationError:
            continue  # the other rule does not exist for this mode
        out[at, at] += likely[r] * np.outer(moved, moved)
    return out

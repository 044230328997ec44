"""Covariance of the scaled model from the covariances of idle and operational modes.

The map from (idle shapes, operational shapes, frequencies) to scaled shapes is linearised along the principal directions of
each covariance: two calls a direction, all directions at once, the step a fixed small part of the shapes. So every method is
covered by the same code, and the number of directions is the rank of the covariance. Pairs, classes and prior are held fixed.
The expansion adds what its prior leaves open.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel
from operando.scaling.doubt import ScaleDoubt
from operando.scaling.expansion import prior_spread
from operando.scaling.methods import Task, real_shapes, scaled_shapes

STEP = 1e-4
"""Largest change of a shape value in one step, over the rms of its shape."""

RANK_TOLERANCE = 1e-10
"""Principal directions below this part of the largest (of the correlation matrix) are left out."""

LARGEST = 5000
"""Parameters of the scaled model above which no covariance is made."""

CHUNK = 64


def covariance_of(model: ModalModel) -> NDArray[np.float64] | None:
    """Covariance of a model, diagonal where only standard deviations are kept; None where there is neither."""
    if model.covariance is not None:
        return np.asarray(model.covariance)
    if model.std is None or any(model.std.get(k) is None for k in ("frequencies_hz", "damping_ratios", "shapes")):
        return None
    shape = np.asarray(model.std["shapes"], float).T.ravel() ** 2
    parts = [np.asarray(model.std["frequencies_hz"], float) ** 2, np.asarray(model.std["damping_ratios"], float) ** 2]
    parts += [shape / 2, shape / 2] if np.iscomplexobj(model.terms.shapes) else [shape]
    return np.diag(np.concatenate(parts))


def factor_of(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """L with C = LLᵀ, by principal directions of the correlation matrix."""
    sd = np.sqrt(np.maximum(np.diag(covariance), 0))
    live = sd > 0
    out = np.zeros((sd.size, 0))
    if not np.any(live):
        return out
    s = sd[live]
    value, vector = np.linalg.eigh(covariance[np.ix_(live, live)] / np.outer(s, s))
    keep = value > RANK_TOLERANCE * value[-1]
    out = np.zeros((sd.size, int(np.sum(keep))))
    out[live] = s[:, None] * vector[:, keep] * np.sqrt(value[keep])
    return out


def shape_block(model: ModalModel, rows: list[int]) -> list[NDArray[np.int_]]:
    """Indices into θ of the shape values at some DOFs, (n_terms, n_rows), real (and imaginary) parts."""
    n, m = model.terms.n, len(model.dofs)
    real = 2 * n + np.arange(n)[:, None] * m + np.asarray(rows)[None, :]
    return [real, real + n * m] if np.iscomplexobj(model.terms.shapes) else [real]


def _directions(factor: NDArray[np.float64], model: ModalModel, rows: list[int], signs: NDArray[np.float64]) -> NDArray[Any]:
    """Shape changes (r, m, n) along each column of a factor."""
    blocks = [np.moveaxis(factor[b], -1, 0).transpose(0, 2, 1) * signs[:, None] for b in shape_block(model, rows)]
    return np.asarray(blocks[0] + 1j * blocks[1] if len(blocks) == 2 else blocks[0])


def scaled_covariance(
    method: str,
    idle: ModalModel,
    operating: ModalModel,
    rows: list[int],
    operating_rows: list[int],
    signs: NDArray[np.float64],
    task: Task,
    carried: NDArray[np.int_],
) -> NDArray[np.float64] | None:
    """Covariance of [f, ζ, shapes mode by mode] of operational modes followed by the idle terms carried over.

    A model without a covariance counts as exact; None where neither carries one, or the model is too large. ``idle`` has its residual
    terms, ``operating`` none; ``signs`` are the sense of the operational DOFs (``operating_rows``) against the idle ones (``rows``).
    """
    n, k, m = operating.n_modes, carried.size, len(rows)
    total = (n + k) * (2 + m)
    idle_cov, operating_cov = covariance_of(idle), covariance_of(operating)
    if (idle_cov is None and operating_cov is None) or total > LARGEST:
        return None
    e = np.asarray(idle.terms.shapes, float)[rows]
    o = np.asarray(operating.shapes)[operating_rows] * signs[:, None]
    out = np.zeros((total, total))
    shape_at = 2 * (n + k) + np.arange((n + k) * m).reshape(n + k, m)
    if operating_cov is not None:
        factor = factor_of(operating_cov)
        change = np.zeros((total, factor.shape[1]))
        change[:n], change[n + k : n + k + n] = factor[:n], factor[n : 2 * n]
        moved = _slope(method, e, o, task, np.zeros(0), _directions(factor, operating, operating_rows, signs), None, factor[:n].T)
        change[shape_at[:n].ravel()] = moved.transpose(2, 1, 0).reshape(n * m, -1)
        out += change @ change.T
    if idle_cov is not None:
        factor = factor_of(idle_cov)
        change = np.zeros((total, factor.shape[1]))
        change[n : n + k], change[2 * n + k : 2 * (n + k)] = factor[carried], factor[idle.terms.n + carried]
        direct = _directions(factor, idle, rows, np.ones(m)).real
        moved = _slope(method, e, o, task, direct, np.zeros(0), factor[: idle.terms.n].T, None)
        change[shape_at[:n].ravel()] = moved.transpose(2, 1, 0).reshape(n * m, -1)
        change[shape_at[n:].ravel()] = direct[:, :, carried].transpose(2, 1, 0).reshape(k * m, direct.shape[0])
        out += change @ change.T
    if method.startswith("expansion"):
        ratio = (task.idle_hz[:, None] / task.operating_hz[None, :]) ** 2 if method == "expansion_stiffness" else np.ones((e.shape[1], n))
        for r, spread in enumerate(prior_spread(e, real_shapes(o)[0], ratio, task.prior)):
            out[np.ix_(shape_at[r], shape_at[r])] += spread @ spread.T
    return (out + out.T) / 2


def with_unseen_change(
    covariance: NDArray[np.float64],
    modal: ModalModel,
    n: int,
    imaginary: NDArray[np.float64],
    frequency_spread: NDArray[np.float64],
    shape_change: NDArray[np.float64],
    doubt: ScaleDoubt | None,
) -> NDArray[np.float64]:
    """Covariance with what no identification can know: what real shapes leave out, and how operation changed the modes it did not show.

    ``modal`` has ``n`` operational modes, and the idle terms carried over as residual terms. ``imaginary`` (m, n) is that part of each
    operational shape at its scale, as far as noise does not explain it: an error of the real shape that shows in the FRF with the same
    size. ``frequency_spread`` and ``shape_change`` (k,) are relative, of what is carried over; ``doubt`` is what a change of mass (or of
    stiffness, where that was kept) leaves of the scale.
    """
    out = np.array(covariance)
    terms, m = modal.terms, len(modal.dofs)
    total = terms.n
    for r in range(n):
        at = slice(2 * total + r * m, 2 * total + (r + 1) * m)
        out[at, at] += np.outer(imaginary[:, r], imaginary[:, r])
    if doubt is not None:
        shapes = np.asarray(terms.shapes)[:, :n]
        together = (shapes * doubt.common / 2).T.ravel()
        at = slice(2 * total, 2 * total + n * m)
        out[at, at] += np.outer(together, together)
        for r in range(n):
            at = slice(2 * total + r * m, 2 * total + (r + 1) * m)
            out[at, at] += (doubt.own[r] / 2) ** 2 * np.outer(shapes[:, r], shapes[:, r])
    carried = np.arange(n, total)
    out[carried, carried] += (frequency_spread * terms.frequencies_hz[carried]) ** 2
    mean_square = np.mean(np.asarray(terms.shapes)[:, carried] ** 2, axis=0)
    diagonal = 2 * total + carried[:, None] * m + np.arange(m)
    out[diagonal, diagonal] += (shape_change**2 * mean_square)[:, None]
    return out


def _slope(
    method: str,
    idle: NDArray[np.float64],
    operating: NDArray[Any],
    task: Task,
    idle_change: NDArray[np.float64],
    operating_change: NDArray[Any],
    idle_hz_change: NDArray[np.float64] | None,
    operating_hz_change: NDArray[np.float64] | None,
) -> NDArray[np.float64]:
    """Derivative (r, m, n) of the scaled shapes along directions, by central differences."""
    changes = [c for c in (idle_change, operating_change) if c.size]
    if not changes:
        return np.zeros((0, *operating.shape))
    base = idle if idle_change.size else operating
    size = np.sqrt(np.mean(np.abs(base) ** 2, axis=0))
    relative = np.max(np.abs(changes[0]) / np.where(size > 0, size, 1), axis=(1, 2))
    hz, hz_change = (task.idle_hz, idle_hz_change) if idle_change.size else (task.operating_hz, operating_hz_change)
    assert hz_change is not None
    relative = np.maximum(relative, np.max(np.abs(hz_change) / np.maximum(hz, 1e-12), axis=1))
    step = STEP / np.where(relative > 0, relative, 1)
    out = []
    for start in range(0, step.size, CHUNK):
        part = slice(start, start + CHUNK)
        h = step[part, None, None]
        ends = []
        for sign in (1, -1):
            moved = changes[0][part] * (h * sign)
            moved_hz = hz + hz_change[part] * (h[:, :, 0] * sign)
            if idle_change.size:
                ends.append(scaled_shapes(method, idle + moved, operating, replace(task, idle_hz=moved_hz)))
            else:
                ends.append(scaled_shapes(method, idle, operating + moved, replace(task, operating_hz=moved_hz)))
        # A shape may come out with the other sign; it is the same shape.
        sense = np.where(np.sum(ends[0] * ends[1], axis=-2, keepdims=True) < 0, -1, 1)
        middle = np.sign(np.sum(ends[0] * scaled_shapes(method, idle, operating, task), axis=-2, keepdims=True))
        out.append((ends[0] - sense * ends[1]) * np.where(middle == 0, 1, middle) / (2 * h))
    return np.concatenate(out)

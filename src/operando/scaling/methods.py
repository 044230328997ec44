"""Scale of operational shapes: every named method as a function of arrays, with leading batch dimensions.

All shapes may carry leading dimensions (..., m, n), so that one call serves many perturbed shapes at once.
No result depends on the arbitrary complex scale of an operational shape: each column is first rotated to the real axis and
brought to a fixed size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data import Finding
from operando.data.arrays import ByContent
from operando.errors import ConfigError, IdentificationError
from operando.limits import METHODS
from operando.scaling.expansion import Prior, expand, unit_size

IN_WORDS = {
    "msf_all": "all modes by MSF onto their idle partner (Eq 2, 3)",
    "sqrt_mac": "all modes by MSF over the square root of MAC",
    "eq13": "modes of the same shape by MSF, changed modes one by one to unit modal mass (Eq 13)",
    "eq15": "modes of the same shape by MSF, changed modes together by the principal square root (Eq 15)",
    "eq20": "modes of the same shape by MSF, changed modes by the swapped root over all modes (Eq 20)",
    "idle_shapes": "idle shapes with operational poles",
    "expansion": "prior-weighted expansion in the idle modes, mass as idle",
    "expansion_stiffness": "prior-weighted expansion in the idle modes, stiffness as idle",
}
"""What each method does."""

NOISE_ONLY = ("msf_all", "eq13", "eq15", "eq20", "idle_shapes")
"""Methods whose covariance holds what noise does to their result, and not how far their assumption is from the structure."""

Array = NDArray[Any]


def noise_only(method: str) -> list[Finding]:
    """The finding that the intervals of a method asked for by name hold noise only; none for the others.

    >>> [f.kind for f in noise_only("eq15")], noise_only("expansion")
    (['noise_only_interval'], [])
    """
    if method not in NOISE_ONLY:
        return []
    return [
        Finding(
            "noise_only_interval",
            f"scaling by {method}, asked for by name: the intervals of its operational FRFs hold noise only",
            "warning",
            consequence="the error of what the method assumes is not in them: the 95 % band may hold far less than 95 % of the true FRF",
            action='compare with method="auto"; `alternatives` states how many dB lie between the methods',
        )
    ]


def real_shapes(shapes: ArrayLike) -> tuple[Array, Array]:
    """Rotate complex shapes to the real axis and take the real part (Shen & Lu 2024, Eq 10–12, with the principal axis).

    The mean direction is the principal axis of (Re, Im), ½·arg Σφ², which does not break down near the imaginary axis.

    Parameters
    ----------
    shapes : (..., m, n) complex array
        Shapes in columns.

    Returns
    -------
    real : (..., m, n) array
        Columns of unit length, sign arbitrary.
    factor : (..., n) complex array
        real = Re(factor · shapes).

    Examples
    --------
    >>> import numpy as np
    >>> from operando.scaling import real_shapes
    >>> real_shapes(np.array([[3j], [4j]]))[0].round(3).ravel().tolist()
    [0.6, 0.8]
    """
    v = np.asarray(shapes, complex)
    # Only the sum of squares decides; dividing by the largest value first keeps any scale safe from overflow.
    size = np.max(np.abs(v), axis=-2, keepdims=True)
    u = v / np.where(size > 0, size, 1)
    angle = 0.5 * np.angle(np.sum(u * u, axis=-2))
    turned = np.real(u * np.exp(-1j * angle)[..., None, :])
    length = np.linalg.norm(turned, axis=-2)
    length = np.where(length > 0, length, 1)
    factor = np.exp(-1j * angle) / (length * np.where(size > 0, size, 1)[..., 0, :])
    return turned / length[..., None, :], factor


def modal_scale_factor(operating: ArrayLike, idle: ArrayLike) -> Array:
    """MSF = φ_oᴴφ̂_e / (φ_oᴴφ_o) for each column pair (Shen & Lu 2024, Eq 2, 3).

    Parameters
    ----------
    operating, idle : (..., m, n) arrays
        Operational shapes in columns.

    Returns
    -------
    (..., n) complex array

    Examples
    --------
    >>> import numpy as np
    >>> from operando.scaling import modal_scale_factor
    >>> modal_scale_factor(np.array([[1.0], [2.0]]), np.array([[0.5], [1.0]])).real.tolist()
    [0.5]
    """
    o, e = np.asarray(operating), np.asarray(idle)
    return np.sum(o.conj() * e, axis=-2) / np.sum(np.abs(o) ** 2, axis=-2)


def _root(matrix: Array, power: float) -> Array:
    """Principal power of symmetric positive matrices."""
    value, vector = np.linalg.eigh(matrix)
    return np.einsum("...ik,...k,...jk->...ij", vector, np.maximum(value, 1e-300) ** power, vector)


@dataclass(frozen=True, eq=False)
class Task(ByContent):
    """What is fixed while shapes vary: pairs, classes, basis."""

    partners: NDArray[np.int_]  # (n_operating,): idle index or −1
    keep_msf: NDArray[np.bool_]  # (n_operating,): unchanged and beyond-band modes, scaled by MSF in the paper's methods
    basis: NDArray[np.int_]  # idle modes of the condensed mass
    # idle_hz, operating_hz: leading dimensions as the shapes
    idle_hz: NDArray[np.float64]
    operating_hz: NDArray[np.float64]
    prior: Prior


def scale_msf(idle: Array, operating: Array, task: Task) -> Array:
    """Re(MSF·φ_o) for paired modes (Eq 2, 3); modes without a partner by Eq 13."""
    out = scale_eq13(idle, operating, task, np.flatnonzero(task.partners < 0))
    r = np.flatnonzero(task.partners >= 0)
    partner = idle[..., :, task.partners[r]]
    factor = modal_scale_factor(operating[..., :, r], partner)
    out[..., :, r] = np.real(operating[..., :, r] * factor[..., None, :])
    return out


def scale_eq13(idle: Array, operating: Array, task: Task, columns: ArrayLike) -> Array:
    """φ̂ = φ̃/√(φ̃ᵀM_mφ̃) on the given columns (Eq 13); zero elsewhere. φ̃ᵀM_mφ̃ = qᵀq with q = Φ†φ̃."""
    index = np.asarray(columns, int)
    shape = np.broadcast_shapes(idle.shape[:-2], operating.shape[:-2])
    out = np.zeros((*shape, *operating.shape[-2:]))
    if index.size:
        turned = real_shapes(operating[..., :, index])[0]
        q = np.linalg.pinv(idle[..., :, task.basis]) @ turned
        out[..., :, index] = turned / _modal_size(np.linalg.norm(q, axis=-2))[..., None, :]
    return out


def _modal_size(size: Array) -> Array:
    if np.any(size <= 1e-9 * np.max(size)):
        raise IdentificationError(
            "an operational shape has no part in the span of the idle shapes: its modal mass is ill-determined",
            hint="use msf_all or idle_shapes, or use more sensors",
        )
    return size


def scale_eq15(idle: Array, operating: Array, task: Task, columns: ArrayLike) -> Array:
    """Φ̂ = Φ̃(Φ̃ᵀM_mΦ̃)^(−1/2), columns first of unit modal mass (Eq 14, 15; scale-invariant form)."""
    index = np.asarray(columns, int)
    out = scale_eq13(idle, operating, task, index)
    if index.size > 1:
        part = out[..., :, index]
        q = np.linalg.pinv(idle[..., :, task.basis]) @ part
        gram = np.swapaxes(q, -1, -2) @ q
        if np.min(np.linalg.eigvalsh(gram)) < 1e-8:
            raise IdentificationError(
                "the changed operational shapes are linearly dependent in the span of the idle shapes: Eq 15 has no principal root",
                hint="use eq13 or msf_all",
            )
        out[..., :, index] = part @ _root(gram, -0.5)
    return out


def scale_eq20(idle: Array, operating: Array, task: Task) -> Array:
    """Φ̂ = Φ[Φ⁻¹(Φ̂_eΦ̂_eᵀ)Φ⁻ᵀ]^(1/2) over all operational modes, columns first of unit modal mass (Eq 20; scale-invariant form)."""
    every = np.arange(operating.shape[-1])
    unit = scale_eq13(idle, operating, task, every)
    if unit.shape[-1] > unit.shape[-2]:
        raise IdentificationError(
            f"Eq 20 needs at most as many operational modes ({unit.shape[-1]}) as DOFs ({unit.shape[-2]})", hint="use eq13 or msf_all"
        )
    p = np.linalg.pinv(unit) @ idle[..., :, task.basis]
    return unit @ _root(p @ np.swapaxes(p, -1, -2), 0.5)


def scale_expansion(idle: Array, operating: Array, task: Task, keep: str) -> Array:
    """All modes by prior-weighted expansion; ``keep`` says what is as at rest, "mass" or "stiffness"."""
    q, shape, rest = expand(idle, real_shapes(operating)[0], task.prior)
    paired = task.partners[task.partners >= 0]
    in_sight = paired if paired.size else np.arange(idle.shape[-1])
    weight = task.idle_hz[..., :, None] / task.operating_hz[..., None, :] if keep == "stiffness" else np.ones(q.shape[-2:])
    return unit_size(idle, q, shape, rest, weight, task.prior.mixing, in_sight)


def scaled_shapes(method: str, idle: Array, operating: Array, task: Task) -> Array:
    """Real operational shapes of unit modal mass by a named method, from complex ones (…, m, n_operating) of arbitrary scale.

    Idle shapes (…, m, n_idle) are real and of unit modal mass.
    """
    if method not in METHODS:
        raise ConfigError(f"scaling method {method!r} is none of {', '.join(('auto', *METHODS))}")
    out = _by_method(method, idle, operating, task)
    paired = np.flatnonzero(task.partners >= 0)
    sense = np.sum(out[..., :, paired] * idle[..., :, task.partners[paired]], axis=-2, keepdims=True)
    out[..., :, paired] *= np.where(sense < 0, -1.0, 1.0)
    return out


def _by_method(method: str, idle: Array, operating: Array, task: Task) -> Array:
    if method.startswith("expansion"):
        return scale_expansion(idle, operating, task, "stiffness" if method == "expansion_stiffness" else "mass")
    by_msf = scale_msf(idle, operating, task)
    if method == "msf_all":
        return by_msf
    paired = np.flatnonzero(task.partners >= 0)
    partner = np.broadcast_to(idle[..., :, task.partners[paired]], (*by_msf.shape[:-1], paired.size))
    if method == "idle_shapes":
        by_msf[..., :, paired] = partner
        return by_msf
    if method == "sqrt_mac":
        now = by_msf[..., :, paired]
        size = np.linalg.norm(partner, axis=-2) / np.linalg.norm(now, axis=-2)
        by_msf[..., :, paired] = now * size[..., None, :]
        return by_msf
    changed = np.flatnonzero(~task.keep_msf)
    if changed.size == 0:
        return by_msf
    if method == "eq20":
        other = scale_eq20(idle, operating, task)
    elif method == "eq15":
        other = scale_eq15(idle, operating, task, changed)
    else:
        other = scale_eq13(idle, operating, task, changed)
    by_msf[..., :, changed] = other[..., :, changed]
    return by_msf

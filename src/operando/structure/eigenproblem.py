"""Poles and complex shapes of the running structure: the eigenproblem of idle modes and added dynamic stiffness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel
from operando.errors import IdentificationError
from operando.structure.effects import Effect, Quadratic
from operando.synthesis import second_order_poles

Array = NDArray[Any]
Placed = Sequence[tuple[Effect, Array]]
Acting = Sequence[tuple[Effect, Array, Array]]  # with its displacements by the modal coordinates, and how these lag (times s)

_ITERATIONS = 40
_CLOSE = 1e-11
"""Relative change of a pole at which its iteration ends."""
_SETTLED = 1e-6
"""Relative change that the last step of a pole may have: double poles are found to the square root of the precision, 1e-8."""


@dataclass(frozen=True)
class RunningDetails:
    """What a modal model of the running structure says besides poles and shapes."""

    left: Array | None
    """Left shapes l (n_dofs, n_terms) of such a scale that the receptance is Σ ψ lᵀ/(iω − λ) and its conjugate part, where no pole is
    real; equal to the shapes up to a factor unless an effect is skew. None where an effect has no finite number of poles, or shapes lag."""
    real_poles: NDArray[np.float64]
    """Poles without oscillation [rad/s], which have no frequency."""


def modal_matrices(base: ModalModel, placed: Placed) -> tuple[Quadratic, list[tuple[Effect, Array, Array]]]:
    """M, C, K over the idle modes of unit modal mass followed by the effects' internal coordinates; without lags of shapes.

    The effects that say no M, C, K of their own (hysteretic, rubber) stand apart.
    """
    n = base.terms.n
    # a term that is taken away has a negative mass of one, and is tied to no other
    mass, damping, stiffness = (base.terms.signs[:, None] * a for a in (np.eye(n), *base.terms.quadratic))
    rest = []
    for effect, weights in placed:
        at = np.asarray(weights @ base.terms.shapes)
        k = at.shape[0]
        form = effect.definition.quadratic(effect.values, k)
        if form is None:
            rest.append((effect, at))
            continue
        own = [effect.sign * a for a in (form.mass, form.damping, form.stiffness)]
        mass, damping, stiffness = with_inside((mass, damping, stiffness), at, own)
    padded = [(e, np.pad(at, ((0, 0), (0, mass.shape[0] - n)))) for e, at in rest]
    return Quadratic(mass, damping, stiffness), [(e, at, np.zeros_like(at)) for e, at in padded]


def with_inside(matrices: Sequence[Array], at: Array, form: Sequence[Array]) -> tuple[Array, Array, Array]:
    """M, C, K (n, n) with the coordinates inside an effect more, given its shapes (places, n or fewer) and its own M, C, K."""
    places, n, more = len(at), len(matrices[0]), len(form[0]) - len(at)
    to = np.zeros((places + more, n + more))
    to[:places, : at.shape[1]], to[places:, n:] = at, np.eye(more)
    mass, damping, stiffness = (to.T @ part @ to for part in form)
    for a, out in zip(matrices, (mass, damping, stiffness), strict=True):
        out[:n, :n] += a
    return mass, damping, stiffness


def acting(base: ModalModel, placed: Placed) -> list[tuple[Effect, Array, Array]]:
    """All effects by their dynamic stiffness over the modal coordinates alone, lags of shapes included."""
    lag = _lag(base)
    return [(effect, np.asarray(weights @ base.terms.shapes), np.asarray(weights @ lag)) for effect, weights in placed]


def _lag(base: ModalModel) -> Array:
    return np.zeros(base.terms.shapes.shape) if base.coupling is None else base.coupling.lag


def running_modes(base: ModalModel, placed: Placed) -> ModalModel:
    """Poles and complex shapes of the idle modes and residual terms under effects of dynamic stiffness.

    The eigenproblem of M λ² + C λ + K in modal coordinates, with the effects' internal ones; where an effect is no M, C, K, or acts where
    shapes lag, all zeros of det D(λ) at once by Ehrlich's and Aberth's iteration. Poles without oscillation are told in the details, a
    :class:`RunningDetails`.

    Shapes are complex, "unscaled", sorted by frequency; residual terms, sorted too, are those that residual idle terms make most of.
    """
    form, rest = modal_matrices(base, placed)
    lag = _lag(base)
    exact = not rest and not (placed and lag.any())
    near = _replaced(base, form, rest)
    poles, right, left = second_order_poles(near.mass, near.damping, near.stiffness)
    real = np.abs(poles.imag) <= 1e-9 * np.abs(poles)
    up = np.flatnonzero(~real & (poles.imag > 0))
    up = up[np.argsort(np.abs(poles[up]))]
    n = base.terms.n
    value, vector = poles[up], right[:, up]
    if not exact:
        if lag.any():
            form, rest = modal_matrices(base, ())[0], acting(base, placed)
        value = _refined(form, rest, value)
        vector = _vectors(form, rest, value)
    shares = np.abs(vector[:n]) ** 2 / np.linalg.norm(vector[:n], axis=0) ** 2
    residual = shares[base.terms.residual].sum(axis=0) > 0.5
    order = np.argsort(residual, kind="stable")
    value, q, up, residual = value[order], vector[:n, order], up[order] if exact else up, residual[order]
    shapes = base.terms.shapes @ q - (lag @ q) * value
    scale = _normal(shapes)
    hz = np.abs(value) / 2 / np.pi
    low, high = _band(base)
    return ModalModel.from_terms(
        hz,
        -value.real / np.abs(value),
        shapes / scale,
        base.dofs,
        scaling="unscaled",
        residual=residual,
        in_band=~residual & (hz >= low) & (hz <= high),
        band_hz=base.band_hz,
        si=base.si,
        provenance=base.provenance.then("running_modes"),
        details=RunningDetails(None if not exact or lag.any() else (base.terms.shapes @ left[:n, up]) * scale, np.sort(poles[real].real)),
    )


def _normal(shapes: Array) -> Array:
    """Factor of each shape that brings it to unit norm, as near to the real axis as can be, its largest part positive."""
    norm = np.linalg.norm(shapes, axis=0)
    square = np.sum(shapes**2, axis=0)
    turn = np.exp(0.5j * np.angle(square))
    largest = shapes[np.argmax(np.abs(shapes), axis=0), np.arange(shapes.shape[1])]
    turn = np.where((largest / turn).real < 0, -turn, turn)
    return np.where(norm > 0, norm, 1.0) * turn


def _band(base: ModalModel) -> tuple[float, float]:
    if base.band_hz is not None:
        return base.band_hz
    inside = base.frequencies_hz[np.asarray(base.in_band)]
    return (0.8 * float(inside.min()), 1.2 * float(inside.max())) if inside.size else (0.0, np.inf)


def _replaced(base: ModalModel, form: Quadratic, rest: Acting) -> Quadratic:
    """The same with spring and mass of the same dynamic stiffness, at the median of the frequencies, in place of what is no M, C, K.

    No damper: a strong one would make poles real that are not, and so lose them.
    """
    w = 2 * np.pi * float(np.median(base.terms.frequencies_hz))
    mass, stiffness = form.mass.copy(), form.stiffness.copy()
    for effect, at, _ in rest:
        z, slope = _stiffness(effect, at, np.array([1j * w]))
        inertia = slope[0].imag / 2 / w
        size, axes = np.linalg.eigh((inertia + inertia.T) / 2)
        inertia = (axes * np.maximum(effect.sign * size, 0)) @ axes.T * effect.sign
        mass += at.T @ inertia @ at
        stiffness += at.T @ (z[0].real + w**2 * inertia) @ at
    return Quadratic(mass, form.damping, stiffness)


def _stiffness(effect: Effect, at: Array, s: Array) -> tuple[Array, Array]:
    """Dynamic stiffness (l, k, k) of an effect at s [rad/s], with its sign, and its derivative by s."""
    h = 1e-5 * np.abs(s)
    z = effect.sign * np.asarray(effect.definition.matrix(np.stack([s, s + h, s - h]), effect.values, at.shape[0]), complex)
    return z[0], (z[1] - z[2]) / (2 * h)[:, None, None]


def _system(form: Quadratic, rest: Acting, s: Array) -> tuple[Array, Array]:
    """D(s) and dD/ds at each s [rad/s]: (l, n, n)."""
    s3 = s[:, None, None]
    d, slope = (form.mass * s3 + form.damping) * s3 + form.stiffness, 2 * form.mass * s3 + form.damping
    for effect, at, late in rest:
        z, dz = _stiffness(effect, at, s)
        p = at - s3 * late
        turned = np.swapaxes(p, 1, 2)
        d, slope = d + turned @ z @ p, slope + turned @ dz @ p - late.T @ z @ p - turned @ z @ late
    return d, slope


def _refined(form: Quadratic, rest: Acting, start: Array) -> Array:
    """Zeros of det D(λ) above the real axis from starting values, by frequency: Newton's steps that keep off each other's zeros.

    One at a time, Newton's method takes several starting values to the same zero and loses the others; Ehrlich's and Aberth's step
    N/(1 − N Σ 1/(λ − λ_j)) with N = 1/tr(D⁻¹D') counts a zero that another value has reached, and its conjugate, as taken.
    """
    value = start * (1 + 1e-7 * np.arange(start.size))  # equal ones would stay together
    moving = np.ones(value.size, bool)
    change = np.ones(value.size)
    for _ in range(_ITERATIONS):
        at = np.flatnonzero(moving)
        if not at.size:
            break
        d, slope = _system(form, rest, value[at])
        try:
            inverse = np.trace(np.linalg.solve(d, slope), axis1=1, axis2=2)
        except np.linalg.LinAlgError:  # a value hit its zero to the last digit
            value[at] *= 1 + 1e-12
            continue
        apart = value[at][:, None] - value[None]
        inverse -= np.sum(1 / np.where(apart == 0, np.inf, apart), axis=1)
        inverse -= np.sum(1 / (value[at][:, None] - value[None].conj()), axis=1)
        step = 1 / inverse
        change[at] = np.abs(step) / np.abs(value[at])
        value[at] -= step
        value = np.where(value.imag < 0, value.conj(), value)
        moving[at] = change[at] > _CLOSE
    if np.any(change > _SETTLED):
        lost = ", ".join(f"{abs(v) / 2 / np.pi:.4g}" for v in value[change > _SETTLED])
        raise IdentificationError(
            f"poles of the running structure are not found (near {lost} Hz)",
            where=", ".join(effect.kind for effect, _, _ in rest),
            hint="its frequency response by Model.frf does not need them; or give the kind its M, C, K by `quadratic`",
        )
    value = value[value.imag > 1e-9 * np.abs(value)]
    return np.asarray(value[np.argsort(np.abs(value))])


def _vectors(form: Quadratic, rest: Acting, poles: Array) -> Array:
    """Right vectors D(λ) v = 0 in columns; of m equal poles m independent ones."""
    vh = np.linalg.svd(_system(form, rest, poles)[0])[2].conj()
    nth = [int(np.sum(np.abs(poles[:i] - p) < _SETTLED * abs(p))) for i, p in enumerate(poles)]
    return np.stack([v[-1 - m] for v, m in zip(vh, nth, strict=True)], axis=1) if len(poles) else vh.reshape(0, 0)


def with_spread(modes: ModalModel, base: ModalModel, placed: Placed, gradient: Array | None = None) -> ModalModel:
    """The running modes with standard deviations of frequencies and damping ratios from the covariance of the idle model.

    ``gradient`` (p, n_terms) holds further changes of the poles [rad/s], one standard deviation each, independent of the idle model.
    """
    poles = modes.terms.poles
    std_hz, std_zeta = np.zeros(poles.size), np.zeros(poles.size)
    for r in range(poles.size):
        change = np.zeros((0,), complex) if gradient is None else gradient[:, r]
        parts = np.stack([change.real, change.imag])
        block = parts @ parts.T
        if base.covariance is not None:
            slopes = pole_slopes(base, placed, complex(poles[r]))
            both = np.stack([slopes.real, slopes.imag])
            block = block + both @ base.covariance @ both.T
        a, b = poles[r].real, poles[r].imag
        size = np.hypot(a, b)
        to_hz = np.array([a, b]) / size / 2 / np.pi
        to_zeta = np.array([-(b**2), a * b]) / size**3
        std_hz[r], std_zeta[r] = np.sqrt(to_hz @ block @ to_hz), np.sqrt(to_zeta @ block @ to_zeta)
    return replace(modes, std={"frequencies_hz": std_hz, "damping_ratios": std_zeta})


def pole_slopes(base: ModalModel, placed: Placed, pole: complex) -> Array:
    """∂λ/∂θ of one pole by the idle parameters θ = [f (Hz), ζ, shapes mode by mode], complex [rad/s per unit].

    dλ = −lᵀ dD(λ) v / (lᵀ D'(λ) v).
    """
    everything = acting(base, placed)
    d, slope = (part[0] for part in _system(modal_matrices(base, ())[0], everything, np.array([pole])))
    u, _, vh = np.linalg.svd(d)
    v, left = vh[-1].conj(), u[:, -1].conj()  # D v = 0, lᵀ D = 0
    over = -1 / (left @ slope @ v)
    n, m = base.terms.n, len(base.dofs)
    w = 2 * np.pi * base.terms.frequencies_hz
    out = np.zeros(n * (2 + m), complex)
    both = base.terms.signs * left * v
    out[:n] = both * (2 * base.terms.damping_ratios * pole + 2 * w) * 2 * np.pi
    out[n : 2 * n] = both * 2 * w * pole
    shapes = np.zeros((n, m), complex)
    for (effect, weights), (_, own, late) in zip(placed, everything, strict=True):
        at = own - pole * late
        z = effect.sign * np.asarray(effect.definition.matrix(np.array([pole]), effect.values, at.shape[0]), complex)[0]
        shapes += np.outer(left, weights.T @ (z @ (at @ v))) + np.outer(v, weights.T @ (z.T @ (at @ left)))
    out[2 * n :] = shapes.ravel()
    return out * over

"""Poles and complex shapes of the running structure: the eigenproblem of idle modes and added dynamic stiffness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel
from operando.effects.base import Quadratic
from operando.effects.effect import Effect

Array = NDArray[Any]
Placed = Sequence[tuple[Effect, Array]]

_ITERATIONS = 40
_CLOSE = 1e-11
"""Relative change of a pole at which its iteration ends."""


@dataclass(frozen=True)
class RunningDetails:
    """What a modal model of the running structure says besides poles and shapes.

    Parameters
    ----------
    coordinates : (n_idle_terms, n_terms) complex array
        Share of each idle term in each running one.
    left : (n_dofs, n_terms) complex array or None
        Left shapes l of such a scale that the receptance is Σ ψ lᵀ/(iω − λ) and its conjugate part, where no pole is real; equal to
        the shapes up to a factor unless an effect is skew. None where an effect has no finite number of poles (hysteretic, rubber).
    real_poles : array
        Poles without oscillation [rad/s], which have no frequency.
    """

    coordinates: Array
    left: Array | None
    real_poles: NDArray[np.float64]


def modal_matrices(base: ModalModel, placed: Placed, around: complex | None = None) -> tuple[Quadratic, bool]:
    """M, C, K over the idle modes followed by the effects' internal coordinates.

    Parameters
    ----------
    base : ModalModel
        Unit modal mass.
    placed : sequence of (Effect, (k, n_dofs) weights)
        Effects of dynamic stiffness and their places.
    around : complex, optional
        Where [rad/s] an effect that is no M, C, K (hysteretic, rubber) is replaced by the spring and damper of the same dynamic
        stiffness; default i times the median of the frequencies.

    Returns
    -------
    Quadratic
    bool
        Whether no effect had to be replaced.
    """
    n = base.terms.n
    w = 2 * np.pi * base.terms.frequencies_hz
    s = 1j * float(np.median(w)) if around is None else complex(around)
    mass, damping, stiffness = np.eye(n), np.diag(2 * base.terms.damping_ratios * w), np.diag(w**2)
    exact = True
    for effect, weights in placed:
        at = np.asarray(weights @ base.terms.shapes)
        k = at.shape[0]
        form = effect.definition.quadratic(effect.values, k)
        if form is None:
            exact = False
            z = np.asarray(effect.definition.matrix(np.array([s]), effect.values, k))[0]
            c = z.imag / s.imag
            form = Quadratic(np.zeros((k, k)), c, z.real - c * s.real)
        size, inner = mass.shape[0], form.internal - k
        wide = np.zeros((form.internal, size + inner))
        wide[:k, :n] = at
        wide[k:, size:] = np.eye(inner)
        grown = [np.pad(a, (0, inner)) for a in (mass, damping, stiffness)]
        parts = [effect.sign * (wide.T @ a @ wide) for a in (form.mass, form.damping, form.stiffness)]
        mass, damping, stiffness = (a + b for a, b in zip(grown, parts, strict=True))
    return Quadratic(mass, damping, stiffness), exact


def eigenpairs(form: Quadratic) -> tuple[Array, Array, Array]:
    """Poles, right and left vectors of (M λ² + C λ + K) v = 0 with H(s) = Σ v lᵀ/(s − λ), all 2n of them.

    Returns
    -------
    poles : (2n,) array
    right, left : (n, 2n) arrays
    """
    n = form.internal
    inverse = np.linalg.inv(form.mass)
    state = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ form.stiffness, -inverse @ form.damping]])
    poles, vectors = np.linalg.eig(state)
    return poles, vectors[:n], (np.linalg.inv(vectors)[:, n:] @ inverse).T


def running_modes(base: ModalModel, placed: Placed) -> ModalModel:
    """Poles and complex shapes of the idle modes and residual terms under effects of dynamic stiffness.

    The eigenproblem of M λ² + C λ + K in modal coordinates, with the effects' internal ones; where an effect is no M, C, K, each pole is
    refined by Newton's method on D(λ) v = 0. Poles without oscillation are told in the details.

    Parameters
    ----------
    base : ModalModel
        Unit modal mass.
    placed : sequence of (Effect, (k, n_dofs) weights)
        As from :func:`operando.effects.place_weights`.

    Returns
    -------
    ModalModel
        Complex, "unscaled" shapes, sorted by frequency; residual terms where residual idle terms make most of them, sorted too;
        ``in_band`` where a mode lies in the base's band. ``details`` is a :class:`RunningDetails`.
    """
    form, exact = modal_matrices(base, placed)
    poles, right, left = eigenpairs(form)
    real = np.abs(poles.imag) <= 1e-9 * np.abs(poles)
    up = np.flatnonzero(~real & (poles.imag > 0))
    up = up[np.argsort(np.abs(poles[up]))]
    n = base.terms.n
    value, vector = poles[up], right[:, up]
    if not exact:
        refined = [_refined(base, placed, p, v[:n]) for p, v in zip(value, vector.T, strict=True)]
        value, vector = _distinct(refined)
    shares = np.abs(vector[:n]) ** 2 / np.linalg.norm(vector[:n], axis=0) ** 2
    residual = shares[base.terms.residual].sum(axis=0) > 0.5
    order = np.argsort(residual, kind="stable")
    value, q, up, residual = value[order], vector[:n, order], up[order] if exact else up, residual[order]
    shapes = base.terms.shapes @ q
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
        details=RunningDetails(q / scale, (base.terms.shapes @ left[:n, up]) * scale if exact else None, np.sort(poles[real].real)),
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


def _refined(base: ModalModel, placed: Placed, pole: complex, start: Array) -> tuple[complex, Array]:
    """One pole of D(λ) v = 0: first along re-made springs and dampers, then by Newton's method with the bordered system."""
    n = base.terms.n
    v = start / np.linalg.norm(start)
    for _ in range(3):
        poles, right, _ = eigenpairs(modal_matrices(base, placed, pole)[0])
        like = np.abs(right[:n].conj().T @ v) / np.maximum(np.linalg.norm(right[:n], axis=0), 1e-300)
        like[poles.imag <= 0] = -1
        best = int(np.argmax(like - np.abs(poles - pole) / max(abs(pole), 1e-300)))
        moved = abs(poles[best] - pole) / abs(pole)
        pole, v = complex(poles[best]), right[:n, best] / np.linalg.norm(right[:n, best])
        if moved < 1e-6:
            break
    border = v.conj()
    for _ in range(_ITERATIONS):
        d, slope = dynamic(base, placed, pole)
        # Newton on D(λ)v = 0 with vᴴ₀v = 1: bordered by the direction of change in λ.
        system = np.block([[d, (slope @ v)[:, None]], [border[None], np.zeros((1, 1))]])
        step = np.linalg.solve(system, np.r_[-(d @ v), 0.0])
        v = v + step[:n]
        pole += complex(step[n])
        if abs(step[n]) < _CLOSE * abs(pole):
            break
    return pole, v


def dynamic(base: ModalModel, placed: Placed, s: complex) -> tuple[Array, Array]:
    """Dynamic stiffness in modal coordinates at s [rad/s] and its derivative, internal coordinates eliminated."""
    w = 2 * np.pi * base.terms.frequencies_hz
    d = np.diag(s**2 + 2 * base.terms.damping_ratios * w * s + w**2).astype(complex)
    slope = np.diag(2 * s + 2 * base.terms.damping_ratios * w).astype(complex)
    h = 1e-5 * abs(s)
    for effect, weights in placed:
        at = np.asarray(weights @ base.terms.shapes)
        z = effect.sign * np.asarray(effect.definition.matrix(np.array([s, s + h, s - h]), effect.values, at.shape[0]), complex)
        d += at.T @ z[0] @ at
        slope += at.T @ ((z[1] - z[2]) / (2 * h)) @ at
    return d, slope


def _distinct(found: list[tuple[complex, Array]]) -> tuple[Array, Array]:
    """Poles above the real axis, each once, by frequency."""
    kept: list[tuple[complex, Array]] = []
    for pole, v in sorted((f for f in found if f[0].imag > 0), key=lambda f: abs(f[0])):
        same = [
            o
            for o in kept
            if abs(o[0] - pole) < 1e-8 * abs(pole) and abs(np.vdot(o[1], v)) > 0.999 * np.linalg.norm(o[1]) * np.linalg.norm(v)
        ]
        if not same:
            kept.append((pole, v))
    return np.array([p for p, _ in kept]), np.array([v for _, v in kept]).T


def with_spread(modes: ModalModel, base: ModalModel, placed: Placed, gradient: Array | None = None) -> ModalModel:
    """The running modes with standard deviations of frequencies and damping ratios from the covariance of the idle model.

    dλ = −lᵀ dD(λ) v / (lᵀ D'(λ) v), all idle parameters.

    Parameters
    ----------
    modes : ModalModel
        Of :func:`running_modes`.
    base : ModalModel
    placed : sequence of (Effect, (k, n_dofs) weights)
    gradient : (p, n_terms) complex array, optional
        Further changes of the poles [rad/s], one standard deviation each, independent of the idle model.
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
    """∂λ/∂θ of one pole by the idle parameters θ = [f (Hz), ζ, shapes mode by mode], complex [rad/s per unit]."""
    d, slope = dynamic(base, placed, pole)
    u, _, vh = np.linalg.svd(d)
    v, left = vh[-1].conj(), u[:, -1].conj()  # D v = 0, lᵀ D = 0
    over = -1 / (left @ slope @ v)
    n, m = base.terms.n, len(base.dofs)
    w = 2 * np.pi * base.terms.frequencies_hz
    out = np.zeros(n * (2 + m), complex)
    out[:n] = left * v * (2 * base.terms.damping_ratios * pole + 2 * w) * 2 * np.pi
    out[n : 2 * n] = left * v * 2 * w * pole
    shapes = np.zeros((n, m), complex)
    for effect, weights in placed:
        at = np.asarray(weights @ base.terms.shapes)
        z = effect.sign * np.asarray(effect.definition.matrix(np.array([pole]), effect.values, at.shape[0]), complex)[0]
        shapes += np.outer(left, weights.T @ (z @ (at @ v))) + np.outer(v, weights.T @ (z.T @ (at @ left)))
    out[2 * n :] = shapes.ravel()
    return out * over

"""Receptances of the idle model with effects on the check lines, and their derivatives, as batched array products."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Geometry, ModalModel
from operando.diagnose.sets import CheckLines
from operando.dof import Dof, Node, match_dofs
from operando.effects import Effect, EffectKind, place_weights
from operando.synthesis import modal_kernel

Array = NDArray[Any]


@dataclass(frozen=True)
class Term:
    """One effect as the fit sees it: kind, place as rows over the idle DOFs, and which of its numbers move.

    Parameters
    ----------
    kind : EffectKind
    dofs : tuple of Dof
        Place as the contract writes it.
    rows : (k, n_dofs) array
        Coordinates x of the effect from the idle DOFs; (0, n_dofs) where it has none.
    sign : {1, -1}
        −1: the opposite of the kind, taken away from the structure.
    band_hz : (float, float)
        Analysis band, for bounds and constants.
    constants : dict
        Values that are stated and never fitted.
    fixed : dict
        Values held at what the user gave.
    index : tuple of int
        Rows of the idle model whose channel a sensor or force kind maps.
    position, direction : optional
        Of a place between sensors.
    """

    kind: EffectKind
    dofs: tuple[Dof, ...]
    rows: Array
    sign: int = 1
    band_hz: tuple[float, float] = (1.0, 100.0)
    constants: dict[str, float] = field(default_factory=dict)
    fixed: dict[str, float] = field(default_factory=dict)
    index: tuple[int, ...] = ()
    position: tuple[float, float, float] | None = None
    direction: str | None = None

    @property
    def moving(self) -> tuple[str, ...]:
        """Names of the parameters that are fitted."""
        names = tuple(p.name for p in self.kind.parameters if p.name not in self.fixed)
        return names

    @property
    def n_dofs(self) -> int:
        """DOFs of the idle model."""
        return int(self.rows.shape[1])

    @property
    def shape_size(self) -> int:
        """Free shape values of an added mode."""
        return self.n_dofs if self.kind.acts == "added_mode" else 0

    @property
    def size(self) -> int:
        """Numbers fitted."""
        return len(self.moving) + self.shape_size

    @classmethod
    def of(cls, effect: Effect, idle: ModalModel, band_hz: tuple[float, float], geometry: Geometry | None = None) -> Term:
        """The term of an effect; its values are the start (:meth:`inward`)."""
        kind = effect.definition
        index: tuple[int, ...] = ()
        rows = np.zeros((0, len(idle.dofs)))
        if kind.acts == "sensor_map":
            index = tuple(match_dofs(effect.location, idle.dofs)[0])
        elif kind.acts == "dynamic_stiffness":
            rows = place_weights(effect, idle, geometry)
        return cls(
            kind,
            effect.location,
            rows,
            int(effect.sign),
            band_hz,
            {p.name: effect.values[p.name] for p in kind.constants},
            {n: effect.values[n] for n in effect.fixed},
            index,
            effect.position,
            effect.direction,
        )

    def effect(self, q: Array, idle: ModalModel, std: dict[str, float] | None = None) -> Effect:
        """The effect with the values of the moving numbers."""
        values = self.values(q)
        shape = values.pop("shape", None)
        return Effect(
            self.kind.kind,
            self.dofs,
            values,
            dict(std or {}),
            self.position,
            self.direction or "",
            self.sign < 0,
            None if shape is None else {str(d): float(v) for d, v in zip(idle.dofs, shape, strict=True)},
            tuple(self.fixed),
        )

    @property
    def key(self) -> tuple[str, tuple[tuple[Node, str], ...]]:
        """Kind and unsigned place, to tell terms apart."""
        return self.kind.kind, tuple((d.node, d.axis) for d in sorted(d.unsigned for d in self.dofs)) or ((0, str(self.position)),)

    def bounds(self) -> tuple[Array, Array]:
        """Bounds of the moving numbers on the search scale."""
        low, high = [], []
        for name in self.moving:
            p = self.kind.parameter(name)
            a, b = p.bounds(self.band_hz)
            low.append(p.inward(a))
            high.append(p.inward(b))
        free = np.full(self.shape_size, np.inf)
        return np.r_[low, -free], np.r_[high, free]

    def values(self, q: Array) -> dict[str, Any]:
        """Values of all parameters from the moving numbers (removed kinds: of what is taken away)."""
        out: dict[str, Any] = dict(self.constants) | dict(self.fixed)
        for name, v in zip(self.moving, q[: len(self.moving)], strict=True):
            out[name] = self.kind.parameter(name).outward(float(v))
        if self.shape_size:
            out["shape"] = np.asarray(q[len(self.moving) :], float)
        return out

    def inward(self, values: dict[str, Any]) -> Array:
        """Moving numbers from values, within the bounds."""
        q = np.array([self.kind.parameter(name).inward(float(values[name])) for name in self.moving])
        if self.shape_size:
            q = np.r_[q, np.asarray(values["shape"], float)]
        low, high = self.bounds()
        return np.clip(q, low, high)

    def stiffness(self, s: Array, values: dict[str, Any]) -> Array:
        """δZ (lines, k, k) over the place's coordinates."""
        return self.sign * np.asarray(self.kind.matrix(s, values, self.rows.shape[0]), complex)


@dataclass(frozen=True)
class IdleArrays:
    """Modal parameters of the idle model as arrays.

    Parameters
    ----------
    model : ModalModel
        Without covariance (kinds that change it are asked often).
    phi : (n_dofs, n_modes) array
        Shapes; the fit may move some of them.
    """

    model: ModalModel
    phi: Array

    @classmethod
    def of(cls, idle: ModalModel) -> IdleArrays:
        """Arrays of a modal model."""
        return cls(replace(idle, covariance=None, std=None), np.array(idle.terms.shapes))

    def kernel(self, hz: Array) -> Array:
        """1/(ω_r² − ω² + 2iζω_rω), (lines, modes)."""
        terms = self.model.terms
        return np.ascontiguousarray(modal_kernel(hz, terms.frequencies_hz, terms.damping_ratios, "receptance").T)

    def with_phi(self, phi: Array) -> IdleArrays:
        """The same poles with other shapes."""
        return IdleArrays(self.model, phi)


@dataclass(frozen=True)
class Prediction:
    """Receptance with effects and what its derivatives need.

    Parameters
    ----------
    data : (lines, responses, references) array
        As the channels would measure it.
    kernel : (lines, modes) array
    phi : (n_dofs, n_modes) array
    left : (lines, responses, k) array
        H0_oB·T, T = (I + δZ·H0_BB)⁻¹ δZ.
    right : (lines, k, references) array
        T·H0_Bi.
    from_place : (lines, responses, k) array
        H_oB of the structure with the effects.
    to_place : (lines, k, references) array
        H_Bi of the same.
    rows : (k, n_dofs) array
    factor : (lines, responses, references) array or None
        What sensor and force kinds multiply by.
    order : int array
        Rows in the order the channels give them.
    """

    data: Array
    kernel: Array
    phi: Array
    left: Array
    right: Array
    from_place: Array
    to_place: Array
    rows: Array
    factor: Array | None
    order: Array


def predict(idle: IdleArrays, lines: CheckLines, terms: Sequence[Term], q: Sequence[Array], kernel: Array | None = None) -> Prediction:
    """Exact update H = H0 − H0_B (I + δZ H0_BB)⁻¹ δZ H0_Bᵀ of the idle model by all terms, then the channels' own faults."""
    values = [t.values(v) for t, v in zip(terms, q, strict=True)]
    phi, model = idle.phi, idle.model
    changed = False
    for t, v in zip(terms, values, strict=True):
        if t.kind.acts == "modal_change":
            model = t.kind.modal_change(model, v)
            changed = True
        elif t.kind.acts == "added_mode":
            model = t.kind.added_mode(model, v, v["shape"])
            phi = np.c_[phi, v["shape"]]
            changed = True
    if kernel is None or changed:
        kernel = IdleArrays(model, phi).kernel(lines.hz)
        n, more = idle.model.n_modes, model.n_modes - idle.model.n_modes
        # Here modes added stand behind all terms of the idle model, in the model before its residual terms.
        kernel = kernel if not more else kernel[:, np.r_[:n, n + more : kernel.shape[1], n : n + more]]
    acting = [(t, v) for t, v in zip(terms, values, strict=True) if t.kind.acts == "dynamic_stiffness"]
    rows = np.concatenate([t.rows for t, _ in acting]) if acting else np.zeros((0, idle.phi.shape[0]))
    size, at = rows.shape[0], rows @ phi
    ends = (np.concatenate([phi[lines.responses], at]), np.concatenate([phi[lines.references], at]))
    full = _over_modes(kernel, *ends)
    n_o, n_j = lines.responses.size, lines.references.size
    data, from_place, to_place = full[:, :n_o, :n_j], full[:, :n_o, n_j:], full[:, n_o:, :n_j]
    left, right = np.zeros_like(from_place), np.zeros_like(to_place)
    if size:
        inner = full[:, n_o:, n_j:]
        z = np.zeros((data.shape[0], size, size), complex)
        start = 0
        s = 1j * lines.omega
        for t, v in acting:
            stop = start + t.rows.shape[0]
            z[:, start:stop, start:stop] = t.stiffness(s, v)
            start = stop
        middle = z / (1 + z * inner) if size == 1 else np.linalg.solve(np.eye(size) + z @ inner, z)
        left, right = from_place @ middle, middle @ to_place
        data = data - left @ to_place
        from_place, to_place = from_place - left @ inner, to_place - inner @ right
    factor, order = channel_maps(lines, terms, values)
    if factor is not None:
        data = data[:, order] * factor
    elif not np.array_equal(order, np.arange(order.size)):
        data = data[:, order]
    return Prediction(data, kernel, phi, left, right, from_place, to_place, rows, factor, order)


def by_size(p: Prediction, term: Term, q: Array, j: int, lines: CheckLines, start: int) -> Array:
    """∂H/∂q_j of one structural term, −H_oB·(∂δZ/∂q)·H_Bi of the structure with the effects, (lines, responses, references).

    Parameters
    ----------
    p : Prediction
    term : Term
    q : array
        Its moving numbers.
    j : int
        Which of them.
    lines : CheckLines
    start : int
        Its first row among those of all terms.
    """
    step = 1e-6 if q[j] + 1e-6 <= term.bounds()[1][j] else -1e-6
    moved = q.copy()
    moved[j] += step
    s = 1j * lines.omega
    change = (term.stiffness(s, term.values(moved)) - term.stiffness(s, term.values(q))) / step
    own = slice(start, start + term.rows.shape[0])
    return _as_measured(p, -(p.from_place[:, :, own] @ change @ p.to_place[:, own]), axis=1)


def _over_modes(kernel: Array, left: Array, right: Array) -> Array:
    """Σ_r left[a, r]·kernel[l, r]·right[b, r], (lines, a, b), as one real matrix product."""
    count, n = kernel.shape
    pairs = (left[:, None, :] * right[None]).reshape(-1, n).T
    both = np.concatenate([kernel.real, kernel.imag]) @ pairs
    out = np.empty((count, pairs.shape[1]), complex)
    out.real, out.imag = both[:count], both[count:]
    return out.reshape(count, left.shape[0], right.shape[0])


def channel_maps(lines: CheckLines, terms: Sequence[Term], values: Sequence[dict[str, Any]]) -> tuple[Array | None, Array]:
    """Factor of each channel and order of the rows, from sensor and force kinds."""
    order = np.arange(lines.responses.size)
    factor: Array | None = None
    for t, v in zip(terms, values, strict=True):
        if t.kind.acts != "sensor_map":
            continue
        if t.kind.places == 2:
            a, b = (np.flatnonzero(lines.responses == i) for i in t.index)
            if a.size and b.size:
                order[[a[0], b[0]]] = order[[b[0], a[0]]]
            continue
        if factor is None:
            factor = np.ones(lines.data.shape, complex)
        own = np.asarray(t.kind.sensor_map(lines.hz, v))
        if t.kind.group == "force":
            factor[:, :, np.flatnonzero(lines.references == t.index[0])] /= own[:, None, None]
        else:
            factor[:, np.flatnonzero(lines.responses == t.index[0]), :] *= own[:, None, None]
    return factor, order


def by_poles(p: Prediction, idle: ModalModel, lines: CheckLines) -> tuple[Array, Array]:
    """∂H/∂f_r [1/Hz] and ∂H/∂ζ_r, each (modes, lines, responses, references)."""
    w = lines.omega[:, None]
    wr = 2 * np.pi * idle.terms.frequencies_hz[None, :]
    z = idle.terms.damping_ratios[None, :]
    n = wr.size
    psi = (p.phi[lines.responses][None] - p.left @ (p.rows @ p.phi))[:, :, :n]
    chi = (p.phi[lines.references].T[None] - (p.rows @ p.phi).T @ p.right)[:, :n]
    square = -(p.kernel[:, :n] ** 2)
    by_hz = square * (2 * wr + 2j * z * w) * 2 * np.pi
    by_zeta = square * 2j * wr * w
    first = np.einsum("lr,lor,lrj->rloj", by_hz, psi, chi)
    second = np.einsum("lr,lor,lrj->rloj", by_zeta, psi, chi)
    return _as_measured(p, first), _as_measured(p, second)


def _as_measured(p: Prediction, out: Array, axis: int = 2) -> Array:
    """As the channels give it; ``axis`` is that of the responses."""
    out = np.take(out, p.order, axis)
    return out if p.factor is None else out * p.factor

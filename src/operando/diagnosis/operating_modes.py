"""Operational modes as an observation: frequency, damping and shape of each, their noise, and which predicted mode each one is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from operando.data import ModalModel
from operando.diagnosis.criteria import ASSUMED_MODES, MODES_FLOOR, NEAR_HZ, PARTNER_LOG_HZ, PARTNER_MAC, SECOND_ORDER
from operando.diagnosis.idle import Idle
from operando.dof import Dof, match_dofs
from operando.errors import DataError

Array = NDArray[Any]
_FREQUENCY_OVER_MAC = 4.0  # a pair with a MAC of 0 costs as much as one that is four times ``NEAR_HZ`` apart
_LEAST_DAMPING = 1e-5  # a predicted ratio below counts as this: its logarithm must exist
_LEAST_SHARE = 0.1  # of the blocks, that are left where there are hardly more of them than values
_ABOVE = 1.15  # modes up to so many times the highest one at rest are used


@dataclass(frozen=True)
class ModeSet:
    """Modes of one record, on DOFs of the idle model and in its signs.

    A shape has no scale: of its 2 m real numbers the two along y and iy say nothing, and ``across`` leaves them out.

    Of n modes at m DOFs ``f`` and ``zeta`` (n,) [Hz, ratio], and ``shapes`` (m, n) of unit norm; ``across`` (n, 2 m, 2 m − 2) is
    orthonormal, perpendicular to y and iy as real numbers; ``noise`` (n (2 m), n (2 m)) is the covariance of [ln f, ln ζ, shape across]
    mode by mode.
    """

    f: Array
    zeta: Array
    shapes: Array
    across: Array
    noise: Array

    @property
    def n(self) -> int:
        return int(self.f.size)

    @property
    def per_mode(self) -> int:
        """Values of one mode: ln f, ln ζ, and its shape."""
        return 2 * len(self.shapes)

    @property
    def measured(self) -> Array:
        """(n, per mode): ln f, ln ζ, zeros."""
        out = np.zeros((self.n, self.per_mode))
        out[:, 0], out[:, 1] = np.log(self.f), np.log(self.zeta)
        return out

    @property
    def level(self) -> Array:
        """What a discrepancy of one, as a share of an FRF that is smooth over a resonance, is of each value (standard deviation).

        Near a mode H = R/(iω − λ): a share α of it at a half-power width moves λ by α ζω, in any direction of the complex plane, and
        the shape by α times its rms.
        """
        out = np.full((self.n, self.per_mode), 1 / np.sqrt(2 * len(self.shapes)))
        out[:, 0], out[:, 1] = self.zeta / np.sqrt(2), 1 / np.sqrt(2)
        return out

    def values(self, s: Array, psi: Array) -> Array:
        """Of predicted modes (n,) [rad/s] as the sensors show them (n, m), in the order of the measured ones: (n, per mode)."""
        out = np.zeros((self.n, self.per_mode))
        out[:, 0] = np.log(np.abs(s) / 2 / np.pi)
        out[:, 1] = np.log(np.maximum(-s.real / np.abs(s), _LEAST_DAMPING))
        scaled = self._scale(psi)[:, None] * psi
        out[:, 2:] = np.einsum("nip,ni->np", self.across, np.concatenate([scaled.real, scaled.imag], 1))
        return out

    def slopes(self, s: Array, psi: Array, by_s: Array, by_psi: Array) -> Array:
        """Derivatives (n, per mode, k) of the values, from those of poles (n, k) and of what the sensors show (n, m, k)."""
        out = np.zeros((self.n, self.per_mode, by_s.shape[1]))
        by_log = (by_s / s[:, None]).real
        zeta = -s.real / np.abs(s)
        by_zeta = -by_s.real / np.abs(s)[:, None] - zeta[:, None] * by_log
        told = zeta > _LEAST_DAMPING
        out[:, 0], out[:, 1] = by_log, by_zeta / np.where(told, zeta, 1)[:, None] * told[:, None]
        power, scale = np.sum(np.abs(psi) ** 2, axis=1), self._scale(psi)
        by_power = 2 * np.einsum("ni,nik->nk", psi.conj(), by_psi).real
        by_scale = (np.einsum("nik,ni->nk", by_psi.conj(), self.shapes.T) - scale[:, None] * by_power) / power[:, None]
        by = by_scale[:, None] * psi[..., None] + scale[:, None, None] * by_psi
        out[:, 2:] = np.einsum("nip,nik->npk", self.across, np.concatenate([by.real, by.imag], 1))
        return out

    def _scale(self, psi: Array) -> Array:
        """Complex factors that bring predicted shapes (n, m) nearest to the measured ones."""
        return np.asarray(np.sum(psi.conj() * self.shapes.T, axis=1) / np.maximum(np.sum(np.abs(psi) ** 2, axis=1), 1e-300))

    def pairs(self, f: Array, shapes: Array) -> Array:
        """Which of some predicted modes each one is, by frequency and MAC: one each, so that their sum costs least.

        ``LinAlgError`` if fewer modes are predicted than measured, or some that cannot be.
        """
        if f.size < self.n:
            raise np.linalg.LinAlgError("fewer modes than were measured")
        apart = self._apart(f, shapes)
        if not np.isfinite(apart).all():  # an exponent or a size far out of its range
            raise np.linalg.LinAlgError("modes that cannot be")
        return np.asarray(linear_sum_assignment(apart)[1])

    def alone(self, f: Array, shapes: Array) -> int:
        """The mode without which the others lie nearest to some predicted ones."""
        apart = self._apart(f, shapes)

        def left(k: int) -> float:
            cost = np.delete(apart, k, axis=0)
            return float(cost[linear_sum_assignment(cost)].sum())

        return min(range(self.n), key=left)

    def _apart(self, f: Array, shapes: Array) -> Array:
        """How far predicted modes are, (n, predicted)."""
        norm = np.maximum(np.linalg.norm(shapes, axis=0), 1e-300)
        mac = np.abs(self.shapes.conj().T @ shapes / norm) ** 2
        return np.asarray(np.abs(np.log(self.f)[:, None] - np.log(f)) / NEAR_HZ + _FREQUENCY_OVER_MAC * (1 - mac))


class OperatingModes:
    """The values of operational modes that are fitted, and those that validate; what ``Lines`` is to FRFs.

    The modes of the whole record are fitted. Where both halves were identified apart the second one validates: it is predicted from
    the first. Where there are no halves, one value of each mode in turn (its frequency, damping or shape) is predicted from the others.

    Parameters
    ----------
    idle : Idle
    whole : ModalModel
    halves : sequence of ModalModel
        Two or none.

    Attributes
    ----------
    sets : list of ModeSet
        Of the whole, and of both halves.
    fit, known, validation : int arrays
        Numbers of values that are fitted, of those from which others are predicted, and of the latter.
    apart : bool
        Whether the validation values are a record of their own.
    responses : int array
        DOFs of the idle model that were measured.

    Raises
    ------
    DataError
        If fewer than two DOFs or no mode in band is common to both states.
    """

    stride = rough = 1  # every value counts in a scan
    sizes, frequencies = 8, 20  # modes move smoothly with a size, and with what resonates

    def __init__(self, idle: Idle, whole: ModalModel, halves: Sequence[ModalModel] = ()) -> None:
        common = tuple(d for d in whole.dofs if any(d.same_axis(o) for o in idle.dofs))
        if len(common) < 2:
            raise DataError("idle and operational modes share fewer than two DOFs", hint="measure at the same sensors in both states")
        responses, signs = match_dofs(common, idle.dofs)
        self.responses = np.asarray(responses)
        kept = [half.select_modes(partners(half, whole)) for half in halves]
        top = _ABOVE * float(idle.f[idle.modes].max())
        blocks = int(getattr(whole.details, "settings", {}).get("blocks", 0) or 0)
        self.sets = [mode_set(whole, common, np.asarray(signs), top, blocks)]
        self.left_out = sum(h.n_modes for h in halves) - sum(h.n_modes for h in kept)
        self.apart = len(kept) == 2 and all(h.n_modes for h in kept)
        if self.apart:
            self.sets += [_of_half(mode_set(half, common, np.asarray(signs), top), self.sets[0]) for half in kept]
        ends = np.cumsum([0, *(s.n * s.per_mode for s in self.sets)])
        parts = [np.arange(a, b) for a, b in pairwise(ends)]
        self.fit = parts[0]
        if self.apart:
            self.known, self.validation = parts[1], parts[2]
        else:
            apart = in_turn(self.sets[0]).ravel()
            self.known, self.validation = parts[0][~apart], parts[0][apart]
        self.set_of = np.repeat(np.arange(len(self.sets)), [p.size for p in parts])
        self.w = np.arange(int(ends[-1]))  # what a prediction is asked for: numbers of values
        self.h = np.concatenate([s.measured.ravel() for s in self.sets])[:, None, None]
        self.noise = np.zeros((self.w.size, self.w.size))
        for part, one in zip(parts, self.sets, strict=True):
            self.noise[np.ix_(part, part)] = one.noise
        # of a real number a variance as of a complex one, twice that of each of its parts
        self.variance = 2 * np.diag(self.noise)[:, None, None]
        self.level = np.sqrt(2) * np.concatenate([s.level.ravel() for s in self.sets])[:, None, None]
        self.correlated = 1.0
        self.there = np.ones((1, 1), bool)
        self.at_rest: dict[Any, Array] = {}  # what effects make of the idle model as it is
        self._bases: dict[tuple[int, ...], tuple[Array, Array]] = {}

    def basis(self, at: Array) -> tuple[Array, Array]:
        """Independent combinations of some values (combinations, values) of variance ½ (1 + α²λ), and λ."""
        key = tuple(at)
        if key not in self._bases:
            whiten = np.linalg.inv(np.linalg.cholesky(self.noise[np.ix_(at, at)]))
            scaled = whiten * (self.level[at, 0, 0] / np.sqrt(2))
            values, vectors = np.linalg.eigh(scaled @ scaled.T)
            self._bases[key] = vectors.T @ whiten / np.sqrt(2), np.maximum(values, 0)
        return self._bases[key]

    def rows(self, values: Array, at: Array) -> Array:
        """Values (values, 1, 1, k) as independent ones, (1, rows, k), of variance ½ without a discrepancy."""
        return np.asarray((self.basis(at)[0] @ values[:, 0, 0])[None])

    def spread(self, at: Array) -> Array:
        """λ of the rows, (1, rows)."""
        return self.basis(at)[1][None]

    def by_stretch(self, values: Array, at: Array) -> Array:
        """Sums of values (values,) over each mode, which a discrepancy moves as a whole."""
        ends = np.cumsum([0, *np.repeat([s.per_mode for s in self.sets], [s.n for s in self.sets])])
        return np.bincount(np.searchsorted(ends, at, side="right"), weights=values)

    def error(self, predicted: Array, at: Array) -> float:
        """Of predicted values (values, 1, 1), rms, in standard deviations of the noise."""
        return float(np.sqrt(2 * np.mean(self.rows((self.h[at] - predicted)[..., None], at) ** 2)))

    def telling(self, rows: int) -> Array:
        """All rows tell a discrepancy."""
        return np.arange(rows)

    def rows_variance(self, alpha: float, at: Array) -> Array:
        """Of the rows, times two, (1, rows)."""
        return np.asarray(1 + alpha**2 * self.spread(at))


def mode_set(model: ModalModel, common: tuple[Dof, ...], signs: Array, top: float, blocks: int = 0) -> ModeSet:
    """Modes below ``top`` [Hz] on some DOFs, ``signs`` of the idle model over these.

    ``blocks`` is how many of the record its covariance was estimated from, by their scatter; 0 where that is not known. The inverse of a
    covariance of p values from N blocks is (N − 1)/(N − p − 2) times too large on average (Hartlap et al., Astron. Astrophys. 464, 2007,
    399–404).
    """
    inside = np.asarray(model.in_band) & (model.frequencies_hz < top) & (model.damping_ratios > 0) & (model.frequencies_hz > 0)
    kept = model.select_modes(inside)
    if not kept.n_modes:
        raise DataError("no operational mode lies in the band of the idle model", hint="identify the operating record over the idle band")
    rows, turned = match_dofs(common, model.dofs)
    own, sense = np.asarray(rows), np.asarray(turned) * signs
    n, m, full = kept.n_modes, own.size, len(model.dofs)
    raw = np.asarray(kept.shapes, complex)[own] * sense[:, None]
    norm = np.linalg.norm(raw, axis=0)
    shapes = raw / norm
    across = np.stack([_across(y) for y in shapes.T])
    noise = np.zeros((n, 2 * m, n, 2 * m))
    f_std, z_std, s_std = kept.frequency_std_hz, kept.damping_ratio_std, kept.shape_std
    for k in range(n):
        y = shapes[:, k]
        covariance = np.zeros((2 + 2 * m, 2 + 2 * m))
        if kept.covariance is not None and np.iscomplexobj(kept.shapes):
            real = 2 * n + k * full + own
            at = np.r_[k, n + k, real, real + n * full]
            unit = np.r_[1 / kept.frequencies_hz[k], 1 / kept.damping_ratios[k], np.tile(sense, 2) / norm[k]]
            covariance = np.asarray(kept.covariance)[np.ix_(at, at)] * unit[:, None] * unit
            if blocks:
                covariance = covariance * ((blocks - 1) / max(blocks - 2 * m - 2, _LEAST_SHARE * blocks))
        else:
            relative = [ASSUMED_MODES[0] if f_std is None else f_std[k] / kept.frequencies_hz[k]]
            relative.append(ASSUMED_MODES[1] if z_std is None else z_std[k] / kept.damping_ratios[k])
            each = np.full(m, ASSUMED_MODES[2] * np.abs(y).max()) if s_std is None else np.asarray(s_std)[own, k] / norm[k]
            covariance = np.diag(np.r_[np.square(relative), np.tile(each**2 / 2, 2)])
        to = np.zeros((2 * m, 2 + 2 * m))
        to[0, 0] = to[1, 1] = 1
        to[2:, 2:] = across[k].T
        second = (SECOND_ORDER * float(np.trace(covariance[2:, 2:]))) ** 2
        floor = np.full(2 * m, (MODES_FLOOR[2] * np.abs(y).max()) ** 2 + second)
        floor[:2] = np.square(MODES_FLOOR[:2])
        noise[k, :, k] = to @ covariance @ to.T + np.diag(floor)
    size = n * 2 * m
    return ModeSet(kept.frequencies_hz, kept.damping_ratios, shapes, across, noise.reshape(size, size))


def _of_half(half: ModeSet, whole: ModeSet) -> ModeSet:
    """Modes of half a record with twice the covariance of the whole.

    That of 26 values from the 44 blocks of a half would have an inverse 2.5 times too large, and each another.
    """
    apart = np.abs(np.log(half.f[:, None] / whole.f)) / PARTNER_LOG_HZ + 1 - np.abs(half.shapes.conj().T @ whole.shapes) ** 2
    n, size = half.n, half.per_mode
    noise = np.zeros((n, size, n, size))
    known = whole.noise.reshape(whole.n, size, whole.n, size)
    for k, other in enumerate(np.argmin(apart, axis=1)):
        turn = np.vdot(whole.shapes[:, other], half.shapes[:, k])
        turn = turn / np.abs(turn)
        unit = np.eye(len(half.shapes))
        rotation = np.block([[turn.real * unit, -turn.imag * unit], [turn.imag * unit, turn.real * unit]])
        to = np.eye(size)
        to[2:, 2:] = half.across[k].T @ rotation @ whole.across[other]
        noise[k, :, k] = 2 * to @ known[other, :, other] @ to.T
        noise[k, :, k] += np.diag(1e-9 * np.diag(noise[k, :, k]))
    return replace(half, noise=noise.reshape(n * size, n * size))


def _across(y: Array) -> Array:
    """Orthonormal real directions (2 m, 2 m − 2) perpendicular to y and iy."""
    along = np.stack([np.r_[y.real, y.imag], np.r_[-y.imag, y.real]], 1)
    return np.asarray(np.linalg.qr(along, mode="complete")[0][:, 2:])


def in_turn(modes: ModeSet) -> Array:
    """(n, per mode) bool: of each mode its shape, frequency or damping in turn; all where there are too few to set some apart."""
    out = np.zeros((modes.n, modes.per_mode), bool)
    for k in range(modes.n):
        out[k, (slice(2, None), slice(0, 1), slice(1, 2))[k % 3]] = True
    return out


def partners(half: ModalModel, whole: ModalModel) -> Array:
    """Modes of half a record that the whole shows, too, one each: the others are spurious, and no effect would explain them.

    Both are on the same DOFs.
    """
    if tuple(half.dofs) != tuple(whole.dofs):
        return np.ones(half.n_modes, bool)
    a, b = np.asarray(half.shapes), np.asarray(whole.shapes)
    norms = np.linalg.norm(a, axis=0)[:, None] * np.linalg.norm(b, axis=0)
    mac = np.abs(a.conj().T @ b / np.maximum(norms, 1e-300)) ** 2
    apart = np.abs(np.log(half.frequencies_hz[:, None] / whole.frequencies_hz))
    near = (apart < PARTNER_LOG_HZ) & (mac > PARTNER_MAC)
    one, other = linear_sum_assignment(np.where(near, apart / PARTNER_LOG_HZ + 1 - mac, 1e3))
    out = np.zeros(half.n_modes, bool)
    out[one] = near[one, other]
    return out

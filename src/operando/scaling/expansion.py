"""Prior-weighted expansion: operational shapes as mixtures of all idle modes, weighted by what a change can do.

A change of stiffness or mass at some place b mixes idle mode k into an operational mode at ω_o by q_k ∝ φ_k(b)/(ω_k² − ω_o²)
(method.md, "What the paper leaves open"). Where b is not known, φ_k(b) is of the size of the others: so q has a prior with
standard deviations ∝ √(δ_j·δ_k)/|ω_k² − ω_o²|, δ the relative shifts of ω² that operation made: modes that do not move do not
mix. How far shapes really follow, one width for all with some scatter, is the most likely; its posterior mean follows from the
shape and its noise. All idle modes take part, residual ones too, however few sensors there are, and noise is smoothed where the
prior leaves no room for it: where nothing changed, the idle shapes remain. The scale then
follows from the modal mass qᵀq = 1 if mass is the same at rest and in operation (assumption 3 of Shen & Lu 2024, Eq 13 in
another basis), or from the modal stiffness qᵀΩ²q = ω_o² if stiffness is; which of the two holds is seen from the
orthogonality of the operational modes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data.arrays import ByContent
from operando.errors import IdentificationError

DEFAULT_NOISE = 0.02
"""Relative noise of an operational shape where no covariance is given and none can be told."""

NOISE_FLOOR = 0.003
"""Least relative noise: idle shapes are not better than this."""

WIDTHS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
"""Trial widths of the prior, 1 being what the frequency shifts let expect; the evidence of each shape chooses."""

WIDTH_SPREAD = 0.7
"""Standard deviation of the logarithm of the width of a shape about the centre common to all shapes."""

CENTRE_SPREAD = 3.0
"""Standard deviation of that centre about 0, a width of 1."""

HZ_NOISE = 5e-4
"""Least relative deviation of a frequency that says nothing."""

ISOTROPIC = 0.2
"""Part of the variance of a shape that is put down to noise of any direction: covariances of an OMA are too sure of some directions."""

NOISE_FACTORS = (1.0, 3.0, 10.0)
"""Trial factors on the stated noise of a shape: now and then an OMA is far too sure of a mode."""

FACTOR_PRICE = 2.0
"""Power with which the likelihood of a factor falls."""

NOT_NOISE = 0.5
"""How likely it is that what a raised noise factor explains away is part of the shape after all."""

UNLIKELY = 1e-3
"""Trials less likely than this are left out of what the width leaves open."""

NOT_ORTHOGONAL = 0.02
"""Non-orthogonality of close modes that is put down to the change, not to noise."""

CLOSE = 0.02
"""Relative distance of frequencies up to which modes are close; further apart, modes unknown beyond the band matter more than noise."""

FURTHEST = 0.15
"""... but not more than this: modes far apart are orthogonal in what did not change, too."""

ORTHOGONALITY_NOISE = 0.01
"""Standard deviation of an off-diagonal below which all pairs of modes count alike."""

REMAINDERS = (0.0, 1.0, 3.0, 10.0, 30.0)
"""Trial sizes of what no idle mode explains, in units of the noise."""

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Trial(ByContent):
    """Log evidence of a width of the prior, with the best remainder and noise factor."""

    evidence: float
    width: NDArray[np.float64]
    remainder: float
    noise_factor: float


@dataclass(frozen=True, eq=False)
class Prior(ByContent):
    """Standard deviations that are held fixed while shapes vary."""

    participation: NDArray[np.float64]  # (n_idle, n_operating): of q, for operational shapes of unit length
    remainder: NDArray[np.float64]  # (n_operating,): of the part of a shape, at each DOF, that the idle modes do not explain
    noise: NDArray[np.float64]  # (n_operating, m, m): covariance of the shape values
    # (n_operating, n_operating): part of the non-orthogonality of modes s and r that is taken out of r, between 0 and 1: large where little
    # is known about how much of s there is in r, as for close modes
    mixing: NDArray[np.float64]
    # (m, m): where that part may lie: the projector on what is outside the span of the idle modes (zero with at least as many modes as
    # DOFs), or everything for shapes without stated noise
    outside: NDArray[np.float64]
    # for each operational mode the trial widths and how likely each is, the chosen one among them
    others: tuple[tuple[tuple[float, Trial], ...], ...] = ()

    def covariance(self, r: int) -> NDArray[np.float64]:
        """Covariance of all in shape r that is not Φq: noise and remainder."""
        return np.asarray(self.noise[r] + self.remainder[r] ** 2 * self.outside)


def make_prior(
    idle: NDArray[np.float64],
    idle_hz: NDArray[np.float64],
    unit_shapes: NDArray[np.float64],
    operating_hz: NDArray[np.float64],
    damping: NDArray[np.float64],
    partners: NDArray[np.int_],
    noise: NDArray[np.float64] | None = None,
    hz_noise: NDArray[np.float64] | None = None,
    idle_std: NDArray[np.float64] | None = None,
) -> Prior:
    """Prior of each operational shape; its width and remainder are the most likely of a small grid (empirical Bayes).

    ``idle`` (m, n_idle) has unit modal mass, residual modes included; ``unit_shapes`` (m, n_operating) columns of unit length; ``partners``
    the idle partner of each or −1. ``noise`` (n_operating, m, m) is the covariance of these columns, without which they count as nearly
    exact, ``hz_noise`` the relative standard deviation of the operational frequencies. By ``idle_std`` (m, n_idle) an idle mode that may as
    well be noise takes little part, unless it is the partner.
    """
    m, n = unit_shapes.shape
    sure = np.ones(idle.shape[1]) if idle_std is None else reliability(idle, idle_std)
    each = np.eye(m) / m
    outside = np.eye(m) - idle @ np.linalg.pinv(idle) if idle.shape[1] < m else np.zeros((m, m))
    shift = frequency_shifts(idle_hz, operating_hz, partners, hz_noise)
    if noise is not None:
        own = np.trace(noise, axis1=1, axis2=2)[:, None, None]
        cov = noise + (ISOTROPIC * own + NOISE_FLOOR**2) * each
    else:
        # Nothing is known of the noise: what the idle modes do not explain is taken for part of the shape.
        cov, outside = np.repeat(NOISE_FLOOR**2 * each[None], n, axis=0), np.eye(m)
    tables = []
    for r in range(n):
        relative, j = _relative(idle, idle_hz, operating_hz[r], damping[r], int(partners[r]), shift[0][r], shift[1])
        tables.append(_trials(idle, relative, j, unit_shapes[:, r], cov[r], outside, sure))
    chosen, likely = _common_width(np.array([[trial.evidence for trial in table] for table in tables]))
    taken = [tables[r][k] for r, k in enumerate(chosen)]
    louder = np.array([trial.noise_factor for trial in taken])
    found = Prior(
        np.array([trial.width for trial in taken]).T,
        np.array([trial.remainder for trial in taken]),
        cov * louder[:, None, None] ** 2,
        np.zeros((n, n)),
        outside,
        tuple(tuple(zip(weights.tolist(), table, strict=True)) for weights, table in zip(likely, tables, strict=True)),
    )
    return replace(found, mixing=_mixing(idle, unit_shapes, found, operating_hz))


def reliability(idle: NDArray[np.float64], std: NDArray[np.float64]) -> NDArray[np.float64]:
    """Part of the mean square of each idle shape (columns) that is not its own error: Σφ²/(Σφ² + Σσ²)."""
    size, error = np.sum(idle**2, axis=0), np.sum(std**2, axis=0)
    return np.asarray(size / np.maximum(size + error, 1e-300))


def _common_width(evidence: NDArray[np.float64]) -> tuple[list[int], NDArray[np.float64]]:
    """Trial of each shape (rows) that is most likely with its neighbours, and how likely each trial is about the common centre.

    One change made all shapes, so their widths scatter about one centre.
    """
    log_width = np.log(WIDTHS)
    best, table = -np.inf, evidence
    for centre in np.linspace(log_width[0], log_width[-1], 25):
        each = evidence - 0.5 * ((log_width - centre) / WIDTH_SPREAD) ** 2
        total = float(np.sum(np.max(each, axis=1))) - 0.5 * (centre / CENTRE_SPREAD) ** 2
        if total > best + 1e-9:
            best, table = total, each
    likely = np.exp(table - np.max(table, axis=1, keepdims=True)) if table.size else table
    return [int(k) for k in np.argmax(table, axis=1)], likely / np.sum(likely, axis=1, keepdims=True)


def frequency_shifts(
    idle_hz: NDArray[np.float64], operating_hz: NDArray[np.float64], partners: NDArray[np.int_], hz_noise: NDArray[np.float64] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Relative change of ω² that operation made in each operational and each idle mode, never below what its noise could hide.

    A change of one sign has |ΔK_jk| ≤ √(ΔK_jj·ΔK_kk), and ΔK_jj shows as the shift of mode j: modes that do not move do not mix.
    Modes without a partner get the rms of the others.
    """
    std = np.full(operating_hz.size, HZ_NOISE) if hz_noise is None else np.maximum(hz_noise, HZ_NOISE)
    paired = np.flatnonzero(partners >= 0)
    own = np.full(operating_hz.size, np.nan)
    own[paired] = 2 * np.hypot(np.log(operating_hz[paired] / idle_hz[partners[paired]]), std[paired])
    typical = float(np.sqrt(np.mean(own[paired] ** 2))) if paired.size else 1.0
    of_idle = np.full(idle_hz.size, typical)
    of_idle[partners[paired]] = own[paired]
    return np.where(np.isfinite(own), own, typical), of_idle


def _relative(
    idle: NDArray[np.float64],
    idle_hz: NDArray[np.float64],
    hz: float,
    damping: float,
    partner: int,
    shift: float,
    idle_shifts: NDArray[np.float64],
) -> tuple[NDArray[np.float64], int]:
    """Expected size of the participation of each idle mode in a shape of unit length, and the mode that leads it."""
    # Damping keeps the weight finite where frequencies meet: what lies within a bandwidth may mix freely.
    reach = 1 / np.hypot(1 - (idle_hz / hz) ** 2, 2 * damping + 1e-4)
    j = partner if partner >= 0 else int(np.argmax(reach))
    size = np.maximum(np.linalg.norm(idle, axis=0), 1e-12 * np.max(np.linalg.norm(idle, axis=0)))
    return np.sqrt(shift * idle_shifts) * reach / size[j], j


def _trials(
    idle: NDArray[np.float64],
    relative: NDArray[np.float64],
    leading: int,
    shape: NDArray[np.float64],
    noise: NDArray[np.float64],
    outside: NDArray[np.float64],
    sure: NDArray[np.float64],
) -> list[Trial]:
    """Each trial width with its best remainder and noise factor."""
    m = shape.size
    size = np.maximum(np.linalg.norm(idle, axis=0), 1e-12 * np.max(np.linalg.norm(idle, axis=0)))
    out = []
    for t in WIDTHS:
        std = np.minimum(t * relative, 3 / size) * sure
        std[leading] = 3 / size[leading]
        spread = (idle * std**2) @ idle.T
        best = Trial(-np.inf, std, 0.0, 1.0)
        for louder in NOISE_FACTORS:
            for rest in REMAINDERS if np.any(outside) else REMAINDERS[:1]:
                tau = rest * float(np.sqrt(np.trace(noise) / m))
                factor = np.linalg.cholesky(spread + louder**2 * noise + tau**2 * outside)
                white = np.linalg.solve(factor, shape)
                evidence = -0.5 * float(white @ white) - float(np.sum(np.log(np.diag(factor)))) - FACTOR_PRICE * np.log(louder)
                if evidence > best.evidence + 1e-9:
                    best = Trial(evidence, std, tau, louder)
        out.append(best)
    return out


def _mixing(idle: NDArray[np.float64], unit_shapes: NDArray[np.float64], prior: Prior, hz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share A_sr = v_sr/(v_rs + v_sr + τ²), v_sr the posterior variance of the part of mode s in mode r; τ grows with their distance."""
    spread = participation_spread(idle, unit_shapes, prior)
    gap = np.abs(hz[:, None] - hz[None, :]) / np.minimum(hz[:, None], hz[None, :])
    own = np.minimum(NOT_ORTHOGONAL * (1 + (gap / CLOSE) ** 2), FURTHEST)
    out: NDArray[np.float64] = spread / (spread + spread.T + own**2)
    np.fill_diagonal(out, 0)
    return out


def participation_spread(idle: NDArray[np.float64], unit_shapes: NDArray[np.float64], prior: Prior) -> NDArray[np.float64]:
    """Posterior variance v[s, r] of the part of operational mode s in mode r, both of unit modal mass."""
    q = expand(idle, unit_shapes, prior)[0]
    size = np.linalg.norm(q, axis=0)
    unit = q / np.maximum(size, 1e-300)
    out = np.zeros((q.shape[1], q.shape[1]))
    for r in range(q.shape[1]):
        std = prior.participation[:, r]
        weighted = idle * std**2
        total = weighted @ idle.T + prior.covariance(r)
        left = np.sum((unit * std[:, None]) ** 2, axis=0)
        known = weighted @ unit
        out[:, r] = np.maximum(left - np.sum(known * np.linalg.solve(total, known), axis=0), 0) / max(size[r], 1e-300) ** 2
    return out


def expand(idle: Array, unit_shapes: Array, prior: Prior) -> tuple[Array, Array, Array]:
    """Posterior mean of q (…, n_idle, n_operating) and of the shape (…, m, n_operating): Φq plus the likely part of the remainder.

    The squared length of that remainder (…, n_operating) comes last.
    """
    lead = np.broadcast_shapes(idle.shape[:-2], unit_shapes.shape[:-2])
    m, n = unit_shapes.shape[-2:]
    q = np.zeros((*lead, idle.shape[-1], n))
    shape, rest = np.zeros((*lead, m, n)), np.zeros((*lead, n))
    for r in range(n):
        weighted = idle * prior.participation[:, r] ** 2
        total = weighted @ np.swapaxes(idle, -1, -2) + prior.covariance(r)
        column = np.broadcast_to(unit_shapes[..., :, r], (*lead, m))[..., None]
        white = np.linalg.solve(np.broadcast_to(total, (*lead, m, m)), column)[..., 0]
        q[..., :, r] = np.einsum("...mk,...m->...k", weighted, white)
        extra = prior.remainder[r] ** 2 * white @ prior.outside
        shape[..., :, r] = np.einsum("...mk,...k->...m", idle, q[..., :, r]) + extra
        rest[..., r] = np.sum(extra**2, axis=-1)
    return q, shape, rest


def orthogonalised(q: Array, shape: Array, mixing: NDArray[np.float64], weight: Array) -> tuple[Array, Array]:
    """Take noise out that shows as non-orthogonality: q_r − Σ_s A_sr·(q_sᵀWq_r)·q_s, and the shapes alike.

    Columns of q are of unit modal mass (or stiffness). ``weight`` (…, n_idle, n_operating) is W as a factor on each column: 1 for mass;
    ω_k²/(ω_s·ω_r) needs ω_k/ω_r on each.
    """
    weighted = q * weight
    gram = np.swapaxes(weighted, -1, -2) @ weighted
    change = np.eye(q.shape[-1]) - mixing * gram
    return q @ change, shape @ change


def unit_size(idle: Array, q: Array, shape: Array, rest: Array, weight: Array, mixing: NDArray[np.float64], in_sight: Array) -> Array:
    """Shapes of unit modal mass from what :func:`expand` gives: scaled, freed of non-orthogonality, scaled again.

    What no idle mode explains counts in the size with the typical size of a mode at the sensors, of the idle modes ``in_sight``. ``weight``
    is 1 where mass is as at rest, ω_k/ω_o where stiffness is.
    """
    typical = np.median(np.sum(idle[..., :, in_sight] ** 2, axis=-2), axis=-1)
    extra = rest / typical[..., None]
    size = np.sqrt(np.sum((q * weight) ** 2, axis=-2) + extra)
    if np.any(size <= 1e-9 * np.max(size)):
        raise IdentificationError(
            "an operational shape has no part in the idle shapes: its modal mass is ill-determined", hint="use idle_shapes"
        )
    q, shape = orthogonalised(q / size[..., None, :], shape / size[..., None, :], mixing, weight)
    again = np.sqrt(np.sum((q * weight) ** 2, axis=-2) + extra / size**2)
    return np.asarray(shape / again[..., None, :])


def orthogonality(q: NDArray[np.float64], idle_hz: NDArray[np.float64], spread: NDArray[np.float64] | None = None) -> tuple[float, float]:
    """Rms off-diagonal of the operational modes' normalised mass and stiffness matrices, both in the idle structure.

    Zero for the first if mass did not change, for the second if stiffness did not. ``spread`` (n_operating, n_operating) is the posterior
    variance of the part of mode s in mode r; pairs of which little is known count little.
    """
    n = q.shape[1]
    if n < 2:
        return 0.0, 0.0
    upper = np.triu_indices(n, 1)
    trust = np.ones(upper[0].size) if spread is None else 1 / ((spread + spread.T)[upper] + ORTHOGONALITY_NOISE**2)
    out = []
    for weighted in (q, q * idle_hz[:, None]):
        unit = weighted / np.maximum(np.linalg.norm(weighted, axis=0), 1e-300)
        out.append(float(np.sqrt(np.average((unit.T @ unit)[upper] ** 2, weights=trust))))
    return out[0], out[1]


def prior_spread(
    idle: NDArray[np.float64], unit_shapes: NDArray[np.float64], size_factor: NDArray[np.float64], prior: Prior
) -> list[NDArray[np.float64]]:
    """What the prior leaves open: a factor (m, k) of the covariance of each scaled shape that the smoothing may have taken away.

    For q ~ N(0, P) and gain K the error of the posterior mean that is not noise is (KΦ − 1)q + Kρ; with the noise part (from the covariance
    of the shapes) it makes up the posterior covariance. The width of the prior is not known: every trial width adds what it leaves open and
    how far its shape lies from the one chosen, as likely as it is. ``size_factor`` (n_idle, n_operating) is the weight of q² in the squared
    size: 1 for mass, (ω_k/ω_o)² for stiffness.
    """
    out = []
    for r in range(unit_shapes.shape[1]):
        column, factor, noise = unit_shapes[:, r], size_factor[:, r], prior.noise[r]
        own, spread = _left_open(idle, column, factor, prior.participation[:, r], prior.remainder[r], noise, prior.outside)
        if not prior.others:
            out.append(spread)
            continue
        at_most = max(weight for weight, _ in prior.others[r])
        chosen = next(trial for weight, trial in prior.others[r] if weight == at_most)
        parts = []
        for weight, trial in prior.others[r]:
            if weight > UNLIKELY:
                louder = noise * (trial.noise_factor / chosen.noise_factor) ** 2
                shape, left = _left_open(idle, column, factor, trial.width, trial.remainder, louder, prior.outside)
                parts += [np.sqrt(weight) * left, np.sqrt(weight) * (shape - own)[:, None]]
                if trial.noise_factor > 1:
                    onto = float(own @ column)
                    seen = column * (float(own @ own) / onto if onto else 0.0)
                    parts.append(np.sqrt(NOT_NOISE * weight) * (seen - own)[:, None])
        out.append(np.concatenate(parts, axis=1))
    return out


def _left_open(
    idle: NDArray[np.float64],
    column: NDArray[np.float64],
    size_factor: NDArray[np.float64],
    std: NDArray[np.float64],
    remainder: float,
    noise: NDArray[np.float64],
    outside: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """One shape (m,) of unit modal mass under a prior, and what that prior leaves open about it (m, k)."""
    m = column.size
    weighted = idle * std**2
    total = weighted @ idle.T + noise + remainder**2 * outside
    gain = np.linalg.solve(total, weighted).T
    rest = remainder * outside
    tail = remainder * rest @ np.linalg.inv(total)
    q = gain @ column
    shape = idle @ q + tail @ column
    # Columns: one a unit deviation of each q, then of the remainder at each DOF.
    dq = np.concatenate([(gain @ idle - np.eye(std.size)) * std, gain @ rest], axis=1)
    dshape = idle @ dq + np.concatenate([tail @ idle * std, (tail - np.eye(m)) @ rest], axis=1)
    size = float(np.sqrt(np.sum(size_factor * q**2)))
    along = (size_factor * q) @ dq / size**2
    return shape / size, (dshape - np.outer(shape, along)) / size

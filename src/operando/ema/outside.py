"""What lies outside the band, completed to all DOFs: residual modes from the driven columns and a prior.

The fit knows the out-of-band part of the driven columns of the FRF matrix without any assumption. The undriven columns follow from
it only through reciprocity and the fact that each mode is one shape. A few pseudo-modes above (and below) the band,
with independent Gaussian shape values of the size of the in-band ones, are fitted to the driven part; where nothing was
driven, the prior's remaining variance stands as a local compliance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from operando.ema.polish import Polished
from operando.ema.polish_model import OUTSIDE_DAMPING, Complex, Parameters, Real
from operando.ema.spectra import RunSpectra
from operando.synthesis import modal_kernel, synthesise

UPPER = (1.05, 1.12, 1.2, 1.3, 1.45, 1.7, 2.1, 2.8, 4.0, 8.0)
LOWER = (0.02, 0.02, 0.02, 0.6)
SHIFT = 0.5
"""Standard deviation of the logarithm of how far above the lines each upper pseudo-mode lies: its neighbours are as far away."""

MOST_DAMPING = 0.5
"""Largest damping ratio of a term below the band: half of the critical one, so that it stays a mode that swings. A mass line at a fiftieth
of the lowest line, which would need more, lags less than was measured."""

LOCAL = 2.0
LOCAL_SHAPE, LOCAL_SPREAD = 0.7, 0.9
"""Mean and standard deviation of the local shape value of an undriven DOF over that which would make up a drive point's compliance."""

N_LINES, INDEPENDENT = 40, 2
"""Lines over the band on which the pseudo-modes are fitted, and so many of them as what they leave is worth: a level and a slope."""

TOLERANCE = 0.01
"""Accuracy asked of the pseudo-modes, in units of the out-of-band part itself.

Asked for more, they buy the last percent of the driven columns with shapes too large at undriven DOFs, where only their squares show: at
0.003 errors between undriven DOFs are a third larger, at 0.03 those of driven columns a quarter (benchmarks/README.md, "Driven pairs").
"""

MOST_TOLERANCE = 0.02
"""The same where a model error rules: the FRFs are known no better. Asked for 1 % of a bookcase (model error 7 %), a mass on its base was
no longer taken for one beside it, as it is; of a plate (7 %) the FRFs were missed by 24 % at 2 and 3 %, by 26 % at 1 %, by 29 % at 7 %, and
a mass of 10 g was found at 2 % alone (tests/test_measured.py)."""

OUTER_TOLERANCE = 0.3
"""The same on lines above the analysis band, where the nearest pseudo-modes would else be out of size."""

LARGEST, NEAREST = 8.0, 4
"""Out of size: over so many times the shape values in the band; the nearest so many pseudo-modes are looked at."""

ILL_DETERMINED = 5.0
"""Standard deviation of a shape value of a mode beyond the lines, over the shape values of the others, above which it is no mode.

It makes up for what lies outside: driven by next to nothing, its shape anywhere else is what the columns hold over next to nothing.
"""

NEGLIGIBLE = 1e-4
"""The same in units of the in-band part: less than this is nothing."""


@dataclass(frozen=True)
class OutsideModes:
    """Residual modes: poles (p,), real shapes (M, p), covariance of the shapes mode by mode (p·M, p·M)."""

    hz: Real
    zeta: Real
    shapes: Real
    covariance: Real


def make_up(runs: Sequence[RunSpectra], fit: Polished) -> NDArray[np.int_]:
    """Modes of the fit beyond its lines that nothing but the driven columns tells of: part of what lies outside."""
    theta = fit.parameters
    top, bottom = max(run.top_hz for run in runs), min(float(run.frequencies_hz[0]) for run in runs)
    beyond = (theta.hz > top) | (theta.hz < bottom)
    if beyond.all() or not beyond.any():
        return np.zeros(0, int)
    m, n = theta.shapes.shape
    rms = float(np.median(np.sqrt(np.mean(theta.shapes[:, ~beyond] ** 2, axis=0))))
    std = np.sqrt(np.maximum(np.diag(fit.covariance)[2 * n :], 0)).reshape(n, m).T
    return np.flatnonzero(beyond & (np.max(std, axis=0) > ILL_DETERMINED * rms))


def without_modes(fit: Polished, gone: NDArray[np.int_]) -> Polished:
    """The fit without some of its modes; the others as they were found beside them."""
    m, n = fit.parameters.shapes.shape
    keep = np.setdiff1d(np.arange(n), gone)
    rows = np.concatenate([keep, n + keep, (2 * n + keep[:, None] * m + np.arange(m)).ravel()])
    return replace(fit, parameters=fit.parameters.modes(keep), covariance=fit.covariance[np.ix_(rows, rows)])


def outside_modes(
    runs: Sequence[RunSpectra],
    fit: Polished,
    band: tuple[float, float],
    lower: bool,
    max_dofs: int = 60,
    gone: NDArray[np.int_] | None = None,
    local_terms: bool = True,
    model_error: float = 0.0,
) -> OutsideModes:
    """Residual modes of all DOFs from the out-of-band part of the driven columns, which the local coefficients of ``fit`` hold.

    They must hold in ``band`` [Hz]; ``lower`` says whether kernels below it were fitted. The nonlinear part of the fit takes ``max_dofs``
    DOFs, further ones follow by linear least squares. What the modes ``gone`` of the fit, which are none (:func:`make_up`), add to the
    driven columns lies outside. With ``local_terms`` each DOF that was not driven gets a term for the compliance of its own.
    ``model_error`` is that of the fit, a share of the FRF: the driven columns are known no better (up to :data:`MOST_TOLERANCE`).
    """
    moved = fit.parameters
    fit = fit if gone is None or not gone.size else without_modes(fit, gone)
    theta = fit.parameters
    top = max([run.top_hz for run in runs] + [float(h) for h in theta.hz])
    bottom = min(float(run.frequencies_hz[0]) for run in runs)
    f = np.geomspace(max(band[0], 1e-3 * band[1]), max(run.top_hz for run in runs), N_LINES)
    m_dofs, n = theta.shapes.shape
    driven, known, refs = _driven(runs, theta, f)
    target = driven.real
    if gone is not None and gone.size:
        part = moved.shapes[:, gone]
        more = np.einsum("kp,jp,pl->kjl", part[refs], part, modal_kernel(f, moved.hz[gone], moved.zeta[gone], "accelerance").real)
        target = target + np.where(known[:, :, None], more, 0.0)
    rms = float(np.median(np.sqrt(np.mean(theta.shapes**2, axis=0))))
    spacing = float((theta.hz.max() - theta.hz.min()) / max(n - 1, 1)) or top / max(n, 1)
    upper_hz = np.array(UPPER) * top
    share = np.sqrt(np.maximum(np.gradient(upper_hz) / spacing, 1.0))
    hz, std = upper_hz, rms * share
    if lower:
        hz = np.concatenate([hz, np.array(LOWER) * bottom])
        std = np.concatenate([std, np.full(len(LOWER), 2 * rms)])
    grid = _Grid(f, hz, top, len(UPPER))
    g = grid.kernels(np.zeros(len(UPPER)))
    scale = np.sqrt(np.mean(target[known] ** 2, axis=0)) if known.any() else np.ones(f.size)
    # The driven columns tell how much there is outside at all (products of two shape values, hence the root).
    expected = np.sqrt(np.sum((std[: len(UPPER), None] ** 2 * g[: len(UPPER)]) ** 2, axis=0))
    std = std * np.sqrt(min(float(np.median(scale / np.maximum(expected, 1e-300))), 2.0))
    inside = synthesise(f, theta.hz, theta.zeta, theta.shapes, theta.shapes[refs])
    floor = NEGLIGIBLE * np.sqrt(np.mean(np.abs(inside) ** 2, axis=(0, 1)))
    noise = _noise(runs, fit, f)
    if not np.any(target[known]):
        return _empty(m_dofs)
    core = np.array(sorted(set(refs) | set(_most_telling(target, known, max_dofs))))
    at = {int(row): i for i, row in enumerate(core)}
    inner = float(np.clip(model_error, TOLERANCE, MOST_TOLERANCE))
    for outer in (inner, OUTER_TOLERANCE):
        asked = np.where(f <= band[1], inner, outer)
        weight = 1 / np.sqrt((asked * scale) ** 2 + floor**2 + noise)
        psi_core, shift, cov_core = _nonlinear(target[:, core], known[:, core], np.array([at[r] for r in refs]), grid, weight, std)
        if np.max(np.abs(psi_core[:, :NEAREST])) < LARGEST * rms:
            break
    hz, g = grid.hz(shift), grid.kernels(shift)
    shapes = np.zeros((m_dofs, hz.size))
    variance = np.broadcast_to(std**2, (m_dofs, hz.size)).copy()
    shapes[core] = psi_core
    variance[core] = np.einsum("ipip->ip", cov_core)
    for row in np.setdiff1d(np.arange(m_dofs), core):
        shapes[row], variance[row] = _linear_row(target[:, row], known[:, row], psi_core[[at[r] for r in refs]], g, weight, std)
    covariance = np.zeros((hz.size, m_dofs, hz.size, m_dofs))
    covariance[np.ix_(np.arange(hz.size), core, np.arange(hz.size), core)] = cov_core.transpose(1, 0, 3, 2)
    rest = np.setdiff1d(np.arange(m_dofs), core)
    for p in range(hz.size):
        covariance[p, rest, p, rest] = variance[rest, p]
    size = hz.size * m_dofs
    made = OutsideModes(hz, np.full(hz.size, OUTSIDE_DAMPING), shapes, covariance.reshape(size, size))
    if lower:
        below = _driven(runs, theta, f, theta.outside_hz < bottom)[0]
        made.zeta[len(UPPER) :] = _lower_damping(made, below.imag, known, refs, f)
    return _with_local(made, refs, top, f) if local_terms else made


def _lower_damping(made: OutsideModes, lag: Real, known: NDArray[np.bool_], refs: list[int], f: Real) -> Real:
    """Damping ratios of the terms below the band, of one damper over mass, from the imaginary part that they have in the driven columns.

    Far above a mode that lags by 2 ζ f_r/f behind what it adds. All terms have one product ζ f_r, for the columns tell no more.
    """
    hz, shapes = made.hz[len(UPPER) :], made.shapes[:, len(UPPER) :]
    along = ((shapes[refs] @ shapes.T)[..., None] * 2 / f)[known]
    product = float(np.sum(along * lag[known]) / max(float(np.sum(along**2)), 1e-300))
    return np.clip(product / hz, OUTSIDE_DAMPING, MOST_DAMPING)


@dataclass(frozen=True)
class _Grid:
    """Pseudo-modes whose frequencies above the lines move: the nearest true mode lies at none that was chosen before."""

    f: Real
    start: Real
    top: float
    upper: int

    def hz(self, shift: Real) -> Real:
        moved = self.start.copy()
        moved[: self.upper] = self.top + (self.start[: self.upper] - self.top) * np.exp(shift)
        return moved

    def kernels(self, shift: Real) -> Real:
        """Of all pseudo-modes, (p, L)."""
        return _outside_kernel(self.f, self.hz(shift))

    def slopes(self, shift: Real) -> Real:
        """Derivatives of the upper ones by their shifts, (upper, L)."""
        step = 1e-4
        up, down = (_outside_kernel(self.f, self.hz(shift + side * step)[: self.upper]) for side in (1, -1))
        return (up - down) / (2 * step)


def _outside_kernel(f: Real, hz: Real, zeta: Real | float = OUTSIDE_DAMPING) -> Real:
    """Real part of the kernels that stand for modes outside, (q, L)."""
    return modal_kernel(f, hz, np.broadcast_to(zeta, hz.shape), "accelerance").real


def _driven(
    runs: Sequence[RunSpectra], theta: Parameters, f: Real, part: NDArray[np.bool_] | None = None
) -> tuple[Complex, NDArray[np.bool_], list[int]]:
    """Out-of-band part of the driven columns on lines ``f``: (K, M, L), which of them are measured (K, M), and their rows.

    ``part`` of the kernels alone, where given.
    """
    q = theta.outside_hz.size
    some = np.arange(q) if part is None else np.flatnonzero(part)
    g = modal_kernel(f, theta.outside_hz[some], theta.outside_zeta[some], "accelerance")
    refs = list(dict.fromkeys(int(row) for run in runs for row in run.force_rows))
    m_dofs = theta.shapes.shape[0]
    total = np.zeros((len(refs), m_dofs, f.size), complex)
    count = np.zeros((len(refs), m_dofs))
    for i, run in enumerate(runs):
        for k, row in enumerate(run.force_rows):
            column = refs.index(int(row))
            total[column, run.response_rows] += theta.local[i][:, k * q + some] @ g
            count[column, run.response_rows] += 1
    known = count > 0
    total[known] /= count[known][:, None]
    return total, known, refs


def _noise(runs: Sequence[RunSpectra], fit: Polished, f: Real) -> Real:
    """Mean variance of the out-of-band part on lines ``f``, from the information of its coefficients."""
    q = fit.parameters.outside_hz.size
    g = _outside_kernel(f, fit.parameters.outside_hz, fit.parameters.outside_zeta)
    parts = []
    for run, (_, information) in zip(runs, fit.local_estimates, strict=True):
        m = run.response_rows.size
        # of all responses together, or of each apart where nothing joins them
        blocks = _inverses(information if information.ndim == 3 else information[None])
        b = blocks.shape[1] * blocks.shape[0] // m
        for j in range(m):
            block, first = (blocks[j], 0) if information.ndim == 3 else (blocks[0], j * b)
            for k in range(run.forces.shape[0]):
                at = first + k * q + np.arange(q)
                parts.append(np.einsum("ql,ql->l", g, block[np.ix_(at, at)] @ g))
    return np.maximum(np.mean(parts, axis=0), 0)


def _inverses(information: Real) -> Real:
    """Inverses of several matrices, each scaled to a diagonal of 1."""
    d = np.sqrt(np.maximum(np.einsum("kii->ki", information), 1e-300))
    outer = d[:, :, None] * d[:, None, :]
    return np.asarray(np.linalg.inv(information / outer + 1e-10 * np.eye(d.shape[1])) / outer)


def _most_telling(target: Real, known: NDArray[np.bool_], count: int) -> list[int]:
    size = np.sum(np.where(known[:, :, None], target, 0) ** 2, axis=(0, 2))
    return [int(i) for i in np.argsort(size)[::-1][:count]]


def _nonlinear(
    target: Real, known: NDArray[np.bool_], refs: NDArray[np.int_], grid: _Grid, weight: Real, std: Real, iterations: int = 150
) -> tuple[Real, Real, Real]:
    """Levenberg–Marquardt for ψ with Σ_p ψ_jp ψ_kp G_p = target_kj and ψ_p ~ N(0, std_p²). Returns ψ (m, p), shifts, covariance of ψ."""
    m, n_p = target.shape[1], std.size
    rng = np.random.default_rng(0)
    psi, shift = 0.3 * std * rng.standard_normal((m, n_p)), np.zeros(grid.upper)
    tw = target * weight
    use = known[:, :, None]

    def rest(p: Real, s: Real) -> Real:
        model = (p[refs][:, None] * p).reshape(-1, n_p) @ (grid.kernels(s) * weight)
        return np.concatenate([np.where(use, model.reshape(target.shape) - tw, 0).ravel(), (p / std).ravel(), s / SHIFT])

    def normal(p: Real, s: Real, r: Real, told: Real | None = None) -> tuple[Real, Real]:
        # Each residual (k, j) touches only rows j and k of ψ: build the normal matrix from p×p blocks; and all shifts.
        gw, dw = grid.kernels(s) * weight, grid.slopes(s) * weight
        gram = gw @ gw.T
        data = r[: known.size * gw.shape[1]].reshape(known.shape[0], m, -1)
        through = data @ gw.T  # (k, j, p)
        matrix = np.zeros((m, n_p, m, n_p))
        gradient = p / std**2
        worth = np.where(known, 1.0 if told is None else told, 0.0)
        mixed, own = gw @ dw.T, dw @ dw.T
        by_shape, by_shift = np.zeros((m, n_p, s.size)), np.diag(np.full(s.size, SHIFT**-2.0))
        slope = s / SHIFT**2
        for k, row in enumerate(refs):
            a = p[row]
            js = np.flatnonzero(known[k])
            told_k = worth[k, js, None, None]
            matrix[js, :, js, :] += told_k * gram * np.outer(a, a)
            matrix[row, :, row, :] += gram * ((told_k[:, 0] * p[js]).T @ p[js])
            cross = told_k * gram * (a[:, None] * p[js, None, :])
            matrix[js, :, row, :] += cross
            matrix[row, :, js, :] += cross.swapaxes(1, 2)
            gradient[js] += through[k, js] * a
            gradient[row] += np.sum(through[k, js] * p[js], axis=0)
            along = (a * p[js])[:, : s.size]  # (j, upper): the shift moves ψ_kp ψ_jp G'_p
            moved = told_k * mixed * along[:, None]  # (j, p, upper)
            by_shape[js] += moved * a[:, None]
            by_shape[row] += np.einsum("jpu,jp->pu", moved, p[js])
            by_shift += own * ((told_k[:, 0] * along).T @ along)
            slope += np.einsum("jl,ul,ju->u", data[k, js], dw, along)
        size = m * n_p
        flat = np.zeros((size + s.size,) * 2)
        flat[:size, :size] = matrix.reshape(size, size)
        flat[np.arange(size), np.arange(size)] += np.tile(1 / std**2, m)
        flat[:size, size:] = by_shape.reshape(size, -1)
        flat[size:, :size] = flat[:size, size:].T
        flat[size:, size:] = by_shift
        return flat, np.concatenate([gradient.ravel(), slope])

    r = rest(psi, shift)
    cost, damping = float(r @ r), 1e-2
    for _ in range(iterations):
        matrix, gradient = normal(psi, shift, r)
        d = np.diag(matrix)
        fall = 0.0
        for _ in range(10):
            step = np.linalg.solve(matrix + damping * np.diag(d), -gradient)
            by, moved = step[: psi.size].reshape(psi.shape), np.clip(step[psi.size :], -SHIFT, SHIFT)
            trial = rest(psi + by, shift + moved)
            fall = cost - float(trial @ trial)
            if fall > 0:
                break
            damping *= 6
        if fall <= 0:
            break
        psi, shift, r, cost = psi + by, shift + moved, trial, cost - fall
        damping = max(damping / 6, 1e-12)
        if fall < 1e-4 * cost:
            break
    told = _told(r[: known.size * grid.f.size].reshape(*known.shape, -1))
    # Given the frequencies, which the model holds as known: what shapes and frequencies leave open together is in no FRF of it.
    covariance = np.linalg.inv(normal(psi, shift, r, told)[0][: psi.size, : psi.size])
    return psi, shift, np.asarray(covariance.reshape(m, n_p, m, n_p), float)


def _told(left: Real) -> Real:
    """Share of its lines that each out-of-band FRF is worth, from what the fit leaves of it in units of what was asked (..., L).

    What a few modes leave is smooth over the band: all lines tell no more of it than ``INDEPENDENT`` would.
    """
    return np.asarray(INDEPENDENT / left.shape[-1] / np.maximum(np.mean(left**2, axis=-1), INDEPENDENT / left.shape[-1]))


def _linear_row(target: Real, known: NDArray[np.bool_], psi_refs: Real, g: Real, weight: Real, std: Real) -> tuple[Real, Real]:
    rows = np.flatnonzero(known)
    if not rows.size:
        return np.zeros(std.size), std**2
    design = np.concatenate([(psi_refs[k][:, None] * g * weight).T for k in rows])
    values = np.concatenate([target[k] * weight for k in rows])
    shapes = np.linalg.solve(design.T @ design + np.diag(1 / std**2), design.T @ values)
    worth = np.repeat(_told((values - design @ shapes).reshape(rows.size, -1)), weight.size)
    return shapes, np.diag(np.linalg.inv(design.T @ (worth[:, None] * design) + np.diag(1 / std**2)))


def _with_local(made: OutsideModes, refs: list[int], top: float, f: Real) -> OutsideModes:
    """Add one local mode a DOF that was not driven: the compliance of its own that no driven column shows.

    It is positive and differs by tens from place to place; the drive points' own compliance from above the band is all that tells its size.
    """
    hz, shapes, covariance = made.hz, made.shapes, made.covariance
    m_dofs = shapes.shape[0]
    rows = np.setdiff1d(np.arange(m_dofs), refs)
    local_hz = LOCAL * top
    unit = _outside_kernel(f, np.array([local_hz]))[0]
    above = np.arange(len(UPPER))
    at_refs = np.median(shapes[refs][:, above] ** 2 @ _outside_kernel(f, hz[above]) / unit, axis=1)
    amplitude = float(np.sqrt(np.median(at_refs))) if refs else 0.0
    extra = np.zeros((m_dofs, rows.size))
    extra[rows, np.arange(rows.size)] = LOCAL_SHAPE * amplitude
    size, added = covariance.shape[0], rows.size * m_dofs
    grown = np.zeros((size + added, size + added))
    grown[:size, :size] = covariance
    position = size + np.arange(rows.size) * m_dofs + rows
    grown[position, position] = (LOCAL_SPREAD * amplitude) ** 2
    all_hz, all_zeta = (np.append(v, np.full(rows.size, more)) for v, more in ((hz, local_hz), (made.zeta, OUTSIDE_DAMPING)))
    return OutsideModes(all_hz, all_zeta, np.concatenate([shapes, extra], axis=1), grown)


def _empty(m_dofs: int) -> OutsideModes:
    return OutsideModes(np.zeros(0), np.zeros(0), np.zeros((m_dofs, 0)), np.zeros((0, 0)))

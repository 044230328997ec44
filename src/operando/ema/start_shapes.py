"""Real mode shapes of unit modal mass from an FRF matrix and given poles: residues of rank one, scaled over all drive points together.

H_ij = Σ_r φ_ir φ_jr K_r with the real-mode kernel K (Shen & Lu 2024, Eq 4). The lines are condensed once into a small Gram matrix for each
pair; on it the quadratic fit of the products φ_i φ_j is a Gauss–Newton iteration that costs nothing per line. Modes outside the band are
pseudo-modes with a Gaussian prior on their shapes, so that columns of DOFs that were never driven stay predictable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg
from threadpoolctl import threadpool_limits

from operando.data import Finding
from operando.dof import Dof, match_dofs, parse_dofs
from operando.errors import DataError, IdentificationError
from operando.synthesis import modal_kernel

__all__ = ["StartShapes", "default_pseudo_hz", "real_shapes_start"]

Real = NDArray[np.float64]

PSEUDO_FACTORS = (1.07, 1.25, 1.6, 2.5, 5.0)
"""Frequencies of the upper pseudo-modes in units of the highest line."""


@dataclass(frozen=True)
class StartShapes:
    """Real modes of an FRF matrix.

    Parameters
    ----------
    dofs : tuple of Dof
        The responses as labelled, then references that are no responses.
    shapes : (m, n) array
        Unit modal mass [kg^(−1/2)] where ``scaled``; pseudo-modes last.
    mode_hz, zeta : (n,) arrays
    residual : (n,) bool array
        Which modes are pseudo-modes.
    scaled : bool
        False where no reference is among the responses: each shape then has an arbitrary scale (equal rms at responses and references).
    scale_std : (n,) array
        Relative standard deviation of the scale of each shape, from the noise and misfit of the FRFs.
    wrong_sign : tuple of int
        Modes whose drive-point residue has the wrong sign (negative modal mass); the scale is that of its magnitude.
    inverted_references : tuple of int
        References whose drive point has the wrong sign in most modes (force or response channel inverted). Their column was taken
        with the opposite sign.
    unseen : tuple of int
        In-band modes that no drive point sees well enough to scale them (relative standard deviation of the scale above 20 %).
    misfit : float
        Mean |H_model − H|²/variance; without a variance the unexplained part of the (weighted) squared norm.
    references : tuple of Dof
        What ``inverted_references`` counts: the references, or with more references than responses (roving hammer, solved transposed
        by reciprocity) the responses.
    """

    dofs: tuple[Dof, ...]
    shapes: Real
    mode_hz: Real
    zeta: Real
    residual: NDArray[np.bool_]
    scaled: bool
    scale_std: Real
    wrong_sign: tuple[int, ...]
    inverted_references: tuple[int, ...]
    unseen: tuple[int, ...]
    misfit: float
    references: tuple[Dof, ...] = ()

    def findings(self) -> tuple[Finding, ...]:
        """What the drive points say, as findings (``drive_point_sign``, ``missing_drive_point``)."""
        out = []
        if not self.scaled:
            out.append(
                Finding(
                    "missing_drive_point",
                    "no reference is among the responses: the shapes have no mass scaling",
                    consequence="frequencies, damping and shapes hold; FRFs of other pairs and operational FRFs cannot be predicted",
                    action="measure the response at one excitation DOF",
                )
            )
        for j in self.inverted_references:
            out.append(
                Finding(
                    "drive_point_sign",
                    f"the drive point at {self.references[j]} has negative residues in most modes: its force or its response is inverted",
                    dof=str(self.references[j]),
                    consequence="this column was taken with the opposite sign",
                    action="check the sense of the force and of the sensor there",
                )
            )
        for r in self.wrong_sign:
            hz = float(self.mode_hz[r])
            out.append(
                Finding(
                    "drive_point_sign",
                    f"the mode at {hz:.4g} Hz has a drive-point residue of the wrong sign (negative modal mass)",
                    band_hz=(hz * (1 - 2 * float(self.zeta[r])), hz * (1 + 2 * float(self.zeta[r]))),
                    consequence="its shape is scaled by the magnitude of the residue, which is not to be trusted",
                    action="check whether it is a mode; excite where it moves",
                )
            )
        for r in self.unseen:
            hz = float(self.mode_hz[r])
            message = f"no drive point sees the mode at {hz:.4g} Hz: its scale is uncertain by {100 * min(self.scale_std[r], 9.99):.0f} %"
            out.append(Finding("missing_drive_point", message, action="add a reference where this mode moves"))
        return tuple(out)


def default_pseudo_hz(low_hz: float, high_hz: float) -> tuple[float, ...]:
    """Frequencies of the pseudo-modes of a band: five above, and one far below (a mass line in the band) where it does not start at 0."""
    return (*(factor * high_hz for factor in PSEUDO_FACTORS), *((0.02 * low_hz,) if low_hz > 0 else ()))


def real_shapes_start(
    frequencies_hz: ArrayLike,
    H: ArrayLike,
    responses: Sequence[Dof | str],
    references: Sequence[Dof | str],
    mode_hz: ArrayLike,
    zeta: ArrayLike,
    *,
    variance: ArrayLike | None = None,
    pseudo_hz: Sequence[float] | None = None,
    pseudo_zeta: float = 0.01,
    prior: float = 0.7,
    quantity: str = "accelerance",
    iterations: int = 30,
) -> StartShapes:
    """Real shapes of unit modal mass for given poles.

    Parameters
    ----------
    frequencies_hz : (n_lines,) array
    H : (n_resp, n_ref, n_lines) complex array
        Not finite lines (pairs that were not measured) get no weight. More references than responses are fine.
    responses, references : sequences of Dof or label
        A reference is a drive point where a response has its node and axis, in either sense.
    mode_hz, zeta : (n,) arrays
        Modes to fit.
    variance : (n_resp, n_ref, n_lines) array, optional
        E|ΔH|². Default: the same for all lines of a pair, from the fit itself.
    pseudo_hz : sequence of float, optional
        Pseudo-modes; default ``default_pseudo_hz`` of the lines, () for none.
    pseudo_zeta : float
    prior : float
        Standard deviation of the pseudo-mode shapes in units of the median rms of the in-band shapes.
    quantity : {"accelerance", "mobility", "receptance"}
    iterations : int

    Returns
    -------
    StartShapes

    Raises
    ------
    DataError
        If shapes disagree.
    IdentificationError
        If there are no modes or no finite lines.
    """
    f = np.asarray(frequencies_hz, float)
    data: NDArray[np.complex128] = np.asarray(H, complex)
    resp, refs = parse_dofs(responses), parse_dofs(references)
    hz, damping = np.atleast_1d(np.asarray(mode_hz, float)), np.atleast_1d(np.asarray(zeta, float))
    if data.shape != (len(resp), len(refs), f.size):
        raise DataError(f"FRFs of shape {data.shape} do not fit {len(resp)} responses, {len(refs)} references, {f.size} lines")
    if hz.size == 0 or hz.shape != damping.shape:
        raise IdentificationError(f"{hz.size} frequencies and {damping.size} damping ratios: no modes to fit")
    if len(refs) > len(resp):
        # roving hammer: the symmetric model is the same for the transposed matrix, and the small side drives the cost
        turned = None if variance is None else np.broadcast_to(np.asarray(variance, float), data.shape).transpose(1, 0, 2)
        options = {"pseudo_hz": pseudo_hz, "pseudo_zeta": pseudo_zeta, "prior": prior, "quantity": quantity, "iterations": iterations}
        out = real_shapes_start(f, data.transpose(1, 0, 2), refs, resp, hz, damping, variance=turned, **options)  # type: ignore[arg-type]
        return _relabelled(out, resp, refs)
    extra = np.asarray(default_pseudo_hz(float(f[0]), float(f[-1])) if pseudo_hz is None else pseudo_hz, float)
    n_free = hz.size
    all_hz = np.concatenate([hz, extra])
    all_zeta = np.concatenate([damping, np.full(extra.size, pseudo_zeta)])
    dofs, rows, signs = _rows(resp, refs)
    with threadpool_limits(1, "blas"):
        pairs = _condense(f, data, variance, modal_kernel(f, all_hz, all_zeta, quantity), rows, signs)
        inverse = np.linalg.inv(pairs.gram + 1e-9 * _diagonal(pairs.gram))
        free: Real = (inverse @ pairs.right[:, :, None])[:, :, 0]
        std: Real = np.sqrt(np.maximum(np.diagonal(inverse, axis1=1, axis2=2), 0))
        drive = np.flatnonzero(pairs.i == pairs.j)
        inverted = _inverted(pairs, free, std, drive, n_free, len(refs))
        flip = np.where(np.isin(pairs.reference, inverted), -1.0, 1.0)
        pairs = replace(pairs, sign=pairs.sign * flip)
        shapes, wrong = _initial(pairs, free, std, drive, len(dofs), n_free)
        shapes, scale_std = _fit(pairs, shapes, n_free, prior, iterations)
    scaled = drive.size > 0
    if not scaled:
        shapes = _balanced(shapes, pairs)
    unseen = [r for r in range(n_free) if scaled and (scale_std[r] > 0.2 or not np.isfinite(scale_std[r]))]
    residual = np.arange(all_hz.size) >= n_free
    marks = (tuple(wrong), tuple(inverted), tuple(unseen))
    return StartShapes(dofs, shapes, all_hz, all_zeta, residual, scaled, scale_std, *marks, pairs.misfit(shapes), refs)


@dataclass(frozen=True)
class _Pairs:
    """Condensed data: one row a measured pair. Cost of a pair: ρᵀGρ − 2gᵀρ + c with ρ = sign·φ_i∘φ_j; 2|e|²/variance summed."""

    i: NDArray[np.int_]
    j: NDArray[np.int_]
    reference: NDArray[np.int_]
    sign: Real
    gram: Real
    right: Real
    constant: Real
    lines: Real
    inflation: float
    known: bool

    def products(self, shapes: Real) -> Real:
        return np.asarray(self.sign[:, None] * shapes[self.i] * shapes[self.j])

    def costs(self, shapes: Real) -> Real:
        rho = self.products(shapes)
        return np.asarray(np.einsum("pa,pab,pb->p", rho, self.gram, rho) - 2 * np.sum(rho * self.right, axis=1) + self.constant)

    def misfit(self, shapes: Real) -> float:
        costs = self.costs(shapes)
        total = max(float(costs.sum()), 0.0)
        return total / float(2 * self.lines.sum()) * self.inflation if self.known else total / float(self.constant.sum())


def _relabelled(turned: StartShapes, responses: tuple[Dof, ...], references: tuple[Dof, ...]) -> StartShapes:
    """The result of the transposed problem with its rows in the order and sense of the responses, then of other references."""
    dofs = (*responses, *(r for r in references if not any(r.same_axis(d) for d in responses)))
    rows, signs = match_dofs(dofs, turned.dofs)
    return replace(turned, dofs=dofs, shapes=turned.shapes[rows] * np.asarray(signs, float)[:, None])


def _rows(responses: tuple[Dof, ...], references: tuple[Dof, ...]) -> tuple[tuple[Dof, ...], list[int], list[int]]:
    """DOFs of the model; row and sign of each reference among them."""
    dofs = list(responses)
    rows, signs = [], []
    for ref in references:
        at = next((k for k, d in enumerate(dofs) if d.same_axis(ref)), None)
        if at is None:
            dofs.append(ref)
            at = len(dofs) - 1
        rows.append(at)
        signs.append(1 if dofs[at].sign == ref.sign else -1)
    return tuple(dofs), rows, signs


def _diagonal(gram: Real) -> Real:
    return np.asarray(np.eye(gram.shape[-1]) * np.diagonal(gram, axis1=-2, axis2=-1)[..., None, :])


def _condense(
    f: Real,
    data: NDArray[np.complex128],
    variance: ArrayLike | None,
    kernel: NDArray[np.complex128],
    rows: list[int],
    signs: list[int],
) -> _Pairs:
    """Gram matrices of the kernels under the weights of each pair; the variance is raised where the poles do not explain the lines."""
    stacked = np.concatenate([kernel.real, kernel.imag], axis=1)
    i, j, reference, sign, gram, right, constant, lines = [], [], [], [], [], [], [], []
    shared = stacked @ stacked.T if variance is None else None
    var = None if variance is None else np.broadcast_to(np.asarray(variance, float), data.shape)
    if var is not None:
        # exact lines would outweigh all others without bound
        var = np.maximum(var, 1e-12 * np.nanmean(np.abs(data) ** 2))
    for o in range(data.shape[0]):
        for k, row in enumerate(rows):
            h = data[o, k]
            good = np.isfinite(h) if var is None else np.isfinite(h) & np.isfinite(var[o, k])
            if np.count_nonzero(good) < 4:
                continue
            target = np.concatenate([np.where(good, h.real, 0), np.where(good, h.imag, 0)])
            if var is None and good.all():
                weight = np.ones(2 * f.size)
                g = np.array(shared)
            else:
                w2 = good.astype(float) if var is None else np.divide(2, var[o, k], out=np.zeros(f.size), where=good)
                weight = np.concatenate([w2, w2])
                g = (stacked * weight) @ stacked.T
            i.append(o)
            j.append(row)
            reference.append(k)
            sign.append(signs[k])
            gram.append(g)
            right.append(stacked @ (weight * target))
            constant.append(float(weight @ target**2))
            lines.append(float(np.count_nonzero(good)))
    if not gram:
        raise IdentificationError("no pair has finite lines")
    G, g_, c, n = np.array(gram), np.array(right), np.array(constant), np.array(lines)
    best = np.linalg.solve(G + 1e-9 * _diagonal(G), g_[:, :, None])[:, :, 0]
    left = np.maximum(c - np.sum(best * (2 * g_ - np.einsum("pab,pb->pa", G, best)), axis=1), 1e-12 * c + 1e-300)
    # without a variance each pair gets its own; a known one is raised by one factor, so that the prior keeps its meaning
    scale = 2 * n / left if variance is None else np.full(n.size, 1 / max(1.0, float(left.sum() / (2 * n.sum()))))
    inflation = 1.0 if variance is None else 1 / float(scale[0])
    scaled = (G * scale[:, None, None], g_ * scale[:, None], c * scale)
    return _Pairs(np.array(i), np.array(j), np.array(reference), np.array(sign, float), *scaled, n, inflation, variance is not None)


def _inverted(pairs: _Pairs, free: Real, std: Real, drive: NDArray[np.int_], n_free: int, n_ref: int) -> list[int]:
    """References whose drive point is negative in most of the modes it sees."""
    out = []
    for k in range(n_ref):
        for p in drive[pairs.reference[drive] == k]:
            z = pairs.sign[p] * free[p, :n_free] / np.maximum(std[p, :n_free], 1e-300)
            clear = np.abs(z) > 5
            if clear.any() and np.mean(z[clear] < 0) > 0.6:
                out.append(k)
    return out


def _initial(pairs: _Pairs, free: Real, std: Real, drive: NDArray[np.int_], m: int, n_free: int) -> tuple[Real, list[int]]:
    """Shapes from the singular vectors of each mode's residue matrix, scaled over the drive points; modes of the wrong sign."""
    n = free.shape[1]
    shapes = np.zeros((m, n))
    wrong: list[int] = []
    ref_rows = np.unique(pairs.j)
    column = np.searchsorted(ref_rows, pairs.j)
    for r in range(n):
        matrix = np.zeros((m, ref_rows.size))
        matrix[pairs.i, column] = pairs.sign * free[:, r]
        u, s, vt = np.linalg.svd(matrix, full_matrices=False)
        left, right = u[:, 0] * np.sqrt(s[0]), vt[0] * np.sqrt(s[0])
        # left = a·φ, right = φ/a at the references: the drive points give a² = Σ left²/Σ left·right
        at = pairs.i[drive]
        both = float(np.sum(left[at] * right[column[drive]]))
        own = float(np.sum(left[at] ** 2))
        total = float(np.sum(pairs.sign[drive] * free[drive, r]))
        noise = float(np.sqrt(np.sum(std[drive, r] ** 2)))
        if drive.size and both < 0 and total < -3 * noise and r < n_free:
            wrong.append(r)
        ratio = own / abs(both) if drive.size and abs(both) > 1e-6 * max(own, 1e-300) else np.sqrt(m / ref_rows.size)
        scale = np.sqrt(min(max(ratio, 1e-6), 1e6))
        shapes[:, r] = left / scale
        only = np.setdiff1d(ref_rows, pairs.i)
        shapes[only, r] = right[np.searchsorted(ref_rows, only)] * scale
    return shapes, wrong


def _fit(pairs: _Pairs, shapes: Real, n_free: int, prior: float, iterations: int) -> tuple[Real, Real]:
    """Gauss–Newton with Levenberg damping; DOFs that are responses only are eliminated (Schur complement)."""
    n = shapes.shape[1]
    system = None
    for stage in range(2):
        rms = np.sqrt(np.mean(shapes[:, :n_free] ** 2, axis=0))
        sigma = prior * float(np.median(rms))
        inverse = np.where(np.arange(n) >= n_free, 1 / max(sigma, 1e-300) ** 2, 0.0)
        if stage == 0:
            limit = np.maximum(np.sqrt(np.mean(shapes**2, axis=0)) / max(sigma, 1e-300), 1.0)
            shapes = shapes / np.where(np.arange(n) >= n_free, limit, 1.0)
        cost = float(pairs.costs(shapes).sum() + np.sum(inverse * shapes**2))
        damping = 1e-4
        for _ in range(max(iterations // 2, 1)):
            system = _System.build(pairs, shapes, inverse)
            for _ in range(8):
                trial = shapes + system.step(damping)
                new = float(pairs.costs(trial).sum() + np.sum(inverse * trial**2))
                if new < cost:
                    break
                damping *= 10
            else:
                break
            gain, shapes, cost, damping = cost - new, trial, new, max(damping / 10, 1e-12)
            if gain < 1e-6 * abs(cost):
                break
    system = _System.build(pairs, shapes, inverse)
    return shapes, system.scale_std(shapes)


@dataclass(frozen=True)
class _System:
    """Normal equations of one Gauss–Newton step: reference DOFs (dense) and response-only DOFs (block diagonal)."""

    refs: NDArray[np.int_]
    others: NDArray[np.int_]
    block: Real  # (n_others, n, n)
    coupling: Real  # (n_others, n, n_refs·n)
    dense: Real  # (n_refs·n, n_refs·n)
    gradient: Real  # (m, n)

    @classmethod
    def build(cls, pairs: _Pairs, shapes: Real, inverse: Real) -> _System:
        m, n = shapes.shape
        refs = np.unique(pairs.j)
        others = np.setdiff1d(np.arange(m), refs)
        place = np.full(m, -1)
        place[refs], place[others] = np.arange(refs.size), np.arange(others.size)
        q = np.einsum("pab,pb->pa", pairs.gram, pairs.products(shapes)) - pairs.right
        gradient = inverse * shapes
        block = np.tile(np.diag(inverse), (others.size, 1, 1))
        coupling = np.zeros((others.size, n, refs.size, n))
        dense = np.zeros((refs.size, n, refs.size, n))
        for k in range(refs.size):
            dense[k, :, k, :] += np.diag(inverse)
        is_ref = np.isin(np.arange(m), refs)
        for p in range(pairs.i.size):
            i, j = pairs.i[p], pairs.j[p]
            a, b = pairs.sign[p] * shapes[j], pairs.sign[p] * shapes[i]
            gradient[i] += a * q[p]
            gradient[j] += b * q[p]
            g = pairs.gram[p]
            ii = a[:, None] * g * a
            ij = a[:, None] * g * b
            kj = place[j]
            dense[kj, :, kj, :] += b[:, None] * g * b
            if is_ref[i]:
                ki = place[i]
                dense[ki, :, ki, :] += ii
                dense[ki, :, kj, :] += ij
                dense[kj, :, ki, :] += ij.T
            else:
                block[place[i]] += ii
                coupling[place[i], :, kj, :] += ij
        size = refs.size * n
        return cls(refs, others, block, coupling.reshape(others.size, n, size), dense.reshape(size, size), gradient)

    def _damped(self, damping: float) -> tuple[Real, Real]:
        """Blocks with damping and a floor for what the data do not see."""
        floor = 1e-12 * max(float(np.max(np.abs(np.diag(self.dense)), initial=0)), float(np.max(np.abs(self.block), initial=0)), 1e-300)
        block = self.block + damping * _diagonal(self.block) + floor * np.eye(self.block.shape[-1])
        dense = self.dense + damping * np.diag(np.diag(self.dense)) + floor * np.eye(len(self.dense))
        return block, dense

    def _schur(self, block: Real, dense: Real) -> Real:
        solved = np.linalg.solve(block, self.coupling)
        return np.asarray(dense - np.tensordot(self.coupling, solved, axes=((0, 1), (0, 1))))

    def step(self, damping: float) -> Real:
        block, dense = self._damped(damping)
        inner = np.linalg.solve(block, self.gradient[self.others][:, :, None])[:, :, 0]
        right = self.gradient[self.refs].ravel() - np.tensordot(inner, self.coupling, axes=((0, 1), (0, 1)))
        out = np.zeros_like(self.gradient)
        schur = self._schur(block, dense)
        try:
            at_refs = -linalg.solve(schur, right, assume_a="pos", check_finite=False)
        except linalg.LinAlgError:
            at_refs = -np.asarray(linalg.lstsq(schur, right, check_finite=False)[0])
        out[self.refs] = at_refs.reshape(self.refs.size, -1)
        rest = self.gradient[self.others] + np.tensordot(self.coupling, at_refs, axes=(2, 0))
        out[self.others] = -np.linalg.solve(block, rest[:, :, None])[:, :, 0]
        return out

    def scale_std(self, shapes: Real) -> Real:
        """Relative standard deviation of |φ| at the reference DOFs, mode by mode."""
        block, dense = self._damped(0.0)
        n = shapes.shape[1]
        values, vectors = np.linalg.eigh(self._schur(block, dense))
        inverse = (vectors / np.maximum(values, 1e-14 * values[-1])) @ vectors.T
        out = np.full(n, np.inf)
        covariance = inverse.reshape(self.refs.size, n, self.refs.size, n)
        for r in range(n):
            phi = shapes[self.refs, r]
            length = float(np.linalg.norm(phi))
            if length > 0:
                out[r] = np.sqrt(max(float(phi @ covariance[:, r, :, r] @ phi), 0.0)) / length**2
        return out


def _balanced(shapes: Real, pairs: _Pairs) -> Real:
    """Shapes without drive points: equal rms at responses and references."""
    left, right = np.unique(pairs.i), np.unique(pairs.j)
    out = shapes.copy()
    a = np.sqrt(np.mean(shapes[left] ** 2, axis=0))
    b = np.sqrt(np.mean(shapes[right] ** 2, axis=0))
    ratio = np.sqrt(np.divide(b, a, out=np.ones_like(a), where=(a > 0) & (b > 0)))
    out[left] *= ratio
    out[right] /= ratio
    return out

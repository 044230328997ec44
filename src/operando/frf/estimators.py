"""H1, H2 and Hv from averaged spectra, with coherence and the variance of each line."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.errors import DataError
from operando.frf.spectra import CrossSpectra
from operando.synthesis import power_of

ESTIMATORS = ("h1", "h2", "hv")

Array = NDArray[Any]


def inverse_force_matrix(force: Array) -> tuple[Array, Array]:
    """Inverse of Gff (n_forces, n_forces, n_lines), NaN where a force is absent; its condition number once scaled to unit auto spectra."""
    g = np.moveaxis(force, -1, 0)
    auto = np.sqrt(np.maximum(np.real(np.einsum("lii->li", g)), 0))
    safe = np.where(auto > 0, auto, np.nan)
    scaled = g / safe[:, :, None] / safe[:, None, :]
    ok: Array = np.asarray(np.isfinite(scaled).all(axis=(1, 2)))
    eye = np.eye(g.shape[1])
    scaled = np.where(ok[:, None, None], scaled, eye)
    values, vectors = np.linalg.eigh(scaled)
    floor = 1e-12 * values[:, -1:]
    condition = values[:, -1] / np.maximum(values[:, 0], floor[:, 0])
    inverse = (vectors / np.maximum(values, floor)[:, None, :]) @ np.conj(np.swapaxes(vectors, 1, 2))
    inverse = inverse / safe[:, :, None] / safe[:, None, :]
    inverse[~ok] = np.nan
    condition[~ok] = np.inf
    return np.moveaxis(inverse, 0, -1), condition


def estimate(spectra: CrossSpectra, estimator: str = "h1") -> tuple[Array, Array, Array, Array, Array]:
    """FRF matrix from averaged spectra.

    H1 = Gxf·Gff⁻¹ (noise on the responses), H2 = Gxx/Gfx (noise on the force; one force at a time), Hv by total
    least squares on signals scaled to equal auto spectra (Rocklin, Crowley & Vold 1985), which for one force is
    the geometric mean of H1 and H2.

    Returns
    -------
    h, variance : (n_responses, n_forces, n_lines) arrays
        H1: E|ΔH|² = Gxx(1−γ²)[Gff⁻¹]_jj/(n_eff − n_forces): the specification's |H|²(1−γ²)/(γ²·n_eff) for one force, with the noise
        estimated without bias (the sample coherence takes n_forces of the averages). H2: |H2|²(1−γ²)/γ² over the same number. Hv: to first
        order in the fluctuation of all averaged spectra, |Hv|²(1−γ²)(1+1/γ²)/2 for one force. NaN where n_eff ≤ n_forces.
    coherence : (n_responses, n_lines) array
        Multiple coherence of each response with all forces (ordinary for one force).
    condition : (n_lines,) array
        Condition number of the scaled force matrix.
    inverse : (n_forces, n_lines) array
        Diagonal of Gff⁻¹, NaN where a force is absent.
    """
    if estimator not in ESTIMATORS:
        raise DataError(f"estimator {estimator!r} is none of {', '.join(ESTIMATORS)}, lrm")
    n_f = spectra.force.shape[0]
    inverse, condition = inverse_force_matrix(spectra.force)
    cross = np.ascontiguousarray(spectra.cross)
    h1 = np.einsum("ijl,jkl->ikl", cross, np.ascontiguousarray(inverse), out=np.empty_like(cross))
    parts = np.einsum("ijl,ijl->il", h1.view(float), cross.view(float))  # products of real, of imaginary parts in turn
    explained = parts[:, ::2] + parts[:, 1::2]
    power = spectra.response
    coherence = np.clip(np.divide(explained, power, out=np.zeros_like(power), where=power > 0), 0, 1)
    relative = None
    if estimator == "h1":
        h = h1
    elif estimator == "h2":
        if n_f > 1:
            raise DataError("H2 needs one force at a time", hint="use estimator h1 or hv for several forces at once")
        conj = spectra.cross[:, 0].conj()
        with np.errstate(divide="ignore", invalid="ignore"):
            h = (power / conj)[:, None, :]
    else:
        h, relative = _total_least_squares(spectra)
    diagonal = np.real(np.einsum("jjl->jl", inverse))
    dof = spectra.averages - n_f
    if dof > 0:
        noise = power * (1 - coherence)
        variance = noise[:, None, :] * diagonal[None] / dof
        if estimator == "h2":
            with np.errstate(divide="ignore", invalid="ignore"):
                variance *= power_of(h) / power_of(h1)
        elif relative is not None:
            variance = relative * power_of(h) / dof
    else:
        variance = np.full(h.shape, np.nan)
    return h, variance, coherence, condition, diagonal


def _total_least_squares(spectra: CrossSpectra) -> tuple[Array, Array]:
    """Hv, and E|ΔH|²/|H|² times the averages: null vector of the scaled matrix of forces and one response, for all responses and lines."""
    n_x, n_f, n_l = spectra.cross.shape
    out, relative = np.empty((n_x, n_f, n_l), complex), np.empty((n_x, n_f, n_l))
    auto = np.sqrt(np.maximum(np.real(np.einsum("jjl->jl", spectra.force)), 0)).T
    g = np.empty((n_l, n_f + 1, n_f + 1), complex)
    for i in range(n_x):
        size = np.sqrt(np.maximum(spectra.response[i], 0))
        scale = np.column_stack([auto, size])
        scale = np.where(scale > 0, scale, np.nan)
        g[:, :n_f, :n_f] = np.moveaxis(spectra.force, -1, 0)
        g[:, n_f, :n_f] = spectra.cross[i].T
        g[:, :n_f, n_f] = spectra.cross[i].T.conj()
        g[:, n_f, n_f] = spectra.response[i]
        scaled = g / scale[:, :, None] / scale[:, None, :]
        bad = ~np.isfinite(scaled).all(axis=(1, 2))
        scaled[bad] = np.eye(n_f + 1)
        # Rows obey Σ_j H_j F_j − X = 0: the row vector v with v G = 0 is the conjugate of the eigenvector of the least value.
        values, vectors = np.linalg.eigh(scaled)
        vector = vectors[:, :, 0].conj()
        with np.errstate(divide="ignore", invalid="ignore"):
            h = -vector[:, :n_f] / vector[:, n_f:] * scale[:, n_f:] / scale[:, :n_f]
            relative[i] = _relative_variance(scaled, values, vectors).T
        h[bad] = relative[i].T[bad] = np.nan
        out[i] = h.T
    return out, relative


def _relative_variance(r: Array, values: Array, vectors: Array) -> Array:
    """E|ΔH_j|²/|H_j|² of the null vectors w of scaled matrices (l, n, n) made of one average, (l, n − 1), the response last.

    Of L = tr(Aᵀ δG) with E δG_ab δG*_cd = G_ac G*_bd (complex Wishart; Goodman, Ann. Math. Stat. 34, 1963, 152–177) the variance is
    tr(Aᵀ G A* G). A holds what moves w (perturbation of first order), and what moves the scales.
    """
    w, n = vectors[:, :, 0], r.shape[-1]
    gaps = values[:, :1] - values[:, 1:]
    out = np.empty((r.shape[0], n - 1))
    for j in range(n - 1):
        c = (vectors[:, j, 1:] / w[:, j, None] - vectors[:, -1, 1:] / w[:, -1, None]) / gaps
        a = np.einsum("lk,lak,lb->lab", c, vectors[:, :, 1:].conj(), w)
        moved = r * a
        scales = -0.5 * (moved.sum(axis=2) + moved.sum(axis=1))
        scales[:, j] -= 0.5
        scales[:, -1] += 0.5
        a[:, np.arange(n), np.arange(n)] += scales
        out[:, j] = np.einsum("lab,lba->l", np.swapaxes(a, 1, 2) @ r, a.conj() @ r).real
    return out

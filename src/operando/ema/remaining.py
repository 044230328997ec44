"""Many sensors: the nonlinear fit on a telling part of them, the other shape rows by linear least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, qr

from operando.dof import Dof
from operando.ema.outside import OutsideModes
from operando.ema.polish import Polished
from operando.ema.polish_model import run_model
from operando.ema.spectra import RunSpectra

MAX_UNKNOWNS = 1500
MAX_CORE = 30


def choose_core(runs: Sequence[RunSpectra], dofs: Sequence[Dof], n_modes: int) -> NDArray[np.int_] | None:
    """Rows for the nonlinear fit, or None where all fit in: the references, and the responses that differ most (pivoted QR)."""
    if len(dofs) * n_modes <= MAX_UNKNOWNS:
        return None
    refs = sorted({int(row) for run in runs for row in run.force_rows})
    if len(refs) * n_modes > MAX_UNKNOWNS // 2:
        return None
    size = max(len(refs) + 2, min(MAX_CORE, MAX_UNKNOWNS // max(n_modes, 1)))
    first = max(runs, key=lambda run: run.response_rows.size)
    x = first.responses / np.sqrt(np.mean(np.abs(first.responses) ** 2, axis=0))[None, :]
    pivots = qr(np.concatenate([x.real, x.imag], axis=1).T[:: max(1, x.shape[1] // 4000)], mode="r", pivoting=True)[1]
    others = [int(first.response_rows[i]) for i in pivots if int(first.response_rows[i]) not in refs]
    return np.array(sorted(refs + others[: size - len(refs)]))


def remaining_rows(
    runs: Sequence[RunSpectra], core: NDArray[np.int_], n_dofs: int, fit: Polished, outside: OutsideModes
) -> tuple[Polished, OutsideModes]:
    """Shape rows of the DOFs that the nonlinear fit left out, given poles, references and transients' poles."""
    theta = fit.parameters
    n = theta.hz.size
    shapes = np.zeros((n_dofs, n))
    shapes[core] = theta.shapes
    wide = replace(theta, shapes=shapes)
    rest = np.setdiff1d(np.arange(n_dofs), core)
    variance = np.zeros((n_dofs, n))
    normal = {int(row): np.zeros((n, n)) for row in rest}
    right = {int(row): np.zeros(n) for row in rest}
    for i, run in enumerate(runs):
        model = run_model(run, wide, i, run.forces)
        stack = np.concatenate([model.modal, model.local, *wide.functions(run).decays[:2]])
        force_share = np.sum(run.force_variance, axis=0) / np.maximum(np.sum(np.abs(run.forces) ** 2, axis=0), 1e-300)
        for j, row in enumerate(run.response_rows):
            if int(row) not in normal:
                continue
            weight = 1 / np.sqrt(run.response_variance[j] + np.abs(run.responses[j]) ** 2 * force_share)
            design = np.concatenate([(stack * weight).real, (stack * weight).imag], axis=1)
            target = np.concatenate([(run.responses[j] * weight).real, (run.responses[j] * weight).imag])
            gram, product = design @ design.T, design @ target
            d = np.sqrt(np.diag(gram)[n:])
            inner = gram[n:, n:] / np.outer(d, d)
            inner[np.diag_indices_from(inner)] += 1e-8
            solved = cho_solve(cho_factor(inner), np.column_stack([gram[n:, :n], product[n:]]) / d[:, None])
            normal[int(row)] += gram[:n, :n] - (gram[n:, :n] / d[:, None]).T @ solved[:, :-1]
            right[int(row)] += product[:n] - (gram[n:, :n] / d[:, None]).T @ solved[:, -1]
    for row in rest:
        scale = np.sqrt(np.maximum(np.diag(normal[int(row)]), 1e-300))
        inverse = np.linalg.inv(normal[int(row)] / np.outer(scale, scale) + 1e-9 * np.eye(n)) / np.outer(scale, scale)
        shapes[row] = inverse @ right[int(row)]
        variance[row] = 0.5 * np.diag(inverse)
    covariance = np.zeros((n * (2 + n_dofs), n * (2 + n_dofs)))
    small = np.concatenate([np.arange(2 * n), (2 * n + np.arange(n)[:, None] * n_dofs + core[None, :]).ravel()])
    covariance[np.ix_(small, small)] = fit.covariance
    for row in rest:
        at = 2 * n + np.arange(n) * n_dofs + row
        covariance[at, at] = variance[row]
    p = outside.hz.size
    outer_shapes = np.zeros((n_dofs, p))
    outer_shapes[core] = outside.shapes
    outer = np.zeros((p * n_dofs, p * n_dofs))
    at = (np.arange(p)[:, None] * n_dofs + core[None, :]).ravel()
    outer[np.ix_(at, at)] = outside.covariance
    return replace(fit, parameters=replace(theta, shapes=shapes), covariance=covariance), replace(
        outside, shapes=outer_shapes, covariance=outer
    )

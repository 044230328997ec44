"""Poles of an idle model whose modes are tied by damping, and how what is not known of it moves them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalCoupling
from operando.data.modal_poles import PoleForm, pole_form
from operando.data.modal_terms import ModalTerms
from operando.diagnosis.idle import Idle

Array = NDArray[Any]
_STEP = 1e-3  # standard deviations of a difference: slopes are then right to 1e-8 of the largest


def poles(idle: Idle) -> tuple[PoleForm, Array]:
    """The poles, and how g moves their frequencies [Hz] and damping ratios, (2n, g)."""
    return _poles_at(idle, np.zeros(idle.f_root.shape[1]))


def with_straight_poles(idle: Idle) -> Idle:
    """The model with unknowns that move the poles of its modes in band in proportion, to second order.

    Poles are known far better than what ties modes. A pole changes with the square of a tie, so along a straight way of frequencies
    and ties, on which it stands still at first order, it moves by many of its standard deviations, always to the same side. The
    diagonals of the modal matrices turn with g by as much as holds the poles (Bates & Watts, J. R. Stat. Soc. B 42, 1980, 1–25:
    curvature of parameters).
    """
    if not idle.between_root.any():
        return idle
    size = idle.f_root.shape[1]
    tied = _modes_alone(idle)  # nothing ties residual terms: without them an eigenproblem takes a tenth of the time
    moving = np.flatnonzero((tied.f_root != 0).any(axis=1) & (tied.zeta_root != 0).any(axis=1))
    rows = np.concatenate([moving, tied.f.size + moving])
    held = np.linalg.inv(poles(tied)[0].by_terms[np.ix_(rows, rows)])
    bend = np.zeros((2 * moving.size, size, size))
    for at, step in enumerate(_STEP * np.eye(size)):
        ahead, behind = (_poles_at(tied, g)[1][rows] for g in (step, -step))
        bend[:, at] = -held @ (ahead - behind) / (2 * _STEP)
    bend = (bend + np.swapaxes(bend, 1, 2)).reshape(2, moving.size, size, size) / 2
    return replace(idle, bend=bend, bent=idle.modes[moving])


def _modes_alone(idle: Idle) -> Idle:
    """Without residual terms."""
    modes = idle.modes
    shapes = replace(idle.shapes, shared=idle.shapes.shared[:, modes], own=idle.shapes.own[:, modes])
    terms = {name: getattr(idle, name)[modes] for name in ("f", "zeta", "residual", "f_root", "zeta_root")}
    return replace(idle, **terms, phi=idle.phi[:, modes], shapes=shapes)


def _poles_at(idle: Idle, g: Array) -> tuple[PoleForm, Array]:
    """The poles at g, and how g moves them from there, told by the diagonals of the modal matrices and what ties modes [1/s]."""
    n, modes, (first, second) = idle.f.size, idle.modes, np.triu_indices(idle.modes.size, 1)
    loss = 4 * np.pi * (idle.zeta * idle.f)[modes]
    scale = np.sqrt(loss[first] * loss[second])
    f, zeta, by_f, by_zeta = idle.diagonals(g)
    damping, lag = np.zeros((n, n)), np.zeros((len(idle.dofs), n))
    damping[modes[first], modes[second]] = (idle.between + idle.between_root @ g) * scale
    lag[:, modes] = idle.lag
    ties = ModalCoupling(damping + damping.T, lag)
    form = pole_form(ModalTerms(f, zeta, idle.phi, idle.dofs, idle.residual, ~idle.residual, coupling=ties))
    assert form is not None
    by_ties = 2 * form.by_damping[:, modes[first], modes[second]]  # both triangles
    return form, form.by_terms @ np.concatenate([by_f, by_zeta]) + by_ties @ (scale[:, None] * idle.between_root)

"""A force law of no kind in the catalogue: a smooth dynamic stiffness at one location, as one more hypothesis."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from operando.diagnosis.case import Case
from operando.diagnosis.criteria import EXPLAINED, ROBUST
from operando.diagnosis.posterior import State, approach, leaves_noise, names
from operando.diagnosis.rival import fitted_if_can_be, score, started
from operando.diagnosis.scan import Say, responses
from operando.diagnosis.terms import FREE_LAW, Term, added
from operando.indicators import INTERVAL
from operando.processes import side_by_side
from operando.structure.effects import with_spread
from operando.units import engineering_unit

Array = NDArray[Any]

_APPROACHED, _FITTED = 8, 2  # locations from which the way to a fit begins, and goes on: the true one was among the first six of the scan
_ALIKE = 3  # kinds whose law is nearest, which are fitted: the true one was first or second of those seen
_TURNS = 3  # of the robust least squares of a law
_ROUGH = 0.03  # discrepancy that a fit begins with


def with_free_law(case: Case, floor: float, say: Say = lambda text: None) -> State | None:
    """The best state with a smooth dynamic stiffness at one location, or between two; None where none explains the lines.

    ``floor`` is the log evidence of a state that it has to come near to; no higher one is tried again where it did not.
    """

    if floor >= case.law_in_vain:
        return None
    near = sorted(side_by_side(lambda term: approach(case, started(case, (term,))), scanned(case)[:_APPROACHED]), key=lambda row: row[0])
    ends = side_by_side(lambda row: fitted_if_can_be(case, row[1], _ROUGH, floor=floor), near[:_FITTED])
    tried = [state for state in ends if state is not None]
    best = max(tried, key=score, default=None)
    if best is None or best.alpha > EXPLAINED or not leaves_noise(best):
        case.law_in_vain = floor
        return None
    where = ", ".join(case.ends(best.terms[0]))
    say(f"a force law that is no kind of the catalogue, {where}: {best.log_evidence:.1f}, discrepancy {best.alpha:.4f}")
    return best


def scanned(case: Case) -> list[Term]:
    """Smooth laws at all sensors and between all pairs of them, by a robust error with nothing else freed; best first.

    Between sensors of one axis and opposite senses also on their sum, which is how far their places move apart.
    """
    about = case.forward.start
    at = case.lines.fit[:: case.lines.stride]
    w, measured = case.lines.w[at], case.lines.h[at]
    state = case.forward.scannable(about, w)
    root = 1 / np.sqrt(case.lines.variance[at] + ROBUST**2 * case.lines.level[at] ** 2)
    left = (measured - state.h) * root
    sensors = [i for i in case.allowed if i not in case.idle.midway]

    def best(place: Term) -> tuple[float, Term]:
        places, along = place.places, place.along
        columns = state.columns[:, :, list(places)] @ along
        own = columns[:, list(places)] @ along
        moved = np.swapaxes(state.structure[:, list(places)], 1, 2) @ along
        by_force = -state.measured(columns[:, :, None] * moved[:, None]) * root
        term = _law(case, place, w, by_force, own, left)
        h = responses(case, about, state, state.columns, [term], at)[..., 0]
        cost = float(np.sum(np.log1p(np.abs((measured - h) * root) ** 2)))
        return cost, term

    dofs, kind = case.dofs, FREE_LAW.kind
    pairs = list(combinations(sensors, 2))
    turned = [(i, j) for i, j in pairs if dofs[i].axis == dofs[j].axis and dofs[i].sign != dofs[j].sign]
    everywhere = [Term(kind, at) for at in (*((i,) for i in sensors), *pairs)] + [Term(kind, at, sign=-1) for at in turned]
    with np.errstate(all="ignore"):
        rows = side_by_side(best, everywhere)
    return [term for cost, term in sorted(rows, key=lambda row: row[0]) if np.isfinite(cost)]


def _law(case: Case, place: Term, w: Array, by_force: Array, own: Array, left: Array) -> Term:
    """The law z whose g = z/(1 + z y) leaves least of the error, robustly: line by line g, then z of (1 − g y) z = g.

    ``by_force`` is what a unit of g changes in the FRFs, y (``own``) the compliance at the location.
    """
    basis, weights = FREE_LAW.basis(w, case.band), np.ones(left.shape)
    for _ in range(_TURNS):
        power = np.sum(weights * np.abs(by_force) ** 2, axis=(1, 2))
        g = np.sum(weights * by_force.conj() * left, axis=(1, 2)) / np.maximum(power, 1e-300)
        root = np.sqrt(power / max(power.max(), 1e-300))
        rows, goal = (root * (1 - g * own))[:, None] * basis, root * g
        c = np.linalg.lstsq(np.concatenate([rows.real, rows.imag]), np.concatenate([goal.real, goal.imag]), rcond=None)[0]
        z = basis @ c
        error = left - by_force * (z / (1 + z * own))[:, None, None]
        weights = 1 / (1 + np.abs(error) ** 2)
    scale = float(np.sqrt(np.mean(np.abs(z) ** 2))) or 1.0
    return replace(place, values=(float(np.log(scale)), *(float(v) for v in c / scale)), fixed=(0,))


def of_a_kind(law: State, say: Say = lambda text: None) -> State | None:
    """The effect of the catalogue whose force law this one is, where its location with that kind is as probable; else None.

    A scan about the idle model starts far from a large effect, and may not come to it. The law's own curve is where it starts from.
    """
    case, (free,) = law.case, law.terms
    fits = (_with_curve_of(law, Term(t.kind, t.places, sign=sign)) for t in case.candidates(()) if _acts_there(t, free) for sign in (1, -1))
    near = sorted((fit for fit in fits if fit is not None), key=lambda row: row[0])
    say("  kinds with such a force law: " + ", ".join(names(case, [term for _, term in near[:_ALIKE]])))
    starts = side_by_side(lambda row: approach(case, started(case, (row[1],)))[1], near[:_ALIKE])
    ends = side_by_side(lambda start: fitted_if_can_be(case, start, _ROUGH, floor=law.log_evidence), starts)
    best = max((state for state in ends if state is not None), key=score, default=None)
    return best if best is not None and score(best) > score(law) else None


def _acts_there(term: Term, free: Term) -> bool:
    """Whether a kind acts along the one coordinate of a law."""
    if not term.structural or term.definition.coordinates not in ("difference", "node"):
        return False
    if term.definition.coordinates == "node":
        return len(free.places) == 1 and free.places[0] in term.places
    return set(term.places) == set(free.places) and free.sign > 0


def _with_curve_of(law: State, term: Term) -> tuple[float, Term] | None:
    """A term of the values that bring its dynamic stiffness nearest to the curve of a law, and its distance in standard deviations."""
    case, (free,) = law.case, law.terms
    w = case.lines.w[case.lines.fit]
    basis, scale = FREE_LAW.basis(w, case.band), np.exp(free.values[0])
    z, covariance = scale * (basis @ free.values[1:]), law.covariance[1:, 1:]
    std = scale * np.sqrt(np.einsum("ij,jk,ik->i", basis, covariance, basis.conj()).real)

    def off(values: Array) -> Array:
        left = (added(term.moved(values), w, case.band)[:, 0, 0] - z) / std
        return np.nan_to_num(np.concatenate([left.real, left.imag]), nan=1e9, posinf=1e9, neginf=-1e9)

    mean = case.prior(term)[0]
    with np.errstate(all="ignore"):
        size = np.mean(np.abs(z)) / np.mean(np.abs(added(term.moved((0.0, *mean[1:])), w, case.band)[:, 0, 0]))
        found = least_squares(off, np.array([np.log(size), *mean[1:]]), max_nfev=200)
    return (float(found.cost), term.moved(found.x)) if np.isfinite(found.x).all() else None


def free_law_text(state: State) -> str:
    """Where the law is, what it leaves, and its dynamic stiffness at both ends of the band."""
    case, (term,) = state.case, state.terms
    where = " and ".join(case.ends(term))
    ends = np.array(case.band)
    basis = FREE_LAW.basis(2 * np.pi * ends, case.band)
    covariance, scale = state.covariance[1:, 1:], np.exp(term.values[0])
    z = scale * (basis @ term.values[1:])

    def told(part: str) -> str:
        rows, values = getattr(basis, part), getattr(z, part)
        half = INTERVAL * scale * np.sqrt(np.einsum("ij,jk,ik->i", rows, covariance, rows))
        factor, unit = engineering_unit(float(np.abs([values, half]).max()), "N/m")
        said = [f"{with_spread(v / factor, s / factor)} {unit} at {hz:.4g} Hz" for v, s, hz in zip(values, half, ends, strict=True)]
        return "from {} to {}".format(*said).replace("-", "−")

    kind = "between" if len(term.places) > 1 else "at"
    return (
        f"a force {kind} {where} explains the FRFs, and its force law is no kind of the catalogue: the real part of its dynamic stiffness "
        f"goes {told('real')}, the imaginary part {told('imag')} (± is the 95 % interval)"
    )

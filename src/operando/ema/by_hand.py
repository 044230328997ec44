"""Modes named by hand: from the automatic answer and the kept candidates, without a new search."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel, numbers_of
from operando.ema.answers import LinearModes
from operando.ema.findings import doubtful_findings
from operando.ema.linear import LinearFit
from operando.ema.pairs import Real
from operando.ema.unit_mass import UnitMassShapes
from operando.errors import IdentificationError
from operando.stabilization import RejectedPole, Stabilization

NEAR_WIDTHS = 3.0
"""A frequency named by hand means the nearest pole within so many half bandwidths of it, or one per cent."""

AddModes = Callable[[Real, Real], tuple[LinearFit, UnitMassShapes]]


def modes_by_hand(
    automatic: ModalModel,
    modes_hz: Sequence[float],
    select_hz: Sequence[float],
    reject_hz: Sequence[float],
    add_modes: AddModes,
) -> ModalModel:
    """The automatic model with other modes: those it has keep their values, new ones come from a linear fit beside them.

    Parameters
    ----------
    automatic : ModalModel
        With :class:`operando.ema.EmaDetails`.
    modes_hz : sequence of float
        Exactly these [Hz]; else those of the automatic answer, ``select_hz`` besides, without the one nearest to each ``reject_hz``.
    select_hz, reject_hz : sequences of float
    add_modes : callable
        Poles (hz, zeta) → linear fit of exactly these, and its shapes.

    Raises
    ------
    IdentificationError
        If no stable pole is near a frequency named, or no mode is left.
    """
    terms, details = automatic.terms, automatic.details
    n = automatic.n_modes
    pool = poles_by_hand(automatic)
    known = [pole for pole in pool if pole[2] >= 0]
    for name, given in (("modes_hz", modes_hz), ("select_hz", select_hz), ("reject_hz", reject_hz)):
        numbers_of(list(given), name, "give frequencies in Hz, as [12.1, 15.5]")
    chosen = [] if modes_hz else known[:n]
    for wanted in (*modes_hz, *select_hz):
        near = _nearest(pool, wanted)
        if all(abs(near[0] - h) > 1e-4 * h for h, _, _ in chosen):
            chosen.append(near)
    gone = [_nearest(known[:n], refused) for refused in reject_hz]
    chosen = [pole for pole in chosen if pole not in gone]
    if not chosen:
        raise IdentificationError("no mode is left after reject_hz", hint="leave some, or name modes in modes_hz")
    keep = np.zeros(terms.n, bool)
    keep[n:] = True
    keep[[i for _, _, i in chosen if i >= 0]] = True
    residual = terms.residual.copy()
    residual[[i for _, _, i in chosen if i >= 0]] = False
    model = _with_marks(automatic, residual).select_terms(_positions(residual, keep))
    new = [(h, z) for h, z, i in chosen if i < 0]
    said = []
    if new:
        model, evidence = _with_new(model, new, chosen, add_modes)
        said += [f"added by hand: {h:.5g} Hz, evidence {e:.3g} independent lines" for (h, _), e in zip(new, evidence, strict=True)]
    dropped = [pole for pole in known[:n] if pole not in chosen]
    said += [f"left out by hand: {h:.5g} Hz{_evidence_text(details.linear, h)}" for h, _, _ in dropped]
    rejected = [RejectedPole(h, z, "by_hand", f"left out by hand{_evidence_text(details.linear, h)}") for h, z, _ in dropped]
    own = replace(
        details,
        stabilization=_diagram_of(details.stabilization, model),
        rejected=(*rejected, *details.rejected),
        rounds=(*details.rounds, *said),
    )
    # On unused lines the automatic modes were judged, not these.
    misfit = automatic.misfit if not new and not dropped else None
    return replace(model, details=own, misfit=misfit, provenance=model.provenance.then("modes by hand: " + "; ".join(said)))


def poles_by_hand(automatic: ModalModel) -> list[tuple[float, float, int]]:
    """Poles that may be named by hand in ``modes_hz`` and ``select_hz``.

    Parameters
    ----------
    automatic : ModalModel
        Of :func:`operando.fit_ema` without anything named by hand.

    Returns
    -------
    list of (float, float, int)
        Frequency [Hz], damping ratio, and the term of the model, −1 for a pole that it does not have. Its modes come first.

    Examples
    --------
    >>> import numpy as np, operando
    >>> from operando.ema import poles_by_hand
    >>> model = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> found = operando.fit_ema(model.frf(np.arange(5, 80, 0.1), references="1+Z"), band=(10, 70))
    >>> [round(hz) for hz, _, _ in poles_by_hand(found)[:2]]
    [20, 45]
    """
    terms, known = automatic.terms, (*range(automatic.n_modes), *_doubtful_terms(automatic))
    poles = [(float(terms.frequencies_hz[i]), float(terms.damping_ratios[i]), i) for i in known]
    # a candidate within a few half bandwidths of a pole that the answer has is that pole, less exactly
    apart = lambda c: all(abs(c.frequency_hz - h) > NEAR_WIDTHS * z * h for h, z, _ in poles)  # noqa: E731
    return poles + [(c.frequency_hz, c.damping_ratio, -1) for c in automatic.details.candidates if apart(c)]


def without_doubts(model: ModalModel, codes: Collection[str]) -> ModalModel:
    """The model with those poles in doubt as modes whose doubts are all of some kinds, which are void.

    Parameters
    ----------
    model : ModalModel
        Of :func:`operando.fit_ema`.
    codes : collection of str
        Kinds of doubts, as in :class:`operando.ema.doubts.Evidence`.

    Returns
    -------
    ModalModel
        The same one where no pole is in such a doubt.

    Examples
    --------
    >>> import numpy as np, operando
    >>> from operando.ema import without_doubts
    >>> model = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> found = operando.fit_ema(model.frf(np.arange(5, 80, 0.1), references="1+Z"), band=(10, 70))
    >>> without_doubts(found, ["twin"]) is found
    True
    """
    linear = getattr(model.details, "linear", None)
    if linear is None:
        return model
    terms = _doubtful_terms(model)
    poles = {i: int(np.argmin(np.abs(linear.frequencies_hz - model.terms.frequencies_hz[i]))) for i in terms}
    poles = {i: k for i, k in poles.items() if linear.evidence[k].doubts and all(code in codes for code, _ in linear.evidence[k].doubts)}
    low, high = model.band_hz or (0.0, np.inf)
    poles = {i: k for i, k in poles.items() if low <= model.terms.frequencies_hz[i] <= high}
    if not poles:
        return model
    residual = model.terms.residual.copy()
    residual[list(poles)] = False
    evidence = tuple(replace(e, doubts=()) if k in poles.values() else e for k, e in enumerate(linear.evidence))
    hz = linear.frequencies_hz[list(poles.values())]
    kept = tuple(p for p in model.details.rejected if p.code not in codes or np.min(np.abs(hz - p.frequency_hz)) > 1e-9 * p.frequency_hz)
    findings = tuple(f for f in model.findings if f.kind != "doubtful_pole")
    inside = [(float(h), e) for h, e in zip(linear.frequencies_hz, evidence, strict=True) if low <= h <= high]
    out = _with_marks(replace(model, findings=(*findings, *doubtful_findings(inside))), residual)
    out = out.select_terms(np.concatenate([np.argsort(out.frequencies_hz), np.arange(out.n_modes, out.terms.n)]))
    own = replace(model.details, linear=replace(linear, evidence=evidence), rejected=kept)
    return replace(out, details=replace(own, stabilization=_diagram_of(own.stabilization, out)))


def _doubtful_terms(model: ModalModel) -> list[int]:
    """Residual terms that are poles in doubt, not what lies outside."""
    if model.details.linear is None:
        return []
    hz = model.details.linear.frequencies_hz
    rest = range(model.n_modes, model.terms.n)
    return [i for i in rest if np.min(np.abs(hz - model.terms.frequencies_hz[i])) < 1e-9 * model.terms.frequencies_hz[i]]


def _with_marks(model: ModalModel, residual: NDArray[np.bool_]) -> ModalModel:
    """The same terms, others of them called modes."""
    t = model.terms
    low, high = model.band_hz or (0.0, np.inf)
    inside = (t.frequencies_hz >= low) & (t.frequencies_hz <= high)
    others = {name: getattr(model, name) for name in ("scaling", "band_hz", "misfit", "si", "findings", "provenance", "details")}
    return ModalModel.from_terms(
        t.frequencies_hz, t.damping_ratios, t.shapes, model.dofs,
        residual=residual, in_band=inside, covariance=t.covariance, std=t.std, **others,
    )  # fmt: skip


def _positions(residual: NDArray[np.bool_], keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``keep`` in the order of the terms once modes stand first."""
    order = np.argsort(residual, kind="stable")
    return np.asarray(keep[order])


def _with_new(
    model: ModalModel, new: list[tuple[float, float]], chosen: list[tuple[float, float, int]], add_modes: AddModes
) -> tuple[ModalModel, list[float]]:
    """The model and modes it lacks, with the shapes that a linear fit of all gives these."""
    poles = sorted((h, z) for h, z, _ in chosen)
    fit, mass = add_modes(np.array([h for h, _ in poles]), np.array([z for _, z in poles]))
    at = [int(np.argmin(np.abs(fit.poles.hz - h))) for h, _ in new]
    t, m, k = model.terms, len(model.dofs), len(at)
    covariance = None
    if t.covariance is not None:
        total = t.n + k
        covariance = np.zeros((total * (2 + m), total * (2 + m)))
        old = np.concatenate([np.arange(t.n), total + np.arange(t.n), 2 * total + np.arange(t.n * m)])
        added = np.concatenate([t.n + np.arange(k), total + t.n + np.arange(k), 2 * total + t.n * m + np.arange(k * m)])
        covariance[np.ix_(old, old)] = t.covariance
        covariance[np.ix_(added, added)] = mass.covariance.of_modes(at)
    low, high = model.band_hz or (0.0, np.inf)
    hz = np.concatenate([t.frequencies_hz, fit.mean_hz[at]])
    others = {name: getattr(model, name) for name in ("scaling", "band_hz", "misfit", "si", "findings", "provenance", "details")}
    zeta, shapes = np.concatenate([t.damping_ratios, fit.poles.zeta[at]]), np.concatenate([t.shapes, mass.shapes[:, at]], axis=1)
    residual = np.concatenate([t.residual, np.zeros(k, bool)])
    whole = ModalModel.from_terms(
        hz, zeta, shapes, model.dofs, residual=residual, in_band=(hz >= low) & (hz <= high), covariance=covariance, **others
    )
    order = np.concatenate([np.argsort(whole.frequencies_hz), np.arange(whole.n_modes, whole.terms.n)])
    return whole.select_terms(order), [float(fit.evidence[:, i].sum()) for i in at]


def _diagram_of(diagram: Stabilization | None, model: ModalModel) -> Stabilization | None:
    """The kept diagram with the modes of the model as the selected ones."""
    if diagram is None:
        return None
    hz = model.frequencies_hz
    members = tuple(np.flatnonzero(np.abs(diagram.table.frequency_hz - h) < 0.003 * h) for h in hz)
    return replace(diagram, selected_hz=hz, selected_damping=model.damping_ratios, selected_vectors=model.shapes, selected_members=members)


def _evidence_text(linear: LinearModes | None, hz: float) -> str:
    """What the linear stage held for the pole at ``hz``."""
    if linear is None or not linear.frequencies_hz.size:
        return ""
    k = int(np.argmin(np.abs(linear.frequencies_hz - hz)))
    if abs(linear.frequencies_hz[k] - hz) > 0.005 * hz:
        return ", which the linear stage did not find"
    return f", for which {linear.evidence[k].evidence:.3g} independent lines speak"


def _nearest(poles: Sequence[tuple[Any, ...]], wanted: float) -> Any:
    """The pole nearest to a frequency named by hand.

    Raises
    ------
    IdentificationError
        If none is near enough to be meant.
    """
    best = min(poles, key=lambda p: abs(p[0] - wanted), default=None)
    if best is None or abs(best[0] - wanted) > max(0.01 * wanted, NEAR_WIDTHS * best[1] * best[0]):
        near = "" if best is None else f"; the nearest is at {best[0]:.5g} Hz"
        raise IdentificationError(f"no stable pole near {wanted:g} Hz{near}", hint="see the stabilisation diagram in the report")
    return best

"""Modes named by hand: from the automatic answer and the kept candidates, without a new search."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, ModalModel, expect
from operando.ema.answers import LinearModes
from operando.ema.details import EmaDetails
from operando.ema.doubts import evidence_of_modes
from operando.ema.findings import doubtful_findings
from operando.ema.linear import LinearFit
from operando.ema.pairs import Real
from operando.ema.unit_mass import UnitMassShapes
from operando.errors import IdentificationError
from operando.stabilization import HAND_TOLERANCE, RejectedPole, Stabilization

NEAR_WIDTHS = 3.0
"""A pole within so many half bandwidths of a pole that the answer has is that pole, less exactly: its resonance is a third there."""

Pole = tuple[float, float, int]
"""Frequency [Hz], damping ratio, term of the model (−1: none)."""
AddModes = Callable[[Real, Real], tuple[LinearFit, UnitMassShapes]]


def modes_by_hand(
    automatic: ModalModel,
    modes_hz: Sequence[float],
    select_hz: Sequence[float],
    reject_hz: Sequence[float],
    add_modes: AddModes,
) -> ModalModel:
    """The automatic model with other modes: those it has keep their values, new ones come from a linear fit beside them.

    Exactly ``modes_hz``; else those of the automatic answer, ``select_hz`` besides, without the one nearest to each ``reject_hz``. Each
    means the pole nearest to it, within ``HAND_TOLERANCE``: one per cent, as a frequency is read off a plot, and as the workbench and
    operational modes take it. The damping of a pole does not widen it: fits leave many poles of large damping. ``add_modes`` makes of poles
    (hz, zeta) the linear fit of exactly these, and its shapes.
    """
    terms, details = automatic.terms, automatic.details
    n = automatic.n_modes
    pool = poles_by_hand(automatic)
    known = [pole for pole in pool if pole[2] >= 0]
    named = _named(pool, (*modes_hz, *select_hz))
    gone = set(_named(known[:n], reject_hz))
    chosen = [] if modes_hz else known[:n]
    chosen = [pole for pole in dict.fromkeys([*chosen, *named]) if pole not in gone]
    if not chosen:
        raise IdentificationError("no mode is left after reject_hz", hint="leave some, or name modes in modes_hz")
    keep = np.zeros(terms.n, bool)
    keep[n:] = True
    keep[[i for _, _, i in chosen if i >= 0]] = True
    residual = terms.residual.copy()
    residual[[i for _, _, i in chosen if i >= 0]] = False
    model = _with_marks(automatic, residual).select_terms(_positions(residual, keep))
    model = _sorted(model)  # a pole in doubt that is named stood behind the modes
    new = {pole: hz for pole, hz in named.items() if pole[2] < 0}
    said = [f"named by hand: {hz:g} Hz, which is a mode already" for pole, hz in named.items() if not modes_hz and pole in known[:n]]
    if new:
        model, lines = _with_new(model, new, known, n, add_modes)
        said += [f"added by hand: {h:.5g} Hz, evidence {e:.3g} independent lines" for (h, _, _), e in zip(new, lines, strict=True)]
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


def poles_by_hand(automatic: ModalModel) -> list[Pole]:
    """Poles that may be named by hand in ``modes_hz`` and ``select_hz`` of an automatic answer.

    Each with its frequency [Hz], damping ratio, and the term of the model, −1 for a pole that it does not have. Its modes come first.
    """
    expect(automatic.details, EmaDetails, "poles beside the modes are known from the details of an EMA", "give what fit_ema(frf) returned")
    terms, known = automatic.terms, (*range(automatic.n_modes), *_doubtful_terms(automatic))
    poles = [(float(terms.frequencies_hz[i]), float(terms.damping_ratios[i]), i) for i in known]
    return poles + [(c.frequency_hz, c.damping_ratio, -1) for c in automatic.details.candidates if _beside(c.frequency_hz, poles) is None]


def without_doubts(model: ModalModel, codes: Collection[str]) -> ModalModel:
    """The model of an EMA with those poles in doubt as modes whose doubts are all of some kinds, which are void."""
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
    out = _sorted(out)
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


def _sorted(model: ModalModel) -> ModalModel:
    """Modes by rising frequency, residual terms as they are."""
    return model.select_terms(np.concatenate([np.argsort(model.frequencies_hz), np.arange(model.n_modes, model.terms.n)]))


def _positions(residual: NDArray[np.bool_], keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``keep`` in the order of the terms once modes stand first."""
    order = np.argsort(residual, kind="stable")
    return np.asarray(keep[order])


def _with_new(model: ModalModel, new: dict[Pole, float], known: list[Pole], n: int, add_modes: AddModes) -> tuple[ModalModel, list[float]]:
    """The model and modes it lacks, with the poles and shapes that a linear fit beside all ``n`` automatic modes gives these.

    Automatic modes that are not wanted stand in that fit, too: without them a new pole would move to one of them. ``new`` has the frequency
    [Hz] that named each pole; ``known`` are those of the automatic answer, its ``n`` modes first.
    """
    poles = sorted({*known[:n], *new})
    fit, mass = add_modes(np.array([h for h, _, _ in poles]), np.array([z for _, z, _ in poles]))
    at = [poles.index(pole) for pole in new]  # both by rising frequency
    for (h, _, _), wanted, i in zip(new, new.values(), at, strict=True):
        found_hz = float(fit.mean_hz[i])
        more = [(float(fit.mean_hz[j]), float(fit.poles.zeta[j]), -1) for j in at if j != i]
        # two named ones may stand closer than a candidate may to a mode, but within a half bandwidth they are one resonance
        _expect_there(wanted, h, found_hz, known, _beside(found_hz, known) or _beside(found_hz, more, 1.0))
    evidence = evidence_of_modes(fit)
    doubts = [f"{fit.mean_hz[i]:.5g} Hz: {evidence[i].doubts[0][1]}" for i in at if evidence[i].doubts]
    if doubts:
        said = Finding(
            "doubtful_by_hand", f"named by hand, in doubt as a mode: {'; '.join(doubts)}", "warning",
            consequence="its frequency, damping and shape may be those of noise or of what lies beside it",
            action="leave it out, unless something else shows that it is a mode",
        )  # fmt: skip
        model = replace(model, findings=(*model.findings, said))
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
    return _sorted(whole), [evidence[i].evidence for i in at]


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


def _beside(hz: float, poles: Sequence[Pole], widths: float = NEAR_WIDTHS) -> float | None:
    """Frequency of the pole that ``hz`` is too near to, in half bandwidths, to be another one."""
    near = [h for h, z, _ in poles if abs(hz - h) <= widths * z * h]
    return min(near, key=lambda h: abs(hz - h), default=None)


def _named(poles: Sequence[Pole], wanted: Sequence[float]) -> dict[Pole, float]:
    """The pole nearest to each frequency named by hand, with that frequency."""
    out: dict[Pole, float] = {}
    for hz in wanted:
        best = min(poles, key=lambda p: abs(p[0] - hz), default=None)
        if best is None or abs(best[0] - hz) > HAND_TOLERANCE * hz:
            raise IdentificationError(f"no stable pole near {hz:g} Hz{_nearest_text(poles, hz)}", hint=_HINT)
        if best in out:
            others = _nearest_text([p for p in poles if p != best], hz, "nearest other")
            raise IdentificationError(
                f"{out[best]:g} Hz and {hz:g} Hz reach one pole, at {best[0]:.6g} Hz{others}",
                hint="leave one of them out, or correct it by the stabilisation diagram in the report",
            )
        out[best] = hz
    return out


def _expect_there(wanted: float, found: float, fitted: float, known: Sequence[Pole], beside: float | None) -> None:
    """Refuse a pole that is not what was named once it is fitted beside the modes: elsewhere, or a part of another one."""
    if beside is None and abs(fitted - wanted) <= HAND_TOLERANCE * wanted:
        return
    what = f"the candidate at {found:.6g} Hz is at {fitted:.6g} Hz once it is fitted"
    part = "" if beside is None else f", a part of the one at {beside:.6g} Hz"
    raise IdentificationError(f"no stable pole near {wanted:g} Hz: {what}{part}{_nearest_text(known, wanted)}", hint=_HINT)


_HINT = "name one of these, or another one of the stabilisation diagram in the report"


def _nearest_text(poles: Sequence[Pole], hz: float, which: str = "nearest") -> str:
    """The two nearest poles, in digits by which they can be named, and how near a name has to be."""
    near = [f"{p[0]:.6g} Hz" for p in sorted(poles, key=lambda p: abs(p[0] - hz))[:2]]
    if not near:
        return ""
    return f"; the {which} is at {', the next at '.join(near)}; a frequency means a pole within {100 * HAND_TOLERANCE:g} % of it"

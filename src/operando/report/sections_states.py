"""What the sections on the two states show: at rest (FRFs, idle model) and running (spectra, operational modes)."""

from __future__ import annotations

from typing import Any

import numpy as np
from markupsafe import Markup

from operando.compare import clear_lines, rms_over
from operando.contrib import library_rows
from operando.data import Frf, ModalModel, phase_collinearity
from operando.plots.stabilization import spectra_unit
from operando.report import derive, figures_frf, figures_stabilization, live
from operando.report.parts import Numbering, hz_list
from operando.results import Results


def idle(results: Results, page: Numbering) -> dict[str, Any]:
    """FRFs at rest, stabilisation, rejected poles, residual modes, chi-square, reciprocity, comparison with a library."""
    frf, model, band = results.idle_frf, results.idle, derive.analysis_band(results)
    out: dict[str, Any] = {"frf": frf, "model": model, "error": None, "reciprocity": []} | _identified(results, model, "idle")
    out["one_reference"] = frf is not None and len(frf.references) == 1  # residues to one force have one shape whatever they are
    if frf is not None:
        synthesised = derive.model_frf(derive.scaled_idle(results), frf)
        error = None if synthesised is None else _misfit_by_pair(synthesised, frf, results)
        pairs = derive.choose_pairs(frf, error)
        out |= {
            "overview": figures_frf.frf_overview(frf, synthesised, band), "drawn": figures_frf.frf_pairs(frf, synthesised, pairs, band),
            "error": error, "reciprocity": derive.reciprocity(frf, band),
            "explorer": live.frfs(results, page) if results.hybrid is None else None,
        }  # fmt: skip
    if model is not None:
        by_dof = np.asarray(getattr(model.details, "misfit_by_dof", ()), float)
        known = by_dof.shape == (len(model.dofs),) and bool(np.any(np.isfinite(by_dof)))
        worst = int(np.nanargmax(by_dof)) if known else 0
        out["worst_dof"] = (float(np.nanmedian(by_dof)), float(by_dof[worst]), model.dofs[worst]) if known else None
        out["n_inside"] = int(np.sum(np.asarray(model.in_band)))
        out["residuals"] = "" if model.residuals is None else derive.range_text(model.residuals.frequencies_hz)
    return out


def operating(results: Results, page: Numbering) -> dict[str, Any]:
    """Spectra, stabilisation, harmonics, rejected poles and modes of the running state."""
    model = results.operating
    out: dict[str, Any] = {"model": model, "harmonics": _harmonics(results), "singular": None} | _identified(results, model, "operating")
    if model is None:
        return out
    if (spectra := getattr(model.details, "spectra", None)) is not None:
        out["singular"] = figures_stabilization.singular_values(
            spectra.frequencies_hz, spectra.singular_values, out["band"], model.frequencies_hz, out["harmonics"], spectra_unit(model)
        )
    given = tuple(getattr(model.details, "setups", ()) or ())
    used = [s for s in given if not s.failed]
    joint = getattr(model.details, "joint", None)
    return out | {
        "setups": given, "used": used, "shared": list(dict.fromkeys(d for s in used for d in s.shared)), "joint": joint,
        "joint_known": joint is not None and bool(np.any(np.isfinite(joint.frequencies_hz))), "matched": _matched, "alone": _alone,
    }  # fmt: skip


def _matched(setup: Any) -> int:
    return int(np.sum(np.asarray(setup.merged) >= 0))


def _alone(setup: Any) -> list[str]:
    """Modes of a set-up that no other shows."""
    return hz_list(f for f, reason in zip(setup.frequencies_hz, setup.reasons, strict=False) if reason)


def _identified(results: Results, model: ModalModel | None, which: str) -> dict[str, Any]:
    """What both states show of an identification: the diagram, the poles rejected, the modes, the comparison with a library."""
    details = getattr(model, "details", None)
    stabilization = getattr(details, "stabilization", None)
    given = getattr(details, "rejected", None) or getattr(stabilization, "rejected", None) or ()
    rejected = sorted(given, key=lambda r: float(r.frequency_hz))
    out: dict[str, Any] = {
        "which": which, "details": details, "rejected": rejected, "drawing": None, "live": None,
        "opinion": _second_opinion(details, results, which),
        "codes": sorted(((sum(r.code == c for r in rejected), c) for c in {r.code for r in rejected}), key=lambda c: (-c[0], c[1])),
    }  # fmt: skip
    if model is None:
        return out
    band = model.band_hz or derive.analysis_band(results)
    if stabilization is not None:
        out["drawing"] = _diagram(results, model, stabilization, band, which)
        out["live"] = live.poles(model, band, which)
    shapes = [np.asarray(model.shapes[:, i]) for i in range(model.n_modes)]
    std = [None if model.shape_std is None else float(np.linalg.norm(model.shape_std[:, i])) for i in range(model.n_modes)]
    return out | {
        "band": band, "scaled": model.scaling == "unit_modal_mass",
        "collinearity": None if model.real_shapes else [phase_collinearity(s) for s in model.complex_shapes.T],
        "top": [int(np.argmax(np.abs(s))) for s in shapes],
        "shape_std": [None if v is None or not np.any(s) else v / float(np.linalg.norm(s)) for v, s in zip(std, shapes, strict=True)],
    }  # fmt: skip


def _diagram(results: Results, model: ModalModel, stabilization: Any, band: Any, which: str) -> Markup:
    harmonics = _harmonics(results) if which == "operating" else []
    name = f"First singular values [{spectra_unit(model)}]" if which == "operating" else "Mode indicator (CMIF)"
    return figures_stabilization.stabilization_diagram(stabilization, band, model.frequencies_hz, harmonics, name)


def _harmonics(results: Results) -> list[float]:
    values = getattr(getattr(results.operating, "details", None), "harmonics_hz", None)
    return [] if values is None else [float(v) for v in values]


def _misfit_by_pair(model: Frf, frf: Frf, results: Results) -> Any:
    """Mean |ΔH|² over the noise variance by pair, or relative error where there is none."""
    inside = clear_lines(frf, derive.analysis_band(results))
    gap = np.abs(model.data - frf.data) ** 2
    weight = frf.variance if frf.variance is not None else np.nanmean(np.abs(frf.data) ** 2, axis=2, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        return rms_over(np.sqrt(gap / weight), inside & np.isfinite(gap / weight), axis=2)


def _second_opinion(details: Any, results: Results, which: str) -> dict[str, Any] | None:
    """The modes beside those of an independent program; None where it was not asked."""
    told: Any = library_rows(results.libraries, which)
    rows = told["modes"] if told else getattr(details, "second_opinion", None) or ()
    if not told and not rows and not results.settings.get("second_opinion"):
        return None
    words = [told[key] for key in ("program", "text") if told[key]] if told else []
    return {"rows": rows, "against": [r for r in rows if r.get("agrees") is False], "words": words}

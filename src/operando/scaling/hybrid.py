"""From an idle and an operational modal model to operational FRFs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, ModalModel
from operando.data.provenance import Provenance
from operando.dof import Dof, match_dofs
from operando.errors import ConfigError, DataError, IdentificationError
from operando.scaling.condensed import CondensedBasis, condensed_basis
from operando.scaling.methods import METHODS, Task, real_shapes, scaled_shapes
from operando.scaling.model import HybridModel
from operando.scaling.pairing import Pairing, pair_modes


def scale_operational(idle: ModalModel, operating: ModalModel, threshold: float = 0.7, method: str = "auto") -> HybridModel:
    """Carry the scale of the idle modes over to the operational ones (Shen & Lu 2024).

    Parameters
    ----------
    idle : ModalModel
        Real shapes of unit modal mass, residual modes included.
    operating : ModalModel
        Complex shapes of arbitrary scale.
    threshold : float
        ε of Eq 1: MAC from which a mode counts as unchanged.
    method : str
        ``auto`` or one of ``operando.scaling.METHODS``.

    Raises
    ------
    ConfigError
        If method or threshold is wrong.
    DataError
        If the idle model is not scaled, or the models have no DOF in common.
    IdentificationError
        If a method asked for by name cannot be applied.
    """
    if method not in ("auto", *METHODS):
        raise ConfigError(f"scaling method {method!r} is none of {', '.join(('auto', *METHODS))}")
    if idle.scaling != "unit_modal_mass":
        raise DataError(
            "the idle modes are not scaled to unit modal mass, so there is no scale to carry over",
            hint="give the units of force and response ([units] or [channels]) and a drive point to the EMA",
        )
    findings: list[Finding] = []
    dofs, idle_rows, operating_rows = common_dofs(idle, operating, findings)
    proper_idle = idle.modes_proper()
    proper_operating = operating.modes_proper()
    idle_shapes = np.asarray(proper_idle.shapes[idle_rows], float)
    operating_shapes = np.asarray(proper_operating.shapes)[operating_rows[0]] * operating_rows[1][:, None]
    if not np.all(np.isfinite(operating_shapes)) or np.any(np.max(np.abs(operating_shapes), axis=0) == 0):
        raise DataError("an operational shape is zero or not finite at the common DOFs")
    pairing = pair_modes(
        idle_shapes, proper_idle.frequencies_hz, operating_shapes, proper_operating.frequencies_hz, threshold, proper_idle.in_band
    )
    basis = _basis(idle_shapes, proper_idle, findings)
    task = Task(
        pairing.partners,
        np.array([p.kind in ("unchanged", "beyond_idle_band") for p in pairing.pairs], bool),
        np.zeros(0, int) if basis is None else basis.modes,
        proper_idle.frequencies_hz,
        proper_operating.frequencies_hz,
    )
    shapes: dict[str, NDArray[np.float64]] = {}
    for name in METHODS:
        try:
            shapes[name] = scaled_shapes(name, idle_shapes, operating_shapes, task)
        except IdentificationError:
            if name == method:
                raise
    chosen = ("eq13" if "eq13" in shapes else "msf_all") if method == "auto" else method
    reason = "asked for" if method != "auto" else "unchanged modes by MSF, changed modes one by one"
    carried, text = _carried_over(idle, pairing)
    models = {name: _assemble(idle, proper_operating, dofs, idle_rows, s, carried) for name, s in shapes.items()}
    out = np.asarray(shapes[chosen])
    scales = np.sum(operating_shapes.conj() * out, axis=0) / np.sum(np.abs(operating_shapes) ** 2, axis=0)
    turned, factor = real_shapes(operating_shapes)
    imaginary = np.linalg.norm(np.imag(operating_shapes * factor), axis=0) / np.linalg.norm(operating_shapes * factor, axis=0)
    return HybridModel(
        idle,
        operating,
        models[chosen],
        pairing,
        chosen,
        reason,
        threshold,
        basis,
        scales,
        None,
        _outside(idle_shapes, turned, basis),
        imaginary,
        _alternatives(models, chosen, idle, proper_operating),
        models,
        text,
        {},
        tuple(findings),
    )


def common_dofs(
    idle: ModalModel, operating: ModalModel, findings: list[Finding]
) -> tuple[tuple[Dof, ...], list[int], tuple[list[int], NDArray[np.float64]]]:
    """DOFs both models have, in the order and sense of the idle model; what is left out becomes a finding."""
    known = {(d.node, d.axis) for d in operating.dofs}
    rows = [i for i, d in enumerate(idle.dofs) if (d.node, d.axis) in known]
    if not rows:
        raise DataError("the idle and the operational modes have no DOF in common", hint="check the DOF labels of both measurements")
    dofs = tuple(idle.dofs[i] for i in rows)
    index, signs = match_dofs(dofs, operating.dofs)
    common = {(d.node, d.axis) for d in dofs}
    for name, model in (("at rest", idle), ("in operation", operating)):
        missing = [str(d) for d in model.dofs if (d.node, d.axis) not in common]
        if missing:
            findings.append(
                Finding(
                    "dof_not_common",
                    f"{len(missing)} DOFs measured {name} only: {', '.join(missing[:12])}{' …' if len(missing) > 12 else ''}",
                    "info",
                    consequence="they are left out of the operational FRFs",
                    action="measure the same DOFs at rest and in operation",
                )
            )
    return dofs, rows, (index, np.asarray(signs, float))


def _basis(shapes: NDArray[np.float64], idle: ModalModel, findings: list[Finding]) -> CondensedBasis | None:
    try:
        return condensed_basis(shapes, idle.frequencies_hz, np.asarray(idle.in_band))
    except IdentificationError as error:
        findings.append(
            Finding(
                "ill_conditioned",
                f"no condensed mass: {error.message}",
                "warning",
                consequence="changed modes are scaled by MSF onto their idle partner",
                action=error.hint or "",
            )
        )
        return None


def _outside(idle: NDArray[np.float64], turned: NDArray[np.float64], basis: CondensedBasis | None) -> NDArray[np.float64]:
    if basis is None:
        return np.ones(turned.shape[1])
    used = idle[:, basis.modes]
    rest = turned - used @ (np.linalg.pinv(used) @ turned)
    return np.linalg.norm(rest, axis=0) / np.linalg.norm(turned, axis=0)


def _carried_over(idle: ModalModel, pairing: Pairing) -> tuple[NDArray[np.int_], str]:
    """Idle modes that stand in the OFRF as they are: residual modes, and modes no operational mode was found for."""
    proper = np.flatnonzero(~np.asarray(idle.residual))
    residual = np.flatnonzero(np.asarray(idle.residual))
    alone = proper[pairing.idle_without_partner]
    parts = []
    if residual.size:
        parts.append(f"{residual.size} residual modes of the idle model (" + _hz(idle, residual) + ")")
    inside = np.asarray(idle.in_band)[alone]
    if np.any(~inside):
        parts.append(f"{int(np.sum(~inside))} idle modes beyond the band (" + _hz(idle, alone[~inside]) + ")")
    if np.any(inside):
        parts.append(f"{int(np.sum(inside))} idle modes in band without an operational mode (" + _hz(idle, alone[inside]) + ")")
    text = "carried over as at rest: " + "; ".join(parts) if parts else "none: the idle model has no residual modes"
    return np.concatenate([residual, alone]).astype(int), text


def _hz(model: ModalModel, index: NDArray[np.int_]) -> str:
    return ", ".join(f"{f:.2f}" for f in model.frequencies_hz[index]) + " Hz"


def _assemble(
    idle: ModalModel,
    operating: ModalModel,
    dofs: tuple[Dof, ...],
    rows: list[int],
    shapes: NDArray[np.float64],
    carried: NDArray[np.int_],
) -> ModalModel:
    n, k = operating.n_modes, carried.size
    return ModalModel(
        np.concatenate([operating.frequencies_hz, idle.frequencies_hz[carried]]),
        np.concatenate([operating.damping_ratios, idle.damping_ratios[carried]]),
        np.concatenate([shapes, np.asarray(idle.shapes)[rows][:, carried]], axis=1),
        dofs,
        "unit_modal_mass",
        residual=np.concatenate([np.zeros(n, bool), np.ones(k, bool)]),
        in_band=np.concatenate([np.asarray(operating.in_band), np.zeros(k, bool)]),
        band_hz=operating.band_hz or idle.band_hz,
        provenance=Provenance.merge(idle.provenance, operating.provenance).then("scale_operational"),
    )


def _alternatives(models: dict[str, ModalModel], chosen: str, idle: ModalModel, operating: ModalModel) -> dict[str, float | None]:
    """Largest difference in dB over lines and pairs, on 400 lines of the band."""
    low, high = operating.band_hz or idle.band_hz or (operating.frequencies_hz.min() * 0.8, operating.frequencies_hz.max() * 1.1)
    lines = np.linspace(max(low, 1e-3), high, 400)
    base = np.abs(models[chosen].frf(lines).data)
    out: dict[str, float | None] = {}
    for name in METHODS:
        if name == chosen:
            continue
        if name not in models:
            out[name] = None
            continue
        other = np.abs(models[name].frf(lines).data)
        good = (base > 0) & (other > 0)
        out[name] = float(np.max(np.abs(20 * np.log10(other[good] / base[good])))) if np.any(good) else None
    return out


def with_method(hybrid: HybridModel, method: str) -> HybridModel:
    """The same models scaled by another named method."""
    return replace(scale_operational(hybrid.idle, hybrid.operating, hybrid.threshold, method))

"""From an idle and an operational modal model to operational FRFs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, ModalModel, ResidualTerms, expect, number_of
from operando.data.provenance import Provenance
from operando.dof import Dof, DofIndex
from operando.errors import ConfigError, DataError, IdentificationError
from operando.limits import METHODS
from operando.printable import first_few
from operando.scaling.carried import LEAST_LEFT, NOT_HELD, CommonShift, common_shift, lessened, part_left, shape_change
from operando.scaling.common_factor import sampling_rate_finding
from operando.scaling.condensed import CondensedBasis, best_addition, condensed_basis
from operando.scaling.doubt import scale_doubt
from operando.scaling.evidence import Choice, choose_method
from operando.scaling.expansion import expand, make_prior
from operando.scaling.flips import class_flips, flip_probability
from operando.scaling.methods import IN_WORDS, Task, noise_only, real_shapes, scaled_shapes
from operando.scaling.missing import missing_modes, with_missing
from operando.scaling.model import HybridModel
from operando.scaling.pairing import Pairing, pair_modes
from operando.scaling.reciprocity import complexity, reciprocity_finding
from operando.scaling.uncertainty import covariance_of, scaled_covariance, shape_block, with_unseen_change
from operando.threads import one_blas_thread

KAPPA_LARGE = 100.0
"""κ from which sensors are said to be badly placed."""

LARGEST = 1e50
"""Size of a shape beyond which its fourth power, as MAC needs it, may leave the range of a double; no unit makes such a number."""


def scale_operational(idle: ModalModel, operating: ModalModel, threshold: float = 0.7, method: str = "auto") -> HybridModel:
    """Carry the scale of the idle modes over to the operational ones (Shen & Lu 2024).

    Parameters
    ----------
    idle : ModalModel
        Real shapes of unit modal mass; its residual terms are carried over.
    operating : ModalModel
        Complex shapes of arbitrary scale.
    threshold : float
        ε of Eq 1: MAC from which a mode counts as unchanged.
    method : str
        ``auto`` chooses by evidence and says why. By name (equations of Shen & Lu 2024; derivations in the documentation, "Scaling"):

        - ``msf_all``: all modes by modal scale factor onto their idle partner (Eq 2, 3);
        - ``sqrt_mac``: the same over √MAC, so that each shape has the length of its idle partner (this project);
        - ``eq13``, ``eq15``: modes of the same shape by MSF, changed ones to unit modal mass with the condensed mass of the idle shapes,
          one by one (Eq 13), or together by the principal square root (Eq 15);
        - ``eq20``: root and inversion exchanged, over all modes (Eq 20);
        - ``idle_shapes``: idle shapes with the operational poles, for modes whose shapes stay;
        - ``expansion``, ``expansion_stiffness``: expansion in the idle modes weighted by a prior, with mass or stiffness as idle (this
          project).

        The intervals of ``msf_all``, ``eq13``, ``eq15``, ``eq20`` and ``idle_shapes`` hold noise only, not the error of what the method
        assumes, and are too narrow where the shapes changed; the model says so in a finding.

    Returns
    -------
    HybridModel

    Raises
    ------
    ConfigError
        If method or threshold is wrong.
    DataError
        If the idle model is not scaled, or the models have no DOF in common.
    IdentificationError
        If a method asked for by name cannot be applied.

    Examples
    --------
    >>> import numpy as np, operando
    >>> idle = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> operating = operando.ModalModel([21.0, 45.0], [0.01, 0.02], np.array([[2, 3], [2, -3]]), "1+Z, 2+Z", "unscaled")
    >>> operando.scale_operational(idle, operating)
    <HybridModel: 2 operational modes at 2 DOFs; scaled by expansion; 2 unchanged>
    """
    expect(idle, ModalModel, "idle modes are needed first", "fit_ema(frf) gives them")
    expect(operating, ModalModel, "operational modes are needed second", "fit_oma(record) gives them")
    threshold = number_of(threshold, "threshold", "give a MAC value above 0 and up to 1")
    if not isinstance(method, str) or method not in ("auto", *METHODS):
        raise ConfigError(f"scaling method {method!r:.60} is none of {', '.join(('auto', *METHODS))}", hint="auto chooses one")
    if idle.scaling != "unit_modal_mass":
        raise DataError(
            "the idle modes are not scaled to unit modal mass, so there is no scale to carry over",
            hint="give the units of force and response ([units] or [channels]) and a drive point to the EMA",
        )
    for name, model in (("idle", idle), ("operational", operating)):
        _check_size(name, model)
    with one_blas_thread():
        return _scale(idle, operating, threshold, method)


def _check_size(name: str, model: ModalModel) -> None:
    """Shapes whose squares and products are numbers."""
    size = np.max(np.abs(model.shapes), axis=0, initial=0.0)
    wrong = np.flatnonzero(~(np.isfinite(size) & (size > 1 / LARGEST) & (size < LARGEST)))
    if wrong.size:
        raise DataError(
            f"the {name} shape of the mode at {model.frequencies_hz[wrong[0]]:g} Hz has the size {size[wrong[0]]:.3g}; "
            f"between {1 / LARGEST:g} and {LARGEST:g} is expected",
            hint="check the units and sensitivities of the channels, or the numbers in the file",
        )


def _scale(idle: ModalModel, operating: ModalModel, threshold: float, method: str) -> HybridModel:
    findings: list[Finding] = []
    dofs, idle_rows, (rows, signs) = common_dofs(idle, operating, findings)
    terms, real_idle = idle.terms, np.arange(idle.n_modes)
    proper = operating.without_residuals()
    e = np.asarray(terms.shapes, float)[idle_rows]
    o = np.asarray(proper.shapes)[rows] * signs[:, None]
    if proper.n_modes == 0 or real_idle.size == 0:
        raise DataError("a model without modes cannot be paired")
    if not np.all(np.isfinite(o)) or np.any(np.max(np.abs(o), axis=0) == 0):
        raise DataError("an operational shape is zero or not finite at the common DOFs")
    in_band = np.asarray(idle.in_band)
    pairing = pair_modes(e[:, real_idle], idle.frequencies_hz, o, proper.frequencies_hz, threshold, in_band)
    findings += [_conflict(text) for text in pairing.conflicts]
    one_factor = sampling_rate_finding(pairing, idle, proper)
    if one_factor is not None:
        findings.append(one_factor)
    if idle.coupling is not None:
        findings.append(
            Finding(
                "complex_idle_modes",
                "the idle model has damping that ties its modes to each other",
                "info",
                consequence="the hybrid route holds real modes and leaves it out: its operational FRFs are those of modal damping",
                action="compare with the FRFs of the model with effects (`operando ofrf --route effect`, `Model.frf`), which have it",
            )
        )
    basis = _basis(e[:, real_idle], idle.frequencies_hz, in_band, dofs, findings, _more_dofs(idle, idle_rows))
    turned, factor = real_shapes(o)
    noise = _noise(proper, rows, signs, factor)
    partners = pairing.partners
    task = Task(
        partners,
        np.array([p.kind in ("unchanged", "beyond_idle_band") for p in pairing.pairs], bool),
        np.zeros(0, int) if basis is None else basis.modes,
        np.asarray(terms.frequencies_hz),
        np.asarray(proper.frequencies_hz),
        make_prior(
            e,
            terms.frequencies_hz,
            turned,
            proper.frequencies_hz,
            proper.damping_ratios,
            partners,
            None if noise is None else noise[0],
            _hz_noise(proper),
            None if terms.shape_std is None else np.asarray(terms.shape_std, float)[idle_rows],
        ),
    )
    shapes, refused = _all_methods(method, e, o, task)
    if method == "auto":
        choice = choose_method(e, o, task, basis, np.array([p.mac for p in pairing.pairs]), set(shapes))
        findings += choice.findings
    else:
        choice = Choice(method, f"asked for: {IN_WORDS[method]}", {})
        findings += noise_only(method)
    alike = [p for p in pairing.pairs if p.idle is not None and p.kind != "changed"]
    at_rest = np.array([p.idle for p in alike], int)
    shift = common_shift(idle.frequencies_hz[at_rest], np.array([proper.frequencies_hz[p.operating] for p in alike]))
    kept = "stiffness" if choice.method == "expansion_stiffness" else "mass"
    participation = expand(e, turned, task.prior)[0] * (np.asarray(terms.frequencies_hz)[:, None] if kept == "stiffness" else 1)
    left = part_left(participation)
    carried, text = _carried_over(idle, real_idle, pairing, shift, left, findings)
    risen = [np.log(proper.frequencies_hz[p.operating] / idle.frequencies_hz[p.idle]) for p in alike]
    held = np.setdiff1d(real_idle, carried)
    missing = missing_modes(participation, terms.frequencies_hz, held, operating.band_hz, sum(risen) >= 0)
    if missing.finding is not None:
        findings.append(missing.finding)
        text += f"; beyond the band: {missing.text}"
    amount = np.where(terms.residual[carried], 1.0, np.sqrt(left[carried]))
    models = {name: _assemble(idle, proper, dofs, idle_rows, s, carried, amount, shift) for name, s in shapes.items()}
    doubt = scale_doubt(e, o, task, kept)
    covariance = scaled_covariance(choice.method, idle, proper, idle_rows, rows, signs, task, carried)
    out = shapes[choice.method]
    if covariance is not None:
        lessening = np.concatenate([np.ones(covariance.shape[0] - carried.size * len(dofs)), np.repeat(amount, len(dofs))])
        covariance = covariance * np.outer(lessening, lessening)
        likely = flip_probability(e, turned, partners, None if noise is None else noise[0], idle, idle_rows, threshold)
        covariance = covariance + class_flips(choice.method, e, o, task, likely, covariance.shape[0], proper.n_modes + carried.size)
        imaginary = _unexplained_imaginary(o, out, None if noise is None else noise[1])
        change = shape_change(e[:, at_rest], out[:, [p.operating for p in alike]])
        lowest = idle.band_hz[0] if idle.band_hz else 0.0
        less = lessened(terms.frequencies_hz[carried], idle.frequencies_hz[at_rest], doubt.mass_share, lowest)
        covariance = with_unseen_change(
            covariance, models[choice.method], proper.n_modes, imaginary, shift.spread * less, change * less, doubt
        )
    models[choice.method] = replace(models[choice.method], covariance=covariance)
    models = {name: with_missing(model, missing, e) for name, model in models.items()}
    modal = models[choice.method]
    found = complexity(o, modal.terms.frequencies_hz, modal.terms.damping_ratios, modal.terms.shapes, None if noise is None else noise[1])
    skew = reciprocity_finding(found, proper.frequencies_hz)
    if skew is not None:
        findings.append(skew)
    return HybridModel(
        idle=idle,
        operating=operating,
        modal=modal,
        pairing=pairing,
        method=choice.method,
        reason=choice.reason,
        threshold=threshold,
        basis=basis,
        scales=np.sum(o.conj() * out, axis=0) / np.sum(np.abs(o) ** 2, axis=0),
        scale_std=_scale_std(modal, proper.n_modes),
        outside_span=_outside(e[:, real_idle], turned, basis),
        imaginary_share=found.share,
        alternatives=_alternatives(models, choice.method),
        alternative_models=models,
        residuals=text,
        evidence={**choice.evidence, "refused": refused},
        findings=tuple(findings),
    )


def _unexplained_imaginary(operating: NDArray[Any], scaled: NDArray[np.float64], noise: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Imaginary part (m, n) of the operational shapes on their principal axis, at the scale found, shrunk by what noise explains."""
    turned = operating * real_shapes(operating)[1]
    imaginary = turned.imag
    if noise is not None:
        own, expected = np.sum(imaginary**2, axis=0), np.sum(noise**2, axis=0)
        imaginary = imaginary * np.sqrt(np.maximum(1 - expected / np.maximum(own, 1e-300), 0))
    return np.asarray(imaginary * np.linalg.norm(scaled, axis=0) / np.linalg.norm(turned.real, axis=0))


def _all_methods(
    method: str, idle: NDArray[np.float64], operating: NDArray[Any], task: Task
) -> tuple[dict[str, NDArray[np.float64]], dict[str, str]]:
    """Shapes by every method that can be applied, and why the others cannot; one asked for by name must."""
    shapes: dict[str, NDArray[np.float64]] = {}
    refused: dict[str, str] = {}
    for name in METHODS:
        try:
            if task.basis.size == 0 and (name in ("eq13", "eq15", "eq20") or np.any(task.partners < 0)) and not name.startswith("exp"):
                raise IdentificationError("there is no condensed mass", hint="use expansion or msf_all")
            shapes[name] = scaled_shapes(name, idle, operating, task)
        except IdentificationError as error:
            if name == method:
                raise
            refused[name] = error.message
    if not shapes:
        raise IdentificationError("no scaling method can be applied", hint="; ".join(f"{k}: {v}" for k, v in refused.items()))
    return shapes, refused


def _noise(
    operating: ModalModel, rows: list[int], signs: NDArray[np.float64], factor: NDArray[np.complex128]
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Covariance (n, m, m) of the real part, and standard deviation (m, n) of the imaginary part, of shapes made real, of unit length."""
    covariance = covariance_of(operating)
    if covariance is None:
        return None
    blocks = shape_block(operating, rows)
    n, m = blocks[0].shape
    real, imag = np.zeros((n, m, m)), np.zeros((m, n))
    turn = np.outer(signs, signs)
    for r in range(n):
        a, b = factor[r].real, factor[r].imag
        re = covariance[np.ix_(blocks[0][r], blocks[0][r])] * turn
        if len(blocks) == 1:
            real[r] = abs(factor[r]) ** 2 * re
            continue
        im = covariance[np.ix_(blocks[1][r], blocks[1][r])] * turn
        both = covariance[np.ix_(blocks[0][r], blocks[1][r])] * turn
        real[r] = a * a * re + b * b * im - a * b * (both + both.T)
        imag[:, r] = np.sqrt(np.maximum(np.diag(b * b * re + a * a * im + a * b * (both + both.T)), 0))
    return real, imag


def _hz_noise(operating: ModalModel) -> NDArray[np.float64] | None:
    """Relative standard deviation of the operational frequencies."""
    covariance = covariance_of(operating)
    if covariance is None:
        return None
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance)[: operating.n_modes], 0)) / operating.frequencies_hz)


def _scale_std(modal: ModalModel, n: int) -> NDArray[np.float64] | None:
    """Relative standard deviation of the size ‖φ̂‖ of each operational shape."""
    if modal.covariance is None:
        return None
    m = len(modal.dofs)
    out = np.zeros(n)
    for r in range(n):
        at = slice(2 * modal.terms.n + r * m, 2 * modal.terms.n + (r + 1) * m)
        u = modal.shapes[:, r] / float(modal.shapes[:, r] @ modal.shapes[:, r])
        out[r] = np.sqrt(max(float(u @ modal.covariance[at, at] @ u), 0))
    return out


def _conflict(text: str) -> Finding:
    return Finding(
        "pairing_conflict",
        text,
        "warning",
        consequence="one of them is scaled as a changed mode",
        action="look at both shapes; reject one of the operational modes if it is no mode",
    )


def common_dofs(
    idle: ModalModel, operating: ModalModel, findings: list[Finding]
) -> tuple[tuple[Dof, ...], list[int], tuple[list[int], NDArray[np.float64]]]:
    """DOFs both models have, in the order and sense of the idle model; what is left out becomes a finding."""
    shared = DofIndex(idle.dofs).common(operating.dofs)
    rows = [i for i, _, _ in shared]
    if not rows:
        raise DataError("the idle and the operational modes have no DOF in common", hint="check the DOF labels of both measurements")
    dofs = tuple(idle.dofs[i] for i in rows)
    index, signs = [j for _, j, _ in shared], [sign for _, _, sign in shared]
    common = DofIndex(dofs)
    for name, model in (("idle", idle), ("in operation", operating)):
        missing = [str(d) for d in model.dofs if d not in common]
        if missing:
            findings.append(
                Finding(
                    "dof_not_common",
                    f"{len(missing)} DOFs measured {name} only: {first_few(missing, 12)}",
                    "info",
                    consequence="they are left out of the operational FRFs",
                    action="measure the same DOFs, idle and in operation",
                )
            )
    return dofs, rows, (index, np.asarray(signs, float))


def _more_dofs(idle: ModalModel, rows: list[int]) -> Callable[[CondensedBasis], str]:
    """Words on which DOF to measure as well: one whose idle shape is known, or where to look for one."""

    def advice(basis: CondensedBasis) -> str:
        found = best_addition(np.asarray(idle.shapes, float), rows, basis.modes)
        if found is not None and found[1] < 0.9 * basis.kappa:
            return f"measure {idle.dofs[found[0]]} in operation as well: κ falls to {found[1]:.0f}"
        return "add a sensor where these shapes differ most, or leave one of the modes out"

    return advice


def _basis(
    shapes: NDArray[np.float64],
    hz: NDArray[np.float64],
    in_band: NDArray[np.bool_],
    dofs: tuple[Dof, ...],
    findings: list[Finding],
    advice: Callable[[CondensedBasis], str],
) -> CondensedBasis | None:
    try:
        basis = condensed_basis(shapes, hz, in_band)
    except IdentificationError as error:
        findings.append(
            Finding(
                "ill_conditioned",
                f"no condensed mass: {error.message}",
                "warning",
                consequence="the methods of Eq 13, 15 and 20 are left out",
                action=error.hint or "",
            )
        )
        return None
    if basis.kappa > KAPPA_LARGE or basis.left_out:
        left = f"; {len(basis.left_out)} idle modes in band do not fit on {len(dofs)} DOFs" if basis.left_out else ""
        findings.append(
            Finding(
                "ill_conditioned",
                f"κ of the idle shapes is {basis.kappa:.0f}{left}",
                "warning" if basis.kappa > KAPPA_LARGE else "info",
                dof=", ".join(str(dofs[i]) for i in basis.weak_dofs),
                consequence="errors of the shapes grow up to 2κ times in the condensed mass (Eq 16–19)",
                action="the sensors hardly tell apart the idle modes at "
                + ", ".join(f"{hz[j]:.2f}" for j in basis.weak_modes)
                + f" Hz: {advice(basis)}",
            )
        )
    return basis


def _outside(idle: NDArray[np.float64], turned: NDArray[np.float64], basis: CondensedBasis | None) -> NDArray[np.float64]:
    if basis is None:
        return np.ones(turned.shape[1])
    used = idle[:, basis.modes]
    rest = turned - used @ (np.linalg.pinv(used) @ turned)
    return np.linalg.norm(rest, axis=0) / np.linalg.norm(turned, axis=0)


def _carried_over(
    idle: ModalModel,
    real_idle: NDArray[np.int_],
    pairing: Pairing,
    shift: CommonShift,
    left: NDArray[np.float64],
    findings: list[Finding],
) -> tuple[NDArray[np.int_], str]:
    """Idle terms that stand in the OFRF: residual terms, and modes no operational mode was found for; moved as the others moved."""
    residual = np.flatnonzero(idle.terms.residual)
    # A partner may only look alike at the sensors and hold nothing of the mode.
    lone = np.isin(np.arange(real_idle.size), pairing.idle_without_partner) | (left[real_idle] > NOT_HELD)
    every = real_idle[lone]
    alone, gone = every[left[every] >= LEAST_LEFT], every[left[every] < LEAST_LEFT]
    inside = np.asarray(idle.in_band)[alone]
    parts = []
    if residual.size:
        parts.append(f"{residual.size} residual modes of the idle model (" + _hz(idle, residual) + ")")
    if np.any(~inside):
        parts.append(f"{int(np.sum(~inside))} idle modes beyond the band (" + _hz(idle, alone[~inside]) + ")")
    if np.any(inside):
        parts.append(f"{int(np.sum(inside))} idle modes in band without an operational mode (" + _hz(idle, alone[inside]) + ")")
        findings.append(
            Finding(
                "mode_not_found",
                "no operational mode was found for the idle modes at " + _hz(idle, alone[inside]),
                "warning",
                consequence="they stand in the operational FRFs as they are in the idle state, but for a shift common to all modes",
                action="look at the stabilisation diagram of the OMA; measure longer or excite them",
            )
        )
    moved = "as idle"
    if shift.logarithm:
        moved = f"with frequencies times {shift.factor:.4f}, as the {shift.pairs} highest pairs moved"
    text = f"retained {moved}: " + "; ".join(parts) if parts else "none: the idle model has no residual modes"
    if gone.size:
        text += f"; not retained: {gone.size} idle modes that are spread over operational ones (" + _hz(idle, gone) + ")"
    return np.concatenate([residual, alone]).astype(int), text


def _hz(model: ModalModel, index: NDArray[np.int_]) -> str:
    return ", ".join(f"{f:.2f}" for f in model.terms.frequencies_hz[index]) + " Hz"


def _assemble(
    idle: ModalModel,
    operating: ModalModel,
    dofs: tuple[Dof, ...],
    rows: list[int],
    shapes: NDArray[np.float64],
    carried: NDArray[np.int_],
    amount: NDArray[np.float64],
    shift: CommonShift,
) -> ModalModel:
    terms = idle.terms
    return ModalModel(
        operating.frequencies_hz,
        operating.damping_ratios,
        shapes,
        dofs,
        "unit_modal_mass",
        ResidualTerms(
            terms.frequencies_hz[carried] * shift.factor,
            terms.damping_ratios[carried],
            np.asarray(terms.shapes)[rows][:, carried] * amount,
            terms.signs[carried],
        ),
        operating.in_band,
        band_hz=operating.band_hz or idle.band_hz,
        si=idle.si,
        provenance=Provenance.merge(idle.provenance, operating.provenance).then("scale_operational"),
    )


def _alternatives(models: dict[str, ModalModel], chosen: str) -> dict[str, float | None]:
    """Largest difference in dB over lines and pairs, on 400 lines of the band; None where a method cannot be applied."""
    model = models[chosen]
    real = model.frequencies_hz
    low, high = model.band_hz or (real.min() * 0.8, real.max() * 1.1)
    lines = np.linspace(max(low, 1e-3), high, 400)
    base = np.abs(model.frf(lines, variance=False).data)
    out: dict[str, float | None] = {}
    for name in METHODS:
        if name == chosen:
            continue
        if name not in models:
            out[name] = None
            continue
        other = np.abs(models[name].frf(lines, variance=False).data)
        good = (base > 0) & (other > 0)
        out[name] = float(np.max(np.abs(20 * np.log10(other[good] / base[good])))) if np.any(good) else None
    return out

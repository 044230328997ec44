"""What the method makes of exact modes: the error of the OFRFs of every scaling, as in the layout study, then with residuals.

The reference is the sum over the 70 lowest exact modes of the target. Errors are rms of dB over 10–220 Hz in steps of 0.1 Hz, the mean
over the outputs B, C, D and the mass (z) for the input A.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from tripod import DOFS, MASS_NODE, A, B, C, D, Modes

from operando.data import ModalModel
from operando.dof import Dof
from operando.indicators import mac
from operando.scaling import METHODS, HybridModel, scale_operational

Array = np.ndarray

DAMPING = 0.01
LINES = np.arange(100, 2201) / 10
KEPT = 70
FIRST, IN_BAND, BEYOND = 1, 19, 6
"""The 3 Hz mode (0) is left out; 19 modes, and the 6 next higher ones."""
EPSILON = {"case 1": 0.75, "case 2": 0.70}
OUTPUTS = (f"{B}+Z", f"{C}+Z", f"{D}+Z", f"{MASS_NODE}+Z")
INPUT = f"{A}+Z"


def rows_of(labels: tuple[str, ...]) -> list[int]:
    """Rows of ``DOFS``."""
    return [DOFS.index(label) for label in labels]


def accelerance(hz: Array, shapes: Array, lines: Array, outputs: tuple[str, ...] = OUTPUTS, source: str = INPUT) -> Array:
    """Sum over modes of 1 % damping, (outputs, lines) in (m/s²)/N."""
    w, wr = 2 * np.pi * lines, 2 * np.pi * hz[:, None]
    gain = -(w**2) / (wr**2 - w**2 + 2j * DAMPING * wr * w)
    return (shapes[rows_of(outputs)] * shapes[rows_of((source,))]) @ gain


def error_db(model: Array, reference: Array) -> float:
    """Mean over outputs of the rms of dB over lines."""
    return float(np.mean(np.sqrt(np.mean((20 * np.log10(np.abs(model) / np.abs(reference))) ** 2, axis=-1))))


def idle_model(modes: Modes, chosen: slice, residual: Array | None = None, in_band: Array | None = None) -> ModalModel:
    """Exact modes as EMA would give them."""
    hz = modes.hz[chosen]
    dofs = tuple(Dof.parse(d) for d in DOFS)
    return ModalModel.from_terms(
        hz, np.full(hz.size, DAMPING), modes.shapes[:, chosen], dofs, "unit_modal_mass", residual=residual, in_band=in_band, si=True
    )


def operating_model(modes: Modes, chosen: slice, seed: int = 1) -> ModalModel:
    """Exact modes as OMA would give them: complex, of a size and phase that mean nothing."""
    hz = modes.hz[chosen]
    rng = np.random.default_rng(seed)
    scale = rng.uniform(0.1, 10, hz.size) * np.exp(2j * np.pi * rng.uniform(size=hz.size))
    dofs = tuple(Dof.parse(d) for d in DOFS)
    return ModalModel(hz, np.full(hz.size, DAMPING), modes.shapes[:, chosen] * scale, dofs, "unscaled")


def principal_root(shapes: Array, idle: Array) -> Array:
    """Eq 15 = Eq 20 on all columns at the scale they have: Φ(ΦᵀMΦ)^(−1/2)."""
    q = np.linalg.pinv(idle) @ shapes
    value, vector = np.linalg.eigh(q.T @ q)
    return shapes @ (vector * value**-0.5) @ vector.T


@dataclass(frozen=True)
class ExactStudy:
    """One case with exact modes.

    Parameters
    ----------
    hybrid : HybridModel
        19 operational modes on 19 idle ones.
    as_stated : dict
        Row of the error table → rms dB.
    with_residuals : dict
        Method → rms dB, with 25 operational modes and the idle model's other exact modes as residual modes.
    floor_with_residuals : float
        The exact operational modes with the same residual modes.
    residual_hybrid : HybridModel
    """

    hybrid: HybridModel
    as_stated: dict[str, float]
    with_residuals: dict[str, float]
    floor_with_residuals: float
    residual_hybrid: HybridModel


def tail_shapes(idle: Modes, target: Modes) -> Array:
    """The 6 modes beyond the 19, scaled by MSF onto the nearest idle shapes (Eq 2, 3)."""
    beyond = slice(FIRST + IN_BAND, FIRST + IN_BAND + BEYOND)
    shapes = target.shapes[:, beyond]
    nearest = idle.shapes[:, FIRST:][:, np.argmax(mac(idle.shapes[:, FIRST:], shapes), axis=0)]
    return shapes * np.sum(nearest * shapes, axis=0) / np.sum(shapes**2, axis=0)


def study(idle: Modes, target: Modes, case: str) -> ExactStudy:
    """The error table of one case."""
    reference = accelerance(target.hz[:KEPT], target.shapes[:, :KEPT], LINES)
    band, all_25 = slice(FIRST, FIRST + IN_BAND), slice(FIRST, FIRST + IN_BAND + BEYOND)
    tail = tail_shapes(idle, target)
    e, exact = idle.shapes[:, band], target.shapes[:, band]

    def error(shapes: Array) -> float:
        return error_db(accelerance(target.hz[all_25], np.hstack([shapes, tail]), LINES), reference)

    at_rest, running = idle_model(idle, band), operating_model(target, band)
    hybrid = scale_operational(at_rest, running, EPSILON[case])
    by_method = {name: np.asarray(model.shapes)[:, :IN_BAND] for name, model in hybrid.alternative_models.items()}
    changed = np.array([pair.kind == "changed" for pair in hybrid.pairing.pairs])
    rows = {name: error(by_method[name]) for name in METHODS if name in by_method}
    rows["auto"] = error(np.asarray(hybrid.modal.shapes)[:, :IN_BAND])
    rows["idle_by_order"] = error(e)
    rows["idle_by_best_mac"] = error(e[:, np.argmax(mac(e, exact), axis=0)])
    every = scale_operational(at_rest, running, 1.0, "eq15").modal
    rows["root_of_all"] = error(np.asarray(every.shapes)[:, :IN_BAND])
    # The same root on shapes whose largest element is 1, as OMA programs give them: the result depends on that choice.
    unit = principal_root(exact / np.max(np.abs(exact), axis=0), e)
    rows["root_of_all, largest element 1"] = error(unit)
    rows["eq20, largest element 1"] = error(np.where(changed, unit, by_method["eq13"]))
    rows["perfect"] = error(np.where(changed, exact, by_method["msf_all"]))
    rows["truncated"] = error_db(accelerance(target.hz[all_25], target.shapes[:, all_25], LINES), reference)

    in_band = np.isin(np.arange(min(KEPT, idle.hz.size)), np.arange(FIRST, FIRST + IN_BAND))
    richer = scale_operational(idle_model(idle, slice(0, KEPT), in_band=in_band), operating_model(target, all_25), EPSILON[case])
    residuals = {
        name: error_db(model.frf(LINES, OUTPUTS, (INPUT,), variance=False).data[:, 0], reference)
        for name, model in richer.alternative_models.items()
    }
    residuals["auto"] = residuals[richer.method]
    terms = richer.modal.terms
    carried = terms.residual
    hz = np.concatenate([target.hz[all_25], terms.frequencies_hz[carried]])
    shapes = np.hstack([target.shapes[:, all_25], np.asarray(terms.shapes)[:, carried]])
    return ExactStudy(hybrid, rows, residuals, error_db(accelerance(hz, shapes, LINES), reference), richer)

"""Rigid-body mass of a freely suspended structure, from what its model holds below the band: a check of the scale by a weighing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from operando.data import ModalModel
from operando.dof import Dof, parse_dofs
from operando.errors import DataError


@dataclass(frozen=True)
class RigidBodyMass:
    """Apparent mass of a structure that moves as a rigid body.

    Parameters
    ----------
    mass_kg : float
        Force over acceleration at the drive point [kg]; the mass of the structure where the force acts through its centre of mass.
    std_kg : float or None
        Standard deviation [kg] from the covariance of the model; None where there is none.
    frequency_hz : float
        Where it was taken [Hz].
    n_modes : int
        Modes below the band that it is the sum of.
    """

    mass_kg: float
    std_kg: float | None
    frequency_hz: float
    n_modes: int


def rigid_body_mass(model: ModalModel, dof: Dof | str, frequency_hz: float | None = None) -> RigidBodyMass:
    """Apparent mass 1/|H| of the modes below the band at a drive point.

    The flexible modes are left out, so the figure holds up to the first of them, where 1/|H| of the measured FRF does not.

    Parameters
    ----------
    model : ModalModel
        Of unit modal mass; residual modes below the band, and modes fitted below it, are used.
    dof : Dof or str
        Drive point.
    frequency_hz : float, optional
        Where to take it [Hz]; default: the lower edge of the band. Close above a mode of the suspension the figure is that of the
        suspension, not of the body.

    Returns
    -------
    RigidBodyMass

    Raises
    ------
    DataError
        If the shapes are not scaled, the model states no band, or it holds nothing below the band at this DOF (a structure on ground).
    DofError
        If the DOF is not in the model.

    Examples
    --------
    >>> import numpy as np, operando
    >>> from operando.ema import rigid_body_mass
    >>> body = operando.ResidualTerms(np.array([0.5]), np.array([0.01]), np.array([[0.5]]))  # 4 kg on soft springs
    >>> model = operando.ModalModel([60.0], [0.01], np.array([[0.1]]), "1+Z", "unit_modal_mass", residuals=body, band_hz=(10.0, 90.0))
    >>> round(rigid_body_mass(model, "1+Z").mass_kg, 1)
    4.0
    """
    if model.scaling != "unit_modal_mass" or not model.si:
        raise DataError(
            "shapes of arbitrary scale have no mass",
            where=str(dof),
            hint="give acceleration and force in [units], and measure a drive point",
        )
    if model.band_hz is None:
        raise DataError("the model states no band, so nothing is known to lie below it", hint="fit it with a band")
    edge = float(model.band_hz[0])
    at = edge if frequency_hz is None else float(frequency_hz)
    if not at > 0:
        raise DataError(f"no apparent mass at {at:g} Hz", hint="give a frequency above 0")
    below = np.asarray(model.terms.frequencies_hz < edge)
    point = parse_dofs((dof,))
    if not below.any() or not np.any(model.select_terms(below).terms.rows(point)):
        raise DataError(
            f"the model holds no mode below {edge:g} Hz that moves {point[0]}",
            hint="only a softly suspended structure has a rigid-body mass; widen the FRFs downwards",
        )
    part = model.select_terms(below).frf([at], point, point)
    size = float(np.abs(part.data[0, 0, 0]))
    # H is real to within the small damping down there, so that E|ΔH|² is the variance of |H|.
    std = None if part.variance is None else float(np.sqrt(part.variance[0, 0, 0])) / size**2
    return RigidBodyMass(1 / size, std, at, int(below.sum()))

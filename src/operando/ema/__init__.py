"""Experimental modal analysis: candidate poles, maximum-likelihood fit of real modes, residual modes, comparison with sdypy-EMA."""

from operando.data import explain_arguments
from operando.ema.by_hand import poles_by_hand as poles_by_hand
from operando.ema.by_hand import without_doubts as without_doubts
from operando.ema.candidates import Candidate, candidate_poles, stabilization_diagram
from operando.ema.details import EmaDetails
from operando.ema.fit import fit_ema
from operando.ema.indicator_functions import cmif, mmif
from operando.ema.lsfd import lsfd
from operando.ema.plscf import OrderPoles, plscf
from operando.ema.rigid_body import RigidBodyMass, rigid_body_mass
from operando.ema.second_opinion import second_opinion
from operando.ema.spectra import excited_limits
from operando.indicators import mac, mean_phase_deviation, phase_collinearity

__all__ = [
    "Candidate",
    "EmaDetails",
    "OrderPoles",
    "RigidBodyMass",
    "candidate_poles",
    "cmif",
    "excited_limits",
    "fit_ema",
    "lsfd",
    "mac",
    "mean_phase_deviation",
    "mmif",
    "phase_collinearity",
    "plscf",
    "rigid_body_mass",
    "second_opinion",
    "stabilization_diagram",
]

explain_arguments(__name__)

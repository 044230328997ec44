"""Level-dependent effects from records with measured force: reverse path with the idle model known, closed-loop simulation."""

from operando.nonlinear.apply import AppliedToRecords, apply_to_records
from operando.nonlinear.equivalent import linear_effects
from operando.nonlinear.levels import at_level
from operando.nonlinear.periodic import PeriodicResponse, best_linear_approximation
from operando.nonlinear.records import diagnose_records, measured_distortion
from operando.nonlinear.result import NonlinearDiagnosis
from operando.nonlinear.simulate import has_restoring_force, simulate
from operando.nonlinear.single import SingleFit, fit_single
from operando.nonlinear.travel import LoopFit, fit_loop

__all__ = [
    "AppliedToRecords",
    "LoopFit",
    "NonlinearDiagnosis",
    "PeriodicResponse",
    "SingleFit",
    "apply_to_records",
    "at_level",
    "best_linear_approximation",
    "diagnose_records",
    "fit_loop",
    "fit_single",
    "has_restoring_force",
    "linear_effects",
    "measured_distortion",
    "simulate",
]

"""Level-dependent effects from records with measured force: reverse path with the idle model known, laws in the closed loop.

Beside what :mod:`operando.diagnosis` names, the parts that the search is made of.
"""

from operando.diagnosis.records.apply import apply_to_records
from operando.diagnosis.records.case import RecordsCase, Sets, contradicted, make_case
from operando.diagnosis.records.closed_loop import closed_loop_force, followed, groups, loop_for, recorded
from operando.diagnosis.records.conclude import beside_others, conclude, too_fast
from operando.diagnosis.records.day import Day
from operando.diagnosis.records.detect import Detection
from operando.diagnosis.records.diagnose import diagnose_records, measured_distortion
from operando.diagnosis.records.fit_laws import fit_law, linear_law
from operando.diagnosis.records.hold_out import DISCREPANCY
from operando.diagnosis.records.refine import of_all_runs, own_values, refined, std_of, stepped
from operando.diagnosis.records.result import FoundLaws, RecordsApplied, RecordsDiagnosis
from operando.diagnosis.records.spot import Spot, examine, rank_places, weighed
from operando.diagnosis.records.steps import SearchStep, Tried, settle_law
from operando.diagnosis.records.surface import parity

__all__ = [
    "DISCREPANCY",
    "Day",
    "Detection",
    "FoundLaws",
    "RecordsApplied",
    "RecordsCase",
    "RecordsDiagnosis",
    "SearchStep",
    "Sets",
    "Spot",
    "Tried",
    "apply_to_records",
    "beside_others",
    "closed_loop_force",
    "conclude",
    "contradicted",
    "diagnose_records",
    "examine",
    "fit_law",
    "followed",
    "groups",
    "linear_law",
    "loop_for",
    "make_case",
    "measured_distortion",
    "of_all_runs",
    "own_values",
    "parity",
    "rank_places",
    "recorded",
    "refined",
    "settle_law",
    "std_of",
    "stepped",
    "too_fast",
    "weighed",
]

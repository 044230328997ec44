"""Finding the missing physics: one statistical model of a check, a search over effects, and what the data allow to say."""

from __future__ import annotations

from operando.data import explain_arguments
from operando.diagnosis.applied import Applied
from operando.diagnosis.by_hand import apply_effects
from operando.diagnosis.complex_idle import with_complex_modes
from operando.diagnosis.from_frf import diagnose, diagnose_frf
from operando.diagnosis.from_modes import diagnose_modes
from operando.diagnosis.records import RecordsApplied, RecordsDiagnosis, apply_to_records, diagnose_records, measured_distortion
from operando.diagnosis.result import Diagnosis

__all__ = [
    "Applied",
    "Diagnosis",
    "RecordsApplied",
    "RecordsDiagnosis",
    "apply_effects",
    "apply_to_records",
    "diagnose",
    "diagnose_frf",
    "diagnose_modes",
    "diagnose_records",
    "measured_distortion",
    "with_complex_modes",
]

explain_arguments(__name__)

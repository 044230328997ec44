"""Finding the missing physics: one statistical model of a check, a search over effects, and what the data allow to say."""

from __future__ import annotations

from operando.diagnose import Diagnosis
from operando.diagnosis.from_frf import diagnose, diagnose_frf

__all__ = ["Diagnosis", "diagnose", "diagnose_frf"]

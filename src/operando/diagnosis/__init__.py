"""Finding the missing physics: one statistical model of a check, a search over effects, and what the data allow to say."""

from __future__ import annotations

from operando.diagnosis.by_hand import Applied, apply_effects
from operando.diagnosis.from_frf import diagnose, diagnose_frf
from operando.diagnosis.from_modes import diagnose_modes
from operando.diagnosis.result import Diagnosis

__all__ = ["Applied", "Diagnosis", "apply_effects", "diagnose", "diagnose_frf", "diagnose_modes"]

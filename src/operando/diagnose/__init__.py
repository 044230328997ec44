"""Finding the missing physics: the idle model with effects added, where it fails, and what is missing."""

from __future__ import annotations

from operando.diagnose.apply import Applied, apply_effects
from operando.diagnose.diagnosis import Diagnosis, diagnose
from operando.diagnose.model import Model, joint_covariance

__all__ = ["Applied", "Diagnosis", "Model", "apply_effects", "diagnose", "joint_covariance"]

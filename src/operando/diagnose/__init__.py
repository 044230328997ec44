"""Finding the missing physics: the idle model with effects added, where it fails, and what is missing."""

from __future__ import annotations

from operando.diagnose.model import Model, joint_covariance

__all__ = ["Model", "joint_covariance"]

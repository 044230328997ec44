"""The structure as it runs: the idle model with effects added, its FRFs, modes, and motion in time."""

from __future__ import annotations

from operando.data import explain_arguments
from operando.structure.added_mass import with_masses
from operando.structure.force_law import ForceLaw, has_restoring_force
from operando.structure.linearization import LinearEquivalent, at_level, linear_effects
from operando.structure.model import Model
from operando.structure.time_domain import simulate

__all__ = ["ForceLaw", "LinearEquivalent", "Model", "at_level", "has_restoring_force", "linear_effects", "simulate", "with_masses"]

explain_arguments(__name__)

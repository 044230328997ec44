"""The structure as it runs: the idle model with effects added."""

from __future__ import annotations

from operando.structure.model import Model

__all__ = ["Model"]

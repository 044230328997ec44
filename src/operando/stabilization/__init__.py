"""Stabilisation diagrams, automatic mode selection, reasons of rejected poles (shared by EMA and OMA)."""

from operando.stabilization.table import STATUS, PoleTable, RejectedPole, Stabilization

__all__ = ["STATUS", "PoleTable", "RejectedPole", "Stabilization"]

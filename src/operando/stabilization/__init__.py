"""Stabilisation diagrams, automatic mode selection, reasons of rejected poles (shared by EMA and OMA)."""

from operando.data import explain_arguments
from operando.stabilization.classify import classify, stability_letters
from operando.stabilization.select import HAND_TOLERANCE, select_modes, track_poles
from operando.stabilization.select import demote as demote
from operando.stabilization.table import STATUS, PoleTable, RejectedPole, Stabilization, Tolerances

__all__ = [
    "HAND_TOLERANCE",
    "STATUS",
    "PoleTable",
    "RejectedPole",
    "Stabilization",
    "Tolerances",
    "classify",
    "select_modes",
    "stability_letters",
    "track_poles",
]

explain_arguments(__name__)

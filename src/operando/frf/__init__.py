"""FRF estimation: H1, H2, Hv, several references, hammer hits, local rational models, checks."""

from operando.data import explain_arguments
from operando.frf.checks import (
    check_drive_points,
    check_frf,
    in_one_sense,
    opposed_dofs,
    power_signs,
    reciprocity_error,
    reversing,
)
from operando.frf.estimate import estimate_frf
from operando.frf.excitation import is_periodic
from operando.frf.given import merge_frfs
from operando.frf.hits import Hits, find_hits, hits_of, is_impact, without_hits
from operando.frf.leakage import Peak, resonance_peaks
from operando.frf.periodic import PeriodicFrf, SteadyPeriods, periodic_frf, steady_periods
from operando.frf.rational import LocalRational, local_rational
from operando.frf.runs import RunEstimate, merge_runs
from operando.frf.spectra import CrossSpectra, cross_spectra, effective_averages
from operando.frf.usable import channel_faults, trimmed, usable_channels, whole
from operando.limits import IMPACT_WINDOWS, WINDOWS

__all__ = [
    "IMPACT_WINDOWS",
    "WINDOWS",
    "CrossSpectra",
    "Hits",
    "LocalRational",
    "Peak",
    "PeriodicFrf",
    "RunEstimate",
    "SteadyPeriods",
    "channel_faults",
    "check_drive_points",
    "check_frf",
    "cross_spectra",
    "effective_averages",
    "estimate_frf",
    "find_hits",
    "hits_of",
    "in_one_sense",
    "is_impact",
    "is_periodic",
    "local_rational",
    "merge_frfs",
    "merge_runs",
    "opposed_dofs",
    "periodic_frf",
    "power_signs",
    "reciprocity_error",
    "resonance_peaks",
    "reversing",
    "steady_periods",
    "trimmed",
    "usable_channels",
    "whole",
    "without_hits",
]

explain_arguments(__name__)

"""FRF estimation: H1, H2, Hv, several references, hammer hits, local rational models, checks."""

from operando.data import explain_arguments
from operando.frf.checks import check_drive_points, check_frf, reciprocity_error
from operando.frf.checks import in_one_sense as in_one_sense
from operando.frf.checks import opposed_dofs as opposed_dofs
from operando.frf.checks import power_signs as power_signs
from operando.frf.checks import reversing as reversing
from operando.frf.checks import with_fewer_references as with_fewer_references
from operando.frf.estimate import estimate_frf
from operando.frf.excitation import is_periodic
from operando.frf.given import merge_frfs
from operando.frf.hits import Hits, find_hits, is_impact
from operando.frf.hits import hits_of as hits_of
from operando.frf.hits import without_hits as without_hits
from operando.frf.leakage import Peak, resonance_peaks
from operando.frf.periodic import PeriodicFrf, SteadyPeriods, periodic_frf, steady_periods
from operando.frf.rational import LocalRational, local_rational
from operando.frf.runs import RunEstimate, merge_runs
from operando.frf.spectra import CrossSpectra, cross_spectra, effective_averages
from operando.frf.usable import channel_faults as channel_faults
from operando.frf.usable import trimmed as trimmed
from operando.frf.usable import usable_channels
from operando.frf.usable import whole as whole
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
    "check_drive_points",
    "check_frf",
    "cross_spectra",
    "effective_averages",
    "estimate_frf",
    "find_hits",
    "is_impact",
    "is_periodic",
    "local_rational",
    "merge_frfs",
    "merge_runs",
    "periodic_frf",
    "reciprocity_error",
    "resonance_peaks",
    "steady_periods",
    "usable_channels",
]

explain_arguments(__name__)

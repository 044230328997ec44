"""Raw-data checks: findings with numbers, never silent deletion."""

from operando.data import explain_arguments
from operando.quality.between import check_gains, check_shapes, check_states
from operando.quality.overview import SHOWN_CHANNELS, Overview, Pulse, densities, overview, pulses
from operando.quality.record import check_channels, check_forces, check_record, check_runs, dissipated_shares
from operando.quality.samples import constant_runs, dropouts, not_finite, overload, pile_up, soft_clipping

__all__ = [
    "SHOWN_CHANNELS",
    "Overview",
    "Pulse",
    "check_channels",
    "check_forces",
    "check_gains",
    "check_record",
    "check_runs",
    "check_shapes",
    "check_states",
    "constant_runs",
    "densities",
    "dissipated_shares",
    "dropouts",
    "not_finite",
    "overload",
    "overview",
    "pile_up",
    "pulses",
    "soft_clipping",
]

explain_arguments(__name__)

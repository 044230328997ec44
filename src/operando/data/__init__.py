"""The nouns: records, FRFs, modal models, geometry, findings; frozen, labelled, SI inside."""

from operando.data.findings import Finding, group_findings
from operando.data.frf import QUANTITIES, FrequencyAxis, Frf
from operando.data.geometry import Appearance, CoordinateSystem, Geometry, direction_of, node_motion
from operando.data.modal import ModalModel, phase_collinearity
from operando.data.modal_terms import ModalTerms, ResidualTerms
from operando.data.provenance import Provenance, file_hash
from operando.data.time import Channel, TimeRecord

__all__ = [
    "QUANTITIES",
    "Appearance",
    "Channel",
    "CoordinateSystem",
    "Finding",
    "FrequencyAxis",
    "Frf",
    "Geometry",
    "ModalModel",
    "ModalTerms",
    "Provenance",
    "ResidualTerms",
    "TimeRecord",
    "direction_of",
    "file_hash",
    "group_findings",
    "node_motion",
    "phase_collinearity",
]

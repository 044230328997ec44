"""The nouns: records, FRFs, modal models, geometry, findings; frozen, labelled, SI inside.

``__all__`` names what is for users; what is imported ``as`` itself serves the other packages of operando, here and in these.
"""

from operando.data.arrays import band_limits as band_limits
from operando.data.arrays import bands_of as bands_of
from operando.data.arrays import complex_of as complex_of
from operando.data.arrays import count_of as count_of
from operando.data.arrays import frequencies_of as frequencies_of
from operando.data.arrays import number_of as number_of
from operando.data.arrays import numbers_of as numbers_of
from operando.data.arrays import ordered_band as ordered_band
from operando.data.arrays import positive_band as positive_band
from operando.data.axis import FrequencyAxis
from operando.data.coupling import ModalCoupling
from operando.data.declared import check_fields as check_fields
from operando.data.declared import explain_arguments as explain_arguments
from operando.data.declared import listed as listed
from operando.data.findings import Finding, group_findings
from operando.data.findings import once_of_a_sense as once_of_a_sense
from operando.data.findings import with_further as with_further
from operando.data.frf import Frf
from operando.data.geometry import Appearance, CoordinateSystem, Geometry, direction_of, node_motion
from operando.data.levels import LEVEL_RATIO, force_rms, level_groups, one_level
from operando.data.mapped import MappedSamples, RowStatistics
from operando.data.mapped import filling as filling
from operando.data.mapped import mapped_rows as mapped_rows
from operando.data.mapped import pieces as pieces
from operando.data.mapped import row_statistics as row_statistics
from operando.data.modal import ModalModel, phase_collinearity
from operando.data.modal_terms import ModalTerms, ResidualTerms
from operando.data.objects import Short
from operando.data.objects import common_name as common_name
from operando.data.objects import counted as counted
from operando.data.objects import expect as expect
from operando.data.objects import names_text as names_text
from operando.data.objects import plots as plots
from operando.data.objects import several as several
from operando.data.provenance import Provenance
from operando.data.quantities import QUANTITIES, quantity_named, unit_of
from operando.data.receptances import Receptances
from operando.data.stored import StoredFile, StoredRow
from operando.data.time import Channel, TimeRecord
from operando.files import file_hash as file_hash

__all__ = [
    "LEVEL_RATIO",
    "QUANTITIES",
    "Appearance",
    "Channel",
    "CoordinateSystem",
    "Finding",
    "FrequencyAxis",
    "Frf",
    "Geometry",
    "MappedSamples",
    "ModalCoupling",
    "ModalModel",
    "ModalTerms",
    "Provenance",
    "Receptances",
    "ResidualTerms",
    "RowStatistics",
    "Short",
    "StoredFile",
    "StoredRow",
    "TimeRecord",
    "direction_of",
    "force_rms",
    "group_findings",
    "level_groups",
    "node_motion",
    "one_level",
    "phase_collinearity",
    "quantity_named",
    "unit_of",
]

explain_arguments(__name__)

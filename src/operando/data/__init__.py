"""The nouns: records, FRFs, modal models, geometry, findings; frozen, labelled, SI inside."""

from operando.data.arrays import (
    band_limits,
    bands_of,
    complex_of,
    frequencies_of,
    number_of,
    numbers_of,
    order_of,
    ordered_band,
    positive_band,
)
from operando.data.axis import FrequencyAxis
from operando.data.coupling import ModalCoupling
from operando.data.declared import check_fields, explain_arguments, listed
from operando.data.findings import Finding, group_findings, once_of_a_sense, with_further
from operando.data.frf import Frf
from operando.data.geometry import Appearance, CoordinateSystem, Geometry, direction_of, node_motion
from operando.data.levels import LEVEL_RATIO, force_rms, level_groups, one_level
from operando.data.mapped import MappedSamples, RowStatistics, filling, mapped_rows, pieces, row_statistics
from operando.data.modal import ModalModel, phase_collinearity
from operando.data.modal_terms import ModalTerms, ResidualTerms
from operando.data.objects import Short, common_name, counted, expect, names_text, plots, several
from operando.data.provenance import Provenance
from operando.data.quantities import QUANTITIES, quantity_named, unit_of
from operando.data.receptances import Receptances
from operando.data.stored import StoredFile, StoredRow
from operando.data.time import Channel, TimeRecord
from operando.files import file_hash

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
    "band_limits",
    "bands_of",
    "check_fields",
    "common_name",
    "complex_of",
    "counted",
    "direction_of",
    "expect",
    "explain_arguments",
    "file_hash",
    "filling",
    "force_rms",
    "frequencies_of",
    "group_findings",
    "level_groups",
    "listed",
    "mapped_rows",
    "names_text",
    "node_motion",
    "number_of",
    "numbers_of",
    "once_of_a_sense",
    "one_level",
    "order_of",
    "ordered_band",
    "phase_collinearity",
    "pieces",
    "plots",
    "positive_band",
    "quantity_named",
    "row_statistics",
    "several",
    "unit_of",
    "with_further",
]

explain_arguments(__name__)

"""Error measures between any model and any measurement, against the noise floor; where a model fails."""

from __future__ import annotations

from operando.compare.comparison import Comparison, compare, compare_all, with_effect
from operando.compare.maps import clear_lines, error_map, level_error_db, rms_over
from operando.compare.measures import SNR_LIMIT, Lines
from operando.compare.models import ModelComparison, compare_models, modal_of
from operando.compare.route import FOUND, Route, gets_worse, recommended
from operando.data import explain_arguments

__all__ = [
    "FOUND",
    "SNR_LIMIT",
    "Comparison",
    "Lines",
    "ModelComparison",
    "Route",
    "clear_lines",
    "compare",
    "compare_all",
    "compare_models",
    "error_map",
    "gets_worse",
    "level_error_db",
    "modal_of",
    "recommended",
    "rms_over",
    "with_effect",
]

explain_arguments(__name__)

"""Error measures between any model and any measurement, against the noise floor; where a model fails."""

from __future__ import annotations

from operando.compare.comparison import Comparison, compare, compare_all, with_effect
from operando.compare.measures import SNR_LIMIT, Lines
from operando.compare.route import FOUND, Route, gets_worse, recommended

__all__ = ["FOUND", "SNR_LIMIT", "Comparison", "Lines", "Route", "compare", "compare_all", "gets_worse", "recommended", "with_effect"]

"""Error measures between any model and any measurement, against the noise floor; where a model fails."""

from __future__ import annotations

from operando.compare.comparison import Comparison, compare, compare_all, with_effect
from operando.compare.measures import SNR_LIMIT, Lines

__all__ = ["SNR_LIMIT", "Comparison", "Lines", "compare", "compare_all", "with_effect"]

"""What settings of a test may be, known without the packages that use them: every run compares its test file with it before any stage."""

from __future__ import annotations

LEAST_LINES = 8
"""Lines that a band must hold: one mode has four real unknowns a pair with its residual terms, eight lines give twice as many equations."""

LOWER, UPPER = 0.8, 1.1
"""Lines of the linear stage, in units of the band's ends: resonances just outside show where they are."""

WINDOWS = ("hann", "rectangular")
"""Windows of blocks."""

IMPACT_WINDOWS = ("rectangular", "force", "exponential", "force_exponential")
"""Windows of hits."""

METHODS = ("msf_all", "sqrt_mac", "eq13", "eq15", "eq20", "idle_shapes", "expansion", "expansion_stiffness")
"""Scaling methods, besides ``auto``."""

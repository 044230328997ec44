"""What a band must hold, known without the rest of the EMA: the test file is held against it before any stage."""

from __future__ import annotations

LEAST_LINES = 8
"""Lines that a band must hold: one mode has four real unknowns a pair with its residual terms, eight lines give twice as many equations."""

LOWER, UPPER = 0.8, 1.1
"""Lines of the linear stage, in units of the band's ends: resonances just outside show where they are."""

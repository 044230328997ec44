"""FRF estimation: H1, H2, Hv, several references, hammer hits, local rational models, checks."""

from operando.frf.estimate import estimate_frf

__all__ = ["estimate_frf"]

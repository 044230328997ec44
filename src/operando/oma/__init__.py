"""Operational modal analysis: own SSI-cov, SSI-dat, harmonics, uncertainty."""

from operando.oma.details import OmaDetails
from operando.oma.fit import fit_oma, normalise_shapes
from operando.oma.spectra import Spectra, output_spectra

__all__ = ["OmaDetails", "Spectra", "fit_oma", "normalise_shapes", "output_spectra"]

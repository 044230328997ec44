"""Operational modal analysis: own SSI-cov, SSI-dat, harmonics, uncertainty."""

from operando.data import explain_arguments
from operando.oma.beside import beside_pyoma
from operando.oma.details import OmaDetails
from operando.oma.estimate import normalise_shapes
from operando.oma.fit import fit_oma
from operando.oma.halves import fit_halves
from operando.oma.harmonics import Harmonic, find_harmonics
from operando.oma.spectra import Spectra, output_spectra

__all__ = [
    "Harmonic",
    "OmaDetails",
    "Spectra",
    "beside_pyoma",
    "find_harmonics",
    "fit_halves",
    "fit_oma",
    "normalise_shapes",
    "output_spectra",
]

explain_arguments(__name__)

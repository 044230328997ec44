"""Figures: results and matplotlib Axes in, Axes out. The methods of objects, the report and the workbench draw by these functions."""

from __future__ import annotations

from operando.data import explain_arguments
from operando.plots.diagnosis import plot_dynamic_stiffness, plot_steps, plot_where
from operando.plots.errors import plot_comparison, plot_error_map, plot_errors
from operando.plots.fits import fit_circle, plot_nyquist, plot_synthesis_correlation
from operando.plots.frfs import plot_frf, plot_frf_rms
from operando.plots.location import plot_location
from operando.plots.modes import plot_changes, plot_complexity, plot_mac, plot_participation, plot_shares
from operando.plots.ofrfs import plot_hybrid, plot_ofrf
from operando.plots.records import plot_force_spectra, plot_hits, plot_psd, plot_record
from operando.plots.shapes import animate_shape, plot_geometry, plot_shape
from operando.plots.stabilization import plot_singular_values, plot_stabilization, plot_stabilization_of

__all__ = [
    "animate_shape",
    "fit_circle",
    "plot_changes",
    "plot_comparison",
    "plot_complexity",
    "plot_dynamic_stiffness",
    "plot_error_map",
    "plot_errors",
    "plot_force_spectra",
    "plot_frf",
    "plot_frf_rms",
    "plot_geometry",
    "plot_hits",
    "plot_hybrid",
    "plot_location",
    "plot_mac",
    "plot_nyquist",
    "plot_ofrf",
    "plot_participation",
    "plot_psd",
    "plot_record",
    "plot_shape",
    "plot_shares",
    "plot_singular_values",
    "plot_stabilization",
    "plot_stabilization_of",
    "plot_steps",
    "plot_synthesis_correlation",
    "plot_where",
]

explain_arguments(__name__)

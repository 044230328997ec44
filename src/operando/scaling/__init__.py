"""The hybrid core: pairing of operational with idle modes, scale of operational shapes, operational FRFs (Shen & Lu 2024)."""

from __future__ import annotations

from operando.data import explain_arguments
from operando.limits import METHODS
from operando.scaling.condensed import CondensedBasis, choose_dofs, condensed_basis, condensed_mass
from operando.scaling.hybrid import scale_operational
from operando.scaling.methods import modal_scale_factor, real_shapes
from operando.scaling.model import HybridModel
from operando.scaling.pairing import Pair, Pairing, pair_modes

__all__ = [
    "METHODS",
    "CondensedBasis",
    "HybridModel",
    "Pair",
    "Pairing",
    "choose_dofs",
    "condensed_basis",
    "condensed_mass",
    "modal_scale_factor",
    "pair_modes",
    "real_shapes",
    "scale_operational",
]

explain_arguments(__name__)

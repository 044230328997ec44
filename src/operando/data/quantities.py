"""Names of what an FRF is: motion over force, its other names, and its reciprocals."""

from __future__ import annotations

import difflib

from operando.errors import DataError

QUANTITIES = ("receptance", "mobility", "accelerance")
"""Displacement, velocity, acceleration over force: powers 0, 1, 2 of iω."""

RECIPROCALS = {"dynamic_stiffness": "receptance", "impedance": "mobility", "apparent_mass": "accelerance"}
"""Force over motion, pair by pair: 1/H of the quantity named."""

ALIASES = {
    "compliance": "receptance", "dynamic_compliance": "receptance", "dynamic_flexibility": "receptance", "flexibility": "receptance",
    "admittance": "receptance", "inertance": "accelerance", "mechanical_mobility": "mobility", "mechanical_impedance": "impedance",
    "dynamic_mass": "apparent_mass", "effective_mass": "apparent_mass",
}  # fmt: skip
"""Other names of the same."""

UNITS = {
    "accelerance": "(m/s²)/N", "mobility": "(m/s)/N", "receptance": "m/N",
    "apparent_mass": "kg", "impedance": "N·s/m", "dynamic_stiffness": "N/m",
}  # fmt: skip
"""SI unit of each quantity."""


def quantity_named(name: str, reciprocals: bool = True) -> str:
    """The quantity that a name means: ``accelerance`` for ``inertance``, ``receptance`` for ``compliance``.

    Parameters
    ----------
    name : str
        In any case, words apart or joined by ``_``.
    reciprocals : bool
        Whether force over motion (``dynamic_stiffness``, ``impedance``, ``apparent_mass``) is allowed.

    Returns
    -------
    str

    Raises
    ------
    DataError
        If the name is none of them, or a reciprocal where FRFs (motion over force) are asked for.

    Examples
    --------
    >>> quantity_named("Dynamic stiffness"), quantity_named("inertance")
    ('dynamic_stiffness', 'accelerance')
    """
    clean = str(name).strip().lower().replace(" ", "_").replace("-", "_")
    clean = ALIASES.get(clean, clean)
    if clean in QUANTITIES or (reciprocals and clean in RECIPROCALS):
        return clean
    if clean in RECIPROCALS:
        hint = f"frf.values({clean!r}) gives the numbers, frf.plot(quantity={clean!r}) draws them"
        raise DataError(f"{name!r} is force over motion, an FRF is motion over force", hint=hint)
    near = difflib.get_close_matches(clean, (*QUANTITIES, *RECIPROCALS, *ALIASES), 1, 0.6)
    hint = f"did you mean {near[0]!r}?" if near else "other names: " + ", ".join(ALIASES)
    raise DataError(f"quantity {name!r} is none of {', '.join((*QUANTITIES, *(RECIPROCALS if reciprocals else ())))}", hint=hint)


def unit_of(quantity: str) -> str:
    """SI unit of a quantity, by any of its names: ``(m/s²)/N`` for accelerance.

    Parameters
    ----------
    quantity : str
        Any name of an FRF quantity.

    Returns
    -------
    str

    Examples
    --------
    >>> unit_of("inertance")
    '(m/s²)/N'
    """
    return UNITS[quantity_named(quantity)]

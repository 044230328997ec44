"""Degrees of freedom: node, direction and sign, as ``12+Z``."""

from __future__ import annotations

import re
from dataclasses import dataclass

from operando.errors import DofError

AXES = ("", "X", "Y", "Z", "RX", "RY", "RZ")
"""Axis names in the order of the UFF direction codes 0 to 6."""

_PATTERN = re.compile(r"^\s*(\d+)\s*(?:([+-])?\s*(R?[XYZ]))?\s*$", re.IGNORECASE)
_NAMED = re.compile(r"^\s*(\d+)([+-])([a-z][a-z0-9_]{0,15})\s*$")
_NAME = re.compile(r"^[a-z][a-z0-9_]{0,15}$")


@dataclass(frozen=True, slots=True, order=True)
class Dof:
    """One degree of freedom.

    Parameters
    ----------
    node : int
        Node number, not negative.
    axis : str
        "X", "Y", "Z", "RX", "RY" or "RZ"; empty for a scalar; or the name of a direction that is no axis, in lower case ("a", "beam1"),
        whose unit vector stands in [directions] of the test file (``Geometry.directions``).
    sign : {1, -1}
        Sense along the axis; a scalar has sign 1.

    Raises
    ------
    DofError
        If a field is out of range.
    """

    node: int
    axis: str = ""
    sign: int = 1

    def __post_init__(self) -> None:
        if self.node < 0:
            raise DofError(f"node number {self.node} is negative", hint="node numbers start at 0")
        if self.axis not in AXES and not (_NAME.match(self.axis) and self.axis.upper() not in AXES):
            hint = "use X, Y, Z, RX, RY, RZ, nothing for a scalar, or the name of a direction in lower case"
            raise DofError(f"unknown axis {self.axis!r}", hint=hint)
        if self.sign not in (1, -1) or (self.axis == "" and self.sign != 1):
            raise DofError(f"sign {self.sign} of DOF {self.node}{self.axis} is not allowed")

    @classmethod
    def parse(cls, text: str | Dof) -> Dof:
        """Read ``12+Z``, ``12Z`` (positive), ``7-X``, ``101+RY``, a scalar ``12``, or a named direction with its sign, ``5+a``.

        Raises
        ------
        DofError
            If the text is no DOF label.
        """
        if isinstance(text, Dof):
            return text
        match = _PATTERN.match(str(text))
        named = _NAMED.match(str(text)) if match is None else None
        if named is not None:
            return cls(int(named[1]), named[3], -1 if named[2] == "-" else 1)
        if match is None:
            raise DofError(f"{text!r} is no DOF label", hint="write node, sign, axis, as in 12+Z, 7-X, 101+RY, or 12")
        node, sign, axis = match.groups()
        return cls(int(node), (axis or "").upper(), -1 if sign == "-" else 1)

    @classmethod
    def from_uff(cls, node: int, code: int) -> Dof:
        """DOF from a UFF node number and direction code (−6 … 6, 0 is a scalar).

        Raises
        ------
        DofError
            If the code is outside −6 … 6.
        """
        if not -6 <= code <= 6:
            raise DofError(f"UFF direction code {code} is outside -6 ... 6")
        return cls(int(node), AXES[abs(code)], -1 if code < 0 else 1)

    @property
    def named(self) -> bool:
        """Whether the direction is no axis but one named in [directions]."""
        return self.axis not in AXES

    @property
    def uff_code(self) -> int:
        """UFF direction code, −6 … 6.

        Raises
        ------
        DofError
            If the direction is no axis.
        """
        if self.named:
            raise DofError(f"direction {self.axis!r} of DOF {self} has no UFF code", hint="UFF knows X, Y, Z and rotations only")
        return AXES.index(self.axis) * self.sign

    @property
    def unsigned(self) -> Dof:
        """The same axis in its positive sense."""
        return Dof(self.node, self.axis, 1)

    @property
    def opposite(self) -> Dof:
        """The same axis in the other sense (a scalar has none and is returned as it is)."""
        return self if self.axis == "" else Dof(self.node, self.axis, -self.sign)

    def same_axis(self, other: Dof) -> bool:
        """Whether both are the same node and axis, whatever the sense."""
        return self.node == other.node and self.axis == other.axis

    def __str__(self) -> str:
        return f"{self.node}{'+' if self.sign > 0 else '-'}{self.axis}" if self.axis else str(self.node)

    def __repr__(self) -> str:
        return f"Dof('{self}')"


def parse_dofs(labels: object) -> tuple[Dof, ...]:
    """Parse several labels: a comma-separated text, or an iterable of labels or DOFs."""
    if isinstance(labels, Dof):
        return (labels,)
    items = [part for part in labels.split(",") if part.strip()] if isinstance(labels, str) else list(labels)  # type: ignore[call-overload]
    return tuple(Dof.parse(item) for item in items)


def match_dofs(wanted: tuple[Dof, ...], available: tuple[Dof, ...]) -> tuple[list[int], list[int]]:
    """Find each wanted DOF among the available ones, in either sense.

    Returns
    -------
    indices : list of int
        Position in ``available`` for each wanted DOF.
    signs : list of int
        1 where the sense agrees, −1 where it is opposite.

    Raises
    ------
    DofError
        If a wanted DOF is not among the available ones.
    """
    table = {(dof.node, dof.axis): i for i, dof in enumerate(available)}
    indices, signs = [], []
    for dof in wanted:
        i = table.get((dof.node, dof.axis))
        if i is None:
            raise DofError(f"DOF {dof} is not measured", hint="available: " + ", ".join(str(d) for d in available[:40]))
        indices.append(i)
        signs.append(dof.sign * available[i].sign)
    return indices, signs

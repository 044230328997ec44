"""Degrees of freedom: node, direction and sign, as ``12+Z``; the node of a component is ``FRAM:12``, its DOF ``FRAM:12+Z``."""

from __future__ import annotations

import operator
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from fnmatch import fnmatchcase
from functools import total_ordering

from operando.errors import DataError, DofError

AXES = ("", "X", "Y", "Z", "RX", "RY", "RZ")
"""Axis names in the order of the UFF direction codes 0 to 6."""

Node = int | str
"""A node: its number, or ``COMPONENT:NUMBER`` where nodes are numbered anew in each component (``FRAM:1`` and ``MOTR:1``)."""

MAX_NUMBER_DIGITS = 18
"""Longest node number that is read: it fits 64 bits, and no format of measured data has longer ones."""

_NODE = rf"(?:([^\s:,@=;/\"'\x00-\x1f\x7f][^:,@=;/\"'\x00-\x1f\x7f]{{0,31}}):)?0*([0-9]{{1,{MAX_NUMBER_DIGITS}}})"
_PATTERN = re.compile(rf"^\s*{_NODE}:?\s*(?:([+-])?\s*(R?[XYZ]))?\s*$", re.IGNORECASE)
_NAMED = re.compile(rf"^\s*{_NODE}:?([+-])([a-z][a-z0-9_]{{0,15}})\s*$")
_NAME = re.compile(r"^[a-z][a-z0-9_]{0,15}$")
_NODE_ALONE = re.compile(rf"^{_NODE}$")


def _whole(value: object) -> int | None:
    """A whole number; None where it is none."""
    try:
        return operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        return None


def split_node(node: Node) -> tuple[str, int]:
    """Component (empty where there is none) and number of a node.

    Raises a DofError if a text is no node label.
    """
    if (number := _whole(node)) is not None:
        return "", number
    match = _NODE_ALONE.match(node) if isinstance(node, str) else None
    if match is None:
        raise DofError(f"{node!r:.60} is no node label", hint="write a number, or component and number as in FRAM:12")
    return (match[1] or "").rstrip(), int(match[2])


def node_label(component: str, number: int) -> Node:
    """Node of a component (``FRAM:12``), or the number itself without one.

    Raises a DofError if the text cannot name a component.
    """
    if not component:
        return number
    label = f"{component.strip()}:{number}"
    split_node(label)
    return label


@total_ordering
@dataclass(frozen=True, slots=True)
class Dof:
    """One degree of freedom.

    Parameters
    ----------
    node : int or str
        Node number, not negative; or component and number, ``FRAM:12``.
    axis : str
        "X", "Y", "Z", "RX", "RY" or "RZ"; empty for a scalar; or the name of a direction that is no axis, in lower case ("a", "beam1"),
        whose unit vector stands in [directions] of the test file (``Geometry.directions``).
    sign : {1, -1}
        Sense along the axis; a scalar has sign 1.

    Raises
    ------
    DofError
        If a field is out of range.

    Examples
    --------
    >>> from operando import Dof
    >>> Dof(12, "Z", -1)
    Dof('12-Z')
    >>> str(Dof.parse("FRAM:12+X"))
    'FRAM:12+X'
    """

    node: Node
    axis: str = ""
    sign: int = 1

    def __post_init__(self) -> None:
        component, number = split_node(self.node)
        object.__setattr__(self, "node", node_label(component, number))
        if not 0 <= number < 10**MAX_NUMBER_DIGITS:
            text = f"node number {self.node} is negative" if number < 0 else f"the node number has more than {MAX_NUMBER_DIGITS} digits"
            raise DofError(text, hint=f"node numbers start at 0 and have up to {MAX_NUMBER_DIGITS} digits")
        if not isinstance(self.axis, str) or (self.axis not in AXES and not (_NAME.match(self.axis) and self.axis.upper() not in AXES)):
            hint = "use X, Y, Z, RX, RY, RZ, nothing for a scalar, or the name of a direction in lower case"
            raise DofError(f"unknown axis {self.axis!r}", hint=hint)
        if _whole(self.sign) not in (1, -1) or (self.axis == "" and self.sign != 1):
            raise DofError(f"sign {self.sign} of DOF {self.node}{self.axis} is not allowed")

    @classmethod
    def parse(cls, text: str | Dof) -> Dof:
        """Read ``12+Z``, ``12Z`` (positive), ``7-X``, ``101+RY``, a scalar ``12``, a named direction with its sign, ``5+a``, or the DOF of
        a component, ``FRAM:12+Z`` (also ``FRAM:12:+Z``).

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
            component, number, sign, axis = named.groups()
        elif match is not None:
            component, number, sign, axis = match.groups()
            axis = (axis or "").upper()
        elif re.match(rf"\s*0*[0-9]{{{MAX_NUMBER_DIGITS + 1}}}", str(text)):
            hint = f"node numbers start at 0 and have up to {MAX_NUMBER_DIGITS} digits"
            raise DofError(f"the node number of {str(text)[:20]!r}… has more than {MAX_NUMBER_DIGITS} digits", hint=hint)
        else:
            shown = str(text) if len(str(text)) <= 60 else f"{str(text)[:60]}…"
            raise DofError(f"{shown!r} is no DOF label", hint="write node, sign, axis, as in 12+Z, 7-X, 101+RY, 12, or FRAM:12+Z")
        return cls(node_label((component or "").rstrip(), int(number)), axis, -1 if sign == "-" else 1)

    @classmethod
    def from_uff(cls, node: int, code: int, component: str = "") -> Dof:
        """DOF from a UFF node number and direction code (−6 … 6, 0 is a scalar), and the component whose node it is.

        Raises
        ------
        DofError
            If the code is outside −6 … 6, or the text cannot name a component.
        """
        if not -6 <= code <= 6:
            raise DofError(f"UFF direction code {code} is outside -6 ... 6")
        return cls(node_label(component, int(node)), AXES[abs(code)], -1 if code < 0 else 1)

    @property
    def component(self) -> str:
        """Component of the node; empty where nodes have none."""
        return split_node(self.node)[0]

    @property
    def number(self) -> int:
        """Number of the node, within its component where it has one."""
        return split_node(self.node)[1]

    def __lt__(self, other: object) -> bool:
        if not isinstance(other, Dof):
            return NotImplemented
        return (*split_node(self.node), self.axis, self.sign) < (*split_node(other.node), other.axis, other.sign)

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

    @property
    def key(self) -> tuple[Node, str]:
        """Node and axis: what the DOFs of both senses share."""
        return self.node, self.axis

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
    if not isinstance(labels, str | Iterable):
        raise DofError(f"DOF labels are a text or a list of labels, not {type(labels).__name__}", hint='write "1+Z, 2+Z"')
    items = [part for part in labels.split(",") if part.strip()] if isinstance(labels, str) else list(labels)
    return tuple(Dof.parse(item) for item in items)


class DofIndex:
    """Positions of DOFs in their order, found by node and axis whatever the sense. Of two of one axis the first counts.

    Parameters
    ----------
    dofs : iterable of Dof

    Examples
    --------
    >>> index = DofIndex(parse_dofs("1+Z, 2-Z"))
    >>> index.find(Dof.parse("2+Z"))
    (1, -1)
    >>> Dof.parse("3+Z") in index
    False
    """

    __slots__ = ("_at", "dofs")

    def __init__(self, dofs: Iterable[Dof]) -> None:
        self.dofs = tuple(dofs)
        self._at: dict[tuple[Node, str], int] = {}
        for i, dof in enumerate(self.dofs):
            self._at.setdefault(dof.key, i)

    def __len__(self) -> int:
        return len(self._at)

    def __iter__(self) -> Iterator[Dof]:
        return (self.dofs[i] for i in self._at.values())

    def __contains__(self, dof: object) -> bool:
        return isinstance(dof, Dof) and dof.key in self._at

    def __repr__(self) -> str:
        return f"DofIndex({', '.join(map(str, self))})"

    def find(self, dof: Dof) -> tuple[int, int] | None:
        """Position of a DOF and 1 where its sense agrees, −1 where it is opposite; None where it is not there."""
        i = self._at.get(dof.key)
        return None if i is None else (i, dof.sign * self.dofs[i].sign)

    def common(self, other: Iterable[Dof]) -> list[tuple[int, int, int]]:
        """(own position, position in the other, sign) of each axis that both have, in the own order."""
        index = other if isinstance(other, DofIndex) else DofIndex(other)
        found = ((i, index.find(self.dofs[i])) for i in self._at.values())
        return [(i, *at) for i, at in found if at is not None]

    def match(self, wanted: Iterable[Dof]) -> tuple[list[int], list[int]]:
        """Positions of the wanted DOFs, and 1 or −1 for each by its sense.

        Raises a DofError if one is not there; a DOF of a similar label is told.
        """
        indices, signs = [], []
        for dof in wanted:
            at = self.find(dof)
            if at is None:
                raise _not_measured(str(dof), self.dofs)
            indices.append(at[0])
            signs.append(at[1])
        return indices, signs


def _not_measured(text: str, available: Sequence[Dof]) -> DofError:
    labels = [str(d) for d in available]
    near = get_close_matches(text, labels, 1, 0.5)
    hint = (f"did you mean {near[0]!r}? " if near else "") + "available: " + ", ".join(labels[:40])
    return DofError(f"DOF {text} is not measured", hint=hint)


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
    return DofIndex(available).match(wanted)


def named_dofs(wanted: object, available: Sequence[Dof]) -> tuple[Dof, ...]:
    """The DOFs that an index in square brackets means.

    Parameters
    ----------
    wanted : str, Dof, iterable of both, ``:`` or None
        Labels (``"12+Z"``, ``"1+Z, 2+Z"``), patterns over the labels (``"*Z"``, ``"1?+X"``), several of them, or all.
    available : sequence of Dof

    Raises
    ------
    DofError
        If a pattern matches nothing, something is no label, or none is named.

    Examples
    --------
    >>> named_dofs("*Z", parse_dofs("1+Z, 2-Z, 2+X"))
    (Dof('1+Z'), Dof('2-Z'))
    """
    if wanted is None or wanted is Ellipsis or (isinstance(wanted, slice) and wanted == slice(None)):
        return tuple(available)
    if isinstance(wanted, slice | int | float):
        hint = 'write labels, as in frf["12+Z", "3+X"]; arrays are indexed by position: frf.data[0, 1]'
        raise DofError(f"{wanted!r} is no DOF label", hint=hint)
    parts: Iterable[object]
    if isinstance(wanted, str):
        parts = [p for p in wanted.split(",") if p.strip()]
    elif isinstance(wanted, Iterable):
        parts = wanted
    else:
        parts = [wanted]
    found: dict[Dof, None] = {}
    for part in parts:
        text = str(part).strip()
        if "*" not in text and "?" not in text:
            found[part if isinstance(part, Dof) else Dof.parse(text)] = None
            continue
        hits = [d for d in available if fnmatchcase(str(d), text)]
        if not hits:
            raise _not_measured(text, available)
        found |= dict.fromkeys(hits)
    if not found:
        raise DofError(f"{wanted!r} names no DOF", hint="leave it out for all: " + ", ".join(map(str, available[:40])))
    return tuple(found)


def check_dofs(wanted: tuple[Dof, ...], known: tuple[Dof, ...], where: str) -> None:
    """DOFs asked for must be measured.

    Raises a DofError if one is not; the nearest is named.
    """
    try:
        match_dofs(wanted, known)
    except DofError as error:
        raise DofError(error.message, where=where, hint=error.hint) from None


def refuse_twice(dofs: Iterable[Dof], what: str) -> None:
    """Labels of an array name each DOF once: a DataError if one appears twice, in either sense."""
    seen = set()
    for dof in dofs:
        if dof.key in seen:
            raise DataError(f"{what} {dof} appears twice (in either sense)", hint="give each its own DOF; in a test file by [channels]")
        seen.add(dof.key)

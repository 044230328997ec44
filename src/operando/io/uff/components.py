"""Nodes numbered within components: Testlab writes the component of a node into the entity name of a function.

``FRAM:1:+Z`` and ``MOTR:1:+Z`` are two DOFs; their functions state node 1 both. Other programs put the name of the channel into the
same field, so a name is taken as a component only where the file says so.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from operando.dof import Dof, Node, node_label, split_node
from operando.errors import DofError
from operando.io.content import FileHeader
from operando.io.uff.header58 import Header58
from operando.io.uff.split import RawSet

_TESTLAB = re.compile(r"test\.?\s?lab", re.IGNORECASE)
_STATED = "nodes of components: "


def evidence_of_components(headers: Sequence[Header58], file_header: FileHeader | None) -> str:
    """Why the entity names of a file are components, in words; empty where they are not."""
    if file_header is not None and any(_TESTLAB.search(t) for t in (file_header.program, file_header.writer)):
        return "the file is from Testlab, which writes components there"
    ends = [(h.ids, name, dof) for h in headers for name, dof in ((h.response_name, h.response), (h.reference_name, h.reference))]
    if any(name and dof is not None and _spelled(ids, name, dof) for ids, name, dof in ends):
        return "the ID lines write DOFs with them"
    # a component has several nodes and directions; the name of a channel stands for one
    held: dict[str, set[Dof]] = {}
    for _, name, dof in ends:
        if name and dof is not None:
            held.setdefault(name, set()).add(dof.unsigned)
    if all(len(dofs) == 1 for dofs in held.values()):
        return ""
    names: dict[tuple[object, ...], set[tuple[str, str]]] = {}
    for h in headers:
        if h.response is not None:
            key = (h.function_type, h.ordinate.code, h.response.unsigned, None if h.reference is None else h.reference.unsigned)
            names.setdefault(key, set()).add((h.response_name, h.reference_name))
    for found in names.values():
        if len(found) > 1 and all(any(pair) for pair in found):
            return "functions of one node and direction differ in them"
    return ""


def _spelled(ids: Iterable[str], name: str, dof: Dof) -> str:
    """Full name of a component as an ID line writes it with this node; the entity name may be cut at 10 characters."""
    for line in ids:
        if f":{dof.number}" not in line:  # a pattern of its own for each node takes longer than all else
            continue
        for match in re.finditer(rf"([^\s/:][^/:]*):{dof.number}:?[+-]R?[XYZ]\b", line):
            words = match[1].split(" ")
            for i in range(len(words)):  # the name may hold blanks, and words may stand before it
                full = " ".join(words[i:])
                if full == name or (len(name) >= 10 and full.startswith(name)):
                    return full
    return ""


def with_components(raw: RawSet) -> RawSet:
    """The set with its entity names as components of its DOFs; a name that cannot be one stays a channel name."""
    header = raw.header
    if header is None:
        return raw
    response, used = _labelled(header.ids, header.response_name, header.response)
    reference, _ = _labelled(header.ids, header.reference_name, header.reference)
    name = "" if used else header.response_name
    return replace(raw, header=replace(header, response=response, reference=reference, response_name=name))


def _labelled(ids: tuple[str, ...], name: str, dof: Dof | None) -> tuple[Dof | None, bool]:
    if dof is None or not name:
        return dof, False
    try:
        return Dof(node_label(_spelled(ids, name, dof) or name, dof.number), dof.axis, dof.sign), True
    except DofError:
        return dof, False


@dataclass(frozen=True)
class NodeNumbers:
    """Numbers for the nodes of components in sets that hold numbers only: component k of the list counts from k·base on.

    ``base`` is a power of ten above all numbers; 0 where there is no component.
    """

    components: tuple[str, ...] = ()
    base: int = 0

    @classmethod
    def of(cls, nodes: Iterable[Node]) -> NodeNumbers:
        """Numbers for some nodes."""
        split = [split_node(node) for node in nodes]
        names = tuple(sorted({component for component, _ in split if component}))
        return cls(names, 10 ** len(str(max(number for _, number in split)))) if names else cls()

    @classmethod
    def stated(cls, text: str) -> NodeNumbers:
        """What the description of a file states, as :attr:`text` writes it; none where it does not."""
        match = re.fullmatch(rf"{_STATED}(.+)", text.strip())
        pairs = [] if match is None else [re.fullmatch(r"(.+) ([0-9]{1,9})", part) for part in match[1].split(", ")]
        good = [pair for pair in pairs if pair is not None]
        if not good or len(good) < len(pairs):
            return cls()
        base = int(good[0][2])
        if not base or any(int(pair[2]) != (k + 1) * base for k, pair in enumerate(good)):
            return cls()
        return cls(tuple(pair[1] for pair in good), base)

    @property
    def text(self) -> str:
        """What a file states in its description (set 151) so that the numbers can be taken back; empty without components."""
        pairs = ", ".join(f"{name} {(k + 1) * self.base}" for k, name in enumerate(self.components))
        return f"{_STATED}{pairs}" if pairs else ""

    def number(self, node: Node) -> int:
        """Number of a node."""
        component, number = split_node(node)
        return (self.components.index(component) + 1) * self.base + number if component else number

    def node(self, number: int) -> Node:
        """Node of a number."""
        if not self.base or not 0 < number // self.base <= len(self.components):
            return number
        return node_label(self.components[number // self.base - 1], number % self.base)

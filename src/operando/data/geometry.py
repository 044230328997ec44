"""Geometry: node coordinates, lines and faces for drawing and interpolation."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from operando.data.arrays import frozen
from operando.data.provenance import Provenance
from operando.errors import DataError


@dataclass(frozen=True)
class Geometry:
    """Nodes with coordinates [m], lines and faces between them.

    Parameters
    ----------
    nodes : tuple of int
        Node numbers, each once.
    coordinates : (n_nodes, 3) array
        x, y, z [m].
    lines : tuple of tuple of int
        Polylines through node numbers.
    faces : tuple of tuple of int
        Triangles and quadrilaterals of node numbers.
    name : str
        What it is, as the file says.
    unit_known : bool
        Whether the unit of the coordinates was stated; else they are taken as metres.
    provenance : Provenance, optional
        Where it came from.
    """

    nodes: tuple[int, ...]
    coordinates: NDArray[np.float64]
    lines: tuple[tuple[int, ...], ...] = ()
    faces: tuple[tuple[int, ...], ...] = ()
    name: str = ""
    unit_known: bool = True
    provenance: Provenance = field(default_factory=Provenance)

    def __post_init__(self) -> None:
        object.__setattr__(self, "nodes", tuple(int(n) for n in self.nodes))
        object.__setattr__(self, "coordinates", frozen(self.coordinates, float, 2, "coordinates"))
        if self.coordinates.shape != (len(self.nodes), 3):
            raise DataError(f"{len(self.nodes)} nodes but coordinates of shape {self.coordinates.shape}")
        if len(set(self.nodes)) != len(self.nodes):
            raise DataError("a node number appears twice in the geometry")

    def position(self, node: int) -> NDArray[np.float64] | None:
        """Coordinates [m] of a node, or None."""
        try:
            return self.coordinates[self.nodes.index(node)]
        except ValueError:
            return None

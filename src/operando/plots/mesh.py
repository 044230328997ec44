"""What of a geometry is drawn with a shape: positions, sides and patches between measured nodes, and how far each node moves."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Geometry, node_motion
from operando.dof import Dof

Edge = tuple[int, ...]


class Mesh:
    """Node positions, sides and patches among all nodes, and which nodes are measured (those of ``dofs``)."""

    def __init__(self, geometry: Geometry, dofs: Sequence[Dof]) -> None:
        index = self.index = {n: i for i, n in enumerate(geometry.nodes)}
        self.nodes = geometry.nodes
        self.dofs = tuple(dofs)
        self.directions = geometry.directions
        self.xyz = np.asarray(geometry.coordinates, float)
        found = {index.get(d.node) for d in dofs} - {None}
        self.measured = np.zeros(len(index), bool)
        self.measured[[i for i in found if i is not None]] = True
        lines = [[index[n] for n in line if n in index] for line in geometry.lines]
        self.edges: set[Edge] = {tuple(sorted(e)) for line in lines for e in pairwise(line) if e[0] != e[1]}
        self.faces: list[tuple[int, ...]] = [tuple(index[n] for n in face if n in index) for face in geometry.faces]
        self.faces = [f for f in self.faces if len(f) >= 3]
        self.outline = set(self.edges) | _sides(self.faces)
        moving = lambda group: bool(np.all(self.measured[list(group)]))  # noqa: E731
        usable = [e for e in self.outline if moving(e)]
        # Sensors on few nodes of a plate are joined by triangles; of a space frame, by nothing that is not there.
        if len(usable) < 0.5 * max(len(self.outline), 1) and not (self.outline and _is_spatial(self.xyz[self.measured])):
            self.faces, self.edges = _triangulate(self.xyz, np.flatnonzero(self.measured))
            if not self.outline:
                self.outline = set(self.edges) | _sides(self.faces)
        else:
            self.faces = [f for f in self.faces if moving(f)]
            self.edges = {e for e in self.outline if moving(e)}
            if not self.faces and _is_flat(self.xyz[self.measured]):  # patches carry the colour, lines stay the user's
                self.faces = _triangulate(self.xyz, np.flatnonzero(self.measured))[0]

    @property
    def span(self) -> float:
        """Diagonal of the structure [m]."""
        return float(np.linalg.norm(np.ptp(self.xyz, axis=0))) or 1.0

    @property
    def drawable(self) -> bool:
        """Whether at least two nodes are measured."""
        return bool(self.measured.sum() >= 2)

    def displacements(self, shape: NDArray[Any]) -> NDArray[Any]:
        """Displacement vector of each node (n_nodes, 3) for a shape at the DOFs; rotations are not drawn, scalars move along z."""
        out = np.zeros((self.xyz.shape[0], 3), np.asarray(shape).dtype)
        for node, motion in node_motion(self.dofs, np.asarray(shape)[:, None], self.directions).items():
            if node in self.index:
                out[self.index[node]] = motion[:, 0]
        return out


def _sides(faces: Sequence[tuple[int, ...]]) -> set[Edge]:
    return {tuple(sorted((f[i - 1], f[i]))) for f in faces for i in range(len(f))}


def _is_flat(points: NDArray[np.float64]) -> bool:
    """Whether points lie close to a plane but not on a line."""
    if points.shape[0] < 3:
        return False
    s = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(s[1] > 0.02 * s[0] and s[2] < 0.1 * s[1])


def _is_spatial(points: NDArray[np.float64]) -> bool:
    """Whether points lie neither close to a plane nor on a line."""
    return points.shape[0] >= 4 and not _is_flat(points) and bool(np.linalg.matrix_rank(points - points.mean(axis=0), tol=1e-6) == 3)


def _triangulate(xyz: NDArray[np.float64], nodes: NDArray[np.intp]) -> tuple[list[tuple[int, ...]], set[Edge]]:
    """Delaunay triangles of nodes in their best-fit plane; a chain along the main axis where they lie on a line."""
    if nodes.size < 2:
        return [], set()
    centred = xyz[nodes] - xyz[nodes].mean(axis=0)
    _, s, vh = np.linalg.svd(centred, full_matrices=False)
    flat = centred @ vh[:2].T if vh.shape[0] >= 2 else np.column_stack([centred @ vh[0], np.zeros(nodes.size)])
    if nodes.size < 3 or s[1] < 0.02 * s[0]:
        order = nodes[np.argsort(flat[:, 0])]
        return [], {tuple(sorted((int(a), int(b)))) for a, b in pairwise(order)}
    from matplotlib.tri import Triangulation

    try:
        triangles = Triangulation(flat[:, 0], flat[:, 1]).triangles
    except (RuntimeError, ValueError):  # duplicate or degenerate points
        return [], set()
    corner = flat[triangles]
    sides = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2)
    d1, d2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = 0.5 * np.abs(d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0])
    good = area > 0.06 * sides.max(axis=1) ** 2  # slivers along the hull join sensors that are not neighbours
    faces = [tuple(int(nodes[i]) for i in t) for t in triangles[good]]
    return faces, _sides(faces)


def patches(
    faces: Sequence[tuple[int, ...]], points: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Triangles of all faces, divided so that colour runs smoothly: corners (k, 3, 3), mean values (k,)."""
    corners = np.array([(f[0], f[i], f[i + 1]) for f in faces for i in range(1, len(f) - 1)])
    n = 4 if len(corners) <= 40 else 2 if len(corners) <= 150 else 1
    small = []
    for i in range(n):
        for j in range(n - i):
            small.append([(i, j), (i + 1, j), (i, j + 1)])
            if i + j < n - 1:
                small.append([(i + 1, j), (i + 1, j + 1), (i, j + 1)])
    a, b = np.moveaxis(np.array(small, float), 2, 0) / n
    weights = np.stack([1 - a - b, a, b], axis=2)
    placed = np.einsum("scw,twx->tscx", weights, points[corners]).reshape(-1, 3, 3)
    return placed, np.einsum("scw,tw->tsc", weights, values[corners]).mean(axis=2).ravel()

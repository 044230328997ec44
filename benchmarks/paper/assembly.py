"""Assembly of elements of six DOFs a node, and the lowest modes of the whole."""

from __future__ import annotations

import numpy as np

Array = np.ndarray


class Assembly:
    """Collects element matrices; node k holds the DOFs 6k … 6k + 5."""

    def __init__(self, nodes: int) -> None:
        self.mass = np.zeros(6 * nodes)
        self._rows: list[Array] = []
        self._columns: list[Array] = []
        self._values: list[Array] = []

    def add(self, where: Array, stiffness: Array, masses: Array) -> None:
        """Equal elements: their nodes (elements, nodes each), one stiffness matrix and one diagonal of lumped masses."""
        at = (6 * where[:, :, None] + np.arange(6)).reshape(len(where), -1)
        n = at.shape[1]
        self._rows.append(np.repeat(at, n, axis=1).ravel())
        self._columns.append(np.tile(at, n).ravel())
        self._values.append(np.tile(stiffness.ravel(), len(where)))
        np.add.at(self.mass, at.ravel(), np.tile(masses, len(where)))

    def spring(self, dof: int, stiffness: float) -> None:
        """A spring from one DOF to ground [N/m]."""
        self._rows.append(np.array([dof]))
        self._columns.append(np.array([dof]))
        self._values.append(np.array([stiffness]))

    def stiffness(self) -> object:
        """Sparse stiffness, by columns."""
        from scipy.sparse import coo_array

        where = (np.concatenate(self._rows), np.concatenate(self._columns))
        return coo_array((np.concatenate(self._values), where), shape=(self.mass.size, self.mass.size)).tocsc()


def square_cells(cells: int) -> Array:
    """Nodes (cells², 4) of a square mesh, counter-clockwise; nodes count along y first."""
    i, j = (g.ravel() for g in np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij"))
    first = i * (cells + 1) + j
    return np.stack([first, first + cells + 1, first + cells + 2, first + 1], axis=1)


def free_dofs(cells: int, others: list[int], fixed: list[int]) -> Array:
    """Free DOFs of a square mesh and other nodes, in an order of elimination with little fill-in."""
    order = (6 * np.array([*dissection(0, cells + 1, 0, cells + 1, cells + 1), *others])[:, None] + np.arange(6)).ravel()
    return order[~np.isin(order, fixed)]


def dissection(x0: int, x1: int, y0: int, y1: int, row: int) -> list[int]:
    """Plate nodes in the order of nested dissection (George 1973): halves first, the line between them last; little fill-in."""
    if (x1 - x0) * (y1 - y0) <= 16:
        return [i * row + j for i in range(x0, x1) for j in range(y0, y1)]
    if x1 - x0 >= y1 - y0:
        c = (x0 + x1) // 2
        return dissection(x0, c, y0, y1, row) + dissection(c + 1, x1, y0, y1, row) + [c * row + j for j in range(y0, y1)]
    c = (y0 + y1) // 2
    return dissection(x0, x1, y0, c, row) + dissection(x0, x1, c + 1, y1, row) + [i * row + c for i in range(x0, x1)]


def lowest_modes(stiffness: object, mass: Array, free: Array, count: int) -> tuple[Array, Array]:
    """Natural frequencies [Hz] and shapes (all DOFs, count) of unit modal mass.

    Largest eigenvalues 1/ω² of M^½K⁻¹M^½: a standard problem that rotations without inertia do not disturb.
    """
    from scipy.sparse.linalg import LinearOperator, eigsh, splu

    k = stiffness[free][:, free].tocsc()
    root = np.sqrt(mass[free])
    factor = splu(k, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    flexibility = LinearOperator(k.shape, matvec=lambda x: root * factor.solve(root * np.ravel(x)), dtype=float)
    start = root * np.random.default_rng(1).standard_normal(free.size)
    value, vector = eigsh(flexibility, count, which="LM", v0=start, ncv=2 * count)
    order = np.argsort(-value)
    shapes = np.zeros((mass.size, count))
    shapes[free] = factor.solve(root[:, None] * vector[:, order]) / value[order]
    return 1 / (2 * np.pi * np.sqrt(value[order])), shapes

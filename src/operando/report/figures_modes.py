"""Mode shapes on the geometry, idle and operating side by side, and MAC matrices."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data import Geometry, node_motion
from operando.dof import Dof
from operando.report.canvas import ORANGE_PURPLE, WHITE_BLUE, Canvas, shades
from operando.report.svg import GREY, IDLE, INK, MODEL, PALE, drawn, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PER_ROW = 3


class ShapePair:
    """One row of the gallery: an idle shape, an operating shape or both, real, with captions."""

    def __init__(
        self, label: str, idle: NDArray[Any] | None, operating: NDArray[Any] | None, idle_text: str = "", operating_text: str = ""
    ) -> None:
        self.label, self.idle, self.operating = label, idle, operating
        self.idle_text, self.operating_text = idle_text, operating_text


def mode_shapes(geometry: Geometry | None, dofs: Sequence[Dof], pairs: Sequence[ShapePair]) -> str:
    """SVG: each mode at rest and running, side by side, deformed over the undeformed structure; as bars without a geometry.

    Parameters
    ----------
    geometry : Geometry or None
    dofs : sequence of Dof
        One a row of each shape.
    pairs : list of ShapePair
    """
    columns = min(_PER_ROW, max(len(pairs), 1))
    rows = -(-max(len(pairs), 1) // columns)
    width, head, cell = 10.2, 0.34, 1.75
    height = rows * (head + cell) + 0.1
    sheet = Canvas(width, height)
    step = width / columns
    mesh = None if geometry is None else _mesh(geometry, tuple(dofs))
    alone = all(p.idle is None for p in pairs)
    half = (step - 0.1) / (1 if alone else 2)
    for k, pair in enumerate(pairs):
        x0, y0 = (k % columns) * step, height - (k // columns + 1) * (head + cell)
        sheet.text(x0 + 0.06, y0 + cell + 0.14, pair.label, 9, bold=True)
        both = ((pair.idle, pair.idle_text, IDLE), (pair.operating, pair.operating_text, MODEL))
        for side, (shape, text, color) in enumerate(both[1:] if alone else both):
            left = x0 + 0.04 + side * half
            sheet.text(left + half / 2, y0 + cell - 0.05, text, 7.5, "middle", color)
            box = (left + 0.05, y0, half - 0.1, cell - 0.14)
            if shape is None:
                sheet.text(left + half / 2, y0 + cell / 2, "none", 7.5, "middle", GREY)
            elif mesh is None:
                _bars(sheet, tuple(dofs), shape, color, box)
            else:
                _deformed(sheet, mesh, tuple(dofs), shape, box)
    return sheet.svg(f"Mode shapes at rest and running, {len(pairs)} modes side by side")


Box = tuple[float, float, float, float]


class _Mesh:
    """What is drawn: node positions, sides and patches among all nodes, and which nodes are measured."""

    def __init__(self, geometry: Geometry, dofs: tuple[Dof, ...]) -> None:
        index = self.index = {n: i for i, n in enumerate(geometry.nodes)}
        self.directions = geometry.directions
        self.xyz = np.asarray(geometry.coordinates, float)
        self.node_of_dof = [index.get(d.node) for d in dofs]
        self.measured = np.zeros(len(index), bool)
        self.measured[[i for i in self.node_of_dof if i is not None]] = True
        lines = [[index[n] for n in line if n in index] for line in geometry.lines]
        self.edges = {tuple(sorted(e)) for line in lines for e in pairwise(line) if e[0] != e[1]}
        self.faces = [tuple(index[n] for n in face if n in index) for face in geometry.faces]
        self.faces = [f for f in self.faces if len(f) >= 3]
        self.outline = set(self.edges) | {tuple(sorted((f[i - 1], f[i]))) for f in self.faces for i in range(len(f))}
        moving = lambda group: bool(np.all(self.measured[list(group)]))  # noqa: E731
        usable = [e for e in self.outline if moving(e)]
        # Sensors on few nodes of a plate are joined by triangles; of a space frame, by nothing that is not there.
        if len(usable) < 0.5 * max(len(self.outline), 1) and not (self.outline and _is_spatial(self.xyz[self.measured])):
            self.faces, self.edges = _triangulate(self.xyz, np.flatnonzero(self.measured))
            if not self.outline:
                self.outline = set(self.edges) | {tuple(sorted((f[i - 1], f[i]))) for f in self.faces for i in range(len(f))}
        else:
            self.faces = [f for f in self.faces if moving(f)]
            self.edges = {e for e in self.outline if moving(e)}
            if not self.faces and _is_flat(self.xyz[self.measured]):  # patches carry the colour, lines stay the user's
                self.faces = _triangulate(self.xyz, np.flatnonzero(self.measured))[0]


def _mesh(geometry: Geometry, dofs: tuple[Dof, ...]) -> _Mesh | None:
    mesh = _Mesh(geometry, dofs)
    return mesh if mesh.measured.sum() >= 2 else None


def _is_flat(points: NDArray[np.float64]) -> bool:
    """Whether points lie close to a plane but not on a line."""
    if points.shape[0] < 3:
        return False
    s = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(s[1] > 0.02 * s[0] and s[2] < 0.1 * s[1])


def _is_spatial(points: NDArray[np.float64]) -> bool:
    """Whether points lie neither close to a plane nor on a line."""
    return points.shape[0] >= 4 and not _is_flat(points) and np.linalg.matrix_rank(points - points.mean(axis=0), tol=1e-6) == 3


def _triangulate(xyz: NDArray[np.float64], nodes: NDArray[np.intp]) -> tuple[list[tuple[int, ...]], set[tuple[int, ...]]]:
    """Delaunay triangles of nodes in their best-fit plane; a chain along the main axis where they lie on a line."""
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
    return faces, {tuple(sorted((f[i - 1], f[i]))) for f in faces for i in range(3)}


def _project(xyz: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Orthographic view from the front right above: drawing plane (n, 2) and depth (n,)."""
    azimuth, elevation = np.radians(-58.0), np.radians(32.0)
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    right = np.array([-sa, ca, 0.0])
    up = np.array([-se * ca, -se * sa, ce])
    towards = np.array([ce * ca, ce * sa, se])
    return np.column_stack([xyz @ right, xyz @ up]), xyz @ towards


def _displacements(mesh: _Mesh, dofs: tuple[Dof, ...], shape: NDArray[Any]) -> NDArray[np.float64]:
    """Displacement vector of each node (n_nodes, 3) for a real shape; rotations are not drawn, scalars move along z."""
    out = np.zeros((mesh.xyz.shape[0], 3))
    for number, motion in node_motion(dofs, np.asarray(shape, float)[:, None], mesh.directions).items():
        if number in mesh.index:
            out[mesh.index[number]] = motion[:, 0]
    return out


def _deformed(sheet: Canvas, mesh: _Mesh, dofs: tuple[Dof, ...], shape: NDArray[Any], box: Box) -> None:
    move = _displacements(mesh, dofs, shape)
    length = np.linalg.norm(move, axis=1)
    peak = length.max() if length.size and length.max() > 0 else 1.0
    span = np.linalg.norm(np.ptp(mesh.xyz, axis=0)) or 1.0
    moved = mesh.xyz + move * (0.13 * span / peak)
    direction = np.linalg.svd(move, full_matrices=False)[2][0]
    signed = move @ direction * (1 if direction[np.argmax(np.abs(direction))] >= 0 else -1) / peak
    rest, _ = _project(mesh.xyz)
    flat, depth = _project(moved)
    shown = mesh.measured
    both = np.vstack([rest, flat[shown]])
    low, size = both.min(axis=0), np.maximum(np.ptp(both, axis=0), 1e-9 * span)
    scale = min(box[2] / size[0], box[3] / size[1])
    shift = np.array([box[0] + box[2] / 2, box[1] + box[3] / 2]) - scale * (low + size / 2)
    rest, flat = scale * rest + shift, scale * flat + shift
    sheet.lines([rest[list(e)] for e in mesh.outline], "#c3cbd3", 0.6)
    if mesh.faces:
        patches, values = _patches(mesh.faces, flat, depth, signed)
        sheet.polygons(list(patches), shades(0.5 + 0.46 * values, ORANGE_PURPLE), 0.35)
    if mesh.edges:
        color, thick = ("#46525d", 0.7) if mesh.faces else (MODEL, 1.2)
        sheet.lines([flat[list(e)] for e in mesh.edges], color, thick)
    joined = {n for group in (*mesh.faces, *mesh.edges) for n in group}
    alone = [n for n in np.flatnonzero(shown) if n not in joined]
    if alone:
        sheet.lines([np.array([rest[n], flat[n]]) for n in alone], MODEL, 1.0)
    sheet.dots(flat[shown], shades(0.5 + 0.5 * signed[shown], ORANGE_PURPLE), 2.5, 0.35)


def _patches(
    faces: Sequence[tuple[int, ...]], flat: NDArray[np.float64], depth: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Triangles of all faces from back to front, divided so that colour runs smoothly: corners (k, 3, 2), mean values (k,)."""
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
    points = np.einsum("scw,twx->tscx", weights, flat[corners]).reshape(-1, 3, 2)
    height = np.einsum("scw,tw->tsc", weights, values[corners]).mean(axis=2).ravel()
    order = np.argsort(np.einsum("scw,tw->tsc", weights, depth[corners]).mean(axis=2).ravel())
    return points[order], height[order]


def _bars(sheet: Canvas, dofs: tuple[Dof, ...], shape: NDArray[Any], color: str, box: Box) -> None:
    """Shape as bars by DOF where there is no geometry."""
    values = np.asarray(shape, float)
    values = values / (float(np.max(np.abs(values))) or 1.0)
    left, bottom, width, height = box
    foot = 0.3
    middle, size = bottom + foot + (height - foot) / 2, (height - foot) / 2
    step = width / max(values.size, 1)
    x = left + step * (np.arange(values.size) + 0.15)
    corners = [
        [(a, middle), (a + 0.7 * step, middle), (a + 0.7 * step, middle + size * v), (a, middle + size * v)]
        for a, v in zip(x, values, strict=True)
    ]
    sheet.polygons(corners, [color] * values.size)
    sheet.lines([[(left, middle), (left + width, middle)]], INK, 0.6)
    for i in range(0, values.size, max(1, values.size // 8)):
        sheet.text(x[i] + 0.35 * step + 0.03, bottom + foot - 0.03, str(dofs[i]), 5.5, "end", turn=90)


def mac_matrices(
    matrices: Sequence[tuple[str, ArrayLike, Sequence[str], Sequence[str], str, str]],
) -> str:
    """SVG: MAC matrices side by side with values in the cells.

    Parameters
    ----------
    matrices : sequence of (title, (rows, columns) array, row labels, column labels, row axis name, column axis name)
    """
    width, n = 10.2, len(matrices)
    panel = (width - 0.1) / max(n, 2) - 0.85
    heights = [panel * np.shape(m[1])[0] / max(np.shape(m[1])[1], 1) for m in matrices]
    tall = min(max(heights), 1.3 * panel)
    height = tall + 1.1
    sheet = Canvas(width, height)
    for k, (title, values, row_labels, column_labels, row_name, column_name) in enumerate(matrices):
        mac = np.asarray(values, float)
        rows, columns = mac.shape
        wide = min(panel, tall * columns / rows)
        high = wide * rows / columns
        x0, y0 = 0.78 + k * (panel + 0.85), height - 0.3 - high
        cell = wide / columns
        corner = [(x0 + j * cell, y0 + high - (i + 1) * cell) for i in range(rows) for j in range(columns)]
        side = 0.97 * cell
        corners = [[(x, y), (x + side, y), (x + side, y + side), (x, y + side)] for x, y in corner]
        sheet.polygons(corners, shades(np.clip(mac, 0, 1) / 1.15, WHITE_BLUE))
        size = float(np.clip(72 * cell * 0.34, 0, 8))
        label = min(8, size + 1.5)
        for (i, j), v in np.ndenumerate(mac):
            if v >= 0.005 and size >= 4.2:
                x, y = x0 + (j + 0.5) * cell, y0 + high - (i + 0.5) * cell - 0.35 * size / 72
                sheet.text(x, y, "1" if v > 0.995 else f"{v:.2f}"[1:], size, "middle", "white" if v > 0.6 else INK)
        for j, words in enumerate(column_labels):
            sheet.text(x0 + (j + 0.5) * cell + 0.35 * label / 72, y0 - 0.06, words, label, "end", turn=90)
        for i, words in enumerate(row_labels):
            sheet.text(x0 - 0.06, y0 + high - (i + 0.5) * cell - 0.35 * label / 72, words, label, "end")
        sheet.text(x0, y0 + high + 0.1, title, 10, bold=True)
        longest = max((len(words) for words in column_labels), default=0) * 0.56 * label / 72
        sheet.text(x0 + wide / 2, max(y0 - 0.26 - longest, 0.04), column_name, 9, "middle")
        sheet.text(x0 - 0.63, y0 + high / 2, row_name, 9, "middle", turn=90)
    return sheet.svg("Modal assurance criterion matrices: " + "; ".join(m[0] for m in matrices))


def conditioning(labels: Sequence[str], share: ArrayLike, modes: Sequence[str], mode_share: ArrayLike) -> str:
    """SVG: which sensors are nearly redundant and which combination of modes they barely tell apart, as shares of the weakest direction."""
    return _conditioning(labels, share, modes, mode_share)


@drawn
def _conditioning(labels: Sequence[str], share: ArrayLike, modes: Sequence[str], mode_share: ArrayLike) -> tuple[Figure, str]:
    figure = new_figure(10.2, 2.3)
    for left, names, values, color, title in (
        (0.06, labels, share, MODEL, "Sensors in the weakest direction"),
        (0.56, modes, mode_share, IDLE, "Idle modes in the weakest direction"),
    ):
        axes = figure.add_axes((left, 0.33, 0.43, 0.53))
        heights = 100 * np.asarray(values, float)
        axes.bar(np.arange(heights.size), heights, color=color, width=0.7)
        every = max(1, heights.size // 24)
        axes.set_xticks(np.arange(0, heights.size, every), list(names)[::every], rotation=90, fontsize=7)
        axes.set_ylabel("Share [%]")
        axes.set_title(title)
        axes.grid(True, axis="y")
        axes.tick_params(axis="x", length=0)
        axes.spines["left"].set_color(PALE)
    return figure, "Share of each sensor and each idle mode in the least well conditioned direction of the idle shape matrix"

"""Mode shapes and geometries in three dimensions, with axes and node names, still and moving."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data import Geometry, ModalModel, count_of, direction_of, expect
from operando.data.arrays import number_of
from operando.dof import Dof
from operando.errors import DataError, ObjectError
from operando.plots.mesh import Mesh, patches
from operando.plots.style import GREY, INK, MODEL, ORANGE_PURPLE, colormap, new_axes, short_name, style

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ELEVATION, AZIMUTH = 32.0, -58.0
"""View from the front right above [°]."""

_E, _A = np.radians((ELEVATION, AZIMUTH))
SEEN = np.array(
    [[-np.sin(_A), np.cos(_A), 0], [-np.sin(_E) * np.cos(_A), -np.sin(_E) * np.sin(_A), np.cos(_E)],
     [np.cos(_E) * np.cos(_A), np.cos(_E) * np.sin(_A), np.sin(_E)]]
).T  # fmt: skip
"""Turns points (n, 3) so that x lies to the right, y up and z towards the eye."""

LARGEST = 0.13
"""Greatest displacement drawn, as part of the diagonal of the structure."""

MOST_NAMES = 100
"""Measured nodes up to which names are written where nothing else is asked for."""

LEAST_SIDE = 0.12
"""Least side of the box that is drawn, as part of the diagonal: a chain or a plate has none across."""


def real_shape(shape: ArrayLike) -> NDArray[np.float64]:
    """A shape turned to the real axis (principal axis of its entries), greatest entry 1: for drawing only."""
    v = np.asarray(shape)
    if np.iscomplexobj(v):
        v = np.real(v * np.exp(-0.5j * np.angle(np.sum(v**2))))
    peak = float(np.max(np.abs(v))) if v.size else 0.0
    return np.asarray(v / peak if peak > 0 else v, float)


def plot_shape(
    model: ModalModel,
    mode: int = 0,
    geometry: Geometry | None = None,
    axes: Axes | None = None,
    *,
    scale: float = 1.0,
    names: bool | None = None,
) -> Axes:
    """One mode shape on the structure, deformed over undeformed, with axes and node names; as bars by DOF without a geometry.

    Colour is the displacement along the main direction of motion. Complex shapes are turned to the real axis.

    Parameters
    ----------
    model : ModalModel
        Model to draw.
    mode : int
        Number of the mode, from 0; negative from the end.
    geometry : Geometry, optional
        With the nodes of the DOFs.
    axes : matplotlib Axes, optional
        With ``projection="3d"`` for a geometry. Default: of a new figure, which can be turned by the mouse.
    scale : float
        Larger or smaller than usual, where the greatest displacement is 13 % of the diagonal.
    names : bool, optional
        Write node names; default: where 100 nodes at most are measured.

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    DataError
        If there is no such mode, or the geometry has fewer than two of the measured nodes.
    ObjectError
        If something else than a model or a geometry is given, or the axes are flat.

    Examples
    --------
    >>> import numpy as np, operando
    >>> model = operando.ModalModel([10.0], [0.01], np.array([[1.0], [0.5], [-1.0]]), "1+Z, 2+Z, 3+Z")
    >>> beam = operando.Geometry((1, 2, 3), np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), ((1, 2, 3),))
    >>> operando.plots.plot_shape(model, 0, beam).get_title()
    'Mode 0: 10.00 Hz, ζ 1.00 %'
    """
    k = _mode(model, mode)
    title = f"Mode {k}: {model.frequencies_hz[k]:.2f} Hz, ζ {100 * model.damping_ratios[k]:.2f} %"
    shape = real_shape(model.shapes[:, k])
    with style():
        if geometry is None:
            axes = new_axes(max(5.0, 1.2 + 0.3 * shape.size), 3.0) if axes is None else axes
            draw_bars(axes, model.dofs, shape)
            axes.set_ylabel("Shape, greatest DOF 1 [–]")
            axes.set_xlabel("DOF")
        else:
            mesh = _mesh(geometry, model.dofs)
            axes = new_axes(7.5, 6.0, "3d") if axes is None else axes
            draw_shape(axes, mesh, shape, scale=scale, names=mesh.measured.sum() <= MOST_NAMES if names is None else names)
        axes.set_title(title)
    return axes


def animate_shape(
    model: ModalModel,
    mode: int = 0,
    geometry: Geometry | None = None,
    axes: Axes | None = None,
    *,
    scale: float = 1.0,
    names: bool | None = None,
    frames: int = 24,
    seconds: float = 1.2,
) -> FuncAnimation:
    """One mode shape in motion; complex shapes move with their phases.

    Parameters
    ----------
    model : ModalModel
        Model to draw.
    mode : int
        Index of the mode.
    geometry : Geometry, optional
        Positions of the nodes.
    axes : matplotlib Axes, optional
        Default: of a new figure.
    scale : float
        Size of the deformation, 1 for the usual one.
    names : bool, optional
        Node names; default: where they have room.
    frames : int
        Pictures a period.
    seconds : float
        Duration of a period on the screen [s].

    Returns
    -------
    matplotlib FuncAnimation
        Keep it while it runs; ``.save("mode.gif")`` writes it, ``.to_jshtml()`` shows it in a notebook.

    Raises
    ------
    DataError, ObjectError
        As for :func:`plot_shape`; also without a geometry or without a frame.

    Examples
    --------
    >>> import numpy as np, operando
    >>> model = operando.ModalModel([10.0], [0.01], np.array([[1.0], [0.5], [-1.0]]), "1+Z, 2+Z, 3+Z")
    >>> beam = operando.Geometry((1, 2, 3), np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), ((1, 2, 3),))
    >>> moving = operando.plots.animate_shape(model, 0, beam, frames=3)
    >>> len(moving.to_jshtml()) > 1000
    True
    """
    from matplotlib.animation import FuncAnimation

    k = _mode(model, mode)
    count_of(frames, "frames", 24)
    if geometry is None:
        raise DataError("a shape moves on a geometry", hint="give geometry=read(file).geometry")
    shape = np.asarray(model.shapes[:, k], complex)
    shape = shape * np.exp(-0.5j * np.angle(np.sum(shape**2))) / (float(np.max(np.abs(shape))) or 1.0)
    mesh = _mesh(geometry, model.dofs)
    with style():
        axes = new_axes(7.5, 6.0, "3d") if axes is None else axes
        named = mesh.measured.sum() <= MOST_NAMES if names is None else names
        drawn = draw_shape(axes, mesh, shape.real, scale=scale, names=named)
        axes.set_title(f"Mode {k}: {model.frequencies_hz[k]:.2f} Hz, ζ {100 * model.damping_ratios[k]:.2f} %")
        figure = axes.get_figure(root=True)
        assert figure is not None

        def frame(n: int) -> list[Any]:
            return drawn.move(np.real(shape * np.exp(2j * np.pi * n / frames)))

        return FuncAnimation(figure, frame, frames=frames, interval=1000 * seconds / frames, blit=False)


def plot_geometry(geometry: Geometry, axes: Axes | None = None, *, dofs: Sequence[Dof] = (), names: bool | None = None) -> Axes:
    """Nodes, lines and faces with axes in metres and node names; measured directions as arrows.

    Parameters
    ----------
    geometry : Geometry
        Geometry to draw.
    axes : matplotlib Axes, optional
        With ``projection="3d"``. Default: of a new figure.
    dofs : sequence of Dof
        Measured directions, drawn as arrows.
    names : bool, optional
        Write node names; default: with 100 nodes at most.

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    ObjectError
        If something else than a geometry is given, or the axes are flat.

    Examples
    --------
    >>> import numpy as np, operando
    >>> beam = operando.Geometry((1, 2, 3), np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), ((1, 2, 3),))
    >>> operando.plots.plot_geometry(beam).get_xlabel()
    'x [m]'
    """
    expect(geometry, Geometry, "a geometry can be drawn here", "read(file).geometry is one")
    mesh = Mesh(geometry, [Dof(n, "Z") for n in geometry.nodes])
    with style():
        axes = new_axes(7.5, 6.0, "3d") if axes is None else axes
        place = _solid(axes)
        at = mesh.index
        _lines(place, [mesh.xyz[[at[n] for n in line if n in at]] for line in geometry.lines], "#5b6670", 0.9)
        corners = [mesh.xyz[[at[n] for n in face if n in at]] for face in geometry.faces]
        if corners:
            _faces(place, [c for c in corners if len(c) > 2], "#dbe4ee", 0.45)
            _lines(place, [np.vstack([c, c[:1]]) for c in corners], "#5b6670", 0.6)
        place.scatter(*mesh.xyz.T, s=14, color=MODEL, edgecolors=INK, linewidths=0.4, depthshade=False)
        arrows = [
            (mesh.xyz[mesh.index[d.node]], v)
            for d in dofs
            if d.node in mesh.index and (v := direction_of(d, geometry.directions)) is not None
        ]
        if arrows:
            start, way = np.array([a for a, _ in arrows]), np.array([v for _, v in arrows])
            place.quiver(*start.T, *way.T, length=0.1 * mesh.span, color=INK, linewidth=0.9, arrow_length_ratio=0.25)
        if len(geometry.nodes) <= MOST_NAMES if names is None else names:
            _names(place, geometry.nodes, mesh.xyz, mesh.span)
        _box(place, mesh.xyz if not arrows else np.vstack([mesh.xyz, start + 0.1 * mesh.span * way]), mesh.span)
        unclipped(place)
        axes.set_title(short_name(geometry.name) or f"{len(geometry.nodes)} nodes")
    return axes


class Drawn:
    """What of a shape has been drawn, so that it can be moved."""

    def __init__(self, mesh: Mesh, shape: NDArray[Any], scale: float = 1.0) -> None:
        move = mesh.displacements(np.asarray(shape, float))
        scale = number_of(scale, "scale", "1 is the usual size")
        self.mesh, self.size = mesh, LARGEST * scale * mesh.span
        self.peak = float(np.linalg.norm(move, axis=1).max(initial=0.0)) or 1.0
        main = np.linalg.svd(move, full_matrices=False)[2][0]
        self.direction = main * (1 if main[np.argmax(np.abs(main))] >= 0 else -1)
        joined = {n for group in (*mesh.faces, *mesh.edges) for n in group}
        self.alone = [n for n in np.flatnonzero(mesh.measured) if n not in joined]
        self.parts: dict[str, Any] = {}
        self.names: list[tuple[Any, int]] = []

    def placed(self, shape: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions of all nodes, and displacement along the main direction between −1 and 1."""
        move = self.mesh.displacements(np.asarray(shape, float))
        return self.mesh.xyz + move * (self.size / self.peak), move @ self.direction / self.peak

    def move(self, shape: NDArray[Any]) -> list[Any]:
        """Draw the same in another position."""
        moved, signed = self.placed(shape)
        mesh, parts = self.mesh, self.parts
        colors = colormap(ORANGE_PURPLE)
        if "faces" in parts:
            corners, values = patches(mesh.faces, moved, signed)
            parts["faces"].set_verts(corners)
            parts["faces"].set_facecolor(colors(0.5 + 0.46 * values))
        if "edges" in parts:
            parts["edges"].set_segments([moved[list(e)] for e in sorted(mesh.edges)])
        if "nodes" in parts:
            parts["nodes"]._offsets3d = tuple(moved[mesh.measured].T)
            parts["nodes"].set_facecolor(colors(0.5 + 0.5 * signed[mesh.measured]))
        for text, node in self.names:
            text.set_position_3d(moved[node] + self.mesh.span * 0.015)
        return [*parts.values(), *(t for t, _ in self.names)]


def draw_shape(axes: Axes, mesh: Mesh, shape: NDArray[Any], *, scale: float = 1.0, names: bool = False) -> Drawn:
    """A real shape on three-dimensional axes."""
    place = _solid(axes)
    drawn = Drawn(mesh, shape, scale)
    moved, signed = drawn.placed(shape)
    colors = colormap(ORANGE_PURPLE)
    _lines(place, [mesh.xyz[list(e)] for e in sorted(mesh.outline)], "#c3cbd3", 0.8)
    if mesh.faces:
        corners, values = patches(mesh.faces, moved, signed)
        drawn.parts["faces"] = _faces(place, corners, colors(0.5 + 0.46 * values), 1.0)
    if mesh.edges:
        drawn.parts["edges"] = _lines(place, [moved[list(e)] for e in sorted(mesh.edges)], *_edge_look(mesh))
    _lines(place, [np.array([mesh.xyz[n], moved[n]]) for n in drawn.alone], MODEL, 1.0)
    shown = mesh.measured
    drawn.parts["nodes"] = place.scatter(
        *moved[shown].T, s=16.0, c=colors(0.5 + 0.5 * signed[shown]), edgecolors=INK, linewidths=0.5, depthshade=False
    )
    if names:
        measured = np.flatnonzero(shown)
        texts = _names(place, [mesh.nodes[n] for n in measured], moved[shown], mesh.span)
        drawn.names = list(zip(texts, measured.tolist(), strict=True))
    turned = 2 * mesh.xyz[shown] - moved[shown]  # where half a period later stands, which an animation shows
    _box(place, np.vstack([mesh.xyz, moved[shown], turned]), mesh.span)
    return drawn


def draw_small(figure: Figure, box: Sequence[float], mesh: Mesh, shape: NDArray[Any]) -> None:
    """What :func:`draw_shape` shows, flat on the figure and without axes, as large as a box (left, bottom, width, height) [inch] allows."""
    from matplotlib.collections import CircleCollection, PathCollection, PolyCollection
    from matplotlib.path import Path

    thin = 0.65  # strokes and nodes against those of a figure
    drawn = Drawn(mesh, shape)
    moved, signed = drawn.placed(shape)
    shown = np.flatnonzero(mesh.measured)
    seen = np.vstack([mesh.xyz, moved[shown]]) @ SEEN[:, :2]
    low, high, room = seen.min(axis=0), seen.max(axis=0), np.array(box[2:])
    zoom = 0.96 * float(np.min(room / np.maximum(high - low, 1e-9 * mesh.span)))
    shift = np.append(box[:2] + room / 2 - zoom * (low + high) / 2, 0)
    still, moved = (zoom * points @ SEEN + shift for points in (mesh.xyz, moved))
    colors, inch = colormap(ORANGE_PURPLE), figure.dpi_scale_trans
    parts: list[tuple[float, Any]] = []  # each with what of it is nearest to the eye

    def strokes(ends: NDArray[np.float64], color: str, width: float) -> None:
        if ends.size:
            path = Path(ends[..., :2].reshape(-1, 2), np.tile([Path.MOVETO, Path.LINETO], len(ends)))
            made = PathCollection([path], facecolors="none", edgecolors=color, linewidths=thin * width, transform=inch)
            parts.append((ends[..., 2].max(), made))

    strokes(still[sorted(mesh.outline)], "#c3cbd3", 0.8)
    if mesh.faces:
        corners, values = patches(mesh.faces, moved, signed)
        far = np.argsort(corners[..., 2].mean(axis=1), kind="stable")
        fill = colors(0.5 + 0.46 * values[far])
        parts.append((corners[..., 2].max(), PolyCollection(list(corners[far, :, :2]), facecolors=fill, linewidths=0, transform=inch)))
    strokes(moved[sorted(mesh.edges)], *_edge_look(mesh))
    strokes(np.stack([still, moved], axis=1)[drawn.alone], MODEL, 1.0)
    far = shown[np.argsort(moved[shown, 2], kind="stable")]
    nodes = CircleCollection(
        [(4.0 * thin) ** 2], offsets=moved[far, :2], offset_transform=inch, facecolors=colors(0.5 + 0.5 * signed[far]), edgecolors=INK,
        linewidths=0.5 * thin,
    )  # fmt: skip
    parts.append((moved[shown, 2].max(), nodes))
    for _, part in sorted(parts, key=lambda p: p[0]):
        figure.add_artist(part)


def _edge_look(mesh: Mesh) -> tuple[str, float]:
    return ("#46525d", 0.9) if mesh.faces else (MODEL, 1.4)


def draw_bars(axes: Axes, dofs: Sequence[Dof], shape: NDArray[Any], color: str = MODEL, most: int = 40) -> None:
    """A shape as bars by DOF, where there is no geometry."""
    values = np.asarray(shape, float)
    values = values / (float(np.max(np.abs(values), initial=0.0)) or 1.0)
    axes.bar(np.arange(values.size), values, color=color, width=0.7)
    axes.axhline(0, color=INK, lw=0.6)
    every = max(1, -(-values.size // most))
    axes.set_xticks(np.arange(0, values.size, every), [str(d) for d in dofs][::every], rotation=90)
    axes.set_ylim(-1.05, 1.05)
    axes.set_yticks([-1, 0, 1])
    axes.tick_params(axis="x", length=0)


def _mode(model: object, mode: int) -> int:
    if not isinstance(model, ModalModel):
        raise ObjectError(f"shapes of a {type(model).__name__} cannot be drawn", hint="give a ModalModel; of a hybrid model its .modal")
    n = model.n_modes
    if not (isinstance(mode, int | np.integer) and -n <= mode < n):
        raise DataError(f"there is no mode {mode!r}", hint=f"the model has {n} modes, 0 to {n - 1}" if n else "the model has none")
    return int(mode) % n


def _mesh(geometry: object, dofs: Sequence[Dof]) -> Mesh:
    if not isinstance(geometry, Geometry):
        raise ObjectError(f"a {type(geometry).__name__} is no geometry", hint="read(file).geometry is one")
    mesh = Mesh(geometry, dofs)
    if not mesh.drawable:
        known = ", ".join(map(str, geometry.nodes[:12]))
        raise DataError("fewer than two measured nodes are in the geometry", hint=f"it has the nodes {known}; the shape has {dofs[0]}, …")
    return mesh


def _solid(axes: Axes) -> Any:
    if getattr(axes, "name", "") != "3d":
        raise ObjectError("flat axes cannot show a structure", hint='make them by figure.add_subplot(projection="3d")')
    return axes


def _lines(place: Any, segments: Sequence[NDArray[np.float64]], color: str, width: float) -> Any:
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    return place.add_collection3d(Line3DCollection(segments, colors=color, linewidths=width)) if len(segments) else None


def _faces(place: Any, corners: Any, colors: Any, alpha: float) -> Any:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    made = Poly3DCollection(list(corners), facecolors=colors, edgecolors="none", linewidths=0, alpha=None if alpha >= 1 else alpha)
    return place.add_collection3d(made)


def unclipped(place: Any) -> None:
    """Draw what lies beyond the square of the axes, too: a flat structure is wider than it."""
    for part in (*place.collections, *place.lines):
        part.set_clip_on(False)


def _names(place: Any, nodes: Sequence[object], xyz: NDArray[np.float64], span: float) -> list[Any]:
    return [place.text(*(p + 0.015 * span), str(n), fontsize=7.5, color="#46525d", zorder=20) for n, p in zip(nodes, xyz, strict=True)]


def _box(place: Any, points: NDArray[np.float64], span: float) -> None:
    """Equal scales in all directions, and words at the axes."""
    from matplotlib.ticker import MaxNLocator

    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, LEAST_SIDE * span / 2) * 1.02
    place.set_proj_type("ortho")
    place.view_init(ELEVATION, AZIMUTH)
    place.set_box_aspect(tuple(half / half.max()))
    for name, m, h in zip("xyz", middle, half, strict=True):
        getattr(place, f"set_{name}lim")(m - h, m + h)
        getattr(place, f"set_{name}label")(f"{name} [m]")
        axis = getattr(place, f"{name}axis")
        axis.set_major_locator(MaxNLocator(5 if h > 0.5 * half.max() else 3))
        axis.set_pane_color((0.97, 0.98, 0.99, 1.0))
        axis.line.set_color(GREY)
        axis.labelpad = 8
    place.tick_params(labelsize=7.5, colors=INK)

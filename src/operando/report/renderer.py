"""What matplotlib draws, written as small SVG at once: short numbers, no groups, what stands in many places said once."""

from __future__ import annotations

import base64
import hashlib
import io
from collections.abc import Sequence
from functools import lru_cache
from itertools import cycle, pairwise
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from matplotlib.backend_bases import RendererBase
from matplotlib.colors import to_rgba
from matplotlib.font_manager import findfont, get_font, weight_dict
from matplotlib.path import Path
from matplotlib.textpath import text_to_path
from matplotlib.transforms import Affine2D

LONG_PATH = 17
"""Points from which a path of straight pieces is a curve of data: a tenth of a point is below a seventh of its line's width on paper."""

FONTS = ("DejaVu Sans", "sans-serif", "sans serif", "sans")
"""Families that the page replaces by its own."""

OWN_FONT = ["DejaVu Sans"]
"""The one that figures of the report are measured with: that of their style, shipped with matplotlib."""

HATCH = 72
"""Side of the square of a hatch [pt]."""

_LETTERS: dict[int, str] = {int(Path.MOVETO): "M", int(Path.LINETO): "L", int(Path.CURVE3): "Q", int(Path.CURVE4): "C"}
_STRAIGHT = {int(Path.MOVETO): "M%.7g %.7g", int(Path.LINETO): " %.7g %.7g", int(Path.CLOSEPOLY): "z", int(Path.STOP): ""}
_ANCHORS = {"left": "start", "center": "middle", "right": "end"}
_MARK = "\0"  # stands for the drawing's own prefix in its ids until the prefix, made of the content, is known


def short(value: float) -> str:
    """A number with two decimals at most."""
    return f"{round(float(value), 2) + 0.0:.8g}"


def _hex(color: Any) -> str:
    return f"#{round(255 * color[0]):02x}{round(255 * color[1]):02x}{round(255 * color[2]):02x}"


class SmallSvg(RendererBase):
    """Renderer of a figure of a size in points.

    Parameters
    ----------
    width, height : float
        Size [pt].
    dpi : float
        Pixels of images in an inch.
    """

    def __init__(self, width: float, height: float, dpi: float) -> None:
        super().__init__()
        self.width, self.height, self.dpi = width, height, dpi
        self._body: list[str] = []
        self._shared: dict[str, str] = {}
        self._many = False
        self._heights: dict[Any, tuple[float | None, ...]] = {}

    def text(self) -> str:
        """All that was drawn, with ids that hold for this content alone."""
        shared = "".join(content.replace(" ", f' id="{key}" ', 1) for content, key in self._shared.items())
        body = (f"<defs>{shared}</defs>" if shared else "") + "\n".join(self._body)
        return body.replace(_MARK, "f" + hashlib.sha256(body.encode()).hexdigest()[:10] + "-")

    def _key(self, content: str) -> str:
        """Id of an element that others refer to."""
        return self._shared.setdefault(content, f"{_MARK}{len(self._shared)}")

    def flipy(self) -> bool:
        """Texts are placed from the top."""
        return True

    def get_canvas_width_height(self) -> tuple[float, float]:
        """Size [pt]."""
        return self.width, self.height

    def get_text_width_height_descent(self, s: str, prop: Any, ismath: Any) -> tuple[float, float, float]:
        """Size of a text [pt], unhinted: the browser scales it."""
        return _own_text_size(s, prop) if not ismath and prop.get_family() == OWN_FONT else _text_size(s, prop, ismath)

    def _get_font_height_metrics(self, prop: Any) -> tuple[float | None, ...]:
        """Ascent, descent and gap between lines of a font [pt], which matplotlib (from 3.11 on) looks up for each text otherwise."""
        if prop not in self._heights:
            self._heights[prop.copy()] = _height_metrics(prop)
        return self._heights[prop]

    def option_scale_image(self) -> bool:
        """Images are scaled by the browser."""
        return True

    def option_image_nocomposite(self) -> bool:
        """Images stay apart."""
        return True

    def get_image_magnification(self) -> float:
        """Pixels of an image in a point."""
        return self.dpi / 72

    def draw_path(self, gc: Any, path: Any, transform: Any, rgbFace: Any = None) -> None:
        """One line or area."""
        if self._many:
            a = transform.get_matrix()
            self.draw_markers(
                gc, path, Affine2D.from_values(a[0, 0], a[1, 0], a[0, 1], a[1, 1], 0, 0), Path(a[None, :2, 2]), Affine2D(), rgbFace
            )
            return
        line = rgbFace is None and gc.get_hatch_path() is None
        clip = (0.0, 0.0, self.width, self.height) if line else None
        d = _outline(path, transform, self.height, line and path.should_simplify, clip, gc.get_sketch_params())
        if d:
            self._body.append(f'<path d="{d}"{self._look(gc, rgbFace)}/>')

    def draw_markers(
        self, gc: Any, marker_path: Any, marker_trans: Any, path: Any, trans: Any, rgbFace: Any = None
    ) -> None:  # fmt: skip
        """One mark in many places."""
        ends = [points[-2:].tolist() for points, _ in path.iter_segments(trans, simplify=False) if len(points)]
        wide, high = self.width, self.height
        places = [(x, high - y) for x, y in ends if -wide < x < 2 * wide and -high < y < 2 * high]
        if places:
            mark = self._key(f'<path d="{_outline(marker_path, marker_trans)}"/>')
            used, look = [f'<use href="#{mark}" x="{short(x)}" y="{short(y)}"' for x, y in places], self._look(gc, rgbFace)
            alone = len(used) == 1 and "clip-path" not in look  # which would move with the mark
            self._body.append(f"{used[0]}{look}/>" if alone else f"<g{look}>{'/>'.join(used)}/></g>")

    def draw_path_collection(
        self, gc: Any, master_transform: Any, paths: Any, all_transforms: Any, offsets: Any, offset_trans: Any, facecolors: Any,
        edgecolors: Any, linewidths: Any, linestyles: Any, *rest: Any, **more: Any,
    ) -> None:  # fmt: skip
        """Lines, areas or one mark in many places."""
        in_place = len(paths) > 1 == len(offsets) and not len(all_transforms) and not np.any(offsets)
        alike = max(len(edgecolors), len(linewidths), len(linestyles)) < 2 and gc.get_hatch_path() is None
        if in_place and alike and gc.get_sketch_params() is None and (ready := _polygons(paths, master_transform, self.height)):
            self._draw_areas(gc, ready, facecolors, edgecolors, linewidths, linestyles)
            return
        self._many = len(paths) == 1 < len(offsets)
        colors = facecolors, edgecolors, linewidths, linestyles
        super().draw_path_collection(gc, master_transform, paths, all_transforms, offsets, offset_trans, *colors, *rest, **more)
        self._many = False

    def _draw_areas(self, gc: Any, ready: list[str], faces: Any, edges: Any, widths: Any, dashes: Any) -> None:
        """Areas of one outline, each in its colour: as matplotlib goes through them, with what they share done once."""
        own: Any = self.new_gc()
        own.copy_properties(gc)
        for width in widths:
            own.set_linewidth(width)
        for dash in dashes:
            own.set_dashes(*dash)
        edge = to_rgba(edges[0]) if len(edges) else (0, 0, 0, 0)
        if edge[3] == 0:
            own.set_linewidth(0)
        else:
            own.set_foreground(edge, isRGBA=True)
        looks: dict[Any, str] = {}
        for d, color in zip(ready, cycle([tuple(face) for face in faces] or [()]), strict=False):
            if color not in looks:
                looks[color] = self._look(own, None if not color or color[3:] == (0,) else color)
            self._body.append(f'<path d="{d}"{looks[color]}/>')

    def draw_gouraud_triangles(self, gc: Any, triangles_array: Any, colors_array: Any, transform: Any) -> None:
        """Triangles, each in the mean of its colours."""
        gc.set_linewidth(0)
        for corners, colors in zip(triangles_array, colors_array, strict=True):
            self.draw_path(gc, Path([*corners, corners[0]], closed=True), transform, colors.mean(axis=0))

    def draw_image(self, gc: Any, x: float, y: float, im: Any, transform: Any = None) -> None:
        """Pixels, the first row below."""
        from PIL import Image

        high, wide = im.shape[:2]
        if not high or not wide:
            return
        stream = io.BytesIO()
        Image.fromarray(im).save(stream, format="png")
        if transform is None:
            pixel, style = Affine2D().scale(72 / self.dpi), {}
        else:
            pixel, style = Affine2D().scale(1 / wide, 1 / high) + transform, {"image-rendering": "pixelated"}
            style["opacity"] = "" if gc.get_alpha() in (None, 1) else short(gc.get_alpha())
        onto = pixel + Affine2D().translate(x, y).scale(1, -1).translate(0, self.height)
        matrix = " ".join(f"{v:.8g}" for v in onto.get_matrix()[:2].T.ravel())
        data = base64.b64encode(stream.getvalue()).decode()
        self._body.append(
            f'<g{self._clip(gc)}><image width="{wide}" height="{high}" transform="matrix({matrix})" style="{_css(style)}" '
            f'href="data:image/png;base64,{data}"/></g>'
        )

    def draw_text(self, gc: Any, x: float, y: float, s: str, prop: Any, angle: float, ismath: Any = False, mtext: Any = None) -> None:
        """A line of text in the font of the page; formulas as outlines."""
        if ismath:
            super().draw_text(gc, x, y, s, prop, angle, ismath, mtext)
            return
        weight = prop.get_weight()
        style = {"font-size": f"{short(prop.get_size())}px", "font-weight": str(weight_dict.get(weight, weight)).replace("400", "")}
        style |= {f"font-{k}": getattr(prop, f"get_{k}")().replace("normal", "") for k in ("style", "variant")}
        if (family := prop.get_family())[0] not in FONTS:
            style["font-family"] = ", ".join(f"'{name}'" for name in family)
        color = gc.get_rgb()
        alpha = gc.get_alpha() if gc.get_forced_alpha() else color[3]
        style |= {"fill": _hex(color), "opacity": "" if alpha == 1 else short(alpha)}
        if mtext and (angle == 0 or mtext.get_rotation_mode() == "anchor"):  # the letters of the reader may be wider or narrower
            at = np.array(mtext.get_transform().transform(mtext.get_unitless_position()))
            at[1] = self.height - at[1]
            down = np.array([np.sin(np.radians(angle)), np.cos(np.radians(angle))])
            x, y = at + down @ ([x, y] - at) * down
            style["text-anchor"] = _ANCHORS[mtext.get_horizontalalignment()]
        turn = f' transform="rotate({-angle:.8g} {short(x)} {short(y)})"' if angle else ""
        look = quoteattr(_css(style))
        element = f'<text x="{short(x)}" y="{short(y)}" style={look}{turn}>{escape(s)}</text>'
        clip = self._clip(gc)  # around it: the text may be turned
        self._body.append(f"<g{clip}>{element}</g>" if clip else element)

    def _clip(self, gc: Any) -> str:
        path, transform = gc.get_clip_path()
        box = gc.get_clip_rectangle()
        if path is not None:
            shape = f'<path d="{_outline(path, transform, self.height)}"/>'
        elif box is not None:
            x, y, wide, high = box.bounds
            shape = f'<rect x="{short(x)}" y="{short(self.height - y - high)}" width="{short(wide)}" height="{short(high)}"/>'
        else:
            return ""
        return f' clip-path="url(#{self._key(f"<clipPath >{shape}</clipPath>")})"'

    def _look(self, gc: Any, face: Any) -> str:
        """Attributes of a line or area."""
        alpha, forced = gc.get_alpha(), gc.get_forced_alpha()
        style = {"fill": "none" if face is None else _hex(face), "opacity": "" if not forced or alpha == 1 else short(alpha)}
        if face is not None and len(face) == 4 and face[3] != 1 and not forced:
            style["fill-opacity"] = short(face[3])
        if gc.get_hatch_path() is not None:
            style["fill"] = f"url(#{self._hatch(gc, style['fill'])})"
        if width := gc.get_linewidth():
            color, (offset, dashes) = gc.get_rgb(), gc.get_dashes()
            cap = gc.get_capstyle()
            style |= {
                "stroke": _hex(color),
                "stroke-opacity": "" if forced or color[3] == 1 else short(color[3]),
                "stroke-width": "" if width == 1 else f"{width:.3g}",
                "stroke-linejoin": str(gc.get_joinstyle()).replace("round", ""),
                "stroke-linecap": {"butt": "", "projecting": "square"}.get(cap, cap),
                "stroke-dasharray": "" if dashes is None else ",".join(map(short, dashes)),
                "stroke-dashoffset": short(offset) if dashes is not None and offset else "",
            }
        return f' style="{_css(style)}"{self._clip(gc)}'

    def _hatch(self, gc: Any, fill: str) -> str:
        d = _outline(gc.get_hatch_path(), Affine2D().scale(HATCH), HATCH)
        color = _hex(gc.get_hatch_color())
        ground = f'<rect width="{HATCH + 1}" height="{HATCH + 1}" fill="{fill}"/>'
        lines = f'<path d="{d}" fill="{color}" stroke="{color}" stroke-width="{short(gc.get_hatch_linewidth())}"/>'
        return self._key(f'<pattern patternUnits="userSpaceOnUse" width="{HATCH}" height="{HATCH}">{ground}{lines}</pattern>')


_text_size = text_to_path.get_text_width_height_descent


@lru_cache(4096)
def _own_text_size(s: str, prop: Any) -> tuple[float, float, float]:
    """Size of a text in the font of all figures, in which many show the same numbers."""
    return _text_size(s, prop, False)


def _css(style: dict[str, str]) -> str:
    return ";".join(f"{name}:{value}" for name, value in style.items() if value)


def _polygons(paths: Sequence[Any], transform: Any, top: float) -> list[str]:
    """Path data as :func:`_outline` makes it for areas of the same few straight sides, all at once; nothing for others."""
    first = paths[0].codes
    codes = None if first is None else first.tobytes()
    corners = len(paths[0].vertices)
    alike = all(len(p.vertices) == corners and codes == (None if p.codes is None else p.codes.tobytes()) for p in paths)
    letters = [Path.MOVETO] + [Path.LINETO] * (corners - 1) if first is None else first.tolist()
    closed = letters[-1] == Path.CLOSEPOLY
    sides = letters[1:-1] if closed else letters[1:]
    if not alike or corners >= LONG_PATH or letters[0] != Path.MOVETO or set(sides) != {Path.LINETO}:
        return []
    points = np.array([p.vertices[: 1 + len(sides)] for p in paths], float)
    if np.ma.isMaskedArray(paths[0].vertices) or not np.all(np.isfinite(points)):
        return []
    a = transform.get_matrix()
    x, y = (points[..., 0] * a[i, 0] + points[..., 1] * a[i, 1] + a[i, 2] for i in (0, 1))
    placed = np.round(np.stack([x, y], axis=-1) * (1, -1) + (0, top), 2) + 0.0  # no −0
    form = "M%.7g %.7g" + " %.7g %.7g" * len(sides) + ("z" if closed else "")
    return [form % tuple(row) for row in placed.reshape(len(paths), -1).tolist()]


def _height_metrics(prop: Any) -> tuple[float | None, ...]:
    """What the font says of itself, in its size, or nothing."""
    font: Any = get_font(findfont(prop))
    for name, gap, ascent, descent in (
        ("OS/2", "sTypoLineGap", "sTypoAscender", "sTypoDescender"),
        ("hhea", "lineGap", "ascent", "descent"),
    ):
        if (table := font.get_sfnt_table(name)) is not None:
            scale = 1 / font.get_sfnt_table("head")["unitsPerEm"] * prop.get_size_in_points()
            return table[ascent] * scale, -table[descent] * scale, table[gap] * scale
    return None, None, None


def _outline(
    path: Any, transform: Any, top: float = 0.0, simplify: bool = False, clip: Sequence[float] | None = None, sketch: Any = None
) -> str:
    """Path data, y from the top: curves in tenths of a point, marks in hundredths."""
    clean = path.cleaned(transform, remove_nans=True, clip=clip, simplify=simplify, curves=True, sketch=sketch)
    codes: list[int] = clean.codes.tolist()
    round_parts = {int(Path.CURVE3), int(Path.CURVE4)} & set(codes)  # letters and marks have them, curves of data do not
    digits = 1 if len(codes) > LONG_PATH and not round_parts else 2
    points = np.round(clean.vertices * (1, -1) + (0, top), digits) + 0.0  # no −0
    if not round_parts and not any(b == Path.LINETO for a, b in pairwise(codes) if a == Path.CLOSEPOLY):
        form = "".join(map(_STRAIGHT.__getitem__, codes))
        return form % tuple(points[(clean.codes == Path.MOVETO) | (clean.codes == Path.LINETO)].ravel().tolist())
    pieces, taken, last = [], [], 0
    for k, code in enumerate(codes):
        if code in _LETTERS:  # the letter stands once for a run, and M is followed by lines
            same = (code == last and code != Path.MOVETO) or (last == Path.MOVETO and code == Path.LINETO)
            pieces.append(" %.7g %.7g" if same else _LETTERS[code] + "%.7g %.7g")
            taken.append(k)
        elif code == Path.CLOSEPOLY:
            pieces.append("z")
        last = code
    return "".join(pieces) % tuple(points[taken].ravel().tolist())

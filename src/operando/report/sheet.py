"""Figures whose axes have one tick that is put at each place in turn: a tick is five artists, and dearer to make than to draw."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis, XAxis, YAxis
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FixedFormatter, FixedLocator, NullLocator


class _Moving:
    """One tick at each of its places, with the number there."""

    def __init__(self, tick: Any, places: list[tuple[float, str]]) -> None:
        self.tick, self.places = tick, places

    def __iter__(self) -> Iterator[_Moving]:
        yield self  # to be drawn

    def _each(self) -> Iterator[Any]:
        for place, word in self.places:
            self.tick.update_position(place)
            self.tick.label1.set_text(word)
            self.tick.label2.set_text(word)
            yield self.tick

    def boxes(self, renderer: Any) -> tuple[list[Any], list[Any]]:
        """Boxes of the labels on either side."""
        found: tuple[list[Any], list[Any]] = [], []
        for tick in self._each():
            for label, boxes in zip((tick.label1, tick.label2), found, strict=True):
                if label.get_visible() and label.get_in_layout():
                    boxes.append(label.get_window_extent(renderer))
        return found

    def draw(self, renderer: Any) -> None:
        """Draw all lines of the grid as one, all marks of a kind as one, then the labels."""
        tick = self.tick
        if not self.places or not tick.get_visible():
            return
        for line in (tick.gridline, tick.tick1line, tick.tick2line):
            if line.get_visible():
                self._draw_at_all(line, renderer)
        for each in self._each():
            each.label1.draw(renderer)
            each.label2.draw(renderer)

    def _draw_at_all(self, line: Any, renderer: Any) -> None:
        """Draw what a line is at one place at all places, by one path with gaps."""
        along, across = (0, 1) if self.tick.__name__ == "xtick" else (1, 0)
        one = line.get_data(orig=True)
        part = [*one[across], np.nan] if len(one[across]) > 1 else one[across]
        data: list[Any] = [None, None]
        data[along] = np.repeat([place for place, _ in self.places], len(part))
        data[across] = np.tile(part, len(self.places))
        line.set_data(*data)
        line.draw(renderer)
        line.set_data(*one)


class _OneTick(Axis):
    _boxes: Any = None  # of the labels of the ticks, while the axis is drawn

    def draw(self, *args: Any, **kwargs: Any) -> None:
        """Draw the axis; matplotlib measures the labels of its ticks three times for it, which do not move in between."""
        self._boxes = ()
        with self._no_minor_made() if isinstance(self.get_minor_locator(), NullLocator) else nullcontext():
            first = self.get_major_ticks(1)[0]
            labels: list[Any] = [label for label in (first.label1, first.label2) if label.get_visible()]
            for label in labels:
                label._get_layout = _known_layout(label)
            super().draw(*args, **kwargs)
            for label in labels:
                del label._get_layout
        self._boxes = None

    def _get_ticklabel_bboxes(self, ticks: Any, renderer: Any) -> Any:
        made: Any = super()
        if self._boxes:
            return self._boxes
        boxes = ticks.boxes(renderer) if isinstance(ticks, _Moving) else made._get_ticklabel_bboxes(ticks, renderer)
        if self._boxes is not None:
            self._boxes = boxes
        return boxes

    def set_clip_path(self, path: Any, transform: Any = None) -> None:
        """Clip the axis and its ticks."""
        with self._no_minor_made():
            super().set_clip_path(path, transform)

    def set_tick_params(self, *args: Any, **kwargs: Any) -> None:
        """Set the look of ticks, of those that are there and of later ones."""
        with self._no_minor_made():
            super().set_tick_params(*args, **kwargs)

    @contextmanager
    def _no_minor_made(self) -> Iterator[None]:
        """Minor ticks, which few axes have, are made where they are drawn, and not to be asked or set a look."""
        if "minorTicks" in self.__dict__:
            yield
            return
        self.minorTicks: list[Any] = []
        yield
        if not self.__dict__.get("minorTicks"):
            self.__dict__.pop("minorTicks", None)  # the first tick of the axis that is made resets both kinds

    def _get_tick(self, major: bool) -> Any:
        made: Any = super()
        tick = made._get_tick(major)
        if not major:
            tick.set_clip_path(self.axes.patch)
        return tick

    def _update_ticks(self) -> Any:
        """The ticks as matplotlib asks for them to draw and to measure; all of them where they were touched one by one."""
        made: Any = super()
        if len(self.majorTicks) > 1 or not isinstance(self.get_minor_locator(), NullLocator):
            return made._update_ticks()
        places: Any = self.get_majorticklocs()
        words = self.get_major_formatter().format_ticks(places)
        scale = self.get_transform().transform
        low, high = sorted(scale(self.get_view_interval()))
        slack = 1e-10 * (high - low)  # as matplotlib's
        inside = [low - slack <= at <= high + slack for at in scale(places)]
        return _Moving(self.majorTicks[0], [(p, w) for p, w, here in zip(places, words, inside, strict=True) if here])

    def set_ticks(self, ticks: Any, labels: Any = None, *, minor: bool = False, **kwargs: Any) -> Any:
        """Places and their names, in letters of one size and direction; as matplotlib does it where more is asked for."""
        if minor or not len(ticks) or not set(kwargs) <= {"fontsize", "rotation"}:
            return super().set_ticks(ticks, labels, minor=minor, **kwargs)
        this: Any = self
        for axis in this._get_shared_axis():
            axis.set_view_interval(min(ticks), max(ticks))
        self.set_major_locator(FixedLocator(ticks))
        if labels is not None:
            self.set_major_formatter(FixedFormatter(labels))
            self.set_tick_params(**{{"fontsize": "labelsize", "rotation": "labelrotation"}[name]: value for name, value in kwargs.items()})
        return self.majorTicks

    def get_majorticklabels(self) -> Any:
        """The texts of all ticks, which are made for it."""
        self.get_major_ticks()
        return super().get_majorticklabels()


class _X(_OneTick, XAxis):
    pass


class _Y(_OneTick, YAxis):
    pass


class _Axes(Axes):
    def _init_axis(self) -> None:  # as in matplotlib's example of a projection of one's own
        self.xaxis, self.yaxis = _X(self, clear=False), _Y(self, clear=False)
        for name, spine in self.spines.items():
            spine.register_axis(self.xaxis if name in ("top", "bottom") else self.yaxis)


def _known_layout(label: Any) -> Callable[[Any], Any]:
    """Where the letters of a label lie about its place, found once for each word it is given."""
    known: dict[str, Any] = {}

    def layout(renderer: Any) -> Any:
        word = label.get_text()
        if word not in known:
            known[word] = Text._get_layout(label, renderer)  # type: ignore[attr-defined]
        return known[word]

    return layout


class Sheet(Figure):
    """A figure of the report."""

    def add_axes(self, *args: Any, **kwargs: Any) -> Axes:
        """Axes with one tick; those of a projection as matplotlib makes them."""
        return super().add_axes(*args, **kwargs if "projection" in kwargs else {"axes_class": _Axes} | kwargs)

"""Figures whose axes have one tick that is put at each place in turn: a tick is five artists, and dearer to make than to draw."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

from matplotlib.axes import Axes
from matplotlib.axis import Axis, XAxis, YAxis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedFormatter, FixedLocator, NullLocator


class _Moving:
    """One tick at each of its places, with the number there."""

    def __init__(self, tick: Any, places: list[tuple[float, str]]) -> None:
        self.tick, self.places = tick, places

    def __iter__(self) -> Iterator[Any]:
        for place, word in self.places:
            self.tick.update_position(place)
            self.tick.label1.set_text(word)
            self.tick.label2.set_text(word)
            yield self.tick


class _OneTick(Axis):
    _boxes: list[Any] | None = None  # of the labels of the ticks, while the axis is drawn

    def draw(self, *args: Any, **kwargs: Any) -> None:
        """Draw the axis; matplotlib measures the labels of its ticks twice for it, which do not move in between."""
        self._boxes = []
        with self._no_minor_made() if isinstance(self.get_minor_locator(), NullLocator) else nullcontext():
            super().draw(*args, **kwargs)
        self._boxes = None

    def _get_ticklabel_bboxes(self, ticks: Any, renderer: Any) -> Any:
        made: Any = super()
        if self._boxes is None:
            return made._get_ticklabel_bboxes(ticks, renderer)
        if not self._boxes:
            self._boxes.append(made._get_ticklabel_bboxes(ticks, renderer))
        return self._boxes[0]

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


class Sheet(Figure):
    """A figure of the report."""

    def add_axes(self, *args: Any, **kwargs: Any) -> Axes:
        """Axes with one tick; those of a projection as matplotlib makes them."""
        return super().add_axes(*args, **kwargs if "projection" in kwargs else {"axes_class": _Axes} | kwargs)

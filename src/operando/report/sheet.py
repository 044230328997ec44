"""Figures whose axes have one tick that is put at each place in turn: a tick is five artists, and dearer to make than to draw."""

from __future__ import annotations

from collections.abc import Iterator
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

"""Figures of time records: samples, power spectral densities, force spectra, hits over one another with their numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Channel, TimeRecord, expect, ordered_band
from operando.errors import DataError
from operando.plots.style import CYCLE, IDLE, INK, MEASURED, PURPLE, frequency_axis, log_axis, new_axes, new_stack, short_name, style, thin
from operando.printable import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from operando.quality import Pulse

DRAWN = "a time record can be drawn here", "read(file).records[0] is one"
"""What figures say of what is none, and what to do."""

SYMBOLS = {"m/s2": "m/s²", "rad/s2": "rad/s²", "N m": "N·m"}


def unit_words(unit: str) -> str:
    """Unit of a channel as people write it; that it is not known where it is empty."""
    return SYMBOLS.get(unit, unit) or "unit of the file"


def plot_record(record: TimeRecord, axes: Axes | None = None, *, channels: object = None) -> Axes:
    """Samples over time, each channel below the other; what findings mark is shaded.

    Parameters
    ----------
    record : TimeRecord
        One record.
    axes : matplotlib Axes, optional
        All channels over one another, which needs one quantity. Default: a new figure with a place for each.
    channels : DOF labels or channel names, optional
        Default: the first eight.

    Returns
    -------
    matplotlib Axes
        The topmost.

    Raises
    ------
    DofError
        If a channel is not in the record.
    DataError
        If channels of different units are to be drawn into the same axes.

    Examples
    --------
    >>> import numpy as np, operando
    >>> channel = operando.Channel(operando.Dof.parse("3+Z"), "acceleration", "m/s2")
    >>> record = operando.TimeRecord(np.sin(np.arange(1000.0))[None], 1000.0, (channel,))
    >>> operando.plots.plot_record(record).get_ylabel()
    '3+Z\\n[m/s²]'
    """
    part, total = _part(record, channels)
    with style():
        n = part.data.shape[0]
        if axes is None:
            places = new_stack([1.0] * n, [c.label or f"channel {k}" for k, c in enumerate(part.channels)], 9.0, 0.9 + 0.95 * n)
        else:
            _one_unit(part)
            places = [axes] * n
        for k, (channel, place) in enumerate(zip(part.channels, places, strict=True)):
            t, y = _outline(part, k)
            color = CYCLE[k % len(CYCLE)] if axes is not None else IDLE if channel.is_force else MEASURED
            place.plot(t, y, color=color, lw=0.7, label=channel.label)
            place.grid(True)
            place.margins(x=0)
            if axes is None:
                place.set_ylabel(f"{printable(channel.label)}\n[{unit_words(channel.unit)}]", fontsize=8)
                mark_findings(place, record, channel)
        top = places[0]
        places[-1].set_xlabel("Time [s]")
        if axes is not None:
            axes.set_ylabel(_quantity(part.channels[0]))
            axes.legend(loc="best", ncols=2)
        elif record.name or n < total:
            words = f"{n} of {total} channels" if n < total else ""
            top.set_title("; ".join(w for w in (short_name(record.name), words) if w))
    return top


def plot_psd(
    record: TimeRecord,
    axes: Axes | None = None,
    *,
    channels: object = None,
    block_seconds: float | None = None,
    band: tuple[float, float] | None = None,
) -> Axes:
    """Power spectral densities (Welch: Hann blocks, half overlapped).

    Parameters
    ----------
    record : TimeRecord
        One record.
    axes : matplotlib Axes, optional
        Default: of a new figure; channels of different units stand in axes of their own.
    channels : DOF labels or channel names, optional
        Default: the first eight.
    block_seconds : float, optional
        Length of a block [s]. Default: for some 2000 lines, and 15 averages at least.
    band : (float, float), optional
        Band shown [Hz].

    Returns
    -------
    matplotlib Axes
        The topmost.

    Raises
    ------
    DofError
        If a channel is not in the record.
    DataError
        If the record is shorter than a block, the band holds nothing of it,
        or channels of different units are to be drawn into the same axes.

    Examples
    --------
    >>> import numpy as np, operando
    >>> channel = operando.Channel(operando.Dof.parse("3+Z"), "acceleration", "m/s2")
    >>> noise = np.random.default_rng(1).normal(size=(1, 5000))
    >>> operando.plots.plot_psd(operando.TimeRecord(noise, 1000.0, (channel,))).get_ylabel()
    'Acceleration [(m/s²)²/Hz]'
    """
    part, total = _part(record, channels)
    kinds = list(dict.fromkeys((c.quantity, c.unit) for c in part.channels))
    if axes is not None:
        _one_unit(part)
    from operando.quality import densities

    f, psd = densities(part, block_seconds)
    _expect_lines(band, f[-1])
    with style():
        places = new_stack([1.0] * len(kinds), [q for q, _ in kinds], 9.0, 1.0 + 2.6 * len(kinds)) if axes is None else [axes]
        draw_densities(places, part.channels, f, psd, band)
        if axes is None:
            words = [short_name(record.name), f"{part.data.shape[0]} of {total} channels" if part.data.shape[0] < total else ""]
            places[0].set_title("; ".join(w for w in words if w))
    return places[0]


def plot_force_spectra(
    record: TimeRecord, axes: Axes | None = None, *, band: tuple[float, float] | None = None, block_seconds: float | None = None
) -> Axes:
    """What the forces excite: the spectrum of each hit of a hammer record, else the power spectral density of each force.

    A hit excites usefully up to where its spectrum has fallen by some 10 to 20 dB, and nothing at its notches.

    Parameters
    ----------
    record : TimeRecord
        With forces.
    axes : matplotlib Axes, optional
        Default: of a new figure.
    band : (float, float), optional
        Band shown [Hz].
    block_seconds : float, optional
        Length of a block of the density [s].

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    DataError
        If the record has no force, the band holds nothing of it.

    Examples
    --------
    >>> import numpy as np, operando
    >>> force = np.zeros((1, 4000)); force[0, 500:503] = force[0, 2500:2503] = [40.0, 100.0, 40.0]
    >>> channel = operando.Channel(operando.Dof.parse("3+Z"), "force", "N")
    >>> operando.plots.plot_force_spectra(operando.TimeRecord(force, 1000.0, (channel,))).get_ylabel()
    'Force spectrum of each hit [N·s]'
    """
    expect(record, TimeRecord, *DRAWN)
    rows = record.force_indices
    if not rows:
        raise DataError(
            "the record has no force", where=record.name or None, hint="a channel is a force by its quantity: [channels] names it"
        )
    from operando.quality import pulses

    hits = pulses(record)
    if not hits:
        return plot_psd(record.select(rows), axes, band=band, block_seconds=block_seconds)
    _expect_lines(band, record.sampling_hz / 2)
    with style():
        axes = new_axes(9.0, 4.0) if axes is None else axes
        draw_force_spectra(axes, hits, record.channels[rows[0]], record.sampling_hz, band)
    return axes


def plot_hits(record: TimeRecord, axes: Axes | None = None) -> Axes:
    """The hits of a hammer record over one another, each with its number; those that are not used are dashed, with the reason.

    Parameters
    ----------
    record : TimeRecord
        With one force of short impacts.
    axes : matplotlib Axes, optional
        Default: of a new figure.

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    DataError
        If it is no hammer record.

    Examples
    --------
    >>> import numpy as np, operando
    >>> force = np.zeros((1, 4000)); force[0, 500:503] = force[0, 2500:2503] = [40.0, 100.0, 40.0]
    >>> channel = operando.Channel(operando.Dof.parse("3+Z"), "force", "N")
    >>> operando.plots.plot_hits(operando.TimeRecord(force, 1000.0, (channel,))).get_title(loc="left")
    '3+Z: 2 hits, 2 used'
    """
    expect(record, TimeRecord, *DRAWN)
    from operando.quality import pulses

    hits = pulses(record)
    if not hits:
        raise DataError("the record holds no hits of one hammer", where=record.name or None, hint="plot_record draws its forces")
    with style():
        axes = new_axes(9.0, 4.2) if axes is None else axes
        draw_hits(axes, hits, record.channels[record.force_indices[0]], record.sampling_hz)
    return axes


def _expect_lines(band: tuple[float, float] | None, nyquist: float) -> None:
    """Refuse a band in which a record holds nothing."""
    if band is not None and not (ordered_band(band)[1] >= 0 and ordered_band(band)[0] < nyquist):
        raise DataError(f"the band of {band[0]:g} to {band[1]:g} Hz holds no lines of the record, which reaches {nyquist:g} Hz")


def draw_densities(
    places: Sequence[Axes],
    channels: Sequence[Channel],
    f: NDArray[Any],
    psd: NDArray[Any],
    band: tuple[float, float] | None = None,
    count: int = 900,
) -> None:
    """Power spectral densities of some channels, those of each unit in axes of their own; ``count`` intervals keep the look."""
    kinds = list(dict.fromkeys((c.quantity, c.unit) for c in channels))
    for kind, place in zip(kinds, places, strict=True):
        rows = [k for k, c in enumerate(channels) if (c.quantity, c.unit) == kind]
        _spectra(place, f, psd[rows], [channels[k].label for k in rows], band, last=place is places[-1], count=count)
        place.set_ylabel(_quantity(channels[rows[0]], density=True))
        place.legend(loc="best", ncols=2)


def draw_force_spectra(
    axes: Axes, hits: Sequence[Pulse], channel: Channel, sampling_hz: float, band: tuple[float, float] | None = None
) -> None:
    """The spectrum of each hit."""
    length = max(int(sampling_hz / 2), 64)  # a line every 2 Hz; the pulse itself is much shorter
    f = np.fft.rfftfreq(length, 1 / sampling_hz)
    low, high = (0.0, sampling_hz / 2) if band is None else ordered_band(band)
    for hit in hits:
        size = np.abs(np.fft.rfft(hit.force, length)) / sampling_hz
        keep = thin(f, size)
        keep = keep[(f[keep] >= low) & (f[keep] <= high)]
        axes.plot(f[keep], size[keep], label=f"{hit.number}: {hit.reason}" if hit.reason else f"{hit.number}", **_look(hit))
    axes.set_yscale("log")
    values = np.concatenate([np.asarray(line.get_ydata(), float) for line in axes.lines])
    axes.set_ylim(max(values[values > 0].min(), values.max() * 1e-4) * 0.8, values.max() * 1.5)
    log_axis(axes.yaxis)
    frequency_axis(axes, low, high)
    axes.set_ylabel("Force spectrum of each hit [N·s]" if channel.unit == "N" else "Force spectrum of each hit")
    axes.set_title(f"{channel.label}: {len(hits)} hits")
    axes.legend(loc="best", ncols=4, title="Hit")


def draw_hits(axes: Axes, hits: Sequence[Pulse], channel: Channel, sampling_hz: float) -> None:
    """The pulses of the hits over one another, each with its number."""
    for hit in hits:
        t = 1e3 * (np.arange(hit.force.size) - hit.peak) / sampling_hz
        top = abs(hit.force[hit.peak])
        force = (np.sign(hit.force[hit.peak]) or 1.0) * hit.force
        look = _look(hit)
        words = f"{hit.number}  at {hit.time_s:.2f} s" + (f", not used: {hit.reason}" if hit.reason else "")
        axes.plot(t, force, marker="o", ms=2.2, label=words, **look)
        side = 1 if hit.number % 2 == 0 else -1
        axes.annotate(str(hit.number), (0.0, top), (side * 9, 2), textcoords="offset points", fontsize=8, color=look["color"], ha="center")
    axes.axhline(0, color=INK, lw=0.5)
    axes.grid(True)
    axes.margins(x=0.02)
    axes.set_xlabel("Time from the peak [ms]")
    reversed_ = any(hit.force[hit.peak] < 0 for hit in hits)
    axes.set_ylabel(f"Force [{unit_words(channel.unit)}], polarity reversed to positive" if reversed_ else _quantity(channel))
    axes.set_title(f"{channel.label}: {len(hits)} hits, {sum(not hit.reason for hit in hits)} used")
    axes.legend(loc="upper right", title="Hit", fontsize=7.5, ncols=1 if len(hits) <= 12 else 2)


def _part(record: TimeRecord, channels: object) -> tuple[TimeRecord, int]:
    """The channels drawn, and how many there are."""
    from operando.quality import SHOWN_CHANNELS

    expect(record, TimeRecord, *DRAWN)
    total = len(record.channels)
    if channels is not None:
        return record[channels], total
    return record.select(list(range(min(total, SHOWN_CHANNELS)))), total


def _one_unit(record: TimeRecord) -> None:
    kinds = {(c.quantity, c.unit) for c in record.channels}
    if len(kinds) > 1:
        words = ", ".join(f"{q} [{unit_words(u)}]" for q, u in sorted(kinds))
        raise DataError(f"channels of {words} do not fit the same axes", hint="name channels of one quantity, or leave axes out")


def _quantity(channel: Channel, density: bool = False) -> str:
    unit = unit_words(channel.unit)
    if density:
        unit = f"({unit})²/Hz" if "/" in unit or " " in unit or "·" in unit else f"{unit}²/Hz"
    return f"{channel.quantity.replace('_', ' ').capitalize()} [{unit}]"


def _outline(record: TimeRecord, row: int, count: int = 2000) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times and samples that keep the look of a channel."""
    y = np.asarray(record.data[row], float)
    t = record.start_s + np.arange(y.size) / record.sampling_hz
    keep = thin(t, y, count)
    return t[keep], y[keep]


def mark_findings(place: Axes, record: TimeRecord, channel: Channel) -> None:
    """Spans that findings mark at this channel."""
    kinds: dict[str, None] = {}
    for f in record.findings:
        if f.time_s is None or f.severity == "info" or f.dof not in (None, channel.label):
            continue
        place.axvspan(f.time_s[0], max(f.time_s[1], f.time_s[0] + record.duration_s / 500), color=PURPLE, alpha=0.25, lw=0)
        kinds[f.kind.replace("_", " ")] = None
    if kinds:
        place.annotate(
            ", ".join(kinds), (1, 1), (-3, -9), xycoords="axes fraction", textcoords="offset points", ha="right", fontsize=7.5, color=PURPLE
        )


def _spectra(
    place: Axes, f: NDArray[Any], psd: NDArray[Any], labels: Sequence[str], band: tuple[float, float] | None, last: bool, count: int
) -> None:
    low, high = (float(f[1]), float(f[-1])) if band is None else ordered_band(band)
    shown = (f >= low) & (f <= high) & (f > 0)
    place.set_yscale("log")
    tops = []
    for k, (row, label) in enumerate(zip(psd, labels, strict=True)):
        y = row[shown]
        if not np.any(y > 0):
            continue
        keep = thin(f[shown], np.log(np.maximum(y, 1e-300)), count)
        place.plot(f[shown][keep], np.where(y[keep] > 0, y[keep], np.nan), color=CYCLE[k % len(CYCLE)], lw=1.0, label=label)
        tops.append(y[y > 0])
    if tops:
        values = np.concatenate(tops)
        place.set_ylim(max(values.min() * 0.5, values.max() * 1e-10), values.max() * 2)
    log_axis(place.yaxis)
    frequency_axis(place, low, high, label=last)


def _look(hit: Pulse) -> dict[str, Any]:
    if hit.reason:
        return {"color": PURPLE, "lw": 0.9, "ls": (0, (4, 2))}
    return {"color": CYCLE[hit.number % len(CYCLE)], "lw": 1.1, "ls": "-"}

"""Figures of time records: samples, power spectral densities, force spectra, hits over one another with their numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Channel, TimeRecord
from operando.errors import DataError, ObjectError
from operando.plots.style import CYCLE, IDLE, INK, MEASURED, PURPLE, frequency_axis, log_axis, new_axes, new_stack, short_name, style, thin
from operando.printable import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from operando.frf import Hits

MOST_CHANNELS = 8
"""Channels drawn where none are named; the title says how many there are."""

LINES_A_BAND = 2000
"""Lines of a spectrum where no block length is given: as many as a figure can show."""

LEAST_AVERAGES = 15
"""Blocks that a spectrum should have at least, where no block length is given."""

BEFORE, AFTER = 0.6, 1.4
"""Part of a hit that is drawn: so many durations of the pulse before and after its peak (its foot is at 1 % of the peak)."""

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
                _marked(place, record, channel)
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
        If the record is shorter than a block, or channels of different units are to be drawn into the same axes.

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
    f, psd = densities(part, block_seconds)
    with style():
        places = new_stack([1.0] * len(kinds), [q for q, _ in kinds], 9.0, 1.0 + 2.6 * len(kinds)) if axes is None else [axes]
        for kind, place in zip(kinds, places, strict=True):
            rows = [k for k, c in enumerate(part.channels) if (c.quantity, c.unit) == kind]
            _spectra(place, f, psd[rows], [part.channels[k].label for k in rows], band, last=place is places[-1])
            place.set_ylabel(_quantity(part.channels[rows[0]], density=True))
            place.legend(loc="best", ncols=2)
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
        If the record has no force.

    Examples
    --------
    >>> import numpy as np, operando
    >>> force = np.zeros((1, 4000)); force[0, 500:503] = force[0, 2500:2503] = [40.0, 100.0, 40.0]
    >>> channel = operando.Channel(operando.Dof.parse("3+Z"), "force", "N")
    >>> operando.plots.plot_force_spectra(operando.TimeRecord(force, 1000.0, (channel,))).get_ylabel()
    'Force spectrum of each hit [N·s]'
    """
    _check(record)
    rows = record.force_indices
    if not rows:
        raise DataError(
            "the record has no force", where=record.name or None, hint="a channel is a force by its quantity: [channels] names it"
        )
    hits = _hits(record)
    if hits is None or not hits.indices.size:
        return plot_psd(record.select(rows), axes, band=band, block_seconds=block_seconds)
    force = np.asarray(record.data[rows[0]], float) - hits.offset
    length = max(int(record.sampling_hz / 2), 64)  # a line every 2 Hz; the pulse itself is much shorter
    with style():
        axes = new_axes(9.0, 4.0) if axes is None else axes
        f = np.fft.rfftfreq(length, 1 / record.sampling_hz)
        for k, used in enumerate(hits.used):
            a, b = _pulse(hits, k, force.size)
            size = np.abs(np.fft.rfft(force[a:b], length)) / record.sampling_hz
            look: dict[str, Any] = _look(k, bool(used))
            axes.plot(f, size, label=f"{k}" if used else f"{k}: {_reason(hits, k)}", **look)
        low, high = band or (0.0, record.sampling_hz / 2)
        axes.set_yscale("log")
        shown = (f >= low) & (f <= high)
        values = np.concatenate([np.asarray(line.get_ydata(), float)[shown] for line in axes.lines])
        axes.set_ylim(max(values[values > 0].min(), values.max() * 1e-4) * 0.8, values.max() * 1.5)
        log_axis(axes.yaxis)
        frequency_axis(axes, low, high)
        axes.set_ylabel("Force spectrum of each hit [N·s]" if record.channels[rows[0]].unit == "N" else "Force spectrum of each hit")
        axes.set_title(f"{record.channels[rows[0]].label}: {hits.indices.size} hits")
        axes.legend(loc="best", ncols=4, title="Hit")
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
    _check(record)
    hits = _hits(record)
    if hits is None or not hits.indices.size:
        raise DataError("the record holds no hits of one hammer", where=record.name or None, hint="plot_record draws its forces")
    channel = record.channels[record.force_indices[0]]
    force = np.asarray(record.data[record.force_indices[0]], float) - hits.offset
    with style():
        axes = new_axes(9.0, 4.2) if axes is None else axes
        for k, peak in enumerate(hits.indices):
            a, b = _pulse(hits, k, force.size)
            t = 1e3 * (np.arange(a, b) - peak) / record.sampling_hz
            sign = np.sign(force[peak]) or 1.0
            look = _look(k, bool(hits.used[k]))
            words = f"{k}  at {record.start_s + hits.times_s[k]:.2f} s" + ("" if hits.used[k] else f", not used: {_reason(hits, k)}")
            axes.plot(t, sign * force[a:b], marker="o", ms=2.2, label=words, **look)
            side = 1 if k % 2 == 0 else -1
            axes.annotate(
                str(k), (0.0, sign * force[peak]), (side * 9, 2), textcoords="offset points", fontsize=8, color=look["color"], ha="center"
            )
        axes.axhline(0, color=INK, lw=0.5)
        axes.grid(True)
        axes.margins(x=0.02)
        axes.set_xlabel("Time from the peak [ms]")
        axes.set_ylabel(
            f"Force [{unit_words(channel.unit)}], polarity reversed to positive" if np.any(force[hits.indices] < 0) else _quantity(channel)
        )
        axes.set_title(f"{channel.label}: {hits.indices.size} hits, {int(hits.used.sum())} used")
        axes.legend(loc="upper right", title="Hit", fontsize=7.5, ncols=1 if hits.indices.size <= 12 else 2)
    return axes


def densities(record: TimeRecord, block_seconds: float | None = None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Frequencies [Hz] (k,) and power spectral densities (n_channels, k) of a record, in unit²/Hz."""
    from operando.frf import cross_spectra

    n = record.n_samples
    block = (
        int(block_seconds * record.sampling_hz)
        if block_seconds is not None
        else max(64, min(2 * LINES_A_BAND, 2 * n // (LEAST_AVERAGES + 1)))
    )
    block = min(block, n) if block_seconds is None else block
    spectra = cross_spectra(record.data, [], list(range(record.data.shape[0])), record.sampling_hz, block)
    return spectra.frequencies_hz, spectra.response


def _hits(record: TimeRecord) -> Hits | None:
    from operando.frf import hits_of  # loads what a figure of an FRF does not need

    return hits_of(record)


def _check(record: object) -> None:
    if not isinstance(record, TimeRecord):
        raise ObjectError(f"a time record can be drawn here, not {type(record).__name__}", hint="read(file).records[0] is one")


def _part(record: TimeRecord, channels: object) -> tuple[TimeRecord, int]:
    """The channels drawn, and how many there are."""
    _check(record)
    total = len(record.channels)
    if channels is not None:
        return record[channels], total
    return record.select(list(range(min(total, MOST_CHANNELS)))), total


def _one_unit(record: TimeRecord) -> None:
    kinds = {(c.quantity, c.unit) for c in record.channels}
    if len(kinds) > 1:
        words = ", ".join(f"{q} [{unit_words(u)}]" for q, u in sorted(kinds))
        raise DataError(
            f"channels of {words} do not fit the same axes",
            hint="name channels of one quantity, or leave axes out",
        )


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


def _marked(place: Axes, record: TimeRecord, channel: Channel) -> None:
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


def _spectra(place: Axes, f: NDArray[Any], psd: NDArray[Any], labels: Sequence[str], band: tuple[float, float] | None, last: bool) -> None:
    low, high = band or (float(f[1]), float(f[-1]))
    shown = (f >= low) & (f <= high) & (f > 0)
    place.set_yscale("log")
    tops = []
    for k, (row, label) in enumerate(zip(psd, labels, strict=True)):
        y = row[shown]
        if not np.any(y > 0):
            continue
        keep = thin(f[shown], np.log(np.maximum(y, 1e-300)), 900)
        place.plot(f[shown][keep], np.where(y[keep] > 0, y[keep], np.nan), color=CYCLE[k % len(CYCLE)], lw=1.0, label=label)
        tops.append(y[y > 0])
    if tops:
        values = np.concatenate(tops)
        place.set_ylim(max(values.min() * 0.5, values.max() * 1e-10), values.max() * 2)
    log_axis(place.yaxis)
    frequency_axis(place, low, high, label=last)


def _pulse(hits: Hits, k: int, n: int) -> tuple[int, int]:
    """Samples of one pulse: from before it rises to after it has fallen, a second pulse of a double hit included."""
    peak = int(hits.indices[k])
    wide = max(int(hits.lead[k]) if hits.lead.size > k else 0, 3)
    following = hits.pulses[hits.pulses > peak]
    stop = peak + max(4 * wide, int(AFTER * wide) + 4)
    if hits.reasons[k] == "double_hit" and following.size:
        stop = max(stop, int(following[0]) + 4 * wide)
    return max(0, peak - wide - max(2, int(BEFORE * wide))), min(n, stop)


def _reason(hits: Hits, k: int) -> str:
    return hits.reasons[k].replace("_", " ")


def _look(k: int, used: bool) -> dict[str, Any]:
    color = CYCLE[k % len(CYCLE)]
    return {"color": color, "lw": 1.1, "ls": "-"} if used else {"color": PURPLE, "lw": 0.9, "ls": (0, (4, 2))}

"""Figures of the raw records: samples over time, power spectral densities, hits over one another with their spectra."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from operando.plots.records import draw_densities, draw_force_spectra, draw_hits, mark_findings, unit_words
from operando.plots.style import short_name
from operando.printable import printable
from operando.report.svg import IDLE, MEASURED, drawn, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from operando.quality import Overview

ROW = 1.25
"""Height of one record [inch]."""


@drawn
def raw_records(records: Sequence[Overview]) -> tuple[Figure, str]:
    """SVG: samples over time, a row for each record: its first force and its loudest response."""
    columns = 2 if any(raw.outline.force_indices for raw in records) else 1
    height = ROW * len(records) + 0.5
    figure = new_figure(10.2, height)
    for k, raw in enumerate(records):
        outline = raw.outline
        rms = np.sqrt(np.nanmean(np.square(outline.data, dtype=float), axis=1))
        loudest = max(((float(rms[i]), i) for i in outline.response_indices), default=(0.0, None))[1]
        shown = [next(iter(outline.force_indices), None), loudest][-columns:]
        for column, row in enumerate(shown):
            if row is None:
                continue
            width = 0.905 / columns - 0.06
            box = (0.075 + column * (width + 0.085), (0.45 + ROW * (len(records) - 1 - k)) / height, width, (ROW - 0.42) / height)
            axes = figure.add_axes(box)
            channel = outline.channels[row]
            t = outline.start_s + np.arange(outline.n_samples) / outline.sampling_hz
            axes.plot(
                t, outline.data[row], color=IDLE if channel.is_force else MEASURED, lw=0.6, label=f"{channel.label} of {outline.name}"
            )
            mark_findings(axes, outline, channel)
            axes.margins(x=0)
            axes.grid(True)
            axes.set_ylabel(f"{printable(channel.label)}\n[{unit_words(channel.unit)}]", fontsize=8)
            axes.set_title(short_name(outline.name), fontsize=8.5, pad=3)
            if k == len(records) - 1:
                axes.set_xlabel("Time [s]")
    return figure, f"Time records: {', '.join(short_name(raw.outline.name) for raw in records)}"


@drawn
def raw_densities(raw: Overview, band: tuple[float, float] | None = None) -> tuple[Figure, str]:
    """SVG: power spectral densities of the channels of one record, those of each unit in axes of their own."""
    kinds = len({(c.quantity, c.unit) for c in raw.outline.channels})
    height = 2.4 * kinds + 0.45
    figure = new_figure(10.2, height)
    places = [figure.add_axes((0.085, (0.45 + 2.4 * (kinds - 1 - k)) / height, 0.9, 2.1 / height)) for k in range(kinds)]
    draw_densities(places, raw.outline.channels, raw.frequencies_hz, raw.densities, band, 250)
    places[0].set_title(short_name(raw.outline.name), fontsize=9.5)
    return figure, f"Power spectral densities of {short_name(raw.outline.name)}"


@drawn
def raw_hits(records: Sequence[Overview], band: tuple[float, float] | None = None) -> tuple[Figure, str]:
    """SVG: the hits of each hammer record over one another, and the spectrum of each."""
    cell = 2.9
    height = cell * len(records)
    figure = new_figure(10.2, height)
    for k, raw in enumerate(records):
        bottom = (0.5 + cell * (len(records) - 1 - k)) / height
        channel = raw.outline.channels[raw.outline.force_indices[0]]
        left, right = (figure.add_axes((x, bottom, 0.405, (cell - 0.8) / height)) for x in (0.075, 0.58))
        draw_hits(left, raw.pulses, channel, raw.sampling_hz)
        draw_force_spectra(right, raw.pulses, channel, raw.sampling_hz, band)
        left.set_title(f"{short_name(raw.outline.name)}; {left.get_title(loc='left')}", fontsize=9.5)
        right.set_title("")
        if (legend := right.get_legend()) is not None:  # the numbers stand beside, in the same colours
            legend.remove()
    return figure, f"Hits over one another, and their spectra: {', '.join(short_name(raw.outline.name) for raw in records)}"

"""SVG of figures: where things stand, what is said once, and that every kind of artist of a user's own figure is kept."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from operando.report.svg import to_svg


def parsed(figure):
    """The elements of the SVG by their names; every id is there once and every reference has its id."""
    text = to_svg(figure, "words")
    tags = " ".join(re.findall("<[^>]+>", text))
    ids = re.findall(r'\bid="([^"]+)"', tags)
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'href="#([^"]+)"', tags)) | set(re.findall(r"url\(#([^)]+)\)", tags)) == set(ids)
    found = {}
    for element in ElementTree.fromstring(text).iter():
        found.setdefault(element.tag, []).append(element)
    return found


def numbers(d):
    return np.array(re.findall(r"-?[\d.]+", d), float).reshape(-1, 2)


def test_lines_and_marks_stand_where_the_data_are():
    figure = Figure(figsize=(4, 3))
    axes = figure.add_axes((0.1, 0.1, 0.8, 0.8))
    x, y = np.array([1.0, 2.0, 3.0, 5.0]), np.array([1.0, -1.0, np.nan, 2.0])
    axes.plot(x, y, color="#123456")
    axes.plot(x, y, "o", color="#654321")
    axes.scatter(x, y, s=[30.0], c=["#aa0000", "#00aa00", "#0000aa", "#aaaa00"])
    there = parsed(figure)
    dpi = figure.dpi
    figure.dpi = 72
    seen = axes.transData.transform(np.column_stack([x, y])) * (1, -1) + (0, 216)
    figure.dpi = dpi
    known = seen[np.isfinite(y)]
    line = next(e for e in there["path"] if "#123456" in e.get("style", ""))
    assert numbers(line.get("d")) == pytest.approx(known, abs=0.0051)
    assert re.fullmatch(r"M[^M]+M[^A-Z]+", line.get("d"))  # no line over the gap
    of_color = lambda color: [e for e in there["use"] if color in e.get("style", "")]  # noqa: E731
    marks = of_color("#654321")
    assert [[float(e.get(k)) for k in "xy"] for e in marks] == [pytest.approx(p, abs=0.0051) for p in known]
    assert any("clip-path" in holder.attrib and list(holder) == marks for holder in there["g"])
    spots = [spot for color in ("#aa0000", "#00aa00", "#aaaa00") for spot in of_color(color)]
    assert len(spots) == 3
    assert len({e.get("href") for e in spots}) == 1  # the mark itself is said once


def test_a_figure_of_ones_own_keeps_all_it_shows():
    figure = Figure(figsize=(6, 4))
    axes = figure.add_subplot(2, 2, 1)
    axes.bar([0, 1], [1, 2], hatch="//", facecolor="#aabbcc", alpha=0.5)
    axes.set_title(r"$\omega^2$ of 1 < 2 & 3", family="Courier New", style="italic")
    axes.text(0.5, 0.5, 'id="a" href="#a" url(#a)')
    axes.text(0, 1, "one\ntwo", rotation=30, rotation_mode="anchor")
    axes = figure.add_subplot(2, 2, 2)
    axes.imshow(np.arange(6.0).reshape(2, 3))
    axes = figure.add_subplot(2, 2, 3)
    axes.tripcolor([0, 1, 0], [0, 0, 1], [0.0, 1.0, 2.0], shading="gouraud")
    axes.plot([0, 1], [0, 1], rasterized=True)
    axes = figure.add_subplot(2, 2, 4)
    (line,) = axes.plot([0, 1, 2], [0, 1, 0], dashes=(4, 2), url="https://example.org")
    line.set_clip_path(Circle((1, 0.5), 0.5, transform=axes.transData))
    there = parsed(figure)
    assert len(there["pattern"]) == 1
    assert len(there["image"]) == 2
    assert any(len(clip) and clip[0].tag == "path" for clip in there["clipPath"])
    looks = [e.get("style", "") for e in there["path"]]
    assert any("stroke-dasharray" in look for look in looks)
    assert any("opacity:0.5" in look and "url(#" in look for look in looks)
    assert len(there["linearGradient"]) == 3  # from each corner of the triangle
    texts = [e.text for e in there["text"]]
    assert {"one", "two", 'id="a" href="#a" url(#a)'} <= set(texts)
    assert "a" not in there  # the page leads nowhere
    assert figure.dpi == 100

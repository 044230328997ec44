"""SVG of figures: where things stand, what is said once, and that every kind of artist of a user's own figure is kept."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from operando.report import renderer
from operando.report.renderer import _polygons
from operando.report.sheet import Sheet
from operando.report.svg import to_svg


def parsed(figure):
    """The elements of the SVG by their names; every id is there once and every reference has its id."""
    text = to_svg(figure, "words")
    ids = re.findall(r'\bid="([^"]+)"', text)
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'href="#([^"]+)"', text)) | set(re.findall(r"url\(#([^)]+)\)", text)) == set(ids)
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
    assert re.fullmatch(r"M[^A-Z]+M[^A-Z]+", line.get("d"))  # no line over the gap
    holder = next(e for e in there["g"] if "#654321" in e.get("style", ""))
    assert [[float(e.get(k)) for k in "xy"] for e in holder] == [pytest.approx(p, abs=0.0051) for p in known]
    assert "clip-path" in holder.attrib
    spots = [e for e in there["g"] for c in e if "#00" in e.get("style", "") or "#aa" in e.get("style", "")]
    assert len(spots) == 3
    assert len({c.get("href") for e in spots for c in e}) == 1  # the mark itself is said once


def test_a_figure_of_ones_own_keeps_all_it_shows():
    figure = Figure(figsize=(6, 4))
    axes = figure.add_subplot(2, 2, 1)
    axes.bar([0, 1], [1, 2], hatch="//", facecolor="#aabbcc", alpha=0.5)
    axes.set_title(r"$\omega^2$ of 1 < 2 & 3", family="Courier New", style="italic")
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
    assert any("fill:#767e57" in look for look in looks)  # the mean of the colours of the triangle
    texts = [e.text for e in there["text"]]
    assert {"one", "two"} <= set(texts)
    assert "a" not in there  # the page leads nowhere
    assert figure.dpi == 100


def pieces(svg):
    """Every line, area, mark and word of an SVG with its look, whether they stand in one element or in many."""
    tree = ElementTree.fromstring(svg)
    shared = {e.get("id"): ElementTree.tostring(e).replace(e.get("id").encode(), b"") for e in tree.iter() if e.get("id")}
    clip = lambda e: shared.get(e.get("clip-path", "url(#)")[5:-1])  # noqa: E731
    found = []
    for holder in tree.iter():
        for e in () if holder.tag == "defs" else holder:
            look = (e if e.get("style") else holder).get("style", ""), clip(e) or clip(holder) or b""
            if e.tag == "path" and not e.get("id"):
                found += [("path", "M" + part, *look) for part in e.get("d").split("M")[1:]]
            elif e.tag == "use":
                found.append((shared[e.get("href")[1:]], e.get("x") + " " + e.get("y"), *look))
            elif e.tag == "text":
                found.append((e.text, str(sorted(e.items())), *look))
    return sorted(found, key=str)


def test_axes_with_one_tick_show_what_matplotlib_shows():
    def drawn(figure):
        axes = figure.add_axes((0.1, 0.6, 0.35, 0.3))
        axes.plot([0, 3e6 + 1, 3e6 + 2], [1, 2, 3])  # with an offset at the axis
        axes.set_xlim(3e6 + 2, 3e6)
        axes.grid(True)
        axes.set_xlabel("x [m]")
        right = axes.twinx()
        right.plot([3e6, 3e6 + 1], [1, 50])
        right.set_ylabel("right")
        axes = figure.add_axes((0.6, 0.6, 0.35, 0.3))
        axes.loglog([1, 1000], [1, 20])  # with minor ticks
        axes.grid(True, which="both")
        axes.tick_params(which="minor", length=5, color="red")
        axes = figure.add_axes((0.1, 0.1, 0.35, 0.3))
        axes.bar([0, 1, 2], [3, 4, 5])
        axes.set_xticks([0, 1, 2], ["a", "b", "c"], rotation=90)
        axes.set_yticks([0, 4, 8], ["none", "half", "all"], fontsize=6)  # wider than the data
        axes.get_xticklabels()[0].set_fontweight("bold")
        axes.set_ylabel("y")
        axes.tick_params(labelsize=5)
        figure.add_axes((0.6, 0.1, 0.35, 0.3), projection="polar")
        words = [t.get_text() for t in axes.get_yticklabels()]
        return pieces(to_svg(figure, "words")), words, [t.get_text() for t in axes.get_yticklabels()]

    (own, *words), (matplotlibs, *wanted) = drawn(Sheet(figsize=(8, 6))), drawn(Figure(figsize=(8, 6)))
    assert own == matplotlibs
    assert words == wanted
    assert len(own) > 100
    assert len(Sheet().add_axes((0.1, 0.1, 0.8, 0.8)).xaxis.majorTicks) == 1
    axis = Sheet().add_axes((0.1, 0.1, 0.8, 0.8)).xaxis
    assert "minorTicks" not in vars(axis)


def test_areas_drawn_at_once_are_those_drawn_one_by_one(monkeypatch):
    def drawn():
        figure = Figure(figsize=(6, 4))
        axes = figure.add_subplot(1, 2, 1)
        axes.pcolormesh(np.arange(6.0).reshape(2, 3), edgecolors="white", cmap="viridis")
        axes = figure.add_subplot(1, 2, 2)
        rng = np.random.default_rng(1)
        triangles = rng.uniform(size=(20, 3, 2))
        axes.add_collection(PolyCollection(list(triangles), facecolors=rng.uniform(size=(20, 4)), linewidths=0))
        triangles[3, 1] = np.nan  # a corner that is not there
        axes.add_collection(PolyCollection(list(triangles), facecolors="none", edgecolors=rng.uniform(size=(20, 3))))
        axes.add_collection(PolyCollection(list(triangles), facecolors="none", edgecolors="red"))
        axes.add_collection(PolyCollection(list(triangles[5:]), facecolors=["red", (0, 0, 1, 0.5)], edgecolors="green", linestyles="--"))
        axes.add_collection(PolyCollection([triangles[0], rng.uniform(size=(5, 2))], facecolors=["red", "blue"]))  # of unlike corners
        axes.add_collection(PolyCollection(list(triangles[:2]), offsets=[(0.1, 0.2), (0.3, 0.1)], facecolors=["red", "blue"]))
        return to_svg(figure, "words")

    once, made = drawn(), []
    monkeypatch.setattr(renderer, "_polygons", lambda *given: made.append(_polygons(*given)) or [])
    assert drawn() == once
    assert [len(m) for m in made] == [6, 20, 0, 15, 0]


def test_the_height_of_letters_is_what_matplotlib_looks_up(monkeypatch):
    def drawn():
        figure = Figure(figsize=(6, 4))
        for k, family in enumerate(("DejaVu Sans", "DejaVu Serif", "DejaVu Sans Mono")):
            figure.text(0.1, 0.2 + 0.2 * k, "one\ntwo gym", family=family, size=7 + 3 * k, rotation=40 * k, va="center_baseline")
        return to_svg(figure, "words")

    own = drawn()
    monkeypatch.delattr(renderer.SmallSvg, "_get_font_height_metrics")
    assert drawn() == own

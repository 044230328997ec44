"""The report as one HTML file: assembly of the sections, style inlined, written beside and renamed."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from markupsafe import Markup

from operando.atomic import replacing
from operando.data import expect
from operando.errors import DataError
from operando.printable import without_active
from operando.report.derive import analysis_band
from operando.report.idle_check import TITLE, idle_against_check
from operando.report.parts import Numbering, Section, render, without_blank_lines
from operando.report.sections import build
from operando.report.svg import Drawing
from operando.report.text import band_text
from operando.results import Results
from operando.threads import one_blas_thread


@cache
def asset(name: str) -> Markup:
    """A file of ``templates/`` as it stands: the style, the script."""
    return without_blank_lines(files("operando.report").joinpath("templates", name).read_text(encoding="utf-8"))


def policy(script: str) -> str:
    """The page loads nothing and runs its one script; its style and the sizes of its drawings stand in the page."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    allowed = f"style-src 'unsafe-inline'; script-src 'sha256-{digest}'; img-src data:"
    return f"default-src 'none'; {allowed}; base-uri 'none'; form-action 'none'"


class Report:
    """The report of one test, to which figures and texts may be added before it is written.

    Parameters
    ----------
    results : Results
        Any part may be missing; the report says so in its place.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from operando import Report, Results
    >>> figure = Figure()
    >>> lines = figure.subplots().plot([10.0, 20.0], [0.1, 0.4])
    >>> report = Report(Results("pump")).add_figure(figure, "Level over speed.", section="Run-up").add_text("At 40 °C.", section="Run-up")
    >>> "Run-up" in report.html()
    True
    """

    def __init__(self, results: Results) -> None:
        expect(results, Results, "a report is made of results", "run(test) returns them, load(folder) reads them")
        self.results = results
        self._added: dict[str, list[tuple[Drawing | None, str]]] = {}

    def add_figure(self, figure: Any, caption: str = "", section: str = "Further figures") -> Report:
        """Add a figure to a section of one's own, after those of the report.

        Parameters
        ----------
        figure : matplotlib Figure or Axes
            Drawn into the page, with its data as CSV.
        caption : str
            Plain text.
        section : str
            Title of the section; made where it is new.

        Returns
        -------
        Report
            Itself, to go on with.

        Raises
        ------
        DataError
            If it is no figure of matplotlib.
        """
        drawn = getattr(figure, "figure", figure)
        if not hasattr(drawn, "get_axes") or not hasattr(drawn, "get_size_inches"):
            raise DataError(f"{type(figure).__name__} is no figure", hint="give a matplotlib Figure or Axes, as every plot method returns")
        self._added.setdefault(section, []).append((Drawing.of(drawn, caption or section), caption))
        return self

    def add_text(self, text: str, section: str = "Further notes") -> Report:
        """Add a paragraph of plain text to a section of one's own.

        Parameters
        ----------
        text : str
        section : str

        Returns
        -------
        Report
            Itself, to go on with.
        """
        self._added.setdefault(section, []).append((None, text))
        return self

    def html(self) -> str:
        """The whole page, without any reference outside itself, and the same whenever it is made of the same results."""
        results, page = self.results, Numbering()
        sections = build(results, page)
        for n, (title, parts) in enumerate(self._added.items(), start=1):
            sections.append(Section(f"added-{n}", title, render("added.html.j2", page, parts=parts)))
        title = results.name or "unnamed test"
        meta = f"Analysis band {band_text(analysis_band(results))}"
        both = results.hybrid is not None or results.diagnosis is not None
        kicker, what = ("Operational frequency response functions", "operational FRFs") if both else ("Modal analysis", "modes")
        if idle_against_check(results):
            kicker, what = TITLE, f"{TITLE[0].lower()}{TITLE[1:]}"
        block = results.settings.get("report") or {}
        return render_page(f"{title}: {what}", title, f"{kicker} · test report", meta, sections, block)

    def save(self, path: str | Path) -> None:
        """Write one self-contained HTML file; it appears whole or not at all (written beside, then renamed).

        Parameters
        ----------
        path : path
        """
        with one_blas_thread():
            text = self.html()
        with replacing(path, "w", encoding="utf-8", newline="\n") as stream:
            stream.write(text)


def render_report(results: Results) -> str:
    """HTML text of the whole report of one test."""
    return Report(results).html()


def render_page(
    window: str, title: str, kicker: str, meta: str, sections: Sequence[Section], block: Mapping[str, str] | None = None
) -> str:
    """HTML text of a page of numbered sections with their contents beside them.

    The plain texts are of the window, the heading, and the lines above and below it; ``block`` holds the lines of the title block.
    """
    from operando import __version__

    script = asset("report.js")
    page = render(
        "page.html.j2", window=window, title=title, kicker=kicker, meta=meta, sections=sections, block=block or {}, version=__version__,
        style=asset("report.css"), script=script, policy=Markup(policy(script)),
    )  # fmt: skip
    # what reached a drawing, too, is only shown
    return without_active(page)


def write_report(results: Results, path: str | Path) -> None:
    """Write the report of one test as a single self-contained HTML file.

    Parameters
    ----------
    results : Results
        Any part may be missing; the report says so in its place.
    path : path
        Target file; it appears whole or not at all (written beside, then renamed).
    """
    Report(results).save(path)

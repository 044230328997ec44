"""The report as one HTML file: assembly of the sections, style inlined, written beside and renamed."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path

from markupsafe import Markup

from operando.io.atomic import replacing
from operando.printable import without_active
from operando.report.derive import analysis_band
from operando.report.parts import Section, render, without_blank_lines
from operando.report.sections import build
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


def render_report(results: Results) -> str:
    """HTML text of the whole report, without any reference outside itself, and the same whenever it is made of the same results."""
    title = results.name or "unnamed test"
    meta = f"Analysis band {band_text(analysis_band(results))}"
    kicker = "Operating frequency response functions · test report"
    return render_page(f"{title}: operating FRFs", title, kicker, meta, build(results))


def render_page(window: str, title: str, kicker: str, meta: str, sections: Sequence[Section]) -> str:
    """HTML text of a page of numbered sections with their contents beside them.

    Parameters
    ----------
    window, title, kicker, meta : str
        Plain texts: of the window, the heading, the lines above and below it.
    sections : sequence of Section
    """
    from operando import __version__

    script = asset("report.js")
    page = render(
        "page.html.j2", window=window, title=title, kicker=kicker, meta=meta, sections=sections, version=__version__,
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
    with one_blas_thread():
        text = render_report(results)
    with replacing(path, "w", encoding="utf-8", newline="\n") as stream:
        stream.write(text)

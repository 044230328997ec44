"""The report as one HTML file: assembly of the sections, style inlined, written beside and renamed."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from operando.io.atomic import replacing
from operando.printable import without_active
from operando.report.parts import Section
from operando.report.sections import build
from operando.report.text import band_text, esc
from operando.results import Results
from operando.threads import one_blas_thread

# folded tables print too
_SCRIPT = "addEventListener('beforeprint',function(){document.querySelectorAll('details').forEach(function(d){d.open=true})});"
_SCRIPT_HASH = base64.b64encode(hashlib.sha256(_SCRIPT.encode()).digest()).decode()
# The page loads nothing and runs the one script above; its style and the sizes of its drawings stand in the page.
_POLICY = (
    f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{_SCRIPT_HASH}'; img-src data:; base-uri 'none'; form-action 'none'"
)


def render_report(results: Results) -> str:
    """HTML text of the whole report, without any reference outside itself, and the same whenever it is made of the same results."""
    from operando.report.derive import analysis_band

    title = results.name or "unnamed test"
    meta = f"Analysis band {band_text(analysis_band(results))}"
    kicker = "Operating frequency response functions · test report"
    return render_page(f"{title}: operating FRFs", title, kicker, meta, build(results))


def render_page(window: str, title: str, kicker: str, meta: str, sections: Sequence[Section]) -> str:
    """HTML text of a page of numbered sections with their contents beside them.

    Parameters
    ----------
    window, title, kicker : str
        Plain texts: of the window, the heading, the line above it.
    meta : str
        Below the heading (HTML).
    sections : sequence of Section
    """
    from operando import __version__

    style = files("operando.report").joinpath("report.css").read_text(encoding="utf-8")
    contents = "".join(f'<li><a href="#{s.anchor}">{n}. {esc(s.title)}</a></li>' for n, s in enumerate(sections, start=1))
    body = "".join(
        f'<section id="{s.anchor}" aria-labelledby="{s.anchor}-title"><h2 id="{s.anchor}-title">{n}. {esc(s.title)}</h2>{s.html}</section>'
        for n, s in enumerate(sections, start=1)
    )
    page = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{esc(window)}</title><style>{style}</style></head><body>"
        f'<div class="frame"><nav aria-label="Contents"><h2>Contents</h2><ol>{contents}</ol></nav><main>'
        f'<header><p class="kicker">{esc(kicker)}</p><h1>{esc(title)}</h1>'
        f'<p class="meta">{meta} · operando {esc(__version__)}</p></header>'
        f"{body}<footer>Made by operando {esc(__version__)}. Method: Shen &amp; Lu, Machines 2024, 12(8), 516. SI units; "
        "e<sup>+iωt</sup>; H = response/force; levels in dB are 20·log<sub>10</sub>.</footer></main></div>"
        f"<script>{_SCRIPT}</script></body></html>\n"
    )
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

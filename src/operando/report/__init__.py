"""The HTML report: figures (result in, SVG text out), tables, sections and the page."""

from operando.report.assessment import Assumption, Headline, assumptions, headline
from operando.report.page import render_report, write_report

__all__ = ["Assumption", "Headline", "assumptions", "headline", "render_report", "write_report"]

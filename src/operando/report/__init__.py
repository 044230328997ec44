"""The HTML report: figures (result in, SVG text out), tables, sections and the page."""

from operando.data import explain_arguments
from operando.report.assessment import Assumption, Headline, assumptions, headline
from operando.report.page import Report, render_report, write_report

__all__ = ["Assumption", "Headline", "Report", "assumptions", "headline", "render_report", "write_report"]

explain_arguments(__name__)

"""The sections of the report in order."""

from __future__ import annotations

from collections.abc import Callable

from operando.report import sections_answer, sections_modes, sections_rest, sections_states
from operando.report.parts import Numbering, Section
from operando.results import Results

_MAKERS: tuple[tuple[str, str, Callable[[Results, Numbering], str]], ...] = (
    ("answer", "Answer", sections_answer.answer),
    ("data", "What was measured", sections_rest.measured),
    ("idle", "At rest: FRFs and idle model", sections_states.idle),
    ("operating", "Running: operational modes", sections_states.operating),
    ("shapes", "Mode shapes and MAC", sections_modes.shapes),
    ("scaling", "Pairing and scaling", sections_modes.scaling),
    ("ofrf", "Operating FRFs against the check", sections_answer.ofrf),
    ("diagnosis", "Diagnosis: what the idle model lacks", sections_rest.diagnosis),
    ("settings", "Settings, timings, provenance", sections_rest.provenance),
)


def build(results: Results) -> list[Section]:
    """All sections in order; each is a pure function from results to HTML and says in one sentence what is missing."""
    numbering = Numbering()
    return [Section(anchor, title, make(results, numbering)) for anchor, title, make in _MAKERS]

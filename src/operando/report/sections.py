"""The sections of the report in order: values collected for each, drawn by the template of its name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from operando.report import sections_answer, sections_diagnosis, sections_modes, sections_rest, sections_states
from operando.report.parts import Numbering, Section, render
from operando.results import Results

_Maker = tuple[str, str, Callable[[Results, Numbering], dict[str, Any]]]

_DIAGNOSED: _Maker = ("missing", "Answer: what is missing in the idle model", sections_diagnosis.answer)
_MAKERS: tuple[_Maker, ...] = (
    ("answer", "Answer: how good the operating FRFs are", sections_answer.answer),
    ("data", "What was measured", sections_rest.measured),
    ("idle", "At rest: FRFs and idle model", sections_states.idle),
    ("operating", "Running: operational modes", sections_states.operating),
    ("shapes", "Mode shapes and MAC", sections_modes.shapes),
    ("scaling", "Pairing and scaling", sections_modes.scaling),
    ("ofrf", "Operating FRFs against the check", sections_answer.ofrf),
    ("diagnosis", "Diagnosis: the evidence", sections_diagnosis.diagnosis),
    ("settings", "Settings and provenance", sections_rest.provenance),
)


def build(results: Results) -> list[Section]:
    """All sections in order; each says in one sentence what is missing."""
    page = Numbering()
    makers = (_DIAGNOSED, *_MAKERS) if results.diagnosis else _MAKERS
    return [
        Section(anchor, title, render(f"{anchor}.html.j2", page, results=results, **make(results, page))) for anchor, title, make in makers
    ]

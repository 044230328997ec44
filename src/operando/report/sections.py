"""The sections of the report in order: values collected for each, drawn by the template of its name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from operando.report import sections_answer, sections_diagnosis, sections_modes, sections_rest, sections_states
from operando.report.assessment import scope
from operando.report.idle_check import TITLE, idle_against_check
from operando.report.parts import Numbering, Section, render
from operando.results import Results

_Maker = tuple[str, str, Callable[[Results, Numbering], dict[str, Any]]]

_MAKERS: dict[str, _Maker] = {
    "missing": ("missing", "Answer: what is missing in the idle model", sections_diagnosis.answer),
    "answer": ("answer", "Answer: how good the operational FRFs are", sections_answer.answer),
    "data": ("data", "What was measured", sections_rest.measured),
    "idle": ("idle", "Idle state (reference): FRFs and model", sections_states.idle),
    "operating": ("operating", "Operating state: operational modes", sections_states.operating),
    "shapes": ("shapes", "Mode shapes and MAC", sections_modes.shapes),
    "scaling": ("scaling", "Pairing and scaling", sections_modes.scaling),
    "ofrf": ("ofrf", "Operational FRFs against the validation measurement", sections_answer.ofrf),
    "diagnosis": ("diagnosis", "Diagnosis: the evidence", sections_diagnosis.diagnosis),
    "settings": ("settings", "Settings and provenance", sections_rest.provenance),
}
_ALONE = {"ema": ("idle", "Answer: the idle modes"), "oma": ("operating", "Answer: the operational modes")}
"""What a test of one state is: its section, and the title of its answer."""


def build(results: Results, page: Numbering | None = None) -> list[Section]:
    """All sections in order; each says in one sentence what is missing. A test of one state has its own ones only."""
    page = page or Numbering()
    state, answer = _ALONE.get(scope(results), ("", ""))
    names = ["answer", "data", state, "shapes", "settings"] if state else [n for n in _MAKERS if n != "missing" or results.diagnosis]
    of_idle = idle_against_check(results)
    if of_idle:
        names = [n for n in names if n not in ("operating", "scaling")]
        answer = "How good the idle model is" if results.diagnosis else f"Answer: {TITLE[0].lower()}{TITLE[1:]}"
    sections = []
    for anchor, title, make in (_MAKERS[name] for name in names):
        if anchor == "answer":  # one answer a page
            title = answer or ("How good the operational FRFs are" if results.diagnosis else title)
        if anchor == "ofrf" and of_idle:
            title = TITLE
        sections.append(Section(anchor, title, render(f"{anchor}.html.j2", page, results=results, **make(results, page))))
    return sections

"""The reference of the test file and the campaign file: keys, defaults and values from the code, a sentence for each key.

The keys are those of the types by which the parser reads, so the page cannot fall behind; a key without a sentence is an error.
"""

from __future__ import annotations

import inspect
import re
from dataclasses import fields
from typing import Any

from operando.campaign.config import Entries
from operando.config import Analysis, Sections
from operando.values import keys_of, words_of

SECTIONS: dict[str, tuple[str, str]] = {
    "": (
        "The file itself",
        "Paths and patterns are relative to the test file. An unknown key is an error that names the nearest known one.",
    ),
    "idle": ("`[idle]`: reference state, force measured", "Either `records` or `frfs`, not both."),
    "operating": (
        "`[operating]`: operating state, force unknown",
        "Records only: without a force there are no FRFs, and `frfs` is refused.",
    ),
    "check": (
        "`[check]`: validation measurement (optional)",
        "The operating state with a measured force. The OFRFs of the hybrid route are compared with it and never use it. "
        "The same keys as `[idle]`.",
    ),
    "records": (
        "A part of a record",
        'In `records`, a table may stand instead of a path: `{file = "run1.uff", start_s = 10, stop_s = 70}`. '
        "Where a pattern and a table name the same file, the table counts.",
    ),
    "geometry": ("`[geometry]` (optional)", "Without it, geometry in the measurement files is used (UFF 15, 2411, 82, 2412)."),
    "units": ("`[units]` (optional)", "For files that do not state units. A unit that a file states is never replaced from here."),
    "channels": (
        "`[channels]` (optional)",
        "One entry for each channel, by its name or DOF: "
        '`"ch1" = {dof = "12+Z", quantity = "acceleration", unit = "g"}`. What stands here replaces the label in the file.',
    ),
    "analysis": ("`[analysis]` (optional)", "Every setting has a default; the values used are stated in `summary.json` and in the report."),
    "between": (
        "`[between]` (optional)",
        "What may differ between the idle and the operating measurement and is no missing physics, each as one standard deviation; "
        "0 says that it does not. Without this section two days in a laboratory and one set-up are both tried, and the more probable one "
        "is stated.",
    ),
    "report": (
        "`[report]` (optional)",
        "The title block of the report, each line a text, a date or a list of them.",
    ),
    "effects": (
        "`[effects]` (optional)",
        "Kinds of effects of your own. The files are run when the test file is read: name only files whose content you know.",
    ),
    "directions": (
        "`[directions]` (optional)",
        "For sensors along no axis: a label and its unit vector in the frame of the geometry. The label is a node, a sign and a name in "
        'lower case (`"5+a" = [0.86, 0.47, -0.15]`), or the label that the file has.',
    ),
}

STATE = {
    "records": "Raw time histories: a list of paths, patterns or tables. One file is one run.",
    "frfs": "FRFs measured elsewhere (UFF 58 function type 4); coherence (type 6) is used if it is there.",
}
WORDS: dict[str, dict[str, str]] = {
    "": {
        "name": "Name of the test in all outputs. Default: the name of the folder.",
        "idle": "Section: measurements in the reference state.",
        "operating": "Section: measurements in operation, force unknown.",
        "check": "Section: validation measurement.",
        "geometry": "Section: file with nodes, lines and surfaces.",
        "units": "Section: units where the files do not say.",
        "channels": "Section: DOF, quantity, unit and sensitivity of channels.",
        "analysis": "Section: settings.",
        "between": "Section: what may differ between the idle measurement and that in operation.",
        "effects": "Section: kinds of effects of your own.",
        "directions": "Section: sensor directions that are no axes.",
        "report": "Section: title block of the report.",
    },
    "report": {
        "object": "What was measured: machine, type, serial number.",
        "date": "Day or days of the measurement.",
        "operator": "Who measured.",
        "sensors": 'Sensors and front end: `["13 × ABC 352C33", "hammer 086C03"]`.',
        "comments": "Whatever else a reader must know: mounting, speed, load, temperature.",
    },
    "between": {
        "sensor_gain": "Gain of each sensor, relative. Two days: 0.01.",
        "force_gain": "Gain of each force channel, relative. Two days: 0.01.",
        "stiffness": "Stiffness of the whole, relative, as by temperature. Two days: 0.003.",
        "damping": "Damping, relative. Two days: 0.1.",
        "offset": "How far sensors and exciter are put back beside their position, as a share of the rms of a mode shape. Two days: 0.015.",
        "skew": "Delay of the responses against the forces [s]. Two days: 3e-5.",
    },
    "effects": {
        "modules": 'Python files that register kinds of effects, as in `["my_laws.py"]`, relative to the test file.',
    },
    "idle": STATE,
    "operating": STATE,
    "check": STATE,
    "records": {
        "file": "Path or pattern of the record.",
        "start_s": "First time used, on the record's own time axis [s]. Default: the beginning.",
        "stop_s": "Last time used [s]. Default: the end.",
    },
    "geometry": {
        "file": "UFF file or CSV table with nodes; exactly one.",
        "units": 'Unit of the coordinates where the file does not say, as in `"mm"`.',
    },
    "units": {
        "length": "Unit of coordinates in the measurement files.",
        "sampling_hz": "Sampling rate of tables that have no time column [Hz].",
        "frequency_step_hz": "Step of the lines of FRF arrays that have no frequency vector beside them [Hz]; the first line is 0 Hz.",
        "columns": 'What the columns of a table without a header line are: `["Hz", "dB", "deg"]`, `["Hz", "real", "imag"]` or, '
        'for records, `["s", "g", "N"]`.',
    },
    "channels": {
        "dof": "DOF of the channel: node, sign, axis, as in `12+Z`.",
        "quantity": "What the channel measures: one of the quantities of `[units]`.",
        "unit": "Unit of the numbers in the file.",
        "sensitivity": "Units of the file for one unit of the quantity. 1 where the numbers are already in that unit.",
        "exclude": "`true` leaves the channel out.",
        "reason": "Why; it stands in the report.",
    },
}

CAMPAIGN: dict[str, str] = {
    "name": "Name of the campaign. Default: the name of the folder.",
    "tests": 'Test files, as in `["runs/{speed}/test.toml"]`. `{speed}` matches like `*` and is the parameter. In an object store: '
    '`["s3://bucket/{speed}/test.toml"]`, with the records beside or below the test file.',
    "template": "A test file in which `{speed}` stands for the value of each row.",
    "table": "CSV file with one row a test and a header line such as `speed [rpm],load [N]`.",
    "rows": "The rows themselves: `[{speed = 600}, {speed = 900}]`.",
    "units": 'Units of the parameters: `{speed = "rpm"}`.',
    "over": "Parameter on the horizontal axis of the report. Default: the first that varies.",
    "baseline": "The test every state is compared with, by name or parameters. Default: the first.",
    "until": "Last stage of each test.",
    "workers": 'What the tests run on: `{processes = 4}`, `{scheduler = "tcp://host:8786"}`, or '
    '`{cluster = "slurm", jobs = 20, options = {…}}`.',
}


def known_keys(section: str) -> dict[str, Any]:
    """Keys of a section of the test file ("": the file itself; "records": a table in ``records``), each with its type."""
    path = {"": (), "records": ("idle", "records", 0), "channels": ("channels", "")}.get(section, (section,))
    return keys_of(Sections, *path)


def settings_words() -> dict[str, tuple[str, str]]:
    """Setting of [analysis] → (type, sentence), from the docstring of ``Analysis``."""
    text = inspect.getdoc(Analysis) or ""
    out: dict[str, tuple[str, str]] = {}
    block = re.split(r"\n-+\n", text)[1] if "\n---" in text else ""
    for entry in re.split(r"\n(?=\S)", block):
        head, _, body = entry.partition("\n")
        names, _, kind = head.partition(" : ")
        for name in names.split(","):
            out[name.strip()] = (kind.strip(), " ".join(body.split()))
    return out


def missing() -> list[str]:
    """Keys that the code takes and this page has no sentence for, and sentences for keys that the code does not take."""
    out = []
    for section in SECTIONS:
        if section == "directions":  # any label is a key
            continue
        known = set(known_keys(section))
        has = set(settings_words()) if section == "analysis" else set(WORDS[section])
        if section == "units":
            has |= {key for key in known if key in _quantities()}
        out += [f"[{section}] {key} has no description" for key in sorted(known - has)]
        out += [f"[{section}] {key} is described, but the parser does not take it" for key in sorted(has - known)]
    known = set(keys_of(Entries))
    out += [f"campaign {key} has no description" for key in sorted(known - set(CAMPAIGN))]
    return out + [f"campaign {key} is described, but the parser does not take it" for key in sorted(set(CAMPAIGN) - known)]


def _quantities() -> dict[str, str]:
    from operando.units import SI_UNIT

    return dict(SI_UNIT)


def _cell(text: str) -> str:
    return text.replace("|", r"\|").replace("``", "`")


def _default(value: Any) -> str:
    if value is None:
        return "chosen"
    if value == ():
        return "none"
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


def page() -> str:
    """The page, without its title."""
    lost = missing()
    if lost:
        raise ValueError("; ".join(lost))
    out: list[str] = []
    for section, (title, words) in SECTIONS.items():
        out += [f"## {title}", "", words, ""]
        if section == "directions":
            continue
        if section == "analysis":
            out += ["| setting | default | meaning | values |", "| --- | --- | --- | --- |"]
            described, settings = settings_words(), known_keys(section)
            for f in fields(Analysis):
                kind, text = described[f.name]
                out.append(f"| `{f.name}` | {_default(f.default)} | {_cell(text)} | {_cell(words_of(settings[f.name]) or kind)} |")
        else:
            out += ["| key | meaning |", "| --- | --- |"]
            units = _quantities() if section == "units" else {}
            if units:
                names = ", ".join(f"`{q}` ({u or 'no unit'})" for q, u in units.items())
                out.append(f'| a quantity | Its unit, as in `acceleration = "g"`. Quantities, with the SI unit used inside: {names} |')
            out += [f"| `{key}` | {_cell(WORDS[section][key])} |" for key in known_keys(section) if key not in units]
        out.append("")
    words = "`operando campaign campaign.toml` runs many tests. Give `tests`, or `template` with `rows` or `table`."
    out += ["## The campaign file", "", words, ""]
    out += ["| key | meaning |", "| --- | --- |", *(f"| `{key}` | {_cell(CAMPAIGN[key])} |" for key in keys_of(Entries)), ""]
    return "\n".join(out)

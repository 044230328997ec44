"""Texts that would act, in every text field of a test: none is live on the terminal, in CSV, HTML or SVG."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import faults
from io_files import text_set
from operando.data import Finding
from operando.io import read, write_hdf5, write_uff
from test_printable import acts
from test_report_safety import CHROMIUM, dom_of

SCRIPT = "<script>document.title='owned'</script><img src=x onerror=\"document.title='owned'\">"
FORMULA = "=cmd|' /C calc'!A0"
TERMINAL = "\x1b]0;owned\x07\x1b[31m\x1b[2J\x9b2J"
TURNED = "\u202egnp.exe\u2066\u200f\u061c"
QUOTES = "'\"`--></style></svg>{{7*7}}${7*7}%s\x00\x7f"
HOSTILE = (SCRIPT, FORMULA, TERMINAL, TURNED, QUOTES)
ALL = "".join(HOSTILE)
IN_NAMES = (ALL.replace("/", "").replace("\x00", ""))[:80]
"""As much of it as the name of a file takes."""

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs a terminal of POSIX, and file names of any characters")


def with_text_sets(path: Path) -> None:
    """Put the texts into the ID lines of a UFF file, and into sets behind it: header, trace line, one of an unknown type."""
    lines = path.read_bytes().split(b"\n")
    for i, line in enumerate(lines):
        if line.startswith((b"operando time record", b"NONE")):
            lines[i] = HOSTILE[i % 5].encode()
    header = text_set(151, ALL[:70], TERMINAL, FORMULA, TURNED, QUOTES, SCRIPT[:70], ALL[:70])
    trace = text_set(82, f"{1:10d}{2:10d}{1:10d}", ALL[:70], f"{1:10d}{2:10d}")
    path.write_bytes(b"\n".join(lines) + header + trace + text_set(9999, *HOSTILE))


@pytest.fixture(scope="module")
def hostile(tmp_path_factory):
    """A test with the texts everywhere, and its results folder."""
    base = tmp_path_factory.mktemp("hostile")
    test = faults.small_test(base / f"test {IN_NAMES}")
    folder = test.parent
    text = test.read_text(encoding="utf-8").replace('"two masses"', json.dumps(ALL))
    for name in ("idle", "operating", "check"):
        (record,) = read(folder / f"{name}.uff").records
        texts = [f"{HOSTILE[i % 5]} {i}" for i in range(len(record.channels))]
        channels = tuple(replace(c, name=t, source_unit=t) for c, t in zip(record.channels, texts, strict=True))
        said = Finding("odd", ALL, "warning", ALL, 0, ALL, consequence=ALL, action=ALL)
        record = replace(record, channels=channels, name=ALL, findings=(said,))
        (folder / f"{name}.uff").unlink()
        file = f"{name} {IN_NAMES}.{'uff' if name == 'check' else 'h5'}"
        if name == "check":
            write_uff(folder / file, record)
            with_text_sets(folder / file)
        else:
            write_hdf5(folder / file, {"record": record})
        text = text.replace(f'"{name}.uff"', json.dumps(file))
    with_text_sets(folder / "geometry.uff")
    text += f"[channels]\n{json.dumps(f'{HOSTILE[2]} 2')} = {{sensitivity = 1.0, reason = {json.dumps(ALL)}}}\n"
    test.write_text(text.replace("\x7f", "\\u007f"), encoding="utf-8")
    return test, folder / f"out {IN_NAMES}"


BAR = re.compile(r"\x1b\[(?:\?25[lh]|[0-9;]*m|2K|1A)")
"""What the bar of the progress sends: cursor, colours, a line cleared, a line up."""


def on_a_terminal(*arguments: str | Path, cwd: Path, status: int = 0, bar: bool = False) -> str:
    """What a command sends to a terminal, as it is; plain lines of progress, or the bar."""
    ours, theirs = os.openpty()
    command = [sys.executable, "-m", "operando", *map(str, arguments)]
    env = os.environ | {"TERM": "xterm" if bar else "dumb"}
    child = subprocess.Popen(command, stdout=theirs, stderr=theirs, stdin=theirs, cwd=cwd, env=env)
    os.close(theirs)
    said = b""
    while True:
        try:
            more = os.read(ours, 1 << 16)
        except OSError:  # the other end is closed
            break
        if not more:
            break
        said += more
    os.close(ours)
    assert child.wait() == status, said.decode(errors="replace")
    return said.decode("utf-8").replace("\r\n", "\n")


def test_a_run_on_hostile_texts(hostile, tmp_path):
    test, out = hostile
    said = on_a_terminal("run", test, "-o", out, cwd=tmp_path)
    barred = on_a_terminal("run", test, "-o", out, "-v", cwd=tmp_path, bar=True)
    assert BAR.search(barred)
    said += BAR.sub("", barred)
    said += on_a_terminal("report", out, cwd=tmp_path)
    said += on_a_terminal("diagnose", out, cwd=tmp_path)
    assert len(said.splitlines()) > 15
    assert not acts(said.replace("\r", ""))
    assert r"\x1b]0;owned" in said
    shown = [p for p in out.iterdir() if p.suffix in (".html", ".json", ".csv", ".svg")]
    assert {p.suffix for p in shown} >= {".html", ".json"}
    for path in shown:
        text = path.read_text(encoding="utf-8")
        assert not acts(text), path.name
        if path.suffix == ".json":
            json.loads(text)
    page = (out / "report.html").read_text(encoding="utf-8")
    assert page.count("<script") == 1  # its own
    assert "&lt;script&gt;document.title" in page
    assert "<img src=x" not in page
    assert not re.search(r"<[a-z][^>]*\son\w+\s*=", re.sub(r'"[^"]*"', '""', page))
    assert "{{7*7}}" in page  # no template took it


def test_inspect_init_and_errors_on_hostile_texts(hostile, tmp_path):
    test, _ = hostile
    files = sorted(p for p in test.parent.iterdir() if p.suffix in (".h5", ".uff"))
    assert len(files) == 4
    said = on_a_terminal("inspect", *files, cwd=tmp_path)
    assert r"\u202egnp.exe" in said
    assert r"\x1b]0;owned" in said
    said += on_a_terminal("init", test.parent, "-o", tmp_path / "made.toml", cwd=tmp_path)
    said += on_a_terminal("run", test, "--set", f"analysis.{TERMINAL}=1", cwd=tmp_path, status=1)
    said += on_a_terminal("run", test, "--set", f"idle.records=[{json.dumps(ALL)}]", cwd=tmp_path, status=1)
    (tmp_path / f"{IN_NAMES}.uff").write_bytes(b"    -1\n    58\n" + b"\n".join(t.encode() for t in HOSTILE) + b"\n    -1\n")
    said += on_a_terminal("inspect", tmp_path / f"{IN_NAMES}.uff", cwd=tmp_path, status=1)
    assert not acts(said.replace("\r", ""))
    assert not acts((tmp_path / "made.toml").read_text(encoding="utf-8"))


def test_conversion_of_hostile_texts_to_csv(hostile, tmp_path):
    test, _ = hostile
    source = next(p for p in test.parent.iterdir() if p.name.startswith("idle"))
    (record,) = read(source).records
    write_hdf5(tmp_path / "names.h5", {"record": replace(record, channels=tuple(replace(c, dof=None) for c in record.channels))})
    for number, path in enumerate((source, tmp_path / "names.h5")):
        said = on_a_terminal("convert", path, tmp_path / f"{number}.csv", cwd=tmp_path)
        assert not acts(said.replace("\r", ""))
        text = (tmp_path / f"{number}.csv").read_text(encoding="utf-8")
        assert not acts(text)
        rows = [row for row in csv.reader(text.splitlines()) if not row[0].startswith("#")]
        assert not [cell for cell in rows[0] if re.match(r"\s*[=+\-@|%\t\r]", cell)]
        assert {len(row) for row in rows} == {1 + len(record.channels)}
        numbers = np.array(rows[1:], float)[:, 1:]
        np.testing.assert_array_equal(numbers.T, record.data)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to open the report with")
def test_no_script_of_a_hostile_test_runs_in_a_browser(hostile, tmp_path):
    test, out = hostile
    if not (out / "report.html").exists():
        on_a_terminal("run", test, "-o", out, cwd=tmp_path)
    shutil.copy(out / "report.html", tmp_path / "report.html")
    dom = dom_of(tmp_path / "report.html", tmp_path / "profile")
    assert dom.count("<script") == 1
    assert not re.search(r"<title>\s*owned\s*</title>|<img src=\"?x", dom)
    # without its policy, too: what the page holds is text
    free = re.sub(r"<meta http-equiv[^>]*>", "", (tmp_path / "report.html").read_text(encoding="utf-8"))
    (tmp_path / "free.html").write_text(free, encoding="utf-8")
    dom = dom_of(tmp_path / "free.html", tmp_path / "profile2")
    assert "<title>owned</title>" not in dom
    assert "<title" in dom

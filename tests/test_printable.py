"""Nothing a measurement file says is live in any output."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import unicodedata

import numpy as np
import pytest
from click.testing import CliRunner

from operando.cli import main
from operando.data import Channel, TimeRecord
from operando.dof import Dof
from operando.io import read, write_csv
from operando.jsonable import json_text
from operando.printable import LONGEST_WORD, first_few, json_escaped, printable, without_active

NASTY = "=cmd|' /C calc'!A0\x1b[31m\x1b]0;owned\x07\u202egnp.exe\u2066<script>alert(1)</script>\x9b2J\x00\u200f"


def acts(text, lines=True):
    """Characters of a text that would act on a terminal or the order of writing, by the Unicode database."""
    return {c for c in text if unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp") and not (lines and c in "\n\t")}


def test_every_active_character_of_unicode_is_shown():
    text = "".join(chr(i) for i in range(sys.maxunicode + 1) if unicodedata.category(chr(i)) in ("Cc", "Cf", "Cs", "Zl", "Zp"))
    assert not acts(printable(text), lines=False)
    assert not acts(without_active(text))
    letters = "12+Z µ ü é 中文 עברית ± − · ² … \U0001f600"
    assert printable(letters) == letters
    assert printable("a\x1bb\nc\u202ed") == r"a\x1bb\nc\u202ed"
    assert printable("a\n\tb", lines=True) == "a\n\tb"


def test_json_keeps_the_data():
    document = {"name": NASTY, "more": "\U000e0001\ud800 µ"}
    text = json_text(document)
    assert not acts(text)
    assert "µ" in text
    assert json.loads(text) == document
    assert json_escaped('"a"') == '"a"'


def test_overlong_words_are_cut_and_counted():
    long = printable("x" * 100_000)
    assert len(long) < LONGEST_WORD
    assert "100000 characters" in long
    assert printable("short words " * 1000) == "short words " * 1000


def nasty_file(path):
    from scipy.io import savemat

    names = np.array(["Acceleration " + NASTY, "Force " + NASTY], dtype=object)
    data = np.random.default_rng(0).normal(size=(400, 2))
    savemat(path, {"x": data, "fs": 100.0, "channel_names": names, "units": np.array(["g", NASTY], dtype=object)})
    return path


def test_terminal(tmp_path):
    """Answers, tables, messages and errors of the command line, as written to stdout and stderr."""
    path = nasty_file(tmp_path / "nasty.mat")
    folder = tmp_path / "idle\x1b[31m\u202e"
    folder.mkdir()
    shutil.copy(path, folder / "run\x1b]0;x\x07.mat")
    (folder / "broken\x9b.mat").write_bytes(b"MATLAB 5.0 MAT-file" + b"\x00" * 200)
    for arguments in (
        ["inspect", str(path)], ["inspect", str(path), "--json"], ["inspect", str(folder / "broken\x9b.mat")],
        ["init", str(folder), "-o", str(tmp_path / "test.toml"), "--force"], ["init", str(tmp_path), "--json"],
        ["inspect", "none\x1b[31m"], ["run", "\u202enone.toml"], ["--no\x1bsuch"], ["\x1b[31m"], ["report", str(folder)],
    ):  # fmt: skip
        done = CliRunner().invoke(main, arguments)
        assert not acts(done.stdout + done.stderr), arguments
        assert "Traceback" not in done.output
        assert done.stdout or done.stderr
    made = (tmp_path / "test.toml").read_text()
    assert not acts(made)
    import tomllib

    assert NASTY in tomllib.loads(made).get("channels", {NASTY: 0}) or r"\x1b" in made


def test_csv_cells_are_no_formulas(tmp_path):
    names = ["=cmd|x!A0", "+1+1", "-2", "@SUM(A1)", "\t=1", "\r=1", NASTY, "plain"]
    record = TimeRecord(
        np.arange(-8.0, 16.0).reshape(8, 3), 10.0, tuple(Channel(None, "acceleration", "m/s2", name=name) for name in names)
    )
    write_csv(tmp_path / "a.csv", record)
    text = (tmp_path / "a.csv").read_text()
    head = text.splitlines()[1].split(",")
    assert not acts(text)
    assert not [cell for cell in head if re.match(r"[=+\-@\t\r]", cell)]
    assert len(head) == 9
    (back,) = read(tmp_path / "a.csv").records
    np.testing.assert_array_equal(back.data, record.data)  # numbers below zero stay numbers
    assert [c.name for c in back.channels][:4] == names[:4]
    labelled = TimeRecord(np.ones((1, 3)), 10.0, (Channel(Dof(12, "Z"), "force", "N"),))
    write_csv(tmp_path / "b.csv", labelled)
    assert (tmp_path / "b.csv").read_text().splitlines()[1] == "time [s],12+Z [N]"


@pytest.mark.slow
def test_a_whole_run_on_nasty_names(tmp_path):
    """Names of test, files and channels through all stages: terminal, summary, comparison, diagnosis, report, UFF texts."""
    from dataclasses import replace

    import measurements
    from operando.io import write_hdf5

    place = tmp_path / "nasty"
    measurements.write_test(place, check=True)
    for file in sorted(place.rglob("*.uff")):
        records = read(file).records
        if not records:
            continue
        file.unlink()
        named = [replace(r, channels=tuple(replace(c, name=f"{NASTY}{i}") for i, c in enumerate(r.channels)), name=NASTY) for r in records]
        write_hdf5(file.with_name(f"{file.stem}\x1b[31m\u202e<script>.h5"), {f"record{i}": r for i, r in enumerate(named)})
    text = (place / "test.toml").read_text().replace("*.uff", "*.h5").replace("chain", r"\u001b[31m\u202e<script>alert(1)</script>")
    (place / "test.toml").write_text(text)
    done = subprocess.run(
        [sys.executable, "-m", "operando", "run", str(place / "test.toml"), "-o", str(tmp_path / "out")], capture_output=True
    )
    assert done.returncode == 0, done.stderr
    assert not acts((done.stdout + done.stderr).decode())
    texts = [p for p in (tmp_path / "out").iterdir() if p.suffix in (".json", ".html")]
    assert len(texts) >= 4
    for path in texts:
        assert not acts(path.read_text(encoding="utf-8")), path.name
    assert (tmp_path / "out/report.html").read_text(encoding="utf-8").count("<script") == 1


def test_the_first_few_names_say_that_there_are_more():
    assert first_few([1, 2, 3], 3) == "1, 2, 3"
    assert first_few((f"{n}+Z" for n in range(4)), 3) == "0+Z, 1+Z, 2+Z …"
    assert first_few([]) == ""

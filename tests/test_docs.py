"""The documentation: every command and snippet of README and docs/ runs, references hold what the code takes, the site builds."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from operando.cli import COMMANDS, main
from pages import DOCS, LANGUAGES, QUIET, ROOT, blocks, command_lines, pages, programs, run_page

FIRST = ("docs/tutorials/whole_chain.md", "docs/tutorials/validation.md", "docs/tutorials/contacts.md")
"""Pages that go on with one another's folders, in this order."""
sys.path.insert(0, str(DOCS))


def page_name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def test_blocks_are_programs_or_say_that_they_are_not():
    for page in pages():
        for block in blocks(page):
            assert block.language.split()[0] in (*LANGUAGES, *QUIET) if block.language else False, f"{block}: {block.language!r}"


def test_pages_name_commands_that_exist():
    shell = [b for page in pages() for b in programs(page) if b.language == "sh"]
    called = {words[1] for b in shell for words in command_lines(b) if words[0] == "operando"}
    assert called <= set(COMMANDS)
    assert called >= set(COMMANDS) - {"frf", "workbench"}, "a command that no page shows"  # the workbench answers until Ctrl-C


def test_links_of_written_pages_lead_somewhere():
    made = {DOCS / "api" / "index.rst"}
    others = [ROOT / name for name in ("CONTRIBUTING.md", "CHANGELOG.md")]
    for page in (*pages(), *others):
        text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
            there = (page.parent / target).resolve()
            assert target.startswith(("http", "mailto")) or there.exists() or there in made, f"{page_name(page)} points to {target}"


def test_tutorials_of_the_whole_chain_and_readme_run(tmp_path, monkeypatch, own_kinds_gone):
    folder, again = tmp_path / "tutorials", tmp_path / "readme"
    for place in (folder, again):
        place.mkdir()
        (place / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(folder)
    printed = {FIRST[0]: run_page(ROOT / FIRST[0], folder)}
    assert (folder / "frame-results" / "report.html").stat().st_size > 100_000
    for name in ("frame-results", "demo-results"):
        shutil.copytree(folder / "frame-results", again / name)
    with monkeypatch.context() as patch:  # one report was drawn, and the README draws another: a line stands for those between
        patch.setattr("operando.report.write_report", lambda results, path: path.write_text(results.name, encoding="utf-8"))
        printed |= {name: run_page(ROOT / name, folder) for name in FIRST[1:]}
    assert "idle model as it is" in "".join(printed[FIRST[0]])
    assert "(1, 1, 1400)" in printed[FIRST[0]][-1]
    assert "coulomb_friction" in "".join(printed[FIRST[2]])

    # The README on the same files: stages that ran are taken from their results, as for any user who runs a test again.
    monkeypatch.chdir(again)
    told = run_page(ROOT / "README.md", again)
    assert "(1, 1, 1400)" in told[-1]
    assert (again / "pair.uff").exists()
    demo = again / "demo-results"
    assert (demo / "report.html").stat().st_size > 100_000
    assert sum(file.stat().st_size for file in demo.rglob("*") if file.is_file()) < 40e6
    asked = CliRunner().invoke(main, ["demo", "-o", str(demo), "--json"])
    errors = json.loads(asked.stdout)["comparison"]["models"]
    assert errors["ofrf"]["error_db"] < errors["idle"]["error_db"]
    assert errors["effect"]["error_db"] < 0.3
    # what benchmarks/example_data hid in the running frame
    found = json.loads((demo / "diagnosis.json").read_text())
    assert found["verdict"] == "explained"
    assert [(e["kind"], e["location"]) for e in found["effects"]] == [("ground_spring", ["2+Z"])]
    size = found["effects"][0]["parameters"]["stiffness"]
    assert abs(size["value"] - 1.5e5) < 3 * size["std"] < 0.01 * 1.5e5


@pytest.mark.parametrize("page", [p for p in pages() if programs(p) and page_name(p) not in (*FIRST, "README.md")], ids=page_name)
def test_page_runs(page, tmp_path, monkeypatch, own_kinds_gone):
    (tmp_path / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(tmp_path)
    run_page(page, tmp_path)


def test_test_file_reference_describes_every_key():
    from generators import test_file

    assert test_file.missing() == []
    text = test_file.page()
    for key in ("band", "hits_reject", "start_s", "sensitivity", "sampling_hz", "baseline"):
        assert f"`{key}`" in text


def test_test_file_reference_notices_a_key_without_words(monkeypatch):
    from generators import test_file

    monkeypatch.delitem(test_file.WORDS["channels"], "exclude")
    assert test_file.missing() == ["[channels] exclude has no description"]
    with pytest.raises(ValueError, match="exclude"):
        test_file.page()


def test_catalogues_hold_every_effect_and_finding(tmp_path):
    from generators import effects, findings

    text = effects.page(tmp_path)
    for name in effects.kinds():
        assert f"### `{name}`" in text
        assert (tmp_path / f"{name}.svg").stat().st_size > 2000
    text = findings.page()
    for kind in ("overload", "soft_clip", "dropout", "flat", "missing_drive_point", "overlapping_hits", "harmonic", "not_reciprocal"):
        assert f"### `{kind}`" in text


def test_pages_name_no_path_of_a_machine():
    for page in (*pages(), ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"):
        assert not re.search(r"(?<![\w.])/(work|tmp|home|root|usr)/", page.read_text(encoding="utf-8")), page_name(page)


def test_link_checker_finds_what_is_broken(tmp_path):
    from check_links import broken

    (tmp_path / "index.html").write_text('<a href="other.html#here">x</a><a href="gone.html">x</a><a href="other.html#nowhere">x</a>')
    (tmp_path / "other.html").write_text('<p id="here"></p><script src="https://example.org/a.js"></script>')
    assert broken(tmp_path) == [
        "index.html points to gone.html, which is not there",
        "index.html points to other.html#nowhere, which has no such place",
        "other.html loads https://example.org/a.js from the network",
    ]


def test_formulas_put_indices_beside_accented_letters():
    pytest.importorskip("sphinx", reason="the site needs the extra: pip install 'operando[docs]'")
    from generators.mathml import formula

    drawn = formula(r"\hat\phi_e^{\mathsf T} + \sum_{r=1}^n x_r")
    assert "msubsup" in drawn
    assert drawn.count("munderover") == 2  # the limits of the sum alone
    with pytest.raises(ValueError, match="nosuch"):
        formula(r"\nosuch{x}")


@pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("sphinx", "myst_parser", "furo")),
    reason="the site needs the extra: pip install 'operando[docs]'",
)
def test_site_builds_without_warnings_and_its_links_hold(tmp_path):
    source, site = tmp_path / "docs", tmp_path / "site"
    shutil.copytree(DOCS, source, ignore=shutil.ignore_patterns("_made", "api", "_build", "__pycache__"))
    for name in ("CONTRIBUTING.md", "CHANGELOG.md"):
        shutil.copy(ROOT / name, tmp_path / name)
    call = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", str(source), str(site)]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    done = subprocess.run([sys.executable, str(DOCS / "check_links.py"), str(site)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]

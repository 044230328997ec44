"""Pages of the documentation as programs: their commands, test files and Python blocks, run in the order they stand."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

from click.testing import CliRunner

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
LANGUAGES = ("sh", "toml", "python")
QUIET = ("text", "{include}", "{toctree}", "{note}", "{warning}")
"""Blocks that are no programs."""
SHELL = {"cp", "rm", "mkdir", "mv"}


@dataclass(frozen=True)
class Block:
    """One fenced block of a page: its language, text, and the line it starts at."""

    page: str
    line: int
    language: str
    text: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"


def pages() -> list[Path]:
    """README and all written pages of docs/."""
    made = ("_made", "_build", "api")
    return [ROOT / "README.md", *sorted(p for p in DOCS.rglob("*.md") if p.relative_to(DOCS).parts[0] not in made)]


def blocks(page: Path) -> list[Block]:
    """All fenced blocks of a page."""
    out: list[Block] = []
    fence, start, lines = "", 0, []
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        mark = re.match(r"(`{3,})(.*)", line)
        if mark and not fence:
            fence, start, lines, language = mark[1], number, [], mark[2].strip()
        elif mark and mark[1] == fence and not mark[2].strip():
            out.append(Block(page.relative_to(ROOT).as_posix(), start, language, "\n".join(lines) + "\n"))
            fence = ""
        elif fence:
            lines.append(line)
    assert not fence, f"{page} does not close the block of line {start}"
    return out


def programs(page: Path) -> list[Block]:
    """The blocks of a page that are run."""
    return [b for b in blocks(page) if b.language in LANGUAGES]


def command_lines(block: Block) -> list[list[str]]:
    """Commands of a shell block, as words."""
    return [words for line in block.text.splitlines() for part in line.split(" && ") if (words := shlex.split(part, comments=True))]


def run_command(words: list[str], folder: Path) -> str:
    """Run one command of a page in a folder; what is told about the installation is looked up, not run."""
    name, *arguments = words
    if name == "operando":
        from operando.cli import main

        files = [f for word in arguments for f in (sorted(map(str, folder.glob(word))) if "*" in word and "=" not in word else [word])]
        done = CliRunner().invoke(main, files)
        assert done.exit_code == 0, f"{' '.join(words)}: {done.output}{done.exception or ''}"
        return done.output
    if name == "make":
        rules = (ROOT / "Makefile").read_text(encoding="utf-8")
        for target in (a for a in arguments if "=" not in a):
            assert re.search(rf"^{target}:", rules, re.M), f"the Makefile has no {target}"
    elif name == "pip":
        project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        for extra in re.findall(r"\[([\w,]+)\]", " ".join(arguments)):
            assert set(extra.split(",")) <= set(project["optional-dependencies"]), f"there is no extra {extra}"
    else:
        assert name in SHELL, f"a page calls {name}"
        subprocess.run(words, cwd=folder, check=True)
    return ""


def run_page(page: Path, folder: Path) -> list[str]:
    """Run a page from its first block to its last in a folder (the working directory); returns what each block printed."""
    import contextlib
    import io

    names: dict[str, object] = {"__name__": "__page__"}
    printed = []
    for block in programs(page):
        out = io.StringIO()
        try:
            if block.language == "sh":
                for words in command_lines(block):
                    out.write(run_command(words, folder))
            elif block.language == "toml":
                first = block.text.splitlines()[0]
                assert re.fullmatch(r"# \S+\.toml", first), "the first line of a TOML block names its file"
                (folder / first.removeprefix("# ")).write_text(block.text, encoding="utf-8")
            else:
                with contextlib.redirect_stdout(out):
                    exec(compile(block.text, str(block), "exec"), names)
        except Exception as error:
            raise AssertionError(f"{block}: {type(error).__name__}: {error}") from error
        printed.append(out.getvalue())
    return printed


def main(folder: Path, wanted: list[str]) -> None:
    """Run pages by hand and show what they print: ``python tests/pages.py FOLDER [PART OF A NAME …]``."""
    import os
    import time

    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "data").exists():
        (folder / "data").symlink_to(ROOT / "data")
    os.chdir(folder)
    for page in pages():
        if programs(page) and (not wanted or any(part in page.as_posix() for part in wanted)):
            started = time.process_time()
            print(f"=== {page.relative_to(ROOT)}")
            print("\n---\n".join(run_page(page, folder)))
            print(f"=== {time.process_time() - started:.1f} s of processor time")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), sys.argv[2:])

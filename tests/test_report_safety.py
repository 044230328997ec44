"""The report shows what measurement files say and lets none of it act."""

from __future__ import annotations

import base64
import hashlib
import re
import shutil
import subprocess

import numpy as np
import pytest

from operando.data import Finding, Frf, Provenance
from operando.report import render_report
from operando.report.figures_modes import mac_matrices
from operando.report.svg import drawn, new_figure
from operando.results import CheckRun, Results
from test_printable import NASTY, acts

LIVE = (
    NASTY + "<img src=x onerror=\"document.title='owned'\"><script>document.title='owned'</script></title></svg>' onload='document.title=1"
)
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def dom_of(path, profile):
    """A page as the browser has it after its scripts ran."""
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", f"--user-data-dir={profile}", "--dump-dom"]
    done = subprocess.run([CHROMIUM, *flags, path.as_uri()], capture_output=True, text=True, timeout=120)
    assert "</html>" in done.stdout, done.stderr
    return done.stdout


def nasty_results():
    frf = Frf(np.ones((2, 1, 30)) + 0j, np.arange(30.0), ("1Z", "2Z"), ("1Z",), coherence=np.ones((2, 1, 30)), averages=4, name=LIVE,
              provenance=Provenance(((LIVE, LIVE),), (LIVE,)))  # fmt: skip
    finding = Finding(LIVE, LIVE, "error", LIVE, 1, LIVE, consequence=LIVE, action=LIVE)
    row = {"file": LIVE, "path": LIVE, "used_for": LIVE, "role": LIVE, "format": LIVE, "sets": {LIVE: 3}, "channels": [LIVE],
           "units": [LIVE], "error": LIVE, "ignored": [{"set": 1, "type": 5, "title": LIVE, "reason": LIVE}], LIVE: LIVE}  # fmt: skip
    return Results(
        name=LIVE, settings={"units": {LIVE: LIVE}, "channels": {LIVE: {"reason": LIVE}}, LIVE: LIVE}, findings=[finding, finding],
        inventory=[row, row | {"error": None}], idle_frf=frf, check=[CheckRun(LIVE, LIVE, frf)],
        left_out={"oma": LIVE, "compare": LIVE, LIVE: LIVE}, timings_s={LIVE: 1.0},
    )  # fmt: skip


@pytest.fixture(scope="module")
def page():
    return render_report(nasty_results())


def test_no_text_of_a_file_is_markup(page):
    assert not acts(page)
    assert page.count("<script") == 1
    assert "<img" not in page
    assert r"\x1b[31m" in page
    assert "&lt;script&gt;" in page
    assert not re.search(r"<[^>]*\son\w+\s*=\s*['\"]", re.sub(r'"[^"]*"', '""', page))


def test_the_policy_names_the_one_script(page):
    policy = re.search(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">', page)
    assert policy
    assert "default-src 'none'" in policy[1]
    assert re.search(r"script-src 'sha256-[A-Za-z0-9+/=]{44}'(;|$)", policy[1])
    assert page.index(policy[0]) < page.index("<style>")
    script = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)[0]
    assert base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() in policy[1]


def test_drawings_take_texts_as_texts():
    assert "<script" not in mac_matrices([(LIVE, np.eye(1), [LIVE], [LIVE], LIVE, LIVE)])

    def figure():
        made = new_figure(3, 2)
        made.text(0.1, 0.5, "<script>1</script><img src=x onerror=1>")
        return made, LIVE

    text = drawn(figure)()
    assert "<script" not in text
    assert "<img" not in text


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to open the report with")
def test_nothing_runs_in_a_browser(page, tmp_path):
    def opened(html):
        (tmp_path / "report.html").write_text(html, encoding="utf-8")
        return dom_of(tmp_path / "report.html", tmp_path / "profile")

    dom = opened(page)
    assert dom.count("<script") == 1
    assert not re.search(r"<title>\s*owned\s*</title>|<img|<title>1</title>", dom)
    # the policy holds, too: a script and a picture put into the page do not act …
    planted = "<p id='here'></p><script>document.title='owned'</script><img src='none' onerror=\"document.title='owned'\">"
    assert "<title>owned</title>" not in opened(page.replace("<main>", "<main>" + planted))
    # … but would without it, so this test can fail
    free = re.sub(r"<meta http-equiv[^>]*>", "", page)
    assert "<title>owned</title>" in opened(free.replace("<main>", "<main>" + planted))

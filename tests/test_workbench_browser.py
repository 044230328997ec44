"""The workbench in a real browser: a mode chosen in the diagram ends in the test file; pages fit narrow screens and complain of nothing."""

from __future__ import annotations

import threading
import time

import pytest

from browser import CHROMIUM, Browser
from operando.config import load_test
from operando.workbench import Bench, Served
from operando.workbench.edits import Exclude

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
PAGES = ("modes/idle", "modes/operating", "missing", "data", "report")


@pytest.fixture(scope="module")
def browser():
    with Browser() as made:
        yield made


@pytest.fixture
def served(chain_test, browser):
    made = Served(Bench(chain_test / "results"))
    thread = threading.Thread(target=made.answer)
    thread.start()
    yield made
    browser.open("about:blank")
    made.close()
    thread.join(10)


def until(browser, expression, seconds=20.0):
    """Wait until an expression on the page is true."""
    end = time.monotonic() + seconds
    while not browser.run(f"Boolean({expression})"):
        assert time.monotonic() < end, f"{expression}: {browser.run('document.body.innerText')}"
        time.sleep(0.1)


def entered(browser, served, width=1280):
    """The first page, entered by the address that is printed, with the diagram drawn."""
    browser.errors.clear()
    browser.call("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)
    browser.open(served.address)
    until(browser, "location.pathname === '/modes/idle' && document.querySelectorAll('#diagram text.pole').length > 10")


def press(browser, hz, order):
    """Press the mouse on the diagram at a frequency and model order."""
    script = f"""(() => {{
      const svg = document.querySelector('#diagram svg'), host = document.getElementById('diagram'), box = svg.getBoundingClientRect();
      const scale = box.width / svg.viewBox.baseVal.width, at = host.made;
      return [box.x + at.px({hz}) * scale, box.y + at.py({order}) * scale];
    }})()"""
    browser.run("document.getElementById('diagram').scrollIntoView({behavior: 'instant', block: 'center'})")
    x, y = browser.run(script)
    for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
        browser.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)


def test_a_mode_left_out_in_the_diagram_is_saved(browser, served):
    entered(browser, served)
    hz = float(served.bench.results.idle.frequencies_hz[1])
    press(browser, hz, 8)
    until(browser, "document.querySelector('.lines ins')")
    assert browser.run("document.querySelector('.lines ins').textContent") == f"reject_hz = [{hz:.6g}]"
    until(browser, "/is left out$/.test((document.querySelector('#diagram .readout') || {}).textContent)")
    browser.click("button[data-do=save]")
    until(browser, "!document.querySelector('.lines') && /not in the results shown/.test(document.getElementById('panel').textContent)")
    assert load_test(served.bench.draft.path).analysis.reject_hz == (float(f"{hz:.6g}"),)
    assert browser.errors == []


def test_hover_reads_a_pole_and_undo_takes_a_choice_back(browser, served):
    entered(browser, served)
    hz = float(served.bench.results.idle.frequencies_hz[0])
    press(browser, hz, 9)
    until(browser, "document.querySelector('.lines ins')")
    browser.click("button[data-do=undo]")
    until(browser, "!document.querySelector('.lines')")
    until(browser, "document.querySelectorAll('#diagram text.pole').length > 10")
    x, y = browser.run(
        "(b => [b.x + b.width / 2, b.y + b.height / 2])(document.querySelector('#diagram text.pole').getBoundingClientRect())"
    )
    browser.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
    said = browser.run("document.querySelector('#diagram .readout').textContent")
    assert "Hz, damping" in said
    assert "order" in said
    assert browser.errors == []


def test_everything_is_reached_by_keyboard_and_errors_are_read(browser, served):
    entered(browser, served)
    browser.run("document.querySelector('button[data-do=leave]').focus()")
    browser.call("Input.dispatchKeyEvent", type="keyDown", key="Enter", code="Enter", windowsVirtualKeyCode=13, text="\r")
    browser.call("Input.dispatchKeyEvent", type="keyUp", key="Enter", code="Enter", windowsVirtualKeyCode=13)
    until(browser, "document.querySelector('.lines ins')")
    served.bench.draft.path.write_text(served.bench.draft.text + "# by another program\n", encoding="utf-8")
    browser.click("button[data-do=save]")
    until(browser, "!document.getElementById('alert').hidden")
    assert "changed meanwhile" in browser.run("document.getElementById('alert').textContent")
    until(browser, "document.querySelector('button[data-do=reread]')")
    browser.click("button[data-do=reread]")
    until(browser, "!document.querySelector('button[data-do=reread]')")
    browser.click("button[data-do=save]")
    until(browser, "!document.querySelector('.lines')")
    text = served.bench.draft.path.read_text(encoding="utf-8")
    assert "# by another program" in text
    assert "reject_hz" in text
    assert [e for e in browser.errors if "400" not in e] == []


def test_a_run_shows_its_progress_and_the_new_results(browser, served):
    entered(browser, served)
    count = browser.run("document.querySelectorAll('button[data-do=leave]').length")
    browser.click("button[data-do=leave]", 1)
    until(browser, "document.querySelector('.lines ins')")
    browser.click("button[data-do=run]")
    until(browser, "document.querySelector('#panel progress')")
    until(browser, "/Done/.test(document.getElementById('panel').textContent)", 120)
    until(browser, f"document.querySelectorAll('button[data-do=leave]').length === {count - 1}")
    assert browser.errors == []


def test_the_form_of_an_effect_follows_the_kind(browser, served):
    entered(browser, served)
    browser.open(served.address.split("?")[0] + "missing")
    browser.run("(s => { s.value = 'coupling_spring'; s.dispatchEvent(new Event('change')); })(document.querySelector('#effect select'))")
    shown = "document.querySelectorAll('#effect fieldset:not([hidden]) {}').length"
    assert browser.run(shown.format("[name=dof]")) == 2
    assert browser.run(shown.format("input.value")) == 1
    assert browser.errors == []


@pytest.mark.parametrize("width", [400, 1280])
def test_pages_fit_the_screen_and_complain_of_nothing(browser, served, width):
    entered(browser, served, width)
    for page in PAGES:
        browser.open(served.address.split("?")[0] + page)
        assert browser.run("document.documentElement.scrollWidth") <= width, page
        nameless = "e => !(e.textContent.trim() || e.ariaLabel || (e.labels || []).length)"
        assert browser.run(f"Array.from(document.querySelectorAll('button, input, select')).filter({nameless}).length") == 0, page
    assert browser.errors == []


@pytest.mark.parametrize("width", [400, 1280])
def test_nothing_serious_bars_anyone_from_the_pages(browser, served, axe, width):
    entered(browser, served, width)
    served.bench.draft.add(Exclude("2+Z", "cable"))
    for page in PAGES:
        browser.open(served.address.split("?")[0] + page)
        browser.run(f"{axe}; 0")
        options = "{resultTypes: ['violations'], iframes: false}"
        found = browser.run(f"axe.run(document, {options}).then(r => r.violations.map(v => [v.impact, v.id, v.nodes[0].html]))")
        assert [v for v in found if v[0] in ("serious", "critical")] == [], page

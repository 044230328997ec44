"""The report in a browser: pickers, cursor, zoom, moving shapes, sorting, data of the figures; without JavaScript and in print."""

from __future__ import annotations

import base64
import gzip
import io
import json
import re
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from browser import CHROMIUM, Browser
from operando.cli import main
from operando.report import render_report
from operando.report.figure_csv import figure_csv
from operando.report.svg import new_figure
from test_report import whole  # noqa: F401

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to open the report with")


@pytest.fixture(scope="module")
def html(whole):  # noqa: F811
    return render_report(whole)


@pytest.fixture(scope="module")
def file(html, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(html, encoding="utf-8")
    return path


@pytest.fixture
def page(file):
    with Browser() as browser:
        browser.open(file)
        yield browser
        assert browser.errors == []


LIVE = "document.querySelector('.live[data-kind={}]')"
CHOOSE = "(s => {{ s.value = '{}'; s.dispatchEvent(new Event('change')); }})({}.querySelectorAll('select')[{}])"


def ink(canvas):
    """How many points of a canvas are not blank."""
    return f"(c => c.getContext('2d').getImageData(0, 0, c.width, c.height).data.filter((v, i) => i % 4 === 3 && v > 0).length)({canvas})"


@needs_browser
def test_picker_draws_the_chosen_pair_and_the_cursor_reads_the_models_values(page, whole):  # noqa: F811
    frfs = LIVE.format("frfs")
    canvas = f"{frfs}.querySelector('canvas')"
    before = page.run(f"{canvas}.toDataURL()")
    names = page.run(f"Array.from({frfs}.querySelector('select').options, o => o.textContent)")
    assert names == [str(d) for d in whole.idle_frf.responses]
    page.run(CHOOSE.format(5, frfs, 0))
    page.run(CHOOSE.format(3, frfs, 1))
    assert page.run(f"{canvas}.dataset.pair") == "105+Z from 103+Z"
    assert page.run(f"{canvas}.toDataURL()") != before
    assert page.run(ink(canvas)) > 2000
    page.click(".live[data-kind=frfs] canvas")
    said = page.run(f"{frfs}.querySelector('.readout').textContent").replace("−", "-")
    hz = float(re.match(r"([\d.]+) Hz", said)[1])
    for name, model in (("idle model", whole.idle), ("operational FRF", whole.hybrid)):
        level, phase = map(float, re.search(rf"{name}: (-?[\d.]+) dB, (-?[\d.]+)°", said).groups())
        h = model.frf([hz], "105+Z", "103+Z").data[0, 0, 0]
        assert level == pytest.approx(20 * np.log10(abs(h)), abs=0.02)
        assert abs((phase - np.degrees(np.angle(h)) + 180) % 360 - 180) < 1.0


@needs_browser
def test_measured_curves_are_those_of_the_results(page, whole):  # noqa: F811
    frfs = LIVE.format("frfs")
    page.run(CHOOSE.format(2, frfs, 0))
    page.run(CHOOSE.format(0, frfs, 1))
    page.click(".live[data-kind=frfs] canvas")
    said = page.run(f"{frfs}.querySelector('.readout').textContent").replace("−", "-")
    hz = float(re.match(r"([\d.]+) Hz", said)[1])
    level, coherence = map(float, re.search(r"idle, measured: (-?[\d.]+) dB, -?\d+°, coherence ([\d.]+)", said).groups())
    near = np.flatnonzero(np.abs(whole.idle_frf.frequencies_hz - hz) < 2.0)
    levels = 20 * np.log10(np.abs(whole.idle_frf.data[2, 0, near]))
    assert np.min(np.abs(levels - level)) < 0.02
    assert np.min(np.abs(whole.idle_frf.coherence[2, 0, near] - coherence)) < 0.005


@needs_browser
def test_zoom_by_buttons_and_back(page):
    frfs = LIVE.format("frfs")
    page.click(".live[data-kind=frfs] button")
    low, high = map(float, page.run(f"{frfs}.querySelector('canvas').dataset.range").split())
    assert 8.0 <= low < high <= 140.0
    assert high - low == pytest.approx(66.0, rel=1e-3)
    page.click(".live[data-kind=frfs] button", 2)
    assert page.run(f"{frfs}.querySelector('canvas').dataset.range") == "8 140"


@needs_browser
def test_shapes_move_when_asked_and_only_then(page):
    shapes = LIVE.format("shapes")
    canvas = f"{shapes}.querySelector('canvas')"
    assert page.run(f"{canvas}.dataset.frames") is None
    still = page.run(f"{canvas}.toDataURL()")
    page.click(".live[data-kind=shapes] button")
    wait = (
        f"new Promise(r => {{ const t = setInterval(() => {{ if ({canvas}.dataset.frames > 5) {{ clearInterval(t); r(true); }} }}, 20); }})"
    )
    assert page.run(wait)
    assert page.run(f"{canvas}.toDataURL()") != still
    page.click(".live[data-kind=shapes] button")
    stopped = page.run(f"{canvas}.dataset.frames")
    page.run("new Promise(r => setTimeout(r, 200))")
    assert page.run(f"{canvas}.dataset.frames") == stopped
    page.run(CHOOSE.format(3, shapes, 0))
    assert page.run(f"{canvas}.dataset.mode").startswith("idle 3")


@needs_browser
def test_poles_are_read_when_their_part_is_opened(page):
    poles = LIVE.format("poles")
    assert page.run(f"{poles}.hidden")
    page.run(f"{poles}.closest('details').open = true; new Promise(r => setTimeout(r, 100))")
    page.click(".live[data-kind=poles] canvas")
    assert "nearest pole" in page.run(f"{poles}.querySelector('.readout').textContent")


@needs_browser
def test_tables_sort_by_number(page):
    body = "Array.from(document.querySelectorAll('#answer table')[0].tBodies[0].rows, r => parseFloat(r.cells[2].textContent))"
    up = page.run(body)
    page.click("#answer table th:nth-child(3) button")
    assert page.run(body) == sorted(up)
    page.click("#answer table th:nth-child(3) button")
    assert page.run(body) == sorted(up, reverse=True)


@contextmanager
def on_screen(file, width):
    """A report on a screen of this width, with all its parts open."""
    with Browser(width, 900) as browser:
        browser.call("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)
        browser.open(file)
        browser.run("document.querySelectorAll('details').forEach(d => d.open = true); new Promise(r => setTimeout(r, 100))")
        yield browser
        assert browser.errors == []


def stays_within(browser):
    """Whether the page does not scroll sideways."""
    return browser.run("document.documentElement.scrollWidth <= document.documentElement.clientWidth")


@needs_browser
@pytest.mark.parametrize("width", [320, 400, 1280])  # 320: what WCAG 2.2, 1.4.10 (reflow), asks for
def test_nothing_is_wider_than_the_screen(file, width):
    with on_screen(file, width) as browser:
        assert stays_within(browser)


@pytest.fixture(scope="module")
def demo_file(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    done = CliRunner().invoke(main, ["demo", "-o", str(folder)])
    assert done.exit_code == 0, done.output
    return folder / "report.html"


@needs_browser
def test_demo_reads_on_a_narrow_screen(demo_file):
    with on_screen(demo_file, 400) as browser:
        assert stays_within(browser)
        # a caption stays in view while its table scrolls, so all of it must fit in the box
        beyond = "s => s.getBoundingClientRect().right - s.closest('.scroll').getBoundingClientRect().right"
        assert browser.run(f"Math.max(...Array.from(document.querySelectorAll('caption span'), {beyond}))") < 1
    with on_screen(demo_file, 320) as browser:
        assert stays_within(browser)


@needs_browser
@pytest.mark.parametrize("width", [320, 400])
def test_long_names_wrap_on_a_narrow_screen(whole, tmp_path, width):  # noqa: F811
    name = "frame_with_gearbox_and_pump_on_four_rubber_mounts_2026-11-28_second_run"
    results = replace(whole, name=name, left_out={"diagnose": f"no file {name}/{name}.uff"})
    path = tmp_path / "report.html"
    path.write_text(render_report(results), encoding="utf-8")
    with on_screen(path, width) as browser:
        assert stays_within(browser)


@needs_browser
@pytest.mark.parametrize("width", [400, 1280])
def test_nothing_serious_bars_anyone_from_the_report(file, axe, width):
    with Browser(width, 900) as browser:
        browser.open(file)
        browser.run(f"{axe}; 0")
        found = browser.run(
            "axe.run(document, {resultTypes: ['violations']}).then(r => r.violations.map(v => [v.impact, v.id, v.nodes[0].html]))"
        )
        assert [v for v in found if v[0] in ("serious", "critical")] == []


@needs_browser
def test_print_and_no_script_show_the_still_pictures(file):
    with Browser() as browser:
        browser.open(file)
        browser.call("Emulation.setEmulatedMedia", media="print")
        assert browser.run("getComputedStyle(document.querySelector('.live')).display") == "none"
        browser.call("Emulation.setEmulatedMedia", media="")
        browser.call("Emulation.setScriptExecutionDisabled", value=True)
        browser.open(file)
        assert browser.run("document.querySelectorAll('.live:not([hidden])').length") == 0
        assert browser.run("Array.from(document.querySelectorAll('figure svg')).every(s => s.getBoundingClientRect().height > 50)")


@needs_browser
def test_text_stands_out_from_its_ground(page):
    """Contrast of WCAG AA for all text of the page (4.5 to 1)."""
    script = """(() => {
      const linear = v => (v /= 255) <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4;
      const light = c => { const [r, g, b] = c.map(linear); return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
      const parts = s => s.match(/[\\d.]+/g).map(Number);
      const ground = e => {
        for (; e; e = e.parentElement) {
          const c = parts(getComputedStyle(e).backgroundColor);
          if (c.length < 4 || c[3] > 0) return c.slice(0, 3);
        }
        return [255, 255, 255];
      };
      const bad = new Set();
      document.querySelectorAll('p, td, th, li, h1, h2, h3, summary, span, a, figcaption, caption, label, button, footer').forEach(e => {
        if (!e.textContent.trim() || !e.offsetParent || e.closest('.off')) return;
        const a = light(parts(getComputedStyle(e).color).slice(0, 3)), b = light(ground(e));
        const contrast = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
        if (contrast < 4.5) bad.add(e.tagName + '.' + e.className + ' ' + e.textContent.slice(0, 30));
      });
      return Array.from(bad);
    })()"""
    page.run("document.querySelectorAll('details').forEach(d => { d.open = true; }); new Promise(r => setTimeout(r, 200))")
    assert page.run(script) == []


def test_every_figure_holds_its_data(html):
    found = re.findall(r'download="figure-(\d+)\.csv\.gz" href="data:application/gzip;base64,([^"]+)"', html)
    assert [int(n) for n, _ in found] == list(range(1, 1 + html.count("<figure>")))
    for _, packed in found:
        lines = gzip.decompress(base64.b64decode(packed)).decode().splitlines()
        widths = {line.count(",") for line in lines}
        assert len(widths) == 1, "a table has rows of one length"
        assert len(lines) > 1


def test_data_of_a_figure_are_what_it_draws():
    figure = new_figure(4, 3)
    axes = figure.add_subplot()
    axes.plot([1, 2, 3], [1.5, np.nan, 2.5], label="=SUM(A1), b")
    axes.plot([1, 2, 3], [4, 5, 6], label="two")
    axes.bar([0, 1], [3, 4])
    axes.set_xlabel("Frequency [Hz]")
    axes.set_ylabel("Level")
    table = np.genfromtxt(io.StringIO(figure_csv(figure)), delimiter=",", names=True)
    assert table.shape == (3,)
    np.testing.assert_allclose(table["Frequency_Hz"], [1, 2, 3])
    np.testing.assert_allclose(table["Level__two"], [4, 5, 6])
    np.testing.assert_allclose(table["Level_to"], [3, 4, np.nan])
    assert np.isnan(table["Level__SUMA1__b"][1])


def test_hostile_names_stay_text_in_the_data_of_the_script(html):
    data = [json.loads(re.sub("&#34;", '"', d)) for d in re.findall(r"<pre hidden>(.*?)</pre>", html, re.DOTALL)]
    assert {tuple(sorted(d))[:2] for d in data}
    assert "<" not in "".join(re.findall(r"<pre hidden>(.*?)</pre>", html, re.DOTALL))

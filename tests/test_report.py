"""The report: whole and partial results, self-contained HTML, figures, numbers in words."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass, field, replace
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest

from operando.compare import compare_all, error_map
from operando.data import Channel, Finding, Frf, Geometry, ModalModel, Provenance, TimeRecord, group_findings
from operando.dof import Dof
from operando.errors import WriteError
from operando.report import assumptions, derive, headline, render_report, sections_rest, write_report
from operando.report.figures_modes import ShapePair, mode_shapes
from operando.report.idle_check import idle_peaks
from operando.report.parts import render
from operando.report.svg import thin
from operando.report.text import band_text, count, decibel, fixed, listing, number, plus_minus
from operando.results import CheckRun, Results
from operando.scaling import scale_operational
from operando.stabilization import PoleTable, RejectedPole, Stabilization
from structures import Chain

N = 12
BAND = (8.0, 140.0)


@dataclass(frozen=True)
class Details:
    """What an identification keeps, as the report reads it."""

    stabilization: Stabilization | None = None
    harmonics_hz: np.ndarray = field(default_factory=lambda: np.zeros(0))
    spectra: object = None
    second_opinion: object = None
    fit_band_hz: tuple = (7.0, 150.0)
    fit_misfit: float = 1.01
    converged: bool = False
    misfit_by_dof: np.ndarray = field(default_factory=lambda: np.linspace(0.9, 1.3, N))
    rounds: tuple = ("12 modes, misfit 1.0 <ok>",)


def dofs():
    return tuple(Dof(100 + i, "Z") for i in range(N))


def grid():
    nodes = tuple(100 + i for i in range(N))
    xyz = np.array([[0.3 * (i % 4), 0.25 * (i // 4), 0.0] for i in range(N)])
    lines = tuple((100 + 4 * r + c, 101 + 4 * r + c) for r in range(3) for c in range(3))
    return Geometry(nodes, xyz, lines + tuple((100 + i, 104 + i) for i in range(8)))


def diagram(hz, zeta, seed):
    rng = np.random.default_rng(seed)
    order, f, z, status = [], [], [], []
    for n in range(2, 61, 2):
        found = min(len(hz), n // 2)
        order += [n] * (found + n // 4)
        f += list(hz[:found] * (1 + 1e-4 * rng.standard_normal(found))) + list(rng.uniform(*BAND, n // 4))
        z += list(zeta[:found]) + list(rng.uniform(0, 0.1, n // 4))
        status += [3 if n > 26 else 2] * found + list(rng.integers(0, 2, n // 4))
    table = PoleTable(np.array(order), np.array(f), np.array(z), np.ones((2, len(f)), complex), np.array(status))
    rejected = (
        RejectedPole(50.0, 0.0002, "harmonic", "a harmonic of 25.00 Hz: its damping of 0.02 % is below that of any mode"),
        RejectedPole(71.3, 0.081, "too_damped", "damping of 8.1 % is above the limit of 5 % <script>"),
    )
    lines = np.linspace(*BAND, 900)
    curves = np.array([np.sum([1 / ((lines - h) ** 2 + 0.2) for h in hz[k::2]], axis=0) for k in range(2)])
    return Stabilization(table, hz, zeta, np.ones((2, len(hz)), complex), tuple(np.array([0]) for _ in hz), rejected, lines, curves)


def covariance(n, m, f, z, shapes, relative):
    std = np.concatenate([relative * 0.02 * f, relative * z, relative * np.abs(np.asarray(shapes)).max() * np.ones(m * n)])
    return np.diag(std**2)


def measured(chain, f, references, noise, seed):
    rng = np.random.default_rng(seed)
    h = chain.accelerance(f, ref=references)
    variance = (noise * np.sqrt(np.mean(np.abs(h) ** 2, axis=2, keepdims=True)) * np.ones(f.size)) ** 2
    data = h + np.sqrt(variance / 2) * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape))
    coherence = np.abs(h) ** 2 / (np.abs(h) ** 2 + 20 * variance)
    refs = tuple(dofs()[i] for i in references)
    inputs = Provenance((("idle/run1.uff", "ab" * 32),), ("estimate_frf(estimator='h1')",))
    return Frf(data, f, dofs(), refs, variance=variance, coherence=coherence, averages=20.0, provenance=inputs)


@pytest.fixture(scope="module")
def whole():
    rest = Chain(N, mass=1.0, stiffness=2e5, zeta=0.008, seed=1)
    running = Chain(N, mass=1.0, stiffness=2e5, zeta=0.011, seed=1)
    running.K[4, 4] += 1.5e5
    w2, running.phi = np.linalg.eigh(np.linalg.inv(np.sqrt(running.M)) @ running.K @ np.linalg.inv(np.sqrt(running.M)))
    running.phi = np.linalg.inv(np.sqrt(running.M)) @ running.phi
    running.hz = np.sqrt(w2) / 2 / np.pi
    f = np.arange(6.0, 150.0, 0.2)
    frf = measured(rest, f, [0, 7], 0.01, 2)
    residual = np.r_[np.zeros(N, bool), True]
    hz, zeta = np.r_[rest.hz, 190.0], np.r_[rest.zeta, 0.01]
    shapes = np.column_stack([rest.phi, 0.02 * np.ones(N)])
    idle = ModalModel.from_terms(
        hz, zeta, shapes, dofs(), "unit_modal_mass", residual=residual, covariance=covariance(N + 1, N, hz, zeta, shapes, 0.01),
        band_hz=BAND, misfit=1.04, details=Details(diagram(rest.hz, rest.zeta, 3)),
    )  # fmt: skip
    rng = np.random.default_rng(5)
    factor = np.exp(1j * rng.uniform(0, 6, N)) * rng.uniform(1, 9, N)
    noisy = (running.phi + 0.01 * (rng.standard_normal((N, N)) + 1j * rng.standard_normal((N, N)))) * factor
    lines = np.linspace(6, 150, 1500)
    singular = np.array([np.sum([1 / ((lines - h) ** 2 + 0.3) for h in running.hz], axis=0) / 10**k for k in range(4)])
    spectra = SimpleNamespace(frequencies_hz=lines, singular_values=singular)
    cov = np.diag(np.r_[2e-4 * running.hz, 0.05 * running.zeta, 0.02 * np.ones(2 * N * N)] ** 2)
    operating = ModalModel(
        running.hz, running.zeta, noisy, dofs(), covariance=cov, band_hz=BAND,
        details=Details(diagram(running.hz, running.zeta, 4), np.array([25.0, 50.0]), spectra),
    )  # fmt: skip
    hybrid = scale_operational(idle, operating)
    check = [
        CheckRun("check/run1a.uff", "a", measured(running, f, [0], 0.01, 6)),
        CheckRun("check/run2a.uff", "a", measured(running, f, [7], 0.01, 7)),
        CheckRun("check/run1b.uff", "b", measured(running, f, [0], 0.02, 8)),
        CheckRun("check/run2b.uff", "b", measured(running, f, [7], 0.02, 9)),
    ]
    models = {"idle": idle, "ofrf": hybrid} | {k: hybrid.alternative_models[k] for k in ("idle_shapes", "msf_all")}
    comparison = compare_all(models, check, BAND)
    findings = [
        Finding("double_hit", "two hits within 12 ms", "info", "run1.uff", 2, "100+Z", (1.0, 1.012), None, "hit left out", "hit once"),
        Finding("overload", "18 samples at full scale", "error", "run2.uff", 0, "103+Z", None, None, "peaks are cut", "lower the gain"),
        Finding("few_averages", "4 averages & <few>", "warning", "run1.uff"),
    ]
    inventory = [
        {"file": "idle/run1.uff", "role": "idle", "format": "uff", "channels": 13, "dofs": [str(d) for d in dofs()], "ignored": [],
         "units": {"force": "N"}, "sampling_hz": 1024.0, "duration_s": 40.0, "used": True},
    ]  # fmt: skip
    return Results(
        "chain & <grid>", {"band": list(BAND), "oma": {"method": "ssi-cov"}}, findings, inventory, grid(), frf, idle, operating, hybrid,
        check, comparison, None, {"diagnose": "not built yet"}, {"frf": 1.2, "ema": 9.75},
    )  # fmt: skip


class Page(HTMLParser):
    """Collects what matters and insists on balanced tags."""

    VOID = frozenset({"meta", "br", "link", "img", "hr", "input", "path", "use", "rect", "circle", "line"})

    def __init__(self, text):
        super().__init__()
        self.stack, self.ids, self.targets, self.counts = [], [], [], {}
        self.feed(text)
        assert not self.stack

    def handle_starttag(self, tag, attrs):
        self.counts[tag] = self.counts.get(tag, 0) + 1
        for name, value in attrs:
            if name == "id":
                self.ids.append(value)
            if name in ("href", "xlink:href", "src"):
                self.targets.append(value)
        if tag not in self.VOID or self.get_starttag_text().endswith("/>"):
            self.stack.append(tag)

    def handle_startendtag(self, tag, attrs):
        if tag not in self.VOID:
            self.handle_starttag(tag, attrs)
            self.stack.pop()
        else:
            self.handle_starttag(tag, attrs)
            if self.stack and self.stack[-1] == tag:
                self.stack.pop()

    def handle_endtag(self, tag):
        if self.stack and self.stack[-1] == tag:
            self.stack.pop()
        else:
            assert tag in self.VOID, f"</{tag}> closes {self.stack[-3:]}"


@pytest.fixture(scope="module")
def html(whole):
    return render_report(whole)


def test_whole_report_is_self_contained(html):
    page = Page(html)
    assert all(t.startswith(("#", "data:")) for t in page.targets)
    assert not re.search(r"(?:src|href)\s*=\s*[\"']?(?:https?:)?//", html)
    assert "url(http" not in html
    assert "@import" not in html
    assert len(page.ids) == len(set(page.ids)), "two elements share an id"
    assert {t[1:] for t in page.targets if t.startswith("#")} <= set(page.ids)
    assert len(html.encode()) < 6e6
    assert not re.search(r"\bnan\b", re.sub(r"<style.*?</style>", "", html, flags=re.DOTALL).lower())


def test_every_figure_and_section_is_there(html):
    page = Page(html)
    assert page.counts["figure"] == page.counts["svg"] == 13
    assert [int(n) for n in re.findall(r"<b>Figure (\d+)\.</b>", html)] == list(range(1, 14))
    for anchor in ("answer", "data", "idle", "operating", "shapes", "scaling", "ofrf", "diagnosis", "settings"):
        assert f'href="#{anchor}"' in html
    assert html.count("aria-label=") >= 13
    assert "not built yet" in html
    assert "abab" in html
    assert "&lt;script&gt;" in html
    assert "chain &amp; &lt;grid&gt;" in html


def test_headings_stand_in_order(html):
    """A screen reader goes from heading to heading: the title is the first, and no level is left out."""
    levels = [int(n) for n in re.findall(r"<h([1-6])\b", html)]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert max(np.diff(levels)) == 1


def test_answer_has_the_numbers_of_the_comparison(whole, html):
    error = whole.comparison["models"]["ofrf"]["error_db"]
    text = " ".join(headline(whole).sentences)
    assert f"{error:.2f} dB" in text
    assert (
        f"{whole.comparison['models']['idle']['error_db']:.2f} dB" in text
        or f"{whole.comparison['models']['idle']['error_db']:.1f} dB" in text
    )
    assert html.index(text[:40]) < html.index("2. What was measured</h2>")


def test_findings_gravest_first(html):
    body = html[html.index("What is wrong with the data") :]
    assert body.index("18 samples") < body.index("4 averages") < body.index("two hits")


def test_findings_counted_as_one_are_not_counted_again(whole):
    """A test counts alike findings of its FRFs as one; what each FRF says of them, and of a polarity reversed, is no finding more."""
    alike = tuple(Finding("overload", f"{n} samples at full scale", "info", file=f"run{n}.uff") for n in range(3))
    of_model = (Finding("drive_point_sign", "negative residues", "error", dof="30+Z"),)
    again = Finding("inverted", "drive point 30+Z/30+Z: 90 % of the dissipated power is negative", "error", dof="30+Z")
    other = Finding("overload", "the reference is overloaded", "info")
    frf, idle = replace(whole.idle_frf, findings=(*alike, again, other)), replace(whole.idle, findings=of_model)
    results = replace_results(whole, findings=group_findings([*of_model, *alike]), idle_frf=frf, idle=idle)
    of_check = {f for run in whole.check for f in run.frf.findings}
    assert [f for f in derive.all_findings(results) if f not in of_check] == [*of_model, group_findings(alike)[0], other]


def test_figures_are_quick_and_load_no_pyplot(whole, tmp_path):
    import sys

    # Another test of the same process may have loaded it (the second opinions do).
    sys.modules.pop("matplotlib.pyplot", None)
    start = time.process_time()  # of this process: other work on the machine does not count
    write_report(whole, tmp_path / "report.html")
    assert time.process_time() - start < 12
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    assert "matplotlib.pyplot" not in sys.modules


def test_failed_write_leaves_the_old_report(whole, tmp_path, monkeypatch):
    target = tmp_path / "report.html"
    target.write_text("old")
    monkeypatch.setattr("os.replace", lambda *a: (_ for _ in ()).throw(OSError("disk")))
    with pytest.raises(WriteError, match="disk"):
        write_report(replace_results(whole, name="x", idle=None, operating=None, hybrid=None, check=[], idle_frf=None), target)
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def replace_results(results, **changes):
    values = {k: getattr(results, k) for k in results.__dataclass_fields__}
    return Results(**(values | changes))


PARTS = {
    "no check": ({"check": [], "comparison": None}, "no validation measurement"),
    "no geometry": ({"geometry": None, "check": [], "comparison": None, "idle_frf": None}, "There is no geometry"),
    "no operating": (
        {"operating": None, "hybrid": None, "comparison": None, "left_out": {"oma": "no [operating] in the test"}},
        "no [operating]",
    ),
    "no idle": ({"idle": None, "idle_frf": None, "hybrid": None, "comparison": None}, "There is no idle model"),
    "no comparison": ({"comparison": None, "idle_frf": None, "geometry": None}, "The comparison was not made"),
    "only frf": (
        {"idle": None, "operating": None, "hybrid": None, "check": [], "comparison": None, "geometry": None},
        "No modes were identified",
    ),
}


@pytest.mark.parametrize("name", PARTS)
def test_missing_parts_are_said_in_a_sentence(whole, name):
    changes, sentence = PARTS[name]
    text = render_report(replace_results(whole, **changes))
    Page(text)
    assert sentence in text


def test_empty_results_make_a_report():
    text = render_report(Results("nothing"))
    page = Page(text)
    assert "svg" not in page.counts
    assert text.count('class="missing"') >= 8
    assert "Operational FRFs were not made" in text


def test_idle_without_units_says_how_to_give_them(whole):
    idle = replace(whole.idle, scaling="unscaled", shapes=whole.idle.shapes.astype(complex), covariance=None, si=False)
    frf = replace(whole.idle_frf, si=False)
    text = render_report(replace_results(whole, idle=idle, idle_frf=frf, hybrid=None, comparison=None, check=[]))
    assert "[units]" in text
    assert "units of the file" in text


def test_not_reciprocal_is_the_first_thing_that_does_not_hold(whole):
    finding = Finding("not_reciprocal", "H differs from its transpose by 21 %", "error")
    results = replace_results(whole, findings=[*whole.findings, finding], check=[], comparison=None)
    limits = headline(results).limits
    assert any("21 %" in t and "symmetric" in t for t in limits)
    reciprocity = lambda r: next(a for a in assumptions(r) if a.name.startswith("Reciprocity"))  # noqa: E731
    assert reciprocity(whole).state == "holds"
    against_the_check = reciprocity(replace_results(whole, findings=[finding]))
    assert against_the_check.state == "doubtful"
    assert "21 %" in against_the_check.text
    at_rest = replace(whole.idle_frf, findings=(finding,))
    assert reciprocity(replace_results(whole, findings=[finding], idle_frf=at_rest)).state == "holds"


def test_skew_check_is_found_not_reciprocal_from_the_numbers(whole):
    runs = [r for r in whole.check if r.level == "b"]
    skewed = [replace_check(runs[0], 1.0), replace_check(runs[1], 1.4)]
    state = next(a for a in assumptions(replace_results(whole, check=skewed)) if a.name.startswith("Reciprocity"))
    assert state.state == "fails"


def replace_check(run, factor):
    return CheckRun(run.name, run.level, replace(run.frf, data=run.frf.data * factor))


def test_runs_of_one_level_stand_side_by_side(whole):
    run = derive.validation_run(whole)
    assert run.level == "b"
    assert [str(d) for d in run.frf.references] == ["100+Z", "107+Z"]
    assert len(run.frf.drive_points()) == 2


def test_level_difference_is_one_where_only_noise_differs(whole):
    assert derive.level_difference(whole.check)["ratio"] == pytest.approx(1.0, abs=0.05)
    louder = [replace_check(r, 1.3 if r.level == "a" else 1.0) for r in whole.check]
    assert derive.level_difference(louder)["ratio"] > 5


def test_error_map_agrees_with_a_known_gain(whole):
    run = derive.validation_run(whole)
    louder = replace(run.frf, data=run.frf.data * 2)
    error = error_map(louder, run.frf, derive.band_edges(BAND))
    assert error.shape == (N, 8)
    np.testing.assert_allclose(error[np.isfinite(error)], 20 * np.log10(2), rtol=1e-9)


def test_sensor_redundancy_points_at_the_twins():
    rng = np.random.default_rng(0)
    shapes = rng.standard_normal((5, 5))
    shapes[3] = shapes[1] + 1e-3 * rng.standard_normal(5)
    found = derive.sensor_redundancy(shapes, dofs()[:5])
    assert set(np.argsort(-found["dofs"])[:2]) == {1, 3}
    assert found["kappa"] == pytest.approx(np.linalg.cond(shapes))
    assert derive.sensor_redundancy(shapes[:3], dofs()[:3]) is None


def test_thinned_curve_keeps_peaks():
    x = np.linspace(0, 1, 50_000)
    y = np.zeros(x.size)
    y[31_415] = 7.0
    keep = thin(x, y, 300)
    assert keep.size <= 602
    assert 31_415 in keep
    assert {0, x.size - 1} <= set(keep.tolist())


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (21.07868, 0.00123, "21.079 ± 0.002"),
        (64.2, 0.0508, "64.2 ± 0.1"),
        (3.0, 12.3, "3 ± 24"),
        (-0.5, None, "−0.50000"),
        (None, 1.0, "–"),
    ],
)
def test_value_and_its_95_percent_interval_have_matching_digits(value, std, text):
    assert re.sub("<[^>]+>", "", plus_minus(value, std)) == text


def test_words():
    assert (count(0, "mode"), count(1, "mode"), count(3, "mode")) == ("no modes", "1 mode", "3 modes")
    assert listing(["a", "b", "c"]) == "a, b and c"
    assert (band_text((5.4, 142.2)), band_text((53.477, 53.477)), band_text(None)) == ("5.4–142.2 Hz", "53.477 Hz", "–")
    assert number(float("nan")) == "–"
    assert number(1.23456e-7, 3) == "1.23·10⁻⁷"
    assert fixed(-0.001, 2, sign=True) == "+0.00" or fixed(-0.001, 2, sign=True) == "0.00"


@pytest.mark.parametrize("layout", ["line", "plane", "solid", "twins"])
def test_shapes_are_drawn_without_lines_in_the_geometry(layout):
    rng = np.random.default_rng(1)
    xyz = rng.uniform(0, 1, (N, 3)) * {"line": [1, 0, 0], "plane": [1, 1, 0], "solid": [1, 1, 1], "twins": [0, 0, 1]}[layout]
    if layout == "twins":
        xyz[:] = xyz[0]
    geometry = Geometry(tuple(100 + i for i in range(N)), xyz)
    shape = rng.standard_normal(N)
    svg = mode_shapes(geometry, dofs(), [ShapePair("one", shape, -shape, "idle", "running"), ShapePair("two", shape, None)])
    assert svg.startswith("<svg")
    assert "nan" not in svg
    assert "Mode shapes, idle and operating, 2 modes side by side" in svg
    assert "Mode shapes, idle, 1 mode side by side" in mode_shapes(geometry, dofs(), [ShapePair("one", shape, None)])
    assert "Mode shapes, operating, 1 mode side by side" in mode_shapes(geometry, dofs(), [ShapePair("one", None, shape)])


def test_inventory_and_findings_cells_are_escaped():
    text = render("inventory.html.j2", **sections_rest.inventory([{"file": "a<b>.uff", "channels": 3, "note": "x & y", "nothing": None}]))
    assert "a&lt;b&gt;.uff" in text
    assert "x &amp; y" in text
    assert "nothing" not in text
    assert "<i>" not in render("findings.html.j2", **sections_rest.findings([Finding("nan", "<i>", dof="1+Z")]))


def test_record_types_used_by_the_report_import_without_matplotlib():
    import subprocess
    import sys

    code = "import sys, operando.report; assert not {'matplotlib', 'scipy.signal', 'pandas'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert TimeRecord(np.zeros((1, 4)), 10.0, (Channel(None),)).duration_s == 0.4


def test_second_opinion_names_the_modes_it_disagrees_on(whole):
    row = {"frequency_hz": 17.27, "other_frequency_hz": 17.26, "damping_ratio": 0.008, "other_damping_ratio": 0.0081, "mac": 0.999}
    rows = ({**row, "agrees": True, "text": ""}, {**row, "frequency_hz": 34.05, "agrees": False, "text": "damping & <scale>"})
    idle = replace(whole.idle, details=replace(whole.idle.details, second_opinion=rows))
    text = render_report(replace_results(whole, idle=idle, operating=None, hybrid=None, check=[], comparison=None))
    assert "agrees on 1 of 2 modes; it disagrees at 34.05 Hz" in text
    assert "damping &amp; &lt;scale&gt;" in text


def test_thinned_curve_steps_over_gaps():
    x = np.linspace(0, 1, 9_000)
    y = np.sin(40 * x)
    y[1_000:3_000] = np.nan
    keep = thin(x, y, 200)
    inner = keep[(keep > 0) & (keep < x.size - 1)]
    assert np.all(np.isfinite(y[inner]))
    assert np.nanmax(y[keep]) == np.nanmax(y)
    assert np.nanmin(y[keep]) == np.nanmin(y)


def test_variance_is_filled_for_the_pairs_drawn_only(whole):
    run = derive.validation_run(whole)
    bare = derive.model_frf(whole.hybrid, run.frf)
    assert bare.variance is None
    some = derive.with_variance(whole.hybrid, bare, [(3, 1, "worst pair")])
    full = whole.hybrid.frf(run.frf.frequencies_hz, run.frf.responses, run.frf.references)
    np.testing.assert_allclose(some.data, full.data, rtol=1e-12)
    np.testing.assert_allclose(some.variance[3, 1], full.variance[3, 1], rtol=1e-9)
    assert np.isnan(some.variance[0, 0]).all()


def test_scale_of_modes_leaves_damping_errors_out(whole):
    models = whole.comparison["models"]
    damped = [{"frequency_hz": 20.0, "height_error_db": -20 * np.log10(1.2), "damping_error_percent": 20.0, "frequency_error_percent": 0.0}]
    heavier = [{"frequency_hz": 20.0, "height_error_db": 1.5, "damping_error_percent": 0.0, "frequency_error_percent": 0.0}]

    def mass(by_mode):
        comparison = whole.comparison | {"models": models | {"ofrf": models["ofrf"] | {"by_mode": by_mode}}}
        found = assumptions(replace_results(whole, comparison=comparison))
        return next(a for a in found if a.name.startswith("Same mass"))

    assert "0.00 dB" in mass(damped).text
    assert mass(heavier).state == "doubtful"


def test_what_the_fit_did_is_told(html):
    body = " ".join(
        html[
            html.index("3. Idle state (reference): FRFs and model</h2>") : html.index("4. Operating state: operational modes</h2>")
        ].split()
    )
    assert "It did not converge" in body
    assert "1.30 at worst, at 111+Z" in body
    assert "misfit 1.0 &lt;ok&gt;" in body


def test_real_modes_do_not_hold_where_the_idle_model_says_they_are_not(whole):
    from operando.diagnosis import complex_idle

    message = "residues of the mode at 53.48 Hz are not in phase (quadrature part 25 % rms)"
    results = only(whole, idle=whole.idle, idle_frf=whole.idle_frf)
    real = lambda found: assumptions(replace_results(results, findings=found))[0]  # noqa: E731
    assert real([]).state == "holds"
    assert real([complex_idle._not_tried(ValueError("lines differ"))]).state == "holds", "this says nothing of the modes"
    stated = real([Finding("complex_modes", message, "info")])
    assert stated.state == "doubtful"
    assert message in stated.text


def test_columns_that_hold_nothing_are_left_out(whole, html):
    """Real shapes have a phase collinearity of 1 by construction, and residues to one force have one shape whatever they are."""
    idle, operating = html.index('id="idle"'), html.index('id="operating"')
    assert '<th scope="col" class="n">Phase collinearity' not in html[idle:operating]
    assert "The fit makes them real" in html[idle:operating]
    assert '<th scope="col" class="n">Phase collinearity' in html[operating:]
    pole = SimpleNamespace(evidence=9.0, rank_share=1.0, collinearity=0.99, quadrature=0.01, drift=0.0, doubts=())
    linear = SimpleNamespace(
        evidence=[pole], frequencies_hz=[20.0], frequency_std_hz=[0.1], damping_ratios=[0.01], damping_ratio_std=[0.001]
    )
    details = SimpleNamespace(linear=linear, answer="")
    for references in (1, 2):
        frf = whole.idle_frf.select(references=whole.idle_frf.references[:references])
        text = render_report(only(whole, idle=replace(whole.idle, details=details), idle_frf=frf))
        assert "Evidence of each pole" in text
        assert ("One shape [%]" in text) == (references == 2)


def test_level_dependence_is_told_and_excuses_reciprocity(whole):
    finding = Finding("nonlinear", "runs differ by 39 % of |H|", "warning")
    runs = [r for r in whole.check if r.level == "b"]
    check = [runs[0], replace_check(runs[1], 1.4)]
    told = Finding("not_reciprocal", "H and its reverse differ by 30 %", "warning")
    check[0] = CheckRun(check[0].name, "b", replace(check[0].frf, findings=(told,)))
    rows = [
        {"name": "x", "level_name": lv, "models": {"ofrf": {"error_db": a}, "idle": {"error_db": b}}}
        for lv, a, b in (("b", 5.4, 0.9), ("a", 1.5, 4.3))
    ]
    results = replace_results(whole, findings=[finding], check=check, comparison=whole.comparison | {"by_run": rows})
    states = {a.name: a.state for a in assumptions(results)}
    assert states["Linear behaviour"] == "fails"
    assert states["Reciprocity in operation"] == "doubtful"
    assert "at b the operational FRFs are off by 5.40 dB and the idle model by 0.90 dB" in " ".join(headline(results).sentences)


def test_periods_of_the_force_say_whether_the_structure_is_linear(whole):
    results = only(whole, idle=whole.idle, idle_frf=whole.idle_frf)
    linear = lambda found: next(a for a in assumptions(replace_results(results, findings=found)) if a.name == "Linear behaviour")  # noqa: E731
    periodic = Finding("periodic_excitation", "the force at 1+Z repeats", "info")
    assert linear([]).state == "untested"
    assert linear([periodic]).state == "holds"
    strong = Finding("nonlinear_distortion", "nonlinear distortion repeats in each period: 31 dB below the response", "warning")
    assert linear([periodic, strong]).state == "doubtful"
    assert "31 dB below" in linear([periodic, strong]).text
    assert linear([periodic, replace(strong, severity="info")]).state == "holds"
    assert "Linear behaviour" in render_report(replace_results(results, findings=[periodic, strong]))


def test_what_was_not_tested_is_named_for_what_it_is(whole):
    idle = replace(whole.idle, misfit=None, details=SimpleNamespace(fit_misfit=2.43))
    states = {a.name: a.text for a in assumptions(replace_results(whole, idle=idle, hybrid=None, operating=None, comparison=None))}
    assert "on the fitted lines it is 2.43" in states["The idle model has the dominant modes"]
    mass = states["Same mass, idle and operating"]
    assert "a validation measurement would" not in mass
    assert "there are none with a scale to compare" in mass


def test_title_block_says_what_was_measured_by_whom(whole):
    block = {"object": "Pump <7>", "date": "2026-05-04", "operator": "A. Smith"}
    text = render_report(replace_results(whole, settings=whole.settings | {"report": block}, hybrid=None, check=[], comparison=None))
    Page(text)
    top = text[text.index("<header>") : text.index("</header>")]
    assert "<dt>Object</dt><dd>Pump &lt;7&gt;</dd>" in top
    assert "2026-05-04" in top
    assert "<dl" not in render_report(Results("nothing"))


def only(results, **parts):
    """Results of one state."""
    none = {"idle": None, "operating": None, "idle_frf": None, "hybrid": None, "check": [], "comparison": None, "left_out": {}}
    return replace_results(results, **(none | parts))


def test_a_hammer_test_has_its_own_answer_without_empty_columns(whole):
    results = only(whole, idle=whole.idle, idle_frf=whole.idle_frf, left_out={"oma": "no [operating] in the test"})
    text = render_report(results)
    page = Page(text)
    head = headline(results)
    assert head.verdict == "12 idle modes in 8–140 Hz"
    assert any("18 samples at full scale" in t for t in head.limits), "what is wrong with the data limits the answer"
    assert head.grade == "fair"
    assert headline(replace_results(results, findings=[])).grade == "good"
    beside = replace_results(results, idle=replace(whole.idle, in_band=np.arange(whole.idle.n_modes) > 0))
    assert headline(beside).verdict == "11 idle modes in 8–140 Hz"
    assert f"Frequencies from {whole.idle.frequencies_hz[1]:.4g} " in headline(beside).sentences[0]
    assert "no [operating] in the test" in head.sentences[-1]
    assert {f"#{name}" for name in ("operating", "scaling", "ofrf", "diagnosis", "missing")}.isdisjoint(page.targets)
    answer = text[text.index('id="answer"') : text.index('id="data"')]
    assert "Oper" not in "".join(re.findall("<th.*?</th>", answer))
    assert '<td class="n">–</td>' not in answer
    assert "not tested" not in answer


def test_files_that_cannot_be_read_are_named_once(whole):
    unread = [Finding("unreadable", "cannot be read: no time column", "error", f, consequence="not used") for f in ("a.csv", "b.csv")]
    results = replace_results(only(whole, operating=whole.operating), findings=unread)
    assert headline(results).limits == ("a.csv, b.csv: cannot be read: no time column: not used.",)


def test_an_output_only_test_has_its_own_answer(whole):
    results = only(whole, operating=whole.operating, left_out={"ema": "no [idle] in the test"})
    text = render_report(results)
    Page(text)
    assert headline(results).verdict == "12 operational modes in 8–140 Hz"
    assert ": modes</title>" in text
    assert "Operational frequency response functions · test report" not in text
    assert "arbitrary scale" in " ".join(headline(results).sentences)
    assert 'href="#idle"' not in text
    assert "Idle" not in "".join(re.findall("<th .*?</th>", text))
    failed = only(whole, operating=whole.operating, left_out={"ema": "failed: too few lines"})
    assert headline(failed).verdict == "No operational FRFs"


def test_without_operating_records_the_idle_model_is_held_against_the_validation_measurement(whole):
    alone = {**whole.comparison, "models": {"idle": whole.comparison["models"]["idle"]}}
    why = {"ofrf": "the test has no [operating] records"}
    results = replace_results(whole, operating=None, hybrid=None, diagnosis=None, comparison=alone, left_out=why)
    error = results.comparison["models"]["idle"]["error_db"]
    assert headline(results).verdict == f"The idle model is off by {decibel(error)} from the validation measurement"
    text = render_report(results)
    Page(text)
    for part in ("Models against the validation measurement", "Level error by response DOF", "Errors by mode", "covariance of the EMA"):
        assert part in text
    assert "Operational FRFs at drive points" not in text
    assert ": idle model against the validation measurement</title>" in text
    for part in ("How good the operational", "Operational frequency response functions ·", "operating (right", 'id="scaling"'):
        assert part not in text
    answer = text[text.index('id="answer"') : text.index('id="data"')]
    assert "Oper." not in answer
    assert "Operating frequency" not in answer
    assert "Validation frequency [Hz]" in answer


def test_idle_modes_stand_beside_the_peaks_of_the_validation_measurement(whole):
    hz = whole.idle.frequencies_hz
    near = {
        "frequency_hz": 1.02 * hz[3],
        "frequency_error_percent": 100 * (1 / 1.02 - 1),
        "damping_ratio": 0.011,
        "damping_ratio_std": 2e-4,
    }
    by_mode = [near, {"frequency_hz": 1.1 * hz[4], "frequency_error_percent": None, "damping_ratio": 0.01}]
    only_idle = {**whole.comparison, "models": {"idle": whole.comparison["models"]["idle"] | {"by_mode": by_mode}}}
    found = idle_peaks(replace_results(whole, operating=None, hybrid=None, comparison=only_idle))
    assert [p.idle for p in found if p.frequency_hz is not None] == [3, None]
    peak = next(p for p in found if p.idle == 3)
    assert (peak.percent, peak.damping_ratio, peak.damping_ratio_std) == (pytest.approx(2.0), 0.011, 2e-4)
    assert sum(p.idle is not None for p in found) == N
    assert idle_peaks(replace_results(whole, comparison=None)) == []


def test_figures_and_texts_of_the_user_stand_in_sections_of_their_own(tmp_path):
    from matplotlib.figure import Figure

    from operando import Report
    from operando.errors import DataError

    figure = Figure(figsize=(4, 3))
    axes = figure.subplots()
    axes.plot([600.0, 900.0], [0.1, 0.4], label="level")
    axes.set_title("<script>1</script>")
    report = Report(Results("pump")).add_text("Measured at 40 °C & <dry>.", section="Run-up")
    report.add_figure(figure, "Level <over> speed.", section="Run-up").add_figure(axes, "Again.", section="Second")
    report.save(tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert page.counts["figure"] == 2
    assert re.findall(r"<b>Figure (\d+)\.</b>", text) == ["1", "2"]
    assert "Level &lt;over&gt; speed." in text
    assert "40 °C &amp; &lt;dry&gt;" in text
    assert text.count("<script") == 1
    assert "Run-up</h2>" in text
    assert report.html() == text, "the same whenever it is made"
    with pytest.raises(DataError, match="no figure"):
        report.add_figure([1, 2, 3])

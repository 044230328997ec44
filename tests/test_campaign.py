"""The campaign file, its parameters, modes followed through states, what changes and what stands out."""

from __future__ import annotations

import re

import numpy as np
import pytest

from operando.campaign import load_campaign
from operando.campaign.changes import outliers, size_change, steps, stretches
from operando.campaign.document import document_of
from operando.campaign.outputs import rows_of
from operando.campaign.page import render, said_of
from operando.campaign.parameters import axis_of, read_table
from operando.campaign.tracks import crossings, follow
from operando.errors import ConfigError

# --- the campaign file


def campaign_file(tmp_path, text, **files):
    for name, body in {"test.toml": '[idle]\nrecords = ["{speed}/*.uff"]\n', **files}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(body, encoding="utf-8")
    (tmp_path / "campaign.toml").write_text(text, encoding="utf-8")
    return tmp_path / "campaign.toml"


def test_a_template_is_filled_by_rows(tmp_path):
    rows = 'rows = [{speed = "0600", analysis = {max_order = 20}}, {speed = 900, name = "fast/one"}]'
    campaign = load_campaign(campaign_file(tmp_path, f'name = "x"\ntemplate = "test.toml"\n{rows}\nunits = {{speed = "rpm"}}'))
    first, second = campaign.members
    assert (first.name, second.name) == ("speed-0600", "fast-one")
    assert first.text == '[idle]\nrecords = ["0600/*.uff"]\n'
    assert first.row.parameters == {"speed": 600.0}
    assert first.row.changes == ("analysis.max_order=20",)
    assert campaign.title(second) == "speed 900 rpm"
    assert (campaign.over, campaign.baseline, campaign.baseline_given) == ("speed", "speed-0600", False)


def test_a_table_gives_rows_units_and_entries(tmp_path):
    table = "speed [rpm];load [kN];analysis.band;name\n600;0,5;[5, 90];slow\n900;1,5;;\n"
    campaign = load_campaign(campaign_file(tmp_path, 'template = "test.toml"\ntable = "runs.csv"', **{"runs.csv": "﻿" + table}))
    assert [m.row.parameters for m in campaign.members] == [{"speed": 600.0, "load": 0.5}, {"speed": 900.0, "load": 1.5}]
    assert campaign.members[0].row.changes == ("analysis.band=[5, 90]",)
    assert campaign.units == {"speed": "rpm", "load": "kN"}
    assert [m.name for m in campaign.members] == ["slow", "speed-900_load-1-5"]


def test_globs_name_what_they_match(tmp_path):
    files = {f"runs/{day}/{speed}rpm/test.toml": "" for day in ("2024-03-01", "2024-03-02") for speed in (1000, 900)}
    text = 'tests = ["runs/{date}/{speed}rpm"]\nbaseline = {speed = 900, date = 2024-03-02}'
    campaign = load_campaign(campaign_file(tmp_path, text, **files))
    assert [(m.row.parameters["date"], m.row.parameters["speed"]) for m in campaign.members] == [
        ("2024-03-01", 900.0), ("2024-03-01", 1000.0), ("2024-03-02", 900.0), ("2024-03-02", 1000.0),
    ]  # fmt: skip
    assert (campaign.baseline, campaign.baseline_given) == ("date-2024-03-02_speed-900", True)


def test_tests_of_one_name_get_folders_of_their_own(tmp_path):
    rows = 'template = "test.toml"\nrows = [{speed = 1, name = "a"}, {speed = 2, name = "A"}, {speed = 3, name = "a-2"}]'
    names = [m.name for m in load_campaign(campaign_file(tmp_path, rows)).members]
    assert len({n.lower() for n in names}) == 3


ROWS = 'template = "test.toml"\nrows = [{speed = 1}, {speed = 2}]\n'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (ROWS + "basline = 3", "did you mean 'baseline'"),
        (ROWS + '[workers]\nprocesess = 2', "did you mean 'processes'"),
        (ROWS + "[workers]\nprocesses = 0", "a whole number of at least 1"),
        (ROWS + '[workers]\ncluster = "slrum"', "did you mean 'slurm'"),
        (ROWS + 'over = "sped"', "did you mean 'speed'"),
        (ROWS + 'baseline = "speed-3"', "did you mean 'speed-"),
        (ROWS + "baseline = {speed = 3}", "no test has speed 3"),
        (ROWS + 'until = "emma"', "did you mean 'ema'"),
        (ROWS + 'units = {sped = "rpm"}', "did you mean 'speed'"),
        ('template = "test.toml"\nrows = [{sped = 1}]', "no column fills {speed}"),
        ('template = "test.toml"', "a template needs rows"),
        ('template = "plain.toml"\nrows = [{speed = 1}, {speed = 2}]', "every row would be the same test"),
        ("rows = [{speed = 1}]", "the rows name no test"),
        ('template = "test.toml"\nrows = [{speed = 1}, {speed = 2}, {speed = 1}]', "tests 1 and 3 are the same"),
        ('tests = ["nothing/*.toml"]', "no test file matches"),
        ('name = "x"', "names no test"),
        ('template = "test.toml"\nrows = [{speed = [1]}]', "expected a number, a text or a date"),
        ("template = \"test.toml\"\nrows = [{speed = 'a\"b'}]", "quotes cannot stand"),
        ('[idle]\nrecords = ["x.uff"]', "is a test file, expected a campaign file"),
        ("name = ", "not valid TOML"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named_with_the_nearest_right_one(tmp_path, text, said):
    with pytest.raises(ConfigError) as error:
        load_campaign(campaign_file(tmp_path, text, **{"plain.toml": '[idle]\nrecords = ["a.uff"]\n'}))
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("table", "said"),
    [("speed\n", "holds no rows"), ("speed,speed\n1,2\n", "the name 'speed' again"), ("a,b\n1\n", "has 1 cells, expected 2")],
)
def test_a_table_that_is_none(tmp_path, table, said):
    (tmp_path / "t.csv").write_text(table)
    with pytest.raises(ConfigError, match=re.escape(said)):
        read_table(tmp_path / "t.csv")


def test_places_are_numbers_days_or_the_order():
    assert axis_of("v", [{"v": 3.0}, {"v": 1.0}], {"v": "m/s"}).places == (3.0, 1.0)
    assert axis_of("v", [{"v": 3.0}, {"v": 1.0}], {"v": "m/s"}).label == "v [m/s]"
    days = axis_of("d", [{"d": "2024-03-02T12:00"}, {"d": "2024-03-01"}], {})
    assert (days.kind, days.places) == ("date", (1.5, 0.0))
    assert axis_of("v", [{"v": 3.0}, {"v": "fast"}], {}).kind == "order"
    assert axis_of(None, [{}, {}], {}).places == (0.0, 1.0)


# --- modes through the states


def mode(number, hz, shape, std=0.001, ratio=0.01):
    return {
        "mode": number, "frequency_hz": hz, "frequency_std_hz": std, "damping_ratio": ratio, "damping_ratio_std": 1e-4, "shape": shape,
    }  # fmt: skip


def shapes(count=3, dofs=6, seed=0, noise=0.05):
    """Orthogonal shapes with noise, by DOF."""
    rng = np.random.default_rng(seed)
    base = np.linalg.qr(rng.normal(size=(dofs, count)))[0]
    return lambda k: dict(zip((f"{i + 1}+Z" for i in range(dofs)), base[:, k] + noise * rng.normal(size=dofs) / np.sqrt(dofs), strict=True))


def test_modes_that_cross_are_followed_by_their_shapes():
    shape, rng = shapes(), np.random.default_rng(1)
    states = []
    for i in range(11):
        hz = [10 + 0.2 * i, 12 - 0.2 * i, 30.0]  # the first two cross half way between states 5 … exactly at state 5
        modes = [mode(0, hz[k] + 0.013, shape(k)) for k in range(3)] if i != 4 else [mode(0, hz[k], shape(k)) for k in (0, 2)]
        order = rng.permutation(len(modes))
        states.append([{**modes[k], "mode": j} for j, k in enumerate(order)])
    tracks = follow(states, states, baseline=0)
    assert [len(t.points) for t in tracks] == [11, 10, 11]
    assert tracks[0].points[-1].frequency_hz == pytest.approx(12.013)
    assert tracks[1].points[-1].frequency_hz == pytest.approx(10.013)
    assert min(p.mac_baseline for t in tracks for p in t.points) > 0.95
    found = crossings(tracks, [100.0 * i for i in range(11)])
    assert [(c.first, c.second) for c in found] == [(0, 1)]
    assert found[0].place == pytest.approx(500, abs=20)
    assert found[0].frequency_hz == pytest.approx(11, abs=0.1)


def test_of_like_shapes_the_nearer_in_frequency_goes_on():
    one = {"1+Z": 1.0, "2+Z": 0.2}
    states = [[mode(0, 10.0, one), mode(1, 12.0, one)], [mode(0, 12.1, one), mode(1, 10.1, one)]]
    tracks = follow(states, states, 0)
    assert [[p.mode for p in t.points] for t in tracks] == [[0, 1], [1, 0]]


def test_a_dof_and_its_opposite_are_one_and_shared_dofs_decide():
    first = {"1+Z": 1.0, "2+Z": -0.5, "3+Z": 0.7}
    turned = {"1-Z": [-1.0, 0.0], "2+Z": [-0.5, 0.0], "9+Z": [5.0, 0.0]}
    tracks = follow([[mode(0, 10.0, first)], [mode(0, 10.1, turned)]], [[mode(0, 10.0, first)], [mode(0, 10.1, turned)]], 0)
    assert len(tracks) == 1
    assert tracks[0].points[1].mac_baseline == pytest.approx(1.0)


def test_another_shape_begins_another_track():
    shape = shapes(noise=0.0)
    states = [[mode(0, 10.0, shape(0))], [mode(0, 10.0, shape(1))], [mode(0, 10.0, shape(0))], [mode(0, 15.0, shape(0))]]
    assert [[p.state for p in t.points] for t in follow(states, states, 0)] == [[0, 2], [1], [3]]


def test_crossings_within_the_intervals_are_none():
    shape = shapes(noise=0.0)
    states = [[mode(0, 10 + 0.001 * i, shape(0), std=0.1), mode(1, 10.005 - 0.001 * i, shape(1), std=0.1)] for i in range(10)]
    assert not crossings(follow(states, states, 0), range(10))


# --- effects, steps, values that stand out


def spring(value, std=10.0, at="7+Z"):
    return {"kind": "ground_spring", "location": [at], "parameters": {"stiffness": {"value": value, "unit": "N/m", "std": std}}}


def diagnosis(*effects, verdict="explained", ambiguous=()):
    return {"verdict": verdict, "effects": list(effects), "ambiguous_with": list(ambiguous)}


def told_of(diagnoses, baseline=0):
    return [(s.what, s.states, s.open) for s in stretches(diagnoses, baseline)]


def test_an_effect_that_appears_and_stays():
    clean, held = diagnosis(verdict="no_misfit"), diagnosis(spring(12e3))
    unsure = diagnosis(verdict="inconclusive")
    assert told_of([clean, clean, held, None, held, unsure]) == [("appears", (2, 4), True)]
    assert told_of([clean, held, clean]) == [("appears", (1,), False)]
    other = diagnosis(spring(1e3, at="8+Z"), ambiguous=[spring(12e3)])
    assert told_of([clean, held, other])[0] == ("appears", (1, 2), True)


def test_what_the_baseline_has_too_is_no_change():
    held, clean = diagnosis(spring(12e3)), diagnosis(verdict="no_misfit")
    assert told_of([held, held, held]) == [("everywhere", (0, 1, 2), True)]
    assert told_of([held, clean, clean]) == [("is gone", (1, 2), True), ("everywhere", (0,), False)]
    assert told_of([clean, held] * 5) == [("scattered", (1, 3, 5, 7, 9), True)]


def test_sizes_of_first_and_last_where_they_differ():
    assert size_change(spring(12e3), spring(12.005e3)).count("±") == 1
    assert "at first" in size_change(spring(12e3), spring(13e3))


def test_a_spike_stands_out_and_changes_do_not():
    """The threshold changes.BEYOND: five scatters from the running median of five."""
    rng = np.random.default_rng(3)
    noise = 0.01 * rng.normal(size=40)
    trend = 10 + 0.05 * np.arange(40) + noise
    spike = trend.copy()
    spike[17] += 0.3
    jump = 10 + noise + 0.5 * (np.arange(40) >= 23)
    std = [0.01] * 40
    assert outliers(trend, std) == []
    assert outliers(jump, std) == []
    assert outliers(spike, std) == [17]
    assert outliers(spike[:6], std[:6]) == []
    assert steps(jump, std, range(40)) == [(22, 23)]
    assert steps(trend, std, range(40)) == []
    assert steps(spike, std, range(40), without=[17]) == []
    curve = 10 + 0.02 * np.linspace(0, 6, 40) ** 2  # speeds far apart at the end change more
    assert outliers(curve, std) == []


def test_false_alarms_are_rare():
    """The threshold changes.BEYOND: 20 000 values of normal scatter give less than one alarm in a hundred series of 30."""
    rng = np.random.default_rng(5)
    series = rng.normal(size=(700, 30))
    found = sum(len(outliers(100 + row, [1.0] * 30)) + len(steps(100 + row, [1.0] * 30, range(30))) for row in series)
    assert found <= 7


# --- everything together


def test_thirty_states_of_which_the_last_eight_hold_a_spring(tmp_path):
    """Records as tests leave them: a crossing near 1433 rpm, a spring from test 23 on, a spike, a mode not seen, a test that failed."""
    rows = ", ".join(f"{{speed = {100 * i}}}" for i in range(1, 31))
    file = campaign_file(tmp_path, f'name = "rotor"\ntemplate = "test.toml"\nunits = {{speed = "rpm"}}\nrows = [{rows}]')
    campaign, shape, rng, records = load_campaign(file), shapes(4, 8, noise=0.1), np.random.default_rng(2), {}
    for i, member in enumerate(campaign.members):
        hz = [10 + 0.1 * i, 12 - 0.05 * i, 20 + 0.3 * (i >= 22), 31 + 2.0 * (i == 12)]
        modes = [mode(k, hz[k] + 0.01 * rng.normal(), shape(k), std=0.01) for k in range(3 if i == 5 else 4)]
        found = diagnosis(spring(12e3)) if i >= 22 else diagnosis(verdict="no_misfit")
        records[member.name] = {"state": "done", "operating": modes, "diagnosis": found, "seconds": 1.0}
    records["speed-1800"] = {"state": "failed", "reason": "no such file"}
    counts = {"run": 30, "unchanged": 0, "seconds": 1.0, "work_seconds": 1.0}
    document = document_of(campaign, lambda members: (records[m.name] for m in members), counts)
    said = said_of(document)
    assert said[0].startswith("From test 23 (speed 2300 rpm) on: ground spring at 7+Z, 12.00 ± 0.02 kN/m, is missing in the idle model")
    assert said[1].startswith("Operational mode 2 goes from ")
    assert "from test 22 (speed 2200 rpm) to test 23 (speed 2300 rpm)" in said[1]
    assert re.search(r"modes 0 and 1 cross near speed 14[1-5]\d(\.\d)? rpm, at 11\.3", said[2])
    odd = {t["number"]: t["stands_out"] for t in document["tests"] if t["stands_out"]}
    assert list(odd) == [6, 13]
    assert (len(odd[6]), len(odd[13])) == (1, 1)
    assert [t["seen"] for t in document["operating"]["tracks"]] == [29, 29, 29, 28]
    assert document["counts"]["failed"] == 1
    page = render(document)
    assert "no such file" in page
    assert page.count("<figure>") == 3


# --- the page


def small_document(hostile="<script>alert(1)</script>"):
    point = {"test": "a", "place": 1.0, "mode": 0, "frequency_hz": 10.0, "frequency_std_hz": 0.1, "damping_ratio": 0.01}
    point |= {"damping_ratio_std": None, "mac_before": None, "mac_baseline": 1.0, "change_percent": 0.0, "changed": False}
    row = {"number": 1, "name": "a", "title": hostile, "place": 1.0, "parameters": {"speed": hostile}, "test": "x", "state": "done"}
    row |= {"reason": hostile, "left_out": {}, "results": 'tests/a"b', "seconds": 1.0, "cpu_seconds": 1.0, "scaling": hostile, "errors": {}}
    row |= {"findings": [{"kind": hostile, "severity": "error", "message": hostile}], "stands_out": [hostile]}
    row |= {"diagnosis": {"verdict": hostile}, "missing": [hostile]}
    failed = row | {"number": 2, "name": "b", "state": "failed", "place": None, "diagnosis": None}
    effect = {"what": "appears", "label": hostile, "size": hostile, "tests": ["a"], "words": hostile}
    part = {"tracks": [{"track": 0, "seen": 1, "points": [point]}], "crossings": [{"words": hostile}], "steps": [{"words": hostile}]}
    return {
        "name": hostile, "parameters": [{"name": "speed", "unit": None}], "over": {"label": hostile, "kind": "number"},
        "until": None, "baseline": {"test": "a", "chosen": hostile},
        "counts": {"done": 1, "incomplete": 0, "failed": 1, "run": 2, "unchanged": 0, "seconds": 1.0, "work_seconds": 1.0},
        "tests": [row, failed], "idle": part, "operating": part, "effects": [effect],
    }  # fmt: skip


def test_the_page_stands_alone_and_shows_what_it_is_given():
    page = render(small_document())
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert" in page
    assert not re.search(r"(?:src|href)=[\"'](?!#|tests/)", page)
    assert "Content-Security-Policy" in page


def test_the_table_has_a_row_a_mode_and_one_for_a_test_without():
    rows = list(rows_of(small_document()))
    assert [(r["test"], r.get("of"), r["state"]) for r in rows] == [
        ("a", "idle", "done"),
        ("a", "operating", "done"),
        ("b", None, "failed"),
    ]

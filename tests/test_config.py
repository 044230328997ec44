"""The test file: what is read, what is refused, and how the refusal helps."""

from __future__ import annotations

from dataclasses import replace

import pytest

from operando import load_test
from operando.config import Analysis, Span, State, Test
from operando.errors import ConfigError

FULL = """
name = "pump"
[idle]
records = ["idle/*.uff"]
[operating]
records = ["operating/run.uff"]
[check]
frfs = ["check.uff"]
[geometry]
file = "geometry.uff"
units = "mm"
[units]
acceleration = "g"
force = "lbf"
[channels]
"ch1" = {dof = "12+Z", quantity = "acceleration", unit = "g", sensitivity = 1.0}
"13+Z" = {exclude = true, reason = "cable"}
[analysis]
band = [5, 220.0]
overlap = 0.5
hits = "all"
references = ["1Z", "2-X"]
exclude_bands = [[49.0, 51.0]]
select_hz = [11.5]
"""


@pytest.fixture
def folder(tmp_path):
    for name in ("idle/run10.uff", "idle/run2.uff", "operating/run.uff", "check.uff", "geometry.uff"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    return tmp_path


def write(folder, text):
    path = folder / "test.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_full_file(folder):
    test = load_test(write(folder, FULL))
    assert isinstance(test, Test)
    assert test.name == "pump"
    assert [p.name for p in test.idle.records] == ["run2.uff", "run10.uff"]  # natural order
    assert test.check.frfs == (folder / "check.uff",)
    assert test.geometry_file == folder / "geometry.uff"
    assert test.geometry_units == "mm"
    assert len(test.files) == 5
    settings = test.settings()
    assert settings["band"] == [5.0, 220.0]
    assert settings["references"] == ["1+Z", "2-X"]
    assert settings["threshold"] == 0.7
    assert settings["scaling"] == "auto"
    assert settings["max_order"] is None
    assert settings["channels"]["13+Z"] == {"exclude": True, "reason": "cable"}
    assert set(Analysis().to_dict()) <= set(settings)


def test_the_short_form_names_the_files_of_each_state_and_what_is_chosen(tmp_path):
    test = Test("pump", geometry_file=tmp_path / "geometry.uff", idle=State(records=(tmp_path / "a.uff", tmp_path / "b.uff")))
    assert repr(test) == "<Test: pump; idle 2 records; geometry geometry.uff>"
    test = replace(test.with_analysis(band=(5, 220)), check=State(frfs=(tmp_path / "check.uff",)), units={"force": "N"})
    assert repr(test) == "<Test: pump; idle 2 records; check 1 FRF file; geometry geometry.uff; band (5.0, 220.0); [units]>"


def test_folder_and_bom_and_name(folder):
    path = write(folder, "[operating]\nrecords = ['operating/*.uff']\n")
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    test = load_test(folder)
    assert test.name == folder.name
    assert not test.idle
    assert test.operating


@pytest.mark.parametrize(("scaling", "hint"), [("foo", None), ("eq14", "did you mean 'eq15'?")])
def test_choices_are_listed_once(folder, scaling, hint):
    with pytest.raises(ConfigError, match="expected one of auto, msf_all") as caught:
        load_test(write(folder, FULL)).with_analysis(scaling=scaling)
    assert caught.value.hint == hint


@pytest.mark.parametrize("name", Analysis().to_dict())
def test_every_setting_has_a_check(folder, name):
    with pytest.raises(ConfigError, match=r"\{\} is not allowed; expected .") as caught:
        load_test(write(folder, FULL)).with_analysis(**{name: {}})
    assert caught.value.where == f"settings, [analysis] {name}"


@pytest.mark.parametrize(
    ("old", "new", "message", "hint"),
    [
        ("overlap = 0.5", "overlapp = 0.5", "unknown key", "did you mean 'overlap'?"),
        ("[analysis]", "[anlysis]", "unknown key", "did you mean 'analysis'?"),
        ('records = ["idle/*.uff"]', 'record = ["idle/*.uff"]', "unknown key", "did you mean 'records'?"),
        ("exclude = true", "exlude = true", "unknown key", "did you mean 'exclude'?"),
        ('acceleration = "g"', 'accelaration = "g"', "unknown key", "did you mean 'acceleration'?"),
        ('acceleration = "g"', 'acceleration = "furlong"', "unknown unit", "known"),
        ('force = "lbf"', 'force = "mm"', "unit of displacement", "example"),
        ("band = [5, 220.0]", "band = [220, 5]", "low < high", None),
        ("overlap = 0.5", "overlap = 1", "below 1", None),
        ("overlap = 0.5", "threshold = 1.2", "MAC", None),
        ("overlap = 0.5", "threshold = true", "MAC", None),
        ("overlap = 0.5", 'scaling = "eq133"', "expected one of", "eq13"),
        ("overlap = 0.5", "max_order = 20.5", "whole number", None),
        ("overlap = 0.5", "block_seconds = -1", "positive", None),
        ("overlap = 0.5", "block_seconds = inf", "positive", None),
        ('hits = "all"', 'hits = "al"', "expected one of", "did you mean 'all'"),
        ('dof = "12+Z"', 'dof = "12+Q"', "no DOF label", "12+Z"),
        ("sensitivity = 1.0", "sensitivity = 0", "other than 0", None),
        ('["idle/*.uff"]', '["idel/*.uff"]', "matches no file", "relative to"),
        ('file = "geometry.uff"', 'file = "geo.uff"', "matches no file", "relative to"),
        ('frfs = ["check.uff"]', 'frfs = "nothing.uff"', "matches no file", "relative to"),
        ('records = ["operating/run.uff"]', 'frfs = ["check.uff"]', "force is unknown", "check"),
        ('name = "pump"', "name = 3", "expected a text", None),
        ('name = "pump"', 'name = "C:\\pump"', "not valid TOML", "single quotes"),
        ('records = ["idle/*.uff"]', 'records = ["idle/*.uff"]\nfrfs = ["check.uff"]', "both", "keep one"),
        ('["idle/*.uff"]', '[{file = "idle/*.uff", start = 1}]', "unknown key", "did you mean 'start_s'?"),
        ('["idle/*.uff"]', "[{start_s = 1}]", "names no file", "start_s = 10"),
        ('["idle/*.uff"]', '[{file = "idle/run2.uff", start_s = 7, stop_s = 7}]', "not before stop_s", None),
        ('["idle/*.uff"]', '[{file = "idle/run2.uff", start_s = "7 s"}]', "expected a time in s", None),
        ('["idle/*.uff"]', '[{file = "idle/run3.uff", start_s = 7}]', "matches no file", "relative to"),
        ("overlap = 0.5", 'hits_reject = ["idle/run2.uff"]', "names no hit", "FILE#NUMBER"),
        ("overlap = 0.5", 'hits_reject = ["idle/run3.uff#0"]', "no record of [idle] or [check]", "'idle/run2.uff#0'"),
        ("overlap = 0.5", 'hits_reject = ["operating/run.uff#0"]', "no record of [idle] or [check]", None),
    ],
)
def test_wrong_files_are_refused_with_help(folder, old, new, message, hint):
    assert old in FULL
    path = write(folder, FULL.replace(old, new, 1))
    with pytest.raises(ConfigError) as caught:
        load_test(path)
    error = caught.value.to_dict()
    assert message in error["error"]
    assert str(path) in error["where"]
    if hint is not None:
        assert hint in error["hint"]


def test_of_several_records_the_wrong_one_is_named(folder):
    wrong = 'records = ["idle/*.uff", {file = "idle/run2.uff", start_s = "7 s"}]'
    path = write(folder, FULL.replace('records = ["idle/*.uff"]', wrong, 1))
    with pytest.raises(ConfigError, match=r"\[idle\] records, entry 2: start_s is '7 s', expected a time in s"):
        load_test(path)


def test_missing_file_and_no_measurement(folder):
    with pytest.raises(ConfigError, match="no such test file"):
        load_test(folder / "none.toml")
    with pytest.raises(ConfigError, match="names no measurement"):
        load_test(write(folder, 'name = "x"'))
    (folder / "test.toml").write_bytes(b"name = '\xff'")
    with pytest.raises(ConfigError, match="UTF-8"):
        load_test(folder)


def test_settings_can_be_changed_and_are_checked(folder):
    test = load_test(write(folder, FULL))
    assert test.with_analysis(second_opinion=True, band=(1, 2)).analysis.band == (1.0, 2.0)
    assert test.analysis.second_opinion is False
    with pytest.raises(ConfigError, match="did you mean 'threshold'"):
        test.with_analysis(treshold=0.5)


def test_parts_of_records(folder):
    text = """
[idle]
records = ["idle/*.uff", {file = "idle/run10.uff", start_s = 2, stop_s = 8.5}]
[operating]
records = [{file = "operating/*.uff", start_s = 10}, {file = "operating/run.uff", stop_s = 5}, {file = "operating/run.uff", start_s = 10}]
"""
    test = load_test(write(folder, text))
    # what the table says of a file holds also where the pattern names it; two parts of a file are two runs
    assert [(p.name, s) for p, s in test.idle.runs] == [("run2.uff", None), ("run10.uff", Span(2.0, 8.5))]
    assert [s for _, s in test.operating.runs] == [Span(10.0, None), Span(None, 5.0)]
    assert [test.label(*run) for run in test.operating.runs] == [
        "operating/run.uff (10 s to the end)",
        "operating/run.uff (the beginning to 5 s)",
    ]
    assert test.label(*test.idle.runs[1]) == "idle/run10.uff"
    assert test.operating.files == (folder / "operating/run.uff",)
    assert len(test.parts) == 4
    assert test.settings()["parts_of_records"][0] == {"state": "idle", "file": "idle/run10.uff", "start_s": 2.0, "stop_s": 8.5}
    with pytest.raises(ConfigError, match="1 spans for 2 records"):
        State(records=(folder / "a", folder / "b"), spans=(None,))


def test_hits_rejected_by_hand_belong_to_their_state(folder):
    text = """
[idle]
records = ["idle/*.uff"]
[check]
records = ["operating/*.uff"]
[analysis]
hits_reject = ["./idle/run2.uff#3", "run.uff#01"]
"""
    test = load_test(write(folder, text))
    assert test.rejected_hits(test.idle) == ("idle/run2.uff#3",)
    assert test.rejected_hits(test.check) == ("operating/run.uff#1",)
    assert test.settings()["hits_reject"] == ["./idle/run2.uff#3", "run.uff#01"]
    with pytest.raises(ConfigError, match="no record of"):
        test.with_analysis(hits_reject=["idle/run77.uff#1"])


DIRECTIONS = """
[directions]
"5+a" = [0.86, 0.47, -0.15]
"5-b" = [0.0, 0.0, -1.0]
"7+X" = [-1, 0, 0]
"""


def test_directions_are_unit_vectors_of_positive_dofs(folder):
    text = FULL.replace('dof = "12+Z"', 'dof = "5+a"').replace('"13+Z"', '"5+b"') + DIRECTIONS
    test = load_test(write(folder, text))
    assert set(test.directions) == {"5+a", "5+b", "7+X"}
    assert sum(v**2 for v in test.directions["5+a"]) == pytest.approx(1)  # NOT_UNIT: two decimals are enough
    assert test.directions["5+b"] == (0, 0, 1)
    assert test.settings()["directions"]["7+X"] == [-1, 0, 0]
    assert load_test(write(folder, FULL)).directions == {}


@pytest.mark.parametrize(
    ("old", "new", "message", "hint"),
    [
        ("[0.86, 0.47, -0.15]", "[0.86, 0.47]", "three numbers", None),
        ("[0.86, 0.47, -0.15]", "[0.86, 0.47, 0.9]", "length 1.33", "divide"),
        ('"5+a"', '"5a"', "no DOF label", "lower case"),
        ('"5+a"', '"5+RX"', "rotation", None),
        ('"5-b"', '"5+a"', "", None),
        ('"7+X"', '"5+b"', "given twice", None),
        ('dof = "12+Z"', 'dof = "5+c"', "not declared", "did you mean"),
        ('dof = "12+Z"', 'dof = "31+q"', "not declared", "[directions]"),
    ],
)
def test_wrong_directions_are_refused_with_help(folder, old, new, message, hint):
    with pytest.raises(ConfigError) as caught:
        load_test(write(folder, (FULL + DIRECTIONS).replace(old, new, 1)))
    error = caught.value.to_dict()
    assert message in error["error"]
    if hint is not None:
        assert hint in error["hint"]


def test_directions_of_dofs_that_are_not_there(tmp_path):
    from measurements import write_test
    from operando.pipeline import run

    path = write_test(tmp_path, check=False, idle=False, extra='[directions]\n"3+X" = [1.0, 0.0, 0.0]')
    with pytest.raises(ConfigError, match="'3\\+X' is a DOF of no file") as caught:
        run(path, tmp_path / "out", until="inspect")
    assert "did you mean '3+Z'" in caught.value.hint


def test_title_block_of_the_report(folder):
    block = '[report]\nobject = "pump 7"\ndate = 2026-05-04\nsensors = ["13 × 352C33", "086C03"]\n'
    test = load_test(write(folder, FULL + block))
    assert test.report == {"object": "pump 7", "date": "2026-05-04", "sensors": "13 × 352C33, 086C03"}
    assert test.settings()["report"] == test.report
    with pytest.raises(ConfigError, match="operater") as unknown:
        load_test(write(folder, FULL + '[report]\noperater = "A"\n'))
    assert "operator" in unknown.value.hint
    with pytest.raises(ConfigError, match="7"):
        load_test(write(folder, FULL + "[report]\nobject = 7\n"))

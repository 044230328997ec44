"""Changes by hand in the test file: comments and order survive, nothing invalid is written, nothing of others is overwritten."""

from __future__ import annotations

import os

import pytest

from operando.config import load_test
from operando.errors import ConfigError
from operando.workbench.edits import AddTo, Draft, Exclude, SetValue, TakeFrom, changed_lines, edited

TEXT = """# the pump
name = "pump"
[idle]
frfs = ["idle.uff"]   # from the old analyser

[analysis]
band = [1.0, 2.0]     # Hz
select_hz = [         # seen by eye
  1.2,
  1.5,                # weak
]

[channels]
"1+Z" = {dof = "1+Z", unit = "m/s2"}  # front
"""


@pytest.fixture
def path(tmp_path):
    import operando

    operando.write_uff(tmp_path / "idle.uff", operando.Frf([[[1.0, 2.0]]], [1.0, 2.0], "1+Z", "1+Z"))
    (tmp_path / "test.toml").write_text(TEXT, encoding="utf-8")
    return tmp_path / "test.toml"


def test_comments_and_order_survive():
    made = edited(TEXT, [AddTo("select_hz", 1.7), AddTo("reject_hz", 1.9), SetValue("band", [1.0, 1.9]), Exclude("1+Z", "cable")])
    for comment in ("# the pump", "# from the old analyser", "# Hz", "# seen by eye", "# weak", "# front"):
        assert comment in made
    changes = changed_lines(TEXT, made)
    assert [c["old"] for c in changes if c["old"]] == [["band = [1.0, 2.0]     # Hz"], ['"1+Z" = {dof = "1+Z", unit = "m/s2"}  # front']]
    assert ["  1.7,"] in [c["new"] for c in changes]
    assert '"1+Z" = {dof = "1+Z", unit = "m/s2", exclude = true, reason = "cable"}  # front' in made


@pytest.mark.parametrize(
    ("edit", "back"),
    [
        (AddTo("reject_hz", 1.9), TakeFrom("reject_hz", 1.9)),
        (SetValue("exclude_bands", [[1.1, 1.2]]), SetValue("exclude_bands", None)),
        (Exclude("1+Z", "cable"), Exclude("1+Z", None)),
        (Exclude("2+Z", "cable"), Exclude("2+Z", None)),
        (AddTo("select_hz", 1.8), TakeFrom("select_hz", 1.8)),
    ],
)
def test_a_change_taken_back_leaves_the_file_as_it_was(edit, back):
    assert edited(TEXT, [edit]) != TEXT
    assert edited(TEXT, [edit, back]) == TEXT


@pytest.mark.parametrize("text", ['name = "a"\nidle.frfs = ["x"]\n', 'name = "a"\r\n[idle]\r\nfrfs = ["x"]\r\n'])
def test_files_of_other_habits(text):
    made = edited(text, [AddTo("select_hz", 3.0), Exclude("1+Z", "cable")])
    assert made.startswith(text)
    assert ("\r\n" in text) == ("\r\n" in made)
    assert made.count("\n") == made.count("\r\n") or "\r\n" not in text


def test_nothing_to_take_back_changes_nothing():
    assert edited(TEXT, [TakeFrom("select_hz", 9.0), TakeFrom("oma_select_hz", 9.0), Exclude("7+Z", None)]).split() == TEXT.split()


def test_a_draft_is_written_whole_and_valid(path):
    os.chmod(path, 0o640)
    draft = Draft(path)
    draft.add(AddTo("select_hz", 1.7))
    assert path.read_text() == TEXT
    draft.save()
    assert load_test(path).analysis.select_hz == (1.2, 1.5, 1.7)
    assert draft.edits == [] and draft.lines() == [] and draft.test.analysis.select_hz == (1.2, 1.5, 1.7)  # noqa: PT018
    assert path.stat().st_mode & 0o777 == 0o640
    assert sorted(p.name for p in path.parent.iterdir()) == ["idle.uff", "test.toml"]


def test_what_is_invalid_is_refused_at_once(path):
    draft = Draft(path)
    with pytest.raises(ConfigError, match="0 <= low < high"):
        draft.add(SetValue("band", [5.0, 2.0]))
    assert draft.edits == []
    assert path.read_text() == TEXT


def test_undo_goes_back_one_step(path):
    draft = Draft(path)
    draft.add(AddTo("select_hz", 1.7))
    draft.add(AddTo("select_hz", 1.8))
    draft.undo()
    assert draft.table["analysis"]["select_hz"] == [1.2, 1.5, 1.7]
    draft.undo()
    draft.undo()
    assert draft.lines() == []


def test_a_file_changed_meanwhile_is_not_overwritten(path):
    draft = Draft(path)
    draft.add(AddTo("select_hz", 1.7))
    path.write_text(TEXT.replace("1.5, ", "1.6, "), encoding="utf-8")
    with pytest.raises(ConfigError, match="changed meanwhile"):
        draft.save()
    assert load_test(path).analysis.select_hz == (1.2, 1.6)
    assert draft.read_again() == []
    draft.save()
    assert load_test(path).analysis.select_hz == (1.2, 1.6, 1.7)


def test_reading_again_names_what_does_not_fit_any_more(path):
    draft = Draft(path)
    draft.add(SetValue("threshold", 0.5))
    path.write_text('name = "a"\nidle = {frfs = ["idle.uff"]}\nanalysis = {threshold = 0.6}\n', encoding="utf-8")
    assert draft.read_again() == []
    path.write_text(TEXT.replace("[analysis]", "[analysis"), encoding="utf-8")
    with pytest.raises(ConfigError, match="TOML"):
        draft.read_again()
    assert draft.changed_on_disk()


def test_a_byte_order_mark_stays(path):
    path.write_bytes(b"\xef\xbb\xbf" + TEXT.encode())
    draft = Draft(path)
    draft.add(AddTo("select_hz", 1.7))
    draft.save()
    assert path.read_bytes().startswith(b"\xef\xbb\xbf# the pump")

"""``operando init``: what each file is taken for."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner

import measurements
from operando import load_test
from operando.cli import main
from operando.errors import ConfigError, MissingError
from operando.scaffold import scaffold, write_test


@pytest.fixture
def folder(tmp_path):
    place = tmp_path / "pump"
    measurements.write_test(place, check=True)
    (place / "test.toml").unlink()
    return place


def roles(made, folder):
    return {t.file.relative_to(folder).as_posix(): t.role for t in made.taken}


def test_folders_name_the_states(folder):
    (folder / "notes.md").write_text("x")
    made = scaffold(folder)
    assert roles(made, folder) == {
        "check/run1a.uff": "check records",
        "check/run1b.uff": "check records",
        "geometry.uff": "geometry",
        "idle/run1.uff": "idle records",
        "idle/run2.uff": "idle records",
        "notes.md": "ignored",
        "operating/run1.uff": "operating records",
    }
    assert all(t.sure for t in made.taken)
    write_test(made, folder / "test.toml")
    test = load_test(folder)
    assert test.name == "pump"
    assert 'records = ["idle/*.uff"]' in made.text
    assert (len(test.idle.records), len(test.operating.records), len(test.check.records)) == (2, 1, 2)
    assert test.geometry_file is not None
    with pytest.raises(ConfigError, match="exists already"):
        write_test(made, folder / "test.toml")


def test_without_names_forces_decide_and_doubts_are_said(folder, tmp_path):
    flat = tmp_path / "flat"
    flat.mkdir()
    for i, name in enumerate(("idle/run1.uff", "operating/run1.uff")):
        (flat / f"m{i}.uff").write_bytes((folder / name).read_bytes())
    (flat / "broken.uff").write_bytes(b"\x00\x01\x02nothing")
    made = scaffold(flat)
    assert roles(made, flat) == {"broken.uff": "ignored", "m0.uff": "idle records", "m1.uff": "operating records"}
    assert any("unsure: m0.uff" in note for note in made.notes)
    assert any("broken.uff" in note for note in made.notes)
    assert any("no check measurement" in note for note in made.notes)
    # the test file may lie elsewhere
    target = tmp_path / "elsewhere/test.toml"
    made = scaffold(flat, target)
    write_test(made, target)
    assert load_test(target).idle.records[0].resolve() == (flat / "m0.uff").resolve()


def test_force_in_operation_is_a_check_in_doubt(folder):
    (folder / "operating/driven.uff").write_bytes((folder / "check/run1a.uff").read_bytes())
    made = scaffold(folder)
    doubt = next(t for t in made.taken if t.file.name == "driven.uff")
    assert (doubt.role, doubt.sure) == ("check records", False)
    assert '"operating/run1.uff"' in made.text  # no glob that would take the driven run too


def test_units_and_labels_that_lack_are_asked_for(tmp_path):
    rows = "\n".join(f"{i / 100},{(i * 7) % 5},{(i * 3) % 4}" for i in range(200))
    (tmp_path / "idle.csv").write_text(f"time [s],left,right\n{rows}\n")
    made = scaffold(tmp_path)
    assert any("DOF or quantity" in note for note in made.notes)
    assert '# "left"' in made.text


def test_nothing_to_test(tmp_path):
    with pytest.raises(MissingError, match="no measurement"):
        scaffold(tmp_path)
    with pytest.raises(MissingError, match="no such folder"):
        scaffold(tmp_path / "none")


def test_command(folder):
    done = CliRunner().invoke(main, ["init", str(folder), "--json"])
    assert done.exit_code == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["schema"] == "operando/init/1"
    assert len(document["taken"]) == 6
    assert (folder / "test.toml").read_text() == document["text"]
    done = CliRunner().invoke(main, ["init", str(folder)])
    assert done.exit_code == 1
    done = CliRunner().invoke(main, ["init", str(folder), "--force"])
    assert done.exit_code == 0
    assert "idle/run1.uff" in done.stdout

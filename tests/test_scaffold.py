"""``operando init``: what each file is taken for."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

import measurements
import operando
from operando import load_test, run
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
    assert any("no validation measurement" in note for note in made.notes)
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


def test_every_file_is_listed_with_its_reason(folder):
    (folder / "notes.md").write_text("x")
    (folder / ".hidden").write_text("x")
    (folder / "old").mkdir()
    (folder / "old/summary.json").write_text("{}")
    (folder / "old/idle_frf.uff").write_text("x")
    (folder / "test.toml").write_text("")
    made = scaffold(folder)
    reasons = {t.file.relative_to(folder).as_posix(): t.reason for t in made.taken if t.role == "ignored"}
    assert reasons == {
        ".hidden": "a hidden file",
        "notes.md": "not read: .md files hold no measurement",
        "old": "a results folder",
        "test.toml": "a test file or settings, no measurement",
    }


def test_a_silent_force_channel_is_no_force(folder, tmp_path):
    """A hammer that lies beside the running machine is recorded, too."""
    from dataclasses import replace

    import numpy as np

    from operando.io import read, write_uff

    record = read(folder / "idle/run1.uff").records[0]
    (row,) = record.force_indices
    flat = tmp_path / "flat"
    flat.mkdir()
    quiet = np.array(record.data)
    quiet[row] *= 1e-3
    write_uff(flat / "a.uff", record)
    write_uff(flat / "b.uff", replace(record, data=quiet))
    made = scaffold(flat)
    assert roles(made, flat) == {"a.uff": "idle records", "b.uff": "operating records"}
    assert "silent" in made.taken[1].reason


def test_a_band_is_proposed_from_the_forces(tmp_path):
    """A force with power between 20 and 60 Hz only."""
    import numpy as np
    from scipy.signal import butter, sosfilt

    from operando.data import Channel, TimeRecord
    from operando.dof import Dof
    from operando.io import write_uff

    force = sosfilt(butter(8, (20, 60), "bandpass", fs=512, output="sos"), np.random.default_rng(0).normal(size=1 << 14))
    channels = (Channel(Dof(1, "Z"), "force", "N"), Channel(Dof(1, "Z"), "acceleration", "m/s2"))
    write_uff(tmp_path / "idle.uff", TimeRecord(np.stack([force, np.roll(force, 1)]), 512.0, channels))
    made = scaffold(tmp_path)
    low, high = json.loads(next(line for line in made.text.splitlines() if line.startswith("# band")).split("=")[1].split("#")[0])
    assert 12 < low < 21  # where the force has lost 17 dB, a fiftieth of its power
    assert 59 < high < 75
    write_test(made, tmp_path / "test.toml")
    assert load_test(tmp_path).analysis.band is None  # a proposal, not a setting


def test_columns_of_bare_tables_are_proposed(tmp_path):
    import numpy as np

    f = np.arange(1, 100) * 0.5
    h = 1 / (40**2 - f**2 + 2j * f)
    for i in range(2):
        np.savetxt(tmp_path / f"h{i}.txt", np.column_stack([f, 20 * np.log10(np.abs(h)), np.degrees(np.angle(h))]))
    np.savetxt(tmp_path / "other.txt", np.column_stack([f, np.abs(h), np.angle(h)]))
    made = scaffold(tmp_path)
    assert roles(made, tmp_path) == {"h0.txt": "idle frfs", "h1.txt": "idle frfs", "other.txt": "ignored"}
    assert 'columns = ["Hz", "dB", "deg"]' in made.text
    write_test(made, tmp_path / "test.toml")
    assert load_test(tmp_path).units["columns"] == ["Hz", "dB", "deg"]
    assert any("guessed: columns" in note for note in made.notes)


def test_names_cannot_write_into_the_test_file(tmp_path):
    """Line ends, quotes and escapes in names stay names."""
    import tomllib

    from operando.scaffold.text import can_be_named, quoted

    for name in ('a"b', "a\\b", "a\n[analysis]\nband = [1, 2]", "a\x1b\x7f\u202e\U000e0001", "µ é ''' #"):
        assert tomllib.loads(f"{quoted(name)} = {quoted(name)}") == {name: name}
    assert not can_be_named(tmp_path / "a\udcff.uff")
    place = tmp_path / "evil\n[analysis]\nband = [1, 2]\n#"
    place.mkdir()
    rows = "\n".join(f"{i / 100},{i % 3},{i % 5}" for i in range(50))
    (place / "run\n[x]\ny=1.csv").write_text(f"time [s],1+Z [g],F [N]\n{rows}\n")
    made = scaffold(place)
    table = tomllib.loads(made.text)
    assert "x" not in table
    assert "band" not in table["analysis"]


def test_arrays_without_frequencies_are_taken_and_the_step_is_asked_for(tmp_path):
    lines = np.arange(401) * 0.25
    h = np.stack([(lines / 30) ** 2 / (1 - (lines / f) ** 2 + 0.02j * lines / f) for f in (21.0, 50.0)], axis=1)
    np.savez(tmp_path / "frf.npz", data=h)
    (tmp_path / "LICENSE").write_text("Copyright")
    (tmp_path / "Citation.txt").write_text("A. Author, a paper")
    made = scaffold(tmp_path)
    assert {t.file.name: t.role for t in made.taken} == {"frf.npz": "idle frfs", "LICENSE": "ignored", "Citation.txt": "ignored"}
    assert all(t.sure for t in made.taken if t.role == "ignored")
    assert any("2 FRFs of 401 lines without frequencies" in t.reason for t in made.taken)
    assert any("give [units] frequency_step_hz" in note for note in made.notes)
    write_test(made, tmp_path / "test.toml")
    results = run(tmp_path, tmp_path / "results", until="frf", report=False)
    assert "line 12, [idle] frfs" in results.findings[0].file
    assert results.findings[0].action.startswith("give [units] frequency_step_hz")

    asked = {"# frequency_step_hz": "frequency_step_hz", "# acceleration": "acceleration", "# force": "force", '# "': '"'}
    text = (tmp_path / "test.toml").read_text()
    for commented, taken in asked.items():
        text = text.replace(commented, taken)
    (tmp_path / "test.toml").write_text(text)
    frf = run(tmp_path, tmp_path / "results", until="frf", report=False).idle_frf
    np.testing.assert_array_equal(frf.frequencies_hz, lines)
    assert ([str(d) for d in frf.responses], [str(d) for d in frf.references], frf.si) == (["1+Z", "2+Z"], ["1+Z"], True)
    with pytest.raises(ConfigError, match="frequency_step_hz"):
        load_test(tmp_path, changes=["units.frequency_step_hz=-1"])


def test_files_of_the_same_frfs_are_said_to_be_several_states(tmp_path):
    for name in ("ref", "cut"):
        operando.write_uff(tmp_path / f"{name}.uff", operando.Frf([[range(1, 99)]], range(5, 103), "1+Z", "1+Z"))
    (tmp_path / "notes.uff").write_text("Measured in May.\nBy two of us.\n")
    notes = scaffold(tmp_path).notes
    assert any(note.startswith("cut.uff, ref.uff hold FRFs of the same DOFs") for note in notes)
    assert any(note.startswith("not used: notes.uff: cannot be read") for note in notes)
    told = CliRunner().invoke(main, ["init", str(tmp_path)]).stdout.splitlines()[-1]
    assert told.startswith("Next: move each state into a folder of its own")


def test_tables_without_a_rate_are_taken_and_the_rate_is_asked_for(tmp_path):
    rng = np.random.default_rng(1)
    (tmp_path / "idle").mkdir()
    rows = "\n".join(",".join(f"{v:.5g}" for v in row) for row in rng.normal(size=(400, 2)))
    (tmp_path / "idle" / "hits.csv").write_text(f"force 1+Z [N],acc 3-X [g]\n{rows}\n")
    made = scaffold(tmp_path)
    assert [(t.role, t.reason) for t in made.taken] == [
        ("idle records", "1 force and 1 response channels, 400 samples without a sampling rate; named 'idle'")
    ]
    assert "hits.csv: no sampling rate is stated: give [units] sampling_hz, nothing runs without" in made.notes
    said = CliRunner().invoke(main, ["init", str(tmp_path), "-o", str(tmp_path / "other.toml")]).stdout
    assert "Next: write what" in said
    assert "[channels]" not in made.text  # the heads of the columns say where they were measured
    write_test(made, tmp_path / "test.toml")
    text = (tmp_path / "test.toml").read_text()
    (tmp_path / "test.toml").write_text(text.replace("# sampling_hz = ?", "sampling_hz = 512"))
    assert load_test(tmp_path).units["sampling_hz"] == 512


def test_a_dof_in_the_head_of_a_column_is_read(tmp_path):
    heads = {
        "acc 3+Z [m/s2]": "3+Z",
        "3-x acc [g]": "3-X",
        "4+Z [g]": "4+Z",
        "acc 1+Z to 2+Z [g]": None,
        "acc 3z [g]": None,
        "acc 12 [g]": None,
    }
    (tmp_path / "a.csv").write_text(f"time [s],{','.join(heads)}\n" + "".join(f"{i / 100}{',1.0' * len(heads)}\n" for i in range(9)))
    [record] = operando.read(tmp_path / "a.csv").records
    assert [None if c.dof is None else str(c.dof) for c in record.channels] == list(heads.values())


def test_files_in_doubt_for_one_reason_are_said_in_one_line(folder, tmp_path):
    flat = tmp_path / "flat"
    flat.mkdir()
    for i in range(5):
        (flat / f"m{i}.uff").write_bytes((folder / "idle/run1.uff").read_bytes())
    [line] = [note for note in scaffold(flat).notes if note.startswith("unsure")]
    assert line.startswith("unsure: m0.uff, m1.uff, m2.uff, … (5) taken as idle records:")


def test_tables_of_the_structure_are_no_records(tmp_path):
    """Nodes, lines and directions beside the records, as campaigns bring them."""
    rows = "\n".join(f"{i / 100},{(i * 7) % 5}" for i in range(200))
    (tmp_path / "run.csv").write_text(f"time [s],1+Z [g]\n{rows}\n")
    (tmp_path / "grid.txt").write_text("node_name\t x\t\t y\t z\n 1  1.8e+01 -1.8e+01 0\n 2  1.8e+01 1.8e+01 0\n")
    (tmp_path / "points.csv").write_text("Node,x [m],y [m],z [m]\n1,0,0,0\n2,1,0,0\n")
    (tmp_path / "lines.txt").write_text("node_name_1\t node_name_2\n 3 7\n 4 8\n")
    (tmp_path / "edges.csv").write_text("from,to\n1,2\n2,3\n")
    (tmp_path / "directions.csv").write_text("setup,node,channel,azimuth_deg,elevation_deg\n1,5,5+X,28.9,-8.7\n")
    made = scaffold(tmp_path)
    assert roles(made, tmp_path) == dict.fromkeys(("directions.csv", "edges.csv", "lines.txt"), "ignored") | {
        "run.csv": "operating records",
        "grid.txt": "geometry",
        "points.csv": "geometry",
    }
    assert 'records = ["run.csv"]' in made.text
    assert "[channels]" not in made.text
    assert 'file = "grid.txt"' in made.text
    [told] = [note for note in made.notes if "lines.txt" in note]
    assert told.startswith("not used: lines.txt: a table of lines between nodes (node_name_1, node_name_2), no measurement")
    assert "[geometry] takes" in told
    assert any("[directions]" in note for note in made.notes if "directions.csv" in note)


def test_arrays_without_a_rate_are_taken_and_the_rate_is_asked_for(tmp_path):
    np.savez(tmp_path / "mast.npz", data=np.random.default_rng(0).normal(size=(3000, 4)).astype(np.float32))
    made = scaffold(tmp_path)
    assert roles(made, tmp_path) == {"mast.npz": "operating records"}
    assert "3000 samples without a sampling rate" in made.taken[0].reason
    assert "# sampling_hz = ?  # samples a second: needed, mast.npz does not say" in made.text.splitlines()
    assert any("give [units] sampling_hz, nothing runs without" in note for note in made.notes)
    write_test(made, tmp_path / "test.toml")
    asked = {"# sampling_hz = ?": "sampling_hz = 512", '# "ch': '"ch'}
    text = (tmp_path / "test.toml").read_text()
    for commented, given in asked.items():
        text = text.replace(commented, given)
    (tmp_path / "test.toml").write_text(text)
    test = load_test(tmp_path)
    [record] = operando.read(tmp_path / "mast.npz", units=test.units, channels=test.channels).records
    assert (record.sampling_hz, len(record.response_indices)) == (512, 4)


def test_an_array_of_coordinates_lacks_no_rate(tmp_path):
    np.savez(tmp_path / "geometry.npz", nodes=np.random.default_rng(0).normal(size=(30, 3)))
    with pytest.raises(MissingError, match=r"no measurement.*no data with a time or frequency axis"):
        scaffold(tmp_path)


def test_what_is_proposed_of_slow_records_lies_within_them(tmp_path):
    """30 Hz, names that tell no direction, and one number for two sensors."""
    rows = "\n".join(f"{i / 30:.6f},{(i * 7) % 5},{(i * 3) % 4},1" for i in range(3000))
    (tmp_path / "tower.csv").write_text(f"time [s],LAT069_FA [g],LAT069_SS [g],top_x [g]\n{rows}\n")
    made = scaffold(tmp_path)
    [line] = [line for line in made.text.splitlines() if "band =" in line]
    low, high = json.loads(line.split("=")[1].split("#")[0])
    assert (low, high) == (0.1, 12.0)  # ten periods in 100 s, 0.4 of the rate
    assert "sampled at 30 Hz" in line
    lines = {line.split(" = ")[0].strip('"'): line for line in made.text.splitlines() if line.startswith('"')}
    assert lines["LAT069_FA"].endswith('dof = "69+Z", quantity = "acceleration"}  # guessed, in no file: the direction; correct it')
    assert "# guessed, in no file: node 70 (69+Z is taken) and the direction; correct it" in lines["LAT069_SS"]
    assert "# guessed, in no file: node 1; correct it" in lines["top_x"]
    write_test(made, tmp_path / "test.toml")
    assert load_test(tmp_path).channels["LAT069_SS"]["dof"] == "70+Z"


def test_a_band_of_the_idle_files_lies_within_the_operating_records(tmp_path):
    (tmp_path / "idle").mkdir()
    operando.write_uff(tmp_path / "idle/frf.uff", operando.Frf([[range(1, 199)]], range(2, 200), "1+Z", "1+Z"))
    rows = "\n".join(f"{i / 50},{(i * 7) % 5}" for i in range(1000))
    (tmp_path / "run.csv").write_text(f"time [s],1+Z [g]\n{rows}\n")
    assert "# band = [2, 20]" in scaffold(tmp_path).text

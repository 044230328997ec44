"""UFF files that are damaged or written in an unusual way: nothing is lost or changed without a word."""

from __future__ import annotations

import re

import numpy as np
import pytest

from io_files import SHARED, ascii58, binary58, head58, text_set, units164
from operando.data import Geometry, ModalModel
from operando.errors import FormatError
from operando.io import read, read_uff_sets, write_uff

FAULTS = SHARED / "faults"
needs_faults = pytest.mark.skipif(not FAULTS.is_dir(), reason="the folder of files that did harm is missing beside the project")


def load(tmp_path, *sets, **kw):
    path = tmp_path / "file.uff"
    path.write_bytes(b"".join(sets))
    return read(path, **kw)


def kinds(content):
    return sorted(f.kind for f in content.findings)


# --- bytes outside the sets -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_damaged_opening_separator_is_told(tmp_path, which):
    sets = [ascii58([float(i)] * 4, response=(i, 3)) for i in (1, 2, 3)]
    sets[which] = b"   x" + sets[which][4:]
    content = load(tmp_path, *sets)
    assert content.records[0].data[:, 0].tolist() == [float(i) for i in (1, 2, 3) if i != which + 1]
    (finding,) = content.findings
    assert (finding.kind, finding.severity) == ("outside_sets", "error")
    assert "set of type 58" in finding.message
    assert ("before the first set" if which == 0 else f"after set {which - 1}") in finding.message


def test_the_number_of_bytes_outside_is_exact(tmp_path):
    content = load(tmp_path, b"exported by a program\n", ascii58([1.0] * 4), b"\n  and more\n", ascii58([2.0] * 4, response=(2, 3)))
    messages = [f.message for f in content.findings]
    assert [m.split(" belong")[0] for m in messages] == [
        "21 bytes from byte 0 on (before the first set)",
        f"8 bytes from byte {22 + len(ascii58([1.0] * 4)) + 3} on (after set 0)",
    ]
    assert {f.severity for f in content.findings} == {"warning"}


def test_blanks_and_separators_between_sets_are_nothing(tmp_path):
    sets = [ascii58([1.0] * 4), b"\r\n \n    -1\n", binary58([1.0] * 4, response=(2, 3)), b"\n\n\x00\x1a"]
    assert not load(tmp_path, b"\xef\xbb\xbf", *sets).findings


def test_sets_behind_a_function_that_declares_too_much_are_read(tmp_path):
    long = binary58([1.0] * 4, points=400, stated=0)
    content = load(tmp_path, long, *(binary58([2.0] * 4, response=(i, 3)) for i in range(20, 40)))
    assert [s.status for s in content.sets] == ["not understood"] + ["used"] * 20
    assert content.records[0].data.shape == (20, 4)


# --- points, stated bytes, bytes there ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [2, 4])
@pytest.mark.parametrize("tail", [b"    -1\n", b"\n    -1\n", b"\r\n    -1\r\n"])
@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize("stated", [None, 0])
def test_blanks_of_the_separator_are_no_sample(tmp_path, kind, tail, last, stated):
    size = 4 if kind == 2 else 8
    wrong = binary58([1.0] * 9, kind=kind, points=10, tail=tail, stated=9 * size if stated is None else stated)
    good = ascii58([1.0] * 4, response=(2, 3))
    content = load(tmp_path, *((good, wrong) if last else (wrong, good)))
    assert sorted(s.status for s in content.sets) == ["not understood", "used"]
    (finding,) = content.findings
    assert finding.kind == "truncated"
    assert f"declares 10 points ({10 * size} bytes)" in finding.message


def test_zeros_count_as_filling_only_in_the_last_line(tmp_path):
    numbers = [1.0, 2.0, 3.0, 4.0, 5.0, 0.0, 0.0, 0.0]
    assert load(tmp_path, ascii58(numbers, points=5)).records[0].n_samples == 5
    for points in (4, 6):
        with pytest.raises(FormatError, match=f"declares {points} points"):
            load(tmp_path, ascii58([*numbers[:points], *[0.0] * (3 if points == 4 else 4)], points=points))


def test_a_function_that_declares_more_than_its_text_takes_no_memory(tmp_path):
    with pytest.raises(FormatError, match=r"declares 9999999999 points .*characters"):
        load(tmp_path, ascii58([1.0] * 4).replace(b"         4         4", b"         49999999999"))


# --- forms of text --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("codec", ["utf-16", "utf-16-le", "utf-16-be"])
def test_utf16(tmp_path, codec):
    text = (ascii58([1.0, 2.0, 3.0, 4.0], ids=("Prüfstand µ", *["NONE"] * 4)) + text_set(9999, "x")).decode()
    content = load(tmp_path, text.encode(codec))
    assert content.records[0].data.tolist() == [[1.0, 2.0, 3.0, 4.0]]
    assert content.records[0].channels[0].name == "Prüfstand µ"
    assert kinds(content) == ["format", "unknown_set"]
    assert "UTF-16" in content.findings[0].message
    assert content.sets[1].raw == text_set(9999, "x")


def test_utf16_that_breaks_off_is_refused(tmp_path):
    with pytest.raises(FormatError, match="UTF-16"):
        load(tmp_path, ascii58([1.0] * 4).decode().encode("utf-16") + b"\x00\xd8\x41")


def test_lone_carriage_returns(tmp_path):
    raws = [ascii58([1.0, 2.0, 3.0, 4.0]), text_set(15, "1 0 0 7 1.5D+00 2.5 3.5"), ascii58([5.0] * 4, response=(2, 3))]
    content = load(tmp_path, *(raw.replace(b"\n", b"\r") for raw in raws))
    assert content.records[0].data.tolist() == [[1.0, 2.0, 3.0, 4.0], [5.0] * 4]
    assert content.geometry.coordinates.tolist() == [[1.5, 2.5, 3.5]]
    assert [f.message for f in content.findings if f.kind == "format"] == ["the line ends are lone carriage returns: read all the same"]
    assert len(read_uff_sets(tmp_path / "file.uff")) == 3
    with pytest.raises(FormatError, match="sets are binary"):
        load(tmp_path, binary58([1.0] * 4, eol=b"\r", tail=b"\r    -1\r"))


@pytest.mark.parametrize("line", ["-1.0E+00-2.0E+00 3.0D+00-4.0d-01", "-1.0D+00-2.0D+00+3.0D+00-4.0D-01"])
def test_glued_numbers_and_d_exponents(tmp_path, line):
    lines = head58(points=4, step_text="  1.00000D-02", start_text="  0.00000D+00")
    record = load(tmp_path, "\n".join(["    -1", *lines, line, "    -1", ""]).encode()).records[0]
    assert record.data.tolist() == [[-1.0, -2.0, 3.0, -0.4]]
    assert record.sampling_hz == 100.0


# --- shapes ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("record", "text"),
    [
        (7, "  1.00000E+01"),
        (7, ""),
        (7, "x"),
        (6, "         2"),
        (5, "         1         2"),
        (8, "  1.0 2.0"),
        (8, ""),
        (9, "NaN 0.0 0.0"),
    ],
)
def test_a_damaged_mode_is_a_finding_and_the_others_are_read(tmp_path, record, text):
    model = ModalModel(np.array([10.0, 20.0]), np.array([0.01, 0.02]), np.ones((3, 2)), ("1+X", "1+Y", "1+Z"), "unscaled")
    write_uff(tmp_path / "m.uff", model)
    sets = [raw for _, raw in read_uff_sets(tmp_path / "m.uff")]
    lines = sets[1].decode().split("\n")
    assert lines[1].strip() == "55"
    lines[2 + record] = text
    content = load(tmp_path, sets[0], "\n".join(lines).encode(), sets[2])
    assert [s.status for s in content.sets] == ["used", "not understood", "used"]
    assert content.models[0].frequencies_hz.tolist() == [20.0]
    assert ("unknown_set", 1) in [(f.kind, f.set) for f in content.findings]


def test_a_lost_residual_term_is_noticed(tmp_path):
    rng = np.random.default_rng(0)
    f = np.array([10.0, 20.0, 60.0])
    model = ModalModel.from_terms(f, np.full(3, 0.02), rng.normal(size=(4, 3)) * [1, 1, 30], [f"{i}+Z" for i in range(1, 5)],
                                  "unit_modal_mass", residual=[False, False, True])  # fmt: skip
    write_uff(tmp_path / "m.uff", model)
    assert not read(tmp_path / "m.uff").findings
    sets = [raw for _, raw in read_uff_sets(tmp_path / "m.uff")]
    content = load(tmp_path, *sets[:-1])
    assert kinds(content) == ["modes_incomplete"]
    assert content.models[0].n_residuals == 0


# --- information sets -----------------------------------------------------------------------------------------------------------


def test_unit_factors_that_are_not_those_of_the_code(tmp_path):
    nodes = text_set(15, "1 0 0 7 1.5 2.5 3.5")
    factors = "  1.00000D+03  1.00000D+03  1.00000D+00", "  2.73150D+02"
    assert not load(tmp_path, text_set(164, "         5mm (milli-newton)             2", *factors), nodes).findings
    content = load(tmp_path, text_set(164, "         1SI: Meter (newton)            2", *factors), nodes)
    assert kinds(content) == ["unit_conflict"]
    assert content.geometry.coordinates.tolist() == [[1.5e-3, 2.5e-3, 3.5e-3]]


def test_an_exponential_window_of_the_qualifiers_is_said(tmp_path):
    record4 = "  0.0000000E+00  0.0000000E+00  0.0000000E+00  0.0000000E+00  5.2706007E-02"
    zero = "  0.0000000E+00" * 5
    qualifiers = text_set(1858, "           0" * 6, "     0     4" + "     0" * 10, zero, record4, zero, "X+    X+", "NONE")
    content = load(tmp_path, qualifiers, ascii58([1.0] * 4))
    assert kinds(content) == ["exponential_window"]
    assert "0.052706" in content.findings[0].message
    assert content.sets[0].raw == qualifiers


# --- the files that did harm ----------------------------------------------------------------------------------------------------


@needs_faults
def test_files_that_did_harm():
    first = read(FAULTS / "first_separator_damaged.uff")
    assert [(f.kind, f.severity) for f in first.findings] == [("outside_sets", "error")]
    assert "6103 bytes" in first.findings[0].message
    points = read(FAULTS / "58b_points_36865.uff")
    assert [(r.data.shape) for r in points.records] == [(13, 36864)]
    assert [(f.kind, f.set) for f in points.findings] == [("truncated", 0)]
    assert "states 147456 bytes" in points.findings[0].message
    modes = read(FAULTS / "mode55_indexerror.uff")
    refused = [s.index for s in modes.sets if s.status != "used"]
    assert {f.set for f in modes.findings} >= set(refused)
    assert modes.models[0].n_modes == sum(s.number == 55 and s.status == "used" for s in modes.sets)
    assert modes.models[0].n_modes >= 10
    escape = read(FAULTS / "terminal_escape.uff")
    assert escape.records[0].channels[1].name.startswith("\x1b]0;")  # kept as data; escaped where it is shown


def test_geometry_with_a_node_of_a_colour_that_is_no_number(tmp_path):
    write_uff(tmp_path / "g.uff", Geometry((1, 2), np.eye(3)[:2]))
    text = (tmp_path / "g.uff").read_text().replace("         2         0         0         1", "         2         0         0       1.5")
    (tmp_path / "g.uff").write_text(text)
    content = read(tmp_path / "g.uff")
    assert content.geometry is None
    assert "not whole" in content.findings[0].message


# --- what a damaged function leaves behind --------------------------------------------------------------------------------------


def frf58(response, reference, points=4, **kw):
    axis = {"abscissa": (18, "Frequency", "Hz"), "step": 0.5}
    return ascii58([1.0, 2.0] * points, kind=6, points=points, function=4, response=response, reference=reference,
                   denominator=(13, "Force", "N"), **(axis | kw))  # fmt: skip


def coherence58(response, reference, value=0.9):
    return ascii58([value] * 4, function=6, abscissa=(18, "Frequency", "Hz"), quantity=0, unit="NONE", step=0.5, response=response,
                   reference=reference)  # fmt: skip


def test_a_damaged_first_separator_does_not_hide_the_others(tmp_path):
    sets = [ascii58([float(i)] * 4, response=(i, 3)) for i in (1, 2, 3)]
    content = load(tmp_path, sets[0].replace(b"    -1\n", b"   -1\n", 1), *sets[1:])
    assert content.records[0].data[:, 0].tolist() == [2.0, 3.0]
    assert kinds(content) == ["outside_sets"]


def test_a_file_without_its_end_is_told(tmp_path):
    content = load(
        tmp_path,
        ascii58([1.0] * 4),
        text_set(15, "1 0 0 7 1.0 2.0 3.0")[: -len("    -1\n")],
    )
    assert content.geometry.nodes == (1,)
    assert "format" in kinds(content)


def test_a_coherence_without_its_frf_is_told(tmp_path):
    sets = [frf58((i, 3), (j, 3)) for i, j in ((1, 1), (2, 1), (1, 2))]
    content = load(tmp_path, *sets, coherence58((1, 3), (1, 3)), coherence58((2, 3), (2, 3)), coherence58((1, 3), (1, 3), 0.5))
    assert [(f.kind, f.set) for f in content.findings] == [("duplicate_set", 5), ("unused_function", 4)]
    assert np.nanmax(content.frfs[0].coherence) == 0.9
    assert np.isnan(content.frfs[0].coherence).all(axis=2).tolist() == [[False, True], [True, True]]


def test_frfs_on_different_lines_are_told(tmp_path):
    content = load(tmp_path, frf58((1, 3), (1, 3)), frf58((2, 3), (1, 3), points=5), frf58((3, 3), (1, 3), step=0.25))
    assert kinds(content) == ["unequal_lines"]
    assert "3 different sets" in content.findings[0].message


def test_different_numbers_of_averages_are_told(tmp_path):
    content = load(tmp_path, *(frf58((i, 3), (1, 3), ids=("NONE",) * 4 + (f"averages={n}",)) for i, n in ((1, 8), (2, 80))))
    assert kinds(content) == ["few_averages"]
    assert content.frfs[0].averages == 8.0


def test_a_direction_of_one_mode_alone_is_told(tmp_path):
    shapes = np.zeros((3, 3))
    shapes[0], shapes[2, 1] = 1.0, 0.5
    model = ModalModel(np.array([10.0, 20.0, 30.0]), np.full(3, 0.01), shapes, ("1+X", "1+Y", "1+Z"), "unscaled")
    write_uff(tmp_path / "m.uff", model)
    (finding,) = read(tmp_path / "m.uff").findings
    assert (finding.kind, "1+Z" in finding.message) == ("odd_direction", True)


# --- found by mutants -----------------------------------------------------------------------------------------------------------


def test_a_set_that_is_swallowed_by_the_units_is_told(tmp_path):
    """The separators between the units and a function are gone: its lines stand behind those of the units."""
    units = units164()
    content = load(tmp_path, units[: -len("    -1\n")], ascii58([1.0] * 4)[len("    -1\n") :], ascii58([2.0] * 4, response=(2, 3)))
    assert len(content.records[0].channels) == 1
    (finding,) = [f for f in content.findings if f.kind == "outside_sets"]
    assert (finding.severity, finding.set) == ("error", 0)
    assert "13 lines more than a set of type 164" in finding.message
    assert not [f for f in load(tmp_path, units, ascii58([1.0] * 4)).findings if f.kind == "outside_sets"]


def test_a_stated_value_that_the_modes_cannot_make_is_noticed_also_where_it_is_no_number(tmp_path):
    model = ModalModel(np.array([10.0, 20.0]), np.array([0.01, 0.02]), np.ones((3, 2)), ("1+X", "1+Y", "1+Z"), "unit_modal_mass")
    write_uff(tmp_path / "m.uff", model)
    text = (tmp_path / "m.uff").read_text()
    assert not read(tmp_path / "m.uff").findings
    (tmp_path / "n.uff").write_text(re.sub(r" at \d+ Hz = ", " at nan Hz = ", text))
    assert kinds(read(tmp_path / "n.uff")) == ["modes_incomplete"]


def test_infinite_and_signalling_numbers_make_no_warning(tmp_path):
    good = ascii58([1.0, 2.0, 3.0, 4.0, 5.0, 6.0], kind=6, even=0, points=2, function=4, reference=(1, 3), denominator=(13, "Force", "N"),
                   abscissa=(18, "Frequency", "Hz"))  # fmt: skip
    content = load(tmp_path, good.replace(b"  3.000000000000E+00", b"                 inf"))
    assert np.isinf(content.frfs[0].data[0, 0, 0].imag)
    assert content.frfs[0].data[0, 0, 1] == complex(5.0, 6.0)
    load(tmp_path, binary58([1.0] * 4, kind=2).replace(b"\x00\x00\x80\x3f", b"\x01\x00\xa0\x7f", 1), binary58([1.0] * 4, response=(2, 3)))
    frf = ascii58([1.0] * 8, kind=6, points=4, function=4, reference=(1, 3), abscissa=(18, "Frequency", "Hz"), step_text="  1.0000E+308")
    with pytest.raises(FormatError):
        load(tmp_path, frf)


def test_a_damaged_line_is_not_printed_whole(tmp_path):
    with pytest.raises(FormatError) as caught:
        load(tmp_path, ascii58([1.0] * 4).replace(b"         4         4         1", b"x" * 5000))
    assert len(str(caught.value)) < 400


def test_modes_at_different_nodes_are_told(tmp_path):
    """A node number that is lost in one mode makes it a model of its own."""
    model = ModalModel(np.array([10.0, 20.0, 30.0]), np.full(3, 0.01), np.ones((6, 3)), [f"{n}+{a}" for n in (1, 2) for a in "XYZ"])
    write_uff(tmp_path / "m.uff", model)
    assert not read(tmp_path / "m.uff").findings
    sets = [raw for _, raw in read_uff_sets(tmp_path / "m.uff")]
    sets[-1] = sets[-1].replace(b"\n         1\n", b"\n         7\n", 1)
    content = load(tmp_path, *sets)
    assert [m.n_modes for m in content.models] == [2, 1]
    (finding,) = content.findings
    assert (finding.kind, "2 different sets of nodes" in finding.message) == ("unequal_nodes", True)

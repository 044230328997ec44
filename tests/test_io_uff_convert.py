"""What a conversion keeps of a UFF file: systems, names, colours, double precision, components, dates; what it names as lost."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from io_files import ascii58, text_set, units164
from operando.data import Appearance, Channel, CoordinateSystem, Frf, Geometry, ModalModel, Provenance, TimeRecord
from operando.dof import Dof
from operando.errors import WriteError
from operando.io import FileHeader, convert, read, read_uff_sets, write_uff
from operando.io.uff.lines import parse_date, print_date
from operando.io.uff.text_sets import number13


def converted(tmp_path, *sets, target="out.uff", **kw):
    path = tmp_path / "in.uff"
    path.write_bytes(b"".join(sets))
    document = convert(path, tmp_path / target, **kw)
    return document, read(path), read(tmp_path / target)


def node_line(number, definition, displacement, color, *xyz):
    return f"{number:10d}{definition:10d}{displacement:10d}{color:10d}", "".join(f"{v:25.16E}".replace("E", "D") for v in xyz)


TURNED = ["      3      0      4", "TURNED", "  0.0 1.0 0.0", " -1.0 0.0 0.0", "  0.0 0.0 1.0", "  1.0D+03 2.0D+03 0.0"]
HEADER151 = text_set(151, "pump", "on its frame", "LMS Test.Lab Rev 18A", "11-Oct-17 09:34:21", "12-Oct-17 09:34:21", "writer", "13-Oct-17")


def test_geometry_keeps_systems_names_colours_and_digits(tmp_path):
    third = 1000 / 3
    nodes = [line for n in (1, 2, 3, 4) for line in node_line(n, 1, 3 if n == 2 else 0, 10 + n, n * third, -n, 0.0)]
    content = converted(
        tmp_path, HEADER151, units164(1000.0, 1000.0), text_set(2420, "         7", "part", *TURNED), text_set(2411, *nodes),
        text_set(82, "         1         5         6", "left rail", "         1         2         0         3         4"),
        text_set(82, "         2         3         7", "bracket", "         2         3         4"),
        text_set(2412, "         1        91         1         1         9         3", "         1         2         3",
                 "         2       115         1         1         8         8", "         1         2         3         4" * 2),
    )  # fmt: skip
    document, before, after = content
    g, h = before.geometry, after.geometry
    assert g.coordinates[0, 0] == pytest.approx(1 / 3, rel=1e-15)
    np.testing.assert_array_equal(h.coordinates, g.coordinates)
    for geometry in (g, h):
        assert geometry.nodes == (1, 2, 3, 4)
        assert geometry.lines == ((1, 2), (3, 4), (2, 3, 4))
        assert geometry.appearance.line_names == ("left rail", "left rail", "bracket")
        assert geometry.appearance.line_colors == (6, 6, 7)
        assert geometry.appearance.face_colors == (9,)
        assert geometry.appearance.node_colors == {1: 11, 2: 12, 3: 13, 4: 14}
        assert geometry.node_systems == {2: 3}
        (system,) = geometry.systems
        assert (system.number, system.kind, system.color, system.name) == (3, 0, 4, "TURNED")
        assert system.origin.tolist() == [1.0, 2.0, 0.0]
        assert system.axes.tolist() == [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
    assert replace(after.header, writer="writer", written="13-Oct-17") == before.header
    assert before.header.name == "pump"
    assert any("1 elements of set" in text for text in document["lost"])
    assert any("SI now" in text for text in document["lost"])


def test_systems_of_set_18_are_kept(tmp_path):
    systems = text_set(18, "         1         0         0         8         1", "TURNED", "  1.0 2.0 3.0  1.0 3.0 3.0", "  1.0 2.0 4.0")
    _, before, after = converted(tmp_path, units164(1.0), systems, text_set(15, "1 1 1 7 1.0 0.0 0.0"))
    assert after.geometry.coordinates.tolist() == [[1, 3, 3]]
    np.testing.assert_allclose(after.geometry.systems[0].axes, before.geometry.systems[0].axes, atol=1e-15)
    assert after.geometry.node_systems == {1: 1}
    assert after.geometry.systems[0].name == "TURNED"


def test_long_trace_lines_are_cut_at_the_limit_of_the_standard(tmp_path):
    nodes = tuple(range(1, 601))
    line = Appearance(line_names=("rim",), line_colors=(3,))
    write_uff(tmp_path / "a.uff", Geometry(nodes, np.random.default_rng(0).normal(size=(600, 3)), (nodes,), appearance=line))
    back = read(tmp_path / "a.uff").geometry
    pairs = [pair for part in back.lines for pair in pairwise(part)]
    assert pairs == list(pairwise(nodes))
    assert set(back.appearance.line_names) == {"rim"}
    for info, raw in read_uff_sets(tmp_path / "a.uff"):
        if info.number == 82:
            assert len(raw.decode().split("\n", 4)[4].split()) - 1 <= 250


def test_sets_passed_on_stand_behind_the_units_of_their_file(tmp_path):
    groups = text_set(2467, "something in mm")
    converted(tmp_path, units164(1000.0, 1000.0), ascii58([1.0] * 4), groups)
    raws = [raw for _, raw in read_uff_sets(tmp_path / "out.uff")]
    assert raws[-2:] == [units164(1000.0, 1000.0), groups]
    assert b"SI: Meter" in raws[0]


def analysis2414(kind, data_type, numbers12, numbers13, values, location=1):
    return text_set(
        2414, "         1", "MODE 1", f"{location:10d}", *["NONE"] * 5,
        f"{1:10d}{kind:10d}{2:10d}{8:10d}{data_type:10d}{3:10d}", f"{0:10d}" * 5 + f"{4:10d}{0:10d}{0:10d}", f"{0:10d}{0:10d}",
        "".join(f"{v:13.5E}" for v in numbers12), "".join(f"{v:13.5E}" for v in numbers13), *values,
    )  # fmt: skip


def test_modes_of_analysis_data(tmp_path):
    real = analysis2414(2, 4, [0, 12.5, 0, 2.0, 0.03, 0], [0] * 6, ["         7", "  1.0D+00  2.0D+00  3.0D+00"])
    pole = 2 * np.pi * 10 * (-0.02 + 1j * np.sqrt(1 - 0.02**2))
    complex_mode = analysis2414(3, 5, [0] * 6, [pole.real, pole.imag, 0, 0, 0, 0], ["         7", " 1.0 2.0 3.0 4.0 5.0 6.0"])
    other = analysis2414(1, 2, [0] * 6, [0] * 6, ["         7", " 1.0 2.0 3.0"])
    elements = analysis2414(2, 2, [0] * 6, [0] * 6, ["         7", " 1.0 2.0 3.0"], location=2)
    document, before, after = converted(tmp_path, real, complex_mode, other, elements)
    for content in (before, after):
        first, second = content.models
        assert (first.frequencies_hz[0], first.damping_ratios[0]) == (12.5, pytest.approx(0.03))
        assert first.shapes[:, 0].tolist() == [1, 2, 3]
        assert second.frequencies_hz[0] == pytest.approx(10.0, rel=1e-5)
        assert second.shapes[:, 0].tolist() == [1 + 2j, 3 + 4j, 5 + 6j]
    assert [p["type"] for p in document["passed_on"]] == [2414, 2414]
    assert any("2414" in text for text in document["lost"])


def test_what_a_table_cannot_hold_is_named(tmp_path):
    document, _, _ = converted(tmp_path, HEADER151, text_set(15, "1 0 0 7 1.0 0.0 0.0"), ascii58([1.0] * 4), target="out.csv")
    assert "header of the file (set 151)" in document["lost"]
    assert "geometry of 1 nodes: cannot be represented in csv" in document["lost"]
    assert len(document["lost"]) == len(set(document["lost"]))


def test_a_conversion_leaves_its_source_as_it_is(tmp_path):
    before = ascii58([1.0] * 4)
    with pytest.raises(WriteError, match="over the file that is read"):
        converted(tmp_path, before, target="in.uff")
    assert (tmp_path / "in.uff").read_bytes() == before


def test_hdf5_keeps_everything_of_a_geometry(tmp_path):
    system = CoordinateSystem(3, 1, np.array([1.0, 2.0, 3.0]), np.eye(3)[[1, 2, 0]], "ring", 5)
    shown = Appearance({"FRAM:1": 3, 2: 4}, ("rail",), (6,), (8,))
    geometry = Geometry(("FRAM:1", 2, "MOTR:1"), np.eye(3), (("FRAM:1", 2),), (("FRAM:1", 2, "MOTR:1"),), "g", systems=(system,),
                        node_systems={"MOTR:1": 3}, appearance=shown)  # fmt: skip
    write_uff(tmp_path / "a.uff", geometry)
    document = convert(tmp_path / "a.uff", tmp_path / "a.h5")
    assert document["lost"] == []
    convert(tmp_path / "a.h5", tmp_path / "b.uff")
    for name in ("a.uff", "a.h5", "b.uff"):
        back = read(tmp_path / name).geometry
        assert (back.nodes, back.lines, back.faces) == (geometry.nodes, geometry.lines, geometry.faces)
        assert (back.node_systems, back.appearance) == (
            geometry.node_systems,
            Appearance({"FRAM:1": 3, 2: 4, "MOTR:1": 1}, ("rail",), (6,), (8,)),
        )
        np.testing.assert_array_equal(back.systems[0].axes, system.axes)


# --- components -----------------------------------------------------------------------------------------------------------------


def named(name, node, **kw):
    return ascii58([1.0] * 4, name=name, response=(node, 3), **kw)


def labels(content):
    return [str(c.dof) for c in content.records[0].channels]


@pytest.mark.parametrize(
    ("sets", "expected"),
    [
        ([named("FRAM", 1), named("MOTR", 1), named("MOTR", 2)], ["FRAM:1+Z", "MOTR:1+Z", "MOTR:2+Z"]),
        ([HEADER151, named("FRAM", 1), named("MOTR", 2)], ["FRAM:1+Z", "MOTR:2+Z"]),
        ([named("FRAM", 1, ids=("Time FRAM:1:+Z", *["NONE"] * 4)), named("MOTR", 2)], ["FRAM:1+Z", "MOTR:2+Z"]),
    ],
)
def test_components_of_testlab_are_parts_of_the_dof(tmp_path, sets, expected):
    _, before, after = converted(tmp_path, *sets)
    assert labels(before) == labels(after) == expected
    (finding,) = [f for f in before.findings if f.kind == "components"]
    assert "FRAM, MOTR" in finding.message
    assert not [f for f in before.findings if f.kind == "duplicate_channel"]
    assert b"FRAM               1   3" in (tmp_path / "out.uff").read_bytes()


def test_channel_names_stay_channel_names(tmp_path):
    force = ascii58([1.0] * 4, name="hammer", quantity=13, unit="N", label="Force", response=(1, 3))
    content = converted(tmp_path, force, named("sensor 1", 1), named("sensor 2", 2), named("NONE", 3))[1]
    assert labels(content) == ["1+Z", "1+Z", "2+Z", "3+Z"]
    assert [c.name for c in content.records[0].channels] == ["hammer", "sensor 1", "sensor 2", ""]


def test_frfs_between_components(tmp_path):
    dofs = tuple(Dof.parse(text) for text in ("FRAM:1+Z", "MOTR:1+Z", "A_LONG_COMPONENT:7-X", "5+Y"))
    data = np.random.default_rng(0).normal(size=(4, 4, 6, 2)) @ [1, 1j]
    frf = Frf(data, np.arange(6.0), dofs, dofs, variance=np.abs(data) ** 2 * 0.01)
    model = ModalModel(np.array([10.0]), np.array([0.01]), np.arange(1.0, 5.0)[:, None], dofs, "unit_modal_mass")
    geometry = Geometry(("FRAM:1", "MOTR:1", "A_LONG_COMPONENT:7", 5), np.eye(4)[:, :3], (("FRAM:1", 5),))
    write_uff(tmp_path / "a.uff", frf, model, geometry)
    content = read(tmp_path / "a.uff")
    assert content.frfs[0].responses == content.frfs[0].references == dofs
    np.testing.assert_array_equal(content.frfs[0].data, data)
    assert {d.unsigned for d in content.models[0].dofs} == {d.unsigned for d in dofs}
    np.testing.assert_allclose(content.models[0].rows(dofs), model.shapes)
    assert (content.geometry.nodes, content.geometry.lines) == (geometry.nodes, geometry.lines)
    assert {f.kind for f in content.findings} == {"components"}


def test_geometry_takes_the_components_of_the_dofs():
    geometry = Geometry((1, 2, 3), np.eye(3), ((1, 2), (2, 3)), appearance=Appearance({1: 5}, ("a", "b")), node_systems={2: 1})
    dofs = [Dof.parse(text) for text in ("FRAM:1+Z", "FRAM:1+X", "MOTR:2+Z", "FRAM:3+Z", "MOTR:3+Z")]
    found, unclear = geometry.with_components(dofs)
    assert (found.nodes, unclear) == (("FRAM:1", "MOTR:2", 3), (3,))
    assert found.lines == (("FRAM:1", "MOTR:2"), ("MOTR:2", 3))
    assert (found.appearance.node_colors, found.node_systems) == ({"FRAM:1": 5}, {"MOTR:2": 1})
    assert found.position("MOTR:2").tolist() == [0, 1, 0]
    assert found.position("FRAM:3") is None
    assert geometry.with_components([Dof(1, "Z")]) == (geometry, ())


# --- digits and dates -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [1 / 51200, 1 / 3, -1 / 3, 0.0, 25 / 128, 1.0, 44100 / 65536, 1e-7 / 3, 123456.789012, 1e20 / 3])
def test_numbers_fill_their_thirteen_columns(value):
    text = number13(value)
    assert len(text) == 13
    assert text[0] == " " or text[:2] == "-0" or value < 0
    assert float(text) == pytest.approx(value, rel=6e-7 if abs(value) > 1e9 or abs(value) < 1e-6 else 1e-8)


def test_six_digits_stay_as_they_are():
    assert number13(12.5) == "  1.25000E+01"
    assert number13(1 / 512) == "  0.001953125"


@pytest.mark.parametrize(
    ("text", "iso"),
    [
        ("17-NOV-26 09:15:00", "2026-11-17T09:15:00"), ("1-jan-1999   7:05", "1999-01-01T07:05:00"),
        ("08-Oct-99 10:27:07", "1999-10-08T10:27:07"),
        ("31-Feb-20 10:00:00", ""), ("NONE", ""), ("2020-01-01", ""),
    ],
)  # fmt: skip
def test_dates(text, iso):
    assert parse_date(text) == iso
    assert parse_date(print_date(iso)) == iso


def test_the_date_of_measuring_goes_with_the_data(tmp_path):
    record = TimeRecord(np.ones((1, 4)), 100.0, (Channel(Dof(1, "Z"), "acceleration", "m/s2", "a"),))
    write_uff(tmp_path / "a.uff", record)
    assert read(tmp_path / "a.uff").records[0].provenance.measured == ""
    dated = replace(record, provenance=Provenance(measured="2026-11-17T09:15:00").then("cut"))
    for name, header in (("b.uff", None), ("c.uff", FileHeader("test", written="2026-11-17T09:15:00"))):
        write_uff(tmp_path / name, dated, header=header)
        assert read(tmp_path / name).records[0].provenance.measured == "2026-11-17T09:15:00"
    assert read(tmp_path / "c.uff").header.written == "17-Nov-26 09:15:00"
    assert Provenance.merge(Provenance(measured="2026-11-18"), Provenance(), Provenance(measured="2026-11-17")).measured == "2026-11-17"

"""Writing UFF: round trips, and pyuff as a second pair of eyes in both directions."""

from __future__ import annotations

import gc
import warnings

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from io_files import text_set
from operando.data import Channel, Frf, Geometry, ModalModel, TimeRecord
from operando.dof import Dof
from operando.errors import DataError, WriteError
from operando.io import read, write_uff

pyuff = pytest.importorskip("pyuff")

FORMS = [{"binary": True}, {"binary": True, "big_endian": True}, {"binary": False}]


def make_record(samples=50, dtype=float, rate=51200.0, start=0.0):
    rng = np.random.default_rng(0)
    channels = (
        Channel(Dof(1, "Z"), "force", "N", "impact hammer, long name µ"),
        Channel(Dof(2, "X", -1), "acceleration", "m/s2", "a2"),
        Channel(None, "voltage", "V", "tacho"),
        Channel(Dof(3), "displacement", "m"),
    )
    return TimeRecord(rng.normal(size=(4, samples)).astype(dtype), rate, channels, start)


def make_frf(lines=40, quantity="accelerance", axis=None):
    rng = np.random.default_rng(1)
    data = rng.normal(size=(3, 2, lines)) + 1j * rng.normal(size=(3, 2, lines))
    data[1, 1] = np.nan
    axis = np.arange(lines) * 44100 / 65536 if axis is None else axis
    coherence = rng.uniform(0.5, 1, size=data.shape)
    coherence[1, 1] = np.nan
    return Frf(data, axis, ("1+Z", "2-X", "3+RX"), ("1+Z", "2-X"), quantity, coherence=coherence, averages=12.5)


def make_model(complex_shapes=False):
    rng = np.random.default_rng(2)
    shapes = rng.normal(size=(4, 3)) + (1j * rng.normal(size=(4, 3)) if complex_shapes else 0)
    scaling = "unscaled" if complex_shapes else "unit_modal_mass"
    f, zeta = np.array([10.123456789012, 20.0, 33.3]), np.array([0.0123456789, 0.02, 1e-4])
    residual = np.array([False, False, not complex_shapes])
    return ModalModel.from_terms(f, zeta, shapes, ("1+Z", "2-X", "3+Y", "3+X"), scaling, residual=residual)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_record_round_trip(tmp_path, form, dtype):
    record = make_record(dtype=dtype, start=-0.01)
    write_uff(tmp_path / "a.uff", record, **form)
    (back,) = read(tmp_path / "a.uff").records
    if form["binary"]:
        assert back.data.dtype == dtype
        np.testing.assert_array_equal(back.data, record.data)
    else:
        np.testing.assert_allclose(back.data, record.data, rtol=1e-12)
    assert (back.sampling_hz, back.start_s) == (record.sampling_hz, record.start_s)
    for a, b in zip(record.channels, back.channels, strict=True):
        assert (a.dof, a.quantity, a.unit, a.name) == (b.dof, b.quantity, b.unit, b.name)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("quantity", ["accelerance", "mobility", "receptance"])
def test_frf_round_trip(tmp_path, form, quantity):
    frf = make_frf(quantity=quantity)
    write_uff(tmp_path / "a.uff", frf, **form)
    content = read(tmp_path / "a.uff")
    (back,) = content.frfs
    tolerance = {"rtol": 0 if form["binary"] else 1e-11, "atol": 0 if form["binary"] else 1e-12}
    np.testing.assert_allclose(back.data, frf.data, **tolerance)
    np.testing.assert_allclose(back.coherence, frf.coherence, **tolerance)
    np.testing.assert_array_equal(back.frequencies_hz, frf.frequencies_hz)
    assert (back.responses, back.references, back.quantity, back.si) == (frf.responses, frf.references, quantity, True)
    assert back.averages == 12.5
    expected = np.abs(frf.data) ** 2 * (1 - frf.coherence) / (frf.coherence * 12.5)
    np.testing.assert_allclose(back.variance, expected, rtol=1e-9)
    assert not content.findings


@pytest.mark.parametrize(("form", "digits"), [(FORMS[0], 0), (FORMS[1], 0), (FORMS[2], 1e-7)])
def test_uneven_lines_round_trip(tmp_path, form, digits):
    axis = np.sort(np.random.default_rng(3).uniform(1, 100, 40))
    frf = make_frf(axis=axis)
    write_uff(tmp_path / "a.uff", frf, **form)
    (back,) = read(tmp_path / "a.uff").frfs
    np.testing.assert_allclose(back.frequencies_hz, axis, rtol=digits)


@given(rate=st.floats(1e-3, 1e7), samples=st.integers(1, 300), start=st.floats(-1e4, 1e4), binary=st.booleans())
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_rate_survives(tmp_path, rate, samples, start, binary):
    record = TimeRecord(np.ones((1, samples)), rate, (Channel(Dof(1, "X"), "acceleration", "m/s2"),), start)
    write_uff(tmp_path / "a.uff", record, binary=binary)
    (back,) = read(tmp_path / "a.uff").records
    assert back.sampling_hz == pytest.approx(rate, rel=1e-12)
    assert back.start_s == pytest.approx(start, rel=1e-12, abs=1e-12 / rate)


@given(start=st.floats(0, 100), step=st.floats(1e-4, 100), lines=st.integers(2, 200))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_frequency_axis_survives(tmp_path, start, step, lines):
    axis = start + step * np.arange(lines)
    frf = Frf(np.ones((1, 1, lines), complex), axis, ("1X",), ("1X",))
    write_uff(tmp_path / "a.uff", frf)
    (back,) = read(tmp_path / "a.uff").frfs
    np.testing.assert_allclose(back.frequencies_hz, axis, rtol=1e-12)


@given(values=st.lists(st.floats(width=64, allow_nan=True, allow_infinity=True), min_size=1, max_size=40), big=st.booleans())
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_value_survives_in_binary(tmp_path, values, big):
    record = TimeRecord(np.array([values, values[::-1]]), 100.0, tuple(Channel(Dof(i, "X"), "acceleration", "m/s2") for i in (1, 2)))
    write_uff(tmp_path / "a.uff", record, big_endian=big)
    (back,) = read(tmp_path / "a.uff").records
    np.testing.assert_array_equal(back.data, record.data)


@pytest.mark.parametrize("complex_shapes", [False, True])
def test_model_round_trip(tmp_path, complex_shapes):
    model = make_model(complex_shapes)
    write_uff(tmp_path / "a.uff", model)
    text = (tmp_path / "a.uff").read_text()
    assert ("unit modal mass, kg^-0.5" in text) != complex_shapes
    (back,) = read(tmp_path / "a.uff").models
    np.testing.assert_array_equal(back.frequencies_hz, model.frequencies_hz)
    np.testing.assert_array_equal(back.damping_ratios, model.damping_ratios)
    np.testing.assert_allclose(back.rows(model.dofs), model.shapes, rtol=1e-5)
    assert back.n_residuals == model.n_residuals == (0 if complex_shapes else 1)
    np.testing.assert_array_equal(back.terms.frequencies_hz, model.terms.frequencies_hz)
    assert (back.scaling, back.si) == (model.scaling, not complex_shapes)


def test_geometry_round_trip(tmp_path):
    geometry = Geometry((30, 1, 2, 7), np.arange(12.0).reshape(4, 3) / 8, ((30, 1, 2), (2, 7)), ((30, 1, 2), (30, 1, 2, 7)))
    write_uff(tmp_path / "a.uff", geometry)
    back = read(tmp_path / "a.uff").geometry
    assert (back.nodes, back.lines, back.faces, back.unit_known) == (geometry.nodes, geometry.lines, geometry.faces, True)
    np.testing.assert_array_equal(back.coordinates, geometry.coordinates)


def test_numbers_without_unit_stay_without(tmp_path):
    record = TimeRecord(np.ones((1, 5)), 100.0, (Channel(Dof(1, "X"), "acceleration", "", "a"),))
    geometry = Geometry((1,), np.ones((1, 3)), unit_known=False)
    frf = Frf(np.ones((1, 1, 5), complex), np.arange(5.0), ("1X",), ("1X",), si=False)
    write_uff(tmp_path / "a.uff", record, geometry, frf)
    content = read(tmp_path / "a.uff")
    assert content.records[0].channels[0].unit == ""
    assert not content.geometry.unit_known
    assert not content.frfs[0].si
    assert not any(s.number == 164 for s in content.sets)


def test_a_file_appears_whole_or_not_at_all(tmp_path):
    path = tmp_path / "a.uff"
    write_uff(path, make_record())
    before = path.read_bytes()
    mixed = ModalModel(np.ones(1), np.ones(1) * 0.01, np.ones((2, 1)), ("1+X", "2"))
    with pytest.raises(DataError):
        write_uff(path, make_record(samples=5), mixed)
    with pytest.raises(DataError):
        write_uff(path, "no object")
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.uff"]
    with pytest.raises(WriteError, match="folder"):
        write_uff(tmp_path / "no" / "folder.uff", make_record())


def test_passing_on_raw_sets(tmp_path):
    raws = [text_set(1858, "x"), text_set(9999, "y").rstrip(b"\n")]
    write_uff(tmp_path / "a.uff", make_record(), passthrough=raws)
    content = read(tmp_path / "a.uff")
    assert [s.raw.rstrip() for s in content.sets if s.status != "used"] == [r.rstrip() for r in raws]


# --- pyuff reads what operando writes -------------------------------------------------------------------------------------------


def pyuff_sets(path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sets = pyuff.UFF(str(path)).read_sets()
    return sets if isinstance(sets, list) else [sets]


@pytest.mark.parametrize("form", FORMS)
def test_pyuff_reads_functions(tmp_path, form):
    record, frf = make_record(rate=512.0), make_frf(axis=np.arange(40) * 0.25)
    write_uff(tmp_path / "a.uff", record, **form)
    sets = pyuff_sets(tmp_path / "a.uff")
    assert sets[0]["type"] == 164
    for row, channel, d in zip(record.data, record.channels, sets[1:], strict=True):
        np.testing.assert_allclose(d["data"][: row.size], row, rtol=1e-12)
        assert (d["func_type"], d["ordinate_axis_units_lab"]) == (1, channel.unit)
        assert d["rsp_node"] == (0 if channel.dof is None else channel.dof.node)
        assert d["abscissa_inc"] == pytest.approx(1 / 512, rel=1e-5)
    write_uff(tmp_path / "b.uff", frf, **form)
    sets = [d for d in pyuff_sets(tmp_path / "b.uff") if d.get("func_type") == 4]
    pairs = [(i, j) for j in range(2) for i in range(3) if (i, j) != (1, 1)]
    for (i, j), d in zip(pairs, sets, strict=True):
        np.testing.assert_allclose(d["data"], frf.data[i, j], rtol=1e-11, atol=1e-12)
        assert (d["rsp_node"], d["rsp_dir"]) == (frf.responses[i].node, frf.responses[i].uff_code)
        assert (d["ref_node"], d["ref_dir"]) == (frf.references[j].node, frf.references[j].uff_code)
        if form["binary"]:
            assert d["n_bytes"] == 16 * 40


def test_pyuff_reads_modes_and_geometry(tmp_path):
    model = make_model()
    geometry = Geometry((1, 2, 3, 4), np.arange(12.0).reshape(4, 3), ((1, 2, 3),), ((1, 2, 3), (1, 2, 3, 4)))
    write_uff(tmp_path / "a.uff", model, geometry)
    sets = pyuff_sets(tmp_path / "a.uff")
    assert [d["type"] for d in sets] == [164, 2411, 82, 2412, 55, 55, 55]
    assert sets[1]["y"].tolist() == [1.0, 4.0, 7.0, 10.0]
    assert sets[2]["nodes"].tolist() == [1, 2, 3, 0]
    assert [e["nodes_nums"] for e in sets[3][94]] == [[1, 2, 3, 4]]
    terms = model.terms
    for r, d in enumerate(sets[4:]):
        assert d["freq"] == pytest.approx(terms.frequencies_hz[r], rel=1e-5)
        assert d["modal_damp_vis"] == pytest.approx(terms.damping_ratios[r], rel=1e-5)
        assert d["modal_m"] == 1.0
        np.testing.assert_allclose(d["r1"], [0, -terms.shapes[1, r], terms.shapes[3, r]], rtol=1e-5)
    write_uff(tmp_path / "b.uff", make_model(complex_shapes=True))
    sets = [d for d in pyuff_sets(tmp_path / "b.uff") if d["type"] == 55]
    np.testing.assert_allclose(sets[1]["eig"], make_model(True).poles[1], rtol=1e-5)
    np.testing.assert_allclose(sets[1]["r3"][0], make_model(True).shapes[0, 1], rtol=1e-5)


# --- operando reads what pyuff writes -------------------------------------------------------------------------------------------


def pyuff_write(path, *sets):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pyuff.UFF(str(path)).write_sets(list(sets), "add")
        gc.collect()  # pyuff leaves the file open


def pyuff_function(data, binary, step=1 / 512, **kw):
    d = {
        "type": 58, "binary": binary, "func_type": 1, "rsp_node": 5, "rsp_dir": -2, "ref_node": 7, "ref_dir": 3, "data": data,
        "x": np.arange(len(data)) * step, "func_id": 1, "ver_num": 0, "load_case_id": 0, "rsp_ent_name": "NONE", "ref_ent_name": "NONE",
        "abscissa_spacing": 1, "abscissa_min": 0.0, "abscissa_inc": step, "z_axis_value": 0.0, "num_pts": len(data), "id1": "a",
        "id2": "NONE", "id3": "NONE", "id4": "NONE", "id5": "NONE",
    }  # fmt: skip
    for name in ("abscissa", "ordinate", "orddenom", "z_axis"):
        d |= {f"{name}_spec_data_type": 0, f"{name}_len_unit_exp": 0, f"{name}_force_unit_exp": 0, f"{name}_temp_unit_exp": 0}
        label = "z_axis_axis" if name == "z_axis" else f"{name}_axis"
        d |= {f"{label}_lab": "NONE", f"{label}_units_lab": "NONE"}
    d |= {"ordinate_spec_data_type": 12, "ordinate_axis_units_lab": "g", "abscissa_spec_data_type": 17}
    return d | kw


@pytest.mark.parametrize("binary", [0, 1])
def test_operando_reads_functions_of_pyuff(tmp_path, binary):
    data = np.random.default_rng(0).normal(size=101)
    path = tmp_path / "a.uff"
    pyuff_write(path, pyuff_function(data, binary), pyuff_function(-data, binary, rsp_node=6))
    (record,) = read(path).records
    np.testing.assert_allclose(record.data / 9.80665, [data, -data], rtol=1e-11)
    assert record.sampling_hz == 512.0
    assert [str(c.dof) for c in record.channels] == ["5-Y", "6-Y"]


@pytest.mark.parametrize("binary", [0, 1])
def test_operando_reads_complex_functions_of_pyuff(tmp_path, binary):
    rng = np.random.default_rng(0)
    data = rng.normal(size=65) + 1j * rng.normal(size=65)
    path = tmp_path / "a.uff"
    kw = {
        "func_type": 4,
        "step": 25 / 128,
        "abscissa_spec_data_type": 18,
        "orddenom_spec_data_type": 13,
        "orddenom_axis_units_lab": "N",
    }
    pyuff_write(path, pyuff_function(data, binary, **kw), pyuff_function(2 * data, binary, rsp_node=6, **kw))
    content = read(path)
    (frf,) = content.frfs
    np.testing.assert_allclose(frf.data[:, 0] / 9.80665, [data, 2 * data], rtol=1e-10, atol=1e-11)
    assert frf.axis.step == 25 / 128
    # pyuff states half the size of complex binary data: it is read by the points, and said.
    assert bool([f for f in content.findings if f.kind == "format"]) == bool(binary)


def test_operando_reads_small_sets_of_pyuff(tmp_path):
    path = tmp_path / "a.uff"
    nodes = {
        "type": 15,
        "node_nums": [3, 4, 9],
        "def_cs": [0] * 3,
        "disp_cs": [0] * 3,
        "color": [1] * 3,
        "x": [1.5, 2, 3],
        "y": [0, 0, 1],
        "z": [1] * 3,
    }
    units = {
        "type": 164, "units_code": 1, "units_description": "feet", "temp_mode": 1, "length": 3.280839895013123, "force": 0.22480894387096,
        "temp": 1.0, "temp_offset": 0.0,
    }  # fmt: skip
    lines = {"type": 82, "trace_num": 1, "n_nodes": 3, "color": 1, "id": "x", "nodes": np.array([3, 4, 9])}
    pyuff_write(path, units, nodes, lines)
    geometry = read(path).geometry
    np.testing.assert_allclose(geometry.coordinates[:, 0], np.array([1.5, 2, 3]) * 0.3048, rtol=1e-6)
    assert geometry.lines == ((3, 4, 9),)

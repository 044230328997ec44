"""Reading UFF: number formats, vendor variants, units, assembly of records and FRFs."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from io_files import ascii58, binary58, head58, text_set, units164
from operando.dof import Dof
from operando.errors import ConfigError, FormatError, MissingError, UnitError
from operando.io import read, read_uff_sets
from operando.io.uff.increments import parse_float, printed_rounding, restore_start, restore_step, tidy_rate
from operando.units import G_STANDARD

WIDE = b"    -1" + b" " * 74 + b"\r\n"
EIGHT = "".join(f"{n:10d}" for n in range(1, 9))
FREQ = (18, "Frequency", "Hz")
NEWTON = (13, "Force", "N")
SEPARATOR = b"\n    -1\n    58\n"


def load(tmp_path, *sets, **kw):
    path = tmp_path / "file.uff"
    path.write_bytes(b"".join(sets))
    return read(path, **kw)


def frf_set(numbers, response=(1, 3), reference=(1, 3), **kw):
    defaults = {"kind": 6, "points": len(numbers) // 2, "function": 4, "abscissa": FREQ, "denominator": NEWTON, "step": 0.5}
    return ascii58(numbers, response=response, reference=reference, **(defaults | kw))


# --- number formats -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [2, 4, 5, 6])
@pytest.mark.parametrize("even", [0, 1])
@pytest.mark.parametrize("form", ["ascii", "<", ">"])
def test_every_number_format(tmp_path, kind, even, form):
    rng = np.random.default_rng(kind)
    n = 11
    values = rng.normal(size=n) + (1j * rng.normal(size=n) if kind in (5, 6) else 0)
    x = np.arange(n) * 0.25
    columns = [values.real, values.imag] if kind in (5, 6) else [values]
    numbers = np.column_stack(columns if even else [x, *columns]).ravel().tolist()
    complex_values = kind in (5, 6)
    kw = {"kind": kind, "points": n, "even": even, "step": 0.25, "function": 4 if complex_values else 1}
    if complex_values:
        kw |= {"abscissa": FREQ, "denominator": NEWTON, "reference": (1, 3)}
    content = load(tmp_path, ascii58(numbers, **kw) if form == "ascii" else binary58(numbers, form, **kw))
    tolerance = {"rtol": 1e-5 if form == "ascii" else 1e-6, "atol": 1e-9} if kind in (2, 5) else {"rtol": 1e-11, "atol": 1e-12}
    if complex_values:
        frf = content.frfs[0]
        np.testing.assert_allclose(frf.data[0, 0], values, **tolerance)
        np.testing.assert_allclose(frf.frequencies_hz, x, rtol=1e-6)
    else:
        record = content.records[0]
        np.testing.assert_allclose(record.data[0], values, **tolerance)
        assert record.sampling_hz == 4.0
        assert record.channels[0].dof == Dof(12, "Z")


def test_single_precision_stays_single(tmp_path):
    content = load(tmp_path, binary58([1.5, 2.5, -3.25], kind=2, points=3))
    assert content.records[0].data.dtype == np.float32
    assert content.records[0].data[0].tolist() == [1.5, 2.5, -3.25]


@pytest.mark.parametrize("tail", [b"\n    -1\n", b"\r\n    -1\r\n", b"    -1\n", WIDE, b"    -1", b"\n    -1", b"", b"\n"])
@pytest.mark.parametrize("eol", [b"\n", b"\r\n"])
def test_ends_of_binary_sets(tmp_path, tail, eol):
    data = [1.0, 2.0, 3.0, 4.0]
    first = binary58(data, eol=eol, tail=b"    -1\r\n" if eol == b"\r\n" else b"\n    -1\n")
    content = load(tmp_path, first, binary58(data[::-1], eol=eol, tail=tail, response=(13, 3)))
    assert content.records[0].data.tolist() == [data, data[::-1]]
    assert all(s.status == "used" for s in content.sets)


@pytest.mark.parametrize("order", ["<", ">"])
def test_payload_that_holds_separators(tmp_path, order):
    text = (SEPARATOR + b"    -1\n    58b    1\n\n    -1\r\n    -1\n") * 3
    text += b" " * (-len(text) % 8)
    numbers = np.frombuffer(text, order + "f8")
    content = load(tmp_path, binary58(numbers.tolist(), order, points=numbers.size), ascii58([1.0] * 4, response=(13, 3)))
    assert content.records[0].data.astype(order + "f8").tobytes() == text
    assert content.records[1].data.tolist() == [[1.0] * 4]
    assert len(content.sets) == 2


@pytest.mark.parametrize("stated", [0, 24, 47, 96, -1, 10**9])
def test_wrong_byte_count_is_read_by_the_points(tmp_path, stated):
    numbers = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    kw = {"kind": 6, "points": 3, "function": 4, "abscissa": FREQ, "denominator": NEWTON, "reference": (1, 3)}
    content = load(tmp_path, binary58(numbers, stated=stated, **kw), binary58(numbers, stated=stated, response=(2, 3), **kw))
    assert content.frfs[0].data[:, 0].tolist() == [[1 + 2j, 3 + 4j, 5 + 6j]] * 2
    assert any("by the points" in f.message for f in content.findings)


@pytest.mark.parametrize(
    "line",
    ["-1.0D+00 2.5d-01-3.0E+00 4.0", "  -1. 0.25-3.00000 4.E0", "-1.0E+000 2.5E-001 -3.0E+000 4.0E+000", "-1.0+000 2.5-001-3.0+000 4"],
)
def test_fortran_numbers(tmp_path, line):
    raw = "\n".join(["    -1", *head58(points=4), line, "    -1", ""]).encode()
    assert load(tmp_path, raw).records[0].data.tolist() == [[-1.0, 0.25, -3.0, 4.0]]


def test_numbers_that_fill_their_columns(tmp_path):
    raw = "\n".join(["    -1", *head58(kind=2, points=4), "1.2345678E+001.2345678E-01-2.345678E+001.0000000E+02", "    -1", ""]).encode()
    np.testing.assert_array_equal(load(tmp_path, raw).records[0].data, [[1.2345678, 0.12345678, -2.345678, 100.0]])


def test_overflow_marks_become_nan(tmp_path):
    raw = "\n".join(["    -1", *head58(points=4), "1.0 ******* -1.#IND 4.0", "    -1", ""]).encode()
    assert np.isnan(load(tmp_path, raw).records[0].data[0]).tolist() == [False, True, True, False]


def test_zeros_that_fill_the_last_line_are_no_data(tmp_path):
    raw = ascii58([1.0, 2.0, 3.0, 4.0, 5.0, 0.0, 0.0, 0.0], points=5)
    assert load(tmp_path, raw).records[0].data.tolist() == [[1.0, 2.0, 3.0, 4.0, 5.0]]


@pytest.mark.parametrize("eol", ["\r\n", "\n", " \n", "    \r\n"])
def test_line_ends_of_text(tmp_path, eol):
    raw = ascii58([1.0, 2.0, 3.0, 4.0]).decode().replace("\n", eol).encode()
    assert load(tmp_path, b"\r\n \n", raw, raw).records[0].data.shape == (2, 4)


def test_one_separator_between_sets_and_none_at_the_end(tmp_path):
    one = ascii58([1.0, 2.0, 3.0, 4.0])
    body = one[len(b"    -1\n") :]
    text = one + body + body[: -len(b"    -1\n")]
    content = load(tmp_path, text)
    assert content.records[0].data.shape == (3, 4)
    assert [s.number for s in content.sets] == [58, 58, 58]


def test_byte_order_mark_and_text_before_the_first_set(tmp_path):
    assert load(tmp_path, b"\xef\xbb\xbf", ascii58([1.0] * 4)).records[0].n_samples == 4
    assert load(tmp_path, b"exported by a program\n", ascii58([1.0] * 4)).records[0].n_samples == 4


@pytest.mark.parametrize(("number", "name"), [(1, "VAX"), (3, "IBM")])
def test_old_floating_point_is_refused(tmp_path, number, name):
    raw = binary58([1.0] * 4).replace(b"b     1     2", b"b     1     %d" % number)
    with pytest.raises(FormatError, match=name):
        load(tmp_path, raw)


def test_non_ascii_headers(tmp_path):
    for encoding in ("utf-8", "latin-1"):
        raw = ascii58([1.0] * 4, unit="m/s²", ids=("Prüfstand µ", *["NONE"] * 4)).decode().encode(encoding)
        channel = load(tmp_path, raw).records[0].channels[0]
        assert (channel.quantity, channel.unit, channel.name) == ("acceleration", "m/s2", "Prüfstand µ")


def test_shifted_columns(tmp_path):
    lines = head58(points=4)
    lines[6] = "   1  1  0  0 sensor  12  -3 NONE  0  0"
    lines[7] = " 4 4 1 0.0 0.01 0.0"
    raw = "\n".join(["    -1", *lines, "1. 2. 3. 4.", "    -1", ""]).encode()
    record = load(tmp_path, raw).records[0]
    assert record.channels[0].dof == Dof(12, "Z", -1)
    assert record.sampling_hz == 100.0


# --- damage ---------------------------------------------------------------------------------------------------------------------


def test_truncated_files_are_refused_and_say_where(tmp_path):
    for raw in (ascii58([1.0] * 40, points=40), binary58([1.0] * 40, points=40)):
        with pytest.raises(FormatError, match="declares 40 points") as error:
            load(tmp_path, raw[:-60])
        assert "file.uff" in str(error.value)


def test_a_damaged_set_beside_good_ones_is_an_error_finding(tmp_path):
    content = load(tmp_path, ascii58([1.0] * 4), ascii58([1.0] * 3, points=4), binary58([2.0] * 4), binary58([1.0] * 2, points=3))
    assert content.records[0].data.tolist() == [[1.0] * 4, [2.0] * 4]
    assert [s.status for s in content.sets] == ["used", "not understood", "used", "not understood"]
    assert sorted((f.kind, f.severity, f.set) for f in content.findings if f.kind == "truncated") == [
        ("truncated", "error", 1),
        ("truncated", "error", 3),
    ]
    assert content.sets[1].raw.startswith(b"    -1\n    58")


def test_more_points_than_declared_are_refused(tmp_path):
    with pytest.raises(FormatError, match="declares 4 points"):
        load(tmp_path, ascii58([1.0] * 8, points=4))


def test_text_mode_transfer_is_named(tmp_path):
    numbers = np.frombuffer(b"ab\ncdefg" * 20, "<f8").tolist()
    raw = binary58(numbers, points=20).replace(b"\n", b"\r\n")
    with pytest.raises(FormatError, match="text mode"):
        load(tmp_path, raw)


@pytest.mark.parametrize("raw", [b"", b"\n\n", b"    -1\n", b"    -1\n    -1\n", b"hello\x00\x01", b"\x89PNG\r\n\x1a\n\x00\x00"])
def test_files_that_are_no_uff(tmp_path, raw):
    with pytest.raises(FormatError):
        load(tmp_path, raw)
    with pytest.raises(MissingError):
        read(tmp_path / "nothing.uff")
    with pytest.raises(MissingError):
        read(tmp_path)


@pytest.mark.parametrize("points", [0, -5])
def test_a_function_without_points(tmp_path, points):
    with pytest.raises(FormatError, match="points"):
        load(tmp_path, ascii58([], points=points))


# --- steps ----------------------------------------------------------------------------------------------------------------------

RATES = [
    1,
    10,
    12.5,
    25,
    30,
    100,
    128,
    200,
    256,
    400,
    512,
    610.3515625,
    1000,
    1024,
    1651.6,
    2048,
    2560,
    4096,
    5120,
    8192,
    10000,
    12800,
    16384,
    20480,
]
RATES += [
    25600,
    32768,
    40960,
    44100,
    48000,
    50000,
    51200,
    65536,
    96000,
    102400,
    131072,
    192000,
    200000,
    204800,
    262144,
    1000000,
    1048576,
    2000000,
]


@pytest.mark.parametrize("rate", RATES)
def test_common_rates_survive_six_digits(rate):
    assert tidy_rate(restore_step(f"{1 / rate:13.5E}", 1000)) == rate


@pytest.mark.parametrize("rate", [1024, 1651.6, 3200, 8192, 44100, 48000, 51200, 65536, 102400])
@pytest.mark.parametrize("block", [512, 1000, 4096, 32768, 65536])
def test_common_line_spacings_survive_six_digits(rate, block):
    step = rate / block
    restored = restore_step(f"{step:13.5E}", block // 2 + 1, True)
    assert restored == pytest.approx(step, rel=1e-14)


def test_the_standard_example_and_rounding():
    assert restore_step("  1.95312E-03", 4096) == 1 / 512
    assert printed_rounding("1.95312E-03") == pytest.approx(5e-9)
    assert parse_float("1.5D-03") == parse_float("1.5-003") == 0.0015
    assert restore_start(" -9.98047E-03", 1 / 51200) == -511 / 51200
    assert restore_start(" -9.99998E-03", 1 / 51200) == -9.99998e-3
    assert restore_start("1.23456E+00", 1.0) == 1.23456


@given(st.floats(1e-7, 1e3), st.integers(2, 10**7))
@settings(max_examples=200, deadline=None)
def test_a_restored_step_prints_as_before(step, points):
    text = f"{step:13.5E}"
    restored = restore_step(text, points)
    assert abs(restored - float(text)) <= printed_rounding(text) * 1.001


# --- units ----------------------------------------------------------------------------------------------------------------------


def test_labels_are_converted(tmp_path):
    content = load(tmp_path, ascii58([1.0] * 4, unit="g"), ascii58([1.0] * 4, quantity=13, unit="lbf", label="Force", response=(1, 3)))
    assert content.records[0].data[:, 0] == pytest.approx([G_STANDARD, 4.4482216152605])
    assert [c.unit for c in content.records[0].channels] == ["m/s2", "N"]
    assert [c.source_unit for c in content.records[0].channels] == ["g", "lbf"]
    assert content.records[0].force_indices == [1]


def test_unit_set_164_is_applied_where_no_label_is(tmp_path):
    silent = {"unit": "NONE", "label": "NONE"}
    content = load(
        tmp_path, units164(1000.0, 1000.0), ascii58([1.0] * 4, **silent), ascii58([1.0] * 4, quantity=13, response=(2, 3), **silent),
        ascii58([1.0] * 4, quantity=15, exponents=(-2, 1, 0), response=(3, 3), **silent), ascii58([1.0] * 4, unit="g", response=(4, 3)),
    )  # fmt: skip
    # The file is in mm and mN: a value divided by the factor is SI; pressure mN/mm² is 1000 Pa.
    assert content.records[0].data[:, 0] == pytest.approx([1e-3, 1e-3, 1e3, G_STANDARD])
    assert not content.findings


def test_what_the_file_does_not_say(tmp_path):
    raw = ascii58([1.0] * 4, unit="NONE")
    content = load(tmp_path, raw)
    assert content.records[0].channels[0].unit == ""
    assert content.records[0].data[0, 0] == 1.0
    (finding,) = content.findings
    assert finding.kind == "missing_unit"
    assert "[units]" in finding.action
    content = load(tmp_path, raw, units={"acceleration": "g"})
    assert content.records[0].data[0, 0] == pytest.approx(G_STANDARD)
    assert not content.findings
    assert load(tmp_path, ascii58([1.0] * 4, unit="m/s2"), units={"acceleration": "g"}).records[0].data[0, 0] == 1.0
    with pytest.raises(UnitError):
        load(tmp_path, raw, units={"acceleration": "lbf"})


def test_a_unit_of_another_quantity_is_a_finding(tmp_path):
    content = load(tmp_path, ascii58([1.0] * 4, unit="Pa"))
    assert {f.kind for f in content.findings} == {"unit_conflict", "missing_unit"}
    assert content.records[0].channels[0].unit == ""


def test_channels_override_the_file(tmp_path):
    sets = [
        ascii58([2.0] * 4, name="ch1", unit="V", quantity=0),
        ascii58([1.0] * 4, response=(13, 3)),
        ascii58([1.0] * 4, response=(14, 3)),
    ]
    channels = {
        "ch1": {"dof": "7-X", "quantity": "acceleration", "unit": "g", "sensitivity": 0.1},
        "13+Z": {"exclude": True, "reason": "cable"},
    }
    content = load(tmp_path, *sets, channels=channels)
    record = content.records[0]
    assert [str(c.dof) for c in record.channels] == ["7-X", "14+Z"]
    assert record.data[0, 0] == pytest.approx(20 * G_STANDARD)
    assert content.sets[1].status == "ignored"
    assert "cable" in content.sets[1].note
    with pytest.raises(ConfigError, match="sensitivty"):
        load(tmp_path, *sets, channels={"ch1": {"sensitivty": 1.0}})


def test_a_dof_label_means_the_sensor_not_the_force(tmp_path):
    force = ascii58([1.0] * 4, quantity=13, unit="N", label="Force")
    content = load(tmp_path, force, ascii58([1.0] * 4), channels={"12+Z": {"exclude": True}})
    assert [c.quantity for c in content.records[0].channels] == ["force"]
    content = load(tmp_path, force, ascii58([1.0] * 4), channels={"12+Z:force": {"exclude": True}})
    assert [c.quantity for c in content.records[0].channels] == ["acceleration"]


# --- records --------------------------------------------------------------------------------------------------------------------


def test_unequal_channels_become_records_of_their_own(tmp_path):
    content = load(tmp_path, ascii58([1.0] * 4), ascii58([1.0] * 8, points=8), ascii58([1.0] * 4, step=0.02))
    assert sorted((r.sampling_hz, r.n_samples) for r in content.records) == [(50.0, 4), (100.0, 4), (100.0, 8)]
    assert {"unequal_rate", "unequal_length"} <= {f.kind for f in content.findings}


def test_uneven_times(tmp_path):
    kw = {"even": 0, "points": 4}
    content = load(tmp_path, ascii58([0.0, 1.0, 0.1, 2.0, 0.2, 3.0, 0.3, 4.0], **kw))
    assert (content.records[0].sampling_hz, content.records[0].data.tolist()) == (10.0, [[1.0, 2.0, 3.0, 4.0]])
    with pytest.raises(FormatError, match="not evenly spaced"):
        load(tmp_path, ascii58([0.0, 1.0, 0.1, 2.0, 0.25, 3.0, 0.3, 4.0], **kw))


def test_milliseconds(tmp_path):
    assert load(tmp_path, ascii58([1.0] * 4, step=2.0, abscissa=(17, "Time", "ms"))).records[0].sampling_hz == 500.0


def test_other_functions_are_named_and_kept(tmp_path):
    psd = ascii58([1.0] * 4, function=9, abscissa=FREQ)
    content = load(tmp_path, ascii58([1.0] * 4), psd, text_set(1858, "something"))
    assert [(s.status, s.number) for s in content.sets] == [("used", 58), ("ignored", 58), ("not understood", 1858)]
    assert "power spectral density" in content.sets[1].title
    assert content.sets[1].raw == psd
    assert [f.kind for f in content.findings] == ["unknown_set"]


def test_memory_is_the_size_of_the_data(tmp_path):
    path = tmp_path / "big.uff"
    n = 250_000
    path.write_bytes(b"".join(binary58(np.zeros(n).tolist(), points=n, response=(i, 3)) for i in range(1, 5)))
    read(path)  # imports are not counted
    tracemalloc.start()
    content = read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1.1 * content.records[0].data.nbytes


def test_raw_sets(tmp_path):
    path = tmp_path / "file.uff"
    sets = [units164(), ascii58([1.0] * 4), binary58([1.0] * 4), text_set(9999, "x")]
    path.write_bytes(b"".join(sets))
    found = read_uff_sets(path)
    assert [raw for _, raw in found] == sets
    assert [info.number for info, _ in found] == [164, 58, 58, 9999]


# --- FRFs -----------------------------------------------------------------------------------------------------------------------


def test_frfs_become_one_matrix(tmp_path):
    rng = np.random.default_rng(3)
    h = rng.normal(size=(3, 2, 5, 2))
    nodes = [(1, 3), (2, 1), (3, -2)]
    sets = [frf_set(h[i, j].ravel().tolist(), nodes[i], nodes[j], unit="g") for i in range(3) for j in range(2) if (i, j) != (2, 1)]
    (frf,) = load(tmp_path, *sets).frfs
    expected = (h[..., 0] + 1j * h[..., 1]) * G_STANDARD
    expected[2, 1] = np.nan
    np.testing.assert_allclose(frf.data, expected, rtol=1e-11)
    assert [str(d) for d in frf.responses] == ["1+Z", "2+X", "3-Y"]
    assert [str(d) for d in frf.references] == ["1+Z", "2+X"]
    assert (frf.quantity, frf.si, frf.axis.step) == ("accelerance", True, 0.5)


@pytest.mark.parametrize(
    ("kw", "quantity", "factor"),
    [
        ({"quantity": 11, "unit": "mm/s"}, "mobility", 1e-3),
        ({"quantity": 8, "unit": "um", "denominator": (13, "Force", "kN")}, "receptance", 1e-9),
        ({"quantity": 0, "unit": "(m/s^2)/N", "denominator": (0, "NONE", "NONE")}, "accelerance", 1.0),
        ({"quantity": 12, "unit": "g/lbf", "denominator": (13, "Force", "NONE")}, "accelerance", G_STANDARD / 4.4482216152605),
        ({"quantity": 1, "unit": "(1/N)*(m/s²)", "denominator": (0, "NONE", "NONE")}, "accelerance", 1.0),
        ({"quantity": 0, "unit": "1/kg", "denominator": (0, "NONE", "NONE")}, "accelerance", 1.0),
        ({"quantity": 8, "unit": "m/N", "denominator": (0, "NONE", "NONE")}, "receptance", 1.0),
    ],
)
def test_frf_quantities(tmp_path, kw, quantity, factor):
    (frf,) = load(tmp_path, frf_set([1.0, 0.0] * 4, **kw)).frfs
    assert frf.quantity == quantity
    assert frf.si
    assert frf.data[0, 0, 0].real == pytest.approx(factor)


def test_frfs_without_units_keep_their_numbers(tmp_path):
    raw = frf_set([1.0, 0.0] * 4, unit="NONE", denominator=(13, "NONE", "NONE"))
    content = load(tmp_path, raw)
    assert not content.frfs[0].si
    assert content.frfs[0].data[0, 0, 0] == 1
    assert content.findings[0].kind == "missing_unit"
    assert load(tmp_path, raw, units={"acceleration": "g"}).frfs[0].si is False
    assert load(tmp_path, raw, units={"acceleration": "g", "force": "lbf"}).frfs[0].data[0, 0, 0].real == pytest.approx(2.2046226, rel=1e-6)
    assert load(tmp_path, units164(1000.0, 1.0), raw).frfs[0].data[0, 0, 0].real == pytest.approx(1e-3)


def test_what_is_no_response_over_force_is_ignored(tmp_path):
    content = load(
        tmp_path, frf_set([1.0, 0.0] * 4), frf_set([1.0, 0.0] * 4, quantity=13, unit="N", denominator=(12, "Acceleration", "m/s2")),
        frf_set([1.0, 0.0] * 4, response=(3, 3), denominator=(12, "Acceleration", "m/s2")),
    )  # fmt: skip
    assert [s.status for s in content.sets] == ["used", "ignored", "ignored"]
    assert "no response over force" in content.sets[1].note


def test_coherence_and_variance(tmp_path):
    ids = ("NONE", "NONE", "NONE", "NONE", "Averages: 10")
    frf = [frf_set([3.0, 4.0] * 4, (i, 3), ids=ids) for i in (1, 2)]
    coherence = ascii58([0.9] * 4, function=6, abscissa=FREQ, quantity=0, unit="NONE", response=(1, 3), reference=(1, 3), step=0.5)
    other = ascii58([0.9] * 4, function=6, abscissa=FREQ, quantity=0, unit="NONE", response=(9, 3), reference=(1, 3), step=0.5)
    content = load(tmp_path, *frf, coherence, other)
    (h,) = content.frfs
    np.testing.assert_allclose(h.coherence[0, 0], 0.9)
    assert np.all(np.isnan(h.coherence[1, 0]))
    np.testing.assert_allclose(h.variance[0, 0], 25 * 0.1 / (0.9 * 10))
    assert (h.averages, content.sets[3].status) == (10.0, "ignored")


def test_multiple_coherence_counts_for_all_references(tmp_path):
    frf = [frf_set([3.0, 4.0] * 4, (1, 3), (j, 3)) for j in (1, 2)]
    multiple = ascii58([0.5] * 4, function=26, abscissa=FREQ, quantity=0, unit="NONE", response=(1, 3), step=0.5)
    assert load(tmp_path, *frf, multiple).frfs[0].coherence.tolist() == [[[0.5] * 4] * 2]


def test_duplicates_and_senses(tmp_path):
    sets = [frf_set([1.0, 0.0] * 4), frf_set([2.0, 0.0] * 4), frf_set([5.0, 0.0] * 4, response=(1, -3), reference=(2, 3))]
    content = load(tmp_path, *sets)
    (frf,) = content.frfs
    assert frf.data[0, :, 0].tolist() == [1.0, -5.0]  # the second sense is turned into the first
    assert content.sets[1].status == "ignored"
    assert [f.kind for f in content.findings] == ["duplicate_set"]


def test_axes_of_different_lines_are_frfs_of_their_own(tmp_path):
    content = load(
        tmp_path,
        frf_set([1.0, 0.0] * 4),
        frf_set([1.0, 0.0] * 5, response=(2, 3)),
        frf_set([1.0, 0.0] * 4, response=(3, 3), quantity=11, unit="m/s"),
    )
    assert [(len(f.axis), f.quantity) for f in content.frfs] == [(4, "accelerance"), (5, "accelerance"), (4, "mobility")]


def test_functions_without_dofs_get_numbers(tmp_path):
    content = load(tmp_path, frf_set([1.0, 0.0] * 4, (0, 0), (0, 0)), frf_set([2.0, 0.0] * 4, (0, 0), (0, 0)))
    assert [str(d) for d in content.frfs[0].responses] == ["1", "2"]
    assert {f.kind for f in content.findings} == {"missing_dof"}


def test_exclude_and_relabel_a_response(tmp_path):
    sets = [frf_set([1.0, 0.0] * 4, (i, 3)) for i in (1, 2, 3)]
    content = load(tmp_path, *sets, channels={"2+Z": {"exclude": True, "reason": "loose"}, "3+Z": {"dof": "30-X"}})
    assert [str(d) for d in content.frfs[0].responses] == ["1+Z", "30-X"]
    assert "loose" in content.sets[1].note


# --- small sets -----------------------------------------------------------------------------------------------------------------


def test_geometry_in_its_unit(tmp_path):
    nodes = text_set(15, *[f"{n:10d}{0:10d}{0:10d}{7:10d}{x:13.5E}{-1.0:13.5E}{2.0:13.5E}" for n, x in ((3, 100.0), (1, -50.0), (2, 0.0))])
    lines = text_set(82, f"{1:10d}{6:10d}{1:10d}", "NONE", "".join(f"{n:10d}" for n in (3, 1, 0, 2, 3, 0)))
    content = load(tmp_path, units164(1000.0), nodes, lines)
    np.testing.assert_allclose(content.geometry.coordinates[:, 0], [0.1, -0.05, 0.0])
    assert content.geometry.nodes == (3, 1, 2)
    assert content.geometry.lines == ((3, 1), (2, 3))
    assert content.geometry.unit_known
    assert not load(tmp_path, nodes).geometry.unit_known
    assert load(tmp_path, nodes, units={"length": "mm"}).geometry.coordinates[0, 0] == pytest.approx(0.1)


def test_nodes_without_indentation(tmp_path):
    geometry = load(tmp_path, text_set(15, "1 0 0 7 1.5 -2.5 3.5", "12 0 0 7 4.5 5.5-6.5")).geometry
    assert geometry.nodes == (1, 12)
    assert geometry.coordinates.tolist() == [[1.5, -2.5, 3.5], [4.5, 5.5, -6.5]]


def test_nodes_in_local_systems(tmp_path):
    systems = text_set(
        18, "         1         0         0         8         1", "TURNED", "  1.0 2.0 3.0  1.0 3.0 3.0", "  1.0 2.0 4.0",
        "         2         1         0         8         1", "ROUND", "  0.0 0.0 1.0  1.0 0.0 1.0", "  0.0 0.0 2.0",
        "         3         2         0         8         1", "BALL", "  0.0 0.0 0.0  1.0 0.0 0.0", "  0.0 0.0 1.0",
    )  # fmt: skip
    rows = [
        (1, 0, 1, 5.0, 6.0, 7.0),
        (2, 1, 1, 1.0, 0.0, 0.0),
        (3, 1, 0, 0.0, 1.0, 2.0),
        (4, 2, 0, 2.0, 90.0, 0.5),
        (5, 3, 0, 1.0, 1.0, 1.0),
    ]
    nodes = text_set(15, *[f"{n:10d}{d:10d}{e:10d}{7:10d}{x:13.5E}{y:13.5E}{z:13.5E}" for n, d, e, x, y, z in rows])
    content = load(tmp_path, systems, nodes)
    # System 1 has its x axis along global y and its z axis along global z, so its y axis along -x.
    expected = [[5, 6, 7], [1, 3, 3], [0, 2, 5], [0, 2, 1.5], [1, 1, 1]]
    np.testing.assert_allclose(content.geometry.coordinates, expected, atol=1e-12)
    assert {f.kind for f in content.findings} == {"local_directions", "local_coordinates", "missing_unit"}
    assert content.sets[0].status == "used"
    flat = text_set(18, "         1         0         0         8         1", "X", "  1.0 2.0 3.0  1.0 3.0 3.0", "  1.0 4.0 3.0")
    assert load(tmp_path, flat, nodes).sets[0].status == "not understood"


def test_nodes_with_d_exponents_and_elements(tmp_path):
    nodes = text_set(
        2411, *[line for n in range(1, 10) for line in (f"{n:10d}{1:10d}{1:10d}{11:10d}", f"   {n}.0D+00   0.0D+00   -1.5D-01")]
    )
    elements = text_set(
        2412, "         1        21         0         0         7         2", "         0         1         1", "         1         2",
        "         2        94         0         0         7         4", "         1         2         3         4",
        "         3        91         0         0         7         3", "         1         2         3",
        "         4       115         0         0         7         8", EIGHT,
        "         5        95         0         0         7         8", EIGHT,
    )  # fmt: skip
    geometry = load(tmp_path, nodes, elements).geometry
    assert geometry.coordinates[4].tolist() == [5.0, 0.0, -0.15]
    assert geometry.lines == ((1, 2),)
    assert geometry.faces == ((1, 2, 3, 4), (1, 2, 3), (1, 3, 5, 7))  # a solid has no face of its own


def mode55(kind, numbers, rows, per_node=3, data_type=2, ids=("NONE",) * 5, mode=1):
    lines = [*ids, "".join(f"{n:10d}" for n in (1, kind, 2, 8, data_type, per_node)), f"{2:10d}{4:10d}{1:10d}{mode:10d}", numbers]
    for node, values in rows:
        lines += [f"{node:10d}", values]
    return text_set(55, *lines)


def test_modes_with_glued_numbers(tmp_path):
    second = [(5, "-1.00000E+00-2.00000E+00 0.00000E+00"), (7, " 1.0D+00 0.5D+00 0.0")]
    content = load(
        tmp_path, mode55(2, "  2.00000E+01  1.00000E+00  2.00000E-02", second, mode=2),
        mode55(2, "  1.00000E+01  1.00000E+00  1.00000E-02", [(5, " 3.00000E+00-4.00000E+00 0.00000E+00"), (7, "1. 1. 0.")]),
    )  # fmt: skip
    (model,) = content.models
    assert model.frequencies_hz.tolist() == [10.0, 20.0]
    assert model.damping_ratios.tolist() == [0.01, 0.02]
    assert [str(d) for d in model.dofs] == ["5+X", "5+Y", "7+X", "7+Y"]  # the directions that are zero everywhere were not measured
    assert model.shapes.tolist() == [[3.0, -1.0], [-4.0, -2.0], [1.0, 1.0], [1.0, 0.5]]
    assert model.scaling == "unscaled"


def test_complex_modes(tmp_path):
    pole = -0.02 * 2 * np.pi * 10 + 1j * 2 * np.pi * 10 * np.sqrt(1 - 0.02**2)
    raw = mode55(3, f"{pole.real:13.5E}{pole.imag:13.5E}" + f"{0.0:13.5E}" * 4, [(5, " 1.0 2.0 3.0 4.0 5.0 6.0")], data_type=5)
    (model,) = load(tmp_path, raw).models
    assert model.frequencies_hz[0] == pytest.approx(10.0, rel=1e-5)
    assert model.damping_ratios[0] == pytest.approx(0.02, rel=1e-4)
    assert model.shapes[:, 0].tolist() == [1 + 2j, 3 + 4j, 5 + 6j]


def test_a_small_set_that_cannot_be_read_is_kept(tmp_path):
    bad = [text_set(15, "not a node"), text_set(55, "NONE"), text_set(2412, "1 2 3"), text_set(82, "x"), text_set(2411, "1 2 3")]
    content = load(tmp_path, ascii58([1.0] * 4), *bad)
    assert [s.status for s in content.sets] == ["used"] + ["not understood"] * 5
    assert [s.raw for s in content.sets[1:]] == bad
    assert {f.kind for f in content.findings} == {"unknown_set"}


def test_a_set_55_cut_off_within_a_node_says_so():
    from operando.errors import FormatError
    from operando.io.uff.shapes import _node_values

    with pytest.raises(FormatError, match="ends after 2 of the 3 values of node 12"):
        _node_values(["        11", " 1.0 2.0 3.0", "        12", " 1.0 2.0"], 3)

"""Text numbers read in columns: the bits of ``float``, and nothing taken for a number that is none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from io_files import ascii58
from operando.errors import FormatError
from operando.io import read
from operando.io.uff.columns58 import EXACT_POWER, GROUP, LINES, LONGEST, columns_of, numbers_in_columns, scaled
from operando.io.uff.split import split_sets

CORPUS = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "uff-corpus"


def bits(values):
    values = np.ascontiguousarray(values, complex if np.iscomplexobj(values) else float)
    return values.ravel().view(np.uint64).tolist()


def lines_of(layout, values, ending="\n"):
    return [("".join(f % v for f, v in zip(layout, row, strict=True)) + ending).encode() for row in values]


@pytest.mark.parametrize("powers", [(-3, 3), (-12, 12), (-99, 98)], ids=str)
@pytest.mark.parametrize("ending", ["\n", "\r\n", "  \n"], ids=repr)
@pytest.mark.parametrize(
    "layout",
    [["%20.12E"] * 4, ["%13.5E"] * 6, ["%20.11e"] * 4, ["%13.5E", "%20.12E", "%20.12E"], ["%21.13E"] * 2, ["%16.1E"]],
    ids=lambda layout: ",".join(dict.fromkeys(layout)),
)
def test_the_bits_are_those_of_float(layout, ending, powers):
    rng = np.random.default_rng(0)
    values = rng.normal(size=(3000, len(layout))) * 10.0 ** rng.uniform(*powers, (3000, len(layout)))
    values[(np.abs(values) < 1e-98) | (np.abs(values) > 9e98)] = 1.5
    values[5], values[7] = 0.0, -0.0
    lines = [line for line in lines_of(layout, values, ending) if len(line) == len(lines_of(layout, values[:1], ending)[0])]
    columns = columns_of(lines[0])
    found = numbers_in_columns(b"".join(lines), columns)
    assert bits(found) == bits([float(word) for word in b"".join(lines).split()])


def test_exact_powers_and_groups_are_the_largest():
    assert 5**EXACT_POWER < 2**53 < 5 ** (EXACT_POWER + 1)  # 10^k has the odd part 5^k
    assert 10**GROUP - 1 < 2**24 < 10 ** (GROUP + 1) - 1


def test_numbers_beside_the_middle_of_two_doubles():
    """Decimal numbers as near to the middle of two doubles as 14 digits come: the worst for the rounding."""
    rng = np.random.default_rng(1)
    whole, power = [], []
    for _ in range(3000):
        p = int(rng.integers(-99, 85))
        double = float(f"{rng.integers(10**13, 10**14)}e{p}")
        middle = (int(np.ldexp(np.frexp(double)[0], 54)) + 1, int(np.frexp(double)[1]) - 54)  # odd number of half units, in powers of two
        numerator = middle[0] * 2 ** max(middle[1], 0) * 10 ** max(-p, 0)
        denominator = 2 ** max(-middle[1], 0) * 10 ** max(p, 0)
        whole.append(numerator // denominator + int(rng.integers(0, 2)))
        power.append(p)
    found = scaled(np.array(whole, float), np.array(power))
    assert bits(found) == bits([float(f"{n}e{p}") for n, p in zip(whole, power, strict=True)])


@pytest.mark.parametrize(
    "word",
    ["  1.5000000000OO0E+00", "  1.50000000000 0E+00", "  1,500000000000E+00", "  1.500000000000F+00", "  1.500000000000E,00",
     " *1.500000000000E+00", "  1.500000000000E+0 ", "                 NaN"],
)  # fmt: skip
def test_a_line_that_deviates_is_not_read_in_columns(word):
    good = lines_of(["%20.12E"] * 2, np.ones((3, 2)))
    bad = good[0][:20] + word.encode().ljust(20)[:20] + b"\n"
    columns = columns_of(good[0])
    assert numbers_in_columns(b"".join(good), columns) is not None
    assert numbers_in_columns(b"".join([good[0], bad, good[1]]), columns) is None


def test_lines_of_any_number_are_read_a_few_at_a_time_and_very_long_ones_by_words():
    lines = lines_of(["%20.12E"] * 4, np.random.default_rng(2).normal(size=(2 * LINES + 3, 4)))
    found = numbers_in_columns(b"".join(lines), columns_of(lines[0]))
    assert bits(found) == bits([float(word) for word in b"".join(lines).split()])
    fits = (LONGEST - 1) // 20
    for numbers, read_so in ((fits, True), (fits + 1, False)):
        assert (columns_of(lines_of(["%20.12E"] * numbers, np.ones((1, numbers)))[0]) is not None) == read_so


@pytest.mark.parametrize("line", [b"1.5E+00\n", b" 1.5E+100\n", b" 15.E+00\n", b" 1.5E+00,\n", b" 1.5\n", b"\n", b" 1.5E+001.5E+00\n"])
def test_lines_without_columns(line):
    assert columns_of(line) is None


@pytest.mark.parametrize(
    "odd",
    [b"        1.0D+00        2.0        -3.E0           4\n", b"   1.000000000000E+00   2.000000000000E+00  -3.000000000000E+00 4.0\n",
     b"   1.000000000000D+00   2.000000000000D+00  -3.000000000000D+00   4.000000000000D+00\n"],
    ids=["free form", "shorter", "D exponents"],
)  # fmt: skip
def test_an_odd_line_among_thousands(tmp_path, odd):
    numbers = np.random.default_rng(2).normal(size=4 * 5000)
    lines = ascii58(numbers, points=numbers.size + 4).splitlines(keepends=True)
    lines.insert(3000, odd)
    (tmp_path / "a.uff").write_bytes(b"".join(lines))
    found = read(tmp_path / "a.uff").records[0].data[0]
    at = 4 * (3000 - 13)
    assert found[at : at + 4].tolist() == [1.0, 2.0, -3.0, 4.0]
    np.testing.assert_allclose(np.delete(found, range(at, at + 4)), numbers, rtol=1e-12)


def test_text_among_thousands_of_lines_is_refused(tmp_path):
    numbers = np.random.default_rng(2).normal(size=4 * 5000)
    lines = ascii58(numbers, points=numbers.size).splitlines(keepends=True)
    lines[3000] = lines[3000].replace(b"E", b"?", 1)
    (tmp_path / "a.uff").write_bytes(b"".join(lines))
    with pytest.raises(FormatError, match="no number"):
        read(tmp_path / "a.uff")


@pytest.mark.parametrize("ending", [b"\n", b"\r\n"])
@pytest.mark.parametrize("blanks", [0, 74], ids=["short separators", "separators as long as the lines"])
@pytest.mark.parametrize("count", [1, 3, 4, 4096, 8192, 8193])
def test_ends_of_sets_are_found_whatever_the_lines_look_like(count, blanks, ending):
    """A separator may have as many blanks behind it as the lines of numbers have characters."""
    numbers = np.random.default_rng(3).normal(size=4 * count)
    one = ascii58(numbers, points=numbers.size)
    text = (one + one).replace(b"    -1\n", b"    -1" + b" " * blanks + b"\n").replace(b"\n", ending)
    sets = split_sets(text)
    assert [(raw.number, raw.problem, raw.notes) for raw in sets] == [(58, "", ())] * 2
    assert all(text[raw.payload[1] :].startswith(b"    -1") and text[raw.payload[1] - 1 : raw.payload[1]] == b"\n" for raw in sets)


def test_a_set_without_numbers_ends_at_once():
    text = ascii58([], points=4)
    (raw,) = split_sets(text)
    assert "declares 4 points" in raw.problem
    assert raw.payload[0] == raw.payload[1]


@pytest.mark.skipif(not CORPUS.is_dir(), reason="the corpus of universal files is not beside the project (../shared)")
def test_files_of_other_programs_read_the_same_by_words(monkeypatch):
    """The reader of words and the reader in columns agree on the ASCII functions of the corpus."""

    def numbers(path):
        content = read(path)
        return [bits(item.data) for item in (*content.records, *content.frfs)]

    files = [CORPUS / name for name in ("Sample_UFF58_ascii.uff", "time-history-not-all-columns-filled.uff")]
    quick = [numbers(path) for path in files]
    assert all(quick)
    monkeypatch.setattr("operando.io.uff.values58.columns_of", lambda line: None)
    assert quick == [numbers(path) for path in files]

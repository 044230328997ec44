"""The comparison of two codes on the same raw files: answers that are equal, off by a little, and another one."""

import copy
import json
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

sys.path.append(str(Path(__file__).resolve().parents[1] / "benchmarks"))

import frozen_answers
from frozen_answers import answers, differences, kept

SUMMARY = {
    "schema": "operando/summary/1",
    "inventory": [{"file": "idle/run1.uff", "sha256": "ab", "sampling_hz": 512.0}],
    "idle": {"modes": [{"frequency_hz": 20.0, "frequency_std_hz": 1e-4,
                        "shape": {"1+Z": 0.5, "2+X": -1e-9}, "shape_std": {"1+Z": 1e-3, "2+X": 1e-3}}]},
    "pairing": [{"scale": [0.1, 0.0], "scale_std": 0.01, "class": "unchanged", "note": ""}],
}  # fmt: skip
DIAGNOSIS = {
    "verdict": "explained",
    "effects": [{"kind": "point_mass", "location": ["1+Z"], "parameters": {"mass": {"value": 2.0, "std": 0.01, "unit": "kg"}}}],
    "ambiguous_with": [],
    "ladder": [{"error_db": 1e-3, "added": None}],
    "notes": ["nothing was touched"],
}


def folder(path, summary=SUMMARY, diagnosis=DIAGNOSIS, covariance=1.0):
    path.mkdir(parents=True)
    (path / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    (path / "diagnosis.json").write_text(json.dumps(diagnosis), encoding="utf-8")
    with h5py.File(path / "model.h5", "w") as model:
        model["idle/covariance"] = covariance * np.eye(3)
        model["stages/seconds"] = np.random.default_rng().normal(size=2)  # left out
    return answers(path)


def changed(value, *path, to):
    """A copy with another value at the path."""
    copied = inner = copy.deepcopy(value)
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = to
    return copied


def test_equal_answers_are_equal_to_the_bit(tmp_path):
    row = differences(folder(tmp_path / "a"), folder(tmp_path / "b", changed(SUMMARY, "schema", to="operando/summary/2")))
    assert (row.level(0.0), row.to_the_bit, row.verdict) == (0, True, "explained")
    assert row.effects == "point_mass@1+Z, alike: none"
    assert row.numbers == 1 + 2 + 4 + 3 + 2 + 1 + 9  # inventory, frequency, shape, scale, mass, ladder, covariance


@pytest.mark.parametrize(
    ("path", "to", "relative", "sigma"),
    [
        (("idle", "modes", 0, "frequency_hz"), 20.0 * (1 + 1e-6), 1e-6, 0.2),
        (("idle", "modes", 0, "shape", "2+X"), 0.0, 2e-9, 1e-6),  # of the largest in the shape
        (("pairing", 0, "scale"), [0.1, 1e-7], 1e-6, 1e-5),
    ],
)
def test_a_number_is_off(tmp_path, path, to, relative, sigma):
    row = differences(folder(tmp_path / "a"), folder(tmp_path / "b", changed(SUMMARY, *path, to=to)))
    assert row.relative == pytest.approx(relative, rel=1e-5)
    assert row.sigma == pytest.approx(sigma, rel=1e-5)
    assert row.at == row.sigma_at
    assert row.at.startswith("summary/")
    assert (row.level(1e-9), row.level(2e-6)) == (1, 0)
    assert (row.level(1e-9, 0.9 * sigma), row.level(1e-9, 1.1 * sigma)) == (1, 0)


def test_numbers_without_a_deviation_are_held_to_the_tolerance(tmp_path):
    before = folder(tmp_path / "a")
    row = differences(before, folder(tmp_path / "b", covariance=1 + 1e-6))
    assert (row.at, row.sigma, row.level(1e-9, sigma=1.0)) == ("model.h5/idle/covariance", 0.0, 1)
    unknown = changed(SUMMARY, "pairing", 0, "scale_std", to=0.0)  # a deviation of zero is none
    row = differences(folder(tmp_path / "e", unknown), folder(tmp_path / "f", changed(unknown, "pairing", 0, "scale", to=[0.1, 1e-7])))
    assert (row.no_std, row.sigma) == (pytest.approx(1e-6), 0.0)
    row = differences(before, folder(tmp_path / "c", diagnosis=changed(DIAGNOSIS, "ladder", 0, "error_db", to=1e-3 + 1e-10)))
    assert row.relative == pytest.approx(1e-10, rel=1e-3)  # of 1 dB
    assert folder(tmp_path / "d", covariance=np.nan).keys() == before.keys()
    assert differences(before, answers(tmp_path / "d")).level(1.0) == 2


@pytest.mark.parametrize(
    ("path", "to"),
    [
        (("verdict",), "partial"),
        (("effects", 0, "kind"), "sensor_mass"),
        (("effects", 0, "location"), ["2+X"]),
        (("effects",), []),
        (("ladder", 0, "added"), {"kind": "point_mass"}),
        (("ladder",), []),
    ],
)
def test_another_answer_differs_whatever_the_tolerance(tmp_path, path, to):
    row = differences(folder(tmp_path / "a"), folder(tmp_path / "b", diagnosis=changed(DIAGNOSIS, *path, to=to)))
    assert row.level(1.0, 100.0) == 2
    assert ("→" in row.verdict, "→" in row.effects) == (path == ("verdict",), path[0] == "effects")


def test_sentences_and_new_values_are_no_answers(tmp_path):
    words = changed(changed(DIAGNOSIS, "notes", to=["nobody touched it"]), "seed", to=1.0)
    row = differences(folder(tmp_path / "a"), folder(tmp_path / "b", diagnosis=words))
    assert (row.sentences, row.new, row.lacking, row.level(0.0), row.to_the_bit) == (1, 1, 0, 0, False)


def test_no_answers_are_not_equal(tmp_path):
    assert differences(answers(tmp_path), answers(tmp_path)).level(1.0) == 2


def test_rows_come_back_from_the_file_and_the_table_counts_them(tmp_path):
    rows = []
    for name, frequency in (("one", 20.0), ("two", 20.0 * (1 + 1e-6)), ("three", 20.1)):
        after = folder(tmp_path / name, changed(SUMMARY, "idle", "modes", 0, "frequency_hz", to=frequency))
        row = differences(answers(tmp_path / "one"), after)
        row.case, row.group = name, "linear"
        rows.append(row)
    file = tmp_path / "rows.csv"
    with file.open("w", encoding="utf-8", newline="") as sink:
        frozen_answers.write(sink, rows, header=True)
    assert kept(file) == rows
    text = frozen_answers.table(rows, 1e-9)
    assert text.startswith(
        "1 of 3 cases equal within 1e-09 (1 to the bit), 1 within 0.0001, 1 differ. Largest difference 0.005: summary/idle/"
    )
    assert "| linear | 1 | 1 | 1 | 0.005 |" in text


def test_sixty_cases_meet_all_kinds_of_data():
    from paired import GROUPS  # of hidden_effects, which frozen_answers has put on the path

    specs = [frozen_answers.parse(name) for name in frozen_answers.NAMES]
    assert [s.name for s in specs] == frozen_answers.NAMES
    assert [s.seed for s in specs] == list(range(9500, 9560))
    assert {(s.family, s.check) for s in specs} == {(f, c) for f in ("frame", "rotor", "panel") for c in (True, False)}
    groups = {frozen_answers.group(vars(s)) for s in specs}
    assert groups == set(GROUPS)
    assert min(sum(s.references == n for s in specs) for n in (1, 3)) >= 20

"""What ``operando run`` prints: tables of modes, what ± is, how operational modes stand to idle ones."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from operando.cli.summary import mode_table, run_text
from operando.data import Frf, ModalModel
from operando.report.class_words import SAME_MAC, class_words, shapes_counted
from operando.results import Results

DOFS = ("1+Z", "2+Z", "3+Z")
PAIRING = [
    {"operating": 0, "idle": 0, "mac": 0.763, "class": "unchanged"},
    {"operating": 1, "idle": 1, "mac": 0.98, "class": "unchanged"},
    {"operating": 2, "idle": None, "mac": None, "class": "unpaired"},
]


def model(hz, std=True):
    n = len(hz)
    return ModalModel(
        np.array(hz), 0.01 * np.ones(n), np.eye(3)[:, :n], DOFS, covariance=np.diag(1e-4 * np.ones(2 * n + 3 * n)) if std else None
    )


def test_operational_modes_stand_beside_idle_ones_with_their_change():
    hybrid = SimpleNamespace(to_dict=lambda: {"pairing": PAIRING})
    rows = mode_table(model([7.939, 20.1, 30.0]), hybrid, model([6.867, 20.0])).splitlines()
    assert rows[0].split("band")[1].split() == ["idle", "Hz", "changed", "by", "%", "MAC", "class"]
    assert rows[1].split()[-6:] == ["+15.61", "0.763", "similar", "shape", "(MAC", "0.76)"]
    assert rows[2].endswith("+0.50  0.980  same shape")
    assert rows[3].endswith("no idle partner")
    assert "%" in mode_table(model([7.0]))


def test_one_reference_is_one():
    frf = Frf(np.ones((3, 1, 2)), [1.0, 2.0], DOFS, DOFS[:1])
    assert run_text(Results("x", idle_frf=frf), Path("nowhere")).startswith("x: FRFs of 3 responses to 1 reference, 1 … 2 Hz.")


def test_modes_are_printed_to_the_digit_of_their_interval():
    std = {"frequencies_hz": np.array([1e-4, 0.2]), "damping_ratios": np.array([5e-6, 2e-3]), "shapes": 0.1 * np.ones((3, 2))}
    first, second = mode_table(ModalModel([9.98765, 61.2], [0.01236, 0.02], np.eye(3)[:, :2], DOFS, std=std)).splitlines()[1:]
    assert first.split() == ["0", "9.9877", "0.0002", "1.236", "0.001"]
    assert second.split() == ["1", "61.2", "0.4", "2.0", "0.4"]
    alone = mode_table(model([9.98765], std=False)).splitlines()[1]
    assert alone.split() == ["0", "9.98765", "1.00"]  # six and three digits where nothing is known of them


def test_what_the_interval_is_stands_once_under_the_tables():
    text = run_text(Results("x", idle=model([6.867]), operating=model([7.9])), Path("nowhere"))
    assert text.count("95 % interval") == 1
    assert text.index("Operational modes") < text.index("± is the 95 % interval. Of idle modes it is that of one measurement")
    assert "Of idle modes" not in run_text(Results("x", operating=model([7.9])), Path("nowhere"))
    assert "95 %" not in run_text(Results("x", operating=model([7.9], std=False)), Path("nowhere"))


@pytest.mark.parametrize(
    ("row", "percent", "words"),
    [
        ({"class": "unchanged", "mac": 0.95}, 15.61, "same shape, frequency +15.6 %"),
        ({"class": "unchanged", "mac": 0.763}, 15.61, "similar shape (MAC 0.76), frequency +15.6 %"),
        ({"class": "unchanged", "mac": 0.763}, None, "similar shape (MAC 0.76)"),
        ({"class": "unpaired", "mac": None}, None, "no idle partner"),
        ({}, None, "not paired"),
    ],
)
def test_shapes_are_the_same_from_a_mac_of_0_9_on(row, percent, words):
    assert class_words(row, percent)[0] == words


def test_shapes_are_counted_as_they_are_named():
    assert shapes_counted(PAIRING) == ["1 with the same shape as idle", "1 with a similar shape (MAC 0.76)", "1 without an idle partner"]
    assert shapes_counted(PAIRING[1:2]) == ["1 with the same shape as idle"]


def test_shapes_are_the_same_from_a_stated_mac_on():
    assert class_words({"class": "unchanged", "mac": SAME_MAC})[0] == "same shape"
    assert class_words({"class": "unchanged", "mac": SAME_MAC - 0.01})[0].startswith("similar shape")


def test_a_floor_beyond_what_decibels_hold_for_is_not_stated():
    from operando.cli.summary import comparison_table

    row = {"error_db": 9.08, "relative_error": 1.05, "misfit": 13.4, "noise_floor_db": 24.32}
    text = comparison_table({"models": {"idle": row}})
    assert "24.32" not in text
    assert "> 3" in text.splitlines()[1]
    assert "no meaning in dB; the reduced χ² says" in text
    near = comparison_table({"models": {"idle": row | {"noise_floor_db": 1.234}}})
    assert "1.23" in near
    assert "no meaning" not in near

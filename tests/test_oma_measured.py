"""OMA on records nobody here made: the practice cases with exact answers, a lattice mast, an offshore turbine."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from operando.data import Channel, TimeRecord
from operando.dof import Dof
from operando.indicators import mac
from operando.oma import fit_oma

SHARED = Path(__file__).resolve().parents[1].parent / "shared"
CASES, DATA = SHARED / "cases", SHARED / "data"


def need(path):
    if not path.exists():
        pytest.skip(f"{path.name}: measured data are not here (../shared)")
    return path


@pytest.mark.parametrize("case", ["p1", "p3", "p4", "p5"])
def test_practice_case(case):
    from operando.io import read

    content = read(need(CASES / case / "operating" / "run1.uff"))
    answer = json.loads((CASES / "answers" / f"{case}.json").read_text())
    model = fit_oma(content.records, band=tuple(answer["band"]))
    hz, zeta = np.array(answer["operating_hz"]), np.array(answer["operating_zeta"])
    inside = (hz > answer["band"][0]) & (hz < answer["band"][1])
    hz, zeta = hz[inside], zeta[inside]
    assert model.n_modes == hz.size == 12
    assert model.details.harmonics_hz.size == 0
    f_error = np.abs(model.frequencies_hz - hz)
    z_error = np.abs(model.damping_ratios - zeta)
    assert np.median(f_error / hz) < 5e-4
    assert np.max(f_error / hz) < 1.5e-3
    assert np.median(z_error / zeta) < 0.07
    misses = np.sum(f_error > 2 * model.frequency_std_hz) + np.sum(z_error > 2 * model.damping_ratio_std)
    assert misses <= 4  # of 24; one in twenty is expected
    assert max(np.max(f_error / model.frequency_std_hz), np.max(z_error / model.damping_ratio_std)) < 4


def test_nonlinear_case_has_no_harmonics():
    from operando.io import read

    content = read(need(CASES / "p2" / "operating" / "run1.uff"))
    model = fit_oma(content.records, band=(3.2, 136.3))
    assert model.details.harmonics_hz.size == 0
    assert 10 <= model.n_modes <= 13


def test_mast_close_pairs():
    data = np.load(need(DATA / "mast" / "lumo.npz"))["data"][:, :18].T
    channels = tuple(Channel(Dof(1 + i // 2, "XY"[i % 2]), "acceleration", "m/s2") for i in range(18))
    model = fit_oma(TimeRecord(data, 1651.6, channels, name="mast"), band=(1.0, 110.0))
    for hz in (2.77, 2.82, 13.54, 15.99, 16.33, 42.6, 66.9, 69.7, 72.1, 92.9, 101.4):
        assert np.min(np.abs(model.frequencies_hz / hz - 1)) < 0.006, hz
    for pair in ((2.77, 2.82), (15.99, 16.33)):
        i, j = (int(np.argmin(np.abs(model.frequencies_hz - hz))) for hz in pair)
        assert i != j
        assert mac(model.shapes[:, [i]], model.shapes[:, [j]])[0, 0] < 0.2
    assert model.n_modes <= 16
    assert model.details.harmonics_hz.size == 0


def test_turbine_parked():
    data = np.loadtxt(need(DATA / "turbine" / "offshore_wind_turbine_parked.csv"), delimiter=",", skiprows=1)
    channels = tuple(Channel(Dof((15, 69, 97)[i // 2], "XY"[i % 2]), "acceleration", "m/s2") for i in range(6))
    model = fit_oma(TimeRecord(9.80665 * data[:, 1:].T, 30.0, channels, name="parked"), band=(0.15, 3.0))
    for hz in (0.23, 0.75, 1.34):
        assert np.min(np.abs(model.frequencies_hz / hz - 1)) < 0.04, (hz, model.frequencies_hz)
    assert model.details.harmonics_hz.size == 0


def test_turbine_whose_rotor_stops():
    data = np.loadtxt(need(DATA / "turbine" / "offshore_wind_data_rotor_stop.csv"), delimiter=",", skiprows=1)
    channels = (Channel(Dof(1, "X"), "acceleration", "m/s2"), Channel(Dof(1, "Y"), "acceleration", "m/s2"))
    model = fit_oma(TimeRecord(9.80665 * data[:, 1:].T, 25.0, channels, name="stopped"), band=(0.1, 2.0))
    i = int(np.argmin(np.abs(model.frequencies_hz - 0.293)))
    assert abs(model.frequencies_hz[i] - 0.293) < 0.002
    assert abs(model.damping_ratios[i] - 0.0024) < 2 * model.damping_ratio_std[i]

"""Idle modes of structures that nobody here measured: a highway bridge through a test file, a bookcase through the API."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from operando.data import Frf
from operando.ema import fit_ema, rigid_body_mass
from operando.frf import check_frf
from operando.pipeline import run

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"
UNITS = '[units]\nacceleration = "g"\nforce = "lbf"\n'


def need(path):
    if not path.exists():
        pytest.skip(f"{path.name}: measured data are not here (../shared)")
    return path


def assert_modes(model, wanted):
    for hz in wanted:
        assert np.min(np.abs(model.frequencies_hz / hz - 1)) < 0.005, (hz, model.frequencies_hz)


@pytest.mark.parametrize("units", ["", UNITS], ids=["no units", "units"])
def test_bridge(units, tmp_path):
    frfs = need(DATA / "bridge" / "dam0.unv")
    text = f'name = "bridge"\n[idle]\nfrfs = ["{frfs.as_posix()}"]\n{units}[analysis]\nband = [1.5, 6.0]\n'
    (tmp_path / "test.toml").write_text(text, encoding="utf-8")
    results = run(tmp_path / "test.toml", tmp_path / "out", until="ema")
    model = results.idle
    assert model is not None
    assert_modes(model, (2.482, 2.958, 3.498, 4.08, 4.17, 4.632))
    kinds = {f.kind for f in (*results.findings, *model.findings)}
    assert "drive_point_sign" not in kinds  # an offset near 0 Hz is no wrong sense
    assert ("missing_unit" in {f.kind for f in model.findings}) is (not units)
    assert model.scaling == ("unit_modal_mass" if units else "unscaled")
    assert model.si is bool(units)


@pytest.fixture(scope="module")
def bookcase():
    data = np.load(need(DATA / "bookcase" / "frf.npz"))["data"]
    return Frf(data.T[:, None, :], np.arange(data.shape[0]) / 16, tuple(f"{i}-Y" for i in range(9)), ("8-Y",))


@pytest.fixture(scope="module")
def bookcase_model(bookcase):
    return fit_ema(bookcase, band=(5.0, 80.0))


def test_bookcase_inverted_channel(bookcase):
    assert [f.dof for f in check_frf(bookcase).findings if f.kind == "inverted"] == ["0-Y"]


def test_bookcase_modes(bookcase_model):
    assert_modes(bookcase_model, (21.4, 50.0, 68.3))


def test_bookcase_mass(bookcase_model):
    assert 24 < rigid_body_mass(bookcase_model, "8-Y").mass_kg < 31

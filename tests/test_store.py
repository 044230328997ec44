"""Results on disk: everything comes back, wrong files are explained."""

from __future__ import annotations

import numpy as np
import pytest

from models import results
from operando.errors import FormatError, MissingError
from operando.store import load_results, save_results


def test_round_trip(tmp_path):
    made = results()
    made.settings = {"band": [1.0, 2.0], "channels": {"1+Z": {"exclude": True}}, "used": {"ema": {"orders": [1, 2]}}}
    made.timings_s = {"frf": 0.5}
    made.left_out = {"diagnose": "not built yet"}
    save_results(made, tmp_path / "model.h5")
    back = load_results(tmp_path)
    assert (back.name, back.settings, back.left_out) == (made.name, made.settings, made.left_out)
    assert back.timings_s == {}  # no result: it differs from run to run
    assert back.findings == made.findings
    assert back.idle.dofs == made.idle.dofs
    for name in ("frequencies_hz", "damping_ratios", "shapes", "covariance"):
        np.testing.assert_array_equal(getattr(back.idle, name), getattr(made.idle, name))
        assert not getattr(back.idle, name).flags.writeable
    lines = np.linspace(5, 100, 37)
    np.testing.assert_array_equal(back.hybrid.frf(lines).data, made.hybrid.frf(lines).data)
    np.testing.assert_array_equal(back.hybrid.frf(lines).variance, made.hybrid.frf(lines).variance)
    assert back.hybrid.to_dict() == made.hybrid.to_dict()
    assert back.check[0].level == made.check[0].level
    np.testing.assert_array_equal(back.check[0].frf.data, made.check[0].frf.data)
    np.testing.assert_array_equal(back.geometry.coordinates, made.geometry.coordinates)


def test_parts(tmp_path):
    save_results(results(), tmp_path / "model.h5")
    back = load_results(tmp_path / "model.h5", only=("hybrid",))
    assert back.hybrid is not None
    assert back.idle is None
    assert back.name == "chain"


def test_wrong_files_are_explained(tmp_path):
    with pytest.raises(MissingError, match=r"no model\.h5"):
        load_results(tmp_path)
    (tmp_path / "model.h5").write_bytes(b"not HDF5")
    with pytest.raises(FormatError, match="cannot be read"):
        load_results(tmp_path)
    from operando.io import write_hdf5

    write_hdf5(tmp_path / "other.h5", {"thing": {"a": 1}})
    with pytest.raises(FormatError, match="no results of operando"):
        load_results(tmp_path / "other.h5")


def test_a_failed_save_leaves_the_old_file(tmp_path):
    made = results()
    path = tmp_path / "model.h5"
    save_results(made, path)
    before = path.read_bytes()
    made.settings = {"function": print}
    with pytest.raises(Exception, match="cannot be stored"):
        save_results(made, path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["model.h5"]

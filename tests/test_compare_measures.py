"""Error measures against values worked out by hand."""

import json
from dataclasses import replace

import numpy as np
import pytest

from operando.compare import compare, compare_all
from operando.data import FrequencyAxis, Frf, ModalModel
from operando.errors import DataError
from operando.results import CheckRun
from structures import Chain


def chain_frf(chain, f, scale=1.0, variance=None, level_noise=None):
    dofs = tuple(f"{i}+Z" for i in range(1, len(chain.hz) + 1))
    data = chain.accelerance(f) * scale
    var = None if variance is None else np.full(data.shape, variance)
    if level_noise is not None:
        data = data + level_noise
    return Frf(data, FrequencyAxis(f), dofs, dofs, variance=var)


def chain_model(chain):
    return ModalModel(chain.hz, chain.zeta, chain.phi, tuple(f"{i}+Z" for i in range(1, len(chain.hz) + 1)), "unit_modal_mass")


def test_factor_two_is_six_db_and_exact_reference_counts_all_lines():
    chain, f = Chain(4), np.linspace(5, 150, 200)
    c = compare(chain_model(chain), chain_frf(chain, f, 0.5))
    assert c.error_db == pytest.approx(20 * np.log10(2))
    assert c.relative_error == pytest.approx(1)
    assert c.misfit is None
    assert c.noise_floor_db is None
    assert c.n_lines == 4 * 4 * 200
    assert [len(c.by_dof), len(c.by_band)] == [4, 8]
    edges = np.array([b["band_hz"] for b in c.by_band])
    assert np.allclose(np.diff(np.log(edges[:, 0])), np.log(150 / 5) / 8)
    json.dumps(c.to_dict(), allow_nan=False)


def test_misfit_of_the_truth_is_one():
    chain, f = Chain(4), np.linspace(5, 150, 500)
    rng = np.random.default_rng(0)
    sd = 1e-3
    noise = sd / np.sqrt(2) * (rng.normal(size=(4, 4, 500)) + 1j * rng.normal(size=(4, 4, 500)))
    c = compare(chain_model(chain), chain_frf(chain, f, variance=sd**2, level_noise=noise))
    assert c.misfit == pytest.approx(1, abs=0.05)
    assert c.model_share == 0


def test_pairs_of_a_model_without_a_standard_deviation_are_compared_by_that_of_the_measurement():
    chain, f = Chain(4), np.linspace(5, 150, 50)
    measured = chain_frf(chain, f, 0.5, variance=1e-6)
    stated = np.full(measured.data.shape, np.nan)
    stated[:, 0] = 0.0
    made = replace(chain_frf(chain, f), variance=stated)
    c = compare(made, measured)
    assert c.n_lines == compare(replace(made, variance=None), measured).n_lines
    assert c.misfit == pytest.approx(c.misfit_meas)
    assert any("no variance on 600 of 800 lines" in n for n in c.notes)


def test_senses_and_missing_dofs():
    chain, f = Chain(4), np.linspace(5, 150, 50)
    measured = chain_frf(chain, f).select("3-Z,1+Z", "2+Z")
    measured = Frf(np.concatenate([measured.data, measured.data[:1]]), f, ("3-Z", "1+Z", "9+Z"), ("2+Z",))
    c = compare(chain_model(chain), measured)
    assert c.error_db == pytest.approx(0, abs=1e-9)
    assert c.relative_error < 1e-12
    assert any("9+Z" in n for n in c.notes)
    with pytest.raises(DataError, match="in common"):
        compare(chain_model(chain), Frf(measured.data[:1], f, ("8+Z",), ("2+Z",)))


def test_lowest_level_judges():
    chain, f = Chain(3), np.linspace(5, 150, 50)
    runs = [CheckRun("a", "10 N", chain_frf(chain, f, 2.0), 10.0), CheckRun("b", "2.5 N", chain_frf(chain, f), 2.5)]
    out = compare_all({"idle": chain_model(chain)}, runs)
    assert (out["judged_on"]["level"], out["judged_on"]["unit"]) == (2.5, "N")
    assert out["models"]["idle"]["error_db"] == pytest.approx(0, abs=1e-9)
    assert out["by_run"][0]["models"]["idle"]["error_db"] == pytest.approx(20 * np.log10(2))
    json.dumps(out, allow_nan=False)

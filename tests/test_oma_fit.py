"""Operational modal analysis of simulated records with known modes; pyOMA-2 as an oracle."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from operando.data import Channel, TimeRecord
from operando.dof import Dof
from operando.errors import ConfigError, DataError, DofError, IdentificationError
from operando.oma import fit_oma
from structures import Chain

FS, BAND = 200.0, (15.0, 80.0)
CHAIN = Chain(5, 1.0, 4e4, np.array([0.008, 0.012, 0.006, 0.01, 0.009]))
"""Five modes between 16 and 62 Hz."""


def simulate(chain, seconds, fs, seed, derivative=(2,), noise=0.01):
    """Stationary responses to white forces at all masses: a piece of a longer periodic response. Derivative 0, 1, 2 for each mass."""
    rng = np.random.default_rng(seed)
    n = int(1.3 * seconds * fs)
    f = np.fft.rfftfreq(n, 1 / fs)
    force = rng.standard_normal((len(chain.hz), f.size)) + 1j * rng.standard_normal((len(chain.hz), f.size))
    force[:, f > 0.45 * fs] = 0
    w, wr = 2 * np.pi * f, 2 * np.pi * chain.hz[:, None]
    modal = (chain.phi.T @ force) / (wr**2 - w**2 + 2j * chain.zeta[:, None] * wr * w)
    power = np.resize(derivative, len(chain.hz))
    lines = (chain.phi @ modal) * (1j * w) ** power[:, None]
    x = np.fft.irfft(lines, n, axis=1)[:, : int(seconds * fs)]
    return x + noise * x.std(axis=1, keepdims=True) * rng.standard_normal(x.shape)


def record(x, fs=FS, quantities=("acceleration",), name="run"):
    quantities = [quantities[i % len(quantities)] for i in range(len(x))]
    return TimeRecord(x, fs, tuple(Channel(Dof(i + 1, "Z"), q, name=f"ch{i + 1}") for i, q in enumerate(quantities)), name=name)


@pytest.fixture(scope="module")
def clean():
    return simulate(CHAIN, 200.0, FS, 1)


@pytest.fixture(scope="module")
def model(clean):
    return fit_oma(record(clean), band=BAND)


def check_modes(model, chain=CHAIN, sigmas=4.0, min_mac=0.995):
    assert model.n_modes == len(chain.hz)
    assert np.all(np.abs(model.frequencies_hz - chain.hz) < sigmas * model.frequency_std_hz)
    assert np.all(np.abs(model.damping_ratios - chain.zeta) < sigmas * model.damping_ratio_std)
    unit = chain.phi / np.linalg.norm(chain.phi, axis=0)
    assert np.min(np.abs(np.sum(unit * model.shapes, axis=0)) ** 2) > min_mac


def test_modes_shapes_and_normalisation(model):
    check_modes(model)
    assert np.all(model.frequency_std_hz < 0.0015 * model.frequencies_hz)
    assert model.scaling == "unscaled"
    np.testing.assert_allclose(np.linalg.norm(model.shapes, axis=0), 1)
    peak = model.shapes[np.argmax(np.abs(model.shapes), axis=0), np.arange(model.n_modes)]
    assert np.all(peak.real > 0)
    np.testing.assert_allclose(peak.imag, 0, atol=1e-12)
    assert model.covariance.shape == (model.n_parameters,) * 2
    assert np.linalg.eigvalsh(model.covariance).min() > -1e-12 * np.linalg.eigvalsh(model.covariance).max()


def test_details_hold_diagram_spectra_and_reasons(model):
    d = model.details
    assert d.stabilization.selected_hz.size == model.n_modes == d.model_orders.size
    assert d.spectra.singular_values.shape[1] == d.spectra.frequencies_hz.size <= 2000
    assert np.all(d.spectra.singular_values[0] >= d.spectra.singular_values[1])
    assert d.harmonics_hz.size == 0
    assert all(r.code and r.reason for r in d.rejected)
    top = d.spectra.frequencies_hz[np.argmax(d.spectra.singular_values[0])]
    assert np.min(np.abs(top / CHAIN.hz - 1)) < 0.02


def test_repeats_bit_by_bit(model, clean):
    again = fit_oma(record(clean), band=BAND)
    np.testing.assert_array_equal(again.shapes, model.shapes)
    np.testing.assert_array_equal(again.covariance, model.covariance)


def test_mixed_quantities_give_displacement_shapes():
    x = simulate(CHAIN, 200.0, FS, 2, derivative=(2, 0, 1, 2, 0))
    check_modes(fit_oma(record(x, quantities=("acceleration", "displacement", "velocity", "acceleration", "displacement")), band=BAND))


def test_several_runs_are_averaged(model):
    runs = [record(simulate(CHAIN, s, FS, k), name=f"r{k}") for k, s in ((1, 200.0), (7, 120.0), (8, 280.0))]
    together = fit_oma(runs, band=BAND)
    check_modes(together)
    ratio = together.damping_ratio_std / model.damping_ratio_std
    assert 0.4 < np.median(ratio) < 0.8  # three times the data: about 1/√3


def test_sense_of_a_run_follows_the_first(clean):
    turned = TimeRecord(
        np.vstack([-clean[:1], clean[1:]]),
        FS,
        (Channel(Dof(1, "Z", -1), "acceleration"), *record(clean).channels[1:]),
    )
    one = fit_oma(record(clean), band=BAND)
    two = fit_oma([record(clean), turned], band=BAND)
    np.testing.assert_allclose(two.frequencies_hz, one.frequencies_hz, rtol=1e-3)
    assert np.min(np.abs(np.sum(one.shapes.conj() * two.shapes, axis=0))) > 0.999


def test_references_and_forces(clean):
    force = Channel(Dof(3, "Z"), "force", name="hammer")
    with_force = TimeRecord(np.vstack([clean, clean[:1]]), FS, (*record(clean).channels, force))
    found = fit_oma(with_force, band=BAND, references="1+Z,4+Z")
    check_modes(found)
    assert len(found.dofs) == 5
    assert found.details.settings["references"] == ["1+Z", "4+Z"]


def test_plain_ssi_agrees_with_pyoma(clean):
    found = fit_oma(record(clean[:, :20000]), band=BAND, weighting="none", second_opinion=True, block_rows=40)
    own = [row for row in found.details.second_opinion if row["frequency_hz"] is not None]
    assert len(own) == 5
    for row, std in zip(own, found.frequency_std_hz, strict=True):
        assert row["agrees"]
        assert row["mac"] > 0.99
        assert abs(row["other_frequency_hz"] - row["frequency_hz"]) < 0.5 * std


def test_pyoma_leaves_no_trace(clean):
    before = np.geterr()
    found = fit_oma(record(clean[:, :8000]), band=BAND, method="ssi-dat", max_order=30, block_rows=20)
    assert np.geterr() == before
    assert logging.getLogger("pyoma2").handlers == []
    assert found.covariance is None
    assert [f.kind for f in found.findings] == ["no_uncertainty"]
    near = np.abs(found.frequencies_hz[:, None] / CHAIN.hz - 1).min(axis=0)
    assert np.all(near < 0.01)


def test_choice_by_hand(clean):
    rejected = fit_oma(record(clean), band=BAND, reject_hz=[CHAIN.hz[2]], uncertainty=False)
    assert rejected.n_modes == 4
    assert "by_hand" in [r.code for r in rejected.details.rejected if abs(r.frequency_hz - CHAIN.hz[2]) < 0.5]
    with pytest.raises(DataError, match="reject_hz 'ab': no numbers"):
        fit_oma(record(clean), band=BAND, reject_hz="ab", uncertainty=False)
    with pytest.raises(IdentificationError, match="by hand"):
        fit_oma(record(clean), band=BAND, select_hz=[190.0], uncertainty=False)


def test_wrong_input_is_refused(clean):
    r = record(clean)
    no_dof = TimeRecord(clean, FS, tuple(Channel(None, "acceleration", name=f"ch{i}") for i in range(5)))
    with pytest.raises(DofError, match="without DOF: ch0"):
        fit_oma(no_dof)
    with pytest.raises(DofError, match="share none"):
        fit_oma([r.select([0, 1]), r.select([2, 3, 4])])
    with pytest.raises(DataError, match="sampled"):
        fit_oma([r, record(clean, 100.0)])
    with pytest.raises(DataError, match="not finite"):
        fit_oma(record(np.where(np.arange(clean.shape[1]) == 7, np.nan, clean)), band=BAND)
    with pytest.raises(DataError, match="constant"):
        fit_oma(record(np.ones((2, clean.shape[1]))), band=BAND)
    with pytest.raises(DataError, match="no operating record"):
        fit_oma([])
    with pytest.raises(ConfigError, match="band"):
        fit_oma(r, band=(10, 150))
    with pytest.raises(ConfigError, match="method"):
        fit_oma(r, method="fdd")
    with pytest.raises(IdentificationError, match="too few"):
        fit_oma(record(clean[:, :300]), band=BAND, block_rows=60)


def test_unusable_channels_are_left_out_and_said(clean):
    spoiled = clean.copy()
    spoiled[1, 5:8] = np.nan
    spoiled[4] = 2.0
    found = fit_oma(record(spoiled), band=BAND)
    assert [str(d) for d in found.dofs] == ["1+Z", "3+Z", "4+Z"]
    assert found.n_modes == 5
    said = [f for f in found.findings if f.kind == "channel_left_out"]
    assert [f.dof for f in said] == ["2+Z", "5+Z"]
    assert "3 samples" in said[0].message
    without = fit_oma(record(clean).select([0, 2, 3]), band=BAND)
    assert np.allclose(found.frequencies_hz, without.frequencies_hz)


def test_changing_operation_is_noted(clean):
    louder = clean * np.where(np.arange(clean.shape[1]) > clean.shape[1] // 2, 3.0, 1.0)
    found = fit_oma(record(louder), band=BAND)
    assert [f.kind for f in found.findings] == ["nonstationary"]
    assert "times as strongly" in found.findings[0].message


def test_details_survive_the_native_format(model, tmp_path):
    from operando.io.hdf5 import read_hdf5, write_hdf5

    write_hdf5(tmp_path / "m.h5", {"model": model})
    back = read_hdf5(tmp_path / "m.h5")["model"]
    f, values = back.details.spectra
    np.testing.assert_array_equal(f, model.details.spectra.frequencies_hz)
    np.testing.assert_array_equal(values, model.details.spectra.singular_values)
    assert back.details.rejected == model.details.rejected
    assert back.details.settings == model.details.settings

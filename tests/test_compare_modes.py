"""Errors by mode: peaks refitted in measurement and model; variances; levels."""

import json
from dataclasses import replace

import numpy as np
import pytest

import operando
from operando.compare import compare, compare_all
from operando.compare.comparison import lowest_level
from operando.compare.peaks import CHANCE, LARGEST_REST, fit_peaks, largest_rest
from operando.data import Frf, ModalModel
from operando.errors import DataError
from operando.results import CheckRun
from operando.scaling import scale_operational
from structures import Chain, modified

LABELS = tuple(f"{i}+Z" for i in range(1, 6))
F = np.linspace(10, 150, 1500)


def truth(chain, noise=0.0, seed=0):
    data = chain.accelerance(F)
    if not noise:
        return Frf(data, F, LABELS, LABELS)
    rng = np.random.default_rng(seed)
    sd = noise * np.sqrt(np.mean(np.abs(data) ** 2))
    return Frf(
        data + sd / np.sqrt(2) * (rng.normal(size=data.shape) + 1j * rng.normal(size=data.shape)), F, LABELS, LABELS,
        variance=np.full(data.shape, sd**2),
    )  # fmt: skip


def model(hz, zeta, phi, covariance=None):
    return ModalModel(hz, zeta, phi, LABELS, "unit_modal_mass", covariance=covariance)


def test_peaks_of_exact_frfs_are_the_modes():
    chain = Chain(5)
    peaks = fit_peaks(chain.accelerance(F).reshape(25, -1), F)
    assert len(peaks) == 5
    assert [p.frequency_hz for p in peaks] == pytest.approx(chain.hz, rel=1e-4)
    assert [p.damping_ratio for p in peaks] == pytest.approx(chain.zeta, rel=0.01)


def test_two_close_modes_under_one_peak_are_told_apart():
    chain = Chain(5)
    chain.hz[2] = chain.hz[1] * 1.01
    peaks = fit_peaks(chain.accelerance(F).reshape(25, -1), F)
    assert [p.frequency_hz for p in peaks[:3]] == pytest.approx(chain.hz[:3], rel=5e-4)


@pytest.mark.parametrize(("of_force", "stated"), [(False, False), (True, False), (False, True), (True, True)])
def test_intervals_of_peaks_cover(of_force, stated):
    """Noise of each pair alike, and noise of the force, in proportion to the FRFs and the same in all pairs."""
    chain, rng = Chain(5), np.random.default_rng(5)
    f = np.linspace(10, 150, 700)
    data = chain.accelerance(f)[:, 0]
    floor = 0.02 * np.sqrt(np.mean(np.abs(data) ** 2))
    off = []
    for _ in range(40):
        noise = rng.normal(size=(2, 5, f.size))
        if of_force:
            noise = 0.05 * np.broadcast_to(noise[:, :1], noise.shape)
            seen, variance = data * (1 + (noise[0] + 1j * noise[1]) / np.sqrt(2)), 0.05**2 * np.abs(data) ** 2
        else:
            seen, variance = data + floor * (noise[0] + 1j * noise[1]) / np.sqrt(2), np.full(data.shape, floor**2)
        for peak in fit_peaks(seen, f, variance=variance if stated else None):
            mode = np.argmin(np.abs(chain.hz - peak.frequency_hz))
            away = peak.frequency_hz - chain.hz[mode]
            if abs(away) < 0.02 * peak.frequency_hz:  # noise makes peaks of its own where the FRFs are small
                off.append([away / peak.frequency_std_hz, (peak.damping_ratio - chain.zeta[mode]) / peak.damping_ratio_std])
    assert len(off) == 200
    for cover in np.mean(np.abs(off) < 1.96, axis=0):
        assert 0.90 <= cover <= 0.98


def test_errors_that_the_fit_absorbs_are_known_from_the_variance():
    """Estimates over whole records err smoothly over their lines: nothing is left of it, and the interval is that of the variance."""
    chain, f = Chain(5), np.linspace(10, 150, 700)
    data = chain.accelerance(f)[:, 0]
    variance = 0.02**2 * np.mean(np.abs(data) ** 2) * np.ones(data.shape)
    unknown, known = fit_peaks(data, f), fit_peaks(data, f, variance=variance)
    for without, peak in zip(unknown, known, strict=True):
        assert without.frequency_std_hz < 1e-2 * peak.frequency_std_hz
        assert 1e-5 < peak.frequency_std_hz / peak.frequency_hz < 1e-3


def test_a_mode_that_drifts_while_a_hammer_roves_is_one_peak(monkeypatch):
    """Rows of points one after the other, frequency and damping by the row; two modes as close stay two (``OWN_POLES``)."""
    rng = np.random.default_rng(2)
    f, shape = np.arange(340.0, 410.0, 0.5), rng.normal(size=45)
    rows = np.repeat(np.linspace(-0.12, 0.12, 9), 5)
    pole = 2 * np.pi * (-(0.0017 + 0.003 * rows**2) * 374 + 1j * (374 + rows))

    def seen(h):
        return h + 1e-3 * np.sqrt(np.mean(np.abs(h) ** 2)) * (rng.normal(size=(2, 45, f.size)).T @ [1, 1j]).T

    drifting = seen(shape[:, None] / (2j * np.pi * f - pole[:, None]))
    [peak] = fit_peaks(drifting, f)
    assert peak.frequency_hz == pytest.approx(374, abs=0.03)
    assert 0.05 < peak.frequency_std_hz < 0.12
    two = rng.normal(size=(45, 2)) @ (
        1 / (2j * np.pi * f - 2 * np.pi * np.array([-0.0017 * 374 + 373.8j, -0.0017 * 374 + 374.2j])[:, None])
    )
    assert len(fit_peaks(seen(two), f)) == 2
    monkeypatch.setattr("operando.compare.peaks.OWN_POLES", 1e-9)
    assert len(fit_peaks(drifting, f)) == 2


def test_errors_by_mode_are_those_put_in():
    chain = Chain(5)
    hz, zeta, phi = chain.hz.copy(), chain.zeta.copy(), chain.phi.copy()
    hz[1] *= 1.02
    zeta[2] *= 1.5
    phi[:, 3] *= np.sqrt(2)
    rows = compare(model(hz, zeta, phi), truth(chain)).by_mode
    assert [r["frequency_hz"] for r in rows] == pytest.approx(chain.hz, rel=1e-3)
    assert [r["frequency_error_percent"] for r in rows] == pytest.approx([0, 2, 0, 0, 0], abs=0.05)
    assert rows[2]["damping_error_percent"] == pytest.approx(50, abs=2)
    assert rows[2]["height_error_db"] == pytest.approx(-20 * np.log10(1.5), abs=0.2)
    assert rows[3]["height_error_db"] == pytest.approx(20 * np.log10(2), abs=0.2)
    assert rows[0]["height_error_db"] == pytest.approx(0, abs=0.1)


def test_a_mode_the_model_lacks_has_no_errors():
    chain = Chain(5)
    keep = [0, 1, 3, 4]
    out = compare(model(chain.hz[keep], chain.zeta[keep], chain.phi[:, keep]), truth(chain)).to_dict()
    assert out["by_mode"][2]["frequency_error_percent"] is None
    assert out["by_mode"][2]["height_error_db"] is None
    assert out["by_mode"][1]["frequency_error_percent"] is not None
    json.dumps(out, allow_nan=False)


def test_noise_makes_no_peaks_and_moves_them_little():
    chain = Chain(5)
    rows = compare(model(chain.hz, chain.zeta, chain.phi), truth(chain, 0.02)).by_mode
    assert [r["frequency_hz"] for r in rows] == pytest.approx(chain.hz, rel=1e-3)
    assert np.max(np.abs([r["damping_error_percent"] for r in rows])) < 10


def test_only_lines_above_the_noise_count_in_db():
    chain = Chain(5)
    data = chain.accelerance(F)
    variance = np.where(np.abs(data) > np.median(np.abs(data)), 1e-12, 1e6)
    wrong = Frf(data * np.where(variance > 1, 100, 1), F, LABELS, LABELS, variance=variance)
    c = compare(model(chain.hz, chain.zeta, chain.phi), wrong)
    assert c.error_db == pytest.approx(0, abs=1e-9)
    assert c.relative_error > 0.5
    noisy = Frf(data, F, LABELS, LABELS, variance=np.full(data.shape, 1e6))
    assert compare(model(chain.hz, chain.zeta, chain.phi), noisy).error_db is None


def test_noise_floor_is_the_error_of_the_truth():
    chain = Chain(5)
    c = compare(model(chain.hz, chain.zeta, chain.phi), truth(chain, 0.01))
    assert c.noise_floor_db == pytest.approx(c.error_db, rel=0.05)


def test_model_variance_counts_and_is_each_models_own():
    chain = Chain(5)
    sd = np.concatenate([1e-4 * chain.hz, 0.01 * chain.zeta, 0.01 * np.abs(chain.phi).T.ravel() + 1e-3])
    rng = np.random.default_rng(3)
    misfits, shares = [], []
    for seed in range(12):
        d = rng.normal(size=sd.size) * sd
        drawn = model(chain.hz + d[:5], chain.zeta + d[5:10], chain.phi + d[10:].reshape(5, 5).T, np.diag(sd**2))
        c = compare(drawn, truth(chain, 0.01, seed))
        misfits.append(c.misfit)
        shares.append(c.model_share)
    assert np.median(misfits) == pytest.approx(1, abs=0.35)
    assert 0.05 < np.median(shares) < 0.95
    exact = model(chain.hz, chain.zeta, chain.phi)
    own = model(chain.hz, chain.zeta, chain.phi, np.diag(sd**2))
    run = CheckRun("a", "1 N rms", truth(chain, 0.01), 1.0)
    out = compare_all({"idle": own, "ofrf": exact}, [run])
    # One comparison has one number: as by itself, whatever else is compared beside it.
    for name, one in (("idle", own), ("ofrf", exact)):
        assert out["models"][name] == compare(one, run.frf).to_dict() == compare_all({"model": one}, [run])["models"]["model"]
    assert out["models"]["ofrf"]["model_share"] == 0
    assert out["models"]["ofrf"]["misfit"] == out["models"]["ofrf"]["misfit_meas"] > out["models"]["idle"]["misfit"]
    assert out["judged_on"] == {"runs": ["a"], "level": 1.0, "unit": "N", "level_name": "1 N rms", "band_hz": None}


def test_several_runs_of_the_lowest_level_are_pooled():
    chain = Chain(5)
    full = truth(chain)
    runs = [
        CheckRun("1a", "10 N rms", full, 10.0),
        CheckRun("1b", "2.5 N rms", full.select(None, "1+Z"), 2.5),
        CheckRun("2b", "2.5 N rms", full.select(None, "3+Z"), 2.5),
    ]
    wrong = modified(chain, mass=(2, 0.1))
    m = model(wrong.hz, wrong.zeta, wrong.phi)
    out = compare_all({"idle": m}, runs)
    together = compare(m, full.select(None, "1+Z,3+Z"))
    assert out["judged_on"]["level"] == 2.5
    assert out["models"]["idle"]["error_db"] == pytest.approx(together.error_db)
    assert out["models"]["idle"]["relative_error"] == pytest.approx(together.relative_error)
    assert [r["frequency_hz"] for r in out["models"]["idle"]["by_mode"]] == pytest.approx([r["frequency_hz"] for r in together.by_mode])
    assert [r["name"] for r in out["by_run"]] == ["1a", "1b", "2b"]


@pytest.mark.parametrize(
    ("levels", "lowest"),
    [({"a": 10.0, "b": 2.5}, "b"), ({"1 N": 10.0, "9 N": 2.5}, "9 N"), ({"full": None, "low": None}, "low"), ({"a": None, "b": None}, "b")],
)
def test_the_lowest_level_is_that_of_the_least_force_and_no_text_is_read(levels, lowest):
    frf = truth(Chain(5))
    assert lowest_level([CheckRun(name, name, frf, force) for name, force in levels.items()]) == lowest


def test_frf_against_frf_on_common_lines():
    chain = Chain(5)
    measured = truth(chain)
    made = Frf(measured.data[:, :, 100:1200:2], F[100:1200:2], LABELS, LABELS)
    c = compare(made.to_quantity("receptance"), measured)
    assert c.n_lines == 25 * 550
    assert c.relative_error < 1e-9
    assert any("not in the model FRFs" in n for n in c.notes)


def test_a_measurement_of_the_opposite_sense_is_noted_once_with_its_consequence():
    chain = Chain(5)
    idle, measured = model(chain.hz, chain.zeta, chain.phi), truth(chain)
    noise = np.full(measured.data.shape, 1e-12)
    other = Frf(-measured.data, F, LABELS, LABELS, variance=noise)
    assert compare(idle, Frf(measured.data, F, LABELS, LABELS, variance=noise)).notes == ()
    [exact] = compare(idle, measured).notes
    assert exact.startswith("the FRFs compared with state neither variance nor coherence and count as exact")
    one = compare(idle, Frf(-measured.data[:, :1], F, LABELS, LABELS[:1], variance=noise[:, :1]))
    [note] = one.notes
    assert note.startswith("force and accelerometer have opposite senses at the measured drive point 1+Z")
    assert "with one of the two reversed" in note
    assert one.relative_error == compare(idle, Frf(measured.data[:, :1], F, LABELS, LABELS[:1])).relative_error
    assert compare(other, other).notes == ()


def test_a_model_is_compared_in_the_band_it_was_fitted_in_unless_another_one_is_named():
    chain = Chain(5)
    whole, measured = model(chain.hz, chain.zeta, chain.phi), truth(chain)
    low, high = 0.8 * chain.hz[0], 0.5 * (chain.hz[1] + chain.hz[2])
    idle = replace(whole, band_hz=(low, high))
    c = compare(idle, measured)
    assert c.n_lines == 25 * int(((low <= F) & (high >= F)).sum())
    assert c.to_dict() | {"notes": []} == compare(idle, measured, (low, high)).to_dict() | {"notes": []}
    assert c.notes[0].startswith(f"compared in the band of the model, {low:.4g} to {high:.4g} Hz")
    assert compare(idle, measured, (F[0], F[-1])).n_lines == compare(whole, measured).n_lines == 25 * F.size
    elsewhere = replace(whole, band_hz=(2 * F[-1], 3 * F[-1]))
    beyond = compare(elsewhere, measured)
    assert beyond.n_lines == 25 * F.size
    assert "all lines are compared" in beyond.notes[0]


def test_a_hybrid_model_is_compared_in_the_band_of_its_operational_modes():
    chain = Chain(5)
    idle, measured = model(chain.hz, chain.zeta, chain.phi), truth(chain)
    low, high = 0.8 * chain.hz[0], 0.5 * (chain.hz[2] + chain.hz[3])
    hybrid = scale_operational(replace(idle, band_hz=(F[0], F[-1])), replace(idle, band_hz=(low, high)))
    assert compare(hybrid, measured).n_lines == 25 * int(((low <= F) & (high >= F)).sum())


def test_one_common_dof_compares_no_shape():
    one = ModalModel([10.0, 20.0], [0.01, 0.01], np.array([[1.0, 1.0], [1.0, -1.0], [0.5, 2.0]]), "1+Z, 2+Z, 3+Z")
    other = ModalModel([10.5, 20.0], [0.01, 0.01], np.array([[1.0, 1.0], [1.0, 1.0]]), "3-Z, 4+Z")
    with pytest.raises(DataError, match=r"only the DOF 3\+Z in common: over one DOF every MAC is 1"):
        operando.mac(one, other)
    with pytest.raises(DataError, match="over one DOF every MAC is 1"):
        operando.mac(other["3-Z"])
    found = operando.compare(one, other)
    assert [(m["first"], m["second"], m["mac"], m["same_shape"]) for m in found.modes] == [(0, 0, None, None), (1, 1, None, None)]
    assert np.isnan(found.mac).all()
    assert found.to_dict()["mac"] is None
    assert found.notes[0] == "compared over 1 common DOF; left out: 1+Z, 2+Z of the first, 4+Z of the second"
    assert "shapes not compared" in repr(found)


def test_dofs_that_only_one_model_has_are_said():
    one = ModalModel([10.0, 20.0], [0.01, 0.01], np.array([[1.0, 1.0], [1.0, -1.0], [0.5, 2.0]]), "1+Z, 2+Z, 3+Z")
    with pytest.warns(UserWarning, match=r"MAC over 2 common DOFs; left out: 3\+Z of the first") as said:
        operando.mac(one, one["1+Z, 2+Z"])
    assert said[0].filename == __file__
    assert operando.compare(one, one["1+Z, 2+Z"]).notes == ("compared over 2 common DOFs; left out: 3+Z of the first",)
    assert operando.compare(one, one).notes == ()


def test_units_that_one_side_does_not_know_are_said():
    model = ModalModel([10.0, 20.0], [0.01, 0.01], np.array([[1.0, 1.0], [1.0, -1.0]]), "1+Z, 2+Z", "unit_modal_mass")
    frf = model.frf(np.arange(5.0, 30.0, 0.1))
    words = "the units of model and measurement are not both known: the errors hold the ratio of their units"
    assert words in operando.compare(model, replace(frf, si=False)).notes
    assert words in operando.compare(replace(model, si=False), frf).notes
    assert words not in operando.compare(model, frf).notes
    assert "the units of the second model are not known" in operando.compare(model, replace(model, si=False)).notes[0]


def _shared_noise(rng, pairs, lines):
    """Noise that all pairs share, of unit power: that of the force, or what a nonlinear location answers."""
    series = (rng.normal(size=lines) + 1j * rng.normal(size=lines)) / np.sqrt(2)
    return np.outer(np.exp(2j * np.pi * rng.random(pairs)), series)


def test_noise_that_the_pairs_share_holds_hardly_a_mode():
    """CHANCE: with the variance stated none, without one in some 200 lines; every seventh line was one before."""
    rng = np.random.default_rng(3)
    f = np.arange(10, 60, 0.25)
    runs = [_shared_noise(rng, 6, f.size) for _ in range(10)]
    assert sum(len(fit_peaks(y, f, variance=np.ones(y.shape))) for y in runs) == 0
    assert sum(len(fit_peaks(y, f)) for y in runs) <= 15


@pytest.mark.parametrize("lines_wide", [0.5, 2.0, 8.0])
def test_a_mode_20_db_above_the_noise_is_found(lines_wide):
    rng = np.random.default_rng(4)
    f = np.arange(10, 60, 0.25)
    pole = 2 * np.pi * 35.1 * (-lines_wide * 0.25 / 2 / 35.1 + 1j)
    found = 0
    for _ in range(20):
        clean = np.outer(np.sign(rng.normal(size=6)), -pole.real / (2j * np.pi * f - pole))
        peaks = fit_peaks(clean + 0.1 * _shared_noise(rng, 6, f.size), f, variance=np.full(clean.shape, 0.01))
        found += any(abs(p.frequency_hz - 35.1) < 0.25 for p in peaks)
    assert found >= 17


def test_a_pole_of_few_lines_must_explain_nearly_all_of_them():
    """Of eleven lines the background leaves eight complex values: t^7 is the chance of one direction, and two a line are tried."""
    assert largest_rest(11, 1) == pytest.approx((CHANCE / 22) ** (1 / 7))
    assert largest_rest(11, 1) < LARGEST_REST == largest_rest(100, 1)

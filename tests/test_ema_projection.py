"""Limits inside the projection and before the polish, on inputs of one or two modes: from where on each counts, and what it does."""

from dataclasses import replace

import numpy as np
import pytest

from operando.data import Frf
from operando.dof import Dof
from operando.ema import fit_ema
from operando.ema.fit import model_dofs
from operando.ema.pair_fits import Grams, Moments, modal_columns
from operando.ema.pairs import Pairs
from operando.ema.polished import SCAN_STEPS, polish_runs, polish_work
from operando.ema.projection import DRIFT_MOST, LEAST_FALL, PEAK_LINES, PEAK_MOST, PEAK_WIDTHS, Poles, basis, largest, project, search_poles
from operando.ema.unit_mass import ModalCovariance

MODE = 100.0


def pairs_of(f, h):
    """Pairs of one reference with a known noise of 1."""
    count = len(h)
    at = np.arange(count)
    return Pairs(f, h, np.ones(h.shape), True, at, np.zeros(count, int), np.c_[at, 0 * at], at)


def spread_seen(zeta, steps, distance):
    """Whether a lone line of 1, so far [Hz] above the mode, is seen by the prior on the residue; lines at ``steps`` Hz from the mode."""
    f = MODE + np.sort(np.unique(np.r_[steps, distance]))
    h = np.where(np.isclose(f, MODE + distance), 1.0 + 0j, 0j)[None]
    most = largest(pairs_of(f, h), Poles(np.array([MODE]), np.array([zeta])))[0, 0]
    assert most in (0.0, pytest.approx(PEAK_MOST * 2 * zeta, rel=0.01))  # over |s²/(2ζω²)| at the resonance
    return most > 0


@pytest.mark.parametrize("times", [0.99, 1.01])
def test_the_size_of_a_mode_is_held_by_the_frf_within_its_width_its_drift_and_the_next_lines(times):
    fine = np.arange(-10.0, 10.0, 0.05)
    broad, sharp = 2 * DRIFT_MOST / PEAK_WIDTHS, 0.5 * DRIFT_MOST / PEAK_WIDTHS
    assert spread_seen(broad, fine, times * PEAK_WIDTHS * broad * MODE) == (times < 1)
    assert spread_seen(sharp, fine, times * DRIFT_MOST * MODE) == (times < 1)


def test_the_size_of_a_mode_is_held_by_a_few_lines_where_they_are_coarse():
    """PEAK_LINES beside the nearest, here all above the mode and each farther off than its width and its drift."""
    coarse = 2.0 * np.arange(PEAK_LINES + 4)
    assert spread_seen(1e-3, coarse, coarse[PEAK_LINES])
    assert not spread_seen(1e-3, coarse, coarse[PEAK_LINES + 1])


@pytest.mark.parametrize("times", [0.95, 1.05])
def test_no_step_is_taken_for_less_than_a_fifth_of_a_standard_deviation(times):
    """LEAST_FALL: damping off by t standard deviations costs t²/2; beyond that the search goes back to the best value."""
    f, true = np.arange(30.0, 300.0, 0.2), Poles(np.array([MODE]), np.array([0.01]), np.array([0.05]), np.array([1e-6]))
    h = np.array([[1.0], [0.5]]) * basis(f, true, 0.0)[0]
    pairs, ends, variance = pairs_of(f, h), (30.0, 300.0), np.full(h.shape, 1e-4)
    before = project(pairs, true, variance, None, ends).coefficients
    now = project(pairs, true, variance, before, ends)
    bent = np.linalg.solve(now.normal, now.gradient.sum(axis=0))  # the priors pull a little
    std = np.sqrt(0.5 / now.normal[1, 1])
    assert np.all(np.abs(bent) < 0.1 * std)
    best = replace(true, hz=true.hz * np.exp(bent[0]), zeta=true.zeta * np.exp(bent[1]))
    off = times * np.sqrt(2 * LEAST_FALL) * std
    start = replace(best, zeta=best.zeta * np.exp(off))
    found, _, fall, _ = search_poles(pairs, start, variance, before, ends, steps=3, max_damping=0.15)
    if times < 1:
        assert found.zeta[0] == start.zeta[0]
    else:
        assert fall == pytest.approx(times**2 * LEAST_FALL, rel=0.02)
        assert abs(np.log(found.zeta[0] / best.zeta[0])) < 0.02 * off


def test_a_step_without_another_behind_it_makes_normal_equations_when_asked_only():
    """What is foreseen of the next step decides; cost and residues are the same with and without."""
    f, true = np.arange(30.0, 300.0, 0.2), Poles(np.array([MODE]), np.array([0.01]), np.array([0.05]), np.array([1e-6]))
    h = np.array([[1.0], [0.5]]) * basis(f, true, 0.0)[0]
    pairs, ends, variance = pairs_of(f, h), (30.0, 300.0), np.full(h.shape, 1e-4)
    before = project(pairs, true, variance, None, ends).coefficients
    start = replace(true, zeta=1.01 * true.zeta)
    found, now, fall, whole = search_poles(pairs, start, variance, before, ends, steps=1, max_damping=0.15)
    assert fall > LEAST_FALL
    assert not now.normal.any()
    full = whole()
    assert full.normal[1, 1] > 0
    for name in ("cost", "a", "b", "shift", "error", "evidence"):
        np.testing.assert_array_equal(getattr(full, name), getattr(now, name))
    again, last, _, _ = search_poles(pairs, start, variance, before, ends, steps=4, max_damping=0.15)
    assert abs(np.log(again.zeta[0] / true.zeta[0])) <= abs(np.log(found.zeta[0] / true.zeta[0]))
    assert last.cost.sum() <= now.cost.sum()


def test_the_covariance_of_modes_is_the_same_by_parts():
    """Carried by the poles, and a block of its own for each shape; some of the modes, and in places among other terms with signs turned."""
    rng = np.random.default_rng(3)
    n, m = 3, 4
    carry, half, own = rng.standard_normal((n * (2 + m), 2 * n)), rng.standard_normal((2 * n, 2 * n)), rng.standard_normal((n, m, m))
    parts = ModalCovariance(carry, half @ half.T, own)
    whole = carry @ half @ half.T @ carry.T
    for r in range(n):
        at = slice(2 * n + r * m, 2 * n + (r + 1) * m)
        whole[at, at] += own[r]
    np.testing.assert_allclose(parts.of_modes(range(n)), whole, rtol=1e-12, atol=1e-12)
    some = [0, 2, n, n + 2, *(2 * n + np.arange(m)), *(2 * n + 2 * m + np.arange(m))]
    np.testing.assert_allclose(parts.of_modes([0, 2]), whole[np.ix_(some, some)], rtol=1e-12, atol=1e-12)
    signs, out = np.where(rng.random(len(carry)) > 0.5, 1.0, -1.0), np.zeros((30, 30))
    places = slice(0, n), slice(5, 5 + n), slice(10, 10 + n * m)
    parts.fill(out, places, signs)
    at = np.r_[0:n, 5 : 5 + n, 10 : 10 + n * m]
    np.testing.assert_allclose(out[np.ix_(at, at)], whole * np.outer(signs, signs), rtol=1e-12, atol=1e-12)
    out[np.ix_(at, at)] = 0
    assert not out.any()


def test_the_scans_for_missing_modes_count_as_work(monkeypatch):
    """SCAN_STEPS: with few modes they are most of a polish; one that is too long for their sake is not begun."""
    f = np.arange(60.0, 140.0, 0.1)
    h = np.array([[1.0], [0.6]]) * basis(f, Poles(np.array([MODE]), np.array([0.01])), 0.0)[0]
    rng = np.random.default_rng(0)
    h = h + 0.01 * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape))
    dofs = (Dof.parse("1+Z"), Dof.parse("2+Z"))
    frf = Frf(h[:, None], f, dofs, dofs[:1], variance=np.full((2, 1, f.size), 2e-4))
    runs, _ = polish_runs(frf, model_dofs(frf), (70.0, 130.0), None)
    work = polish_work(runs, 2, 1)
    scans = SCAN_STEPS * sum(run.frequencies_hz.size * run.responses.shape[0] * run.forces.shape[0] for run in runs)
    monkeypatch.setattr("operando.ema.polished.SCAN_STEPS", 0)
    assert polish_work(runs, 2, 1) == work - scans < 0.5 * work
    monkeypatch.setattr("operando.ema.fit.POLISH_WORK", work - scans / 2)
    assert fit_ema(frf, band=(70.0, 130.0)).details.answer == "polished"
    monkeypatch.setattr("operando.ema.polished.SCAN_STEPS", SCAN_STEPS)
    details = fit_ema(frf, band=(70.0, 130.0)).details
    assert details.answer == "linear"
    assert "two are allowed" in details.answer_reason


@pytest.mark.parametrize("rate", [0.0, 3.0])
@pytest.mark.parametrize("core_only", [True, False])
@pytest.mark.parametrize(
    ("hz", "zeta"),
    [
        (np.linspace(20, 490, 30), 0.004),
        (np.array([5.0, 5.2, 30.0, 400.0]), 1e-4),
        (np.array([20.0, 60.0, 200.0, 380.0]), 0.15),
        (np.array([100.0, 100.02, 101.0, 200.0, 200.001]), 1e-3),
    ],
    ids=["even", "light", "heavy", "close"],
)
def test_sums_over_the_lines_are_those_of_all_products(hz, zeta, core_only, rate):
    """Those that follow from simpler ones as well, against products of the columns one by one, in units of their diagonals."""
    rng = np.random.default_rng(0)
    f = np.linspace(0, 500, 2000)
    columns = modal_columns(f, hz, np.full(hz.size, zeta), rng.standard_normal((3, f.size)) + 0j, rate)
    weight = 1 / rng.uniform(0.1, 2.0, (5, f.size))
    found = Grams(columns, weight, core_only).of(slice(1, 4))
    rows = columns.rows[: columns.core] if core_only else columns.rows
    expected = np.stack([((rows * w) @ rows.conj().T).real for w in weight[1:4]])
    size = np.sqrt(np.einsum("pii->pi", expected))
    assert np.max(np.abs(found - expected) / (size[:, :, None] * size[:, None, :])) < 1e-11
    assert np.array_equal(found, found.transpose(0, 2, 1))


def test_sums_follow_from_simpler_ones_where_their_errors_become_no_larger():
    """From |ω_i² − ω_j²| = 2ω(ζ_iω_i + ζ_jω_j) at the last line on, and for no mode with itself."""
    f, low, zeta = np.linspace(0, 500, 400), 100.0, 0.01
    for times, apart in ((0.99, False), (1.01, True)):
        # x² − low² = 2·500·ζ(low + x)·times, so x = low + 1000·ζ·times
        hz = np.array([low, low + 1000 * zeta * times])
        columns = modal_columns(f, hz, np.full(2, zeta), np.zeros((0, f.size), complex), 0.0)
        over = Moments(columns, np.ones((1, f.size)), True).over
        assert bool(over[0, 1]) == apart
        assert over[0, 0] == over[1, 1] == 0

"""The discrepancy and its standard deviation: 95 % intervals hold the part of the FRFs, or of the responses, that was put in."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import test_diagnosis as chain
from operando.diagnosis import discrepancy
from operando.diagnosis.criteria import LEAST_DISCREPANCY
from operando.diagnosis.discrepancy import discrepancy_row, likely_discrepancy, most_likely
from operando.diagnosis.lines import changes
from operando.diagnosis.posterior import fit, linear_evidence, most_gain, with_discrepancy
from operando.diagnosis.records.hold_out import Discrepancy
from operando.diagnosis.terms import Term
from operando.indicators import INTERVAL
from test_diagnosis_spreads import started


def smooth(apart, shape, rng):
    """Complex noise (…, lines) of unit variance whose correlation falls by e over one unit of ``apart`` (lines,)."""
    out = (rng.standard_normal((*shape, apart.size)) + 1j * rng.standard_normal((*shape, apart.size))) / np.sqrt(2)
    for k, alike in enumerate(np.exp(-np.diff(apart)), 1):
        out[..., k] = alike * out[..., k - 1] + np.sqrt(1 - alike**2) * out[..., k]
    return out


def fitted(alpha, seed, noise=2e-4, common=False):
    """A chain with a mass, fitted where a smooth part of each FRF, or of all FRFs in common, is explained by nothing."""
    w, zeta, *_ = chain.modes()
    at = changes(chain.HZ, chain.BAND, w / 2 / np.pi, zeta)
    one = replace_frf(chain.case, alpha, at, common, seed, noise)
    return fit(one, started(one, Term("point_mass", (1,), (np.log(0.4),))), 0.05)


def replace_frf(make, alpha, at, common, seed, noise):
    measured = chain.measured
    error = smooth(at, (1, 1) if common else (chain.N, 2), np.random.default_rng(1000 + seed))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chain, "measured", lambda *a: (f := measured(*a)) and replace(f, data=f.data * (1 + alpha * error)))
        return make(chain.add_mass, seed=seed, noise=noise)


def deviations(alpha, seeds, **how):
    """What each estimate is off by, over its standard deviation."""
    rows = [discrepancy_row(most_likely(fitted(alpha, seed, **how))) for seed in range(seeds)]
    return np.array([(row["value"] - alpha) / row["std"] for row in rows])


def holds(off):
    return float(np.mean(np.abs(off) < INTERVAL))


@pytest.mark.parametrize("begun", [0.02, 0.1, 0.4])
def test_half_of_the_discrepancy_adds_no_more_than_is_said_without_its_information(begun):
    state = fitted(0.02, 0)
    problem, x = state.problem, state.problem.packed(state.x)
    slopes, residual = problem.derived(x)
    here, _, factor = linear_evidence(problem, residual, slopes, x, begun)
    gain = linear_evidence(problem, residual, slopes, x, begun / 2)[0] - here
    most = most_gain(problem, residual, slopes, x, begun, begun / 2, factor)
    assert gain <= most < gain + 1.4 * x.shared.size  # ½ log |Λ'Λ⁻¹| at most: log 2 of each unknown
    assert (gain > 0) == (most > 0) == (begun > 0.02)


def test_intervals_hold_the_discrepancy():
    off = deviations(0.01, 40)
    assert holds(off) >= 0.9
    assert 0.6 < np.sqrt(np.mean(off**2)) < 1.2


@pytest.mark.slow
@pytest.mark.parametrize(("alpha", "noise"), [(0.03, 2e-3), (0.01, 1e-2)])
def test_95_percent_intervals_hold_90_to_98_percent(alpha, noise):
    assert 0.9 <= holds(deviations(alpha, 300, noise=noise)) <= 0.98


def test_an_error_that_all_pairs_have_in_common_is_counted_once():
    own, common = (np.mean([likely_discrepancy(fitted(0.01, seed, common=one))[1] for seed in range(6)]) for one in (False, True))
    assert common > 1.8 * own


def test_the_most_likely_discrepancy_is_at_the_top_of_the_evidence():
    state = most_likely(fitted(0.01, 3))
    problem = state.problem
    x = problem.packed(state.x)
    slopes, residual = problem.derived(x)
    here, *beside = (linear_evidence(problem, residual, slopes, x, by * state.alpha)[0] for by in (1, 0.99, 1.01))
    assert here > max(beside)


def test_the_most_likely_discrepancy_is_looked_for_once_and_near_that_of_the_fit(monkeypatch):
    asked = []
    monkeypatch.setattr(discrepancy, "linear_evidence", lambda *given: asked.append(given[-1]) or linear_evidence(*given))
    begun = fitted(0.01, 3)
    state = most_likely(begun)
    assert len(asked) < 12
    assert max(np.abs(np.log(asked) - np.log(begun.alpha))) < 0.35
    asked.clear()
    assert discrepancy_row(state)["value"] == state.alpha
    assert not asked


def test_what_validation_lines_ask_for_beyond_is_part_of_the_deviation():
    state = with_discrepancy(fitted(0.005, 0), 0.02)
    row = discrepancy_row(state)
    assert row["value"] == 0.02
    assert row["std"] == pytest.approx(0.015, rel=0.1)


def test_the_least_discrepancy_is_assumed_and_has_no_deviation():
    assert discrepancy_row(most_likely(fitted(0.0, 0))) == {"value": pytest.approx(LEAST_DISCREPANCY), "std": None}


def of_responses(alpha, seed, power=400.0):
    """What a model leaves of two runs with four responses, weighed, where a part of each is off; four responses have that in common."""
    rng = np.random.default_rng(seed)
    hz = np.arange(5.0, 60.0, 0.05)
    w, zeta, *_ = chain.modes()
    at = changes(hz, (5.0, 60.0), w / 2 / np.pi, zeta)
    left = []
    for _ in range(2):
        noise = rng.standard_normal((4, hz.size)) + 1j * rng.standard_normal((4, hz.size))
        left.append(np.abs(noise / np.sqrt(2) + alpha * np.sqrt(power) * smooth(at, (1,), rng)) ** 2)
    return Discrepancy(left, [np.full((4, hz.size), power)] * 2, [(at / 2).astype(int)] * 2).to_dict()


@pytest.mark.parametrize(("alpha", "least", "most"), [(0.0, 0.9, 1.0), (0.1, 0.9, 0.98)])
def test_intervals_hold_the_discrepancy_of_responses(alpha, least, most):
    rows = [of_responses(alpha, seed) for seed in range(200)]
    assert least <= np.mean([abs(row["value"] - alpha) <= INTERVAL * row["std"] * (1 + 1e-9) for row in rows]) <= most


def test_the_discrepancy_of_responses_is_that_of_a_case():
    """Of runs of a case: weighed errors without decays, and stretches by the modes of the idle model."""
    hz = np.arange(10.0, 50.0, 0.1)
    run = SimpleNamespace(responses=np.full((2, hz.size), 3.0), lines=slice(None), variance=np.full((2, hz.size), 0.25), hz=hz)
    weighted = SimpleNamespace(run=run, with_error=lambda error: SimpleNamespace(decayed=lambda: 2 * error))
    idle = SimpleNamespace(frequencies_hz=np.array([20.0]), damping_ratios=np.array([0.01]))
    off = Discrepancy.of(SimpleNamespace(idle=idle, band=(10.0, 50.0)), [weighted], [np.full((2, hz.size), 1.0)])
    assert off.chi_square(0.0) == pytest.approx(4)
    assert off.to_dict()["value"] == pytest.approx(np.sqrt(3 / 36))

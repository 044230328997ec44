"""Spreads of what differs between two days, estimated with each state; steps that follow a bend; what could stand in an effect's place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from operando.diagnosis import posterior
from operando.diagnosis.between import SPREAD_FACTOR, STATED
from operando.diagnosis.criteria import LEAST_DISCREPANCY, UNUSUAL
from operando.diagnosis.days import unlike_days, untouched
from operando.diagnosis.descent import _NOTHING, Descent
from operando.diagnosis.found import Found
from operando.diagnosis.hypotheses import as_channels_were
from operando.diagnosis.posterior import NEAR, approach, fit, likely_alpha, linear_evidence, names, on_validation_lines
from operando.diagnosis.problem import Problem
from operando.diagnosis.rival import score
from operando.diagnosis.scan import LinearScan
from operando.diagnosis.search import RIVALS, Search, search
from operando.diagnosis.slopes import Slopes
from operando.diagnosis.spreads import likely_spreads, log_prior, rescaled
from operando.diagnosis.terms import Term
from operando.diagnosis.verdict import verdict_and_reason
from test_diagnosis import N, add_damper, add_mass, case


def started(one, *terms):
    """The model at rest with effects."""
    return replace(one.forward.start, terms=terms, u=np.zeros(len(one.forward.outside(terms))))


def at_first_order(problem, x, alpha):
    made = problem.predict(x)
    slopes = Slopes(lambda at: (problem.rows(made.shared), problem.rows(made.own)))
    return linear_evidence(problem, problem.residual(made.h), slopes, x, alpha)


def test_the_step_of_the_spreads_is_along_the_slope_of_the_evidence():
    one = case(add_mass, gains=1 + 0.02 * np.random.default_rng(3).standard_normal(N))
    state = fit(one, started(one, Term("point_mass", (1,), (np.log(0.4),))), 0.01)
    problem = state.problem
    x = problem.packed(state.x)
    _evidence, best, factor = at_first_order(problem, x, state.alpha)
    step, promised = likely_spreads(problem, best, factor, most=10.0)
    assert promised > 0
    slope = 0.0
    for number, *_ in one.between.estimated:
        by = np.zeros(step.size)
        by[number] = 1e-3
        up, down = (at_first_order(*rescaled(problem, x, side * by), state.alpha)[0] for side in (1, -1))
        slope += (up - down) / 2e-3 * step[number]
    # the model that is linear has its prior of the factors at its top here: what is promised is half the slope along the step
    assert 0.5 * slope == pytest.approx(promised, rel=2e-3)
    assert not step[[i for i, (name, *_) in enumerate(one.between.groups) if name in STATED]].any()


def test_a_point_stays_what_it_is_in_other_spreads():
    one = case(add_mass)
    rng = np.random.default_rng(0)
    start = started(one, Term("point_mass", (1,), (np.log(0.3),)))
    x = replace(start, d=rng.standard_normal(start.d.size), own=rng.standard_normal(start.own.shape))
    problem = Problem(one, x.terms, one.lines.fit)
    by = 0.3 * rng.standard_normal(one.between.log_factors.size)
    other, there = rescaled(problem, problem.packed(x), by)
    np.testing.assert_allclose(other.predict(there, False).h, problem.predict(problem.packed(x), False).h, rtol=1e-10)
    np.testing.assert_allclose(other.case.between.log_factors, by)
    assert not one.between.log_factors.any()


@pytest.mark.parametrize("gain", [0.004, 0.01, 0.025])
def test_the_spread_of_gains_is_learnt(gain):
    """Eight tests of five sensors: the rms of what is estimated is that of the gains, less what the prior of a factor draws to 1 %."""
    estimated, true = [], []
    for seed in range(8):
        gains = 1 + gain * np.random.default_rng(seed).standard_normal(N)
        one = case(gains=gains, seed=seed)
        state = fit(one, one.forward.start, 0.1)
        state = fit(state.case, state.x, state.alpha, own_spreads=True)
        factors = zip(one.between.groups, state.case.between.log_factors, strict=True)
        estimated.append(next(v for (name, *_), v in factors if name == "sensor"))
        true.append(np.mean((gains - 1) ** 2))
    wanted = 0.5 * np.log(np.mean(true) / 0.01**2)
    # five numbers and a prior of SPREAD_FACTOR: information 2·5 against 1/SPREAD_FACTOR²
    drawn = 10 / (10 + SPREAD_FACTOR**-2)
    assert np.mean(estimated) == pytest.approx(drawn * wanted, abs=0.2)


def test_a_spread_is_within_a_factor_of_two_in_most_laboratories():
    between = case().between
    covariance = np.linalg.inv(between.precision_of_factors())
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), SPREAD_FACTOR, rtol=1e-9)
    assert np.exp(2 * SPREAD_FACTOR) == pytest.approx(2, rel=0.02)
    seen = [i for i, (name, *_) in enumerate(between.groups) if name == "seen"]
    assert covariance[seen[0], seen[1]] == pytest.approx(0.5 * SPREAD_FACTOR**2)


def test_spreads_beyond_all_laboratories_stand_for_something_else():
    one = case()
    state = fit(one, one.forward.start, 0.1)
    by = np.zeros(one.between.log_factors.size)
    by[one.between.estimated[0][0]] = UNUSUAL * SPREAD_FACTOR
    for more, beyond in ((0.99, False), (1.01, True)):
        problem, x = rescaled(state.problem, state.problem.packed(state.x), more * by)
        assert unlike_days(replace(state, problem=problem, x=problem.point(x))) is beyond
        assert log_prior(problem) == pytest.approx(-0.5 * (more * UNUSUAL) ** 2, rel=1e-6)


@pytest.mark.parametrize(("gain", "kept"), [(0.5 * _NOTHING, False), (2.0 * _NOTHING, True)])
def test_a_damping_is_forgotten_at_the_minimum(gain, kept, monkeypatch):
    """A turn that gains less than _NOTHING has ended there: from where spreads have moved it, the way is another."""
    one = case()
    state = fit(one, one.forward.start, 0.1)
    problem, descent = state.problem, Descent()
    x = problem.packed(state.x)
    rows = problem.derived(x)
    now = problem.objective(problem.predict(x, False).h, x, problem.variance(state.alpha))
    monkeypatch.setattr(problem, "objective", lambda h, x, variance: now - gain)
    descent.damping = 1e6
    descent.turn(problem, x, rows, state.alpha, state.factor, rows[0].information(problem.weights(state.alpha)))
    assert (descent.damping > 0) is kept


def test_a_fit_with_spreads_estimated_is_not_made_twice(monkeypatch):
    one = case()
    state = fit(one, one.forward.start)
    as_channels_were([state], lambda text: None)
    asked = []
    monkeypatch.setattr("operando.diagnosis.search.fitted_if_can_be", lambda *given, **how: asked.append(given))
    run = Search(one, lambda text: None, Found(state, state, {(): state}), own_spreads=True)
    assert not run._begin_with(run.start)
    assert run.pool[()] is state.own_spreads is not None
    assert not asked


def test_sensors_together_not_one_of_them_tell_that_spreads_are_beyond_laboratories():
    """An offset of one sensor where shapes are steep is no other laboratory; half of the variance is common to all sensors."""
    one = case()
    state = fit(one, one.forward.start, 0.1)
    seen = [i for i, (name, *_) in enumerate(one.between.groups) if name == "seen"]
    limit = UNUSUAL * SPREAD_FACTOR * np.sqrt(0.5 + 0.5 / len(seen))
    for some, size, beyond in ((seen[:1], 1.2 * UNUSUAL * SPREAD_FACTOR, False), (seen, 0.99 * limit, False), (seen, 1.01 * limit, True)):
        by = np.zeros(one.between.log_factors.size)
        by[some] = size
        problem, x = rescaled(state.problem, state.problem.packed(state.x), by)
        assert unlike_days(replace(state, problem=problem, x=problem.point(x))) is beyond


@pytest.mark.parametrize(("nats", "name"), [(0.99 * RIVALS, "unexplained"), (1.01 * RIVALS, "partial")])
def test_an_effect_beside_differences_that_no_laboratory_has_is_partial_where_the_evidence_is_large(nats, name):
    """Such differences explain most of the error without the effect as well: what it lowers the error by says nothing."""
    one = case(add_mass)
    best = fit(one, started(one, Term("point_mass", (1,), (float(np.log(0.4)),))), 0.1)
    by = np.zeros(one.between.log_factors.size)
    by[one.between.estimated[0][0]] = 1.01 * UNUSUAL * SPREAD_FACTOR
    problem, x = rescaled(best.problem, best.problem.packed(best.x), by)
    far = replace(best, problem=problem, x=problem.point(x))
    empty = fit(one, one.forward.start, 0.1)
    empty.log_evidence += score(far) - score(empty) - nats
    empty._validated = on_validation_lines(far)
    found = Found(far, empty, {})
    verdict, why = verdict_and_reason(found, None)
    assert (verdict, "more than between days" in why) == (name, True)


def test_channels_that_are_as_they_were_tell_that_it_was_no_other_day():
    """Four standard deviations of gains and positions together; modes that moved alike were warmer, and no structure has changed."""
    one = case()
    state = fit(one, one.forward.start, 0.1)
    names = [name for name, *_ in one.between.groups]
    covariance = np.linalg.inv(one.between.precision_of_factors())
    weights = np.zeros(len(names))
    for which in ("sensor", "seen", "driven"):
        mean = np.array([name == which for name in names], float)
        mean /= mean.sum()
        weights += mean / np.sqrt(mean @ covariance @ mean)
    by = -UNUSUAL * covariance @ weights / np.sqrt(weights @ covariance @ weights)
    usual = np.exp(-UNUSUAL * SPREAD_FACTOR)
    known = state.std()[0][one.between.shared["mode"]]
    for less, shift, std, still in (
        (0.99, 1.0, 0.01, False), (1.01, 1.0, 0.01, True), (1.01, 1.01 * usual, 0.01, True), (1.01, 0.99 * usual, 0.01, False),
        (1.01, 1.0, 1.01 / UNUSUAL, False),
    ):  # fmt: skip
        problem, x = rescaled(state.problem, state.problem.packed(state.x), less * by)
        point = problem.point(x)
        point.d[problem.case.between.shared["mode"]] = shift
        times = (known.max() if still or less < 1 or shift < 1 else known.min()) / std
        factor = replace(state.factor, lower=state.factor.lower * times)
        assert untouched(replace(state, problem=problem, x=point, factor=factor)) is still


@pytest.mark.parametrize("size", [5.0, 40.0, 300.0])
def test_the_evidence_of_a_state_does_not_depend_on_its_start(size):
    """A damper from a fifth to five times its size: products of its size and of shapes bend the valley."""
    one = case(add_damper, gains=1 + 0.01 * np.random.default_rng(3).standard_normal(N), warmer=0.002)
    start = started(one, Term("ground_damper", (3,), (np.log(size),)))
    ends = [fit(one, start, alpha, own_spreads=True) for alpha in (0.3, 0.01)]
    for end in ends:
        assert end.log_evidence == pytest.approx(ends[0].log_evidence, abs=0.5)
        assert np.exp(end.terms[0].values[0]) == pytest.approx(40.0, rel=0.02)


@pytest.mark.parametrize("there", [1, 2, 3])
def test_what_could_do_the_same_is_found_about_the_state_that_has_the_effect(there):
    """Springs elsewhere in the place of one of 200 N/m: the two that slopes name first are the two likeliest once all are fitted."""

    def weak(m, c, k):
        k[there, there] += 200

    def spring(i):
        return Term("ground_spring", (i,), (np.log(200.0),))

    one = case(weak, noise=5e-3, kinds=("ground_spring",))
    state = fit(one, started(one, spring(there)), 0.1)
    found, worth = LinearScan(state, held=state.terms[0]).in_place_of(state.terms[0])
    fitted = {i: fit(one, started(one, spring(i)), 0.1).log_evidence for i in range(N) if i != there}
    likeliest = sorted(fitted, key=lambda i: -fitted[i])[:2]
    assert {row.term.places[0] for row in found[:2]} == set(likeliest)
    assert all(row.term.key != state.terms[0].key for row in found)
    assert found[0].evidence < worth  # nothing takes over more than the effect is worth


def test_an_effect_is_told_from_days_that_learn_to_differ():
    """Learnt spreads of the state without effects do not stand for a mass."""
    found = search(case(add_mass, gains=1 + 0.02 * np.random.default_rng(5).standard_normal(N), warmer=0.004))
    best = found.best
    assert [text.split("=")[0] for text in names(best.case, best.terms)] == ["point_mass@2+Z"]
    assert np.exp(best.terms[0].values[0]) == pytest.approx(0.4, abs=3 * np.sqrt(best.covariance[0, 0]) * 0.4)
    assert found.empty.log_evidence < best.log_evidence - 100


def test_the_way_to_a_fit_ends_where_its_turns_no_longer_tell_ways_apart(monkeypatch):
    """What is left to gain when a turn gains less than ``NEAR`` is far below the 20 nats by which ways are told apart."""
    one = case(add_mass, gains=1 + 0.02 * np.random.default_rng(3).standard_normal(N), warmer=0.004)
    start = started(one, Term("point_mass", (1,), (np.log(0.2),)))
    cost, there = approach(one, start)
    monkeypatch.setattr(posterior, "NEAR", 0.0)
    least = approach(one, start, turns=40)[0]
    assert abs(cost - least) < NEAR
    assert np.exp(there.terms[0].values[0]) == pytest.approx(0.4, rel=0.05)


@pytest.mark.parametrize("alpha", [1e-3, 0.03, 0.4])
def test_the_discrepancy_is_that_of_the_least_cost_on_its_whole_grid(alpha):
    one = case(add_mass)
    problem = Problem(one, (), one.lines.fit)
    x = problem.packed(one.forward.start)
    slopes, residual = problem.derived(x)
    factor = linear_evidence(problem, residual, slopes, x, alpha)[2]
    shared, own = slopes.whole()
    for size in (1e-3, 0.1, 1.0):
        left = size * residual
        some = one.lines.telling(left.shape[1])
        power = left[:, some] ** 2 + factor.of_rows(shared[:, some], own[:, some])
        spread = one.lines.spread(one.lines.fit)[:, some]
        grid = np.exp(np.linspace(np.log(LEAST_DISCREPANCY), 0, 80))
        cost = [np.sum(power / (1 + a**2 * spread) + 0.5 * np.log(1 + a**2 * spread)) for a in grid]
        least = grid[int(np.argmin(cost))]
        expected = least * min(1, least / alpha) if least < alpha else least
        assert likely_alpha(problem, left, slopes, factor, alpha) == pytest.approx(expected, rel=1e-12)


def test_a_state_that_is_known_begins_a_search_as_it_is():
    one = case(warmer=0.001)
    alone = fit(one, one.forward.start)
    for known in ((), (alone,)):
        said = []
        search(one, said.append, known=known)
        assert said[0].startswith("  []") == (not known)  # that state's fit is told first


def test_a_candidate_is_looked_at_on_fewer_lines_that_stand_for_all():
    one = case(add_mass)
    state = fit(one, started(one, Term("point_mass", (1,), (np.log(0.4),))), 0.01)
    whole, part = (
        Problem(one, state.terms, at, n) for at, n in ((one.lines.fit, 1), (one.lines.fit[:: one.lines.stride], one.lines.stride))
    )
    made = [linear_evidence(p, *p.derived(p.packed(state.x))[::-1], p.packed(state.x), state.alpha)[2] for p in (whole, part)]
    all_lines, fewer = (np.sqrt(np.diag(f.shared_covariance(whole.values_at))[0]) for f in made)
    assert fewer == pytest.approx(all_lines, rel=0.3)

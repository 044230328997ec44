"""Complex modes in the idle model: told by their poles, against the eigenvalues of the structure's own matrices."""

from dataclasses import replace

import numpy as np
import pytest

from operando import ModalModel, Model, fit_ema
from operando.data.modal_poles import pole_form
from operando.diagnosis import with_complex_modes
from operando.diagnosis.arrow import Factor
from operando.diagnosis.between import SAME_SET_UP
from operando.diagnosis.case import Case
from operando.diagnosis.complex_idle import EARNED, _tied
from operando.diagnosis.force_noise import common_variance, moved_by_force_noise
from operando.diagnosis.found import Found
from operando.diagnosis.idle import NEAR, Idle, Moves
from operando.diagnosis.lines import Lines
from operando.diagnosis.measured import Measured
from operando.diagnosis.poles import poles
from operando.diagnosis.posterior import at_rest, fit
from operando.diagnosis.problem import Problem
from operando.diagnosis.rival import started
from operando.diagnosis.search import Search
from operando.diagnosis.terms import Term
from operando.frf import with_fewer_references
from test_coupling import HZ, chain, whole
from test_diagnosis import BAND, DOFS, N, case, complex_modes, identified, matrices, measured, modes

REFERENCES = (0, 3)


def eigen():
    """Poles and complex shapes of the chain with its dashpot."""
    mass, damping, stiff, *_ = chain()
    state = np.block([[np.zeros((N, N)), np.eye(N)], [-np.linalg.solve(mass, stiff), -np.linalg.solve(mass, damping)]])
    poles, vectors = np.linalg.eig(state)
    up = np.flatnonzero(poles.imag > 0)
    up = up[np.argsort(np.abs(poles[up]))]
    return poles[up], vectors[:N, up]


def told():
    """The exact model of the chain, told by its poles."""
    model = whole()
    form = pole_form(model.terms)
    return model.with_terms(frequencies_hz=form.frequencies_hz, damping_ratios=form.damping_ratios, coupling=form.coupling)


def real_modes():
    """What a fit of real modes to FRFs of the chain with its dashpot would have: no ties."""
    _, _, _, w, phi, modal = chain()
    zeta = np.diag(modal) / 2 / w
    std = np.concatenate([1e-5 * w, 1e-3 * zeta, np.full(N * N, 2e-4)])
    return ModalModel(w / 2 / np.pi, zeta, phi, DOFS, "unit_modal_mass", covariance=np.diag(std**2), band_hz=BAND)


def idle_frf(seed=0, noise=2e-4):
    mass, damping, stiff, *_ = chain()
    return measured(mass, damping, stiff, REFERENCES, noise, seed)


def still(idle):
    """Forces without noise."""
    return np.zeros((idle.f_root.shape[1], 0)), np.zeros((N, idle.shapes.own.shape[2], 0))


def test_a_model_told_by_its_poles_has_them_and_the_same_frfs():
    poles, vectors = eigen()
    model = told()
    np.testing.assert_allclose(model.terms.poles, poles, rtol=1e-9)
    np.testing.assert_allclose(model.frf(HZ).data, whole().frf(HZ).data, rtol=1e-8, atol=1e-12)
    for own, exact in zip(model.complex_shapes.T, vectors.T, strict=True):
        assert abs(np.vdot(own, exact)) ** 2 == pytest.approx(np.vdot(own, own).real * np.vdot(exact, exact).real, rel=1e-9)
    assert min(model.mode_dict(i)["modal_phase_collinearity"] for i in range(N)) < 0.97
    np.testing.assert_allclose(pole_form(model.terms).frequencies_hz, model.frequencies_hz, rtol=1e-12)  # told so already


def test_slopes_of_the_poles_are_differences():
    base = told().terms
    form, step = pole_form(base), 1e-6

    def at(**changed):
        other = pole_form(replace(base, **changed))
        return np.concatenate([other.frequencies_hz, other.damping_ratios])

    def difference(name, change):
        value = getattr(base, name)
        return (at(**{name: value + change}) - at(**{name: value - change})) / 2

    for term in range(N):
        one = step * np.eye(N)[term]
        np.testing.assert_allclose(form.by_terms[:, term] * step, difference("frequencies_hz", one), rtol=1e-5, atol=1e-13)
        np.testing.assert_allclose(form.by_terms[:, N + term] * step, difference("damping_ratios", one), rtol=1e-5, atol=1e-13)
    tie = np.zeros((N, N))
    tie[1, 2] = tie[2, 1] = 1e-3
    ends = [at(coupling=replace(base.coupling, damping=base.coupling.damping + sign * tie)) for sign in (1, -1)]
    np.testing.assert_allclose(2 * form.by_damping[:, 1, 2] * 1e-3, (ends[0] - ends[1]) / 2, rtol=1e-4, atol=1e-12)


def test_idle_takes_the_diagonals_of_the_matrices():
    exact, again = Idle.of(whole(), BAND, DOFS[:1]), Idle.of(told(), BAND, DOFS[:1])
    for name in ("f", "zeta", "between"):
        np.testing.assert_allclose(getattr(again, name), getattr(exact, name), rtol=1e-9, atol=1e-12)


def test_complex_modes_are_fitted_where_real_ones_do_not_explain_the_idle_frfs():
    model = with_complex_modes(real_modes(), idle_frf())
    poles, _ = eigen()
    assert model.coupling is not None
    exact = np.concatenate([np.abs(poles) / 2 / np.pi, -poles.real / np.abs(poles)])
    found = np.concatenate([model.frequencies_hz, model.damping_ratios])
    std = np.concatenate([model.frequency_std_hz, model.damping_ratio_std])
    assert np.abs((found - exact) / std).max() < 4
    assert (std[:N] < 1e-3 * exact[:N]).all()
    truth = whole().frf(HZ, references=[DOFS[i] for i in REFERENCES]).data
    error, before = (
        np.linalg.norm(m.frf(HZ, references=[DOFS[i] for i in REFERENCES]).data - truth) / np.linalg.norm(truth)
        for m in (model, real_modes())
    )
    assert error < 0.002 < 0.05 < before
    assert any(f.kind == "complex_modes" and "falls from" in f.message for f in model.findings)
    assert with_complex_modes(model, idle_frf()) is model  # once is enough


def test_modes_outside_the_band_stay_as_they_were_known():
    band = BAND[0], 46.0
    real = replace(real_modes(), band_hz=band, in_band=np.arange(N) < N - 1)
    model = with_complex_modes(real, idle_frf())
    assert model.coupling is not None
    held = Idle.of(model, band, DOFS[:1])  # its own value; the pole has what ties it to the others
    assert held.f[-1] == pytest.approx(real.frequencies_hz[-1], rel=1e-9)
    assert model.frequency_std_hz[-1] >= real.frequency_std_hz[-1]
    assert model.damping_ratio_std[-1] >= real.damping_ratio_std[-1]


def test_intervals_of_the_complex_poles_cover():
    """With noise above the least discrepancy a model is allowed (0.05 % of the FRFs, at a peak 1 % of their rms)."""
    poles, _ = eigen()
    exact = np.concatenate([np.abs(poles) / 2 / np.pi, -poles.real / np.abs(poles)])
    inside = []
    for seed in range(8):
        model = with_complex_modes(real_modes(), idle_frf(seed, 1e-2))
        found = np.concatenate([model.frequencies_hz, model.damping_ratios])
        std = np.concatenate([model.frequency_std_hz, model.damping_ratio_std])
        inside.append(np.abs(found - exact) < 1.96 * std)
    assert 0.88 <= np.mean(inside) <= 0.995  # of 80 values: 95 % ± 3 standard deviations of what is counted


@pytest.mark.parametrize("off", [0.0, 0.004])
def test_real_modes_stay_real(off):
    """Also where the model is plainly wrong: real modes fitted again explain as much, and ties have to earn ``EARNED`` nats."""
    assert EARNED > 0
    mass, stiff = matrices()
    model = identified()
    model = model.with_terms(frequencies_hz=model.frequencies_hz * (1 + off))
    assert with_complex_modes(model, measured(mass, modes()[3], stiff, REFERENCES, 2e-4, 0)) is model


def test_real_modes_stand_where_complex_ones_cannot_be_looked_for():
    """Every line lacks a pair: nothing can be fitted to all pairs at once."""
    frf = idle_frf()
    data = frf.data.copy()
    lines = np.arange(data.shape[2])
    for response in range(N):
        data[response, :, lines % N == response] = np.nan
    model = with_complex_modes(real_modes(), replace(frf, data=data))
    assert model.coupling is None
    assert any(f.kind == "complex_modes_not_tried" and f.consequence == "the idle model has real modes" for f in model.findings)


def test_real_modes_stand_where_the_covariance_of_complex_ones_fails(monkeypatch):
    monkeypatch.setattr("operando.diagnosis.complex_idle.moved_by_force_noise", lambda state: np.linalg.cholesky(-np.eye(3)))
    model = with_complex_modes(real_modes(), idle_frf())
    assert model.coupling is None
    assert [f.kind for f in model.findings] == ["complex_modes_not_tried"]


def test_a_line_that_is_exactly_zero_leaves_the_variance_of_the_others():
    frf = idle_frf()
    silent = frf.data.copy()
    silent[0, :, 3] = 0
    one, other = (
        Lines(replace(frf, data=d, variance=None).to_quantity("receptance"), np.array([20.0]), np.array([0.01])) for d in (frf.data, silent)
    )
    assert np.isfinite(other.variance).all()
    assert other.variance[-1] == pytest.approx(one.variance[-1], rel=1e-3)


def test_a_model_without_scale_stays_as_it_is():
    model = replace(real_modes(), scaling="unscaled")
    assert with_complex_modes(model, idle_frf()) is model


def test_each_peak_has_lines_that_are_fitted_and_lines_that_validate():
    frf, (w, zeta, *_) = idle_frf(), modes()
    f = w / 2 / np.pi
    lines = Lines(frf.to_quantity("receptance"), f, zeta, 160, 1.0, between=True)
    w = lines.w / 2 / np.pi
    assert not set(lines.fit) & set(lines.validation)
    assert lines.validation.size == 50
    for hz, width in zip(f, 3 * zeta * f, strict=True):
        near = np.abs(w - hz) < width
        assert near[lines.fit].sum() > near[lines.validation].sum() > 0


@pytest.mark.parametrize(("effect", "term"), [
    ("global_stiffness=change:-0.2", Term("global_stiffness", (), (np.log(0.2),), -1)),
    ("global_damping=change:-0.6", Term("global_damping", (), (np.log(0.4),))),
])  # fmt: skip
def test_all_stiffness_and_all_damping_take_the_lag_of_shapes_along(effect, term):
    """Damping that ties modes to what lies outside the band, over the stiffness there: as in the model that is handed out."""
    one = case(lag=0.4)
    forward, w = one.forward, one.lines.w[one.lines.fit]
    model = _tied(identified(), one.idle, still(one.idle))
    responses, references = ([DOFS[i] for i in at] for at in (forward.responses, forward.references))
    h = np.moveaxis(forward.predict(replace(forward.start, terms=(term,)), w, derivatives=False).h, 0, 2)
    wanted = Model(model).add(effect).frf(w / 2 / np.pi, responses, references, "receptance").data
    np.testing.assert_allclose(h, wanted, rtol=1e-6, atol=1e-9 * np.abs(wanted).max())
    unlagged = Model(model.with_terms(coupling=replace(model.coupling, lag=0 * model.coupling.lag))).add(effect)
    without = unlagged.frf(w / 2 / np.pi, responses, references, "receptance").data
    assert np.abs(without - wanted).max() > 1e-3 * np.abs(wanted).max()  # the lag is seen in this case


def test_residual_terms_near_the_band_are_tied_as_modes():
    band = BAND[0], float(modes()[0][-1] / 2 / np.pi) - 1
    known = complex_modes(Idle.of(identified(residual=1), band, [DOFS[i] for i in REFERENCES]), 0.3)
    assert known.modes.size == N - 1
    near = known.with_near(band)
    assert near.modes.size == N
    assert near.with_near(band) is near
    assert known.with_near((band[0], band[1] / NEAR)) is known  # farther off it only follows
    lines = 2 * np.pi * np.linspace(*band, 40)
    before, after = (Case(idle, idle_frf(), band, correlated=1.0).forward for idle in (known, near))
    at_rest = before.predict(before.start, lines, derivatives=False).h
    np.testing.assert_allclose(after.predict(after.start, lines, derivatives=False).h, at_rest, rtol=1e-9)
    driven = np.flatnonzero(known.driven)
    assert known.loose(driven, band).modes.size == N
    assert known.loose(driven, band, complex_modes=False).modes.size == N - 1
    # and stay tied in the model that is told
    tied = replace(near, between=np.full(near.between.size, 0.1))
    again = Idle.of(_tied(identified(residual=1), tied, still(tied)), band, [DOFS[i] for i in REFERENCES])
    np.testing.assert_allclose(again.between, tied.between, rtol=1e-6)


def moved(idle, g):
    """The model at g, as known as it was."""
    extra = idle.shapes.own.shape[2]
    known = Factor(np.tile(np.eye(extra), (N, 1, 1)), np.zeros((N, extra, g.size)), np.eye(g.size))
    return idle.moved(g, np.zeros((N, extra)), known)


def test_poles_move_in_proportion_where_ties_are_hardly_known():
    straight = at_rest(Idle.of(real_modes(), BAND, DOFS[:1]), idle_frf(noise=2e-3), BAND).idle
    idle = replace(straight, bend=None)
    form, slopes = poles(idle)
    std, size = np.linalg.norm(slopes, axis=1), slopes.shape[1]
    at_start = np.concatenate([form.frequencies_hz, form.damping_ratios])
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((size, size)))[0]

    def off(model, *way):
        """Of the poles, beyond what is in proportion to the way, in their standard deviations."""
        for g in way:
            model = moved(model, g)
        there = poles(model)[0]
        return (np.concatenate([there.frequencies_hz, there.damping_ratios]) - at_start - slopes @ sum(way)) / std

    own = np.tile(np.eye(straight.shapes.own.shape[2]), (N, 1, 1))
    for seed in range(6):
        g = 0.5 * np.random.default_rng(seed).standard_normal(size)
        held = off(straight, g)
        assert np.abs(held).max() < 0.2 * np.abs(off(idle, g)).max()
        turned = poles(moved(straight.along(turn, own), turn.T @ g))[0]  # the same unknowns by other names
        np.testing.assert_allclose(turned.frequencies_hz, at_start[:N] + (slopes @ g + std * held)[:N], rtol=1e-12)
    assert np.abs(off(straight, 0.5 * g, 0.5 * g)).max() == pytest.approx(np.abs(held).max(), rel=0.3)  # on along the same way


def test_a_change_of_all_stiffness_is_as_sure_as_the_poles_are():
    """A straight way of frequencies and ties leaves a bias of -0.8 standard deviations, three times as large as those of the poles."""
    mass, damping, stiff, *_ = chain()
    off = {False: [], True: []}
    for seed in range(8):
        frf = [measured(mass, damping, k, (0,), 2e-3, 2 * seed + i) for i, k in enumerate((stiff, 1.01 * stiff))]
        rest = at_rest(Idle.of(real_modes(), BAND, DOFS[:1]), frf[0], BAND)
        for straight, rows in off.items():
            idle = rest.idle if straight else replace(rest.idle, bend=None)
            case_of = Case(idle, frf[1], BAND, SAME_SET_UP, correlated=rest.correlated)
            terms = (Term("global_stiffness", (), (float(np.log(0.01)),)),)
            found = fit(case_of, replace(case_of.forward.start, terms=terms), 0.01)
            rows.append((np.log(found.terms[0].size / 0.01), np.sqrt(found.covariance[0, 0])))
    (bent, std_bent), (error, std) = (np.array(off[straight]).T for straight in (False, True))
    assert np.sqrt(np.mean(error**2)) < 0.5 * np.sqrt(np.mean(bent**2))
    assert std.mean() < 0.7 * std_bent.mean()
    assert abs(np.mean(error / std)) < 1.96 / np.sqrt(error.size)
    assert 0.5 < np.sqrt(np.mean((error / std) ** 2)) < 1.5


def with_force_noise(frf, share, seed):
    """FRFs with an error that all responses to a force share, as their variance has it."""
    rng = np.random.default_rng(seed)
    shape = 1, *frf.data.shape[1:]
    error = share * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)
    return replace(frf, data=frf.data * (1 + error), variance=frf.variance + (share * np.abs(frf.data)) ** 2)


def test_intervals_of_the_poles_hold_what_the_noise_of_the_forces_does():
    values, _ = eigen()
    exact = np.concatenate([np.abs(values) / 2 / np.pi, -values.real / np.abs(values)])
    share, told, off, off_without = 5e-3, [], [], []
    for seed in range(8):
        frf = with_force_noise(idle_frf(seed, 3e-4), share, 100 + seed)
        rest = at_rest(Idle.of(real_modes(), BAND, [DOFS[i] for i in REFERENCES]), frf, BAND)
        told.append(np.sqrt(common_variance(rest.state)))
        form, slopes = poles(rest.idle)
        error = np.concatenate([form.frequencies_hz, form.damping_ratios]) - exact
        std, by_force = np.linalg.norm(slopes, axis=1), np.linalg.norm(slopes @ moved_by_force_noise(rest.state)[0], axis=1)
        off.append(error / np.hypot(std, by_force))
        off_without.append(error / std)
    np.testing.assert_allclose(np.mean(told, axis=0), share, rtol=0.1)
    inside, without = (np.mean(np.abs(rows) < 1.96) for rows in (off, off_without))
    assert 0.9 < inside < 0.99
    assert without < 0.8  # each response counted for itself


def with_idle_lines(seed=0):
    """A spring more to ground in operation, and a case with the lines of the idle FRFs beside the prior that was made of them."""
    mass, damping, stiff, *_ = chain()
    more = stiff.copy()
    more[1, 1] += 0.02 * stiff[1, 1]
    rest = at_rest(Idle.of(real_modes(), BAND, DOFS[:1]), measured(mass, damping, stiff, (0,), 2e-3, 2 * seed), BAND)
    check = measured(mass, damping, more, (0,), 2e-3, 2 * seed + 1)
    one = Case(rest.idle, check, BAND, SAME_SET_UP, correlated=rest.correlated, fitted=rest.fitted)
    return one, (Term("ground_spring", (1,), (float(np.log(0.02 * stiff[1, 1])),)),)


def test_the_idle_frfs_say_what_the_normal_prior_says_near_its_mean():
    one, terms = with_idle_lines()
    exact = one.exactly()
    assert one.exactly().idle_lines is exact.idle_lines  # made once
    assert exact.exactly() is exact
    problem = Problem(exact, terms, exact.lines.fit)
    at_rest_ = problem.packed(replace(exact.forward.start, u=np.zeros(problem.n_u), terms=terms))
    rng = np.random.default_rng(0)
    g, own = rng.standard_normal(exact.forward.n_g), rng.standard_normal(exact.forward.start.own.shape)
    away = problem.packed(replace(problem.point(at_rest_), g=g, own=own))
    straight = Problem(exact, terms, exact.lines.fit, straight=True)

    def beyond(share):
        x = at_rest_ * (1 - share) + away * share
        return problem.penalty(x) - straight.penalty(x)

    assert beyond(0.0) == 0
    assert abs(beyond(1e-3)) < 1e-6  # of third order
    assert beyond(1.0) > 10  # and far off, FRFs that were not measured
    # all that the prior knows and more is in the lines: their information is nowhere larger than its own
    problem.derived(at_rest_)
    assert np.abs(problem.idle.information.shared).max() < 1e-6
    known = exact.idle_lines.known
    assert np.linalg.eigvalsh(np.tril(known.shared) + np.tril(known.shared, -1).T).max() < 1 + 1e-6


def test_the_gradient_with_idle_frfs_is_that_of_differences():
    one, terms = with_idle_lines()
    exact = one.exactly()
    problem = Problem(exact, terms, exact.lines.fit)
    rng = np.random.default_rng(1)
    start = replace(exact.forward.start, u=np.zeros(problem.n_u), terms=terms)
    g, own = 0.5 * rng.standard_normal(start.g.size), 0.5 * rng.standard_normal(start.own.shape)
    x = problem.packed(replace(start, g=g, own=own))
    problem.derived(x)
    by_shared, by_own = problem.of_prior(x)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        way = problem.packed(replace(start, g=rng.standard_normal(g.size), own=rng.standard_normal(own.shape))) + problem.packed(start) * -1
        step = way * 1e-5
        wanted = (problem.penalty(x + step) - problem.penalty(x + step * -1)) / 2
        got = by_shared @ step.shared + np.sum(by_own * problem.by_response(step.own))
        assert got == pytest.approx(wanted, rel=1e-4)
        # and the penalty of second order is that of the point
        there = problem.penalty_of(x, step * 10)
        assert there == pytest.approx(problem.penalty(x + step * 10), abs=1e-5 * abs(there))


def test_with_the_idle_frfs_a_size_covers():
    off = []
    for seed in range(6):
        one, terms = with_idle_lines(seed)
        exact = one.exactly()
        found = fit(exact, started(exact, terms), 0.01)
        off.append((found.terms[0].values[0] - terms[0].values[0]) / np.sqrt(found.covariance[0, 0]))
    assert abs(np.mean(off)) < 1.96 / np.sqrt(len(off))
    assert 0.3 < np.sqrt(np.mean(np.square(off))) < 1.7


def test_a_shape_that_no_other_follows_is_no_scale():
    """The one of the driven DOF of a mode that damping alone lets see: its moves are its own."""
    phi, driven = np.array([[0.1, 1.0], [1.0, 1.0]]), np.array([True, False])
    shared = np.zeros((2, 2, 2))
    shared[0, 0, 0] = 0.1  # of the first mode alone the driven value
    shared[0, 1, 1], shared[1, 1, 1] = 0.5, -0.5  # of the second both, inversely
    moves = Moves(shared, np.zeros((2, 2, 0)))
    np.testing.assert_allclose(moves.scale(phi, driven), [[1, 0], [0, 0.5]])
    np.testing.assert_allclose(moves.scale(phi, driven, exact=True), [[0, 0], [0, 0.5]])


@pytest.mark.parametrize(
    ("added", "worth", "tied", "asked"),
    [(1, 31.0, True, 2), (1, 1.1 * EARNED, True, 2), (1, 0.9 * EARNED, True, 1), (0, 31.0, True, 0), (1, 31.0, False, 0)],
)
def test_effects_that_were_added_are_held_to_the_idle_frfs(monkeypatch, added, worth, tied, asked):
    """Where damping ties modes two gyroscopic effects that nearly cancelled were 31 nats better than the one that was there.

    One that does not earn its place is not fitted again, but what it was added to is.
    """
    one, terms = with_idle_lines()
    if not tied:
        one.fitted = None
    first = fit(one, started(one, terms), 0.01)
    more = (*terms, Term("point_mass", (2,), (np.log(1e-3),)))[: 1 + added]
    best = replace(first, x=first.carried(more), log_evidence=first.log_evidence + worth)
    best.least_change = 1.0
    run = Search(one, lambda text: None, Found(first, first, {first.key: first}), own_spreads=True)
    run.pool = {first.key: first, best.key: best}
    fits = []
    monkeypatch.setattr(run, "fitted", lambda starts, floor: fits.extend(starts))
    run._hold_to_idle_frfs(first)
    assert [s.x.terms for s in fits] == [first.terms, more][:asked]
    assert all(s.case.idle_lines is not None and not s.x.g.any() for s in fits)


def roving_hammer(responses=(2,), damping=None):
    """Idle FRFs of few responses by forces everywhere."""
    mass, own, stiff, *_ = chain()
    return measured(mass, own if damping is None else damping, stiff, range(N), 2e-4, 0, responses=responses)


def test_frfs_of_many_references_are_taken_as_of_many_responses():
    """With 64 references and one response the fit took 165 s and 6.6 GB, with both exchanged 4 s: at rest H is symmetric."""
    hammer = roving_hammer()
    assert (len(hammer.responses), len(hammer.references)) == (1, N)
    turned = with_fewer_references(hammer)
    assert (turned.responses, turned.references) == (hammer.references, hammer.responses)
    np.testing.assert_array_equal(turned.data[:, 0], hammer.data[0])
    np.testing.assert_array_equal(turned.variance[:, 0], hammer.variance[0])
    assert with_fewer_references(turned) is turned
    model = real_modes()
    assert Measured.of(model, idle_frf(), hammer, BAND, lambda text: None).rest.state.case.forward.references.size == 1
    one, two = (with_complex_modes(model, frf, band=BAND) for frf in (hammer, turned))
    assert one.coupling is not None
    np.testing.assert_allclose(one.damping_ratios, two.damping_ratios, rtol=1e-12)
    np.testing.assert_allclose(one.damping_ratios, pole_form(whole().terms).damping_ratios, rtol=0.02)


def test_modes_that_the_linear_stage_has_in_phase_are_not_fitted_as_complex(monkeypatch):
    def refused(*_):
        raise AssertionError("fitted")

    monkeypatch.setattr("operando.diagnosis.complex_idle._fitted", refused)
    # between twelve pairs the prior of the search alone is below 1 %
    real, lagging = (replace(roving_hammer((1, 2, 4), damping), variance=None) for damping in (modes()[3], None))
    model = fit_ema(real, band=BAND, ema="linear")
    assert with_complex_modes(model, real) is model
    with pytest.raises(AssertionError, match="fitted"):
        with_complex_modes(fit_ema(lagging, band=BAND, ema="linear"), lagging)

"""Diagnosis from operational modes against physical truths: a chain with the effect in its own matrices, solved apart from operando."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from operando.data import ModalModel
from operando.diagnosis import diagnose, diagnose_modes
from operando.diagnosis.between import SAME_SET_UP, spreads_of
from operando.diagnosis.criteria import ASSUMED_MODES, MODES_FLOOR, NEAR_HZ, PARTNER_LOG_HZ, PARTNER_MAC, SECOND_ORDER
from operando.diagnosis.forward import Point
from operando.diagnosis.idle import Idle
from operando.diagnosis.lacking import with_lacking
from operando.diagnosis.modes_case import TOLD_BY_MODES, ModesCase
from operando.diagnosis.operating_modes import OperatingModes, partners
from operando.diagnosis.posterior import fit, left_on, unfitted
from operando.diagnosis.problem import Problem, Step
from operando.diagnosis.scan import LinearScan
from operando.diagnosis.terms import Term
from operando.errors import ConfigError, DataError
from operando.structure import Model
from operando.structure.effects import Effect, kind_of
from structures import Chain

DOFS = tuple(f"{i + 1}+Z" for i in range(7))
SENSORS = (0, 2, 3, 5, 6, 8, 9)
IN_BAND = 6
NODE = dict(zip(DOFS, SENSORS, strict=True))


def chain(seed=0):
    return Chain(n=10, mass=1.0, stiffness=3e5, spread=0.35, zeta=np.linspace(0.006, 0.014, 10), seed=seed)


def idle_of(c, seed=0, scatter=0.05):
    """Modes in the band nearly exact, those above as residual modes with shapes that are ``scatter`` wrong."""
    rng = np.random.default_rng(seed)
    n, m = len(c.hz), len(SENSORS)
    phi = c.phi[list(SENSORS)]
    std = np.full((m, n), 2e-4) * np.sqrt(np.mean(phi**2))
    std[:, IN_BAND:] = scatter * np.sqrt(np.mean(phi**2))
    variance = np.r_[(1e-6 * c.hz) ** 2, (1e-3 * c.zeta) ** 2, (std.T**2).ravel()]
    return ModalModel.from_terms(
        c.hz,
        c.zeta,
        phi + std * rng.standard_normal((m, n)),
        DOFS,
        scaling="unit_modal_mass",
        residual=np.arange(n) >= IN_BAND,
        covariance=np.diag(variance),
        band_hz=(1.0, 1.1 * float(c.hz[IN_BAND - 1])),
    )


def running(c, effect=None, seed=0, noise=1.0):
    """Operational modes of M, C, K with the effect put in, with scatter as SSI leaves it; shapes of random complex scale."""
    rng = np.random.default_rng(100 + seed)
    n = len(c.hz)
    mass, stiff = c.M.copy(), c.K.copy()
    damp = c.M @ c.phi @ np.diag(4 * np.pi * c.zeta * c.hz) @ c.phi.T @ c.M
    if effect is not None:
        kind, places, size = effect
        at = [np.eye(n)[NODE[p]] for p in places]
        b = at[0] - at[1] if len(at) == 2 else at[0] if at else np.zeros(n)
        skew = np.outer(at[0], at[1]) - np.outer(at[1], at[0]) if len(at) == 2 else 0
        square = np.outer(b, b)
        if kind == "point_mass":
            mass += size * square
        elif kind.endswith("_spring"):
            stiff += size * square
        elif kind.endswith("_damper"):
            damp += size * square
        elif kind == "gyroscopic":
            damp += size * skew
        elif kind == "circulatory":
            stiff += size * skew
        elif kind == "global_stiffness":
            stiff *= 1 + size
        elif kind == "global_damping":
            damp *= 1 + size
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(mass, stiff), -np.linalg.solve(mass, damp)]])
    poles, v = np.linalg.eig(a)
    up = np.flatnonzero(poles.imag > 0)
    up = up[np.argsort(np.abs(poles[up]))][:IN_BAND]
    shapes = v[:n][:, up][list(SENSORS)]
    shapes = shapes * np.exp(2j * np.pi * rng.random(IN_BAND)) / np.abs(shapes).max(axis=0)
    hz, zeta = np.abs(poles[up]) / 2 / np.pi, -poles[up].real / np.abs(poles[up])
    f_std, z_std = 4e-4 * hz, 0.06 * zeta
    s_std = np.full(shapes.shape, 3e-3)
    gauss = lambda like: noise * rng.standard_normal(like.shape)  # noqa: E731
    return ModalModel(
        hz + f_std * gauss(hz),
        zeta + z_std * gauss(zeta),
        shapes + s_std * (gauss(hz + 0 * shapes.real) + 1j * gauss(hz + 0 * shapes.real)),
        DOFS,
        covariance=np.diag(np.r_[f_std**2, z_std**2, np.tile((s_std.T**2).ravel(), 2)]),
    )


TRUTHS = [
    ("point_mass", ("4+Z",), 0.15),
    ("ground_spring", ("2+Z",), 2e4),
    ("ground_damper", ("5+Z",), 12.0),
    ("coupling_spring", ("3+Z", "6+Z"), 1.5e4),
    ("coupling_damper", ("1+Z", "4+Z"), 12.0),
    ("gyroscopic", ("2+Z", "5+Z"), 40.0),
    ("circulatory", ("3+Z", "5+Z"), 1.5e4),
    ("global_stiffness", (), -0.06),
    ("global_damping", (), 0.8),
]


def case_of(c, operating, scatter=0.05, spreads=SAME_SET_UP, halves=(), seed=0, exact=False):
    """The chain's idle modes and some operational modes as the engine sees them."""
    model = idle_of(c, seed, scatter)
    if exact:
        model = ModalModel.from_terms(
            c.hz, c.zeta, c.phi[list(SENSORS)], DOFS, scaling="unit_modal_mass", residual=model.terms.residual, band_hz=model.band_hz
        )
    idle = Idle.of(model, model.band_hz, model.dofs)
    return ModesCase(idle, OperatingModes(idle, operating, halves), model.band_hz, spreads)


def term_of(case, kind, places, size):
    """An effect with its size on the search scale."""
    at = [DOFS.index(p) for p in places]
    value = np.log(1 + size) if kind == "global_damping" else np.log(abs(size))
    return Term(kind, tuple(at), (float(value),), 1 if kind == "global_damping" else int(np.sign(size)))


@pytest.mark.parametrize("truth", TRUTHS, ids=[t[0] for t in TRUTHS])
def test_predicted_modes_are_those_of_the_physical_matrices(truth):
    """Poles and shapes of the eigenproblem, in the values that are compared: ln f, ln zeta, shape."""
    c = chain()
    case = case_of(c, running(c, truth, noise=0.0), exact=True)
    x = case.forward.start
    at = case.lines.w
    with_it = case.forward.predict(Point(x.g, x.d, x.own, x.u, (term_of(case, *truth),)), at, derivatives=False).h
    left = (case.lines.h - with_it).reshape(IN_BAND, -1)
    assert np.abs(left[:, 0]).max() < 1e-9
    assert np.abs(left[:, 1]).max() < 1e-6
    assert np.abs(left[:, 2:]).max() < 1e-7


UNKNOWNS = [
    (("ground_spring", ("2+Z",), 2e4), ("gyroscopic", ("3+Z", "5+Z"), -40.0), ("global_damping", (), 0.2)),
    (("point_mass", ("4+Z",), 0.15), ("coupling_damper", ("1+Z", "6+Z"), 12.0), ("global_stiffness", (), -0.05)),
]


@pytest.mark.parametrize(
    ("lag", "driven", "terms"),
    [(0.0, DOFS, UNKNOWNS[0]), (0.0, DOFS[:2], UNKNOWNS[1]), (1e-4, DOFS, UNKNOWNS[1]), (1e-4, DOFS[:2], UNKNOWNS[0])],
    ids=["real-all_driven-spring", "real-two_driven-mass", "complex-all_driven-mass", "complex-two_driven-spring"],
)
def test_derivatives_agree_with_differences(lag, driven, terms):
    """By all unknowns: idle model, two days, what lies outside the band at undriven places, the values, shapes, channels."""
    c = chain()
    idle = Idle.of(idle_of(c), idle_of(c).band_hz, tuple(d for d in idle_of(c).dofs if str(d) in driven))
    idle = replace(idle, lag=lag * np.random.default_rng(1).standard_normal(idle.lag.shape))
    case = ModesCase(idle, OperatingModes(idle, running(c, TRUTHS[1])), idle_of(c).band_hz)
    chosen = tuple(term_of(case, *t) for t in terms)
    problem = Problem(case, chosen, case.lines.w)
    assert bool(problem.n_u) == (len(driven) < len(DOFS))
    start = case.forward.start
    x = problem.packed(Point(start.g, start.d, start.own, np.zeros(problem.n_u), chosen))
    rng = np.random.default_rng(0)
    away = 0.2 * rng.standard_normal(x.shared.size)
    away[problem.values_at : problem.values_at + problem.n_values] = 0
    x = x + Step(away, 0 * x.own)
    found = problem.predict(x).shared[:, 0, 0]
    step = 1e-4
    for number in range(x.shared.size):
        unit = np.zeros(x.shared.size)
        unit[number] = step
        up, down = (problem.predict(x + Step(side * unit, 0 * x.own), False).h[:, 0, 0] for side in (1, -1))
        exact = (up - down) / (2 * step)
        np.testing.assert_allclose(found[:, number], exact, rtol=1e-4, atol=1e-5 * np.abs(exact).max() + 1e-10)


def test_slopes_and_responses_of_a_scan_are_those_of_the_model():
    """Slopes exactly; trial values, which take what lies above the band as it is at its ends, to a tenth of the largest change."""
    c = chain()
    case = case_of(c, running(c, TRUTHS[0]), exact=True)
    scan = LinearScan(fit(case, case.forward.start))
    start = case.forward.start
    for kind, places, size in TRUTHS[:7]:
        term = term_of(case, kind, places, size)
        got = scan.state.responses([term])[:, 0, 0, 0]
        more = Point(scan.x.g, scan.x.d, scan.x.own, start.u, (term,))
        want = case.forward.predict(more, scan.w, derivatives=False).h[:, 0, 0]
        np.testing.assert_allclose(got, want, atol=0.1 * np.abs(want - scan.state.h[:, 0, 0]).max())
        unit = Term(kind, term.places, (0.0,), term.sign)
        slope = scan.state.slopes([unit])[:, 0, 0, 0]
        little = term.moved((np.log(1e-4 * abs(size)),))
        sign = term.sign if kind in ("gyroscopic", "circulatory") else 1
        more = Point(scan.x.g, scan.x.d, scan.x.own, start.u, (little,))
        moved = case.forward.predict(more, scan.w, derivatives=False).h[:, 0, 0] - scan.state.h[:, 0, 0]
        np.testing.assert_allclose(slope * 1e-4 * abs(size) * sign * term.sign, moved, atol=2e-3 * np.abs(moved).max())


@pytest.mark.parametrize(("kind", "size"), [("global_stiffness", -0.02), ("global_damping", 0.5)])
def test_a_change_of_the_whole_is_scanned_for_where_nothing_was_touched(kind, size):
    """Between two days it is one of the differences, and comes by promotion; where there are none it is a candidate as any other."""
    c = chain()
    case = case_of(c, running(c, (kind, (), size)))
    state = fit(case, case.forward.start)
    found, none = LinearScan(state).run()
    assert found[0].term.kind == kind
    assert found[0].evidence > none + 10
    want = term_of(case, kind, (), size)
    assert (found[0].term.sign, found[0].term.values[0]) == (want.sign, pytest.approx(want.values[0], abs=0.2))


@pytest.mark.parametrize("truth", TRUTHS, ids=[t[0] for t in TRUTHS])
def test_each_kind_is_found_where_it_is_and_as_large_as_it_is(truth):
    c = chain()
    kind, places, size = truth
    found = diagnose_modes(idle_of(c), running(c, truth), kinds=TOLD_BY_MODES)
    assert found.verdict in ("explained", "ambiguous")
    effect = found.effects[0]
    assert (effect.kind, tuple(map(str, effect.location))) == (kind, places)
    name = effect.definition.parameters[0].name
    value = effect.sign * effect.values[name]
    assert abs(value - size) < 4 * effect.std[name]
    assert effect.std[name] < 0.2 * abs(size)
    before, after = found.ladder[0], found.ladder[-1]
    assert after["heldout_misfit"] < min(2.0, 0.8 * before["heldout_misfit"])


def swinging(c, place, mass, hz, zeta):
    """Modes of the chain with a mass on a spring and damper of its own at a sensor; those in band, and the one it brings."""
    n, w = len(c.hz), 2 * np.pi * hz
    damp = c.M @ c.phi @ np.diag(4 * np.pi * c.zeta * c.hz) @ c.phi.T @ c.M
    between = np.r_[np.eye(n)[NODE[place]], -1]
    square = np.outer(between, between)
    wider = [np.pad(a, (0, 1)) for a in (c.M, damp, c.K)]
    wider[0][n, n] = mass
    return modes_of(wider[0], wider[1] + 2 * zeta * w * mass * square, wider[2] + w**2 * mass * square, IN_BAND + 1)


def modes_of(mass, damp, stiff, count):
    """Poles and shapes at the sensors of M, C, K; K may be complex, as it is in the upper half of the s-plane."""
    n = len(mass)
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(mass, stiff), -np.linalg.solve(mass, damp)]])
    poles, v = np.linalg.eig(a)
    up = np.flatnonzero(poles.imag > 0)
    up = up[np.argsort(np.abs(poles[up]))][:count]
    return poles[up], v[:n][:, up][list(SENSORS)]


def on_a_law(c, place, law):
    """Modes of the chain with a dynamic stiffness to ground at a sensor, one by one: K at the pole, until it is its own."""
    b = np.eye(len(c.hz))[NODE[place]]
    damp = c.M @ c.phi @ np.diag(4 * np.pi * c.zeta * c.hz) @ c.phi.T @ c.M
    s, shapes = 2j * np.pi * c.hz[:IN_BAND], []
    for k in range(IN_BAND):
        for _ in range(40):
            poles, v = modes_of(c.M, damp, c.K + law(s[k]) * np.outer(b, b), IN_BAND)
            s[k] = poles[k]
        shapes.append(v[:, k])
    return s, np.stack(shapes, 1)


def measured(s, shapes, seed=0, noise=1.0):
    """Operational modes of these poles and shapes, with scatter as SSI leaves it."""
    rng = np.random.default_rng(100 + seed)
    hz, zeta, shapes = np.abs(s) / 2 / np.pi, -s.real / np.abs(s), shapes / np.abs(shapes).max(axis=0)
    f_std, z_std, s_std = 4e-4 * hz, 0.06 * zeta, np.full(shapes.shape, 3e-3)
    gauss = lambda like: noise * rng.standard_normal(like.shape)  # noqa: E731
    return ModalModel(
        hz + f_std * gauss(hz),
        zeta + z_std * gauss(zeta),
        shapes + s_std * (gauss(s_std) + 1j * gauss(s_std)),
        DOFS,
        covariance=np.diag(np.r_[f_std**2, z_std**2, np.tile((s_std.T**2).ravel(), 2)]),
    )


BAND = (1.0, 1.1 * float(chain().hz[IN_BAND - 1]))
REFERENCE = 0.5 * sum(BAND)
FURTHER = [
    ("tuned_absorber", "4+Z", (0.2, 75.0, 0.04), lambda c: swinging(c, "4+Z", 0.2, 75.0, 0.04)),
    (
        "ground_hysteretic_spring",
        "2+Z",
        (3e4, 0.4),
        lambda c: on_a_law(c, "2+Z", lambda s: 3e4 * (1 + 0.4j)),
    ),
    (
        "ground_rubber",
        "5+Z",
        (6e4, 0.4),
        lambda c: on_a_law(c, "5+Z", lambda s: 6e4 * (s / (2 * np.pi * REFERENCE)) ** 0.4),
    ),
]
NAMES = [t[0] for t in FURTHER]


def further_term(kind, place, values):
    """A kind of more than one value on the search scale."""
    names = kind_of(kind).names
    law = Effect(kind, (place,), dict(zip(names, values, strict=True)), band_hz=BAND)
    return Term.of(law, (DOFS.index(place),))


@pytest.mark.parametrize(("kind", "place", "values", "truth"), FURTHER, ids=NAMES)
def test_kinds_of_several_values_are_predicted_from_their_laws(kind, place, values, truth):
    """An absorber has a coordinate of its own and brings a mode; the others are no M, C, K: each pole has the stiffness at itself."""
    c = chain()
    case = case_of(c, measured(*truth(c), noise=0.0), exact=True)
    x = case.forward.start
    term = further_term(kind, place, values)
    with_it = case.forward.predict(Point(x.g, x.d, x.own, x.u, (term,)), case.lines.w, derivatives=False).h
    left = (case.lines.h - with_it).reshape(-1, case.lines.sets[0].per_mode)
    assert np.abs(left[:, 0]).max() < 1e-8
    assert np.abs(left[:, 1]).max() < 1e-6
    assert np.abs(left[:, 2:]).max() < 1e-6
    found = case.forward.scannable(x, case.lines.w).responses([term])[:, 0, 0, 0]
    bare = case.forward.predict(x, case.lines.w, derivatives=False).h[:, 0, 0] if kind != "tuned_absorber" else 0 * found
    far = np.abs(found - with_it[:, 0, 0]).max()
    assert far < 0.35 * np.abs(with_it[:, 0, 0] - bare).max()
    problem = Problem(case, (term,), case.lines.w)
    at = problem.packed(Point(x.g, x.d, x.own, np.zeros(problem.n_u), (term,)))
    slopes = problem.predict(at).shared[:, 0, 0]
    for number in range(problem.values_at, problem.values_at + len(values)):
        unit = 1e-5 * (np.arange(at.shared.size) == number)
        up, down = (problem.predict(at + Step(side * unit, 0 * at.own), False).h[:, 0, 0] for side in (1, -1))
        np.testing.assert_allclose(slopes[:, number], (up - down) / 2e-5, rtol=1e-4, atol=1e-5 * np.abs(slopes[:, number]).max())


@pytest.mark.parametrize(("kind", "place", "values", "truth"), FURTHER, ids=NAMES)
def test_kinds_of_several_values_are_found_with_all_of_them(kind, place, values, truth):
    c = chain()
    found = diagnose_modes(idle_of(c), measured(*truth(c)))
    assert found.verdict in ("explained", "ambiguous")
    effect = found.effects[0]
    assert [(e.kind, str(e.location[0])) for e in found.effects] == [(kind, place)]
    for name, value in zip(effect.definition.names, values, strict=True):
        assert abs(effect.values[name] - value) < 4 * effect.std[name]
    assert effect.std[effect.definition.names[0]] < 0.3 * values[0]


def with_a_mode_more(c, seed=0):
    """Modes of the chain as it is, and one of a shape that it does not have: at 75 Hz, 1.2 % of damping."""
    damp = c.M @ c.phi @ np.diag(4 * np.pi * c.zeta * c.hz) @ c.phi.T @ c.M
    s, shapes = modes_of(c.M, damp, c.K, IN_BAND)
    shape = np.random.default_rng(5).standard_normal(len(SENSORS))
    s, shapes = np.append(s, 2 * np.pi * 75.0 * (1j - 0.012)), np.c_[shapes, shape]
    order = np.argsort(np.abs(s))
    return measured(s[order], shapes[:, order], seed)


def test_a_mode_that_the_idle_model_lacks_is_told_as_one():
    """No effect at a location brings a mode of such a shape. Of its values all derivatives agree with differences."""
    c = chain()
    found = diagnose_modes(idle_of(c), with_a_mode_more(c))
    assert found.verdict == "explained"
    (effect,) = found.effects
    assert effect.kind == "missing_mode"
    for name, value in (("frequency", 75.0), ("damping_ratio", 0.012)):
        assert abs(effect.values[name] - value) < 4 * effect.std[name]
    shape = np.array([effect.shape[d] for d in DOFS])
    true = np.random.default_rng(5).standard_normal(len(SENSORS))
    assert (shape @ true) ** 2 / (shape @ shape) / (true @ true) > 0.999
    case = case_of(c, with_a_mode_more(c), spreads=spreads_of({}))
    grown = with_lacking(unfitted(case, case.forward.start, 0.1))
    assert grown.f[grown.lacking] == pytest.approx(75.0, rel=2e-3)
    case = ModesCase(grown, case.lines, case.band, spreads_of({}))
    problem = Problem(case, grown.lacking_term, case.lines.w)
    start = case.forward.start
    x = problem.packed(Point(start.g, start.d, start.own, np.zeros(problem.n_u), grown.lacking_term))
    slopes = problem.predict(x).shared[:, 0, 0]
    for number in range(x.shared.size):
        unit = 1e-4 * (np.arange(x.shared.size) == number)
        up, down = (problem.predict(x + Step(side * unit, 0 * x.own), False).h[:, 0, 0] for side in (1, -1))
        exact = (up - down) / 2e-4
        np.testing.assert_allclose(slopes[:, number], exact, rtol=1e-4, atol=1e-5 * np.abs(exact).max() + 1e-10)


def test_what_swings_and_weighs_next_to_nothing_is_a_mode_more():
    """As light as one likes, it brings its mode, and no operational mode tells its mass: that a part swings there is not claimed."""
    c = chain()
    found = diagnose_modes(idle_of(c), measured(*swinging(c, "4+Z", 1e-4, 75.0, 0.012)))
    assert [e.kind for e in found.effects] == ["missing_mode"]
    assert found.effects[0].values["frequency"] == pytest.approx(75.0, rel=2e-3)
    # nor is it ruled out: the verdict names both, and what tells them apart
    assert found.verdict == "ambiguous"
    assert ("tuned_absorber", "4+Z") in [(e.kind, e.place) for e in found.ambiguous_with]
    assert "4+Z" in found.proposed_measurement


def test_nothing_is_found_where_nothing_is_hidden():
    for seed in range(3):
        c = chain(seed)
        found = diagnose_modes(idle_of(c, seed), running(c, seed=seed))
        assert found.effects == ()
        # Six modes leave 28 values to judge: their misfit exceeds 1.5 by chance once in some thirty times, and the verdict says so.
        assert found.verdict == ("no_misfit" if found.ladder[0]["heldout_misfit"] < 1.5 else "unexplained")
        assert len(found.ladder) == 1
        assert found.candidates


def test_one_mode_cannot_tell_kinds_apart_and_says_so():
    c = chain()
    # A mode that the mass does move.
    found = diagnose_modes(idle_of(c), running(c, TRUTHS[0]).select_modes([2]))
    assert found.verdict == "ambiguous"
    assert len({e.kind for e in (*found.effects, *found.ambiguous_with)}) >= 2
    assert "measure" in found.proposed_measurement
    assert "too few" in found.notes[0]


def test_two_effects_are_found_one_after_the_other():
    c = chain()
    more = chain()
    more.K = c.K.copy()
    first, second = np.eye(10)[NODE["2+Z"]], np.eye(10)[NODE["6+Z"]]
    more.K = c.K + 3e4 * np.outer(first, first)
    # The damping matrix stays that of the idle chain: only M and K of the truth change.
    truth = running(_with(c, stiffness=more.K, mass=c.M + 0.2 * np.outer(second, second)))
    found = diagnose_modes(idle_of(c), truth, kinds=("point_mass", "ground_spring"))
    got = {(e.kind, str(e.location[0])): e for e in found.effects}
    assert set(got) == {("ground_spring", "2+Z"), ("point_mass", "6+Z")}
    assert got["ground_spring", "2+Z"].values["stiffness"] == pytest.approx(3e4, rel=0.05)
    assert got["point_mass", "6+Z"].values["mass"] == pytest.approx(0.2, rel=0.05)
    misfits = [row["heldout_misfit"] for row in found.ladder]
    assert misfits == sorted(misfits, reverse=True)


class _with:
    """The chain's damping with other M and K."""

    def __init__(self, c, stiffness, mass):
        self.hz, self.zeta, self.K = c.hz, c.zeta, stiffness
        self.M = mass
        self.phi = np.linalg.solve(mass, c.M @ c.phi)


def test_a_shape_is_compared_free_of_its_scale():
    c = chain()
    case = case_of(c, running(c, TRUTHS[5], noise=0.0))
    one = case.lines.sets[0]
    rng = np.random.default_rng(1)
    s = 2 * np.pi * one.f * (1j - one.zeta)
    scale = rng.standard_normal(one.n) + 1j * rng.standard_normal(one.n)
    np.testing.assert_allclose(one.values(s, one.shapes.T * scale[:, None])[:, 2:], 0, atol=1e-12)
    other = rng.standard_normal((one.n, len(DOFS))) + 1j * rng.standard_normal((one.n, len(DOFS)))
    np.testing.assert_allclose(one.values(s, other), one.values(s, other * scale[:, None]), atol=1e-12)
    # what is left is the shortest difference from any multiple of the prediction, but for its part along the shape itself
    multiple = [np.linalg.lstsq(p[:, None], y, rcond=None)[0][0] * p for p, y in zip(other, one.shapes.T, strict=True)]
    across = [np.r_[d.real, d.imag] @ a for d, a in zip(multiple, one.across, strict=True)]
    np.testing.assert_allclose(one.values(s, other)[:, 2:], across, atol=1e-12)


def test_modes_are_paired_by_frequency_and_mac():
    """A pair 5 % apart in frequency (``NEAR_HZ``) costs as much as one with a MAC of 0.75."""
    c = chain()
    case = case_of(c, running(c, noise=0.0))
    one = case.lines.sets[0]
    assert NEAR_HZ == 0.05
    order = np.random.default_rng(0).permutation(one.n)
    np.testing.assert_array_equal(order[one.pairs(one.f[order] * 1.03, one.shapes[:, order])], np.arange(one.n))
    # two modes that have passed each other are told by their shapes
    f = one.f.copy()
    f[[2, 3]] = 0.99 * f[2], 0.98 * f[2]
    np.testing.assert_array_equal(one.pairs(f, one.shapes), np.arange(one.n))
    with pytest.raises(np.linalg.LinAlgError):
        one.pairs(f[:3], one.shapes[:, :3])
    with pytest.raises(np.linalg.LinAlgError, match="cannot be"):
        one.pairs(np.where(np.arange(f.size) == 1, np.nan, f), one.shapes)


def test_a_size_that_leaves_too_few_modes_is_not_chosen():
    """A damper so large that a mode no longer swings, where the idle model has just the modes that were measured."""
    c = chain()
    whole = idle_of(c)
    bare = ModalModel(whole.frequencies_hz, whole.damping_ratios, whole.shapes, DOFS, "unit_modal_mass", band_hz=whole.band_hz)
    idle = Idle.of(bare, bare.band_hz, bare.dofs)
    case = ModesCase(idle, OperatingModes(idle, running(c, noise=0.0), ()), bare.band_hz, SAME_SET_UP)
    state = case.forward.scannable(case.forward.start, case.lines.w)
    sizes = [Term("ground_damper", (0,), (float(np.log(size)),)) for size in (1.0, 10.0, 3e3)]
    alone = state.responses(sizes[:2])
    assert np.isfinite(alone).all()
    together = state.responses(sizes)
    np.testing.assert_array_equal(together[..., :2], alone)
    assert np.isnan(together[..., 2]).all()


def test_noise_is_at_least_what_any_identification_leaves():
    c = chain()
    exact = running(c, noise=0.0)
    sure = ModalModel(exact.frequencies_hz, exact.damping_ratios, exact.shapes, DOFS, covariance=1e-16 * np.asarray(exact.covariance))
    one = case_of(c, sure).lines.sets[0]
    variance = np.diag(one.noise).reshape(one.n, -1)
    np.testing.assert_allclose(variance[:, 0], MODES_FLOOR[0] ** 2, rtol=1e-3)
    np.testing.assert_allclose(variance[:, 1], MODES_FLOOR[1] ** 2, rtol=1e-3)
    np.testing.assert_allclose(variance[:, 2:].min(axis=1), (MODES_FLOOR[2] * np.abs(one.shapes).max(axis=0)) ** 2, rtol=1e-3)


def test_a_covariance_of_few_blocks_counts_as_larger():
    """88 blocks, 14 values a mode: by 87/72; of a half twice that of the whole."""
    c = chain()
    whole, half = running(c), running(c, seed=1)
    told = replace(whole, details=SimpleNamespace(settings={"blocks": 88}, halves=()))
    plain, more = (case_of(c, m, halves=(half, half)).lines.sets for m in (whole, told))
    floor = np.tile(np.r_[np.square(MODES_FLOOR[:2]), np.zeros(12)], IN_BAND)
    ratio = (np.diag(more[0].noise) - floor) / (np.diag(plain[0].noise) - floor)
    np.testing.assert_allclose(ratio, 87 / 72, rtol=0.03)
    np.testing.assert_allclose(np.diag(more[1].noise).reshape(IN_BAND, -1)[:, :2], 2 * np.diag(more[0].noise).reshape(IN_BAND, -1)[:, :2])


def test_noise_of_modes_without_a_covariance_is_assumed():
    c = chain()
    exact = running(c, noise=0.0)
    one = case_of(c, ModalModel(exact.frequencies_hz, exact.damping_ratios, exact.shapes, DOFS)).lines.sets[0]
    std = np.sqrt(np.diag(one.noise)).reshape(one.n, -1)
    np.testing.assert_allclose(std[:, 0], np.hypot(ASSUMED_MODES[0], MODES_FLOOR[0]))
    np.testing.assert_allclose(std[:, 1], np.hypot(ASSUMED_MODES[1], MODES_FLOOR[1]))
    largest = np.abs(one.shapes).max(axis=0)
    alone = ASSUMED_MODES[2] ** 2 * largest**2 / 2 + (MODES_FLOOR[2] * largest) ** 2
    second = (SECOND_ORDER * len(DOFS) * (ASSUMED_MODES[2] * largest) ** 2) ** 2
    np.testing.assert_allclose(std[:, 2] ** 2, alone + second, rtol=1e-6)


def test_residuals_are_standard_normal_without_an_effect():
    """So that a misfit of 1 means as good as the data allow: of the values fitted, and of a half predicted from the other."""
    values = []
    for seed in range(12):
        c = chain(seed)
        whole, *halves = (running(c, seed=40 * k + seed, noise=np.sqrt(2) if k else 1.0) for k in range(3))
        case = case_of(c, whole, halves=halves, seed=seed)
        start, lines = case.forward.start, case.lines
        values.append([left_on(case, start, 0.0, at)[0] for at in (lines.fit, lines.validation)])
    assert np.all(np.abs(np.mean(values, axis=0) - 1) < 0.15)


def test_the_document_is_plain_json_with_the_keys_of_the_contract():
    c = chain()
    document = diagnose(idle_of(c), operating=running(c, TRUTHS[1]), kinds=("ground_spring", "point_mass")).to_dict()
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert document["data"] == ["operating_modes"]
    assert document["noise_floor_db"] is None
    assert all(row["error_db"] is None and row["heldout_error_db"] is None for row in document["ladder"])
    assert document["ladder"][1]["added"]["kind"] == document["effects"][0]["kind"] == "ground_spring"
    assert {"selection_misfit", "evidence"} <= set(document["candidates"][0])
    assert document["schema"] == "operando/diagnosis/2"
    assert {row["kind"] for row in document["detectable"]} == {"ground_spring", "point_mass"}
    assert document["discrepancy"]["value"] < 0.03
    assert [row["frequency_hz"] for row in document["where"]["by_mode"]] == pytest.approx(list(running(c, TRUTHS[1]).frequencies_hz))


def test_where_the_idle_model_fails_counts_noise_as_one_by_sensor_band_and_mode():
    left = {"by_dof": [], "by_band": [], "by_mode": []}
    for seed in range(6):
        c = chain(seed)
        where = diagnose(idle_of(c), operating=running(c, seed=seed), kinds="ground_spring").to_dict()["where"]
        assert all(row["error_db"] is None for key in ("by_dof", "by_band") for row in where[key])
        assert [row["dof"] for row in where["by_dof"]] == [f"{k + 1}+Z" for k in range(len(SENSORS))]
        assert len(where["by_band"]) == 8
        for key, name in (("by_dof", "misfit"), ("by_band", "misfit"), ("by_mode", "idle_misfit")):
            left[key] += [row[name] for row in where[key] if row[name] is not None]
    for key, values in left.items():
        assert np.mean(values) == pytest.approx(1, abs=0.15), key


def test_where_the_idle_model_fails_says_by_how_much_modes_are_off():
    c = chain()
    there = running(c, TRUTHS[1])
    where = diagnose(idle_of(c), operating=there, kinds="ground_spring").to_dict()["where"]
    off = [100 * (f / its - 1) for f, its in zip(c.hz, there.frequencies_hz, strict=False)]
    assert [row["frequency_error_percent"] for row in where["by_mode"]] == pytest.approx(off, abs=0.05)
    worst = max(where["by_dof"], key=lambda row: row["misfit"])
    assert worst["misfit"] > 10


@pytest.mark.parametrize("truth", [TRUTHS[1], TRUTHS[5]], ids=["ground_spring", "gyroscopic"])
def test_the_model_handed_on_predicts_the_running_structure(truth):
    c = chain()
    kind, places, size = truth
    idle = idle_of(c)
    found = diagnose_modes(idle, running(c, truth), kinds=(kind,))
    true = ModalModel.from_terms(c.hz, c.zeta, c.phi[list(SENSORS)], DOFS, scaling="unit_modal_mass", residual=idle.terms.residual)
    hz = np.linspace(2.0, 1.05 * c.hz[IN_BAND - 1], 150)
    exact = Model(true, (Effect(kind, places, {Effect(kind, places).definition.names[0]: size}),)).frf(hz)
    got, before = found.model.frf(hz), idle.frf(hz)
    error = np.linalg.norm(got.data - exact.data) / np.linalg.norm(exact.data)
    assert error < 0.15 * np.linalg.norm(before.data - exact.data) / np.linalg.norm(exact.data)
    # Its own variance says how far off it is, to first order.
    ratio = np.mean(np.abs(got.data - exact.data) ** 2 / got.variance)
    assert 0.1 < ratio < 5


def test_order_and_sense_of_sensors_do_not_matter():
    c = chain()
    operating = running(c, TRUTHS[0])
    turned = ModalModel(
        operating.frequencies_hz,
        operating.damping_ratios,
        operating.shapes[::-1] * np.where(np.arange(7) == 2, -1, 1)[:, None],
        tuple(d if i != 2 else d.replace("+", "-") for i, d in enumerate(DOFS[::-1])),
        std={
            "frequencies_hz": operating.frequency_std_hz,
            "damping_ratios": operating.damping_ratio_std,
            "shapes": operating.shape_std[::-1],
        },
    )
    idle = idle_of(c)
    one = diagnose_modes(idle, operating, kinds=("point_mass",), places=("4+Z",))
    two = diagnose_modes(idle, turned, kinds=("point_mass",), places=("4+Z",))
    assert "effects were looked for at these DOFs alone, as the test asks: 4+Z" in one.notes
    assert two.effects[0].values["mass"] == pytest.approx(one.effects[0].values["mass"], rel=1e-6)


def test_what_cannot_be_diagnosed_says_why():
    c = chain()
    idle, operating = idle_of(c), running(c)
    with pytest.raises(ConfigError, match="none of the kinds"):
        diagnose_modes(idle, operating, kinds=["sensor_gain"])
    unscaled = ModalModel(idle.frequencies_hz, idle.damping_ratios, idle.shapes, DOFS)
    with pytest.raises(DataError, match="scale"):
        diagnose_modes(unscaled, operating)
    elsewhere = ModalModel(operating.frequencies_hz, operating.damping_ratios, operating.shapes, tuple(f"{i}+X" for i in range(7)))
    with pytest.raises(DataError, match="fewer than two"):
        diagnose_modes(idle, elsewhere)


SPRING = ("ground_spring", ("2+Z",), 2e4)
KINDS = ("ground_spring", "ground_damper")


def test_what_the_second_half_does_not_show_is_not_explained():
    c = chain()
    idle, with_it, without = idle_of(c), running(c, SPRING, seed=1), running(c, seed=2)
    both = diagnose_modes(idle, running(c, SPRING), halves=(with_it, running(c, SPRING, seed=2)), kinds=KINDS)
    assert both.verdict == "explained"
    assert [str(e.location[0]) for e in both.effects] == ["2+Z"]
    assert "second half, identified apart" in both.notes[0]
    for halves in ((with_it, without), (without, with_it)):
        found = diagnose_modes(idle, running(c, SPRING), halves=halves, kinds=KINDS)
        assert found.verdict in ("partial", "unexplained")
        assert "chi-square" in found.reason or found.verdict == "partial"


def test_a_mode_that_one_half_alone_shows_decides_nothing():
    c = chain()
    idle, whole, first, second = idle_of(c), running(c, SPRING), running(c, SPRING, seed=1), running(c, SPRING, seed=2)
    twice = _with_spurious(second, 3)
    assert partners(twice, whole).sum() == IN_BAND
    assert partners(second, whole).all()
    found = diagnose_modes(idle, whole, halves=(first, twice), kinds=KINDS)
    plain = diagnose_modes(idle, whole, halves=(first, second), kinds=KINDS)
    assert found.verdict == "explained"
    assert "1 mode that one half alone showed" in found.notes[0]
    assert found.ladder[-1]["heldout_misfit"] == pytest.approx(plain.ladder[-1]["heldout_misfit"])


def _with_spurious(model, k):
    """The same modes and a twin of one of them, 0.6 % off and with another shape."""
    n, m = model.n_modes, len(model.dofs)
    shape = np.asarray(model.shapes)[:, k] * (1 + 0.5 * np.cos(np.arange(m)))
    order = lambda values, more: np.insert(np.asarray(values), k, more, axis=-1)  # noqa: E731
    std = {
        "frequencies_hz": order(model.frequency_std_hz, 0.01),
        "damping_ratios": order(model.damping_ratio_std, 1e-3),
        "shapes": order(model.shape_std, np.full(m, 3e-3)),
    }
    hz = order(model.frequencies_hz, 0.994 * model.frequencies_hz[k])
    assert hz.size == n + 1
    return ModalModel(hz, order(model.damping_ratios, 0.01), order(model.shapes, shape), model.dofs, std=std)


def test_a_mode_of_half_a_record_needs_a_partner_in_the_whole():
    """No farther than ``PARTNER_LOG_HZ``, with a MAC above ``PARTNER_MAC``."""
    c = chain()
    whole = running(c, noise=0.0)

    def moved(by):
        hz = np.asarray(whole.frequencies_hz).copy()
        hz[0] *= np.exp(by)
        return ModalModel(hz, whole.damping_ratios, whole.shapes, DOFS)

    assert partners(moved(0.9 * PARTNER_LOG_HZ), whole).all()
    assert not partners(moved(-1.1 * PARTNER_LOG_HZ), whole)[0]
    shapes = np.array(whole.shapes)
    shapes[:, 0] = shapes[:, 4]
    assert PARTNER_MAC < 1
    assert not partners(ModalModel(whole.frequencies_hz, whole.damping_ratios, shapes, DOFS), whole)[0]


@pytest.mark.parametrize("size", [3.0, 1.0])
def test_of_a_damper_that_hardly_shows_no_other_is_made(size):
    c = chain(1)
    whole, *halves = (running(c, ("ground_damper", ("5+Z",), size), seed=10 + k) for k in range(3))
    found = diagnose_modes(idle_of(c, 1), whole, halves=halves, kinds=("ground_damper", "coupling_damper"))
    told = {(e.kind, e.place) for e in (*found.effects, *found.ambiguous_with)}
    assert {(e.kind, e.place) for e in found.effects} <= {("ground_damper", "5+Z")}
    if size == 3.0:
        assert ("ground_damper", "5+Z") in told
    if found.verdict != "explained" and found.ambiguous_with:
        assert "measure" in found.proposed_measurement


def test_sizes_scatter_as_their_standard_deviations_say():
    z = []
    for seed in range(12):
        c = chain(seed)
        case = case_of(c, running(c, SPRING, seed=seed), seed=seed)
        x = case.forward.start
        state = fit(case, Point(x.g, x.d, x.own, x.u, (term_of(case, *SPRING),)))
        z.append((state.terms[0].values[0] - np.log(SPRING[2])) / np.sqrt(state.covariance[0, 0]))
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.5


def test_modes_farther_off_than_their_noise_are_a_discrepancy_and_widen_the_size():
    c = chain()
    operating = running(c, SPRING)
    bold = ModalModel(
        operating.frequencies_hz, operating.damping_ratios, operating.shapes, DOFS, covariance=np.asarray(operating.covariance) / 25
    )
    found = []
    for modes in (operating, bold):
        case = case_of(c, modes)
        x = case.forward.start
        found.append(fit(case, Point(x.g, x.d, x.own, x.u, (term_of(case, *SPRING),))))
    plain, claimed = found
    assert plain.alpha < 0.001
    assert claimed.alpha > 0.01
    # a fifth is claimed, and the residuals are five times as large: the discrepancy gives back a part of it
    assert np.sqrt(claimed.covariance[0, 0]) > 1.25 * np.sqrt(plain.covariance[0, 0]) / 5

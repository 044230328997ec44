"""Diagnosis from check FRFs beyond the sensors: places between them, a mode that is lacking, the mass of a sensor; power; scale."""

import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad

from operando.data import Frf, Geometry, ModalModel
from operando.diagnosis import diagnose_frf, elsewhere, from_frf, hypotheses, sizes
from operando.diagnosis.arrow import ROUNDING, Factor, Information
from operando.diagnosis.between import SAME_SET_UP
from operando.diagnosis.case import Case
from operando.diagnosis.corrected import effects_of
from operando.diagnosis.criteria import (
    ALIKE_CURVES,
    AS_AT_REST,
    BETWEEN_STD,
    COMMON_BETWEEN,
    LEAST_BETWEEN_STD,
    LOOSE,
    MOST_CHI_SQUARE,
    NEIGHBOURS,
    ONE_SYSTEM,
    SCALE_BETWEEN,
    SCALE_BETWEEN_STD,
    STRAINED,
    WITHOUT_SENSOR,
)
from operando.diagnosis.elsewhere import search_between_sensors
from operando.diagnosis.found import Found
from operando.diagnosis.hypotheses import _HALF, Hypotheses
from operando.diagnosis.idle import Idle
from operando.diagnosis.lacking import _grown, with_lacking
from operando.diagnosis.lacking_mode import apart, grown_by_a_mode, with_mode
from operando.diagnosis.midway import TOGETHER, between_sensors, located, midway, on_a_sum, with_midway
from operando.diagnosis.posterior import fit, leaves_noise, on_validation_lines, unfitted
from operando.diagnosis.rival import score, started
from operando.diagnosis.scan import robust_cost, robust_scan
from operando.diagnosis.search import _BESIDE, RIVALS, WAYS, Search
from operando.diagnosis.sensor_mass import frequency_misfit, of_a_sensor
from operando.diagnosis.size_by_level import levels_disagree
from operando.diagnosis.sizes import _NEAR, _along_valley, with_likely_sizes
from operando.diagnosis.terms import Term
from operando.diagnosis.verdict import unlike_neighbours, unseen
from operando.dof import Dof
from operando.results import CheckRun
from test_diagnosis import BAND, DOFS, HZ, N, add_mass, case, identified, matrices, measured, modes

LINE = Geometry(tuple(range(1, N + 1)), np.column_stack([np.arange(N), np.zeros(N), np.zeros(N)]))


def check_of(change, references=(0, 3), responses=range(N), noise=2e-4):
    mass, stiff = matrices()
    m, c, k = mass.copy(), modes()[3].copy(), stiff.copy()
    change(m, c, k)
    return CheckRun("run", "1 N", measured(m, c, k, references, noise, 1, None, responses))


def rest(references=(0, 3), responses=range(N)):
    mass, stiff = matrices()
    return measured(mass, modes()[3], stiff, references, 2e-4, 2, None, responses)


def poorly_driven(std: float = 0.2):
    """The chain with a reference that hardly moves in the first mode: its scale is known to 20 %, products to 1e-4."""
    model = identified((0,))
    phi = np.asarray(model.terms.shapes)
    n = model.n_modes
    covariance = np.array(model.covariance)
    at = 2 * n + np.arange(N)  # shape of the first mode
    along = phi[:, 0] * np.r_[1.0, -np.ones(N - 1)]
    covariance[np.ix_(at, at)] += std**2 * np.outer(along, along)
    return replace(model, covariance=covariance)


@pytest.mark.parametrize(("std", "moved_by"), [(0.2, 0.4), (7.0, 2 * np.sqrt(np.log(50)))])
def test_products_of_a_driven_and_another_dof_stay_where_the_scale_of_a_mode_moves(std, moved_by):
    """Also where the scale is hardly known: its factor is log-normal."""
    idle = Idle.of(poorly_driven(std), BAND, DOFS[:1])
    scale = idle.shapes.scale(idle.phi, idle.driven)[0]
    g = 2.0 * scale / np.linalg.norm(scale)  # two standard deviations
    moved, _ = idle.shape(g, np.zeros((N, idle.shapes.own.shape[2])))
    assert np.log(moved[0, 0] / idle.phi[0, 0]) == pytest.approx(moved_by, rel=0.01)
    products = moved[1:, 0] * moved[0, 0] / (idle.phi[1:, 0] * idle.phi[0, 0])
    np.testing.assert_allclose(products, 1, atol=2e-3)  # by sums alone they were 1 − 0.4² = 0.84


def test_how_shapes_move_is_the_derivative_of_where_they_are():
    idle = Idle.of(poorly_driven(), BAND, DOFS[:1])
    rng = np.random.default_rng(3)
    g, own = rng.standard_normal(idle.f_root.shape[1]), rng.standard_normal((N, idle.shapes.own.shape[2]))
    _, moves = idle.shape(g, own)
    step, other = 1e-6 * rng.standard_normal(g.size), 1e-6 * rng.standard_normal(own.shape)
    slope = idle.shape(g + step, own + other)[0] - idle.shape(g - step, own - other)[0]
    wanted = 2 * (moves.shared @ step + (moves.own @ other[..., None])[..., 0])
    np.testing.assert_allclose(slope, wanted, atol=1e-5 * np.abs(wanted).max())


AT, ORDER, FREE, ZETA = np.arange(1, 8) / 8, np.arange(1, 5), np.array([10.0, 18.0, 27.0, 38.0]), 0.01
ON_BEAM = tuple(Dof(i + 1, "Z", 1) for i in range(AT.size))
BEAM = Geometry(tuple(range(1, 8)), np.column_stack([AT, np.zeros(7), np.zeros(7)]))


def shapes_of_beam(at):
    """Of a beam on two supports: sines, so the truth between sensors is known."""
    return np.sqrt(2) * np.sin(np.pi * np.multiply.outer(at, ORDER))


def on_beam(spot, law):
    """FRFs of the beam with a dynamic stiffness law(s) to ground at a spot."""
    phi, here, line, w = shapes_of_beam(AT), shapes_of_beam(spot), 2 * np.pi * HZ[:, None], 2 * np.pi * FREE
    rng = np.random.default_rng(5)
    k = 1 / (w**2 - line**2 + 2j * ZETA * w * line)
    h, column = np.einsum("ir,nr,jr->nij", phi, k, phi[[1, 4]]), (phi[None] * k[:, None]) @ here
    own, row = (k * here**2).sum(1), (here * k) @ phi[[1, 4]].T
    z = law(1j * line[:, 0])
    h = h - column[:, :, None] * (z / (1 + z * own))[:, None, None] * row[:, None]
    h = np.moveaxis(-(line[:, :, None] ** 2) * h, 0, 2)
    size = 2e-4 * np.sqrt(np.mean(np.abs(h) ** 2))
    h = h + size * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    return Frf(h, HZ, ON_BEAM, (ON_BEAM[1], ON_BEAM[4]), variance=np.full(h.shape, size**2))


def model_of_beam():
    std = np.r_[1e-5 * FREE, np.full(4, 1e-5), np.full(28, 2e-4)]
    zeta = np.full(4, ZETA)
    return ModalModel(FREE, zeta, shapes_of_beam(AT), ON_BEAM, "unit_modal_mass", covariance=np.diag(std**2), band_hz=BAND)


def test_a_mass_between_sensors_is_found_there():
    spot, mass = 5 / 16, 0.05
    here, w = shapes_of_beam(spot), 2 * np.pi * FREE
    run = CheckRun("run", "1 N", on_beam(spot, lambda s: mass * s**2))
    said = []
    found = diagnose_frf(model_of_beam(), [run], idle_frf=on_beam(spot, lambda s: 0 * s), geometry=BEAM, progress=said.append)
    assert not any("another day" in line for line in said)  # where nothing was touched, what explains the lines spares that search
    assert found.verdict in ("explained", "ambiguous")
    [effect] = found.effects
    assert (effect.kind, effect.position, effect.direction) == ("point_mass", (spot, 0.0, 0.0), "+Z")
    assert not any("not measured in operation" in note for note in found.notes)  # a place between sensors is no DOF that was left out
    assert effect.values["mass"] == pytest.approx(mass, abs=3 * effect.std["mass"])
    # the model knows the shape that the fit found there, with its covariance
    assert [d.node for d in found.model.idle.dofs][:7] == list(range(1, 8))
    assert len(found.model.idle.dofs) == 8
    assert found.model.covariance.shape == (4 + 4 + 32 + 1,) * 2
    wanted = np.sqrt(np.linalg.eigvals(np.linalg.solve(np.eye(4) + mass * np.outer(here, here), np.diag(w**2))).real) / 2 / np.pi
    np.testing.assert_allclose(np.sort(found.model.modes().frequencies_hz), np.sort(wanted), rtol=1e-3)


def with_each_second_sensor(spot, law):
    """A case of the beam with what acts half-way between two of its sensors, and that place."""
    kept = [0, 2, 4, 6]
    whole = model_of_beam()
    std = np.r_[1e-5 * FREE, np.full(4, 1e-5), np.full(16, 2e-4)]
    dofs, shapes = tuple(ON_BEAM[i] for i in kept), whole.shapes[kept]
    few = ModalModel(FREE, whole.damping_ratios, shapes, dofs, "unit_modal_mass", covariance=np.diag(std**2), band_hz=BAND)
    wider = with_midway(Idle.of(few, BAND, [ON_BEAM[4]]), BEAM)
    place = next(i for i, p in wider.midway.items() if p == pytest.approx((spot, 0.0, 0.0)))
    return Case(wider, on_beam(spot, law).select(dofs, [ON_BEAM[4]]), BAND, SAME_SET_UP), place


@pytest.mark.parametrize("scale", [0.1, 1.0])
def test_a_size_between_sensors_is_within_its_interval(scale, monkeypatch):
    """Shapes drawn about what the sensors suggest, by a part of the errors that they may have or by all of it."""
    size, z = 40.0, []
    one, place = with_each_second_sensor(0.25, lambda s: size * s)
    every, suggested = one.uncompressed.shapes.own[place], one.uncompressed.phi[place]
    for seed in range(5):
        rng = np.random.default_rng(seed)
        drawn = suggested + every @ (rng.standard_normal(every.shape[1]) * np.r_[np.ones(TOGETHER), np.full(suggested.size, scale)])
        with monkeypatch.context() as patch:
            patch.setitem(globals(), "shapes_of_beam", lambda at, drawn=drawn: drawn if np.ndim(at) == 0 else SINES(at))
            one, place = with_each_second_sensor(0.25, lambda s: size * s)
        far = fit(one, started(one, (Term("ground_damper", (place,), (float(np.log(30 * size)),)),)), 0.03, closely=True)
        found = with_likely_sizes(Found(far, far, {far.key: far})).best
        z.append((found.terms[0].values[0] - np.log(size)) / np.sqrt(found.covariance[0, 0]))
        assert found.terms[0].fixed == (0,)
        assert found.sizes[0][0] >= 0.999 * far.covariance[0, 0]  # no less than where no scale is estimated
    assert np.sqrt(np.mean(np.square(z))) < 1.5
    (effect,) = effects_of(found)
    assert effect.std["damping"] == pytest.approx(effect.values["damping"] * np.sqrt(found.covariance[0, 0]), rel=0.01)
    sensor = fit(one, started(one, (Term("ground_damper", (1,), (float(np.log(size)),)),)), 0.03)
    assert with_likely_sizes(Found(sensor, sensor, {})).best is sensor  # an effect at a sensor stays as it is


SINES = shapes_of_beam


@pytest.mark.parametrize(("error", "gains"), [(0.05, True), (1.5, False)])
def test_the_scale_of_errors_between_sensors_is_integrated_over(error, gains, monkeypatch):
    """Against quadrature, for shapes that the data tell exactly; its prior is about SCALE_BETWEEN, with SCALE_BETWEEN_STD."""
    x = error * np.array([1.0, -1, 0.5, 1, -0.5, 1])
    monkeypatch.setattr(sizes, "_unknowns_at", lambda state, place: (1e-12 * np.eye(x.size), x, np.zeros((x.size, TOGETHER))))

    def prior(s):
        return np.exp(-0.5 * ((s - SCALE_BETWEEN) / SCALE_BETWEEN_STD) ** 2)

    def ratio(s):
        return prior(s) * np.exp(-x.size * s - 0.5 * np.sum(x**2) * (np.exp(-2 * s) - 1))

    wanted = np.log(quad(ratio, -6, 0, limit=200)[0] / quad(prior, -6, 0)[0])
    assert sizes.by_scale(None, [0]) == pytest.approx(wanted, abs=0.05)
    assert (wanted > 0) == gains


def test_of_two_locations_between_sensors_the_one_with_small_errors_stands(monkeypatch):
    """States near the best one are held as well; one far from it, or with nothing between sensors, is not."""
    terms = {name: (Term("ground_damper", (9 + i,), (1.0,)),) for i, name in enumerate("abcd")} | {
        "e": (Term("ground_damper", (1,), (1.0,)),)
    }
    case = SimpleNamespace(idle=SimpleNamespace(midway=dict.fromkeys(range(9, 13))))
    value = {"a": 0.0, "b": -1.0, "c": -_NEAR + 0.5, "d": -_NEAR - 0.5, "e": -2.0}
    pool = {name: SimpleNamespace(key=name, terms=terms[name], case=case, log_evidence=value[name], alpha=1e-3) for name in value}
    held = []

    def at(state, number):
        held.append(state.key)
        return SimpleNamespace(**vars(state) | {"log_evidence": {"a": -3.0, "b": 4.0, "c": -9.0}[state.key]})

    monkeypatch.setattr(sizes, "at_likely_size", at)
    monkeypatch.setattr(sizes, "score", lambda state: state.log_evidence)
    monkeypatch.setattr(sizes, "names", lambda case, terms: [])
    found = with_likely_sizes(Found(pool["a"], pool["e"], pool))
    assert held == ["a", "b", "c"]
    assert (found.best.key, found.best.log_evidence, found.pool["d"]) == ("b", 4.0, pool["d"])


@pytest.mark.parametrize("size", [4e2, 2e3])
def test_a_size_that_is_held_begins_where_the_frfs_are_the_same(size):
    """A strong spring, held at another size with the shape as it was, led to the next valley, and its evidence to hardly a spread."""
    one, place = with_each_second_sensor(0.25, lambda s: size)
    state = fit(one, started(one, (Term("ground_spring", (place,), (float(np.log(size)),)),)), 0.03)
    lines = one.lines.w[one.lines.fit[::5]]

    def frfs(x, value):
        return one.forward.predict(replace(x, terms=(state.terms[0].moved((value,)),)), lines, derivatives=False).h

    there = state.terms[0].values[0] - 0.3
    as_it_was, as_fitted = frfs(state.x, there), frfs(state.x, state.terms[0].values[0])
    along = frfs(_along_valley(state, 0, there), there)
    assert np.abs(along - as_fitted).max() < 0.05 * np.abs(as_it_was - as_fitted).max()
    held = with_likely_sizes(Found(state, state, {state.key: state})).best
    # four sensors on this beam suggest its third shape 2.5 standard deviations off, and the size follows that; the next valley is at 3
    assert abs(held.terms[0].values[0] - np.log(size)) < 2.5 * np.sqrt(held.covariance[0, 0])
    assert held.covariance[0, 0] > 0.1**2


@pytest.mark.parametrize(
    ("count", "worth", "on_sum", "taken"),
    [
        (2, 40.0, False, False),
        (1, 40.0, False, True),
        (1, -WAYS + 1, False, True),
        (1, -WAYS - 1, False, False),
        (2, 1.0, True, True),
        (2, -1.0, True, False),
        (3, 40.0, True, False),
    ],
)
def test_an_effect_between_sensors_stands_for_several_at_them(monkeypatch, count, worth, on_sum, taken):
    """Where effects at sensors explain the lines: their shapes are known, so no as many elsewhere take their place; one does for two.

    As many do where one acts on the sum of two motions, which no part at these sensors has.
    """
    monkeypatch.setattr(elsewhere, "on_a_sum", lambda state, geometry: on_sum)
    cases = [SimpleNamespace(idle=SimpleNamespace(midway={9: (0.5, 0.0, 0.0)}))] * 2
    at_sensors = SimpleNamespace(
        terms=(Term("ground_damper", (1,), (1.0,)), Term("ground_damper", (2,), (1.0,))), alpha=1e-3, log_evidence=0.0
    )
    there = SimpleNamespace(terms=tuple(Term("ground_damper", (9 + i,), (1.0,)) for i in range(count)), alpha=1e-3, log_evidence=worth)
    monkeypatch.setattr(elsewhere, "cases_between_sensors", lambda *args: cases)
    monkeypatch.setattr(elsewhere, "search", lambda *args, **how: Found(there, there, {}))
    monkeypatch.setattr(elsewhere, "with_likely_sizes", lambda found, say: found)
    monkeypatch.setattr(elsewhere, "score", lambda state: state.log_evidence)
    empty = SimpleNamespace(case=SimpleNamespace(uncompressed=SimpleNamespace(midway={})))
    found = Found(at_sensors, empty, {}, odds=10.0)
    got = search_between_sensors(found, lambda idle: [], BEAM, lambda text: None, 1)
    assert got.best is (there if taken else at_sensors)
    assert got.odds == 10.0


@pytest.mark.parametrize(
    ("sign", "places", "kind", "asked"),
    [
        (-1, (1, 2), "coupling_spring", True),
        (-1, (1, 2), "channel_swap", False),  # of channels, no part
        (-1, (1, 3), "coupling_spring", False),  # with a sensor between them
        (1, (1, 2), "coupling_spring", False),
    ],
)
def test_one_effect_between_sensors_is_looked_for_where_one_acts_on_the_sum_of_their_motions(sign, places, kind, asked):
    """A spring acts on how far points move apart; with channels of opposite senses the difference is twice the motion half-way between."""
    dofs = tuple(replace(d, sign=sign) if i == 1 else d for i, d in enumerate(DOFS))
    state = SimpleNamespace(terms=(Term(kind, places, (0.0,)),), case=SimpleNamespace(dofs=dofs))
    assert on_a_sum(state, LINE) == between_sensors(state, LINE) == asked
    assert not on_a_sum(state, None)


@pytest.mark.parametrize(
    ("terms", "asked"),
    [
        ([("point_mass", (1,)), ("point_mass", (2,))], True),
        ([("tuned_absorber", (1,)), ("ground_spring", (1,))], True),  # at one sensor: what lacks is in the others
        ([("ground_spring", (1,)), ("coupling_spring", (1, 2))], True),
        ([("coupling_spring", (1, 2)), ("ground_spring", (4,))], False),  # one effect alone joins the two sensors
        ([("coupling_spring", (1, 2))], False),
        ([("point_mass", (1,)), ("point_mass", (3,))], False),
    ],
)
def test_one_effect_between_sensors_is_looked_for_where_several_stand_beside_its_place(terms, asked):
    state = SimpleNamespace(terms=tuple(Term(kind, places, (0.0,)) for kind, places in terms), case=SimpleNamespace(dofs=DOFS))
    assert between_sensors(state, LINE) == asked
    assert not between_sensors(state, None)


@pytest.mark.parametrize(("places", "asked"), [([(1,), (2,)], True), ([(1,), (3,)], False)])
def test_what_another_day_has_at_both_neighbours_is_held_against_one_effect_between_them(places, asked, monkeypatch):
    """With nothing touched: two dampers at sensors, on another day, stood for one between them."""

    def state(terms, value):
        return SimpleNamespace(terms=terms, log_evidence=value, alpha=0.1, case=SimpleNamespace(dofs=DOFS), key=value)

    empty, best = state((), -90.0), state(tuple(Term("ground_damper", at, (0.0,)) for at in places), -10.0)
    days = SimpleNamespace(forward=SimpleNamespace(start=None), elsewhere=True)
    stands = {
        "fit": lambda *args: state((), -100.0),
        "Rival": lambda *args: SimpleNamespace(score=-100.0),
        "search": lambda case, *args, **how: Found(best if case is days else empty, empty, {}),
        "score": lambda state: state.log_evidence,
        "untouched": lambda state: False,
        "promotions": lambda state: [],
        "grown_by_a_mode": lambda states: [],
        "as_channels_were": lambda *args: None,
    }
    for name, does in stands.items():
        monkeypatch.setattr(hypotheses, name, does)
    for name in ("no_effect_at_a_sensor", "mode_alone", "back_to_one_set_up"):
        monkeypatch.setattr(Hypotheses, name, lambda *args: None)
    bars = []
    monkeypatch.setattr(Hypotheses, "one_between_sensors", lambda self, found, bar: bars.append(bar))
    found = Hypotheses(days, SimpleNamespace(), again=lambda idle: [], geometry=LINE).run()
    assert bars == [-10.0] * asked
    assert (found.best, found.odds) == (best, -80.0)


def test_places_between_sensors_are_those_of_neighbours_with_what_they_suggest():
    for factor, count in ((0.99, 4), (1.01, 3)):  # the second and the third sensor are neighbours, or are not
        gap = np.zeros((N, 3))
        gap[2:, 0] = factor * NEIGHBOURS - 1
        assert len(midway(DOFS, replace(LINE, coordinates=LINE.coordinates + gap))) == count
    idle = Idle.of(identified(), BAND, [DOFS[0], DOFS[3]])
    wider = with_midway(idle, LINE)
    assert wider.midway == {N + i: (0.5 + i, 0.0, 0.0) for i in range(4)}
    assert located(LINE, wider).position(wider.dofs[N].node) == pytest.approx([0.5, 0, 0])
    assert located(LINE, idle) is LINE
    assert with_midway(idle, replace(LINE, nodes=(1,), coordinates=LINE.coordinates[:1])) is None


def test_a_shape_between_sensors_is_told_the_better_the_longer_its_waves_are():
    """What a straight line over three sensors may err by goes with the frequency, and all modes with the place between them."""
    idle = Idle.of(identified(), BAND, [DOFS[0], DOFS[3]])
    three = replace(LINE, nodes=LINE.nodes[:3], coordinates=LINE.coordinates[:3])
    wider = with_midway(idle, three)
    own = wider.shapes.own[N]
    along, common = own[:, :TOGETHER].T
    each = np.diagonal(own[:, TOGETHER:])
    waves = idle.f[idle.modes] / idle.f[idle.modes].max()
    near, whole = (np.sqrt(np.mean(v[:, idle.modes] ** 2, axis=0)) for v in (idle.phi[:2], idle.phi))
    np.testing.assert_allclose(each[idle.modes], waves * np.hypot(BETWEEN_STD * near, LEAST_BETWEEN_STD * whole), rtol=1e-12)
    # anywhere nearer to the middle than to the next two middles, uniformly
    np.testing.assert_allclose(along, (idle.phi[1] - idle.phi[0]) / 2 / np.sqrt(12), rtol=1e-12)
    # by one factor, of a straight line here, and of a spline over all sensors
    np.testing.assert_allclose(common, COMMON_BETWEEN[0] * wider.phi[N], rtol=1e-12)
    all_of_them = with_midway(idle, LINE)
    np.testing.assert_allclose(all_of_them.shapes.own[N][:, 1], COMMON_BETWEEN[1] * all_of_them.phi[N], rtol=1e-12)


@pytest.mark.parametrize(("factor", "unlike"), [(0.99, False), (1.01, True)])
def test_an_effect_between_sensors_with_shapes_unlike_theirs_is_none_there(factor, unlike):
    """By the mean square over the modes without the worst, against STRAINED."""
    wider = with_midway(Idle.of(identified(), BAND, [DOFS[0], DOFS[3]]), LINE)
    forward = SimpleNamespace(idle=wider, n_shape=wider.shapes.own.shape[2])
    own = np.zeros((len(wider.dofs), forward.n_shape))
    rows = wider.shapes.own[N, wider.modes]
    wanted = factor * np.sqrt(STRAINED) * np.linalg.norm(rows, axis=1)
    wanted[2] *= 10
    own[N] = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    state = SimpleNamespace(
        case=SimpleNamespace(forward=forward, place=lambda i: "(0.5, 0, 0) m, +Z"),
        terms=(Term("point_mass", (N,), (0.0,)), Term("point_mass", (0,), (0.0,))),
        x=SimpleNamespace(own=own),
    )
    assert ("a mass at (0.5, 0, 0) m, +Z" in unlike_neighbours(state)) == unlike
    assert not unlike_neighbours(replace_terms(state, state.terms[1:]))


def replace_terms(state, terms):
    return SimpleNamespace(**(vars(state) | {"terms": terms}))


def without_mode(model, r):
    keep = [i for i in range(N) if i != r]
    rows = np.r_[keep, N + np.array(keep), (2 * N + np.array(keep)[:, None] * N + np.arange(N)).ravel()]
    terms = model.terms
    return ModalModel(
        terms.frequencies_hz[keep],
        terms.damping_ratios[keep],
        np.asarray(terms.shapes)[:, keep],
        DOFS,
        "unit_modal_mass",
        covariance=model.covariance[np.ix_(rows, rows)],
        band_hz=BAND,
    )


def test_a_mode_that_the_idle_model_lacks_is_found_with_its_shape():
    w, zeta, phi, damping = modes()
    lacks = without_mode(identified(), 2)
    mass, stiff = matrices()
    check = CheckRun("run", "1 N", measured(mass, damping, stiff, (0, 3), 2e-4, 1))
    line = 2j * np.pi * HZ[:, None, None]
    mode = (line**2 / (w[2] ** 2 + line**2 + 2 * zeta[2] * w[2] * line) * np.outer(phi[:, 2], phi[[0, 3], 2])).transpose(1, 2, 0)
    there = rest()
    found = diagnose_frf(lacks, [check], idle_frf=replace(there, data=there.data - mode))
    assert found.verdict == "explained"
    [effect] = found.effects
    assert effect.kind == "missing_mode"
    assert effect.values["frequency"] == pytest.approx(w[2] / 2 / np.pi, rel=1e-3)
    shape = np.array(list(effect.shape.values()))
    np.testing.assert_allclose(shape * np.sign(shape[0]), phi[:, 2] * np.sign(phi[0, 2]), atol=0.02 * np.abs(phi[:, 2]).max())
    assert found.model.modes().n_modes == N


@pytest.mark.parametrize(("no_laboratory", "depth"), [(True, 1), (False, 2)])
def test_between_sensors_one_step_is_made_where_no_laboratory_has_such_days(monkeypatch, no_laboratory, depth):
    """And its spreads are estimated where that step has led between sensors."""

    def state(place, log_evidence=0.0):
        case = SimpleNamespace(uncompressed=SimpleNamespace(midway={}))
        term = Term("point_mass", (place,), (0.0,))
        return SimpleNamespace(terms=(term,), key=(term.key,), alpha=0.0, case=case, log_evidence=log_evidence)

    found, asked = Found(state(1), state(1), {}, odds=-1000.0), []
    monkeypatch.setattr(elsewhere, "no_other_day", lambda best: no_laboratory)
    cases = [SimpleNamespace(name=name, idle=SimpleNamespace(midway={9: (0.5, 0.0, 0.0)})) for name in ("days", "one set-up")]
    monkeypatch.setattr(elsewhere, "cases_between_sensors", lambda *args: cases)

    def search(case, say, **how):
        ends = [Found(state(1), state(1), dict(enumerate(pool))) for pool in pools]
        asked.append((case.name, how["depth"], [how["go_on"](end) for end in ends]))
        return found

    pools = [state(1), state(2)], [state(1), state(9, -RIVALS + 1)], [state(1), state(9, -RIVALS - 1)]
    monkeypatch.setattr(elsewhere, "search", search)
    monkeypatch.setattr(elsewhere, "with_likely_sizes", lambda found, say: found)
    monkeypatch.setattr(elsewhere, "score", lambda state: 0.0)
    assert search_between_sensors(found, lambda idle: [], object(), lambda text: None, 2) is found
    assert asked == [("days", depth, [not no_laboratory, True, not no_laboratory])]


@pytest.mark.parametrize(
    ("met", "ends", "like", "taken"), [(2.0, 3.0, None, True), (2.0, 3.0, "days", True), (2.0, 0.5, None, False), (0.5, 3.0, None, False)]
)
def test_what_is_met_at_sensors_on_the_way_is_searched_from_there(monkeypatch, met, ends, like, taken):
    """An absorber at a sensor was 230 nats better than what had been found, and was left (frame 10629)."""

    def state(place, log_evidence):
        case = SimpleNamespace(uncompressed=SimpleNamespace(midway={}), like=like)
        term = Term("point_mass", (place,), (0.0,))
        return SimpleNamespace(terms=(term,), key=(term.key,), alpha=0.0, case=case, log_evidence=log_evidence)

    found, better, asked = Found(state(1, 1.0), state(1, 1.0), {}, odds=-1000.0), state(2, met), []
    wider = [SimpleNamespace(name="wider", idle=SimpleNamespace(midway={9: (0.5, 0.0, 0.0)}))] * 2
    monkeypatch.setattr(elsewhere, "cases_between_sensors", lambda *args: wider)

    def search(case, say, also=(), **how):
        if case.name == "wider":
            return Found(better, better, {})
        asked.append((case.name, also))
        return Found(state(2, ends), state(1, 1.0), {})

    monkeypatch.setattr(elsewhere, "search", search)
    monkeypatch.setattr(elsewhere, "no_other_day", lambda best: False)
    monkeypatch.setattr(elsewhere, "with_likely_sizes", lambda found, say: found)
    monkeypatch.setattr(elsewhere, "score", lambda state: state.log_evidence)
    sensors = [SimpleNamespace(name=name) for name in ("days", "one set-up")]
    got = search_between_sensors(found, lambda idle: sensors, object(), lambda text: None, 2)
    assert (got is not found) == taken
    assert asked == ([("one set-up" if like else "days", better.terms)] if met > 1.0 else [])
    assert got.odds == found.odds


def test_a_mode_is_held_against_a_state_with_its_spreads_estimated_as_that_was():
    """An absorber with spreads estimated has more evidence than the mode without, and less than with them (frame 10128, two days)."""
    mass, stiff = matrices()
    frf = measured(mass, modes()[3], stiff, (0, 3), 2e-4, 1)

    def again(idle):
        return [Case(idle, frf, BAND, correlated=1.0)]

    [one] = again(Idle.of(without_mode(identified(), 2), BAND, [DOFS[0], DOFS[3]]))
    [grown] = grown_by_a_mode([fit(one, one.forward.start)])
    first = with_mode(grown, again, -np.inf, lambda text: None).best
    estimated = fit(first.case, first.x, first.alpha, own_spreads=True)
    assert score(estimated) > score(first) + 10
    bar = 0.5 * (score(first) + score(estimated))
    assert with_mode(grown, again, bar, lambda text: None) is None
    assert with_mode(grown, again, bar, lambda text: None, own_spreads=True).best.terms == first.terms
    assert with_mode(grown, again, score(estimated) + 10, lambda text: None, own_spreads=True) is None


def one_mode_more(w, phi, size, zeta):
    """FRFs of a mode 1.3 times as high as the second, of a part of its shape with signs changed, and its pole [rad/s]."""
    line, pole = 2j * np.pi * HZ, 1.3 * w[1]
    shape = size * phi[:, 1] * np.array([1, -1, 1, 1, -1])
    return np.outer(shape, shape[[0, 3]])[..., None] * line**2 / (pole**2 + line**2 + 2 * zeta * pole * line), pole


@pytest.mark.parametrize("size", [0.04, 0.06])
def test_a_weak_mode_is_looked_for_before_another_day_is(size):
    """Another day leaves little of the lines, and takes the weaker one for what days do (``no_misfit``)."""
    w, _, phi, damping = modes()
    mass, stiff = matrices()
    frf = measured(mass, damping, stiff, (0, 3), 2e-4, 1)
    mode, pole = one_mode_more(w, phi, size, 0.01)
    said = []
    check = CheckRun("run", "1 N", replace(frf, data=frf.data + mode))
    found = diagnose_frf(identified(), [check], idle_frf=rest(), progress=said.append)
    assert [e.kind for e in found.effects] == ["missing_mode"]
    assert found.effects[0].values["frequency"] == pytest.approx(pole / 2 / np.pi, rel=1e-3)
    assert not any(line.startswith("on another day") for line in said)


def test_a_mode_between_the_lines_that_validate_is_seen():
    """A narrow one changes some of the fitted lines alone: lines that validate keep a chi-square of 0.6 without it (``no_misfit``)."""
    w, _, phi, damping = modes()
    mass, stiff = matrices()
    frf = measured(mass, damping, stiff, (0, 3), 2e-4, 1)
    mode, pole = one_mode_more(w, phi, 0.02, 0.005)
    check = CheckRun("run", "1 N", replace(frf, data=frf.data + mode))
    days = Case(Idle.of(identified(), BAND, (DOFS[0], DOFS[3])), check.frf, BAND, spreads={}, correlated=1.0)
    without = fit(days, days.forward.start)
    assert on_validation_lines(without)[0] < MOST_CHI_SQUARE
    assert not leaves_noise(without)
    found = diagnose_frf(identified(), [check], idle_frf=rest())
    assert found.verdict == "explained"
    assert [e.kind for e in found.effects] == ["missing_mode"]
    assert found.effects[0].values["frequency"] == pytest.approx(pole / 2 / np.pi, rel=1e-3)


def test_a_mode_that_explains_the_lines_spares_the_search_for_two_effects():
    """It is asked for where the best location leaves more than half of what there is, robustly."""
    w, _, phi, damping = modes()
    mass, stiff = matrices()
    frf = measured(mass, damping, stiff, (0, 3), 2e-4, 1)
    mode, _ = one_mode_more(w, phi, 0.2, 0.01)
    said = []
    found = diagnose_frf(identified(), [CheckRun("run", "1 N", replace(frf, data=frf.data + mode))], idle_frf=rest(), progress=said.append)
    assert found.verdict == "explained"
    assert [e.kind for e in found.effects] == ["missing_mode"]
    before = said[: next(i for i, text in enumerate(said) if text.startswith("a mode missing"))]
    assert not any("', '" in text for text in before)  # states of two effects


@pytest.mark.parametrize("part", [0.4, 0.6])
def test_what_stands_instead_of_two_effects_is_tried_by_what_one_leaves(monkeypatch, part):
    """``_HALF``: of what the best sensor leaves for a place between sensors, of what there is for a mode."""
    one, asked = case(add_mass), []
    days = fit(one, one.forward.start)
    whole = robust_cost(one, one.forward.start)
    best = robust_scan(one, one.forward.start)[0]
    assert -best[0] < _HALF * whole  # the mass that is there
    monkeypatch.setattr(Hypotheses, "lacking_mode", lambda *args, **how: asked.append("mode"))

    def scanned(case, x):
        at_sensor = (-part * whole, Term("point_mass", (1,), (0.0,)), False)
        between = [(-part * part * whole, Term("point_mass", (place,), (0.0,)), False) for place in case.idle.midway]
        return [*between[:1], at_sensor]

    monkeypatch.setattr(hypotheses, "robust_scan", scanned)
    monkeypatch.setattr(hypotheses, "search", lambda case, *args, **how: asked.append("between") or Found(days, days, {}))
    monkeypatch.setattr(hypotheses, "with_likely_sizes", lambda found, say: found)
    one.at_rest.robust = scanned(one, None)

    def again(idle):
        return [Case(idle, check_of(add_mass).frf, BAND, correlated=1.0) for _ in range(2)]

    assert Hypotheses(one, one, again=again, geometry=LINE).instead_of_two() is None
    assert asked == (["between"] if part < _HALF else ["mode"])


@pytest.mark.parametrize(("share", "taken"), [(0.99, True), (1.01, False)])
def test_a_place_between_sensors_explains_the_check_as_the_idle_model_does_the_idle_frfs(monkeypatch, share, taken):
    """``AS_AT_REST``: up to twice the discrepancy at rest; beyond it, something else is asked."""
    one, at_rest = case(add_mass), 0.004
    days = fit(one, one.forward.start)
    there = Found(replace(days, alpha=share * AS_AT_REST * at_rest), days, {}, odds=10.0)
    one.at_rest.robust = [(-robust_cost(one, one.forward.start), Term("point_mass", (1,), (0.0,)), False)]
    monkeypatch.setattr(Hypotheses, "one_between_sensors", lambda *args, **how: there)
    monkeypatch.setattr(Hypotheses, "lacking_mode", lambda *args, **how: None)
    found = Hypotheses(one, one, at_rest=at_rest, again=lambda idle: [], geometry=LINE).instead_of_two()
    assert found is (there if taken else None)


def test_a_mode_that_does_not_explain_the_lines_alone_is_not_fitted_again():
    """Two effects at sensors: where one explains little it is asked for, and once more where two do not."""

    def changed(m, c, k):
        add_mass(m, c, k)
        k[3, 3] += 4e3

    frf, said = check_of(changed).frf, []

    def again(idle):
        days = Case(idle, frf, BAND, correlated=1.0)
        return [days, Case(idle, frf, BAND, SAME_SET_UP, correlated=1.0, like=days)]

    days, same = again(Idle.of(identified(), BAND, [DOFS[0], DOFS[3]]))
    empty, both = fit(same, same.forward.start), Hypotheses(days, same, said.append, again=again)
    assert both.alone.alpha > LOOSE
    for _ in range(2):
        assert both.lacking_mode(Found(empty, empty, {empty.key: empty}), at_once=True) is None
    tried = [text for text in said if text.startswith("a mode missing")]
    assert len(tried) == len(set(tried)) > 0


@pytest.mark.parametrize(("becomes_another", "wanted"), [(None, "likelier"), ("likelier", "first"), ("both", None)])
def test_of_modes_that_may_be_lacking_the_likeliest_is_searched_that_does_not_become_another(monkeypatch, becomes_another, wanted):
    """A pole on the flank of a mode that had moved came first, and with an absorber for the one that was lacking explained the FRFs."""
    one = case()
    state = fit(one, one.forward.start)
    both = {name: replace(state, alpha=0.003, log_evidence=nats) for name, nats in (("first", 1.0), ("likelier", 2.0))}
    separate = {id(s): becomes_another not in (name, "both") for name, s in both.items()}
    one.at_rest.grown = list(both)
    monkeypatch.setattr(hypotheses, "with_mode", lambda grown, *rest: Found(both[grown], state, {}, odds=5.0))
    monkeypatch.setattr(Hypotheses, "explains", lambda self, state: False)
    monkeypatch.setattr(hypotheses, "apart", lambda state: separate[id(state)])
    monkeypatch.setattr(hypotheses, "search", lambda case, say, start, depth: start)
    monkeypatch.setattr(hypotheses, "fit", lambda case, x: replace(state, alpha=1.01 * LOOSE))
    got = Hypotheses(one, one, again=lambda idle: []).lacking_mode(Found(state, state, {}))
    assert got is None if wanted is None else (got.best, got.odds) == (both[wanted], 5.0)


@pytest.mark.parametrize(("odds", "alpha", "asked"), [(-5.0, 0.99 * LOOSE, True), (5.0, 0.99 * LOOSE, False), (-5.0, 1.01 * LOOSE, False)])
def test_a_lacking_mode_is_looked_for_where_two_days_alone_leave_little(monkeypatch, odds, alpha, asked):
    """What differs between the days may stand for it: a weak mode was ``no_misfit``, 1260 nats worse than with it."""
    modes = []

    def searched(self):
        return Found(self.alone, replace(self.alone, alpha=alpha), {self.alone.key: self.alone}, odds=odds)

    def lacking(found, *rest):
        modes.append(True)
        return found

    monkeypatch.setattr(Hypotheses, "run", searched)
    monkeypatch.setattr(from_frf, "search_lacking_mode", lacking)
    check = CheckRun("run", "1 N", check_of(lambda m, c, k: None).frf)
    assert diagnose_frf(identified(), [check], band=BAND).verdict == "no_misfit"
    assert modes == [True] * asked


def test_a_lacking_mode_is_told_as_it_is_in_operation():
    """No difference between the days moves it: it was seen on one of them alone."""
    check = check_of(lambda m, c, k: None).frf
    lacks = Case(Idle.of(without_mode(identified(), 2), BAND, (DOFS[0], DOFS[3])), check, BAND, spreads={}, correlated=1.0)
    grown = with_lacking(replace(fit(lacks, lacks.forward.start), x=lacks.forward.start))
    days = Case(grown, check, BAND, correlated=1.0)
    forward, lines = days.forward, days.lines.w[days.lines.fit[::5]]
    x = replace(forward.start, d=np.random.default_rng(1).standard_normal(forward.n_d), terms=grown.lacking_term)
    made = forward.moved(x)
    np.testing.assert_allclose([made.f[grown.lacking], made.zeta[grown.lacking]], np.exp(x.terms[0].values))
    assert np.abs(made.f / forward.idle.f - 1)[forward.modes[:-1]].min() > 1e-5
    exact = forward.predict(x, lines).shared
    for name in ("stiffness", "damping_whole", "mode", "damping", "damping_local"):
        for i in range(forward.between.shared[name].start, forward.between.shared[name].stop):
            step = 1e-4 * np.eye(forward.n_d)[i]
            up, down = (forward.predict(replace(x, d=x.d + side * step), lines, derivatives=False).h for side in (1, -1))
            wanted = (up - down) / 2e-4
            np.testing.assert_allclose(exact[..., forward.n_g + i], wanted, rtol=1e-5, atol=1e-7 * np.abs(up).max(), err_msg=f"{name} {i}")


def test_no_mode_is_lacking_where_what_is_left_does_not_add_to_its_drive_points():
    there = rest((0,))
    half = replace(there, data=0.5 * there.data)  # every residue of what is left is negative

    def again(idle):
        return [Case(idle, half, BAND, correlated=1.0)]

    [one] = again(Idle.of(identified((0,)), BAND, DOFS[:1]))
    state = replace(fit(one, one.forward.start), x=one.forward.start)
    [grown] = grown_by_a_mode([state, state])  # what two states agree on is looked at once
    assert grown.f[grown.lacking] == with_lacking(state).f[-1]
    assert with_mode(grown, again, score(state), lambda text: None) is None


def test_a_lacking_mode_is_looked_at_though_what_is_left_at_its_drive_point_has_the_other_sign():
    w, zeta, _, _ = modes()
    there, pole = rest((0,)), 1.07 * w[1]
    shape = np.array([0.03, 0.8, -0.6, 0.5, -0.7])  # hardly driven: other errors are larger at the drive point
    line = 2j * np.pi * HZ
    own = line**2 / (pole**2 + line**2 + 2 * zeta[1] * pole * line)
    sign = np.array([-1, 1, 1, 1, 1])
    lacking = replace(there, data=there.data + (sign * shape * shape[0])[:, None, None] * own)
    one = Case(Idle.of(identified((0,)), BAND, DOFS[:1]), lacking, BAND, correlated=1.0)
    grown = with_lacking(replace(fit(one, one.forward.start), x=one.forward.start))
    assert grown.f[grown.lacking] == pytest.approx(pole / 2 / np.pi, rel=1e-3)
    assert np.all(grown.phi[1:, grown.lacking] * grown.phi[1, grown.lacking] * shape[1:] * shape[1] > 0)


def operating_modes(heavier):
    mass, stiff = matrices()
    mass[1, 1] += 0.4 if heavier else 0
    values, vectors = np.linalg.eig(np.linalg.solve(mass, stiff))
    order = np.argsort(values.real)
    hz = np.sqrt(values.real[order]) / 2 / np.pi
    return ModalModel(hz, np.full(N, 0.008), vectors.real[:, order], DOFS, "unscaled")


@pytest.mark.parametrize(("heavier", "kind"), [(False, "sensor_mass"), (True, "point_mass")])
def test_a_mass_that_the_operating_record_knows_nothing_of_is_a_sensor_s(heavier, kind):
    found = diagnose_frf(identified(), [check_of(add_mass)], idle_frf=rest(), operating=operating_modes(heavier))
    assert [(e.kind, str(e.location[0])) for e in found.effects] == [(kind, "2+Z")]


def test_a_mass_stays_one_of_the_structure_unless_operational_modes_say_otherwise_beyond_three_sigma():
    one = case(add_mass)
    state = fit(one, replace(one.forward.start, u=np.zeros(len(one.forward.outside([TRUE]))), terms=(TRUE,)))
    assert of_a_sensor(copy.copy(state), identified(), None, None).terms[0].kind == "point_mass"
    light = operating_modes(False)
    gap = frequency_misfit(operating_modes(True), light)
    loose = replace(light, std=None, covariance=None)
    assert gap > WITHOUT_SENSOR
    assert of_a_sensor(state, identified(), loose, None).terms[0].kind == "sensor_mass"


TRUE = Term("point_mass", (1,), (float(np.log(0.4)),))


def test_power_is_asked_where_a_mode_moves_most_and_for_kinds_not_looked_for():
    quiet, loud = case(noise=1e-4), case(noise=30.0)
    assert unseen(fit(quiet, quiet.forward.start)) == []
    assert len(unseen(fit(loud, loud.forward.start))) == N
    few = Case(
        quiet.uncompressed,
        measured(matrices()[0], modes()[3], matrices()[1], (0, 3), 30.0, 0),
        BAND,
        correlated=1.0,
        kinds=("sensor_gain",),
    )
    assert len(unseen(fit(few, few.forward.start))) == N


@pytest.mark.parametrize(("apart", "one"), [(0.9, True), (1.1, False)])
def test_runs_of_two_levels_are_one_system_within_twice_their_noise(apart, one):
    low = rest()
    noise = np.sqrt(low.variance)
    # two runs without noise of their own, apart by the root of a share of ONE_SYSTEM times the variance of their difference
    high = replace(low, data=low.data + np.sqrt(2 * apart * ONE_SYSTEM) * noise)
    runs = [CheckRun("low", "1 N", low, 1.0), CheckRun("high", "4 N", high, 4.0)]
    assert levels_disagree(runs, BAND) is not one
    assert not levels_disagree([runs[0], replace(runs[1], level="1 N")], BAND)


@pytest.mark.parametrize(
    ("away", "damped", "separate"),
    [(0.9, 1.0, False), (1.1, 1.0, True), (0.0, 1 / 5, False), (0.0, 1 / 7, True)],
)
def test_a_mode_whose_curve_is_that_of_another_is_not_lacking(away, damped, separate):
    """By ``ALIKE_CURVES``: apart by its half-power width, or on the hump of a mode damped 3 + 2√2 times as much."""
    one = case()
    r = 2
    width = 2 * one.idle.zeta[r]
    grown = _grown(fit(one, one.forward.start), one.idle.f[r] * (1 + away * width), damped * one.idle.zeta[r], np.ones(N))
    case_of = Case(grown, rest(), BAND, correlated=1.0)
    state = SimpleNamespace(case=case_of, terms=case_of.idle.lacking_term)
    assert apart(state) is separate
    assert pytest.approx(4 * (3 + 2 * np.sqrt(2)) / (4 + 2 * np.sqrt(2)) ** 2) == ALIKE_CURVES
    assert apart(SimpleNamespace(case=case_of, terms=()))  # explained without it


def test_an_information_that_rounding_made_singular_is_factored():
    rng = np.random.default_rng(1)
    own = rng.standard_normal((1, 50, 2)) * 1e9
    shared = own @ rng.standard_normal((1, 2, 1))  # nothing is left of the shared unknown once those of the DOF are taken out
    factor = Factor.of(Information.of(shared, own), np.array([1e-9]), np.ones((1, 2)))
    assert ROUNDING < 1e-12
    assert np.isfinite(factor.lower).all()


def test_a_channel_whose_own_unknowns_do_the_same_and_are_told_beyond_rounding_is_factored():
    """Thirty unknowns of a DOF that move its FRFs in six ways, each 1e8 times the noise: their information has no inverse in 16 digits."""
    rng = np.random.default_rng(1)
    own = 1e8 * rng.standard_normal((1, 200, 6)) @ rng.standard_normal((1, 6, 30))
    shared = own @ rng.standard_normal((30, 4))
    factor = Factor.of(Information.of(shared, own), np.ones(4), np.ones((1, 30)))
    assert np.isfinite(factor.lower).all()
    assert np.isfinite(factor.half_log_determinant)


def test_an_effect_between_sensors_is_tried_at_the_places_beside_it():
    """The nearest ones of the same axis (``_BESIDE``); one at a sensor, whose shapes are known, stays there."""
    wider = with_midway(Idle.of(identified(), BAND, [DOFS[0], DOFS[3]]), LINE)
    one = Case(wider, check_of(add_mass).frf, BAND, SAME_SET_UP, kinds=("point_mass",))

    def beside(place):
        mass = Term("point_mass", (place,), (-1.0,))
        starts = Search(one, lambda text: None).beside(unfitted(one, started(one, (mass,)), 0.1), mass, ())
        return [t for x in starts for t in x.terms]

    assert [wider.midway[t.places[0]][0] for t in beside(N)] == [1.5, 2.5, 3.5]
    assert len(beside(N)) <= _BESIDE
    assert {(t.kind, t.values) for t in beside(N)} == {("point_mass", (-1.0,))}
    assert beside(1) == []


def test_a_mass_between_sensors_is_held_against_an_absorber_there():
    """With shapes that are hardly known a mass explains what an absorber does; from the shapes that the sensors suggest that is found."""
    mass, wa, zeta = 0.1, 2 * np.pi * 23.0, 0.08
    one, place = with_each_second_sensor(0.25, lambda s: mass * s**2 * (wa**2 + 2 * zeta * wa * s) / (s**2 + 2 * zeta * wa * s + wa**2))
    light = Term("point_mass", (place,), (float(np.log(0.1)),))
    own = np.ones_like(one.forward.start.own)
    state = unfitted(one, replace(started(one, (light,)), own=own), 0.1)
    (start,) = [x for x in Search(one, lambda text: None).beside(state, light, ()) if x.terms[0].kind == "tuned_absorber"]
    assert start.terms[0].places == (place,)
    np.testing.assert_allclose(np.exp(start.terms[0].values[:2]), [mass, wa / 2 / np.pi], rtol=0.3)
    assert not start.own.any()

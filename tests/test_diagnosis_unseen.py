"""What acts on a motion that no sensor shows: its law, how many motions, and how much of each mode it is; on chains with few sensors."""

from dataclasses import replace

import numpy as np
import pytest

from operando.data import Frf, ModalModel
from operando.diagnosis import diagnose_frf, unseen
from operando.diagnosis.between import UNSEEN_ABOVE
from operando.diagnosis.case import Case
from operando.diagnosis.idle import Idle
from operando.diagnosis.rival import score
from operando.diagnosis.unseen import _LIKE, _NEAR, LowRank, Way, _fitted, unseen_share, unseen_text, with_motions, with_unseen_motion
from operando.dof import Dof
from operando.results import CheckRun

N, SENSORS, DRIVEN = 9, (0, 2, 4, 5, 7), (0, 5)
DOFS = tuple(Dof.parse(f"{i + 1}+Z") for i in SENSORS)
HZ = np.arange(4.0, 50.0, 0.04)
BAND = (5.0, 45.0)
ZETA = 0.008


def chain():
    """Mass, stiffness, circular frequencies and shapes of unit modal mass: a chain's shapes, with three modes far above the band."""
    rng = np.random.default_rng(11)
    mass = np.diag(rng.uniform(0.8, 1.2, N))
    spring = rng.uniform(0.7, 1.3, N + 1)
    stiff = np.diag(spring[:-1] + spring[1:]) - np.diag(spring[1:-1], 1) - np.diag(spring[1:-1], -1)
    root = np.diag(1 / np.sqrt(np.diag(mass)))
    phi = root @ np.linalg.eigh(root @ stiff @ root)[1]
    w = 2 * np.pi * np.array([8.3, 13.7, 20.5, 26.0, 33.6, 40.6, 95.0, 120.0, 150.0])
    return mass, mass @ phi @ np.diag(w**2) @ phi.T @ mass, w, phi


def frf(change=None, seed=0, noise=2e-4):
    m, k, w, phi = (v.copy() for v in chain())
    c = m @ phi @ np.diag(2 * ZETA * w) @ phi.T @ m
    if change is not None:
        change(m, c, k)
    line = 2 * np.pi * HZ[:, None, None]
    h = np.linalg.inv(k - line**2 * m + 1j * line * c)[:, list(SENSORS)][:, :, list(DRIVEN)] * -(line**2)
    h = np.moveaxis(h, 0, 2)
    rng = np.random.default_rng(seed)
    size = noise * np.sqrt(np.mean(np.abs(h) ** 2))
    h = h + size * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    return Frf(h, HZ, DOFS, tuple(Dof.parse(f"{i + 1}+Z") for i in DRIVEN), variance=np.full(h.shape, size**2))


def model(seed=7):
    """The chain at rest as a test would know it: modes above the band are residual terms."""
    _, _, w, phi = chain()
    phi = phi[list(SENSORS)]
    n = phi.size
    std = np.concatenate([1e-5 * w / 2 / np.pi, np.full(N, 1e-3 * ZETA), np.full(n, 2e-4 * np.abs(phi).max())])
    start = np.concatenate([w / 2 / np.pi, np.full(N, ZETA), phi.T.ravel()])
    start = start + std * np.random.default_rng(seed).standard_normal(std.size)
    values = start[:N], start[N : 2 * N], start[2 * N :].reshape(N, len(SENSORS)).T
    known = {"scaling": "unit_modal_mass", "covariance": np.diag(std**2), "band_hz": BAND}
    return ModalModel.from_terms(*values, DOFS, residual=w / 2 / np.pi > BAND[1], **known)


def asked(change, seed=0):
    """The case where nothing was touched, and the same check with another idle model."""
    check = frf(change, seed)
    idle = Idle.of(model(7 + seed), BAND, [Dof.parse(f"{i + 1}+Z") for i in DRIVEN])

    def again(other):
        return [Case(other, check, BAND, {}, correlated=1.0)]

    return again(idle)[0], again


def masses(m, c, k):
    """On two masses that no sensor shows."""
    m[1, 1] += 0.2
    m[6, 6] += 0.3


def spring(m, c, k):
    k[3, 3] += 6e3


def damper(m, c, k):
    c[3, 3] += 15.0


def mass_away(m, c, k):
    m[8, 8] -= 0.1


@pytest.mark.parametrize(
    ("change", "law", "motions"),
    [
        (masses, ("point_mass", 1), 2),
        (spring, ("ground_spring", 1), 1),
        (damper, ("ground_damper", 1), 1),
        (mass_away, ("point_mass", -1), 1),
    ],
)
def test_the_law_and_the_number_of_motions_are_found(change, law, motions):
    state = with_unseen_motion(*asked(change), -np.inf)
    assert state is not None
    assert {(t.kind, t.sign) for t in state.terms} == {law}
    assert len(state.terms) == motions
    assert state.alpha < 0.002


@pytest.mark.parametrize("seed", range(6))
def test_the_share_of_each_mode_is_within_its_interval(seed):
    """Added mass over modal mass, mode by mode: all within 3.5 standard deviations, and most within two."""
    state = with_unseen_motion(*asked(masses, seed), -np.inf)
    _, _, w, phi = chain()
    inside = w / 2 / np.pi < BAND[1]
    wanted = 100 * (0.2 * phi[1] ** 2 + 0.3 * phi[6] ** 2)[inside]
    share, std = unseen_share(state)
    off = np.abs(share - wanted) / std
    assert off.max() < 3.5
    assert np.median(off) < 1.5
    assert "like a mass on 2 motions that no sensor shows" in unseen_text(state)


def test_effects_of_several_laws_are_not_one_law():
    def mixed(m, c, k):
        m[0, 0] += 0.3
        k[4, 4] += 9e3
        c[7, 7] += 30.0
        k[2, 2] -= 4e3

    assert with_unseen_motion(*asked(mixed), -np.inf) is None


def test_slopes_are_those_of_the_error():
    case, _ = asked(masses)
    low, rng = LowRank(case), np.random.default_rng(0)
    z = low.law("point_mass", 1)
    b, to = (0.1 * rng.standard_normal((low.modes.size, 2)) for _ in range(2))
    h = 1e-6
    along = (low.error(z, b + h * to) - low.error(z, b - h * to)) / (2 * h)
    np.testing.assert_allclose(low.slope(z, b) @ to.ravel(), along, atol=1e-5 * np.abs(along).max())


def test_the_evidence_does_not_depend_on_where_the_fit_began():
    """Its prior is about zero, wherever the least squares before it have come to."""
    case, again = asked(spring)
    low = LowRank(case)
    way = low.followed(low.one_more(Way(("ground_spring", 1), np.zeros((low.modes.size, 0)), 0.0)))[0]
    one = _fitted(case, again, way, -np.inf)
    other = _fitted(case, again, replace(way, b=way.b * np.linspace(0.99, 1.01, len(way.b))[:, None]), -np.inf)
    assert abs(score(one) - score(other)) < 1.0


def test_a_diagnosis_says_that_no_sensor_shows_it():
    check = CheckRun("run 1", "10 N rms", frf(masses))
    found = diagnose_frf(model(), [check], idle_frf=frf(seed=5))
    assert found.verdict == "unexplained"
    assert found.effects == ()
    assert "a mass on 2 motions that no sensor shows" in str(found.reason)
    assert "put sensors" in str(found.proposed_measurement)
    # what is missing is no noise: 0.02 % of the FRFs' rms is
    assert found.noise_floor_db is not None
    assert found.noise_floor_db < 0.2 * found.ladder[0]["error_db"]


def test_laws_and_numbers_of_motions_far_from_the_least_cost_are_not_fitted(monkeypatch):
    """_NEAR: the benchmark's right ones cost up to 1.2 times the least."""
    case, again = asked(spring)
    costs, fitted = (1.0, 0.99 * _NEAR, 1.01 * _NEAR), []
    ways = [Way(("ground_spring", 1), np.ones((case.idle.modes.size, 1)), cost) for cost in costs]
    monkeypatch.setattr(LowRank, "followed", lambda self, way: ways)
    monkeypatch.setattr(unseen, "_fitted", lambda case, again, way, floor: fitted.append(way.cost))
    assert with_unseen_motion(case, again, -np.inf) is None
    assert set(fitted) == set(costs[:2])


def test_the_best_of_each_law_that_was_followed_is_fitted_however_far_it_is(monkeypatch):
    """With the idle model as it is the right law may be caught in a valley; a fit with all unknowns leaves it."""
    case, again = asked(spring)
    fitted, one = [], np.ones((case.idle.modes.size, 1))
    costs = {True: (1.0, 1.01 * _NEAR), False: (3 * _NEAR, 2 * _NEAR)}
    first: list[tuple[str, int]] = []

    def followed(self, way):
        first.append(way.law)
        return [Way(way.law, one, cost) for cost in costs[way.law == first[0]]]

    monkeypatch.setattr(LowRank, "followed", followed)
    monkeypatch.setattr(unseen, "side_by_side", lambda function, items: [function(item) for item in items])
    monkeypatch.setattr(unseen, "_fitted", lambda case, again, way, floor: fitted.append(way.cost))
    assert with_unseen_motion(case, again, -np.inf) is None
    assert fitted == [1.0, 2 * _NEAR]


def test_sensors_are_named_that_move_as_the_motion_does():
    """_LIKE: at least half of what they do in the modes is along it."""
    state = with_unseen_motion(*asked(spring), -np.inf)
    (term,), modes = state.terms, state.case.forward.idle.modes
    phi = state.case.forward.moved(state.x).phi[:, modes]
    along = phi[term.places[0]] / np.linalg.norm(phi[term.places[0]])
    part = (phi[: len(SENSORS)] @ along) ** 2 / np.sum(phi[: len(SENSORS)] ** 2, axis=1)
    best = np.argsort(-part)[:2]
    text = unseen_text(state)
    for i in range(len(SENSORS)):
        assert (f"{DOFS[i]} (" in text) == (i in best and part[i] > _LIKE)


def test_above_the_band_nothing_is_known_of_a_motion_that_no_sensor_shows():
    """A rotation has more there than any sensor: with the little of these its share of the modes would be too large."""
    case, again = asked(masses)
    (wide,) = again(with_motions(case.uncompressed, np.ones((2, case.uncompressed.modes.size))))
    of_sensors = wide.between.own_above[: len(SENSORS)]
    np.testing.assert_allclose(wide.between.own_above[len(SENSORS) :], UNSEEN_ABOVE * np.median(case.between.own_above), rtol=0.5)
    assert wide.between.own_above[len(SENSORS) :].min() > of_sensors.max()

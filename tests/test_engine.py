"""The evidence engine of benchmarks/engine: derivatives, and effects found on chains whose FRFs come from matrices, not from modes."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from operando.data import Frf
from operando.dof import Dof

sys.path.append(str(Path(__file__).resolve().parents[1] / "benchmarks" / "engine"))

from idle import Idle
from kinds import Effect, candidates, stiffness
from model import SPREADS, Case
from posterior import at_rest, fit, names, on_validation_lines
from search import EXTRA, search

N = 5
DOFS = tuple(Dof.parse(f"{i}+Z") for i in range(1, N + 1))
HZ = np.arange(5.0, 60.0, 0.05)


def matrices():
    rng = np.random.default_rng(4)
    mass = np.diag(rng.uniform(0.8, 1.2, N))
    spring = rng.uniform(0.8, 1.2, N + 1) * 2.5e4
    stiff = np.diag(spring[:-1] + spring[1:]) - np.diag(spring[1:-1], 1) - np.diag(spring[1:-1], -1)
    return mass, stiff


def case(change=None, gains=None, warmer=0.0, noise=2e-4, references=(0, 3), between=0.0, seed=0):
    """A chain at rest, known to 1e-4 or so, and check FRFs of what ``change(mass, damping, stiffness)`` leaves of it."""
    mass, stiff = matrices()
    values, vectors = np.linalg.eigh(np.linalg.inv(np.sqrt(mass)) @ stiff @ np.linalg.inv(np.sqrt(mass)))
    phi, w = np.linalg.inv(np.sqrt(mass)) @ vectors, np.sqrt(values)
    zeta = np.linspace(0.006, 0.010, N)
    damping = mass @ phi @ np.diag(2 * zeta * w) @ phi.T @ mass
    m, c, k = mass.copy(), damping.copy(), stiff * (1 + warmer)
    if change is not None:
        change(m, c, k)
    line = 2 * np.pi * HZ[:, None, None]
    h = np.linalg.inv(k - line**2 * m + 1j * line * c)[:, :, list(references)] * -(line**2)
    h = np.moveaxis(h, 0, 2)
    if gains is not None:
        h = h * np.asarray(gains)[:, None, None]
    rng = np.random.default_rng(seed)
    size = noise * np.sqrt(np.mean(np.abs(h) ** 2))
    h = h + size * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    frf = Frf(h, HZ, DOFS, tuple(DOFS[i] for i in references), variance=np.full(h.shape, size**2))
    std = np.concatenate([1e-5 * w / 2 / np.pi, 1e-3 * zeta, np.tile(2e-4 * np.abs(phi).max(), N * N)])
    start = np.concatenate([w / 2 / np.pi, zeta, phi.T.ravel()]) + std * rng.standard_normal(std.size)
    idle = SimpleNamespace(
        frequencies_hz=start[:N], damping_ratios=start[N : 2 * N], shapes=start[2 * N :].reshape(N, N).T, dofs=DOFS,
        residual=np.zeros(N, bool), covariance=np.diag(std**2),
    )  # fmt: skip
    return Case(complex_modes(Idle.from_terms(idle, (6.0, 58.0)), between), frf, (6.0, 58.0))


def complex_modes(idle, std):
    """The model at rest with damping between its modes and lag of its shapes, known to ``std``."""
    if not std:
        return idle
    covariance = idle.covariance.copy()
    n, m = idle.between.size, idle.lag.size
    lag = 1e-3 * std
    covariance[-n - m :, -n - m :] = np.diag(np.repeat([std**2, lag**2], [n, m]))
    return replace(idle, between=np.full(n, std / 2), lag=np.full(idle.lag.shape, lag / 2), covariance=covariance)


def add_mass(m, c, k):
    m[1, 1] += 0.4


def add_damper(m, c, k):
    c[3, 3] += 40.0


def shifted(effect, j, by):
    return replace(effect, values=tuple(v + by * (i == j) for i, v in enumerate(effect.values)))


def test_derivatives_are_those_of_the_frfs():
    one = case(between=0.1)
    rng = np.random.default_rng(1)
    effects = [
        Effect("ground_spring", (2,), (np.log(3e3),)),
        Effect("gyroscopic", (0, 4), (np.log(2.0),), -1),
        Effect("tuned_absorber", (1,), (np.log(0.05), np.log(20.0), np.log(0.03))),
        Effect("global_stiffness", (), (np.log(0.01),)),
        Effect("sensor_delay", (3,), (1e-4,)),
    ]
    x = [0.3 * rng.standard_normal(n) for n in (one.n_z, one.n_d, len(one.outside(effects)))]
    x[1][one.parts["seen"]] = 0  # enters the derivatives by the others at first order only
    at, step = one.lines.fit[::9], 1e-5
    exact = one.predict(*x, effects, at)

    def slope(up, down, width):
        return (one.predict(*up, at, derivatives=False).h - one.predict(*down, at, derivatives=False).h) / width

    def check(slopes, which, i, name):
        sides = [[v + side * step * np.eye(v.size)[i] if j == which else v for j, v in enumerate(x)] for side in (1, -1)]
        numbers = slope([*sides[0], effects], [*sides[1], effects], 2 * step)
        np.testing.assert_allclose(slopes[..., i], numbers, rtol=1e-3, atol=3e-5 * np.abs(numbers).max() + 1e-18, err_msg=name)

    for i in (0, one.n_z // 2, one.n_z - 1):
        check(exact.by_z, 0, i, "z")
    for name in SPREADS:
        check(exact.by_d, 1, one.parts[name].start + min(2, one.parts[name].stop - one.parts[name].start - 1), name)
    assert len(x[2]) == 3 * (1 + 2)  # of the undriven places 1, 2 and 4: own and to the other two; the chain has nothing below the band
    for i in range(len(x[2])):
        check(exact.by_u, 2, i, "outside")
    n = 0
    for effect in effects:
        for j in range(len(effect.values)):
            width = 1e-5 * (1e-3 if effect.kind == "sensor_delay" else 1)
            moved = [
                [
                    Effect(e.kind, e.places, tuple(v + s * width * (e is effect and i == j) for i, v in enumerate(e.values)), e.sign)
                    for e in effects
                ]
                for s in (1, -1)
            ]
            numbers = slope((*x, moved[0]), (*x, moved[1]), 2 * width)
            np.testing.assert_allclose(exact.by_effects[..., n], numbers, rtol=1e-3, atol=1e-6 * np.abs(numbers).max(), err_msg=effect.kind)
            n += 1


def test_nothing_is_found_where_only_the_days_differ():
    found = search(case(gains=1 + 0.01 * np.random.default_rng(2).standard_normal(N), warmer=0.003))
    assert found.best.effects == []
    assert found.best.alpha < 0.002
    assert on_validation_lines(found.best.case, found.best)[0] < 1.3  # below 1: lines are taken for correlated, and are not here
    whole = found.best.case.parts["stiffness"]
    moved = (found.best.d * found.best.case.spread)[whole][0]
    assert moved == pytest.approx(0.003, abs=3 * found.best.std("stiffness")[0] * found.best.case.spread[whole][0])


@pytest.mark.parametrize(("change", "wanted", "size"), [(add_mass, "point_mass@2+Z", 0.4), (add_damper, "ground_damper@4+Z", 40.0)])
def test_one_effect_is_found_with_its_size_through_other_gains_and_another_temperature(change, wanted, size):
    found = search(case(change, gains=1 + 0.01 * np.random.default_rng(3).standard_normal(N), warmer=-0.002))
    best = found.best
    assert [text.split("=")[0] for text in names(best.case, best.effects)] == [wanted]
    std = float(np.sqrt(best.covariance[0, 0]))
    assert abs(np.log(best.effects[0].size / size)) < 3 * std
    assert found.empty.log_evidence < best.log_evidence - EXTRA


def test_a_change_of_all_stiffness_beyond_a_temperature_is_named():
    found = search(case(warmer=-0.03))
    assert [effect.kind for effect in found.best.effects] == ["global_stiffness"]
    # what a temperature may be is not known from the data
    assert found.best.effects[0].size == pytest.approx(-0.03, abs=3 * SPREADS["stiffness"])


def test_a_fit_ends_at_the_effect_it_starts_from():
    one = case(add_mass)
    state = fit(one, [Effect("point_mass", (1,), (np.log(0.35),))])
    assert state.effects[0].size == pytest.approx(0.4, rel=0.05)
    assert state.alpha < 0.002


def test_a_mass_is_found_through_complex_modes_at_rest():
    mass, stiff = matrices()
    values, vectors = np.linalg.eigh(np.linalg.inv(np.sqrt(mass)) @ stiff @ np.linalg.inv(np.sqrt(mass)))
    phi, w = np.linalg.inv(np.sqrt(mass)) @ vectors, np.sqrt(values)
    modal = np.diag(2 * np.linspace(0.006, 0.010, N) * w) + 8.0 * np.outer(phi[3], phi[3])  # a dashpot at 4+Z
    damping = mass @ phi @ modal @ phi.T @ mass
    line = 2 * np.pi * HZ[:, None, None]
    rng = np.random.default_rng(0)

    def measured(m):
        h = np.moveaxis(np.linalg.inv(stiff - line**2 * m + 1j * line * damping)[:, :, [0, 3]] * -(line**2), 0, 2)
        size = 2e-4 * np.sqrt(np.mean(np.abs(h) ** 2))
        h = h + size * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
        return Frf(h, HZ, DOFS, (DOFS[0], DOFS[3]), variance=np.full(h.shape, size**2))

    zeta, band = np.diag(modal) / (2 * w), (6.0, 58.0)
    start = SimpleNamespace(
        frequencies_hz=w / 2 / np.pi, damping_ratios=1.05 * zeta, shapes=phi, dofs=DOFS, residual=np.zeros(N, bool),
        covariance=np.diag(np.concatenate([1e-5 * w, 1e-3 * zeta, np.full(N * N, 2e-4)]) ** 2),
    )  # fmt: skip
    idle, state = at_rest(Idle.from_terms(start, band), measured(mass), band)
    assert state.alpha < 0.002
    np.testing.assert_allclose(idle.zeta, zeta, rtol=0.01)
    heavier = mass.copy()
    heavier[1, 1] += 0.1
    best = search(Case(idle, measured(heavier), band)).best
    assert [(e.kind, e.places) for e in best.effects] == [("point_mass", (1,))]
    assert abs(np.log(best.effects[0].size / 0.1)) < 3 * np.sqrt(best.covariance[0, 0])
    assert on_validation_lines(best.case, best)[0] < 1.3


def test_candidates_leave_out_what_is_there():
    there = [Effect("point_mass", (0, 1), (0.0,)), Effect("gyroscopic", (0, 2), (0.0,))]
    found = set(candidates([(0, 1), (2,), (3,), (4,)], there))
    assert not {("point_mass", (0, 1)), ("point_mass", (0,))} & found
    assert ("gyroscopic", (0, 2)) not in found
    assert {("point_mass", (2,)), ("tuned_absorber", (1,)), ("global_damping", ())} <= found
    one_place, two_places, whole = 7, 4, 2
    assert len(found) == one_place * N - 1 + two_places * N * (N - 1) // 2 + whole - len(there)


def test_an_absorber_far_below_its_frequency_is_a_mass():
    w = 2 * np.pi * np.array([1.0, 2.0])
    mass = stiffness(Effect("point_mass", (0,), (0.0,)), w)[0]
    np.testing.assert_allclose(stiffness(Effect("tuned_absorber", (0,), (0.0, np.log(1e4), np.log(0.02))), w)[0], mass, rtol=1e-6)

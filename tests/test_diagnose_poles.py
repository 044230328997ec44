"""Poles under effects that say no mass, damping and stiffness matrices: all of them, each once."""

from __future__ import annotations

import numpy as np
import pytest

from effect_truth import at, chain_and_idle, pole_list
from operando.data import ModalModel
from operando.structure import Model

N = 6
W0 = 2 * np.pi * 60.0


@pytest.mark.parametrize("kind", ["ground_hysteretic_spring", "ground_rubber"])
def test_no_pole_is_lost_however_stiff_the_effect(kind):
    chain, idle = chain_and_idle()
    rng = np.random.default_rng(3)
    for size in 10.0 ** rng.uniform(3, 8, 20):
        share = rng.uniform(0.1, 0.7)
        place = int(rng.integers(N))
        more = f"loss_factor:{share}" if "hyst" in kind else f"exponent:{share},reference_hz:60"
        law = (lambda s, a=share: 1 + 1j * a) if "hyst" in kind else (lambda s, a=share: (s / W0) ** a)
        modes = Model(idle).add(f"{kind}@{place + 1}+Z=stiffness:{size},{more}").add("point_mass@2+Z=mass:0.3").modes()
        assert modes.n_modes == N, size
        for pole, shape in zip(modes.poles, modes.shapes.T, strict=True):
            d = pole**2 * (chain.M + 0.3 * at(N, 1)) + pole * chain.C + chain.K + size * law(pole) * at(N, place)
            assert np.linalg.norm(d @ shape) / np.linalg.norm(d, 2) / np.linalg.norm(shape) < 1e-9


def test_an_own_kind_without_matrices_has_all_its_poles_also_beside_a_mass_or_an_absorber(inerter):
    chain, idle = chain_and_idle()
    for value, place, mass in ((0.05, (1, 3), 0.2), (0.4, (1, 4), 0.7), (50.0, (0, 5), 3.0)):
        b = chain.M + value * at(N, *place) + mass * at(N, place[0])
        text = f"{inerter}@{place[0] + 1}+Z,{place[1] + 1}+Z=inertance:{value}"
        for order in (1, -1):
            model = Model(idle)
            for effect in (text, f"point_mass@{place[0] + 1}+Z=mass:{mass}")[::order]:
                model = model.add(effect)
            assert np.allclose(model.modes().poles, pole_list(b, chain.C, chain.K), rtol=1e-8)
    absorber = "tuned_absorber@3+Z=mass:0.3,frequency:50,damping_ratio:0.05"
    poles = Model(idle).add(f"{inerter}@2+Z,5+Z=inertance:0.4").add(absorber).modes().poles
    mass, damping, stiffness = (np.pad(a, (0, 1)) for a in (chain.M + 0.4 * at(N, 1, 4), chain.C, chain.K))
    between = np.eye(N + 1)[2] - np.eye(N + 1)[N]
    mass[N, N] = 0.3
    damping += 2 * 0.05 * 100 * np.pi * 0.3 * np.outer(between, between)
    stiffness += (100 * np.pi) ** 2 * 0.3 * np.outer(between, between)
    assert np.allclose(poles, pole_list(mass, damping, stiffness), rtol=1e-8)


def test_equal_poles_stay_two_under_an_effect_that_one_of_them_feels():
    shapes = np.eye(3)
    idle = ModalModel([40.0, 40.0, 90.0], [0.01] * 3, shapes, ["1+Z", "2+Z", "3+Z"], "unit_modal_mass", band_hz=(5.0, 120.0))
    modes = Model(idle).add("ground_hysteretic_spring@3+Z=stiffness:1e4,loss_factor:0.2").modes()
    assert modes.n_modes == 3
    assert np.allclose(modes.frequencies_hz[:2], 40.0, rtol=1e-6)
    assert np.linalg.svd(modes.shapes[:, :2])[1][-1] > 0.5

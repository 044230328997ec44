"""All modes at one factor from their idle partners: a wrong sampling rate, or the whole structure changed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from operando.data import ModalModel
from operando.scaling import scale_operational
from operando.scaling.common_factor import common_factor
from structures import Chain, modified

CHAIN = Chain(6)
STD = 2e-4
"""Relative standard deviation of the frequencies, as of a good operational record."""


def model(chain, scaling, std=STD, seed=0, factor=1.0):
    rng = np.random.default_rng(seed)
    n, m = chain.hz.size, chain.phi.shape[0]
    hz = chain.hz * factor * (1 + std * rng.standard_normal(n))
    complex_shapes = scaling == "unscaled"
    shapes = chain.phi * np.exp(0.3j) if complex_shapes else chain.phi
    spread = np.concatenate([std * hz, np.full(n, 1e-4), np.full(n * m * (2 if complex_shapes else 1), 1e-3)])
    dofs = tuple(f"{i + 1}+Z" for i in range(m))
    return ModalModel(hz, np.full(n, 0.01), shapes, dofs, scaling, covariance=np.diag(spread**2), band_hz=(0.5 * hz[0], 1.1 * hz[-1]))


def findings(chain, **keywords):
    idle = model(CHAIN, "unit_modal_mass", seed=1)
    return [f for f in scale_operational(idle, model(chain, "unscaled", **keywords)).findings if f.kind == "sampling_rate"]


@pytest.mark.parametrize("factor", [500 / 512, 512 / 500])
def test_wrong_header_is_found_with_its_factor(factor):
    (found,) = findings(CHAIN, factor=factor)
    assert _value(found.message) == pytest.approx(factor, rel=2 * STD)
    assert "500" in found.message
    assert "512" in found.message
    assert "stiffness of the whole structure" in found.consequence  # a real change of all parts looks the same
    assert "header" in found.action


def test_nothing_is_said_of_the_same_structure():
    assert not any(findings(CHAIN, seed=s) for s in range(2, 30))


def test_nothing_is_said_of_a_local_change():
    for dof in range(6):
        for added in (0.1, 0.5):
            assert not findings(modified(CHAIN, mass=(dof, added)), seed=3 + dof)
            assert not findings(modified(CHAIN, spring=(dof, 2e5 * added)), seed=3 + dof)


def _value(message):
    return float(message.split(" lie at ")[1].split(" ±")[0])


def test_a_whole_change_of_stiffness_reads_the_same():
    (found,) = findings(modified(CHAIN, global_stiffness=0.05))
    assert _value(found.message) == pytest.approx(np.sqrt(1.05), rel=2 * STD)


def test_warmth_is_too_little():
    assert not findings(CHAIN, factor=0.998)


def test_ratios_too_uncertain_to_tell():
    hz = np.array([10.0, 20.0, 30.0])
    wide = 0.02 * hz
    assert not common_factor(hz, hz * 0.98, wide, wide)[2]
    fine = 1e-4 * hz
    factor, std, one = common_factor(hz, hz * 0.98, fine, fine)
    assert one
    assert factor == pytest.approx(0.98)
    assert std < 2e-4
    assert not common_factor(hz, hz * np.array([0.98, 0.98, 0.99]), fine, fine)[2]


def test_models_without_deviations_are_left_alone():
    idle = replace(model(CHAIN, "unit_modal_mass"), covariance=None)
    hybrid = scale_operational(idle, model(CHAIN, "unscaled", factor=0.97))
    assert not [f for f in hybrid.findings if f.kind == "sampling_rate"]

"""Both halves of an operating record identified apart."""

from __future__ import annotations

import numpy as np
import pytest

from operando.oma import fit_halves, fit_oma
from structures import Chain
from test_oma_fit import BAND, CHAIN, FS, check_modes, record, simulate


def _sine(x, hz):
    return x + 2 * x.std() * np.sin(2 * np.pi * hz * np.arange(x.shape[1]) / FS)


@pytest.fixture(scope="module")
def run():
    return record(_sine(simulate(CHAIN, 200.0, FS, 1), 33.0))


@pytest.fixture(scope="module")
def whole(run):
    return fit_oma(run, band=BAND)


def test_each_half_finds_the_modes_without_the_sinusoid(run, whole):
    halves = fit_halves(run, whole)
    assert len(halves) == 2
    for half in halves:
        check_modes(half)
        assert half.details is None
    # Half the time tells frequencies √2 less well, and the halves are independent.
    ratio = np.mean(halves[0].frequency_std_hz / whole.frequency_std_hz)
    assert 1.2 < ratio < 1.7
    assert not np.allclose(halves[0].frequencies_hz, halves[1].frequencies_hz, rtol=1e-6)


def test_the_halves_are_halves_of_time(whole):
    # The structure changes half-way: each half shows its own state.
    stiffer = Chain(5, 1.0, 4.4e4, CHAIN.zeta)
    x = np.concatenate([simulate(CHAIN, 100.0, FS, 2), simulate(stiffer, 100.0, FS, 3)], axis=1)
    first, second = fit_halves(record(x), whole)
    check_modes(first)
    check_modes(second, stiffer)


def test_a_record_too_short_for_halves_has_none(whole):
    assert fit_halves(record(simulate(CHAIN, 1.0, FS, 1)), whole) == ()

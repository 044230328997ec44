"""Candidate poles of analytic chains and of the practice cases, and the second opinion on them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from operando.ema.candidates import candidate_poles, stabilization_diagram
from operando.ema.second_opinion import DAMPING_TOLERANCE, FREQUENCY_TOLERANCE, second_opinion
from operando.errors import DataError, IdentificationError
from structures import Chain

CASES = Path(__file__).resolve().parents[1].parent / "shared" / "cases"
DATA = CASES.parent / "data"


def noisy(H, sigma, seed=0):
    rng = np.random.default_rng(seed)
    return H + sigma * (rng.standard_normal(H.shape) + 1j * rng.standard_normal(H.shape)) / np.sqrt(2)


def matched(candidates, hz, zeta):
    """The best supported candidate within half a bandwidth of each mode, or None."""
    out = []
    for h, z in zip(hz, zeta, strict=True):
        near = [c for c in candidates if abs(c.frequency_hz / h - 1) < max(0.5 * z, 5e-4)]
        out.append(max(near, key=lambda c: c.support, default=None))
    return out


def test_all_modes_and_nothing_else():
    chain = Chain(10, zeta=np.linspace(0.004, 0.012, 10), seed=4)
    f = np.arange(5, 165, 0.1)
    H = chain.accelerance(f, ref=[0, 6])
    sigma = 0.003 * np.mean(np.abs(H))
    found = [c for c in candidate_poles(f, noisy(H, sigma), np.full(H.shape, 1 / sigma)) if c.prominent]
    assert len(found) == 10
    np.testing.assert_allclose([c.frequency_hz for c in found], chain.hz, rtol=2e-4)
    np.testing.assert_allclose([c.damping_ratio for c in found], chain.zeta, rtol=0.02)
    assert all(c.support > 0.5 for c in found)


def test_a_weak_low_mode_under_a_noise_floor_of_acceleration_is_not_lost():
    # accelerance weights a mode at 5 Hz by (5/100)² against one at 100 Hz
    hz, zeta = np.array([5.0, 40.0, 90.0, 97.0]), np.full(4, 0.01)
    phi = np.random.default_rng(3).standard_normal((6, 4))
    f = np.arange(2, 110, 0.04)
    w, wr = 2 * np.pi * f, 2 * np.pi * hz
    kernel = -(w**2) / (wr[:, None] ** 2 - w**2 + 2j * zeta[:, None] * wr[:, None] * w)
    H = np.einsum("ir,jr,rk->ijk", phi, phi[:2], kernel)
    found = matched(candidate_poles(f, noisy(H, 0.05)), hz, zeta)
    assert all(c is not None and c.prominent for c in found)


def test_wrong_band_is_explained():
    f = np.arange(5, 165, 0.5)
    H = Chain(4).accelerance(f, ref=[0])
    with pytest.raises(IdentificationError, match="no fit possible"):
        candidate_poles(f, H, band=(20, 24))


def test_stabilization_diagram_selects_and_draws():
    chain = Chain(6, zeta=0.01)
    f = np.arange(10, 150, 0.25)
    H = chain.accelerance(f, ref=[0, 3])
    diagram = stabilization_diagram(f, noisy(H, 0.003 * np.mean(np.abs(H))), max_order=16)
    np.testing.assert_allclose(diagram.selected_hz, chain.hz, rtol=1e-3)
    assert diagram.indicator is not None
    assert diagram.indicator.shape == (2, f.size)
    assert np.any(diagram.table.status == 4)  # unstable poles are shown, not dropped
    less = stabilization_diagram(f, H, max_order=16, reject_hz=[chain.hz[2]])
    assert [r.code for r in less.rejected].count("by_hand") == 1


def exact_case(name):
    """Noisy FRFs of a case from its exact idle modes, all sixteen, at the sensors; noise as of a 64 s record."""
    answer = json.loads((CASES / "answers" / f"{name}.json").read_text())
    phi, hz, zeta = np.array(answer["idle_shapes"]), np.array(answer["idle_hz"]), np.array(answer["idle_zeta"])
    low, high = answer["band"]
    f = np.arange(low, 1.25 * high, 1 / 16)
    w, wr = 2 * np.pi * f, 2 * np.pi * hz
    kernel = -(w**2) / (wr[:, None] ** 2 - w**2 + 2j * zeta[:, None] * wr[:, None] * w)
    refs = [answer["nodes"].index(r) for r in answer["refs"]]
    H = np.einsum("ir,jr,rk->ijk", phi, phi[refs], kernel)
    sigma = 0.003 * np.sqrt(np.mean(np.abs(H) ** 2, axis=2, keepdims=True)) * np.ones(f.size)
    return f, noisy(H, sigma), sigma, hz, zeta, high


@pytest.mark.skipif(not CASES.exists(), reason="the practice cases are not beside the project")
@pytest.mark.parametrize("name", ["p1", "p2", "p3", *(pytest.param(n, marks=pytest.mark.slow) for n in ("p4", "p5"))])
def test_every_mode_of_the_cases_is_a_prominent_candidate(name):
    f, H, sigma, hz, zeta, high = exact_case(name)
    candidates = candidate_poles(f, H, 1 / sigma)
    inside = hz < high
    found = matched(candidates, hz[inside], zeta[inside])
    assert all(c is not None and c.prominent for c in found)
    assert sum(c.prominent for c in candidates if c.frequency_hz < high) <= inside.sum() + 1
    assert np.max(np.abs([c.frequency_hz / h - 1 for c, h in zip(found, hz[inside], strict=True)])) < 5e-4
    assert np.max(np.abs([c.damping_ratio / z - 1 for c, z in zip(found, zeta[inside], strict=True)])) < 0.03


@pytest.mark.skipif(not DATA.exists(), reason="the measured data are not beside the project")
def test_bridge_has_its_six_published_modes_and_no_other():
    from operando.io import read

    frfs = read(DATA / "bridge" / "dam0.unv").frfs
    H = np.concatenate([np.asarray(x.data) for x in frfs])
    found = [c.frequency_hz for c in candidate_poles(frfs[0].frequencies_hz, H, band=(1.5, 6)) if c.prominent]
    # published: 2.48, 2.96, 3.50, 4.08, 4.17, 4.63 Hz
    np.testing.assert_allclose(found, [2.482, 2.958, 3.498, 4.08, 4.17, 4.632], rtol=0.006)


@pytest.mark.skipif(not DATA.exists(), reason="the measured data are not beside the project")
def test_bookcase_has_its_three_modes():
    H = np.load(DATA / "bookcase" / "frf.npz")["data"].T[:, None, :]
    found = [c.frequency_hz for c in candidate_poles(np.arange(1601) / 16, H, band=(15, 80)) if c.prominent]
    np.testing.assert_allclose(found, [21.4, 50.0, 68.3], rtol=0.005)


@pytest.mark.parametrize(("of_limit", "agrees"), [(0.9, True), (1.1, False)])
def test_a_second_opinion_agrees_within_its_tolerances(of_limit, agrees):
    chain = Chain(6, zeta=0.01)
    f = np.arange(10, 160, 0.25)
    H = chain.accelerance(f, ref=[0])
    [off_hz] = second_opinion(f, H, chain.hz[1:2] * (1 + of_limit * FREQUENCY_TOLERANCE), chain.zeta[1:2], references=["1+Z"])
    [off_damping] = second_opinion(f, H, chain.hz[1:2], chain.zeta[1:2] / (1 + of_limit * DAMPING_TOLERANCE), references=["1+Z"])
    assert (off_hz["agrees"], off_damping["agrees"]) == (agrees, agrees)


@pytest.mark.parametrize("offset", [0.0, 0.07])
def test_second_opinion_agrees_on_good_modes_and_not_on_bad_ones(offset):
    chain = Chain(6, zeta=0.01)
    f = np.arange(10, 160, 0.25) + offset
    H = chain.accelerance(f, ref=[0])
    H.setflags(write=False)
    zeta = chain.zeta.copy()
    zeta[2] *= 1.5
    out = second_opinion(f, H, np.append(chain.hz, 152.0), np.append(zeta, 0.01), references=["1+Z"])
    assert [r["agrees"] for r in out] == [True, True, False, True, True, True, False]
    assert out[0]["reference"] == "1+Z"
    np.testing.assert_allclose([r["second_frequency_hz"] for r in out[:6]], chain.hz, rtol=2e-4)
    assert "damping" in out[2]["note"]
    assert out[6]["second_frequency_hz"] is None


def test_second_opinion_is_contained():
    code = (
        "import numpy as np, sys, os\n"
        "from operando.ema.second_opinion import second_opinion\n"
        "assert not {'matplotlib', 'sdypy', 'pyuff', 'pandas'} & set(sys.modules)\n"
        "f = np.arange(10, 100, .25)\n"
        "H = (1 / (50**2 - f**2 + 1j * f))[None, None, :]\n"
        "before = np.geterr()\n"
        "second_opinion(f, H, [50.0], [0.01])\n"
        "assert np.geterr() == before and 'MPLBACKEND' not in os.environ\n"
    )
    run = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, env=_plain_environment())
    assert run.returncode == 0, run.stderr
    assert run.stderr == ""
    assert run.stdout == ""


def _plain_environment():
    return {k: v for k, v in os.environ.items() if k != "MPLBACKEND"}


def test_second_opinion_wants_even_lines():
    f = np.array([1.0, 2.0, 4.0, 5.0])
    with pytest.raises(DataError, match="evenly"):
        second_opinion(f, np.ones((1, 1, 4), complex), [2.0], [0.01])

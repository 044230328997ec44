"""Operational modes that nobody found, told by what the found ones leave of the idle modes."""

import numpy as np
import pytest
from scipy.linalg import eigh

from operando.data import ModalModel
from operando.dof import Dof
from operando.scaling import scale_operational
from operando.scaling.missing import BEYOND, missing_modes
from structures import Chain

N = 10
DOFS = tuple(Dof.parse(f"{i}+Z") for i in range(1, N + 1))
IDLE_HZ = np.arange(10.0, 60.0, 10.0)


def rotated(angle):
    """Five operational modes in five idle ones, the last two mixed."""
    q = np.eye(5)
    q[3:, 3:] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return q


def test_nothing_is_missing_where_every_idle_mode_is_held():
    assert missing_modes(rotated(0.7), IDLE_HZ, np.arange(5), (5.0, 55.0), True).hz.size == 0


def test_idle_modes_carried_over_by_themselves_are_not_missing():
    found = missing_modes(np.eye(5)[:, :4], IDLE_HZ, np.arange(4), (5.0, 55.0), True)
    assert found.hz.size == 0
    assert found.finding is None


@pytest.mark.parametrize(("rising", "place"), [(True, 55.0 * BEYOND), (False, 5.0 / BEYOND)])
def test_a_mixture_that_is_in_no_mode_found_is_put_beyond_the_band(rising, place):
    q = rotated(0.7)
    found = missing_modes(q[:, :4], IDLE_HZ, np.arange(5), (5.0, 55.0), rising)
    np.testing.assert_allclose(np.abs(found.mixture[:, 0]), np.abs(q[:, 4]), atol=1e-12)
    np.testing.assert_allclose(found.hz, place)
    assert found.idle_hz == (40.0, 50.0)
    assert "40.0, 50.0 Hz" in found.finding.message


def test_two_modes_of_the_same_mixture_hold_it_once():
    """An absorber splits a mode in two of like shape: they hold one idle mode, and the others are still looked at."""
    q = np.c_[np.eye(5)[:, :4], np.eye(5)[:, 3] + 1e-3 * np.eye(5)[:, 4]]
    assert missing_modes(q, IDLE_HZ, np.arange(5), (5.0, 55.0), True).hz.size == 1


def test_the_band_holds_a_mode_that_operation_pushed_out_of_the_band():
    """A stiff support at the end of a chain: one mode fewer in band, and it is made of several idle ones."""
    chain = Chain(N, spread=0.3, seed=1)
    stiff = np.array(chain.K)
    stiff[4, 4] += 40 * np.max(np.diag(chain.K))
    value, phi = eigh(stiff, chain.M)
    hz = np.sqrt(value) / 2 / np.pi
    band = (0.5 * chain.hz[0], 1.02 * chain.hz[-1])
    inside = hz < band[1]
    assert inside.sum() == N - 1
    idle = ModalModel(
        chain.hz, chain.zeta, chain.phi, DOFS, "unit_modal_mass", covariance=np.diag(np.full(N * (2 + N), 1e-12)), band_hz=band, si=True
    )
    k = int(inside.sum())
    running = ModalModel(
        hz[inside], chain.zeta[:k], phi[:, inside] + 0j, DOFS, "unscaled", covariance=np.diag(np.full(k * (2 + 2 * N), 1e-12)), band_hz=band
    )
    hybrid = scale_operational(idle, running, threshold=0.5)
    assert hybrid.modal.residuals.frequencies_hz[-1] == pytest.approx(band[1] * BEYOND)
    assert "beyond the band" in hybrid.residuals
    assert [f for f in hybrid.findings if f.kind == "mode_not_found"]
    # The exact FRF at the place of the support, with the mode far above, lies within the band.
    lines = np.linspace(*band, 200)
    w, own = 2 * np.pi * lines, 2 * np.pi * hz[:, None]
    gain = -(w**2) / (own**2 - w**2 + 2j * chain.zeta[0] * own * w)
    exact = np.einsum("or,sr,rl->osl", phi, phi, gain)
    frf = hybrid.frf(lines)
    without = hybrid.modal.select_terms(np.arange(hybrid.modal.terms.n - 1)).frf(lines)
    inside_band = [np.mean(np.abs(made.data - exact) ** 2 < 3 * made.variance) for made in (frf, without)]
    assert inside_band[0] > 0.95
    assert inside_band[1] < inside_band[0]

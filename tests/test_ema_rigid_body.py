"""Rigid-body mass from a modal model, against a free chain of masses in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from operando.data import Frf, ModalModel
from operando.ema import fit_ema, rigid_body_mass
from operando.errors import DataError, DofError

DOFS = ("1+Z", "2+Z", "3+Z")


def chain(suspension=0.3):
    """Three masses of 2, 3 and 4 kg on springs between them, hung softly as one body: (Hz, shapes of unit modal mass)."""
    from scipy.linalg import eigh

    m = np.diag([2.0, 3.0, 4.0])
    k = 6e4 * np.array([[1.0, -1, 0], [-1, 2, -1], [0, -1, 1]]) + (2 * np.pi * suspension) ** 2 * m
    w2, phi = eigh(k, m)
    return np.sqrt(w2) / 2 / np.pi, phi


def model(**changes):
    hz, phi = chain()
    given = {"scaling": "unit_modal_mass", "residual": [True, False, False], "band_hz": (5.0, 60.0)} | changes
    return ModalModel.from_terms(hz, np.full(3, 0.01), phi, DOFS, **given)


def test_mass_of_a_free_chain_is_the_sum_of_its_masses():
    found = rigid_body_mass(model(), "2+Z", 30.0)
    assert found.mass_kg == pytest.approx(9.0, rel=2e-4)
    assert (found.std_kg, found.frequency_hz, found.n_modes) == (None, 30.0, 1)
    # at the band edge the suspension at 0.3 Hz still shows, by the factor 1 − (f₀/f)²
    assert rigid_body_mass(model(), "2-Z").mass_kg == pytest.approx(9.0 * (1 - 0.06**2), rel=1e-4)


def test_standard_deviation_is_the_scatter_of_draws():
    covariance = np.diag(np.full(15, 1e-12))
    covariance[6:9, 6:9] = 1e-4 * np.array([[1.0, 0.5, 0], [0.5, 4, 0], [0, 0, 1]])  # in the order given: the suspension first
    given = model(covariance=covariance)
    found = rigid_body_mass(given, "2+Z")
    rng = np.random.default_rng(0)
    shift = np.sqrt(covariance[7, 7]) * rng.standard_normal(4000)
    phi = given.residuals.shapes[1, 0] + shift
    scatter = np.std((1 - 0.06**2) / phi**2)
    assert found.std_kg == pytest.approx(scatter, rel=0.06)


def test_from_a_fit_of_noisy_frfs():
    hz, phi = chain()
    f = np.arange(0.25, 80, 0.25)
    kernel = -(f**2) / (hz[:, None] ** 2 - f**2 + 2j * 0.01 * hz[:, None] * f)
    h = np.einsum("ir,jr,rl->ijl", phi, phi[:1], kernel)
    rng = np.random.default_rng(1)
    std = 2e-4 * np.ones_like(np.abs(h))
    h = h + std * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    found = rigid_body_mass(fit_ema(Frf(h, f, DOFS, ("1+Z",), variance=std**2), band=(5.0, 60.0)), "1+Z")
    assert found.mass_kg == pytest.approx(9.0, rel=0.02)
    assert found.std_kg is not None
    assert 0 < found.std_kg < 0.5


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"scaling": "unscaled"}, "no mass"),
        ({"si": False}, "no mass"),
        ({"band_hz": None}, "no band"),
        ({"band_hz": (0.1, 60.0)}, "no mode below"),
    ],
)
def test_without_scale_or_rigid_body_it_says_so(changes, words):
    with pytest.raises(DataError, match=words):
        rigid_body_mass(model(**changes), "1+Z")


def test_unknown_place_or_frequency():
    with pytest.raises(DofError):
        rigid_body_mass(model(), "9+Z")
    with pytest.raises(DataError, match="0 Hz"):
        rigid_body_mass(model(), "1+Z", 0.0)

"""An effect at a place without a sensor: found between two sensors, with the measured places alone left unexplained."""

from __future__ import annotations

import numpy as np
import pytest

from operando.data import FrequencyAxis, Frf, Geometry, ModalModel
from operando.diagnosis import diagnose
from operando.dof import Dof
from operando.results import CheckRun

LENGTH, MODES, NODES = 2.0, 8, 9


def beam(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies [Hz] and shapes of a pinned beam of 8 kg at places x: analytic."""
    n = np.arange(1, MODES + 1)
    return 9.0 * n**2 / 4 + 5, np.sqrt(2 / 8.0) * np.sin(np.pi * n * x[:, None] / LENGTH)


def made(mass_at: float, mass: float) -> tuple[ModalModel, CheckRun, Geometry]:
    x = np.linspace(0.2, 1.8, NODES)
    hz_modes, shapes = beam(x)
    dofs = tuple(Dof(10 * (i + 1), "Z", 1) for i in range(NODES))
    n, m = MODES, NODES
    spread = np.r_[1e-6 * hz_modes, np.full(n, 1e-6), 1e-5 * np.ones(n * m)]
    idle = ModalModel.from_terms(
        hz_modes,
        np.full(n, 0.01),
        shapes,
        dofs,
        "unit_modal_mass",
        residual=np.arange(n) >= 7,
        in_band=np.arange(n) < 6,
        covariance=np.diag(spread**2),
        band_hz=(4.0, 100.0),
    )
    b = beam(np.array([mass_at]))[1][0]
    hz = np.linspace(4.0, 100.0, 700)
    s = 2j * np.pi * hz
    w = 2 * np.pi * hz_modes
    references = [1, 4]
    data = np.empty((m, 2, hz.size), complex)
    for k, sk in enumerate(s):
        dynamic = np.diag(w**2 + 2 * 0.01 * w * sk + sk**2) + mass * sk**2 * np.outer(b, b)
        data[:, :, k] = sk**2 * shapes @ np.linalg.solve(dynamic, shapes[references].T)
    rng = np.random.default_rng(3)
    noise = 2e-3 * np.sqrt(np.mean(np.abs(data) ** 2))
    variance = np.full(data.shape, noise**2)
    measured = data + noise * np.sqrt(0.5) * (rng.standard_normal(data.shape) + 1j * rng.standard_normal(data.shape))
    frf = Frf(measured, FrequencyAxis(hz), dofs, tuple(dofs[r] for r in references), "accelerance", variance=variance)
    points = np.c_[x, np.zeros(m), np.zeros(m)]
    return idle, CheckRun("run", "", frf), Geometry(tuple(d.node for d in dofs), points)


@pytest.mark.slow
@pytest.mark.parametrize("where", [0.9, 1.3])
def test_a_mass_between_two_sensors_is_placed_there(where: float) -> None:
    idle, run, geometry = made(where, 0.5)
    found = diagnose(idle, check=[run], geometry=geometry)
    assert [e.kind for e in found.effects] == ["point_mass"]
    effect = found.effects[0]
    assert effect.position is not None
    assert effect.position[0] == pytest.approx(where, abs=1e-9)
    assert found.verdict in ("explained", "ambiguous")
    assert found.ladder[-1]["heldout_misfit"] < 2 < 50 < found.ladder[0]["heldout_misfit"]
    assert effect.values["mass"] == pytest.approx(0.5, abs=3 * effect.std["mass"])
    assert effect.to_dict()["location"] == []
    assert effect.to_dict()["position"] == list(effect.position)


def test_without_geometry_no_place_is_invented() -> None:
    idle, run, _ = made(0.9, 0.05)
    found = diagnose(idle, check=[run], kinds=("point_mass",))
    assert all(e.position is None for e in found.effects)
    assert found.verdict != "no_misfit"

"""Two days in a laboratory move and damp modes just outside the band as well: their flanks are no effect."""

from __future__ import annotations

import numpy as np
import pytest

from operando.data import FrequencyAxis, Frf, ModalModel
from operando.diagnosis import diagnose
from operando.diagnosis.idle import Idle
from operando.dof import Dof
from operando.results import CheckRun

BAND, NODES, REFERENCES = (4.0, 58.0), 7, [1, 4]
HZ = 9.0 * np.arange(1, 8) ** 2 / 4 + 5  # 7.25, 14, 25.25, 41 Hz in band; the fifth at 61.25 Hz, 5 % above it
X = np.linspace(0.1, 0.9, NODES)
SHAPES = 0.5 * np.sin(np.pi * np.arange(1, 8) * X[:, None])
DOFS = tuple(Dof(10 * (i + 1), "Z", 1) for i in range(NODES))


def idle_model() -> ModalModel:
    n = HZ.size
    spread = np.r_[1e-6 * HZ, np.full(n, 1e-6), np.full(n * NODES, 1e-5)]
    return ModalModel.from_terms(
        HZ, np.full(n, 0.01), SHAPES, DOFS, "unit_modal_mass",
        residual=np.arange(n) >= 4, in_band=np.arange(n) < 4, covariance=np.diag(spread**2), band_hz=BAND,
    )  # fmt: skip


def on_another_day(damping_above: float, frequency_above: float) -> CheckRun:
    """FRFs with sensors put back (gain 1 %, shape 1 %), modes moved by 0.1 % and damped by 5 %, and the fifth by what is asked."""
    rng = np.random.default_rng(5)
    hz, zeta = HZ * (1 + 1e-3 * rng.standard_normal(HZ.size)), 0.01 * np.exp(0.05 * rng.standard_normal(HZ.size))
    hz[4], zeta[4] = HZ[4] * frequency_above, 0.01 * damping_above
    lines = np.linspace(*BAND, 400)
    s, w = 2j * np.pi * lines, 2 * np.pi * hz
    kernel = s**2 / (w[:, None] ** 2 + 2 * zeta[:, None] * w[:, None] * s + s**2)
    seen = SHAPES + 0.01 * 0.35 * rng.standard_normal(SHAPES.shape)
    data = np.einsum("ir,jr,rk->ijk", seen, SHAPES[REFERENCES], kernel)
    noise = 2e-4 * np.sqrt(np.mean(np.abs(data) ** 2))
    data = data * np.exp(0.01 * rng.standard_normal(NODES))[:, None, None]
    data += noise * np.sqrt(0.5) * (rng.standard_normal(data.shape) + 1j * rng.standard_normal(data.shape))
    frf = Frf(data, FrequencyAxis(lines), DOFS, tuple(DOFS[r] for r in REFERENCES), "accelerance", variance=np.full(data.shape, noise**2))
    return CheckRun("run", "", frf)


@pytest.mark.parametrize(("damping", "frequency"), [(1.3, 1.002), (0.8, 0.997)])
def test_a_mode_above_the_band_that_differs_between_days_is_no_effect(damping: float, frequency: float) -> None:
    found = diagnose(idle_model(), check=[on_another_day(damping, frequency)])
    assert (found.verdict, found.effects) == ("no_misfit", ())
    assert found.ladder[0]["heldout_misfit"] < 1.5


def test_it_would_be_one_if_only_modes_in_band_could_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Idle, "with_near", lambda self, band, fitted=False: self)
    assert diagnose(idle_model(), check=[on_another_day(1.3, 1.002)], kinds=["point_mass"]).verdict != "no_misfit"

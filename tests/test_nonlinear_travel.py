"""Friction and play from loops of force over displacement: a device walked through by the tests' own code, and a measured one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from operando.contrib import fit_loop
from operando.errors import DataError

SHARED = Path(__file__).resolve().parents[1].parent / "shared"
RATE = 500.0
TIME = np.arange(4000) / RATE
WAY = 0.02 * np.sin(np.pi * TIME / 8) * np.sin(2 * np.pi * TIME)


def device(x, stiffness, slip, play):
    """Slider of slip force behind a spring behind a play: the slider moves only where the spring pulls it with the slip force."""
    out, slider = [], 0.0
    for u in x:
        stretch = u - slider
        contact = stretch - np.clip(stretch, -play / 2, play / 2)
        f = stiffness * contact
        if abs(f) > slip:
            slider += (abs(f) - slip) / stiffness * np.sign(f)
            f = slip * np.sign(f)
        out.append(f)
    return np.array(out)


def noisy(f, share=0.03):
    return f + share * f.std() * np.random.default_rng(2).standard_normal(f.size)


def test_friction_with_play_is_named_and_sized():
    found = fit_loop(WAY, noisy(device(WAY, 1e6, 800.0, 4e-3)), RATE)
    assert found.kinds == ("coulomb_friction", "clearance")
    assert found.values["force"] == pytest.approx(800, rel=0.02)
    assert found.values["gap"] == pytest.approx(2e-3, rel=0.05)
    assert found.values["stiffness"] == pytest.approx(1e6, rel=0.1)
    assert found.errors["clearance"] < 0.5 * found.errors["coulomb_friction"] < 0.5 * found.errors["linear"]


def test_friction_without_play_has_none():
    found = fit_loop(WAY, noisy(device(WAY, 1e6, 800.0, 0.0)), RATE)
    assert found.kinds == ("coulomb_friction",)
    assert found.values["force"] == pytest.approx(800, rel=0.02)


def test_spring_and_damper_are_neither():
    f = 3e4 * WAY + 2e3 * np.gradient(WAY) * RATE
    found = fit_loop(WAY, noisy(f), RATE)
    assert "units of the signals" in repr(found)
    assert "\n" not in repr(found)
    assert found.kinds == ()
    assert found.values["stiffness"] == pytest.approx(3e4, rel=0.02)
    assert found.values["damping"] == pytest.approx(2e3, rel=0.02)


def test_too_few_strokes_are_refused():
    with pytest.raises(DataError, match="strokes"):
        fit_loop(WAY[:700], WAY[:700], RATE)
    with pytest.raises(DataError, match="number of samples"):
        fit_loop(WAY, WAY[1:], RATE)
    with pytest.raises(DataError, match="not finite"):
        fit_loop(WAY, np.where(np.arange(WAY.size) == 33, np.nan, WAY), RATE)


@pytest.mark.parametrize(("name", "kilonewton"), [("1Hz0lbtension1amplitude", (1.5, 3.5)), ("1Hz30lbtension1amplitude", (9.0, 11.0))])
@pytest.mark.skipif(not (SHARED / "data" / "friction").is_dir(), reason="the measured data are not here")
def test_measured_damper_shows_friction_and_backlash(name, kilonewton):
    """Band friction damper with backlash (inch, kip): plateaus of about 0.35 to 0.8 kip without tension, 2.3 kip with it."""
    data = np.array(json.loads((SHARED / "data" / "friction" / f"{name}.json").read_text())["data"])
    found = fit_loop(0.0254 * data[:, 1], 4448.22 * data[:, 2], 1024.0)
    assert found.kinds == ("coulomb_friction", "clearance")
    assert kilonewton[0] < found.values["force"] / 1e3 < kilonewton[1]
    assert 1.5e-3 < found.values["gap"] < 4e-3
    assert found.errors["clearance"] < 0.7 * found.errors["linear"]

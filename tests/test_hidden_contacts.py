"""The generator of level-dependent hidden effects: its time integration against a solver of its own kind, its sizes, its files."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import fft
from scipy.integrate import solve_ivp

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks" / "hidden_effects"
sys.path.append(str(FOLDER))

import contacts  # noqa: E402
import generate  # noqa: E402
import records  # noqa: E402
from families import draw  # noqa: E402
from hidden import add_to_first  # noqa: E402

HZ, ZETA = np.array([6.0, 17.0, 41.0]), np.array([0.01, 0.008, 0.006])
ROWS = np.array([[0.6, -0.5, 0.4], [0.3, 0.7, -0.6]])


@pytest.mark.parametrize("kind", ["clearance", "cubic_stiffness", "hysteresis", "coulomb_friction"])
def test_integration_against_an_adaptive_solver(kind, monkeypatch):
    """A periodic force, from the moment the effect is switched on; both sides filtered alike."""
    monkeypatch.setattr(contacts, "LEAD", 0.5)
    rng = np.random.default_rng(4)
    rate, samples = records.RATE, 512
    period = 4096
    force = records.random_force(rng, period, np.array([5.0]), 3.0, 60.0)
    hz = records.lines(period)
    w0 = 2 * np.pi * HZ
    kernel = 1 / (w0[:, None] ** 2 - (2 * np.pi * hz) ** 2 + 2j * ZETA[:, None] * w0[:, None] * 2 * np.pi * hz)
    modal = kernel * ROWS[0][:, None] * force
    b = ROWS[1]
    x_rms = fft.irfft(b @ modal, period).std()
    v_rms = fft.irfft((b @ modal) * 2j * np.pi * hz, period).std()
    values, law, rate_of = contacts._law(kind, 5.0 if kind == "coulomb_friction" else 3e3, x_rms, v_rms, rng, float(b @ b))
    assert all(v > 0 for v in values.values())
    contact = contacts.Contact(b, law, rate_of)
    pole = w0 * (-ZETA + 1j * np.sqrt(1 - ZETA**2))
    start, lead = 1024, int(0.5 * rate)
    made = contacts.added(pole, ROWS, b, contact, (b @ modal)[None], period, np.array([start]), samples, rate, records.anti_alias)[0]

    # The same from one set of equations: modes under force and law, started from the linear motion at the same moment.
    begin = (start - lead) / rate
    dense = fft.irfft(np.pad(force[0], (0, 15 * period // 2)) * 16, 16 * period)
    times = np.arange(dense.size) / rate / 16
    q0 = fft.irfft(modal, period)[:, start - lead]
    v0 = fft.irfft(modal * 2j * np.pi * hz, period)[:, start - lead]

    def slope(t, y):
        q, v, z = y[:3], y[3:6], y[6]
        x, xv = b @ q, b @ v
        a = ROWS[0] * np.interp(t, times, dense) - 2 * ZETA * w0 * v - w0**2 * q - b * law(x, xv, z)
        return np.concatenate([v, a, [rate_of(x, xv, z)]])

    at = np.arange(start, start + samples) / rate
    first = np.concatenate([q0, v0, [0.0]])
    solved = solve_ivp(slope, (begin, at[-1]), first, t_eval=at, rtol=1e-7, atol=1e-10, max_step=4e-4)
    whole = np.array([slope(t, y)[3:6] for t, y in zip(at, solved.y.T, strict=True)]).T
    linear = fft.irfft(-((2 * np.pi * hz) ** 2) * modal, period)[:, start : start + samples]
    theirs = fft.rfft((ROWS @ (whole - linear))[0] * np.sin(np.pi * (np.arange(samples) + 0.5) / samples) ** 4)
    # Compared in band, both windowed.
    window = np.sin(np.pi * (np.arange(samples) + 0.5) / samples) ** 4
    ours = fft.rfft(made[0] * window)
    inside = (fft.rfftfreq(samples, 1 / rate) > 4) & (fft.rfftfreq(samples, 1 / rate) < 60)
    assert np.linalg.norm(ours[inside] - theirs[inside]) < 0.03 * np.linalg.norm(theirs[inside])


@pytest.mark.parametrize("kind", contacts.NONLINEAR)
def test_sizes_shake_the_structure_neither_little_nor_to_pieces(kind):
    structure = draw("rotor", 501)
    state, contact = contacts.hide_contact(kind, structure, (0, 1), np.random.default_rng(1), 12.0)
    (effect,) = state.effects
    assert effect["kind"] == kind
    assert len(effect["location"]) in (1, 2)
    x = 3 * effect["rms_displacement_m"]
    assert np.isfinite(contact.law(x, 0.1, 0.5))
    assert 1e-9 < effect["rms_displacement_m"] < 1e-2


def test_a_case_holds_its_runs_and_never_its_answer(tmp_path, monkeypatch):
    def quick(pole, rows, b, contact, linear, period, starts, samples, rate, gain):
        return np.zeros((len(linear), len(rows), samples))

    monkeypatch.setattr(records, "added", quick)
    spec = generate.parse("frame-clearance-500-r2-shaker")
    assert spec.name == "frame-clearance-500-r2-shaker"
    case = generate.write(spec, tmp_path)
    names = {p.relative_to(case).as_posix() for p in case.rglob("*") if p.is_file()}
    assert {"check/run1a.uff", "check/run1b.uff", "check/run2a.uff", "check/run2b.uff", "operating/run1.uff", "idle/run2.uff"} <= names
    for path in case.rglob("*"):
        if path.is_file():
            assert b"clearance" not in path.read_bytes()
    with pytest.raises(ValueError, match="shaker"):
        generate.truth(generate.parse("frame-clearance-500-r2-hammer"))


def test_on_another_day_the_effect_acts_on_the_structure_of_that_day():
    """A linear spring as a contact against the FRFs of that day with the spring in the stiffness matrix, both through the channels."""
    spec = generate.Spec("rotor", "clearance", 501, 2, days=True)
    known = generate.truth(spec)
    state, b, k = known.state, known.contact.row, 2e4
    assert state.remounted is not None
    spring = contacts.Contact(b, lambda x, v, z: k * x, lambda x, v, z: 0 * z)
    rate, samples, lead = records.RATE, 4096, int(contacts.LEAD * records.RATE)
    period = lead + samples + 4096
    force = records.random_force(np.random.default_rng(2), period, np.array([5.0]), 3.0, 190.0)
    reference = known.references[0]
    column, hz = state.remounted.columns[reference][None], records.lines(period)
    away = np.where(hz > 0, -1 / np.maximum(2 * np.pi * hz, 1e-9) ** 2, 0)
    pole, shapes = records._modes_at(known.structure, state, np.concatenate([b[None], state.seen]))
    assert np.abs(shapes.imag).max() > 1e-3 * np.abs(shapes.real).max()
    at = records.steady(state.system, b[None], column, force, period)[0] * away
    made = contacts.added(
        pole, shapes[1:], shapes[0], spring, at[None], period, np.array([lead]), samples, rate,
        lambda f: records.logger_gain(f) * state.remounted.responses(f),
    )[0]  # fmt: skip
    sprung = replace(state.system, stiffness=add_to_first(state.system.stiffness, k * np.outer(b, b)))
    both = [records.through_faults(state, records.steady(s, state.seen, column, force, period), hz) for s in (sprung, state.system)]
    wanted = fft.irfft(both[0] - both[1], period)[:, lead : lead + samples]
    window = np.sin(np.pi * (np.arange(samples) + 0.5) / samples) ** 4
    ours, theirs = (fft.rfft(x * window, axis=1)[:, 40:1400] for x in (made, wanted))
    assert np.linalg.norm(ours - theirs) < 0.01 * np.linalg.norm(theirs)

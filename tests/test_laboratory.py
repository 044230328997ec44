"""The laboratory family: its plates against tables, its FRFs against the equations of motion, its files against what it meant."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

import operando

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks" / "laboratory"
sys.path.append(str(FOLDER))

import frf_kinds  # noqa: E402
import lab_structures as structures  # noqa: E402
from plates import Plate  # noqa: E402


def _generate():
    import importlib.util

    spec = importlib.util.spec_from_file_location("laboratory_generate", FOLDER / "generate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


GENERATE = _generate()


@pytest.mark.parametrize(
    ("clamped", "skip", "table"),
    [(None, 3, (13.468, 19.596, 24.270, 34.801, 34.801)), (1e5, 0, (3.471, 8.508, 21.285, 27.199, 30.958))],
    ids=["free", "clamped edge"],
)
def test_plate_against_table(clamped, skip, table):
    """Square plates, ν = 0.3: ω a² √(ρh/D) of Leissa (NASA SP-160; free: Leissa 1973); the clamp of 1e5 D/a³ is 0.2 % soft."""
    plate = Plate(0.7, 0.7, 0.005, poisson=0.3, clamped=clamped)
    hz, _ = plate.modes(10)
    values = 2 * np.pi * hz * 0.7**2 * np.sqrt(plate.density * plate.thickness / plate.rigidity)
    np.testing.assert_allclose(values[skip : skip + len(table)], table, rtol=3e-3)


@pytest.mark.parametrize("kind", ["plate", "ladder", "aircraft", "mast"])
@pytest.mark.parametrize("dampers", [False, True])
def test_frf_against_equations_of_motion(kind, dampers):
    """Poles and complex vectors give the inverse of the dynamic stiffness, the response of coupled equations solved line by line."""
    structure = structures.draw(np.random.default_rng(5), 20, kind=kind, local_dampers=dampers, modes=(6, 9))
    modal, rows = structure.modal, structure.rows(list(structure.points[:3]))
    hz = np.linspace(*structure.band, 40)
    for f, value in zip(hz, modal.accelerance(hz, rows, rows[:2]).transpose(2, 0, 1), strict=True):
        omega = 2 * np.pi * f
        dynamic = np.diag((2 * np.pi * modal.hz) ** 2) - omega**2 * np.eye(len(modal.hz)) + 1j * omega * modal.damping
        exact = -(omega**2) * rows @ np.linalg.solve(dynamic, rows[:2].T)
        np.testing.assert_allclose(value, exact, rtol=1e-7, atol=1e-9 * np.abs(exact).max())
    if not dampers:  # real modes: the shapes stated are those of unit modal mass
        np.testing.assert_allclose(np.abs(modal.shapes), np.eye(len(modal.hz)), atol=1e-6)
    assert 5 <= len(structure.in_band) <= 20


def test_hit_beside_a_point():
    """A hit that misses: the slope of the shape, by differences between points of a plate; by the rotation of a beam's node."""
    for kind in ("plate", "mast"):
        structure = structures.draw(np.random.default_rng(2), 40, kind=kind)
        point = structure.points[25]
        step = np.array([1e-4, 0, 0]) if kind == "plate" else np.array([0, 0, 1e-4])
        there, back = structure.beside(point, step), structure.beside(point, -step)
        here = structure.beside(point, np.zeros(3))
        np.testing.assert_allclose((there + back) / 2, here, rtol=1e-3, atol=1e-4 * np.abs(here).max())
        assert np.abs(there - back).max() > 0


def test_faults_have_their_sizes():
    """Each fault alone changes the FRFs by what it says."""
    structure = structures.draw(np.random.default_rng(3), 40, kind="plate")
    hz = np.linspace(1, 1.1 * structure.band[1], 800)
    sensors, hits = [structure.points[4]], list(structure.points)

    def frfs(**faults):
        return frf_kinds.measure(
            np.random.default_rng(1), structure, sensors, hits, hz, frf_kinds.Faults(**({"noise": 1e-12} | faults))
        ).data

    clean = frfs()
    exact = structure.modal.accelerance(hz, structure.rows(sensors), structure.rows(hits))
    np.testing.assert_allclose(clean, exact, atol=1e-9 * np.abs(exact).max())
    gains = np.abs(frfs(hit_gain=0.05) / clean).mean(axis=2)
    assert 0.03 < gains.std() < 0.07
    np.testing.assert_allclose(frfs(wrong_hits={7: ("gain", 1.5)})[0, 7], 1.5 * clean[0, 7], rtol=1e-6)
    np.testing.assert_allclose(frfs(opposite=True), -clean, rtol=1e-6)
    rise = np.abs(frfs(sensor_rise=0.03) / clean)[0, 0]
    assert rise[0] == pytest.approx(1, abs=1e-3)
    assert 1.015 < rise[-1] < 1.032
    tail = (frfs(tail=0.1) - clean)[0]
    falling = np.abs(tail[:, 200] / tail[:, 600])
    np.testing.assert_allclose(falling, hz[600] / hz[200], rtol=0.02)
    moved = frf_kinds.drift(np.random.default_rng(0), 74, 10, frf_kinds.Faults(drift_range=0.002))
    assert 0.0005 < np.ptp(moved) <= 0.002
    noisy = frfs(noise=1e-4)
    floor = 1e-4 * np.median(np.abs(clean).max(axis=2))
    assert np.sqrt((np.abs(noisy - clean)[:, :, :100] ** 2).mean()) == pytest.approx(floor, rel=0.2)


@pytest.mark.parametrize("kind", ["single_reference", "complex_modes"])
def test_files_hold_what_was_measured(kind, tmp_path):
    """Files read back by operando: FRFs near the truth's (faults are percents), DOFs as in the answer; one seed, the same bytes."""
    answer = GENERATE.generate(kind, 3, tmp_path / "case")
    assert json.loads((tmp_path / "case.truth.json").read_text()) == json.loads(json.dumps(answer))
    frf = operando.read(tmp_path / "case" / "frfs.uff" if (tmp_path / "case" / "frfs.uff").exists() else tmp_path / "case" / "frfs_1.uff")
    frf = frf.frfs[0] if hasattr(frf, "frfs") else frf
    assert frf.si
    assert frf.coherence is None
    assert {str(d) for d in (*frf.responses, *frf.references)} <= set(answer["modes"][0]["shape"])
    sense = -1 if answer["faults"]["opposite"] else 1
    mode = max((m for m in answer["modes"] if m["in_band"]), key=lambda m: 1 / m["damping_ratio"])
    line = int(np.argmin(np.abs(frf.frequencies_hz - mode["frequency_hz"])))
    shape = {k: complex(*v) for k, v in mode["shape"].items()}
    residue = np.array([[shape[str(o)] * shape[str(i)] for i in frf.references] for o in frf.responses])
    likeness = np.vdot(residue, sense * frf.data[:, :, line]) / np.linalg.norm(residue) / np.linalg.norm(frf.data[:, :, line])
    assert abs(likeness) > 0.9
    assert likeness.imag > 0.3  # an accelerance at resonance is +i times a positive residue
    before = {p.name: p.read_bytes() for p in (tmp_path / "case").glob("*.uff")}
    GENERATE.generate(kind, 3, tmp_path / "case")
    assert {p.name: p.read_bytes() for p in (tmp_path / "case").glob("*.uff")} == before
    assert not list((tmp_path / "case").glob("*.json"))

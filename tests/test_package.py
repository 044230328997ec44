"""What is shipped: the example data and how honest they are, the wheel, the two commands."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import numpy as np
import pytest

import operando

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "data" / "example"
GENERATOR = ROOT / "benchmarks" / "example_data"
GRAVITY = 9.80665


@pytest.fixture(scope="module")
def frame():
    """The generator's own model of the machine frame."""
    sys.path.insert(0, str(GENERATOR))
    try:
        import frame

        yield frame
    finally:
        sys.path.remove(str(GENERATOR))


def read_58b(path: Path) -> tuple[np.ndarray, list[tuple[int, int, str]], float]:
    """Samples, (node, direction, unit) and time step, read with a few lines that are neither the generator's nor operando's."""
    content, start, samples, channels, step = path.read_bytes(), 0, [], [], 0.0
    while (start := content.find(b"    58b", start)) >= 0:
        lines = []
        for _ in range(12):
            end = content.index(b"\n", start)
            lines.append(content[start:end].decode("ascii"))
            start = end + 1
        size = int(lines[0][31:43])
        samples.append(np.frombuffer(content[start : start + size], "<f4").astype(float))
        place, abscissa, ordinate = lines[6], lines[7], lines[9]
        channels.append((int(place[41:51]), int(place[51:55]), ordinate[47:67].strip()))
        step = float(abscissa[43:56])
        assert int(abscissa[10:20]) == len(samples[-1])
        start += size
    return np.array(samples), channels, step


@pytest.fixture(scope="module")
def states(frame):
    return {"idle": frame.idle_state(), "operating": frame.operating_state()}


def exact(frame, state, reference: int, hz: np.ndarray) -> np.ndarray:
    x, y, sense = frame.SENSORS[reference]
    return state.accelerance(hz, frame.sensor_rows(state.shapes), sense * state.shapes[[frame.node_at(x, y)]])[:, 0]


def welch(data: np.ndarray, rate: float, block: int) -> tuple[np.ndarray, np.ndarray]:
    """Plain H1 of all rows to the first, Hann window, half overlap."""
    window = np.hanning(block + 1)[:-1]
    starts = range(0, data.shape[1] - block + 1, block // 2)
    spectra = np.array([np.fft.rfft(window * data[:, s : s + block]) for s in starts])
    force = spectra[:, 0]
    return np.fft.rfftfreq(block, 1 / rate), np.einsum("bcl,bl->cl", spectra[:, 1:], force.conj()) / np.sum(np.abs(force) ** 2, axis=0)


def relative(estimate: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(estimate - truth) / np.linalg.norm(truth))


def test_example_is_small_and_gives_nothing_away():
    files = [p for p in EXAMPLE.rglob("*") if p.is_file()]
    assert sum(p.stat().st_size for p in files) < 15e6
    truth = json.loads((GENERATOR / "truth.json").read_text())
    assert truth["effects"][0]["kind"] == "ground_spring"
    for path in files:
        text = path.read_bytes()[:4000].decode("latin-1").lower()
        assert "spring" not in text, f"{path.name} tells the answer"
        assert "truth" not in path.name


def test_generator_shares_no_code_with_operando():
    names = set()
    for path in GENERATOR.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                names.add((node.module or "").split(".")[0])
    assert names <= {"__future__", "dataclasses", "itertools", "json", "sys", "pathlib", "numpy", "scipy", "frame", "uff", "make"}


def test_frame_is_the_plate_of_the_books(frame, monkeypatch):
    """The bare plate, simply supported on all edges, has the closed-form frequencies of Kirchhoff theory."""
    monkeypatch.setattr(frame, "RIBS", ())
    monkeypatch.setattr(frame, "MASSES", ())
    monkeypatch.setattr(frame, "MOUNTS", ())
    stiffness, mass = frame.assemble()
    x, y = frame.grid().T
    on_x, on_y = (x < 1e-9) | (x > frame.LENGTH - 1e-9), (y < 1e-9) | (y > frame.WIDTH - 1e-9)
    held = np.zeros(3 * len(x), bool)
    held[0::3] = on_x | on_y
    held[1::3] = on_y  # the slope along a supported edge is zero
    held[2::3] = on_x
    from scipy.linalg import eigh

    values = eigh(stiffness[np.ix_(~held, ~held)], mass[np.ix_(~held, ~held)], eigvals_only=True, subset_by_index=[0, 3])
    rigidity = frame.YOUNG * frame.THICKNESS**3 / 12 / (1 - frame.POISSON**2)
    waves = sorted((m / frame.LENGTH) ** 2 + (n / frame.WIDTH) ** 2 for m in range(1, 6) for n in range(1, 6))[:4]
    expected = np.pi**2 * np.array(waves) * np.sqrt(rigidity / frame.DENSITY / frame.THICKNESS) / 2 / np.pi
    np.testing.assert_allclose(np.sqrt(values) / 2 / np.pi, expected, rtol=0.01)


def test_check_record_is_the_operating_state_and_not_the_idle_one(frame, states):
    data, channels, step = read_58b(EXAMPLE / "check" / "run1a.uff")
    assert channels[0] == (3, 3, "N")
    assert {unit for _, _, unit in channels[1:]} == {"g"}
    assert (9, -3, "g") in channels
    assert step == pytest.approx(1 / 512, rel=1e-5)
    hz, estimate = welch(data, 512.0, 8192)
    band = (hz > 5) & (hz < 145)
    estimate = estimate[:, band] * GRAVITY
    assert relative(estimate, exact(frame, states["operating"], 3, hz[band])) < 0.06
    assert relative(estimate, exact(frame, states["idle"], 3, hz[band])) > 0.3


def test_hammer_record_is_the_idle_state(frame, states):
    """From silence to silence, the ratio of the whole record's spectra is the FRF, but for the noise."""
    data, channels, _ = read_58b(EXAMPLE / "idle" / "hammer2.uff")
    assert channels[0] == (9, -3, "N")
    spectra, hz = np.fft.rfft(data), np.fft.rfftfreq(data.shape[1], 1 / 512)
    band = (hz > 5) & (hz < 145)
    estimate = spectra[1:, band] / spectra[0, band] * GRAVITY
    assert relative(estimate, exact(frame, states["idle"], 9, hz[band])) < 0.04
    hits = np.flatnonzero((data[0] > 20) & (data[0] >= np.roll(data[0], 1)) & (data[0] > np.roll(data[0], -1)))
    assert len(hits) == 8
    assert np.ptp(data[0, hits]) > 50


def test_spring_of_the_operating_state_is_the_one_in_truth(frame, states):
    """The operating receptance is the idle one with the spring of truth.json by the Sherman-Morrison formula."""
    truth = json.loads((GENERATOR / "truth.json").read_text())
    effect = truth["effects"][0]
    place = truth["dofs"].index(effect["location"][0])
    spring = effect["parameters"]["stiffness"]["value"]
    hz = np.linspace(5, 145, 60)
    idle, operating = states["idle"], states["operating"]
    rows = frame.sensor_rows(idle.shapes)
    omega2 = (2 * np.pi * hz) ** 2
    before = -idle.accelerance(hz, rows, rows) / omega2
    column = before[:, place]
    after = before - spring * column[:, None] * column[None] / (1 + spring * column[place])
    np.testing.assert_allclose(-operating.accelerance(hz, rows, rows) / omega2, after, rtol=1e-6, atol=1e-7 * np.abs(after).max())


def test_generator_makes_the_same_file_again(states):
    sys.path.insert(0, str(GENERATOR))
    try:
        import make
    finally:
        sys.path.remove(str(GENERATOR))
    again = make.check_run(states["operating"], 12, 6.0, 3021)
    stored = (EXAMPLE / "check" / "run2b.uff").read_bytes()
    assert len(again) == len(stored)
    a, b = np.frombuffer(again[2000:6000], "<f4"), np.frombuffer(stored[2000:6000], "<f4")
    np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


def test_operando_reads_the_example_in_si():
    raw, _, _ = read_58b(EXAMPLE / "idle" / "hammer2.uff")
    (record,) = operando.read(EXAMPLE / "idle" / "hammer2.uff").records
    assert record.data.shape == raw.shape
    np.testing.assert_allclose(record.data[0], raw[0], rtol=1e-6)
    np.testing.assert_allclose(record.data[1:], raw[1:] * GRAVITY, rtol=1e-6)
    assert [str(channel.dof) for channel in record.channels[:3]] == ["9-Z", "1+Z", "2+Z"]
    assert record.sampling_hz == pytest.approx(512.0, rel=1e-12)


def test_wheel_holds_the_example_and_the_licence(tmp_path):
    wheel_module = pytest.importorskip("hatchling.builders.wheel", reason="hatchling comes with the dev extras")
    wheel = next(iter(wheel_module.WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])))
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        metadata = archive.read(next(n for n in names if n.endswith(".dist-info/METADATA"))).decode()
    shipped = {p.relative_to(EXAMPLE).as_posix() for p in EXAMPLE.rglob("*") if p.is_file()}
    assert {f"operando/example_data/{name}" for name in shipped} <= names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    templates = ROOT / "src" / "operando" / "report" / "templates"
    assert {f"operando/report/templates/{p.name}" for p in templates.iterdir()} <= names
    assert "Requires-Dist: jinja2" in metadata
    assert not [n for n in names if n.split("/")[0] not in {"operando", f"operando-{operando.__version__}.dist-info"}]
    assert not [n for n in names if "truth" in n]
    assert "License-Expression: MIT" in metadata


def test_version_is_the_same_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["version"] == operando.__version__
    assert all(">=" in d for d in project["dependencies"]), "every dependency has a lower bound"


@pytest.mark.skipif(not Path("/usr/bin/make").exists(), reason="make is not installed")
def test_make_test_runs_ruff_mypy_and_the_tests():
    done = subprocess.run(["/usr/bin/make", "-n", "test"], cwd=ROOT, capture_output=True, text=True, check=True)
    for needed in ("ruff check", "ruff format --check", "mypy", "pytest"):
        assert needed in done.stdout
    assert "OMP_NUM_THREADS := 1" in (ROOT / "Makefile").read_text()


def test_ci_calls_make_test_and_passes_its_exit_code_on(tmp_path):
    script = ROOT / ".ci" / "run"
    assert os.access(script, os.X_OK)
    fake = tmp_path / "make"
    fake.write_text('#!/bin/sh\necho "asked for: $*"\nexit 3\n')
    fake.chmod(0o755)
    environment = {**os.environ, "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(["bash", str(script)], capture_output=True, text=True, env=environment)
    assert done.stdout.strip() == "asked for: test"
    assert done.returncode == 3

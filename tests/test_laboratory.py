"""The laboratory family: its plates against tables, its FRFs against the equations of motion, its files against what it meant."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import operando

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks" / "laboratory"
sys.path.append(str(FOLDER))

import frf_kinds  # noqa: E402
import lab_judge  # noqa: E402
import lab_records  # noqa: E402
import lab_structures as structures  # noqa: E402
import multisine_kind  # noqa: E402
from modal import Modal  # noqa: E402
from plates import Plate  # noqa: E402


def _module(name):
    """A module whose name another benchmark has, too."""
    import importlib.util

    spec = importlib.util.spec_from_file_location(f"laboratory_{name}", FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


GENERATE, SCORE = _module("generate"), _module("score")
sys.path[:] = [p for p in sys.path if p != str(FOLDER)]  # another benchmark's tests import modules named alike


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
    structure = structures.draw(np.random.default_rng(3), 30, kind="plate")
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
    (tmp_path / "case" / "left.uff").write_bytes(b"of another draw")
    GENERATE.generate(kind, 3, tmp_path / "case")
    assert {p.name: p.read_bytes() for p in (tmp_path / "case").glob("*.uff")} == before
    assert not list((tmp_path / "case").glob("*.json"))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine.txt").write_text("not to be lost")
    with pytest.raises(FileExistsError):
        GENERATE.generate(kind, 3, tmp_path / "other")


def _three(*ratios):
    hz = np.array([8.0, 21.0, 23.0])
    return Modal(hz, np.diag(4 * np.pi * np.array(ratios) * hz))


THREE = _three(0.03, 0.04, 0.025)


def _series(spectrum, rate):
    """The periodic function of time that has this spectrum of ``rfft``."""
    used = np.flatnonzero(np.abs(spectrum) > 1e-12 * np.abs(spectrum).max())
    used = used[used > 0]
    period = 2 * (spectrum.size - 1)
    weight = 2 / period * spectrum[used]
    turn = 2j * np.pi * used * rate / period
    return lambda t: spectrum[0].real / period + np.real(weight @ np.exp(turn * t))


def test_records_against_integration():
    """A hit: H·F on the lines of a long period gives what the equations of motion give, integrated from rest."""
    rate, period = 250.0, 2048
    hz = lab_records.lines(period, rate)
    pulse = lab_records.half_sine(hz, 100.0, 0.012, 0.5) * lab_records.anti_alias(hz, rate) * rate
    outputs, inputs = np.array([[1.0, 0.4, -0.7]]), np.array([[0.3, -1.1, 0.8]])
    spectra = lab_records.respond(SimpleNamespace(modal=THREE), outputs, inputs, pulse[None], hz, rate, np.zeros(3))
    acceleration = np.fft.irfft(spectra, period)[0, :600]
    force, stiffness, damping = _series(pulse, rate), (2 * np.pi * THREE.hz) ** 2, np.diag(THREE.damping)

    def right(t, y):
        return np.concatenate([y[3:], inputs[0] * force(t) - stiffness * y[:3] - damping * y[3:]])

    times = np.arange(600) / rate
    y = solve_ivp(right, (0, times[-1]), np.zeros(6), t_eval=times, rtol=1e-7, atol=1e-10).y
    exact = outputs[0] @ np.array([right(t, state)[3:] for t, state in zip(times, y.T, strict=True)]).T
    np.testing.assert_allclose(acceleration, exact, atol=2e-4 * np.abs(exact).max())


def test_softening_joint_against_integration():
    """The force of the joint over a period is what an integration of the whole nonlinear system settles to."""
    rate, period, modal = 200.0, 128, _three(0.04, 0.05, 0.03)
    hz = lab_records.lines(period, rate)
    place = np.array([0.8, 0.5, -0.4])
    structure = SimpleNamespace(modal=modal)
    drive = np.zeros(hz.size, complex)
    drive[[4, 5, 6, 14]] = period * np.array([20.0, 15.0, 10.0j, 40.0])
    away = np.where(hz > 0, -1 / np.maximum(2 * np.pi * hz, 1e-9) ** 2, 0)
    fine = multisine_kind.FINE
    spectrum = lab_records.respond(structure, place[None], place[None], drive[None], hz, 2.05 * hz[-1], np.zeros(3))[0] * away
    whole = np.zeros(period * fine // 2 + 1, complex)
    whole[: hz.size] = spectrum * fine
    motion = np.fft.irfft(whole, period * fine)[None]
    joint = multisine_kind.Joint(place, 0.25 / float(np.sum(place**2 / (2 * np.pi * modal.hz) ** 2)), float(motion.std()) * 1.5)
    multisine_kind.LEAD, before = 12, multisine_kind.LEAD
    try:
        found, change = multisine_kind.steady_force(structure, joint, motion, rate * fine)
    finally:
        multisine_kind.LEAD = before
    force, stiffness, damping = _series(drive, rate), (2 * np.pi * modal.hz) ** 2, np.diag(modal.damping)

    def right(t, y):
        push = place * (force(t) - joint.force(place @ y[:3]))
        return np.concatenate([y[3:], push - stiffness * y[:3] - damping * y[3:]])

    length = period / rate
    times = 12 * length + np.arange(period) / rate
    y = solve_ivp(right, (0, times[-1]), np.zeros(6), t_eval=times, rtol=1e-7, atol=1e-11).y
    exact = joint.force(place @ y[:3])
    assert change < 1e-4
    assert np.abs(exact).max() > 0.02 * joint.stiffness * joint.knee
    np.testing.assert_allclose(found[0, ::fine], exact, atol=3e-3 * np.abs(exact).max())


@pytest.mark.parametrize("kind", ["roving_accelerometers", "operating_setups"])
def test_set_ups_show_the_modes(kind, tmp_path):
    """Set-ups share the sensors that stay and cover all; in each, spectra at a lone mode have its shape over the sensors there."""
    answer = GENERATE.generate(kind, 3, tmp_path / "case")
    folder = tmp_path / "case" / ("idle" if kind == "roving_accelerometers" else "operating")
    files = sorted(folder.glob("*.uff"))
    setups, stay = answer["faults"]["setups"], set(answer["faults"]["stay"])
    assert len(files) == len(setups) >= 3
    assert set().union(*setups) == set(answer["modes"][0]["shape"])
    modes = answer["modes"]
    hz = np.array([m["frequency_hz"] for m in modes])
    widths = 2 * hz * np.array([m["damping_ratio"] for m in modes])
    lonely = [np.min(np.abs(np.delete(hz, i) - hz[i])) / widths[i] if m["in_band"] and m["visible"] else 0 for i, m in enumerate(modes)]
    mode = modes[int(np.argmax(lonely))]
    for file, names in zip(files, setups, strict=True):
        record = operando.read(file).records[0]
        assert stay <= set(names)
        rows = [i for i, c in enumerate(record.channels) if c.quantity == "acceleration"]
        assert [str(record.channels[i].dof) for i in rows] == names
        blocks = record.data[rows][:, : record.data.shape[1] // 4096 * 4096].reshape(len(rows), -1, 4096)
        spectra = np.fft.rfft(blocks * np.hanning(4096), axis=2)
        line = round(mode["frequency_hz"] * 4096 / record.sampling_hz)
        vector = np.linalg.svd(spectra[:, :, line])[0][:, 0]
        shape = np.array([complex(*mode["shape"][n]) for n in names])
        assert abs(np.vdot(vector, shape)) ** 2 / np.vdot(shape, shape).real > 0.97


def test_multisine_repeats_itself(tmp_path):
    """Periods differ by noise only, lines without force hold none, levels are 1 : 2 : 4; the answer says how the joint moves modes."""
    answer = GENERATE.generate("multisine", 2, tmp_path / "case")
    levels = []
    for n in (1, 2, 3):
        record = operando.read(tmp_path / "case" / "idle" / f"level{n}.uff").records[0]
        periods = record.data.reshape(record.data.shape[0], -1, multisine_kind.PERIOD)
        assert periods.shape[1] == answer["faults"]["periods"]
        apart = np.abs(periods - periods.mean(axis=1, keepdims=True)).std(axis=(1, 2))
        assert np.all(apart < 0.02 * np.abs(record.data).max(axis=1))
        levels.append(periods[0].std())
    np.testing.assert_allclose(np.array(levels) / levels[0], [1, 2, 4], rtol=0.02)
    force = np.abs(np.fft.rfft(periods[0].mean(axis=0)))
    assert np.median(force[2::2]) < 0.01 * force.max()
    assert answer["faults"]["last_period_change"] < 1e-4
    assert min(answer["faults"]["shift_at_highest_level"]) < -1e-3


def _perfect(truth):
    """summary.json of a program that knows the answer."""
    modes = [
        {
            "frequency_hz": m["frequency_hz"] * (1 + 1e-5),
            "frequency_std_hz": 1e-5 * m["frequency_hz"],
            "damping_ratio": m["damping_ratio"],
            "damping_ratio_std": 1e-4,
            "in_band": True,
            "shape": {k: v[0] for k, v in m["shape_as_hit"].items()},
        }
        for m in truth["modes"]
        if m["in_band"]
    ]
    return {"idle": {"modes": modes, "scaling": "unit_modal_mass", "si": True}}


@pytest.fixture(scope="module")
def judged(tmp_path_factory):
    truth = GENERATE.generate("single_reference", 1, tmp_path_factory.mktemp("judged") / "case")
    return json.loads(json.dumps(truth))


def test_perfect_answer(judged):
    row = lab_judge.judge(judged, _perfect(judged))
    total = lab_judge.together([row | {"outcome": "done", "cpu_s": 1.0, "memory_mb": 100.0}])
    assert row["found"] == row["wanted"] > 5
    assert (
        total["found"]["share"]
        == total["frequency_coverage"]["share"]
        == total["damping_coverage"]["share"]
        == total["scaled"]["share"]
        == 1
    )
    assert total["invented"]["hits"] == 0
    assert total["scale_error"]["max"] < 1e-6
    assert total["dofs"] == 1


def test_mode_seen_only_because_hits_fell_beside_their_points(judged):
    """Judged by the shape at the places that were hit; the answer at the points is counted as another shape."""
    truth = json.loads(json.dumps(judged))
    mode = next(m for m in truth["modes"] if m["in_band"] and m["visible"])
    mode["shape"] = {k: [v[0] * (-1) ** i, 0.0] for i, (k, v) in enumerate(mode["shape"].items())}
    row = lab_judge.judge(truth, _perfect(truth))
    total = lab_judge.together([row | {"outcome": "done", "cpu_s": 1.0, "memory_mb": 100.0}])
    assert row["found"] == row["wanted"]
    assert total["other_shape_at_points"] == 1


def test_wrong_answers_are_counted(judged):
    """A mode left out, one split in two, of a wrong shape, flagged, nowhere, half as wide, turned: each counted once."""
    summary = _perfect(judged)
    modes = summary["idle"]["modes"]
    lost = modes.pop(0)
    twin = dict(modes[0], frequency_hz=modes[0]["frequency_hz"] * 1.001)
    modes[1]["shape"] = {k: v * (-1) ** i for i, (k, v) in enumerate(modes[1]["shape"].items())}
    modes[2]["flags"] = ["TWIN"]
    nowhere = dict(twin, frequency_hz=0.5 * (modes[3]["frequency_hz"] + modes[4]["frequency_hz"]))
    modes[3]["damping_ratio"] *= 0.5
    modes[4]["shape"] = {
        k.replace("+", "-"): -1.1 * v for k, v in modes[4]["shape"].items()
    }  # the same in the other sense, 1.21 in a residue
    for mode in modes:
        mode["shape"].pop(next(iter(mode["shape"])))
    modes += [twin, nowhere, dict(lost, frequency_hz=judged["band_hz"][1] * 1.2)]
    row = lab_judge.judge(judged, summary)
    assert row["found"] == row["wanted"] - 3
    assert row["missed_hz"][0] == pytest.approx(lost["frequency_hz"], rel=1e-4)
    assert row["invented"] == 3
    assert row["flagged"] == row["found_but_flagged"] == 1
    assert all(m["dofs"] == pytest.approx(1 - 1 / len(judged["modes"][0]["shape"]), abs=1e-3) for m in row["modes"])
    half = [m for m in row["modes"] if m["damping_error"] == pytest.approx(-0.5)]
    assert len(half) == 1
    assert abs(half[0]["damping_z"]) == pytest.approx(0.5 * modes[3]["damping_ratio"] * 2 / 1e-4, rel=1e-3)
    assert max(m["scale_error"] for m in row["modes"]) == pytest.approx(0.21, abs=1e-3)


def test_failures_are_counted(judged, tmp_path):
    """No answer misses every mode; a run killed by its limit says so; the table and its file are written."""
    none = lab_judge.judge(judged, None)
    assert none["found"] == 0 < none["wanted"]
    spin = SCORE.run_limited([sys.executable, "-c", "while True: pass"], 1, tmp_path / "log")
    assert SCORE.outcome(spin["exit"], "") == "out of time"
    assert 0.5 < spin["cpu_s"] < 3  # the limit of 1 s counts whole ticks, which on a loaded machine are more than the time used
    fine = SCORE.run_limited([sys.executable, "-c", "x = bytearray(50_000_000)"], 5, tmp_path / "log")
    assert SCORE.outcome(fine["exit"], "") == "done"
    assert 50 < fine["memory_mb"] < 80  # its own, whatever this process holds
    assert SCORE.outcome(-9, "", 124.9, 120) == "out of time"
    assert SCORE.outcome(-9, "", 30.0, 120) == "killed"
    assert SCORE.outcome(1, "Error: no force") == "refused"
    assert SCORE.outcome(1, "Traceback (most recent call last)") == "crash"
    kind = {"kind": "single_reference", "case": "a", "seed": 1}
    rows = [kind | {"outcome": "out of time"} | spin | none, kind | {"outcome": "done"} | fine | lab_judge.judge(judged, _perfect(judged))]
    text = SCORE.write_results(rows, "trial", "A note.", tmp_path)
    assert "1 out of time" in text
    assert f"{none['wanted']}/{2 * none['wanted']} = 50.0 %" in text
    assert len(json.loads((tmp_path / "laboratory-trial.json").read_text())["rows"]) == 2


def test_interval_of_a_share():
    """Clopper–Pearson: the closed form for 0 of n, and the usual table value for 5 of 10."""
    assert lab_judge.interval(0, 10)[1] == pytest.approx(1 - 0.025 ** (1 / 10))
    np.testing.assert_allclose(lab_judge.interval(5, 10), [0.1871, 0.8129], atol=1e-4)

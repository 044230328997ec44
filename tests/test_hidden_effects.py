"""The generator of hidden effects: its finite elements against closed forms, its effects against their laws, its records against H·F."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks" / "hidden_effects"
sys.path.append(str(FOLDER))

import generate  # noqa: E402
import hidden  # noqa: E402
import judge  # noqa: E402
import records  # noqa: E402
import score  # noqa: E402
import tally  # noqa: E402
from beams import Mesh, Section  # noqa: E402
from families import CLOSEST, FAMILIES, HUNG, IN_PLANS, SUSPENSION_DAMPING, draw  # noqa: E402

STEEL = Section(0.03, 0.05)


def _beam(section, length, direction, count=12, clamped=True):
    mesh = Mesh()
    along = np.array(direction) / np.linalg.norm(direction)
    first, second = mesh.node(0.1, -0.2, 0.3), mesh.node(*(np.array([0.1, -0.2, 0.3]) + length * along))
    nodes = mesh.member(first, second, section, count)
    if clamped:
        mesh.clamp(first)
    return mesh, nodes


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, 0, 1), (0.4, -0.7, 0.5)])
def test_cantilever_against_closed_form(direction):
    """Bending in both planes, stretching and torsion of a clamped beam, whichever way it points."""
    length = 0.9
    mesh, _ = _beam(STEEL, length, direction)
    hz, _ = mesh.modes(40)
    iy, iz = STEEL.inertia
    bending = np.array([1.875104, 4.694091, 7.854757]) ** 2 / (2 * np.pi * length**2)
    expected = [b * np.sqrt(STEEL.young * i / STEEL.density / STEEL.area) for b in bending for i in (iy, iz)]
    expected.append(np.sqrt(STEEL.young / STEEL.density) / 4 / length)
    shear = STEEL.young / 2 / (1 + STEEL.poisson)
    expected.append(np.sqrt(shear * STEEL.torsion / STEEL.density / (iy + iz)) / 4 / length)
    for value in expected:
        assert np.abs(hz / value - 1).min() < 2e-3


def test_free_beam_has_six_rigid_modes_and_its_mass():
    """Rigid motion costs nothing and moves the whole mass: with springs to ground, f = sqrt(k/m)."""
    mesh, nodes = _beam(STEEL, 0.8, (0.3, 0.5, 0.2), clamped=False)
    stiffness, mass = mesh.assemble()
    shift = np.tile([1.0, 0, 0, 0, 0, 0], len(nodes))
    assert shift @ mass @ shift == pytest.approx(STEEL.density * STEEL.area * 0.8, rel=1e-9)
    assert np.abs(stiffness @ shift).max() < 1e-6 * stiffness.max()
    assert np.sum(np.abs(np.linalg.eigvalsh(stiffness)) < 1e-9 * stiffness.max()) == 6


def test_spring_between_nodes_and_lump():
    """Two lumps joined by a spring, free: 0 and sqrt(k/m1 + k/m2)."""
    mesh = Mesh()
    a, b = mesh.node(0, 0, 0), mesh.node(0, 0, 0)
    mesh.lump(a, 2.0, (1.0, 1.0, 1.0))
    mesh.lump(b, 3.0, (1.0, 1.0, 1.0))
    mesh.spring(a, b, (5e4,))
    hz, shapes = mesh.modes(12)
    assert hz.max() == pytest.approx(np.sqrt(5e4 / 2 + 5e4 / 3) / 2 / np.pi, rel=1e-9)
    assert shapes.T @ mesh.assemble()[1] @ shapes == pytest.approx(np.eye(12), abs=1e-9)


def test_round_and_square_sections():
    assert Section(0.04).inertia[0] == pytest.approx(np.pi * 0.02**4 / 4)
    assert Section(0.04).torsion == pytest.approx(2 * Section(0.04).inertia[0])
    assert Section(0.02, 0.02).torsion == pytest.approx(0.1406 * 0.02**4, rel=2e-3)


def test_draws_are_fair():
    """Enough modes in band, none too close, references within the sensors."""
    for family in FAMILIES:
        structure = draw(family, 4)
        hz = structure.hz[structure.in_band]
        assert len(hz) >= 8
        assert np.all(hz[1:] / hz[:-1] > CLOSEST[family])
        assert len(structure.sensors) > len(hz)
        assert structure.gaps
        below = structure.hz < structure.band[0]
        assert below.sum() == HUNG.get(family, 0)
        assert np.all(structure.zeta[below] == SUSPENSION_DAMPING)


def _law(effect, structure, s):
    """Added dynamic stiffness (n, n) at s by the law of the contract, from the answer alone."""
    rows = dict(zip([x.name for x in structure.sensors], structure.rows, strict=True))
    p = {name: value["value"] for name, value in effect["parameters"].items()}
    b = [rows[name] for name in effect["location"]]
    kind = effect["kind"]
    omega2, zeta = (2 * np.pi * structure.hz) ** 2, structure.zeta
    if kind == "point_mass":
        node = next(x.node for x in structure.sensors if x.name == effect["location"][0])
        return p["mass"] * s**2 * sum(np.outer(r, r) for r, x in zip(structure.rows, structure.sensors, strict=True) if x.node == node)
    if kind == "global_stiffness":
        return p["change"] * np.diag(omega2)
    if kind == "global_damping":
        return p["change"] * s * np.diag(2 * zeta * np.sqrt(omega2))
    if kind in ("gyroscopic", "circulatory"):
        return p["coefficient"] * (s if kind == "gyroscopic" else 1) * (np.outer(b[0], b[1]) - np.outer(b[1], b[0]))
    if kind == "tuned_absorber":
        w = 2 * np.pi * p["frequency"]
        z = p["mass"] * s**2 * (w**2 + 2 * p["damping_ratio"] * w * s) / (s**2 + w**2 + 2 * p["damping_ratio"] * w * s)
    else:
        z = {
            "ground_spring": lambda: p["stiffness"],
            "coupling_spring": lambda: p["stiffness"],
            "ground_damper": lambda: p["damping"] * s,
            "coupling_damper": lambda: p["damping"] * s,
            "ground_hysteretic_spring": lambda: p["stiffness"] * (1 + 1j * p["loss_factor"]),
            "ground_rubber": lambda: p["stiffness"] * (s / (2 * np.pi * effect["reference_hz"])) ** p["exponent"],
        }[kind]()
    place = b[0] if len(b) == 1 else b[0] - b[1]
    return z * np.outer(place, place)


@pytest.mark.parametrize("kind", [k for k in hidden.LINEAR if k != "missing_mode"])
def test_effect_follows_its_law(kind):
    """The state's FRFs are those of idle dynamic stiffness + law, solved line by line; and the change is 0.5 to 6 dB."""
    spec = generate.Spec("rotor", kind, 4, 2)
    known = generate.truth(spec)
    structure, state = known.structure, known.state
    hz = np.linspace(*known.band, 7)
    found = state.system.accelerance(hz, state.rows, state.rows[list(known.references)])
    for i, f in enumerate(hz):
        s = 2j * np.pi * f
        omega = 2 * np.pi * structure.hz
        z = np.diag(s**2 + 2 * structure.zeta * omega * s + omega**2) + _law(state.effects[0], structure, s)
        exact = s**2 * structure.rows @ np.linalg.solve(z, structure.rows[list(known.references)].T)
        assert np.abs(found[:, :, i] - exact).max() < 1e-7 * np.abs(exact).max()
    assert 0.49 < hidden.change_db(structure, state, known.references) < 6.2


@pytest.mark.parametrize("kind", ["global_stiffness", "global_damping"])
def test_a_change_of_all_leaves_what_was_hung_on_before(kind):
    """An absorber keeps its own frequency and damping where all stiffness or damping of the structure changes beside it."""
    known = generate.truth(generate.Spec("rotor", "tuned_absorber", 4, 2))
    structure, before = known.structure, known.state.system
    after = hidden.hide(kind, structure, known.references, np.random.default_rng(1), known.state)
    change, omega = after.effects[-1]["parameters"]["change"]["value"], 2 * np.pi * structure.hz
    stiffer, damped = (change * (kind == which) for which in ("global_stiffness", "global_damping"))
    n = omega.size
    np.testing.assert_allclose((after.system.stiffness - before.stiffness)[:n, :n], stiffer * np.diag(omega**2), atol=1e-6)
    np.testing.assert_allclose((after.system.damping - before.damping)[:n, :n], damped * np.diag(2 * structure.zeta * omega), atol=1e-9)
    assert abs(change) > 1e-3
    assert len(before.mass) == n + 1
    np.testing.assert_array_equal(after.system.stiffness[n], before.stiffness[n])
    np.testing.assert_array_equal(after.system.damping[n], before.damping[n])


@pytest.mark.parametrize(("frequency", "right"), [(46.7, True), (46.3, True), (45.8, False), (22.5, False), (None, False)])
def test_a_missing_mode_is_right_within_its_half_power_width(frequency, right):
    def mode(f):
        values = {} if f is None else {"frequency": {"value": f, "unit": "Hz"}}
        return {"kind": "missing_mode", "location": [], "parameters": values | {"damping_ratio": {"value": 0.008, "unit": ""}}}

    assert judge.matches(mode(frequency), mode(46.7), {}) is right


def test_missing_mode_is_one_more_term():
    known = generate.truth(generate.Spec("frame", "missing_mode", 1))
    base = hidden.idle(known.structure)
    hz = np.linspace(*known.band, 9)
    added = known.state.system.accelerance(hz, known.state.rows, known.state.rows) - base.system.accelerance(hz, base.rows, base.rows)
    p = known.state.effects[0]["parameters"]
    w, wr = 2 * np.pi * hz, 2 * np.pi * p["frequency"]["value"]
    shape = known.state.rows[:, -1]
    term = np.multiply.outer(np.outer(shape, shape), -(w**2) / (wr**2 - w**2 + 2j * p["damping_ratio"]["value"] * wr * w))
    assert added == pytest.approx(term, rel=1e-6, abs=1e-9 * np.abs(term).max())


def test_poles_are_where_the_frf_peaks():
    """Also for the fractional law, whose eigenvalue problem is not linear: Z(λ) is singular at each pole."""
    for kind in ("ground_rubber", "circulatory"):
        known = generate.truth(generate.Spec("frame", kind, 1))
        structure = known.structure
        poles, _ = known.state.system.poles()
        omega = 2 * np.pi * structure.hz
        for pole in poles[:8]:
            z = np.diag(pole**2 + 2 * structure.zeta * omega * pole + omega**2) + _law(known.state.effects[0], structure, pole)
            values = np.linalg.svd(z, compute_uv=False)
            assert values[-1] < 1e-5 * np.abs(pole) ** 2


def _channels(content):
    """Samples of each 58b set of a file, as (title, array)."""
    out = []
    position = 0
    while (start := content.find(b"\n    58b", position)) >= 0:
        size = int(content[start + 1 :].split(b"\n", 1)[0].split()[4])
        header_end = start + 1
        for _ in range(12):
            header_end = content.index(b"\n", header_end) + 1
        title = content[start + 1 :].split(b"\n", 2)[1].decode().strip()
        out.append((title, np.frombuffer(content[header_end : header_end + size], "<f4").astype(float)))
        position = header_end + size
    return out


@pytest.mark.parametrize("excitation", ["shaker", "hammer"])
def test_records_are_exact_sections(excitation):
    """Without noise the response obeys the equation of motion inside the record, and random records do not close on themselves."""
    structure = draw("frame", 4)
    logger = records.Logger(structure, np.random.default_rng(1), ("m/s^2", "N"))
    state = hidden.idle(structure)
    old = records.RESPONSE_NOISE, records.FORCE_NOISE
    try:
        records.RESPONSE_NOISE = records.FORCE_NOISE = 0.0
        content = records.forced_run(logger, state, 2, excitation, 24, 10.0, "run")
    finally:
        records.RESPONSE_NOISE, records.FORCE_NOISE = old
    (title, force), *responses = _channels(content)
    assert title.startswith("force")
    acceleration = np.array([r for _, r in responses])
    assert acceleration.shape == (len(structure.sensors), 24 * 512)
    # March the modal equations through the record on an 8 times finer grid (the force is band-limited).
    fine = 8
    n = force.size
    grid = np.fft.irfft(np.pad(np.fft.rfft(force), (0, (fine - 1) * n // 2)), fine * n) * fine
    modes = structure.hz < 400
    omega, zeta, rows = 2 * np.pi * structure.hz[modes], structure.zeta[modes], structure.rows[:, modes]
    step = 1 / (512 * fine)
    damped = -zeta * omega + 1j * omega * np.sqrt(1 - zeta**2)
    turn = np.exp(damped * step)
    x = np.zeros(omega.size, complex)  # q = Im(x)/ω_d by Duhamel's integral, force linear between samples
    drive = rows[2]
    tail = np.zeros((len(rows), n // 2))
    static = structure.rows[:, ~modes] @ (structure.rows[2, ~modes] / (2 * np.pi * structure.hz[~modes]) ** 2)
    assert np.abs(static).max() > 0  # high modes answer nearly statically: small in accelerance, hence the tolerance below
    for k in range(fine * n - 1):
        x = turn * x + step * (0.5 * turn * grid[k] + 0.5 * grid[k + 1])
        if (k + 1) % fine == 0 and (k + 1) // fine >= n // 2:
            speed = np.imag(damped * x) / damped.imag
            place = np.imag(x) / damped.imag
            q = drive * grid[k + 1] - 2 * zeta * omega * speed * drive - omega**2 * place * drive
            tail[:, (k + 1) // fine - n // 2] = rows @ q
    shown = acceleration[:, n // 2 + 1 : -600]
    marched = tail[:, 1 : shown.shape[1] + 1]
    # The unknown start has died away by then (e^-12 of it and more is left); what remains are the high modes left out.
    error = np.linalg.norm(shown - marched, axis=1) / np.linalg.norm(shown, axis=1)
    assert np.median(error) < 0.03
    if excitation == "shaker":
        assert np.abs(acceleration[:, 0]).max() > 0.05 * acceleration.std()
    else:
        assert np.abs(acceleration[:, :500]).max() < 1e-3 * np.abs(acceleration).max()


def test_noise_levels_and_sensor_faults():
    structure = draw("rotor", 4)
    content = {}
    for name, state in {
        "sound": hidden.idle(structure),
        "faulty": hidden.replace(hidden.idle(structure), gain={0: -1.0, 1: 0.5}, swap=(3, 4), delay={2: 2 / 512}, force_gain={5: 2.0}),
    }.items():
        logger = records.Logger(structure, np.random.default_rng(5), ("m/s^2", "N"))
        content[name] = [c for _, c in _channels(records.forced_run(logger, state, 5, "shaker", 16, 10.0, "run", check=True))]
    sound, faulty = content["sound"], content["faulty"]
    tolerance = 0.03
    assert np.linalg.norm(faulty[0] - 2 * sound[0]) < tolerance * np.linalg.norm(faulty[0])
    assert np.linalg.norm(faulty[1] + sound[1]) < tolerance * np.linalg.norm(sound[1])
    assert np.linalg.norm(faulty[2] - 0.5 * sound[2]) < tolerance * np.linalg.norm(sound[2])
    assert np.linalg.norm(faulty[3][2:] - sound[3][:-2]) < tolerance * np.linalg.norm(sound[3])
    assert np.linalg.norm(faulty[4] - sound[5]) < tolerance * np.linalg.norm(sound[5])
    assert np.linalg.norm(faulty[5] - sound[4]) < tolerance * np.linalg.norm(sound[4])


def test_case_keeps_its_secret(tmp_path):
    """Answers lie outside the case; no file of the case names the effect; the same Spec gives the same bytes."""
    spec = generate.Spec("frame", "coupling_spring", 4, 1)
    case = generate.write(spec, tmp_path)
    files = sorted(f.relative_to(case).as_posix() for f in case.rglob("*") if f.is_file())
    expected = ["check/run1a.uff", "check/run1b.uff", "geometry.uff", "idle/run1.uff", "operating/run1.uff", "test.toml"]
    assert files == expected
    for name in files:
        content = (case / name).read_bytes()
        assert b"coupling" not in content
        assert b"answer" not in content
    known = json.loads((tmp_path / "answers" / f"{spec.name}.json").read_text())
    assert known["effects"][0]["kind"] == "coupling_spring"
    assert generate.parse(spec.name) == spec
    again = generate.write(spec, tmp_path / "again")
    for name in files:
        assert (again / name).read_bytes() == (case / name).read_bytes()
    exact = np.load(tmp_path / "answers" / f"{spec.name}.npz")
    assert exact["H"].shape == (len(known["dofs"]),) * 2 + (400,)


def test_nothing_of_operando_is_imported():
    code = "import sys; sys.path.insert(0, sys.argv[1]); import generate; assert not [m for m in sys.modules if m.startswith('operando')]"
    subprocess.run([sys.executable, "-c", code, str(FOLDER)], check=True)
    for name in ("beams", "families", "hidden", "days", "records", "generate"):
        text = (FOLDER / f"{name}.py").read_text()
        assert "import operando" not in text
        assert "from operando" not in text


def _answer(effects):
    return {
        "effects": effects,
        "check": True,
        "dofs": ["1+Z", "2-Z", "3+X"],
        "references": ["1+Z"],
        "positions": {"1+Z": [0, 0, 0], "2-Z": [0.4, 0, 0], "3+X": [0.8, 0, 0]},
        "sensor_spacing_m": 0.4,
        "band_hz": [5.0, 50.0],
        "harmonics_hz": [],
        "idle": {
            "frequency_hz": [10.0, 20.0],
            "damping_ratio": [0.01, 0.01],
            "shapes_unit_modal_mass": [[1.0, 0.5], [0.5, -1.0], [0.2, 0.3]],
        },
    }


def _effect(kind, location, **parameters):
    return {
        "kind": kind,
        "location": location,
        "parameters": {k: {"value": v, "unit": "", "std": 0.1 * abs(v)} for k, v in parameters.items()},
    }


def _diagnosis(verdict, *effects, ambiguous=()):
    ladder = [{"heldout_misfit": 100.0}, {"heldout_misfit": 1.0}]
    return {"verdict": verdict, "effects": list(effects), "ambiguous_with": list(ambiguous), "candidates": [], "ladder": ladder}


def test_judge_tells_right_from_wrong():
    """Kind, place, set, size and intervals; a false alarm; a place between sensors."""
    true = _effect("coupling_spring", ["1+Z", "2-Z"], stiffness=1000.0)
    answer = _answer([true])
    right = judge.compare_diagnosis(answer, _diagnosis("explained", _effect("coupling_spring", ["2-Z", "1+Z"], stiffness=1050.0)))
    assert right["top"]
    assert right["in_set"]
    assert right["sizes"][0]["error"] == pytest.approx(0.05)
    assert right["sizes"][0]["z"] == pytest.approx(50 / 105)
    wrong = judge.compare_diagnosis(
        answer, _diagnosis("ambiguous", _effect("coupling_spring", ["1+Z", "3+X"], stiffness=900.0), ambiguous=[true])
    )
    assert not wrong["top"]
    assert wrong["kind_top"]
    assert wrong["in_set"]
    assert not wrong["sizes"]
    assert judge.compare_diagnosis(_answer([]), _diagnosis("explained", true))["false_alarm"]
    assert not judge.compare_diagnosis(_answer([]), _diagnosis("no_misfit"))["false_alarm"]
    between = {**_effect("point_mass", [], mass=1.0), "position": [0.25, 0.0, 0.0], "direction": "+Z"}
    near, far = ({**between, "position": [x, 0.0, 0.0]} for x in (0.4, 0.55))
    assert judge.compare_diagnosis(_answer([between]), _diagnosis("explained", near))["top"]
    assert not judge.compare_diagnosis(_answer([between]), _diagnosis("explained", far))["top"]


def test_judge_counts_modes():
    """A mode found, one missed, one spurious; the modal mass from the scale of the shape; labels of either sign."""
    mode = {"frequency_hz": 10.001, "damping_ratio": 0.0101, "frequency_std_hz": 0.001, "damping_ratio_std": 1e-4, "in_band": True}
    found = {**mode, "shape": {"1+Z": 1.1, "2+Z": -0.55, "3+X": 0.22}, "shape_std": {"1+Z": 0.1, "2+Z": 0.01, "3+X": 0.1}}
    false = {**mode, "frequency_hz": 33.0, "shape": {"1+Z": 1.0, "2+Z": 1.0, "3+X": 0.1}}
    out = judge.identification(_answer([]), {"idle": {"modes": [found, false], "misfit": 1.0}})["idle"]
    assert out["found"] == 1
    assert out["missed"] == [20.0]
    assert out["spurious"] == [33.0]
    pair = out["pairs"][0]
    assert pair["mass_error"] == pytest.approx(1 / 1.21 - 1)
    assert pair["f_z"] == pytest.approx(1.0)
    assert pair["shape_within"] == pytest.approx(2 / 3)


def test_plan_is_what_the_issue_asks_for():
    """At least six seeds a kind in each family, 100 runs with nothing hidden, every name once and readable."""
    specs = score.plan("full")
    assert len({s.name for s in specs}) == len(specs) >= 200
    assert all(generate.parse(s.name) == s for s in specs)
    for family in IN_PLANS:
        for kind in (*hidden.LINEAR, *hidden.SENSOR):
            seeds = {s.seed for s in specs if s.family == family and s.kind == kind and s.check}
            assert len(seeds) >= 6
    assert sum(s.kind in ("none", "orders") for s in specs) >= 100


def test_plan_of_panels_has_all_kinds_of_three_two_and_one_reference():
    specs = score.plan("panel")
    assert len({s.name for s in specs}) == len(specs) == 55
    assert {s.references for s in specs} == {1, 2, 3}
    assert all(s.family == "panel" and generate.parse(s.name) == s for s in specs)


def test_tally_says_what_is_not_there():
    row = {
        "case": "a",
        "kind": "none",
        "check": True,
        "references": 1,
        "identification": None,
        "diagnosis": None,
        "no_diagnosis": "not built yet",
    }
    text = tally.report([row])
    assert "No diagnosis in 1 runs: not built yet" in text


def test_uneven_pairs_have_the_ratio_they_promise():
    known = generate.truth(generate.parse("rotor-uneven-702-r3-shaker"))
    strong = hidden.change_db(known.structure, known.weaker_than, known.references)
    weak = hidden.change_db(known.structure, known.state, known.references, known.weaker_than)
    assert 2 * 0.95 <= strong <= 6 * 1.05
    assert 3 * 0.9 <= strong / weak <= 30 * 1.1
    assert len(known.state.effects) == 2
    assert len({e["kind"] for e in known.state.effects}) == 2

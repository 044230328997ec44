"""Two days in a laboratory and complex modes at rest: what the generator of hidden effects lets differ besides what it hides."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from test_hidden_effects import _channels

sys.path.append(str(Path(__file__).resolve().parents[1] / "benchmarks" / "hidden_effects"))

import days
import generate
import hidden
import records
import score
import tally
from families import IN_PLANS, draw

DAYS = "frame-point_mass-4-r1-shaker-days"


def test_two_days_differ_only_where_the_machine_runs(tmp_path):
    """Same structure at rest, same effect, same forces; only check and operating records differ; what differs is told, with sizes."""
    spec = generate.parse(DAYS)
    folders = [generate.write(s, tmp_path) for s in (spec, generate.replace(spec, days=False))]
    again = generate.write(spec, tmp_path / "again")
    for file in sorted(f.relative_to(folders[0]) for f in folders[0].rglob("*") if f.is_file()):
        two, one, repeated = ((f / file).read_bytes() for f in (*folders, again))
        assert two == repeated
        assert (two == one) == (file.parts[0] not in ("check", "operating"))
    answers = [json.loads((tmp_path / "answers" / f"{f.name}.json").read_text()) for f in folders]
    assert all(answers[0][key] == answers[1][key] for key in ("effects", "change_db", "idle", "references", "band_hz"))
    assert set(answers[0]) - set(answers[1]) == {"between", "between_db", "between_median_db"}
    between = answers[0]["between"]
    assert list(between["sensors"]) == answers[0]["dofs"]
    assert list(between["forces"]) == answers[0]["references"]
    exact = np.load(tmp_path / "answers" / f"{spec.name}.npz")
    known = generate.truth(spec)
    true = known.state.system.accelerance(exact["f"][:3], known.state.rows, known.state.rows)
    assert exact["H"][:, :, :3] == pytest.approx(true, rel=1e-5, abs=1e-6)


def test_names_of_days_and_complex_cases_round_trip():
    for ends in ("days", "complex", "days-complex", "orders-days", "nocheck-orders-days"):
        assert generate.parse(f"rotor-none-801-r3-shaker-{ends}").name == f"rotor-none-801-r3-shaker-{ends}"
    for kind in ("cubic_stiffness", "coulomb_friction"):
        with pytest.raises(ValueError, match="real modes"):
            generate.truth(generate.Spec("rotor", kind, 801, days=True, complex=True))
    for plan, least in (("days", 90), ("complex", 34), ("single", 24)):
        specs = score.plan(plan)
        assert len({s.name for s in specs}) == len(specs) == least
        assert all(generate.parse(s.name) == s for s in specs)
    specs = score.plan("days")
    assert sum(s.kind == "none" for s in specs) == 30
    assert {s.kind for s in specs if s.kind != "none"} == set(hidden.LINEAR)
    assert min(sum(s.references == n for s in specs) for n in (1, 3)) >= 40


@pytest.fixture(scope="module")
def drawn_days():
    """Some differences a family, with what the answer says of them."""
    out = []
    for family in IN_PLANS:
        structure = draw(family, 4)
        for seed in range(8):
            drawn = days.draw_days(structure, (0, 1), np.random.default_rng(seed))
            out.append((structure, drawn, days.told(structure, (0, 1), drawn)))
    return out


def test_differences_between_days_have_their_sizes(drawn_days):
    """Gains about 1 %, frequencies about 0.2 %, damping about 10 %, a degree, millimetres, a few steps of 20 µs."""
    sensors = [s for _, _, t in drawn_days for s in t["sensors"].values()]
    forces = [s for _, _, t in drawn_days for s in t["forces"].values()]
    gains = [s["gain"] for s in sensors + forces]
    assert np.std(gains) == pytest.approx(0.01, rel=0.2)
    assert abs(np.mean(gains) - 1) < 0.003
    assert 0.003 < np.median([s["gain_off_rms"] for s in sensors]) < 0.012
    assert all(0.29 < s["askew_deg"] < 1.51 for s in sensors)
    assert all(0.49 < s["askew_deg"] < 2.01 for s in forces)
    assert all(0.0009 < s["beside_m"] < 0.0041 for s in sensors)
    assert 0.005 < np.median([s["shape_off_rms"] for s in sensors]) < 0.03
    for structure, drawn, told in drawn_days:
        assert 0.0008 < told["frequency_shift_rms"] < 0.0035
        assert 0.05 < told["damping_off_rms"] < 0.18
        assert abs(told["response_late_s"]) <= 3 / 51200
        assert all(0.015 < s["beside_m"] / structure.spacing < 0.025 for s in told["forces"].values())
        assert all(-0.7 < change < 1.0 for change in drawn.damping.values())


def test_differences_between_days_are_no_single_numbers(drawn_days):
    """Gains depend on frequency, modes shift apart, damping couples modes, shapes change otherwise than by a factor."""
    for structure, drawn, told in drawn_days:
        hz = np.linspace(*structure.band, 50)
        ratios = np.array([channel.ratio(hz) for channel, _ in drawn.sensors])
        assert np.median(np.ptp(np.abs(ratios), axis=1)) > 5e-4
        shift, factor = np.array(told["frequency_shift"]), np.array(told["damping_factor"])
        assert 0.02 < np.std(shift) / told["frequency_shift_rms"] < 1.2
        assert np.std(factor) > 0.005
        rest = hidden.idle(structure)
        after = days.second_day(structure, rest, drawn)
        inside = np.flatnonzero(structure.in_band)
        for change in (after.system.stiffness - rest.system.stiffness, after.system.damping - rest.system.damping):
            assert change == pytest.approx(change.T, abs=1e-9 * np.abs(change).max())
            block = change[np.ix_(inside, inside)]
            assert np.abs(block - np.diag(np.diag(block))).max() > 0.02 * np.abs(np.diag(block)).max()
        scaled = [(a @ b) / np.linalg.norm(a) / np.linalg.norm(b) for a, b in zip(after.seen[:, inside], rest.rows[:, inside], strict=True)]
        assert min(scaled) < 1 - 1e-5


def test_parts_add_up_to_the_structure():
    for family in IN_PLANS:
        structure = draw(family, 4)
        square = (2 * np.pi * structure.hz) ** 2
        assert sum(structure.parts.values()) == pytest.approx(np.diag(square), abs=1e-9 * square.max())
        rest = hidden.idle(structure).system.damping
        assert sum(days._dampers(structure).values()) == pytest.approx(rest, abs=1e-9 * rest.max())


def test_beside_its_place_a_sensor_sees_what_stands_there():
    """Rotation times offset is the slope of the shape: against central differences along the members, for the lowest modes."""
    structure = draw("rotor", 4)
    state, compared = hidden.idle(structure), 0
    for sensor in structure.sensors:
        n, points = sensor.node, structure.points
        if not 0 < n < len(points) - 1 or np.abs(points[n + 1] + points[n - 1] - 2 * points[n]).max() > 1e-9:
            continue  # not in the middle of three nodes of one member
        along = points[n + 1] - points[n - 1]
        exact = np.eye(3)[sensor.axis]
        slope = days.Placing(exact, along).row(structure, state, sensor) - state.rows[list(structure.sensors).index(sensor)]
        ends = [sensor.sense * structure.shapes[3 * m + sensor.axis] for m in (n + 1, n - 1)]
        assert np.linalg.norm((slope - ends[0] + ends[1])[:5]) < 0.1 * np.linalg.norm(slope[:5]) + 1e-6
        compared += 1
    assert compared >= 3


def test_changes_of_all_act_on_day_two():
    """A hidden change of all stiffness is one of the stiffness of day two."""
    known = generate.truth(generate.parse("frame-global_stiffness-4-r1-shaker-days"))
    change = known.state.effects[0]["parameters"]["change"]["value"]
    alone = days.second_day(known.structure, hidden.idle(known.structure), known.days).system
    assert known.state.system.stiffness == pytest.approx((1 + change) * alone.stiffness, rel=1e-9)
    assert known.state.system.damping == pytest.approx(alone.damping, rel=1e-9)


def test_day_two_goes_through_the_records():
    """Responses through their channels, the force through its own and early by the skew; the run at rest knows nothing of it."""
    structure = draw("rotor", 4)
    rest = hidden.idle(structure)
    plain = [days.Channel(gain, (2000.0, 2000.0), (0.16, 0.16)) for gain in (2.0, 0.5)]
    rows = dict(enumerate(rest.rows))
    remounted = days.Remounted(rest.rows, rows, (plain[0],) * len(rest.rows), {5: plain[1]}, 2 / 512)
    content = []
    for state, check in (
        (rest, True),
        (hidden.replace(rest, remounted=remounted), True),
        (hidden.replace(rest, remounted=remounted), False),
    ):
        logger = records.Logger(structure, np.random.default_rng(5), ("m/s^2", "N"))
        content.append([c for _, c in _channels(records.forced_run(logger, state, 5, "shaker", 8, 10.0, "run", check=check))])
    same_day, next_day, at_rest = content
    assert np.linalg.norm(0.5 * same_day[0][2:] - next_day[0][:-2]) < 0.03 * np.linalg.norm(next_day[0])
    for one, two in zip(same_day[1:], next_day[1:], strict=True):
        assert np.linalg.norm(2 * one - two) < 0.03 * np.linalg.norm(two)
    assert all(np.array_equal(a, b) for a, b in zip(same_day, at_rest, strict=True))


def test_days_alone_change_the_frfs():
    """With nothing hidden: tenths of a dB in the median, no more than 1.5 dB rms where no antiresonance is near."""
    for name in ("frame-none-801-r3-shaker-days", "rotor-none-802-r3-shaker-days"):
        known = generate.truth(generate.parse(name))
        told = days.between_db(known.structure, known.references, known.days)
        assert 0.1 < told["between_median_db"] < 1.5
        assert told["between_median_db"] < told["between_db"] < 6
        before, after = days.day_frfs(known.structure, known.references, known.days, np.linspace(*known.band, 200))
        loud = np.abs(before) > np.sqrt(np.mean(np.abs(before) ** 2, axis=2, keepdims=True)) / 3
        assert 0.1 < np.sqrt(np.mean((20 * np.log10(np.abs(after / before)))[loud] ** 2)) < 1.5
        assert not known.state.effects


def test_local_damper_makes_modes_complex():
    """One or two modes are damped by 5 to 10 % and complex; the sum of the residues told is the FRF."""
    for family in IN_PLANS:
        spec = generate.Spec(family, "none", 1050, complex=True)
        known = generate.truth(spec)
        rest = hidden.idle(known.structure)
        poles, shapes = days.mode_shapes(rest, rest.rows, len(known.structure.hz))
        inside = known.structure.in_band
        zeta = (-poles.real / np.abs(poles))[inside]
        assert days.mpc(shapes)[inside].min() < 0.9
        assert 0.05 < zeta.max() < 0.10
        assert np.sort(zeta)[-3] < 0.011 + 0.006 + 0.002  # what it had at most, what the damper adds at most, coupling
        hz = np.linspace(*known.band, 7)
        s = 2j * np.pi * hz
        parts = np.einsum("ir,jr,r->ijr", shapes, shapes, 1 / (2j * np.abs(poles.imag)))
        total = s**2 * (parts @ (1 / (s - poles[:, None])) + parts.conj() @ (1 / (s - poles.conj()[:, None])))
        assert total == pytest.approx(rest.system.accelerance(hz, rest.rows, rest.rows), rel=1e-6, abs=1e-9)
        told = generate.answer(spec, known)
        assert told["change_db"] == 0
        assert np.abs(told["idle"]["shapes_imaginary"]).max() > 0.05 * np.abs(told["idle"]["shapes_unit_modal_mass"]).max()


def test_tally_keeps_days_apart():
    diagnosis = {
        "verdict": "ambiguous",
        "effects": ["point_mass@1+Z=mass:1", "sensor_gain@2+Z"],
        "right": [True],
        "top": True,
        "in_set": True,
    }
    diagnosis |= {"sizes": [{"kind": "point_mass", "name": "mass", "primary": True, "error": 0.02, "z": 1.0}], "extra": 1}
    diagnosis |= {"false_alarm": False, "heldout": [], "monotone": True}
    row = {"case": "a", "kind": "point_mass", "check": True, "references": 3, "identification": None, "change_db": 0.0}
    row |= {"days": True, "between_db": 2.0, "truth": [{"kind": "point_mass"}], "diagnosis": diagnosis}
    quiet = {**row, "case": "b", "kind": "none", "truth": [], "diagnosis": {**diagnosis, "right": [], "sizes": [], "false_alarm": True}}
    quiet["diagnosis"] |= {"candidate": None}
    text = tally.report([row, quiet])
    assert "Two days in a laboratory (2 runs)" in text
    assert "Must show" not in text
    lines = {line.rsplit("  ", 1)[0].strip(): line.rsplit("  ", 1)[1].strip() for line in text.splitlines() if line.startswith("  ")}
    assert lines["one effect, 3 references: kind and place at the top"] == "1/1 = 100.0 %"
    assert lines["one effect: none named beside it"] == "0/1, 1 in all"
    assert lines["one effect: size inside its 95 % interval"] == "1/1"
    assert lines["nothing hidden: structural effects named"] == "1/1 = 100.0 %"

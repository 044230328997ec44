"""A mass beside an effect that depends on the level: by FRFs at a level, in time, in records, and by the command line."""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest
from click.testing import CliRunner

from nonlinear_truth import RATE, Strip, band_force, measure_many, place, respond
from operando.cli import main
from operando.data import Channel, TimeRecord
from operando.diagnosis import apply_to_records
from operando.diagnosis.at_level import level_frf
from operando.dof import Dof
from operando.errors import DataError
from operando.frf import estimate_frf
from operando.io import read, write_uff
from operando.pipeline.levels import check_frfs
from operando.results import Results
from operando.store import load_results, save_results
from operando.structure import Model, at_level, simulate, with_masses
from operando.structure.effects import Effect, parse_effect

STRIP = Strip()
BAND = (5.0, 95.0)
HZ = np.arange(5.0, 95.0, 0.1)
MASS = 0.15
CUBIC = (place(STRIP, 2), "cubic_stiffness", {"coefficient": 1e8})
MASSES = [Effect("point_mass", ("6+Z",), {"mass": MASS})]
BOTH = [*MASSES, Effect("cubic_stiffness", ("3+Z",), {"coefficient": 1e8})]


@cache
def loaded():
    """The strip with the mass: its own matrices, whose damping is taken for modal."""
    one = Strip()
    w = 2 * np.pi * one.hz
    mass = np.eye(w.size) + MASS * np.outer(one.phi[5], one.phi[5])
    root = np.linalg.inv(np.linalg.cholesky(mass))
    values, vectors = np.linalg.eigh(root @ np.diag(w**2) @ root.T)
    vectors = root.T @ vectors
    one.hz = np.sqrt(values) / 2 / np.pi
    one.zeta = np.diag(vectors.T @ np.diag(2 * one.zeta * w) @ vectors) / 2 / np.sqrt(values)
    one.phi = one.phi @ vectors
    return one


@cache
def records():
    return measure_many(loaded(), {"cubic": [CUBIC]}, seconds=12.0, run_in=3.0)["cubic"]


def off(one, other):
    """Rms difference over rms."""
    return float(np.sqrt(np.mean(np.abs(one - other) ** 2) / np.mean(np.abs(other) ** 2)))


def test_a_mass_becomes_part_of_the_model():
    made, others = with_masses(STRIP.idle(), BOTH)
    assert others == BOTH[1:]
    exact = Model(STRIP.idle(), tuple(MASSES)).frf(HZ, variance=False)
    assert off(made.frf(HZ).data, exact.data) < 0.01  # damping between the modes is left out
    assert off(STRIP.idle().frf(HZ).data, exact.data) > 1
    assert made.n_modes == STRIP.idle().n_modes
    np.testing.assert_array_equal(made.terms.residual, STRIP.idle().terms.residual)
    idle = STRIP.idle()
    assert with_masses(idle, BOTH[1:])[0] is idle


def test_what_is_not_known_of_the_idle_model_goes_with_it():
    idle = STRIP.idle()
    n, m = idle.terms.n, len(idle.dofs)
    std = np.concatenate([1e-4 * idle.terms.frequencies_hz, 1e-2 * idle.terms.damping_ratios, np.full(n * m, 1e-3)])
    known = idle.with_terms(covariance=np.diag(std**2))
    made = with_masses(known, MASSES)[0].frf(HZ, "1+Z, 6+Z", "2+Z")
    exact = Model(known, tuple(MASSES)).frf(HZ, "1+Z, 6+Z", "2+Z")
    assert np.median(made.variance / exact.variance) == pytest.approx(1, abs=0.05)


def test_a_mass_that_cannot_be_taken_away_is_refused():
    away = Effect("point_mass", ("6+Z",), {"mass": 50.0}, removed=True)
    with pytest.raises(DataError, match="more mass would be taken away"):
        with_masses(STRIP.idle(), [away])


def test_the_simulation_follows_the_integrator():
    force = band_force(np.random.default_rng(5), int(5 * RATE))
    ramp = int(0.1 * RATE)
    force[:ramp] *= np.linspace(0, 1, ramp)
    force[-ramp:] *= np.linspace(1, 0, ramp)
    answer = respond(loaded(), [1], force[None], [CUBIC])[0]
    made = simulate(STRIP.idle(), BOTH, TimeRecord(force[None], RATE, (Channel(Dof(2, "Z", 1), "force", "N"),)))
    assert off(made.data, answer) < 0.03
    assert off(simulate(STRIP.idle(), BOTH[1:], TimeRecord(force[None], RATE, (Channel(Dof(2, "Z", 1), "force", "N"),))).data, answer) > 0.3


def test_frfs_at_a_level_are_those_of_the_structure_with_the_mass():
    here = at_level(STRIP.idle(), BOTH, 10.0, "2+Z", BAND)
    there = at_level(loaded().idle(), BOTH[1:], 10.0, "2+Z", BAND)
    assert here[0] is BOTH[0]
    assert here[1].values["stiffness"] == pytest.approx(there[0].values["stiffness"], rel=0.02)
    made = level_frf(STRIP.idle(), BOTH, 10.0, HZ, "1+Z, 3+Z", "2+Z", band=BAND)
    wanted = level_frf(loaded().idle(), BOTH[1:], 10.0, HZ, "1+Z, 3+Z", "2+Z", band=BAND)
    assert off(made.data, wanted.data) < 0.03


@cache
def applied(*effects):
    return apply_to_records(STRIP.idle(), [parse_effect(e) for e in effects], records(), band=BAND)


def test_in_records_the_others_are_fitted_with_the_mass():
    made = applied("cubic_stiffness@3+Z", f"point_mass@6+Z=mass:{MASS}")
    assert [e.kind for e in made.effects] == ["point_mass", "cubic_stiffness"]
    assert made.effects[0].values == {"mass": MASS}
    assert made.effects[1].values["coefficient"] == pytest.approx(1e8, rel=0.03)
    left = [row["heldout_misfit"] for row in made.ladder]
    assert len(left) == 3
    assert left[0] > 5 * left[1] > 25 * left[2]
    assert [row["added"] and row["added"]["kind"] for row in made.ladder] == [None, "point_mass", "cubic_stiffness"]
    assert made.model.effects[0].kind == "point_mass"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A results folder whose check came from raw files."""
    path = tmp_path_factory.mktemp("loaded")
    for i, record in enumerate(records()):
        write_uff(path / f"run{i}.uff", record)
    again = [read(path / f"run{i}.uff").records[0] for i in range(len(records()))]
    check = check_frfs(again, lambda part: estimate_frf(part, estimator="lrm"))
    at_rest = estimate_frf(measure_many(STRIP, {"none": []}, seconds=12.0, run_in=3.0)["none"], estimator="lrm")
    save_results(Results("a strip", {"band": list(BAND)}, idle=STRIP.idle(), idle_frf=at_rest, check=check), path / "model.h5")
    return path


def asked(*arguments):
    done = CliRunner().invoke(main, [*map(str, arguments), "--json"])
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def test_from_the_command_line_the_mass_is_sized_by_frfs(folder):
    asked("add", folder, "point_mass@6+Z", "cubic_stiffness@3+Z")
    stored = load_results(folder)
    mass, cubic = stored.diagnosis["effects"]
    assert mass["kind"] == "point_mass"
    assert abs(mass["parameters"]["mass"]["value"] - MASS) < max(3 * mass["parameters"]["mass"]["std"], 0.002)
    assert cubic["parameters"]["coefficient"]["value"] == pytest.approx(1e8, rel=0.05)
    assert any("point_mass at 6+Z is sized by the FRFs" in word for word in stored.diagnosis["by_hand"]["words"])
    rows = stored.diagnosis["ladder"]
    assert rows[2]["heldout_misfit"] < 0.05 * rows[0]["heldout_misfit"]
    assert (folder / "ofrf_effect.uff").is_file()
    made = asked(
        "ofrf", folder, "--route", "effect", "--references", "2+Z", "--level", "10", "--frequencies", "10:60:0.5", "-o", folder / "at10.uff"
    )
    assert made
    # taken back one by one
    asked("remove", folder, 2)
    assert [e["kind"] for e in load_results(folder).diagnosis["effects"]] == ["point_mass"]

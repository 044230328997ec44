"""Diagnosis from check FRFs: a chain of masses whose running state hides a known effect, solved by its matrices."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from operando.cli.diagnose import steps_table
from operando.compare.peaks import fit_peaks
from operando.data import Frf, ModalModel
from operando.diagnosis import apply_effects, diagnose
from operando.diagnosis.terms import _HELD, Term
from operando.dof import Dof
from operando.errors import IdentificationError, MissingError
from operando.pipeline.by_hand import model_now
from operando.plots import plot_steps
from operando.results import CheckRun
from operando.structure.effects import Effect, EffectKind, Parameter, parse_effect, register, unregister
from structures import Chain

N = 7
HZ = np.arange(4.0, 150.0, 0.25)
DOFS = tuple(Dof.parse(f"{i + 1}+Z") for i in range(N))


@pytest.fixture(scope="module")
def chain():
    return Chain(N)


@pytest.fixture(scope="module")
def idle(chain):
    p = N * (2 + N)
    std = np.r_[1e-6 * chain.hz, 1e-4 * chain.zeta, np.full(N * N, 1e-4)]
    return ModalModel(chain.hz, chain.zeta, chain.phi, DOFS, scaling="unit_modal_mass", covariance=np.diag(std**2)[:p, :p])


def running(chain, references, mass=None, damping=None, stiffness=None, seed=0, noise=2e-3):
    """Check FRFs from M, C, K with changes added, and complex noise of known variance."""
    damping_idle = chain.M @ chain.phi @ np.diag(2 * chain.zeta * 2 * np.pi * chain.hz) @ chain.phi.T @ chain.M
    m, c, k = chain.M.copy(), damping_idle, chain.K.copy()
    m = m if mass is None else m + mass
    c = c if damping is None else c + damping
    k = k if stiffness is None else k + stiffness
    w = 2 * np.pi * HZ
    h = np.array([-(x**2) * np.linalg.inv(k + 1j * x * c - x**2 * m)[:, references] for x in w])
    h = np.moveaxis(h, 0, 2)
    spread = noise * np.sqrt(np.mean(np.abs(h) ** 2, axis=2, keepdims=True))
    rng = np.random.default_rng(seed)
    data = h + spread * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    variance = np.broadcast_to(spread**2, h.shape).copy()
    return CheckRun("check", "1 N rms", Frf(data, HZ, DOFS, tuple(DOFS[r] for r in references), variance=variance))


def at(i, j=None):
    b = np.zeros(N)
    b[i] = 1
    if j is not None:
        b[j] = -1
    return np.outer(b, b)


def skew(i, j):
    out = np.zeros((N, N))
    out[i, j], out[j, i] = 1, -1
    return out


CASES = [
    ("point_mass", ["5+Z"], {"mass": 0.15 * at(4)}, "mass", 0.15),
    ("ground_spring", ["3+Z"], {"stiffness": 2e4 * at(2)}, "stiffness", 2e4),
    ("ground_damper", ["6+Z"], {"damping": 15 * at(5)}, "damping", 15.0),
    ("coupling_spring", ["2+Z", "6+Z"], {"stiffness": 1.5e4 * at(1, 5)}, "stiffness", 1.5e4),
    ("gyroscopic", ["3+Z", "5+Z"], {"damping": 20 * skew(2, 4)}, "coefficient", 20.0),
]


@pytest.fixture(scope="module")
def found_in(chain, idle):
    """The diagnosis of a case, by its kind."""
    changes = {kind: change for kind, _, change, _, _ in CASES}
    return cache(lambda kind: diagnose(idle, check=[running(chain, [0, 3], **changes[kind])]))


@pytest.mark.parametrize(("kind", "place", "change", "name", "size"), CASES, ids=[c[0] for c in CASES])
def test_kind_place_and_size(found_in, kind, place, change, name, size):
    found = found_in(kind)
    assert found.verdict == "explained"
    assert [e.kind for e in found.effects] == [kind]
    assert [str(d) for d in found.effects[0].location] == place
    assert found.effects[0].values[name] == pytest.approx(size, rel=0.01)
    # The true size lies where the standard deviation says.
    assert abs(found.effects[0].values[name] - size) < 5 * found.effects[0].std[name]
    assert found.ladder[0]["heldout_misfit"] > 20
    assert found.ladder[1]["heldout_misfit"] < 1.5
    document = found.to_dict()
    assert document["schema"] == "operando/diagnosis/2"
    assert document["candidates"][0]["kind"] == kind


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(s, marks=pytest.mark.slow) for s in (2, 3))])
def test_nothing_hidden(chain, idle, seed):
    found = diagnose(idle, check=[running(chain, [0, 3], seed=seed)])
    assert found.verdict == "no_misfit"
    assert found.effects == ()
    assert 0.8 < found.ladder[0]["heldout_misfit"] < 1.2


def test_a_wrong_sensitivity_is_named_as_sensor(chain, idle):
    run = running(chain, [0, 3])
    data, variance = np.array(run.frf.data), np.array(run.frf.variance)
    data[4] *= 1.2
    variance[4] *= 1.2**2
    found = diagnose(idle, check=[CheckRun("check", "", Frf(data, HZ, DOFS, run.frf.references, variance=variance))])
    assert [(e.kind, str(e.location[0])) for e in found.effects] == [("sensor_gain", "5+Z")]
    assert found.effects[0].values["gain"] == pytest.approx(1.2, rel=1e-3)


def test_swapped_channels(chain, idle):
    run = running(chain, [0, 3])
    order = [0, 1, 5, 3, 4, 2, 6]
    frf = Frf(run.frf.data[order], HZ, DOFS, run.frf.references, variance=run.frf.variance[order])
    found = diagnose(idle, check=[CheckRun("check", "", frf)])
    assert [(e.kind, {str(d) for d in e.location}) for e in found.effects] == [("channel_swap", {"3+Z", "6+Z"})]


def test_two_effects(chain, idle):
    found = diagnose(idle, check=[running(chain, [0, 3], mass=0.15 * at(4), damping=15 * at(1))])
    assert {(e.kind, str(e.location[0])) for e in found.effects} == {("point_mass", "5+Z"), ("ground_damper", "2+Z")}
    held = [row["heldout_misfit"] for row in found.ladder]
    assert held == sorted(held, reverse=True)


def test_runs_that_depend_on_level_are_not_explained(chain, idle):
    low = running(chain, [0, 3])
    high = running(chain, [0, 3], stiffness=2e4 * at(2), seed=1)
    found = diagnose(idle, check=[CheckRun("low", "1 N rms", low.frf, 1.0), CheckRun("high", "4 N rms", high.frf, 4.0)])
    assert found.verdict in ("partial", "unexplained")
    rows = found.to_dict()["by_level"]
    assert [(row["level"], row["unit"]) for row in rows] == [(1.0, "N"), (4.0, "N")]
    for row, run in zip(rows, (low, high), strict=True):
        peaks = fit_peaks(run.frf.data.reshape(-1, HZ.size), HZ)
        assert [m["frequency_hz"] for m in row["modes"]] == pytest.approx([p.frequency_hz for p in peaks], rel=1e-5)
        assert [m["damping_ratio"] for m in row["modes"]] == pytest.approx([p.damping_ratio for p in peaks], rel=1e-2)
        assert all(m["frequency_std_hz"] > 0 and m["damping_ratio_std"] > 0 for m in row["modes"])


def test_kinds_without_a_location_alone_are_searched(chain, idle):
    """A mass that none of them explains: the scans over locations have no rows."""
    found = diagnose(idle, check=[running(chain, [0, 3], mass=0.6 * at(4))], kinds=("global_stiffness", "global_damping"))
    assert found.verdict in ("partial", "unexplained")
    asked = "only these kinds of effects were looked for, as the test asks: global_stiffness, global_damping"
    assert asked in found.notes
    assert not any("DOFs alone" in n for n in found.notes)


def test_wrong_effect_by_hand_is_said_to_be_wrong(chain, idle):
    check = [running(chain, [0, 3], mass=0.15 * at(4))]
    right = apply_effects(idle, ["point_mass@5+Z"], check=check)
    wrong = apply_effects(idle, ["point_mass@2+Z"], check=check)
    start = right.ladder[0]["heldout_misfit"]
    assert right.effects[0].values["mass"] == pytest.approx(0.15, rel=0.01)
    assert start - wrong.ladder[1]["heldout_misfit"] < 0.5 * (start - right.ladder[1]["heldout_misfit"])
    assert any("point_mass@5+Z" in w for w in wrong.words)
    assert not any("point_mass@2+Z" in w for w in right.words)


def test_held_values_stay(chain, idle):
    check = [running(chain, [0, 3], mass=0.15 * at(4))]
    held = apply_effects(idle, ["point_mass@5+Z=mass:0.1"], check=check, refit=False)
    assert held.effects[0].values["mass"] == pytest.approx(0.1, rel=1e-12)


def test_a_held_removed_effect_is_said_to_be_removed_and_has_no_interval(chain, idle):
    taken = parse_effect("point_mass@5+Z=mass:-0.1", fixed=True)
    held = apply_effects(idle, [taken], check=[running(chain, [0, 3], mass=-0.1 * at(4))]).to_dict()
    assert held["effects"][0]["parameters"]["mass"] == {"value": pytest.approx(-0.1), "unit": "kg", "std": None}
    assert held["effects"][0]["fixed"] == ["mass"]  # the next refit holds it, too
    assert held["words"][0].startswith("removed point_mass at 5+Z: ")
    assert model_now(held["effects"])[1] == "  1 removed point mass at 5+Z: 100 g (held)"
    assert "+ removed point_mass 5+Z" in steps_table(held["ladder"])


def test_steps_name_the_position_of_an_effect_between_sensors():
    mass = Effect("point_mass", (), {"mass": 0.1}, position=(0.3, 0.1, 0.0), direction="+Z")
    rows = [{"step": 1, "added": mass.to_dict(), "error_db": 1.0, "heldout_error_db": 1.0, "misfit": 1.0, "heldout_misfit": 1.0}]
    assert "+ point_mass (0.3, 0.1, 0) m, +Z" in steps_table(rows)
    axes = plot_steps({"ladder": rows, "noise_floor_db": None})
    assert [t.get_text() for t in axes.get_xticklabels()] == ["+ point_mass\n(0.3, 0.1, 0) m, +Z"]


@pytest.mark.parametrize(("std", "held"), [(0.9 * _HELD, True), (1.1 * _HELD, False)])
def test_a_value_held_by_hand_has_no_interval_and_one_that_is_likely_keeps_it(std, held):
    effect = Term("point_mass", (0,), (0.0,), fixed=(0,)).effect(DOFS, [std], (5.0, 60.0), {})
    assert ("mass" not in effect.std) is held
    assert (effect.fixed == ("mass",)) is held


@pytest.fixture
def inerter():
    class Inerter(EffectKind):
        kind, plain, places = "inerter_for_test", "an inerter between two points", 2
        parameters = (Parameter("inertance", "kg", 1e-6, 1e4, "log", 1.0, "inertance"),)

        def dynamic_stiffness(self, s, values):
            return values["inertance"] * s**2

    yield register(Inerter)
    unregister("inerter_for_test")


def test_one_more_effect_never_leaves_more_of_the_fitted_lines(chain, idle, inerter):
    check = [running(chain, [0, 3], stiffness=2e4 * at(2, 4))]
    spring, far_off = "coupling_spring@3+Z,5+Z=stiffness:2e4", "inerter_for_test@3+Z,5+Z=inertance:50"
    both = apply_effects(idle, [spring, far_off], check=check)
    assert both.ladder[2]["misfit"] < 1.2 * both.ladder[1]["misfit"] < 2
    assert both.effects[0].values["stiffness"] == pytest.approx(2e4, rel=0.01)


def test_kinds_of_ones_own_that_nobody_asked_for_are_named(chain, idle, inerter):
    check = [running(chain, [0, 3], mass=0.15 * at(4))]
    said = "kinds of your own were not looked for in the FRFs: inerter_for_test; name them in [analysis] kinds to look for them"
    assert said in diagnose(idle, check=check).notes
    asked = diagnose(idle, check=check, kinds=("point_mass", "inerter_for_test")).notes
    assert said not in asked
    assert "only these kinds of effects were looked for, as the test asks: point_mass, inerter_for_test" in asked


def test_a_refit_that_fails_is_refused(chain, idle, inerter, monkeypatch):
    monkeypatch.setattr("operando.diagnosis.by_hand._PARTS", ())
    check = [running(chain, [0, 3], stiffness=2e4 * at(2, 4))]
    effects = ["coupling_spring@3+Z,5+Z=stiffness:2e4", "inerter_for_test@3+Z,5+Z=inertance:50"]
    with pytest.raises(IdentificationError, match="the refit failed: with inerter_for_test") as refused:
        apply_effects(idle, effects, check=check)
    assert "start values" in refused.value.hint
    left, without = (
        float(part.split()[0]) for part in str(refused.value).replace(",", " ").split("chi-square of ")[1].split("without it ")
    )
    monkeypatch.setattr("operando.diagnosis.applied.FAILED", 1.1 * left / max(without, 1.0))
    assert len(apply_effects(idle, effects, check=check).effects) == 2  # no farther off than the limit allows


def test_model_of_the_diagnosis_predicts_the_running_structure(chain, found_in):
    found = found_in("ground_spring")
    exact = running(chain, list(range(N)), stiffness=2e4 * at(2), noise=0.0)
    made = found.model.frf(HZ, DOFS, DOFS)
    ratio = 20 * np.log10(np.abs(made.data) / np.abs(exact.frf.data))
    assert np.median(np.abs(ratio)) < 0.02


def test_without_check_or_modes(idle):
    with pytest.raises(MissingError):
        diagnose(idle)
    with pytest.raises(MissingError):
        apply_effects(idle, ["point_mass@5+Z"], check=[])

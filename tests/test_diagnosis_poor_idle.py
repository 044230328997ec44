"""A poor idle model: FRFs of a roving hammer without coherence, with an offset under the window and hits that are not alike."""

from dataclasses import replace

import numpy as np
import pytest

from operando.data import Frf, ModalModel
from operando.diagnosis import apply_effects, diagnose_frf, poor_idle
from operando.diagnosis.between import SAME_SET_UP
from operando.diagnosis.case import Case
from operando.diagnosis.criteria import ABOVE_ERROR, EXPLAINED
from operando.diagnosis.idle import Idle
from operando.diagnosis.poor_idle import _between_sizes, lowered_alone, with_what_is_left
from operando.diagnosis.posterior import at_rest, fit
from operando.diagnosis.rival import started
from operando.diagnosis.terms import Term
from operando.dof import Dof
from operando.frf import in_one_sense, opposed_dofs
from operando.results import CheckRun

N, DRIVEN = 8, 2
DOFS = tuple(Dof.parse(f"{i + 1}+Z") for i in range(N))
HZ = np.arange(4.0, 62.0, 0.05)
BAND = (6.0, 58.0)
ADDED = 0.12  # kg


def chain():
    """Mass, stiffness, circular frequencies, damping ratios, and shapes of unit modal mass."""
    rng = np.random.default_rng(4)
    mass = np.diag(rng.uniform(0.8, 1.2, N))
    spring = rng.uniform(0.8, 1.2, N + 1) * 3e4
    stiff = np.diag(spring[:-1] + spring[1:]) - np.diag(spring[1:-1], 1) - np.diag(spring[1:-1], -1)
    root = np.diag(1 / np.sqrt(np.diag(mass)))
    values, vectors = np.linalg.eigh(root @ stiff @ root)
    return mass, stiff, np.sqrt(values), np.linspace(0.002, 0.003, N), root @ vectors


def roved(seed, mass_added=0.0, offset=1.0, drift=2e-4, gains=0.05, variance=False):
    """Accelerance of one accelerometer, a hit at each point: each with its own gain, frequencies, offset and a little noise."""
    mass, stiff, w, zeta, phi = chain()
    rng = np.random.default_rng(seed)
    line = 2 * np.pi * HZ
    damping = mass @ phi @ np.diag(2 * zeta * w) @ phi.T @ mass
    mass[DRIVEN, DRIVEN] += mass_added
    h = np.empty((N, 1, HZ.size), complex)
    for i in range(N):
        k = stiff * (1 + drift * rng.standard_normal()) ** 2
        whole = np.linalg.inv(k - line[:, None, None] ** 2 * mass + 1j * line[:, None, None] * damping)
        tail = offset * rng.normal(1, 0.5) * 2 * np.pi * BAND[0] / (1j * line)  # of the accelerance between the modes
        h[i, 0] = -(line**2) * whole[:, i, DRIVEN] * (1 + gains * rng.standard_normal()) + tail
    h += 2e-3 * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape))
    return Frf(h, HZ, DOFS, (DOFS[DRIVEN],), variance=np.full(h.shape, 8e-6) if variance else None)


def model(seed=7):
    """The chain at rest as a modal analysis of such FRFs knows it."""
    _, _, w, zeta, phi = chain()
    std = np.concatenate([1e-4 * w / 2 / np.pi, 0.05 * zeta, np.full(N * N, 0.03 * np.abs(phi).max())])
    values = np.concatenate([w / 2 / np.pi, zeta, phi.T.ravel()])
    values = values + std * np.random.default_rng(seed).standard_normal(std.size)
    f, z, shapes = values[:N], values[N : 2 * N], values[2 * N :].reshape(N, N).T
    return ModalModel.from_terms(
        f, z, shapes, DOFS, residual=np.zeros(N, bool), scaling="unit_modal_mass", covariance=np.diag(std**2), band_hz=BAND
    )


def rest_of(frf):
    return at_rest(Idle.of(model(), BAND, frf.references), frf, BAND)


@pytest.fixture(scope="module")
def idle_frf():
    return roved(1)


@pytest.fixture(scope="module")
def rest(idle_frf):
    found = rest_of(idle_frf)
    assert found.state.alpha > EXPLAINED
    return found


def test_what_the_idle_model_leaves_is_an_error_of_the_check(idle_frf, rest):
    """Between peaks it is the offset, less what a fit takes of it, pair by pair; a larger variance stays, other pairs have the median."""
    check = roved(2)
    told = with_what_is_left(check, rest.state)
    assert told.quantity == "receptance"
    assert np.allclose(told.data, check.to_quantity("receptance").data)
    line = 2 * np.pi * HZ
    tails = np.sqrt(told.variance[:, 0]) * line**2
    offset = idle_frf.to_quantity("accelerance").data[:, 0] - roved(1, offset=0.0).data[:, 0]
    between = (HZ > 8) & (HZ < 50)
    ratio = np.median(tails[:, between] / np.abs(offset[:, between]), axis=1)
    assert np.all((ratio > 0.3) & (ratio < 1.5)), ratio
    large = with_what_is_left(roved(2, variance=True), rest.state)
    assert np.array_equal(large.variance, np.maximum(told.variance, roved(2, variance=True).to_quantity("receptance").variance))
    some = roved(1)
    narrow = rest_of(Frf(some.data[:-1], HZ, DOFS[:-1], some.references))
    other = with_what_is_left(check, narrow.state).variance
    assert np.allclose(other[-1, 0], np.median(other[:-1, 0], axis=0), rtol=0.3)


@pytest.mark.parametrize("seed", [11, 12, pytest.param(13, marks=pytest.mark.slow)])
def test_a_mass_is_told_beside_errors_of_the_measurement(idle_frf, seed):
    """Partial, for the idle model misses the idle FRFs themselves: the right kind, place and size, and nothing beside it."""
    found = diagnose_frf(model(), [CheckRun("run", "1 N", roved(seed, ADDED))], idle_frf=idle_frf)
    assert found.verdict == "partial"
    (effect,) = found.effects
    assert (effect.kind, str(effect.location[0])) == ("point_mass", str(DOFS[DRIVEN]))
    assert abs(effect.values["mass"] - ADDED) < 2.5 * effect.std["mass"] < ADDED
    assert "differs by" in found.reason
    assert any("counts as error of the operating measurement" in note for note in found.notes)


@pytest.mark.parametrize("seed", [21, 22, pytest.param(23, marks=pytest.mark.slow)])
def test_nothing_is_told_where_the_same_structure_is_measured_again(idle_frf, seed):
    found = diagnose_frf(model(), [CheckRun("run", "1 N", roved(seed))], idle_frf=idle_frf)
    assert found.verdict == "inconclusive"
    assert found.effects == ()
    assert "what the idle model leaves of the idle FRFs themselves hides it" in found.proposed_measurement  # no noise of the validation


def test_no_effect_is_told_where_the_scan_has_another_than_the_fit(idle_frf, monkeypatch):
    """The scan holds the idle model, the fit adapts it: what only one of them has may be an error of the measurement."""
    scan = poor_idle.robust_scan

    def scan_with_a_spring_first(case, x):
        rows = scan(case, x)
        assert (rows[0][1].kind, rows[0][1].places) == ("point_mass", (DRIVEN,))
        return sorted(rows, key=lambda row: row[1].kind != "ground_spring")

    check = [CheckRun("run", "1 N", roved(11, ADDED))]
    monkeypatch.setattr(poor_idle, "robust_scan", scan_with_a_spring_first)
    found = diagnose_frf(model(), check, idle_frf=idle_frf, kinds=("point_mass", "ground_spring"))
    assert not found.effects
    assert found.verdict in ("inconclusive", "unexplained")


def test_effects_are_the_same_at_one_location_where_one_kind_contains_the_other():
    mass, absorber, spring = (Term(kind, (DRIVEN,), (0.0,)) for kind in ("point_mass", "tuned_absorber", "ground_spring"))
    assert all(poor_idle.same_effect(a, b) for a, b in ((mass, absorber), (absorber, mass), (mass, mass)))
    assert not poor_idle.same_effect(mass, spring)
    assert not poor_idle.same_effect(mass, replace(mass, places=(0,)))
    assert not poor_idle.same_effect(mass, replace(mass, sign=-1))


def test_effects_lower_the_error_by_themselves(idle_frf, rest):
    """By the share of "partial", on lines that stand above their error; what differs between the days is no merit of an effect."""
    check = with_what_is_left(roved(11, ADDED), rest.state)
    case = Case(rest.idle, check, BAND, SAME_SET_UP)
    mass, spring = (
        fit(case, started(case, (Term(kind, (DRIVEN,), (np.log(size),), sign),)))
        for kind, size, sign in (("point_mass", ADDED, 1), ("ground_spring", 300.0, -1))
    )
    day = Case(rest.idle, check, BAND)
    shifted = fit(day, day.forward.start)
    assert lowered_alone(mass)
    assert not lowered_alone(spring)
    assert not lowered_alone(shifted)


def test_what_stands_above_its_error_is_told_in_db_to_2_db():
    """ABOVE_ERROR: the error alone, of a complex normal deviate."""
    rng = np.random.default_rng(0)
    error = (rng.standard_normal(100_000) + 1j * rng.standard_normal(100_000)) / np.sqrt(2 * ABOVE_ERROR)
    assert np.sqrt(np.mean((20 * np.log10(np.abs(1 + error))) ** 2)) == pytest.approx(2, abs=0.2)


def test_a_size_that_two_hypotheses_do_not_share_has_their_difference_in_its_interval(rest):
    case = Case(rest.idle, with_what_is_left(roved(11, ADDED), rest.state), BAND, SAME_SET_UP)
    mass = Term("point_mass", (DRIVEN,), (np.log(ADDED),))
    state = fit(case, started(case, (mass,)))
    other = replace(state, x=replace(state.x, terms=(state.terms[0].moved((state.terms[0].values[0] - 0.6,)),)))
    both = _between_sizes(state, other)
    assert both.terms[0].values[0] == pytest.approx(state.terms[0].values[0] - 0.3)
    assert both.covariance[0, 0] == pytest.approx(state.covariance[0, 0] + 0.3**2, rel=0.05)
    opposite = replace(other, x=replace(other.x, terms=(replace(other.terms[0], sign=-1),)))
    assert _between_sizes(state, opposite) is None


def test_the_sense_of_a_drive_point_in_noise_is_that_of_the_idle_measurement():
    frf = roved(1, offset=0.0)
    turned = in_one_sense(frf, frf.references)
    rng = np.random.default_rng(0)
    loud = np.max(np.abs(turned.data)) * (rng.standard_normal(turned.data.shape) + 1j * rng.standard_normal(turned.data.shape))
    unclear = Frf(turned.data + loud, HZ, DOFS, frf.references)
    assert opposed_dofs(turned) == frf.references
    assert opposed_dofs(unclear) == ()
    assert opposed_dofs(unclear, known=frf.references) == frf.references
    assert opposed_dofs(frf, known=frf.references) == ()


@pytest.mark.parametrize("offset", [0.0, 0.1])
def test_effects_are_added_to_frfs_as_the_diagnosis_takes_them(offset):
    """Force and accelerometer of opposite senses: a refit by hand has them in one sense, and the error of a poor idle model, as well."""
    at_rest, running = roved(1, offset=offset), roved(11, ADDED, offset=offset)
    turned = [in_one_sense(frf, frf.references) for frf in (at_rest, running)]
    assert all(opposed_dofs(frf) == frf.references for frf in turned)
    plain = apply_effects(model(), "point_mass@3+Z", check=running, idle_frf=at_rest, band=BAND)
    added, none = (apply_effects(model(), e, check=turned[1], idle_frf=turned[0], band=BAND) for e in ("point_mass@3+Z", []))
    assert added.to_dict() == plain.to_dict()
    (effect,) = added.effects
    assert abs(effect.values["mass"] - ADDED) < 2.5 * effect.std["mass"] < 0.2 * ADDED
    found = diagnose_frf(model(), [CheckRun("run", "1 N", running)], idle_frf=at_rest, kinds=("point_mass",), band=BAND)
    for key in ("error_db", "heldout_error_db"):
        assert found.ladder[0][key] == added.ladder[0][key] == none.ladder[0][key]

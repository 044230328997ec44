"""A force law that is no kind of the catalogue: found at its location, told with its dynamic stiffness; and where effects make it worse."""

from dataclasses import replace

import numpy as np
import pytest

from operando.data import ModalModel
from operando.diagnosis import diagnose_frf, free_law
from operando.diagnosis.farther_off import farther_off
from operando.diagnosis.free_law import free_law_text, of_a_kind, scanned, with_free_law
from operando.diagnosis.hypotheses import as_channels_were
from operando.diagnosis.posterior import fit
from operando.diagnosis.rival import score, started
from operando.diagnosis.terms import FREE_LAW, Term, added, slopes
from operando.errors import ConfigError
from operando.indicators import INTERVAL
from operando.results import CheckRun
from operando.structure.effects import catalogue, kind_of
from test_diagnosis import BAND, DOFS, HZ, N, add_mass, case, identified, matrices, measured, modes, told

INERTANCE = 0.3
PAIR = (1, 3)  # 2+Z and 4+Z; the force acts on 1+Z and 4+Z


def add_inerter(m, c, k):
    """A mass that feels the difference of two displacements: no kind of the catalogue, and no diagonal mass matrix."""
    b = np.eye(N)[PAIR[0]] - np.eye(N)[PAIR[1]]
    m += INERTANCE * np.outer(b, b)


def test_an_inerter_is_located_and_its_law_is_told():
    document = told(add_inerter).to_dict()
    assert document["verdict"] == "unexplained"
    assert document["effects"] == []
    assert document["between"] == []
    assert "between 2+Z and 4+Z" in document["reason"]
    assert "no kind of the catalogue" in document["reason"]
    assert "2+Z and 4+Z" in document["proposed_measurement"]
    (law,) = document["picture"]["dynamic_stiffness"]
    assert law["location"] == ["2+Z", "4+Z"]
    w = 2 * np.pi * np.array(law["frequency_hz"])
    wanted = -INERTANCE * w**2
    assert np.abs(np.array(law["law_real"]) - wanted).max() < 0.05 * np.abs(wanted).max()
    assert np.abs(np.array(law["law_imag"])).max() < 0.05 * np.abs(wanted).max()


@pytest.mark.parametrize("seed", [0, 1, 2, *(pytest.param(s, marks=pytest.mark.slow) for s in range(3, 8))])
def test_intervals_of_the_law_hold_the_true_one(seed):
    """At six frequencies from end to end of the band, real and imaginary parts: all within 3.5 standard deviations."""
    state = with_free_law(case(add_inerter, seed=seed, spreads={}), -np.inf)
    assert state is not None
    assert sorted(state.terms[0].places) == sorted(PAIR)
    w = 2 * np.pi * np.linspace(*BAND, 6)
    (term,) = state.terms
    basis, scale = FREE_LAW.basis(w, state.case.band), np.exp(term.values[0])
    z = scale * basis @ term.values[1:]
    covariance = state.covariance[1:, 1:]
    for part, wanted in (("real", -INERTANCE * w**2), ("imag", 0 * w)):
        rows = getattr(basis, part)
        std = scale * np.sqrt(np.einsum("ij,jk,ik->i", rows, covariance, rows))
        assert np.abs((getattr(z, part) - wanted) / std).max() < 3.5
    # half the interval that the sentence tells, at the upper end of the band
    half = INTERVAL * scale * np.sqrt(basis[-1].real @ covariance @ basis[-1].real)
    assert f"{half / 1e3:.1g} kN/m at {state.case.band[1]:.4g} Hz" in free_law_text(state)


def test_the_scan_finds_laws_of_all_forms_at_their_location():
    def mass(m, c, k):
        add_mass(m, c, k)

    def lossy(m, c, k):
        c[2, 2] += 30.0
        k[2, 2] += 4e3

    for change, place in ((add_inerter, PAIR), (mass, (1,)), (lossy, (2,))):
        first = scanned(case(change, spreads={}))[0]
        assert first.places == place
    w = 2 * np.pi * HZ[100:1000:100]
    z = added(first, w, BAND)[:, 0, 0]
    np.testing.assert_allclose(z, 4e3 + 30j * w, rtol=0.1)


def test_a_kind_of_the_catalogue_is_more_probable_than_a_free_law():
    """Eight values cost more than one, so that what the catalogue has is told by its name."""
    one = case(add_mass, spreads={})
    by_name = fit(one, started(one, (Term("point_mass", (1,), (float(np.log(0.4)),)),)))
    free = with_free_law(one, -np.inf)
    assert free is not None
    assert free.terms[0].places == (1,)
    assert score(by_name) > score(free) + 10
    assert told(add_mass).verdict == "explained"


def test_no_law_is_told_where_it_does_not_explain_the_lines(monkeypatch):
    def spread(m, c, k):  # three masses: no force at one location
        m[0, 0] += 0.4
        m[2, 2] += 0.3
        m[4, 4] += 0.5

    spread_out, scans = case(spread, spreads={}), []
    monkeypatch.setattr(free_law, "scanned", lambda one: scans.append(one) or scanned(one))
    assert with_free_law(spread_out, -1000.0) is None
    assert with_free_law(spread_out, -999.0) is None  # asked for more, the same fits are left off sooner
    assert len(scans) == 1
    assert with_free_law(spread_out, -np.inf) is None
    assert len(scans) == 2


def test_a_law_between_sensors_of_opposite_senses_is_told_with_both_in_one():
    """How far their places move apart is the sum of what they measure; an inerter there was a mass between sensors, and `explained`."""
    turned = 4
    b = np.eye(N)[1] - np.eye(N)[turned]
    mass, stiff = matrices()
    frf = measured(mass + INERTANCE * np.outer(b, b), modes()[3], stiff, (0, 3), 2e-4, 4)
    signs = np.where(np.arange(N) == turned, -1.0, 1.0)
    dofs = tuple(d.opposite if i == turned else d for i, d in enumerate(DOFS))
    one = identified()
    values = one.frequencies_hz, one.damping_ratios, one.terms.shapes * signs[:, None]
    model = ModalModel.from_terms(*values, dofs, scaling="unit_modal_mass", covariance=one.covariance, band_hz=BAND)
    run = CheckRun("run", "1 N", replace(frf, data=frf.data * signs[:, None, None], responses=dofs))
    found = diagnose_frf(model, [run])
    assert found.verdict == "unexplained"
    assert "a force between 2+Z and 5+Z" in str(found.reason)
    assert "2+Z and 5+Z" in str(found.proposed_measurement)
    assert found.picture["dynamic_stiffness"][0]["location"] == ["2+Z", "5+Z"]


def test_derivatives_of_a_free_law_are_those_of_its_dynamic_stiffness():
    w = 2 * np.pi * np.linspace(*BAND, 5)
    term = Term(FREE_LAW.kind, PAIR, (float(np.log(2e4)), *np.linspace(-1, 1, 8)), fixed=(0,))
    for number, slope in enumerate(slopes(term, w, BAND)):
        if not number:
            continue
        more = added(replace(term, values=tuple(v + (i == number) for i, v in enumerate(term.values))), w, BAND) - added(term, w, BAND)
        np.testing.assert_allclose(slope, more, rtol=1e-6, atol=1e-3)


def test_a_free_law_is_no_kind_to_look_for():
    assert FREE_LAW.kind not in catalogue()
    with pytest.raises(ConfigError, match="unknown kind"):
        kind_of(FREE_LAW.kind)


def test_modes_that_moved_one_by_one_where_nothing_was_touched_are_no_other_day():
    """No effect at one location, and no temperature: what laboratories have from day to day could make it, but for the sensors."""

    def moved(m, c, k):
        w, _, phi, _ = modes()
        k += m @ phi @ np.diag(2 * np.array([2e-3, -3e-3, 3e-3, -2e-3, 3e-3]) * w**2) @ phi.T @ m

    found = told(moved)
    assert found.verdict == "unexplained"
    assert "nothing was touched" in str(found.reason)
    assert found.effects == ()

    def warmer(m, c, k):
        k *= 1.002

    assert [e.kind for e in told(warmer).effects] == ["global_stiffness"]


def test_where_channels_are_as_they_were_nothing_is_searched_on_another_day(monkeypatch):
    """No further effect makes channels differ that do not."""
    said: list[str] = []
    monkeypatch.setattr("operando.diagnosis.hypotheses.untouched", lambda state: bool(np.abs(state.x.own).max() < 1))
    known = fit(one := case(), one.forward.start)
    found = as_channels_were([known], said.append)
    assert found is not None
    assert (found.best.key, found.empty) == ((), known)
    assert found.best.case.between.log_factors.any()  # with its spreads estimated
    assert len(said) == 1
    assert as_channels_were([replace(known, alpha=0.1)], said.append) is None  # it does not explain the lines
    touched = case(gains=1 + 0.01 * np.random.default_rng(3).standard_normal(N))
    assert as_channels_were([fit(touched, touched.forward.start)], said.append) is None
    assert len(said) == 1


# Effects that make some response worse


def test_a_right_effect_makes_nothing_worse_on_another_day():
    """Gains that differ by 5 % and a temperature move the FRFs by decibels, and the effect is right."""
    gains = np.array([1.05, 0.95, 1.05, 0.95, 1.06])
    state = fit(one := case(add_mass, gains, 0.004), started(one, (Term("point_mass", (1,), (float(np.log(0.4)),)),)), 0.03)
    assert farther_off(state) is None


def test_an_effect_that_serves_one_response_and_spoils_others_is_told():
    one = case(add_mass, spreads={})
    right = fit(one, started(one, (Term("point_mass", (1,), (float(np.log(0.4)),)),)), 0.03)
    assert farther_off(right) is None
    wrong = replace(right, x=replace(right.x, terms=(Term("point_mass", (4,), (float(np.log(0.6)),)),)), alpha=5e-4)
    said = farther_off(wrong)
    assert said is not None
    assert "farther off" in said


@pytest.mark.parametrize(
    ("change", "kind", "places", "size"),
    [
        (lambda m, c, k: m.__setitem__((1, 1), m[1, 1] + 0.5), "point_mass", (1,), 0.5),
        (lambda m, c, k: k.__setitem__((2, 2), k[2, 2] + 6e4), "ground_spring", (2,), 6e4),
        (lambda m, c, k: c.__setitem__((3, 3), c[3, 3] + 40.0), "ground_damper", (3,), 40.0),
    ],
)
def test_a_law_of_the_catalogue_is_told_by_its_kind(change, kind, places, size):
    """From its own curve: a large effect is far from where a scan about the idle model looks."""
    law = with_free_law(case(change, spreads={}), -np.inf)
    assert law is not None
    assert law.terms[0].kind == FREE_LAW.kind
    found = of_a_kind(law)
    assert found is not None
    (term,) = found.terms
    assert (term.kind, term.places) == (kind, places)
    assert np.exp(term.values[0]) == pytest.approx(size, rel=0.02)
    assert score(found) > score(law)


def test_a_law_of_no_kind_stays_one():
    law = with_free_law(case(add_inerter, spreads={}), -np.inf)
    assert law is not None
    assert of_a_kind(law) is None

"""Effects that operational modes suggest for a search in FRFs; gains of sensors on DOFs that hardly move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import test_diagnose_modes as by_modes
from operando.data import ModalModel
from operando.diagnosis.between import SAME_SET_UP, SPREADS, Between
from operando.diagnosis.case import Case
from operando.diagnosis.hypotheses import Hypotheses
from operando.diagnosis.idle import Idle
from operando.diagnosis.modes_case import TOLD_BY_MODES
from operando.diagnosis.suggested import _COUNT, _ROUGH, begun_with, suggested_by_modes
from operando.diagnosis.terms import Term
from test_diagnosis import BAND, DOFS, N, add_mass, case, identified, matrices, measured, modes


def chain_at_rest(c):
    idle = by_modes.idle_of(c)
    return Idle.of(idle, idle.band_hz, idle.dofs), idle.band_hz


@pytest.fixture(scope="module")
def chain():
    return by_modes.chain()


@pytest.mark.parametrize(("kind", "places", "size"), by_modes.TRUTHS[:5])
def test_what_shifts_the_modes_as_operation_does_is_suggested(chain, kind, places, size):
    """Of each kind: the effect that acts is among the first, and there are no more of them than are tried (_COUNT)."""
    idle, band = chain_at_rest(chain)
    terms = suggested_by_modes(idle, by_modes.running(chain, (kind, places, size)), band, TOLD_BY_MODES, None, print)
    assert len(terms) <= _COUNT
    assert (kind, set(places)) in [(t.kind, {str(idle.dofs[i]) for i in t.places}) for t in terms]


def test_nothing_is_suggested_where_modes_do_not_tell(chain):
    idle, band = chain_at_rest(chain)
    moved = by_modes.running(chain, by_modes.TRUTHS[0])
    assert suggested_by_modes(idle, moved, band, ["sensor_gain", "sensor_delay"], None, print) == []
    assert suggested_by_modes(idle, moved, (1000.0, 2000.0), TOLD_BY_MODES, None, print) == []
    elsewhere = replace(moved, dofs=tuple(replace(dof, node=dof.node + 100) for dof in moved.dofs))
    said = []
    assert suggested_by_modes(idle, elsewhere, band, TOLD_BY_MODES, None, said.append) == []
    assert said[0].startswith("the operational modes suggest no effect: ")


def test_a_search_begins_with_what_is_suggested():
    """Without a step of its own (``depth=0``) it ends there; and no effect is begun with from none."""
    gains = 1 + 0.01 * np.random.default_rng(3).standard_normal(N)

    def heavy(m, c, k):  # beyond what days could be
        m[1, 1] += 0.8

    both = (case(heavy, gains=gains), case(heavy, gains=gains, spreads=SAME_SET_UP))
    mass = Term("point_mass", (1,), (float(np.log(0.4)),))
    said = []
    found = Hypotheses(*both, said.append, depth=0, suggested=lambda: [Term("ground_spring", (2,), (6.0,)), mass]).run()
    assert found.best.key == (("point_mass", (1,)),)
    assert np.exp(found.best.terms[0].values[0]) == pytest.approx(0.8, abs=0.02)
    assert found.odds < 0
    assert any("operational modes suggest" in line for line in said)
    alone = Hypotheses(*both, depth=0).run()
    assert alone.best.key == ()
    assert begun_with(both[0], []) is None


def test_a_gain_that_no_laboratory_has_is_tried_as_an_effect_where_nothing_was_touched():
    """Beside another effect, without a step of the search: on another day the gain is one of the differences."""
    gains = np.ones(N)
    gains[2] = 0.8
    both = (case(add_mass, gains=gains), case(add_mass, gains=gains, spreads=SAME_SET_UP))
    said = []
    found = Hypotheses(*both, said.append, depth=0, suggested=lambda: [Term("point_mass", (1,), (float(np.log(0.2)),))]).run()
    assert found.best.key == (("point_mass", (1,)), ("sensor_gain", (2,)))
    values = {term.kind: term.values[0] for term in found.best.terms}
    assert np.exp(values["point_mass"]) == pytest.approx(0.4, abs=0.02)
    assert found.odds > 0
    assert any("differences beyond those of laboratories as effects" in line for line in said)
    assert not any("on another day:" in line for line in said)


def test_fits_begin_with_more_than_they_end_with():
    """_ROUGH, of the FRFs: above what an explanation leaves."""
    state = begun_with(case(add_mass), [Term("point_mass", (1,), (float(np.log(0.2)),))])
    assert state.alpha < _ROUGH


def test_a_change_of_shape_along_the_shape_is_a_gain():
    """Where a DOF hardly moves, a sensor a degree askew shows much of other motion: a draw of many such sensors."""
    model = identified()
    shapes = np.array(model.terms.shapes)
    shapes[2] *= 0.02
    known = Idle.of(replace_shapes(model, shapes), BAND, [DOFS[0]])
    between = Between(known, np.array([0]), BAND, SPREADS.copy())
    rng = np.random.default_rng(0)

    def drawn(dof, gain, shape):
        moved = SPREADS[shape] * between.rms * rng.standard_normal((200_000, between.rms.size))
        own = known.phi[dof, known.modes]
        return np.std(SPREADS[gain] * rng.standard_normal(200_000) + moved @ own / (own @ own)) / SPREADS[gain]

    for dof in range(N):
        assert between.sensor_gains[dof] == pytest.approx(drawn(dof, "sensor", "seen"), rel=0.02)
    assert between.force_gains[0] == pytest.approx(drawn(0, "force", "driven"), rel=0.02)
    assert between.sensor_gains[2] > 10
    assert max(np.delete(between.sensor_gains, 2)) < 1.5
    same = Between(known, np.array([0]), BAND, dict(SAME_SET_UP))
    np.testing.assert_array_equal(same.sensor_gains, 1)


def hung(shapes=None):
    """The chain where its first mode is that of a suspension, below the band; driven at the first DOF."""
    model = identified()
    terms = model.terms
    band = (1.3 * float(terms.frequencies_hz[0]), BAND[1])
    known = {"scaling": model.scaling, "covariance": model.covariance, "band_hz": band}
    shapes = terms.shapes if shapes is None else shapes
    values = terms.frequencies_hz, terms.damping_ratios, shapes
    return ModalModel.from_terms(*values, model.dofs, residual=np.arange(N) == 0, **known), band


def test_at_an_undriven_place_no_less_lies_outside_the_band_than_at_a_driven_one():
    """A column shows what both have times each other, which may be nothing by chance; where it shows more, that counts."""
    shapes = np.array(identified().terms.shapes)
    shapes[2, 0] = 1e-3 * shapes[0, 0]
    shapes[3, 0] = 3 * shapes[0, 0]
    model, band = hung(shapes)
    between = Between(Idle.of(model, band, [DOFS[0]]), np.array([0]), band, SPREADS.copy())
    assert between.own_below[0] == pytest.approx(float(shapes[0, 0] ** 2))
    assert between.own_below[2] == pytest.approx(between.own_below[0])
    assert between.own_below[3] == pytest.approx(9 * between.own_below[0])
    both = Between(Idle.of(model, band, [DOFS[0], DOFS[2]]), np.array([0]), band, SPREADS.copy())
    assert both.own_below[2] == pytest.approx(1e-6 * both.own_below[0])  # measured there


def test_what_lies_below_the_band_swings_and_lags_as_the_suspension_does():
    model, band = hung()
    known = Idle.of(model, band, [DOFS[0]])
    mass, stiff = matrices()
    frf = measured(mass, modes()[3], stiff, (0,), 2e-4, 0)
    one = Case(known, frf, band, correlated=1.0)
    (hz,), (zeta,) = known.f[known.residual], known.zeta[known.residual]
    assert hz < band[0]
    w = one.lines.w[one.lines.fit]
    forward, term = one.forward, Term("point_mass", (2,), (float(np.log(0.4)),))
    rows = forward.outside([term])
    suspension = 1 / ((2 * np.pi * hz) ** 2 - w**2 + 2j * zeta * 2 * np.pi * hz * w)
    below = [row for row in rows if row.below]
    assert below
    for row in below:
        np.testing.assert_allclose(row.law(1j * w), suspension, rtol=1e-9)
    x = replace(forward.start, terms=(term,), u=0.1 * np.random.default_rng(0).standard_normal(len(rows)))
    slopes = forward.predict(x, w).shared[..., forward.n_g + forward.n_d :][..., : len(rows)]
    for number in range(len(rows)):
        step = 1e-4 * (np.arange(len(rows)) == number)
        up, down = (forward.predict(replace(x, u=x.u + side * step), w, derivatives=False).h for side in (1, -1))
        np.testing.assert_allclose(slopes[..., number], (up - down) / 2e-4, atol=1e-6 * np.abs(slopes).max())


def replace_shapes(model, shapes):
    terms = model.terms
    return type(model).from_terms(
        terms.frequencies_hz, terms.damping_ratios, shapes, model.dofs, residual=terms.residual, scaling=model.scaling,
        covariance=model.covariance, band_hz=model.band_hz,
    )  # fmt: skip

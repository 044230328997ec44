"""Damping that ties modes to each other: FRFs, poles and effects against the structure's own matrices."""

from dataclasses import replace

import numpy as np
import pytest

import operando
from operando import ModalCoupling, ModalModel, Model, ResidualTerms
from operando.diagnosis.case import Case
from operando.diagnosis.corrected import model_of
from operando.diagnosis.idle import Idle
from operando.diagnosis.posterior import at_rest
from operando.errors import DataError
from test_diagnosis import BAND, DOFS, N, matrices, measured, modes

HZ = np.linspace(5, 120, 400)
DASHPOT = 30.0  # N·s/m at the fourth mass


def chain():
    """Mass, damping and stiffness of the chain with a dashpot at one place; its real modes and their full damping matrix."""
    mass, stiff = matrices()
    w, _, phi, damping = modes()
    damping = damping.copy()
    damping[3, 3] += DASHPOT
    return mass, damping, stiff, w, phi, phi.T @ damping @ phi


def tied(modal):
    return modal - np.diag(np.diag(modal))


def whole(residual=None):
    """The chain with all its modes: exact."""
    _, _, _, w, phi, modal = chain()
    return ModalModel.from_terms(
        w / 2 / np.pi,
        np.diag(modal) / 2 / w,
        phi,
        DOFS,
        "unit_modal_mass",
        residual=residual,
        coupling=ModalCoupling(tied(modal), np.zeros((N, N))),
        band_hz=BAND,
    )


def truncated(lagging=True):
    """The first three modes, and the others as residual terms that only follow: what ties these to modes is a lag of shapes."""
    _, _, _, w, phi, modal = chain()
    keep, rest = np.arange(3), np.arange(3, N)
    between, lag = np.zeros((N, N)), np.zeros((N, N))
    between[:3, :3] = tied(modal[:3, :3])
    lag[:, keep] = (phi[:, rest] / w[rest] ** 2) @ modal[np.ix_(rest, keep)]
    return ModalModel(
        w[keep] / 2 / np.pi,
        np.diag(modal)[keep] / 2 / w[keep],
        phi[:, keep],
        DOFS,
        "unit_modal_mass",
        residuals=ResidualTerms(w[rest] / 2 / np.pi, np.diag(modal)[rest] / 2 / w[rest], phi[:, rest]),
        coupling=ModalCoupling(between, lag * lagging),
        band_hz=BAND,
    )


def receptance(mass, damping, stiff, hz=HZ):
    line = 2 * np.pi * hz[:, None, None]
    return np.moveaxis(np.linalg.inv(stiff - line**2 * mass + 1j * line * damping), 0, 2)


def test_frfs_of_tied_modes_are_those_of_the_matrices():
    mass, damping, stiff, *_ = chain()
    wanted = receptance(mass, damping, stiff)
    np.testing.assert_allclose(whole().frf(HZ, quantity="receptance").data, wanted, rtol=1e-9, atol=1e-12 * np.abs(wanted).max())
    line = 2j * np.pi * HZ
    np.testing.assert_allclose(whole().frf(HZ).data, wanted * line**2, rtol=1e-9, atol=1e-9 * np.abs(wanted * line**2).max())


def test_modes_tied_to_terms_outside_the_band_lag_to_first_order():
    _, _, _, w, phi, modal = chain()
    hz = np.r_[w[:3] / 2 / np.pi, 300.0, 400.0]  # what lies outside only follows
    ties, across = 0.02 * tied(modal), np.ix_(np.arange(3, N), np.arange(3))
    inside, lag = ties.copy(), np.zeros((N, N))
    inside[across] = inside.T[across] = 0
    lag[:, :3] = (phi[:, 3:] / (2 * np.pi * hz[3:]) ** 2) @ ties[across]

    def receptances(damping, lag):
        tie = ModalCoupling(damping, lag)
        model = ModalModel(hz, np.diag(modal) / 2 / w, phi, DOFS, "unit_modal_mass", coupling=tie)
        return model.frf(np.linspace(10, 40, 300), quantity="receptance").data

    exact = receptances(ties, 0 * lag)
    without, first = (np.linalg.norm(receptances(inside, factor * lag) - exact) for factor in (0, 1))
    assert first < 0.05 * without


def test_a_lag_enters_as_it_is_defined():
    model = truncated()
    terms, tie = model.terms, model.coupling
    damping, stiffness = terms.quadratic
    s = 2j * np.pi * HZ[:, None, None]
    late = terms.shapes - s * tie.lag
    wanted = late @ np.linalg.inv(s**2 * np.eye(N) + s * damping + stiffness) @ np.swapaxes(late, 1, 2)
    np.testing.assert_allclose(model.frf(HZ, quantity="receptance").data, np.moveaxis(wanted, 0, 2), rtol=1e-8, atol=1e-20)
    # … and under an effect (Sherman–Morrison)
    h, k = wanted, 2e4
    under = h - k * h[:, :, [1]] * h[:, [1]] / (1 + k * h[:, [1], [1], None])
    found = Model(model).add(f"ground_spring@2+Z=stiffness:{k}").frf(HZ, quantity="receptance", variance=False)
    np.testing.assert_allclose(found.data, np.moveaxis(under, 0, 2), rtol=1e-8, atol=1e-20)


EFFECTS = {
    "ground_spring@2+Z=stiffness:2e4": lambda m, c, k: np.add.at(k, (1, 1), 2e4),
    "point_mass@2+Z=mass:0.4": lambda m, c, k: np.add.at(m, (1, 1), 0.4),
    "ground_damper@1+Z=damping:5": lambda m, c, k: np.add.at(c, (0, 0), 5.0),
    "global_damping=change:0.3": lambda m, c, k: np.multiply(c, 1.3, out=c),
    "global_stiffness=change:0.1": lambda m, c, k: np.multiply(k, 1.1, out=k),
}


@pytest.mark.parametrize("effect", EFFECTS)
def test_effects_act_on_tied_modes_as_on_the_matrices(effect):
    mass, damping, stiff, *_ = chain()
    EFFECTS[effect](mass, damping, stiff)
    model = Model(whole()).add(effect)
    wanted = receptance(mass, damping, stiff)
    found = model.frf(HZ, quantity="receptance", variance=False).data
    np.testing.assert_allclose(found, wanted, rtol=1e-7, atol=1e-10 * np.abs(wanted).max())
    state = np.block([[np.zeros((N, N)), np.eye(N)], [-np.linalg.solve(mass, stiff), -np.linalg.solve(mass, damping)]])
    poles = np.linalg.eigvals(state)
    poles = poles[poles.imag > 0]
    np.testing.assert_allclose(model.modes().terms.poles, poles[np.argsort(np.abs(poles))], rtol=1e-9)


ABSORBER = 0.5, 2 * np.pi * 30, 0.02  # kg, rad/s, damping ratio
AT_ONE_PLACE = {  # DOF and dynamic stiffness at s
    "ground_spring@2+Z=stiffness:2e4": (1, lambda s: 2e4),
    "point_mass@2+Z=mass:0.4": (1, lambda s: 0.4 * s**2),
    "ground_damper@1+Z=damping:5": (0, lambda s: 5 * s),
    "tuned_absorber@2+Z=mass:0.5,frequency:30,damping_ratio:0.02": (1, lambda s: absorbing(s, *ABSORBER)),
}


def absorbing(s, mass, w, zeta):
    link = mass * (w**2 + 2 * zeta * w * s)
    return mass * s**2 * link / (mass * s**2 + link)


@pytest.mark.parametrize("effect", AT_ONE_PLACE)
def test_poles_where_shapes_lag_are_zeros_of_the_dynamic_stiffness(effect):
    """At a pole the modal dynamic stiffness, with the effect at φ − s·lag, is singular; at the pole without lag it is not."""
    base = truncated()
    dof, law = AT_ONE_PLACE[effect]

    def singular(s):
        damping, stiffness = base.terms.quadratic
        late = base.terms.shapes[dof] - s * base.coupling.lag[dof]
        values = np.linalg.svd(s**2 * np.eye(N) + s * damping + stiffness + law(s) * np.outer(late, late), compute_uv=False)
        return values[-1] / values[-2]

    found, without = (
        Model(b).add(effect).modes().terms for b in (base, replace(base, coupling=replace(base.coupling, lag=np.zeros((N, N)))))
    )
    assert found.n == N + effect.startswith("tuned")
    assert max(singular(pole) for pole in found.poles) < 1e-9
    assert max(singular(pole) for pole in without.poles) > 1e-4
    # a free vibration moves the DOFs by its shapes at the pole
    pole = found.poles[0]
    near = np.abs(pole) / 2 / np.pi * (1 + np.array([-1e-6, 1e-6]))
    h = Model(base).add(effect).frf(near, quantity="receptance", variance=False).data
    residue = (h[:, :, 1] - h[:, :, 0]) / (1 / (2j * np.pi * near[1] - pole) - 1 / (2j * np.pi * near[0] - pole))
    u, shape = np.linalg.svd(residue)[0][:, 0], found.shapes[:, 0]
    assert np.abs(np.vdot(u, shape)) ** 2 / np.vdot(shape, shape).real == pytest.approx(1, abs=1e-6)


def test_coupling_follows_its_terms_and_dofs(tmp_path):
    model = whole()
    wanted = model.frf(HZ, quantity="receptance").data
    part = model["3-Z, 1+Z"]
    found = part.frf(HZ, quantity="receptance").data
    np.testing.assert_allclose(found, wanted[np.ix_([2, 0], [2, 0])] * np.array([[1, -1], [-1, 1]])[..., None], rtol=1e-9)
    mixed = whole(residual=[True, False, True, False, False])  # terms are put in another order
    np.testing.assert_allclose(mixed.frf(HZ, quantity="receptance").data, wanted, rtol=1e-7, atol=1e-20)
    model.save(tmp_path / "model.h5")
    again = operando.load(tmp_path / "model.h5")
    np.testing.assert_array_equal(again.coupling.stiffness, model.coupling.stiffness)
    np.testing.assert_array_equal(again.coupling.damping, model.coupling.damping)
    np.testing.assert_array_equal(again.coupling.lag, model.coupling.lag)
    few = model.select_modes([0, 2])
    np.testing.assert_array_equal(few.coupling.damping, model.coupling.damping[np.ix_([0, 2], [0, 2])])


def test_a_missing_mode_is_tied_to_nothing():
    model = whole().select_modes([0, 1, 3, 4])
    shape = {str(d): float(v) for d, v in zip(DOFS, whole().shapes[:, 2], strict=True)}
    effect = operando.Effect("missing_mode", values={"frequency": 40.0, "damping_ratio": 0.01}, shape=shape)
    grown = Model(model, (effect,))._base()
    assert grown.coupling.damping.shape == (N, N)
    assert not grown.coupling.damping[4].any()
    np.testing.assert_array_equal(grown.coupling.damping[:4, :4], model.coupling.damping)


def test_the_hybrid_route_says_that_it_leaves_coupling_out():
    idle = whole()
    operating = ModalModel(idle.frequencies_hz, idle.damping_ratios, 2.0 * idle.shapes, DOFS)
    codes = [f.kind for f in operando.scale_operational(idle, operating).findings]
    assert "complex_idle_modes" in codes
    codes = [f.kind for f in operando.scale_operational(replace(idle, coupling=None), operating).findings]
    assert "complex_idle_modes" not in codes


def test_coupling_that_does_not_belong_is_refused():
    with pytest.raises(DataError, match="not symmetric"):
        ModalCoupling(np.array([[0, 1.0], [2.0, 0]]), np.zeros((1, 2)))
    with pytest.raises(DataError, match="stiffness beside that of 2 terms"):
        ModalCoupling(np.eye(2), np.zeros((1, 2)), np.zeros(3))
    with pytest.raises(DataError, match="expected"):
        ModalCoupling(np.zeros((3, 3)), np.zeros((1, 2)))
    for scaling, n in (("unit_modal_mass", 3), ("unscaled", 2)):
        with pytest.raises(DataError, match="does not belong"):
            ModalModel([1, 2], [0.01] * 2, np.ones((1, 2)), "1+Z", scaling, coupling=ModalCoupling(np.zeros((n, n)), np.zeros((1, n))))


def test_the_model_of_a_diagnosis_predicts_what_its_state_does_where_modes_are_complex():
    mass, damping, stiff, w, phi, modal = chain()
    zeta = np.diag(modal) / 2 / w
    std = np.concatenate([1e-5 * w, 1e-3 * zeta, np.full(N * N, 2e-4)])
    real = ModalModel(w / 2 / np.pi, zeta, phi, DOFS, "unit_modal_mass", covariance=np.diag(std**2), band_hz=BAND)
    rest = at_rest(Idle.of(real, BAND, (DOFS[0], DOFS[3])), measured(mass, damping, stiff, (0, 3), 2e-4, 0), BAND)
    assert rest.again
    found = model_of(real, rest.state)
    assert found.idle.coupling.lag.any()
    lines = np.linspace(*BAND, 60)
    wanted = rest.state.case.forward.predict(rest.state.x, 2 * np.pi * lines, derivatives=False).h
    got = found.frf(lines, references=[DOFS[0], DOFS[3]], quantity="receptance", variance=False).data
    np.testing.assert_allclose(got, np.moveaxis(wanted, 0, 2), rtol=1e-7, atol=1e-9 * np.abs(wanted).max())
    # given as the idle model it is taken as it is
    known = Idle.of(found.idle, BAND, (DOFS[0], DOFS[3]))
    exact = Case(known, measured(mass, damping, stiff, (0, 3), 2e-4, 1), BAND, correlated=1.0)
    assert known.complex
    again = exact.forward.predict(exact.forward.start, 2 * np.pi * lines, derivatives=False).h
    np.testing.assert_allclose(again, wanted, rtol=1e-7, atol=1e-9 * np.abs(wanted).max())

"""Output-only diagnosis against physical truths: a chain with the effect in its own matrices, solved apart from operando."""

from __future__ import annotations

import json

import numpy as np
import pytest

from operando.data import ModalModel
from operando.diagnosis import diagnose
from operando.diagnosis.output_only import candidate_effects, diagnose_output_only, judge_rows
from operando.diagnosis.output_only_fit import Prior, fit, jacobian
from operando.diagnosis.output_only_forward import LINEAR_KINDS, Basis, action_of, solve
from operando.diagnosis.output_only_residuals import compress, fit_scale, residuals, target_of, whiteners
from operando.effects import Effect
from operando.errors import ConfigError, DataError
from operando.structure import Model
from structures import Chain

DOFS = tuple(f"{i + 1}+Z" for i in range(7))
SENSORS = (0, 2, 3, 5, 6, 8, 9)
IN_BAND = 6
NODE = dict(zip(DOFS, SENSORS, strict=True))


def chain(seed=0):
    return Chain(n=10, mass=1.0, stiffness=3e5, spread=0.35, zeta=np.linspace(0.006, 0.014, 10), seed=seed)


def idle_of(c, seed=0, scatter=0.05):
    """Modes in the band nearly exact, those above as residual modes with shapes that are ``scatter`` wrong."""
    rng = np.random.default_rng(seed)
    n, m = len(c.hz), len(SENSORS)
    phi = c.phi[list(SENSORS)]
    std = np.full((m, n), 2e-4) * np.sqrt(np.mean(phi**2))
    std[:, IN_BAND:] = scatter * np.sqrt(np.mean(phi**2))
    variance = np.r_[(1e-6 * c.hz) ** 2, (1e-3 * c.zeta) ** 2, (std.T**2).ravel()]
    return ModalModel.from_terms(
        c.hz,
        c.zeta,
        phi + std * rng.standard_normal((m, n)),
        DOFS,
        scaling="unit_modal_mass",
        residual=np.arange(n) >= IN_BAND,
        covariance=np.diag(variance),
        band_hz=(1.0, 1.1 * float(c.hz[IN_BAND - 1])),
    )


def running(c, effect=None, seed=0, noise=1.0):
    """Operating modes of M, C, K with the effect put in, with scatter as SSI leaves it; shapes of random complex scale."""
    rng = np.random.default_rng(100 + seed)
    n = len(c.hz)
    mass, stiff = c.M.copy(), c.K.copy()
    damp = c.M @ c.phi @ np.diag(4 * np.pi * c.zeta * c.hz) @ c.phi.T @ c.M
    if effect is not None:
        kind, places, size = effect
        at = [np.eye(n)[NODE[p]] for p in places]
        b = at[0] - at[1] if len(at) == 2 else at[0] if at else np.zeros(n)
        skew = np.outer(at[0], at[1]) - np.outer(at[1], at[0]) if len(at) == 2 else 0
        square = np.outer(b, b)
        if kind == "point_mass":
            mass += size * square
        elif kind.endswith("_spring"):
            stiff += size * square
        elif kind.endswith("_damper"):
            damp += size * square
        elif kind == "gyroscopic":
            damp += size * skew
        elif kind == "circulatory":
            stiff += size * skew
        elif kind == "global_stiffness":
            stiff *= 1 + size
        elif kind == "global_damping":
            damp *= 1 + size
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(mass, stiff), -np.linalg.solve(mass, damp)]])
    poles, v = np.linalg.eig(a)
    up = np.flatnonzero(poles.imag > 0)
    up = up[np.argsort(np.abs(poles[up]))][:IN_BAND]
    shapes = v[:n][:, up][list(SENSORS)]
    shapes = shapes * np.exp(2j * np.pi * rng.random(IN_BAND)) / np.abs(shapes).max(axis=0)
    hz, zeta = np.abs(poles[up]) / 2 / np.pi, -poles[up].real / np.abs(poles[up])
    f_std, z_std = 4e-4 * hz, 0.06 * zeta
    s_std = np.full(shapes.shape, 3e-3)
    gauss = lambda like: noise * rng.standard_normal(like.shape)  # noqa: E731
    return ModalModel(
        hz + f_std * gauss(hz),
        zeta + z_std * gauss(zeta),
        shapes + s_std * (gauss(hz + 0 * shapes.real) + 1j * gauss(hz + 0 * shapes.real)),
        DOFS,
        covariance=np.diag(np.r_[f_std**2, z_std**2, np.tile((s_std.T**2).ravel(), 2)]),
    )


TRUTHS = [
    ("point_mass", ("4+Z",), 0.15),
    ("ground_spring", ("2+Z",), 2e4),
    ("ground_damper", ("5+Z",), 12.0),
    ("coupling_spring", ("3+Z", "6+Z"), 1.5e4),
    ("coupling_damper", ("1+Z", "4+Z"), 12.0),
    ("gyroscopic", ("2+Z", "5+Z"), 40.0),
    ("circulatory", ("3+Z", "5+Z"), 1.5e4),
    ("global_stiffness", (), -0.06),
    ("global_damping", (), 0.8),
]


@pytest.mark.parametrize("truth", TRUTHS, ids=[t[0] for t in TRUTHS])
def test_forward_modes_are_those_of_the_physical_matrices(truth):
    c = chain()
    kind, places, size = truth
    exact = running(c, truth, noise=0.0)
    idle = idle_of(c, scatter=0.0)
    true = ModalModel.from_terms(c.hz, c.zeta, c.phi[list(SENSORS)], DOFS, scaling="unit_modal_mass", residual=idle.terms.residual)
    action = action_of(Effect(kind, places), true)
    modes = solve(Basis.of(true), [action], [size])
    poles = modes.poles[modes.poles.imag > 0]
    poles = poles[np.argsort(np.abs(poles))][:IN_BAND]
    np.testing.assert_allclose(np.abs(poles) / 2 / np.pi, exact.frequencies_hz, rtol=1e-9)
    np.testing.assert_allclose(-poles.real / np.abs(poles), exact.damping_ratios, rtol=1e-7)
    target = target_of(true, exact)
    raw, _, _ = residuals(target, modes, whiteners(target))
    assert np.abs(raw).max() < 1e-5


@pytest.mark.parametrize("truth", TRUTHS, ids=[t[0] for t in TRUTHS])
def test_each_kind_is_found_where_it_is_and_as_large_as_it_is(truth):
    c = chain()
    kind, places, size = truth
    found = diagnose_output_only(idle_of(c), running(c, truth), kinds=LINEAR_KINDS)
    assert found.verdict in ("explained", "ambiguous")
    effect = found.effects[0]
    assert (effect.kind, tuple(map(str, effect.location))) == (kind, places)
    name = effect.definition.parameters[0].name
    value = effect.sign * effect.values[name]
    assert abs(value - size) < 4 * effect.std[name]
    assert effect.std[name] < 0.2 * abs(size)
    before, after = found.ladder[0], found.ladder[-1]
    assert after["heldout_misfit"] < min(2.0, 0.8 * before["heldout_misfit"])


def test_nothing_is_found_where_nothing_is_hidden():
    for seed in range(3):
        c = chain(seed)
        found = diagnose_output_only(idle_of(c, seed), running(c, seed=seed))
        assert found.effects == ()
        # Six modes leave 28 values to judge: their misfit exceeds 1.5 by chance once in some thirty times, and the verdict says so.
        assert found.verdict == ("no_misfit" if found.ladder[0]["heldout_misfit"] < 1.5 else "unexplained")
        assert len(found.ladder) == 1
        assert found.candidates


def test_one_mode_cannot_tell_kinds_apart_and_says_so():
    c = chain()
    # A mode that the mass does move.
    found = diagnose_output_only(idle_of(c), running(c, TRUTHS[0]).select_modes([2]))
    assert found.verdict == "ambiguous"
    assert len({e.kind for e in (*found.effects, *found.ambiguous_with)}) >= 2
    assert "measure" in found.proposed_measurement
    assert "too few" in found.notes[0]


def test_two_effects_are_found_one_after_the_other():
    c = chain()
    more = chain()
    more.K = c.K.copy()
    first, second = np.eye(10)[NODE["2+Z"]], np.eye(10)[NODE["6+Z"]]
    more.K = c.K + 3e4 * np.outer(first, first)
    # The damping matrix stays that of the idle chain: only M and K of the truth change.
    truth = running(_with(c, stiffness=more.K, mass=c.M + 0.2 * np.outer(second, second)))
    found = diagnose_output_only(idle_of(c), truth, kinds=("point_mass", "ground_spring"))
    got = {(e.kind, str(e.location[0])): e for e in found.effects}
    assert set(got) == {("ground_spring", "2+Z"), ("point_mass", "6+Z")}
    assert got["ground_spring", "2+Z"].values["stiffness"] == pytest.approx(3e4, rel=0.05)
    assert got["point_mass", "6+Z"].values["mass"] == pytest.approx(0.2, rel=0.05)
    misfits = [row["heldout_misfit"] for row in found.ladder]
    assert misfits == sorted(misfits, reverse=True)


class _with:
    """The chain's damping with other M and K."""

    def __init__(self, c, stiffness, mass):
        self.hz, self.zeta, self.K = c.hz, c.zeta, stiffness
        self.M = mass
        self.phi = np.linalg.solve(mass, c.M @ c.phi)


def test_jacobian_agrees_with_differences():
    c = chain()
    idle = idle_of(c)
    target, basis = target_of(idle, running(c, TRUTHS[5])), Basis.of(idle)
    white = whiteners(target)
    for kind, places, size in TRUTHS:
        action = action_of(Effect(kind, places), idle)
        prior = Prior.of(basis, [action])
        eta = 0.2 * np.random.default_rng(0).standard_normal(prior.root.shape[1])

        def raw(x, action=action, prior=prior):
            modes = solve(basis, [action], x[:1], prior.shapes(basis, x[1:]), derivatives=True)
            # Shapes stand under a scale the fit takes away: their exact scale-free difference.
            return modes, *residuals(target, modes, white)

        x = np.r_[size, eta]
        modes, _, index, _ = raw(x)
        j = jacobian(target, basis, [action], x[:1], prior, modes, index, white)
        for p in range(min(3, x.size)):
            h = np.zeros(x.size)
            h[p] = 1e-5 * abs(size) if p == 0 else 2e-3
            numeric = (raw(x + h)[1] - raw(x - h)[1]) / (2 * h[p])
            np.testing.assert_allclose(j[:, :2, p], numeric[:, :2], rtol=1e-4, atol=1e-4 * np.abs(numeric[:, :2]).max() + 1e-9)


def test_shape_residual_is_free_of_scale():
    rng = np.random.default_rng(1)
    psi = rng.standard_normal((5, 3)) + 1j * rng.standard_normal((5, 3))
    scale = np.array([2.0 - 1j, 0.3j, -4.0])
    white = np.stack([np.linalg.inv(np.linalg.cholesky(np.cov(rng.standard_normal((10, 40))))) for _ in range(3)])
    got, left, _ = fit_scale(psi * scale, psi, white)
    np.testing.assert_allclose(got, scale, rtol=1e-10)
    assert np.abs(left).max() < 1e-10
    # Against plain weighted least squares on a shape that does not fit.
    other = rng.standard_normal((5, 3)) + 0j
    got, left, _ = fit_scale(other, psi, white)
    for k in range(3):
        x = white[k] @ np.block([[psi[:, k].real[:, None], -psi[:, k].imag[:, None]], [psi[:, k].imag[:, None], psi[:, k].real[:, None]]])
        t = white[k] @ np.r_[other[:, k].real, other[:, k].imag]
        a = np.linalg.lstsq(x, t, rcond=None)[0]
        np.testing.assert_allclose([got[k].real, got[k].imag], a, rtol=1e-9)
        np.testing.assert_allclose(left[k], t - x @ a, atol=1e-10)


def test_residuals_are_standard_normal_without_an_effect():
    """So that a misfit of 1 means as good as the data allow."""
    values = []
    for seed in range(12):
        c = chain(seed)
        idle = idle_of(c, seed)
        target = target_of(idle, running(c, seed=seed))
        found = fit(target, Basis.of(idle), (), (), np.ones((target.n, target.per_mode), bool))
        values.append(found.misfit)
    assert 0.85 < np.mean(values) < 1.15


def test_the_document_is_plain_json_with_the_keys_of_the_contract():
    c = chain()
    document = diagnose(idle_of(c), operating=running(c, TRUTHS[1]), kinds=("ground_spring", "point_mass")).to_dict()
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert document["data"] == ["operating_modes"]
    assert document["noise_floor_db"] is None
    assert all(row["error_db"] is None and row["heldout_error_db"] is None for row in document["ladder"])
    assert document["ladder"][1]["added"]["kind"] == document["effects"][0]["kind"] == "ground_spring"
    assert {"selection_misfit", "evidence"} <= set(document["candidates"][0])
    misfits = [row["selection_misfit"] for row in document["candidates"]]
    assert misfits == sorted(misfits)


@pytest.mark.parametrize("truth", [TRUTHS[1], TRUTHS[5]], ids=["ground_spring", "gyroscopic"])
def test_the_model_handed_on_predicts_the_running_structure(truth):
    c = chain()
    kind, places, size = truth
    idle = idle_of(c)
    found = diagnose_output_only(idle, running(c, truth), kinds=(kind,))
    true = ModalModel.from_terms(c.hz, c.zeta, c.phi[list(SENSORS)], DOFS, scaling="unit_modal_mass", residual=idle.terms.residual)
    hz = np.linspace(2.0, 1.05 * c.hz[IN_BAND - 1], 150)
    exact = Model(true, (Effect(kind, places, {Effect(kind, places).names[0]: size}),)).frf(hz)
    got, before = found.model.frf(hz), idle.frf(hz)
    error = np.linalg.norm(got.data - exact.data) / np.linalg.norm(exact.data)
    assert error < 0.15 * np.linalg.norm(before.data - exact.data) / np.linalg.norm(exact.data)
    # Its own variance says how far off it is, to first order.
    ratio = np.mean(np.abs(got.data - exact.data) ** 2 / got.variance)
    assert 0.1 < ratio < 5


def test_order_and_sense_of_sensors_do_not_matter():
    c = chain()
    operating = running(c, TRUTHS[0])
    turned = ModalModel(
        operating.frequencies_hz,
        operating.damping_ratios,
        operating.shapes[::-1] * np.where(np.arange(7) == 2, -1, 1)[:, None],
        tuple(d if i != 2 else d.replace("+", "-") for i, d in enumerate(DOFS[::-1])),
        std={
            "frequencies_hz": operating.frequency_std_hz,
            "damping_ratios": operating.damping_ratio_std,
            "shapes": operating.shape_std[::-1],
        },
    )
    idle = idle_of(c)
    one = diagnose_output_only(idle, operating, kinds=("point_mass",), places=("4+Z",))
    two = diagnose_output_only(idle, turned, kinds=("point_mass",), places=("4+Z",))
    assert two.effects[0].values["mass"] == pytest.approx(one.effects[0].values["mass"], rel=1e-6)


def test_judge_rows_are_a_third_and_fixed_beforehand():
    c = chain()
    target = target_of(idle_of(c), running(c))
    rows = judge_rows(target)
    assert rows[:, 0].sum() == rows[:, 1].sum() == rows[:, 2].sum() == IN_BAND // 3
    assert not np.any(rows[:, 0] & rows[:, 1])


def test_compressed_residuals_keep_small_and_bound_large():
    assert compress(np.array([1.0]))[0] == pytest.approx(1.0, rel=3e-3)
    assert compress(np.array([1e3]))[0] < 50


def test_candidates_are_all_single_places_and_pairs():
    idle = idle_of(chain())
    assert len(candidate_effects(idle)) == 3 * 7 + 4 * 21 + 2
    assert len(candidate_effects(idle, ["gyroscopic"], ["1+Z", "2+Z", "5+Z"])) == 3


def test_what_cannot_be_diagnosed_says_why():
    c = chain()
    idle, operating = idle_of(c), running(c)
    with pytest.raises(ConfigError, match="none of the kinds"):
        diagnose_output_only(idle, operating, kinds=["sensor_gain"])
    unscaled = ModalModel(idle.frequencies_hz, idle.damping_ratios, idle.shapes, DOFS)
    with pytest.raises(DataError, match="scale"):
        diagnose_output_only(unscaled, operating)
    elsewhere = ModalModel(operating.frequencies_hz, operating.damping_ratios, operating.shapes, tuple(f"{i}+X" for i in range(7)))
    with pytest.raises(DataError, match="fewer than two"):
        diagnose_output_only(idle, elsewhere)

"""Modes and residual terms of a modal model: who is listed, who is synthesised, and in which order θ runs."""

import json

import h5py
import numpy as np
import pytest

from effect_truth import chain_and_idle, receptance
from operando.data import Frf, ModalModel, ResidualTerms
from operando.diagnosis.idle import Idle
from operando.ema import fit_ema
from operando.errors import DataError
from operando.io import read_hdf5, write_hdf5, write_uff
from operando.structure import Model
from operando.structure.effects import Effect
from operando.synthesis import synthesis_variance, synthesise
from structures import Chain

DOFS = ("1+Z", "2-Z", "3+Z")
RESIDUAL = np.array([True, False, False, True, False, True])
"""As a fit may leave them: below, among and above the modes."""


def mixed(complex_shapes=False, covariance=True):
    """Arrays over all terms, in an order in which residual terms stand anywhere."""
    rng = np.random.default_rng(4)
    n, m = RESIDUAL.size, len(DOFS)
    shapes = rng.normal(size=(m, n)) + (1j * rng.normal(size=(m, n)) if complex_shapes else 0)
    p = n * (2 + m * (2 if complex_shapes else 1))
    half = 1e-3 * rng.normal(size=(p, p))
    out = {
        "frequencies_hz": np.array([0.04, 11.0, 23.0, 31.0, 42.0, 119.9]),
        "damping_ratios": np.linspace(0.01, 0.02, n),
        "shapes": shapes,
        "dofs": DOFS,
        "scaling": "unscaled" if complex_shapes else "unit_modal_mass",
        "residual": RESIDUAL,
        "in_band": ~RESIDUAL & (np.arange(n) < 4),
    }
    return out | ({"covariance": half @ half.T} if covariance else {})


def test_a_fit_lists_modes_alone():
    """Modes above the band and a stiff rest: what stands for them is part of the synthesis and none of the modes."""
    chain = Chain(8, zeta=0.008, seed=2)
    inside = chain.hz < 0.5 * (chain.hz[3] + chain.hz[4])
    f = np.arange(5.0, 0.5 * (chain.hz[3] + chain.hz[4]), 0.1)
    h = chain.accelerance(f, ref=[0, 3])
    rng = np.random.default_rng(0)
    std = 1e-3 * np.sqrt(np.mean(np.abs(h) ** 2))
    h = h + std * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    dofs = tuple(f"{i + 1}+Z" for i in range(8))
    model = fit_ema(Frf(h, f, dofs, (dofs[0], dofs[3]), variance=np.full(h.shape, std**2)), band=(f[0], f[-1]))
    np.testing.assert_allclose(model.frequencies_hz[model.in_band], chain.hz[inside], rtol=1e-3)
    assert model.n_modes == model.shapes.shape[1] == model.frequency_std_hz.size == model.shape_std.shape[1] == inside.sum() + 1
    # The next one stands just above the lines: its flank tells it, and it is marked as outside the band.
    beyond = ~np.asarray(model.in_band)
    assert np.all(np.abs(model.frequencies_hz[beyond] - chain.hz[inside.sum()]) < 3 * model.frequency_std_hz[beyond])
    assert model.residuals is not None
    assert model.n_residuals > 0
    at = model.residuals.frequencies_hz
    assert np.all((at < f[0]) | (at > f[-1]))
    made = model.to_dict()
    assert [mode["frequency_hz"] for mode in made["modes"]] == model.frequencies_hz.tolist()
    assert made["residual_modes"] == model.n_residuals
    # without them the FRFs miss what lies outside; with them they are those measured
    error = [np.linalg.norm(m.frf(f, dofs, (dofs[0], dofs[3])).data - h) for m in (model, model.without_residuals())]
    assert error[0] < 0.1 * error[1]


@pytest.mark.parametrize("quantity", ["accelerance", "receptance"])
def test_synthesis_and_its_variance_do_not_depend_on_the_order_given(quantity):
    given = mixed()
    model = ModalModel.from_terms(**given)
    hz = np.linspace(3, 60, 40)
    hz_, zeta, shapes = given["frequencies_hz"], given["damping_ratios"], given["shapes"]
    made = model.frf(hz, quantity=quantity)
    np.testing.assert_allclose(made.data, synthesise(hz, hz_, zeta, shapes, shapes, quantity), rtol=1e-9)
    expected = synthesis_variance(hz, hz_, zeta, shapes, given["covariance"], range(3), range(3), quantity)
    np.testing.assert_allclose(made.variance, expected, rtol=1e-9)


def test_the_variance_of_synthesised_frfs_is_that_of_their_derivatives(monkeypatch):
    """JCJᴴ with derivatives by differences; the same in pieces of a few lines and pairs, for pairs in any order and twice."""
    rng = np.random.default_rng(5)
    n, m, hz = 3, 4, np.linspace(5.0, 60.0, 70)
    f, zeta, shapes = np.array([11.0, 23.0, 31.0]), np.array([0.01, 0.02, 0.015]), rng.standard_normal((m, n))
    half = 1e-3 * rng.standard_normal((n * (2 + m), n * (2 + m)))
    rows, columns = [2, 0, 2], [1, 2]
    theta = np.concatenate([f, zeta, shapes.T.ravel()])

    def at(t):
        own = t[2 * n :].reshape(n, m).T
        return synthesise(hz, t[:n], t[n : 2 * n], own[rows], own[columns])

    steps = 1e-6 * np.eye(theta.size)
    slopes = np.array([(at(theta + step) - at(theta - step)) / 2e-6 for step in steps])
    expected = np.einsum("aijl,ab,bijl->ijl", slopes, half @ half.T, slopes.conj()).real
    found = synthesis_variance(hz, f, zeta, shapes, half @ half.T, rows, columns)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    monkeypatch.setattr("operando.synthesis._FORM_VALUES", 1)
    np.testing.assert_allclose(synthesis_variance(hz, f, zeta, shapes, half @ half.T, rows, columns), found, rtol=1e-12)


@pytest.mark.parametrize("complex_shapes", [False, True])
def test_theta_runs_over_modes_then_residual_terms(complex_shapes):
    """θ = [f, ζ, shapes term by term] of all terms, modes first, residual terms last; complex: all real parts, then all imaginary ones."""
    given = mixed(complex_shapes)
    model = ModalModel.from_terms(**given)
    order = [1, 2, 4, 0, 3, 5]
    n, m = 6, len(DOFS)
    assert (model.n_modes, model.n_residuals, model.terms.n, model.n_parameters) == (3, 3, n, len(given["covariance"]))
    np.testing.assert_array_equal(model.frequencies_hz, given["frequencies_hz"][order[:3]])
    np.testing.assert_array_equal(model.residuals.frequencies_hz, given["frequencies_hz"][order[3:]])
    np.testing.assert_array_equal(model.terms.shapes, given["shapes"][:, order])
    assert model.terms.residual.tolist() == [False] * 3 + [True] * 3
    assert model.in_band.tolist() == [True, True, False]
    at = [*order, *(n + k for k in order), *(2 * n + k * m + i for k in order for i in range(m))]
    at += [2 * n + n * m + k * m + i for k in order for i in range(m)] if complex_shapes else []
    np.testing.assert_array_equal(model.covariance, given["covariance"][np.ix_(at, at)])
    variance = np.diag(given["covariance"])
    np.testing.assert_allclose(model.frequency_std_hz, np.sqrt(variance[order[:3]]))
    np.testing.assert_allclose(model.damping_ratio_std, np.sqrt(variance[[n + k for k in order[:3]]]))
    parts = variance[2 * n :].reshape(-1, n, m).sum(axis=0)
    np.testing.assert_allclose(model.shape_std, np.sqrt(parts[order[:3]]).T)
    np.testing.assert_allclose(model.terms.shape_std, np.sqrt(parts[order]).T)


def test_selections():
    model = ModalModel.from_terms(**mixed())
    some = model.select_modes([2, 0])
    assert some.residuals is None
    np.testing.assert_array_equal(some.frequencies_hz, model.frequencies_hz[[2, 0]])
    np.testing.assert_array_equal(some.shape_std, model.shape_std[:, [2, 0]])
    kept = model.select_terms([5, 1, 3])
    assert (kept.n_modes, kept.n_residuals) == (1, 2)
    np.testing.assert_array_equal(kept.terms.frequencies_hz, model.terms.frequencies_hz[[1, 5, 3]])
    np.testing.assert_array_equal(kept.terms.shape_std, model.terms.shape_std[:, [1, 5, 3]])
    assert model.without_residuals().covariance.shape == (3 * 5,) * 2
    moved = model.with_terms(frequencies_hz=2 * model.terms.frequencies_hz)
    np.testing.assert_array_equal(moved.frequencies_hz, 2 * model.frequencies_hz)
    np.testing.assert_array_equal(moved.residuals.frequencies_hz, 2 * model.residuals.frequencies_hz)
    np.testing.assert_array_equal(moved.covariance, model.covariance)


def signed():
    """Two modes, two residual terms, and one that is taken away; and what its FRFs are, summed by hand."""
    rng = np.random.default_rng(6)
    hz, zeta, shapes = np.array([11.0, 23.0, 0.5, 60.0, 60.0]), np.full(5, 0.01), rng.normal(size=(3, 5))
    signs = np.array([1.0, 1.0, 1.0, 1.0, -1.0])
    half = 1e-4 * rng.normal(size=(25, 25))
    model = ModalModel.from_terms(
        hz, zeta, shapes, DOFS, "unit_modal_mass", residual=hz > 50, covariance=half @ half.T, signs=signs, band_hz=(5.0, 40.0)
    )

    def by_hand(theta, w):
        f, z, phi = theta[:5], theta[5:10], theta[10:].reshape(5, 3).T
        k = signs[:, None] / ((2 * np.pi * f[:, None]) ** 2 - w**2 + 4j * np.pi * (z * f)[:, None] * w)
        return np.einsum("it,jt,tl->ijl", phi, phi, k)

    return model, by_hand, np.concatenate([hz, zeta, shapes.T.ravel()]), half


def test_terms_that_are_taken_away_count_with_their_sign(tmp_path):
    model, by_hand, theta, half = signed()
    lines = np.array([6.0, 10.9, 17.0, 35.0])
    own = [model.dofs[0], model.dofs[2]]
    made = model.frf(lines, own, own, "receptance")
    exact = by_hand(theta, 2 * np.pi * lines)[np.ix_([0, 2], [0, 2])]
    np.testing.assert_allclose(made.data, exact, rtol=1e-10)
    rng = np.random.default_rng(7)
    draws = [by_hand(theta + half @ rng.normal(size=25), 2 * np.pi * lines)[np.ix_([0, 2], [0, 2])] - exact for _ in range(4000)]
    np.testing.assert_allclose(made.variance, np.mean(np.abs(draws) ** 2, axis=0), rtol=0.15)
    # selected, moved, stored and read, the signs stay
    np.testing.assert_array_equal(model.select_terms([4, 0, 1]).terms.signs, [1, 1, -1])
    np.testing.assert_array_equal(model.with_terms(damping_ratios=2 * model.terms.damping_ratios).terms.signs, model.terms.signs)
    write_hdf5(tmp_path / "signed.h5", {"idle": model})
    np.testing.assert_array_equal(read_hdf5(tmp_path / "signed.h5")["idle"].terms.signs, model.terms.signs)


def test_effects_act_on_a_model_with_terms_that_are_taken_away():
    model, by_hand, theta, half = signed()
    lines = np.array([6.0, 10.9, 17.0, 35.0])
    spring = 50.0
    running = Model(model, (Effect("ground_spring", ("3+Z",), {"stiffness": spring}),))

    def changed(theta):
        h = by_hand(theta, 2 * np.pi * lines)
        return h - h[:, 2:] * h[2] * spring / (1 + spring * h[2, 2])

    got, exact = running.frf(lines, quantity="receptance"), changed(theta)
    np.testing.assert_allclose(got.data, exact, rtol=1e-9)
    rng = np.random.default_rng(8)
    draws = [changed(theta + half @ rng.normal(size=25)) - exact for _ in range(4000)]
    np.testing.assert_allclose(got.variance, np.mean(np.abs(draws) ** 2, axis=0), rtol=0.2)
    # its poles are those at which the determinant vanishes, and their slopes those of the poles
    modes = running.modes(variance=True)
    for pole in modes.terms.poles[:2]:
        k = model.terms.signs / ((2 * np.pi * theta[:5]) ** 2 + pole**2 + 4 * np.pi * theta[5:10] * theta[:5] * pole)
        assert abs(1 + spring * np.sum(k * model.terms.shapes[2] ** 2)) < 1e-9
    # and their standard deviations those of the scatter
    scatter = []
    for _ in range(300):
        t = theta + half @ rng.normal(size=25)
        drawn = model.with_terms(frequencies_hz=t[:5], damping_ratios=t[5:10], shapes=t[10:].reshape(5, 3).T, covariance=None)
        scatter.append(Model(drawn, running.effects).modes().frequencies_hz[:3] - modes.frequencies_hz[:3])
    np.testing.assert_allclose(modes.frequency_std_hz[:3], np.std(scatter, axis=0), rtol=0.2)


def test_terms_that_are_taken_away_are_refused_where_only_squares_can_be(tmp_path):
    model = signed()[0]
    with pytest.raises(DataError, match="UFF 55 takes no residual terms that are taken away"):
        write_uff(tmp_path / "modes.uff", model)
    with pytest.raises(DataError, match="UFF 55 takes no residual terms that are taken away"):
        model.to_pyuff()
    with pytest.raises(DataError, match="a diagnosis takes no residual terms that are taken away"):
        Idle.of(model, (5.0, 40.0), (model.dofs[0],))
    with pytest.raises(DataError, match="1 and −1"):
        ResidualTerms([0.1], [0.01], np.ones((3, 1)), [0.5])
    with pytest.raises(DataError, match="only residual terms have signs"):
        ModalModel.from_terms([1.0], [0.01], np.ones((3, 1)), DOFS, signs=[-1.0])


def test_what_does_not_belong_together_is_refused():
    rest = ResidualTerms([0.1], [0.01], np.ones((2, 1)))
    with pytest.raises(DataError, match="2 DOFs"):
        ModalModel([1.0], [0.01], np.ones((3, 1)), DOFS, residuals=rest)
    with pytest.raises(DataError, match="residual terms: 1 frequencies, 2 damping ratios"):
        ResidualTerms([0.1], [0.01, 0.02], np.ones((3, 1)))
    with pytest.raises(DataError, match="not negative"):
        ResidualTerms([-0.1], [0.01], np.ones((3, 1)))
    with pytest.raises(DataError, match=r"covariance has shape \(5, 5\), expected \(10, 10\)"):
        ModalModel([1.0], [0.01], np.ones((3, 1)), DOFS, residuals=ResidualTerms([0.1], [0.01], np.ones((3, 1))), covariance=np.eye(5))
    with pytest.raises(DataError, match="one value a term"):
        ModalModel([1.0], [0.01], np.ones((3, 1)), DOFS, std={"frequencies_hz": np.ones(2)})
    empty = ModalModel([1.0], [0.01], np.ones((3, 1)), DOFS, residuals=ResidualTerms([], [], np.ones((3, 0))))
    assert empty.residuals is None


def test_a_file_with_residual_terms_among_the_modes_is_read_rightly(tmp_path):
    """Older files hold all terms in one set of arrays with a mask."""
    model = ModalModel.from_terms(**mixed())
    path = tmp_path / "model.h5"
    write_hdf5(path, {"idle": model})
    with h5py.File(path, "a") as file:
        group = file["idle"]
        tree = json.loads(group["__tree__"].asstr()[()])
        del tree["fields"]["residuals"]
        for name, values in mixed().items():
            if isinstance(values, np.ndarray):
                if name in group:
                    del group[name]
                group[name] = values
                tree["fields"][name] = {"__array__": name}
        del group["__tree__"], group.attrs["blake2b"]
        group["__tree__"] = json.dumps(tree)
        file.attrs["schema"] = "operando/hdf5/1"
    back = read_hdf5(path)["idle"]
    np.testing.assert_array_equal(back.frequencies_hz, model.frequencies_hz)
    np.testing.assert_array_equal(back.terms.shapes, model.terms.shapes)
    np.testing.assert_array_equal(back.covariance, model.covariance)
    np.testing.assert_array_equal(back.in_band, model.in_band)


def test_a_mode_added_before_residual_terms_keeps_arrays_in_step():
    """The idle model lacks a mode and holds two others as residual terms; with the mode and a spring it is the truth."""
    chain, idle = chain_and_idle()
    std = np.r_[1e-4 * idle.frequencies_hz, 1e-2 * idle.damping_ratios, np.full(36, 1e-3)]
    covariance = np.diag(std**2)
    whole = ModalModel.from_terms(
        idle.frequencies_hz, idle.damping_ratios, idle.shapes, idle.dofs, idle.scaling, residual=np.arange(6) >= 4, covariance=covariance,
        band_hz=idle.band_hz,
    )  # fmt: skip
    lacking = whole.select_terms([0, 1, 3, 4, 5])
    shape = {str(d): v for d, v in zip(idle.dofs, chain.phi[:, 2], strict=True)}
    added = Effect("missing_mode", values={"frequency": chain.hz[2], "damping_ratio": chain.zeta[2]}, shape=shape)
    spring = Effect("ground_spring", ("3+Z",), {"stiffness": 8e4})
    change = np.zeros((6, 6))
    change[2, 2] = 8e4
    hz = np.arange(6.0, 130.0, 0.5)
    exact = receptance(chain, hz, stiffness=change)
    made = Model(lacking, (added, spring))
    frf = made.frf(hz, quantity="receptance")
    assert np.max(np.abs(frf.data - exact)) < 1e-10 * np.max(np.abs(exact))
    # the mode added is taken for exact: the variance is that of a whole model that knows it
    known = np.array(covariance)
    where = [2, 8, *range(12 + 2 * 6, 12 + 3 * 6)]
    known[where] = known[:, where] = 0
    kept = ModalModel(idle.frequencies_hz, idle.damping_ratios, idle.shapes, idle.dofs, idle.scaling, covariance=known)
    np.testing.assert_allclose(frf.variance, Model(kept, (spring,)).frf(hz, quantity="receptance").variance, rtol=1e-9)

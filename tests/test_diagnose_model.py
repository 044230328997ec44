"""The idle model with effects against direct inversion and direct eigenvalues of the chain with the effect written into its matrices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from effect_truth import at, chain_and_idle, pole_list, receptance, skew
from operando.data import Geometry, ModalModel, ResidualTerms
from operando.diagnosis.by_hand import words_of
from operando.errors import ConfigError, DataError, DofError
from operando.structure import Model, at_level
from operando.structure.effects import Effect, catalogue, parse_effect

N = 6
HZ = np.linspace(3, 140, 83)
W0 = 2 * np.pi * 60.0

# Effect as text → added dynamic stiffness matrix by hand, from the laws of the contract.
STIFFNESS = {
    "point_mass@3+Z=mass:0.7": lambda s: 0.7 * s**2 * at(N, 2),
    "point_mass@3+Z=mass:-0.5": lambda s: -0.5 * s**2 * at(N, 2),
    "sensor_mass@5+Z=mass:0.05": lambda s: 0.05 * s**2 * at(N, 4),
    "ground_spring@3+Z=stiffness:8e4": lambda s: 8e4 * at(N, 2),
    "ground_spring@3-Z=stiffness:8e4": lambda s: 8e4 * at(N, 2),
    "ground_spring@3+Z=stiffness:-5e4": lambda s: -5e4 * at(N, 2),
    "ground_damper@2+Z=damping:60": lambda s: 60 * s * at(N, 1),
    "ground_hysteretic_spring@4+Z=stiffness:5e4,loss_factor:0.3": lambda s: 5e4 * (1 + 0.3j) * at(N, 3),
    "ground_rubber@4+Z=stiffness:5e4,exponent:0.3,reference_hz:60": lambda s: 5e4 * (s / W0) ** 0.3 * at(N, 3),
    "coupling_spring@2+Z,5+Z=stiffness:6e4": lambda s: 6e4 * at(N, 1, 4),
    "coupling_damper@2+Z,5+Z=damping:40": lambda s: 40 * s * at(N, 1, 4),
    "tuned_absorber@3+Z=mass:0.3,frequency:50,damping_ratio:0.05": lambda s: (
        0.3 * s**2 * (0.3 * 2 * 0.05 * 100 * np.pi * s + 0.3 * (100 * np.pi) ** 2)
        / (0.3 * s**2 + 0.3 * 2 * 0.05 * 100 * np.pi * s + 0.3 * (100 * np.pi) ** 2) * at(N, 2)
    ),
    "gyroscopic@2+Z,4+Z=coefficient:150": lambda s: 150 * s * skew(N, 1, 3),
    "gyroscopic@2+Z,4+Z=coefficient:-150": lambda s: -150 * s * skew(N, 1, 3),
    "circulatory@2+Z,4+Z=coefficient:3e3": lambda s: 3e3 * skew(N, 1, 3),
}  # fmt: skip


def far(found, truth):
    return float(np.max(np.abs(found - truth)) / np.max(np.abs(truth)))


@pytest.mark.parametrize("text", STIFFNESS)
def test_added_stiffness_matches_direct_inversion(text):
    chain, idle = chain_and_idle()
    frf = Model(idle).add(text).frf(HZ, quantity="receptance")
    assert far(frf.data, receptance(chain, HZ, STIFFNESS[text])) < 1e-10


@pytest.mark.parametrize("quantity", ["mobility", "accelerance"])
def test_quantities_and_some_pairs_in_either_sense(quantity):
    chain, idle = chain_and_idle()
    frf = Model(idle).add("ground_spring@3+Z=stiffness:8e4").frf(HZ, "2+Z,5-Z", "1-Z", quantity)
    truth = receptance(chain, HZ, lambda s: 8e4 * at(N, 2))
    factor = (2j * np.pi * HZ) ** {"mobility": 1, "accelerance": 2}[quantity]
    assert far(frf.data, np.stack([-truth[1, 0] * factor, truth[4, 0] * factor])[:, None]) < 1e-10


def test_a_point_mass_acts_on_all_measured_directions_of_its_node():
    chain, idle = chain_and_idle()
    turned = replace(idle, dofs=["1+X", "1-Y", "1+Z", "1+RX", "2+Z", "3+Z"])
    frf = Model(turned).add("point_mass@1+Z=mass:0.4").frf(HZ, quantity="receptance")
    truth = receptance(chain, HZ, mass=0.4 * np.diag([1, 1, 1, 0, 0, 0]))
    assert far(frf.data, truth) < 1e-10


def test_several_effects_at_once_in_any_order():
    chain, idle = chain_and_idle()
    texts = ["gyroscopic@2+Z,4+Z=coefficient:150", "point_mass@3+Z=mass:0.7", "coupling_spring@2+Z,5+Z=stiffness:6e4"]
    truth = receptance(chain, HZ, lambda s: sum(STIFFNESS[t](s) for t in texts))
    for order in (texts, texts[::-1]):
        model = Model(idle)
        for text in order:
            model = model.add(text)
        assert far(model.frf(HZ, quantity="receptance").data, truth) < 1e-10


def test_global_stiffness_keeps_the_viscous_damping_matrix():
    chain, idle = chain_and_idle()
    frf = Model(idle).add("global_stiffness=change:-0.15").frf(HZ, quantity="receptance")
    assert far(frf.data, receptance(chain, HZ, stiffness=-0.15 * chain.K)) < 1e-10


def test_global_damping():
    chain, idle = chain_and_idle()
    frf = Model(idle).add("global_damping=change:0.8").frf(HZ, quantity="receptance")
    assert far(frf.data, receptance(chain, HZ, damping=0.8 * chain.C)) < 1e-10


def test_a_missing_mode_completes_the_model():
    chain, idle = chain_and_idle()
    effect = Effect(
        "missing_mode",
        values={"frequency": chain.hz[2], "damping_ratio": chain.zeta[2]},
        shape={str(d): v for d, v in zip(idle.dofs, chain.phi[:, 2], strict=True)},
    )
    lacking = Model(idle.select_modes([0, 1, 3, 4, 5]))
    assert far(lacking.frf(HZ, quantity="receptance").data, receptance(chain, HZ)) > 0.05
    model = lacking.add(effect).add("ground_spring@3+Z=stiffness:8e4")
    assert far(model.frf(HZ, quantity="receptance").data, receptance(chain, HZ, lambda s: 8e4 * at(N, 2))) < 1e-10
    # it is told as it is in operation: a change of the whole moves the others alone, whichever comes first
    for stiffer in (lacking.add(effect).add("global_stiffness=change:0.1"), lacking.add("global_stiffness=change:0.1").add(effect)):
        hz = stiffer.modes().frequencies_hz
        np.testing.assert_allclose(
            np.sort(hz / np.sqrt(1.1)), np.sort(np.r_[chain.hz[[0, 1, 3, 4, 5]], chain.hz[2] / np.sqrt(1.1)]), rtol=1e-9
        )
    with pytest.raises(ConfigError, match="shape"):
        lacking.add("missing_mode=frequency:50")


# Faults of the channels: (effect, measured accelerance from the true one by hand).
def _rows(h, i, factor):
    out = h.copy()
    out[i] = out[i] * factor
    return out


SENSORS = {
    "sensor_gain@3+Z=gain:1.2": lambda h: _rows(h, 2, 1.2),
    "sensor_polarity@3+Z": lambda h: _rows(h, 2, -1),
    "sensor_delay@3+Z=delay:2e-4": lambda h: _rows(h, 2, np.exp(-2j * np.pi * HZ * 2e-4)),
    "channel_swap@3+Z,5+Z": lambda h: h[[0, 1, 4, 3, 2, 5]],
    "force_gain@2+Z=gain:1.1": lambda h: np.moveaxis(_rows(np.moveaxis(h, 1, 0), 1, 1 / 1.1), 0, 1),
    "force_delay@2+Z=delay:1e-4": lambda h: np.moveaxis(_rows(np.moveaxis(h, 1, 0), 1, np.exp(2j * np.pi * HZ * 1e-4)), 0, 1),
}


@pytest.mark.parametrize("text", SENSORS)
def test_channel_faults_map_what_is_measured_and_leave_the_structure(text):
    chain, idle = chain_and_idle()
    model = Model(idle).add("ground_spring@3+Z=stiffness:8e4").add(text)
    true = receptance(chain, HZ, lambda s: 8e4 * at(N, 2))
    assert far(model.frf(HZ, quantity="receptance").data, SENSORS[text](true)) < 1e-10
    assert far(model.structure().frf(HZ, quantity="receptance").data, true) < 1e-10
    alone = model.frf(HZ, "3+Z", "2+Z", "receptance").data[0, 0]  # the row of the other channel is not asked for
    assert far(alone, SENSORS[text](true)[2, 1]) < 1e-10
    assert np.allclose(model.modes().poles, Model(idle).add("ground_spring@3+Z=stiffness:8e4").modes().poles, rtol=1e-12)


def test_a_swap_after_a_gain_takes_the_gain_along():
    chain, idle = chain_and_idle()
    true = receptance(chain, HZ)
    first = Model(idle).add("sensor_gain@3+Z=gain:2").add("channel_swap@3+Z,5+Z").frf(HZ, quantity="receptance").data
    last = Model(idle).add("channel_swap@3+Z,5+Z").add("sensor_gain@3+Z=gain:2").frf(HZ, quantity="receptance").data
    assert far(first[4], 2 * true[2]) < 1e-10
    assert far(first[2], true[4]) < 1e-10
    assert far(last[2], 2 * true[4]) < 1e-10
    opposite = Model(idle).add("channel_swap@3+Z,5-Z").frf(HZ, "3+Z,5+Z", quantity="receptance").data
    assert far(opposite, -true[[4, 2]]) < 1e-10


# Poles and shapes.

MATRICES = {
    "point_mass@3+Z=mass:0.7": {"m": 0.7 * at(N, 2)},
    "ground_spring@3+Z=stiffness:-5e4": {"k": -5e4 * at(N, 2)},
    "ground_damper@2+Z=damping:60": {"c": 60 * at(N, 1)},
    "coupling_spring@2+Z,5+Z=stiffness:6e4": {"k": 6e4 * at(N, 1, 4)},
    "coupling_damper@2+Z,5+Z=damping:40": {"c": 40 * at(N, 1, 4)},
    "gyroscopic@2+Z,4+Z=coefficient:150": {"c": 150 * skew(N, 1, 3)},
    "circulatory@2+Z,4+Z=coefficient:3e3": {"k": 3e3 * skew(N, 1, 3)},
}


@pytest.mark.parametrize("text", MATRICES)
def test_poles_match_direct_eigenvalues(text):
    chain, idle = chain_and_idle()
    more = MATRICES[text]
    truth = pole_list(chain.M + more.get("m", 0), chain.C + more.get("c", 0), chain.K + more.get("k", 0))
    modes = Model(idle).add(text).modes()
    assert modes.n_modes == N
    assert np.allclose(modes.poles, truth, rtol=1e-10)


def test_poles_of_the_absorber_with_its_own_mass():
    chain, idle = chain_and_idle()
    w, m, z = 100 * np.pi, 0.3, 0.05
    b = np.zeros(N + 1)
    b[2], b[N] = 1, -1
    grow = lambda a: np.pad(a, (0, 1))  # noqa: E731
    mass = grow(chain.M)
    mass[N, N] = m
    truth = pole_list(mass, grow(chain.C) + 2 * z * w * m * np.outer(b, b), grow(chain.K) + w**2 * m * np.outer(b, b))
    modes = Model(idle).add("tuned_absorber@3+Z=mass:0.3,frequency:50,damping_ratio:0.05").modes()
    assert modes.n_modes == N + 1
    assert np.allclose(modes.poles, truth, rtol=1e-10)


@pytest.mark.parametrize(
    "text",
    [
        "ground_hysteretic_spring@4+Z=stiffness:5e4,loss_factor:0.3",
        "ground_rubber@4+Z=stiffness:5e4,exponent:0.3,reference_hz:60",
        "ground_rubber@1+Z=stiffness:2e5,exponent:0.6,reference_hz:60",
    ],
)
def test_poles_of_stiffness_that_varies_with_frequency_are_zeros_of_the_determinant(text):
    chain, idle = chain_and_idle()
    stiff, place = (2e5, 0) if "@1" in text else (5e4, 3)
    law = (lambda s: 1 + 0.3j) if "hyst" in text else (lambda s, a=0.6 if "0.6" in text else 0.3: (s / W0) ** a)
    modes = Model(idle).add(text).modes()
    assert modes.n_modes == N
    assert np.all(np.diff(modes.frequencies_hz) > 0)
    for pole, shape in zip(modes.poles, modes.shapes.T, strict=True):
        d = pole**2 * chain.M + pole * chain.C + chain.K + stiff * law(pole) * at(N, place)
        size = np.linalg.norm(d, 2) * np.linalg.norm(shape)
        assert np.linalg.norm(d @ shape) / size < 1e-9


@pytest.mark.parametrize(
    "text", ["gyroscopic@2+Z,4+Z=coefficient:150", "circulatory@2+Z,4+Z=coefficient:3e3", "ground_damper@2+Z=damping:60"]
)
def test_poles_and_left_shapes_make_the_same_frf_as_the_update(text):
    _, idle = chain_and_idle()
    model = Model(idle).add(text)
    modes = model.modes()
    s = 2j * np.pi * HZ
    total = np.einsum("ir,jr,rl->ijl", modes.shapes, modes.details.left, 1 / (s - modes.poles[:, None]))
    total += np.einsum("ir,jr,rl->ijl", modes.shapes.conj(), modes.details.left.conj(), 1 / (s - modes.poles.conj()[:, None]))
    assert far(total, model.frf(HZ, quantity="receptance").data) < 1e-9


def test_shapes_are_those_of_the_matrices_and_residual_modes_stay_residual():
    chain, idle = chain_and_idle()
    rest = ResidualTerms(idle.frequencies_hz[4:], idle.damping_ratios[4:], idle.shapes[:, 4:])
    flagged = replace(idle.select_modes(range(4)), residuals=rest, covariance=None)
    running = Model(flagged).add("ground_spring@3+Z=stiffness:2e4").modes()
    assert (running.n_modes, running.n_residuals, running.in_band.tolist()) == (4, 2, [True] * 4)
    modes = running.terms
    truth = pole_list(chain.M, chain.C, chain.K + 2e4 * at(N, 2))
    for pole, shape in zip(truth, modes.shapes.T, strict=True):
        d = pole**2 * chain.M + pole * chain.C + chain.K + 2e4 * at(N, 2)
        assert np.linalg.norm(d @ shape) / np.linalg.norm(d, 2) < 1e-9
        assert np.linalg.norm(shape) == pytest.approx(1)


def test_an_overdamped_mode_is_told_as_real_poles():
    chain, idle = chain_and_idle(n=2)
    modes = Model(idle).add("ground_damper@1+Z=damping:1e5").modes()
    truth = pole_list(chain.M, chain.C + 1e5 * at(2, 0), chain.K)
    assert np.allclose(modes.poles, truth, rtol=1e-8)
    assert modes.n_modes + modes.details.real_poles.size / 2 == 2
    assert np.all(modes.details.real_poles < 0)


@pytest.mark.parametrize("text", ["clearance@2+Z=stiffness:1e5,gap:1e-4", "bilinear_stiffness@2+Z=stiffness:1e5"])
def test_effects_that_depend_on_the_level_are_said_to_be_left_out(text):
    _, idle = chain_and_idle()
    model = Model(idle).add(text).add("ground_spring@1+Z=stiffness:1e4")
    for made in (model.frf([20.0, 30.0]), model.modes()):
        (found,) = made.findings
        assert (found.kind, found.severity) == ("level_dependent", "warning")
        assert found.message == f"left out, for it depends on the level of the force: {model.effects[0]}"
    standing = Model(idle, tuple(at_level(idle, model.effects, 1.0, idle.dofs[0], (10.0, 60.0))))
    assert not standing.frf([20.0, 30.0]).findings


def test_without_effects_the_modes_are_the_idle_ones():
    _, idle = chain_and_idle()
    modes = Model(idle).modes()
    assert np.allclose(modes.poles, idle.poles, rtol=1e-12)
    assert np.allclose(np.abs(np.sum(modes.shapes.conj() * idle.shapes, axis=0)), np.linalg.norm(idle.shapes, axis=0))


# Variance.


def _spread_idle(idle, seed=0):
    rng = np.random.default_rng(seed)
    p = idle.n_parameters
    n = idle.n_modes
    size = np.r_[1e-4 * idle.frequencies_hz, 2e-2 * idle.damping_ratios, np.full(p - 2 * n, 5e-3)]
    mix = rng.normal(size=(p, p)) / np.sqrt(p)
    half = size[:, None] * mix
    return replace(idle, covariance=half @ half.T), half


@pytest.mark.parametrize(
    "texts",
    [
        ["ground_spring@3+Z=stiffness:8e4"],
        ["gyroscopic@2+Z,4+Z=coefficient:150", "sensor_gain@3-Z=gain:1.3"],
        ["global_stiffness=change:0.2", "point_mass@3+Z=mass:0.7"],
        ["channel_swap@3+Z,5-Z", "coupling_damper@2+Z,5+Z=damping:40"],
    ],
)
def test_variance_matches_the_scatter_of_random_models(texts):
    _, exact = chain_and_idle()
    idle, half = _spread_idle(exact)
    effects = [parse_effect(t) for t in texts]
    effects[0] = effects[0].with_std({n: 0.01 * abs(effects[0].values[n]) for n in effects[0].definition.names})
    model = Model(idle, tuple(effects))
    hz = np.array([11.0, 25.0, 47.0, 90.0, 118.0])
    stated = model.frf(hz, "3-Z,4+Z", "1+Z,3-Z", "receptance").variance
    rng = np.random.default_rng(1)
    theta = np.r_[exact.frequencies_hz, exact.damping_ratios, exact.shapes.T.ravel()]
    n, draws = exact.n_modes, []
    for _ in range(700):
        t = theta + half @ rng.normal(size=half.shape[1])
        values = {k: v + 0.01 * abs(v) * rng.normal() for k, v in effects[0].values.items()}
        drawn = ModalModel(t[:n], t[n : 2 * n], t[2 * n :].reshape(n, -1).T, exact.dofs, "unit_modal_mass")
        first = effects[0].with_values(**values) if values else effects[0]
        draws.append(Model(drawn, (first, *effects[1:])).frf(hz, "3-Z,4+Z", "1+Z,3-Z", "receptance").data)
    nominal = model.frf(hz, "3-Z,4+Z", "1+Z,3-Z", "receptance").data
    scatter = np.mean(np.abs(np.array(draws) - nominal) ** 2, axis=0)
    ratio = stated / scatter
    assert np.all((ratio > 0.8) & (ratio < 1.25))


@pytest.mark.parametrize(
    "texts",
    [
        ["ground_spring@3+Z=stiffness:8e4", "sensor_gain@4+Z=gain:1.3"],
        ["global_stiffness=change:0.2", "point_mass@3+Z=mass:0.7"],
    ],
)
def test_variance_counts_what_idle_parameters_and_values_share(texts):
    _, exact = chain_and_idle()
    idle, _ = _spread_idle(exact)
    effects = tuple(parse_effect(t) for t in texts)
    p, q = idle.n_parameters, 2
    # Both values go with the shape at the place (where the idle model shows too much motion, the effect is found too small).
    rng = np.random.default_rng(5)
    half = np.linalg.cholesky(idle.covariance + 1e-18 * np.diag(np.diag(idle.covariance)))
    at_place = 2 * N + np.arange(N) * N + 2
    lean = np.tile(-np.sign(exact.shapes[2]) @ half[at_place], (q, 1))
    lean /= np.linalg.norm(lean, axis=1)[:, None]
    size = np.array([0.03 * abs(e.values[e.definition.names[0]]) for e in effects])
    below = np.c_[size[:, None] * lean, 0.2 * np.diag(size)]
    whole = np.r_[np.c_[half, np.zeros((p, q))], below]
    model = Model(idle, effects, covariance=whole @ whole.T)
    hz = np.array([11.0, 25.0, 47.0, 90.0])
    ask = ("3-Z,4+Z", "1+Z,3-Z", "receptance")
    stated, apart = model.frf(hz, *ask).variance, Model(idle, effects, covariance=below @ below.T).frf(hz, *ask).variance
    theta = np.r_[exact.frequencies_hz, exact.damping_ratios, exact.shapes.T.ravel()]
    n, draws = exact.n_modes, []
    for _ in range(1500):
        t = whole @ rng.normal(size=p + q)
        u = theta + t[:p]
        drawn = ModalModel(u[:n], u[n : 2 * n], u[2 * n :].reshape(n, -1).T, exact.dofs, "unit_modal_mass")
        moved = tuple(
            e.with_values(**{e.definition.names[0]: e.values[e.definition.names[0]] + v}) for e, v in zip(effects, t[p:], strict=True)
        )
        draws.append(Model(drawn, moved).frf(hz, *ask).data)
    scatter = np.mean(np.abs(np.array(draws) - model.frf(hz, *ask).data) ** 2, axis=0)
    assert np.all((stated / scatter > 0.8) & (stated / scatter < 1.25))
    off = [np.sqrt(np.mean(np.log(v / scatter) ** 2)) for v in (stated, apart)]
    assert off[0] < 0.5 * off[1]
    only = model.structure()
    assert only.covariance.shape == (p + len(only.effects),) * 2


def test_variance_of_the_bare_idle_model_is_that_of_the_modal_model():
    idle, _ = _spread_idle(chain_and_idle()[1])
    mine, theirs = Model(idle).frf(HZ), idle.frf(HZ)
    assert np.allclose(mine.variance, theirs.variance, rtol=1e-9)
    assert np.allclose(mine.data, theirs.data, rtol=1e-12)
    assert Model(chain_and_idle()[1]).add("ground_spring@3+Z").frf(HZ).variance is None


# Adding, removing, other states.


def test_what_no_parameter_explains_counts_in_the_variance():
    idle, _ = _spread_idle(chain_and_idle()[1])
    plain, less_sure = Model(idle).frf(HZ), Model(idle, discrepancy=0.02).frf(HZ)
    np.testing.assert_allclose(less_sure.variance, plain.variance + (0.02 * np.abs(plain.data)) ** 2)
    assert Model(idle, discrepancy=0.02).add("ground_spring@3+Z=stiffness:8e4").discrepancy == 0.02


def test_add_remove_and_other_values():
    _, idle = chain_and_idle()
    model = Model(idle).add("point_mass@3+Z=mass:0.7").add("gyroscopic@2+Z,4+Z=coefficient:100")
    assert [e.kind for e in model.effects] == ["point_mass", "gyroscopic"]
    assert [e.kind for e in model.remove(1).effects] == ["gyroscopic"]
    assert np.allclose(model.remove(2).remove(1).frf(HZ).data, idle.frf(HZ).data)
    with pytest.raises(ConfigError, match="cannot be -1 kg"):
        model.with_values(1, mass=-1.0)
    with pytest.raises(ConfigError, match="it has mass"):
        model.with_values(1, stiffness=1.0)
    faster = model.with_values(2, coefficient=200.0)
    direct = Model(idle).add("point_mass@3+Z=mass:0.7").add("gyroscopic@2+Z,4+Z=coefficient:200")
    assert np.allclose(faster.frf(HZ).data, direct.frf(HZ).data, rtol=1e-12)
    assert model.effects[1].values["coefficient"] == 100.0
    for step in (0, 3):
        with pytest.raises(ConfigError, match="step"):
            model.remove(step)


def test_a_value_at_its_bound_has_a_variance():
    """Derivatives step over the bound; they are no state that anybody asked for."""
    _, idle = chain_and_idle()
    effect = Effect("ground_rubber", ("3+Z",), {"stiffness": 2e4, "exponent": 0.1, "reference_hz": 30.0})
    low, _ = effect.definition.parameter("exponent").bounds((5.0, 130.0))
    at_bound = effect.with_values(exponent=low).with_std({"stiffness": 100.0, "exponent": 0.02})
    variance = Model(idle, (at_bound,)).frf(HZ, "3+Z", "1+Z").variance
    assert variance is not None
    assert variance.max() > 0


def test_models_refuse_what_they_cannot_hold():
    _, idle = chain_and_idle()
    with pytest.raises(DofError):
        Model(idle).add("ground_spring@99+Z")
    with pytest.raises(DataError, match="unit modal mass"):
        Model(replace(idle, scaling="unscaled"))
    with pytest.raises(DataError, match="quantity"):
        Model(idle).frf(HZ, quantity="dynamic stiffness")
    with pytest.raises(DataError, match="geometry"):
        Model(idle).add("ground_spring@0.1,0,0:+Z")
    with pytest.raises(DataError, match="covariance"):
        Model(idle, (parse_effect("ground_spring@3+Z"),), covariance=np.eye(2))


def test_an_effect_between_sensors_of_a_smooth_structure():
    # A pinned beam has sine shapes; a spring between two of 12 sensors, against all modes at the true place.
    x = np.linspace(0.05, 0.95, 12)
    modes = np.arange(1, 6)
    shapes = np.sqrt(2) * np.sin(np.pi * np.outer(x, modes))
    idle = ModalModel(10.0 * modes**2, np.full(5, 0.01), shapes, [f"{i}+Z" for i in range(12)], "unit_modal_mass")
    geometry = Geometry(tuple(range(12)), np.c_[x, np.zeros(12), np.zeros(12)])
    place = 0.41
    found = Model(idle, geometry=geometry).add(f"ground_spring@{place},0,0:+Z=stiffness:5e3").modes()
    b = np.sqrt(2) * np.sin(np.pi * place * modes)
    w = 2 * np.pi * idle.frequencies_hz
    truth = pole_list(np.eye(5), np.diag(2 * 0.01 * w), np.diag(w**2) + 5e3 * np.outer(b, b))
    assert np.allclose(found.frequencies_hz, np.abs(truth) / 2 / np.pi, rtol=2e-3)
    assert np.abs(found.frequencies_hz[0] - idle.frequencies_hz[0]) > 1


def test_a_kind_of_the_users_own_serves_frfs_and_poles(inerter):
    assert inerter in catalogue()
    chain, idle = chain_and_idle()
    model = Model(idle).add(f"{inerter}@2+Z,5+Z=inertance:0.4")
    truth = receptance(chain, HZ, mass=0.4 * at(N, 1, 4))
    assert far(model.frf(HZ, quantity="receptance").data, truth) < 1e-10
    assert np.allclose(model.modes().poles, pole_list(chain.M + 0.4 * at(N, 1, 4), chain.C, chain.K), rtol=1e-9)


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        (100.0, 0.9, "lower by 99.1"),
        (100.0, 99.0, "the data do not support it"),
        (100.0, 110.0, "makes the prediction worse"),
        (100.0, 70.0, "most of the error remains"),
        (0.9, 0.7, "nothing was left to explain"),
    ],
)
def test_what_is_said_of_an_effect_added_by_hand(before, after, said):
    assert said in words_of(Effect("ground_damper", ("3+Z",), {"damping": 1.0}), before, after)

"""What the expansion makes of shapes by what the frequencies say, and what becomes of modes that operation did not show."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigh

from operando.data import ModalModel
from operando.data.undriven import BETWEEN, OWN, undriven_variance
from operando.dof import Dof
from operando.scaling import scale_operational
from operando.scaling.carried import common_shift, lessened, part_left
from operando.scaling.expansion import make_prior
from operando.scaling.methods import Task, scale_expansion
from operando.structure import Model
from structures import Chain, modified

N = 10
DOFS = tuple(Dof.parse(f"{i}+Z") for i in range(1, N + 1))


def model(chain, count=N, shapes=None, covariance=None, hz=None, scaling="unit_modal_mass"):
    phi = chain.phi[:, :count] if shapes is None else shapes
    return ModalModel(chain.hz[:count] if hz is None else hz, chain.zeta[:count], phi, DOFS, scaling, covariance=covariance, si=True)


def noisy(chain, sigma, rng, hz_std=3e-4):
    """Operational modes with shape noise of relative size sigma, and the covariance that says so."""
    unit = chain.phi / np.linalg.norm(chain.phi, axis=0)
    rough = sigma / np.sqrt(2 * N) * (rng.standard_normal(unit.shape) + 1j * rng.standard_normal(unit.shape))
    hz = chain.hz * (1 + hz_std * rng.standard_normal(N))
    variance = np.concatenate([(hz_std * hz) ** 2, (0.03 * chain.zeta) ** 2, np.full(2 * N * N, sigma**2 / (2 * N))])
    return model(chain, shapes=unit + rough, covariance=np.diag(variance), hz=hz, scaling="unscaled")


def shape_error(hybrid, truth):
    found = np.asarray(hybrid.modal.shapes)[:, : truth.shape[1]]
    found = found * np.sign(np.sum(found * truth, axis=0))
    return np.linalg.norm(found - truth, axis=0) / np.linalg.norm(truth, axis=0)


def test_where_nothing_changed_the_idle_shapes_remain():
    """Frequencies that did not move say so, whatever the noise of the operational shapes."""
    chain = Chain(N, spread=0.3, seed=1)
    hybrid = scale_operational(model(chain), noisy(chain, 0.05, np.random.default_rng(2)))
    assert hybrid.method == "expansion"
    assert np.max(shape_error(hybrid, chain.phi)) < 0.012
    msf = np.asarray(hybrid.alternative_models["msf_all"].shapes)[:, :N]
    assert np.median(np.linalg.norm(msf - chain.phi, axis=0) / np.linalg.norm(chain.phi, axis=0)) > 0.025


@pytest.mark.parametrize("change", [{"spring": (3, 1.5e5)}, {"mass": (6, 0.5)}, {"coupling": (2, 7, 1e5)}])
def test_where_frequencies_moved_the_shapes_follow(change):
    chain = Chain(N, spread=0.3, seed=1)
    target = modified(chain, **change)
    hybrid = scale_operational(model(chain), noisy(target, 0.02, np.random.default_rng(3)))
    error = shape_error(hybrid, target.phi)
    assert np.median(error) < 0.02
    assert np.max(error) < 0.06


def test_shapes_without_a_stated_noise_are_taken_as_they_are():
    """Eight of ten idle modes cannot make up the shape of a strong local change: it is kept, not smoothed."""
    chain = Chain(N, spread=0.3, seed=1)
    target = modified(chain, spring=(3, 4e5))
    idle = model(chain, 8)
    running = ModalModel(target.hz[:8], target.zeta[:8], target.phi[:, :8] * 3j, DOFS, "unscaled")
    found = np.asarray(scale_operational(idle, running).modal.shapes)[:, :8]
    mac = np.sum(found * target.phi[:, :8], axis=0) ** 2 / np.sum(found**2, axis=0) / np.sum(target.phi[:, :8] ** 2, axis=0)
    assert np.min(mac) > 0.999


def test_common_shift_is_taken_where_pairs_agree():
    rng = np.random.default_rng(4)
    hz = np.linspace(20, 120, 10)
    softer = common_shift(hz, 0.95 * hz * (1 + 0.003 * rng.standard_normal(10)))
    assert softer.factor == pytest.approx(0.95, abs=0.003)
    assert 0.001 < softer.spread < 0.006
    local = common_shift(hz, hz * (1 + np.where(np.arange(10) % 4 == 0, 0.03, 0.0)))
    assert abs(local.logarithm) < 0.004
    assert local.spread > 0.01
    assert common_shift(hz[:3], 0.9 * hz[:3]).logarithm == 0


def test_modes_that_operation_did_not_show_move_with_the_others():
    chain = Chain(N, spread=0.3, seed=1)
    target = modified(chain, global_stiffness=-0.12)
    running = ModalModel(target.hz[:6], target.zeta[:6], target.phi[:, :6] + 0j, DOFS, "unscaled")
    in_band = np.arange(N) < 6
    idle = ModalModel(chain.hz, chain.zeta, chain.phi, DOFS, "unit_modal_mass", in_band=in_band, si=True)
    hybrid = scale_operational(idle, running)
    assert "as the 6 highest pairs moved" in hybrid.residuals
    np.testing.assert_allclose(hybrid.modal.residuals.frequencies_hz, target.hz[6:], rtol=1e-3)


def test_band_holds_what_real_shapes_leave_out():
    """A ground damper makes shapes complex: real parts are off by more than the covariances of the modes say, and the band shows it."""
    chain = Chain(N, spread=0.3, seed=1)
    f = np.linspace(20, 130, 600)
    w, damper = 2 * np.pi * f, np.zeros((N, N))
    damper[4, 4] = 60.0
    modal_damping = np.linalg.inv(chain.phi.T) @ np.diag(2 * chain.zeta * 2 * np.pi * chain.hz) @ np.linalg.inv(chain.phi)
    c = modal_damping + damper
    exact = np.stack([-(x**2) * np.linalg.inv(chain.K - x**2 * chain.M + 1j * x * c) for x in w], axis=-1)
    inverse = np.linalg.inv(chain.M)
    state = np.block([[np.zeros((N, N)), np.eye(N)], [-inverse @ chain.K, -inverse @ c]])
    value, vector = np.linalg.eig(state)
    order = [i for i in np.argsort(np.abs(value)) if value[i].imag > 0]
    pole, shapes = value[order], vector[:N, order]
    shapes = shapes / np.linalg.norm(shapes, axis=0)
    small = np.full(N * (2 + N), 1e-10)
    both = np.full(N * (2 + 2 * N), 1e-10)
    idle = model(chain, covariance=np.diag(small))
    running = ModalModel(np.abs(pole) / 2 / np.pi, -pole.real / np.abs(pole), shapes, DOFS, "unscaled", covariance=np.diag(both))
    frf = scale_operational(idle, running, method="expansion").frf(f)
    ratio = np.abs(frf.data - exact) ** 2 / frf.variance
    assert np.max(np.abs(frf.data - exact) / np.abs(exact)) > 0.2
    assert np.mean(ratio < -np.log(0.05)) > 0.9


def test_modes_carried_over_are_as_uncertain_as_they_moved():
    """Springs and masses along the chain: the modes that operation did not show lie within their intervals, which are not all too wide."""
    chain = Chain(N, spread=0.3, seed=1)
    in_band = np.arange(N) < 6
    small = np.full(N * (2 + N), 1e-10)
    idle = ModalModel(chain.hz, chain.zeta, chain.phi, DOFS, "unit_modal_mass", in_band=in_band, covariance=np.diag(small), si=True)
    ratio = []
    for change in [{"spring": (dof, 2e5)} for dof in range(1, N - 1)] + [{"mass": (dof, 0.3)} for dof in range(1, N - 1)]:
        target = modified(chain, **change)
        running = ModalModel(
            target.hz[:6], target.zeta[:6], target.phi[:, :6] + 0j, DOFS, "unscaled", covariance=np.diag(np.full(6 * (2 + 2 * N), 1e-10))
        )
        modal = scale_operational(idle, running).modal
        ratio.append((target.hz[6:] - modal.residuals.frequencies_hz) / np.sqrt(np.diag(modal.covariance)[6:10]))
    assert np.mean(np.abs(ratio) < 1.96) > 0.85
    assert np.median(np.abs(ratio)) > 0.25


def test_what_pairs_show_of_change_lessens_with_frequency_for_a_stiffness():
    pairs, beyond = np.array([50.0, 100.0]), np.array([60.0, 158.113883, 500.0])
    middle = np.sqrt(np.mean(pairs**2))
    np.testing.assert_allclose(lessened(beyond, pairs, 0.0), np.minimum((middle / beyond) ** 2, 1))
    np.testing.assert_allclose(lessened(beyond, pairs, 1.0), 1)


def test_a_stiffness_leaves_modes_far_below_all_pairs_as_they_are():
    """A free structure: rigid bodies below the band stay as they are, whatever springs between its parts do to the modes above."""
    pairs = np.array([10.0, 20.0, 30.0, 33.0, 36.0, 40.0])
    low = lessened(np.array([0.1, 2.0, 9.5]), pairs, 0.0)
    assert low[0] < 0.01 < low[1] < 0.2 < low[2] <= 1
    # A residual mode stands for modes anywhere below the band.
    assert lessened(np.array([0.1]), pairs, 0.0, 2.0)[0] == pytest.approx(low[1])
    assert lessened(np.array([0.1]), pairs, 0.0, 9.9)[0] == 1
    # A change of mass changes their size, though it mixes them little.
    assert low[1] < lessened(np.array([2.0]), pairs, 1.0)[0] < 1


def test_rigid_bodies_of_a_free_chain_keep_their_shape_in_the_band():
    """The change of a spring between parts, exact modes: the carried rigid-body mode is exact, and the band at low frequency is narrow."""
    chain = Chain(N, spread=0.3, seed=1)
    free = chain.K - np.diag(np.sum(chain.K, axis=1))
    more = np.zeros((N, N))
    more[np.ix_([3, 4], [3, 4])] = 0.4 * -free[3, 4] * np.array([[1, -1], [-1, 1]])
    small = np.full(N * (2 + N), 1e-12)
    made = []
    for stiffness in (free, free + more):
        value, phi = eigh(stiffness, chain.M)
        made.append((np.sqrt(np.maximum(value, 1e-2)) / 2 / np.pi, phi))
    residual = np.arange(N) < 1
    band = (0.7 * made[0][0][1], 1.2 * made[0][0][-1])
    zeta = np.full(N, 0.01)
    idle = ModalModel.from_terms(
        made[0][0], zeta, made[0][1], DOFS, "unit_modal_mass", residual=residual, in_band=~residual, band_hz=band,
        covariance=np.diag(small), si=True,
    )  # fmt: skip
    size = np.full((N - 1) * (2 + 2 * N), 1e-12)
    running = ModalModel(made[1][0][1:], zeta[1:], made[1][1][:, 1:] + 0j, DOFS, "unscaled", covariance=np.diag(size))
    modal = scale_operational(idle, running).modal
    at = slice(2 * N + (N - 1) * N, 2 * N + N * N)
    spread = np.sqrt(np.trace(modal.covariance[at, at])) / np.linalg.norm(made[0][1][:, 0])
    highest = np.mean(
        [1 - np.sum(a * b) ** 2 / (np.sum(a**2) * np.sum(b**2)) for a, b in zip(made[0][1].T[-8:], made[1][1].T[-8:], strict=True)]
    )
    assert spread < 0.3 * np.sqrt(highest)


def test_an_idle_mode_that_may_be_noise_takes_no_part():
    """A ghost at the frequency of an operational mode, its shape far smaller than its standard deviation, must not blow up the band."""
    chain = Chain(N, spread=0.3, seed=1)
    target = modified(chain, spring=(3, 1.5e5))
    ghost = 1e-3 * np.random.default_rng(5).standard_normal(N)
    hz, zeta = np.append(chain.hz, target.hz[4] * 0.999), np.append(chain.zeta, 0.006)
    std = np.concatenate([1e-4 * hz, 0.01 * zeta, np.repeat(1e-3 * np.sqrt(np.mean(chain.phi**2, axis=0)), N), np.full(N, 0.03)])
    idle = ModalModel(hz, zeta, np.c_[chain.phi, ghost], DOFS, "unit_modal_mass", covariance=np.diag(std**2), si=True)
    running = noisy(target, 0.01, np.random.default_rng(6))
    modal = scale_operational(idle, running).modal
    n = modal.terms.n
    at = slice(2 * n + 4 * N, 2 * n + 5 * N)
    assert np.sqrt(np.trace(modal.covariance[at, at])) < 0.05 * np.linalg.norm(modal.shapes[:, 4])


def test_a_change_of_mass_that_cannot_be_scaled_away_widens_the_band():
    """A thicker part: mass and stiffness both change. The scale by unchanged mass is off by more than any identification error."""
    chain = Chain(N, spread=0.3, seed=1)
    heavier = np.where(np.arange(N) < 6, 1.25, 1.0)
    stiff = np.diag(np.where(np.arange(N) < 6, 1.5, 1.0))
    mass = chain.M * np.sqrt(np.outer(heavier, heavier))
    stiffness = np.sqrt(stiff) @ chain.K @ np.sqrt(stiff)
    value, shapes = eigh(stiffness, mass)
    hz = np.sqrt(value) / 2 / np.pi
    running = ModalModel(
        hz[:7], chain.zeta[:7], shapes[:, :7] * (2 + 1j), DOFS, "unscaled", covariance=np.diag(np.full(7 * (2 + 2 * N), 1e-10))
    )
    idle = model(chain, covariance=np.diag(np.full(N * (2 + N), 1e-10)))
    hybrid = scale_operational(idle, running, method="expansion")
    size = np.linalg.norm(np.asarray(hybrid.modal.shapes)[:, :7], axis=0) / np.linalg.norm(shapes[:, :7], axis=0) - 1
    assert np.sqrt(np.mean(size**2)) > 0.02
    assert 0.4 < np.sqrt(np.mean((size / hybrid.scale_std) ** 2)) < 2.5
    assert "mass_changed" in {f.kind for f in scale_operational(idle, running).findings}
    spring = modified(chain, spring=(4, 2e5))
    running = ModalModel(
        spring.hz[:7], spring.zeta[:7], spring.phi[:, :7] * (2 + 1j), DOFS, "unscaled", covariance=np.diag(np.full(7 * (2 + 2 * N), 1e-10))
    )
    softer = scale_operational(idle, running)
    assert np.max(softer.scale_std) < 0.01
    assert "mass_changed" not in {f.kind for f in softer.findings}


def test_undriven_pairs_are_less_sure_than_their_local_compliances():
    """Two DOFs that nothing drove: how their local compliances go together is not known, and the band between them says so."""
    chain = Chain(N, spread=0.3, seed=1)
    local = np.zeros((N, 2))
    local[3, 0] = local[7, 1] = 0.5
    shapes = np.hstack([chain.phi[:, :6], local])
    hz, residual = np.append(chain.hz[:6], [300.0, 300.0]), np.arange(8) >= 6
    small = np.diag(np.full(8 * (2 + N), 1e-12))
    idle = ModalModel.from_terms(hz, np.full(8, 0.01), shapes, DOFS, "unit_modal_mass", residual=residual, covariance=small, si=True)
    running = ModalModel(
        chain.hz[:6], chain.zeta[:6], chain.phi[:, :6] * 2j, DOFS, "unscaled", covariance=np.diag(np.full(6 * (2 + 2 * N), 1e-12))
    )
    f = np.array([80.0])
    std = np.sqrt(scale_operational(idle, running).frf(f).variance[:, :, 0])
    w, own = 2 * np.pi * f[0], 2 * np.pi * 300.0
    compliance = w**2 * 0.5**2 / abs(own**2 - w**2)
    assert std[3, 7] == pytest.approx(np.sqrt(2) * BETWEEN * compliance, rel=0.1)
    assert std[2, 7] < 0.2 * std[3, 7]
    # so it is of the idle model, and of the model with an effect elsewhere; where an effect acts a measurement has told it
    rest, other = (np.sqrt(made.frf(f).variance[:, :, 0]) for made in (idle, Model(idle).add("ground_spring@1+Z=stiffness:0.01")))
    for spread in (rest, other):
        assert spread[3, 7] == pytest.approx(np.sqrt(2) * BETWEEN * compliance, rel=0.1)
        assert spread[3, 3] == pytest.approx(np.sqrt(2) * OWN * compliance, rel=0.1)
    there = np.sqrt(Model(idle).add("ground_spring@4+Z=stiffness:0.01").frf(f).variance[:, :, 0])
    assert there[3, 7] < 0.1 * rest[3, 7]
    # of one DOF alone nothing says whether it was driven
    alone = ModalModel.from_terms(hz, np.full(8, 0.01), shapes[3:4], DOFS[3:4], "unit_modal_mass", residual=residual)
    assert not undriven_variance(alone.terms, [0], [0]).any()


def test_an_idle_mode_spread_over_others_is_not_carried_over_again():
    """A stiff spring moves the highest mode out of the band; what was the idle mode there lives on in the others."""
    chain = Chain(N, spread=0.3, seed=1)
    target = modified(chain, spring=(4, 2e6))
    count = N - 1
    shape = chain.phi.T @ chain.M @ target.phi[:, :count]
    left = part_left(shape)
    np.testing.assert_allclose(left, (chain.phi.T @ chain.M @ target.phi[:, -1]) ** 2, atol=1e-9)
    missed = part_left(np.delete(np.eye(N), 3, axis=1))
    np.testing.assert_allclose(missed, np.arange(N) == 3)
    idle = model(chain)
    running = ModalModel(target.hz[:count], target.zeta[:count], target.phi[:, :count] * 2j, DOFS, "unscaled")
    hybrid = scale_operational(idle, running)
    alone = hybrid.pairing.idle_without_partner
    assert hybrid.modal.n_residuals == int(np.sum(left[alone] >= 0.1))
    if hybrid.modal.n_residuals:
        carried = hybrid.modal.residuals.shapes[:, 0]
        np.testing.assert_allclose(carried, chain.phi[:, alone[0]] * np.sqrt(left[alone[0]]), rtol=0.02, atol=1e-3)


def test_modes_far_apart_are_orthogonal_too():
    """Few sensors, loud shapes: what distant operational modes are off orthogonality is taken out of the one that is less well known."""
    chain = Chain(N, spread=0.3, seed=1)
    target = modified(chain, spring=(3, 2e5))
    seen = [0, 2, 3, 5, 7, 9]
    gain = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        exact = target.phi[seen, :6]
        length = np.linalg.norm(exact, axis=0)
        unit = exact / length + 0.1 / np.sqrt(len(seen)) * rng.standard_normal(exact.shape)
        unit = unit / np.linalg.norm(unit, axis=0)
        noise = np.repeat(0.01 / len(seen) * np.eye(len(seen))[None], 6, axis=0)
        prior = make_prior(chain.phi[seen], chain.hz, unit, target.hz[:6], target.zeta[:6], np.arange(6), noise)
        task = Task(np.arange(6), np.ones(6, bool), np.zeros(0, int), chain.hz, target.hz[:6], prior)
        far = np.abs(np.log(target.hz[:6, None] / target.hz[None, :6])) > 0.15
        found = []
        for mixing in (prior.mixing, np.where(far, 0, prior.mixing)):
            made = scale_expansion(chain.phi[seen], unit, replace(task, prior=replace(prior, mixing=mixing)), "mass")
            made = made * np.sign(np.sum(made * exact, axis=0))
            found.append(np.sqrt(np.mean(np.sum((made - exact) ** 2, axis=0) / length**2)))
        gain.append(found[0] / found[1])
    assert np.median(gain) < 0.97


def test_an_idle_mode_whose_partner_holds_nothing_of_it_is_carried_over():
    """Fewer operational modes than idle ones in band: the partner of a mode beyond the band only looks alike at the sensors."""
    chain = Chain(N, spread=0.3, seed=1)
    phi = np.array(chain.phi)
    phi[:, 6] = 0.9 * phi[:, 3] + 0.1 * phi[:, 6]
    hz = np.array(chain.hz)
    hz[6] = 3 * hz[-1]
    order = np.argsort(hz)
    shapes, hz = phi[:, order], hz[order]
    in_band = np.arange(N) < N - 1
    small = np.diag(np.full(N * (2 + N), 1e-10))
    idle = ModalModel(hz, chain.zeta, shapes, DOFS, "unit_modal_mass", in_band=in_band, covariance=small, si=True)
    # The idle mode 3 is there twice over: as itself and, 2 % higher, with a little of another.
    third = shapes[:, 3] + 0.05 * shapes[:, 4]
    found = np.c_[shapes[:, :3], shapes[:, 3], third]
    running = ModalModel(
        np.r_[hz[:4], 1.02 * hz[3]], chain.zeta[:5], found + 0j, DOFS, "unscaled", covariance=np.diag(np.full(5 * (2 + 2 * N), 1e-10))
    )
    hybrid = scale_operational(idle, running, threshold=0.5)
    paired = [p.idle for p in hybrid.pairing.pairs]
    assert N - 1 in paired
    assert np.any(np.isclose(hybrid.modal.residuals.frequencies_hz, hz[-1]))

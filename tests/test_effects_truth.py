"""Each kind of effect against matrices assembled here: K + iωC − ω²M with the effect inverted line by line, poles by state space."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import eig, eigh

from operando import Effect, ModalModel, Model, parse_effect
from operando.errors import DataError

DOFS = ("1+X", "1+Z", "2+X", "2+Z", "3+X", "3-Z", "4+X", "4+Z")
F = np.linspace(4.0, 120.0, 160)
S = 2j * np.pi * F
BAND = (4.0, 120.0)


class Structure:
    """Four nodes that move in X and Z on a full random stiffness: every DOF is coupled to every other, with 1 to 3 % damping."""

    def __init__(self) -> None:
        rng = np.random.default_rng(7)
        n = len(DOFS)
        a = rng.standard_normal((n, n))
        self.M = np.diag(rng.uniform(0.8, 2.0, n)) + 0.05 * (a @ a.T)
        b = rng.standard_normal((n, n))
        q, _ = np.linalg.qr(b)
        self.K = q @ np.diag((2 * np.pi * np.linspace(8, 105, n)) ** 2) @ q.T
        w2, self.phi = eigh(self.K, self.M)
        self.w = np.sqrt(w2)
        self.zeta = np.linspace(0.01, 0.03, n)
        self.C = self.M @ self.phi @ np.diag(2 * self.zeta * self.w) @ self.phi.T @ self.M

    def idle(self, covariance=None) -> ModalModel:
        return ModalModel(self.w / 2 / np.pi, self.zeta, self.phi, DOFS, "unit_modal_mass", band_hz=BAND, covariance=covariance)


TRUTH = Structure()


def inverse(dynamic):
    """Accelerance from dynamic stiffness (lines, n, n), in the sense of the DOFs."""
    return np.moveaxis(np.linalg.inv(dynamic) * (S**2)[:, None, None], 0, -1)


def stiffness(extra=0.0, mass=None, damping=None, spring=None):
    m, c, k = (TRUTH.M if mass is None else mass), (TRUTH.C if damping is None else damping), (TRUTH.K if spring is None else spring)
    return k + S[:, None, None] * c + (S**2)[:, None, None] * m + extra


def unit(i):
    out = np.zeros(len(DOFS))
    out[i] = 1
    return out


def along(b, z):
    return np.asarray(z)[:, None, None] * np.outer(b, b)


B3 = unit(3)  # 2+Z
# 3-Z points down: a place written 3+Z is minus that coordinate, so 2+Z against 3+Z is x_3 + x_5.
B35 = unit(3) + unit(5)
SKEW = np.outer(unit(3), unit(6)) - np.outer(unit(6), unit(3))


def absorber_truth(m, hz, zeta):
    """Nine degrees of freedom: the absorber's mass is a coordinate of its own."""
    n = len(DOFS)
    mass, damping, spring = (np.pad(a, (0, 1)) for a in (TRUTH.M, TRUTH.C, TRUTH.K))
    mass[n, n] = m
    d = np.r_[B3, -1.0]
    spring = spring + m * (2 * np.pi * hz) ** 2 * np.outer(d, d)
    damping = damping + 2 * zeta * 2 * np.pi * hz * m * np.outer(d, d)
    return mass, damping, spring


def absorber_dynamic():
    mass, damping, spring = absorber_truth(0.4, 40.0, 0.05)
    full = spring + S[:, None, None] * damping + (S**2)[:, None, None] * mass
    return np.linalg.inv(np.linalg.inv(full)[:, :-1, :-1])


W0 = 2 * np.pi * 62.0  # centre of the band
STRUCTURAL = {
    "point_mass@2+Z=mass:0.3": stiffness(mass=TRUTH.M + 0.3 * (np.outer(unit(2), unit(2)) + np.outer(B3, B3))),
    "sensor_mass@2+Z=mass:0.05": stiffness(mass=TRUTH.M + 0.05 * (np.outer(unit(2), unit(2)) + np.outer(B3, B3))),
    "point_mass@2+Z=mass:-0.2": stiffness(mass=TRUTH.M - 0.2 * (np.outer(unit(2), unit(2)) + np.outer(B3, B3))),
    "ground_spring@2+Z=stiffness:4e4": stiffness(along(B3, np.full(F.size, 4e4))),
    "ground_spring@2-Z=stiffness:-1e4": stiffness(along(B3, np.full(F.size, -1e4))),
    "ground_damper@2+Z=damping:60": stiffness(along(B3, 60 * S)),
    "ground_hysteretic_spring@2+Z=stiffness:4e4,loss_factor:0.2": stiffness(along(B3, np.full(F.size, 4e4 * (1 + 0.2j)))),
    "ground_rubber@2+Z=stiffness:4e4,exponent:0.4": stiffness(along(B3, 4e4 * (1j * 2 * np.pi * F / W0) ** 0.4)),
    "coupling_spring@2+Z,3+Z=stiffness:3e4": stiffness(along(B35, np.full(F.size, 3e4))),
    "coupling_damper@2+Z,3+Z=damping:40": stiffness(along(B35, 40 * S)),
    "tuned_absorber@2+Z=mass:0.4,frequency:40,damping_ratio:0.05": absorber_dynamic(),
    "gyroscopic@2+Z,4+X=coefficient:70": stiffness(70 * S[:, None, None] * SKEW),
    "gyroscopic@4+X,2+Z=coefficient:70": stiffness(-70 * S[:, None, None] * SKEW),
    "circulatory@2+Z,4+X=coefficient:2e4": stiffness(2e4 * np.ones(F.size)[:, None, None] * SKEW),
    "global_stiffness=change:0.1": stiffness(spring=1.1 * TRUTH.K),
    "global_damping=change:0.5": stiffness(damping=1.5 * TRUTH.C),
}


def model(*texts):
    out = Model(TRUTH.idle())
    for text in texts:
        out = out.add(parse_effect(text, BAND))
    return out


@pytest.mark.parametrize("text", STRUCTURAL)
def test_frf_equals_direct_inversion(text):
    want = inverse(STRUCTURAL[text])
    got = model(text).frf(F).data
    idle = Model(TRUTH.idle()).frf(F).data
    assert np.abs(got - want).max() < 1e-8 * np.abs(want).max()
    assert np.abs(got - idle).max() > 1e-2 * np.abs(want).max(), "the effect must be seen for the test to mean something"


@pytest.mark.parametrize(("quantity", "power"), [("receptance", 0), ("mobility", 1), ("accelerance", 2)])
def test_quantities_senses_and_choice_of_pairs(quantity, power):
    text = "gyroscopic@2+Z,4+X=coefficient:70"
    want = inverse(STRUCTURAL[text]) * S ** (power - 2)
    got = model(text).frf(F, "3+Z, 1+X", "4+Z", quantity)
    np.testing.assert_allclose(got.data[0, 0], -want[5, 7], rtol=1e-8)
    np.testing.assert_allclose(got.data[1, 0], want[0, 7], rtol=1e-8)


def test_several_effects_act_together():
    texts = (
        "point_mass@2+Z=mass:0.3",
        "gyroscopic@2+Z,4+X=coefficient:70",
        "ground_rubber@1+X=stiffness:2e4,exponent:0.3",
        "global_stiffness=change:0.1",
    )
    mass = TRUTH.M + 0.3 * (np.outer(unit(2), unit(2)) + np.outer(B3, B3))
    extra = 70 * S[:, None, None] * SKEW + along(unit(0), 2e4 * (1j * 2 * np.pi * F / W0) ** 0.3)
    want = inverse(stiffness(extra, mass=mass, spring=1.1 * TRUTH.K))
    for order in (texts, texts[::-1]):
        got = model(*order).frf(F).data
        assert np.abs(got - want).max() < 1e-8 * np.abs(want).max()


def state_space(mass, damping, spring):
    n = len(mass)
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(mass, spring), -np.linalg.solve(mass, damping)]])
    values, vectors = eig(a)
    up = np.flatnonzero(values.imag > 1e-6)
    order = up[np.argsort(np.abs(values[up]))]
    return values[order], vectors[: len(DOFS), order]


POLES = {
    "point_mass@2+Z=mass:0.3": (TRUTH.M + 0.3 * (np.outer(unit(2), unit(2)) + np.outer(B3, B3)), TRUTH.C, TRUTH.K),
    "ground_spring@2+Z=stiffness:4e4": (TRUTH.M, TRUTH.C, TRUTH.K + 4e4 * np.outer(B3, B3)),
    "ground_damper@2+Z=damping:60": (TRUTH.M, TRUTH.C + 60 * np.outer(B3, B3), TRUTH.K),
    "coupling_spring@2+Z,3+Z=stiffness:3e4": (TRUTH.M, TRUTH.C, TRUTH.K + 3e4 * np.outer(B35, B35)),
    "coupling_damper@2+Z,3+Z=damping:40": (TRUTH.M, TRUTH.C + 40 * np.outer(B35, B35), TRUTH.K),
    "tuned_absorber@2+Z=mass:0.4,frequency:40,damping_ratio:0.05": absorber_truth(0.4, 40.0, 0.05),
    "gyroscopic@2+Z,4+X=coefficient:70": (TRUTH.M, TRUTH.C + 70 * SKEW, TRUTH.K),
    "circulatory@2+Z,4+X=coefficient:2e4": (TRUTH.M, TRUTH.C, TRUTH.K + 2e4 * SKEW),
    "global_stiffness=change:0.1": (TRUTH.M, TRUTH.C, 1.1 * TRUTH.K),
    "global_damping=change:0.5": (TRUTH.M, 1.5 * TRUTH.C, TRUTH.K),
}


@pytest.mark.parametrize("text", POLES)
def test_poles_and_shapes_equal_the_state_space(text):
    poles, shapes = state_space(*POLES[text])
    got = model(text).modes()
    assert got.n_modes == poles.size
    np.testing.assert_allclose(got.poles, poles, rtol=1e-9)
    for a, b in zip(got.shapes.T, shapes.T, strict=True):
        assert abs(np.vdot(a, b)) ** 2 / np.vdot(a, a).real / np.vdot(b, b).real > 1 - 1e-9


@pytest.mark.parametrize(
    ("text", "law"),
    [
        ("ground_hysteretic_spring@2+Z=stiffness:4e4,loss_factor:0.2", lambda s: 4e4 * (1 + 0.2j)),
        ("ground_rubber@2+Z=stiffness:4e4,exponent:0.4", lambda s: 4e4 * (s / W0) ** 0.4),
        ("ground_rubber@2+Z=stiffness:3e5,exponent:0.7", lambda s: 3e5 * (s / W0) ** 0.7),
    ],
)
def test_poles_of_stiffness_that_varies_with_s(text, law):
    """Every pole and shape makes the dynamic stiffness singular, and none is missed (their number by the argument principle)."""

    def dynamic(s):
        return TRUTH.K + s * TRUTH.C + s**2 * TRUTH.M + law(s) * np.outer(B3, B3)

    got = model(text).modes()
    for pole, shape in zip(got.poles, got.shapes.T, strict=True):
        assert np.linalg.norm(dynamic(pole) @ shape) < 1e-7 * np.linalg.norm(dynamic(0.9 * pole) @ shape)
    low, high, left, right = 2 * np.pi * 2, 2 * np.pi * 400, -800.0, 50.0
    edges = [
        (right + 1j * low, right + 1j * high),
        (right + 1j * high, left + 1j * high),
        (left + 1j * high, left + 1j * low),
        (left + 1j * low, right + 1j * low),
    ]
    path = np.concatenate([a + (b - a) * np.linspace(0, 1, 4000)[:-1] for a, b in edges])
    winding = np.unwrap(np.angle([np.linalg.det(dynamic(s) / 1e5) for s in np.r_[path, path[:1]]]))
    inside = (got.poles.imag > low) & (got.poles.imag < high) & (got.poles.real > left)
    assert round((winding[-1] - winding[0]) / 2 / np.pi) == inside.sum() == got.n_modes


def test_poles_and_frf_agree_with_two_kinds_of_law_at_once():
    m = model("ground_rubber@2+Z=stiffness:4e4,exponent:0.4", "tuned_absorber@1+X=mass:0.4,frequency:40,damping_ratio:0.05")
    for pole in m.modes().poles:
        z = np.asarray(4e4 * (pole / W0) ** 0.4)
        k, c = 0.4 * (2 * np.pi * 40) ** 2, 0.4 * 2 * 0.05 * 2 * np.pi * 40
        absorber = 0.4 * pole**2 * (c * pole + k) / (0.4 * pole**2 + c * pole + k)
        d = TRUTH.K + pole * TRUTH.C + pole**2 * TRUTH.M + z * np.outer(B3, B3) + absorber * np.outer(unit(0), unit(0))
        sizes = np.linalg.svd(d, compute_uv=False)
        assert sizes[-1] < 1e-8 * sizes[0]


def test_overdamped_structure_keeps_its_oscillating_modes():
    damping = TRUTH.C + 4e3 * np.outer(B3, B3)
    poles, _ = state_space(TRUTH.M, damping, TRUTH.K)
    got = model("ground_damper@2+Z=damping:4e3").modes()
    assert poles.size < len(DOFS)
    np.testing.assert_allclose(got.poles, poles, rtol=1e-8)


def test_faults_of_the_channels():
    h = inverse(stiffness())
    cases = {
        "sensor_gain@2+Z=gain:1.2": (3, 1.2 * h[3]),
        "sensor_polarity@2+Z": (3, -h[3]),
        "sensor_delay@2+Z=delay:1e-3": (3, h[3] * np.exp(-2j * np.pi * F * 1e-3)),
        "sensor_gain@3+Z=gain:0.8": (5, 0.8 * h[5]),
    }
    for text, (row, want) in cases.items():
        got = model(text).frf(F).data
        np.testing.assert_allclose(got[row], want, rtol=1e-9, atol=1e-12)
        others = [i for i in range(len(DOFS)) if i != row]
        np.testing.assert_allclose(got[others], h[others], rtol=1e-9, atol=1e-12)
    for text, factor in {"force_gain@2+Z=gain:1.2": 1 / 1.2, "force_delay@2+Z=delay:1e-3": np.exp(2j * np.pi * F * 1e-3)}.items():
        got = model(text).frf(F).data
        np.testing.assert_allclose(got[:, 3], h[:, 3] * factor, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(got[:, 4], h[:, 4], rtol=1e-9, atol=1e-12)


def test_swapped_channels_exchange_rows_and_leave_the_forces():
    h = inverse(stiffness())
    got = model("channel_swap@2+Z,4+X").frf(F).data
    np.testing.assert_allclose(got[3], h[6], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(got[6], h[3], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(got[0, 3], h[0, 3], rtol=1e-9)
    # Only one of the two is asked for: it still shows the other.
    np.testing.assert_allclose(model("channel_swap@2+Z,4+X").frf(F, "2+Z", "1+X").data[0, 0], h[6, 0], rtol=1e-9)


def test_faults_of_the_channels_see_the_structure_with_its_effects():
    text = "point_mass@2+Z=mass:0.3"
    want = inverse(STRUCTURAL[text])
    both = model(text, "sensor_gain@1+X=gain:1.5", "sensor_mass@4+Z=mass:0.1")
    np.testing.assert_allclose(both.structure().frf(F).data, want, rtol=1e-7, atol=1e-9)
    measured = both.frf(F).data
    mass = TRUTH.M + 0.3 * (np.outer(unit(2), unit(2)) + np.outer(B3, B3)) + 0.1 * (np.outer(unit(6), unit(6)) + np.outer(unit(7), unit(7)))
    want = inverse(stiffness(mass=mass))
    np.testing.assert_allclose(measured[0], 1.5 * want[0], rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(measured[3], want[3], rtol=1e-7, atol=1e-9)


def test_missing_mode_completes_the_idle_model():
    idle = TRUTH.idle().select_modes([0, 1, 2, 4, 5, 6, 7])
    shape = dict(zip(DOFS, TRUTH.phi[:, 3], strict=True))
    effect = Effect("missing_mode", (), {"frequency": TRUTH.w[3] / 2 / np.pi, "damping_ratio": TRUTH.zeta[3]}, shape=shape)
    want = inverse(stiffness())
    got = Model(idle, (effect,)).frf(F).data
    assert np.abs(got - want).max() < 1e-9 * np.abs(want).max()
    with_mass = Model(idle, (effect, parse_effect("point_mass@2+Z=mass:0.3"))).frf(F).data
    want = inverse(STRUCTURAL["point_mass@2+Z=mass:0.3"])
    assert np.abs(with_mass - want).max() < 1e-8 * np.abs(want).max()
    # It is told as it is in operation: what moves the whole by a tenth in stiffness has moved it already, and leaves c = 2ζω.
    moved = np.sqrt(1.1)
    values = {"frequency": moved * TRUTH.w[3] / 2 / np.pi, "damping_ratio": TRUTH.zeta[3] / moved}
    pair = [Effect("missing_mode", (), values, shape=shape), parse_effect("global_stiffness=change:0.1")]
    want = inverse(STRUCTURAL["global_stiffness=change:0.1"])
    for order in (pair, pair[::-1]):
        got = Model(idle, tuple(order)).frf(F).data
        assert np.abs(got - want).max() < 1e-8 * np.abs(want).max(), "a change of the whole moves the mode that is told as in operation"


def test_harmonics_are_no_structure():
    m = model("harmonic_excitation=frequencies:25;50")
    np.testing.assert_array_equal(m.frf(F).data, Model(TRUTH.idle()).frf(F).data)
    np.testing.assert_allclose(m.modes().poles, TRUTH.idle().poles, rtol=1e-10)


def test_unscaled_model_is_refused():
    with pytest.raises(DataError, match="unit modal mass"):
        Model(ModalModel(TRUTH.w, TRUTH.zeta, TRUTH.phi, DOFS))


def test_shapes_go_through_the_channels_and_forces_do_not():
    plain = model("point_mass@2+Z=mass:0.3").modes()
    seen = model(
        "point_mass@2+Z=mass:0.3",
        "sensor_gain@1+X=gain:1.5",
        "sensor_delay@3-Z=delay:1e-3",
        "channel_swap@2+Z,4+X",
        "force_gain@1+Z=gain:2",
    ).modes()
    want = plain.shapes.copy()
    want[0] *= 1.5
    want[5] *= np.exp(-plain.poles * 1e-3)
    want[[3, 6]] = want[[6, 3]]
    np.testing.assert_allclose(seen.shapes, want, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(seen.poles, plain.poles, rtol=1e-12)


@pytest.mark.parametrize(
    "texts",
    [
        ("gyroscopic@2+Z,4+X=coefficient:70", "point_mass@2+Z=mass:0.3"),
        ("ground_rubber@2+Z=stiffness:4e4,exponent:0.4", "global_stiffness=change:0.1"),
        ("tuned_absorber@2+Z=mass:0.4,frequency:40,damping_ratio:0.05",),
    ],
)
def test_spread_of_the_poles_is_the_scatter_of_random_models(texts):
    rng = np.random.default_rng(3)
    idle = TRUTH.idle()
    n, p = idle.n_modes, idle.n_parameters
    size = np.r_[1e-3 * idle.frequencies_hz, 2e-2 * idle.damping_ratios, np.full(p - 2 * n, 3e-3)]
    half = size[:, None] * rng.normal(size=(p, p)) / np.sqrt(p)
    effects = []
    for text in texts:
        e = parse_effect(text, BAND)
        effects.append(e.with_std({name: 0.01 * abs(e.values[name]) for name in e.definition.names}))
    stated = Model(TRUTH.idle(half @ half.T), tuple(effects)).modes(variance=True)
    theta = np.r_[idle.frequencies_hz, idle.damping_ratios, idle.shapes.T.ravel()]
    hz, zeta = [], []
    for _ in range(150):
        t = theta + half @ rng.normal(size=p)
        drawn = ModalModel(t[:n], t[n : 2 * n], t[2 * n :].reshape(n, -1).T, DOFS, "unit_modal_mass", band_hz=BAND)
        moved = [e.with_values(**{k: e.values[k] + e.std[k] * rng.normal() for k in e.definition.names}) for e in effects]
        modes = Model(drawn, tuple(moved)).modes()
        hz.append(modes.frequencies_hz)
        zeta.append(modes.damping_ratios)
    for said, seen in ((stated.frequency_std_hz, np.std(hz, axis=0)), (stated.damping_ratio_std, np.std(zeta, axis=0))):
        # 150 draws know a standard deviation to 6 %; four of those.
        np.testing.assert_allclose(said / seen, 1, atol=0.25)

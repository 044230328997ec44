"""Scale of operational shapes against analytic truth."""

import json
from dataclasses import replace

import numpy as np
import pytest

from operando.data import ModalModel
from operando.errors import DataError, IdentificationError
from operando.scaling import METHODS, scale_operational
from operando.scaling.doubt import ScaleDoubt
from structures import Chain, modified


def models(chain, changed, keep=None, rng=None):
    dofs = tuple(f"{i}+Z" for i in range(1, len(chain.hz) + 1))
    keep = range(len(chain.hz)) if keep is None else keep
    idle = ModalModel(chain.hz, chain.zeta, chain.phi, dofs, "unit_modal_mass")
    factor = np.ones(len(keep)) if rng is None else rng.normal(size=len(keep)) + 1j * rng.normal(size=len(keep))
    operating = ModalModel(changed.hz[keep], changed.zeta[keep], changed.phi[:, keep] * factor, dofs)
    return idle, operating


@pytest.mark.parametrize("method", ["auto", *METHODS])
def test_nothing_changed_gives_the_idle_frf(method):
    chain = Chain(6)
    idle, operating = models(chain, chain, rng=np.random.default_rng(1))
    f = np.linspace(5, 150, 300)
    hybrid = scale_operational(idle, operating, method=method)
    # The expansion weighs shapes by an assumed noise: exact only to second order in it.
    tolerance = 1e-6 if hybrid.method.startswith("expansion") else 1e-10
    assert np.max(np.abs(hybrid.frf(f).data - chain.accelerance(f))) < tolerance * np.max(np.abs(chain.accelerance(f)))
    assert all(p.kind == "unchanged" for p in hybrid.pairing.pairs)


@pytest.mark.parametrize("method", ["eq13", "eq15", "eq20"])
def test_spring_is_exact_with_all_modes(method):
    chain = Chain(6)
    changed = modified(chain, spring=(2, 3e5))
    idle, operating = models(chain, changed, rng=np.random.default_rng(2))
    f = np.linspace(5, 150, 300)
    hybrid = scale_operational(idle, operating, threshold=1.0, method=method)
    exact = changed.accelerance(f)
    assert np.linalg.norm(hybrid.frf(f).data - exact) < 1e-9 * np.linalg.norm(exact)


@pytest.mark.parametrize("method", ["auto", *METHODS])
def test_arbitrary_scale_changes_nothing(method):
    rng = np.random.default_rng(3)
    chain = Chain(6)
    changed = modified(chain, spring=(2, 2e5))
    idle, operating = models(chain, changed, keep=[0, 1, 2, 3, 4])
    noisy = np.asarray(operating.shapes) + 0.02 * (rng.normal(size=(6, 5)) + 1j * rng.normal(size=(6, 5)))
    f = np.linspace(5, 150, 200)
    frfs = []
    for factor in (np.ones(5), 10.0 ** rng.uniform(-6, 6, 5) * np.exp(2j * np.pi * rng.uniform(size=5))):
        op = ModalModel(operating.frequencies_hz, operating.damping_ratios, noisy * factor, operating.dofs)
        frfs.append(scale_operational(idle, op, method=method).frf(f).data)
    assert np.max(np.abs(frfs[1] - frfs[0]) / np.abs(frfs[0])) < 1e-9


def test_idle_without_units_is_refused():
    chain = Chain(4)
    idle, operating = models(chain, chain)
    with pytest.raises(DataError, match="not scaled"):
        scale_operational(ModalModel(chain.hz, chain.zeta, chain.phi, idle.dofs), operating)


def test_condensed_methods_need_no_more_modes_than_dofs():
    """n > m: every method gives what it can, none gives shapes that are too large."""
    chain = Chain(8)
    changed = modified(chain, spring=(2, 1e5))
    dofs = ("1+Z", "3+Z", "5+Z", "8+Z")
    rows = [0, 2, 4, 7]
    idle = ModalModel(chain.hz, chain.zeta, chain.phi[rows], dofs, "unit_modal_mass")
    operating = ModalModel(changed.hz[:6], changed.zeta[:6], changed.phi[rows][:, :6] * 1j, dofs)
    hybrid = scale_operational(idle, operating)
    true = np.linalg.norm(changed.phi[rows][:, :6], axis=0)
    made = np.linalg.norm(hybrid.modal.shapes[:, :6], axis=0)
    assert np.max(np.abs(made / true - 1)) < 0.15
    assert hybrid.basis.modes.size <= 4
    strict = scale_operational(idle, operating, threshold=1.0)
    assert strict.alternatives["eq20"] is None
    assert "at most as many operational modes" in strict.evidence["refused"]["eq20"]
    with pytest.raises(IdentificationError, match="at most as many"):
        scale_operational(idle, operating, threshold=1.0, method="eq20")


def test_fewer_modes_than_dofs_reports_the_part_outside():
    chain = Chain(8)
    changed = modified(chain, spring=(2, 6e5))
    idle, operating = models(chain, changed, keep=[0, 1, 2])
    few = idle.select_modes([0, 1, 2])
    hybrid = scale_operational(few, operating)
    used = chain.phi[:, :3]
    for r in range(3):
        v = changed.phi[:, r]
        rest = v - used @ np.linalg.lstsq(used, v, rcond=None)[0]
        assert hybrid.outside_span[r] == pytest.approx(np.linalg.norm(rest) / np.linalg.norm(v), abs=1e-9)


def test_close_modes_stay_apart():
    chain = Chain(6, spread=0.0)
    chain.hz[2] = chain.hz[1] * 1.002
    idle, operating = models(chain, chain, rng=np.random.default_rng(5))
    assert scale_operational(idle, operating).pairing.partners.tolist() == list(range(6))


def noisy_pair(chain, changed, noise, seed, covariance=True):
    rng = np.random.default_rng(seed)
    idle, operating = models(chain, changed)
    m, n = operating.shapes.shape
    sd = noise * np.sqrt(np.mean(np.abs(operating.shapes) ** 2, axis=0)) / np.sqrt(2)
    shapes = operating.shapes + sd * (rng.normal(size=(m, n)) + 1j * rng.normal(size=(m, n)))
    loud = noise > 0
    hz = operating.frequencies_hz * (1 + 3e-4 * loud * rng.normal(size=n))
    zeta = operating.damping_ratios * (1 + 0.05 * loud * rng.normal(size=n))
    diag = np.concatenate([(3e-4 * hz) ** 2, (0.05 * zeta) ** 2, np.repeat(sd**2, m), np.repeat(sd**2, m)])
    return idle, ModalModel(hz, zeta, shapes, operating.dofs, covariance=np.diag(diag) if covariance and loud else None)


def frf_error_db(hybrid, changed, f):
    return float(np.sqrt(np.mean((20 * np.log10(np.abs(hybrid.frf(f).data) / np.abs(changed.accelerance(f)))) ** 2)))


def test_auto_sees_an_added_mass_and_scales_by_stiffness():
    chain = Chain(6)
    changed = modified(chain, mass=(2, 0.4))
    f = np.linspace(5, 150, 300)
    for noise in (0.01, 0.0):
        idle, operating = noisy_pair(chain, changed, noise, 0)
        hybrid = scale_operational(idle, operating)
        assert hybrid.method == "expansion_stiffness"
        assert any(x.kind == "mass_changed" for x in hybrid.findings)
    assert frf_error_db(hybrid, changed, f) < 0.5 * frf_error_db(scale_operational(idle, operating, method="eq13"), changed, f)


def test_auto_keeps_mass_for_a_spring_and_for_nothing():
    chain = Chain(6)
    for changed in (modified(chain, spring=(2, 3e5)), modified(chain, coupling=(1, 4, 1e5)), modified(chain)):
        for seed in range(3):
            hybrid = scale_operational(*noisy_pair(chain, changed, 0.01, seed))
            assert hybrid.method == "expansion"
            assert not [x for x in hybrid.findings if x.kind in ("mass_changed", "not_reciprocal")]
            assert "mass" in hybrid.reason


def test_noise_smaller_than_by_msf_when_nothing_changed():
    chain = Chain(6)
    f = np.linspace(5, 150, 300)
    auto, msf = [], []
    for seed in range(5):
        idle, operating = noisy_pair(chain, modified(chain), 0.03, seed)
        auto.append(frf_error_db(scale_operational(idle, operating), chain, f))
        msf.append(frf_error_db(scale_operational(idle, operating, method="msf_all"), chain, f))
    assert np.median(auto) < np.median(msf)


def test_residual_and_missing_modes_are_carried_over():
    chain = Chain(6)
    dofs = tuple(f"{i}+Z" for i in range(1, 7))
    residual = np.array([False] * 5 + [True])
    in_band = np.array([True] * 4 + [False] * 2)
    idle = ModalModel.from_terms(chain.hz, chain.zeta, chain.phi, dofs, "unit_modal_mass", residual=residual, in_band=in_band)
    operating = ModalModel(chain.hz[:3], chain.zeta[:3], chain.phi[:, :3] * 1j, dofs)
    hybrid = scale_operational(idle, operating)
    f = np.linspace(5, 150, 200)
    for model in (hybrid, *hybrid.alternative_models.values()):
        assert np.allclose(model.frf(f).data, chain.accelerance(f), rtol=1e-4, atol=1e-4)
    assert (hybrid.modal.n_modes, hybrid.modal.n_residuals) == (3, 3)
    assert "1 residual modes" in hybrid.residuals
    assert "1 idle modes beyond the band" in hybrid.residuals
    assert "1 idle modes in band without an operational mode" in hybrid.residuals
    assert f"{chain.hz[3]:.2f} Hz" in next(x.message for x in hybrid.findings if x.kind == "mode_not_found")


def test_alternatives_and_json():
    chain = Chain(6)
    hybrid = scale_operational(*noisy_pair(chain, modified(chain, spring=(2, 3e5)), 0.01, 0))
    out = json.loads(json.dumps(hybrid.to_dict(), allow_nan=False))
    assert set(out) == {"pairing", "scaling"}
    assert set(out["pairing"][0]) >= {"operating", "idle", "mac", "class", "scale", "scale_std"}
    assert set(out["scaling"]) >= {"method", "reason", "threshold", "kappa", "outside_span", "residuals", "alternatives"}
    low, high = hybrid.modal.frequencies_hz[:6].min() * 0.8, hybrid.modal.frequencies_hz[:6].max() * 1.1
    lines = np.linspace(low, high, 400)
    ratio = np.abs(hybrid.alternative_models["msf_all"].frf(lines).data) / np.abs(hybrid.frf(lines).data)
    assert out["scaling"]["alternatives"]["msf_all"] == pytest.approx(np.max(np.abs(20 * np.log10(ratio))))
    # The scale reproduces the shape it stands for, as far as one factor can.
    r = 0
    factor = complex(*out["pairing"][r]["scale"])
    assert np.real(hybrid.operating.shapes[:, r] * factor) == pytest.approx(hybrid.modal.shapes[:, r], rel=0.2, abs=0.05)


def test_variance_by_sampling(monkeypatch):
    """Linearised variance of every method against the scatter of 120 draws from both covariances.

    What the assumption of unchanged mass or stiffness leaves open scatters in no draw and is left out.
    """
    nothing = ScaleDoubt(np.zeros(5), np.zeros(5), 0.0, 0.0)
    monkeypatch.setattr("operando.scaling.hybrid.scale_doubt", lambda *arguments: nothing)
    chain = Chain(5)
    changed = modified(chain, spring=(2, 3e5))
    idle, operating = noisy_pair(chain, changed, 0.01, 1)
    spread = np.concatenate([1e-5 * idle.frequencies_hz, 1e-3 * idle.damping_ratios, 0.003 * np.abs(idle.shapes).T.ravel() + 1e-4])
    idle = replace(idle, covariance=np.diag(spread**2))
    f = np.linspace(5, 140, 40)
    rng = np.random.default_rng(7)
    draws = [scale_operational(*draw(idle, operating, rng)) for _ in range(120)]
    for method in METHODS:
        hybrid = scale_operational(idle, operating, method=method)
        models = [h.alternative_models[method] for h in draws]
        samples = np.array([m.frf(f, variance=False).data for m in models])
        scatter = np.sqrt(np.var(samples.real, axis=0) + np.var(samples.imag, axis=0))
        ratio = np.sqrt(hybrid.frf(f).variance) / scatter
        # The expansion's stated variance also holds what the prior shrinks, so it may be larger than the scatter.
        assert 0.88 < np.median(ratio) < (1.5 if method.startswith("expansion") else 1.12), method
        sizes = np.array([np.linalg.norm(m.shapes[:, :5], axis=0) for m in models])
        stated = hybrid.scale_std / (np.std(sizes, axis=0) / np.mean(sizes, axis=0))
        assert 0.85 < np.median(stated) < (1.5 if method.startswith("expansion") else 1.2), method


def test_a_class_that_may_flip_is_in_the_variance():
    """ε at the MAC of a mode: half of all draws scale it by the other rule, and their scatter shows it; far from ε none does."""
    chain = Chain(5)
    changed = modified(chain, spring=(2, 3e5))
    idle, operating = noisy_pair(chain, changed, 0.02, 1)
    mac = [p.mac for p in scale_operational(idle, operating).pairing.pairs]
    r = int(np.argmin(mac))
    rng = np.random.default_rng(3)
    idle = replace(idle, covariance=np.diag(np.full(idle.n_parameters, 1e-16)))
    draws = [draw(idle, operating, rng) for _ in range(80)]
    for threshold, flips in ((mac[r], True), (mac[r] + 0.2 * (1 - mac[r]), False)):
        hybrid = scale_operational(idle, operating, threshold, "eq13")
        sizes = [np.linalg.norm(scale_operational(*pair, threshold, "eq13").modal.shapes[:, r]) for pair in draws]
        scatter = np.sqrt(np.mean((np.array(sizes) / np.linalg.norm(hybrid.modal.shapes[:, r]) - 1) ** 2))
        assert 0.65 < hybrid.scale_std[r] / scatter < 1.5, (threshold, flips)


def draw(idle, operating, rng):
    n, m = 5, 5
    a = np.sqrt(np.diag(idle.covariance)) * rng.normal(size=idle.n_parameters)
    b = np.sqrt(np.diag(operating.covariance)) * rng.normal(size=operating.n_parameters)
    one = replace(idle, frequencies_hz=idle.frequencies_hz + a[:n], damping_ratios=idle.damping_ratios + a[n : 2 * n],
                  shapes=idle.shapes + a[2 * n :].reshape(n, m).T, covariance=None)  # fmt: skip
    parts = b[2 * n :].reshape(2, n, m)
    other = replace(operating, frequencies_hz=operating.frequencies_hz + b[:n], damping_ratios=operating.damping_ratios + b[n : 2 * n],
                    shapes=operating.shapes + parts[0].T + 1j * parts[1].T)  # fmt: skip
    return one, other


def test_one_missing_covariance_counts_as_exact_and_two_as_unknown():
    chain = Chain(5)
    changed = modified(chain, spring=(2, 3e5))
    idle, operating = noisy_pair(chain, changed, 0.01, 1)
    hybrid = scale_operational(idle, operating)
    assert np.all(hybrid.frf([20.0, 40.0]).variance > 0)
    idle, operating = noisy_pair(chain, changed, 0.01, 1, covariance=False)
    hybrid = scale_operational(idle, operating)
    assert hybrid.frf([20.0]).variance is None
    assert hybrid.scale_std is None
    assert all(row["scale_std"] is None for row in hybrid.to_dict()["pairing"])


def test_std_alone_is_enough():
    chain = Chain(5)
    idle, operating = noisy_pair(chain, modified(chain, spring=(2, 3e5)), 0.01, 1)
    diag = np.sqrt(np.diag(operating.covariance))
    std = {"frequencies_hz": diag[:5], "damping_ratios": diag[5:10], "shapes": operating.shape_std}
    only = replace(operating, covariance=None, std=std)
    one, other = scale_operational(idle, operating).frf([20.0, 50.0]), scale_operational(idle, only).frf([20.0, 50.0])
    assert other.variance == pytest.approx(one.variance, rel=1e-6)


@pytest.mark.parametrize("method", ["auto", *METHODS])
def test_methods_whose_interval_holds_noise_only_say_so(method):
    idle = ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1.0, 1.0], [1.0, -1.0]]), "1+Z, 2+Z", "unit_modal_mass")
    operating = ModalModel([21.0, 45.0], [0.01, 0.02], np.array([[2.0, 3.0], [2.0, -3.0]]), "1+Z, 2+Z")
    said = [f.kind for f in scale_operational(idle, operating, method=method).findings]
    assert ("noise_only_interval" in said) == (method in ("msf_all", "eq13", "eq15", "eq20", "idle_shapes"))
    assert method == "auto" or f"``{method}``" in scale_operational.__doc__

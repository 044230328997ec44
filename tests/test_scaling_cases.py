"""Scaling on the practice cases, from exact modes with noise of the size of an OMA; the FRFs are judged against the exact ones."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from operando.data import Frf, ModalModel
from operando.scaling import METHODS, scale_operational

ANSWERS = Path(__file__).resolve().parents[1].parent / "shared" / "cases" / "answers"
pytestmark = pytest.mark.skipif(not ANSWERS.is_dir(), reason="practice cases are not there (../shared/cases)")


def kernel(f, hz, zeta):
    w, wr = 2 * np.pi * f[None], 2 * np.pi * np.asarray(hz)[:, None]
    return -(w**2) / (wr**2 - w**2 + 2j * np.asarray(zeta)[:, None] * wr * w)


def without_effect(answer, h, f):
    """The exact idle FRF: the known effect taken off the exact operating FRF, line by line."""
    out = h.copy()
    for effect in answer["effects"]:
        rows = [answer["nodes"].index(int(d.split("+")[0])) for d in effect["location"]]
        value = effect["value"][0]
        for k, w in enumerate(2 * np.pi * f):
            change = np.zeros(h.shape[:2], complex)
            if effect["kind"] == "point_mass":
                change[rows[0], rows[0]] = -(w**2) * value
            elif effect["kind"] == "gyroscopic":
                change[rows[0], rows[1]], change[rows[1], rows[0]] = 1j * w * value, -1j * w * value
            else:
                b = np.zeros(h.shape[0])
                b[rows] = 1, -1
                change += value * np.outer(b, b)
            out[:, :, k] = -(w**2) * np.linalg.inv(np.linalg.inv(h[:, :, k] / -(w**2)) - change)
    return out


def operating_shapes(h, f, hz, zeta):
    """Complex shapes by least squares at the known poles, the rest as smooth terms."""
    wr = 2 * np.pi * np.asarray(hz)
    k = kernel(f, hz, zeta)
    extra = kernel(f, f[-1] * np.array([1.12, 1.2, 1.4, 2, 5]), np.full(5, 0.01))
    basis = np.vstack([k, k * 2j * np.pi * f / wr[:, None], extra]).T
    y = h.reshape(-1, f.size).T
    weight = 1 / np.sqrt(np.mean(np.abs(y) ** 2, axis=1))
    stack = lambda a: np.vstack([a.real, a.imag])  # noqa: E731
    x = np.linalg.lstsq(stack(basis * weight[:, None]), stack(y * weight[:, None]), rcond=None)[0]
    n = wr.size
    pole = -zeta + 1j * np.sqrt(1 - zeta**2)
    residues = (x[:n] + pole[:, None] * x[n : 2 * n]).reshape(n, *h.shape[:2])
    return np.array([np.linalg.svd(r)[0][:, 0] for r in residues]).T


@cache
def exact(name):
    answer = json.loads((ANSWERS / f"{name}.json").read_text())
    data = np.load(ANSWERS / f"{name}.npz")
    h, f = data["H"], data["f"]
    hz, zeta, phi = (np.array(answer[k]) for k in ("idle_hz", "idle_zeta", "idle_shapes"))
    dofs = tuple(f"{n}+Z" for n in answer["nodes"])
    # Static compliance of what lies beyond the 16 known modes, as pseudo-modes far above the band.
    known = np.einsum("ir,jr,rl->ijl", phi, phi, kernel(f, hz, zeta))
    rest = (without_effect(answer, h, f) - known).real
    w2 = (2 * np.pi * f) ** 2
    far = 4 * f[-1]
    scale = w2 / ((2 * np.pi * far) ** 2 - w2)
    static = -np.einsum("ijl,l->ij", rest, scale) / np.sum(scale**2)
    value, vector = np.linalg.eigh((static + static.T) / 2)
    pseudo = (vector * np.sqrt(np.maximum(value, 0)))[:, value > 0]
    n = 16 + pseudo.shape[1]
    idle = ModalModel.from_terms(
        np.r_[hz, np.full(n - 16, far)], np.r_[zeta, np.full(n - 16, 0.01)], np.c_[phi, pseudo], dofs, "unit_modal_mass",
        residual=np.arange(n) >= 16, in_band=np.arange(n) < 12, band_hz=(f[0], f[-1]),
    )  # fmt: skip
    poles = np.array(answer["operating_hz"])[:12], np.array(answer["operating_zeta"])[:12]
    return idle, operating_shapes(h, f, *poles), poles, Frf(h, f, dofs, dofs)


def case(name, seed, noise=0.015):
    idle, shapes, (hz, zeta), truth = exact(name)
    rng = np.random.default_rng(seed)
    sd = noise * np.sqrt(np.mean(np.abs(shapes) ** 2, axis=0)) / np.sqrt(2)
    noisy = shapes + sd * (rng.normal(size=shapes.shape) + 1j * rng.normal(size=shapes.shape))
    hz, zeta = hz * (1 + 3e-4 * rng.normal(size=12)), zeta * (1 + 0.05 * rng.normal(size=12))
    diag = np.concatenate([(3e-4 * hz) ** 2, (0.05 * zeta) ** 2, np.repeat(sd**2, 12), np.repeat(sd**2, 12)])
    return idle, ModalModel(hz, zeta, noisy * np.exp(2j * np.pi * rng.uniform(size=12)), idle.dofs, covariance=np.diag(diag)), truth


def error_db(model, truth):
    """The contract's error_db on every second line."""
    made = model.frf(truth.frequencies_hz[::2], variance=False).data
    return float(np.sqrt(np.mean((20 * np.log10(np.abs(made) / np.abs(truth.data[:, :, ::2]))) ** 2)))


@pytest.mark.parametrize(("name", "method"), [("p1", "expansion_stiffness"), ("p4", "expansion")])
@pytest.mark.parametrize("seed", [0, 1])
def test_auto_beats_idle_model_and_baselines(name, method, seed):
    idle, operating, truth = case(name, seed)
    hybrid = scale_operational(idle, operating)
    error = {k: error_db(m, truth) for k, m in hybrid.alternative_models.items()}
    ofrf, rest = error_db(hybrid.modal, truth), error_db(idle, truth)
    assert hybrid.method == method
    assert ofrf <= 0.8 * min(rest, error["idle_shapes"])
    assert ofrf <= error["msf_all"]
    assert ofrf <= min(v for k, v in error.items()) + 0.1
    assert not [f for f in hybrid.findings if f.kind == "not_reciprocal"]


def test_nothing_hidden_stays_nothing():
    idle, operating, truth = case("p5", 0)
    hybrid = scale_operational(idle, operating)
    assert {f.kind for f in hybrid.findings} == set()
    assert all(p.kind == "unchanged" for p in hybrid.pairing.pairs)
    assert error_db(hybrid.modal, truth) < error_db(hybrid.alternative_models["msf_all"], truth)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_gyroscopic_case_is_not_reciprocal(seed):
    idle, operating, _ = case("p3", seed)
    found = [f for f in scale_operational(idle, operating).findings if f.kind == "not_reciprocal"]
    assert len(found) == 1
    assert "it cannot be represented by a symmetric OFRF; only the effect route can" in found[0].consequence


@pytest.mark.parametrize("method", ["auto", *METHODS])
def test_complex_factors_change_no_line(method):
    idle, operating, truth = case("p1", 3)
    rng = np.random.default_rng(4)
    factor = 10.0 ** rng.uniform(-5, 5, 12) * np.exp(2j * np.pi * rng.uniform(size=12))
    n, m = 12, 12
    # The covariance of a shape turns with it.
    turn = np.kron(np.diag(factor), np.eye(m))
    jacobian = np.block([[turn.real, -turn.imag], [turn.imag, turn.real]])
    cov = np.array(operating.covariance)
    cov[2 * n :, 2 * n :] = jacobian @ cov[2 * n :, 2 * n :] @ jacobian.T
    other = ModalModel(operating.frequencies_hz, operating.damping_ratios, operating.shapes * factor, operating.dofs, covariance=cov)
    f = truth.frequencies_hz[::10]
    a, b = scale_operational(idle, operating, method=method), scale_operational(idle, other, method=method)
    one, two = a.frf(f), b.frf(f)
    assert np.max(np.abs(two.data - one.data) / np.abs(one.data)) < 1e-9
    assert np.allclose(two.variance, one.variance, rtol=1e-4)

"""The model that is handed out against the FRFs it was fitted to: a chain of masses with a damper to ground, by its own matrices.

The truth is (K + iωC − ω²M)⁻¹ at each line; nothing of the analysis is used to make it.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from operando import Frf, fit_ema
from operando.diagnosis import with_complex_modes
from operando.diagnosis.criteria import MOST_CHI_SQUARE, REST_DISCREPANCY
from operando.diagnosis.idle import Idle
from operando.diagnosis.posterior import at_rest
from operando.ema.discrepancy import STUDENT_FREEDOM, student_weights
from operando.ema.findings import NOTABLE_MISFIT, misfit_findings
from operando.ema.frf_noise import stated_covariance
from operando.ema.linear import FEW_PLACES, fit_linear
from operando.ema.pairs import frf_pairs, informative_lines
from operando.ema.projection import Poles
from operando.ema.unit_mass import _left_out
from operando.indicators import INTERVAL

DOFS = tuple(f"{i + 1}+Z" for i in range(5))
REFERENCES = (0, 3)
BAND = (15.0, 190.0)  # four modes; the fifth stands at 202 Hz
HZ = np.arange(10.0, 200.0, 0.1)
DAMPED = 1
"""Mass from which the damper goes to ground."""


def matrices(damper):
    """Mass, damping and stiffness of five masses between springs of 2 MN/m, 1 % in each mode, and a damper [N s/m]."""
    mass = np.diag(4.0 * (1 + 0.1 * np.arange(5)))
    stiff = 2e6 * (np.diag([2.0, 2.0, 2.0, 2.0, 1.0]) - np.eye(5, k=1) - np.eye(5, k=-1))
    root = np.sqrt(np.diag(mass))
    squares, vectors = np.linalg.eigh(stiff / np.outer(root, root))
    phi = vectors / root[:, None]
    damping = mass @ phi @ np.diag(0.02 * np.sqrt(squares)) @ phi.T @ mass
    damping[DAMPED, DAMPED] += damper
    return mass, damping, stiff


def exact(damper, hz):
    """Accelerance (5, references, lines)."""
    mass, damping, stiff = matrices(damper)
    w = 2 * np.pi * hz[:, None, None]
    receptance = np.linalg.inv(stiff + 1j * w * damping - w**2 * mass)
    return np.moveaxis(-(w**2) * receptance, 0, 2)[:, list(REFERENCES)]


def true_poles(damper):
    """Frequencies [Hz] and damping ratios of the complex modes."""
    mass, damping, stiff = matrices(damper)
    state = np.block([[np.zeros((5, 5)), np.eye(5)], [-np.linalg.solve(mass, stiff), -np.linalg.solve(mass, damping)]])
    poles = np.linalg.eigvals(state)
    poles = poles[poles.imag > 0]
    poles = poles[np.argsort(np.abs(poles))]
    return np.abs(poles) / 2 / np.pi, -poles.real / np.abs(poles)


def measured(damper, noise, seed=0):
    """FRFs with white noise of a share of the rms of each pair, and its variance."""
    h = exact(damper, HZ)
    std = noise * np.sqrt(np.mean(np.abs(h) ** 2, axis=2, keepdims=True)) * np.ones(h.shape)
    rng = np.random.default_rng(seed)
    h = h + std * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    return Frf(h, HZ, DOFS, tuple(DOFS[i] for i in REFERENCES), "accelerance", variance=std**2)


@cache
def fitted(damper, noise, ema="auto"):
    frf = measured(damper, noise)
    return frf, fit_ema(frf, band=BAND, ema=ema)


def left(model, frf):
    """Reduced chi-square of the FRFs that the model makes, over all lines and pairs in its band."""
    part = frf.band(*BAND)
    h = model.frf(part.frequencies_hz, part.responses, part.references, "accelerance").data
    return float(np.mean(np.abs(h - part.data) ** 2 / part.variance))


def misfits(model):
    return [f for f in model.findings if f.kind == "misfit"]


@pytest.mark.parametrize(
    ("damper", "noise"), [(0.0, 1e-3), (0.0, 1e-2), (30.0, 1e-3), (30.0, 1e-2), (100.0, 1e-3), (100.0, 1e-2), (400.0, 1e-3)]
)
def test_the_misfit_is_that_of_the_model_handed_out(damper, noise):
    frf, model = fitted(damper, noise)
    assert model.misfit == pytest.approx(left(model, frf), rel=0.05)
    assert model.details.free_misfit == pytest.approx(1.0, abs=0.05)
    by_dof = model.details.misfit_by_dof
    assert np.mean(by_dof) == pytest.approx(model.misfit, rel=0.1)


@pytest.mark.parametrize("noise", [1e-3, 1e-2])
@pytest.mark.parametrize("ema", ["auto", "linear"])
def test_a_model_as_good_as_its_fit_has_no_finding(noise, ema):
    _, model = fitted(0.0, noise, ema)
    assert 0.9 < model.misfit < 1 + 0.5 * (NOTABLE_MISFIT - 1)
    assert not model.findings


def test_no_finding_where_noise_hides_the_phase():
    """The damper ties the modes as before, and its part in the FRFs is below their noise."""
    _, model = fitted(30.0, 1e-2)
    assert 1.1 < model.misfit < NOTABLE_MISFIT
    assert not model.findings


@pytest.mark.parametrize(("damper", "noise"), [(30.0, 1e-3), (100.0, 1e-2), (400.0, 1e-3)])
def test_a_finding_says_that_real_shapes_do_not_describe_the_frfs(damper, noise):
    _, model = fitted(damper, noise)
    (found,) = misfits(model)
    assert found.severity == "warning"
    assert f"is {model.misfit:.3g}; the fit behind it" in found.message
    assert "real shapes do not describe them" in found.consequence
    assert "with_complex_modes" in found.action


@pytest.mark.parametrize(("damper", "noise"), [(30.0, 1e-3), (100.0, 1e-3), (100.0, 1e-2), (400.0, 1e-3), (400.0, 1e-2)])
def test_the_variance_of_the_frfs_holds_what_real_shapes_leave_out(damper, noise):
    """Sums over the band: peaks count most. Noise alone was 17 to 3400 times too small for them."""
    _, model = fitted(damper, noise)
    hz = measured(0.0, 1e-3).band(*BAND).frequencies_hz
    made = model.frf(hz, DOFS, [DOFS[i] for i in REFERENCES], "accelerance")
    error = np.abs(made.data - exact(damper, hz)) ** 2
    assert 0.5 < error.sum() / made.variance.sum() < 2
    assert 0.5 < np.median(error / made.variance) < 2


@pytest.mark.parametrize(("damper", "noise", "draws"), [(30.0, 1e-3, 1), (100.0, 1e-3, 1), (400.0, 1e-3, 1), (400.0, 1e-2, 4)])
def test_poles_are_those_of_the_complex_modes(damper, noise, draws):
    """Shapes alone are worse for being real: 95 % intervals of frequencies and damping ratios of the free fit hold the truth."""
    hz, zeta = (values[:4] for values in true_poles(damper))
    z = []
    for seed in range(draws):
        model = fit_ema(measured(damper, noise, seed), band=BAND)
        z += [(model.frequencies_hz[:4] - hz) / model.frequency_std_hz[:4], (model.damping_ratios[:4] - zeta) / model.damping_ratio_std[:4]]
        assert np.all(model.frequency_std_hz[:4] < 2e-4 * hz)
    assert np.mean(np.abs(z) < INTERVAL) >= 0.9
    assert np.max(np.abs(z)) < 4


def test_noise_of_phase_widens_no_shape():
    """Imaginary parts as large as noise makes them are no property of the mode; twenty times as large, they are all of its deviation."""
    rng = np.random.default_rng(0)
    variance = np.diag(rng.uniform(0.5, 2.0, 40) ** 2)
    added = [np.trace(_left_out(rng.standard_normal(40) * np.sqrt(np.diag(variance)), variance)) / np.trace(variance) for _ in range(200)]
    assert np.mean(added) < 0.15
    large = 20 * np.sqrt(np.diag(variance))
    np.testing.assert_allclose(_left_out(large, variance), (1 - 1 / 400) * np.outer(large, large), rtol=1e-12)
    assert not _left_out(np.zeros(40), variance).any()


def test_complex_modes_are_taken_where_the_misfit_says_so_and_the_error_is_small():
    """A damper of 30 N s/m leaves less than 1 % of the FRFs, which is 21 times their noise."""
    frf, model = fitted(30.0, 1e-3)
    assert model.misfit > MOST_CHI_SQUARE
    known = Idle.of(model, BAND, frf.references)
    assert at_rest(known, frf, BAND).state.alpha < REST_DISCREPANCY
    found = with_complex_modes(model, frf)
    assert found.coupling is not None
    assert found.misfit == pytest.approx(1.0, abs=0.2)
    assert left(found, frf) == pytest.approx(1.0, abs=0.1)
    assert not misfits(found)
    # on both sides of the limit
    asked = replace(model, misfit=0.99 * MOST_CHI_SQUARE)
    assert with_complex_modes(asked, frf) is asked


@pytest.mark.parametrize("noise", [1e-3, 1e-2])
def test_real_modes_stay_real_whatever_the_misfit(noise):
    """Fitted again, they have to earn ties: a misfit of another cause makes no complex modes."""
    frf, model = fitted(0.0, noise)
    asked = replace(model, misfit=100.0)
    assert with_complex_modes(asked, frf) is asked


def test_the_finding_names_what_the_model_goes_without():
    def one(misfit, free=1.0, **parts):
        (found,) = misfit_findings(misfit, free, {"shift": 0.0, "phase": 0.0, "shape": 0.0, "outside": 0.0} | parts)
        return found

    assert "real shapes" in one(2.0, phase=1.0).consequence
    assert "one shape of unit modal mass" in one(2.0, shape=1.0, phase=0.5).consequence
    assert "one frequency for all" in one(2.0, shift=1.0).consequence
    assert "outside the band" in one(2.0, outside=1.0).consequence
    assert not misfit_findings(0.99 * NOTABLE_MISFIT, 1.0, {"phase": 1.0})
    assert one(1.01 * NOTABLE_MISFIT, phase=1.0).kind == "misfit"
    # what the fit behind it leaves as well is no matter of real shapes
    assert "linearity" in one(4.0, free=3.0, phase=1.0).consequence
    assert not misfit_findings(float("nan"), float("nan"), {"phase": 1.0})


def test_wrong_gain_at_one_reference_is_told_from_complex_modes():
    """Sensors stay, and the force at one reference counts 10 % too much: residues contradict one scale, and are in phase."""
    frf = measured(0.0, 1e-3)
    data = frf.data.copy()
    data[:, 1] *= 1.1
    model = fit_ema(replace(frf, data=data), band=BAND, ema="linear")
    (found,) = misfits(model)
    assert "one shape of unit modal mass" in found.consequence
    assert model.misfit == pytest.approx(left(model, replace(frf, data=data)), rel=0.1)


def weighted_fit(columns, y, plain):
    """Least squares with Student weights to their end: coefficients, weights, what is left."""
    weight = np.ones(y.size)
    for _ in range(30):
        half = np.sqrt(weight / plain)[:, None]
        x = np.linalg.lstsq(half * columns, half[:, 0] * y, rcond=None)[0]
        squares = np.abs(y - columns @ x) ** 2
        weight = (STUDENT_FREEDOM + 2) / (STUDENT_FREEDOM + 2 * squares / plain)
    return x, weight, squares


@pytest.mark.parametrize("stated", [0.5, 0.734, 1.0])
def test_the_slope_of_student_weights_gives_the_scatter(stated):
    """Complex straight lines with Gaussian noise of variance 1, taken for ``stated``: as small as that where its size is fitted."""
    rng = np.random.default_rng(3)
    columns = np.stack([np.ones(60), np.linspace(-1, 1, 60)], axis=1) + 0j
    plain = np.full(60, stated)
    found, by_scores, by_slope = [], [], []
    for _ in range(400):
        y = (rng.standard_normal(60) + 1j * rng.standard_normal(60)) / np.sqrt(2)
        x, weight, squares = weighted_fit(columns, y, plain)
        weights, slope = student_weights(squares, plain)
        np.testing.assert_allclose(weights, weight, rtol=1e-12)
        inverse = np.linalg.inv((columns.T.real * weight / plain) @ columns.real)
        scores = (columns.T.real * weight**2 * squares / plain**2) @ columns.real
        found.append(x)
        by_scores.append(0.5 * np.diag(inverse @ scores @ inverse))
        by_slope.append(by_scores[-1] * (weights.mean() / slope.mean()) ** 2)
    scatter = np.mean(np.abs(found) ** 2, axis=0) / 2  # of real and imaginary part
    np.testing.assert_allclose(np.mean(by_slope, axis=0) / scatter, 1, atol=0.12)  # two standard deviations of 800 values, and 4 unknowns
    assert np.all(np.mean(by_scores, axis=0) < 0.75 * scatter)


@pytest.mark.parametrize("known", [True, False], ids=["variance known", "variance fitted"])
def test_damping_of_a_roving_test_scatters_as_stated(known):
    """26 points roved, one reference: from point to point errors count as they are seen, with the slope of their weights."""
    n, noise, hz_of = 26, 1e-2, np.arange(10.0, 200.0, 0.5)
    stiff = 5.4e7 * (2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))
    stiff[-1, -1] /= 2
    mass = 4.0 * (1 + 0.1 * np.arange(n))
    squares, vectors = np.linalg.eigh(stiff / np.sqrt(np.outer(mass, mass)))
    hz, phi = np.sqrt(squares) / 2 / np.pi, vectors / np.sqrt(mass)[:, None]
    w, s = 2 * np.pi * hz, 2j * np.pi * hz_of
    gain = s**2 / (s**2 + 0.02 * w[:, None] * s + (w**2)[:, None])
    exact_h = ((phi * phi[-1]) @ gain)[:, None]
    std = noise * np.sqrt(np.mean(np.abs(exact_h) ** 2, axis=2, keepdims=True)) * np.ones(exact_h.shape)
    dofs, inside = tuple(f"{i + 1}+Z" for i in range(n)), np.flatnonzero(hz < 204.0)
    assert n >= FEW_PLACES
    error, stated = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        h = exact_h + std * (rng.standard_normal(std.shape) + 1j * rng.standard_normal(std.shape)) / np.sqrt(2)
        frf = Frf(h, hz_of, dofs, dofs[-1:], "accelerance", variance=std**2 if known else None)
        pairs = frf_pairs(frf, frf.responses, (12.0, 199.5))
        pairs = pairs.lines(informative_lines(pairs.frequencies_hz, hz[inside], np.full(inside.size, 0.01)))
        fit = fit_linear(pairs, Poles(hz[inside], np.full(inside.size, 0.01)), (12.0, 199.5), rounds=8)
        error.append(np.log(fit.poles.zeta[:3] / 0.01))
        stated.append(np.diag(stated_covariance(fit))[inside.size : inside.size + 3])
    ratio = np.sqrt(np.mean(stated) / np.mean(np.square(error)))
    assert 0.85 < ratio < 1.15  # of 120 values: 1 ± 2 standard deviations; 0.83 and 0.76 before the slope of the weights counted

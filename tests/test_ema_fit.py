"""The maximum-likelihood fit against analytic chains: accuracy, honesty of the intervals, faults of the input."""

import os
from dataclasses import replace

import numpy as np
import pytest

from operando.data import Frf, TimeRecord
from operando.data.time import Channel
from operando.dof import Dof
from operando.ema import fit_ema
from operando.ema.normal import linearised, normal_equations, residual
from operando.ema.order import refine
from operando.ema.polish import polish, start_parameters
from operando.ema.polish_model import run_model, transfer
from operando.ema.spectra import excited_limits, noise_from_spectra, record_spectra
from operando.ema.start import outside_kernels
from operando.errors import DataError, IdentificationError
from operando.indicators import mac
from structures import Chain

FS = 512.0
HZ = np.array([22.0, 41.0, 63.0, 64.5, 90.0, 118.0])
DOFS = tuple(Dof.parse(f"{i}+Z") for i in range(1, 7))


def outside(*hz):
    """Poles of kernels outside the band."""
    return np.array(hz), np.full(len(hz), 0.01)


def plate_like():
    """Chain shapes with chosen frequencies: two of them 1.5 Hz apart."""
    chain = Chain(6, zeta=np.array([0.006, 0.004, 0.01, 0.008, 0.007, 0.009]), spread=0.4, seed=3)
    chain.hz = HZ.copy()
    return chain


def steady_record(chain, ref, rng, seconds=16.0, x_noise=0.01, f_noise=0.002, force=20.0):
    """A piece of a periodic steady state, four times as long: exact, non-periodic in the record, moving at its first sample."""
    n = int(seconds * FS)
    f = np.fft.rfftfreq(4 * n, 1 / FS)
    spectrum = rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size)
    spectrum[(f < 2) | (f > 215)] = 0
    h = chain.accelerance(np.maximum(f, 1e-9), ref=[ref])[:, 0]
    p = np.fft.irfft(spectrum)
    scale = force / p.std()
    p, x = p[n : 2 * n] * scale, np.fft.irfft(h * spectrum, axis=1)[:, n : 2 * n] * scale
    p = p + f_noise * p.std() * rng.standard_normal(n)
    x = x + x_noise * x.std(axis=1, keepdims=True) * rng.standard_normal(x.shape)
    channels = [Channel(DOFS[ref], "force", "N")] + [Channel(d, "acceleration", "m/s2") for d in DOFS]
    return TimeRecord(np.vstack([p[None], x]), FS, tuple(channels), name=f"run{ref}")


@pytest.fixture(scope="module")
def fitted():
    from operando.frf import estimate_frf

    chain = plate_like()
    rng = np.random.default_rng(5)
    records = [steady_record(chain, 0, rng), steady_record(chain, 3, rng)]
    frf = estimate_frf(records)
    return chain, records, frf, fit_ema(frf, band=(10, 140), records=records)


def proper(model):
    return model.select_modes(np.asarray(model.in_band))


def test_modes_and_intervals(fitted):
    chain, _, _, model = fitted
    modes = proper(model)
    assert modes.n_modes == 6
    assert np.max(np.abs(modes.frequencies_hz / chain.hz - 1)) < 5e-5
    assert np.max(np.abs(modes.damping_ratios / chain.zeta - 1)) < 0.01
    z = np.concatenate(
        [(modes.frequencies_hz - chain.hz) / modes.frequency_std_hz, (modes.damping_ratios - chain.zeta) / modes.damping_ratio_std]
    )
    assert np.sqrt(np.mean(z**2)) < 1.7
    assert 0.8 < model.misfit < 1.25
    assert model.scaling == "unit_modal_mass"


def test_modal_masses_and_undriven_columns(fitted):
    chain, _, _, model = fitted
    modes = proper(model)
    scale = np.sum(modes.shapes * chain.phi, axis=0) / np.sum(chain.phi**2, axis=0)
    assert np.max(np.abs(np.abs(scale) ** -2 - 1)) < 0.01
    f = np.linspace(15, 130, 300)
    h, exact = model.frf(f).data, chain.accelerance(f)
    error = np.linalg.norm(h - exact, axis=(0, 2)) / np.linalg.norm(exact, axis=(0, 2))
    assert error.max() < 0.03


def test_close_modes_are_separated(fitted):
    modes = proper(fitted[3])
    assert np.min(np.diff(modes.frequencies_hz)) == pytest.approx(1.5, abs=0.01)


def test_frfs_alone_give_the_same_modes(fitted):
    chain, _, frf, _ = fitted
    modes = proper(fit_ema(frf, band=(10, 140)))
    assert modes.n_modes == 6
    assert np.max(np.abs(modes.frequencies_hz / chain.hz - 1)) < 1e-3
    assert np.max(np.abs(modes.damping_ratios / chain.zeta - 1)) < 0.1


def test_selection_by_hand(fitted):
    _, records, frf, _ = fitted
    model = fit_ema(frf, band=(10, 100), records=records, reject_hz=[41.0])
    assert not np.any(np.abs(proper(model).frequencies_hz - 41) < 0.5)


def test_exponential_window_is_taken_off():
    """Under a window of rate β the FRF is H(iω + β): poles and numerator move."""
    chain = plate_like()
    f = np.arange(5, 140, 0.05)
    rate = 1.2
    s, w = 2j * np.pi * f + rate, 2 * np.pi * chain.hz[:, None]
    gain = s**2 / (s**2 + 2 * chain.zeta[:, None] * w * s + w**2)
    h = np.einsum("jr,kr,rl->jkl", chain.phi, chain.phi[[0, 3]], gain)
    rng = np.random.default_rng(0)
    h = h + 1e-3 * np.abs(h).mean() * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape))
    frf = Frf(h, f, DOFS, (DOFS[0], DOFS[3]), exponential_window_rate=rate)
    modes = proper(fit_ema(frf, band=(10, 135)))
    assert modes.n_modes == 6
    assert np.max(np.abs(modes.damping_ratios / chain.zeta - 1)) < 0.05


def test_inverted_force_is_turned_and_said(fitted):
    chain, records, frf, _ = fitted
    flipped = [replace(records[0], data=np.vstack([-records[0].data[:1], records[0].data[1:]])), records[1]]
    data = frf.data.copy()
    data[:, 0] *= -1
    model = fit_ema(replace(frf, data=data), band=(10, 140), records=flipped)
    found = [f for f in model.findings if f.kind == "drive_point_sign"]
    assert [f.dof for f in found] == ["1+Z"]
    modes = proper(model)
    scale = np.sum(modes.shapes * chain.phi, axis=0) / np.sum(chain.phi**2, axis=0)
    assert np.max(np.abs(np.abs(scale) ** -2 - 1)) < 0.01


def test_without_units_or_drive_point_nothing_is_scaled(fitted):
    chain, _, frf, _ = fitted
    no_units = fit_ema(replace(frf, si=False), band=(10, 140))
    assert no_units.scaling == "unscaled"
    assert any(f.kind == "missing_unit" for f in no_units.findings)
    no_drive = fit_ema(frf.select(responses=["2+Z", "3+Z", "5+Z", "6+Z"]), band=(10, 140), ema="polished")
    assert no_drive.scaling == "unscaled"
    assert no_drive.details.answer == "polished"
    assert [str(d) for d in no_drive.dofs] == ["2+Z", "3+Z", "5+Z", "6+Z"]
    assert np.min(np.max(mac(no_drive.shapes, chain.phi[[1, 2, 4, 5]]), axis=0)) > 0.9999
    assert any(f.kind == "missing_drive_point" for f in no_drive.findings)
    with pytest.raises(DataError, match="arbitrary scale"):
        no_drive.frf([20.0])


def test_roving_hammer(fitted):
    chain, _, frf, _ = fitted
    full = Frf(chain.accelerance(frf.frequencies_hz), frf.axis, DOFS, DOFS)
    rng = np.random.default_rng(1)
    noise = 2e-3 * np.abs(full.data).mean() * (rng.standard_normal(full.data.shape) + 1j * rng.standard_normal(full.data.shape))
    row = replace(full, data=full.data + noise).select(responses=["1+Z", "4+Z"])
    modes = proper(fit_ema(row, band=(10, 140)))
    assert modes.n_modes == 6
    order = [modes.dofs.index(d) for d in DOFS]
    scale = np.sum(modes.shapes[order] * chain.phi, axis=0)
    assert np.max(np.abs(np.abs(scale) / np.sum(chain.phi**2, axis=0) - 1)) < 0.02


def test_input_errors(fitted):
    _, records, frf, _ = fitted
    with pytest.raises(DataError, match="reversed"):
        fit_ema(frf, band=(50, 20))
    with pytest.raises(IdentificationError):
        fit_ema(frf.band(200, 200.5), band=(200, 200.5))
    silent = replace(records[0], channels=tuple(replace(c, quantity="acceleration", unit="m/s2") for c in records[0].channels))
    with pytest.raises(DataError, match="no force channel"):
        fit_ema(frf, band=(10, 140), records=[silent])


def test_noise_estimate_without_a_model(fitted):
    _, records, _, _ = fitted
    ratios = []
    for record in [*records, *(steady_record(plate_like(), 0, np.random.default_rng(seed), seconds=32.0) for seed in range(4))]:
        run = record_spectra(record, DOFS, (10, 140))
        n = record.n_samples
        # The noise put in, from the clean rms (noise adds 1e-4 of power).
        expected_x = n * (0.01 * record.data[1:].std(axis=1)) ** 2
        expected_f = n * (0.002 * record.data[0].std()) ** 2
        assert np.median(run.response_variance / expected_x[:, None]) == pytest.approx(1, abs=0.15)
        ratios.append(run.force_variance[0, 0] / expected_f)
    assert np.median(ratios) == pytest.approx(1, abs=0.3)
    low, high = excited_limits(record, (10, 140))
    assert high == pytest.approx(215, abs=6)
    assert low < 0.6 * 10  # below all that the fit uses
    few = noise_from_spectra(run.frequencies_hz[:20], run.responses[:, :20], run.forces[:, :20])
    assert np.all(few[0] > 0)


def test_gradient_is_that_of_the_cost(fitted):
    """Re(JᴴC⁻¹e) with the cleaned force is minus half the gradient of the cost at fixed weights' force direction."""
    chain, records, _, _ = fitted
    run = record_spectra(records[0], DOFS, (15, 130))
    run = replace(run, force_variance=np.zeros_like(run.force_variance))
    rng = np.random.default_rng(2)
    theta = start_parameters(
        [run], chain.hz * 1.0005, chain.zeta * 1.05, chain.phi * (1 + 0.01 * rng.standard_normal((6, 6))), outside(150.0, 300.0)
    )
    gradient = normal_equations(run, theta, 0)[1]
    n, m = 6, 6
    base = residual(run, theta, 0).cost
    for index in [1, n + 2, 2 * n + 3 * m + 4, 2 * n + 1 * m + 0]:
        eps = 1e-6
        hz, zeta, shapes = theta.hz.copy(), theta.zeta.copy(), theta.shapes.copy()
        if index < n:
            hz[index] *= np.exp(eps)
        elif index < 2 * n:
            zeta[index - n] *= np.exp(eps)
        else:
            mode, row = divmod(index - 2 * n, m)
            shapes[row, mode] += eps
        up = residual(run, replace(theta, hz=hz, zeta=zeta, shapes=shapes), 0).cost
        assert (up - base) / eps == pytest.approx(-2 * gradient[index], rel=2e-3, abs=1e-4 * abs(base))


def test_normal_equations_are_those_of_the_whole_noise_covariance(fitted, monkeypatch):
    """Re(JᴴC⁻¹J) for shape values, C = D + hσ²hᴴ line by line; the same where few lines are taken at a time."""
    chain, records, _, _ = fitted
    run = record_spectra(records[0], DOFS, (15, 130))
    run = run.lines(np.arange(run.frequencies_hz.size) % 7 == 0)
    theta = start_parameters([run], chain.hz, chain.zeta, chain.phi, outside(150.0, 300.0))
    state = residual(run, theta, 0)
    normal = normal_equations(run, theta, 0, state)[0]
    model = run_model(run, theta, 0, state.clean_force)
    h = transfer(run, theta, 0, run_model(run, theta, 0, run.forces))[0]
    n, m, mode, rows = 6, 6, 3, run.response_rows
    other = [i for i, row in enumerate(rows) if row != run.force_rows[0]][:2]  # shape values that move one response alone
    expected = np.zeros((2, 2))
    for line in range(run.frequencies_hz.size):
        noise = np.diag(run.response_variance[:, line]) + run.force_variance[0, line] * np.outer(h[:, line], h[:, line].conj())
        slopes = np.zeros((rows.size, 2), complex)
        slopes[other, [0, 1]] = model.modal[mode, line]
        expected += (slopes.conj().T @ np.linalg.solve(noise, slopes)).real
    at = 2 * n + mode * m + rows[other]
    np.testing.assert_allclose(normal[np.ix_(at, at)], expected, rtol=1e-6)
    assert abs(expected[0, 1]) > 1e-3 * expected[0, 0]  # through the noise of the force
    monkeypatch.setattr("operando.ema.normal._COMMON_VALUES", 1)
    np.testing.assert_allclose(normal_equations(run, theta, 0, state)[0], normal, rtol=1e-9, atol=1e-12 * np.abs(normal).max())


def test_a_normal_matrix_serves_for_more_than_one_step(fitted, monkeypatch):
    """REUSED, NEAR and SAME: few matrices are made; modes and deviations are those of a fit that makes one for each step and at its end."""
    from operando.ema import polish as module

    chain, records, _, _ = fitted
    runs = [record_spectra(record, DOFS, (15, 130)) for record in records]
    start = start_parameters(runs, HZ * 1.0003, np.full(HZ.size, 0.008), 0.9 * chain.phi, outside(150.0, 300.0))
    made = []
    monkeypatch.setattr(module, "linearised", lambda *given: made.append(1) or linearised(*given))
    fit = polish(runs, start)
    few, lines = len(made), [np.arange(run.frequencies_hz.size) % 3 == 0 for run in runs]
    monkeypatch.setattr(module, "REUSED", 0.0)
    polish(runs, start)
    assert few < len(made) - few
    monkeypatch.setattr(module, "SAME", 0.0)
    exact = polish(runs, start, tolerance=1e-6, apart=lines)
    assert fit.converged
    assert exact.converged
    std, moved = (np.sqrt(np.diag(f.covariance)) for f in (exact, fit))
    values = [np.r_[np.log(f.parameters.hz), np.log(f.parameters.zeta), f.parameters.shapes.T.ravel()] for f in (exact, fit)]
    assert np.max(np.abs(values[1] - values[0]) / std) < 2e-3
    np.testing.assert_allclose(moved, std, rtol=1.2e-3)
    assert fit.cost - exact.cost < 1e-5  # far below the tolerance of 0.05
    kept = [run.lines(~part) for run, part in zip(runs, lines, strict=True)]
    alone = linearised(kept, exact.parameters, [residual(run, exact.parameters, i) for i, run in enumerate(kept)])[0].normal
    assert np.max(np.abs(exact.without.normal - alone) / np.sqrt(np.outer(np.diag(alone), np.diag(alone)))) < 1e-5
    known = polish(kept, exact.parameters, known=exact.without)
    fresh = polish(kept, exact.parameters, tolerance=1e-6)
    assert (known.iterations, known.converged) == (0, True)
    assert abs(known.cost - fresh.cost) < 1e-5
    assert known.cost < sum(residual(run, exact.parameters, i).cost for i, run in enumerate(kept)) - 1


def test_modes_added_to_a_fit_keep_what_it_has(fitted):
    """From the fitted modes and new ones in between, the fit with more modes ends no worse, and finds the mode that was left out."""
    from operando.ema.order import _grown, refine

    chain, records, _, _ = fitted
    runs = [record_spectra(record, DOFS, (15, 130)) for record in records]
    left_out = int(np.argsort(chain.hz)[2])
    keep = [r for r in np.argsort(chain.hz) if r != left_out]
    fit = refine(runs, 6, chain.hz[keep], chain.zeta[keep], lower=False)
    start = _grown(runs, 6, fit.parameters, [(float(chain.hz[left_out]) * 1.001, 0.01)])
    assert np.all(np.diff(start.hz) > 0)
    assert start.hz.size == 6
    old = ~np.isclose(start.hz, chain.hz[left_out] * 1.001)
    assert np.array_equal(start.shapes[:, old], fit.parameters.shapes)
    assert all(t.shape == (2, 6) for t in start.transients)
    more = refine(runs, 6, start.hz, start.zeta, lower=False, start=start)
    assert more.cost < 0.2 * fit.cost
    assert np.abs(more.parameters.hz - chain.hz[left_out]).min() < 1e-3 * chain.hz[left_out]


def test_second_opinion_beside_it(fitted):
    os.environ.setdefault("MPLBACKEND", "Agg")
    _, _, frf, _ = fitted
    model = fit_ema(frf.band(5, 150), band=(10, 140), second_opinion=True)
    assert len(model.details.second_opinion) >= 2 * 6
    assert any(o["agrees"] for o in model.details.second_opinion)


def test_a_fit_that_cannot_reach_what_is_needed_is_given_up():
    """``needed_cost``: the steps that are left must reach it at the pace of the last one; what can reach it is the same fit."""
    chain, rng = plate_like(), np.random.default_rng(5)
    runs = [record_spectra(steady_record(chain, 0, rng), DOFS, (15, 130))]
    start = start_parameters(runs, HZ * 1.002, np.full(HZ.size, 0.02), 0.3 * chain.phi, outside(150.0))
    steps = []
    whole = polish(runs, start, tolerance=1e-3, progress=steps.append)
    assert whole.converged
    reached, of_all = polish(runs, start, tolerance=1e-3, needed_cost=1.01 * whole.cost), len(steps)
    assert (reached.cost, reached.iterations) == (whole.cost, whole.iterations)
    lost = polish(runs, start, tolerance=1e-3, needed_cost=0.5 * whole.cost, progress=steps.append)
    assert not lost.converged
    assert len(steps) - of_all < of_all


@pytest.mark.parametrize(("share", "force_noise"), [(3, 0.01), (6, 0.002)])
def test_a_fit_reaches_its_end_from_no_terms_for_what_lies_outside(share, force_noise):
    """A strong mode 8 % above the lines: full steps of the local terms ended the fit at 70 and 1500 times the noise."""
    chain = plate_like()
    top = int(np.argmax(chain.hz))
    chain.phi[:, top] *= share
    rng = np.random.default_rng(1)
    records = [steady_record(chain, row, rng, x_noise=0.001, f_noise=force_noise) for row in (0, 3)]
    runs = [record_spectra(record, DOFS, (15, 0.93 * chain.hz[top])) for record in records]
    hz, zeta, shapes = np.delete(chain.hz, top), np.delete(chain.zeta, top), np.delete(chain.phi, top, axis=1)
    fit = polish(runs, start_parameters(runs, hz, zeta, shapes, outside_kernels(runs, hz, False)))
    assert fit.converged
    assert fit.cost / fit.n_data < 1


def test_a_fit_that_ends_before_its_minimum_is_said(fitted, monkeypatch):
    from operando.ema import polished

    _, records, frf, model = fitted
    assert "not_converged" not in {f.kind for f in model.findings}
    final = polished._final
    monkeypatch.setattr(polished, "_final", lambda *a: replace(final(*a), converged=False, iterations=25))
    [finding] = [f for f in fit_ema(frf, band=(10, 140), records=records).findings if f.kind == "not_converged"]
    assert "after 25 steps" in finding.message


def test_kernels_below_the_band_are_asked_for_where_a_mode_lies_there():
    """They start without a share in the fit that is known, which they leave as it is; one mode below the lines is told by them."""
    from operando.ema.polished import _needs_lower, _with_lower

    chain, rng = plate_like(), np.random.default_rng(5)
    records = [steady_record(chain, 0, rng), steady_record(chain, 3, rng)]
    rank = np.argsort(chain.hz)
    hz, zeta = chain.hz[rank], chain.zeta[rank]
    runs = [record_spectra(record, DOFS, (15, 130)) for record in records]
    assert not _needs_lower(runs, 6, hz, zeta, None)[0]
    above = [record_spectra(record, DOFS, (35, 130)) for record in records]
    lower, share, theta = _needs_lower(above, 6, hz[1:], zeta[1:], None)
    assert lower
    assert share == 0
    np.testing.assert_allclose(theta.hz, hz[1:], rtol=2e-3)
    run = replace(above[0], forces=above[0].forces * [[1.0], [0.5]], force_rows=np.array([0, 3]))
    run = replace(run, force_variance=np.repeat(run.force_variance, 2, axis=0))
    without = start_parameters([run], hz, zeta, chain.phi[:, rank], outside(150.0, 200.0, 300.0))
    without = replace(without, local=(rng.standard_normal(without.local[0].shape),))
    costs = [residual(run, theta, 0).cost for theta in (without, _with_lower([run], without))]
    np.testing.assert_allclose(costs[1], costs[0], rtol=1e-12)


def test_a_response_without_a_number_is_left_out_and_the_rest_is_fitted():
    chain = Chain(5)
    dofs, f = tuple(f"{i}+Z" for i in range(1, 6)), np.arange(10.0, 160.0, 0.2)
    data = chain.accelerance(f)[:, :2].copy()
    data += 1e-3 * np.sqrt(np.mean(np.abs(data) ** 2)) * (np.random.default_rng(1).normal(size=(*data.shape, 2)) @ [1, 1j])
    broken = data.copy()
    broken[2] = np.nan
    model = fit_ema(Frf(broken, f, dofs, dofs[:2], si=True), band=(12, 155))
    assert [str(d) for d in model.dofs] == ["1+Z", "2+Z", "4+Z", "5+Z"]
    assert model.scaling == "unit_modal_mass"
    [finding] = [x for x in model.findings if x.kind == "nan"]
    assert (finding.dof, finding.severity) == ("3+Z", "warning")
    without = fit_ema(Frf(data, f, dofs, dofs[:2], si=True).select([d for d in dofs if d != "3+Z"]), band=(12, 155))
    np.testing.assert_allclose(model.frequencies_hz, without.frequencies_hz, rtol=1e-12)
    with pytest.raises(DataError, match="no value of the FRFs is a number"):
        fit_ema(Frf(np.full_like(data, np.nan), f, dofs, dofs[:2], si=True), band=(12, 155))


def test_the_scale_of_a_mode_that_the_reference_hardly_moves():
    """LEAST_RESIDUE: its drive residues scatter as their deviations say, and fits from wrong scales end at one minimum."""
    chain, weak = plate_like(), 4
    chain.phi[0, weak] = 0.04 * np.abs(chain.phi[:, weak]).max()
    z = []
    for seed in range(16):
        run = record_spectra(steady_record(chain, 0, np.random.default_rng(100 + seed), x_noise=0.02), DOFS, (15, 130))
        costs = []
        for factor in (0.05, 1.0, -3.0):  # of the wrong size and, together with the other DOFs, of the wrong sense
            shapes = chain.phi.copy()
            shapes[0, weak] *= factor
            start = start_parameters([run], chain.hz, chain.zeta, shapes, outside(150.0, 300.0))
            fit = polish([run], start, tolerance=1e-3)
            assert fit.converged
            costs.append(fit.cost)
        assert np.ptp(costs) < 0.02
        value = fit.parameters.shapes[0, weak]
        std = np.sqrt(fit.covariance[2 * HZ.size + weak * 6, 2 * HZ.size + weak * 6])
        z.append((value**2 - chain.phi[0, weak] ** 2) / (2 * abs(value) * std))
    assert 0.45 < np.sqrt(np.mean(np.square(z))) < 1.4  # a variance stays whole beside the common error: rather too wide
    assert abs(np.mean(z)) < 0.6


def test_a_start_whose_drive_residue_is_noise_has_the_products_right():
    """LEAST_DRIVE: a drive residue of the wrong sense gives the scale its magnitude, the least share of the largest one at least."""
    from operando.ema.start import LEAST_DRIVE, rank_one

    chain = plate_like()
    run = record_spectra(steady_record(chain, 0, np.random.default_rng(0)), DOFS, (15, 130))
    for drive, scale in ((-0.02, 0.02), (1e-9, 3.0 * LEAST_DRIVE)):
        residues = np.array([[drive, 1.0, -2.0, 3.0, 0.5, 0.1]])[..., None]
        shapes, seen = rank_one([run], [residues], 6)
        assert not seen[0] or drive > 0
        np.testing.assert_allclose(shapes[0, 0] * shapes[1:, 0], residues[0, 1:, 0])
        np.testing.assert_allclose(shapes[0, 0] ** 2, scale)


def test_modes_above_the_lines_are_described_by_fixed_kernels():
    """DAMPED_FACTORS, MORE_DAMPING: to 0.3 % of what modes 4 to 20 % above the lines, of any damping, add there."""
    from operando.ema.start import outside_kernels
    from operando.synthesis import modal_kernel

    run = record_spectra(steady_record(plate_like(), 0, np.random.default_rng(0)), DOFS, (15, 130))
    f = run.frequencies_hz
    kernels = modal_kernel(f, *outside_kernels([run], np.array([90.0]), False), "accelerance")
    for above in (1.04, 1.06, 1.1, 1.15, 1.2):
        for zeta in (0.003, 0.007, 0.02):
            mode = modal_kernel(f, np.array([above * f[-1]]), np.array([zeta]), "accelerance")[0]
            left = mode.view(float) - np.linalg.lstsq(kernels.view(float).T, mode.view(float), rcond=None)[0] @ kernels.view(float)
            assert np.linalg.norm(left) < 3e-3 * np.linalg.norm(mode.view(float))


def test_a_suspension_below_the_lines_is_described_by_fixed_kernels():
    """LOWER_FACTORS, DAMPED_LOWER, LOWER_DAMPING: to 0.5 % of what one at a tenth to four tenths of the lowest line adds."""
    from operando.ema.polish_model import OUTSIDE_DAMPING
    from operando.ema.start import DAMPED_LOWER, LOWER_DAMPING, LOWER_FACTORS
    from operando.synthesis import modal_kernel

    f = np.linspace(10.0, 100.0, 300)
    zeta = np.repeat([OUTSIDE_DAMPING, LOWER_DAMPING], [len(LOWER_FACTORS), len(DAMPED_LOWER)])
    kernels = modal_kernel(f, f[0] * np.array([*LOWER_FACTORS, *DAMPED_LOWER]), zeta, "accelerance").view(float)
    for below in (0.1, 0.2, 0.3, 0.4):
        for damping in (0.01, 0.03, 0.1):
            mode = modal_kernel(f, np.array([below * f[0]]), np.array([damping]), "accelerance")[0].view(float)
            left = mode - np.linalg.lstsq(kernels.T, mode, rcond=None)[0] @ kernels
            assert np.linalg.norm(left) < 5e-3 * np.linalg.norm(mode)


def test_the_fit_ends_between_modes():
    """WIDER, VALLEY: not on the flank of a mode beyond its lines, nor at an antiresonance."""
    from operando.ema.polished import WIDER, between_modes

    chain, f = plate_like(), np.arange(5.0, 200.0, 0.1)
    chain.hz[-2:] = 124.0, 141.0
    frf = Frf(chain.accelerance(f, ref=[0]), f, DOFS, DOFS[:1])
    assert 129 < between_modes(frf, WIDER[0] * 93.0, WIDER[1] * 93.0) < 137
    assert between_modes(frf, 250.0, 300.0) == 300.0


def test_poles_at_the_end_of_the_lines_are_held_in_the_last_fit(fitted, monkeypatch):
    """BEYOND: all others are fitted."""
    from operando.ema import polished as module
    from operando.ema.order import OrderLog

    chain, records, _, _ = fitted
    runs = [record_spectra(record, DOFS, (15, 119)) for record in records]
    rank = np.argsort(chain.hz)
    fit = refine(runs, 6, chain.hz[rank], chain.zeta[rank], lower=False, max_iterations=2)
    held = []
    monkeypatch.setattr(module, "refine", lambda *given, **how: held.append(how["hold_poles"]) or refine(*given, **how))
    log = OrderLog()
    final = module._final(runs, 6, fit, False, log, None)
    assert [list(h) for h in held] == [[False] * 5 + [True]]
    reach = fit.parameters.hz * (1 + module.BEYOND * fit.parameters.zeta)
    assert list(reach > runs[0].top_hz) == list(held[0])
    assert final.parameters.hz[-1] == fit.parameters.hz[-1]
    assert final.parameters.zeta[-1] == fit.parameters.zeta[-1]
    assert np.all(final.parameters.hz[:-1] != fit.parameters.hz[:-1])
    assert f"held ({final.parameters.hz[-1]:.4g} Hz)" in log.rounds[-1]


def test_a_pole_that_is_held_takes_nothing_from_the_rest(fitted):
    """All others move and keep their standard deviations: a mode that the data tell little of lost both once."""
    chain, records, _, _ = fitted
    runs = [record_spectra(record, DOFS, (15, 119)) for record in records]
    rank = np.argsort(chain.hz)
    start = refine(runs, 6, chain.hz[rank], chain.zeta[rank], lower=False, max_iterations=4).parameters
    # shapes in units in which a standard deviation is a large number
    runs = [replace(r, forces=r.forces * 1e-8, force_variance=r.force_variance * 1e-16) for r in runs]
    transients, local = tuple(1e-4 * t for t in start.transients), tuple(1e8 * x for x in start.local)
    start = replace(start, shapes=start.shapes * 1e4, transients=transients, local=local)
    last = np.arange(6) == 5
    free, held = (polish(runs, start, hold_poles=hold, max_iterations=8) for hold in (False, last))
    others = np.concatenate([~last, ~last, np.repeat(~last, 6)])
    ratio = np.sqrt(np.diag(held.covariance)[others] / np.diag(free.covariance)[others])
    assert np.all((ratio > 0.3) & (ratio < 1.001))
    assert np.all(np.diag(held.covariance)[[5, 11]] == 0)
    assert held.parameters.hz[5] == start.hz[5]
    assert np.all(held.parameters.zeta[:5] != start.zeta[:5])
    assert np.all(held.parameters.shapes != start.shapes)


def test_frfs_alone_know_no_more_than_the_records_behind_them():
    """Lines of a local rational estimate share data, the noise of the force is common to a column: rms z was 2 to 3, modes too many."""
    from operando.frf import estimate_frf

    chain, z = plate_like(), []
    for seed in range(4):
        rng = np.random.default_rng([11, seed])
        model = fit_ema(estimate_frf([steady_record(chain, ref, rng) for ref in (0, 3)], estimator="lrm"), band=(10, 140), ema="polished")
        modes = proper(model)
        assert modes.n_modes == 6
        z += [(modes.frequencies_hz - chain.hz) / modes.frequency_std_hz, (modes.damping_ratios - chain.zeta) / modes.damping_ratio_std]
    assert 0.45 < np.sqrt(np.mean(np.square(z))) < 1.4  # a variance stays whole beside the common error: rather too wide


def test_the_common_error_of_a_column_and_lines_that_count_as_one_are_found():
    from operando.ema.frf_noise import _common_share, frf_noise
    from operando.ema.linear import fit_linear
    from operando.ema.pairs import frf_pairs
    from operando.ema.projection import Poles

    chain, rng, f = plate_like(), np.random.default_rng(3), np.arange(10.0, 150.0, 0.1)
    h = chain.accelerance(f, ref=[0])[:, 0]

    def noise(*shape):
        return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)

    own, share = 1e-3 * np.sqrt(np.mean(np.abs(h) ** 2)), 1e-5
    variance = np.full(h.shape, own**2)
    assert _common_share(own * noise(*h.shape), h, variance) == pytest.approx(0, abs=0.03 * share)
    assert _common_share(own * noise(*h.shape) + np.sqrt(share) * h * noise(f.size), h, variance) == pytest.approx(share, rel=0.15)
    rough = own * noise(*h.shape)
    smooth = sum(np.roll(rough, k, axis=1) for k in range(5)) / np.sqrt(5)  # triangle over nine lines: 1 + 2·(4 + 3 + 2 + 1)/5
    frf = Frf((h + smooth)[:, None], f, DOFS, DOFS[:1], variance=variance[:, None])
    pairs = frf_pairs(frf, DOFS, (10.0, 150.0))
    found = frf_noise(pairs, fit_linear(pairs, Poles(chain.hz, chain.zeta), (10.0, 150.0)))
    assert found.correlated_lines == pytest.approx(5, rel=0.25)
    assert found.common[0] < 0.1 * share


def test_damping_by_the_linear_stage_is_as_certain_as_stated():
    """Lines that share data, an error that all FRFs of a force have: by independent lines it was stated 1.4 to 2.9 times too certain."""
    from operando.ema.frf_noise import frf_noise, stated_covariance
    from operando.ema.linear import fit_linear
    from operando.ema.pairs import frf_pairs, informative_lines
    from operando.ema.projection import Poles

    chain, f, z = plate_like(), np.arange(10.0, 150.0, 0.05), []
    h = chain.accelerance(f, ref=[0])[:, 0]

    def noise(rng, *shape):
        rough = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)
        return sum(np.roll(rough, k, axis=-1) for k in range(9)) / 3  # triangle over 17 lines: nine count as one

    own, share = 3e-4 * np.sqrt(np.mean(np.abs(h) ** 2)), 1e-6
    for seed in range(12):
        rng = np.random.default_rng([5, seed])
        data = h * (1 + np.sqrt(share) * noise(rng, f.size)) + own * noise(rng, *h.shape)
        pairs = frf_pairs(Frf(data[:, None], f, DOFS, DOFS[:1], variance=np.full(h.shape, own**2)[:, None]), DOFS, (10.0, 150.0))
        lines = informative_lines(f, chain.hz, chain.zeta)
        fit = fit_linear(pairs.lines(lines), Poles(chain.hz, chain.zeta), (10.0, 150.0))
        std = np.sqrt(np.diag(stated_covariance(replace(fit, noise=frf_noise(pairs, fit)))))[fit.n_modes :]
        z.append(np.log(fit.poles.zeta / chain.zeta) / std)
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.2


def test_the_normal_matrix_of_an_frf_column_holds_its_common_error(fitted):
    """With the functions of an FRF column used once, a matrix of other forces was subtracted from: no Cholesky factor, no fit."""
    from operando.ema.spectra import FrfNoise, frf_spectra

    chain, _, frf, _ = fitted
    run = frf_spectra(frf, DOFS, (15, 130), FrfNoise(1.0, {0: 1e-3}))[0]
    assert np.all(run.force_variance == 1e-3)
    theta = start_parameters([run], chain.hz * 1.001, chain.zeta, chain.phi, outside(150.0, 300.0))
    normal = normal_equations(run, theta, 0)[0]
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    assert np.linalg.eigvalsh(normal / np.outer(scale, scale))[0] > -1e-9

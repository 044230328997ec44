"""Spectra of whole records and the noise in them, as the maximum-likelihood fit needs them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as sfft

from operando.data import Frf, TimeRecord
from operando.dof import Dof, match_dofs
from operando.errors import DataError, IdentificationError
from operando.frf import find_hits, is_impact, is_periodic, usable_channels, whole
from operando.limits import LEAST_LINES


@dataclass(frozen=True)
class RunSpectra:
    """One run in the frequency domain: X = H·F + transient + noise."""

    frequencies_hz: NDArray[np.float64]
    responses: NDArray[np.complex128]  # (m, L): accelerations, or the accelerance column itself where only FRFs are given
    forces: NDArray[np.complex128]  # (k, L): forces; ones for FRF columns
    # response_rows, response_signs (m,): row of each response in the DOF list of the model, and its sense against that DOF
    response_rows: NDArray[np.int_]
    response_signs: NDArray[np.float64]
    # force_rows, force_signs (k,): the same for the forces
    force_rows: NDArray[np.int_]
    force_signs: NDArray[np.float64]
    # response_variance, force_variance: (m, L), (k, L): E|noise|² of each line, times correlated_lines; of the force of an FRF column the
    # error that its responses have in common, relative to the FRFs
    response_variance: NDArray[np.float64]
    force_variance: NDArray[np.float64]
    step_s: float | None  # sampling interval; None where there is no transient to model (FRF columns)
    name: str = ""
    top_hz: float = 0.0  # last line of the fitted band [Hz]; kept when lines are taken out
    correlated_lines: float = 1.0  # lines that count as one, where FRFs share data between neighbouring lines
    window_rate: float = 0.0  # rate β [1/s] of the exponential window that forces and responses carry: X and F are those at s = iω + β

    def __post_init__(self) -> None:
        if self.top_hz <= 0:
            object.__setattr__(self, "top_hz", float(self.frequencies_hz[-1]))

    def lines(self, keep: NDArray[Any] | slice) -> RunSpectra:
        """The same run on some of its lines."""
        return replace(
            self,
            frequencies_hz=self.frequencies_hz[keep],
            responses=self.responses[:, keep],
            forces=self.forces[:, keep],
            response_variance=self.response_variance[:, keep],
            force_variance=self.force_variance[:, keep],
        )

    def band(self, low: float, high: float) -> RunSpectra:
        """The same run on the lines within [low, high] Hz."""
        inside = (self.frequencies_hz >= low) & (self.frequencies_hz <= high)
        if not inside.any():
            ends = f"{self.frequencies_hz[0]:g}-{self.frequencies_hz[-1]:g} Hz" if inside.size else "no line at all"
            raise IdentificationError(
                f"no line within {low:g}-{high:g} Hz; the spectra hold {ends}", where=self.name or None, hint="choose another band"
            )
        part = self.lines(inside)
        return replace(part, top_hz=float(part.frequencies_hz[-1]))

    def without_bands(self, bands: Sequence[tuple[float, float]]) -> RunSpectra:
        """The same run on the lines outside these bands [Hz]."""
        keep = np.ones(self.frequencies_hz.size, bool)
        for low, high in bands:
            keep &= (self.frequencies_hz < low) | (self.frequencies_hz > high)
        return self if keep.all() else self.lines(keep)


def record_spectra(record: TimeRecord, dofs: Sequence[Dof], band: tuple[float, float]) -> RunSpectra:
    """Full-record spectra on the lines of a band [Hz] of one run with measured force, noise estimated from the record.

    Velocity and displacement channels are brought to acceleration by powers of iω. All DOFs must be among those of the model.
    """
    force_index, response_index = record.force_indices, record.response_indices
    if not force_index:
        raise DataError("no force channel", where=record.name or None, hint="[idle] and [check] need a measured force")
    if not response_index:
        raise DataError("no response channel with a DOF", where=record.name or None)
    n = record.n_samples
    f = sfft.rfftfreq(n, 1 / record.sampling_hz)
    keep = (f >= max(band[0], 0.5 / record.duration_s)) & (f <= band[1])
    f = f[keep]
    spectra = sfft.rfft(np.asarray(record.data, float), axis=1)[:, keep]
    x, forces = spectra[response_index], spectra[force_index]
    s = 2j * np.pi * f
    for row, i in enumerate(response_index):
        power = {"acceleration": 0, "velocity": 1, "displacement": 2}[record.channels[i].quantity]
        x[row] = x[row] * s**power
    wanted = tuple(d for i in response_index if (d := record.channels[i].dof) is not None)
    references = tuple(d for i in force_index if (d := record.channels[i].dof) is not None)
    if len(references) != len(force_index):
        raise DataError("a force channel has no DOF", where=record.name or None, hint="give it in [channels] of the test file")
    rows, signs = match_dofs(wanted, tuple(dofs))
    force_rows, force_signs = match_dofs(references, tuple(dofs))
    response_variance, force_variance = noise_from_spectra(f, x, forces)
    return RunSpectra(
        f,
        x,
        forces,
        np.asarray(rows),
        np.asarray(signs, float),
        np.asarray(force_rows),
        np.asarray(force_signs, float),
        response_variance,
        force_variance,
        1 / record.sampling_hz,
        record.name,
    )


def rings_from_one_hit(record: TimeRecord) -> bool:
    """Whether the force of a record is one impact."""
    rows = record.force_indices
    if len(rows) != 1:
        return False
    force = np.asarray(record.data[rows[0]], float)
    return is_impact(force) and find_hits(force, record.sampling_hz).pulses.size == 1


def whole_records(records: Sequence[TimeRecord] | None) -> list[TimeRecord] | None:
    """The records whose spectra the fit may use, with the channels that can be used; None where the FRFs say more.

    A transient that is free in each mode looks like the response to a single hit, whose FRF starts from rest. Under a periodic force the
    FRF at the excited lines holds all that the records do, with noise and distortion in its variance. A force with samples that are not
    finite has an FRF from the blocks without them.
    """
    if not records:
        return None
    usable = usable_channels(records)[0]
    if len(whole(usable)) < len(usable) or any(rings_from_one_hit(record) or is_periodic(record) for record in usable):
        return None
    return usable


def excited_fit_band(records: Sequence[TimeRecord], band: tuple[float, float], wider: float) -> tuple[float, float]:
    """Lines to fit [Hz]: a little more than the analysis band, and no further than all forces have power."""
    limits = [excited_limits(record, band) for record in records]
    low, high = max(low for low, _ in limits), min(high for _, high in limits)
    fit_band = (max(0.6 * band[0], low), float(max(min(wider * band[1], 0.97 * high), min(band[1], high))))
    if not fit_band[0] < fit_band[1]:
        raise IdentificationError(
            f"no band in which all forces have power within {band[0]:g}-{band[1]:g} Hz", hint="fit the runs apart, or choose another band"
        )
    return fit_band


def excited_limits(record: TimeRecord, band: tuple[float, float], share: float = 0.02) -> tuple[float, float]:
    """Lowest and highest frequency [Hz] between which the force spectrum stays above ``share`` of its typical power in the band.

    Typical is the level above which half of the power in the band stands, so that a band wider than the excitation changes nothing. Where
    the force ends inside the band, so does what is returned; else it reaches beyond the band as far as the force does.

    Parameters
    ----------
    record : TimeRecord
        Record with forces.
    band : (float, float)
        Band [Hz].
    share : float, optional
        Share of the typical power.

    Returns
    -------
    (float, float)
        Both [Hz].

    Raises
    ------
    DataError
        If the record has no force channel.

    Examples
    --------
    >>> import numpy as np, operando
    >>> rng = np.random.default_rng(0)
    >>> channels = [operando.Channel("1+Z", "force", "N"), operando.Channel("2+Z", "acceleration", "m/s2")]
    >>> record = operando.TimeRecord(rng.standard_normal((2, 1000)), 500.0, channels)
    >>> from operando.ema import excited_limits
    >>> excited_limits(record, (20.0, 200.0))
    (0.0, 230.0)
    """
    rows = record.force_indices
    if not rows:
        raise DataError("no force channel", where=record.name or None, hint="[idle] and [check] need a measured force")
    f = sfft.rfftfreq(record.n_samples, 1 / record.sampling_hz)
    power = np.sum(np.abs(sfft.rfft(np.asarray(record.data[rows], float), axis=1)) ** 2, axis=0)
    width = max(8, int(0.01 * f.size))
    count = f.size // width
    smooth = np.median(power[: count * width].reshape(count, width), axis=1)
    middle = f[: count * width].reshape(count, width).mean(axis=1)
    inside = (middle >= band[0]) & (middle <= band[1])
    ordered = np.sort(smooth[inside] if inside.any() else smooth)[::-1]
    typical = float(ordered[int(np.searchsorted(np.cumsum(ordered), 0.5 * ordered.sum()))])
    weak = smooth < share * typical
    there = np.flatnonzero(inside & ~weak)
    if not there.size:
        return 0.0, float(0.92 * record.sampling_hz / 2)
    half = 0.5 * float(middle[1] - middle[0]) if count > 1 else 0.0
    above, below = np.flatnonzero(weak & (middle > middle[there[-1]])), np.flatnonzero(weak & (middle < middle[there[0]]))
    high = float(middle[above[0]]) if above.size else float(0.92 * record.sampling_hz / 2)
    low = float(middle[below[-1]]) + half if below.size else 0.0
    return low, high


@dataclass(frozen=True)
class FrfNoise:
    """How the errors of FRFs go together.

    Lines that count as one, the distance of lines [Hz], and by the row of each force the relative variance of the error common to its FRFs.
    """

    correlated_lines: float = 1.0
    common: Mapping[int, float] = field(default_factory=dict)
    spacing_hz: float = 0.0


FRF_NOISE = FrfNoise()
"""Errors of lines and pairs that are independent of each other."""


def frf_spectra(frf: Frf, dofs: Sequence[Dof], band: tuple[float, float], noise: FrfNoise = FRF_NOISE) -> list[RunSpectra]:
    """The columns of an FRF matrix as runs with unit force and no transient.

    With more references than responses (a roving hammer) the rows stand for them: by reciprocity the sensor that stays is what was driven,
    and few runs of many responses need a fraction of the work of many runs of few. The variances are times the lines that count as one, so
    that a sum over all lines holds no more than the FRFs do. A variance stays whole beside the error that its column has in common.
    """
    part = frf.to_quantity("accelerance").band(*band)
    f = part.frequencies_hz
    if f.size < LEAST_LINES:
        raise IdentificationError(f"only {f.size} lines within {band[0]:g}-{band[1]:g} Hz", hint="widen [analysis] band")
    data, variances, responses, references = part.data, part.variance, part.responses, part.references
    common = noise.common
    if len(references) > len(responses):
        data, variances = data.transpose(1, 0, 2), None if variances is None else variances.transpose(1, 0, 2)
        responses, references, common = references, responses, {}
    out = []
    for k, reference in enumerate(references):
        column = data[:, k]
        use = np.all(np.isfinite(column), axis=1) & np.any(column != 0, axis=1)
        if not use.any():
            continue
        measured = tuple(d for d, u in zip(responses, use, strict=True) if u)
        rows, signs = match_dofs(measured, tuple(dofs))
        force_rows, force_signs = match_dofs((reference,), tuple(dofs))
        x = column[use]
        variance = None if variances is None else np.array(variances[use, k])
        if variance is None or not np.all(np.isfinite(variance)) or not np.any(variance > 0):
            variance = local_variance(x)
        floor = 1e-8 * np.mean(np.abs(x) ** 2, axis=1, keepdims=True)
        out.append(
            RunSpectra(
                f,
                np.asarray(x),
                np.ones((1, f.size), complex),
                np.asarray(rows),
                np.asarray(signs, float),
                np.asarray(force_rows),
                np.asarray(force_signs, float),
                np.maximum(variance, floor) * noise.correlated_lines,
                np.full((1, f.size), common.get(int(force_rows[0]), 0.0) * noise.correlated_lines),
                None,
                f"column {reference}",
                correlated_lines=noise.correlated_lines,
                window_rate=part.exponential_window_rate,
            )
        )
    if not out:
        raise IdentificationError("no FRF column with finite values in the band")
    return out


def local_variance(x: NDArray[np.complex128], half_width: int = 4) -> NDArray[np.float64]:
    """Noise of each FRF line from a local quadratic fit over 2·half_width+1 lines, smoothed by a running median.

    For FRFs that come without coherence. Sharp peaks make it too large, never too small.
    """
    width = 2 * half_width + 1
    d = np.arange(-half_width, half_width + 1) / half_width
    basis = np.linalg.qr(np.stack([d**p for p in range(3)], axis=1))[0]
    windows = np.lib.stride_tricks.sliding_window_view(x, width, axis=1)
    rest = windows - (windows @ basis) @ basis.T
    variance = np.sum(np.abs(rest) ** 2, axis=2) / (width - 3)
    variance = np.pad(variance, ((0, 0), (half_width, half_width)), mode="edge")
    span = np.lib.stride_tricks.sliding_window_view(np.pad(variance, ((0, 0), (10, 10)), mode="edge"), 21, axis=1)
    return np.asarray(np.median(span, axis=2) / np.log(2) * 0.8)


def noise_from_spectra(
    f: NDArray[np.float64], x: NDArray[np.complex128], forces: NDArray[np.complex128], width: int = 40, degree: int = 7, n_bands: int = 8
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Response (m, L) and force (k, L) noise without a modal model, from local polynomial residuals.

    In blocks of ``width`` lines each response is regressed on F·δ^p and δ^p (p ≤ ``degree``: FRF and transient, locally smooth); the
    covariance of what remains is diag(σ_x²) + Σ_k σ_f,k² h_k h_kᴴ, the second part common to all responses and visible
    where the FRF is large. Both are fitted by moments over the blocks that the polynomials describe. The first is piecewise constant over
    ``n_bands`` bands of equal width, the second constant.
    """
    m, n_lines = x.shape
    k = forces.shape[0]
    regressors = (degree + 1) * (k + 1)
    width = max(width, 2 * regressors + 8)
    n_blocks = n_lines // width
    if n_blocks < 4:
        variance = np.repeat(np.mean(np.abs(x) ** 2, axis=1, keepdims=True) * 1e-4, n_lines, axis=1)
        return variance, np.zeros((k, n_lines))
    used = n_blocks * width
    d = np.linspace(-1, 1, width)
    powers = np.stack([d**p for p in range(degree + 1)])  # (p, width)
    xb = x[:, :used].reshape(m, n_blocks, width).transpose(1, 2, 0)
    fb = forces[:, :used].reshape(k, n_blocks, width).transpose(1, 0, 2)
    basis = np.concatenate([fb[:, i, None, :] * powers for i in range(k)] + [np.broadcast_to(powers, (n_blocks, *powers.shape))], axis=1)
    scale = np.linalg.norm(basis, axis=2, keepdims=True)
    basis = (basis / scale).transpose(0, 2, 1)
    q, r = np.linalg.qr(basis)
    inner = q.conj().transpose(0, 2, 1) @ xb
    rest = xb - q @ inner
    freedom = width - regressors
    coefficients = np.linalg.solve(r, inner) / scale
    # A block's force columns are the first of each group of powers: the FRF at the block's middle.
    h = coefficients[:, [i * (degree + 1) for i in range(k)], :]  # (blocks, k, m)
    covariance = np.einsum("bli,blj->bij", rest, rest.conj()) / freedom
    power = np.real(np.einsum("bii->bi", covariance))
    # Where two degrees less leave clearly more, the polynomials have not converged: a resonance narrower than the block.
    fewer = [i for i in range(regressors) if i % (degree + 1) <= degree - 2]
    q_low = np.linalg.qr(basis[:, :, fewer])[0]
    rest_low = xb - q_low @ (q_low.conj().transpose(0, 2, 1) @ xb)
    power_low = np.sum(np.abs(rest_low) ** 2, axis=1) / (width - len(fewer))
    weight = np.sum(np.abs(h) ** 2, axis=1) + 1e-300
    converged = np.sum(weight * power_low / power, axis=1) / weight.sum(axis=1) < 1.3
    return _fit_noise(power, covariance, h, f, width, n_blocks, n_bands, np.mean(np.abs(forces) ** 2, axis=1), converged)


def _fit_noise(
    power: NDArray[np.float64],
    covariance: NDArray[np.complex128],
    h: NDArray[np.complex128],
    f: NDArray[np.float64],
    width: int,
    n_blocks: int,
    n_bands: int,
    force_power: NDArray[np.float64],
    converged: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    n_lines, m = f.size, power.shape[1]
    k = h.shape[1]
    band_of_block = np.minimum(np.arange(n_blocks) * n_bands // n_blocks, n_bands - 1)
    vf = np.zeros(k)
    vx = np.zeros((n_bands, m))
    for _ in range(8):
        common = np.einsum("k,bkm->bm", vf, np.abs(h) ** 2)
        for b in range(n_bands):
            rows = band_of_block == b
            # Response noise from the blocks where the force noise matters least; the median ignores blocks the polynomials miss.
            clean = np.where(common[rows] < 0.3 * np.maximum(power[rows], 1e-300), power[rows] - common[rows], np.nan)
            enough = np.sum(np.isfinite(clean), axis=0) >= max(3, rows.sum() // 8)
            fallback = np.quantile(power[rows], 0.1, axis=0)
            centre = fallback.copy()
            centre[enough] = np.nanmedian(clean[:, enough], axis=0)
            vx[b] = np.maximum(centre, 1e-6 * fallback + 1e-300)
        vx_block = vx[band_of_block]
        # Force noise from the cross terms between responses (free of response noise), each weighted by its own variance.
        new = np.zeros(k)
        for i in range(k):
            hi = h[:, i]
            cross = np.real(np.einsum("bi,bij,bj->b", hi.conj() / vx_block, covariance, hi / vx_block)) - np.sum(
                np.abs(hi) ** 2 / vx_block**2 * power, axis=1
            )
            gain = np.sum(np.abs(hi) ** 2 / vx_block, axis=1) ** 2 - np.sum(np.abs(hi) ** 4 / vx_block**2, axis=1)
            estimate = cross / np.maximum(gain, 1e-300)
            strength = gain / np.maximum(np.sum(np.abs(hi) ** 2 / vx_block, axis=1), 1e-300) * force_power[i]
            if converged.sum() >= 6:
                strength = np.where(converged, strength, -1.0)
            order = np.argsort(strength)[::-1][: min(max(8, n_blocks // 3), max(int(converged.sum()), 6))]
            new[i] = max(float(np.median(estimate[order])), 0.0) if m > 1 else 0.0
        if np.allclose(new, vf, rtol=1e-3, atol=0):
            vf = new
            break
        vf = new
    # Floors keep the weights finite: noise-free data are simulated, rounded to single precision at best.
    vf = np.minimum(vf, 0.1 * force_power)
    edges = np.minimum((np.arange(n_lines) // width) * n_bands // n_blocks, n_bands - 1)
    vx_line = vx[edges].T
    return np.ascontiguousarray(vx_line), np.repeat(vf[:, None], n_lines, axis=1)

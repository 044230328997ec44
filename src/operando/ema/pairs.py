"""Given FRFs as a list of pairs (response, reference), and what is known of their noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, Frf
from operando.dof import Dof, match_dofs
from operando.errors import DataError, IdentificationError

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

LOW_QUANTILE = 25
NOISE_FLOOR = 1e-8
"""Smallest noise variance, over the mean power of the pair: data in single precision are no better."""


@dataclass(frozen=True)
class Pairs:
    """Measured accelerances in the senses of the model's DOFs, one row a pair."""

    frequencies_hz: Real
    accelerance: Complex
    noise: Real  # (P, L): shape over frequency of the variance E|ΔH|² of the measurement; its size is fitted where ``noise_known`` is false
    noise_known: bool
    # rows, columns (P,): DOF of the model of the response and of the reference
    rows: NDArray[np.int_]
    columns: NDArray[np.int_]
    grid: NDArray[np.int_]  # (P, 2): response and reference number of each pair in the FRF matrix
    # (P,): where hammer or sensors stood, in the order of the file: the set-up, or else response or reference, whichever side has more.
    # What is measured at once errs together. −1 for the mean of several set-ups.
    places: NDArray[np.int_]
    window_rate: float = 0.0  # rate β [1/s] of the exponential window the FRFs carry
    offset: bool = True  # whether the fit has a term 1/s for an offset of the sensors

    @property
    def drive_points(self) -> NDArray[np.int_]:
        """Pairs whose response and reference are the same DOF."""
        return np.flatnonzero(self.rows == self.columns)

    def lines(self, keep: NDArray[Any]) -> Pairs:
        """The same pairs on some of their lines."""
        return replace(self, frequencies_hz=self.frequencies_hz[keep], accelerance=self.accelerance[:, keep], noise=self.noise[:, keep])

    @property
    def roving_side(self) -> int:
        """0 where the responses rove, 1 where the references do: the side with more places."""
        return roving_side(self.grid)

    @property
    def staying(self) -> NDArray[np.int_]:
        """DOF of each pair on the side with fewer places: the accelerometers of a roving hammer, else the references."""
        return self.rows if self.roving_side == 1 else self.columns

    def turned(self, dofs: NDArray[np.int_]) -> Pairs:
        """The pairs with the staying sensors at some DOFs in the opposite sense."""
        sign = np.where(np.isin(self.staying, dofs), -1.0, 1.0)
        return replace(self, accelerance=self.accelerance * sign[:, None])


def frf_pairs(frf: Frf, dofs: tuple[Dof, ...], band: tuple[float, float]) -> Pairs:
    """The measured pairs of an FRF matrix on the lines within ``band`` [Hz].

    Pairs without a finite value or without any response are left out; so are lines on which a pair left over has none.
    """
    part = frf.to_quantity("accelerance").band(*band)
    f = part.frequencies_hz
    rows, row_signs = match_dofs(part.responses, dofs)
    columns, column_signs = match_dofs(part.references, dofs)
    finite = np.isfinite(part.data)
    measured = finite.mean(axis=2) > 0.5
    measured &= np.any(np.where(finite, part.data, 0) != 0, axis=2)
    grid = np.argwhere(measured)
    if not grid.size:
        raise IdentificationError("no FRF with finite values in the band", hint="check [analysis] band against the lines of the FRFs")
    i, j = grid.T
    usable = finite[i, j].all(axis=0) & (f > 0)
    if usable.sum() < 8:
        raise IdentificationError(f"only {usable.sum()} lines within {band[0]:g}-{band[1]:g} Hz", hint="widen [analysis] band")
    sign = np.asarray(row_signs, float)[i] * np.asarray(column_signs, float)[j]
    h = np.asarray(part.data[i, j][:, usable] * sign[:, None])
    variance = None if part.variance is None else part.variance[i, j][:, usable]
    known = variance is not None and bool(np.all(np.isfinite(variance))) and bool(np.all(np.any(variance > 0, axis=1)))
    floor = NOISE_FLOOR * np.mean(np.abs(h) ** 2, axis=1, keepdims=True)
    noise = np.maximum(variance if known and variance is not None else noise_shape(h), floor)
    places = grid[:, roving_side(grid)] if part.setups is None else part.setups[i, j]
    return Pairs(f[usable], h, noise, known, np.asarray(rows)[i], np.asarray(columns)[j], grid, places, part.exponential_window_rate)


def roving_side(grid: NDArray[np.int_]) -> int:
    """0 where the responses rove, 1 where the references do: the side with more places."""
    return int(np.argmax([np.unique(places).size for places in grid.T]))


def noise_shape(h: Complex) -> Real:
    """Noise variance over frequency of FRFs that come without coherence, (P, L).

    The fourth difference over the lines takes away what is smooth; a running low quantile of its power, divided by that quantile of
    an exponential distribution, is the level between the resonances, which peaks cannot raise. A constant factor is left to the fit.
    """
    from scipy.ndimage import percentile_filter, uniform_filter1d

    n_lines = h.shape[1]
    if n_lines < 9:
        return np.broadcast_to(1e-4 * np.mean(np.abs(h) ** 2, axis=1, keepdims=True), h.shape).copy()
    power = np.abs(np.diff(h, 4, axis=1)) ** 2 / 70.0  # 1² + 4² + 6² + 4² + 1²
    power = np.pad(power, ((0, 0), (2, 2)), mode="edge")
    width = max(41, n_lines // 8)
    low = percentile_filter(power, LOW_QUANTILE, size=(1, width), mode="nearest") / -np.log1p(-LOW_QUANTILE / 100)
    return np.asarray(uniform_filter1d(low, width, axis=1, mode="nearest"))


def informative_lines(f: Real, hz: Real, zeta: Real, per_width: int = 8) -> NDArray[np.int_]:
    """Lines that carry the information on the poles: ``per_width`` in each half-power width, fewer away from the resonances.

    Model errors are smooth over frequency, so further lines add numbers and no information; the spacing grows with the distance to
    the nearest pole, as the detail of the FRF shrinks.
    """
    if not hz.size:
        return np.arange(f.size)
    spacing = np.full(f.size, np.inf)
    for h, z in zip(hz, zeta, strict=True):
        spacing = np.minimum(spacing, np.maximum(2 * z * h, np.abs(f - h)))
    spacing /= per_width
    keep = [0]
    for i in range(1, f.size):
        if f[i] - f[keep[-1]] >= 0.999 * spacing[i] or i == f.size - 1:
            keep.append(i)
    return np.array(keep)


def with_values(frf: Frf) -> tuple[Frf, tuple[Finding, ...]]:
    """The FRFs without responses and references of which no line is a number, and what was left out.

    What is infinite is no number: it becomes NaN. Lines of which some pair that is measured at others holds no number are left out of
    that pair by the fits; a finding says so.
    """
    finite = np.isfinite(frf.data)
    if not finite.any():
        raise DataError("no value of the FRFs is a number", hint="look at the channels with operando inspect")
    if not frf.data[finite].any():
        raise DataError("all values of the FRFs are zero", hint="look at the channels with operando inspect")
    if np.isinf(frf.data).any():
        frf = replace(frf, data=np.where(finite, frf.data, np.nan))
    there = finite.any(axis=2)
    found: list[Finding] = []
    if (partial := there[:, :, None] & ~finite & (frf.frequencies_hz > 0)).any():
        i, j, _ = np.argwhere(partial)[0]
        hz = frf.frequencies_hz[partial.any(axis=(0, 1))]
        pairs = int(np.sum(partial.any(axis=2)))
        where = f"{hz[0]:g} Hz" if hz.size == 1 else f"{hz[0]:g} to {hz[-1]:g} Hz"
        lines = "1 line" if hz.size == 1 else f"{hz.size} lines"
        named = f"{frf.responses[i]}/{frf.references[j]}" + (f" and {pairs - 1} more" if pairs > 1 else "")
        found.append(Finding(
            "nan", f"{lines} of the FRF {named} hold no number ({where})", "warning", dof=str(frf.responses[i]),
            band_hz=(float(hz[0]), float(hz[-1])), consequence="the model is fitted without these values", action="measure there again",
        ))  # fmt: skip
    rows, columns = there.any(axis=1), there.any(axis=0)
    if rows.all() and columns.all():
        return frf, tuple(found)
    named_dofs = ((frf.responses, rows), (frf.references, columns))
    lost = list(dict.fromkeys(str(d) for dofs, seen in named_dofs for d, s in zip(dofs, seen, strict=True) if not s))
    responses, references = ([d for d, s in zip(dofs, seen, strict=True) if s] for dofs, seen in named_dofs)
    found.insert(0, Finding(
        "nan", f"no line of the FRFs at {', '.join(lost)} is a number", "warning", dof=lost[0],
        consequence="the model is made without", action="measure there again, or exclude the channel in [channels]",
    ))  # fmt: skip
    return frf.select(responses, references), tuple(found)

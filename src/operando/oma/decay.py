"""Modes of free decays: subspace identification of the records themselves, deviations from surrogates of what the decays leave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from operando.data import Finding
from operando.errors import IdentificationError
from operando.indicators import INTERVAL
from operando.oma.diagram import Prepared
from operando.oma.estimate import Estimate, normalise_shapes, taken_poles, to_displacement
from operando.oma.subspace import Factors, Poles, Realisation, poles_of_orders, realise
from operando.oma.uncertainty import student_widening
from operando.stabilization import PoleTable, Tolerances, classify

MOST_ROWS = 240
"""Rows of the Hankel matrix: beyond, the decompositions of all surrogates would take longer than the identification of a long record."""
MAX_ORDER = 60
SURROGATES = 60
"""Surrogates for the covariance: its standard deviations are then known to 9 %, which Student's t allows for."""
FAR = 10.0
"""Moves so many times their median (7 standard deviations) belong to another pole."""
SAME_POLE = 0.05
"""A pole of the early or late part that lies farther off (relative), or has lost its damping or three times as much, is another one."""
HELD = 0.95
"""Part of the surrogates in which early and late part must hold a mode, for their difference to be judged."""
DIFFERENT = 3.0
"""Standard deviations between early and late part of the decays from which on a mode counts as changing with amplitude."""


@dataclass(frozen=True)
class _Gram:
    """Products of the Hankel columns with themselves: those that begin early, and those that begin late."""

    early: NDArray[np.float64]
    late: NDArray[np.float64]


@dataclass(frozen=True)
class DecayDiagram:
    """Poles of all orders of free decays; ``estimate`` concludes like that of the diagrams of stationary records.

    ``pieces`` are the decays (r, n), channels scaled to ``scale``; ``rows`` are block rows.
    """

    table: PoleTable
    orders: list[int]
    poles: list[Poles]
    pieces: list[NDArray[np.float64]]
    scale: NDArray[np.float64]
    prepared: Prepared
    rows: int
    changing: list[Finding] = field(default_factory=list)
    blocks: int = SURROGATES

    @property
    def samples(self) -> int:
        """Samples of all decays."""
        return sum(p.shape[1] for p in self.pieces)

    @cached_property
    def seconds(self) -> float:
        """Length of all decays [s]."""
        return self.samples / self.prepared.rate

    def estimate(self, groups: list[tuple[int, int]]) -> Estimate:
        """Modes at the (order, row of the table) given, with covariance.

        The decays of all poles of the order are taken off; what is left (noise, ambient vibration) is given back with random phases
        at each line, the same for all channels, so that its spectra and cross spectra stay; the identification is repeated on each
        surrogate. Where early and late columns give another frequency or damping than the surrogates allow, half the difference is added.
        """
        n, r = len(groups), self.scale.size
        lam, raw = np.zeros(n, complex), np.zeros((r, n), complex)
        where: dict[int, NDArray[np.int_]] = {}
        for modes, of, columns in taken_poles(groups, self.poles, self.orders, self.table):
            where[of.order] = modes
            lam[modes] = np.log(of.mu[columns]) * self.prepared.rate
            raw[:, modes] = of.shapes[:, columns]
        shapes = self._normalised(raw, lam)
        covariance = self._covariance(lam, shapes, where) if n else None
        size = np.abs(lam)
        return Estimate(size / 2 / np.pi, -lam.real / size, shapes, covariance, np.array([order for order, _ in groups], int))

    def _normalised(self, raw: NDArray[np.complex128], lam: NDArray[np.complex128]) -> NDArray[np.complex128]:
        return normalise_shapes(to_displacement(raw * self.scale[:, None], lam, self.prepared.derivative))

    def _covariance(
        self, lam: NDArray[np.complex128], shapes: NDArray[np.complex128], where: dict[int, NDArray[np.int_]]
    ) -> NDArray[np.float64]:
        rng = np.random.default_rng(0)
        model, noise = zip(*[self._taken_apart(p) for p in self.pieces], strict=True)
        theta = _parameters(lam, shapes)
        draws = []
        early_late = []
        for _ in range(SURROGATES):
            drawn = [m + surrogate(e, rng) for m, e in zip(model, noise, strict=True)]
            found, early, late = self._again(gram_of(drawn, self.rows), lam, where)
            draws.append(_parameters(found[0], _aligned(found[1], shapes)) - theta)
            early_late.append(_ratio(early, lam) - _ratio(late, lam))
        changes = without_lost(np.array(draws), lam.size, self.scale.size)
        covariance = changes.T @ changes / SURROGATES * student_widening(SURROGATES) ** 2
        _, early, late = self._again(gram_of(self.pieces, self.rows), lam, where)
        differences = np.array(early_late)
        held = np.mean(np.isfinite(differences), axis=0) >= HELD
        spread = np.sqrt(np.mean(np.where(np.isfinite(differences), differences, 0.0) ** 2, axis=0))
        difference = _ratio(early, lam) - _ratio(late, lam)
        self._add_change(covariance, lam, np.where(held & np.isfinite(difference), difference, 0.0), spread)
        return covariance

    def _add_change(
        self, covariance: NDArray[np.float64], lam: NDArray[np.complex128], difference: NDArray[np.float64], spread: NDArray[np.float64]
    ) -> None:
        """Half the difference between early and late part, where it is significant, into the variances; findings name the modes."""
        n = lam.size
        size = np.concatenate([np.abs(lam) / 2 / np.pi, -lam.real / np.abs(lam)])
        self.changing.clear()
        for i in range(2 * n):
            if abs(difference[i]) > DIFFERENT * spread[i]:
                covariance[i, i] += (difference[i] * size[i] / 2) ** 2
                if i < n:
                    self.changing.append(
                        Finding(
                            "amplitude_dependent",
                            f"mode at {size[i]:.5g} Hz: early in the decay its frequency lies {100 * difference[i]:+.2g} % off that late "
                            f"(noise: ± {196 * spread[i]:.2g} %)",
                            "warning",
                            band_hz=(0.95 * size[i], 1.05 * size[i]),
                            consequence="the structure is not linear at these amplitudes; half the difference is in the standard deviation",
                            action="analyse loud and quiet parts apart (start_s, stop_s)",
                        )
                    )

    def _again(
        self, gram: _Gram, lam: NDArray[np.complex128], where: dict[int, NDArray[np.int_]]
    ) -> tuple[tuple[NDArray[np.complex128], NDArray[np.complex128]], NDArray[np.complex128], NDArray[np.complex128]]:
        """λ and shapes nearest to the modes from all columns, λ from early and from late ones."""
        out = []
        for matrix in (gram.early + gram.late, gram.early, gram.late):
            realisation = realised(matrix, self.scale.size, self.orders[-1])
            near, raw = np.zeros(lam.size, complex), np.zeros((self.scale.size, lam.size), complex)
            for order, modes in where.items():
                of = poles_of_orders(realisation, [order], self.prepared.rate)[0]
                own = np.log(of.mu) * self.prepared.rate
                if not own.size:
                    near[modes] = lam[modes]
                    continue
                for i in modes:
                    j = int(np.argmin(np.abs(own - lam[i])))
                    near[i], raw[:, i] = own[j], of.shapes[:, j]
            out.append((near, raw))
        return (out[0][0], self._normalised(out[0][1], out[0][0])), out[1][0], out[2][0]

    def _taken_apart(self, piece: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """A decay as the sum of the decaying exponentials of the largest order, and the rest (scaled for the freedom the fit took)."""
        mu = self.poles[-1].mu
        mu = mu[np.abs(mu) < 1.0]
        t = np.arange(piece.shape[1])
        waves = mu[None, :] ** t[:, None]
        basis = np.column_stack([waves.real, waves.imag])
        fit = basis @ np.linalg.lstsq(basis, piece.T, rcond=1e-10)[0]
        freedom = max(piece.shape[1] - basis.shape[1], piece.shape[1] // 2)
        return fit.T, (piece - fit.T) * np.sqrt(piece.shape[1] / freedom)


def decay_diagram(
    prepared: Prepared, decays: Sequence[Sequence[tuple[int, int]]], max_order: int | None, tolerances: Tolerances | None
) -> DecayDiagram:
    """Poles of free decays by the eigensystem realisation of the records (Juang & Pappa 1985), all decays side by side.

    Each decay (first sample, stop) gives columns y(t), y(t + 1), … of one Hankel matrix; its left singular vectors are the observability
    matrix whatever the initial state of each. White noise of equal size in all channels does not turn them: channels are scaled to their
    noise at the end of the decays.
    """
    r = prepared.runs[0].shape[0]
    raw = [np.asarray(run[:, a:b], float) for run, spans in zip(prepared.runs, decays, strict=True) for a, b in spans]
    ends = [p[:, -max(p.shape[1] // 10, 2) :].std(axis=1) for p in raw]
    loud = np.sqrt(np.mean([np.mean(p**2, axis=1) for p in raw], axis=0))
    scale = np.maximum(np.mean(ends, axis=0), 1e-6 * loud)
    shortest = min(p.shape[1] for p in raw)
    rows = int(max(4, min(round(MOST_ROWS / r), 100, shortest // 3)))
    if shortest < 24 or (rows - 1) * r < 4:
        raise IdentificationError(f"decays of {shortest} samples are too short", hint="record longer decays, or widen the band")
    pieces = [p / scale[:, None] for p in raw]
    order = int(min(max_order or MAX_ORDER, (rows - 1) * r, sum(p.shape[1] - rows for p in pieces) // 2)) // 2 * 2
    gram = gram_of(pieces, rows)
    realisation = realised(gram.early + gram.late, r, order)
    orders = list(range(4, order + 1, 2)) or [order]
    poles = poles_of_orders(realisation, orders, prepared.rate)
    table = classify(orders, [q.hz for q in poles], [q.zeta for q in poles], [q.shapes for q in poles], tolerances)
    return DecayDiagram(table, orders, poles, pieces, scale, prepared, rows)


def gram_of(pieces: Sequence[NDArray[np.float64]], rows: int) -> _Gram:
    """Hankel matrix times its transpose, from the first and from the second half of each decay's columns."""
    r = pieces[0].shape[0]
    out = [np.zeros((rows * r, rows * r)) for _ in range(2)]
    for p in pieces:
        columns = p.shape[1] - rows + 1
        view = np.lib.stride_tricks.sliding_window_view(p, columns, axis=1)  # (r, rows, columns)
        hankel = view.transpose(1, 0, 2).reshape(rows * r, columns)
        half = columns // 2
        out[0] += hankel[:, :half] @ hankel[:, :half].T
        out[1] += hankel[:, half:] @ hankel[:, half:].T
    return _Gram(*out)


def realised(gram: NDArray[np.float64], n_channels: int, order: int) -> Realisation:
    """Shift equation of the leading eigenvectors."""
    size = gram.shape[0]
    values, vectors = eigh(gram, subset_by_index=(size - order, size - 1))
    s = np.sqrt(np.maximum(values[::-1], 0))
    left = vectors[:, ::-1]
    return realise(Factors(left, s, left), n_channels)


def surrogate(noise: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Another record with the spectra and cross spectra of (r, n) noise: one random phase a line for all channels."""
    lines = np.fft.rfft(noise, axis=1)
    lines = lines * np.exp(2j * np.pi * rng.random(lines.shape[1]))
    return np.asarray(np.fft.irfft(lines, noise.shape[1], axis=1))


def uncertain_decays(estimate: Estimate, keep_hz: Sequence[float]) -> dict[int, tuple[str, str]]:
    """Modes whose frequency is uncertain by more than their half-power width, or whose damping by more than itself (95 %)."""
    if estimate.covariance is None:
        return {}
    n = estimate.hz.size
    std = np.sqrt(np.diag(estimate.covariance))
    out = {}
    for i in range(n):
        hz, zeta = float(estimate.hz[i]), float(estimate.zeta[i])
        half_hz, half = INTERVAL * float(std[i]), INTERVAL * float(std[n + i])
        ill_determined = half_hz > 2 * zeta * hz or half > zeta
        if ill_determined and not any(abs(hz - f) < 0.01 * f for f in keep_hz):
            value = f"{hz:.4g} ± {half_hz:.2g} Hz, damping ratio {100 * zeta:.3g} ± {100 * half:.3g} %"
            out[i] = ("uncertain", f"{value}: the decays do not hold this pole")
    return out


def decay_findings(diagram: DecayDiagram, names: Sequence[str]) -> list[Finding]:
    """That the records are decays, and which modes change on the way."""
    lengths = [p.shape[1] / diagram.prepared.rate for p in diagram.pieces]
    first = Finding(
        "free_decay",
        f"{len(lengths)} free {'decay' if len(lengths) == 1 else 'decays'} of {min(lengths):.3g} to {max(lengths):.3g} s, no stationary "
        "vibration: the power falls by orders of magnitude",
        "info",
        file=", ".join(dict.fromkeys(n for n in names if n)) or None,
        consequence="analysed as free decays (subspace identification of the decays themselves), not by correlations",
        action="give records of steady operation if the machine is meant to run",
    )
    return [first, *diagram.changing]


def _parameters(lam: NDArray[np.complex128], shapes: NDArray[np.complex128]) -> NDArray[np.float64]:
    size = np.abs(lam)
    flat = shapes.T.ravel()
    return np.concatenate([size / 2 / np.pi, -lam.real / size, flat.real, flat.imag])


def _aligned(shapes: NDArray[np.complex128], like: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Shapes with the same component real and positive as in ``like``."""
    top = np.argmax(np.abs(like), axis=0), np.arange(like.shape[1])
    peak = shapes[top]
    return np.asarray(shapes * np.where(np.abs(peak) > 0, np.abs(peak) / np.where(peak == 0, 1, peak), 1))


def _ratio(found: NDArray[np.complex128], lam: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Relative differences of frequency and of damping ratio to λ (2·n,); NaN where it is another pole."""
    f = np.abs(found) / np.abs(lam) - 1
    z = (found.real / np.abs(found)) / (lam.real / np.abs(lam)) - 1
    lost = (np.abs(f) > SAME_POLE) | (z < -1) | (z > 2)
    return np.where(np.concatenate([lost, lost]), np.nan, np.concatenate([f, z]))


def without_lost(changes: NDArray[np.float64], n: int, r: int) -> NDArray[np.float64]:
    """Changes of the parameters (draws, p) with those of a mode set aside in draws where another pole was taken for it.

    A draw is one of these where the frequency or damping moves ``FAR`` times the median move. Where more than one draw in ten is, the
    mode is not held by the data and all draws count.
    """
    out = changes.copy()
    for i in range(n):
        move = np.abs(changes[:, [i, n + i]])
        far = np.any(move > FAR * np.maximum(np.median(move, axis=0), 1e-300), axis=1)
        if 0 < far.sum() <= 0.1 * far.size:
            own = [i, n + i, *(2 * n + i * r + np.arange(r)), *(2 * n + (n + i) * r + np.arange(r))]
            out[np.ix_(np.flatnonzero(far), own)] = 0
            out[:, own] *= np.sqrt(far.size / (far.size - far.sum()))
    return out

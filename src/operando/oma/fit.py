"""Operational modal analysis of output-only records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from operando.data import ModalModel, TimeRecord
from operando.errors import ConfigError, IdentificationError
from operando.oma.conditioning import Responses, gather_responses, resample
from operando.oma.correlation import BlockCorrelations, correlate, pool
from operando.oma.details import OmaDetails
from operando.oma.spectra import output_spectra
from operando.oma.subspace import Factors, Poles, Realisation, factorise_weighted, poles_of_orders, realise
from operando.oma.uncertainty import Perturbations, covariance_of_mean, normalised_changes, perturb
from operando.stabilization import PoleTable, Stabilization, Tolerances, classify, select_modes

METHODS = ("ssi-cov", "ssi-dat")
WEIGHTINGS = ("cva", "none")
MAX_ORDER = 120


def fit_oma(
    record: TimeRecord | Sequence[TimeRecord],
    *,
    band: tuple[float, float] | None = None,
    max_order: int | None = None,
    references: object = None,
    known_harmonics_hz: Sequence[float] = (),
    select_hz: Sequence[float] = (),
    reject_hz: Sequence[float] = (),
    method: str = "ssi-cov",
    block_rows: int | None = None,
    tolerances: Tolerances | None = None,
    weighting: str = "cva",
    uncertainty: bool = True,
) -> ModalModel:
    """Modes of a running structure from its responses alone.

    Parameters
    ----------
    record : TimeRecord or sequence of TimeRecord
        One run or several (their correlations are averaged). Forces are ignored.
    band : (low, high), optional
        Analysis band [Hz]; default from ten periods in a run to 0.4 of the sampling rate.
    max_order : int, optional
        Largest model order (states).
    references : DOF labels, optional
        Channels correlated with; default all.
    known_harmonics_hz : sequence of float
        Rotor orders known to the user [Hz].
    select_hz, reject_hz : sequences of float
        Choice by hand.
    method : {"ssi-cov", "ssi-dat"}
    block_rows : int, optional
        Block rows (and columns) of the Hankel matrix.

    Returns
    -------
    ModalModel
        Complex shapes of unit norm with the largest component real and positive, "unscaled"; ``details`` is an ``OmaDetails``.

    Raises
    ------
    DataError, DofError, IdentificationError, ConfigError
    """
    if method not in METHODS:
        raise ConfigError(f"method {method!r} is none of {', '.join(METHODS)}")
    responses = gather_responses(record)
    band = _band(band, responses)
    r = len(responses.dofs)
    refs = _reference_rows(references, responses)
    rows = block_rows or int(np.clip(round(800 / r), 30, 120))
    with threadpool_limits(1, "blas"):
        spectra = output_spectra(responses.runs, responses.sampling_hz, band)
        runs, rate = _at_suitable_rate(responses, band)
        correlations = _correlations(runs, refs, 2 * rows, uncertainty)
        samples = sum(run.shape[1] for run in runs)
        factors = factorise_weighted(correlations.mean, refs, rows, 2 * (max_order or MAX_ORDER), samples, weighting)
        order = max_order or default_order(factors, samples, weighting)
        order = min(order, factors.s.size - 1, (rows - 1) * r)
        realisation = realise(factors, r)
        orders = list(range(4, order + 1, 2))
        poles = poles_of_orders(realisation, orders, rate)
        table = classify(orders, [p.hz for p in poles], [p.zeta for p in poles], [p.shapes for p in poles], tolerances)
        stabilization = select_modes(
            table,
            band=band,
            tolerances=tolerances,
            select_hz=select_hz,
            reject_hz=reject_hz,
            indicator_hz=spectra.frequencies_hz,
            indicator=spectra.singular_values,
        )
        groups = best_orders(stabilization, orders)
        estimate = _estimate(groups, poles, orders, correlations, factors, realisation, responses.derivative, rows, rate, table)
    settings: dict[str, Any] = {
        "method": method,
        "weighting": weighting,
        "band": list(band),
        "block_rows": rows,
        "max_order": order,
        "sampling_hz": rate,
        "references": [str(responses.dofs[i]) for i in refs],
        "blocks": int(correlations.weights.size),
    }
    details = OmaDetails(stabilization, np.asarray(known_harmonics_hz, float), spectra, model_orders=estimate.orders, settings=settings)
    return ModalModel(
        estimate.hz,
        estimate.zeta,
        estimate.shapes,
        responses.dofs,
        "unscaled",
        covariance=estimate.covariance,
        band_hz=band,
        findings=responses.findings,
        provenance=responses.provenance.then(f"fit_oma(method={method!r}, band={band}, block_rows={rows}, max_order={order})"),
        details=details,
    )


@dataclass(frozen=True)
class _Estimate:
    hz: NDArray[np.float64]
    zeta: NDArray[np.float64]
    shapes: NDArray[np.complex128]
    covariance: NDArray[np.float64] | None
    orders: NDArray[np.int_]


def default_order(factors: Factors, samples: int, weighting: str) -> int:
    """Largest model order worth looking at: a third beyond the canonical correlations that exceed what white noise gives."""
    if weighting != "cva":
        return min(80, factors.s.size)
    level = np.sqrt(factors.left.shape[0] / samples) + np.sqrt(factors.right.shape[0] / samples)
    signal = int(np.sum(factors.s > level))
    return int(np.clip(2 * round(1.3 * signal / 2), 20, MAX_ORDER))


def best_orders(stabilization: Stabilization, orders: Sequence[int]) -> list[tuple[int, int]]:
    """(order, row of the table) each selected mode is taken from.

    One order for as many modes as possible: of those with most modes the one whose poles lie nearest to the medians over all
    orders; a mode missing there is taken from the order where it lies nearest to its own.
    """
    table = stabilization.table
    count = np.zeros(len(orders))
    distance = np.zeros(len(orders))
    place = {order: k for k, order in enumerate(orders)}
    own: list[dict[int, tuple[float, int]]] = []
    for hz, zeta, members in zip(stabilization.selected_hz, stabilization.selected_damping, stabilization.selected_members, strict=True):
        far = np.abs(table.frequency_hz[members] - hz) / (zeta * hz) + np.abs(table.damping_ratio[members] - zeta) / zeta
        mine = {}
        for row, d in zip(members, far, strict=True):
            k = place[int(table.order[row])]
            count[k] += 1
            distance[k] += d
            mine[k] = (float(d), int(row))
        own.append(mine)
    if not own:
        return []
    full = np.flatnonzero(count == count.max())
    common = int(full[np.argmin(distance[full])])
    out = []
    for mine in own:
        k = common if common in mine else min(mine, key=lambda q: mine[q][0])
        out.append((orders[k], mine[k][1]))
    return out


def _estimate(
    groups: list[tuple[int, int]],
    poles: list[Poles],
    orders: list[int],
    correlations: BlockCorrelations,
    factors: Factors,
    realisation: Realisation,
    derivative: NDArray[np.int_],
    rows: int,
    rate: float,
    table: PoleTable,
) -> _Estimate:
    """Poles, shapes and covariance of the selected modes, each at its order."""
    n, r = len(groups), realisation.n_channels
    taken = np.array([g[0] for g in groups], int)
    lam = np.zeros(n, complex)
    shapes = np.zeros((r, n), complex)
    blocks = correlations.weights.size if correlations.blocks is not None else 0
    d_lam = np.zeros((blocks, n), complex)
    d_shapes = np.zeros((blocks, r, n), complex)
    for order in np.unique(taken):
        of = poles[orders.index(int(order))]
        modes = np.flatnonzero(taken == order)
        columns = np.array([int(np.argmin(np.abs(of.hz - table.frequency_hz[groups[i][1]]))) for i in modes])
        lam[modes] = np.log(of.mu[columns]) * rate
        shapes[:, modes] = of.shapes[:, columns]
        if blocks:
            change = perturb(correlations, factors, realisation, of, columns, rows, rate)
            d_lam[:, modes], d_shapes[:, :, modes] = change.lam, change.shapes
    covariance = None
    if blocks and n:
        covariance = covariance_of_mean(normalised_changes(lam, shapes, Perturbations(d_lam, d_shapes), derivative), correlations.weights)
    if np.any(derivative != derivative[0]):
        shapes = shapes / lam[None, :] ** derivative[:, None]
    size = np.abs(lam)
    return _Estimate(size / 2 / np.pi, -lam.real / size, normalise_shapes(shapes), covariance, taken)


def normalise_shapes(shapes: NDArray[Any]) -> NDArray[np.complex128]:
    """Unit norm, largest component real and positive."""
    out = np.array(shapes, complex)
    for column in out.T:
        peak = column[np.argmax(np.abs(column))]
        if peak != 0:
            column *= abs(peak) / peak / np.linalg.norm(column)
    return out


def _band(band: tuple[float, float] | None, responses: Responses) -> tuple[float, float]:
    rate = responses.sampling_hz
    duration = min(run.shape[1] for run in responses.runs) / rate
    if band is None:
        return 10 / duration, 0.4 * rate
    low, high = float(band[0]), float(band[1])
    if not 0 <= low < high:
        raise ConfigError(f"band {band} Hz is empty", hint="give [low, high] in Hz")
    if high >= rate / 2:
        raise ConfigError(f"band reaches {high:g} Hz, half the sampling rate is {rate / 2:g} Hz")
    return low, high


def _at_suitable_rate(responses: Responses, band: tuple[float, float]) -> tuple[list[NDArray[Any]], float]:
    """Resample to two and a half times the upper band limit where the record is much faster."""
    wanted = 2.5 * band[1]
    if responses.sampling_hz < 1.3 * wanted:
        return list(responses.runs), responses.sampling_hz
    done = [resample(run, responses.sampling_hz, 1.05 * band[1], wanted) for run in responses.runs]
    return [d[0] for d in done], done[0][1]


def _reference_rows(references: object, responses: Responses) -> NDArray[np.int_]:
    from operando.dof import match_dofs, parse_dofs

    if references is None:
        return np.arange(len(responses.dofs))
    return np.unique(match_dofs(parse_dofs(references), responses.dofs)[0])


def _correlations(runs: list[NDArray[Any]], refs: NDArray[np.int_], n_lags: int, uncertainty: bool) -> BlockCorrelations:
    """Pooled correlations in blocks of at least four times the lags, about a hundred at most, so that neighbours hardly depend on each other."""
    samples = [run.shape[1] for run in runs]
    if min(samples) < 5 * n_lags:
        raise IdentificationError(
            f"{min(samples)} samples are too few for {n_lags} correlation lags", hint="take longer runs, or fewer block_rows (keyword)"
        )
    length = max(4 * n_lags, sum(samples) // 100)
    parts = []
    for run, n in zip(runs, samples, strict=True):
        centred = run - run.mean(axis=1, keepdims=True)
        parts.append(correlate(centred, refs, n_lags, max(1, (n - n_lags) // length) if uncertainty else 1, uncertainty))
    return pool(parts, samples)

"""Operational modal analysis of output-only records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from operando.data import ModalModel, TimeRecord, band_limits, count_of, frequencies_of, several
from operando.errors import ConfigError
from operando.oma.band import BandChoice, default_band
from operando.oma.setups import fit_setups, group_setups
from operando.oma.single import Band, Options, default_block_rows, identify
from operando.stabilization import Tolerances
from operando.threads import one_blas_thread

METHODS = ("ssi-cov", "ssi-dat")
WEIGHTINGS = ("cva", "none")


def fit_oma(
    record: TimeRecord | Sequence[TimeRecord],
    *,
    band: tuple[float, float] | None = None,
    max_order: int | None = None,
    references: object = None,
    known_harmonics_hz: Sequence[float] = (),
    select_hz: float | Sequence[float] = (),
    reject_hz: float | Sequence[float] = (),
    method: str = "ssi-cov",
    block_rows: int | None = None,
    tolerances: Tolerances | None = None,
    weighting: str = "cva",
    uncertainty: bool = True,
    second_opinion: bool = False,
) -> ModalModel:
    """Modes of a running structure from its responses alone.

    Covariance-driven stochastic subspace identification (Van Overschee & De Moor 1996; Peeters & De Roeck 1999) with
    canonical-variate weights on unwindowed FFT correlations. Sinusoids are found and taken out first; modes are chosen
    automatically, and every candidate that is not taken keeps its reason; standard deviations come from the scatter between blocks
    of the record (``operando.oma.uncertainty``).

    Parameters
    ----------
    record : TimeRecord or sequence of TimeRecord
        One run or several. Runs over the same sensors are averaged (their correlations); runs of different sensors are set-ups, merged
        by the sensors they share (``operando.oma.setups``). Only response channels with a DOF are used; displacement, velocity
        and acceleration may be mixed.
    band : (low, high), optional
        Analysis band [Hz]; by default where the resonances hold their power (``operando.oma.band``), stated as a finding.
    max_order : int, optional
        Largest model order (states); default from the canonical correlations.
    references : DOF labels, optional
        Channels correlated with; default all.
    known_harmonics_hz : sequence of float
        Rotor orders known to the user [Hz]: taken out whether or not they stand out.
    select_hz, reject_hz : float or sequence of float
        Choice by hand [Hz]: taken beside the automatic choice, or left out (``operando.stabilization.select_modes``).
    method : {"ssi-cov", "ssi-dat"}
        ``ssi-dat`` is run by pyOMA-2, on the longest run, without uncertainty.
    block_rows : int, optional
        Block rows (and columns) of the Hankel matrix.
    tolerances : Tolerances, optional
        Of the stabilisation diagram.
    weighting : {"cva", "none"}
        ``none`` is plain SSI-cov.
    uncertainty : bool
        False leaves the covariance out (faster).
    second_opinion : bool
        Also run pyOMA-2's SSI-cov and list where it disagrees (``details.second_opinion``).

    Returns
    -------
    ModalModel
        "unscaled", complex shapes in proportions of displacement, each of unit norm with its largest component real and positive (also
        in the covariance); ``details`` is an ``OmaDetails``.

    Raises
    ------
    DataError, DofError
        If the record cannot be used (no response DOF, samples that are not finite, runs that do not fit together, set-ups that share
        no sensor).
    ConfigError
        If an option is out of range.
    IdentificationError
        If the record is too short, no mode is found, or one chosen by hand is absent.

    Examples
    --------
    >>> import numpy as np, operando
    >>> from scipy.signal import lfilter
    >>> rng = np.random.default_rng(1)
    >>> pole = np.exp(2 * np.pi / 200 * (-0.02 * 20 + 20j))  # 20 Hz, 2 % damping, sampled at 200 Hz
    >>> motion = lfilter([1.0], np.poly([pole, pole.conjugate()]).real, rng.standard_normal(60_000))
    >>> channels = [operando.Channel("1+Z", "acceleration", "m/s2"), operando.Channel("2+Z", "acceleration", "m/s2")]
    >>> data = np.stack([motion, -motion]) + 0.01 * rng.standard_normal((2, 60_000))
    >>> model = operando.fit_oma(operando.TimeRecord(data, 200.0, channels), band=(5, 50))
    >>> float(model.frequencies_hz[0].round(0)), model.shapes[:, 0].real.round(1).tolist()
    (20.0, [-0.7, 0.7])
    """
    if method not in METHODS:
        raise ConfigError(f"method {method!r} is none of {', '.join(METHODS)}")
    if weighting not in WEIGHTINGS:
        raise ConfigError(f"weighting {weighting!r} is none of {', '.join(WEIGHTINGS)}")
    block_rows = count_of(block_rows, "block_rows", 60)
    setups = group_setups(several(record, TimeRecord, "operational modes come from time records", "read(file).records holds them"))
    records = [r for group in setups for r in group]
    with one_blas_thread():
        if band is None:
            channels = max(len(r.response_indices) for r in records)
            choice = default_band(records, block_rows or default_block_rows(max(channels, 1), [r.n_samples for r in records]))
        else:
            choice = BandChoice(checked_band(band, records), "given")
        options = Options(
            choice.band,
            choice.text,
            count_of(max_order, "max_order", 60),
            references,
            frequencies_of(known_harmonics_hz, "known_harmonics_hz"),
            frequencies_of(select_hz, "select_hz"),
            frequencies_of(reject_hz, "reject_hz"),
            method,
            block_rows,
            tolerances,
            weighting,
            uncertainty,
            second_opinion,
        )
        model = identify(setups[0], options).modes() if len(setups) == 1 else fit_setups(setups, options)
    return replace(model, findings=(*choice.findings, *model.findings))


def checked_band(band: Band, records: Sequence[TimeRecord]) -> Band:
    """The band asked for."""
    rate = min(r.sampling_hz for r in records)
    low, high = band_limits(band)
    if not 0 <= low < high:
        raise ConfigError(f"band {band} Hz is empty", hint="give [low, high] in Hz")
    if high >= rate / 2:
        raise ConfigError(f"band reaches {high:g} Hz, half the sampling rate is {rate / 2:g} Hz")
    return low, high

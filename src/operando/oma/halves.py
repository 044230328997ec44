"""Both halves of an operating record, identified apart: one chooses an effect, the other validates it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from operando.data import ModalModel, TimeRecord
from operando.errors import DataError, IdentificationError
from operando.oma.fit import fit_oma


def fit_halves(record: TimeRecord | Sequence[TimeRecord], whole: ModalModel) -> tuple[ModalModel, ...]:
    """Modes of the first and of the second half of each run, with the settings of the whole.

    Nothing but the settings (band, references, rate and known sinusoids among them) goes from the whole to the halves; a sinusoid found
    in the whole is taken out of both, because half the time shows it less well.

    Parameters
    ----------
    record : TimeRecord or sequence of TimeRecord
        What ``whole`` was identified from.
    whole : ModalModel
        From ``fit_oma`` (``ssi-cov``).

    Returns
    -------
    tuple of ModalModel
        First and second half, without details; empty where a half is too short to be identified.

    Examples
    --------
    >>> import numpy as np, operando
    >>> from scipy.signal import lfilter
    >>> rng = np.random.default_rng(1)
    >>> pole = np.exp(2 * np.pi / 200 * (-0.02 * 20 + 20j))  # 20 Hz, 2 % damping, sampled at 200 Hz
    >>> motion = lfilter([1.0], np.poly([pole, pole.conjugate()]).real, rng.standard_normal(60_000))
    >>> channels = [operando.Channel("1+Z", "acceleration", "m/s2"), operando.Channel("2+Z", "acceleration", "m/s2")]
    >>> record = operando.TimeRecord(np.stack([motion, -motion]) + 0.01 * rng.standard_normal((2, 60_000)), 200.0, channels)
    >>> model = operando.fit_oma(record, band=(5, 50))
    >>> [float(half.frequencies_hz[0].round(0)) for half in fit_halves(record, model)]
    [20.0, 20.0]
    """
    runs = [record] if isinstance(record, TimeRecord) else list(record)
    settings: dict[str, Any] = whole.details.settings
    if settings["method"] != "ssi-cov":
        return ()
    known = sorted({*settings["known_harmonics_hz"], *(float(f) for f in whole.details.harmonics_hz)})
    out = []
    for second in (False, True):
        parts = [_half(run, second) for run in runs]
        try:
            found = fit_oma(
                parts,
                band=tuple(settings["band"]),
                references=settings["references"],
                known_harmonics_hz=known,
                select_hz=settings["select_hz"],
                reject_hz=settings["reject_hz"],
                weighting=settings["weighting"],
            )
        except (IdentificationError, DataError):
            return ()
        if found.covariance is None:
            return ()
        out.append(replace(found, details=None, findings=()))
    return tuple(out)


def _half(run: TimeRecord, second: bool) -> TimeRecord:
    middle = run.data.shape[1] // 2
    return replace(run, data=run.data[:, middle:] if second else run.data[:, :middle])

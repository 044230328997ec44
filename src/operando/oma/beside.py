"""pyOMA-2 on the records behind a model, with the settings the model was made with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from operando.data import ModalModel, TimeRecord, several
from operando.errors import DataError
from operando.oma.conditioning import at_suitable_rate, gather_responses
from operando.oma.pyoma import second_opinion
from operando.oma.setups import group_setups
from operando.oma.single import Options, prepare


def beside_pyoma(model: ModalModel, records: TimeRecord | Sequence[TimeRecord]) -> tuple[dict[str, Any], ...]:
    """What pyOMA-2 (SSI-cov, unweighted) finds in the same records, mode by mode.

    Parameters
    ----------
    model : ModalModel
        As :func:`fit_oma` returned it for these records.
    records : TimeRecord or sequence of TimeRecord
        Of several runs of the same sensors the longest is used.

    Returns
    -------
    tuple of dict
        For each own mode and each mode that only pyOMA-2 sees: ``frequency_hz``, ``other_frequency_hz``, ``damping_ratio``,
        ``other_damping_ratio``, ``mac``, ``agrees``, ``text``; None where there is no partner.

    Raises
    ------
    DataError
        If pyOMA-2 has nothing to set beside: set-ups of different sensors, or free decays.
    MissingError
        If pyOMA-2 is not installed.

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
    >>> [row["agrees"] for row in beside_pyoma(model, record)][:1]
    [True]
    """
    setups = group_setups(several(records, TimeRecord, "a model is compared on time records", "read(file).records holds them"))
    settings = getattr(model.details, "settings", None) or {}
    if len(setups) > 1:
        raise DataError("pyOMA-2 is not asked where set-ups of different sensors are merged", hint="compare one set-up alone")
    if not settings.get("block_rows") or settings.get("method") == "free-decay":
        raise DataError("pyOMA-2 is not asked about free decays", hint="it identifies records of steady operation")
    options = Options(
        tuple(settings["band"]),
        settings["band_source"],
        references=settings["references"],
        known_harmonics_hz=tuple(settings["known_harmonics_hz"]),
        block_rows=settings["block_rows"],
    )
    responses = gather_responses(setups[0])
    prepared, _ = prepare(responses, *at_suitable_rate(responses, options.band), options)
    std = None if model.frequency_std_hz is None else np.asarray(model.frequency_std_hz)
    longest = max(prepared.runs, key=lambda run: run.shape[1])
    return second_opinion(
        model.frequencies_hz,
        model.damping_ratios,
        model.rows(responses.dofs),
        std,
        longest,
        prepared.rate,
        options.band,
        prepared.rows,
        settings["max_order"],
        prepared.references,
    )

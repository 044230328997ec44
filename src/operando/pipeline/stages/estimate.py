"""FRFs and whole records with the settings of a test, the same for all stages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.config import Analysis, State
from operando.data import Finding, Frf, TimeRecord
from operando.pipeline.stages.work import Work


def estimate(records: list[TimeRecord], analysis: Analysis, rejected: Sequence[str] = ()) -> Frf:
    """``estimate_frf`` with the settings of the test; of the hits rejected by hand those in these records.

    Kept to seven digits: measured FRFs have four, and more digits of noise would double the size of the results.
    """
    from operando.frf import estimate_frf

    frf = estimate_frf(
        records,
        references=analysis.references or None,
        estimator=analysis.estimator,
        block_seconds=analysis.block_seconds,
        overlap=analysis.overlap,
        window=analysis.window,
        hits=analysis.hits,
        hits_reject=of_records(rejected, records),
    )
    variance, coherence = (None if part is None else _seven_digits(part) for part in (frf.variance, frf.coherence))
    return replace(frf, data=_seven_digits(frf.data), variance=variance, coherence=coherence)


def _seven_digits(values: NDArray[Any]) -> NDArray[Any]:
    """Values, or both parts of complex ones, rounded to the 24 bits of single precision, whatever their size."""
    parts, exponents = np.frexp(np.ascontiguousarray(values).view(float))
    return np.ldexp(parts.astype(np.float32).astype(float), exponents).view(values.dtype)


def of_records(rejected: Sequence[str], records: Sequence[TimeRecord]) -> tuple[str, ...]:
    """Those of the hits named ``FILE#NUMBER`` that are in these records."""
    names = {record.name for record in records}
    return tuple(text for text in rejected if text.rpartition("#")[0] in names)


def whole_records(
    work: Work, state: State, findings: list[Finding], choose: Callable[[list[TimeRecord]], list[TimeRecord]] = list
) -> list[TimeRecord]:
    """The records of a state with force, or those chosen of them, for fits of whole records: without the hits rejected by hand."""
    from operando.frf import without_hits

    records = choose(work.inputs.records(state, force=True))
    kept, found = without_hits(records, of_records(work.test.rejected_hits(state), records))
    findings += found
    return kept

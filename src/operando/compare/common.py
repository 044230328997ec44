"""What a model and measured FRFs have in common: pairs, lines, senses; and their values in one row."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from operando.compare.measures import Lines
from operando.data import FrequencyAxis, Frf
from operando.dof import Dof, DofIndex
from operando.errors import DataError
from operando.frf import in_one_sense, opposed_dofs

if TYPE_CHECKING:
    from operando.compare.comparison import Comparison


@runtime_checkable
class FrfModel(Protocol):
    """Anything that makes FRFs."""

    def frf(self, frequencies: ArrayLike, responses: object = None, references: object = None, quantity: str = "accelerance") -> Frf:
        """FRFs at the lines asked for."""


@runtime_checkable
class LevelDependent(FrfModel, Protocol):
    """A model with level-dependent effects: under each force it is another one, which it gives to the comparison itself."""

    def compared(self, compare: Callable[[Any], Comparison], force_n: float | None) -> Comparison:
        """What ``compare`` says of the model under a force [N rms]."""


def common_frfs(model: FrfModel | Frf, measured: Frf, band_hz: tuple[float, float] | None, notes: list[str]) -> tuple[Frf, Frf]:
    """Model and measurement on the same pairs, senses, lines and quantity."""
    if band_hz is not None:
        if len(measured.axis.values[measured.axis.band(*band_hz)]) == 0:
            raise DataError(f"no measured line lies in {band_hz[0]:g} … {band_hz[1]:g} Hz")
        measured = measured.band(*band_hz)
    have_out, have_in = _available(model)
    responses = tuple(d for d in measured.responses if have_out is None or d in have_out)
    references = tuple(d for d in measured.references if have_in is None or d in have_in)
    if not responses or not references:
        raise DataError(
            "model and measurement have no response–reference pair in common",
            hint="measured responses: " + ", ".join(map(str, measured.responses[:20])),
        )
    missing = [str(d) for d in (*measured.responses, *measured.references) if d not in responses and d not in references]
    if missing:
        notes.append("not in the model, left out: " + ", ".join(dict.fromkeys(missing)))
    measured = measured.select(responses, references)
    f = measured.frequencies_hz
    if isinstance(model, Frf):
        keep = (f >= model.frequencies_hz[0] - 1e-9) & (f <= model.frequencies_hz[-1] + 1e-9)
        index = model.at(f)
        step = np.diff(model.frequencies_hz).min() if len(model.axis) > 1 else 1.0
        keep &= np.abs(model.frequencies_hz[index] - f) <= 1e-3 * step
        if not np.any(keep):
            raise DataError("the model FRFs and the measurement have no frequency line in common", hint="synthesise on the measured lines")
        if not np.all(keep):
            notes.append(f"{int(np.sum(~keep))} measured lines are not in the model FRFs, left out")
        made = model.select(responses, references).to_quantity(measured.quantity)
        made = replace(made.lines(index[keep]), axis=FrequencyAxis(f[keep]))
        measured = measured.lines(keep)
    else:
        made = model.frf(f, responses, references, measured.quantity)
    return made, measured


def in_the_sense_of(made: Frf, ref: Frf, notes: list[str]) -> Frf:
    """The measurement, with force and accelerometer in one sense at drive points where they are in the model."""
    already = {d.key for d in opposed_dofs(made)}
    opposed = [d for d in opposed_dofs(ref) if d.key not in already]
    notes += [
        f"force and accelerometer have opposite senses at the measured drive point {dof}, and not in the model: compared are FRFs with "
        "one of the two reversed"
        for dof in opposed
    ]
    return in_one_sense(ref, opposed)


def shared_dofs(model: FrfModel | Frf, measured: Sequence[Frf]) -> tuple[list[Dof], list[Dof], list[Dof]]:
    """Response DOFs of a model, of a measurement, and of both; a model that names none has those of the measurement."""
    holder = getattr(model, "modal", model)
    of_measured: list[Dof] = []
    for frf in measured:
        of_measured += [d for d in frf.responses if d not in DofIndex(of_measured)]
    given = model.responses if isinstance(model, Frf) else getattr(holder, "dofs", None)
    of_model = of_measured if given is None else list(given)
    found = DofIndex(of_model)
    return of_model, of_measured, [d for d in of_measured if d in found]


def _available(model: FrfModel | Frf) -> tuple[DofIndex | None, DofIndex | None]:
    if isinstance(model, Frf):
        return DofIndex(model.responses), DofIndex(model.references)
    holder = getattr(model, "modal", model)
    dofs = getattr(holder, "dofs", None)
    if dofs is None:
        return None, None
    known = DofIndex(dofs)
    return known, known


def collect(made: Frf, ref: Frf, labels: list[Dof], notes: list[str]) -> Lines:
    """Flat lines of one run; ``labels`` grows by DOFs not seen before."""
    labels += [d for d in ref.responses if d not in DofIndex(labels)]
    which = np.array(DofIndex(labels).match(ref.responses)[0])
    shape = ref.data.shape
    zero = np.zeros(shape)
    var_meas = zero if ref.variance is None else ref.variance
    own = zero if made.variance is None else np.nan_to_num(made.variance, posinf=np.inf)
    good = np.isfinite(made.data) & np.isfinite(ref.data) & np.isfinite(var_meas) & np.isfinite(own)
    response = np.broadcast_to(which[:, None, None], shape)
    f = np.broadcast_to(ref.frequencies_hz, shape)
    if not np.all(good):
        notes.append(f"{int(np.sum(~good))} lines are not finite, left out")
    if ref.variance is None:
        notes.append(
            "the FRFs compared with state neither variance nor coherence and count as exact: chi-square and noise floor know only of the "
            "uncertainty of the model"
        )
    unstated = 0 if made.variance is None else int(np.sum(np.isnan(made.variance) & good))
    if unstated:
        notes.append(f"the model states no variance on {unstated} of {int(good.sum())} lines: that of the measurement alone counts there")
    return Lines(made.data[good], ref.data[good], var_meas[good], own[good], response[good], f[good])


def pool(parts: Sequence[Lines]) -> Lines:
    """All lines of several runs."""
    return Lines(*(np.concatenate([getattr(lines, part.name) for lines in parts]) for part in fields(Lines)))

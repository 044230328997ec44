"""The model that a finished diagnosis has left in the results."""

from __future__ import annotations

from collections.abc import Sequence

from operando.diagnosis.document import discrepancy_of
from operando.diagnosis.from_records import standing
from operando.errors import MissingError
from operando.results import Results
from operando.structure import Model


def effect_model(results: Results, changes: Sequence[tuple[int, str, float]] = ()) -> Model:
    """The second route to the operational FRFs: the idle model with the accepted effects, faults of channels among them.

    An effect that depends on the level stands in it as the spring and damper it is equivalent to at the lowest level measured.

    ``changes`` are (step, parameter, another value of it in SI units): a state that was not measured.
    """
    base = results.effect_idle or results.idle
    if results.diagnosis is None or base is None:
        raise MissingError("there is no model with accepted effects", hint="run the test to the stage diagnose")
    effects = tuple(standing(results.diagnosis))
    model = Model(base, effects, results.geometry, results.effect_covariance, discrepancy_of(results.diagnosis))
    for step, name, value in changes:
        model = model.with_values(step, **{name: value})
    return model

"""A law that the catalogue lacks: the place is right and the verdict says that the law is not."""

from __future__ import annotations

from functools import cache

from nonlinear_truth import Strip, measure, place
from operando.diagnosis import diagnose_records

STRIP = Strip()
COEFFICIENT = 3e13


@cache
def records():
    return measure(STRIP, [(place(STRIP, 2), "quintic", {"coefficient": COEFFICIENT})], seconds=12.0, run_in=3.0)


def test_a_law_outside_the_catalogue_is_placed_and_not_called_explained():
    found = diagnose_records(STRIP.idle(), records())
    # what leaves more than a fifth of the judge's misfit is no effect found, but the first candidate: at the right place
    assert found.verdict == "unexplained"
    assert found.effects == ()
    assert found.to_dict()["candidates"][0]["location"] == ["3+Z"]

"""Sizes that would have been found: raised where a fit with the size held shows that more is needed."""

from types import SimpleNamespace

import numpy as np
import pytest

from operando.diagnosis import verdict as module
from operando.diagnosis.case import Case
from operando.diagnosis.idle import Idle
from operando.diagnosis.posterior import fit
from operando.diagnosis.rival import started
from operando.diagnosis.terms import Term
from operando.diagnosis.verdict import _LEAST_POWER, _asked, detectable, seen_at_their_size
from test_diagnosis import BAND, DOFS, case
from test_diagnosis_elsewhere import poorly_driven, rest


@pytest.fixture(scope="module")
def state():
    one = case(spreads={})
    return fit(one, one.forward.start)


def test_what_is_told_is_seen_by_a_fit_with_the_size_held(state):
    """Where the idle model is known as first order has it, and where its first modal mass is known to 60 % (one reference, two days)."""
    poor = Case(Idle.of(poorly_driven(0.6), BAND, DOFS[:1]), rest((0,)), BAND, correlated=1.0)
    for one in (state, fit(poor, poor.forward.start)):
        least = detectable(one)
        raised = seen_at_their_size(one, least)
        assert raised.keys() == least.keys()
        assert all(least[key] <= raised[key] < 1.3 * least[key] for key in least)
        for kind in ("point_mass", "ground_spring"):
            key = min((k for k in least if k[0] == kind), key=lambda k: least[k])
            term = Term(*key, (float(np.log(raised[key])),), fixed=(0,))
            held = fit(one.case, started(one.case, (term,)), one.alpha)
            fall = one.log_evidence - held.log_evidence + one.case.log_place(term)
            assert np.sqrt(2 * fall) > 0.97 * _asked(one.case, kind)


@pytest.mark.parametrize("power", [0.9, 0.7, _LEAST_POWER])
def test_sizes_grow_as_far_as_a_valley_hides_them(state, monkeypatch, power):
    """A likelihood that falls by less than the slope promises: as a power of the size; below _LEAST_POWER no more is believed."""
    least = detectable(state)
    first = {kind: min(v for (k, _), v in least.items() if k == kind) for kind, _ in least}

    def held(case, x, alpha):
        (term,) = x.terms
        seen = 3 * (np.exp(term.values[0]) / first[term.kind]) ** power
        return SimpleNamespace(log_evidence=state.log_evidence + case.log_place(term) - seen**2 / 2)

    monkeypatch.setattr(module, "fitted_if_can_be", held)
    raised = seen_at_their_size(state, least)
    for (kind, _), factor in ((key, raised[key] / least[key]) for key in least):
        assert 3 * factor**power == pytest.approx(_asked(state.case, kind))


def test_other_kinds_are_asked_only_where_a_mass_or_a_spring_is_hidden(state, monkeypatch):
    asked = []

    def held(case, x, alpha):
        asked.append(x.terms[0].kind)
        return SimpleNamespace(log_evidence=-np.inf)

    monkeypatch.setattr(module, "fitted_if_can_be", held)
    monkeypatch.setattr(module, "side_by_side", lambda function, items: [function(item) for item in items])  # so that they are seen
    least = detectable(state)
    assert seen_at_their_size(state, least) == least
    assert sorted(asked) == ["ground_spring", "point_mass"]

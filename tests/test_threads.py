"""Threads over places, laws and runs."""

import threading

import numpy as np
import pytest

from operando import threads
from operando.threads import each


def test_results_keep_the_order_of_the_items_and_inner_calls_stay_in_their_thread(monkeypatch):
    monkeypatch.setattr(threads, "cores", lambda: 2)

    def outer(n):
        own = threading.get_ident()
        return n, {own} | set(each(lambda _: threading.get_ident(), range(5)))

    found = each(outer, range(20))
    assert [n for n, _ in found] == list(range(20))
    assert all(len(used) == 1 for _, used in found)
    assert all(threading.get_ident() not in used for _, used in found)


def test_one_core_needs_no_thread(monkeypatch):
    monkeypatch.setattr(threads, "cores", lambda: 1)
    assert set(each(lambda _: threading.get_ident(), range(5))) == {threading.get_ident()}


def test_an_error_reaches_the_caller(monkeypatch):
    monkeypatch.setattr(threads, "cores", lambda: 2)
    with pytest.raises(ZeroDivisionError):
        each(lambda n: 1 / n, [1, 0, 2])
    assert each(lambda n: n, [1, 2]) == [1, 2]


def test_what_numpy_warns_of_is_the_same_in_a_thread(monkeypatch):
    monkeypatch.setattr(threads, "cores", lambda: 2)
    with np.errstate(divide="ignore"):
        assert each(lambda n: np.ones(1)[0] / np.float64(n), [0, 1]) == [np.inf, 1.0]
    with np.errstate(divide="raise"), pytest.raises(FloatingPointError):
        each(lambda n: np.ones(1)[0] / np.float64(n), [0, 1])

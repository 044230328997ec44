"""Fits side by side in processes."""

import os
import signal
import threading
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from operando import processes
from operando.diagnosis import diagnose_modes
from operando.diagnosis.terms import Term
from operando.processes import side_by_side
from test_diagnose_modes import KINDS, SPRING, chain, idle_of, running

here = pytest.mark.skipif(not processes.CAN_FORK, reason="processes are forked on Linux only")


@pytest.fixture(autouse=True)
def _two_processors(monkeypatch):
    monkeypatch.setattr(processes, "cores", lambda: 2)


def slowly(n):
    """Long enough for the other process to take its share."""
    return n, os.getpid(), sum(i * i for i in range(200_000))


@here
def test_results_keep_the_order_of_the_items_and_inner_calls_stay_in_their_process():
    found = side_by_side(lambda n: (slowly(n), set(side_by_side(lambda _: os.getpid(), range(5)))), range(20))
    assert [row[0][0] for row in found] == list(range(20))
    assert {row[0][1] for row in found} > {os.getpid()}
    assert all(inner == {row[1]} for row, inner in found)


def test_one_processor_another_system_or_another_thread_needs_no_process(monkeypatch):
    def used():
        return {pid for _, pid, _ in side_by_side(slowly, range(6))}

    found = []
    thread = threading.Thread(target=lambda: found.append(used()))
    thread.start()
    thread.join()
    assert found == [{os.getpid()}]
    monkeypatch.setattr(processes, "CAN_FORK", False)
    assert used() == {os.getpid()}
    monkeypatch.setattr(processes, "CAN_FORK", True)
    monkeypatch.setattr(processes, "cores", lambda: 1)
    assert used() == {os.getpid()}


@here
def test_the_error_of_the_first_item_that_fails_reaches_the_caller():
    def divided(n):
        slowly(n)
        if n == 3:
            raise ValueError("three")
        return 1 / n

    with pytest.raises(ZeroDivisionError):
        side_by_side(divided, [1, 0, 3, 2])
    with pytest.raises(ValueError, match="three"):
        side_by_side(divided, [1, 3, 0, 2])


@here
def test_what_there_was_before_is_the_same_object_and_what_is_new_has_its_values():
    term, values = Term("point_mass", (1,), (0.5,)), np.arange(4.0)

    def one(term, n):
        slowly(n)
        return {"same": term, "values": values, "new": Term("point_mass", (n,), (1.5,)), "sums": values + n, "by": os.getpid()}

    found = side_by_side(partial(one, term), range(8))
    assert {row["by"] for row in found} > {os.getpid()}
    assert all(row["same"] is term and row["values"] is values for row in found)
    assert [row["new"] for row in found] == [Term("point_mass", (n,), (1.5,)) for n in range(8)]
    assert all(np.array_equal(row["sums"], values + n) for n, row in enumerate(found))


@here
def test_what_a_killed_process_had_to_do_is_done_by_the_caller():
    own = os.getpid()

    def killed(n):
        if os.getpid() != own:
            os.kill(os.getpid(), signal.SIGKILL)
        return slowly(n)[0]

    assert side_by_side(killed, range(12)) == list(range(12))


@here
def test_more_items_than_the_queue_has_room_for():
    count = 20_000  # a pipe of Linux holds 16 384 numbers
    assert side_by_side(lambda n: 2 * n, range(count)) == [2 * n for n in range(count)]


def _children():
    return set(Path(f"/proc/self/task/{threading.get_native_id()}/children").read_text().split())


@here
def test_an_interruption_leaves_no_process_behind():
    own = os.getpid()

    def interrupted(n):
        if os.getpid() == own:
            raise KeyboardInterrupt
        while True:  # until it is ended
            signal.pause()

    before = _children()
    with pytest.raises(KeyboardInterrupt):
        side_by_side(interrupted, range(4))
    assert _children() == before


@dataclass
class Law:
    """Of a test, so not one of ours: its values are sent."""

    values: tuple[float, ...]


@here
def test_results_of_types_of_a_caller_come_back_too():
    assert side_by_side(lambda n: (slowly(n), Law((float(n),)))[1], range(6)) == [Law((float(n),)) for n in range(6)]


@here
def test_a_diagnosis_in_two_processes_is_that_of_one(monkeypatch):
    """The tests that run beside one another have one process each."""
    structure, forked, fork = chain(), [], os.fork
    monkeypatch.setattr(os, "fork", lambda: forked.append(1) or fork())
    asked = (idle_of(structure), running(structure, SPRING))
    two = diagnose_modes(*asked, kinds=KINDS).to_dict()
    assert forked
    forked.clear()
    monkeypatch.setattr(processes, "cores", lambda: 1)
    assert diagnose_modes(*asked, kinds=KINDS).to_dict() == two
    assert not forked

"""Mutants of small files of every reader: a typed error, the content as it was, or a finding; the long run is in ``benchmarks/fuzz``."""

from __future__ import annotations

import signal

import pytest

from fuzz_seeds import GROUPS
from fuzzing import Fuzzer, applied

MUTANTS = 120
"""Of each seed: some thirty seconds on one core for all."""

pytestmark = pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="needs an alarm clock of the system")


@pytest.mark.parametrize("group", GROUPS)
def test_no_mutant_of_a_file_goes_wrong(group, tmp_path):
    wrong, what = {}, []
    for seed in GROUPS[group](tmp_path / "seed"):
        fuzzer = Fuzzer(seed, tmp_path / seed.file, "test")
        for number in range(MUTANTS):
            outcome = fuzzer.try_mutant(number)
            what.append(outcome.what)
            if outcome.what == "failure":
                wrong[seed.name, number] = outcome.note
    assert not wrong
    assert min(what.count("refused"), what.count("equal")) > len(what) / 50  # the mutator damages, and not everything


def test_the_judge_sees_what_is_lost_without_a_word(tmp_path):
    """A set is gone, and the judge is told that another one was changed."""
    seeds = {seed.name: seed for seed in GROUPS["uff"](tmp_path / "seed")}
    fuzzer = Fuzzer(seed := seeds["uff 58 ascii records"], tmp_path / seed.file)
    units, _, force, *_, last = seed.parts
    a_digit = [(force.stop - 20, force.stop - 19, b"7")]
    fuzzer.path.write_bytes(applied(seed.data, a_digit))
    assert fuzzer.judge(a_digit) == ("equal", "")
    fuzzer.path.write_bytes(applied(seed.data, [*a_digit, (last.start, last.stop, b"")]))
    assert fuzzer.judge(a_digit)[1].startswith("lost without a word: ('channel', '2-Y'")
    assert fuzzer.judge([*a_digit, (last.start, last.stop, b"")]) == ("equal", "")
    fuzzer.path.write_bytes(applied(seed.data, [(last.start, last.start + 10, b"")]))
    assert fuzzer.judge(a_digit)[0] == "told"
    assert len(fuzzer.required([(units.start, units.stop, b"")])) == 3  # the labels of the channels state their units

"""A hammer that roves over many files: wrong hits are named, bad files do not spoil the others, hits are rejected by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from operando.data import TimeRecord
from operando.data.time import Channel
from operando.dof import Dof
from operando.errors import DataError
from operando.frf import estimate_frf, find_hits, hits_of, without_hits
from structures import Chain
from test_frf_estimate import relative, sampled_accelerance

FS = 256.0


def chain(zeta=0.02):
    return Chain(n=5, mass=2.0, stiffness=1.2e5, zeta=zeta, seed=3)


def run(times, at=0, *, seconds, elsewhere=(), name="run.uff", zeta=0.02, seed=0, label=None):
    """Hits at a mass; those numbered in ``elsewhere`` strike the mass two further on, with the label of the first."""
    rng = np.random.default_rng(seed)
    structure, n = chain(zeta), int(seconds * FS)
    forces = np.zeros((5, n))
    for k, t in enumerate(times):
        first = round(t * FS)
        forces[at + 2 if k in elsewhere else at, first : first + 4] += rng.uniform(80, 120) * np.sin(np.pi * (np.arange(4) + 0.5) / 4)
    acc = structure.respond(forces, FS)
    acc += 2e-4 * acc.std() * rng.normal(size=acc.shape)
    measured = forces.sum(axis=0) + 1e-3 * rng.normal(size=n)
    channels = [Channel(Dof((label or at) + 1, "Z"), "force", "N")] + [Channel(Dof(i + 1, "Z"), "acceleration", "m/s2") for i in range(5)]
    return TimeRecord(np.vstack([measured, acc]), FS, tuple(channels), name=name)


def error(frf, at=0, zeta=0.02):
    """Relative error of the column over 5 to 80 Hz."""
    part = frf.band(5.0, 80.0)
    exact = sampled_accelerance(chain(zeta), part.frequencies_hz, FS, range(5), [at])
    return float(relative(part.data[:, :1], exact))


def of_kind(frf, kind):
    return [f for f in frf.findings if f.kind == kind]


EVERY_8_S = [0.5 + 8 * k for k in range(5)]
EVERY_2_S = [0.5 + 2 * k for k in range(8)]


def test_a_wrong_hit_is_named_with_file_number_and_time():
    frf = estimate_frf(run(EVERY_8_S, seconds=41, elsewhere=[3], name="p07.uff"))
    [finding] = of_kind(frf, "inconsistent_hit")
    assert finding.file == "p07.uff"
    assert finding.message.startswith("hit #3 at 24.5")
    assert error(frf) < 0.05


def test_numbers_and_times_of_hits_are_those_of_the_file():
    cut = run(EVERY_8_S, seconds=41, elsewhere=[3]).cut(8.0)
    [finding] = of_kind(estimate_frf(cut), "inconsistent_hit")
    assert finding.message.startswith("hit #2 at 24.5")
    assert finding.time_s[0] == pytest.approx(24.5, abs=0.02)


def test_single_hits_of_one_place_in_several_files_are_averaged_and_the_wrong_one_named():
    files = [run([0.5], seconds=8, seed=k, elsewhere=[0] if k == 2 else [], name=f"hit{k}.uff") for k in range(6)]
    frf = estimate_frf(files)
    [finding] = of_kind(frf, "inconsistent_hit")
    assert finding.file == "hit2.uff"
    assert "hit #0 at 0.5" in finding.message
    assert frf.averages == 5
    assert not of_kind(frf, "few_averages")
    good = [f for k, f in enumerate(files) if k != 2]
    np.testing.assert_allclose(frf.data, estimate_frf(good).data, rtol=1e-9)
    assert error(frf) < 0.05
    # the scatter between hits is the variance: as the errors are
    inside = frf.band(5.0, 80.0)
    exact = sampled_accelerance(chain(), inside.frequencies_hz, FS, range(5), [0])
    assert 0.3 < np.mean(np.abs(inside.data - exact) ** 2) / np.mean(inside.variance) < 3


def test_of_three_single_hits_two_decide_and_two_that_differ_are_named():
    def files(n, wrong):
        return [run([0.5], seconds=8, seed=k, elsewhere=[0] if k == wrong else [], name=f"hit{k}.uff") for k in range(n)]

    three = estimate_frf(files(3, 1))
    [finding] = of_kind(three, "inconsistent_hit")
    assert finding.file == "hit1.uff"
    assert three.averages == 2
    assert error(three) < 0.05
    two = estimate_frf(files(2, 1))
    [finding] = of_kind(two, "inconsistent_hit")
    assert "hit0.uff and hit1.uff" in finding.message
    assert two.averages == 2
    assert np.median(two.coherence) < 0.9
    for n in (2, 3):
        assert not of_kind(estimate_frf(files(n, None)), "inconsistent_hit")


def test_one_bad_file_leaves_the_others_as_they_are():
    good = [run(EVERY_8_S, at, seconds=41, seed=at, name=f"p{at}.uff") for at in (0, 1, 3)]
    dead = run(EVERY_8_S, 2, seconds=41, name="dead.uff")
    dead = replace(dead, data=np.vstack([np.zeros(dead.n_samples), dead.data[1:]]))
    hasty = run([0.5 + k for k in range(20)], 4, seconds=41, name="hasty.uff")  # a hit every second
    alone, together = estimate_frf(good), estimate_frf([good[0], dead, *good[1:], hasty])
    np.testing.assert_array_equal(together.data, alone.data)
    [lost] = of_kind(together, "unusable_run")
    assert (lost.file, lost.severity) == ("dead.uff", "error")
    [short] = of_kind(together, "short_hits")
    assert short.file == "hasty.uff"
    assert "0.9" in short.message
    with pytest.raises(DataError, match="no force channel"):
        estimate_frf([dead, replace(dead, name="also dead")])


def test_most_single_hits_decide_the_window_of_all():
    quick, slow = [run([0.5], at, seconds=8, name=f"p{at}") for at in (0, 1, 3)], run([6.5], 2, seconds=8, name="late")
    frf = estimate_frf([*quick, slow])
    assert frf.exponential_window_rate == 0
    assert [f.file for f in of_kind(frf, "short_hits")] == ["late"]
    ringing = [run([0.5], at, seconds=3, zeta=0.005, name=f"p{at}") for at in (0, 1)]
    assert estimate_frf([*ringing, run([0.5], 3, seconds=3, zeta=0.2, name="damped")]).exponential_window_rate > 0.5


def test_a_hit_rejected_by_hand_is_not_averaged():
    record = run(EVERY_8_S, seconds=41, elsewhere=[1, 3], name="p.uff")
    bad = estimate_frf(record, hits="all")
    frf = estimate_frf(record, hits="all", hits_reject=["p.uff#1", "p.uff#3"])
    assert frf.averages == 3
    assert error(bad) > 0.3
    assert error(frf) < 0.05
    assert [(f.severity, f.file, f.message[:6]) for f in of_kind(frf, "rejected_hit")] == [
        ("info", "p.uff", "hit #1"),
        ("info", "p.uff", "hit #3"),
    ]


@pytest.mark.parametrize("estimator", [None, "lrm"])
def test_a_hit_rejected_by_hand_is_taken_out_of_a_whole_record(estimator):
    options = {"estimator": estimator, "line_spacing_hz": 0.1}
    clean = estimate_frf(run(EVERY_2_S, seconds=17, zeta=0.01), **options)
    record = run(EVERY_2_S, seconds=17, zeta=0.01, elsewhere=[3], name="p.uff")
    bad, frf = (estimate_frf(record, **options, **more) for more in ({}, {"hits_reject": ["p.uff#3"]}))
    assert of_kind(frf, "rejected_hit")
    assert error(bad, zeta=0.01) > 0.15
    assert error(frf, zeta=0.01) < 0.02
    assert error(frf, zeta=0.01) < 2 * error(clean, zeta=0.01) + 0.005


def test_fits_of_whole_records_get_the_stretches_between_rejected_hits():
    record = run(EVERY_2_S, seconds=17, name="p.uff")
    parts, findings = without_hits([record, replace(record, name="q.uff")], ["p.uff#2", "p.uff#4"])
    assert [p.name for p in parts] == ["p.uff", "p.uff", "q.uff"]
    assert [hits_of(p).indices.size for p in parts] == [2, 3, 8]
    assert [f.kind for f in findings] == ["hit_alone"]
    assert "#3" in findings[0].message
    # a stretch ends before the rejected pulse rises, and keeps its place in time
    assert parts[0].start_s + parts[0].duration_s == pytest.approx(4.5, abs=0.03)
    assert parts[1].start_s == pytest.approx(10.5, abs=0.03)
    found = find_hits(record.data[0], FS)
    np.testing.assert_allclose(hits_of(parts[1]).times_s + parts[1].start_s, found.times_s[5:], atol=1e-9)
    same, none = without_hits([record], [])
    assert same == [record]
    assert none == []


@pytest.mark.parametrize(
    ("text", "message", "hint"),
    [
        ("p.uff#8", "which has hits #0 to #7", "p.uff#7"),
        ("pp.uff#1", "no hit of these records", "p.uff"),
        ("p.uff", "no hit of these records", None),
        ("shaker.uff#0", "no hammer record", None),
    ],
)
def test_hits_that_are_not_there_are_named_with_the_nearest(text, message, hint):
    record = run(EVERY_2_S, seconds=17, name="p.uff")
    noise = np.random.default_rng(0).normal(size=record.data.shape)
    with pytest.raises(DataError, match=message) as caught:
        estimate_frf([record, replace(record, data=noise, name="shaker.uff")], hits_reject=[text])
    if hint:
        assert hint in caught.value.hint
    with pytest.raises(DataError, match="hits is off"):
        estimate_frf(record, hits="off", hits_reject=["p.uff#0"])


def test_numbers_count_through_all_records_of_one_file():
    first, second = (run(EVERY_8_S[:3], seconds=25, seed=k, name="p.uff", elsewhere=[1] if k else []) for k in range(2))
    frf = estimate_frf([first, second], hits="all", hits_reject=["p.uff#4"])
    assert error(frf) < 0.05

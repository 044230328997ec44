"""Single hits in files of their own: those of one place are averaged as the hits of one record are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from operando.data import Finding, Provenance
from operando.frf.impact import INCONSISTENT, INCONSISTENT_RATIO
from operando.frf.runs import RunEstimate, aligned, coherence_of


def average_hits(runs: Sequence[RunEstimate]) -> list[RunEstimate]:
    """The runs, with those that are single hits at one place (``hit_s``), on the same sensors, averaged to one.

    With the power of its force as weight the mean of FRFs of single hits is H1 over all hits, and their scatter gives its variance
    (a hit by itself has none but the roughness from line to line). A hit that the mean of the others does not predict is left out, as in
    one record (:func:`operando.frf.impact.reject_inconsistent`).
    """
    groups: dict[tuple[object, ...], list[RunEstimate]] = {}
    for k, run in enumerate(runs):
        same = (frozenset(d.key for d in run.references), frozenset(d.key for d in run.responses))
        groups.setdefault(same if run.hit_s is not None else (k,), []).append(run)
    return [group[0] if len(group) == 1 else _averaged(group) for group in groups.values()]


def _averaged(group: Sequence[RunEstimate]) -> RunEstimate:
    base = group[0]
    parts = [base, *(aligned(r, base.responses, base.references) for r in group[1:])]
    parts, rejected = _consistent(parts)
    weight = np.stack([p.gain[0] for p in parts])
    total = np.maximum(weight.sum(axis=0), 1e-300)
    mean = sum((w * p.data for w, p in zip(weight, parts, strict=True)), np.zeros_like(base.data)) / total
    variance = base.variance
    if len(parts) > 1:
        scatter = sum((w * np.abs(p.data - mean) ** 2 for w, p in zip(weight, parts, strict=True)), np.zeros(mean.shape))
        variance = scatter / total / (len(parts) - 1)
    averages = float(len(parts))
    found = [f for p in parts for f in p.findings]
    return replace(
        parts[0],
        data=mean,
        variance=variance,
        coherence=coherence_of(mean, variance, averages),
        gain=weight.sum(axis=0)[None],
        averages=averages,
        level=float(np.sqrt(np.mean([p.level**2 for p in parts]))),
        hit_s=None,
        si=all(p.si for p in parts),
        findings=(*found, *rejected),
        provenance=Provenance.merge(*(p.provenance for p in parts)),
    )


def _consistent(parts: list[RunEstimate]) -> tuple[list[RunEstimate], list[Finding]]:
    """The hits without those that the mean of the others does not predict; the worst goes first, two always remain.

    Of three hits the one goes that misses the other two by far more than these miss each other. Two that differ are both kept and named.
    """
    findings = []
    while len(parts) > 2:
        errors = [_missed(p, [q for q in parts if q is not p]) for p in parts]
        worst = int(np.argmax(errors))
        rest = [p for k, p in enumerate(parts) if k != worst]
        typical = float(np.median(errors)) if len(parts) > 3 else _missed(rest[0], rest[1:])
        if errors[worst] < max(INCONSISTENT_RATIO * typical, INCONSISTENT):
            break
        findings.append(_wrong_hit(parts[worst], errors[worst], f" (median {100 * typical:.2g} %)" if len(parts) > 3 else ""))
        parts = rest
    if len(parts) == 2 and not findings:
        error = _missed(parts[0], parts[1:])
        if error > max(INCONSISTENT_RATIO * sum(_noise(p) for p in parts), INCONSISTENT):
            findings.append(_two_differ(parts[0], parts[1], error))
    return parts, findings


def _missed(run: RunEstimate, others: Sequence[RunEstimate]) -> float:
    """Part of the response energy of a hit that the mean of others does not predict."""
    total = np.maximum(np.sum([p.gain[0] for p in others], axis=0), 1e-300)
    mean = sum((p.gain[0] * p.data for p in others), np.zeros_like(run.data)) / total
    weight = run.gain[0]
    return float(np.nansum(weight * np.abs(run.data - mean) ** 2) / max(float(np.nansum(weight * np.abs(run.data) ** 2)), 1e-300))


def _noise(run: RunEstimate) -> float:
    """The same part that noise alone makes."""
    weight = run.gain[0]
    return float(np.nansum(weight * run.variance) / max(float(np.nansum(weight * np.abs(run.data) ** 2)), 1e-300))


def _wrong_hit(run: RunEstimate, error: float, compared: str) -> Finding:
    time = run.hit_s or 0.0
    return Finding(
        "inconsistent_hit",
        f"hit #0 at {time:.3f} s: the FRF of the other hits at {run.references[0]} misses {100 * error:.0f} % of its "
        f"response energy{compared}",
        "warning",
        file=run.name or None,
        dof=str(run.references[0]),
        time_s=(time, time),
        consequence="not used: it hit another location or direction, or something else moved",
        action="repeat the hit",
    )


def _two_differ(one: RunEstimate, two: RunEstimate, error: float) -> Finding:
    return Finding(
        "inconsistent_hit",
        f"the two hits at {one.references[0]}, in {one.name or 'one file'} and {two.name or 'another'}, differ by "
        f"{100 * error:.0f} % of their response energy",
        "warning",
        file=one.name or None,
        dof=str(one.references[0]),
        consequence="both are used, with a large variance: which of them is wrong cannot be decided",
        action="repeat the hit, three times or more",
    )

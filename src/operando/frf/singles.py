"""Single hits in files of their own: those of one place are averaged as the hits of one record are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from operando.data import Finding, Provenance
from operando.frf.impact import INCONSISTENT, INCONSISTENT_RATIO
from operando.frf.runs import RunEstimate, aligned, coherence_of

LEAST = 3
"""Hits that always remain."""


def average_hits(runs: Sequence[RunEstimate]) -> list[RunEstimate]:
    """The runs, with those that are single hits at one place, on the same sensors, averaged to one.

    With the power of its force as weight the mean of FRFs of single hits is H1 over all hits, and their scatter gives its variance
    (a hit by itself has none but the roughness from line to line). A hit that the mean of the others does not predict is left out by the
    rule for hits of one record (:func:`operando.frf.impact.reject_inconsistent`).

    Parameters
    ----------
    runs : sequence of RunEstimate
        ``hit_s`` says which are single hits.
    """
    groups: dict[tuple[object, ...], list[RunEstimate]] = {}
    for k, run in enumerate(runs):
        same = (frozenset((d.node, d.axis) for d in run.references), frozenset((d.node, d.axis) for d in run.responses))
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
    # that one hit has no scatter is no remark about several
    found = [f for p in parts for f in p.findings if f.kind != "few_averages"]
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
    """The hits without those that the mean of the others does not predict; the worst goes first, ``LEAST`` always remain."""
    findings = []
    while len(parts) > LEAST:
        weight = np.stack([p.gain[0] for p in parts])
        total, mean = weight.sum(axis=0), sum((w * p.data for w, p in zip(weight, parts, strict=True)), np.zeros_like(parts[0].data))
        errors = []
        for w, p in zip(weight, parts, strict=True):
            others = (mean - w * p.data) / np.maximum(total - w, 1e-300)
            errors.append(float(np.nansum(w * np.abs(p.data - others) ** 2) / max(float(np.nansum(w * np.abs(p.data) ** 2)), 1e-300)))
        worst, typical = int(np.argmax(errors)), float(np.median(errors))
        if errors[worst] < max(INCONSISTENT_RATIO * typical, INCONSISTENT):
            break
        out = parts.pop(worst)
        findings.append(
            Finding(
                "inconsistent_hit",
                f"hit #0 at {out.hit_s:.3f} s: the FRF of the other hits at {out.references[0]} misses {100 * errors[worst]:.0f} % of its "
                f"response energy (median {100 * typical:.2g} %)",
                "warning",
                file=out.name or None,
                dof=str(out.references[0]),
                time_s=(out.hit_s or 0.0, out.hit_s or 0.0),
                consequence="not used: it hit another place or direction, or something else moved",
                action="repeat the hit",
            )
        )
    return parts, findings

"""FRFs measured elsewhere, file by file, in one matrix."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, Frf, Provenance, common_name
from operando.dof import DofIndex
from operando.errors import DataError
from operando.frf.runs import HOMOGENEITY_RATIO, HOMOGENEITY_RELATIVE, absent_pairs, coherence_of, each_once, measured_by
from operando.frf.shift import frequency_shifts, in_words
from operando.printable import first_few

Array = NDArray[Any]
_Pair = tuple[int, int]


def merge_frfs(frfs: Sequence[Frf]) -> Frf:
    """One matrix of FRFs measured reference by reference or sensor by sensor; NaN where a pair was not measured.

    A pair that several files hold is averaged where they agree within their variances (the homogeneity test of runs, pair by pair),
    each weighted by 1/variance: both are measurements of one quantity, and a sensor that stays while others rove should gain from it.
    Where they disagree, or one of them has no variance to compare by, the first one counts, as it does in no mixture of two structures; a
    finding says by how much they differ, and how far the modes are shifted.

    Parameters
    ----------
    frfs : sequence of Frf
        On the same lines; brought to the quantity of the first one.

    Returns
    -------
    Frf

    Raises
    ------
    DataError
        If the lines differ.

    Examples
    --------
    >>> import numpy as np, operando
    >>> idle = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> frf = idle.frf(np.arange(5, 80, 0.1))
    >>> from operando.frf import merge_frfs
    >>> merge_frfs([frf[:, "1+Z"], frf[:, "2+Z"]]).references
    (Dof('1+Z'), Dof('2+Z'))
    """
    first = frfs[0]
    if len(frfs) == 1:
        return first
    same = [_on_lines_of(first, h) for h in frfs]
    responses, references = each_once(h.responses for h in same), each_once(h.references for h in same)
    shape = (len(responses), len(references), len(first.axis))
    data = np.full(shape, np.nan, complex)
    variance = np.full(shape, np.nan) if any(h.variance is not None for h in same) else None
    coherence = np.full(shape, np.nan) if any(h.coherence is not None for h in same) else None
    given = _by_pair(same, DofIndex(responses), DofIndex(references))
    averaged: list[str] = []
    apart: dict[str, list[tuple[str, float, Array, Array]]] = {}
    for (i, j), parts in given.items():
        label = f"{responses[i]}/{references[j]}"
        used = parts[:1]
        for part in parts[1:]:
            relative, agree = _agreement(parts[0], part)
            if agree:
                used.append(part)
            else:
                apart.setdefault(part[3].name or "another file", []).append((label, relative, parts[0][0], part[0]))
        if len(used) > 1:
            averaged.append(label)
        data[i, j], of_line, gamma = _mean(used)
        if variance is not None and of_line is not None:
            variance[i, j] = of_line
        if coherence is not None and gamma is not None:
            coherence[i, j] = gamma
    missing = absent_pairs(data, responses, references)
    return Frf(
        data,
        first.axis,
        responses,
        references,
        first.quantity,
        variance=variance,
        coherence=coherence,
        averages=first.averages,
        si=all(h.si for h in same),
        exponential_window_rate=first.exponential_window_rate,
        name=common_name(same),
        setups=measured_by(same, responses, references),
        findings=tuple(dict.fromkeys([*(f for h in frfs for f in h.findings), *_said(first, averaged, apart), *missing])),
        provenance=Provenance.merge(*(h.provenance for h in same)).then("merge_frfs"),
    )


def _on_lines_of(first: Frf, h: Frf) -> Frf:
    """The FRFs in the quantity of the first ones, if they are on the same lines."""
    axis = first.frequencies_hz
    tolerance = 1e-6 * (axis[-1] - axis[0]) / max(axis.size, 1)
    if len(h.axis) == axis.size and np.allclose(h.frequencies_hz, axis, rtol=1e-9, atol=tolerance):
        return h.to_quantity(first.quantity)
    raise DataError(
        f"FRFs on different lines: {axis.size} lines to {axis[-1]:g} Hz and {len(h.axis)} lines to {h.frequencies_hz[-1]:g} Hz",
        where=h.name or None,
        hint="use FRFs of one frequency resolution",
    )


_Part = tuple[Array, Array | None, Array | None, Frf]
"""One pair of one file: H, its variance, its coherence, the file."""


def _by_pair(frfs: Sequence[Frf], rows: DofIndex, columns: DofIndex) -> dict[_Pair, list[_Part]]:
    """What the files hold of each pair, in the sense of the DOFs of the matrix."""
    out: dict[_Pair, list[_Part]] = {}
    for h in frfs:
        for a, d in enumerate(h.responses):
            for b, e in enumerate(h.references):
                row, column = rows.find(d), columns.find(e)
                if row is None or column is None or np.all(np.isnan(h.data[a, b].real)):
                    continue
                variance = None if h.variance is None or not np.isfinite(h.variance[a, b]).any() else h.variance[a, b]
                coherence = None if h.coherence is None else h.coherence[a, b]
                part = row[1] * column[1] * h.data[a, b], variance, coherence, h
                out.setdefault((row[0], column[0]), []).append(part)
    return out


def _agreement(one: _Part, two: _Part) -> tuple[float, bool]:
    """Relative difference of two measurements of a pair beyond their noise, and whether they agree."""
    difference = np.abs(one[0] - two[0]) ** 2
    size = 0.5 * (np.abs(one[0]) ** 2 + np.abs(two[0]) ** 2)
    good = np.isfinite(difference) & (size > 0)
    if one[1] is None or two[1] is None:
        return float(np.sqrt(np.sum(difference[good]) / max(float(np.sum(size[good])), 1e-300))), False
    expected = one[1] + two[1]
    good &= np.isfinite(expected) & (expected > 0) & (size > 10 * expected)
    if not good.any():
        return 0.0, True
    excess = float(np.sum(difference[good]) - np.sum(expected[good]))
    relative = float(np.sqrt(max(excess, 0.0) / np.sum(size[good])))
    parts = [p for p in np.array_split(np.flatnonzero(good), 8) if p.size]
    ratio = max(float(np.mean(difference[p] / expected[p])) for p in parts)
    return relative, not (ratio > HOMOGENEITY_RATIO and relative > HOMOGENEITY_RELATIVE)


def _mean(parts: Sequence[_Part]) -> tuple[Array, Array | None, Array | None]:
    """Mean of one pair with its variance and coherence; the weight of each is one number over all lines, as for runs."""
    if len(parts) == 1:
        return parts[0][:3]
    variances = [np.where(np.isfinite(v), v, 0) for _, v, _, _ in parts if v is not None]
    weights = np.array([1 / max(float(np.median(v)), 1e-300) for v in variances])
    weights = weights / weights.sum()
    mean = sum((w * p[0] for w, p in zip(weights, parts, strict=True)), np.zeros_like(parts[0][0]))
    variance = sum((w**2 * v for w, v in zip(weights, variances, strict=True)), np.zeros(mean.shape))
    averages = float(sum(p[3].averages or 1.0 for p in parts))
    return mean, variance, coherence_of(mean, variance, averages)


def _said(first: Frf, averaged: Sequence[str], apart: dict[str, list[tuple[str, float, Array, Array]]]) -> list[Finding]:
    """Findings about the pairs that several files hold."""
    out = []
    if averaged:
        out.append(
            Finding(
                "duplicate_pair",
                f"{len(averaged)} pairs are given several times ({first_few(averaged)}) and agree within their variances",
                "info",
                consequence="they are averaged",
            )
        )
    for name, pairs in apart.items():
        both = [np.stack([pair[k] for pair in pairs]) for k in (2, 3)]
        shift = frequency_shifts(first.frequencies_hz, *((h, np.zeros(h.shape)) for h in both))
        moved = "" if shift is None else f"; the modes are {in_words(shift)}"
        out.append(
            Finding(
                "duplicate_pair",
                f"{len(pairs)} pairs are given again ({first_few([p[0] for p in pairs])}) and differ by up to "
                f"{100 * max(p[1] for p in pairs):.2g} % of |H|{moved}",
                "warning",
                file=name,
                consequence="of these pairs the first one given is used",
                action="keep one file; where sensors moved between the files, keep the mass on the structure the same",
            )
        )
    return out

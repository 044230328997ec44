"""Several set-ups of different sensors, one structure: each identified, modes matched and merged, a joint estimate beside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, ModalModel, Provenance, TimeRecord
from operando.dof import Dof, DofIndex, Node, match_dofs, parse_dofs
from operando.errors import ConfigError, DataError, DofError, IdentificationError, OperandoError
from operando.indicators import mac
from operando.oma.decay import DecayDiagram
from operando.oma.details import JointCheck, OmaDetails, SetUp
from operando.oma.joint import Joint, fit_joint
from operando.oma.matching import Cluster, frequency_limit, likeness, match
from operando.oma.merge import Merged, merge
from operando.oma.setup_findings import joint_findings, listed, setup_findings, unseen_findings
from operando.oma.single import Identification, Options, each_once, identify
from operando.oma.spectra import Spectra
from operando.oma.uncertainty import unit_changes
from operando.oma.verdicts import short_record_findings
from operando.stabilization import RejectedPole, Stabilization

SECOND_LOOK = 0.01
"""How near a pole of a set-up's diagram must lie to a mode of the others to be asked about (relative), as for a choice by hand."""


@dataclass
class _Member:
    """A set-up: its records and sensors, and why it cannot be used, empty where it can."""

    records: list[TimeRecord]
    name: str
    sensors: tuple[Dof, ...]
    failed: str = ""
    hint: str = ""


@dataclass
class _Used:
    """A set-up that is used: what was identified, its modes, and why some of them are left out."""

    setup: _Member
    identification: Identification
    model: ModalModel
    cast_out: dict[int, str] = field(default_factory=dict)


def group_setups(records: Sequence[TimeRecord]) -> list[list[TimeRecord]]:
    """Records by the sensors they hold: those of the same sensors are runs of one set-up."""
    if not records:
        raise DataError("no operating record given")
    groups: dict[frozenset[tuple[Node, str]], list[TimeRecord]] = {}
    for r in records:
        sensors = frozenset(d.key for i in r.response_indices if (d := r.channels[i].dof) is not None)
        groups.setdefault(sensors, []).append(r)
    return list(groups.values())


def fit_setups(groups: Sequence[Sequence[TimeRecord]], options: Options) -> ModalModel:
    """Modes of several set-ups that share sensors.

    Each set-up is identified by itself; modes are matched by frequency and shape at the shared sensors (``matching``) and merged
    (``merge``): this is the answer. A set-up that lacks a mode of the others is asked again at its frequency. One subspace
    identification of all set-ups (``joint``) stands beside, fills shapes where a set-up does not see a mode, and shows how far the answer
    depends on the way. A set-up that cannot be used is left out and said.
    """
    if options.method != "ssi-cov" or not options.uncertainty:
        raise ConfigError(
            "set-ups are weighed by their standard deviations, which only method ssi-cov with uncertainty gives",
            hint="leave method and uncertainty at their defaults, or fit each set-up alone",
        )
    members = [_Member(list(g), _name(g), _sensors(g)) for g in groups]
    _check_connected(members)
    used = [found for m in members if not m.failed and (found := _identify(m, options)) is not None]
    if not used:
        first = next(m for m in members if m.failed)
        raise IdentificationError(f"none of {len(members)} set-ups can be identified: {first.failed}", where=first.name, hint=first.hint)
    for f in options.select_hz:
        if not any(np.any(np.abs(u.model.frequencies_hz - f) <= SECOND_LOOK * f) for u in used):
            raise IdentificationError(
                f"no set-up has a pole near {f:g} Hz chosen by hand", hint="take a frequency from a stabilisation diagram"
            )
    clusters = match([u.model for u in used])
    clusters = _second_look(used, clusters)
    clusters = _seen_twice(used, clusters, options)
    if not clusters:
        raise IdentificationError(
            f"no mode is in two of {len(used)} set-ups", hint="look at each set-up by itself; are they of one structure in one state?"
        )
    seconds = [u.identification.prepared.seconds for u in used]
    blocks = [u.identification.diagram.blocks for u in used]
    merged = merge([u.model for u in used], clusters, seconds, blocks)
    joint, why_not = _joint(used, options)
    partner, check = _beside(merged, joint, why_not)
    merged = _filled(merged, joint, partner)
    return _model(members, used, clusters, merged, joint, check, options)


def _name(group: Sequence[TimeRecord]) -> str:
    return ", ".join(dict.fromkeys(r.name for r in group if r.name)) or "unnamed set-up"


def _sensors(group: Sequence[TimeRecord]) -> tuple[Dof, ...]:
    first = group[0]
    return tuple(DofIndex(d for i in first.response_indices if (d := first.channels[i].dof) is not None))


def _keys(m: _Member) -> set[tuple[Node, str]]:
    return {d.key for d in m.sensors}


def _check_connected(members: list[_Member]) -> None:
    """Marks set-ups that no shared sensor joins to the largest group as failed."""
    left = list(range(len(members)))
    groups: list[list[int]] = []
    while left:
        group = [left.pop(0)]
        for k in group:
            near = [j for j in left if _keys(members[j]) & _keys(members[k])]
            group += near
            left = [j for j in left if j not in near]
        groups.append(group)
    best = max(groups, key=len)
    if len(best) == 1:
        names = "; ".join(f"{m.name}: {listed([str(d) for d in m.sensors])}" for m in members[:4])
        raise DofError(
            f"{len(members)} operating records of different sensors share none ({names})",
            hint="set-ups are merged by the sensors they share: leave at least one sensor where it is, or give one file alone",
        )
    for k, m in enumerate(members):
        if k not in best:
            m.failed = f"shares no sensor with the {len(best)} set-ups that are merged"
            m.hint = "leave at least one sensor where it is in all set-ups, or check the labels of this file"


def _identify(m: _Member, options: Options) -> _Used | None:
    """What a set-up says by itself; None, and the reason noted in it, where that is nothing."""
    own = replace(options, select_hz=(), second_opinion=False)
    if options.references is not None:
        wanted = parse_dofs(options.references)
        have = _keys(m)
        own = replace(own, references=tuple(d for d in wanted if d.key in have) or None)
    try:
        found = identify(m.records, own)
        near = tuple(f for f in options.select_hz if _has_pole(found, f))
        identification = replace(found, options=replace(own, select_hz=near))
        try:
            model = identification.modes()
        except IdentificationError:
            if not near:
                raise
            identification, model = found, found.modes()  # poles there, but no chain of them
    except OperandoError as error:
        m.failed, m.hint = error.message, error.hint or ""
        return None
    if model.covariance is None:
        m.failed = "the record is too short for standard deviations, which weigh set-ups"
        m.hint = "measure this set-up longer"
        return None
    return _Used(m, identification, model)


def _has_pole(identification: Identification, hz: float) -> bool:
    table = identification.diagram.table
    near = np.abs(table.frequency_hz - hz) <= SECOND_LOOK * hz
    return int(np.unique(table.order[near & (table.status < 4)]).size) >= 2


def _second_look(used: list[_Used], clusters: list[Cluster]) -> list[Cluster]:
    """Set-ups asked again for modes that at least two others have; what they find there is taken only where it matches."""
    for k, m in enumerate(used):
        lacking = [c for c in clusters if k not in c.members and len(c.members) >= 2]
        wanted = []
        for c in lacking:
            f = float(np.median([used[j].model.frequencies_hz[i] for j, i in c.members.items()]))
            known = np.abs(m.model.frequencies_hz - f) < 1e-3 * f
            if not known.any() and _has_pole(m.identification, f):
                wanted.append(f)
        if not wanted:
            continue
        try:
            again = m.identification.modes(wanted)
        except OperandoError:
            continue
        new = [i for i in range(again.n_modes) if not np.any(np.abs(m.model.frequencies_hz / again.frequencies_hz[i] - 1) < 1e-3)]
        good = []
        for i in new:
            for c in lacking:
                if all(_one(again, i, used[j].model, q) for j, q in c.members.items()):
                    good.append(i)
                    break
        if good:
            keep = sorted([i for i in range(again.n_modes) if i not in new] + good)
            m.model = again.select_modes(keep)
            clusters = match([u.model for u in used])
    return clusters


def _one(a: ModalModel, i: int, b: ModalModel, j: int) -> bool:
    far = abs(float(a.frequencies_hz[i] - b.frequencies_hz[j])) <= frequency_limit(a, i, b, j)
    return far and likeness(a, i, b, j)[1]


def _seen_twice(used: list[_Used], clusters: list[Cluster], options: Options) -> list[Cluster]:
    """Modes of two set-ups or more, and those chosen by hand; the others are left out of their set-up with the reason."""
    kept = []
    for c in clusters:
        (k, i), *more = c.members.items()
        f = float(used[k].model.frequencies_hz[i])
        if more or any(abs(f - hz) <= SECOND_LOOK * hz for hz in options.select_hz):
            kept.append(c)
            continue
        used[k].cast_out[i] = f"seen in this one of {len(used)} set-ups only"
    return kept


def _joint(used: list[_Used], options: Options) -> tuple[Joint | None, str]:
    if any(isinstance(u.identification.diagram, DecayDiagram) for u in used):
        return None, "free decays have no stationary correlations"
    try:
        return fit_joint([u.identification for u in used], options.band, options.tolerances), ""
    except (OperandoError, np.linalg.LinAlgError) as error:
        return None, error.message if isinstance(error, OperandoError) else str(error)


def _beside(merged: Merged, joint: Joint | None, why_not: str) -> tuple[NDArray[np.int_], JointCheck]:
    """Joint mode of each merged mode (−1 where there is none), and the comparison."""
    n = merged.hz.size
    partner = np.full(n, -1)
    nothing = [np.full(n, np.nan) for _ in range(5)]
    if joint is None:
        return partner, JointCheck(f"no joint estimate: {why_not}", *nothing)
    rows, signs = match_dofs(merged.dofs, joint.dofs)
    shapes = joint.shapes[rows] * np.asarray(signs)[:, None]
    hz, hz_std, zeta, zeta_std, macs = nothing
    free = set(range(joint.hz.size))
    for r in range(n):
        near = [j for j in free if abs(joint.hz[j] - merged.hz[r]) < 0.02 * merged.hz[r]]
        seen = merged.seen[:, r]
        like = {j: float(mac(merged.shapes[seen, r], shapes[seen, j])[0, 0]) for j in near}
        if not like or max(like.values()) < 0.5:
            continue
        j = max(like, key=lambda q: like[q] - abs(joint.hz[q] - merged.hz[r]) / (0.02 * merged.hz[r]))
        free.discard(j)
        partner[r] = j
        hz[r], hz_std[r], zeta[r], zeta_std[r], macs[r] = joint.hz[j], joint.hz_std[j], joint.zeta[j], joint.zeta_std[j], like[j]
    text = "one subspace identification of all set-ups, correlations normalised by the shared sensors (Döhler et al. 2010)"
    return partner, JointCheck(text, hz, hz_std, zeta, zeta_std, macs)


def _filled(merged: Merged, joint: Joint | None, partner: NDArray[np.int_]) -> Merged:
    """Shape values that no set-up with the mode has measured: from the joint estimate, else nought, as uncertain as the largest value."""
    if merged.seen.all():
        return merged
    n, m = merged.hz.size, len(merged.dofs)
    shapes, factor = merged.shapes.copy(), merged.factor
    extra = []
    rows, signs = ([], []) if joint is None else match_dofs(merged.dofs, joint.dofs)
    for r in range(n):
        gap = np.flatnonzero(~merged.seen[:, r])
        if not gap.size:
            continue
        std = np.full(gap.size, float(np.max(np.abs(shapes[:, r]))))
        if joint is not None and partner[r] >= 0:
            other = joint.shapes[rows, partner[r]] * np.asarray(signs)
            there = merged.seen[:, r]
            c = np.vdot(other[there], shapes[there, r]) / np.vdot(other[there], other[there]).real
            shapes[gap, r] = c * other[gap]
            std = abs(c) * joint.shape_std[rows, partner[r]][gap]
        for row, s in zip(gap, std, strict=True):
            for part in (0, n * m):
                column = np.zeros(factor.shape[0])
                column[2 * n + r * m + row + part] = s / np.sqrt(2)
                extra.append(column)
    factor = np.column_stack([factor, *extra])
    k = factor.shape[1]
    parts = factor[2 * n :].reshape(2, n, m, k)
    unit, change = unit_changes(shapes, (parts[0] + 1j * parts[1]).transpose(2, 1, 0))
    flat = change.transpose(0, 2, 1).reshape(k, -1)
    factor = np.concatenate([factor[: 2 * n], flat.real.T, flat.imag.T])
    return replace(merged, shapes=unit, factor=factor)


def _model(
    members: list[_Member],
    used: list[_Used],
    clusters: list[Cluster],
    merged: Merged,
    joint: Joint | None,
    check: JointCheck,
    options: Options,
) -> ModalModel:
    order = np.argsort(merged.hz)
    place = {id(clusters[int(r)]): k for k, r in enumerate(order)}
    setups = tuple(_setup(m, members, used, clusters, place) for m in members)
    identified = [u.identification for u in used]
    widest = max(identified, key=lambda x: x.selection().selected_hz.size)
    stabilization = _diagram(joint.stabilization if joint is not None else widest.selection(), setups, merged.hz[order])
    harmonics = each_once([h for x in identified for h in x.harmonics])
    spectra = _mean_spectra([x.spectra for x in identified])
    settings = widest.settings() | {
        "references": list(dict.fromkeys(r for x in identified for r in x.settings()["references"])),
        "select_hz": [float(f) for f in options.select_hz],
        "runs": sum(len(u.setup.records) for u in used),
        "setups": len(used),
        "merged_by": "set-up by set-up (PoSER), joint estimate beside" if joint is not None else "set-up by set-up (PoSER)",
    }
    stacked = ModalModel(
        merged.hz,
        merged.zeta,
        merged.shapes,
        merged.dofs,
        "unscaled",
        in_band=(merged.hz >= options.band[0]) & (merged.hz <= options.band[1]),
        covariance=merged.factor @ merged.factor.T,
        band_hz=options.band,
    )
    model = stacked.select_modes(order)
    joint_in_order = JointCheck(check.text, *(getattr(check, k)[order] for k in _CHECKED))
    seen = merged.seen[:, order]
    findings = [
        *[f if f.file else replace(f, file=u.setup.name) for u in used for f in u.model.findings if f.kind != "short_record"],
        *([_NOT_ASKED] if options.second_opinion else []),
        *short_record_findings(model.frequencies_hz, model.damping_ratios, float(np.sum([x.prepared.seconds for x in identified]))),
        *setup_findings(setups, [m.hint for m in members], model),
        *unseen_findings(model, seen, joint_in_order),
        *joint_findings(model, joint_in_order),
    ]
    call = ", ".join(f"{k}={v!r}" for k, v in settings.items())
    provenance = Provenance.merge(*(r.provenance for u in used for r in u.setup.records)).then(f"fit_oma({call})")
    details = OmaDetails(
        stabilization,
        np.array([h.hz for h in harmonics]),
        spectra,
        None,
        np.zeros(0, int),
        settings,
        setups=setups,
        joint=joint_in_order,
    )
    return replace(model, findings=tuple(dict.fromkeys(findings)), provenance=provenance, details=details)


_NOT_ASKED = Finding(
    "no_second_opinion",
    "pyOMA-2 is not asked where set-ups are merged",
    "info",
    action="run one set-up alone with second_opinion",
)


_CHECKED = ("frequencies_hz", "frequency_std_hz", "damping_ratios", "damping_ratio_std", "mac")


def _setup(m: _Member, members: list[_Member], used: list[_Used], clusters: list[Cluster], place: dict[int, int]) -> SetUp:
    """What is stated of a set-up."""
    elsewhere = {key for other in members if other is not m for key in _keys(other)}
    shared = tuple(str(d) for d in m.sensors if d.key in elsewhere)
    sensors = tuple(str(d) for d in m.sensors)
    k = next((i for i, u in enumerate(used) if u.setup is m), None)
    if k is None:
        return SetUp(m.name, sensors, shared, failed=m.failed)
    model = used[k].model
    belongs = np.full(model.n_modes, -1)
    for c in clusters:
        if k in c.members:
            belongs[c.members[k]] = place[id(c)]
    reasons = tuple(used[k].cast_out.get(i, "") for i in range(model.n_modes))
    f_std, z_std = model.frequency_std_hz, model.damping_ratio_std
    assert f_std is not None
    assert z_std is not None
    return SetUp(
        m.name,
        sensors,
        shared,
        model.frequencies_hz,
        f_std,
        model.damping_ratios,
        z_std,
        belongs,
        reasons,
        model.details.stabilization,
    )


def _diagram(stabilization: Stabilization, setups: Sequence[SetUp], hz: NDArray[np.float64]) -> Stabilization:
    """The diagram to draw, with the modes that only one set-up has among the rejected ones."""
    gone = [
        RejectedPole(float(s.frequencies_hz[i]), float(s.damping_ratios[i]), "one_setup", f"{s.name}: {reason}")
        for s in setups
        for i, reason in enumerate(s.reasons)
        if reason
    ]
    odd = [
        RejectedPole(float(f), float(z), "joint_only", "a mode of the joint estimate that no two set-ups have by themselves")
        for f, z in zip(stabilization.selected_hz, stabilization.selected_damping, strict=True)
        if not np.any(np.abs(hz / f - 1) < 0.02)
    ]
    return replace(stabilization, rejected=tuple(sorted((*stabilization.rejected, *gone, *odd), key=lambda r: r.frequency_hz)))


def _mean_spectra(spectra: Sequence[Spectra]) -> Spectra:
    """Singular values of all set-ups, geometric mean on the lines of the first."""
    first = spectra[0]
    n = min(s.singular_values.shape[0] for s in spectra)
    tiny = 1e-300
    hz = first.frequencies_hz
    logs = [[np.interp(hz, s.frequencies_hz, np.log(np.maximum(row, tiny))) for row in s.singular_values[:n]] for s in spectra]
    return Spectra(hz, np.exp(np.mean(logs, axis=0)))

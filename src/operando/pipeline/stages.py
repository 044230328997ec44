"""What each stage does: pure in its inputs, settings and upstream results; each returns fields of ``Results``."""

from __future__ import annotations

import inspect as introspection
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from operando.config import Analysis, State, Test
from operando.data import Finding, Frf, TimeRecord
from operando.errors import MissingError
from operando.pipeline.inputs import Inputs
from operando.pipeline.names import FREQUENCIES
from operando.pipeline.scale import no_scale
from operando.results import CheckRun, Results


class Lacking(MissingError):
    """What a stage needs is not in the data: it is left out and said, which is no failure."""


@dataclass
class Work:
    """One run of the pipeline: the test, its files, what is known so far, and who is told of progress inside a stage."""

    test: Test
    inputs: Inputs
    results: Results
    say: Callable[[str], None] | None = None

    @property
    def analysis(self) -> Analysis:
        """Settings."""
        return self.test.analysis


@dataclass(frozen=True)
class Stage:
    """A step of the pipeline.

    Parameters
    ----------
    name : str
        Name in the cache.
    part_of : str
        Stage of the contract it belongs to.
    does : callable
        ``Work`` → fields of ``Results`` it fills (and ``findings``, those of the stage itself).
    lacks : callable
        ``Test`` → why the stage is left out, or None.
    upstream : tuple of str
        Stages whose results it uses.
    rooms : tuple of str
        Rooms of operando whose code decides the result.
    settings : tuple of str
        Names in [analysis] that decide the result.
    states : tuple of str
        States whose files it reads.
    optional : bool
        Whether the run still counts as done when this stage fails.
    """

    name: str
    part_of: str
    does: Callable[[Work], dict[str, Any]]
    lacks: Callable[[Test], str | None] = field(default=lambda test: None)
    upstream: tuple[str, ...] = ()
    rooms: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()
    states: tuple[str, ...] = ()
    optional: bool = False


def offered(function: Callable[..., Any], findings: list[Finding], **keywords: Any) -> dict[str, Any]:
    """The keywords that have a value and that the function knows; one it does not know becomes a finding."""
    known = introspection.signature(function).parameters
    given = {key: value for key, value in keywords.items() if value is not None and value != ()}
    for key in given:
        if key not in known:
            message = f"setting {key} has no effect on {function.__name__}"
            findings.append(Finding("setting_unused", message, "warning", consequence="this stage runs as if it were not set"))
    return {key: value for key, value in given.items() if key in known}


def inspect_files(work: Work) -> dict[str, Any]:
    """Inventory, geometry, findings of all files; names in the test file that no file has end the run."""
    inventory = work.inputs.inventory()
    work.inputs.check_names()
    work.inputs.check_hits(inventory)
    geometry = work.inputs.geometry()
    findings = [*work.inputs.all_findings(), *work.inputs.check_geometry(geometry)]
    for name, state in work.test.states.items():
        if state and not any(work.inputs.readable(file) for file in state.files):
            unread = work.inputs.findings[state.files[0]][0]
            where = f"{work.test.where(name, 'records' if state.records else 'frfs')}: {', '.join(f.name for f in state.files[:4])}"
            raise MissingError(
                f"no file of [{name}] can be read: {unread.message.removeprefix('cannot be read: ')}", where=where, hint=unread.action
            )
    if geometry is None:
        message = "no geometry in the files"
        findings.append(
            Finding(
                "no_geometry", message, "info", consequence="mode shapes are drawn as bars", action="give [geometry] file in the test file"
            )
        )
    return {"inventory": inventory, "geometry": geometry, "findings": findings}


def idle_frf(work: Work) -> dict[str, Any]:
    """Idle FRFs, estimated or as given, with drive-point, reciprocity and coherence checks."""
    from operando.frf import check_frf

    idle = work.test.idle
    findings: list[Finding] = []
    if idle.frfs:
        frf = work.inputs.frf(idle)
        if work.analysis.references is not None:
            frf = frf.select(references=work.analysis.references)
    else:
        frf = estimate(work.inputs.records(idle, force=True), work.analysis, findings, work.test.rejected_hits(idle))
    return {"idle_frf": check_frf(frf, work.analysis.band), "findings": findings}


def estimate(records: list[TimeRecord], analysis: Analysis, findings: list[Finding], rejected: Sequence[str] = ()) -> Frf:
    """``estimate_frf`` with the settings of the test; of the hits rejected by hand those in these records."""
    from operando.frf import estimate_frf

    keywords = offered(
        estimate_frf,
        findings,
        references=analysis.references,
        estimator=analysis.estimator,
        block_seconds=analysis.block_seconds,
        overlap=analysis.overlap,
        window=analysis.window,
        hits=analysis.hits,
        hits_reject=of_records(rejected, records),
    )
    return estimate_frf(records, **keywords)


def of_records(rejected: Sequence[str], records: Sequence[TimeRecord]) -> tuple[str, ...]:
    """Those of the hits named ``FILE#NUMBER`` that are in these records."""
    names = {record.name for record in records}
    return tuple(text for text in rejected if text.rpartition("#")[0] in names)


def whole_records(
    work: Work, state: State, findings: list[Finding], choose: Callable[[list[TimeRecord]], list[TimeRecord]] = list
) -> list[TimeRecord]:
    """The records of a state with force, or those chosen of them, for fits of whole records: without the hits rejected by hand."""
    from operando.frf import without_hits

    records = choose(work.inputs.records(state, force=True))
    kept, found = without_hits(records, of_records(work.test.rejected_hits(state), records))
    findings += found
    return kept


def automatic_modes(work: Work) -> dict[str, Any]:
    """Idle modes of unit modal mass, chosen automatically."""
    from operando.ema import fit_ema

    analysis = work.analysis
    findings: list[Finding] = []
    frf = _needed(work.results.idle_frf, "idle FRFs")
    records = whole_records(work, work.test.idle, findings, lambda all_: runs_behind(frf, all_)) if work.test.idle.records else None
    found = fit_ema(
        frf,
        band=analysis.band,
        exclude_bands=analysis.exclude_bands,
        records=records,
        max_order=analysis.max_order,
        ema=analysis.ema,
        second_opinion=analysis.second_opinion,
        progress=work.say,
    )
    return {"automatic": found, "findings": findings}


def idle_modes(work: Work) -> dict[str, Any]:
    """The automatic modes, with those named by hand."""
    from operando.ema import fit_ema

    analysis = work.analysis
    automatic = _needed(work.results.automatic, "idle modes")
    if not (analysis.modes_hz or analysis.select_hz or analysis.reject_hz):
        return {"idle": automatic}
    frf = _needed(work.results.idle_frf, "idle FRFs")
    by_hand = fit_ema(
        frf,
        band=analysis.band,
        exclude_bands=analysis.exclude_bands,
        modes_hz=analysis.modes_hz,
        select_hz=analysis.select_hz,
        reject_hz=analysis.reject_hz,
        automatic=automatic,
    )
    return {"idle": by_hand}


def runs_behind(frf: Frf, records: list[TimeRecord]) -> list[TimeRecord]:
    """The runs and channels the FRFs were made of: what was set aside there must not come back through the raw spectra."""
    used = {path for path, _ in frf.provenance.inputs}
    calls = set(frf.provenance.calls)

    def behind(record: TimeRecord) -> bool:
        cuts = [call for call in record.provenance.calls if call.startswith("cut(")]  # of two parts of a file one may be used
        return any(path in used for path, _ in record.provenance.inputs) and all(call in calls for call in cuts)

    runs = [r for r in records if behind(r)] or records
    measured, driven = ({(d.node, d.axis) for d in dofs} for dofs in (frf.responses, frf.references))
    out = []
    for run in runs:
        at = [None if (d := c.dof) is None else (d.node, d.axis) for c in run.channels]
        keep = [i for i in run.response_indices if at[i] in measured] + [i for i in run.force_indices if at[i] in driven]
        if len(keep) == len(run.response_indices) + len(run.force_indices):
            out.append(run)
        elif all(at[i] in driven for i in run.force_indices) and any(i in keep for i in run.response_indices):
            out.append(run.select(sorted(keep)))
    return out


def operational_modes(work: Work) -> dict[str, Any]:
    """Operational modes, complex and unscaled."""
    from operando.oma import fit_halves, fit_oma

    analysis = work.analysis
    records = work.inputs.records(work.test.operating, force=False)
    findings: list[Finding] = []
    keywords = offered(
        fit_oma,
        findings,
        band=analysis_band(work),
        max_order=analysis.oma_max_order,
        references=analysis.oma_references,
        known_harmonics_hz=analysis.known_harmonics_hz,
        select_hz=analysis.oma_select_hz,
        reject_hz=analysis.oma_reject_hz,
        exclude_bands=analysis.exclude_bands,
        second_opinion=analysis.second_opinion or None,
    )
    operating = fit_oma(records, **keywords)
    if work.test.idle and not work.test.check:
        # The diagnosis from operating modes chooses on one half of the record and is judged on the other.
        operating = replace(operating, details=replace(operating.details, halves=fit_halves(records, operating)))
    return {"operating": operating, "findings": findings}


def analysis_band(work: Work) -> tuple[float, float] | None:
    """The band of the test, else the one the idle modes were fitted in, so that both states have the same."""
    return work.analysis.band or (None if work.results.idle is None else work.results.idle.band_hz)


def hybrid(work: Work) -> dict[str, Any]:
    """Operational modes with the scale of the idle ones."""
    from operando.scaling import scale_operational

    idle = _needed(work.results.idle, "idle modes")
    operating = _needed(work.results.operating, "operational modes")
    if (cause := no_scale(idle, work.results.findings)) is not None:
        raise Lacking(f"the idle modes are not scaled to unit modal mass, so there is no scale to carry over: {cause[0]}", hint=cause[1])
    from operando.quality import check_shapes

    made = scale_operational(idle, operating, work.analysis.threshold, work.analysis.scaling)
    pairs = [(p.idle, p.operating) for p in made.pairing.pairs if p.idle is not None]
    return {"hybrid": made, "findings": check_shapes(idle, operating.without_residuals(), pairs)}


def check_runs(work: Work) -> dict[str, Any]:
    """Check FRFs: all runs in one where they agree, else by level."""
    from operando.frf import check_frf
    from operando.pipeline.levels import check_frfs

    check = work.test.check
    findings: list[Finding] = []
    runs: list[CheckRun] = []
    if check.records:
        records = work.inputs.records(check, force=True)
        rejected = work.test.rejected_hits(check)
        runs = check_frfs(records, lambda part: estimate(part, _judging(work.analysis), findings, rejected))
    for file in check.frfs:
        runs.append(CheckRun(work.inputs.label(file), "as given", work.inputs.frf(State(frfs=(file,)))))
    checked = [replace(run, frf=_of_check(check_frf(run.frf, work.analysis.band))) for run in runs]
    return {"check": checked, "findings": list(dict.fromkeys(findings))}


def _of_check(frf: Frf) -> Frf:
    """Findings that say that they are about the check measurement."""
    return replace(frf, findings=tuple(replace(f, message=f"check measurement: {f.message}") for f in frf.findings))


def _judging(analysis: Analysis) -> Analysis:
    """Settings of the check FRFs: the references of the idle FRFs do not bind them."""
    return replace(analysis, references=None)


def comparison(work: Work) -> dict[str, Any]:
    """Idle model, baselines and operational FRFs against the check."""
    from operando.compare import compare_all

    results, findings = work.results, []
    models: dict[str, Any] = {}
    if results.idle is not None and results.idle.scaling == "unit_modal_mass" and results.idle.si:
        models["idle"] = results.idle
    if results.hybrid is not None:
        named = {name: results.hybrid.alternative_models.get(name) for name in ("idle_shapes", "msf_all")} | {"ofrf": results.hybrid.modal}
        for name, model in named.items():
            if model is not None:
                # the idle model's variance judges all models alike (contract), so that of the others is not worth its cost
                models[name] = replace(model, covariance=None, std=None) if "idle" in models else model
            else:
                message = f"baseline {name} cannot be made from these modes"
                findings.append(Finding("baseline_failed", message, "warning", consequence="it is not compared"))
    if not models:
        raise Lacking("no scaled model to compare with the check", hint="the idle modes need units ([units]) and a drive point")
    if not results.check:
        raise MissingError("no check FRF")
    band = analysis_band(work)
    if results.idle_frf is not None:
        from operando.quality import check_gains

        findings += [f for run in results.check for f in check_gains(results.idle_frf, run.frf, run.name, band)]
    runs = [replace(run, frf=run.frf.without_bands(work.analysis.exclude_bands)) for run in results.check]
    document = compare_all(models, runs, band_hz=band)
    return {"comparison": document | {"settings": results.settings}, "findings": findings}


def missing_physics(work: Work) -> dict[str, Any]:
    """Where the idle model fails in operation and which effect is missing; the comparison gains the idle model with it."""
    from operando.compare import with_effect
    from operando.diagnose import Model, diagnose

    results = work.results
    idle = _needed(results.idle, "idle modes")
    if (cause := no_scale(idle, work.results.findings)) is not None:
        raise Lacking(f"the idle modes have no scale, so no effect has a size: {cause[0]}", hint=cause[1])
    runs = [replace(run, frf=run.frf.without_bands(work.analysis.exclude_bands)) for run in results.check]
    if not runs and results.operating is None:
        raise Lacking("there are neither check FRFs nor operational modes")
    findings: list[Finding] = []
    found = diagnose(
        idle,
        check=runs,
        operating=results.operating,
        geometry=results.geometry,
        hybrid=results.hybrid,
        kinds=work.analysis.kinds or None,
        places=work.analysis.places or None,
        band=analysis_band(work),
        progress=work.say,
        records=whole_records(work, work.test.check, findings) if runs and work.test.check.records else (),
        idle_frf=None if results.idle_frf is None else results.idle_frf.without_bands(work.analysis.exclude_bands),
        exclude_bands=work.analysis.exclude_bands,
    )
    document = found.to_dict()
    comparison = results.comparison
    model = found.model or Model(idle, tuple(found.effects), results.geometry)
    if runs and comparison is not None and found.effects:
        bare = Model(replace(model.idle, covariance=None, std=None), model.effects, model.geometry)
        comparison = with_effect(comparison, idle, bare, runs, analysis_band(work))
    made: dict[str, Any] = {
        "diagnosis": document,
        "comparison": comparison,
        "effect_idle": model.idle,
        "effect_covariance": model.covariance,
        "findings": findings,
    }
    # A place between sensors at which an effect was found is a node from here on.
    return made if model.geometry is None else made | {"geometry": model.geometry}


def _needed(value: Any, what: str) -> Any:
    if value is None:
        raise MissingError(f"there are no {what}")
    return value


def no_idle(test: Test) -> str | None:
    """Why a stage of the idle state is left out."""
    return None if test.idle else "the test has no [idle] measurement"


def no_operation(test: Test) -> str | None:
    """Why a stage of the operating state is left out."""
    return None if test.operating else "the test has no [operating] records"


def no_both(test: Test) -> str | None:
    """Why a stage that needs both states is left out."""
    return no_idle(test) or no_operation(test)


def no_check(test: Test) -> str | None:
    """Why the comparison is left out."""
    return no_idle(test) or (None if test.check else "the test has no [check] measurement")


def no_evidence(test: Test) -> str | None:
    """Why the diagnosis is left out."""
    return no_idle(test) or (None if test.check or test.operating else "the test has neither [check] nor [operating] measurements")


READING = ("data", "io", "quality", "frf/usable", "dof", "units", "pipeline/inputs", "pipeline/names", "pipeline/stages")
ESTIMATING = ("references", "estimator", "block_seconds", "overlap", "window", "hits", "hits_reject")

_EMA_SETTINGS = ("band", "hits_reject", "max_order", "ema", "exclude_bands", "second_opinion")
_OMA_SETTINGS = ("oma_max_order", "oma_references", "known_harmonics_hz", "oma_select_hz", "oma_reject_hz")
_EMA_ROOMS = (*READING, "ema", "stabilization", "synthesis", "indicators", "frf/hits", "frf/leakage", "frf/excitation", "frf/periodic")
_OMA_ROOMS = (*READING, "oma", "stabilization", "indicators")

STEPS: tuple[Stage, ...] = (
    Stage(
        "inspect",
        "inspect",
        inspect_files,
        rooms=(*READING, "frf/hits"),
        settings=("hits_reject", "references", "oma_references", "band", "exclude_bands", "places", *FREQUENCIES),
        states=("idle", "operating", "check", "geometry"),
    ),
    Stage("frf", "frf", idle_frf, no_idle, rooms=(*READING, "frf"), settings=ESTIMATING, states=("idle",)),
    Stage("automatic", "ema", automatic_modes, no_idle, ("frf",), _EMA_ROOMS, _EMA_SETTINGS, ("idle",)),
    Stage(
        "ema",
        "ema",
        idle_modes,
        no_idle,
        ("frf", "automatic"),
        _EMA_ROOMS,
        (*_EMA_SETTINGS, "modes_hz", "select_hz", "reject_hz"),
        ("idle",),
    ),
    Stage(
        "oma",
        "oma",
        operational_modes,
        no_operation,
        (),
        _OMA_ROOMS,
        ("band", "exclude_bands", "second_opinion", *_OMA_SETTINGS),
        ("operating",),
    ),
    Stage(
        "ofrf",
        "ofrf",
        hybrid,
        no_both,
        ("ema", "oma"),
        ("scaling", "synthesis", "quality", "pipeline/scale", "pipeline/stages"),
        ("threshold", "scaling"),
    ),
    Stage("check", "compare", check_runs, no_check, (), (*READING, "frf", "pipeline/levels"), ESTIMATING, ("check",), optional=True),
    Stage(
        "compare",
        "compare",
        comparison,
        no_check,
        ("ema", "ofrf", "check"),
        ("compare", "scaling", "quality", "pipeline/stages"),
        ("band", "threshold", "exclude_bands"),
        optional=True,
    ),
    Stage(
        "diagnose",
        "diagnose",
        missing_physics,
        no_evidence,
        ("ema", "oma", "ofrf", "check", "compare"),
        ("diagnose", "effects", "nonlinear", "compare", "pipeline/stages"),
        ("band", "exclude_bands", "hits_reject", "kinds", "places"),
        optional=True,
    ),
)

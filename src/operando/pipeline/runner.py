"""Run the stages of a test: cached, resumable, with everything that was left out said."""

from __future__ import annotations

import time
import traceback
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from operando.atomic import replacing
from operando.config import Test, load_test
from operando.data import Finding, group_findings, once_of_a_sense
from operando.errors import ConfigError, OperandoError, WriteError
from operando.jsonable import jsonable
from operando.own_effects import effects_hash
from operando.paths import path_of
from operando.pipeline import STAGES
from operando.pipeline.again import Progress, results_go_to
from operando.pipeline.cache import Kept, apart, in_model, load_stage, save_stage, stage_file
from operando.pipeline.code import code_hash
from operando.pipeline.folder import MODEL, ResultsFolder, default_folder, key_of, results_folder
from operando.pipeline.inputs import Inputs
from operando.pipeline.names import UnfitTest
from operando.pipeline.outputs import OUTPUTS, Output
from operando.pipeline.stages import STEPS, Lacking, Stage, Work, none_read
from operando.results import Results
from operando.threads import one_blas_thread


def run(
    test: Test | str | Path,
    out: str | Path | None = None,
    *,
    until: str | None = None,
    progress: Progress | None = None,
    report: bool | None = None,
) -> Results:
    """Run a test from its files to the results folder.

    A stage is not run again as long as its files (by content), its settings, the stages it builds on and the code are the
    same. A stage whose data the test lacks is left out; one that fails becomes a finding of severity ``error``, and what does
    not build on it goes on. Both stand in ``Results.left_out`` with the reason.

    The files of the folder change together when all stages are done: a run that ends before, however it does, leaves them as they
    were, and the next one goes on from the last finished stage. A file that is missing or no longer what a run made is made again.

    Parameters
    ----------
    test : Test or path
        Test or test file.
    out : path, optional
        Results folder; made where it is missing. Default: ``results/NAME`` in the current folder, as on the command line.
    until : str, optional
        Last stage to run, one of ``STAGES``.
    progress : callable, optional
        Called with (stage, message); messages from inside a stage begin with two blanks.
    report : bool, optional
        Whether the report is written, of whatever there is. Default: where ``until`` does not end the run before it.

    Returns
    -------
    Results
        What all stages found, as stored in ``model.h5``.

    Raises
    ------
    ConfigError
        If the test file is wrong or the stage is unknown.
    BusyError
        If another process is at work in the results folder.
    WriteError
        If the results folder cannot be written.

    Examples
    --------
    >>> import tempfile, operando
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     operando.write_uff(f"{folder}/idle.uff", operando.Frf([[range(1, 99)]], range(5, 103), "1+Z", "1+Z"))
    ...     _ = Path(folder, "test.toml").write_text('name = "pump"\\n[idle]\\nfrfs = ["idle.uff"]')
    ...     operando.run(folder, f"{folder}/results", until="inspect").inventory[0]["file"]
    'idle.uff'
    """
    if not isinstance(test, Test):
        test = load_test(path_of(test, "a test is run from its test file", "give the path of test.toml, or load_test(path)"))
    if until is not None and until not in STAGES:
        raise ConfigError(f"unknown stage {until!r}", where="until", hint="stages: " + ", ".join(STAGES))
    check_progress(progress)
    out = default_folder(test.name) if out is None else path_of(out, "results go into a folder")
    results_go_to(out)
    with results_folder(out, "run", make=True) as folder:
        folder.came_from(test.path, progress)
        return run_in(folder, test, until, progress, report)[0]


def check_progress(progress: object) -> None:
    """Refuse what cannot be called with the progress of a run."""
    if progress is not None and not callable(progress):
        raise ConfigError(f"progress is {progress!r:.60}, which cannot be called", hint="give a function of what is said, as print")


def run_in(
    folder: ResultsFolder, test: Test, until: str | None, progress: Progress | None, report: bool | None
) -> tuple[Results, list[tuple[str, str]] | None, list[str]]:
    """Run a test in a results folder that this process holds.

    Beside the results stands what a run says that finds nothing changed (None where something would be tried again), and the names of the
    files of a results folder that these results do not have.
    """
    with one_blas_thread():
        this = _Run(test, folder, progress or (lambda stage, message: None))
        results = this.all(until, report)
    unwanted = [output.name for output in OUTPUTS if not (folder.path / output.name).exists()]
    return results, None if this.unfinished else this.said, ["errors.log", *unwanted]


def used_settings(stage: str, results: Results) -> dict[str, Any]:
    """What a stage chose where the test file leaves it to the data."""
    if stage == "frf" and results.idle_frf is not None:
        frf = results.idle_frf
        calls = [call for call in frf.provenance.calls if not call.startswith("read ")]
        return {"calls": calls, "averages": frf.averages, "lines": len(frf.axis)}
    model = {"ema": results.idle, "oma": results.operating}.get(stage)
    if model is not None:
        chosen = getattr(model.details, "settings", None) or {}
        fitted = {} if getattr(model.details, "fit_band_hz", None) is None else {"fit_band_hz": model.details.fit_band_hz}
        used: dict[str, Any] = jsonable({"band": model.band_hz, **fitted, **chosen})
        return used
    if stage == "ofrf" and results.hybrid is not None:
        return {"scaling": results.hybrid.method, "threshold": results.hybrid.threshold}
    return {}


UNCHANGED = "unchanged, taken from the last run"


class _Run:
    """State of one call of :func:`run`."""

    def __init__(self, test: Test, folder: ResultsFolder, progress: Progress) -> None:
        self.test, self.folder, self.progress = test, folder, progress
        self.work = Work(test, Inputs(test), Results(test.name, settings=test.settings()))
        self.keys: dict[str, str] = {}
        self.kept: dict[str, Kept] = {}
        self.own_findings: list[Finding] = []
        self.said: list[tuple[str, str]] = []  # what a run says that finds nothing changed
        self.unfinished = False  # whether the next run tries something again
        self.log = ""

    @property
    def results(self) -> Results:
        return self.work.results

    def all(self, until: str | None, report: bool | None = None) -> Results:
        """All stages up to ``until``, later ones only where their stored results still hold; then the files, all at once."""
        last = len(STAGES) if until is None else STAGES.index(until) + 1
        for stage in STEPS:
            if not stage.wanted(self.test):
                continue
            self.keys[stage.name] = self._key(stage)
            self._step(stage, asked=STAGES.index(stage.part_of) < last)
        self._write_outputs(last == len(STAGES) if report is None else report)
        return self.results

    def _key(self, stage: Stage) -> str:
        test = self.test
        settings = {name: getattr(test.analysis, name) for name in stage.settings}
        if stage.name == "diagnose":
            settings["between"] = dict(test.between)
            if test.effects:
                settings["effects"] = effects_hash(test.effects)
        files = []
        for name in stage.states:
            state = (() if test.geometry_file is None else (test.geometry_file,)) if name == "geometry" else getattr(test, name).files
            files.append((name, self.work.inputs.hashes(state)))
        reading = (test.units, test.channels, test.geometry_units, test.directions) if stage.states else ()
        spans = {name: [repr(span) for span in getattr(test, name).spans] for name in stage.states if name != "geometry"}
        upstream = [self.keys[name] if name in self.kept else None for name in stage.upstream]
        if stage.name == "oma" and test.analysis.band is None and "ema" in self.kept:
            upstream.append(self.keys["ema"])  # its band is that of the idle modes
        if stage.name == "oma" and test.idle and not test.check:
            upstream.append("halves")  # for the diagnosis from operational modes alone
        return key_of(stage.name, code_hash(stage.does.__module__), files, spans, reading, settings, upstream)

    def _step(self, stage: Stage, asked: bool) -> None:
        lacks = stage.lacks(self.test) or self._upstream_missing(stage) or self._unread(stage)
        if lacks is not None:
            if asked and stage.part_of not in self.results.left_out:
                self.results.left_out[stage.part_of] = lacks
                self.said.append((stage.part_of, f"left out: {lacks}"))
                self.progress(*self.said[-1])
            return
        kept = load_stage(self.folder, stage.name, self.keys[stage.name])
        if kept is not None:
            self._take(stage, kept)
            if asked:
                self.said.append((stage.part_of, UNCHANGED + stage.which))
                self.progress(*self.said[-1])
        elif asked:
            self._make(stage)

    def _make(self, stage: Stage) -> None:
        """Run a stage and keep its result."""
        if self.folder.key(stage_file(stage.name)) == self.keys[stage.name]:
            self.progress(stage.part_of, f"the kept result ({stage.name}) is missing or damaged: made again")
        else:
            self.progress(stage.part_of, "…" if stage.name == stage.part_of else f"{stage.name} …")
        self.work.say = lambda message: self.progress(stage.part_of, f"  {message}")
        started = time.perf_counter()
        try:
            found = stage.does(self.work)
            seconds = time.perf_counter() - started
            kept = save_stage(self.folder, stage.name, self.keys[stage.name], found, seconds)
        except Lacking as error:
            reason = error.message + (f" ({error.hint})" if error.hint else "")
            self.results.left_out[stage.part_of] = reason
            self.unfinished = True
            self.progress(stage.part_of, f"left out: {reason}")
        except (UnfitTest, WriteError):
            raise
        except OperandoError as error:
            self._failed(stage.part_of, error)
        except (MemoryError, Exception) as error:  # one failing part must not lose the rest
            self._failed(stage.part_of, self._unexpected(stage.name, error))
        else:
            self._take(stage, kept)
            self.said.append((stage.part_of, UNCHANGED + stage.which))
            self.progress(stage.part_of, f"done in {seconds:.1f} s")

    def _upstream_missing(self, stage: Stage) -> str | None:
        # the comparison judges whatever model there is
        needed = {"compare": ("ema", "check"), "diagnose": ("ema",)}.get(stage.name, stage.upstream)
        missing = [name for name in needed if name not in self.kept]
        words = {
            "frf": "idle FRFs",
            "automatic": "idle modes",
            "ema": "idle modes",
            "oma": "operational modes",
            "ofrf": "scaled modes",
            "check": "validation FRFs",
        }
        return f"it needs the {' and the '.join(words[m] for m in missing)}" if missing else None

    def _unread(self, stage: Stage) -> str | None:
        """Why a stage is not run whose files the first one found unreadable: it would fail for the same cause."""
        if stage.name == "inspect" or "inspect" in self.kept:
            return None
        unread = [name for name in self.work.inputs.unread() if name in stage.states]
        return f"not run because {none_read(unread)}" if unread else None

    def _take(self, stage: Stage, kept: Kept) -> None:
        names = {f.name for f in fields(Results)} - {"findings"}
        for name, value in kept.found.items():
            if name in names:
                setattr(self.results, name, value)
        self.results.timings_s[stage.part_of] = self.results.timings_s.get(stage.part_of, 0.0) + kept.seconds
        self.own_findings += kept.found.get("findings", [])
        used = used_settings(stage.name, self.results)
        if used:
            self.results.settings.setdefault("used", {})[stage.name] = used
        self.kept[stage.name] = kept
        self._gather_findings()  # later stages say by them why they lack something

    def _failed(self, part: str, error: OperandoError, file: str | None = None) -> None:
        self.unfinished = True
        text = error.message if file is None else f"{file} cannot be written: {error.message}"
        self.progress(part, f"failed: {text}")
        if file in (None, "report.html"):
            self.results.left_out[part] = f"failed: {text}"
        self.own_findings.append(
            Finding(
                "stage_failed",
                f"stage {part}: {text}",
                "error",
                file=error.where,
                consequence="what builds on it is left out" if file is None else "the results stand in model.h5",
                action=error.hint or "",
            )
        )

    def _unexpected(self, what: str, error: BaseException) -> OperandoError:
        log = self.folder.path / "errors.log"
        self.log += f"{time.strftime('%Y-%m-%d %H:%M:%S')} {what}\n{''.join(traceback.format_exception(error))}\n"
        with replacing(log, "w", encoding="utf-8") as stream:
            stream.write(self.log)
        return OperandoError(f"unexpected {type(error).__name__}: {error}", hint=f"a fault of the program; the traceback is in {log}")

    def _gather_findings(self) -> None:
        r = self.results
        carried = [o.findings for o in (r.idle_frf, r.idle, r.operating, r.hybrid) if o is not None]
        carried += [run.frf.findings for run in r.check]
        r.findings = group_findings(once_of_a_sense([*self.own_findings, *(f for group in carried for f in group)]))

    def _write_outputs(self, report: bool) -> None:
        """Make the files that are missing, or not of these results; then all of them take their places at once."""
        drop: list[str] = []
        self.results.stages = {name: kept.rest(self.results) for name, kept in self.kept.items()}
        for output in OUTPUTS:
            if output.stage is not None and output.stage not in self.kept:
                drop.append(output.name)
                continue
            self._gather_findings()
            key = self._output_key(output)
            entry = self.folder.entry(output.name, key)
            if entry is not None:
                self._take_output(output, [Finding(**finding) for finding in entry.get("findings", [])], entry.get("seconds", 0.0))
                if output.name == "report.html" and report:
                    self.progress("report", UNCHANGED)
            elif output.name == "report.html" and not report:
                drop.append(output.name)  # it would show results that no longer hold
            else:
                self._write(output, key, drop)
        self.folder.commit(drop if self.log else [*drop, "errors.log"], self._in_model(drop))
        if report:
            self.said.append(("report", UNCHANGED))

    def _in_model(self, drop: list[str]) -> dict[str, dict[str, Any]]:
        """Entries of the stages done, which stand in ``model.h5`` with the next commit; those of others that stood in it get files."""
        model = self.folder.model_hash()
        if model is None or MODEL in drop:
            return {}
        standing = in_model(self.kept, self.keys, self.results, model)
        if any(entry["model"] != model for entry in self.folder.all_standing().values()):
            apart(self.folder, self.kept)
        return standing

    def _write(self, output: Output, key: str, drop: list[str]) -> None:
        part = "report" if output.name == "report.html" else "store"
        if self.folder.key(output.name) == key:
            self.progress(part, f"{output.name} is missing or changed since the last run: made again")
        elif output.name in ("report.html", "model.h5"):  # the others take no time
            self.progress(part, "…")
        started = time.perf_counter()
        try:
            findings = self.folder.stage(output.name, key, output.of(self.results))
        except WriteError:
            raise
        except (OperandoError, Exception) as error:
            drop.append(output.name)
            told = error if isinstance(error, OperandoError) else self._unexpected(output.name, error)
            self._failed("report" if part == "report" else output.stage or part, told, output.name)
            return
        seconds = time.perf_counter() - started
        self.folder.note(output.name, findings=[asdict(finding) for finding in findings], seconds=seconds)
        self._take_output(output, findings, seconds)
        if part == "report":
            self.progress("report", f"done in {seconds:.1f} s")

    def _take_output(self, output: Output, findings: list[Finding], seconds: float) -> None:
        self.own_findings += findings
        if output.name == "report.html":
            self.results.timings_s["report"] = seconds

    def _output_key(self, output: Output) -> str:
        """Key of what a file tells."""
        r = self.results
        if output.name == "timings.json":
            return key_of(r.timings_s)
        told = (r.settings, r.left_out, [f.to_dict() for f in r.findings]) if output.whole else ()
        made = {name: self.keys[name] for name in sorted(self.kept)}  # all: the diagnosis may add nodes to the geometry of every file
        return key_of(output.name, r.name, made, told, code_hash("operando.pipeline.outputs"))

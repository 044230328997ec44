"""Run the stages of a test: cached, resumable, with everything that was left out said."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

from operando.config import Test, load_test
from operando.data import Finding, group_findings
from operando.errors import ConfigError, OperandoError
from operando.jsonable import jsonable
from operando.pipeline.cache import FOLDER, StageCache, code_hash, key_of, whole, write_json
from operando.pipeline.inputs import Inputs, UnfitTest
from operando.pipeline.outputs import OUTPUTS, write_output
from operando.pipeline.stages import STEPS, Lacking, Stage, Work
from operando.pipeline.summary import summary
from operando.results import Results

STAGES = ("inspect", "frf", "ema", "oma", "ofrf", "compare", "diagnose", "report")
"""Stages of the contract, in order."""

Progress = Callable[[str, str], None]


def run(test: Test | str | Path, out: str | Path, *, until: str | None = None, progress: Progress | None = None) -> Results:
    """Run a test from its files to the results folder.

    A stage is not run again as long as its files (by content), its settings, the stages it builds on and the code are the
    same. A stage whose data the test lacks is left out; one that fails becomes a finding of severity ``error``, and what does
    not build on it goes on. Both stand in ``Results.left_out`` with the reason.

    Parameters
    ----------
    test : Test or path
        Test or test file.
    out : path
        Results folder; made where it is missing.
    until : str, optional
        Last stage to run, one of ``STAGES``.
    progress : callable, optional
        Called with (stage, message).

    Returns
    -------
    Results
        What all stages found, as stored in ``model.h5``.

    Raises
    ------
    ConfigError
        If the test file is wrong or the stage is unknown.
    """
    from threadpoolctl import threadpool_limits

    if not isinstance(test, Test):
        test = load_test(test)
    if until is not None and until not in STAGES:
        raise ConfigError(f"unknown stage {until!r}", where="until", hint="stages: " + ", ".join(STAGES))
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise ConfigError("is a file, expected a folder for the results", where=str(out), hint="choose another name with -o")
    out.mkdir(parents=True, exist_ok=True)
    with threadpool_limits(1, "blas"):
        return _Run(test, out, progress or (lambda stage, message: None)).all(until)


def lacking(test: Test, stage: str) -> str | None:
    """Why a stage cannot be made of this test, None where it can: asked before a run whose purpose it is."""
    reasons = [reason for step in STEPS if step.part_of == stage and (reason := step.lacks(test)) is not None]
    return reasons[0] if reasons else None


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


class _Run:
    """State of one call of :func:`run`."""

    def __init__(self, test: Test, out: Path, progress: Progress) -> None:
        self.test, self.out, self.progress = test, out, progress
        self.cache = StageCache(out)
        self.work = Work(test, Inputs(test), Results(test.name, settings=test.settings()))
        self.keys: dict[str, str] = {}
        self.done: set[str] = set()
        self.fresh: set[str] = set()
        self.own_findings: list[Finding] = []
        (out / "errors.log").unlink(missing_ok=True)

    @property
    def results(self) -> Results:
        return self.work.results

    def all(self, until: str | None) -> Results:
        """All stages up to ``until``; later ones only where their stored results still hold."""
        last = len(STAGES) if until is None else STAGES.index(until) + 1
        try:
            self._stages(last)
        except KeyboardInterrupt:
            # what is finished stays, and no summary or report of older results beside it
            for name in STAGES[:last]:
                if name not in self.done and name not in self.results.left_out:
                    self.results.left_out[name] = "interrupted"
            (self.out / "report.html").unlink(missing_ok=True)
            self._store()
            raise
        self._store()
        return self.results

    def _stages(self, last: int) -> None:
        for stage in STEPS:
            self.keys[stage.name] = self._key(stage)
            self._step(stage, asked=STAGES.index(stage.part_of) < last)
        self._gather_findings()
        if last == len(STAGES):
            self._report()
        elif self.fresh:
            (self.out / "report.html").unlink(missing_ok=True)  # it would show results that no longer hold

    def _key(self, stage: Stage) -> str:
        test = self.test
        settings = {name: getattr(test.analysis, name) for name in stage.settings}
        files = []
        for name in stage.states:
            state = (() if test.geometry_file is None else (test.geometry_file,)) if name == "geometry" else getattr(test, name).files
            files.append((name, self.work.inputs.hashes(state)))
        reading = (test.units, test.channels, test.geometry_units, test.directions) if stage.states else ()
        spans = {name: [repr(span) for span in getattr(test, name).spans] for name in stage.states if name != "geometry"}
        upstream = [self.keys[name] for name in stage.upstream]
        if stage.name == "oma" and test.analysis.band is None and "ema" in self.done:
            upstream.append(self.keys["ema"])  # its band is that of the idle modes
        if stage.name == "oma" and test.idle and not test.check:
            upstream.append("halves")  # for the diagnosis from operating modes alone
        return key_of(stage.name, code_hash(stage.rooms), files, spans, reading, settings, upstream)

    def _step(self, stage: Stage, asked: bool) -> None:
        lacks = stage.lacks(self.test) or self._upstream_missing(stage)
        if lacks is not None:
            if asked and stage.part_of not in self.results.left_out:
                self.results.left_out[stage.part_of] = lacks
                self.progress(stage.part_of, f"left out: {lacks}")
            self._forget(stage)
            return
        started = time.perf_counter()
        found = self.cache.load(stage.name, self.keys[stage.name])
        if found is not None:
            self._take(stage, found)
            if asked:
                self.progress(
                    stage.part_of, "unchanged, taken from the last run" + (f" ({stage.name})" if stage.name != stage.part_of else "")
                )
        elif not asked:
            self._forget(stage)
            return
        else:
            self.progress(stage.part_of, "…" if stage.name == stage.part_of else f"{stage.name} …")
            self.work.say = lambda message: self.progress(stage.part_of, message)
            try:
                found = stage.does(self.work)
            except Lacking as error:
                reason = error.message + (f" ({error.hint})" if error.hint else "")
                self.results.left_out[stage.part_of] = reason
                self.progress(stage.part_of, f"left out: {reason}")
                self._forget(stage)
                return
            except UnfitTest:
                raise
            except OperandoError as error:
                self._failed(stage, error)
                return
            except (MemoryError, Exception) as error:  # one failing part must not lose the rest
                self._failed(stage, self._unexpected(stage, error))
                return
            found["seconds"] = time.perf_counter() - started
            self.cache.save(stage.name, self.keys[stage.name], found)
            self.fresh.add(stage.name)
            self._take(stage, found)
            self.progress(stage.part_of, f"done in {found['seconds']:.1f} s")
        self.done.add(stage.name)
        for name in OUTPUTS.get(stage.name, ()):
            if stage.name in self.fresh or not (self.out / name).exists():
                self._write(stage, name)

    def _upstream_missing(self, stage: Stage) -> str | None:
        # the comparison judges whatever model there is
        needed = {"compare": ("ema", "check"), "diagnose": ("ema",)}.get(stage.name, stage.upstream)
        missing = [name for name in needed if name not in self.done]
        words = {
            "frf": "idle FRFs",
            "automatic": "idle modes",
            "ema": "idle modes",
            "oma": "operational modes",
            "ofrf": "scaled modes",
            "check": "check FRFs",
        }
        return f"it needs the {' and the '.join(words[m] for m in missing)}" if missing else None

    def _take(self, stage: Stage, found: dict[str, Any]) -> None:
        names = {f.name for f in fields(Results)} - {"findings"}
        for name, value in found.items():
            if name in names:
                setattr(self.results, name, value)
        seconds = float(found.get("seconds", 0.0))
        self.results.timings_s[stage.part_of] = self.results.timings_s.get(stage.part_of, 0.0) + seconds
        self.own_findings += found.get("findings", [])
        used = used_settings(stage.name, self.results)
        if used:
            self.results.settings.setdefault("used", {})[stage.name] = used
        self._gather_findings()  # later stages say by them why they lack something

    def _write(self, stage: Stage, name: str) -> None:
        try:
            self.own_findings += write_output(name, self.out, self.results)
        except OperandoError as error:
            self._failed(stage, error, what=f"{name} cannot be written: ")
        except Exception as error:
            self._failed(stage, self._unexpected(stage, error), what=f"{name} cannot be written: ")

    def _failed(self, stage: Stage, error: OperandoError, what: str = "") -> None:
        text = f"{what}{error.message}"
        self.progress(stage.part_of, f"failed: {text}")
        if not what:
            self.results.left_out[stage.part_of] = f"failed: {text}"
            self._forget(stage)
        self.own_findings.append(
            Finding(
                "stage_failed",
                f"stage {stage.part_of}: {text}",
                "error",
                file=error.where,
                consequence="what builds on it is left out" if not what else "the results stand in model.h5",
                action=error.hint or "",
            )
        )

    def _unexpected(self, stage: Stage, error: BaseException) -> OperandoError:
        log = self.out / "errors.log"
        with open(log, "a", encoding="utf-8") as stream:
            stream.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} stage {stage.name}\n{''.join(traceback.format_exception(error))}\n")
        return OperandoError(f"unexpected {type(error).__name__}: {error}", hint=f"a fault of the program; the traceback is in {log}")

    def _forget(self, stage: Stage) -> None:
        """Results that no longer hold must not lie around."""
        self.cache.drop([stage.name])
        for name in OUTPUTS.get(stage.name, ()):
            (self.out / name).unlink(missing_ok=True)

    def _gather_findings(self) -> None:
        r = self.results
        carried = [o.findings for o in (r.idle_frf, r.idle, r.operating, r.hybrid) if o is not None]
        carried += [run.frf.findings for run in r.check]
        r.findings = group_findings([*self.own_findings, *(f for group in carried for f in group)])

    def _report(self) -> None:
        stage = Stage("report", "report", lambda work: {}, optional=True)
        path = self.out / "report.html"
        key = key_of(self.keys, self.results.left_out, [f.to_dict() for f in self.results.findings], self.test.name, code_hash(("report",)))
        if path.exists() and self.cache.load("report", key) is not None:
            self.progress("report", "unchanged, taken from the last run")
            return
        started = time.perf_counter()
        self.progress("report", "…")
        try:
            from operando.report import write_report

            with whole(path) as beside:
                write_report(self.results, beside)
        except OperandoError as error:
            self._failed(stage, error)
        except Exception as error:
            self._failed(stage, self._unexpected(stage, error))
        else:
            seconds = time.perf_counter() - started
            self.results.timings_s["report"] = seconds
            self.cache.save("report", key, {})
            self.progress("report", f"done in {seconds:.1f} s")

    def _store(self) -> None:
        from operando.store import save_results

        self._gather_findings()
        write_json(self.out / "summary.json", summary(self.results))
        path = self.out / "model.h5"
        key = key_of(sorted(self.done), {name: self.keys[name] for name in self.done}, self.results.left_out, self.results.settings)
        if self.fresh or not path.exists() or self.cache.load("store", key) is None:
            self.progress("store", "…")
            save_results(self.results, path)
            self.cache.save("store", key, {})


__all__ = ["FOLDER", "STAGES", "lacking", "run"]

"""Everything one run of the pipeline found: what the report draws and the results folder stores."""

from __future__ import annotations

import importlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from operando.atomic import writing
from operando.data import Finding, Frf, Geometry, ModalModel, Short, counted, number_of, plots
from operando.errors import MissingError

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(repr=False, eq=False)
class CheckRun(Short):
    """One set of FRFs measured in operation that the model is compared with.

    Attributes
    ----------
    name : str
    level : str
        Level in words; runs of one level have the same.
    frf : Frf
    force_n : float or None
        Least rms of the forces [N]; None where it is not known.
    levels_agree : bool
        Whether several levels stand together here because they differ by no more than noise.

    Examples
    --------
    >>> import operando
    >>> operando.CheckRun("run 1", "20 N", operando.Frf([[[1.0, 2.0]]], [5.0, 6.0], "1+Z", "1+Z"), 20.0)
    <CheckRun: run 1; level 20 N; force 20 N rms; 1 response 1+Z; 1 reference 1+Z; 2 lines, 5 to 6 Hz in steps of 1 Hz>
    """

    name: str
    level: str
    frf: Frf
    force_n: float | None = None
    levels_agree: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.force_n is not None:
            self.force_n = number_of(self.force_n, "force_n", "give the least rms of the forces [N]", 0.0)

    def facts(self) -> dict[str, str]:
        """What the short form says."""
        force = "" if self.force_n is None else f"force {self.force_n:.3g} N rms"
        return {"Name": self.name, "Level": f"level {self.level}" if self.level else "", "Force": force} | {
            name: words for name, words in self.frf.facts().items() if name in ("Responses", "References", "Lines")
        }

    def stated_level(self) -> dict[str, Any]:
        """The level as documents hold it: a number with its unit, and its name."""
        return {"level": self.force_n, "unit": "N", "level_name": self.level}


@dataclass(repr=False, eq=False)
class Results(Short):
    """Results of one test, filled stage by stage; what a stage did not make stays None.

    Attributes
    ----------
    name : str
        Name of the test.
    settings : dict
        All settings with defaults, as used.
    findings : list of Finding
    inventory : list of dict
        One row a file: path, sets, channels, DOFs, sampling, duration, what was used and ignored.
    raw : list of operando.quality.Overview
        What the raw records look like: outlines, spectra, hits.
    geometry : Geometry or None
    idle_frf : Frf or None
    idle : ModalModel or None
        Unit modal mass, with residual terms; ``details`` is an ``operando.ema.EmaDetails``.
    automatic : ModalModel or None
        The idle modes before anything named by hand; the same where nothing is.
    operating : ModalModel or None
        Complex, unscaled; ``details`` is an ``operando.oma.OmaDetails``.
    hybrid : operando.scaling.HybridModel or None
    check : list of CheckRun
    comparison : dict or None
        ``comparison.json``; :meth:`plot_comparison` draws it.
    diagnosis : dict or None
        ``diagnosis.json``; :meth:`plot_ladder` and :meth:`plot_where` draw it, as do the functions of ``operando.plots``.
    effect_covariance : array or None
        Joint covariance of the idle model as the diagnosis left it and the effects' values (see ``operando.structure.Model``).
    effect_idle : ModalModel or None
        That idle model (shapes at the effects' places refitted), without ``details``; with the accepted effects it is the second route to
        the operational FRFs.
    idle_libraries, operating_libraries : list of dict
        Other libraries on the same data, where asked for: ``LibraryComparison.to_dict()`` of ``operando.contrib``.
    left_out : dict
        Stage name → reason why it was left out.
    stages : dict
        Step of the pipeline → what it found that stands nowhere else here, for the next run: its own findings, and what a later step put
        something else in place of.
    timings_s : dict
        Stage name → wall seconds; in ``timings.json``, not in ``model.h5``.

    Examples
    --------
    >>> import operando
    >>> operando.Results("pump")
    <Results: pump>
    """

    name: str
    settings: dict[str, Any] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    inventory: list[dict[str, Any]] = field(default_factory=list)
    geometry: Geometry | None = None
    idle_frf: Frf | None = None
    idle: ModalModel | None = None
    operating: ModalModel | None = None
    hybrid: Any = None
    check: list[CheckRun] = field(default_factory=list)
    comparison: dict[str, Any] | None = None
    diagnosis: dict[str, Any] | None = None
    left_out: dict[str, str] = field(default_factory=dict)
    timings_s: dict[str, float] = field(default_factory=dict, compare=False)
    effect_covariance: Any = None  # before the model whose covariance is a block of it: model.h5 holds that once
    effect_idle: ModalModel | None = None
    automatic: ModalModel | None = None
    idle_libraries: list[dict[str, Any]] = field(default_factory=list)
    operating_libraries: list[dict[str, Any]] = field(default_factory=list)
    raw: list[Any] = field(default_factory=list)
    stages: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def libraries(self) -> list[dict[str, Any]]:
        """Other libraries on the data of both states."""
        return [*self.idle_libraries, *self.operating_libraries]

    def to_dict(self) -> dict[str, Any]:
        """``summary.json``; ``comparison`` and ``diagnosis`` hold the other two documents."""
        document: dict[str, Any] = importlib.import_module("operando.pipeline.summary").summary(self)
        return document

    def facts(self) -> dict[str, str]:
        """What the short form says."""
        errors = ((self.comparison or {}).get("models") or {}).get("ofrf") or {}
        level = errors.get("error_db")
        return {
            "Test": self.name,
            "Idle": counted(self.idle.n_modes, "idle mode") if self.idle is not None else "",
            "Operating": counted(self.operating.n_modes, "operational mode") if self.operating is not None else "",
            "Scaling": f"scaled by {self.hybrid.method}" if self.hybrid is not None else "",
            "Validation": "" if level is None else f"operational FRFs within {level:.2f} dB of the validation measurement",
            "Diagnosis": f"diagnosis: {self.diagnosis['verdict'].replace('_', ' ')}" if self.diagnosis else "",
            "Left out": ", ".join(f"{stage} left out" for stage in self.left_out),
        }

    def plot_ladder(self, axes: Axes | None = None) -> Axes:
        """Error by step of the diagnosis: see :func:`operando.plots.plot_steps`.

        Parameters
        ----------
        axes : matplotlib Axes, optional

        Returns
        -------
        matplotlib Axes

        Raises
        ------
        MissingError
            If the results hold no diagnosis.
        """
        made: Axes = plots().plot_steps(self._held("diagnosis"), axes)
        return made

    def plot_where(self, axes: Axes | None = None, *, by: str = "dof") -> Axes:
        """Where the idle model fails in operation: see :func:`operando.plots.plot_where`.

        Parameters
        ----------
        axes : matplotlib Axes, optional
        by : {"dof", "band", "mode"}

        Returns
        -------
        matplotlib Axes

        Raises
        ------
        MissingError
            If the results hold no diagnosis.
        """
        made: Axes = plots().plot_where(self._held("diagnosis"), axes, by=by)
        return made

    def plot_comparison(self, model: str = "ofrf", axes: Axes | None = None, *, by: str = "dof") -> Axes:
        """Level error of one model of the comparison: see :func:`operando.plots.plot_comparison`.

        Parameters
        ----------
        model : str
            ``idle``, ``ofrf``, ``effect``, or another one of ``comparison["models"]``.
        axes : matplotlib Axes, optional
        by : {"dof", "band", "mode"}

        Returns
        -------
        matplotlib Axes

        Raises
        ------
        MissingError
            If the results hold no comparison, or it has no such model.
        """
        models = self._held("comparison")["models"]
        if model not in models:
            raise MissingError(f"the comparison has no model {model!r}", hint="it has " + ", ".join(models))
        made: Axes = plots().plot_comparison(models[model], axes, by=by)
        return made

    def _held(self, stage: str) -> dict[str, Any]:
        document: dict[str, Any] | None = getattr(self, stage)
        if document is None:
            reason = self.left_out.get({"diagnosis": "diagnose", "comparison": "compare"}[stage])
            raise MissingError(f"the results hold no {stage}", hint=reason or "run the test with a validation measurement ([check])")
        return document

    def save(self, path: str | Path) -> None:
        """Write the results as ``model.h5`` into a folder, or into a file whose name ends with ``.h5``; :func:`operando.load` reads them.

        Parameters
        ----------
        path : path
            A folder (made where it is missing) or a file.
        """
        target = Path(path)
        if target.suffix.lower() not in (".h5", ".hdf5"):
            with writing(target):
                target.mkdir(parents=True, exist_ok=True)
            target = target / "model.h5"
        importlib.import_module("operando.store").save_results(self, target)

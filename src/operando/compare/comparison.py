"""Compare any model with any measurement: ``comparison.json``."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from operando.compare.common import FrfModel, LevelDependent, collect, common_frfs, in_the_sense_of, pool
from operando.compare.measures import (
    Lines,
    band_edges,
    band_masks,
    error_db,
    misfit,
    misfit_meas,
    model_share,
    noise_floor_db,
    relative_error,
)
from operando.compare.models import ModelComparison, compare_models
from operando.compare.peaks import Peak, by_mode, fit_peaks
from operando.data import Frf, ModalModel, Short, expect, plots, positive_band
from operando.dof import Dof
from operando.errors import DataError, ObjectError
from operando.results import CheckRun
from operando.scaling import HybridModel
from operando.threads import one_blas_thread

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes


@dataclass(frozen=True, repr=False, eq=False)
class Comparison(Short):
    """One M of ``comparison.json``.

    Values are None where the data do not allow them (no variance, no line above the noise).

    Parameters
    ----------
    error_db : float or None
        Rms of the ratio of magnitudes in dB, on lines above the noise.
    relative_error : float or None
        Norm of the complex error over the norm of the measurement, all lines.
    misfit : float or None
        Mean squared error over the variance of the measurement and of the model compared, of its own; 1 is as good as the data allow.
    noise_floor_db : float or None
        What ``error_db`` would be for a perfect model.
    model_share : float or None
        Share of the model's own variance in the total.
    by_dof, by_band, by_mode : tuple of dict
        The same by response DOF, in eight bands, and by mode of the measurement.
    n_lines : int
        Complex lines compared, all pairs together.
    notes : tuple of str
        What could not be assessed, and why.
    misfit_meas : float or None
        As ``misfit``, by the variance of the measurement alone.

    Examples
    --------
    >>> import numpy as np, operando
    >>> idle = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> other = operando.ModalModel([20.2, 45.0], [0.01, 0.02], idle.shapes, "1+Z, 2+Z", "unit_modal_mass")
    >>> found = operando.compare(other, idle.frf(np.arange(5, 80, 0.1), variance=False))
    >>> round(found.error_db, 2), round(found.relative_error, 3), found.n_lines
    (0.55, 0.428, 3000)
    """

    error_db: float | None
    relative_error: float | None
    misfit: float | None
    noise_floor_db: float | None
    model_share: float | None
    by_dof: tuple[dict[str, Any], ...]
    by_band: tuple[dict[str, Any], ...]
    by_mode: tuple[dict[str, Any], ...]
    n_lines: int = 0
    notes: tuple[str, ...] = ()
    misfit_meas: float | None = None

    def facts(self) -> dict[str, str]:
        """What the short form says."""
        number = lambda value, words: "" if value is None else words.format(value)  # noqa: E731
        return {
            "Level error": number(self.error_db, "level error {:.2f} dB"),
            "Noise floor": number(self.noise_floor_db, "noise floor {:.2f} dB"),
            "Normalised error": number(self.misfit, "reduced chi-square {:.3g}"),
            "Relative error": number(self.relative_error, "relative error {:.3g}"),
            "Compared": f"{self.n_lines} lines, {len(self.by_dof)} response DOFs",
            "Notes": "; ".join(self.notes),
        }

    def plot(self, axes: Axes | None = None, *, by: str = "dof") -> Axes:
        """Level error by response DOF, frequency band or mode (:func:`operando.plots.plot_comparison`).

        Parameters
        ----------
        axes : matplotlib Axes, optional
        by : {"dof", "band", "mode"}

        Returns
        -------
        matplotlib Axes
        """
        made: Axes = plots().plot_comparison(self, axes, by=by)
        return made

    def to_dataframe(self, by: str = "dof") -> pandas.DataFrame:
        """Errors by response DOF, band or mode as a table; the figures over all lines are in ``.attrs``.

        Parameters
        ----------
        by : {"dof", "band", "mode"}

        Raises
        ------
        DataError
            If ``by`` is something else.
        MissingError
            If pandas is not installed.
        """
        if by not in ("dof", "band", "mode"):
            raise DataError(f"errors by {by!r} are not known", hint="use dof, band or mode")
        told = self.to_dict()
        table: pandas.DataFrame = importlib.import_module("operando.io.frames").library("pandas").DataFrame(told[f"by_{by}"])
        table.attrs = {key: value for key, value in told.items() if not key.startswith("by_")}
        return table

    def to_dict(self) -> dict[str, Any]:
        """JSON object as in the specification."""
        figures = ("error_db", "relative_error", "misfit", "misfit_meas", "noise_floor_db", "model_share")
        rows = {name: [dict(row) for row in getattr(self, name)] for name in ("by_dof", "by_band", "by_mode")}
        return {name: getattr(self, name) for name in figures} | rows | {"n_lines": self.n_lines, "notes": list(self.notes)}


@overload
def compare(
    model: ModalModel | HybridModel, measured: ModalModel | HybridModel, band_hz: tuple[float, float] | None = None
) -> ModelComparison: ...
@overload
def compare(model: FrfModel | Frf, measured: Frf | Sequence[Frf], band_hz: tuple[float, float] | None = None) -> Comparison: ...
def compare(model: Any, measured: Any, band_hz: tuple[float, float] | None = None) -> Comparison | ModelComparison:
    """Error measures of a model against a measurement (specification, "Error measures"), or two models mode by mode.

    Parameters
    ----------
    model : model or Frf
        Anything with ``.frf(frequencies, responses, references, quantity)``, or FRFs on the measured lines.
    measured : Frf, several, or a modal or hybrid model
        FRFs: the reference; without variance they are taken as exact, several are pooled. A model: modes are paired by shape and
        frequency.
    band_hz : (float, float), optional
        Lines, or modes, used; default the band that the model was fitted in, else all.

    Returns
    -------
    Comparison or ModelComparison

    Raises
    ------
    ObjectError
        If one is neither a model nor FRFs.
    DataError
        If they share no pair, no line, or no DOF.

    Examples
    --------
    >>> import numpy as np, operando
    >>> one = operando.ModalModel([10.0, 20.0], [0.01, 0.01], np.eye(2), "1+Z, 2+Z")
    >>> other = operando.ModalModel([10.5, 20.0], [0.01, 0.01], np.eye(2), "1+Z, 2+Z")
    >>> operando.compare(one, other).modes[0]["frequency_percent"]
    5.0
    """
    band_hz = None if band_hz is None else positive_band(band_hz)
    if isinstance(measured, ModalModel | HybridModel):
        return compare_models(model, measured, band_hz)
    if not isinstance(model, Frf) and not callable(getattr(model, "frf", None)):
        raise ObjectError(f"a {type(model).__name__} makes no FRF to compare", hint="give a model or an Frf first, the measurement second")
    runs = [measured] if isinstance(measured, Frf) else list(measured) if isinstance(measured, list | tuple) else [measured]
    for run in runs or [None]:
        expect(run, Frf, "a model is compared with FRFs or another model", "read(file).frfs and estimate_frf(records) give FRFs")
    note: tuple[str, ...] = ()
    if band_hz is None and (own := _band_of(model)) is not None:
        of_model = f"the band of the model, {own[0]:.4g} to {own[1]:.4g} Hz"
        if not all(np.any((run.frequencies_hz >= own[0]) & (run.frequencies_hz <= own[1])) for run in runs):
            note = (f"a measurement has no line in {of_model}: all lines are compared, for which it was not made",)
        else:
            band_hz = own
            if any(run.frequencies_hz[0] < own[0] or run.frequencies_hz[-1] > own[1] for run in runs):
                note = (f"compared in {of_model}; band_hz names another one",)
    with one_blas_thread():
        found = _compare(model, runs, band_hz)
    if any(run.si != _si_of(model) for run in runs):
        note = (*note, "the units of model and measurement are not both known: the errors hold the ratio of their units")
    return replace(found, notes=(*note, *found.notes))


def _si_of(model: Any) -> bool:
    """Whether the units of what a model predicts are known."""
    return all(getattr(part, "si", True) for part in (model, getattr(model, "modal", None), getattr(model, "idle", None)))


def _band_of(model: Any) -> tuple[float, float] | None:
    """The band [Hz] that modes were fitted in: the model's own, those of operation of a hybrid one, the idle ones below effects."""
    for part in (model, getattr(model, "modal", None), getattr(model, "idle", None)):
        if (band := getattr(part, "band_hz", None)) is not None:
            return float(band[0]), float(band[1])
    return None


def _compare(model: FrfModel | Frf, runs: list[Frf], band_hz: tuple[float, float] | None, peaks: _Fit = fit_peaks) -> Comparison:
    labels: list[Dof] = []
    notes: list[str] = []
    pairs = [common_frfs(model, run, band_hz, notes) for run in runs]
    pairs = [(made, in_the_sense_of(made, ref, notes)) for made, ref in pairs]
    lines = pool([collect(made, ref, labels, notes) for made, ref in pairs])
    if lines.model.size == 0:
        raise DataError("model and measurement share no finite line")
    low, high = float(lines.frequency_hz.min()), float(lines.frequency_hz.max())
    edges = band_hz or (max(low, high * 1e-3), high)
    return Comparison(
        error_db(lines),
        relative_error(lines),
        misfit(lines),
        noise_floor_db(lines),
        model_share(lines),
        tuple(rows_by_dof(lines, labels)),
        tuple(rows_by_band(lines, *edges)),
        tuple(_modes(pairs, notes, peaks)),
        int(lines.model.size),
        tuple(dict.fromkeys(notes)),
        misfit_meas(lines),
    )


def rows_by_dof(lines: Lines, dofs: Sequence[Dof]) -> list[dict[str, Any]]:
    """``by_dof``: errors of each response; ``lines.response`` numbers ``dofs``."""
    parts = ((dof, lines.where(lines.response == i)) for i, dof in enumerate(dofs))
    return [{"dof": str(dof), "error_db": error_db(part), "misfit": misfit(part)} for dof, part in parts if part.model.size]


def rows_by_band(lines: Lines, low: float, high: float) -> list[dict[str, Any]]:
    """``by_band``: errors in eight bands, equal in logarithmic frequency, of low to high Hz."""
    edges, out = band_edges(low, high), []
    for (a, b), inside in zip(pairwise(edges), band_masks(lines.frequency_hz, edges), strict=True):
        part = lines.where(inside)
        out.append({"band_hz": [float(a), float(b)], "error_db": error_db(part), "misfit": misfit(part)})
    return out


def _modes(pairs: Sequence[tuple[Frf, Frf]], notes: list[str], peaks: _Fit) -> list[dict[str, Any]]:
    """Peaks of the measured FRFs refitted (by ``peaks``), and the model's; runs on other lines than the first are left out."""
    f = pairs[0][1].frequencies_hz
    model, measured, variance = [], [], []
    for made, ref in pairs:
        if ref.frequencies_hz.shape != f.shape or not np.allclose(ref.frequencies_hz, f):
            notes.append("by_mode uses the runs on the lines of the first only")
            continue
        a, b = made.data.reshape(-1, f.size), ref.data.reshape(-1, f.size)
        good = np.all(np.isfinite(a), axis=1) & np.all(np.isfinite(b), axis=1)
        model.append(a[good])
        measured.append(b[good])
        variance.append(np.full((int(good.sum()), f.size), np.nan) if ref.variance is None else ref.variance.reshape(-1, f.size)[good])
    y, h, known = (np.concatenate(parts) for parts in (measured, model, variance))
    if y.size == 0:
        return []
    size = np.sqrt(np.mean(np.abs(y) ** 2, axis=1))
    weight = np.divide(1, size, out=np.zeros_like(size), where=size > 0)
    return by_mode(peaks(y, f, weight, known), fit_peaks(h, f, weight))


_Fit = Callable[[NDArray[Any], NDArray[np.float64], NDArray[np.float64] | None, NDArray[np.float64] | None], list[Peak]]


def _fit_once() -> _Fit:
    """:func:`fit_peaks` that fits a measurement once, however many models are compared with it; its values say whether it is the same."""
    known: dict[tuple[bytes, ...], list[Peak]] = {}

    def fit(
        y: NDArray[Any], f: NDArray[np.float64], weight: NDArray[np.float64] | None, variance: NDArray[np.float64] | None
    ) -> list[Peak]:
        key = (y.tobytes(), f.tobytes(), b"" if weight is None else weight.tobytes())
        if key not in known:
            known[key] = fit_peaks(y, f, weight, variance)
        return known[key]

    return fit


def compare_all(
    models: Mapping[str, FrfModel | Frf], runs: Sequence[CheckRun], band_hz: tuple[float, float] | None = None
) -> dict[str, Any]:
    """``comparison.json``: every model against the runs of the lowest level, and against each run.

    Parameters
    ----------
    models : mapping
        ``idle``, ``idle_shapes``, ``msf_all``, ``ofrf``, ``effect`` → model.
    runs : sequence of CheckRun
        Validation runs.
    band_hz : (float, float), optional
        Band [Hz] of the comparison. Default: all lines.

    Returns
    -------
    dict
        The document.

    Raises
    ------
    DataError
        If there is no run.

    Examples
    --------
    >>> import numpy as np, operando
    >>> from operando.results import CheckRun
    >>> f = np.arange(8.0, 12.0, 0.1)
    >>> model = operando.ModalModel([10.0], [0.01], np.array([[1.0]]), "1+Z", scaling="unit_modal_mass")
    >>> running = operando.ModalModel([10.1], [0.01], np.array([[1.0]]), "1+Z", scaling="unit_modal_mass")
    >>> document = compare_all({"idle": model}, [CheckRun("run 1", "10 N", running.frf(f), 10.0)])
    >>> document["models"]["idle"]["error_db"] > 1
    True
    """
    if not runs:
        raise DataError("no validation measurement to compare with")
    lowest = lowest_level(runs)
    chosen = [r for r in runs if r.level == lowest]
    peaks = _fit_once()

    def errors_on(some: Sequence[CheckRun]) -> dict[str, Any]:
        def one(model: Any) -> Comparison:
            return _compare(model, [r.frf for r in some], band_hz, peaks)

        forces = [r.force_n for r in some if r.force_n is not None]
        with one_blas_thread():
            return {
                name: (m.compared(one, min(forces, default=None)) if isinstance(m, LevelDependent) else one(m)).to_dict()
                for name, m in models.items()
            }

    overall = errors_on(chosen)
    by_run = []
    for r in runs:
        alone = len(chosen) == 1 and r.level == lowest  # this run is all that judged: its errors are known
        errors = overall if alone else errors_on([r])
        by_run.append({"name": r.name, **r.stated_level(), "models": errors})
    on = {"runs": [r.name for r in chosen], **chosen[0].stated_level(), "band_hz": None if band_hz is None else [float(v) for v in band_hz]}
    return {"schema": "operando/comparison/1", "judged_on": on, "models": overall, "by_run": by_run}


def with_effect(
    comparison: dict[str, Any], effect: FrfModel | None, runs: Sequence[CheckRun], band_hz: tuple[float, float] | None = None
) -> dict[str, Any]:
    """``comparison.json`` with the idle model and its effects compared anew, all models without them as they were.

    Parameters
    ----------
    comparison : dict
        As :func:`compare_all` gives it.
    effect : model or None
        Idle model with effects; None where all have been taken back.
    runs : sequence of CheckRun
        Those of ``comparison``.
    band_hz : (float, float), optional
        Band [Hz] of the comparison. Default: all lines.

    Returns
    -------
    dict
        The document.

    Examples
    --------
    >>> with_effect({"models": {"idle": {"error_db": 5.0}, "effect": {"error_db": 0.2}}}, None, [])
    {'models': {'idle': {'error_db': 5.0}}, 'by_run': []}
    """
    chosen = None if effect is None else compare_all({"effect": effect}, runs, band_hz)

    def changed(models: dict[str, Any], new: dict[str, Any] | None) -> dict[str, Any]:
        rest = {name: errors for name, errors in models.items() if name != "effect"}
        return rest if new is None else rest | {"effect": new["models"]["effect"]}

    by_run = [
        old | {"models": changed(old["models"], None if chosen is None else chosen["by_run"][k])}
        for k, old in enumerate(comparison.get("by_run", []))
    ]
    return comparison | {"models": changed(comparison["models"], chosen), "by_run": by_run}


def lowest_level(runs: Sequence[CheckRun]) -> str:
    """The level a linear model is validated at: of the least force; where forces are not known low or lowest, else the last by name."""
    known = [(r.force_n, r.level) for r in runs if r.force_n is not None]
    if len(known) == len(runs):
        return min(known)[1]
    levels = sorted({r.level for r in runs})
    return next((level for level in levels if level.lower() in ("low", "lowest")), levels[-1])

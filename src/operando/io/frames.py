"""Records, FRFs, modal models and geometries as tables of pandas and datasets of xarray; both are loaded when they are asked for."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import numpy as np

from operando.data import Frf, Geometry, ModalModel, TimeRecord, phase_collinearity, unit_of
from operando.errors import MissingError, ObjectError

if TYPE_CHECKING:
    import pandas
    import xarray


def library(name: str) -> Any:
    """A library that is needed only where its form is asked for."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingError(f"{name} is not installed", hint="pip install 'operando[tables]'") from error


def dataframe(obj: Any) -> pandas.DataFrame:
    """Numbers of a record, FRFs, a model or a geometry as a table.

    Of a record: one column a channel over ``time_s``. Of FRFs: complex, one column a pair (response, reference) over ``frequency_hz``;
    then, where they are known, the standard deviation and the coherence of each, as columns (response, "1+Z std") and (response,
    "1+Z coherence"). Of a model: one row a mode, with its shape in a column for each DOF; ``modal_phase_collinearity`` where the shapes are
    complex. Of a geometry: one row a node.

    >>> frf = Frf(np.ones((2, 1, 3)), [1.0, 2.0, 3.0], "1+Z, 2+Z", "1+Z")
    >>> float(dataframe(frf)["2+Z", "1+Z"].loc[2.0].real)
    1.0
    """
    pd = library("pandas")
    if isinstance(obj, TimeRecord):
        index = pd.Index(obj.time_s, name="time_s")
        table = pd.DataFrame(np.asarray(obj.data).T.copy(), index=index, columns=_channel_names(obj))
        table.attrs = {"units": {n: c.unit for n, c in zip(_channel_names(obj), obj.channels, strict=True)}, "name": obj.name}
    elif isinstance(obj, Frf):
        beside = {"": obj.data, " std": None if obj.variance is None else np.sqrt(np.maximum(obj.variance, 0)), " coherence": obj.coherence}
        index = pd.Index(obj.frequencies_hz, name="frequency_hz")
        parts = []
        for word, array in beside.items():
            if array is not None:
                pairs = [(str(r), f"{f}{word}") for r in obj.responses for f in obj.references]
                columns = pd.MultiIndex.from_tuples(pairs, names=("response", "reference"))
                parts.append(pd.DataFrame(array.reshape(len(pairs), -1).T.copy(), index=index, columns=columns))
        table = pd.concat(parts, axis=1)
        table.attrs = {"quantity": obj.quantity, "unit": unit_of(obj.quantity) if obj.si else "", "name": obj.name}
    elif isinstance(obj, ModalModel):
        rows = {
            "frequency_hz": obj.frequencies_hz,
            "frequency_std_hz": _or_nan(obj.frequency_std_hz, obj.n_modes),
            "damping_ratio": obj.damping_ratios,
            "damping_ratio_std": _or_nan(obj.damping_ratio_std, obj.n_modes),
            # of shapes that are real by construction it says nothing
            **({} if obj.real_shapes else {"modal_phase_collinearity": [phase_collinearity(v) for v in obj.complex_shapes.T]}),
            "in_band": np.asarray(obj.in_band),
        } | {str(d): obj.shapes[i] for i, d in enumerate(obj.dofs)}
        table = pd.DataFrame(rows, index=pd.RangeIndex(obj.n_modes, name="mode"))
        table.attrs = {"scaling": obj.scaling, "shape_unit": _shape_unit(obj)}
    elif isinstance(obj, Geometry):
        x, y, z = np.asarray(obj.coordinates).T
        table = pd.DataFrame({"x": x, "y": y, "z": z}, index=pd.Index(list(obj.nodes), name="node"))
        table.attrs = {"unit": "m"}
    else:
        raise ObjectError(f"a {type(obj).__name__} has no form as a table", hint="records, FRFs, modal models and geometries have one")
    made: pandas.DataFrame = table
    return made


def dataset(obj: Any) -> xarray.Dataset:
    """Arrays of a record, FRFs, a model or a geometry with their labels.

    Of a record: ``data`` (channel, time_s). Of FRFs: ``frf``, ``variance``, ``coherence`` (response, reference, frequency_hz). Of a
    model: ``frequency_hz``, ``damping_ratio`` with their deviations (mode), ``shape``, ``shape_std`` (dof, mode); residual terms are in
    ``model.residuals``, the covariance in ``model.covariance``. Of a geometry: ``coordinates`` (node, axis).
    """
    xr = library("xarray")
    if isinstance(obj, TimeRecord):
        coordinates = {"channel": _channel_names(obj), "time_s": obj.time_s, "unit": ("channel", [c.unit for c in obj.channels])}
        made = xr.Dataset({"data": (("channel", "time_s"), np.asarray(obj.data))}, coordinates, {"name": obj.name})
    elif isinstance(obj, Frf):
        dims = ("response", "reference", "frequency_hz")
        held: dict[str, Any] = {"frf": obj.data, "variance": obj.variance, "coherence": obj.coherence}
        names = ([str(d) for d in obj.responses], [str(d) for d in obj.references], obj.frequencies_hz)
        attributes = {"quantity": obj.quantity, "unit": unit_of(obj.quantity) if obj.si else "", "name": obj.name}
        held = {k: (dims, v) for k, v in held.items() if v is not None}
        made = xr.Dataset(held, dict(zip(dims, names, strict=True)), attributes)
    elif isinstance(obj, ModalModel):
        by_mode = {
            "frequency_hz": obj.frequencies_hz, "damping_ratio": obj.damping_ratios, "in_band": np.asarray(obj.in_band),
            "frequency_std_hz": obj.frequency_std_hz, "damping_ratio_std": obj.damping_ratio_std,
        }  # fmt: skip
        arrays: dict[str, Any] = {k: (("mode",), v) for k, v in by_mode.items() if v is not None}
        arrays |= {k: (("dof", "mode"), v) for k, v in (("shape", obj.shapes), ("shape_std", obj.shape_std)) if v is not None}
        attributes = {"scaling": obj.scaling, "shape_unit": _shape_unit(obj)}
        made = xr.Dataset(arrays, {"mode": np.arange(obj.n_modes), "dof": [str(d) for d in obj.dofs]}, attributes)
    elif isinstance(obj, Geometry):
        labels = {"node": list(obj.nodes), "axis": ["x", "y", "z"]}
        made = xr.Dataset({"coordinates": (("node", "axis"), obj.coordinates)}, labels, {"unit": "m"})
    else:
        raise ObjectError(f"a {type(obj).__name__} has no form as a dataset", hint="records, FRFs, modal models and geometries have one")
    out: xarray.Dataset = made
    return out


def _channel_names(record: TimeRecord) -> list[str]:
    """Label of each channel; with its quantity, then its number, where another has the same."""
    names = [c.label or f"ch{i + 1}" for i, c in enumerate(record.channels)]
    twice = {n for n in names if names.count(n) > 1}
    names = [f"{n}:{c.quantity}" if n in twice else n for n, c in zip(names, record.channels, strict=True)]
    return [f"{n}#{i}" if names.count(n) > 1 else n for i, n in enumerate(names)]


def _or_nan(values: Any, n: int) -> Any:
    return np.full(n, np.nan) if values is None else values


def _shape_unit(model: ModalModel) -> str:
    return "kg^(-1/2)" if model.scaling == "unit_modal_mass" and model.si else ""

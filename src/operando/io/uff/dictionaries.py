"""Records, FRFs, models and geometries as the dictionaries of pyuff, one a set: what its users pass around and write."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from operando.data import Frf, Geometry, ModalModel, TimeRecord
from operando.errors import DataError
from operando.io.uff.components import NodeNumbers
from operando.io.uff.header58 import Axis
from operando.io.uff.models import Check
from operando.io.uff.text_sets import mode_ids, node_table, trace_sets
from operando.io.uff.writer import Function, frf_functions, numbered_nodes, record_functions


def dictionaries(obj: TimeRecord | Frf | ModalModel | Geometry) -> list[dict[str, Any]]:
    """The sets of an object as ``pyuff.UFF.write_sets`` takes them and ``read_sets`` gives them.

    They say what the file of :func:`operando.io.write_uff` says: 58 for records and FRFs with coherence and standard deviation (double
    precision, ASCII; ``binary`` may be set to 1), 55 for modes and residual terms, 2411, 82 and 2412 for geometries. Numbers are SI where
    the units are known; a dictionary holds all digits, a set 55 that is written from it six.
    """
    if isinstance(obj, TimeRecord):
        return [_function(f) for f in record_functions(obj)]
    if isinstance(obj, Frf):
        return [_function(f) for f in frf_functions(obj)]
    if isinstance(obj, ModalModel):
        return list(_modes(obj))
    return list(_geometry(obj))


def _function(f: Function) -> dict[str, Any]:
    import pyuff

    values = np.array(f.values)
    x = f.start + f.step * np.arange(values.size) if f.frequencies is None else np.array(f.frequencies)
    if values.size < 2:
        raise DataError("a function of one point has no form in pyuff", hint="write it with operando.io.write_uff")
    axes = {"abscissa": f.abscissa, "ordinate": f.ordinate, "orddenom": f.denominator, "z_axis": Axis()}
    made = pyuff.prepare_58(
        binary=0, **{f"id{i + 1}": text or "NONE" for i, text in enumerate(f.ids)},
        func_type=f.kind, load_case_id=0, ver_num=0, **_end("rsp", f.response, f.name), **_end("ref", f.reference, ""),
        ord_data_type=6 if np.iscomplexobj(values) else 4, num_pts=values.size, abscissa_spacing=int(f.frequencies is None),
        abscissa_min=float(x[0]), abscissa_inc=float(f.step), z_axis_value=0.0,
        **{key: value for prefix, axis in axes.items() for key, value in _axis(prefix, axis).items()},
        data=values.astype(complex if np.iscomplexobj(values) else float), x=x,
    )  # fmt: skip
    return dict(made) | {f"{prefix}_axis_lab": axis.label or "NONE" for prefix, axis in axes.items()}


def _end(prefix: str, dof: Any, name: str) -> dict[str, Any]:
    entity = dof.component if dof is not None and dof.component else name
    number, code = (0, 0) if dof is None else (dof.number, dof.uff_code)
    return {f"{prefix}_ent_name": entity[:10] or "NONE", f"{prefix}_node": number, f"{prefix}_dir": code}


def _axis(prefix: str, axis: Axis) -> dict[str, Any]:
    length, force, temperature = axis.exponents
    return {
        f"{prefix}_spec_data_type": axis.code, f"{prefix}_len_unit_exp": length, f"{prefix}_force_unit_exp": force,
        f"{prefix}_temp_unit_exp": temperature, f"{prefix}_axis_units_lab": axis.unit or "NONE",
    }  # fmt: skip


def _modes(model: ModalModel) -> Iterator[dict[str, Any]]:
    import pyuff

    model.sums_of_squares("UFF 55")
    numbers = NodeNumbers.of(numbered_nodes([model]))
    nodes, places, per_node = node_table(model.dofs)
    terms = model.terms
    stated = Check.of(model)
    check = "" if stated is None else stated.text
    is_complex = np.iscomplexobj(terms.shapes)
    if is_complex and per_node == 6:
        raise DataError("complex modes with rotations have no form in pyuff", hint="write them with operando.io.write_uff")
    for r in range(terms.n):
        shape = np.zeros((len(nodes), max(per_node, 3)), terms.shapes.dtype)
        for (i, j, sign), value in zip(places, terms.shapes[:, r], strict=True):
            shape[i, j] = sign * value
        if is_complex:
            own: dict[str, Any] = {"analysis_type": 3, "eig": complex(terms.poles[r]), "modal_a": 0j, "modal_b": 0j}
        else:
            own = {"analysis_type": 2, "freq": float(terms.frequencies_hz[r]), "modal_m": float(model.scaling == "unit_modal_mass"),
                   "modal_damp_vis": float(terms.damping_ratios[r]), "modal_damp_his": 0.0}  # fmt: skip
        yield dict(
            pyuff.prepare_55(
                **{f"id{i + 1}": text or "NONE" for i, text in enumerate(mode_ids(model, r, check))}, **own,
                model_type=1, data_ch=3 if per_node == 6 else 2, spec_data_type=8, data_type=5 if is_complex else 2,
                n_data_per_node=shape.shape[1], load_case=1, mode_n=r + 1, node_nums=np.array([numbers.number(n) for n in nodes]),
                **{f"r{j + 1}": shape[:, j].copy() for j in range(shape.shape[1])},
            )
        )  # fmt: skip


def _geometry(geometry: Geometry) -> Iterator[dict[str, Any]]:
    import pyuff

    if geometry.systems:
        raise DataError("local coordinate systems have no form in pyuff", hint="write the geometry with operando.io.write_uff")
    numbers = NodeNumbers.of(geometry.nodes)
    shown = geometry.appearance
    zeros = np.zeros(len(geometry.nodes), int)
    x, y, z = np.array(geometry.coordinates, float).T
    yield dict(
        pyuff.prepare_2411(
            node_nums=np.array([numbers.number(n) for n in geometry.nodes]), def_cs=zeros, disp_cs=zeros,
            color=np.array([shown.node_colors.get(n, 1) for n in geometry.nodes]), x=x, y=y, z=z,
        )
    )  # fmt: skip
    for i, (name, color, nodes) in enumerate(trace_sets(geometry, numbers)):
        yield dict(pyuff.prepare_82(trace_num=i + 1, n_nodes=len(nodes), color=color, id=name or "NONE", nodes=np.array(nodes)))
    if geometry.faces:
        colors = shown.face_colors or (1,) * len(geometry.faces)
        elements: dict[Any, Any] = {"type": 2412}
        for i, (face, color) in enumerate(zip(geometry.faces, colors, strict=True)):
            kind = {3: 91, 4: 94}.get(len(face))
            if kind is None:
                raise DataError(f"a face of {len(face)} nodes has no form in UFF 2412", hint="use triangles and quadrilaterals")
            elements.setdefault(kind, []).append(
                {"element_nums": i + 1, "fe_descriptor": kind, "phys_table": 1, "mat_table": 1, "color": color, "num_nodes": len(face),
                 "nodes_nums": [numbers.number(n) for n in face]}
            )  # fmt: skip
        yield elements

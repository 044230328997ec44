"""Plain JSON values of operando's objects: null where there is no value, never NaN."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from operando.dof import Dof
from operando.printable import json_escaped


def json_text(document: Any) -> str:
    r"""JSON document of operando's objects, readable; what acts on a terminal (control characters, direction marks) as ``\u…``.

    Parameters
    ----------
    document : object
        See :func:`jsonable`.
    """
    return json_escaped(json.dumps(jsonable(document), indent=1, ensure_ascii=False, allow_nan=False))


def jsonable(value: Any) -> Any:
    """Value made of dicts with text keys, lists, texts, finite numbers, booleans and None.

    NaN and infinity become None, complex numbers [re, im], DOFs and paths texts, arrays nested lists.
    """
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, complex):
        return [jsonable(value.real), jsonable(value.imag)]
    if isinstance(value, Dof | Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(k): jsonable(v) for k, v in value.items()}
    if isinstance(value, tuple | list | set | frozenset):
        return [jsonable(v) for v in value]
    if hasattr(value, "tolist"):  # numpy arrays and scalars, without importing numpy
        return jsonable(value.tolist())
    if hasattr(value, "to_dict"):
        return jsonable(value.to_dict())
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: jsonable(getattr(value, f.name)) for f in fields(value)}
    return str(value)

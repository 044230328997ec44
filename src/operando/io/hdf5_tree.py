"""How objects of operando stand in HDF5: arrays as datasets named after their place, the rest as JSON, each large array once."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from operando.data import MappedSamples, mapped
from operando.dof import Dof
from operando.errors import DataError

if TYPE_CHECKING:
    import h5py

TREE = "__tree__"
HASH = "blake2b"
"""Key of a hash of 64 bits: as attribute of a group that of its tree, in the tree that of an array."""
PACKED_FROM = 4096
"""Bytes from which an array is compressed, up to the size of records that stay in their file: below, HDF5's notes take as much.
"""


def hash_of(value: str | np.ndarray) -> str:
    """Hash of a text or an array, by which damage is noticed."""
    digest = hashlib.blake2b(digest_size=8)
    if isinstance(value, str):
        digest.update(value.encode("utf-8", "surrogatepass"))
    elif value.dtype.kind in "OU":
        digest.update(json.dumps(value.tolist()).encode())
    else:
        digest.update(f"{value.dtype.str}{value.shape}".encode())
        digest.update(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


@dataclass(frozen=True)
class Target:
    """The group an object is written to, what stands in the file already, and whether large arrays are compressed.

    ``standing`` is what a tree says of each large array, by its hash; ``matrices`` what it says of each large symmetric matrix.
    """

    group: h5py.Group
    standing: dict[str, Any]
    matrices: list[tuple[np.ndarray, dict[str, Any]]]
    packed: bool = True

    def put(self, name: str, value: np.ndarray, stated: str) -> dict[str, str]:
        """Write an array; give back what the tree says of it."""
        write_dataset(self.group, name, value, self.packed)
        return {"__array__": name, HASH: stated}


def write_dataset(group: h5py.Group, path: str, value: Any, packed: bool = True) -> None:
    """Write a text or an array; ``packed``, without loss in less room: bytes of one weight stand together, and then compress."""
    import h5py

    if isinstance(value, str) or (isinstance(value, np.ndarray) and value.dtype.kind in "UO"):
        group.create_dataset(path, data=value, dtype=h5py.string_dtype("utf-8"))
    elif packed and PACKED_FROM <= getattr(value, "nbytes", 0) < mapped.MAPPED_FROM:
        group.create_dataset(path, data=value, chunks=value.shape, compression="gzip", compression_opts=1, shuffle=True)
    elif isinstance(value, np.ndarray) and value.size and value.dtype.kind in "biufc":
        # h5py.Group.create_dataset takes three times as long for the many small arrays of a model
        kind, space = h5py.h5t.py_create(value.dtype, logical=True), h5py.h5s.create_simple(value.shape)
        links, plain = _properties()
        made = h5py.h5d.create(group.id, path.encode(), kind, space, plain, links)
        made.write(h5py.h5s.ALL, h5py.h5s.ALL, np.ascontiguousarray(value))
    else:
        group.create_dataset(path, data=value)


@lru_cache(maxsize=1)
def _properties() -> tuple[h5py.h5p.PropLCID, h5py.h5p.PropDCID]:
    """Of links: groups on the way are made, names are UTF-8. Of datasets: one piece without a time, so that a file is the same again."""
    import h5py

    links, plain = h5py.h5p.create(h5py.h5p.LINK_CREATE), h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    links.set_create_intermediate_group(True)
    links.set_char_encoding(h5py.h5t.CSET_UTF8)
    plain.set_obj_track_times(False)
    return links, plain


def encode(value: Any, target: Target, path: str) -> Any:
    """JSON form of a value; arrays go to datasets named after their path."""
    if value is None or isinstance(value, bool | str | int):
        return value
    if isinstance(value, np.bool_ | np.integer):
        return value.item()
    if isinstance(value, float | np.floating):
        number = float(value)
        return number if math.isfinite(number) else {"__float__": repr(number)}
    if isinstance(value, complex | np.complexfloating):
        return {"__complex__": [repr(float(value.real)), repr(float(value.imag))]}
    if isinstance(value, Dof):
        return {"__dof__": str(value)}
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.ndarray | MappedSamples):
        return _encode_array(np.asarray(value), target, path)
    if isinstance(value, bytes):
        return {"__bytes__": _encode_array(np.frombuffer(value, np.uint8), target, path)}
    if isinstance(value, tuple | list):
        return _encode_sequence(value, target, path)
    if isinstance(value, Mapping):
        if all(isinstance(k, str) and not k.startswith("__") for k in value):
            return {k: encode(v, target, _join(path, k)) for k, v in value.items()}
        pairs = [[encode(k, target, f"{path}/key{i}"), encode(v, target, _join(path, str(i)))] for i, (k, v) in enumerate(value.items())]
        return {"__dict__": pairs}
    if is_dataclass(value) and not isinstance(value, type) and type(value).__module__.split(".")[0] == "operando":
        kind = type(value)
        body = {f.name: encode(getattr(value, f.name), target, _join(path, f.name)) for f in fields(value) if f.init}
        return {"__class__": f"{kind.__module__}:{kind.__qualname__}", "fields": body}
    raise DataError(f"{type(value).__module__}.{type(value).__qualname__} at {path or 'the top'} cannot be stored in HDF5")


def _encode_array(value: np.ndarray, target: Target, path: str) -> Any:
    if value.dtype.kind not in "biufcUS":
        raise DataError(f"an array of {value.dtype} at {path or 'the top'} cannot be stored in HDF5")
    name, stated = path or "value", hash_of(value)
    large = PACKED_FROM <= value.nbytes < mapped.MAPPED_FROM
    if large and stated in target.standing:
        return {"__same__": target.standing[stated]}
    symmetric = large and _symmetric(value)
    if symmetric and (whole := next((tree for matrix, tree in target.matrices if _begins(matrix, value)), None)) is not None:
        return {"__block__": whole, "size": len(value)}
    tree: dict[str, Any]
    if symmetric:
        triangle = value[np.triu_indices(len(value))]
        tree = {"__triangle__": target.put(name, triangle, hash_of(triangle))}
    else:
        tree = target.put(name, value, stated)
    if large:
        target.standing[stated] = _placed(tree, f"{target.group.name.strip('/')}/{name}".strip("/"))
        if symmetric:
            target.matrices.append((value, target.standing[stated]))
    return tree


def _placed(tree: dict[str, Any], name: str) -> dict[str, Any]:
    """What a tree says of an array, with its path from the top of the file."""
    return {"__triangle__": _placed(tree["__triangle__"], name)} if "__triangle__" in tree else tree | {"__array__": name}


def _symmetric(value: np.ndarray) -> bool:
    """Whether a real matrix is symmetric to the bit (0 and −0 differ), so that its triangle says all."""
    if value.ndim != 2 or value.shape[0] != value.shape[1] or value.dtype != np.float64:
        return False
    bits = np.ascontiguousarray(value).view(np.int64)
    return bool(np.array_equal(bits, bits.T))


def _begins(whole: np.ndarray, value: np.ndarray) -> bool:
    """Whether a symmetric matrix is, to the bit, the upper left block of another: what is known of some parameters, and of more."""
    n = len(value)
    first, second = (np.ascontiguousarray(m[:n, :n]).view(np.int64) for m in (whole, value))
    return n < len(whole) and np.array_equal(first, second)


def _encode_sequence(value: tuple[Any, ...] | list[Any], target: Target, path: str) -> Any:
    if len(value) > 0 and all(isinstance(v, Dof) for v in value):
        name = path or "value"
        labels = np.array([str(v) for v in value], dtype=object)
        write_dataset(target.group, name, labels)
        tree: Any = {"__dofs__": name, HASH: hash_of(labels)}
        return tree if isinstance(value, tuple) else {"__list__": tree}
    if len(value) > 32 and all(type(v) is float for v in value):
        return {"__floats__": _encode_array(np.asarray(value, float), target, path), "tuple": isinstance(value, tuple)}
    items = [encode(v, target, _join(path, str(i))) for i, v in enumerate(value)]
    return {"__tuple__": items} if isinstance(value, tuple) else items


def _join(path: str, name: str) -> str:
    """Path of a value below another; two names never make one path."""
    clean = name.replace("%", "%25").replace("/", "%2F").replace(".", "%2E") or "%"
    return f"{path}/{clean}" if path else clean

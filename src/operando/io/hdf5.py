"""Operando's own HDF5 format: any of its dataclasses, arrays as datasets under their field names, the rest as one JSON text.

A group that holds an object has a dataset ``__tree__`` (JSON, with each array replaced by the path of its dataset). So
``h5dump`` or any HDF5 viewer shows ``idle/frequencies_hz``, ``idle/shapes``, … without knowing operando.

HDF5 itself does not notice a changed byte. So the tree holds a hash of each array, the group one of the tree, and the file a list of
its objects: a damaged file is refused, never read as something else. Files of the first version of the format have no hashes; from
the third on a large array that several objects hold stands once, where it comes first, and a symmetric matrix as its upper triangle;
from the fourth on one that is the upper left block of another does not stand again.
"""

from __future__ import annotations

import hashlib
import importlib
import io
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from operando.atomic import replacing
from operando.data import MappedSamples, StoredFile, StoredRow, TimeRecord, check_fields, mapped, mapped_rows, pieces
from operando.data.arrays import owned
from operando.dof import Dof
from operando.errors import FormatError, OperandoError, UnknownKindError
from operando.io.hdf5_tree import HASH, TREE, Target, encode, hash_of, write_dataset
from operando.io.safe import check_growth, opened_hdf5, trust

if TYPE_CHECKING:
    import h5py

SCHEMA = "operando/hdf5/4"
_SCHEMAS = ("operando/hdf5/1", "operando/hdf5/2", "operando/hdf5/3", SCHEMA)
_HASHED = _SCHEMAS[1:]
_CHANGED = "the file is damaged, or was changed after operando wrote it"
UNREADABLE = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError, IndexError)
"""What h5py and the description of an object raise where a file is damaged."""


def _write(target: Target, obj: Any) -> None:
    text = json.dumps(encode(obj, target, ""), ensure_ascii=False, allow_nan=False)
    write_dataset(target.group, TREE, text)
    target.group.attrs[HASH] = hash_of(text)


def read_objects(file: h5py.File, names: Iterable[str]) -> dict[str, Any]:
    """Objects of an open file by the names of their groups; what they share is counted over all of them.

    Fields that this version of operando does not know are left out; fields the file lacks take their defaults.
    """
    repeated = _Repeated(file)
    return {name: _read(file[name], repeated) for name in names}


def _read(group: h5py.Group, repeated: _Repeated) -> Any:
    if TREE not in group:
        raise FormatError(f"group {group.name!r} holds no operando object", where=_where(group), hint="expected a dataset " + TREE)
    try:
        raw = group[TREE][()]
        text = raw.decode("utf-8") if isinstance(raw, bytes) else raw
        stated = group.attrs.get(HASH)
        if stated != hash_of(text) and (stated is not None or _schema(group.file) in _HASHED):
            raise FormatError(f"the description of {group.name!r} is not what was written", where=_where(group), hint=_CHANGED)
        tree = json.loads(text)
    except UNREADABLE as error:
        raise FormatError(f"the description of {group.name!r} is damaged: {error}", where=_where(group)) from error
    return _decode(tree, _Stored(group, repeated))


def write_hdf5(path: str | Path, objects: Mapping[str, Any], *, packed: bool = True) -> None:
    """Write named objects into an HDF5 file, one group each; the file appears whole or not at all.

    Parameters
    ----------
    path : path
        File.
    objects : mapping of name to object
        Any dataclass defined in operando (``TimeRecord``, ``Frf``, ``ModalModel``, ``Geometry``, ``Stabilization``, …, nested as deep as
        wanted), or a dict, list, tuple, array, number, text or None made of such.
    packed : bool
        Compress large arrays: half the size, in twice the time.

    Raises
    ------
    DataError
        If an object holds something that has no lasting form (a function, a foreign object).

    Examples
    --------
    >>> import tempfile, operando
    >>> frf = operando.Frf([[[1.0, 2.0]]], [5.0, 6.0], "7+Z", "1+Z")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_hdf5(f"{folder}/frf.h5", {"idle": frf})
    ...     list(read_hdf5(f"{folder}/frf.h5"))
    ['idle']
    """
    import h5py

    # In memory first: the HDF5 library never sees a write that fails, which it would answer by messages of its own.
    content = io.BytesIO()
    with h5py.File(content, "w", libver=("v108", "v108")) as file:  # the form of HDF5 1.8: many small groups take less room
        file.attrs["schema"], file.attrs["objects"] = SCHEMA, json.dumps(list(objects))
        standing: dict[str, Any] = {}
        matrices: list[tuple[np.ndarray, dict[str, Any]]] = []
        for name, obj in objects.items():
            _write(Target(file.create_group(name), standing, matrices, packed), obj)
    with replacing(path) as stream:
        stream.write(content.getbuffer())
    trust(path, "hdf5")


def read_hdf5(path: str | Path) -> dict[str, Any]:
    """Objects of an HDF5 file of operando, by name.

    Parameters
    ----------
    path : path
        File.

    Returns
    -------
    dict

    Raises
    ------
    FormatError
        If the file is no HDF5 file of operando, or is damaged.

    Examples
    --------
    >>> import tempfile, operando
    >>> frf = operando.Frf([[[1.0, 2.0]]], [5.0, 6.0], "7+Z", "1+Z")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_hdf5(f"{folder}/frf.h5", {"idle": frf})
    ...     read_hdf5(f"{folder}/frf.h5")["idle"].references
    (Dof('1+Z'),)
    """
    import h5py

    try:
        with opened_hdf5(path) as file:
            check_objects(file)
            found = read_objects(file, [str(name) for name, item in file.items() if isinstance(item, h5py.Group) and TREE in item])
    except OperandoError:
        raise
    except UNREADABLE as error:
        raise FormatError(f"cannot be read as HDF5: {error}", where=str(path)) from error
    if not found:
        raise FormatError("an HDF5 file, but without objects of operando", where=str(path), hint="expected groups written by operando")
    return found


def check_objects(file: h5py.File) -> None:
    """Refuse an open file of operando that does not hold all objects it lists, or is of no known version of the format.

    A file of another program lists none, and passes.
    """
    schema = _schema(file)
    if schema is not None and schema not in _SCHEMAS:
        hint = f"known are {' and '.join(_SCHEMAS)}; is the file of a newer version?"
        raise FormatError(f"the format {schema!r:.100} is not known", where=file.filename, hint=hint)
    if schema not in _HASHED:
        return
    try:
        names = list(json.loads(str(file.attrs["objects"])))
    except (KeyError, ValueError, TypeError) as error:
        raise FormatError("the file lists no objects", where=file.filename, hint=_CHANGED) from error
    lost = [name for name in names if not isinstance(name, str) or f"{name}/{TREE}" not in file]
    if lost:
        raise FormatError(f"the object {lost[0]!r:.100} that the file lists is not in it", where=file.filename, hint=_CHANGED)


def _schema(file: h5py.File) -> str | None:
    found = file.attrs.get("schema")
    return None if found is None else str(found)


def _hash_of_rows(samples: MappedSamples, stored: np.dtype[Any]) -> str:
    """The hash of an array that stays in its file, row by row."""
    digest = hashlib.blake2b(f"{stored.str}{samples.shape}".encode(), digest_size=8)
    for i in range(len(samples)):
        for _, part in pieces(samples[[i]], 1 << 21):
            digest.update(np.ascontiguousarray(part, stored).view(np.uint8).data)
    return digest.hexdigest()


def _where(group: h5py.Group) -> str:
    return f"{group.file.filename}:{group.name}"


class _Repeated:
    """Arrays of a file that are read for more than one place: as for all content, no more than in proportion to the file."""

    def __init__(self, file: h5py.File) -> None:
        self.file, self.needed = file, 0

    def array(self, tree: Any) -> np.ndarray:
        """The array that stands elsewhere in the file."""
        found = _array_of(tree, _Stored(self.file["/"], self))
        self.needed += found.nbytes
        check_growth(self.needed, self.file.id.get_filesize(), self.file.filename, "what arrays that stand once and are named again hold")
        return found


def _dataset(group: h5py.Group, name: str) -> h5py.h5d.DatasetID | None:
    """The dataset of a name below a group, None where there is none; h5py.Group.get takes three times as long."""
    import h5py

    try:
        found = h5py.h5o.open(group.id, name.encode())
    except KeyError:
        return None
    return found if isinstance(found, h5py.h5d.DatasetID) else None


class _Stored:
    """The group an object is read from; each of its arrays is taken once."""

    def __init__(self, group: h5py.Group, repeated: _Repeated) -> None:
        self.group, self.repeated = group, repeated
        self._taken: set[str] = set()

    def array(self, name: str, stated: str | None) -> np.ndarray:
        """Values of a dataset below the group, whose hash is stated (None in files of the first version).

        Each is taken once: a short text could name one array many times and fill the memory.
        """
        import h5py

        item = _dataset(self.group, name) if isinstance(name, str) and not name.startswith("/") else None
        if item is None or name in self._taken:
            reason = "named twice" if name in self._taken else "not there"
            raise FormatError(f"the array {name!r} of the description is {reason}", where=self.where)
        self._taken.add(name)
        kind = item.dtype
        if kind.kind in "biufc" and item.shape:
            found = np.zeros(item.shape, kind)
            item.read(h5py.h5s.ALL, h5py.h5s.ALL, found)
        else:
            whole = h5py.Dataset(item)
            found = np.asarray(whole.asstr()[()] if kind.kind == "O" else whole[()])
        if stated is not None and stated != hash_of(found):
            raise FormatError(f"the array {name!r} is not what was written", where=self.where, hint=_CHANGED)
        return found

    def samples(self, name: str, stated: str | None) -> np.ndarray | MappedSamples:
        """The same of the samples of a record, which stay in the file where they are many and lie there as they are in memory."""
        item: Any = self.group.get(name) if isinstance(name, str) and not name.startswith("/") else None
        plain = getattr(item, "ndim", 0) == 2 and item.dtype.kind == "f" and item.nbytes >= mapped.MAPPED_FROM
        start = item.id.get_offset() if plain and item.chunks is None else None
        if start is None or name in self._taken:
            return owned(self.array(name, stated))
        self._taken.add(name)
        step = item.shape[1] * item.dtype.itemsize
        rows = [StoredRow(start + i * step, item.dtype) for i in range(item.shape[0])]
        found = mapped_rows(StoredFile(Path(self.group.file.filename)), rows, item.shape[1], item.dtype.newbyteorder("="))
        if stated is not None and stated != _hash_of_rows(found, item.dtype):
            raise FormatError(f"the array {name!r} is not what was written", where=self.where, hint=_CHANGED)
        return found

    @property
    def where(self) -> str:
        return _where(self.group)


def _decode(tree: Any, stored: _Stored) -> Any:
    if isinstance(tree, list):
        return [_decode(item, stored) for item in tree]
    if not isinstance(tree, dict):
        return tree
    if "__class__" in tree:
        return _decode_class(tree, stored)
    if "__array__" in tree or "__triangle__" in tree:
        return _array_of(tree, stored)
    if "__same__" in tree:
        return stored.repeated.array(tree["__same__"])
    if "__block__" in tree:
        return stored.repeated.array(tree["__block__"])[: tree["size"], : tree["size"]].copy()
    if "__dofs__" in tree:
        return tuple(Dof.parse(str(text)) for text in stored.array(tree["__dofs__"], tree.get(HASH)))
    if "__list__" in tree:
        return list(_decode(tree["__list__"], stored))
    if "__tuple__" in tree:
        return tuple(_decode(item, stored) for item in tree["__tuple__"])
    if "__floats__" in tree:
        numbers = _decode(tree["__floats__"], stored).tolist()
        return tuple(numbers) if tree.get("tuple") else numbers
    if "__bytes__" in tree:
        return _bytes_of(_decode(tree["__bytes__"], stored), stored)
    if "__float__" in tree:
        return float(tree["__float__"])
    if "__complex__" in tree:
        return complex(*(float(part) for part in tree["__complex__"]))
    if "__dof__" in tree:
        return Dof.parse(tree["__dof__"])
    if "__dict__" in tree:
        return {_decode(k, stored): _decode(v, stored) for k, v in tree["__dict__"]}
    return {k: _decode(v, stored) for k, v in tree.items()}


def _array_of(tree: Any, stored: _Stored) -> np.ndarray:
    """An array as it stands, or the symmetric matrix of a triangle."""
    if "__triangle__" not in tree:
        return stored.array(tree["__array__"], tree.get(HASH))
    triangle = stored.array(tree["__triangle__"]["__array__"], tree["__triangle__"].get(HASH))
    size = math.isqrt(2 * triangle.size)  # n² < n(n + 1) < (n + 1)²
    found = np.empty((size, size), triangle.dtype)
    found[np.triu_indices(size)] = triangle
    np.copyto(found, found.T, where=np.tri(size, k=-1, dtype=bool))
    return found


def _bytes_of(value: Any, stored: _Stored) -> bytes:
    if not (isinstance(value, np.ndarray) and value.dtype == np.uint8 and value.ndim == 1):
        raise FormatError("bytes of the description are no row of bytes", where=stored.where, hint=_CHANGED)
    return value.tobytes()


def _class_named(text: str) -> Any:
    """The dataclass of operando with this name, or None. A file can name no other code, and none that runs when it is imported."""
    module_name, _, qualname = text.partition(":")
    parts = module_name.split(".")
    if parts[0] != "operando" or any(part.startswith("_") or part == "cli" for part in parts):
        return None
    try:
        kind: Any = importlib.import_module(module_name)
        for part in qualname.split("."):
            kind = getattr(kind, part)
    except (ImportError, AttributeError, ValueError):
        return None
    return kind if isinstance(kind, type) and is_dataclass(kind) else None


def _decode_class(tree: dict[str, Any], stored: _Stored) -> Any:
    kind = _class_named(str(tree["__class__"]))
    if kind is None or not isinstance(tree.get("fields"), dict):
        raise FormatError(f"{tree['__class__']!r} is no class of this version of operando", where=stored.where)
    # A class whose fields changed makes itself from those of older files.
    make: Any = getattr(kind, "from_stored", None)
    known = {f.name for f in fields(kind) if f.init}
    values: dict[str, Any] = {}
    for name, item in tree["fields"].items():
        if make is None and name not in known:
            continue
        is_samples = kind is TimeRecord and name == "data" and isinstance(item, dict) and "__array__" in item
        values[name] = stored.samples(item["__array__"], item.get(HASH)) if is_samples else _decode(item, stored)
    try:
        made = kind(**values) if make is None else make(values)
        check_fields(made)
    except UnknownKindError as error:
        hint = "a kind of your own must be registered before the file is read: import the module that registers it"
        raise FormatError(f"holds an effect of a kind that is not known here: {error.message}", where=stored.where, hint=hint) from error
    except OperandoError as error:
        reason = f"cannot make {kind.__name__} from what the file holds: {error.message}"
        raise FormatError(reason, where=stored.where, hint="the file is damaged") from error  # not what a call of the class should give
    except Exception as error:  # values of a wrong type fail anywhere in a constructor
        reason = f"{type(error).__name__}: {error}"
        raise FormatError(f"cannot make {kind.__name__} from what the file holds: {reason}", where=stored.where) from error
    return made

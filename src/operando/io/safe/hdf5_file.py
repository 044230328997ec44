"""HDF5 files from elsewhere: everything lies in the file itself, and sizes fit what is stored."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from operando.errors import FormatError
from operando.io.safe.guard import try_apart
from operando.io.safe.limits import DEFLATE_RATIO, check_growth

if TYPE_CHECKING:
    import h5py

_BLOCK = 1 << 22
_FOREIGN = "the data must lie in the file itself: copy them into one file, for example with h5repack"


@contextmanager
def opened_hdf5(path: str | Path) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading, after it was tried in a process of its own."""
    import h5py

    try_apart(path, "hdf5")
    with h5py.File(path, "r") as file:
        yield file


def try_hdf5(path: Path, alive: Callable[[], None] = lambda: None) -> None:
    """Check every link and the size of every dataset, then read once what the library has to take apart.

    Numbers that lie in the file as they are in memory are one read at a known place, and need no trial: so the bulk of a large file is
    read once only, by whoever asked for it. ``alive`` is called at every object: the trial goes on, however many there are.
    """
    import h5py

    with h5py.File(path, "r") as file:
        datasets: list[h5py.Dataset] = []
        _collect(file, path, datasets, {_address(file)}, alive)
        needed = 0
        for dataset in datasets:
            needed += _declared(dataset, path)
            check_growth(needed, path.stat().st_size, str(path), f"what dataset {dataset.name!r} and those before it declare")
        for dataset in datasets:
            alive()
            _read(dataset, path, alive)


def _address(item: h5py.Group | h5py.Dataset) -> int:
    import h5py

    return int(h5py.h5o.get_info(item.id).addr)


def _collect(group: h5py.Group, path: Path, datasets: list[h5py.Dataset], seen: set[int], alive: Callable[[], None]) -> None:
    """All datasets below a group; every object is reached by one hard link."""
    import h5py

    _read_attributes(group)
    waiting = [group]
    while waiting:
        place = waiting.pop()
        for name in place:
            alive()
            if place.id.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
                raise FormatError(f"{name!r} in {place.name!r} is a link to elsewhere", where=str(path), hint=_FOREIGN)
            item = place[name]
            if _address(item) in seen:
                raise FormatError(f"{name!r} in {place.name!r} is linked a second time", where=str(path), hint="the file is damaged")
            seen.add(_address(item))
            _read_attributes(item)
            if isinstance(item, h5py.Group):
                waiting.append(item)
            elif isinstance(item, h5py.Dataset):
                datasets.append(item)


def _read_attributes(item: h5py.Group | h5py.Dataset) -> None:
    import h5py

    if h5py.h5a.get_num_attrs(item.id):
        dict(item.attrs)


def _declared(dataset: h5py.Dataset, path: Path) -> int:
    """Bytes of the numbers of a dataset, checked against the bytes stored for them."""
    import h5py

    properties = dataset.id.get_create_plist()
    if properties.get_external_count() or properties.get_layout() == h5py.h5d.VIRTUAL:
        raise FormatError(f"dataset {dataset.name!r} has its data in another file", where=str(path), hint=_FOREIGN)
    width = dataset.id.get_type().get_size()
    declared = int(dataset.size or 0) * width
    stored = int(dataset.id.get_storage_size())
    most = stored * DEFLATE_RATIO if properties.get_nfilters() else stored
    if declared > most:
        raise FormatError(
            f"dataset {dataset.name!r} declares {dataset.size} values, {declared} bytes; the {stored} bytes stored are too few",
            where=str(path),
            hint="the file is damaged or was not written to its end",
        )
    if stored > path.stat().st_size:
        raise FormatError(f"dataset {dataset.name!r} says it stores {stored} bytes, more than the file has", where=str(path))
    # a chunk is decompressed as a whole, also where the dataset fills a corner of it
    return max(declared, math.prod(dataset.chunks) * width if dataset.chunks else 0)


def _read(dataset: h5py.Dataset, path: Path, alive: Callable[[], None]) -> None:
    """Read the values part by part and throw them away; texts of any length are counted."""
    if dataset.shape is None or _lies_plainly(dataset, path):
        return
    if dataset.ndim == 0 or not dataset.size or (dataset.dtype.kind != "O" and not dataset.chunks and dataset.nbytes <= _BLOCK):
        dataset[()]
        return
    texts = 0
    size = path.stat().st_size
    for part in dataset.iter_chunks() if dataset.chunks else _rows(dataset):
        alive()
        block = dataset[part]
        if dataset.dtype.kind == "O":
            texts += sum(len(item) for item in block.ravel().tolist() if isinstance(item, bytes | str))
            check_growth(texts, size, str(path), f"the texts of dataset {dataset.name!r}")


def _lies_plainly(dataset: h5py.Dataset, path: Path) -> bool:
    """Whether numbers stand in one stretch of the file, not compressed."""
    import h5py

    properties = dataset.id.get_create_plist()
    kinds = [dataset.dtype] if dataset.dtype.names is None else [kind for kind, *_ in (dataset.dtype.fields or {}).values()]
    if properties.get_layout() != h5py.h5d.CONTIGUOUS or properties.get_nfilters() or any(kind.kind not in "biufcS" for kind in kinds):
        return False
    start = dataset.id.get_offset()
    if start is not None and start + dataset.id.get_storage_size() > path.stat().st_size:
        raise FormatError(f"dataset {dataset.name!r} lies beyond the end of the file", where=str(path), hint="the file was cut off")
    return start is not None


def _rows(dataset: h5py.Dataset) -> Iterator[slice]:
    width = dataset.id.get_type().get_size() * dataset.size // dataset.shape[0]
    rows = 64 if dataset.dtype.kind == "O" else max(1, _BLOCK // max(1, width))
    return (slice(start, start + rows) for start in range(0, dataset.shape[0], rows))

"""sdypy-EMA and pyOMA-2 on the same data as operando: frequencies, damping, MAC and time, mode by mode."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from operando.data import Frf, ModalModel, Short, TimeRecord
from operando.ema import fit_ema, second_opinion
from operando.ema.second_opinion import DAMPING_TOLERANCE, FREQUENCY_TOLERANCE
from operando.errors import DataError
from operando.oma import beside_pyoma, fit_oma
from operando.oma.pyoma import AGREE_HZ, AGREE_MAC, AGREE_STD
from operando.threads import one_blas_thread

_EMA = ("sdypy-EMA", "LSCF, one reference at a time; of each mode the reference that drives it most and shows it")
_OMA = ("pyOMA-2", "SSI-cov, no weights, the same references, block rows and orders")

_RULES = {
    "idle": f"agrees: frequency within {100 * FREQUENCY_TOLERANCE:g} %, damping within {100 * DAMPING_TOLERANCE:g} %, whatever the MAC",
    "operating": f"agrees: frequency within {AGREE_STD:g} standard deviations or {100 * AGREE_HZ:g} %, MAC {AGREE_MAC:g} at least, "
    "whatever the damping",
}


@dataclass(frozen=True)
class LibraryMode:
    """One mode here and in the other library; None where one of them does not have it.

    Parameters
    ----------
    frequency_hz, other_frequency_hz : float or None
    damping_ratio, other_damping_ratio : float or None
    mac : float or None
        Of the two shapes.
    agrees : bool
        Whether frequency, damping (EMA alone) and shape agree within what the comparison states.
    text : str
        The difference in words.
    reference : str or None
        Reference whose FRFs the other library was given.
    """

    frequency_hz: float | None
    other_frequency_hz: float | None
    damping_ratio: float | None
    other_damping_ratio: float | None
    mac: float | None
    agrees: bool
    text: str = ""
    reference: str | None = None


@dataclass(frozen=True, repr=False, eq=False)
class LibraryComparison(Short):
    """One library beside operando on the data of one state.

    Parameters
    ----------
    state : {"idle", "operating"}
    library : str
        Name and version.
    method : str
        What it was asked to do.
    modes : tuple of LibraryMode
        Those of operando in the band, then those that only the other library has.
    seconds : float or None
        Wall time of the other library; None where it could not be run.
    own_seconds : float or None
        Wall time of operando's identification with uncertainties, where it is known.
    note : str
        Why there is no comparison, where there is none.
    """

    state: str
    library: str
    method: str
    modes: tuple[LibraryMode, ...] = ()
    seconds: float | None = None
    own_seconds: float | None = None
    note: str = ""

    @property
    def rule(self) -> str:
        """When a mode counts as agreeing, in words."""
        return _RULES[self.state]

    def rows(self) -> list[dict[str, Any]]:
        """One row a mode, as the report draws it."""
        return [asdict(mode) for mode in self.modes]

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        plain = {name: getattr(self, name) for name in ("state", "library", "method", "seconds", "own_seconds", "note")}
        return plain | {"modes": self.rows()}

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> LibraryComparison:
        """Of what :meth:`to_dict` made."""
        return cls(**{**document, "modes": tuple(LibraryMode(**mode) for mode in document["modes"])})

    def facts(self) -> dict[str, str]:
        """What the short form says."""
        own = [m for m in self.modes if m.frequency_hz is not None]
        times = "" if self.seconds is None or self.own_seconds is None else f"{self.seconds:.1f} s against {self.own_seconds:.1f} s here"
        return {
            "Library": f"{self.library} on the {self.state} state",
            "Modes": self.note or f"agrees on {sum(m.agrees for m in own)} of {len(own)} modes",
            "Time": times,
        }


def compare_libraries(
    frf: Frf | None = None,
    records: TimeRecord | Sequence[TimeRecord] | None = None,
    *,
    idle: ModalModel | None = None,
    operating: ModalModel | None = None,
    band: tuple[float, float] | None = None,
    own_seconds: Mapping[str, float] | None = None,
) -> tuple[LibraryComparison, ...]:
    """Fit the same data with sdypy-EMA and pyOMA-2 beside operando.

    sdypy-EMA selects no modes by itself: it is given the frequencies found here and says its nearest stable pole within half the
    distance to the next mode. pyOMA-2's poles go through the same automatic selection as operando's.

    Parameters
    ----------
    frf : Frf, optional
        FRFs at rest, for sdypy-EMA.
    records : TimeRecord or sequence of TimeRecord, optional
        Records in operation, for pyOMA-2.
    idle, operating : ModalModel, optional
        operando's own models of these data; without them they are made here, and timed.
    band : (float, float), optional
        Analysis band [Hz] of models made here.
    own_seconds : mapping, optional
        "idle" and "operating" → wall time that the models given took.

    Returns
    -------
    tuple of LibraryComparison
        One for each kind of data given.

    Raises
    ------
    DataError
        If neither FRFs nor records are given.
    IdentificationError
        If operando finds no mode in them.
    MissingError
        If a library is not installed.

    Examples
    --------
    >>> import numpy as np, operando
    >>> from operando.contrib import compare_libraries
    >>> idle = operando.ModalModel([20.0, 45.0], [0.01, 0.01], np.array([[1.0, 1.0], [1.0, -1.0]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> frf = idle.frf(np.arange(5.0, 80.0, 0.05), references="1+Z")
    >>> compared = compare_libraries(frf, idle=idle)[0]
    >>> [round(mode.other_frequency_hz, 2) for mode in compared.modes], [round(mode.mac, 3) for mode in compared.modes]
    ([20.0, 45.0], [1.0, 1.0])
    """
    if frf is None and records is None:
        raise DataError("there is nothing to compare", hint="give idle FRFs, operating records, or both")
    seconds = dict(own_seconds or {})
    found = []
    states: Any = (("idle", frf, idle, fit_ema, _idle), ("operating", records, operating, fit_oma, _operating))
    for state, data, model, fit, beside in states:
        if data is None:
            continue
        if model is None:
            started = time.perf_counter()
            model = fit(data, band=band)
            seconds[state] = time.perf_counter() - started
        found.append(beside(data, model, seconds.get(state)))
    return tuple(found)


def _named(library: str) -> str:
    try:
        return f"{library} {version(library)}"
    except PackageNotFoundError:
        return library


def _idle(frf: Frf, model: ModalModel, own: float | None) -> LibraryComparison:
    library, method = _named(_EMA[0]), _EMA[1]
    frf = frf.to_quantity("accelerance")
    frf = frf if model.band_hz is None else frf.band(*model.band_hz)
    inside = np.flatnonzero(np.ones(model.n_modes, bool) if model.in_band is None else model.in_band)
    hz, zeta = model.frequencies_hz[inside], model.damping_ratios[inside]
    # That library knows nothing of the window: it is compared with the damping that the FRFs carry.
    seen = zeta + frf.exponential_window_rate / (2 * np.pi * hz)
    shapes = model.rows(frf.responses)[:, inside]
    references = [str(r) for r in frf.references]
    driven = np.abs(model.rows(frf.references)[:, inside])
    started = time.perf_counter()
    try:
        with one_blas_thread():
            told = second_opinion(frf.frequencies_hz, frf.data, hz, seen, references=references, shapes=shapes)
    except DataError as error:  # uneven lines
        return LibraryComparison("idle", library, method, own_seconds=own, note=error.message)
    seconds = time.perf_counter() - started
    modes = []
    for i in range(hz.size):
        mine = [row for row in told if row["mode"] == i]
        best = max(mine, key=lambda row: (row["second_frequency_hz"] is not None, driven[references.index(row["reference"]), i]))
        modes.append(
            LibraryMode(
                float(hz[i]),
                best["second_frequency_hz"],
                float(seen[i]),
                best["second_damping_ratio"],
                best["mac"],
                bool(best["agrees"]),
                best["note"],
                best["reference"] if best["second_frequency_hz"] is not None else None,
            )
        )
    return LibraryComparison("idle", library, method, tuple(modes), seconds, own)


def _operating(records: TimeRecord | Sequence[TimeRecord], model: ModalModel, own: float | None) -> LibraryComparison:
    library, method = _named(_OMA[0]), _OMA[1]
    started = time.perf_counter()
    try:
        with one_blas_thread():
            told = beside_pyoma(model, records)
    except DataError as error:
        return LibraryComparison("operating", library, method, own_seconds=own, note=error.message)
    return LibraryComparison("operating", library, method, tuple(LibraryMode(**row) for row in told), time.perf_counter() - started, own)


def library_rows(documents: Sequence[Mapping[str, Any]], state: str) -> dict[str, Any] | None:
    """What the report shows of the comparison of one state: paragraphs and one row a mode; None where there is none.

    Parameters
    ----------
    documents : sequence of mapping
        ``Results.libraries``.
    state : {"idle", "operating"}

    Returns
    -------
    dict or None
        ``program`` and ``text``: sentences; ``modes``: the rows.

    Examples
    --------
    >>> library_rows([LibraryComparison("idle", "sdypy-EMA", "LSCF", note="uneven lines").to_dict()], "idle")["text"]
    'There is no comparison: uneven lines.'
    """
    found = [LibraryComparison.from_dict(d) for d in documents if d["state"] == state]
    if not found:
        return None
    c = found[0]
    if c.note:
        return {"program": f"{c.library}: {c.method}.", "text": f"There is no comparison: {c.note}.", "modes": []}
    times = [f"{c.library} took {c.seconds:.1f} s" if c.seconds is not None else ""]
    times += [f"operando, with uncertainties, {c.own_seconds:.1f} s" if c.own_seconds is not None else ""]
    text = "; ".join(t for t in times if t)
    return {
        "program": f"The same data through {c.library}: {c.method}. It {c.rule}.",
        "text": f"{text}." if text else "",
        "modes": c.rows(),
    }

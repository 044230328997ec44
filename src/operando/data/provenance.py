"""Where data came from and what was done to them."""

from __future__ import annotations

from dataclasses import dataclass, field

from operando.data.declared import check_fields


@dataclass(frozen=True)
class Provenance:
    """Inputs (path and content hash) and calls that made an object, oldest first.

    Parameters
    ----------
    inputs : tuple of (str, str)
        Path and SHA-256 of each input file.
    calls : tuple of str
        One line a processing step, for example ``estimate_frf(estimator='h1', block_seconds=4.0)``.
    measured : str
        When the data were measured, as the file says (ISO 8601; empty where it does not). Of several inputs the earliest.
    """

    inputs: tuple[tuple[str, str], ...] = ()
    calls: tuple[str, ...] = field(default=())
    measured: str = ""

    def __post_init__(self) -> None:
        check_fields(self)

    def then(self, call: str) -> Provenance:
        """The same inputs with one more processing step."""
        return Provenance(self.inputs, (*self.calls, call), self.measured)

    @classmethod
    def merge(cls, *parts: Provenance) -> Provenance:
        """Inputs and calls of several objects, each once, in order."""
        inputs = dict.fromkeys(i for p in parts for i in p.inputs)
        calls = dict.fromkeys(c for p in parts for c in p.calls)
        return cls(tuple(inputs), tuple(calls), min((p.measured for p in parts if p.measured), default=""))

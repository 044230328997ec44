"""From what a file states about a quantity to SI: labels, codes, unit exponents, unit sets, and what the user adds."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import lru_cache
from math import isclose, isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, names_text
from operando.data.frf import ROUNDING
from operando.dof import Dof
from operando.errors import ConfigError, DataError, DofError, UnitError
from operando.printable import first_few
from operando.units import SI_UNIT, UFF_QUANTITIES, parse_unit

Units = Mapping[str, Any]
"""Quantity → unit text, where the file is silent (the test file's ``[units]``)."""
ChannelSpecs = Mapping[str, Mapping[str, Any]]
"""Channel name or DOF label → dof, quantity, unit, sensitivity, exclude, reason (the test file's ``[channels]``)."""

_BESIDE = ("length", "sampling_hz", "frequency_step_hz", "columns")
"""What may be said of a file besides the units of quantities."""
SPEC_KEYS = ("dof", "quantity", "unit", "sensitivity", "exclude", "reason")
_ROTATIONAL = {"acceleration": "angular_acceleration", "velocity": "angular_velocity", "displacement": "angle", "force": "moment"}
_POWERS = {
    # quantity: powers of length and force in it
    "acceleration": (1, 0), "velocity": (1, 0), "displacement": (1, 0), "force": (0, 1), "moment": (1, 1), "pressure": (-2, 1),
    "stress": (-2, 1), "mass": (-1, 1), "angular_acceleration": (0, 0), "angular_velocity": (0, 0), "angle": (0, 0), "strain": (0, 0),
}  # fmt: skip
_WORDS = {
    "acceleration": ("acceleration", "accel", "acc", "beschleunigung"), "force": ("force", "kraft", "hammer", "load"),
    "velocity": ("velocity", "vel", "geschwindigkeit"), "displacement": ("displacement", "disp", "weg"),
    "voltage": ("voltage", "volt", "spannung"), "strain": ("strain", "dehnung"), "pressure": ("pressure", "mic"),
    "temperature": ("temperature", "temp"),
}  # fmt: skip


def check_stated(units: Any, channels: Any) -> None:
    """Refuse what is no mapping of units, or of channels, and a quantity that is not known."""
    given = (("units", units, 'units={"acceleration": "g"}'), ("channels", channels, 'channels={"ch1": {"dof": "12+Z", "unit": "g"}}'))
    for what, value, example in given:
        if value is not None and not isinstance(value, Mapping):
            raise ConfigError(f"{what} is {value!r:.60}", hint=f"give a dict, as {example}")
    known = (*SI_UNIT, *_BESIDE)
    for key, value in (units or {}).items():
        if key not in known:
            near = get_close_matches(str(key), known, 1, 0.5)
            hint = f"did you mean {near[0]!r}?" if near else "known: " + ", ".join(known)
            raise ConfigError(f"unknown key {key!r:.60}", where="units", hint=hint)
        if (key in SI_UNIT or key == "length") and value not in (None, ""):
            if not isinstance(value, str):
                raise ConfigError(f"{key} is {value!r:.60}, expected a unit", where="units", hint='give a text, as {"acceleration": "g"}')
            try:
                _unit_of(value, key)
            except UnitError as error:
                raise UnitError(error.message, where=f"units {key}", hint=error.hint) from None
    for key, spec in (channels or {}).items():
        if not isinstance(spec, Mapping):
            raise ConfigError(f"{key} is {spec!r:.60}, expected a dict", where="channels", hint='as {"dof": "12+Z", "unit": "g"}')
        _checked(key, spec)


class Asked(dict[str, Mapping[str, Any]]):
    """[channels], which remembers what was looked for in it, and the entries that were found so: a file had a channel for them."""

    def __init__(self, channels: ChannelSpecs | None) -> None:
        super().__init__(channels or {})
        self.asked: set[str] = set()
        self.found: set[str] = set()

    def __getitem__(self, key: str) -> Mapping[str, Any]:
        self.found.add(key)
        return super().__getitem__(key)

    def check(self, where: str) -> None:
        """Refuse an entry that no channel was found for."""
        for key in self:
            if key not in self.found:
                near = get_close_matches(str(key), self.asked, 1, 0.5)
                known = "known: " + first_few(sorted(self.asked), 12)
                hint = f"did you mean {near[0]!r}?" if near else known
                if not self.asked:
                    hint = "nothing there takes an entry; an .h5 file of operando keeps what its channels are"
                raise ConfigError(f"channels: {key!r:.60} names no channel", where=where, hint=hint)


class Silent(dict[str, Any]):
    """[units], which remembers the entries that were not used: quantity, entry, unit of the file → names of what has that."""

    def __init__(self, units: Units | None) -> None:
        super().__init__(units or {})
        self.unused: dict[tuple[str, str, str], dict[str, None]] = {}

    def findings(self, file: str) -> list[Finding]:
        """One finding for each entry that another unit in the file takes the place of."""
        return [
            Finding(
                "unused_unit", f'[units] {quantity} = "{entry}" is not used for {names_text(names)}: the file states {stated}', file=file,
                consequence="the unit of the file counts; [units] is for what a file does not say",
                action="where the file is wrong give the unit of the channel, in [channels]; else leave the entry out",
            )
            for (quantity, entry, stated), names in self.unused.items()
        ]  # fmt: skip


def note_unused(units: Units | None, quantity: str, stated: str, factor: float, name: str) -> None:
    """Note the entry of [units] for a quantity that a file states another unit for; ``name`` is what has that unit."""
    entry = str((units or {}).get(quantity) or "")
    if entry and isinstance(units, Silent) and not isclose(_unit_of(entry, quantity), factor, rel_tol=1e-6):
        units.unused.setdefault((quantity, entry, stated), {})[name] = None


def _unit_of(entry: str, quantity: str) -> float:
    return parse_unit(entry, "displacement" if quantity == "length" else quantity)[1]


@dataclass(frozen=True)
class UnitSystem:
    """Factors of UFF 164: a value in the file's units divided by its factor is SI."""

    length: float = 1.0
    force: float = 1.0
    description: str = ""


@dataclass(frozen=True)
class Scale:
    """How numbers become SI: ``unit`` is empty and ``factor`` 1 where the unit is not known.

    ``origin`` says who stated the unit: ``label``, ``unit set 164``, ``[units]``, ``[channels]``, or empty; ``problem`` a contradiction
    found on the way.
    """

    quantity: str
    unit: str = ""
    factor: float = 1.0
    source_unit: str = ""
    origin: str = ""
    problem: str = ""

    @property
    def known(self) -> bool:
        """Whether the numbers become SI."""
        return bool(self.unit) or self.quantity in ("order", "rpm")


def code_quantity(code: int, dof: Dof | None = None) -> str:
    """Quantity of a UFF data type code; rotational where the DOF is a rotation."""
    quantity = UFF_QUANTITIES.get(code, ("unknown", ""))[0]
    quantity = "force" if quantity == "reaction_force" else quantity
    if quantity == "general":
        quantity = "unknown"
    if dof is not None and dof.axis.startswith("R"):
        quantity = _ROTATIONAL.get(quantity, quantity)
    return quantity


def quantity_from_words(text: str) -> str:
    """Quantity named in a channel name or label (``Acceleration1``, ``Hammer force``), or ``unknown``."""
    words = re.findall(r"[a-zäöü]+", text.lower())
    for quantity, names in _WORDS.items():
        if any(word in names for word in words):
            return quantity
    return "unknown"


@lru_cache(maxsize=256)
def split_ratio(text: str) -> tuple[str, str] | None:
    """Numerator and denominator of a ratio unit: ``(m/s2)/N``, ``m/s2/N``, ``g/lbf``, ``(1/N)*(m/s²)``, ``1/kg``; None if it is none."""
    clean = text.strip()
    if re.fullmatch(r"1\s*/\s*kg|kg\s*\^?\s*-1", clean, re.IGNORECASE):
        return "m/s2", "N"
    match = re.fullmatch(r"\(?\s*1\s*/\s*([^()*]+?)\s*\)?\s*\*\s*\(?\s*([^()]+?)\s*\)?", clean)
    if match is not None:
        return match[2], match[1]
    head, slash, tail = clean.rpartition("/")
    if not slash or not head:
        return None
    try:
        parse_unit(head)
        if parse_unit(tail.strip("() "))[0] not in ("force", "moment"):
            return None
    except UnitError:
        return None
    return head.strip("() "), tail.strip("() ")


def resolve(
    quantity: str,
    text: str,
    units: Units | None = None,
    spec: Mapping[str, Any] | None = None,
    system: UnitSystem | None = None,
    exponents: tuple[int, int, int] = (0, 0, 0),
    name: str = "",
) -> Scale:
    """Decide quantity and SI factor of some numbers.

    What [channels] says (``spec``) comes first, then the unit text of the file, then the unit set 164 of the file (``system``, with the
    exponents of length, force and temperature of the axis), then [units]. ``name`` is what the numbers are of, for findings.
    """
    spec = spec or {}
    problem = ""
    if spec.get("quantity"):
        quantity = str(spec["quantity"])
        if quantity not in SI_UNIT:
            raise UnitError(f"unknown quantity {quantity!r}", where="[channels]", hint="one of " + ", ".join(SI_UNIT))
    if spec.get("unit"):
        found, factor = parse_unit(str(spec["unit"]), quantity)
        return _sensed(Scale(found, SI_UNIT[found], factor, str(spec["unit"]), "[channels]"), spec)
    if text:
        try:
            found, factor = parse_unit(text, "pressure" if quantity == "stress" else quantity)
            note_unused(units, found, text, factor, name)
            return _sensed(Scale(found, SI_UNIT[found], factor, text, "label"), spec)
        except UnitError as error:
            problem = error.message
    powers = (exponents[0], exponents[1]) if any(exponents[:2]) else _POWERS.get(quantity)
    if system is not None and powers is not None and not text:
        factor = system.length ** -powers[0] * system.force ** -powers[1]
        note_unused(units, quantity, system.description or "its own units", factor, name)
        return _sensed(Scale(quantity, SI_UNIT[quantity], factor, system.description, "unit set 164", problem), spec)
    given = None if units is None else units.get(quantity)
    if given and not (text and not problem):
        found, factor = parse_unit(str(given), quantity)
        return _sensed(Scale(found, SI_UNIT[found], factor, str(given), "[units]", problem), spec)
    return _sensed(Scale(quantity, "", 1.0, text, "", problem), spec)


def _sensed(scale: Scale, spec: Mapping[str, Any]) -> Scale:
    """Take a sensitivity (numbers of the file per unit) into the factor."""
    sensitivity = spec.get("sensitivity")
    if sensitivity is None:
        return scale
    try:
        value = float(sensitivity)
    except (TypeError, ValueError):
        value = 0.0
    if not value or not isfinite(value):
        hint = "give the numbers of the file per unit, as 0.1"
        raise ConfigError(f"sensitivity {sensitivity!r:.60} is no number to divide by", where="[channels]", hint=hint)
    return replace(scale, factor=scale.factor / value)


def find_spec(channels: ChannelSpecs | None, name: str, dof: Dof | None, is_force: bool, position: int | None = None) -> Mapping[str, Any]:
    """The user's entry for a channel: by name, by DOF label, by ``ch1``, ``ch2``, … (order in the file).

    A DOF label means the sensor of motion there; the force at the same DOF is ``12+Z:force``.
    """
    if not channels:
        return {}
    keys = [name] if name else []
    if dof is not None:
        labels = {str(dof), f"{dof.node}{dof.axis}" if dof.sign > 0 else str(dof)}
        keys += [f"{label}:force" for label in labels] if is_force else list(labels)
    if position is not None:
        keys.append(f"ch{position + 1}")
    if isinstance(channels, Asked):
        channels.asked.update(keys)
    for key in keys:
        if key in channels:
            return _checked(key, channels[key])
    return {}


def _checked(key: str, spec: Mapping[str, Any]) -> Mapping[str, Any]:
    for word in spec:
        if word not in SPEC_KEYS:
            raise ConfigError(f"unknown key {word!r}", where=f"[channels] {key}", hint="known: " + ", ".join(SPEC_KEYS))
    return spec


def spec_dof(spec: Mapping[str, Any], dof: Dof | None) -> Dof | None:
    """DOF of a channel: the user's where given."""
    if not spec.get("dof"):
        return dof
    try:
        return Dof.parse(str(spec["dof"]))
    except DofError as error:
        raise ConfigError(error.message, where="[channels]", hint=error.hint) from error


def possible_coherence(coherence: NDArray[Any] | None, where: str) -> tuple[NDArray[Any] | None, list[Finding]]:
    """A coherence with NaN for the values below 0 or above 1, which none can have, and the finding about them."""
    if coherence is None:
        return None, []
    wrong = (coherence < -ROUNDING) | (coherence > 1 + ROUNDING)
    if not wrong.any():
        return coherence, []
    message = f"{np.sum(wrong)} of {wrong.size} values of the coherence are below 0 or above 1, the first is {coherence[wrong][0]:g}"
    finding = Finding(
        "impossible_coherence", message, file=where or None, consequence="they are left out: the noise there is not known",
        action="look at what the program that wrote the file calls coherence",
    )  # fmt: skip
    return np.where(wrong, np.nan, coherence), [finding]


def stated_hz(units: Units | None, *keys: str) -> float | None:
    """Number of Hz under the first of some keys of [units] that is there, None where none is."""
    given = next((units[key] for key in keys if units and units.get(key)), None)
    if given is None:
        return None
    what = keys[0].removesuffix("_hz").replace("_", " ").replace("sampling", "sampling rate")
    words = str(given).split()
    try:
        value = float(words[0]) * (parse_unit(words[1], "frequency")[1] if len(words) > 1 else 1.0)
    except (ValueError, IndexError, UnitError) as error:
        raise DataError(f"{what} {given!r} is no number of Hz", where=f"[units] {keys[0]}") from error
    if not (isfinite(value) and value > 0):
        raise DataError(f"{what} {given!r} is not positive", where=f"[units] {keys[0]}")
    return value


def stated_rate(units: Units | None, comments: Sequence[str]) -> float | None:
    """Sampling rate [Hz] of ``units["sampling_hz"]`` or of a comment line, None if neither states one."""
    value = stated_hz(units, "sampling_hz", "sampling")
    if value is not None:
        return value
    for comment in comments:
        match = re.search(r"(?:fs|sampling\w*|sample[ _]?rate)\s*(?:\[Hz\])?\s*[:=]\s*([0-9.eE+]+)", comment, re.IGNORECASE)
        if match is not None and _positive(match[1]):
            return float(match[1])
    return None


def _positive(text: str) -> bool:
    try:
        return float(text) > 0
    except ValueError:
        return False

"""One effect: a kind at a place with values, and its words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from operando.data import check_fields, listed, numbers_of, positive_band
from operando.dof import Dof, parse_dofs
from operando.errors import ConfigError, OperandoError, UnknownKindError
from operando.indicators import INTERVAL
from operando.structure.effects.base import EffectKind
from operando.structure.effects.registry import kind_of
from operando.units import engineering_unit


@dataclass(frozen=True)
class Effect:
    """A physical effect: what, where, how large.

    Parameters
    ----------
    kind : str
        A name of :func:`operando.catalogue`.
    location : tuple of Dof
        One or two DOFs; empty without a place, or where ``position`` says it.
    values : dict
        Parameter name → value in SI; what is left out takes the kind's default.
    std : dict
        Parameter name → standard deviation, where known.
    position : (float, float, float), optional
        A place without a sensor [m].
    direction : str
        Sense and axis at that position, such as "+Z".
    removed : bool
        The opposite of the effect: a mass taken away, a spring that is missing. Values stay positive.
    shape : dict, optional
        DOF label → shape value of unit modal mass, for a missing mode.
    fixed : tuple of str
        Parameters that a fit must hold.
    band_hz : (float, float), optional
        Analysis band [Hz]; used once, for defaults that are the band's centre.

    Raises
    ------
    ConfigError
        If the kind is unknown, takes another number of places, or has no parameter of a given name.

    Examples
    --------
    >>> import operando
    >>> spring = operando.Effect("ground_spring", (operando.Dof(2, "Z"),), {"stiffness": 1.5e5}, {"stiffness": 50.0})
    >>> spring.size
    '150.0 ± 0.1 kN/m'
    """

    kind: str
    location: tuple[Dof, ...] = ()
    values: dict[str, Any] = field(default_factory=dict)
    std: dict[str, float] = field(default_factory=dict)
    position: tuple[float, float, float] | None = None
    direction: str = ""
    removed: bool = False
    shape: dict[str, float] | None = None
    fixed: tuple[str, ...] = ()
    band_hz: tuple[float, float] | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731
        definition = kind_of(self.kind)
        put("location", parse_dofs(self.location))
        if self.position is not None:
            hint = "give x, y, z [m]"
            xyz = numbers_of(self.position, f"position of {self.kind}", hint)
            if xyz.shape != (3,) or not np.all(np.isfinite(xyz)):
                raise ConfigError(f"the position of {self.kind} is {self.position!r:.60}, not three numbers", hint=hint)
            put("position", tuple(float(v) for v in xyz))
            put("direction", str(Dof.parse(f"0{self.direction}"))[1:])
            if self.location or definition.places != 1 or definition.group in ("sensor", "force"):
                raise ConfigError(
                    f"{self.kind} cannot stand at a position without a sensor", hint="only kinds at one DOF of the structure can"
                )
        elif len(self.location) not in (definition.places, *definition.alternative_places):
            raise ConfigError(
                f"{self.kind} takes {definition.places} DOFs, {len(self.location)} given",
                hint=f"write {self.kind}" + ("", "@12+Z", "@12+Z,13+Z")[definition.places],
            )
        elif definition.places == 2 and self.location[0].same_axis(self.location[1]):
            raise ConfigError(f"{self.kind} needs two different DOFs, got {self.location[0]} twice")
        put("fixed", listed(self.fixed))
        if self.band_hz is not None:
            put("band_hz", positive_band(self.band_hz))
        if not isinstance(self.values, Mapping):
            raise ConfigError(f"the values of {self.kind} are {self.values!r:.60}", hint='give a dict, as {"mass": 0.2}')
        values = dict(self.values)
        for name in values:
            definition.parameter(name)
        for p in (*definition.parameters, *definition.constants):
            if definition.acts == "excitation":
                given = numbers_of(values.get(p.name, ()), f"{p.name} of {self.kind}", f"give numbers [{p.unit}]")
                values[p.name] = tuple(float(v) for v in given.ravel())
            elif p.name not in values:
                values[p.name] = p.start(self.band_hz)
            else:
                number = numbers_of(values[p.name], f"{p.name} of {self.kind}", "give a number" + (f" [{p.unit}]" if p.unit else ""))
                if number.ndim or not np.isfinite(number):
                    rule = "positive" if p.transform == "log" else "finite"
                    raise ConfigError(f"{p.name} of {self.kind} must be {rule}, got {values[p.name]!r:.60}")
                values[p.name] = float(number)
        removed = self.removed
        if definition.removable:
            # A negative size is the same effect taken away.
            first = definition.parameters[0].name
            if values[first] < 0:
                values[first], removed = -values[first], not removed
        elif removed:
            raise ConfigError(f"{self.kind} cannot be removed: its opposite is no physical effect")
        for p in definition.parameters:
            if p.transform == "log" and values[p.name] <= 0:
                raise ConfigError(f"{p.name} of {self.kind} must be positive, got {values[p.name]:g}")
        put("values", values)
        put("removed", removed)
        check_fields(self)
        for name, std in self.std.items():
            definition.parameter(name)
            if std < 0:
                raise ConfigError(f"the standard deviation of {name} of {self.kind} is {std:g}", hint="give one of at least 0")

    def __hash__(self) -> int:
        return hash((self.kind, self.location, self.position, self.direction, self.removed, frozenset(self.values.items())))

    @property
    def definition(self) -> EffectKind:
        """The kind: words, parameters, how it acts."""
        return kind_of(self.kind)

    def _known(self) -> EffectKind | None:
        """The kind, None where it was taken out of the catalogue since: the effect can still be shown."""
        try:
            return self.definition
        except UnknownKindError:
            return None

    @property
    def supported(self) -> bool:
        """Whether the 95 % interval of its size, its first value, leaves out that at which the effect says nothing: a gain of 1, else 0.

        Further values say of which form it is: a contact without a gap is one, too.
        """
        return not self.definition.parameters or self._leaves_out_nothing(self.definition.parameters[0].name)

    @property
    def determined(self) -> bool:
        """Whether that holds for every fitted value: else the data leave room for a simpler form.

        Values that may be 0 by the catalogue are not asked, as the speed below which friction is smoothed, and no exponents.
        """
        asked = [p.name for p in self.definition.parameters if p.low != 0.0 and p.name != "exponent"]
        return all(self._leaves_out_nothing(name) for name in asked)

    def _leaves_out_nothing(self, name: str) -> bool:
        return name not in self.std or abs(float(self.values[name]) - (name == "gain")) > INTERVAL * self.std[name]

    @property
    def sign(self) -> float:
        """−1 for an effect taken away."""
        return -1.0 if self.removed else 1.0

    @property
    def place(self) -> str:
        """Where, in words."""
        if self.position is not None:
            return place_words({"position": self.position, "direction": self.direction})
        return " and ".join(str(d) for d in self.location)

    @property
    def size(self) -> str:
        """How large, in words; ± is the 95 % interval."""
        parts = []
        if (definition := self._known()) is None:
            return ", ".join(f"{name} {value}" for name, value in self.values.items())
        for p in (*definition.parameters, *definition.constants):
            value, std = self.values[p.name], self.std.get(p.name)
            if isinstance(value, (tuple, list)):
                if not value:
                    continue
                parts.append(", ".join(f"{v:.5g}" for v in value) + (f" {p.unit}" if p.unit else ""))
                continue
            spread = None if std is None else INTERVAL * std
            size = max(abs(value), spread if spread is not None and np.isfinite(spread) else 0.0)
            factor, unit = (0.01, "%") if p.name == "change" else engineering_unit(size, p.unit)
            text = f"{value / factor:.4g}" if not spread else with_spread(value / factor, spread / factor)
            text = f"{text} {unit}".strip()
            alone = len(definition.parameters) + len(definition.constants) == 1
            parts.append(text if alone else f"{p.plain} {text}")
        return ", ".join(parts)

    @property
    def short(self) -> str:
        """Kind, location and size in a few words."""
        kind = f"{self.kind} taken away" if self.removed else self.kind
        return ", ".join(part for part in (f"{kind} at {self.place}" if self.place else kind, self.size) if part)

    @property
    def explanation(self) -> str:
        """One sentence in plain words."""
        text = self.definition.explain(self.place, self.size, self.removed)
        return text[:1].upper() + text[1:]

    @property
    def confirm(self) -> str:
        """The test that would confirm it."""
        return self.definition.confirm(self.place, self.values)

    def with_values(self, **values: Any) -> Effect:
        """The effect with other values; standard deviations of the changed ones are dropped."""
        kept = {n: s for n, s in self.std.items() if n not in values}
        return replace(self, values={**self.values, **values}, std=kept)

    def with_std(self, std: Mapping[str, float]) -> Effect:
        """The effect with standard deviations."""
        return replace(self, std={**self.std, **std})

    def to_dict(self) -> dict[str, Any]:
        """JSON object as in ``diagnosis.json``."""
        definition = self.definition
        parameters = {}
        for p in (*definition.parameters, *definition.constants):
            value = self.values[p.name]
            if self.removed and p.name == definition.parameters[0].name:
                value = -value  # so that the law of the contract holds as it stands
            std = self.std.get(p.name)
            parameters[p.name] = {
                "value": [float(v) for v in value] if isinstance(value, (tuple, list)) else float(value),
                "unit": p.unit,
                "std": None if std is None or not np.isfinite(std) else float(std),
            }
        out: dict[str, Any] = {"kind": self.kind, "location": [str(d) for d in self.location], "parameters": parameters}
        if self.position is not None:
            out |= {"position": list(self.position), "direction": self.direction}
        if self.removed:
            out["removed"] = True
        if self.shape is not None:
            out["shape"] = {k: float(v) for k, v in self.shape.items()}
        if self.fixed:
            out["fixed"] = list(self.fixed)
        return out | {"explanation": self.explanation, "confirm": self.confirm}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Effect:
        """The effect of a JSON object made by :meth:`to_dict`.

        Raises
        ------
        ConfigError
            If it is none.
        """
        try:
            return cls._from_dict(data)
        except OperandoError:
            raise
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            hint = 'give what Effect.to_dict gives, as {"kind": "point_mass", "location": ["3+Z"], "parameters": {"mass": {"value": 0.2}}}'
            raise ConfigError(f"{data!r:.200} describes no effect ({type(error).__name__}: {error})", hint=hint) from error

    @classmethod
    def _from_dict(cls, data: Mapping[str, Any]) -> Effect:
        values, std = {}, {}
        for name, entry in data.get("parameters", {}).items():
            value = entry["value"]
            values[name] = tuple(value) if isinstance(value, list) else value
            if entry.get("std") is not None:
                std[name] = float(entry["std"])
        position = data.get("position")
        return cls(
            data["kind"],
            parse_dofs(data.get("location", ())),
            values,
            std,
            None if position is None else tuple(position),
            data.get("direction", ""),
            False,  # a negative size says it
            data.get("shape"),
            tuple(data.get("fixed", ())),
        )

    def __str__(self) -> str:
        place = f"{','.join(f'{v:g}' for v in self.position)}:{self.direction}" if self.position else ",".join(map(str, self.location))
        numbers, known = [], self._known()
        for name, value in self.values.items():
            if isinstance(value, (tuple, list)):
                if value:
                    numbers.append(f"{name}:{';'.join(f'{v:.6g}' for v in value)}")
            else:
                first = known is not None and known.removable and name == known.names[0]
                numbers.append(f"{name}:{(self.sign if first else 1.0) * value:.6g}")
        return f"{self.kind}{f'@{place}' if place else ''}{'=' + ','.join(numbers) if numbers else ''}"


def place_words(effect: Mapping[str, Any]) -> str:
    """Where an effect of a document stands, in short: its DOFs, or where no sensor is its position."""
    position = effect.get("position")
    if position:
        return f"({', '.join(f'{v:.4g}' for v in position)}) m, {effect['direction']}"
    return ", ".join(map(str, effect.get("location") or ()))


def with_spread(value: float, std: float) -> str:
    """``0.200 ± 0.004``: the spread with one digit, the value to the same digit."""
    if not np.isfinite(std) or std <= 0:
        return f"{value:.4g}"
    digits = int(np.floor(np.log10(float(f"{std:.0e}"))))  # of the rounded spread: 0.098 is 0.1
    if -6 <= digits <= 4:
        places = max(0, -digits)
        return f"{value:.{places}f} ± {std:.{places}f}"
    lead = max(1, int(np.floor(np.log10(max(abs(value), std)))) - digits + 1)
    return f"{value:.{lead}g} ± {std:.1g}"

"""What a kind of effect is: words, places, parameters with units and bounds, and how it acts on the structure or the measurement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel, check_fields
from operando.data.arrays import ByContent
from operando.errors import ConfigError
from operando.units import engineering_unit

Array = NDArray[Any]
Values = Mapping[str, Any]

TRANSFORMS = ("log", "linear", "signed_log")
_KNEE = 1e-9
"""A signed value below this share of the larger bound counts as zero on the signed logarithmic scale."""


@dataclass(frozen=True)
class Parameter:
    """One number of an effect.

    Parameters
    ----------
    name : str
        As in the specification's table.
    unit : str
        SI unit, empty for a ratio.
    low, high : float or None
        Bounds; None stands for the edge of the analysis band [Hz].
    transform : {"log", "linear", "signed_log"}
        Scale on which a search moves.
    default : float or None
        Start within the bounds where nothing better is known; None stands for the centre of the band [Hz].
    plain : str
        What it is, in words.

    Raises
    ------
    ConfigError
        If the name is not one word, or bounds, transform and default do not fit together.

    Examples
    --------
    >>> from operando import Parameter
    >>> gap = Parameter("gap", "m", 1e-6, 1e-2, "log", 1e-4, "half the play")
    >>> gap.bounds()
    (1e-06, 0.01)
    """

    name: str
    unit: str
    low: float | None
    high: float | None
    transform: str = "log"
    default: float | None = 1.0
    plain: str = ""

    def __post_init__(self) -> None:
        check_fields(self)
        if self.transform not in TRANSFORMS:
            raise ConfigError(f"transform {self.transform!r} of {self.name} is none of {', '.join(TRANSFORMS)}")
        if np.isnan([v for v in (self.low, self.high, self.default) if v is not None]).any():
            raise ConfigError(f"a bound or the default of {self.name} is NaN", hint="give numbers, or None for what follows from the band")
        if not self.name.isidentifier():
            raise ConfigError(f"a parameter is called {self.name!r:.60}", hint="give one word, as in kind@3+Z=word:1.5")
        low, high = -np.inf if self.low is None else self.low, np.inf if self.high is None else self.high
        if not low <= high:
            raise ConfigError(f"{self.name} has the bounds {low:g} and {high:g}", hint="give the lower one first")
        if self.transform == "log" and self.low is not None and self.low <= 0:
            hint = 'give a lower bound above 0, or the transform "linear" or "signed_log"'
            raise ConfigError(f"{self.name} has the lower bound {low:g} on a logarithmic scale", hint=hint)
        if self.default is not None and not low <= self.default <= high:
            raise ConfigError(
                f"the default of {self.name} is {self.default:g}, expected {low:g} to {high:g}", hint="give one within the bounds"
            )

    def bounds(self, band_hz: tuple[float, float] | None = None) -> tuple[float, float]:
        """Lower and upper bound; the band stands in where the kind leaves a bound open.

        Raises
        ------
        ConfigError
            If a bound is the band's edge and no band is given.
        """
        if (self.low is None or self.high is None) and band_hz is None:
            raise ConfigError(f"the bounds of {self.name} are those of the analysis band", hint="give band_hz")
        low = band_hz[0] if self.low is None and band_hz else self.low
        high = band_hz[1] if self.high is None and band_hz else self.high
        assert low is not None
        assert high is not None
        return float(low), float(high)

    def start(self, band_hz: tuple[float, float] | None = None) -> float:
        """The default, or the centre of the band.

        Raises
        ------
        ConfigError
            If the default is the band's centre and no band is given.
        """
        if self.default is not None:
            return float(self.default)
        if band_hz is None:
            raise ConfigError(f"{self.name} starts at the centre of the analysis band", hint=f"give band_hz or {self.name}")
        return float((band_hz[0] + band_hz[1]) / 2)

    def inward(self, value: float) -> float:
        """Value on the scale a search moves on."""
        if self.transform == "log":
            return float(np.log(max(value, 1e-300)))
        if self.transform == "signed_log":
            return float(np.arcsinh(value / self._knee()))
        return float(value)

    def outward(self, moved: float) -> float:
        """Value from the scale a search moves on."""
        if self.transform == "log":
            return float(np.exp(moved))
        if self.transform == "signed_log":
            return float(self._knee() * np.sinh(moved))
        return float(moved)

    def slope(self, value: float) -> float:
        """d value / d moved."""
        if self.transform == "log":
            return float(abs(value))
        if self.transform == "signed_log":
            return float(np.hypot(value, self._knee()))
        return 1.0

    def _knee(self) -> float:
        return _KNEE * max(abs(self.low or 0.0), abs(self.high or 0.0), 1e-300)


@dataclass(frozen=True, eq=False)
class Quadratic(ByContent):
    """δZ(s) = M s² + C s + K over the place's coordinates followed by internal degrees of freedom."""

    mass: Array
    damping: Array
    stiffness: Array

    @property
    def internal(self) -> int:
        """How many coordinates the matrices have (place and internal)."""
        return int(self.mass.shape[0])


class EffectKind:
    """A kind of physical effect; subclass it, fill the class attributes and one way of acting, and :func:`register` it.

    Attributes
    ----------
    kind : str
        Name in the specification's table.
    plain : str
        Plain words, without place and size.
    group : {"structure", "sensor", "force", "idle", "excitation"}
        What it is about: the running structure, a response channel, a force channel, the idle model itself, or the excitation.
    acts : {"dynamic_stiffness", "pseudo_force", "sensor_map", "modal_change", "added_mode", "excitation"}
        Which of the methods below says what it does.
    places : {0, 1, 2}
        How many DOFs it takes.
    alternative_places : tuple of int
        Other numbers of DOFs it can take (two for the difference of two displacements).
    coordinates : {"difference", "separate", "node"}
        What x is: the (difference of the) place's displacement, both displacements apart (skew kinds), or all measured directions
        of the node.
    parameters : tuple of Parameter
        Those a fit may move.
    constants : tuple of Parameter
        Those that are stated with the values but never fitted.
    contains : tuple of str
        Simpler kinds it turns into for some values of its parameters.
    symmetric, level_dependent : bool
        Whether H stays symmetric; whether the effect depends on the level.
    moves : str
        What it moves: "frequencies", "damping", "both", or "nothing" (the channels only).
    removable : bool
        Whether the opposite (a mass taken away, a spring that is missing) makes sense.
    says, says_removed, confirms : str
        Sentences with ``{location}`` and ``{size}`` (``confirms``: ``{location}``, ``{values[name]}`` and, with its unit,
        ``{sizes[name]}``); plain ones where left out.

    Examples
    --------
    >>> from operando import EffectKind, Parameter
    >>> class Inerter(EffectKind):
    ...     kind, plain, places = "inerter", "an inerter between two points", 2
    ...     parameters = (Parameter("inertance", "kg", 1e-3, 1e4, "log", 1.0, "inertance"),)
    ...
    ...     def dynamic_stiffness(self, s, values):
    ...         return values["inertance"] * s**2
    >>> [p.name for p in Inerter.parameters]
    ['inertance']
    """

    kind: ClassVar[str] = ""
    plain: ClassVar[str] = ""
    group: ClassVar[str] = "structure"
    acts: ClassVar[str] = "dynamic_stiffness"
    places: ClassVar[int] = 1
    alternative_places: ClassVar[tuple[int, ...]] = ()
    coordinates: ClassVar[str] = "difference"
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    constants: ClassVar[tuple[Parameter, ...]] = ()
    contains: ClassVar[tuple[str, ...]] = ()
    symmetric: ClassVar[bool] = True
    level_dependent: ClassVar[bool] = False
    moves: ClassVar[str] = "both"
    removable: ClassVar[bool] = False
    says: ClassVar[str] = ""
    says_removed: ClassVar[str] = ""
    confirms: ClassVar[str] = "measure again at another level and look whether the same effect is found"

    def __repr__(self) -> str:
        return f"<EffectKind: {self.kind}; {self.plain}>"

    # How it acts: one of these.

    def dynamic_stiffness(self, s: Array, values: Values) -> Array:
        """Force over displacement that is added at complex s [rad/s]: f = Z x, the structure feels −f. Same shape as s."""
        raise NotImplementedError(f"{self.kind} has no dynamic stiffness")

    def matrix(self, s: Array, values: Values, size: int = 1) -> Array:
        """δZ (…, size, size) over the place's coordinates; by default the dynamic stiffness on each of them."""
        return np.asarray(self.dynamic_stiffness(s, values))[..., None, None] * np.eye(size)

    def quadratic(self, values: Values, size: int = 1) -> Quadratic | None:
        """The same as M, C, K (with internal DOFs where it has some), or None where no finite number of them says it."""
        return None

    def pseudo_force(self, x: Array, v: Array, values: Values) -> Array:
        """Restoring force along the place at displacement x and velocity v; the structure feels the opposite. Same shape as x."""
        raise NotImplementedError(f"{self.kind} has no restoring force")

    def over_steps(self, x: Array, v: Array, values: Values, step: float) -> Array:
        """Restoring force (…, N) along a motion sampled at ``step`` [s], in the mean over the step around each sample.

        By default the force at the sample; a law that jumps or remembers says here what a record of it holds.
        """
        return self.pseudo_force(x, v, values)

    def sensor_map(self, frequencies_hz: Array, values: Values) -> Array:
        """Complex factor of the measured over the true channel at each frequency [Hz] (which may be complex: s/2πi)."""
        raise NotImplementedError(f"{self.kind} maps no channel")

    def modal_change(self, idle: ModalModel, values: Values) -> ModalModel:
        """The idle model under a change that keeps its shapes."""
        raise NotImplementedError(f"{self.kind} changes no modal model")

    def added_mode(self, idle: ModalModel, values: Values, shape: Array) -> ModalModel:
        """The idle model with one mode more, of shape (n_dofs,) and unit modal mass."""
        raise NotImplementedError(f"{self.kind} adds no mode")

    # Words.

    def explain(self, place: str, size: str, removed: bool = False) -> str:
        """One sentence with place and size."""
        sentence = self.says_removed if removed and self.says_removed else self.says
        if sentence:
            return sentence.format(location=place, size=size)
        return f"{self.plain}{f' at {place}' if place else ''}{f': {size}' if size else ''}{' taken away' if removed else ''}"

    def confirm(self, place: str, values: Values) -> str:
        """The test that would confirm it."""
        sizes = {}
        for p in self.parameters:
            if isinstance(value := values.get(p.name), (int, float)):
                factor, unit = engineering_unit(abs(value), p.unit)
                sizes[p.name] = f"{float(f'{value / factor:.2g}'):g} {unit}".strip()
        return self.confirms.format(location=place, values=values, sizes=sizes)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters a fit may move."""
        return tuple(p.name for p in self.parameters)

    def parameter(self, name: str) -> Parameter:
        """The parameter or constant of this name.

        Raises
        ------
        ConfigError
            If the kind has none of this name.
        """
        for p in (*self.parameters, *self.constants):
            if p.name == name:
                return p
        known = ", ".join(p.name for p in (*self.parameters, *self.constants)) or "none"
        raise ConfigError(f"{self.kind} has no parameter {name!r}", hint=f"it has: {known}")

    def defaults(self, band_hz: tuple[float, float] | None = None) -> dict[str, float]:
        """Start values of all parameters and constants."""
        return {p.name: p.start(band_hz) for p in (*self.parameters, *self.constants)}

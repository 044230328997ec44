"""Effects as the search sees them: numbers of DOFs and values on a search scale, with the laws of the catalogue."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from operando.dof import Dof
from operando.structure.effects import Effect, EffectKind, Parameter, kind_of

Array = NDArray[Any]

SEARCHED = (
    "point_mass", "ground_spring", "ground_damper", "ground_hysteretic_spring", "ground_rubber", "coupling_spring", "coupling_damper",
    "gyroscopic", "circulatory", "tuned_absorber", "sensor_gain", "sensor_delay", "sensor_polarity", "channel_swap", "force_gain",
    "force_delay", "global_stiffness", "global_damping",
)  # fmt: skip
"""Kinds looked for where the test file names none."""

IN_FRFS = ("dynamic_stiffness", "sensor_map", "modal_change")
"""Ways of acting that FRFs show."""

AT_ONE_LOCATION = tuple(kind for kind in SEARCHED if kind_of(kind).acts != "dynamic_stiffness" or kind_of(kind).places < 2)
"""Those looked for where the idle model misses the idle FRFs themselves, so that nothing can be explained: of 81 sensors there are 3240
pairs, and to look at all of them took ten minutes."""

BY_SLOPE = ("point_mass", "ground_spring", "ground_damper", "coupling_spring", "coupling_damper", "gyroscopic", "circulatory")
"""Kinds of one size in which the dynamic stiffness is linear: found by the slope of the response at size zero."""

_ORDER = 3  # of the polynomials of a free law


class FreeLaw(EffectKind):
    """A smooth dynamic stiffness of no kind in the catalogue: polynomials in frequency, real and imaginary.

    Not in the catalogue, so nobody can look for it by name: what it explains has a location, and no kind.
    """

    kind = "free_law"
    plain = "a force law of no kind in the catalogue"
    alternative_places = (2,)

    parameters = (
        Parameter("scale", "N/m", 1e-300, 1e300),
        *(Parameter(f"{part}_{k}", "", -np.inf, np.inf, "linear", 0.0) for part in ("real", "imaginary") for k in range(_ORDER + 1)),
    )

    @classmethod
    def basis(cls, w: Array, band: tuple[float, float]) -> Array:
        """Chebyshev polynomials over the band, then i times these, (n_lines, values)."""
        low, high = band
        x = (np.real(w) / np.pi - high - low) / (high - low)
        real = np.polynomial.chebyshev.chebvander(x, _ORDER)
        return np.concatenate([real, 1j * real], axis=-1)


FREE_LAW = FreeLaw()

_HELD = 1e-5  # standard deviation on the search scale of a value that is held by hand; a likely size found beside it has its own
_STEP = 1e-5  # of a value on its search scale, for derivatives of a law: error of second order, 1e-10


@dataclass(frozen=True)
class Term:
    """An effect at places of the idle model.

    ``places`` are numbers of DOFs; a mass has all of its node. ``values`` are on the search scale: the logarithm of the first value (for
    all damping of 1 + change, for a sensor of the gain), a delay as it is, the others on their scale in the catalogue. ``sign`` is 1, or −1
    for the opposite of the kind, or a negative size; of a free law between two it acts on their sum. ``fixed`` are numbers of values that
    no fit moves.
    """

    kind: str
    places: tuple[int, ...] = ()
    values: tuple[float, ...] = ()
    sign: int = 1
    fixed: tuple[int, ...] = ()

    @classmethod
    def of(cls, effect: Effect, places: tuple[int, ...]) -> Term:
        """An effect at DOFs of an idle model."""
        definition, values = effect.definition, effect.values
        sign = -1 if effect.removed else 1
        out = []
        for number, p in enumerate(definition.parameters):
            value = float(values[p.name])
            if number or effect.kind.endswith("_delay"):
                out.append(float(p.inward(value)) if number else value)
                continue
            if not definition.removable and value < 0:
                sign, value = -1, -value
            out.append(float(np.log(1 + sign * value if effect.kind == "global_damping" else value)))
        held = tuple(i for i, p in enumerate(definition.parameters) if p.name in effect.fixed)
        return cls(effect.kind, places, tuple(out), 1 if effect.kind == "global_damping" else sign, held)

    @property
    def definition(self) -> EffectKind:
        return FREE_LAW if self.kind == FREE_LAW.kind else kind_of(self.kind)

    @property
    def key(self) -> tuple[str, tuple[int, ...]]:
        return self.kind, tuple(sorted(self.places))

    @property
    def structural(self) -> bool:
        """Whether it adds dynamic stiffness."""
        return self.definition.acts == "dynamic_stiffness"

    @property
    def along(self) -> Array:
        """What a kind of one coordinate acts on, by its places: one of them, or the difference of two.

        Of a free law it may be the sum: of two sensors of one axis and opposite senses that is how far their places move apart.
        """
        second = -self.sign if isinstance(self.definition, FreeLaw) else -1
        return np.array([1.0, second])[: len(self.places)]

    def moved(self, values: Iterable[float]) -> Term:
        """With other values, but for those that no fit moves."""
        new = tuple(float(v) for v in values)
        if self.fixed:
            new = tuple(self.values[i] if i in self.fixed else v for i, v in enumerate(new))
        return Term(self.kind, self.places, new, self.sign, self.fixed)

    @property
    def size(self) -> float | None:
        """First value in SI units; None for a kind without one."""
        if not self.values:
            return None
        if self.kind.endswith("_delay"):
            return self.values[0]
        size = float(np.exp(self.values[0]))
        return size - 1 if self.kind == "global_damping" else size if self.kind.endswith("_gain") else self.sign * size

    def sizes(self, band: tuple[float, float]) -> dict[str, float]:
        """All values in SI units; the first without its sign where the kind can be taken away."""
        definition = self.definition
        out = {p.name: p.start(band) for p in definition.constants}
        for number, (p, value) in enumerate(zip(definition.parameters, self.values, strict=True)):
            out[p.name] = p.outward(value) if number else float(self.size or 0.0)
        if definition.removable:
            first = definition.parameters[0].name
            out[first] = abs(out[first])
        return out

    @property
    def linear(self) -> bool:
        """Whether the first value is the size itself, which may be zero, and no logarithm of it."""
        return self.kind.endswith(("_gain", "_delay")) or self.kind == "global_damping"

    def within_range(self, band: tuple[float, float]) -> bool:
        """Whether the values after the first lie in the ranges of the catalogue: beyond them a kind is another one by its name."""
        sizes = self.sizes(band)
        ranges = {p.name: p.bounds(band) for p in self.definition.parameters[1:]}
        return all(low <= sizes[name] <= high for name, (low, high) in ranges.items())

    def slope(self, number: int, band: tuple[float, float]) -> float:
        """Derivative of a value in SI units by that on the search scale."""
        if number == 0:
            if self.kind.endswith("_delay"):
                return 1.0
            return float(np.exp(self.values[0]))
        p = self.definition.parameters[number]
        return p.slope(self.sizes(band)[p.name])

    def effect(
        self,
        dofs: Sequence[Dof],
        std: Sequence[float],
        band: tuple[float, float],
        midway: Mapping[int, tuple[float, float, float] | None],
    ) -> Effect:
        """With units, place and standard deviations; ``midway`` are the positions of DOFs without a sensor."""
        definition = self.definition
        numbered = list(enumerate(zip(definition.parameters, std, strict=True)))
        kept = [i for i, (_, s) in numbered if i in self.fixed and s < _HELD]
        spread = {p.name: abs(self.slope(i, band)) * float(s) for i, (p, s) in numbered if i not in kept}
        held = tuple(p.name for i, (p, _) in numbered if i in kept)
        place = self.places[:1] if definition.coordinates == "node" else self.places
        removed = definition.removable and self.sign < 0
        values, position = self.sizes(band), midway.get(place[0]) if place else None
        if position is not None:
            return Effect(self.kind, (), values, spread, position, f"+{dofs[place[0]].axis}", removed, fixed=held, band_hz=band)
        return Effect(self.kind, tuple(dofs[i] for i in place), values, spread, removed=removed, fixed=held, band_hz=band)


def touched(terms: Iterable[Term]) -> list[int]:
    """DOFs on which structural effects act."""
    return sorted({i for t in terms if t.structural for i in t.places})


def moved(terms: Sequence[Term], values: Array) -> list[Term]:
    """The terms with new values, one after the other."""
    out, at = [], 0
    for term in terms:
        out.append(term.moved(values[at : at + len(term.values)]))
        at += len(term.values)
    return out


def added(term: Term, w: Array, band: tuple[float, float]) -> Array:
    """Dynamic stiffness that a term adds between its places on the lines w [rad/s], (n_lines, places, places)."""
    definition = term.definition
    single = definition.coordinates == "difference"
    if isinstance(definition, FreeLaw):
        return (definition.basis(w, band) @ term.values[1:] * np.exp(term.values[0]))[:, None, None] * np.outer(term.along, term.along)
    sign = term.sign if definition.removable else 1
    z = sign * np.asarray(definition.matrix(1j * w, term.sizes(band), 1 if single else len(term.places)), complex)
    return z * np.outer(term.along, term.along) if single else z


def slopes(term: Term, w: Array, band: tuple[float, float]) -> list[Array]:
    """Derivatives of :func:`added` by the values."""
    out = [added(term, w, band)] if _proportional(term.kind) else []
    for number in range(len(out), len(term.values)):
        step = _STEP * (np.arange(len(term.values)) == number)
        up, down = (added(term.moved(np.array(term.values) + side * step), w, band) for side in (1, -1))
        out.append((up - down) / (2 * _STEP))
    return out


def added_by_each(terms: Sequence[Term], w: Array, band: tuple[float, float]) -> Array:
    """Dynamic stiffness that each of some terms of one kind and place adds, (n_lines, places, places, n)."""
    if not _proportional(terms[0].kind):
        return np.stack([added(term, w, band) for term in terms], -1)
    units: dict[tuple[float, ...], Array] = {}
    for term in terms:
        if term.values[1:] not in units:
            units[term.values[1:]] = added(replace(term.moved((0.0, *term.values[1:])), sign=1), w, band)
    return np.stack([term.sign * np.exp(term.values[0]) * units[term.values[1:]] for term in terms], -1)


def resonator(term: Term, band: tuple[float, float]) -> tuple[Array, Array, Array] | None:
    """M, C, K of a kind that has coordinates of its own, as an absorber: over its places, then over these; None of other kinds."""
    if not term.structural or isinstance(term.definition, FreeLaw):
        return None
    single = term.definition.coordinates == "difference"
    size = 1 if single else len(term.places)
    form = term.definition.quadratic(term.sizes(band), size)
    if form is None or form.internal <= size:
        return None
    along = term.along[None] if single else np.eye(size)
    to = block_diag(along, np.eye(form.internal - size))
    sign = term.sign if term.definition.removable else 1
    mass, damping, stiffness = (sign * to.T @ part @ to for part in (form.mass, form.damping, form.stiffness))
    return mass, damping, stiffness


def _proportional(kind: str) -> bool:
    """Whether the dynamic stiffness is in proportion to the first value; own kinds may have other laws."""
    return kind in SEARCHED or kind == "sensor_mass"


def changes(columns: Array, h: Array, terms: Sequence[Term], w: Array, band: tuple[float, float]) -> tuple[Array, Array]:
    """What some structural terms of one kind and place change in FRFs h (lines, DOFs, references): patterns, and their factors.

    Sherman–Morrison–Woodbury, given all columns of the structure (lines, DOFs, DOFs); along one coordinate by a division. Patterns are
    (lines, DOFs, references, p), factors (lines, p, n).
    """
    return changes_by(columns, h, terms[0], added_by_each(terms, w, band))


def changes_by(columns: Array, h: Array, term: Term, z: Array) -> tuple[Array, Array]:
    """The same by the dynamic stiffness that each adds at the places of a term, (n_lines, places, places, n)."""
    b = list(term.places)
    if term.definition.coordinates == "difference":
        along, at = columns[:, :, b[0]], h[:, b[0]]
        if len(b) == 2:
            second = term.along[1]
            along, at = along + second * columns[:, :, b[1]], at + second * h[:, b[1]]
        own = along[:, b] @ term.along
        one = z[:, 0, 0]
        return -(along[:, :, None] * at[:, None])[..., None], (one / (1 + one * own[:, None]))[:, None]
    z = np.moveaxis(z, -1, 1)
    inner = np.linalg.solve(np.eye(len(b)) + z @ columns[:, None, b][..., b], z)
    patterns = -columns[:, :, None, b, None] * np.swapaxes(h[:, b], 1, 2)[:, None, :, None]
    return patterns.reshape(*h.shape, len(b) ** 2), np.swapaxes(inner.reshape(*inner.shape[:2], -1), 1, 2)


def candidates(nodes: Sequence[tuple[int, ...]], terms: Iterable[Term], kinds: Iterable[str], allowed: Iterable[int]) -> Iterator[Term]:
    """Kinds at places, without values, that are not there yet; an absorber may stand beside another."""
    where = sorted(allowed)
    have = {t.key for t in terms}
    for kind in kinds:
        definition = kind_of(kind)
        if definition.places == 0:
            places: Iterator[tuple[int, ...]] = iter([()])
        elif definition.coordinates == "node":
            places = (node for node in nodes if set(node) & set(where))
        elif definition.places == 2:
            places = combinations(where, 2)
        else:
            places = ((i,) for i in where)
        for place in places:
            if kind == "tuned_absorber" or (kind, place) not in have:
                yield Term(kind, place)

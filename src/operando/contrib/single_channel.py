"""One force and one response: a mass on a spring and a damper with a law, by regression on windowed blocks of the equation of motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft as sfft

from operando.contrib.signals import checked_signals
from operando.data.objects import Short
from operando.errors import DataError
from operando.indicators import INTERVAL
from operando.structure.effects import kind_of, with_spread
from operando.structure.force_law import raw_force
from operando.structure.modal_space import Complex, Real

KINDS = (
    "cubic_stiffness",
    "quadratic_stiffness",
    "quadratic_damping",
    "coulomb_friction",
    "clearance",
    "one_sided_contact",
    "saturating_spring",
)
IMPROVES = 0.10
"""A law lowers the squared error on blocks that were not fitted by more than this part."""

BLOCKS, FOLDS = 24, 4
PARTS = 6
"""Parts of the band that are left out in turn for the standard deviations. Of two records and three bands of a measured circuit, sizes lie
at most 0.9 standard deviations apart with 6 parts, 1.1 with 12, 1.6 with 24 and 2.2 with 48, which is too many: what the equation leaves is
alike over a sixth of the band (tests/test_nonlinear_single.py)."""
GRID = np.geomspace(0.03, 0.9, 16)


@dataclass(frozen=True, repr=False, eq=False)
class SingleFit(Short):
    """m·a + c·v + k·x + s(x, v) = f of one channel pair, in the units of its signals.

    Parameters
    ----------
    mass, damping, stiffness : float
    kinds : tuple of str
        Laws accepted, in order; empty where the linear equation is as good.
    values : tuple of dict
        Of each law.
    std : dict
        Standard deviation of mass, damping, stiffness and of the first value of each law (``kind.name``): the larger one of leaving out
        blocks (noise) and leaving out parts of the band (an equation that is not exact: what it leaves is alike in all blocks).
    error, linear_error : float
        Share of the force's power that is not explained, on blocks that were not fitted; and without any law.
    tried : dict
        Error with each law in the first step.
    """

    mass: float
    damping: float
    stiffness: float
    kinds: tuple[str, ...]
    values: tuple[dict[str, float], ...]
    std: dict[str, float]
    error: float
    linear_error: float
    tried: dict[str, float]

    @property
    def frequency_hz(self) -> float:
        """Of the linear part."""
        return float(np.sqrt(max(self.stiffness / self.mass, 0.0)) / (2 * np.pi))

    def facts(self) -> dict[str, str]:
        """What the short form says; sizes are in the units of the signals."""
        sizes = [(name, getattr(self, name), self.std[name]) for name in ("mass", "damping", "stiffness")]
        for kind, values in zip(self.kinds, self.values, strict=True):
            words = kind.replace("_", " ")
            sizes += [(f"{words} {name.replace('_', ' ')}", value, self.std.get(f"{kind}.{name}", 0.0)) for name, value in values.items()]
        return {
            "Laws": " and ".join(k.replace("_", " ") for k in self.kinds) or "linear",
            "Sizes": ", ".join(f"{name} {with_spread(value, INTERVAL * std)}" for name, value, std in sizes),
            "Units": "in the units of the signals, ± 95 %",
            "Frequency": f"linear part at {self.frequency_hz:.4g} Hz",
            "Error": f"{100 * self.error:.2g} % of the force's power left ({100 * self.linear_error:.2g} % linear)",
        }

    def error_on(self, force: ArrayLike, displacement: ArrayLike, sampling_hz: float, band: tuple[float, float]) -> float:
        """Share of the force's power in a band that the equation as it stands leaves unexplained in another record."""
        blocks = _Blocks.of(force, displacement, sampling_hz, band)
        columns = [
            blocks.cut(s) for s in (blocks.a, blocks.v, blocks.x, *(blocks.law(k, v) for k, v in zip(self.kinds, self.values, strict=True)))
        ]
        sizes = [self.mass, self.damping, self.stiffness, *(1.0 for _ in self.kinds)]
        rest = blocks.force - sum(size * c for size, c in zip(sizes, columns, strict=True))
        return float(np.sum(np.abs(rest) ** 2) / np.sum(np.abs(blocks.force) ** 2))


@dataclass(frozen=True)
class _Blocks:
    """Signals of a record, and what turns them into windowed spectra (blocks, lines)."""

    x: Real
    v: Real
    a: Real
    force: Complex
    size: int
    lines: np.ndarray
    step: float

    @classmethod
    def of(cls, force: ArrayLike, displacement: ArrayLike, rate: float, band: tuple[float, float]) -> _Blocks:
        force, x = checked_signals(rate, force=force, displacement=displacement)
        n = x.size
        if n < 64 * BLOCKS // 4:
            raise DataError(f"{n} samples are too few", hint=f"give {64 * BLOCKS // 4} at least")
        if not 0 <= band[0] < band[1] <= rate / 2:
            raise DataError(
                f"the band {band[0]:g} to {band[1]:g} Hz does not lie between 0 and half the sampling rate ({rate / 2:g} Hz)",
                hint="give (lowest, highest) in Hz; above half the rate there is nothing in the record",
            )
        if not (np.ptp(x) and np.ptp(force)):
            raise DataError(f"the {'force' if np.ptp(x) else 'displacement'} is constant", hint="give a record of a test in motion")
        hz = sfft.rfftfreq(n, 1 / rate)
        spectrum = sfft.rfft(x - x.mean())
        # Far above the band a derivative is noise; what the law needs lies below.
        spectrum = spectrum * (1 / (1 + (hz / (3 * band[1])) ** 12))
        v, a = sfft.irfft(2j * np.pi * hz * spectrum, n), sfft.irfft(-((2 * np.pi * hz) ** 2) * spectrum, n)
        size = 2 * n // (BLOCKS + 1)
        block_hz = sfft.rfftfreq(size, 1 / rate)
        lines = np.flatnonzero((block_hz >= band[0]) & (block_hz <= band[1]))
        if lines.size < 4:
            raise DataError(f"a block of the record has {lines.size} lines in the band", hint="a longer record or a wider band")
        empty = cls(x, v, a, np.zeros((0, 0), complex), size, lines, 1 / rate)
        return cls(empty.x, v, a, empty.cut(force), size, lines, 1 / rate)

    def cut(self, signal: Real) -> Complex:
        """Hann-windowed spectra of half-overlapping blocks; the equation of motion holds at each instant, so it holds for them."""
        window = np.sin(np.pi * (np.arange(self.size) + 0.5) / self.size) ** 2
        # The first and the last block hold the edges that differentiation spoils.
        starts = np.arange(1, BLOCKS - 1) * (self.size // 2)
        parts = np.stack([signal[s : s + self.size] * window for s in starts])
        return np.asarray(sfft.rfft(parts, axis=1)[:, self.lines])

    def law(self, kind: str, values: dict[str, float]) -> Real:
        return raw_force(kind_of(kind), self.x, self.v, values, self.step)


def fit_single(
    force: ArrayLike, displacement: ArrayLike, sampling_hz: float, band: tuple[float, float], kinds: Sequence[str] = KINDS, most: int = 2
) -> SingleFit:
    """Mass, damper, spring and what else acts in one channel pair.

    Direct regression on the equation of motion (Masri & Caughey 1979) in the frequency domain, so that a band can be chosen. Laws enter one
    after the other while each lowers the error on blocks that were not fitted.

    Parameters
    ----------
    force, displacement : (N,) arrays
        Any units; the values found have them.
    sampling_hz : float
        Samples a second.
    band : (float, float)
        Lines used [Hz].
    kinds : sequence of str
        Laws to look for.
    most : int
        Laws accepted at most.

    Returns
    -------
    SingleFit

    Raises
    ------
    DataError
        If a sample is not finite, the record is too short, the signals differ in length, or the band ends above half the sampling rate.

    Notes
    -----
    Standard deviations cover noise and an equation that is not quite that of the device. They do not cover what noise of the displacement
    does to its derivatives: at 1 % of the displacement's rms mass, stiffness and law are off by one to two standard deviations.
    Take the displacement about its position of rest: a law such as x³ about another point is another law.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.random.default_rng(0).standard_normal(4096)
    >>> hz = np.fft.rfftfreq(4096, 1 / 200)
    >>> spectrum = np.fft.rfft(x) * (hz < 40)
    >>> x, force = (np.fft.irfft(s, 4096) for s in (spectrum, spectrum * (2e3 + 4j * hz - 2 * (2 * np.pi * hz) ** 2)))
    >>> fit_single(force, x, 200.0, (1.0, 30.0), kinds=["cubic_stiffness"]).kinds
    ()
    """
    blocks = _Blocks.of(force, displacement, sampling_hz, band)
    base = [blocks.cut(s) for s in (blocks.a, blocks.v, blocks.x)]
    accepted: list[tuple[str, dict[str, float]]] = []
    columns = list(base)
    linear = error = _hold_out_error(columns, blocks.force)
    first: dict[str, float] = {}
    while len(accepted) < most:
        options = [
            (_hold_out_error([*columns, c], blocks.force), kind, shape, c)
            for kind in kinds
            if kind not in [k for k, _ in accepted]
            for shape, c in _shapes(blocks, kind)
            if _solve([*columns, c], blocks.force)[-1] > 0
        ]
        best_of = {k: min(o[0] for o in options if o[1] == k) for k in {o[1] for o in options}}
        first = first or best_of
        if not options:
            break
        least = min(options, key=lambda o: o[0])
        near = [o for o in options if o[0] <= 1.03 * least[0]]
        chosen = min(near, key=lambda o: (len(o[2]), o[0]))
        if not chosen[0] < (1 - IMPROVES) * error:
            break
        accepted.append((chosen[1], chosen[2]))
        columns.append(chosen[3])
        error = chosen[0]
    sizes = _solve(columns, blocks.force)
    count, lines = blocks.force.shape
    # Neighbouring blocks overlap by half: pairs are left out together.
    pairs = [_solve(columns, blocks.force, np.arange(count) // 2 != g) for g in range((count + 1) // 2)]
    # What the equation cannot say is alike in all blocks and changes over the band.
    part = np.arange(lines) * min(PARTS, lines) // lines
    parts = [_solve([c[:, part != g] for c in columns], blocks.force[:, part != g]) for g in range(part[-1] + 1)]
    spread = np.maximum(_spread_without(pairs), _spread_without(parts))
    names = ["mass", "damping", "stiffness", *(f"{k}.{kind_of(k).parameters[0].name}" for k, _ in accepted)]
    values = tuple({kind_of(k).parameters[0].name: float(s), **shape} for (k, shape), s in zip(accepted, sizes[3:], strict=True))
    return SingleFit(
        float(sizes[0]), float(sizes[1]), float(sizes[2]), tuple(k for k, _ in accepted), values,
        dict(zip(names, map(float, spread), strict=True)), error, linear, first,
    )  # fmt: skip


def _spread_without(sizes: list[Real]) -> Real:
    """Standard deviations from the sizes found with one group left out at a time (jackknife)."""
    return np.asarray(np.sqrt((len(sizes) - 1) * np.var(sizes, axis=0)))


def _shapes(blocks: _Blocks, kind: str) -> list[tuple[dict[str, float], Complex]]:
    """Columns of a law of unit size for each of its shape values."""
    definition = kind_of(kind)
    name = definition.parameters[0].name
    shapes = getattr(definition, "shape_names", ())
    reach = float(np.max(np.abs(blocks.x)))
    if kind == "coulomb_friction":
        options: list[dict[str, float]] = [{"slip_speed": float(blocks.v.std() * s)} for s in (0.01, 0.03, 0.1, 0.3)]
    else:
        options = [{shapes[0]: float(reach * g)} for g in GRID] if shapes else [{}]
    return [(o, blocks.cut(blocks.law(kind, {name: 1.0, **o}))) for o in options]


def _solve(columns: Sequence[Complex], force: Complex, use: np.ndarray | slice = slice(None)) -> Real:
    """Real sizes of the columns by least squares on some blocks."""
    table = np.stack([c[use].ravel() for c in columns], axis=1)
    table, right = np.concatenate([table.real, table.imag]), np.concatenate([force[use].real.ravel(), force[use].imag.ravel()])
    scale = np.maximum(np.linalg.norm(table, axis=0), 1e-300)
    return np.asarray(np.linalg.lstsq(table / scale, right, rcond=None)[0] / scale)


def _hold_out_error(columns: Sequence[Complex], force: Complex) -> float:
    """Share of the force's power that is left on blocks in turn not fitted; contiguous folds."""
    fold = np.arange(len(force)) * FOLDS // len(force)
    rest = 0.0
    for f in range(FOLDS):
        sizes = _solve(columns, force, fold != f)
        rest += float(np.sum(np.abs(force[fold == f] - sum(s * c[fold == f] for s, c in zip(sizes, columns, strict=True))) ** 2))
    return rest / float(np.sum(np.abs(force) ** 2))

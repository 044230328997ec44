"""Two modal models side by side: paired modes, what changed, and the MAC of all."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel, Short, counted, plots
from operando.errors import DataError, ObjectError
from operando.indicators import common_shapes, left_out
from operando.scaling import pair_modes

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes

THRESHOLD = 0.7
"""MAC from which a mode has kept its shape, as in scaling."""


@dataclass(frozen=True, repr=False, eq=False)
class ModelComparison(Short):
    """Modes of one model paired with those of another.

    Parameters
    ----------
    first, second : ModalModel
        The models, within the band asked for.
    modes : tuple of dict
        One a pair, by frequency: ``first``, ``second`` (mode numbers), ``frequency_hz`` and ``damping_ratio`` (of both),
        ``frequency_percent``, ``damping_percent`` (change from the first to the second), ``mac``, ``same_shape`` (bool); the last two are
        None where the models share one DOF alone, over which no shape can be compared.
    only_first, only_second : tuple of int
        Modes without a partner.
    mac : (n_first, n_second) array
        At the DOFs that both have.
    n_dofs : int
        How many these are.
    notes : tuple of str
        DOFs that only one of the models has.

    Examples
    --------
    >>> import numpy as np, operando
    >>> idle = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> operando.compare(idle, idle)
    <ModelComparison: 2 modes paired over 2 DOFs; 2 with MAC ≥ 0.7; frequencies differ by up to 0 %>
    """

    first: ModalModel
    second: ModalModel
    modes: tuple[dict[str, Any], ...]
    only_first: tuple[int, ...]
    only_second: tuple[int, ...]
    mac: NDArray[np.float64]
    n_dofs: int
    notes: tuple[str, ...] = ()

    def facts(self) -> dict[str, str]:
        """What the short form says."""
        shift = [abs(m["frequency_percent"]) for m in self.modes]
        lonely = len(self.only_first) + len(self.only_second)
        return {
            "Pairs": f"{counted(len(self.modes), 'mode')} paired over {counted(self.n_dofs, 'DOF')}",
            "Shapes": f"{sum(m['same_shape'] for m in self.modes)} with MAC ≥ {THRESHOLD:g}" if self.n_dofs > 1 else "shapes not compared",
            "Frequencies": f"frequencies differ by up to {max(shift):.3g} %" if shift else "",
            "Alone": f"{lonely} without a partner" if lonely else "",
            "Notes": "; ".join(self.notes),
        }

    def to_dict(self) -> dict[str, Any]:
        """JSON object: pairs, modes without a partner, MAC matrix (None over one DOF), notes."""
        return {
            "modes": [dict(m) for m in self.modes],
            "only_first": list(self.only_first),
            "only_second": list(self.only_second),
            "mac": self.mac.tolist() if self.n_dofs > 1 else None,
            "n_dofs": self.n_dofs,
            "notes": list(self.notes),
        }

    def to_dataframe(self) -> pandas.DataFrame:
        """One row a pair of modes, with the standard deviations of both models (NaN where a model states none).

        Raises
        ------
        MissingError
            If pandas is not installed.
        """
        sides = (("first", self.first), ("second", self.second))
        rows = []
        for m in self.modes:
            row = {k: v for k, v in m.items() if not isinstance(v, list)}
            for i, (side, model) in enumerate(sides):
                stds = (("frequency_hz", "frequency_std_hz"), ("damping_ratio", "damping_ratio_std"))
                for value, std in stds:
                    known = getattr(model, std)
                    row |= {f"{value}_{side}": m[value][i], f"{std}_{side}": np.nan if known is None else float(known[m[side]])}
            rows.append(row)
        table: pandas.DataFrame = importlib.import_module("operando.io.frames").library("pandas").DataFrame(rows)
        return table

    def plot(self, axes: Axes | None = None) -> Axes:
        """The cross-MAC of both models (:func:`operando.plots.plot_mac`).

        Parameters
        ----------
        axes : matplotlib Axes, optional

        Returns
        -------
        matplotlib Axes
        """
        made: Axes = plots().plot_mac(self.first, self.second, axes)
        return made


def compare_models(first: Any, second: Any, band_hz: tuple[float, float] | None = None) -> ModelComparison:
    """Pair the modes of two models by shape and frequency.

    Parameters
    ----------
    first, second : ModalModel, or a model with modes
        A hybrid model counts by its scaled modes, a model with effects by those of the running structure.
    band_hz : (float, float), optional
        Modes used; default all.

    Returns
    -------
    ModelComparison

    Raises
    ------
    ObjectError
        If one has no modes to pair.
    DataError
        If they have no DOF in common, or one has no mode in the band.

    Examples
    --------
    >>> import numpy as np, operando
    >>> idle = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> from operando.compare import compare_models
    >>> other = operando.ModalModel([21.0, 45.0], [0.01, 0.02], idle.shapes, "1+Z, 2+Z", "unit_modal_mass")
    >>> compare_models(idle, other)
    <ModelComparison: 2 modes paired over 2 DOFs; 2 with MAC ≥ 0.7; frequencies differ by up to 5 %>
    """
    a, b = (_in_band(modal_of(m), band_hz) for m in (first, second))
    shapes_a, shapes_b, dofs = common_shapes(a, b)
    pairing = pair_modes(shapes_a, a.frequencies_hz, shapes_b, b.frequencies_hz, THRESHOLD)
    comparable = len(dofs) > 1
    notes = [f"compared {left}" for left in [left_out(a, b, dofs)] if left]
    if not comparable:
        notes.append("modes are paired by frequency alone: over one DOF every MAC is 1")
    if a.si != b.si:
        notes.append(f"the units of the {'second' if a.si else 'first'} model are not known: its shapes have another scale")
    rows: list[dict[str, Any]] = []
    for p in pairing.pairs:
        if p.idle is None:
            continue
        f = float(a.frequencies_hz[p.idle]), float(b.frequencies_hz[p.operating])
        z = float(a.damping_ratios[p.idle]), float(b.damping_ratios[p.operating])
        rows.append(
            {
                "first": int(p.idle), "second": int(p.operating), "frequency_hz": list(f), "damping_ratio": list(z),
                "frequency_percent": 100 * (f[1] - f[0]) / f[0] if f[0] else None,
                "damping_percent": 100 * (z[1] - z[0]) / z[0] if z[0] else None,
                "mac": float(p.mac) if comparable else None, "same_shape": bool(p.mac >= THRESHOLD) if comparable else None,
            }
        )  # fmt: skip
    rows.sort(key=lambda r: r["first"])
    taken = {r["second"] for r in rows}
    matrix = pairing.mac if comparable else np.full(pairing.mac.shape, np.nan)
    alone = tuple(j for j in range(b.n_modes) if j not in taken)
    return ModelComparison(a, b, tuple(rows), tuple(pairing.idle_without_partner), alone, matrix, len(dofs), tuple(notes))


def modal_of(model: Any) -> ModalModel:
    """The modes of a model: itself, the scaled ones of a hybrid model, those of the running structure of a model with effects.

    Parameters
    ----------
    model : object
        ModalModel, HybridModel or Model.

    Returns
    -------
    ModalModel

    Raises
    ------
    ObjectError
        If it has none.

    Examples
    --------
    >>> import numpy as np, operando
    >>> idle = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> from operando.compare import modal_of
    >>> modal_of(idle) is idle
    True
    """
    if isinstance(model, ModalModel):
        return model
    inner = getattr(model, "modal", None)
    if isinstance(inner, ModalModel):
        return inner
    modes = getattr(model, "modes", None)
    made = modes() if callable(modes) else None
    if not isinstance(made, ModalModel):
        raise ObjectError(f"a {type(model).__name__} has no modes to pair", hint="give models, or FRFs as the second")
    return made


def _in_band(model: ModalModel, band_hz: tuple[float, float] | None) -> ModalModel:
    if band_hz is None:
        if not model.n_modes:
            raise DataError("a model without modes cannot be compared")
        return model
    f = model.frequencies_hz
    keep = (f >= band_hz[0]) & (f <= band_hz[1])
    if not keep.any():
        raise DataError(f"a model has no mode in {band_hz[0]:g} to {band_hz[1]:g} Hz")
    return model.select_modes(keep)

"""The stabilisation diagram as data: every pole of every order, what was selected, and why the rest was not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Frf, Short, check_fields, counted, plots
from operando.data.arrays import ByContent
from operando.errors import DataError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STATUS = ("unstable", "frequency", "frequency_damping", "stable", "invalid")
"""Stability class of a pole against the order below: none, frequency only, frequency and damping, also the vector; or not physical."""


@dataclass(frozen=True)
class Tolerances:
    """When two poles of neighbouring orders count as the same.

    Parameters
    ----------
    frequency : float
        Largest relative difference of frequency.
    damping : float
        Largest difference of damping ratio, relative to the larger of the two.
    mac : float
        Smallest MAC of the vectors.
    max_damping : float
        Poles with a larger damping ratio, and those with none or negative damping, are no vibration modes (status ``invalid``).
    """

    frequency: float = 0.01
    damping: float = 0.1
    mac: float = 0.95
    max_damping: float = 0.25

    def __post_init__(self) -> None:
        check_fields(self)
        if not (self.frequency > 0 and self.damping > 0 and 0 <= self.mac <= 1 and self.max_damping > 0):
            raise DataError(f"tolerances out of range: {self}", hint="frequency, damping, max_damping > 0 and 0 <= mac <= 1")


@dataclass(frozen=True, eq=False)
class PoleTable(ByContent):
    """All poles of all model orders, one row a pole.

    Parameters
    ----------
    order : (p,) int array
    frequency_hz, damping_ratio : (p,) arrays
    vectors : (m, p) complex array
        Shape or participation of each pole, the quantity whose MAC decides stability.
    status : (p,) int array
        Index into ``STATUS``.
    """

    order: NDArray[np.int_]
    frequency_hz: NDArray[np.float64]
    damping_ratio: NDArray[np.float64]
    vectors: NDArray[Any]
    status: NDArray[np.int_]

    def __post_init__(self) -> None:
        check_fields(self)
        p = self.order.size
        if not (self.frequency_hz.shape == self.damping_ratio.shape == self.status.shape == (p,) and self.vectors.shape[1] == p):
            raise DataError("columns of the pole table have different lengths")


@dataclass(frozen=True)
class RejectedPole:
    """A candidate that was not taken, with its reason.

    ``code`` is a short word (``too_damped``, ``unstable``, ``harmonic``, ``small_cluster``, ``complex_shape``, ``by_hand``,
    ``negative_modal_mass``, ``outside_band``, …), ``reason`` one sentence with the numbers.
    """

    frequency_hz: float
    damping_ratio: float
    code: str
    reason: str


@dataclass(frozen=True, repr=False, eq=False)
class Stabilization(Short):
    """Stabilisation diagram with selection.

    Parameters
    ----------
    table : PoleTable
    selected_hz, selected_damping : (n,) arrays
        The modes taken (before any later refinement).
    selected_vectors : (m, n) array
    selected_members : tuple of int arrays
        Rows of the table that belong to each mode.
    rejected : tuple of RejectedPole
    indicator_hz, indicator : arrays
        What is drawn behind the diagram (CMIF for EMA, first singular values for OMA): (k,), (n_curves, k), positive.
    tolerances : Tolerances or None
        What counted as stable; None in files of older versions.

    Examples
    --------
    >>> import numpy as np
    >>> from operando.stabilization import classify, select_modes
    >>> shape = np.array([[1.0], [0.5]])
    >>> table = classify([2, 4, 6, 8, 10], [[20.0], [20.01], [20.0], [20.0], [20.0]], [[0.01]] * 5, [shape] * 5)
    >>> select_modes(table, band=(5, 50)).selected_damping.round(3).tolist()
    [0.01]
    """

    table: PoleTable
    selected_hz: NDArray[np.float64]
    selected_damping: NDArray[np.float64]
    selected_vectors: NDArray[Any]
    selected_members: tuple[NDArray[np.int_], ...]
    rejected: tuple[RejectedPole, ...] = ()
    indicator_hz: NDArray[np.float64] | None = None
    indicator: NDArray[np.float64] | None = None
    tolerances: Tolerances | None = None

    def facts(self) -> dict[str, str]:
        """What the short form says."""
        orders = np.unique(self.table.order)
        span = f"{counted(orders.size, 'order')} up to {orders[-1]}" if orders.size else "no order"
        return {
            "Poles": f"{counted(self.table.order.size, 'pole')} of {span}",
            "Modes": f"{counted(self.selected_hz.size, 'mode')} taken",
            "Rejected": f"{counted(len(self.rejected), 'candidate')} rejected",
        }

    def plot(
        self,
        axes: Axes | None = None,
        *,
        frf: Frf | None = None,
        band: Sequence[float] | None = None,
        modes_hz: Sequence[float] | None = None,
        harmonics_hz: Sequence[float] = (),
    ) -> Axes:
        """Poles by model order with the usual symbols over mode indicators (:func:`operando.plots.plot_stabilization`).

        Parameters
        ----------
        axes : matplotlib Axes, optional
        frf : Frf, optional
            FRFs whose CMIF and MMIF are drawn behind.
        band : (float, float), optional
            Analysis band [Hz].
        modes_hz : sequence of float, optional
            Final frequencies of the modes [Hz]; default: those selected.
        harmonics_hz : sequence of float
            Harmonics of rotation [Hz].

        Returns
        -------
        matplotlib Axes
        """
        made: Axes = plots().plot_stabilization(self, axes, frf=frf, band=band, modes_hz=modes_hz, harmonics_hz=harmonics_hz)
        return made

"""What a modal model draws; the figures themselves are in ``operando.plots``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from operando.data.frf import Frf
from operando.data.geometry import Geometry
from operando.data.objects import plots

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation
    from matplotlib.axes import Axes

    from operando.data.modal import ModalModel


class ModalFigures:
    """Adds the figures of a modal model to it."""

    def plot_shape(
        self, mode: int = 0, geometry: Geometry | None = None, axes: Axes | None = None, *, scale: float = 1.0, names: bool | None = None
    ) -> Axes:
        """One mode shape on the structure, or as bars by DOF without a geometry (:func:`operando.plots.plot_shape`).

        Parameters
        ----------
        mode : int
            Number of the mode, from 0.
        geometry : Geometry, optional
        axes : matplotlib Axes, optional
            With ``projection="3d"`` for a geometry.
        scale : float
            Larger or smaller than usual.
        names : bool, optional
            Write node names; default: where 100 nodes at most are measured.

        Returns
        -------
        matplotlib Axes
        """
        made: Axes = plots().plot_shape(self, mode, geometry, axes, scale=scale, names=names)
        return made

    def animate(
        self, mode: int = 0, geometry: Geometry | None = None, axes: Axes | None = None, *, scale: float = 1.0, frames: int = 24
    ) -> FuncAnimation:
        """One mode shape in motion (:func:`operando.plots.animate_shape`).

        Parameters
        ----------
        mode : int
            Number of the mode, from 0.
        geometry : Geometry
        axes : matplotlib Axes, optional
            With ``projection="3d"``.
        scale : float
            Larger or smaller than usual.
        frames : int
            Pictures a period.

        Returns
        -------
        matplotlib FuncAnimation
            ``.save("mode.gif")`` writes it, ``.to_jshtml()`` shows it in a notebook.
        """
        made: FuncAnimation = plots().animate_shape(self, mode, geometry, axes, scale=scale, frames=frames)
        return made

    def plot_mac(self, other: ModalModel | None = None, axes: Axes | None = None) -> Axes:
        """AutoMAC, or cross-MAC with another model (:func:`operando.plots.plot_mac`).

        Parameters
        ----------
        other : ModalModel, optional
        axes : matplotlib Axes, optional

        Returns
        -------
        matplotlib Axes
        """
        made: Axes = plots().plot_mac(self, other, axes)
        return made

    def plot_participation(self, axes: Axes | None = None, *, dofs: object = None) -> Axes:
        """How strongly each DOF takes part in each mode (:func:`operando.plots.plot_participation`).

        Parameters
        ----------
        axes : matplotlib Axes, optional
        dofs : DOF labels, optional
            Default: all.

        Returns
        -------
        matplotlib Axes
        """
        made: Axes = plots().plot_participation(self, axes, dofs=dofs)
        return made

    def plot_complexity(self, axes: Axes | None = None) -> Axes:
        """Modal phase collinearity and mean phase deviation of each mode (:func:`operando.plots.plot_complexity`).

        Parameters
        ----------
        axes : matplotlib Axes, optional

        Returns
        -------
        matplotlib Axes
        """
        made: Axes = plots().plot_complexity(self, axes)
        return made

    def plot_stabilization(self, axes: Axes | None = None, *, frf: Frf | None = None) -> Axes:
        """The stabilisation diagram that the identification kept, with the modes of the model (:func:`operando.plots.plot_stabilization`).

        Parameters
        ----------
        axes : matplotlib Axes, optional
        frf : Frf, optional
            FRFs whose CMIF and MMIF are drawn behind.

        Returns
        -------
        matplotlib Axes

        Raises
        ------
        DataError
            If no diagram was kept.
        """
        made: Axes = plots().plot_stabilization_of(self, axes, frf=frf)
        return made

    def plot_synthesis(self, frf: Frf, axes: Axes | None = None, *, band: tuple[float, float] | None = None) -> Axes:
        """How well each measured FRF is what the model makes (:func:`operando.plots.plot_synthesis_correlation`).

        Parameters
        ----------
        frf : Frf
            Measured.
        axes : matplotlib Axes, optional
        band : (float, float), optional
            Lines that count [Hz].

        Returns
        -------
        matplotlib Axes
        """
        made: Axes = plots().plot_synthesis_correlation(frf, self, axes, band=band)
        return made

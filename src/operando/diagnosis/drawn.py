"""The figures of a diagnosis, as methods of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from operando.data import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from operando.data import Geometry


class Drawn:
    """Draws itself by ``operando.plots``."""

    def plot_ladder(self, axes: Axes | None = None) -> Axes:
        """Error by step on the hold-out set: see :func:`operando.plots.plot_steps`.

        Parameters
        ----------
        axes : matplotlib Axes, optional
            Default: of a new figure.

        Returns
        -------
        matplotlib Axes
        """
        made: Axes = plots().plot_steps(self, axes)
        return made

    def plot_where(self, axes: Axes | None = None, *, by: str = "dof") -> Axes:
        """Where the idle model fails in operation: see :func:`operando.plots.plot_where`.

        Parameters
        ----------
        axes : matplotlib Axes, optional
            Default: of a new figure.
        by : {"dof", "band", "mode"}

        Returns
        -------
        matplotlib Axes
        """
        made: Axes = plots().plot_where(self, axes, by=by)
        return made

    def plot_dynamic_stiffness(self, axes: Axes | None = None, *, number: int = 0) -> Axes:
        """Dynamic stiffness at a location found: see :func:`operando.plots.plot_dynamic_stiffness`.

        Parameters
        ----------
        axes : matplotlib Axes, optional
            Default: of a new figure.
        number : int
            Which location, 0 for the first.

        Returns
        -------
        matplotlib Axes
        """
        made: Axes = plots().plot_dynamic_stiffness(self, axes, number=number)
        return made

    def plot_location(self, geometry: Geometry, axes: Axes | None = None, *, names: bool | None = None) -> Axes:
        """The structure with the effects found marked on it: see :func:`operando.plots.plot_location`.

        Parameters
        ----------
        geometry : Geometry
            Positions of the nodes.
        axes : matplotlib Axes, optional
            Three-dimensional. Default: of a new figure.
        names : bool, optional
            Write node names; default: with 100 nodes at most.

        Returns
        -------
        matplotlib Axes
        """
        made: Axes = plots().plot_location(self, geometry, axes, names=names)
        return made

"""The idle model with effects under a measured force, in time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import fft as sfft

from operando.data import Channel, ModalModel, TimeRecord
from operando.dof import match_dofs, parse_dofs
from operando.errors import DataError
from operando.structure.added_mass import with_masses
from operando.structure.closed_loop import Loop, LoopRecord, follow, max_slope, substeps
from operando.structure.effects import Effect
from operando.structure.force_law import law_of
from operando.structure.modal_space import Modes


def simulate(idle: ModalModel, effects: Sequence[Effect], force: TimeRecord, responses: Any = None) -> TimeRecord:
    """Accelerations of the model with effects under a force record, from rest.

    Parameters
    ----------
    idle : ModalModel
        Of unit modal mass.
    effects : sequence of Effect
        Level-dependent ones, springs, dampers and point masses.
    force : TimeRecord
        With force channels at DOFs of the idle model; other channels are not used.
    responses : DOFs, optional
        Default all DOFs of the idle model.

    Returns
    -------
    TimeRecord
        Accelerations [m/s²], sampled like the force.

    Raises
    ------
    DataError
        If the idle model has no scale, no force channel is at one of its DOFs, or a mass cannot be taken away.
    ConfigError
        If an effect has no restoring force of displacement and velocity.
    """
    if idle.scaling != "unit_modal_mass":
        raise DataError("the idle model has no scale, so a force makes no response of known size")
    driven = {i: d for i in force.force_indices if (d := force.channels[i].dof) is not None}
    if not driven:
        raise DataError("no force channel with a DOF", where=force.name or None)
    wanted = idle.dofs if responses is None else tuple(parse_dofs(responses))
    idle, effects = with_masses(idle, effects)
    modes = Modes.of(idle).free()
    at, signs = match_dofs(tuple(driven.values()), idle.dofs)
    rows, senses = match_dofs(wanted, idle.dofs)
    n, rate = force.n_samples, force.sampling_hz
    pairs = [law_of(effect, idle) for effect in effects]
    laws, shapes = [law for law, _ in pairs], np.array([modes.phi.T @ b for _, b in pairs]).reshape(-1, modes.hz.size)
    forces = modes.phi[np.asarray(at)].T @ sfft.rfft(
        np.asarray(force.data[list(driven)], float) * np.asarray(signs, float)[:, None], axis=1
    )
    top = min(float(modes.hz[modes.hz < 0.5 * rate].max(initial=0.1 * rate)), 0.5 * rate)
    linear = modes.from_rest(forces, n, 1 / rate)[0]
    steep = [max_slope(law, shape, float(np.max(np.abs(shape @ linear)))) for law, shape in zip(laws, shapes, strict=True)]
    fine = substeps(top, rate, max(steep, default=0.0), laws)
    total, step = n * fine, 1 / (rate * fine)
    drive = np.zeros((modes.hz.size, total // 2 + 1), complex)
    drive[:, : forces.shape[1]] = forces * fine
    if laws:
        x, v = (shapes @ part for part in modes.from_rest(drive, total, step)[:2])
        rest = np.zeros((modes.hz.size, n))
        moving = LoopRecord(n, rate, Loop(modes.poles, shapes, step), fine, x, v, rest, rest, np.zeros((len(laws), n)))
        drive = drive - shapes.T @ sfft.rfft(follow([moving], [laws], np.inf)[0][0], total, axis=-1)
    a = modes.from_rest(drive, total, step)[2][:, ::fine]
    data = np.asarray(senses, float)[:, None] * (modes.phi[np.asarray(rows)] @ a)
    channels = tuple(Channel(d, "acceleration", "m/s2") for d in wanted)
    return TimeRecord(data, rate, channels, name=f"{force.name}, simulated" if force.name else "simulated")

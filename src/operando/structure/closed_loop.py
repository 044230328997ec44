"""The closed loop: modes driven by measured forces and by restoring forces that depend on where they move.

The modes are integrated exactly for forces that run straight between steps (first-order hold); the restoring force at the end of a step is
solved for, not extrapolated, so stiff contacts and dry friction stay stable. Several cases (records, values) run side by side.

Stops make a lightly damped structure forget its state: two histories that differ by 1e-4 of the force part within seconds. A whole record
cannot be followed then, however right the model. So the loop is closed over windows, each from the state that is known at its beginning.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from operando.errors import DataError
from operando.structure.force_law import ForceLaw
from operando.structure.modal_space import Complex, Real
from operando.structure.step_laws import StepLaw, step_law

BLOCK = 16
"""Steps between two updates of the modal state: inside, the response is a short convolution."""

PER_CYCLE, STICK_PER_CYCLE = 8.0, 48.0
"""Steps in a period of the highest frequency compared, at least; with dry friction."""

SHARE, FINEST = 0.8, 100
"""Part of a radian that a body moves on the steepest part of a law in a step, at most; steps a sample, at most."""


def substeps(top_hz: float, sampling_hz: float, max_slope: float, laws: Sequence[ForceLaw]) -> int:
    """Steps a sample for lines up to ``top_hz`` and laws of a ``max_slope`` [rad/s]: the frequency a body would have on them alone.

    With dry friction the step that takes hold is solved for, so its kinks alone ask for shorter ones.
    """
    per_cycle = STICK_PER_CYCLE if any(law.kind == "coulomb_friction" for law in laws) else PER_CYCLE
    fine = max(1, int(np.ceil(per_cycle * top_hz / sampling_hz)), int(np.ceil(max_slope / (SHARE * sampling_hz))))
    if fine > FINEST:
        raise DataError(
            f"so stiff a force law takes {fine} steps a sample to be simulated", hint="give the force at a higher sampling rate"
        )
    return fine


def max_slope(law: ForceLaw, shape: Real, reach: float) -> float:
    """√(k·Σφ²) [rad/s] of a law's greatest slope k within a reach [m] at a place with shape values φ."""
    x = np.linspace(-reach, reach, 201)
    if law.definition.acts != "pseudo_force":
        slope = abs(law.values.get("stiffness", 0.0))
    elif law.remembers:
        slope = law.values["stiffness"]
    else:
        slope = float(np.max(np.abs(np.diff(law.force(x, np.zeros_like(x), 1.0)) / (x[1] - x[0])), initial=0.0))
    return float(np.sqrt(slope * np.sum(shape**2)))


@dataclass(frozen=True)
class Loop:
    """Response across p places to forces along them, as n modes."""

    poles: Complex  # λ [rad/s], one of each conjugate pair
    shapes: Real  # shape values at the places (p, n): x_p = Σ shapes[p]·q
    step: float  # [s]

    def kernels(self) -> tuple[Complex, Complex, Complex]:
        """exp(λh) and the weights of a force at the beginning and the end of a step, straight in between."""
        lh = self.poles * self.step
        e = np.exp(lh)
        small = np.abs(lh) < 1e-4
        safe = np.where(small, 1.0, lh)
        end = np.where(small, 0.5 + lh / 6 + lh**2 / 24, (e - 1 - lh) / safe**2) * self.step
        whole = np.where(small, 1 + lh / 2 + lh**2 / 6, (e - 1) / safe) * self.step
        return np.asarray(e), np.asarray(whole - end), np.asarray(end)

    def receptance(self, hz: Real) -> Complex:
        """Receptance across its one place, (L,)."""
        w = 2 * np.pi * hz
        poles = self.poles[:, None]
        return np.asarray(self.shapes[0] ** 2 @ (1 / (np.abs(poles) ** 2 - w**2 - 2j * poles.real * w)))


def run_loop(loop: Loop, x_free: Real, v_free: Real, laws: Sequence[StepLaw]) -> Real:
    """Restoring forces (p, cases, N) of one law a place, from the motions (p, cases, N) across the places under measured forces alone."""
    places, cases, n = x_free.shape
    e, c0, c1 = loop.kernels()
    drive = loop.shapes
    # x = Im(z)/ω_d, v = Im(λz)/ω_d for z' = λz + u.
    out_x = loop.shapes / loop.poles.imag
    out_v = out_x * loop.poles
    powers = e[None, :] ** np.arange(1, BLOCK + 1)[:, None]
    # Free motion from the state over a block, and the response to unit samples of force within it.
    state_x, state_v = (np.stack([np.concatenate([(out * p).imag, (out * p).real], axis=1) for p in powers]) for out in (out_x, out_v))
    response = lambda out, weight: np.einsum("pn,qn,jn->jpq", out, drive, powers / e * weight).imag  # noqa: E731
    first, last = ([response(out, weight) for out in (out_x, out_v)] for weight in (c0, c1))
    near_x, near_v = last[0][0], last[1][0]
    # Within a block: force samples s_0 (block start) … s_j; weights of each at step j, for displacement and velocity.
    weights = np.zeros((2, BLOCK + 1, BLOCK + 1, places, places))
    for j in range(1, BLOCK + 1):
        for i in range(1, j + 1):  # force between i−1 and i seen at j
            for quantity in (0, 1):
                weights[quantity, j, i - 1] += first[quantity][j - i]
                weights[quantity, j, i] += last[quantity][j - i]
    alone = weights[..., 0, 0]
    z = np.zeros((loop.poles.size, cases), complex)
    s_all = np.zeros((places, cases, n))
    s_all[:, :, 0] = [law.begin(x_free[p, :, 0], v_free[p, :, 0]) for p, law in enumerate(laws)]
    s = s_all[:, :, 0]

    @lru_cache(maxsize=2)
    def push(count: int) -> Real:
        """What forces within a block add to the state at its end, real parts above imaginary ones, (2n, (count + 1)·p)."""
        back = powers[count - 1 :: -1] / e
        pushed = np.zeros((count + 1, e.size), complex)
        pushed[:-1] += back * c0
        pushed[1:] += back * c1
        both = (pushed[:, None, :] * drive[None]).reshape(-1, e.size).T
        return np.concatenate([both.real, both.imag])

    done = 0
    while done < n - 1:
        count = min(BLOCK, n - 1 - done)
        stacked = np.concatenate([z.real, z.imag])
        xs = x_free[:, :, done + 1 : done + 1 + count].transpose(2, 0, 1) + state_x[:count] @ stacked
        vs = v_free[:, :, done + 1 : done + 1 + count].transpose(2, 0, 1) + state_v[:count] @ stacked
        inside = np.zeros((count + 1, places, cases))
        inside[0] = s
        for j in range(1, count + 1):
            if places == 1:
                x_past, v_past = alone[:, j, :j] @ inside[:j, 0]
                inside[j, 0] = laws[0].solve(xs[j - 1, 0] - x_past, vs[j - 1, 0] - v_past, near_x[0, 0], near_v[0, 0])
                continue
            x = xs[j - 1] - np.einsum("ipq,iqc->pc", weights[0, j, :j], inside[:j])
            v = vs[j - 1] - np.einsum("ipq,iqc->pc", weights[1, j, :j], inside[:j])
            inside[j] = inside[j - 1]
            for turn in range(3):
                for p, law in enumerate(laws):
                    others = inside[j].copy()
                    others[p] = 0
                    at_x, at_v = x[p] - near_x[p] @ others, v[p] - near_v[p] @ others
                    inside[j, p] = law.solve(at_x, at_v, near_x[p, p], near_v[p, p], commit=turn == 2)
        pushed = push(count) @ inside.reshape(-1, cases)
        z = z * (e**count)[:, None] - (pushed[: e.size] + 1j * pushed[e.size :])
        s = inside[count]
        s_all[:, :, done + 1 : done + 1 + count] = inside[1:].transpose(1, 2, 0)
        done += count
    return s_all


@dataclass(frozen=True)
class LoopRecord:
    """What a record of N samples needs to be followed from any of them."""

    n_samples: int
    sampling_hz: float
    loop: Loop
    fine: int  # steps a sample
    x: Real  # motion across the places under the measured force alone, periodic over the record (p, N·fine)
    v: Real
    q: Real  # modal displacements and velocities that the restoring forces and the state at the beginning add (n, N)
    dq: Real
    memory: Real  # internal state of laws that remember (p, N)

    def windows(self, seconds: float) -> tuple[Real, Real, Real]:
        """Motion across the places without restoring forces in each window, (p, windows, W) twice, and the laws' memories (p, windows)."""
        size = min(max(8, round(seconds * self.sampling_hz)), self.n_samples)
        starts = np.arange(0, self.n_samples, size)
        index = np.minimum(starts[:, None] * self.fine + np.arange(size * self.fine + 1), self.x.shape[1] - 1)
        poles = self.loop.poles
        q, dq = self.q[:, starts], self.dq[:, starts]
        c = q / 2 + 1j * (poles.real[:, None] * q - dq) / (2 * poles.imag[:, None])
        ring = np.exp(poles[:, None] * self.loop.step * np.arange(size * self.fine + 1))
        decays = 2 * np.real(np.einsum("pn,nw,nk->pwk", self.loop.shapes, c, ring, optimize=True))
        moving = 2 * np.real(np.einsum("pn,nw,nk->pwk", self.loop.shapes, c * poles[:, None], ring, optimize=True))
        return self.x[:, index] + decays, self.v[:, index] + moving, self.memory[:, starts]


def follow(tracks: Sequence[LoopRecord], variants: Sequence[Sequence[ForceLaw]], seconds: float) -> list[list[Real]]:
    """Restoring forces (p, N·fine) that the closed loop makes over windows, put together; one a variant (a law a place) and track.

    All records have one sampling rate; infinite ``seconds`` of a window follow each record as a whole.
    """
    seconds = min(seconds, max(t.n_samples / t.sampling_hz for t in tracks))
    parts = [t.windows(seconds) for t in tracks]
    longest = max(p[0].shape[2] for p in parts)
    x, v = (
        np.concatenate([np.pad(p[i], ((0, 0), (0, 0), (0, longest - p[i].shape[2])), mode="edge") for p in parts], axis=1) for i in (0, 1)
    )
    memory = np.concatenate([p[2] for p in parts], axis=1)
    count, many = x.shape[1], len(variants)
    loop = tracks[0].loop
    made = [step_law([laws[p] for laws in variants for _ in range(count)], loop.step, np.tile(memory[p], many)) for p in range(len(x))]
    s = run_loop(loop, np.tile(x, (1, many, 1)), np.tile(v, (1, many, 1)), made)
    out: list[list[Real]] = []
    for k in range(many):
        rows, at = [], k * count
        for t, part in zip(tracks, parts, strict=True):
            w, size = part[0].shape[1], part[0].shape[2] - 1
            rows.append(s[:, at : at + w, :size].reshape(len(x), -1)[:, : t.n_samples * t.fine])
            at += w
        out.append(rows)
    return out

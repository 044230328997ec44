"""Idle model and validation FRFs as a search and a refit by hand take them: in one sense, with the error that a poor idle model has."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from operando.data import Frf, ModalModel
from operando.diagnosis.arguments import band_asked
from operando.diagnosis.idle import Idle
from operando.diagnosis.poor_idle import with_what_is_left
from operando.diagnosis.posterior import AtRest, at_rest
from operando.diagnosis.verdict import misses_idle_frfs
from operando.frf import in_one_sense, opposed_dofs, with_fewer_references


@dataclass(frozen=True)
class Measured:
    """Idle model and validation FRFs.

    ``frf`` are the validation FRFs in the sense of the idle model, ``model`` the idle model as the idle FRFs leave it, ``rest`` what they
    say of it. Where it is ``poor``, the variance of the FRFs is at least what it leaves of the idle FRFs.
    """

    frf: Frf
    band: tuple[float, float]
    model: Idle
    rest: AtRest | None
    poor: bool

    @classmethod
    def of(cls, idle: ModalModel, frf: Frf, idle_frf: Frf | None, band: tuple[float, float] | None, say: Callable[[str], None]) -> Measured:
        """From the idle modes, the validation FRFs, and the idle FRFs where there are any."""
        if idle_frf is not None and (opposed := opposed_dofs(idle_frf)):  # the idle model has them in one sense
            frf = in_one_sense(frf, [d for d in opposed_dofs(frf, opposed) if any(d.same_axis(o) for o in opposed)])
            idle_frf = in_one_sense(idle_frf, opposed)
        idle_frf = None if idle_frf is None else with_fewer_references(idle_frf)
        band = band_asked(band, frf) or idle.band_hz or (float(frf.frequencies_hz[0]), float(frf.frequencies_hz[-1]))
        known = Idle.of(idle, band, frf.references if idle_frf is None else idle_frf.references)
        if idle_frf is None:
            return cls(frf, band, known, None, False)
        say("idle model on the idle FRFs")
        rest = at_rest(known, idle_frf, band)
        if not misses_idle_frfs(rest.state):
            return cls(frf, band, rest.idle, rest, False)
        say(f"it differs by {100 * rest.state.alpha:.0f} %: what it leaves counts as error of the measurements")
        model = at_rest(known, with_what_is_left(idle_frf, rest.state), band).idle
        return cls(with_what_is_left(frf, rest.state), band, model, rest, True)

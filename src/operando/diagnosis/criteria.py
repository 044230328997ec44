"""Every threshold of the diagnosis, with its unit and its ground."""

from __future__ import annotations

FIT_LINES, VALIDATION_LINES, REST_LINES = 100, 50, 160
"""Lines to fit, to validate, and at rest: with twice as many no case of ``benchmarks/hidden_effects`` looked at changed its answer."""

BLOCKS = 18
"""Blocks of lines, each third of which validates: about one a mode of the cases in ``benchmarks/hidden_effects``."""

CORRELATED_LINES = 1.0
"""Neighbouring lines over which noise is alike where FRFs bring no variance: of plain averages 1, of a local model of order 2 over 17 lines
6 to 9 (``benchmarks/hidden_effects``); white noise taken for alike over 6 lines counts as a misfit of 0.5 %, the other way round the lines
chosen stand apart."""

POOLED_LINES = 4
"""Lines to each side over which the variance is averaged: one line of five hits has 8 degrees of freedom, and weighs by chance from 0.5
to 3 times what it should (the mean of 1/s² is 4/3); nine lines have 72."""

LEAST_MOVE = 0.02
"""Directions of the idle model that move all FRFs together by less than 0.14 standard deviations (its root) are left out."""

LEAST_DISCREPANCY, MOST_DISCREPANCY = 5e-4, 1.0
"""Range of the discrepancy, as a share of an FRF: half a per mille is what a good converter and cable leave."""

EXPLAINED = 0.03
"""Discrepancy above which nothing is explained (contract, "Verdicts")."""

MOST_CHI_SQUARE = 1.5
"""Reduced chi-square of validation lines above which something is left (contract, "Verdicts")."""

REST_DISCREPANCY = 0.01
"""Discrepancy at rest from which the idle model is fitted again with complex modes: three cases with real modes left 0.05 %, three with
complex ones 10 to 18 % (``benchmarks/hidden_effects``, plan ``complex``)."""

EARNED = 5.0
"""Nats that a further effect must earn: odds of 150 to 1, for the 200 or so kinds and places whose prior a count alone does not hold."""

CONTAINING = 3.0
"""Nats more for a kind that turns into a simpler one for some of its values (an absorber into a mass, rubber into a spring): odds of 20
to 1, so that the simpler one is told where both do."""

ROBUST = 0.05
"""Misfit, as a share of an FRF, that one line may have before the robust scan gives it less weight."""

AS_AT_REST = 2.0
"""Discrepancy of the check over that at rest up to which a place between sensors explains it as the idle model does the idle FRFs."""

ABOVE_ERROR = 10.0
"""Of |H|² over the variance of its error, from which a line tells an error in dB: the error alone makes 2 dB there (20 lg e × √0.05)."""

LOOSE = 0.02
"""Discrepancy above which the scan is robust and about the idle model as it is: under a loose one a linear scan absorbs all."""

STRAINED = 4.0
"""Mean square of one part of what differs between the days, in its spreads, from which it stands for something else (2 σ for all)."""

PROMOTED = 3.0
"""Standard deviations of what differs between the days from which the effect of its name is tried."""

UNUSUAL = 4.0
"""Standard deviations from which a difference between the days is told as unusual (contract)."""

SET = 0.95
"""Probability that the sets of effects told together have (contract)."""

LOWERED = 0.8
"""Share of the misfit that effects take away, for "partial" (contract)."""

SUPPORTED = 0.5
"""Standard deviation of a logarithmic size at which its 95 % interval reaches from a third to three times the size."""

ONE_SIDED = 1.64
"""Standard deviations: 95 % of effects of the size told in ``detectable`` are seen."""

LEAST_CHANGE = 0.003
"""Rms change of the logarithms of all FRFs by a further effect (0.03 dB) below which it is none: decays cut off and converters leave as
much at a peak. The weaker of two hidden effects in ``benchmarks/hidden_effects`` change 0.1 dB and more, three that were none 0.006 to
0.012 dB, with 11 to 27 nats at the peaks of light modes."""

CHANGES_DB = (0.1, 10.0)
"""Change of the FRFs [dB, rms] by effects whose size is within two standard deviations of their prior (``engine.md``)."""

REMOVED = 0.15
"""Prior probability that an effect is the opposite of its kind: something taken away."""

NEIGHBOURS = 1.7
"""Two sensors are neighbours where they are no farther apart than so many times the way to the nearest of the same axis."""

BETWEEN_STD, LEAST_BETWEEN_STD = 0.3, 0.5
"""Standard deviation of a shape value between two sensors in the highest mode, over the root mean square of theirs, and over that of the
whole shape: errors of suggestions are 0.2 to 0.5 of it in frames, none beyond four times (half of the second leaves one in 100 there, of
members that bend between their ends), and less in rotors (``benchmarks/hidden_effects/between.py``)."""

COMMON_BETWEEN = (0.08, 0.02)
"""Standard deviation of the factor that all shapes between two sensors have in common over what these suggest, by a straight line and by a
spline: 0.07 and 0.011 in frames, 0.015 and 0.003 in rotors (``benchmarks/hidden_effects/between.py``). No FRF tells it from the size."""

SCALE_BETWEEN, SCALE_BETWEEN_STD = -2.0, 1.5
"""Logarithm of the error of all shapes at a place between sensors in these standard deviations, and its spread: −1.4 ± 0.8 (straight line)
and −1.3 ± 0.8 (spline) at places of frames, −3.6 ± 1.3 and −4.0 ± 1.6 of rotors (``benchmarks/hidden_effects/between.py``).
"""

ALIKE_CURVES = 0.5
"""Squared correlation of the resonance curves of two modes from which one may be the other that differs: that of two equally damped modes
apart by their half-power width (``apart``). A mode that the dashpot of plan ``complex`` damps by 6 to 8 % has others on its hump, 0.07 and
0.2 (``benchmarks/hidden_effects``)."""

WITHOUT_SENSOR = 9.0
"""By how much the squared errors of operational frequencies over their variances fall without a mass that a sensor alone brought: three
standard deviations."""

ONE_SYSTEM = 2.0
"""Mean squared difference of runs of different level over the variance of their noise from which they are not one linear system."""

LEVEL_CHANGE = 0.1
"""Share of itself by which the size of an effect differs between the lowest and the highest level where it is no constant. Levels are a
factor of 1.4 apart or more: what grows with the square of the motion has doubled there, what falls with the motion has lost 29 %."""

NEAR_HZ = 0.05
"""Distance of two modes, as a logarithm of frequency, that counts as much as a MAC of 0.75 when they are paired."""

MODES_FLOOR = (2e-5, 5e-3, 5e-4)
"""Least standard deviation of ln f, ln ζ and of a shape value over the largest of its mode: what any identification leaves."""

SECOND_ORDER = 0.6
"""Standard deviation added to every value of a shape of unit norm, in parts of the sum of its variances: a covariance is of first order."""

ASSUMED_MODES = (5e-4, 0.08, 0.01)
"""Relative standard deviations of frequency, damping and shape of operational modes that bring none."""

PARTNER_LOG_HZ, PARTNER_MAC = 0.03, 0.6
"""A mode of half the record stands for one of the whole if it lies no farther from it, with a MAC above this."""


def tolerated(discrepancy: float) -> float:
    """The discrepancy in the variance of a model: hardly any beyond what an explanation may leave, or no model would be wrong."""
    return discrepancy if discrepancy <= EXPLAINED else LEAST_DISCREPANCY

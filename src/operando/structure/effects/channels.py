"""Faults of the measurement that look like physics: gain, polarity, delay, swapped channels, mass of a sensor, force channel."""

from __future__ import annotations

import numpy as np

from operando.structure.effects.base import Array, EffectKind, Parameter, Values
from operando.structure.effects.linear import PointMass

GAIN = Parameter("gain", "", 0.05, 20.0, "log", 1.0, "measured over true")
DELAY = Parameter("delay", "s", -0.1, 0.1, "linear", 0.0, "how late the channel is")


class _Channel(EffectKind):
    group = "sensor"
    acts = "sensor_map"
    moves = "nothing"


class SensorGain(_Channel):
    """measured = gain·true."""

    kind = "sensor_gain"
    plain = "a wrong sensitivity"
    says = "the channel at {location} has a wrong sensitivity ({size} times the true value): measurement, not structure"
    confirms = "calibrate the sensor at {location} on a shaker, or mount another sensor instead"
    parameters = (GAIN,)

    def sensor_map(self, frequencies_hz: Array, values: Values) -> Array:
        return np.full(np.shape(frequencies_hz), values["gain"], complex)


class SensorPolarity(_Channel):
    """measured = −true."""

    kind = "sensor_polarity"
    plain = "a reversed sensor"
    says = "the sensor at {location} points the other way: measurement, not structure"
    confirms = "look which way the sensor at {location} points, or turn it round and measure again"

    def sensor_map(self, frequencies_hz: Array, values: Values) -> Array:
        return np.full(np.shape(frequencies_hz), -1.0, complex)


class SensorDelay(_Channel):
    """True, delayed by ``delay``."""

    kind = "sensor_delay"
    plain = "a channel that is late"
    says = "the channel at {location} comes late by {size}: measurement, not structure"
    confirms = "record one sensor on the channel of {location} and on another channel at the same time: the phase between them must be zero"
    parameters = (DELAY,)

    def sensor_map(self, frequencies_hz: Array, values: Values) -> Array:
        return np.asarray(np.exp(-2j * np.pi * np.asarray(frequencies_hz) * values["delay"]))


class ChannelSwap(_Channel):
    """The two channels are exchanged."""

    kind = "channel_swap"
    plain = "two swapped channels"
    says = "the channels of {location} are exchanged: measurement, not structure"
    confirms = "swap the two cables of {location} and measure again, or tap at each sensor in turn"
    places = 2
    coordinates = "separate"

    def sensor_map(self, frequencies_hz: Array, values: Values) -> Array:
        return np.ones(np.shape(frequencies_hz), complex)


class SensorMass(PointMass):
    """The mass of a sensor that was there in this run only."""

    kind = "sensor_mass"
    plain = "the mass of a sensor"
    says = "a sensor of {size} sat on {location} in this run only: measurement, not structure"
    group = "sensor"
    removable = False

    def confirm(self, place: str, values: Values) -> str:
        return f"weigh the sensor and cable at {place}, or take it off and measure the others again"


class ForceGain(SensorGain):
    """measured force = gain·true."""

    kind = "force_gain"
    plain = "a wrong sensitivity of the force channel"
    says = "the force channel at {location} has a wrong sensitivity ({size} times the true value): measurement, not structure"
    confirms = "calibrate the force cell at {location} against a known mass: force over acceleration must be that mass"
    group = "force"


class ForceDelay(SensorDelay):
    """The force channel is late."""

    kind = "force_delay"
    plain = "a force channel that is late"
    says = "the force channel at {location} comes late by {size}: measurement, not structure"
    confirms = "record the force of {location} on two channels at the same time: the phase between them must be zero"
    group = "force"


KINDS: tuple[type[EffectKind], ...] = (SensorGain, SensorPolarity, SensorDelay, ChannelSwap, SensorMass, ForceGain, ForceDelay)

"""Behaviours that depend on time alone: constant, ramp, sine, square.

1. The position within a period is computed from the time by one exact remainder, never summed up: after a year it is as
   exact as in the first second.
"""

import math

from ....config.files.behaviours import ConstantSection, RampSection, SineSection, SquareSection


class _Timeless:
    """Base class of behaviours whose value depends on time alone, and which keep no state."""

    __slots__ = ()

    def resume(self, time: float, value: float) -> None:
        """Do nothing: the value follows from the time alone."""

    def state(self, time: float) -> float | None:
        """Return None: the behaviour depends on time alone and has no state to keep."""
        return None


class Constant(_Timeless):
    """Behaviour ``constant``: always the same value."""

    __slots__ = ("_value",)

    def __init__(self, section: ConstantSection) -> None:
        self._value = float(section.value)

    def value(self, time: float) -> float:
        """Return the constant value, at any time."""
        return self._value


class Ramp(_Timeless):
    """Behaviour ``ramp``: the value goes from ``first`` to ``last`` in ``duration`` seconds, on a straight line.

    Then, with ``at_end`` ``hold``, it stays at ``last``; with ``repeat`` it starts again from ``first``; with
    ``return`` it goes back to ``first`` and forth again.
    """

    __slots__ = ("_at_end", "_duration", "_first", "_rise")

    def __init__(self, section: RampSection) -> None:
        self._first = section.first
        self._rise = section.last - section.first
        self._duration = section.duration
        self._at_end = section.at_end

    def value(self, time: float) -> float:
        """Return the value of the ramp at a time, in seconds of the simulation."""
        duration = self._duration
        if self._at_end == "hold":
            part = min(time / duration, 1.0)
        elif self._at_end == "repeat":
            part = math.fmod(time, duration) / duration
        else:
            part = math.fmod(time, 2 * duration) / duration
            part = 2 - part if part > 1 else part
        return self._first + self._rise * part


class Sine(_Timeless):
    """Behaviour ``sine``: a sine wave around a mean. At time 0 it is ``phase`` degrees after the mean, rising."""

    __slots__ = ("_amplitude", "_factor", "_mean", "_period", "_phase")

    def __init__(self, section: SineSection) -> None:
        self._mean = section.mean
        self._amplitude = section.amplitude
        self._period = section.period
        self._factor = 2 * math.pi / section.period
        self._phase = math.radians(section.phase)

    def value(self, time: float) -> float:
        """Return the value of the sine wave at a time, in seconds of the simulation."""
        return self._mean + self._amplitude * math.sin(time % self._period * self._factor + self._phase)


class Square(_Timeless):
    """Behaviour ``square``: high for the part ``duty`` (0…1) at the start of each period, then low.

    At time 0, ``phase`` degrees (of 360) of a period have passed already.
    """

    __slots__ = ("_duty", "_high", "_low", "_period", "_shift")

    def __init__(self, section: SquareSection) -> None:
        self._low = section.low
        self._high = section.high
        self._period = section.period
        self._duty = section.duty * section.period
        self._shift = section.phase / 360 * section.period

    def value(self, time: float) -> float:
        """Return the value of the square wave at a time, in seconds of the simulation."""
        return self._high if (time + self._shift) % self._period < self._duty else self._low

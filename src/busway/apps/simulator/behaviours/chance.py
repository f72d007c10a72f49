"""Random behaviours, equal for equal seeds: noise and random walk.

1. The random number of a step depends on nothing but the seed, the point and the number of the step. It is the same
   whether or not the engine left out earlier moments, and whichever other points there are.
"""

import math
from hashlib import blake2b
from typing import Final

from ....config.files.behaviours import NoiseSection, RandomWalkSection

_WORD: Final = (1 << 64) - 1
_GOLDEN: Final = 0x9E3779B97F4A7C15
_TO_UNIT: Final = 2.0**-53


def stream_of(seed: int, key: str) -> int:
    """Return the number that selects a point's own sequence of random numbers, for the argument ``stream`` of `drawn`.

    Args:
        seed: the seed of the simulation.
        key: key of the point, ``UNIT/NAME``.
    """
    return int.from_bytes(blake2b(f"{seed}/{key}".encode(), digest_size=8).digest())


def drawn(stream: int, index: int) -> float:
    """Return a uniform random number, 0 ≤ x < 1: number ``index`` of the sequence ``stream`` (SplitMix64)."""
    word = (stream + index * _GOLDEN) & _WORD
    word = ((word ^ word >> 30) * 0xBF58476D1CE4E5B9) & _WORD
    word = ((word ^ word >> 27) * 0x94D049BB133111EB) & _WORD
    return ((word ^ word >> 31) >> 11) * _TO_UNIT


class Noise:
    """Behaviour ``noise``: random values around a mean, each independent of the others.

    They are spread evenly over mean ± ``spread``; with ``distribution`` ``gauss`` they are normally distributed, and
    ``spread`` is the standard deviation.

    Args:
        section: the behaviour's section in the file.
        stream: start number of the point's random sequence (`stream_of`).
    """

    __slots__ = ("_every", "_is_normal", "_mean", "_spread", "_stream")

    def __init__(self, section: NoiseSection, stream: int) -> None:
        self._mean = section.mean
        self._spread = section.spread
        self._is_normal = section.distribution == "gauss"
        self._every = section.every
        self._stream = stream

    def value(self, time: float) -> float:
        """Return the random value of the noise at a time, in seconds of the simulation; always the same for a time."""
        step = round(time / self._every)
        if not self._is_normal:
            return self._mean + self._spread * (2 * drawn(self._stream, step) - 1)
        # Box and Muller: two equally distributed numbers make a normal one.
        radius = math.sqrt(-2 * math.log(1 - drawn(self._stream, 2 * step)))
        return self._mean + self._spread * radius * math.cos(2 * math.pi * drawn(self._stream, 2 * step + 1))

    def resume(self, time: float, value: float) -> None:
        """Do nothing: no value of the noise depends on an earlier value."""

    def state(self, time: float) -> float | None:
        """Return None, as noise has no state to keep."""
        return None


class RandomWalk:
    """Behaviour ``random-walk``: random steps up and down, each at most ``step``, reflected at the limits.

    Args:
        section: the behaviour's section in the file.
        stream: start number of the point's random sequence (`stream_of`).
        start: the value at time 0.
        low, high: smallest and largest value; None for no limit.
    """

    __slots__ = ("_every", "_high", "_low", "_size", "_step", "_stream", "_value")

    def __init__(
        self, section: RandomWalkSection, stream: int, start: float, low: float | None, high: float | None
    ) -> None:
        self._size = section.step
        self._low = -math.inf if low is None else low
        self._high = math.inf if high is None else high
        self._every = section.every
        self._stream = stream
        self._value = start
        self._step = 0

    def value(self, time: float) -> float:
        """Return the value of the random walk at a time, in seconds of the simulation.

        Makes all steps since the last call, also those of moments that the engine left out.
        """
        last = round(time / self._every)
        value = self._value
        for step in range(self._step + 1, last + 1):
            value += self._size * (2 * drawn(self._stream, step) - 1)
            if value < self._low:
                value = min(2 * self._low - value, self._high)
            elif value > self._high:
                value = max(2 * self._high - value, self._low)
        self._step = max(last, self._step)
        self._value = value
        return value

    def resume(self, time: float, value: float) -> None:
        """Let the random walk continue from a value that the point has at a time, in seconds of the simulation."""
        self._value = value
        self._step = math.floor(time / self._every + 1e-9)

    def state(self, time: float) -> float | None:
        """Return the current value of the random walk, to continue from after a restart; ``time`` is ignored."""
        return self._value

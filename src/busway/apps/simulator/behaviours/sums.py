"""Behaviours that continue from their last value: counter and first-order lag.

1. With a number as rate or target the value is computed from the time since the last `resume`: no rounding errors add
   up.
2. An expression as rate or target is computed after each moment, and holds until the next (`Observer`). If it has no
   value (NaN or infinite), the value of a counter or lag does not change.
3. A value may be set by hand between two moments. If the engine then asks for the value at an earlier time, it gets
   the value that was set; at later times the behaviour continues from that value.
"""

import math

from ....points.expression import BoundExpression


class SteadyCounter:
    """Behaviour ``counter`` with a constant rate: the value grows by the rate each second of the simulation.

    Args:
        rate: change of the value per second.
        rollover: the value at which the counter starts from ``begin`` again; None for never.
        start: the value at time 0.
        begin: the value with which it starts again.
        goes_below: whether it goes on below ``begin``; else it comes from below to the rollover, as a number without a
            sign does.
    """

    __slots__ = ("_begin", "_goes_below", "_rate", "_rollover", "_since", "_start")

    def __init__(
        self, rate: float, rollover: float | None, start: float, begin: float = 0.0, *, goes_below: bool = False
    ) -> None:
        self._goes_below = goes_below
        self._rate = rate
        self._rollover = rollover
        self._begin = begin
        self._start = start
        self._since = 0.0

    def value(self, time: float) -> float:
        """Return the value of the counter at a time, in seconds of the simulation."""
        value = self._start + self._rate * max(time - self._since, 0.0)
        return _rolled_over(value, self._begin, self._rollover, self._goes_below)

    def resume(self, time: float, value: float) -> None:
        """Let the counter continue from a value at a time, in seconds of the simulation."""
        self._since = time
        self._start = value

    def state(self, time: float) -> float | None:
        """Return the value of the counter at a time, to continue from after a restart."""
        return self.value(time)


class Counter:
    """Behaviour ``counter`` whose rate is a formula: from moment to moment the value grows by rate × seconds.

    Args:
        rate: the formula, which returns the change of the value per second at a time.
        rollover: the value at which the counter starts from ``begin`` again; None for never.
        start: the value at time 0.
        begin: the value with which it starts again.
        goes_below: as of `SteadyCounter`.
    """

    __slots__ = ("_begin", "_goes_below", "_rate", "_rollover", "_seen", "_time", "_value")

    def __init__(
        self,
        rate: BoundExpression,
        rollover: float | None,
        start: float,
        begin: float = 0.0,
        *,
        goes_below: bool = False,
    ) -> None:
        self._goes_below = goes_below
        self._rate = rate
        self._rollover = rollover
        self._begin = begin
        self._value = start
        self._time = 0.0
        self._seen = 0.0

    def value(self, time: float) -> float:
        """Return the value of the counter at a time, in seconds of the simulation.

        Since the last call of `value` or `resume`, the counter has grown by the rate that the last `observe` has
        computed. If that call was for a later time, the value is returned unchanged.
        """
        value = self._value + self._seen * max(time - self._time, 0.0)
        self._value = _rolled_over(value, self._begin, self._rollover, self._goes_below)
        self._time = max(time, self._time)
        return self._value

    def observe(self, time: float) -> None:
        """Compute the counter's rate by its formula at a time; it holds until the next call. 0 if NaN or infinite."""
        rate = self._rate(time)
        self._seen = rate if math.isfinite(rate) else 0.0

    def resume(self, time: float, value: float) -> None:
        """Let the counter continue from a value at a time, in seconds of the simulation."""
        self._time = time
        self._value = value

    def state(self, time: float) -> float | None:
        """Return the current value of the counter, to continue from after a restart; ``time`` is ignored."""
        return self._value


def _rolled_over(value: float, begin: float, rollover: float | None, goes_below: bool) -> float:
    """Return the value that a counter shows.

    Args:
        value: the count as if the counter never started again.
        begin, rollover, goes_below: as `SteadyCounter` takes them.
    """
    if rollover is None or (goes_below and value < begin):
        return value
    shown = begin + (value - begin) % (rollover - begin)
    return shown if shown < rollover else begin  # of a tiny number below 0, % is the divisor


class SteadyLag:
    """Behaviour ``lag`` with a constant target, which the value approaches exponentially.

    Args:
        target: the value that is approached.
        time_constant: seconds in which the distance to the target falls by 63 %.
        start: the value at time 0.
    """

    __slots__ = ("_since", "_start", "_target", "_time_constant")

    def __init__(self, target: float, time_constant: float, start: float) -> None:
        self._target = target
        self._time_constant = time_constant
        self._start = start
        self._since = 0.0

    def value(self, time: float) -> float:
        """Return the lagging value at a time, in seconds of the simulation."""
        way = self._start - self._target
        return self._target + way * math.exp(min(self._since - time, 0.0) / self._time_constant)

    def resume(self, time: float, value: float) -> None:
        """Let the lagging value continue from a given value at a time, towards its target."""
        self._since = time
        self._start = value

    def state(self, time: float) -> float | None:
        """Return the lagging value at a time, to continue its approach after a restart."""
        return self.value(time)


class Lag:
    """Behaviour ``lag`` whose target is a formula; the value approaches the target exponentially.

    Args:
        target: the formula, which returns the value that is approached at a time.
        time_constant: seconds in which the distance to the target falls by 63 %.
        start: the value at time 0.
    """

    __slots__ = ("_seen", "_target", "_time", "_time_constant", "_value")

    def __init__(self, target: BoundExpression, time_constant: float, start: float) -> None:
        self._target = target
        self._time_constant = time_constant
        self._value = start
        self._time = 0.0
        self._seen = math.nan

    def value(self, time: float) -> float:
        """Return the lagging value at a time, in seconds of the simulation.

        Since the last call of `value` or `resume`, the value has approached the target that the last `observe` has
        computed. It has not changed if that target is not finite, or if that call was for a later time.
        """
        if math.isfinite(self._seen):
            way = self._value - self._seen
            self._value = self._seen + way * math.exp(min(self._time - time, 0.0) / self._time_constant)
        self._time = max(time, self._time)
        return self._value

    def observe(self, time: float) -> None:
        """Compute the target of the lag by its formula at a time; the target holds until the next call."""
        self._seen = self._target(time)

    def resume(self, time: float, value: float) -> None:
        """Let the lagging value continue from a given value at a time, towards its target."""
        self._time = time
        self._value = value

    def state(self, time: float) -> float | None:
        """Return the current lagging value, to continue its approach after a restart; ``time`` is ignored."""
        return self._value

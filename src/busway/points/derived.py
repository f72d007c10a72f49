"""Points computed from others: running totals of counters that roll over, and points with a formula.

Knows points and their latest readings; knows no request and no clock.

1. An accumulator goes on counting when its counter restarts at 0. If the counter fell by at most half of its range, the
   device has reset it; otherwise it has rolled over. The total goes on in both cases.
2. A computed point has no value if one of its inputs has none, and is as uncertain as its inputs are.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any

from .expression import BoundExpression, Expression, parse_expression
from .point import Point
from .quality import Quality, Reading, Reason


class Accumulator:
    """Running total of a counter; it goes on growing when the counter restarts at 0.

    Args:
        rollover: the value at which the counter restarts at 0, in the unit of measure.

    Attributes:
        total: the present total.
        rollover: as given.
        resets: how often the device has reset the counter.
        last: the last reading of the counter; None before the first.
    """

    __slots__ = ("last", "resets", "rollover", "total")

    def __init__(self, rollover: float) -> None:
        self.rollover: float = rollover
        self.total: float = 0.0
        self.resets: int = 0
        self.last: float | None = None

    def take(self, value: float, factor: float = 1.0) -> float:
        """Add the increase of the counter since its last reading to the total, and return the total.

        The first reading is the first total. A counter that fell by more than half of ``rollover`` has restarted at 0
        there; one that fell by less was reset, and its reading is added as it is. A counter that fell below 0 by more
        than ``rollover`` has gone on from ``-rollover``, as a number with a sign does that runs over. The total never
        falls: any other reading below the last one that is below 0 adds nothing.

        Args:
            value: the present reading of the counter, in the unit of measure.
            factor: number above 0 that ``rollover`` is multiplied by for this reading.
        """
        last, rollover = self.last, self.rollover * factor
        self.last = value
        if last is None:
            self.total = value
        elif value >= last:
            self.total += value - last
        elif last - value > rollover / 2:
            runs_over = value < 0 and last - value > rollover
            self.total += max(value + (2 if runs_over else 1) * rollover - last, 0.0)
        else:
            self.resets += 1
            self.total += max(value, 0.0)
        return self.total


class Derivation:
    """The computed points of one device: running totals and formulas.

    Args:
        points: points of the device; only those with a rollover or a formula are computed.

    Raises:
        ConfigError: a formula is invalid.

    Attributes:
        accumulators: running totals by the names of their points.
    """

    def __init__(self, points: Iterable[Point]) -> None:
        points = list(points)
        self.accumulators: dict[str, Accumulator] = {
            each.name: Accumulator(each.rollover) for each in points if each.rollover
        }
        self._exponent_points = {each.name: each.conversion.scale_from for each in points if each.rollover_is_scaled}
        self._latest: dict[str, Any] = {}  # numbers
        computed = {each.name: each for each in points if each.formula}
        expressions = {name: parse_expression(point.formula) for name, point in computed.items()}
        self._computed = [
            (computed[name], expressions[name], expressions[name].bind(self._source)) for name in _ordered(expressions)
        ]

    def restore(self, name: str, total: float, last: float) -> None:
        """Continue the running total of a point from an earlier run; ignored if the point has no running total.

        Args:
            name: name of the point.
            total: the last total.
            last: the reading of the counter at that total.
        """
        accumulator = self.accumulators.get(name)
        if accumulator is not None:
            accumulator.total, accumulator.last = total, last

    @property
    def is_empty(self) -> bool:
        """Whether the device has neither running totals nor points with a formula."""
        return not self.accumulators and not self._computed

    def inputs(self) -> frozenset[str]:
        """Return the names of the points that the formulas use, other computed points included."""
        return frozenset(name for _, expression, _ in self._computed for name in expression.names)

    def apply(
        self, latest: Mapping[str, Reading], time: float = 0.0, exponents: Mapping[str, int] | None = None
    ) -> dict[str, Reading]:
        """Compute running totals and formulas from the latest values of the device's points.

        A running total replaces the reading of its counter: it has the same name, and formulas use the total.

        Args:
            latest: the latest reading of each point that was read. Pass a reading of an accumulator only once, because
                each call adds it to the total.
            time: the value of ``t`` in formulas, in seconds.
            exponents: exponents for ``scale_from``, by name of the point that holds them; None for none.

        Returns:
            By name, the totals of the counters that have a value in ``latest``, and the readings of all points with a
            formula; those without a value have None and the reason.
        """
        found: dict[str, Reading] = {}
        for name, accumulator in self.accumulators.items():
            reading = latest.get(name)
            if reading is not None and reading.value is not None:
                found[name] = Reading(
                    accumulator.take(reading.value, self._rollover_factor(name, exponents)), reading.reason
                )
        known = {**latest, **found}
        for point, expression, compute in self._computed:
            known[point.name] = found[point.name] = self._result(point, expression, compute, known, time)
        return found

    def _rollover_factor(self, name: str, exponents: Mapping[str, int] | None) -> float:
        """Return the power of ten that multiplies the rollover of a counter now; 1 without ``scale_from``."""
        holder = self._exponent_points.get(name)
        return 1.0 if holder is None or exponents is None else 10.0 ** exponents.get(holder, 0)

    def _result(
        self, point: Point, expression: Expression, compute: BoundExpression, known: Mapping[str, Reading], time: float
    ) -> Reading:
        inputs = [known.get(name) for name in expression.names]
        reason = 0
        for each in inputs:
            if each is None or each.value is None or each.quality is Quality.BAD:
                return Reading(None, Reason.NO_INPUT)
            reason = each.reason or reason
        self._latest = {name: known[name].value for name in expression.names}
        value = compute(time)
        if math.isnan(value):
            return Reading(None, Reason.NOT_A_NUMBER)
        low, high = point.conversion.valid or (None, None)
        if (low is not None and value < low) or (high is not None and value > high):
            reason = reason or Reason.OUT_OF_RANGE
        return Reading(value, reason)

    def _source(self, name: str) -> Any:
        return lambda: self._latest[name]


def _ordered(expressions: Mapping[str, Expression]) -> list[str]:
    """Return the names of the computed points, each after the points that its formula uses.

    The caller has already refused formulas that use each other in a circle.
    """
    done: dict[str, None] = {}

    def visit(name: str, depth: int) -> None:
        if name in done or name not in expressions or depth > len(expressions):
            return
        for other in expressions[name].names:
            visit(other, depth + 1)
        done[name] = None

    for name in expressions:
        visit(name, 0)
    return list(done)

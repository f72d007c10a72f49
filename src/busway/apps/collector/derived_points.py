"""Computes points of one device that are derived from reads: totals, computed points, members of variable groups.

Pure: knows points and their latest readings; knows no request and no clock.

1. The sample of an accumulator is its total, which goes on when the counter begins again: `busway.points.derived`
   decides when a counter has begun again.
2. Computed points get a sample at the end of each round that read one of their inputs.
3. Some groups have a variable size, which is itself a point of the device. Members of such a group are read once the
   size is known, and only those that the device has.
4. An input that was not read when it was due, as after an outage, is held: a value computed from it is uncertain.
5. A computed sample is uncertain because of the clock if the clock is not right at its own time, no matter how the
   clock was when its inputs were read.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ...points.derived import Derivation
from ...points.expression import parse_expression
from ...points.point import Point
from ...points.quality import Reading, Reason
from .samples import NANOSECONDS, CounterState, PointGroup, SampleBatch


class DerivedPoints:
    """Computes totals of counters, values of computed points, and members of variable groups of one device.

    Args:
        device: name of the device.
        points: all points of the device.
        counters: the states of accumulators stored before a restart; their totals go on from there.
        limits: seconds without a read after which the value of a point is held, by its name; None for none.
    """

    def __init__(
        self,
        device: str,
        points: Sequence[Point],
        counters: Iterable[CounterState] = (),
        limits: Mapping[str, float] | None = None,
    ) -> None:
        accumulators = [point for point in points if point.rollover and not point.formula]
        computed = [point for point in points if point.formula]
        self._accumulators = frozenset(point.name for point in accumulators)
        self._totals = Derivation(accumulators)
        for each in counters:
            self._totals.restore(each.point, each.total, each.last)
        self._formulas = Derivation(computed)
        self._inputs = {point.name: frozenset(parse_expression(point.formula).names) for point in computed}
        self._group = PointGroup(device, tuple(self._inputs)) if self._inputs else None
        inputs = self._formulas.inputs() - self._inputs.keys()
        self._limits = {name: limit for name, limit in (limits or {}).items() if name in inputs}
        self._latest: dict[str, Reading] = {}
        self._read_at: dict[str, float] = {}
        self._touched: set[str] = set()
        self._counted = [point for point in points if point.exists]
        self._counts: dict[str, int | None] = {name: None for point in self._counted for name, _ in point.exists}

    @property
    def is_empty(self) -> bool:
        """Whether the device has neither totals nor computed points nor groups of variable size."""
        return not (self._accumulators or self._inputs or self._counted)

    def absent(self) -> list[Point]:
        """Return the members of variable groups that the device does not have now, so that they are not read.

        While the size of a group is not known, all its members are among them.
        """
        return [point for point in self._counted if not self._is_there(point)]

    def _is_there(self, point: Point) -> bool:
        for name, place in point.exists:
            count = self._counts[name]
            if count is None or place > count:
                return False
        return True

    def take(
        self, batch: SampleBatch, at: float, exponents: Mapping[str, int] | None = None
    ) -> tuple[SampleBatch, bool]:
        """Replace the counter readings in the samples of a read by running totals, and keep what formulas need.

        Args:
            batch: the samples of the read.
            at: when the read ended, seconds of the monotonic clock.
            exponents: the scale factors of the device as last read, by name; None for none.

        Returns:
            A pair: the samples, with the states of the counters among them; and whether the size of a group of variable
            size has changed, so that `absent` may return other points.
        """
        found = {
            name: Reading(value, reason)
            for name, value, reason in zip(batch.points, batch.values, batch.reason_column(), strict=True)
        }
        changed = self._count(found)
        totals = self._accumulators & found.keys()
        if totals:
            made = self._totals.apply({name: found[name] for name in totals}, exponents=exponents)
            values: list[Any] = list(batch.values)
            for place, name in enumerate(batch.points):
                if name in totals and name in made and values[place] is not None:
                    values[place] = made[name].value
                    found[name] = Reading(values[place], found[name].reason)
            states = self._counter_states(made)
            batch = SampleBatch(batch.group, batch.time, batch.half_width, values, batch.reasons, states)
        if self._group is not None:
            self._latest |= {
                name: Reading(each.value) if each.reason == Reason.CLOCK else each for name, each in found.items()
            }
            self._touched |= found.keys()
            for name in self._limits.keys() & found.keys():
                self._read_at[name] = at
        return batch, changed

    def _counter_states(self, names: Iterable[str]) -> list[CounterState]:
        known = self._totals.accumulators
        return [CounterState(name, known[name].total, last) for name in names if (last := known[name].last) is not None]

    def _count(self, found: Mapping[str, Reading]) -> bool:
        changed = False
        for name in self._counts.keys() & found.keys():
            value = found[name].value
            is_number = isinstance(value, int) or (isinstance(value, float) and math.isfinite(value))
            count = int(value) if is_number else None
            if count is not None and count != self._counts[name]:
                self._counts[name] = count
                changed = True
        return changed

    def failed(self, points: Sequence[str], reason: int) -> None:
        """Record that a read of points failed: computed points that use them then get bad samples with this reason."""
        if self._group is not None:
            self._latest |= {name: Reading(None, reason) for name in points}
            self._touched |= set(points)

    def computed(self, time: int, half_width: int, at: float, usual: Reason = Reason.NONE) -> SampleBatch | None:
        """Return the samples of all computed points at the end of a round.

        None if there are no computed points, or if the round read none of their inputs.

        Args:
            time: time of the samples, nanoseconds since 1970 UTC.
            half_width: half the length of the last transaction, nanoseconds.
            at: when the last transaction ended, seconds of the monotonic clock; it decides which inputs are held.
            usual: the reason of a sample that nothing else is wrong with: `Reason.CLOCK` while the clock is not right.
        """
        touched, self._touched = self._touched, set()
        if self._group is None or not any(inputs & touched for inputs in self._inputs.values()):
            return None
        made = self._formulas.apply(self._latest | self._held(at), time / NANOSECONDS)
        readings = [made.get(name, Reading(None, Reason.NO_INPUT)) for name in self._group.points]
        reasons = [int(each.reason or usual) for each in readings]
        return SampleBatch(
            self._group, time, half_width, [each.value for each in readings], reasons if any(reasons) else 0
        )

    def _held(self, at: float) -> dict[str, Reading]:
        """Return readings of held inputs, by name: good inputs that were not read when they were due (rule 4).

        Each has its last value and the reason `Reason.HELD`.

        Args:
            at: seconds of the monotonic clock.
        """
        return {
            name: Reading(reading.value, Reason.HELD)
            for name, limit in self._limits.items()
            if at - self._read_at.get(name, at) > limit and not (reading := self._latest[name]).reason
        }

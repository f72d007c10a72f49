"""Rules that device files give for points: limits of reads, and what may be written, is reported or is an alarm.

Knows the rules and their ranges; only rules that need nothing but a value are applied here.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from functools import lru_cache
from typing import Final, Literal

from ..codes import MAX_READ_BITS, MAX_READ_REGISTERS, Table
from ..errors import InvalidRequest
from ..values import Address
from ..values.unfit_values import shown
from .conversion import ROUNDING, exact, is_whole

_ROUNDING: Final = float(ROUNDING)
"""`ROUNDING` as a float: it is used for each sample of a point with a deadband."""


@dataclass(frozen=True, slots=True, order=True)
class ItemRange:
    """Addresses of a table from ``start`` up to but not including ``end``.

    Raises:
        ValueError: the range is empty, or ``start`` is negative.
    """

    start: int
    end: int

    def __post_init__(self) -> None:
        if not 0 <= self.start < self.end:
            raise ValueError(f"a span has at least one item, not {self.start}…{self.end}")

    def __contains__(self, other: "ItemRange") -> bool:
        return self.start <= other.start and other.end <= self.end

    @property
    def width(self) -> int:
        """Number of addresses in the range."""
        return self.end - self.start


@dataclass(frozen=True, slots=True)
class ReadRules:
    """Limits for reading a device: largest requests, readable and forbidden ranges.

    Attributes:
        max_registers: most registers in one read, 1…125.
        max_bits: most bits in one read, 1…2000.
        readable: by table, the ranges that exist: a read stays within one of them, and may include addresses between
            points. Without ranges the whole table can be read, but addresses between points may not exist.
        forbidden: by table, ranges that no read may include.
        exact: by table, blocks that are read as a whole or not at all.
        borders: by table, offsets that a read may end before or begin at, but not cross.
        bridge: whether a read may include addresses between points outside readable ranges too.
        one_point: whether a request may read one point only.
        pause: least time in seconds from the end of a reply to the next request to the device.
    """

    max_registers: int = MAX_READ_REGISTERS
    max_bits: int = MAX_READ_BITS
    readable: Mapping[Table, Sequence[ItemRange]] = field(default_factory=dict)
    forbidden: Mapping[Table, Sequence[ItemRange]] = field(default_factory=dict)
    exact: Mapping[Table, Sequence[ItemRange]] = field(default_factory=dict)
    borders: Mapping[Table, Collection[int]] = field(default_factory=dict)
    bridge: bool = False
    one_point: bool = False
    pause: float = 0.0

    def limit(self, table: Table) -> int:
        """Return the largest number of items that one read of a table may ask for."""
        return self.max_bits if table.holds_bits else self.max_registers


@dataclass(frozen=True, slots=True)
class WriteRule:
    """How a point may be written, and with which values.

    Attributes:
        function: function code of the write: 5, 6, 15, 16 or 22; None for the one that suits the point.
        verify: ``none``; ``read-back`` to read the point after a write; or the address where the device shows the
            value.
        minimum, maximum: smallest and largest value that may be written, in the unit of measure; None for no limit.
        step: values must differ from ``minimum`` (or 0) by a whole number of steps; None to allow any value.
        on, off: the raw numbers of a switch; None for a point that is no switch.
        role: the role that the sender of a command to the collector needs.
        armed: whether such a command must be armed first and then confirmed.
    """

    function: int | None = None
    verify: Literal["none", "read-back"] | Address = "none"
    minimum: float | None = None
    maximum: float | None = None
    step: float | None = None
    on: int | None = None
    off: int | None = None
    role: Literal["operate", "configure"] = "operate"
    armed: bool = False

    def check(self, value: float) -> None:
        """Raise `InvalidRequest` if a value may not be written: it is out of range, or no whole number of steps.

        Args:
            value: the value in the unit of measure.
        """
        low, high = self.minimum, self.maximum
        if (low is not None and not value >= low) or (high is not None and not value <= high):
            raise InvalidRequest(f"must be {ranged(low, high)}, not {shown(value)}")
        if self.step is not None:
            step = exact(self.step)
            is_finite = isinstance(value, int) or math.isfinite(value)
            if not is_finite or not is_whole((exact(value) - exact(low or 0)) / step, value, step):
                raise InvalidRequest(
                    f"must be a whole number of steps of {self.step:g} from {low or 0.0:g} on, not {shown(value)}"
                )


@dataclass(frozen=True, slots=True)
class ReportRule:
    """Rule that selects which samples of a point are passed on to a store or sink: by change of the value or by time.

    A sample whose reason (and so its quality) differs from that of the sample before is always passed on. A store has
    one rule, and each sink may have its own, which selects from the samples that the store has kept.

    Attributes:
        when: ``every``: each sample is passed on; ``change``: each change of the value; ``change_or_period``: each
            change, and a sample without a change after ``period``.
        period: seconds, for ``change_or_period``.
        deadband: a value has changed if it differs by more than this from the value passed on before; in the unit of
            measure, or in percent of that value.
        percent: whether the deadband is in percent.
        max_silence: seconds after which a sample is passed on even without a change; None for never.
    """

    when: Literal["every", "change", "change_or_period"] = "every"
    period: float | None = None
    deadband: float = 0.0
    percent: bool = False
    max_silence: float | None = None

    def passes(self, last: tuple[object, int], now: tuple[object, int], silence: float) -> bool:
        """Whether the rule passes a sample on: its reason differs from that of the last sample passed on, or `is_due`.

        Args:
            last: value and reason of the last sample passed on.
            now: value and reason of this sample.
            silence: seconds between the two.
        """
        return last[1] != now[1] or self.is_due(last[0], now[0], silence)

    def is_change(self, before: object, now: object) -> bool:
        """Whether the value ``now`` differs by more than the deadband from ``before``, the last value passed on.

        With ``percent``, the deadband is that percentage of ``before``. Rounding errors of floats do not count: 0.8
        does not differ from 0.7 by more than a deadband of 0.1. Values that are no finite numbers, such as texts, have
        changed if they are different; NaN does not differ from NaN.
        """
        if before == now:
            return False
        numbers = isinstance(before, int | float) and isinstance(now, int | float)
        if not numbers or isinstance(now, bool):
            return True
        assert isinstance(before, int | float)
        assert isinstance(now, int | float)
        if not (math.isfinite(before) and math.isfinite(now)):
            return not (math.isnan(before) and math.isnan(now))
        if not self.deadband:
            return True
        limit = abs(before) * self.deadband / 100 if self.percent else self.deadband
        if isinstance(before, float) or isinstance(now, float):
            limit += max(abs(before), abs(now)) * _ROUNDING
        return abs(now - before) > limit + limit * _ROUNDING

    def is_due(self, before: object, now: object, silence: float) -> bool:
        """Whether the rule passes on a sample whose reason is unchanged: for its value, the time, or ``every``.

        Args:
            before: the value passed on before.
            now: the value of this sample.
            silence: seconds between the two; below 0 if the clock was set back between them. Its true length is not
                known then, so it counts as longer than any limit.
        """
        if self.when == "every" or self.is_change(before, now):
            return True
        limit = self.longest_silence
        return limit is not None and not 0 <= silence < limit

    @property
    def longest_silence(self) -> float | None:
        """Seconds after which a sample is passed on even without a change; None for no such time.

        The smaller of ``max_silence`` and, if the rule is ``change_or_period``, ``period``.
        """
        limits = [self.max_silence, self.period if self.when == "change_or_period" else None]
        return min((each for each in limits if each is not None), default=None)


@dataclass(frozen=True, slots=True)
class AlarmRule:
    """When a point is in alarm: its value is beyond a limit, or is one of certain states.

    Attributes:
        kind: ``HH``, ``H``, ``L`` or ``LL`` for a limit; ``state`` for states.
        limit: in the unit of measure; the alarm begins above it (H, HH) or below it (L, LL). Unused for ``state``.
        delay: seconds for which the value has to be beyond the limit, or in the state, before the alarm begins.
        hysteresis: how far the value has to come back from the limit for the alarm to end, in the unit of measure.
        acknowledge: whether a person has to acknowledge the alarm.
        states: names of the states, for people.
        numbers: the values for which the point is in alarm.
        bits: mask of bits; the point is in alarm if one of them is set in its value. 0 for none.
    """

    kind: Literal["HH", "H", "L", "LL", "state"]
    limit: float = 0.0
    delay: float = 0.0
    hysteresis: float = 0.0
    acknowledge: bool = False
    states: tuple[str, ...] = ()
    numbers: frozenset[int] = frozenset()
    bits: int = 0

    def is_beyond(self, value: float, *, active: bool) -> bool:
        """Whether a value is beyond the limit, or in one of the states, so that the alarm begins or stays active.

        While the alarm is ``active``, the limit is moved by the hysteresis. The delay is not applied here.
        """
        if self.kind == "state":
            return value in self.numbers or bool(self.bits and isinstance(value, int) and value & self.bits)
        is_high = self.kind in ("H", "HH")
        end = self.limit
        if active and self.hysteresis:
            end = _decimal_sum(self.limit, -self.hysteresis if is_high else self.hysteresis)
        return value > end if is_high else value < end

    def text(self, unit_of_measure: str = "") -> str:
        """Return the condition of the alarm in words: ``above 80 °C``, ``is fault``."""
        if self.kind == "state":
            return f"is {' or '.join(self.states)}"
        side = "above" if self.kind in ("H", "HH") else "below"
        return f"{side} {self.limit:.10g}{' ' * bool(unit_of_measure)}{unit_of_measure}"


@lru_cache(maxsize=4096)
def _decimal_sum(one: float, other: float) -> float:
    """Return the sum of two numbers without binary rounding errors: 0.3 and -0.1 make 0.2."""
    return float(Decimal(repr(one)) + Decimal(repr(other)))


def ranged(low: float | None, high: float | None) -> str:
    """Return a range of numbers in words: ``0…100``, ``at least 0``, ``at most 100``. One end can be None, not both."""
    if low is None:
        return f"at most {high:g}"
    return f"at least {low:g}" if high is None else f"{low:g}…{high:g}"

"""What alarms must be, written from docs/how-to/alarms.md alone: a second, small model, that tests compare with.

Knows nothing of busway. Values and limits are decimal numbers as they are written, so that 0.3 - 0.1 is 0.2; times are
nanoseconds.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from decimal import Decimal

NUMERIC = ("HH", "H", "L", "LL")

Key = tuple[object, str]
"""A point, however the test names it, and the kind of a limit."""


@dataclass(frozen=True, slots=True)
class Limit:
    """A limit as a device file has it; ``states`` are values, or places of flags where ``bits`` is set."""

    kind: str
    limit: Decimal = Decimal(0)
    delay: Decimal = Decimal(0)
    hysteresis: Decimal = Decimal(0)
    acknowledge: bool = False
    states: tuple[int, ...] = ()
    bits: bool = False

    def is_beyond(self, value: object) -> bool:
        if self.kind == "state":
            assert isinstance(value, int)
            return any(value >> state & 1 for state in self.states) if self.bits else int(value) in self.states
        number = Decimal(repr(value)) if not isinstance(value, bool) else Decimal(int(value))
        return number > self.limit if self.kind in ("H", "HH") else number < self.limit

    def has_come_back(self, value: object) -> bool:
        if self.kind == "state":
            return not self.is_beyond(value)
        number = Decimal(repr(value)) if not isinstance(value, bool) else Decimal(int(value))
        if self.kind in ("H", "HH"):
            return number <= self.limit - self.hysteresis
        return number >= self.limit + self.hysteresis

    @property
    def delay_ns(self) -> int:
        return int(self.delay * 1_000_000_000)


@dataclass(frozen=True, slots=True)
class Told:
    """An event of the journal."""

    key: Key
    kind: str
    at: int | None
    value: object = None
    by: str = ""


@dataclass(slots=True)
class _Alarm:
    is_active: bool = False
    waits: bool = False
    """Whether a person has to acknowledge it."""
    pending: int | None = None


@dataclass(slots=True)
class AlarmOracle:
    """All alarms of a plant, and the journal that they make."""

    limits: dict[object, tuple[Limit, ...]] = field(default_factory=dict)
    journal: list[Told] = field(default_factory=list)
    _alarms: dict[Key, _Alarm] = field(default_factory=dict)

    def sample(self, point: object, value: object, *, is_bad: bool, at: int, monotonic: int) -> list[Told]:
        """A sample of a point; the events that it causes."""
        if is_bad or value is None or isinstance(value, str) or value != value:
            return []
        events = []
        for limit in self.limits.get(point, ()):
            key = point, limit.kind
            alarm = self._alarms.setdefault(key, _Alarm())
            if alarm.is_active:
                if limit.has_come_back(value):
                    alarm.is_active = False
                    events.append(Told(key, "cleared", at, value))
            elif not limit.is_beyond(value):
                alarm.pending = None
            else:
                if alarm.pending is None:
                    alarm.pending = monotonic
                if monotonic - alarm.pending >= limit.delay_ns:
                    alarm.is_active, alarm.pending = True, None
                    alarm.waits = alarm.waits or limit.acknowledge
                    events.append(Told(key, "raised", at, value))
        self.journal += events
        return events

    def acknowledge(self, key: Key, by: str) -> bool:
        """A person acknowledges; False where there is nothing to acknowledge."""
        alarm = self._alarms.get(key)
        if alarm is None or not alarm.waits:
            return False
        alarm.waits = False
        self.journal.append(Told(key, "acknowledged", None, by=by))
        return True

    def configure(self, limits: Mapping[object, Iterable[Limit]]) -> list[Told]:
        """Another file; the alarms whose limit is gone end."""
        self.limits = {point: tuple(each) for point, each in limits.items()}
        kept = {(point, limit.kind) for point, each in self.limits.items() for limit in each}
        events = [Told(key, "removed", None) for key in self.active() if key not in kept]
        self._alarms = {key: alarm for key, alarm in self._alarms.items() if key in kept}
        self.journal += events
        return events

    def restart(self) -> None:
        """Another process goes on: delays begin again."""
        for alarm in self._alarms.values():
            alarm.pending = None

    def active(self) -> dict[Key, tuple[bool, bool]]:
        """What is active or waits for a person: whether it is active, and whether it waits."""
        return {
            key: (alarm.is_active, alarm.waits) for key, alarm in self._alarms.items() if alarm.is_active or alarm.waits
        }

    def copy(self) -> "AlarmOracle":
        return AlarmOracle(dict(self.limits), list(self.journal), {k: replace(v) for k, v in self._alarms.items()})

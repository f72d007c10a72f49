"""The events of alarms (raised, acknowledged, cleared, removed), and what an alarm is after each.

Pure. The journal is a list of `AlarmEvent`. The state of every alarm follows from it: after a crash, a collector reads
the journal to know which alarms were active and which were acknowledged.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

from ..point_names import PointKey
from ..samples import SampleValue


class AlarmEventKind(StrEnum):
    """Kinds of alarm events: raised, acknowledged, cleared, removed."""

    RAISED = "raised"
    ACKNOWLEDGED = "acknowledged"
    CLEARED = "cleared"
    REMOVED = "removed"
    """The alarm ended because its limit, its point or its device is no longer in the configuration."""


class AlarmState(StrEnum):
    """States of an alarm: whether its value is beyond the limit, and whether it is acknowledged."""

    NORMAL = "normal"
    PENDING = "pending"
    """The value is beyond the limit, and the delay is not over."""
    UNACKNOWLEDGED = "active, not acknowledged"
    ACKNOWLEDGED = "active"
    """Active, and acknowledged already or an alarm that needs no acknowledgement."""
    CLEARED = "cleared, not acknowledged"
    """No longer active, because the value has come back; not acknowledged yet."""

    @property
    def is_active(self) -> bool:
        """Whether the alarm was raised and is not cleared, be it acknowledged or not; False while it is PENDING."""
        return self in (AlarmState.UNACKNOWLEDGED, AlarmState.ACKNOWLEDGED)

    @property
    def is_unacknowledged(self) -> bool:
        """Whether the alarm must still be acknowledged, be it active or cleared."""
        return self in (AlarmState.UNACKNOWLEDGED, AlarmState.CLEARED)


NEXT_STATE: Final = {
    (AlarmState.NORMAL, AlarmEventKind.RAISED): AlarmState.UNACKNOWLEDGED,
    (AlarmState.CLEARED, AlarmEventKind.RAISED): AlarmState.UNACKNOWLEDGED,
    (AlarmState.UNACKNOWLEDGED, AlarmEventKind.ACKNOWLEDGED): AlarmState.ACKNOWLEDGED,
    (AlarmState.CLEARED, AlarmEventKind.ACKNOWLEDGED): AlarmState.NORMAL,
    (AlarmState.UNACKNOWLEDGED, AlarmEventKind.CLEARED): AlarmState.CLEARED,
    (AlarmState.ACKNOWLEDGED, AlarmEventKind.CLEARED): AlarmState.NORMAL,
    (AlarmState.UNACKNOWLEDGED, AlarmEventKind.REMOVED): AlarmState.NORMAL,
    (AlarmState.ACKNOWLEDGED, AlarmEventKind.REMOVED): AlarmState.NORMAL,
    (AlarmState.CLEARED, AlarmEventKind.REMOVED): AlarmState.NORMAL,
}
"""The next state, by state and event; any other pair changes nothing. If an alarm that needs no acknowledgement is
raised from NORMAL, the next state is ACKNOWLEDGED instead of UNACKNOWLEDGED. PENDING counts as NORMAL here.
"""

AlarmKey = tuple[str, str, str]
"""Key of an alarm: device, point, and kind of the limit. There is at most one alarm with each key."""


def renamed_key(key: AlarmKey, moved: Mapping[PointKey, str]) -> AlarmKey:
    """Return the key of an alarm after points were renamed; the same key if its point was not.

    Args:
        key: device, point and limit.
        moved: new names of renamed points, by device and old name.
    """
    device, point, limit = key
    return device, moved.get((device, point), point), limit


@dataclass(frozen=True, slots=True)
class AlarmEvent:
    """One event of an alarm (raised, acknowledged, …), as a line of the alarm journal.

    Attributes:
        device, point: names.
        limit: the kind of the limit: ``HH``, ``H``, ``L``, ``LL``, or ``state``.
        kind: the kind of event.
        at: nanoseconds since 1970 UTC; the time of the sample if a sample caused the event.
        value: the point's value; None if no sample caused the event.
        by: who acknowledged the alarm; empty for other events.
        needs_acknowledgement: in an event `AlarmEventKind.RAISED`, whether a person has to acknowledge the alarm; not
            used in other events.
        text: the condition of the alarm in words: ``above 80 °C``.
    """

    device: str
    point: str
    limit: str
    kind: AlarmEventKind
    at: int
    value: SampleValue | None = None
    by: str = ""
    needs_acknowledgement: bool = False
    text: str = ""

    @property
    def key(self) -> AlarmKey:
        """The key of the alarm that this event belongs to: device, point and limit."""
        return self.device, self.point, self.limit


@dataclass(frozen=True, slots=True)
class RaisedAlarm:
    """An alarm that is active or not acknowledged yet.

    Attributes:
        device, point, limit, text: as in the event that raised it.
        state: its state, neither normal nor pending.
        since: nanoseconds since 1970 UTC at which it was raised.
        value: the value with which it was raised.
        acknowledged_by, acknowledged_at: who acknowledged it, and when, nanoseconds since 1970 UTC; None if not yet, or
            if it needs no acknowledgement.
        cleared_at: when the value came back, nanoseconds since 1970 UTC; None while it has not.
    """

    device: str
    point: str
    limit: str
    text: str
    state: AlarmState
    since: int
    value: SampleValue | None
    acknowledged_by: str | None = None
    acknowledged_at: int | None = None
    cleared_at: int | None = None

    @property
    def key(self) -> AlarmKey:
        """The key of the alarm: device, point and limit."""
        return self.device, self.point, self.limit


def alarm_after(alarm: RaisedAlarm | None, event: AlarmEvent) -> RaisedAlarm | None:
    """Return the alarm as it is after an event; None if it is normal then, or its limit was removed.

    An event that is not possible in the alarm's state changes nothing.

    Args:
        alarm: the alarm before; None if it was normal.
        event: an event of this alarm.
    """
    before = AlarmState.NORMAL if alarm is None else alarm.state
    state = NEXT_STATE.get((before, event.kind))
    if state is None:
        return alarm
    if event.kind is AlarmEventKind.RAISED:
        needs = event.needs_acknowledgement or before is AlarmState.CLEARED
        state = state if needs else AlarmState.ACKNOWLEDGED
        return RaisedAlarm(event.device, event.point, event.limit, event.text, state, event.at, event.value)
    if state is AlarmState.NORMAL or alarm is None:
        return None
    if event.kind is AlarmEventKind.ACKNOWLEDGED:
        return replace(alarm, state=state, acknowledged_by=event.by, acknowledged_at=event.at)
    return replace(alarm, state=state, cleared_at=event.at)


def alarms_after(journal: Iterable[AlarmEvent]) -> dict[AlarmKey, RaisedAlarm]:
    """Return the alarms that are active or unacknowledged after all events of a journal, by key.

    The dict has the order in which the alarms were raised.
    """
    alarms: dict[AlarmKey, RaisedAlarm] = {}
    for event in journal:
        fold_event(alarms, event)
    return alarms


def fold_event(alarms: dict[AlarmKey, RaisedAlarm], event: AlarmEvent) -> None:
    """Apply an alarm event to a dict of the alarms that are active or unacknowledged: add, replace or remove one.

    Args:
        alarms: these alarms by key, in the order in which they were raised; changed in place.
        event: the event.
    """
    before = alarms.get(event.key)
    after = alarm_after(before, event)
    if after is before:
        return
    if event.kind is AlarmEventKind.RAISED or after is None:
        alarms.pop(event.key, None)
    if after is not None:
        alarms[event.key] = after

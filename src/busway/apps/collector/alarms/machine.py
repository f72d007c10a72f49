"""The state machine of one alarm: takes samples of its point, returns alarm events.

Pure: knows a rule, values and the time as a number.

1. A good or uncertain value decides. A bad sample raises and clears nothing, and does not interrupt a delay; its reason
   is shown beside the alarm (`AlarmMachine.reason`).
2. The delay runs from the first value beyond the limit, and starts anew after a value that is not beyond it. It is
   measured by samples: the first sample beyond the limit that is at least the delay later raises the alarm.
3. An active alarm is cleared, at once, by a value that has come back by the hysteresis.
4. The machine reports every change as an event, and its state is what `alarm_after` makes of these events. So the
   journal of events is enough to restore the state.
"""

import math
from dataclasses import replace

from ....points.point_rules import AlarmRule
from ..samples import NANOSECONDS, Quality, SampleValue, quality_of
from .events import AlarmEvent, AlarmEventKind, AlarmState, RaisedAlarm, alarm_after


class AlarmMachine:
    """The state of one alarm of one point, which changes with the samples of the point.

    Args:
        device, point: names.
        rule: the limit, with delay and hysteresis.
        unit_of_measure: the point's unit of measure, for the texts of events.
        alarm: the alarm as it was before a restart; None if it was normal.

    Attributes:
        alarm: the alarm while it is active or unacknowledged, else None.
        reason: number of the reason why the last sample is not good; 0 if it is good, or before the first sample.
    """

    __slots__ = ("_beyond_since", "alarm", "device", "point", "reason", "rule", "unit_of_measure")

    def __init__(
        self, device: str, point: str, rule: AlarmRule, unit_of_measure: str = "", alarm: RaisedAlarm | None = None
    ) -> None:
        self.device: str = device
        self.point: str = point
        self.rule: AlarmRule = rule
        self.unit_of_measure: str = unit_of_measure
        self.alarm: RaisedAlarm | None = alarm
        self.reason: int = 0
        self._beyond_since: float | None = None

    @property
    def state(self) -> AlarmState:
        """The state of the alarm now: `AlarmState.PENDING` if it would be normal but its delay runs.

        An alarm that is cleared and not acknowledged stays `AlarmState.CLEARED` while its delay runs again.
        """
        if self.alarm is not None:
            return self.alarm.state
        return AlarmState.NORMAL if self._beyond_since is None else AlarmState.PENDING

    def continue_as(self, point: str, rule: AlarmRule, unit_of_measure: str) -> None:
        """Change the point's name, the limit and the unit of measure of an alarm, and keep its state.

        The new limit holds from the next sample on.
        """
        self.point, self.rule, self.unit_of_measure = point, rule, unit_of_measure
        if self.alarm is not None:
            self.alarm = replace(self.alarm, point=point)

    def take(self, value: SampleValue | None, reason: int, at: int, now: float) -> AlarmEvent | None:
        """Change the state of the alarm by a sample of its point.

        A bad sample, a text or NaN changes nothing but ``reason``.

        Args:
            value: the point's value; None if there is none.
            reason: number of the reason why the sample is not good; 0 for good.
            at: time of the sample, nanoseconds since 1970 UTC.
            now: the same moment in seconds of a monotonic clock; the delay is measured by it.

        Returns:
            The event to write into the journal; None if the alarm is neither raised nor cleared.
        """
        self.reason = reason
        if not isinstance(value, int | float) or math.isnan(value) or quality_of(reason) is Quality.BAD:
            return None
        active = self.state.is_active
        if self.rule.is_beyond(value, active=active):
            return None if active else self._beyond(value, at, now)
        self._beyond_since = None
        return self._moved(AlarmEventKind.CLEARED, at, value) if active else None

    def _beyond(self, value: SampleValue, at: int, now: float) -> AlarmEvent | None:
        if self._beyond_since is None:
            self._beyond_since = now
        if round((now - self._beyond_since - self.rule.delay) * NANOSECONDS) < 0:
            return None
        self._beyond_since = None
        return self._moved(AlarmEventKind.RAISED, at, value)

    def acknowledge(self, by: str, at: int) -> AlarmEvent | None:
        """Acknowledge the alarm and return its event; None if it needs no acknowledgement.

        Args:
            by: who acknowledges it.
            at: time of the acknowledgement, nanoseconds since 1970 UTC.
        """
        return self._moved(AlarmEventKind.ACKNOWLEDGED, at, by=by) if self.state.is_unacknowledged else None

    def _moved(self, kind: AlarmEventKind, at: int, value: SampleValue | None = None, by: str = "") -> AlarmEvent:
        rule = self.rule
        text = rule.text(self.unit_of_measure)
        needs = rule.acknowledge or self.state is AlarmState.CLEARED  # a person still has to, whatever the limit says
        event = AlarmEvent(self.device, self.point, rule.kind, kind, at, value, by, needs, text)
        self.alarm = alarm_after(self.alarm, event)
        return event

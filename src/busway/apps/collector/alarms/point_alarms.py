"""The alarms of all points of a collector, and which sample belongs to which alarm.

Pure: knows devices, points and samples; knows no store and no clock.

1. For a read of points without alarms, `PointAlarms.take` costs one or two look-ups in a dict.
2. If the configuration file is read again, an alarm keeps its state; the new limit holds from the next sample on, and a
   delay that runs goes on. A point that was renamed takes its alarms along; points may exchange their names. If the
   limit of an active or unacknowledged alarm was removed, an event `AlarmEventKind.REMOVED` ends the alarm.
"""

import weakref
from collections.abc import Mapping, Sequence

from ....points.point import Point
from ..point_names import PointKey
from ..samples import PointGroup, SampleBatch
from .events import AlarmEvent, AlarmEventKind, AlarmKey, RaisedAlarm, renamed_key
from .machine import AlarmMachine

_Places = tuple[tuple[int, tuple[AlarmMachine, ...]], ...]
"""The points of one `PointGroup` that have alarms: for each, its position in the group, and its alarms' machines."""


class PointAlarms:
    """The states of all alarms of a collector; passes samples to the alarms of their points.

    Attributes:
        machines: the state machine of each alarm, by device, point and limit.
    """

    def __init__(self) -> None:
        self.machines: dict[AlarmKey, AlarmMachine] = {}
        self._devices: frozenset[str] = frozenset()
        self._places: weakref.WeakKeyDictionary[PointGroup, _Places] = weakref.WeakKeyDictionary()

    def configure(
        self,
        devices: Mapping[str, Sequence[Point]],
        at: int,
        raised: Mapping[AlarmKey, RaisedAlarm] | None = None,
        moved: Mapping[PointKey, str] | None = None,
    ) -> list[AlarmEvent]:
        """Set up the alarms that the points declare; an alarm that was there before keeps its state.

        Args:
            devices: the points of each device.
            at: the present time, nanoseconds since 1970 UTC; the time of the returned events.
            raised: the alarms that the journal shows as active or unacknowledged, by key; given at the start of a
                collector, None later.
            moved: new names of points that were renamed, by device and old name; None if none were.

        Returns:
            An event `AlarmEventKind.REMOVED` for each active or unacknowledged alarm whose limit is gone; an alarm that
            is normal, or whose delay runs, ends without an event.
        """
        before = {renamed_key(key, moved or {}): machine for key, machine in self.machines.items()}
        alarms = dict(raised or {})
        self.machines = {}
        for device, points in devices.items():
            for point in points:
                for rule in point.alarms:
                    key = (device, point.name, rule.kind)
                    machine = before.pop(key, None)
                    if machine is None:
                        machine = AlarmMachine(device, point.name, rule, point.unit_of_measure, alarms.pop(key, None))
                    else:
                        machine.continue_as(point.name, rule, point.unit_of_measure)
                    self.machines[key] = machine
        self._devices = frozenset(device for device, _, _ in self.machines)
        self._places.clear()
        alarms |= {key: machine.alarm for key, machine in before.items() if machine.alarm is not None}
        return [AlarmEvent(*key, AlarmEventKind.REMOVED, at, text=alarm.text) for key, alarm in alarms.items()]

    def take(self, batch: SampleBatch, now: float) -> Sequence[AlarmEvent]:
        """Pass the samples of a read to the alarms of their points, and return the alarm events: raised or cleared.

        Args:
            batch: the samples.
            now: when they were read, seconds of the monotonic clock.

        Returns:
            The events, to be written into the journal; empty if no alarm was raised or cleared.
        """
        group = batch.group
        if group.device not in self._devices:
            return ()
        places = self._places.get(group)
        if places is None:
            places = self._places[group] = self._places_of(group)
        if not places:
            return ()
        reasons = batch.reason_column()
        return [
            event
            for place, machines in places
            for machine in machines
            if (event := machine.take(batch.values[place], reasons[place], batch.time, now)) is not None
        ]

    def _places_of(self, group: PointGroup) -> _Places:
        by_point: dict[str, list[AlarmMachine]] = {}
        for machine in self.machines.values():
            if machine.device == group.device:
                by_point.setdefault(machine.point, []).append(machine)
        return tuple((place, tuple(by_point[point])) for place, point in enumerate(group.points) if point in by_point)

    def acknowledge(self, key: AlarmKey, by: str, at: int) -> AlarmEvent | None:
        """Acknowledge an alarm and return its event; None if there is no such alarm or it needs no acknowledgement.

        Args:
            key: device, point and limit.
            by: who acknowledges it.
            at: time of the acknowledgement, nanoseconds since 1970 UTC.
        """
        machine = self.machines.get(key)
        return None if machine is None else machine.acknowledge(by, at)

"""The alarms of a running collector: lists, acknowledges and follows them, for programs and the page.

Knows the alarms of points, the committer and asyncio; for the thread of the event loop.

1. `CollectorAlarms.active`, `journal`, `counts` and `events` show an event only once it is in the journal of the store.
   `pending` and `reason` show what the last samples were, stored or not.
2. `CollectorAlarms.acknowledge` returns when its event is in the journal.
3. A reader of events that is too slow loses the oldest, which is counted.
"""

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, Callable, Container, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, Protocol, TypeVar

from ....errors import InvalidRequest, Overloaded
from ....points.point import Point
from ..point_names import PointKey
from ..sample_clock import ClockCorrection
from ..samples import NANOSECONDS, SampleBatch
from .events import AlarmEvent, AlarmKey, AlarmState, RaisedAlarm, alarms_after, fold_event
from .point_alarms import PointAlarms

Named = TypeVar("Named", AlarmEvent, RaisedAlarm)


class _Changed(Protocol):
    """Interface of a function that returns a copy of an alarm or alarm event, such as one with another name."""

    def __call__(self, named: Named, /) -> Named: ...


MOST_UNCOMMITTED: Final = 20_000
"""Most events that are remembered until they are committed; beyond it the oldest are forgotten, and are shown later
without renames and corrections of their times. It is above the number of events that wait for a store (`MOST_ALARMS`).
"""

MOST_WAITING: Final = 10_000
"""Most events that wait for one program that follows events; beyond it the oldest are dropped."""
RECENT: Final = 1000
"""How many of the newest events of the journal are kept in memory, for the page."""
ACKNOWLEDGE_WITHIN: Final = 5.0
"""Seconds that `CollectorAlarms.acknowledge` waits for its event to be in the journal."""


class _EventReader:
    """One program that follows alarm events, with the queue of events that it has not read.

    Attributes:
        waiting: the queue; beyond `MOST_WAITING` the oldest events are dropped.
        arrived: set when events were added, or when no more will come.
        lost: number of dropped events.
    """

    def __init__(self) -> None:
        self.waiting: deque[AlarmEvent] = deque(maxlen=MOST_WAITING)
        self.arrived = asyncio.Event()
        self.lost = 0

    def take(self, events: Iterable[AlarmEvent]) -> None:
        for event in events:
            self.lost += len(self.waiting) == MOST_WAITING
            self.waiting.append(event)
        self.arrived.set()


class CollectorAlarms:
    """The alarms of a running collector, as ``collector.alarms``: list, acknowledge, follow.

    Args:
        keep: queues events for the alarm journal and returns at once; `committed` is called when they are in it.
        now: returns seconds of the monotonic clock of the samples.
        wall: returns nanoseconds since 1970 UTC.

    Attributes:
        readers_lost: number of events dropped because programs that follow `events` were too slow; those of a program
            are added when it stops following.
    """

    def __init__(
        self, keep: Callable[[Sequence[AlarmEvent]], None], now: Callable[[], float], wall: Callable[[], int]
    ) -> None:
        self.readers_lost: int = 0
        self._keep, self._now, self._wall = keep, now, wall
        self._alarms_of_points = PointAlarms()
        self._raised: dict[AlarmKey, RaisedAlarm] = {}
        self._journal: deque[AlarmEvent] = deque(maxlen=RECENT)
        self._readers: list[_EventReader] = []
        self._promised: dict[int, tuple[AlarmEvent, asyncio.Future[None]]] = {}
        self._told: dict[int, tuple[AlarmEvent, AlarmEvent]] = {}  # by id: events to be committed, and as to be shown
        self._earlier: frozenset[int] = frozenset()
        self._ended = False

    # What programs use.

    def active(self) -> list[RaisedAlarm]:
        """Return the alarms that are active or not acknowledged yet, in the order in which they were raised."""
        return list(self._raised.values())

    def pending(self) -> list[AlarmKey]:
        """Return device, point and limit of each normal alarm whose value is beyond the limit while its delay runs."""
        return [key for key, machine in self._alarms_of_points.machines.items() if machine.state is AlarmState.PENDING]

    def reason(self, key: AlarmKey) -> int:
        """Return the number of the reason why the last sample of an alarm's point is not good; 0 if it is good.

        0 also if there was no sample since the start, or if there is no alarm limit with this key.
        """
        machine = self._alarms_of_points.machines.get(key)
        return 0 if machine is None else machine.reason

    def journal(self, limit: int = 100) -> list[AlarmEvent]:
        """Return the newest alarm events, newest first: ``limit`` at most, and `RECENT` at most.

        `busway.Store.alarms` has all events.
        """
        return list(self._journal)[: -limit - 1 : -1]

    def counts(self) -> tuple[int, int]:
        """Return how many alarms are active, and how many are not acknowledged; an alarm can count in both numbers."""
        states = [alarm.state for alarm in self._raised.values()]
        return sum(each.is_active for each in states), sum(each.is_unacknowledged for each in states)

    async def acknowledge(self, device: str, point: str, limit: str, by: str) -> AlarmEvent:
        """Acknowledge an alarm; when this returns, the alarm journal has the event.

        If the caller is cancelled, the alarm is acknowledged nevertheless.

        Args:
            device, point: names.
            limit: the kind of the limit: ``HH``, ``H``, ``L``, ``LL`` or ``state``.
            by: who acknowledges it.

        Returns:
            The event.

        Raises:
            InvalidRequest: there is no such alarm, or it needs no acknowledgement now.
            Overloaded: the store could not be written within `ACKNOWLEDGE_WITHIN` seconds. The alarm is acknowledged,
                and the event waits in memory until the store can be written.
        """
        event = self._alarms_of_points.acknowledge((device, point, limit), by, self._wall())
        if event is None:
            raise InvalidRequest(f"there is no alarm {limit} of {device}/{point} to acknowledge")
        self._note([event])
        kept: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._promised[id(event)] = event, kept
        self._keep([event])
        try:
            async with asyncio.timeout(ACKNOWLEDGE_WITHIN):
                await kept
        except TimeoutError:
            raise Overloaded("the store cannot be written now; the acknowledgement waits in memory") from None
        finally:
            self._promised.pop(id(event), None)
        return event

    async def events(self) -> AsyncGenerator[AlarmEvent, None]:
        """Yield alarm events, each once it is in the journal, until the collector ends.

        The first one is the next event after the iteration has begun; the call alone does not begin it. If more than
        `MOST_WAITING` events wait for a program that is too slow, the oldest are dropped, and counted in
        ``readers_lost``.
        """
        reader = _EventReader()
        self._readers.append(reader)
        try:
            while True:
                while reader.waiting:
                    yield reader.waiting.popleft()
                if self._ended:
                    return
                reader.arrived.clear()
                await reader.arrived.wait()
        finally:
            self._readers.remove(reader)
            self.readers_lost += reader.lost

    # What the collector does.

    def begin(self, journal: Sequence[AlarmEvent], devices: Mapping[str, Sequence[Point]]) -> None:
        """At the start of the collector, restore the alarms that the journal shows as active or unacknowledged.

        An alarm whose limit is no longer in the configuration ends with an event `AlarmEventKind.REMOVED`.

        Args:
            journal: all stored alarm events, in the order in which they were stored.
            devices: the points of each device.
        """
        self._raised = alarms_after(journal)
        self._journal.extend(journal)
        self._earlier = frozenset(event.at for event in journal)
        self._record(self._alarms_of_points.configure(devices, self._wall(), self._raised))

    def configure(self, devices: Mapping[str, Sequence[Point]], moved: Mapping[PointKey, str] | None = None) -> None:
        """Continue with the alarm limits of a configuration that was read again; alarms that remain keep their state.

        An active or unacknowledged alarm whose limit is gone ends with an event `AlarmEventKind.REMOVED`.

        Args:
            devices: the points of each device.
            moved: new names of points that were renamed, by device and old name; alarms and events get the new names.
                None if none were renamed.
        """
        moved = moved or {}
        self._show_anew(lambda named: _renamed(named, moved))
        self._record(self._alarms_of_points.configure(devices, self._wall(), moved=moved))

    def take(self, batch: SampleBatch) -> Sequence[AlarmEvent]:
        """Pass the samples of a read to the alarms of their points, and return the alarm events that they cause.

        Empty if they cause none. The caller stores events and samples together.
        """
        events = self._alarms_of_points.take(batch, self._now() - batch.half_width / NANOSECONDS)
        if events:
            self._note(events)
        return events

    def committed(self, events: Sequence[AlarmEvent]) -> None:
        """Show alarm events in `active`, `journal` and `counts`, and hand them to programs that follow `events`.

        Called in the event loop once the events, the same objects that were stored, are in the journal of the store.
        Lets `acknowledge` return if it waits for one of them.
        """
        shown = [self._told.pop(id(event), (event, event))[1] for event in events]
        for event, as_shown in zip(events, shown, strict=True):
            fold_event(self._raised, as_shown)
            promised = self._promised.get(id(event))
            if promised is not None and not promised[1].done():
                promised[1].set_result(None)
        self._journal.extend(shown)
        for reader in self._readers:
            reader.take(shown)

    def mend(self, correction: ClockCorrection) -> None:
        """Correct the times of alarms and events that this process took from a wall clock that was not right yet.

        Times that an earlier process stored are not changed.
        """
        self._show_anew(lambda named: _moved(named, correction, self._earlier))

    def end(self) -> None:
        """End each iteration over `events`, once it has yielded the events that wait for it."""
        self._ended = True
        for reader in self._readers:
            reader.arrived.set()

    def _record(self, events: Sequence[AlarmEvent]) -> None:
        if events:
            self._note(events)
            self._keep(events)

    def _note(self, events: Iterable[AlarmEvent]) -> None:
        """Remember events until they are in the journal, to show them with the names and times that are right then.

        A rename or a clock correction can change these meanwhile. Beyond `MOST_UNCOMMITTED` the oldest are forgotten.
        """
        self._told.update((id(event), (event, event)) for event in events)
        while len(self._told) > MOST_UNCOMMITTED:
            self._told.pop(next(iter(self._told)))

    def _show_anew(self, changed: _Changed) -> None:
        """Replace all alarms and remembered events by the copies that ``changed`` returns for them."""
        self._raised = {each.key: each for each in map(changed, self._raised.values())}
        self._journal = deque(map(changed, self._journal), maxlen=RECENT)
        self._told = {key: (event, changed(shown)) for key, (event, shown) in self._told.items()}


def _renamed(named: Named, moved: Mapping[PointKey, str]) -> Named:
    """Return an alarm or event with the new name of its point, if ``moved`` has one."""
    name = moved.get((named.device, named.point))
    return named if name is None else replace(named, point=name)


def _moved(named: Named, correction: ClockCorrection, earlier: Container[int]) -> Named:
    """Return an alarm or event with its times corrected, as far as they were taken from a wrong wall clock.

    Args:
        named: the alarm or event.
        correction: which times are wrong, and by how much.
        earlier: times that an earlier process stored, nanoseconds since 1970 UTC; these are not changed.
    """
    names = ("at",) if isinstance(named, AlarmEvent) else ("since", "acknowledged_at", "cleared_at")
    found = {name: getattr(named, name) for name in names}
    mine = {name: at for name, at in found.items() if at is not None and at not in earlier}
    right: dict[str, Any] = {name: correction.corrected(at) for name, at in mine.items()}  # of the fields named
    return named if right == mine else replace(named, **right)

"""``/stream`` of a collector's page: a WebSocket that sends changed values, alarms and commands to all viewers.

A viewer is one open page. Knows viewers and which points they show; knows no store. Values come from `live_values`.

1. There are at most two ticks a second, and in each the changes are sent. Changes are collected and encoded once, in a
   worker thread, for all viewers that were sent the same tick last. A viewer that is still taking its last message is
   left out; its next message has all that it missed.
2. A viewer says which points it shows, at most `MOST_SHOWN`. The registers of these points are sent to it alone. Those
   that are read rarely are read every `LEASED_PERIOD` seconds, with priority over regular polling, as long as they are
   shown, unless their link has no time for it.
3. Everything has a limit: the viewers, the points that each shows, the events that wait, the seconds in which a viewer
   must take a message.
4. A viewer is sent its name and role first. Once its token is removed or has another role, its WebSocket is closed
   within a tick, and nothing is sent to it after that; the page then connects again.
"""

import asyncio
import contextlib
import json
import logging
import secrets
import time
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Final

from pydantic import Field, ValidationError
from starlette.websockets import WebSocket

from ...errors import ConfigError
from ..collector.admission import MOST_LOAD
from ..collector.collector import Collector
from ..collector.commands.command import CommandResult
from ..collector.store.writer import Commit
from .live_values import LiveValues
from .messages import Asked, plain_value
from .request_guard import Caller, caller_of
from .viewers import Gone, accept, check, converse, send

TICK: Final = 0.5
"""Seconds between two ticks: shortest time between two messages with values to the same viewer."""
MOST_SHOWN: Final = 200
MOST_EVENTS: Final = 256
"""Most events that may wait to be sent to a viewer; with more, the oldest are dropped. The page can get all by HTTP."""
LEASED_PERIOD: Final = 1.0
LEASE_SECONDS: Final = 10.0
_LEASE_EVERY: Final = 4.0
_MILLION: Final = 1_000_000
_REVISIONS: Final = 1 << 30

_log = logging.getLogger("busway.apps.web")


class Shown(Asked):
    """Message from an open page: which points it shows from now on, by their positions in ``/api/points``."""

    shown: Annotated[list[Annotated[int, Field(ge=0)]], Field(max_length=MOST_SHOWN)]


class Viewer:
    """One collector page open in a browser: its caller, what it was sent, and which points it shows.

    Attributes:
        caller: name and role, as they were when the WebSocket was opened.
        seen: the tick up to which changes were sent; -1: the next message has all values, as the list of points is new.
        revision: the revision of the list of points that the viewer was sent last; -1 before the first message.
        shown: positions of the points that the page shows.
        told: by position of a shown point, its registers as sent last.
        alarms: the numbers of active and of unacknowledged alarms, as sent last.
        events: events that wait to be sent, as JSON texts, the oldest first.
        message: the message with values that waits to be sent, as a JSON text; empty if there is none.
        is_sending: whether a message with values waits or is being sent; no other is made meanwhile.
        wake: set when there is a message or an event to send, and in each tick.
    """

    def __init__(self, caller: Caller) -> None:
        self.caller: Caller = caller
        self.seen: int = 0
        self.revision: int = -1
        self.shown: tuple[int, ...] = ()
        self.told: dict[int, bytes] = {}
        self.alarms: tuple[int, int] = (0, 0)
        told = {"caller": {"name": caller.name, "role": caller.role.label}}
        self.events: deque[str] = deque([json.dumps(told, ensure_ascii=False)], maxlen=MOST_EVENTS)
        self.message: str = ""
        self.is_sending: bool = False
        self.wake: asyncio.Event = asyncio.Event()


class CollectorStream:
    """The WebSockets of all open pages of one collector.

    Args:
        collector: the running collector.

    Attributes:
        values: the last values of the collector's points.
        revision: number of the list of points; it differs after each change of the list and after each start.
        points: device and name of each point, in the order of ``/api/points``.
    """

    def __init__(self, collector: Collector) -> None:
        self._collector = collector
        self._viewers: list[Viewer] = []
        self._ticker: asyncio.Task[None] | None = None
        self._leased_at = 0.0
        self.revision: int = secrets.randbelow(_REVISIONS)
        self._configuration = collector.configuration
        self.points: list[tuple[str, str]] = _points_of(collector)
        self.values: LiveValues = self._made()
        collector.subscribe(self._committed)
        self._begin()
        collector.commands.subscribe(self._queue_command)

    def __len__(self) -> int:
        return len(self._viewers)

    def _made(self) -> LiveValues:
        last = self._collector.values
        return LiveValues(self.points, last.is_behind, last.limits)

    def _begin(self) -> None:
        """Take over the last values of the collector. Call this once `values` gets commits, so that none is missed."""
        last = self._collector.values
        self.values.begin(last.reads(), last.intervals())

    def _committed(self, commit: Commit) -> None:
        self.values.update(commit)

    def refresh(self) -> LiveValues:
        """Return the last values of all points, after taking over the collector's configuration if that was replaced.

        If the new configuration has another list of points, `points`, `values` and `revision` are new; otherwise only
        the limits are.
        """
        if self._collector.configuration is not self._configuration:
            self._configuration = self._collector.configuration
            points = _points_of(self._collector)
            if points != self.points:
                self.points = points
                self.values = self._made()
                self._begin()
                self.revision += 1
            else:
                self.values.set_limits(self._collector.values.limits)
        return self.values

    def queue_event(self, kind: str, content: Mapping[str, Any]) -> None:  # Any: JSON
        """Queue an event for all open pages. Call it in the event loop's thread.

        Args:
            kind: the kind of event, such as ``command``: the only key of the JSON message.
            content: the value of that key.
        """
        if self._viewers:
            text = json.dumps({kind: content}, ensure_ascii=False, separators=(",", ":"))
            for viewer in self._viewers:
                viewer.events.append(text)
                viewer.wake.set()

    def _queue_command(self, result: CommandResult) -> None:
        command = result.command
        self.queue_event(
            "command",
            {
                "key": command.key,
                "at": result.at,
                "by": command.by,
                "device": command.device,
                "point": command.point,
                "value": plain_value(command.value),
                "state": result.state.value,
            },
        )

    def _queue_alarms(self) -> None:
        """Queue the numbers of active and unacknowledged alarms for each open page that was sent other numbers last."""
        counts = self._collector.alarms.counts()
        content = {"alarms": {"active": counts[0], "unacknowledged": counts[1]}}
        for viewer in self._viewers:
            if viewer.alarms != counts:
                viewer.alarms = counts
                viewer.events.append(json.dumps(content))
                viewer.wake.set()

    async def serve(self, socket: WebSocket) -> None:
        """Serve the WebSocket of one open page until it ends; close it at once if there are `MOST_VIEWERS` already."""
        if not await accept(socket, len(self._viewers)):
            return
        viewer = Viewer(caller_of(socket.scope))
        self._viewers.append(viewer)
        if self._ticker is None:
            self._ticker = asyncio.create_task(self._tick(), name="busway page ticks")
            self._ticker.add_done_callback(self._ticks_ended)
        try:
            await converse(socket, _send(socket, viewer), lambda text: self._take(viewer, text))
        finally:
            self._viewers.remove(viewer)
            if not self._viewers and self._ticker is not None:
                ticker, self._ticker = self._ticker, None
                ticker.cancel()
                await asyncio.gather(ticker, return_exceptions=True)

    def _ticks_ended(self, task: "asyncio.Task[None]") -> None:
        if not task.cancelled() and task.exception() is not None:
            _log.error(
                "values are no longer sent to the page; the next viewer begins that anew", exc_info=task.exception()
            )
            self._ticker = None

    def _take(self, viewer: Viewer, text: str) -> str:
        """Store which points a page shows, from its message. Returns why the message is refused; empty if it is not.

        Positions beyond the list of points are left out.
        """
        try:
            wanted = Shown.model_validate_json(text)
        except ValidationError:
            return f'expected {{"shown": [at most {MOST_SHOWN} places]}}'
        count = len(self.points)
        viewer.shown = tuple(place for place in wanted.shown if place < count)
        self._leased_at = 0.0
        return ""

    async def _tick(self) -> None:
        while True:
            values, revision = self.refresh(), self.revision
            await asyncio.to_thread(values.advance)
            ready = [viewer for viewer in self._viewers if not viewer.is_sending]
            for viewer in ready:
                if viewer.revision != revision:
                    viewer.seen, viewer.revision, viewer.told = -1, revision, {}
            tick = values.tick  # before the texts: what a tick meanwhile adds to them is sent again, and not missed
            texts = {seen: await asyncio.to_thread(values.since, seen) for seen in {each.seen for each in ready}}
            now = time.time_ns() // _MILLION
            for viewer in ready:
                raw = self._raw(viewer) if viewer.shown else {}
                if viewer.seen < tick or raw:
                    raw_text = f',"raw":{json.dumps(raw)}' if raw else ""
                    viewer.message = f'{{"now":{now},"revision":{revision},{texts[viewer.seen]}{raw_text}}}'
                    viewer.seen = tick
                    viewer.is_sending = True
                    viewer.wake.set()
            self._queue_alarms()
            self._lease()
            for viewer in self._viewers:
                viewer.wake.set()  # rule 4 holds where nothing changes, too
            await asyncio.sleep(TICK)

    # What is shown.

    def _raw(self, viewer: Viewer) -> dict[int, str]:
        """Return the registers of shown points that differ from those sent last, as hexadecimal text by position.

        Records these registers as sent. Bits, computed points and points that were not read yet have no registers.
        """
        found: dict[int, str] = {}
        for device, places in self._by_device(viewer.shown).items():
            try:
                registers = self._collector.registers_of(device, places)
            except ConfigError:  # it has gone, and the next tick knows that
                continue
            for name, place in places.items():
                data = registers.get(name)
                if data is not None and viewer.told.get(place) != data:
                    viewer.told[place] = data
                    found[place] = data.hex(" ", 2).upper()
        if len(viewer.told) > 10 * MOST_SHOWN:
            viewer.told = {place: viewer.told[place] for place in viewer.shown if place in viewer.told}
        return found

    def _by_device(self, places: Iterable[int]) -> dict[str, dict[str, int]]:
        found: dict[str, dict[str, int]] = {}
        for place in places:
            device, point = self.points[place] if place < len(self.points) else ("", "")
            if device:
                found.setdefault(device, {})[point] = place
        return found

    def _lease(self) -> None:
        """Make the collector read points that it reads rarely every second, while open pages show them.

        Called in each tick; asks the collector for this again every 4 seconds. Points on links that are too busy are
        left out.
        """
        now = time.monotonic()
        if now - self._leased_at < _LEASE_EVERY:
            return
        self._leased_at = now
        configuration, loads = self._collector.configuration, self._collector.loads()
        for device, points in self._by_device({place for each in self._viewers for place in each.shown}).items():
            known = configuration.devices.get(device)
            if known is None or loads.get(known.link, (1.0, 0.0))[0] > MOST_LOAD:
                continue
            slow = [name for name, period in configuration.periods.items() if period > LEASED_PERIOD]
            rare = [point.name for each in slow for point in known.items.get(each, ()) if point.name in points]
            if rare:
                with contextlib.suppress(ConfigError):  # it has gone
                    self._collector.watch(device, rare, period=LEASED_PERIOD, seconds=LEASE_SECONDS)


def _points_of(collector: Collector) -> list[tuple[str, str]]:
    return [(device.name, point.name) for device in collector.configuration.devices.values() for point in device.points]


async def _send(socket: WebSocket, viewer: Viewer) -> None:
    try:
        while True:
            await viewer.wake.wait()
            viewer.wake.clear()
            await check(socket)
            if viewer.message:
                text, viewer.message = viewer.message, ""
                await send(socket, text)
                viewer.is_sending = False
            while viewer.events:
                await send(socket, viewer.events.popleft())
    except Gone:
        viewer.shown = ()

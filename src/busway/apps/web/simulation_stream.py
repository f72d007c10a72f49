"""``/stream`` of a simulation's page: a WebSocket that sends changes to viewers as JSON texts.

A viewer is one open page. Knows viewers and what they subscribed to; knows no page.

1. A viewer sends what it wants to follow (`Wish`), as often as it likes, and is first sent the present state of that.
   So after a lost connection it asks again, and misses nothing.
2. A viewer is sent at most ten messages a second. A point that changed several times is sent once, with its present
   value.
3. Modbus frames come from the latest ones that are kept (`simulation_traffic`). Frames that come faster than a viewer
   takes them are skipped and counted, so no queue grows. A viewer that takes nothing at all is closed.
4. The simulation is watched only while there are viewers.
"""

import asyncio
import contextlib
import json
import threading
import time
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Final, Literal

from pydantic import Field, ValidationError
from starlette.websockets import WebSocket

from .messages import Asked, plain_value
from .simulation_api import Api
from .viewers import Gone, accept, converse, send

INTERVAL: Final = 0.1
"""Shortest time in seconds between two messages to one viewer."""
STATUS_INTERVAL: Final = 1.0
POINTS_AT_ONCE: Final = 4000
"""Most points in one message; the others come with the next message."""
MOST_POINTS: Final = 5000
"""Most points that one viewer may follow. A page shows fewer; to follow all points of a large simulation would slow the
simulation down.
"""
FRAMES_AT_ONCE: Final = 50

Index = Annotated[int, Field(ge=0)]


class Wish(Asked):
    """Message from an open page: what it wants to be sent from now on; a key that is left out stays unchanged.

    Attributes:
        points: numbers of the points to follow (``index`` in ``/api/points``), or ``all``.
        traffic: whether Modbus frames are wanted.
        after: number of the last frame that the page has; only later frames are sent. Without it, the latest 50 frames
            are sent first when frames are switched on.
    """

    points: Literal["all"] | Annotated[list[Index], Field(max_length=MOST_POINTS)] | None = None
    traffic: bool | None = None
    after: Index | None = None


class SimulationViewer:
    """One open page's WebSocket: what the page wants, and the changes that it was not sent yet.

    Attributes:
        skipped: number of Modbus frames that were not sent because the page was too slow.
    """

    def __init__(self, api: Api) -> None:
        self._api = api
        self._changed: dict[int, None] = {}
        self._points: frozenset[int] = frozenset()
        self._wants_all = False
        self._wants_traffic = False
        self._seen = api.traffic.last
        self._has_switched = True
        self._status_due = 0.0
        self._wake = asyncio.Event()
        self.skipped: int = 0

    def wish(self, wish: Wish) -> str:
        """Apply a message with what the page wants to be sent. Returns why the message is refused; empty if it is not.

        A refused message changes nothing.
        """
        count = len(self._api.order)
        if wish.points == "all":
            if count > MOST_POINTS:
                return f"at most {MOST_POINTS} points can be followed, and there are {count}"
            self._wants_all = True
            self._changed = dict.fromkeys(range(count))
        elif wish.points is not None:
            unknown = next((index for index in wish.points if index >= count), None)
            if unknown is not None:
                return f"there is no point number {unknown}"
            self._wants_all = False
            fresh = frozenset(wish.points)
            kept = {index: None for index in self._changed if index in fresh}
            self._changed = kept | dict.fromkeys(index for index in wish.points if index not in self._points)
            self._points = fresh
        if wish.traffic is not None:
            if wish.traffic and not self._wants_traffic and wish.after is None:
                self._seen = max(self._api.traffic.last - FRAMES_AT_ONCE, 0)
            self._wants_traffic = wish.traffic
        if wish.after is not None:
            self._seen = min(wish.after, self._api.traffic.last)
        self._wake.set()
        return ""

    # What happens, told by the hub.

    def changed(self, indices: Sequence[int]) -> None:
        """Queue changed points to be sent to the page; points that the page does not follow are left out.

        Args:
            indices: numbers of the points (``index`` in ``/api/points``).
        """
        if self._wants_all:
            self._changed.update(dict.fromkeys(indices))
        else:
            points = self._points
            self._changed.update({index: None for index in indices if index in points})
        if self._changed:
            self._wake.set()

    def passed(self) -> None:
        """Note that a Modbus frame was recorded; it is sent to the page if the page wants frames."""
        if self._wants_traffic:
            self._wake.set()

    def switched(self) -> None:
        """Note that a fault was added, removed or switched; all faults are then sent to the page."""
        self._has_switched = True
        self._wake.set()

    # What is sent.

    async def next(self) -> dict[str, Any]:  # Any: JSON
        """Wait for the next message to the page, and return it as a JSON object; it counts as sent from then on.

        Every `STATUS_INTERVAL` seconds a message has the status, also if nothing has changed.
        """
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(max(self._status_due - time.monotonic(), 0.0)):
                    await self._wake.wait()
            self._wake.clear()
            message = self._message()
            if message:
                return message

    def _message(self) -> dict[str, Any]:
        message: dict[str, Any] = {}
        if self._changed:
            message["points"] = [self._point(index) for index in self._take()]
        if self._wants_traffic and self._seen < self._api.traffic.last:
            message |= self._frames()
        now = time.monotonic()
        is_due = now >= self._status_due
        if is_due or self._has_switched:
            self._has_switched = False
            message["faults"] = [one.model_dump(mode="json") for one in self._api.faults()]
        if is_due:
            self._status_due = now + STATUS_INTERVAL
            message["status"] = self._api.status()
        if message:
            message["time"] = time.time()
        return message

    def _take(self) -> list[int]:
        taken = list(self._changed)[:POINTS_AT_ONCE]
        if len(taken) == len(self._changed):
            self._changed = {}
        else:
            for index in taken:
                del self._changed[index]
            self._wake.set()
        return taken

    def _point(self, index: int) -> list[Any]:
        point = self._api.order[index]
        return [index, plain_value(point.value), point.raw, point.changed_at, point.last_writer, point.is_held]

    def _frames(self) -> dict[str, Any]:
        tail = self._api.traffic
        frames = tail.after(self._seen, FRAMES_AT_ONCE)
        if frames:  # what another thread adds meanwhile is sent next
            self.skipped += frames[0].number - self._seen - 1
            self._seen = frames[-1].number
        return {"traffic": [tail.shown(one).model_dump(mode="json") for one in frames], "skipped": self.skipped}


class Streams:
    """The WebSockets of all open pages of a simulation; watches the simulation while there are any.

    Args:
        api: the simulation's HTTP API, which gives the values that are sent.
    """

    def __init__(self, api: Api) -> None:
        self._api = api
        self._viewers: list[SimulationViewer] = []
        self._unwatch: list[Callable[[], object]] = []
        self._thread = 0
        self._loop: asyncio.AbstractEventLoop | None = None

    def __len__(self) -> int:
        return len(self._viewers)

    async def serve(self, socket: WebSocket) -> None:
        """Serve the WebSocket of one open page until it ends; close it at once if there are `MOST_VIEWERS` already."""
        if not await accept(socket, len(self._viewers)):
            return
        viewer = SimulationViewer(self._api)
        self._join(viewer)
        try:
            await converse(socket, _send(socket, viewer), lambda text: _take(viewer, text))
        finally:
            self._leave(viewer)

    # Watching the simulation.

    def _join(self, viewer: SimulationViewer) -> None:
        self._viewers.append(viewer)
        if len(self._viewers) == 1:
            self._loop = asyncio.get_running_loop()
            self._thread = threading.get_ident()
            self._unwatch = [
                self._api.subject.watch(self._changed),
                self._api.traffic.watch(self._passed),
                self._api.switchboard.watch(self._switched),
            ]

    def _leave(self, viewer: SimulationViewer) -> None:
        self._viewers.remove(viewer)
        if not self._viewers:
            for unwatch in self._unwatch:
                unwatch()
            self._unwatch = []

    def _changed(self, changes: Sequence[Any]) -> None:
        places = self._api.places
        indices = [places[change.key] for change in changes]
        self._for_each_viewer(lambda viewer: viewer.changed(indices))

    def _passed(self) -> None:
        self._for_each_viewer(SimulationViewer.passed)

    def _switched(self) -> None:
        self._for_each_viewer(SimulationViewer.switched)

    def _for_each_viewer(self, say: Callable[[SimulationViewer], None]) -> None:
        """Call a function with each open page's `SimulationViewer`, in the event loop's thread.

        From another thread, the call is only scheduled.
        """
        if threading.get_ident() == self._thread:
            self._say(say)
        elif self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._say, say)

    def _say(self, say: Callable[[SimulationViewer], None]) -> None:
        for viewer in self._viewers:
            say(viewer)


def _take(viewer: SimulationViewer, text: str) -> str:
    try:
        return viewer.wish(Wish.model_validate_json(text))
    except ValidationError:
        return "invalid request; expected keys: points, traffic, after"


async def _send(socket: WebSocket, viewer: SimulationViewer) -> None:
    with contextlib.suppress(Gone):
        while True:
            text = json.dumps(await viewer.next(), ensure_ascii=False, separators=(",", ":"), allow_nan=False)
            await send(socket, text)
            await asyncio.sleep(INTERVAL)

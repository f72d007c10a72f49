"""The connections of the page: how many there may be, and how long one may take to say what it wants.

Knows connections of the HTTP server and their limits; knows nothing of what is asked.

1. From its beginning, or from the first byte of a further request, a connection has `HEAD_SECONDS` to the end of the
   head. Who it is, is known then, and no sooner.
2. There are at most `MOST` connections, WebSockets included. A newcomer takes the place of the oldest that has not said
   what it wants; where all have, it is closed.
3. The last descriptors of the process are Modbus': a newcomer that has got one of them is closed.
4. What happens again and again is logged once a minute, with how often.
"""

import asyncio
import logging
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from ...access.repeats import Repeats, so_often
from ...transport.descriptors import is_reserved

HEAD_SECONDS: Final = 5.0
MOST: Final = 100

_log = logging.getLogger("busway.apps.web")


class Throttle(logging.Filter):
    """Lets each sentence through once a minute, and says how often it was held back."""

    def __init__(self) -> None:
        super().__init__()
        self._repeats = Repeats()

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether it is said now."""
        sentence = record.getMessage()
        repeated = self._repeats.again(sentence, time.monotonic())
        if repeated is None:
            return False
        record.msg, record.args = sentence + so_often(repeated), ()
        return True


_http_log = logging.getLogger("busway.apps.web.http")
"""What the HTTP server has to say: whoever sends nonsense makes it say the same again and again."""
_http_log.addFilter(Throttle())


class Doors:
    """What the connections of one page have in common.

    Attributes:
        waiting: those that have not said what they want, in the order they came.
    """

    def __init__(self) -> None:
        self.waiting: dict[PageConnection, None] = {}
        self._repeats = Repeats()

    def protocols(self) -> Callable[..., asyncio.Protocol]:
        """What makes the protocol of a newcomer; takes what uvicorn gives."""
        return partial(PageConnection, self)

    def say(self, sentence: str, *arguments: object) -> None:
        """Log something that may come again and again."""
        repeated = self._repeats.again(sentence, time.monotonic())
        if repeated is not None:
            _log.warning(f"{sentence}%s", *arguments, so_often(repeated))


class PageConnection(H11Protocol):
    """A connection of the page, until it becomes a WebSocket.

    Args:
        doors: what it shares with the others.
        given: what uvicorn gives.
    """

    def __init__(self, doors: Doors, **given: Any) -> None:
        super().__init__(**given)
        self.logger: logging.Logger = _http_log
        self._doors = doors
        self._timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accepted: see whether there is room."""
        super().connection_made(transport)
        accepted = transport.get_extra_info("socket")
        if accepted is not None and is_reserved(accepted.fileno()):
            self._doors.say("a connection to the page is closed: the last file handles are kept for Modbus")
            transport.abort()
            return
        while len(self.connections) > MOST:
            oldest = next(iter(self._doors.waiting), None)
            if oldest is None:
                self._doors.say("a connection to the page is closed: there are %d already", MOST)
                transport.abort()
                return
            self._doors.say("a connection to the page has made room: it had not said what it wants, and %d stand", MOST)
            oldest.close_unheard()
        self._wait()

    def data_received(self, data: bytes) -> None:
        """Bytes have come."""
        super().data_received(data)
        if self.transport.is_closing() or self.conn.their_state is not h11.IDLE:
            self._heard()
        elif self._timer is None and self.conn.trailing_data[0]:
            self._wait()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """It becomes a WebSocket."""
        self._heard()
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """It has ended."""
        self._heard()
        super().connection_lost(exc)

    def close_unheard(self) -> None:
        """Close it before it has said what it wants."""
        self._heard()
        self.connections.discard(self)
        self.transport.abort()

    def _wait(self) -> None:
        self._doors.waiting[self] = None
        self._timer = self.loop.call_later(HEAD_SECONDS, self._too_slow)

    def _heard(self) -> None:
        self._doors.waiting.pop(self, None)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _too_slow(self) -> None:
        self._doors.say("a connection to the page is closed: it has not said within %g s what it wants", HEAD_SECONDS)
        self.close_unheard()

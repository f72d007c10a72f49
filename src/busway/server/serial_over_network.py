"""Server sessions for RTU or ASCII frames over TCP or UDP, used by connections like the MBAP session.

Knows a session and a clock; knows no connection: `ServerConnection` drives it like `TcpServerSession`.

1. Answers leave at once: the converter keeps the silences on its wire.
2. Where silence ends a frame (Serial Line V1.02 §2.5.1.1), the session has a timer of its own for it.
3. One call processes at most `SHARE_OF_BYTES`. The bytes after them wait in ``rest``; they keep the time at which they
   arrived, so the time that they wait is not taken for silence.
"""

import asyncio
import time
from collections.abc import Callable, Container, Sequence
from typing import Final

from ..session.diagnostic_counters import LineDiagnostics
from ..session.line_framing import LineFraming
from ..session.responder import ClientIdentity
from ..session.serial_server import FrameToSend, SerialServerSession
from ..session.server_pipeline import RequestPipeline, ResponderFailure
from ..session.tcp_server import Deferred, TcpServerSession

SHARE_OF_BYTES: Final = 520
"""Most bytes that one call processes: the longest frame in ASCII, or 65 whole reads in RTU."""


class SerialOverNetworkSession:
    """The server session of one connection that carries RTU or ASCII frames.

    Attributes:
        broken: always empty: after a damaged frame the next one may be good, so the connection stays open.
        refused_busy: always 0: a line has one transaction at a time.
        rest: received bytes that are not processed yet.
        spent: estimate of how many requests the last call of `receive` or `go_on` has processed: its bytes / 16.
    """

    __slots__ = (
        "_attend",
        "_came",
        "_deliver",
        "_loop",
        "_session",
        "_timer",
        "broken",
        "refused_busy",
        "rest",
        "spent",
    )

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        pipeline: RequestPipeline,
        units: Container[int],
        *,
        framing: LineFraming,
        diagnostics: LineDiagnostics,
        deliver: Callable[[bytes], None],
        attend: Callable[[], None],
        client: ClientIdentity,
    ) -> None:
        """Create the session of a new connection.

        Args:
            deliver: called with each reply that is ready only after `receive` or `go_on` has returned.
            attend: called without arguments when ``deferred`` or ``failures`` may have got an entry without new bytes.
            loop: event loop of the session's timer.
            pipeline, units, framing, diagnostics, client: as in `SerialServerSession`.
        """
        self._loop = loop
        self._deliver = deliver
        self._attend = attend
        self._session = SerialServerSession(
            pipeline,
            units,
            framing=framing,
            diagnostics=diagnostics,
            deliver=self._late,
            client=client,
            sends_at_once=True,
        )
        self._timer: asyncio.TimerHandle | None = None
        self._came = 0.0
        self.broken: str = ""
        self.refused_busy: int = 0
        self.rest: bytes = b""
        self.spent: int = 0

    # What a driver asks, as of `TcpServerSession`.

    @property
    def waiting(self) -> int:
        """Number of received requests that have no reply yet."""
        return self._session.waiting

    @property
    def unfinished(self) -> int:
        """Number of bytes of an incomplete frame; always 0, because the RTU or ASCII receiver discards them itself."""
        return 0

    @property
    def requests(self) -> int:
        """Number of requests to units of this server so far."""
        return self._session.requests

    @property
    def discarded(self) -> int:
        """Number of damaged frames, and of frames for other units, so far."""
        return self._session.foreign + self._session.damaged_frames

    @property
    def deferred(self) -> list[Deferred]:
        """Replies of responders that need time, which the connection must await."""
        return self._session.deferred

    @deferred.setter
    def deferred(self, value: list[Deferred]) -> None:
        self._session.deferred = value

    @property
    def failures(self) -> Sequence[ResponderFailure]:
        """Exceptions raised by responders, which the connection must log."""
        return self._session.failures

    @failures.setter
    def failures(self, value: Sequence[ResponderFailure]) -> None:
        self._session.failures = list(value)

    def receive(self, buffer: bytes | bytearray, size: int) -> list[bytes]:
        """Process the first ``size`` bytes of ``buffer``. Returns the replies to send, in order.

        If they are more than `SHARE_OF_BYTES`, or ``rest`` is not empty, they are added to ``rest``, and only the first
        `SHARE_OF_BYTES` of it are processed; call `go_on` for the others.
        """
        if self.rest or size > SHARE_OF_BYTES:
            self.put_off(buffer, size)
            return self.go_on()
        self.spent = size // 16
        data, now = bytes(memoryview(buffer)[:size]), time.monotonic()
        known = self._session.answer_known(data, now)
        if known is not None:
            return known
        found = self._session.find(data, now)
        emissions = [*filter(None, map(self._session.process, found))]
        self._rearm()
        return [one.frame for one in emissions]

    def put_off(self, buffer: bytes | bytearray, size: int) -> None:
        """Keep the first ``size`` bytes of ``buffer`` unprocessed, in ``rest``, until `go_on` is called."""
        self._stop_timer()  # they came before the silence was over
        self._came = time.monotonic()
        self.rest += bytes(memoryview(buffer)[:size])

    def go_on(self) -> list[bytes]:
        """Process the first `SHARE_OF_BYTES` of ``rest``; returns the replies to send, in order."""
        share, self.rest = self.rest[:SHARE_OF_BYTES], self.rest[SHARE_OF_BYTES:]
        self.spent = len(share) // 16
        known = self._session.answer_known(share, self._came)
        if known is not None:
            return known
        emissions = self._session.receive(share, self._came)
        if not self.rest:
            self._rearm()
        return [one.frame for one in emissions]

    def close(self) -> None:
        """End the session with its connection: discard queued bytes and stop the timer."""
        self.rest = b""
        self._stop_timer()
        self._session.close()

    # Inside.

    def _late(self, emission: FrameToSend) -> None:
        self._deliver(emission.frame)

    def _rearm(self) -> None:
        if self._timer is not None:
            self._stop_timer()
        deadline = self._session.deadline()
        if deadline is not None:
            self._timer = self._loop.call_later(max(deadline - time.monotonic(), 0.0), self._on_timer)

    def _on_timer(self) -> None:
        for emission in self._session.tick(time.monotonic()):
            self._deliver(emission.frame)
        self._attend()
        self._rearm()

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


Session = TcpServerSession | SerialOverNetworkSession
"""The server session of a network connection: for MBAP, or for RTU and ASCII. Drivers use both classes alike."""

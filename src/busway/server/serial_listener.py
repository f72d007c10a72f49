"""A serial port as a listener: the asyncio driver between a port and the session of its line.

Knows when bytes come and go; knows nothing of what they mean.

1. A port that is absent, or vanishes, is waited for and opened again; the listener stays.
2. A reply is sent when the line has been silent for t3.5, to the microsecond with ``precise_timing``. If another
   station sends before that, the reply is dropped.
3. Times are those of ``time.monotonic``, as the port tells them.
"""

import asyncio
import contextlib
import errno
import logging
import time
from collections.abc import Container
from dataclasses import replace
from typing import Final

from ..errors import LinkDown
from ..observe.connection_trace import ConnectionTrace, trace_for
from ..observe.trace import TRACE
from ..session.diagnostic_counters import LineDiagnostics
from ..session.responder import ClientIdentity
from ..session.serial_server import FrameToSend, SerialServerSession
from ..session.server_pipeline import RequestPipeline
from ..transport.serial.connection import SerialConnection
from ..transport.serial.exact_timer import ExactTimer
from ..transport.serial.overruns import Overruns
from ..transport.serial.port_claims import PortClaim
from ..transport.serial.reopen import ReopenPolicy, open_when_there
from .connection_tap import ConnectionTap, TappedConnection, do_not_close
from .listener_settings import ListenerSettings
from .responder_failures import begin_late_answers, report_failures
from .server_counters import ServerCounters
from .status import ListenerStatus
from .status_indicators import Diagnosis

_log = logging.getLogger("busway.server")

SPIN: Final = 0.0003
"""Seconds of busy waiting before an answer with ``precise_timing``: a sleeping processor wakes up late by this much."""
COARSE_SPIN: Final = 0.0015
"""Seconds of busy waiting where there are only the timers of the event loop, which are up to one millisecond late."""

_NOT_THERE: Final = frozenset({errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.EIO})


class SerialListener:
    """A serial port on which a server answers the requests to its units.

    Attributes:
        name: URL of the endpoint.
        diagnostics: counters and modes of the units of the line.
        diagnosis: when the line last had traffic and faults; its status indicators follow from that.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        settings: ListenerSettings,
        pipeline: RequestPipeline,
        units: Container[int],
        *,
        counters: ServerCounters,
        changes_allowed: bool,
        tap: ConnectionTap | None = None,
    ) -> None:
        assert settings.port is not None
        self.name: str = settings.endpoint.url
        self.diagnostics: LineDiagnostics = LineDiagnostics(changes_allowed=changes_allowed)
        self.diagnostics.ascii_delimiter = settings.framing.delimiter
        self.diagnosis: Diagnosis = Diagnosis()
        self._loop = loop
        self._settings = settings
        self._port = settings.port
        self._counters = counters
        self._tap = tap
        framing = settings.line_framing(units, pipeline.functions, started=time.monotonic())
        self._tapped = TappedConnection(
            self.name, self.name, settings.endpoint.framing, "serial", framing.send_gap, self.transmit, do_not_close
        )
        self._session = SerialServerSession(
            pipeline,
            units,
            framing=framing,
            diagnostics=self.diagnostics,
            deliver=self._late_answer,
            client=ClientIdentity(self.name, self.name),
        )
        self._connection: SerialConnection | None = None
        self._claim: PortClaim | None = None
        self._opening: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._pending: FrameToSend | None = None
        self._emission_timer: ExactTimer | None = None
        self._silence_timer: asyncio.TimerHandle | None = None
        self._spin = 0.0
        self._echo_is_logged = False
        self._overruns: Overruns | None = None
        self._trace: ConnectionTrace | None = None

    # Life.

    async def open(self) -> None:
        """Open the serial port; if it is absent, wait for it in the background.

        Raises:
            LinkDown: the port is in use (the message names the holder), or this user may not open it.
            ConfigError: it is no serial port, does not support the settings, or is in use in this process.
        """
        self._claim = PortClaim(self._settings.endpoint.path, "busway.serve")
        self._emission_timer = ExactTimer(self._emit)
        if self._settings.opening.precise_timing:
            self._spin = SPIN if self._emission_timer.exact else COARSE_SPIN
        try:
            await self._open_once()
        except LinkDown as error:
            if not _may_come(error):
                self._release()
                raise
            _log.warning("%s: %s; waiting for it", self.name, error.message)
            self._reopen()
        except BaseException:
            self._release()
            raise

    def take_no_more(self) -> None:
        """Accept no further request on the line; the reply to the last one is still sent."""
        self._session.take_no_more()

    async def close(self) -> None:
        """Close the port.

        A reply that waits for the silence of the line is sent first; requests in progress get no reply.
        """
        if self._pending is not None:
            await asyncio.sleep(max(self._pending.not_before - time.monotonic(), 0.0))
            if self._pending is not None:  # or the timer was sooner, or another station has spoken
                self._emit()
        if self._opening is not None:
            self._opening.cancel()
            await asyncio.gather(self._opening, return_exceptions=True)
            self._opening = None
        connection, self._connection = self._connection, None
        late = [*self._tasks]
        self._ended()
        await asyncio.gather(*late, return_exceptions=True)
        if connection is not None:
            connection.close()
            await connection.wait_closed()
        self._release()

    def _release(self) -> None:
        if self._emission_timer is not None:
            self._emission_timer.close()
            self._emission_timer = None
        if self._claim is not None:
            self._claim.release()
            self._claim = None

    def status(self) -> ListenerStatus:
        """Return the status of this listener: whether its port is open, indicators and counters."""
        diagnostics, session = self.diagnostics, self._session
        return ListenerStatus(
            endpoint=self.name,
            is_open=self.diagnosis.is_open,
            indicators=self.diagnosis.indicators(time.monotonic(), listen_only=diagnostics.listen_only),
            counters=diagnostics.counters,
            event_count=diagnostics.event_count,
            listen_only=diagnostics.listen_only,
            listen_only_units=tuple(sorted(diagnostics.listen_only_units)),
            requests=session.requests,
            foreign=session.foreign,
            damaged=session.damaged_frames,
            abandoned=session.abandoned,
            echoes=session.echoes,
        )

    @property
    def requests(self) -> int:
        """Number of requests to units of this server on the line so far, broadcasts included."""
        return self._session.requests

    # The port.

    async def _open_once(self) -> None:
        connection = await SerialConnection.open(
            self._settings.endpoint.path, self._port, received=self._received, lost=self._lost
        )
        self._connection = connection
        self._session.characters_take_time = not connection.pseudo_terminal
        self.diagnosis.is_open = True
        self._overruns = Overruns(connection.counters)
        if self._tap is not None:
            self._tap.connection_opened(self._tapped)
        _log.info("%s: open", self.name)

    def _reopen(self) -> None:
        self._opening = self._loop.create_task(self._open_when_there())

    async def _open_when_there(self) -> None:
        try:
            await open_when_there(self._open_once, ReopenPolicy.of(self._settings.opening), waiting=self._still_waiting)
        except Exception as error:
            # A setting that the new port does not take: nothing to wait for, but the other listeners go on.
            _log.error("%s: given up: %s", self.name, error)

    def _still_waiting(self, error: LinkDown, pause: float) -> None:
        _log.debug("%s: %s; tried again in %.1f s", self.name, error.message, pause)

    def _lost(self, error: LinkDown) -> None:
        self._connection = None
        _log.warning("%s: %s; waiting for it", self.name, error.message)
        self._ended()
        self._reopen()

    def _ended(self) -> None:
        if self._tap is not None and self.diagnosis.is_open:
            self._tap.connection_closed(self._tapped)
        self.diagnosis.is_open = False
        if self._emission_timer is not None:
            self._emission_timer.cancel()
        if self._silence_timer is not None:
            self._silence_timer.cancel()
            self._silence_timer = None
        self._pending = None
        for task in self._tasks:
            task.cancel()
        self._session.close()

    # Bytes.

    def _received(self, data: bytes, errors: int) -> None:
        now = time.monotonic()
        session = self._session
        self.diagnosis.traffic = now
        if TRACE.level:
            self._traced().received(data)
        heard = session.requests + session.foreign + session.damaged_frames
        damaged = session.damaged_frames
        overrun = self._overruns is not None and self._overruns.more()
        pending = self._pending
        emissions: list[FrameToSend] = []
        if errors or overrun:
            session.receive_damaged(data, now, overrun=overrun)
        else:
            emissions = session.receive(data, now)
        if session.damaged_frames != damaged:
            self.diagnosis.communication_fault = now
        if pending is not None and self._pending is pending:
            if session.requests + session.foreign + session.damaged_frames != heard:
                self._drop_pending()
            else:
                self._schedule(replace(pending, not_before=session.clear_at()))
        self._follow(emissions)

    def _follow(self, emissions: list[FrameToSend]) -> None:
        """Carry out what the line's session returned: send replies, await responders, log failures, set the timer."""
        session = self._session
        if session.echoes and not self._echo_is_logged:
            self._echo_is_logged = True
            _log.warning("%s: the port receives what it sends; set echo=on", self.name)
        if emissions:
            # Who sends a second request has given up the first; the session has counted that.
            self._schedule(emissions[-1])
        if session.deferred:
            deferred, session.deferred = session.deferred, []
            begin_late_answers(deferred, self._loop, self._tasks)
        if session.failures:
            failures, session.failures = session.failures, []
            self.diagnosis.internal_fault = time.monotonic()
            self._counters.responder_failures += len(failures)
            report_failures(self.name, failures)
        self._watch_silence()

    def _watch_silence(self) -> None:
        if self._silence_timer is not None:
            self._silence_timer.cancel()
            self._silence_timer = None
        deadline = self._session.deadline()
        if deadline is not None:
            self._silence_timer = self._loop.call_later(max(deadline - time.monotonic(), 0.0), self._silent)

    def _silent(self) -> None:
        self._silence_timer = None
        damaged = self._session.damaged_frames
        now = time.monotonic()
        emissions = self._session.tick(now)
        if self._session.damaged_frames != damaged:
            self.diagnosis.communication_fault = now
        self._follow(emissions)

    # Answers.

    def _late_answer(self, emission: FrameToSend) -> None:
        """Send the reply of a responder that needed time to answer."""
        self._schedule(emission)
        self._watch_silence()

    def _schedule(self, emission: FrameToSend) -> None:
        self._pending = emission
        leaves = emission.not_before - self._spin
        if self._emission_timer is not None and leaves > time.monotonic():
            self._emission_timer.set(leaves)
        else:
            self._emit()

    def _drop_pending(self) -> None:
        """Discard a reply that waits to be sent, because another station has sent something; the session counts it."""
        self._pending = None
        if self._emission_timer is not None:
            self._emission_timer.cancel()

    def _emit(self) -> None:
        emission, self._pending = self._pending, None
        connection = self._connection
        if emission is None or connection is None:
            return
        while (now := time.monotonic()) < emission.not_before:
            pass  # at most SPIN, or what the loop's clock is coarser than ours
        try:
            until = connection.write(emission.frame)
        except LinkDown:
            self._session.answer_lost()
            return  # the port tells it by itself
        self._session.answer_left()
        self._follow(self._session.tick(now))  # the silence before it; not sooner, the frame is due
        self._session.sent(emission.frame, until)
        self.diagnosis.traffic = now
        if TRACE.level:
            self._traced().sent(emission.frame)

    def transmit(self, data: bytes) -> None:
        """Send raw bytes on the serial line now; the caller has to keep the silence before them.

        The bytes are lost if the port is not open.
        """
        connection = self._connection
        if connection is None:
            return
        try:
            until = connection.write(data)
        except LinkDown:
            return  # the port tells it by itself
        now = time.monotonic()
        self._follow(self._session.tick(now))
        with contextlib.suppress(ValueError):  # strict timing: who speaks into another's frame breaks its rule
            self._session.sent(data, until)
        self.diagnosis.traffic = now
        if TRACE.level:
            self._traced().sent(data)

    def _traced(self) -> ConnectionTrace:
        if self._trace is None:
            self._trace = trace_for(self._settings.endpoint.framing, self.name, is_server=True)
        return self._trace


def _may_come(error: LinkDown) -> bool:
    """Whether an error of opening says that the serial port is missing now and may come later, such as ENOENT.

    An error without a cause counts as that too.
    """
    cause = error.__cause__
    return cause is None or getattr(cause, "errno", None) in _NOT_THERE

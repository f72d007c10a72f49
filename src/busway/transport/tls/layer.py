"""TLS for asyncio connections: a layer between the transport of a connection and the protocol that uses it.

Knows transports and a `TlsStream`; knows no Modbus, and no certificate.

::

    protocol (ServerConnection, link)      plain bytes
        TlsLayer                           its transport; the loop's protocol
    the loop's transport                   TLS records

1. Received bytes are processed in one call, and all that the protocol writes in it is sent in one write.
2. The layer has no task; one timer limits the handshake, and the wait after a refusal.
3. A handshake that fails is answered with a TLS alert. The connection stays open for a moment after that: if it were
   closed while bytes of the peer are unread, the system would reset it, and the peer would not see the alert.
4. Exactly one of the callbacks ``established`` and ``failed`` is called; both only if ``established`` calls `refuse`.
   The upper protocol that ``established`` returned gets ``connection_lost``, with a `TlsFailure` if TLS ended the
   connection.
"""

import asyncio
import ssl
from collections.abc import Callable
from enum import Enum
from typing import Any, Final

from ..receive_buffer import receive_buffer
from .failures import FailureKind, TlsFailure
from .stream import TlsStream

LINGER_SECONDS: Final = 1.0
"""Seconds for which the connection stays open after a refusal, and received bytes are discarded, unless the peer closes
it before.
"""


class TlsState(Enum):
    """States of a TLS connection under asyncio: handshake, up, refused, closed."""

    HANDSHAKE = "handshake"
    UP = "up"
    REFUSED = "refused"
    """The alert was sent; the connection stays open for a moment, so that the peer can read it."""
    CLOSED = "closed"


class TlsLayer(asyncio.BufferedProtocol):
    """TLS over one asyncio connection: encrypts what the upper protocol writes, decrypts what is received.

    Args:
        loop: the event loop.
        context: of `server_context` or `client_context`.
        server_side: True on a server, False on a client.
        server_name: the name that the server's certificate must have; None on a server.
        timeout: seconds for the handshake.
        established: called with the layer when the handshake is complete; returns the upper protocol, or None if it has
            called `refuse`.
        failed: called once with the layer and the failure if the handshake failed or was refused (`refuse`).
        gone: called with the layer when the TCP connection has ended, after all other calls.

    Attributes:
        state: handshake, up, refused or closed.
        failure: why the connection ended, if TLS is the reason; otherwise None.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        context: ssl.SSLContext,
        *,
        server_side: bool,
        server_name: str | None = None,
        timeout: float,
        established: "Callable[[TlsLayer], asyncio.BufferedProtocol | None]",
        failed: "Callable[[TlsLayer, TlsFailure], None]",
        gone: "Callable[[TlsLayer], None] | None" = None,
    ) -> None:
        self.state: TlsState = TlsState.HANDSHAKE
        self.failure: TlsFailure | None = None
        self._loop = loop
        self._stream = TlsStream(context, server_side=server_side, server_name=server_name)
        self._timeout = timeout
        self._established = established
        self._failed = failed
        self._gone = gone
        self._buffer = receive_buffer(loop)
        self._records = memoryview(self._buffer)
        self._above: Any = None  # the protocol above; its optional methods have no common type
        self._below: Any = None  # the loop's transport
        self._timer: asyncio.TimerHandle | None = None
        self._collecting = False
        self._reading_paused = False
        self._ended_told = False

    # What the event loop calls.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin the TLS handshake on the open connection."""
        self._below = transport
        self._timer = self._loop.call_later(self._timeout, self._too_slow)
        self._shake_hands()

    def get_buffer(self, sizehint: int) -> bytearray:
        """Return the buffer into which the event loop receives encrypted bytes."""
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        """Process received TLS records: continue the handshake, or pass the decrypted bytes to the upper protocol."""
        if self.state is TlsState.UP:  # first, because it is nearly always so
            self._stream.feed(self._records[:nbytes])
            self._deliver()
        elif self.state is TlsState.HANDSHAKE:
            self._stream.feed(self._records[:nbytes])
            self._shake_hands()

    def eof_received(self) -> bool:
        """Handle the end of the TCP stream, also if the peer has not announced it by TLS (close_notify).

        Returns whether the connection stays open for now, because replies are still unsent.
        """
        if self.state is TlsState.UP:
            return self._report_end()
        return False

    def connection_lost(self, exc: Exception | None) -> None:
        """Handle the end of the TCP connection below the TLS layer.

        Calls ``failed`` if the handshake was neither complete nor refused, ``connection_lost`` of the upper protocol if
        there is one, and then ``gone``.
        """
        state, self.state = self.state, TlsState.CLOSED
        self._stop_timer()
        if state is TlsState.HANDSHAKE:
            reason = "the peer closed the connection before both sides had agreed"
            self._failed(self, self.failure or TlsFailure(FailureKind.GONE, reason))
        above, self._above = self._above, None
        if above is not None:
            above.connection_lost(self.failure or self._stream.end_reason(exc))
        if self._gone is not None:
            self._gone(self)

    def pause_writing(self) -> None:
        """Tell the upper protocol to pause, because the peer does not read."""
        if self._above is not None:
            self._above.pause_writing()

    def resume_writing(self) -> None:
        """Tell the upper protocol to go on, because the peer reads again."""
        if self._above is not None:
            self._above.resume_writing()

    # The handshake.

    def _shake_hands(self) -> None:
        try:
            done = self._stream.handshake()
        except TlsFailure as failure:
            self.refuse(failure)
            return
        self._flush()
        if not done:
            return
        self._stop_timer()
        self._above = self._established(self)
        if self._above is None:
            return
        self.state = TlsState.UP
        self._collecting = True
        try:
            self._above.connection_made(self)
        finally:
            self._collecting = False
        if not self._below.is_closing():
            self._deliver()

    def refuse(self, failure: TlsFailure) -> None:
        """End a failed or unwanted handshake: send the TLS alert (or close_notify), and call ``failed``.

        The connection is closed a second later, so that the peer can read these bytes. Does nothing after the
        handshake.
        """
        if self.state is not TlsState.HANDSHAKE:
            return
        self.state = TlsState.REFUSED
        self.failure = failure
        self._stop_timer()
        if not self._below.is_closing():
            self._stream.finish()
            self._flush()
            self._timer = self._loop.call_later(LINGER_SECONDS, self.abort)
            if self._below.can_write_eof():
                self._below.write_eof()
        self._failed(self, failure)

    def _too_slow(self) -> None:
        self.refuse(TlsFailure(FailureKind.TOO_SLOW, f"TLS was not agreed on within {self._timeout:g} s"))

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    # Plain bytes up.

    def _deliver(self) -> None:
        """Pass decrypted bytes to the upper protocol, then send what it has written."""
        self._collecting = True
        try:
            while self._above is not None and not self._reading_paused:
                # The records have been taken out of the buffer that both share.
                room = memoryview(self._above.get_buffer(-1))
                size = self._stream.read_into(room)
                if size:
                    self._above.buffer_updated(size)
                if self._stream.ended:
                    self._report_end()
                    break
                if not size or not self._stream.may_hold_more:
                    break
        except TlsFailure as failure:
            self.failure = failure
            self._flush()
            self._below.abort()
        finally:
            self._collecting = False
        self._flush()

    def _report_end(self) -> bool:
        """Call ``eof_received`` of the upper protocol; close the connection unless replies are still unsent.

        Returns whether the connection stays open for now.
        """
        if not self._ended_told and self._above is not None:
            self._ended_told = True
            if not self._above.eof_received():
                self.close()
                return False
        return not self.is_closing()

    # What the protocol above calls: the transport.

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Encrypt bytes of the upper protocol and send them; drop them if the connection is not up or is closing.

        What the upper protocol writes while it processes received bytes is sent together after that.
        """
        if self.state is not TlsState.UP or self._below.is_closing():
            return
        try:
            self._stream.write(data)
        except TlsFailure as failure:
            self.failure = failure
            self._below.abort()
            return
        if not self._collecting:
            self._flush()

    def _flush(self) -> None:
        records = self._stream.outgoing()
        if records and not self._below.is_closing():
            self._below.write(records)

    def close(self) -> None:
        """Announce the end of the TLS stream (close_notify), and close after the written bytes are sent.

        Before the end of the handshake it is closed at once, as by `abort`.
        """
        if self.state is TlsState.UP and not self._below.is_closing():
            self._stream.finish()
            self._flush()
            self._below.close()
        else:
            self.abort()

    def abort(self) -> None:
        """Close the connection at once, without close_notify; bytes that wait to be sent are dropped."""
        if self._below is not None:
            self._below.abort()

    def is_closing(self) -> bool:
        """Whether the TLS connection is closed, or about to be."""
        return self.state in (TlsState.CLOSED, TlsState.REFUSED) or self._below is None or self._below.is_closing()

    def pause_reading(self) -> None:
        """Stop receiving, and pass nothing more to the upper protocol."""
        self._reading_paused = True
        self._below.pause_reading()

    def resume_reading(self) -> None:
        """Receive from the peer again, after `pause_reading`."""
        if self._reading_paused and not self._below.is_closing():
            self._reading_paused = False
            if self._stream.may_hold_more:
                # Before anything else is received: what waits here would grow with every pause.
                self._loop.call_soon(self._deliver_left)
            else:
                self._below.resume_reading()

    def _deliver_left(self) -> None:
        if self.state is TlsState.UP and not self._below.is_closing():
            self._deliver()
            if not self._reading_paused and not self._below.is_closing():
                self._below.resume_reading()

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """Set the limits of encrypted bytes that wait to be sent: above ``high`` the upper protocol is paused.

        It is resumed at ``low`` bytes. None stands for the default of the transport below.
        """
        self._below.set_write_buffer_limits(high, low)

    def get_write_buffer_size(self) -> int:
        """Number of encrypted bytes that wait to be sent."""
        size: int = self._below.get_write_buffer_size()
        return size

    def get_extra_info(self, name: str, default: Any = None) -> Any:  # as `asyncio.BaseTransport` says it
        """Return a detail of the connection: ``ssl_object``, or one of the transport below, such as ``peername``."""
        if name == "ssl_object":
            return self._stream.ssl_object
        return self._below.get_extra_info(name, default) if self._below is not None else default

"""Limits the HTTP connections of a page: their number, and the time each has to send a request.

Knows connections of uvicorn and their limits; knows no request. uvicorn limits neither the number of connections that
have sent nothing, nor the time of a head, so that is here.

1. From its beginning, or from the first byte of a further request, a connection has `HEAD_SECONDS` to the end of the
   head. Before that it is not known who the client is.
2. There are at most `MOST` connections, WebSockets included. One too many replaces the oldest that has not sent its
   request; if all have, it is closed.
3. The last descriptors of the process are for Modbus: a connection that was given one of them is closed.
4. Events that repeat are logged once a minute, with their number.
5. A stream of any page has the limits that stand here; `simulation_stream` and `collector_stream` keep them.
6. A TLS handshake counts as a connection that has not sent its request, and has the same time. The subject of a
   client's certificate that was verified goes with the connection, for the rules of access.
"""

import asyncio
import logging
import ssl
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from ...access.repeats import Repeats, so_often
from ...transport.descriptors import is_reserved
from .access import CERTIFICATE_SUBJECT

HEAD_SECONDS: Final = 5.0
MOST: Final = 100
CLIENTS: Final = 16
"""Viewers that have a stream (WebSocket) of a page at once."""
SEND_SECONDS: Final = 20.0
"""Seconds that a viewer has to take one message."""
PROTOCOL: Final = "busway"
"""The subprotocol of a stream; a browser may offer its token beside it."""

_log = logging.getLogger("busway.apps.web")


class Throttle(logging.Filter):
    """Log filter that passes each message once a minute, with the number of those it dropped."""

    def __init__(self) -> None:
        super().__init__()
        self._repeats = Repeats()

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether a log message is written now or left out as a repetition."""
        sentence = record.getMessage()
        repeated = self._repeats.again(sentence, time.monotonic())
        if repeated is None:
            return False
        record.msg, record.args = sentence + so_often(repeated), ()
        return True


_http_log = logging.getLogger("busway.apps.web.http")
"""Log of the HTTP server; a client that sends nonsense makes it repeat itself."""
_http_log.addFilter(Throttle())


class SharedConnections:
    """What all HTTP connections of one page share: limits and counts.

    Attributes:
        waiting: connections that have not sent their request, the oldest first.
    """

    def __init__(self) -> None:
        self.waiting: dict[PageConnection | SecuringConnection, None] = {}
        self._repeats = Repeats()

    def protocols(self, tls: Callable[[], ssl.SSLContext] | None = None) -> Callable[..., asyncio.Protocol]:
        """Return the factory that uvicorn calls for each accepted connection of the page.

        Args:
            tls: gives the TLS context of a connection that begins; None for connections without TLS.
        """
        return partial(PageConnection, self) if tls is None else partial(SecuringConnection, self, tls)

    def admits(self, transport: asyncio.Transport, connections: "set[Any]") -> bool:
        """Whether an accepted HTTP connection of the page (one of ``connections``) may stay; else it is closed."""
        accepted = transport.get_extra_info("socket")
        if accepted is not None and is_reserved(accepted.fileno()):
            self.say("a connection to the page is closed: the last file descriptors are reserved for Modbus")
            transport.abort()
            return False
        while len(connections) > MOST:
            oldest = next(iter(self.waiting), None)
            if oldest is None:
                self.say("a connection to the page is closed: %d are open already", MOST)
                transport.abort()
                return False
            self.say("a connection to the page has made room: it had sent no request, and %d are open", MOST)
            oldest.close_unheard()
        return True

    def say(self, sentence: str, *arguments: object) -> None:
        """Log an event of the page that may repeat, once a minute."""
        repeated = self._repeats.again(sentence, time.monotonic())
        if repeated is not None:
            _log.warning(f"{sentence}%s", *arguments, so_often(repeated))


class PageConnection(H11Protocol):
    """An HTTP connection of the page, until it becomes a WebSocket.

    Args:
        shared: state shared with the other connections.
        given: arguments of uvicorn.
    """

    def __init__(self, shared: SharedConnections, **given: Any) -> None:
        super().__init__(**given)
        self.logger: logging.Logger = _http_log
        self._shared = shared
        self._timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Keep an accepted connection if the page's limit allows it."""
        super().connection_made(transport)
        secured = transport.get_extra_info("ssl_object")
        if secured is not None:
            self.app_state = {**self.app_state, CERTIFICATE_SUBJECT: subject_of(secured.getpeercert(binary_form=True))}
        if self._shared.admits(transport, self.connections):
            self._wait()

    def data_received(self, data: bytes) -> None:
        """Process bytes that the connection has received."""
        super().data_received(data)
        if self.transport.is_closing() or self.conn.their_state is not h11.IDLE:
            self._heard()
        elif self._timer is None and self.conn.trailing_data[0]:
            self._wait()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Pass an HTTP connection of the page on to the WebSocket code."""
        self._heard()
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget a connection of the page that has ended."""
        self._heard()
        super().connection_lost(exc)

    def close_unheard(self) -> None:
        """Close a connection of the page that has not sent its request in time."""
        self._heard()
        self.connections.discard(self)
        self.transport.abort()

    def _wait(self) -> None:
        self._shared.waiting[self] = None
        self._timer = self.loop.call_later(HEAD_SECONDS, self._too_slow)

    def _heard(self) -> None:
        self._shared.waiting.pop(self, None)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _too_slow(self) -> None:
        self._shared.say("a connection to the page is closed: no request came within %g s", HEAD_SECONDS)
        self.close_unheard()


class SecuringConnection(asyncio.Protocol):
    """A connection to the page during its TLS handshake, after which a `PageConnection` replaces it.

    Args:
        shared: state shared with the other connections.
        tls: gives the context.
        given: arguments of uvicorn.
    """

    def __init__(self, shared: SharedConnections, tls: Callable[[], ssl.SSLContext], **given: Any) -> None:
        self._shared = shared
        self._tls = tls
        self._given = given
        self._connections: set[Any] = given["server_state"].connections
        self._tasks: set[asyncio.Task[None]] = given["server_state"].tasks
        self._early: list[bytes] = []
        self._has_ended = False
        self._transport: asyncio.Transport | None = None
        self._handshake: asyncio.Task[None] | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin the TLS handshake of an accepted connection if the page's limit allows it."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._connections.add(self)
        if not self._shared.admits(transport, self._connections):
            self._connections.discard(self)
            return
        transport.pause_reading()
        self._shared.waiting[self] = None
        self._handshake = asyncio.get_running_loop().create_task(self._secure(transport))
        self._tasks.add(self._handshake)  # the server awaits them when it stops
        self._handshake.add_done_callback(self._tasks.discard)

    async def _secure(self, transport: asyncio.Transport) -> None:
        loop = asyncio.get_running_loop()
        try:
            secured = await loop.start_tls(
                transport, self, self._tls(), server_side=True, ssl_handshake_timeout=HEAD_SECONDS
            )
        except (OSError, ssl.SSLError) as error:  # an alert, a timeout, or the client has gone
            self._shared.say("a TLS handshake with the page failed: %s", getattr(error, "reason", None) or error)
            secured = None
        finally:
            self._shared.waiting.pop(self, None)
            self._connections.discard(self)
        if secured is not None and not self._has_ended and not secured.is_closing():
            page = PageConnection(self._shared, **self._given)
            secured.set_protocol(page)
            page.connection_made(secured)
            if self._early:
                page.data_received(b"".join(self._early))

    def data_received(self, data: bytes) -> None:
        """Keep bytes that arrived right after the TLS handshake, for the `PageConnection`."""
        self._early.append(data)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget a connection that has ended during its TLS handshake."""
        self._has_ended = True
        self._shared.waiting.pop(self, None)
        self._connections.discard(self)

    def close_unheard(self) -> None:
        """Close a connection whose TLS handshake has not ended in time."""
        if self._handshake is not None:
            self._handshake.cancel()
        self.connection_lost(None)
        if self._transport is not None:
            self._transport.abort()

    def shutdown(self) -> None:
        """Close the connection, because the page is being stopped."""
        self.close_unheard()


def subject_of(certificate: bytes | None) -> str:
    """Return the subject of a certificate in DER as RFC 4514 writes it: ``CN=anna,O=plant``; empty without one."""
    if not certificate:
        return ""
    from cryptography import x509

    try:
        return x509.load_der_x509_certificate(certificate).subject.rfc4514_string()
    except ValueError:  # it was verified, and still has a form that cannot be read
        return ""

"""Limits the HTTP connections of a page: their number, and the time each has to send a request.

Knows connections of uvicorn and their limits; knows no request. uvicorn limits neither the number of connections that
have sent nothing, nor the time in which a head must arrive; this module does.

1. A client has `HEAD_SECONDS` to send the complete head of a request: from the beginning of the connection, or for a
   further request from its first byte. Until then it is not known who the client is.
2. There are at most `MOST` connections, WebSockets included. When there is one more, the oldest connection that has not
   sent its request is closed; if all others have sent theirs, the new connection is closed.
3. The last file descriptors of the process are reserved for Modbus: a connection that was given one of them is closed.
4. Events that repeat are logged once a minute, with the number of messages left out.
5. The limits for the WebSockets of all pages are constants of this module; `simulation_stream` and `collector_stream`
   apply them.
6. A connection in its TLS handshake counts as one that has not sent its request, and the handshake must end within
   `HEAD_SECONDS`. The subject of a verified client certificate is stored with the connection, for `request_guard`.
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

from ...log_limiter import LogLimiter, suppressed_note
from ...transport.descriptors import is_reserved
from .request_guard import CERTIFICATE_SUBJECT

HEAD_SECONDS: Final = 5.0
MOST: Final = 100
MOST_VIEWERS: Final = 16
"""Most viewers that have a WebSocket (``/stream``) of one page at the same time."""
SEND_SECONDS: Final = 20.0
"""Seconds in which a viewer must take a message; then its WebSocket is closed."""
PROTOCOL: Final = "busway"
"""WebSocket subprotocol of ``/stream``; a browser that has a token offers ``bearer.TOKEN`` as well."""

_log = logging.getLogger("busway.apps.web")


class Throttle(logging.Filter):
    """Log filter that passes each message at most once a minute, and appends how many equal ones it has dropped."""

    def __init__(self) -> None:
        super().__init__()
        self._log_limiter = LogLimiter()

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True if a log message is to be written, False if it is dropped as a repetition.

        Appends to the message how many equal messages were dropped before.
        """
        sentence = record.getMessage()
        repeated = self._log_limiter.admit(sentence, time.monotonic())
        if repeated is None:
            return False
        record.msg, record.args = sentence + suppressed_note(repeated), ()
        return True


_http_log = logging.getLogger("busway.apps.web.http")
"""Log of the HTTP server. A client that sends invalid requests causes many equal messages, which the filter drops."""
_http_log.addFilter(Throttle())


class SharedConnections:
    """State that all HTTP connections of one page share: their limits, and the connections that have sent no request.

    Attributes:
        waiting: keys are the connections that have not sent their request, the oldest first; values are unused.
    """

    def __init__(self) -> None:
        self.waiting: dict[PageConnection | SecuringConnection, None] = {}
        self._log_limiter = LogLimiter()

    def protocols(self, tls: Callable[[], ssl.SSLContext] | None = None) -> Callable[..., asyncio.Protocol]:
        """Return the factory that uvicorn calls for each accepted connection of the page.

        Args:
            tls: called for each new connection; returns its TLS context. None for connections without TLS.
        """
        return partial(PageConnection, self) if tls is None else partial(SecuringConnection, self, tls)

    def admits(self, transport: asyncio.Transport, connections: "set[Any]") -> bool:
        """Apply the limits to a new connection of the page: return True if it stays open, False if it was closed.

        If there are more than `MOST`, closes the oldest connections that have sent no request, to make room, and takes
        them out of ``connections``. The new one is closed if there are no such connections, or if its file descriptor
        is reserved for Modbus; the caller takes it out.

        Args:
            transport: the new connection.
            connections: all connections of the page, with the new one.
        """
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
        """Log an event of the page as a warning, at most once a minute for the same event.

        Args:
            sentence: format of the message; events with the same format count as the same event.
            arguments: values for the format.
        """
        repeated = self._log_limiter.admit(sentence, time.monotonic())
        if repeated is not None:
            _log.warning(f"{sentence}%s", *arguments, suppressed_note(repeated))


class PageConnection(H11Protocol):
    """An HTTP connection of the page, until it becomes a WebSocket; adds limits to the protocol of uvicorn.

    The connection is closed if there are too many, or if the head of a request takes longer than `HEAD_SECONDS`. With
    TLS the subject of the client's certificate is put into ``app_state``, where `request_guard` finds it.

    Args:
        shared: state shared with the other connections of the page.
        given: arguments that uvicorn gives to a protocol.
    """

    def __init__(self, shared: SharedConnections, **given: Any) -> None:
        super().__init__(**given)
        self.logger: logging.Logger = _http_log
        self._shared = shared
        self._timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Keep a new connection if the limits of the page allow it, else close it. Called by asyncio."""
        super().connection_made(transport)
        secured = transport.get_extra_info("ssl_object")
        if secured is not None:
            self.app_state = {**self.app_state, CERTIFICATE_SUBJECT: subject_of(secured.getpeercert(binary_form=True))}
        if self._shared.admits(transport, self.connections):
            self._wait()

    def data_received(self, data: bytes) -> None:
        """Process bytes that the connection has received. Called by asyncio."""
        super().data_received(data)
        if self.transport.is_closing() or self.conn.their_state is not h11.IDLE:
            self._heard()
        elif self._timer is None and self.conn.trailing_data[0]:
            self._wait()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Hand an HTTP connection of the page over to the WebSocket protocol of uvicorn."""
        self._heard()
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget a connection of the page that has ended. Called by asyncio."""
        self._heard()
        super().connection_lost(exc)

    def close_unheard(self) -> None:
        """Close a connection that has not sent its request: it took too long, or makes room for a new connection."""
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
    """A connection to the page during its TLS handshake; a `PageConnection` replaces it after the handshake.

    Args:
        shared: state shared with the other connections of the page.
        tls: returns the TLS context for this connection.
        given: arguments that uvicorn gives to a protocol, for the `PageConnection`.
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
        """Begin the TLS handshake of a new connection if the limits of the page allow it, else close it."""
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
        """Keep decrypted bytes that arrive right after the TLS handshake, for the `PageConnection`."""
        self._early.append(data)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget a connection that has ended during its TLS handshake."""
        self._has_ended = True
        self._shared.waiting.pop(self, None)
        self._connections.discard(self)

    def close_unheard(self) -> None:
        """Close the connection during its handshake, to make room for a new one or because the page is stopped."""
        if self._handshake is not None:
            self._handshake.cancel()
        self.connection_lost(None)
        if self._transport is not None:
            self._transport.abort()

    def shutdown(self) -> None:
        """Close the connection. Called by uvicorn when the page is being stopped."""
        self.close_unheard()


def subject_of(certificate: bytes | None) -> str:
    """Return the subject of a certificate in the form of RFC 4514, such as ``CN=anna,O=plant``.

    Returns an empty text if there is no certificate, or if its subject cannot be read.

    Args:
        certificate: the certificate in DER; None or empty if the client has none.
    """
    if not certificate:
        return ""
    from cryptography import x509

    try:
        return x509.load_der_x509_certificate(certificate).subject.rfc4514_string()
    except ValueError:  # it was verified, and still has a form that cannot be read
        return ""

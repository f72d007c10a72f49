"""HTTP service for the status and metrics of a program, in threads beside the program's event loop.

Knows the limits of one connection and of all; knows nothing of the resources: a function of its owner answers
requests, and `http_connection` parses them. The standard library's `ThreadingMixIn` has no limits, so this file sets
them:

1. One request per connection, then the connection is closed. No keep-alive, no chunked bodies, no redirects.
2. Head, body, time and number of connections are limited. One connection too many closes the oldest one that has not
   sent its whole request; if all have, the new connection is answered 503. A peer that sends or reads slowly delays no
   other peer.
3. The last descriptors of the process are for Modbus: an HTTP connection that gets one of them is closed at once.
"""

import contextlib
import logging
import os
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from socketserver import BaseRequestHandler, TCPServer, ThreadingMixIn
from typing import Any, Final

from ..errors import LinkDown
from ..transport.descriptors import is_reserved
from ..transport.tcp import network_kind
from .http_messages import HttpRequest, HttpResponse

_log = logging.getLogger("busway.http")

_BACKLOG: Final = 128
_LOG_PAUSE: Final = 60.0
"""Seconds between two log lines about requests that failed."""
_TURN: Final = 0.1
"""Seconds between two checks for connections whose time is over."""


@dataclass(frozen=True, slots=True)
class HttpLimits:
    """Limits of connections to the HTTP service: how long each may take, and how many there may be.

    Attributes:
        request_seconds: seconds from the accepted connection to the last byte of the request.
        seconds: seconds from the accepted connection to the last byte of the response.
        connections: number of connections open at once. Until the connections closed for new ones have ended, there
            may be up to twice as many.
    """

    request_seconds: float = 5.0
    seconds: float = 10.0
    connections: int = 16


class HttpService(ThreadingMixIn, TCPServer):
    """HTTP service on one listening socket, from `start` to `stop`. Each connection has a thread.

    Args:
        bound: a bound stream socket; the service closes it.
        answer: returns the response to a request; called in the connection's thread, which it may block for a limited
            time. An `HttpError` that it raises is sent as the response; any other exception is logged and answered 500.
        admit: called with each accepted socket; if it returns False, the connection is closed unread.
        limits: limits of connections; None for the defaults of `HttpLimits`.
        name: name of the thread that accepts.
    """

    def __init__(
        self,
        bound: socket.socket,
        answer: Callable[[HttpRequest], HttpResponse],
        *,
        admit: Callable[[socket.socket], bool] = lambda accepted: True,
        limits: HttpLimits | None = None,
        name: str = "busway http",
    ) -> None:
        super().__init__(("", 0), BaseRequestHandler, bind_and_activate=False)
        self.socket.close()
        self.socket = bound
        bound.settimeout(_TURN)  # a peer that has gone between select and accept must not block the thread
        self.daemon_threads = False  # so that `server_close` waits for them
        self.answer = answer
        self._admit = admit
        self._limits = limits or HttpLimits()
        self._deadlines: dict[socket.socket, float] = {}
        self._unheard: dict[socket.socket, None] = {}  # those without a whole request, the oldest first
        self._silent_until = 0.0
        self._thread = threading.Thread(target=self.serve_forever, args=(_TURN,), name=name, daemon=True)

    def start(self) -> None:
        """Begin to listen for HTTP requests and to answer them, in a thread."""
        self.socket.listen(_BACKLOG)
        self._thread.start()

    def stop(self) -> None:
        """Close all connections and the socket. Blocks until the threads have ended; a second call does nothing."""
        if self._thread.ident is not None:
            self.shutdown()
            self._thread.join()
        for accepted in list(self._deadlines):
            self._cut(accepted)
        self.server_close()

    def heard(self, accepted: socket.socket) -> None:
        """Extend the time limit of an HTTP connection, because its whole request was received.

        Called by the connection's thread. The limit is then ``seconds`` of `HttpLimits` instead of ``request_seconds``,
        both from when the connection was accepted.
        """
        self._unheard.pop(accepted, None)
        self._deadlines[accepted] += self._limits.seconds - self._limits.request_seconds

    # Called by the standard library.

    def get_request(self) -> tuple[socket.socket, Any]:  # Any: the address of a peer has the shape of its family
        """Accept an HTTP connection. Returns its socket and the peer's address.

        Raises the `OSError` of a failed accept, but only after a tenth of a second: the next would fail too.
        """
        try:
            return super().get_request()
        except OSError:
            time.sleep(_TURN)  # without descriptors accepting would fail again at once, and for ever
            raise

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Whether an accepted HTTP connection may stay; if not, the standard library closes it.

        False if ``admit`` refuses the connection, or if it has one of the reserved descriptors. At the limit of
        connections, the oldest one without a whole request is closed to make room; if there is none, or at twice the
        limit, the new connection is answered 503, and the result is False.
        """
        if is_reserved(request.fileno()) or not self._admit(request):
            return False
        most = self._limits.connections
        if len(self._deadlines) >= most:
            silent = list(self._unheard)
            if not silent or len(self._deadlines) >= 2 * most:
                from .http_connection import drain

                drain(request, b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\n\r\n")
                return False
            self._cut(silent[0])
        self._deadlines[request] = time.monotonic() + self._limits.request_seconds
        self._unheard[request] = None
        return True

    def finish_request(self, request: Any, client_address: Any) -> None:
        """Answer the request of an HTTP connection, in its thread."""
        from .http_connection import HttpConnection  # here: most programs are never asked

        HttpConnection(request, client_address, self)

    def service_actions(self) -> None:
        """Close the HTTP connections whose time is over; called every tenth of a second."""
        now = time.monotonic()
        for accepted, deadline in list(self._deadlines.items()):
            if now >= deadline:
                self._cut(accepted)

    def shutdown_request(self, request: Any) -> None:
        """Close an HTTP connection, at its end."""
        self._unheard.pop(request, None)
        self._deadlines.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log the exception of a connection's thread, at most once a minute."""
        now = time.monotonic()
        if now >= self._silent_until:
            self._silent_until = now + _LOG_PAUSE
            _log.exception("a request failed; further failures within a minute are not logged")

    def _cut(self, accepted: socket.socket) -> None:
        """Shut down an HTTP connection's socket from another thread; the connection's own thread then closes it."""
        self._unheard.pop(accepted, None)
        with contextlib.suppress(OSError):
            accepted.shutdown(socket.SHUT_RDWR)


def bind_tcp(host: str, port: int) -> socket.socket:
    """Return a TCP socket that listens at an address, for an HTTP service.

    Args:
        host: name or address of this machine.
        port: port number; 0 takes a free one.

    Raises:
        LinkDown: the address cannot be used.
    """
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        bound = socket.socket(family, socket.SOCK_STREAM)
        try:
            if os.name == "posix":  # elsewhere it would let two programs share one port
                bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            bound.bind(address)
            bound.listen()  # with SO_REUSEADDR two programs that begin at once both bind, and one fails here
        except BaseException:
            bound.close()
            raise
    except OSError as error:
        raise LinkDown(
            f"cannot listen on {host}:{port}: {error.strerror or error}", kind=network_kind(error)
        ) from error
    return bound


def bound_name(bound: socket.socket) -> str:
    """Return the address of a bound TCP socket as text: ``127.0.0.1:9502``, ``[::1]:9502``."""
    host, port = bound.getsockname()[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"

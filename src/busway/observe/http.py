"""HTTP service for the status and metrics of a program, in threads beside the program's event loop.

Knows the limits of one connection and of all; knows nothing of the resources: a function of its owner answers
requests. The standard library's `ThreadingHTTPServer` parses them. That server has no limits, so this file sets them:

1. One request per connection, then the connection is closed. No keep-alive, no chunked bodies, no redirects.
2. Head, body, time and number of connections are limited. One connection too many closes the oldest that has not sent
   its whole request, or is answered 503 where all have. A peer that sends or reads slowly delays no other peer.
3. The last descriptors of the process are never kept: they are for Modbus.
"""

import contextlib
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final, NoReturn, cast

from ..errors import LinkDown
from ..transport.descriptors import is_reserved
from ..transport.tcp import network_kind

_log = logging.getLogger("busway.http")

HEAD_LIMIT: Final = 8192
"""Most bytes of request line and headers."""
BODY_LIMIT: Final = 4096
"""Most bytes of a request's body; no resource here needs a larger one."""
_BACKLOG: Final = 128
_LOG_PAUSE: Final = 60.0
"""Seconds between two log lines about requests that failed."""
_TURN: Final = 0.1
"""Seconds between two checks for connections whose time is over."""
_SINGLE: Final = ("host", "content-length", "authorization")
"""Headers that must not stand twice: it would be unclear which one counts."""


class HttpError(Exception):
    """Error that the HTTP service answers with a status code and a sentence.

    Args:
        status: HTTP status code, such as 404.
        sentence: body of the response.
    """

    def __init__(self, status: int, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


@dataclass(frozen=True, slots=True)
class HttpRequest:
    """A request that the HTTP service has received.

    Attributes:
        method: ``GET``, ``POST``, …
        path: path of the resource, without the query.
        headers: value of each header, by name in lower case.
        body: at most `BODY_LIMIT` bytes.
    """

    method: str
    path: str
    headers: Mapping[str, str] = field(default_factory=dict)
    body: bytes = b""


@dataclass(frozen=True, slots=True)
class HttpResponse:
    """A response that the HTTP service sends.

    Attributes:
        body: the bytes of the body.
        content_type: type of the body.
        status: HTTP status code, 200 for success.
    """

    body: bytes
    content_type: str = "text/plain; charset=utf-8"
    status: int = 200


@dataclass(frozen=True, slots=True)
class HttpLimits:
    """Limits of connections to the HTTP service: how long each may take, and how many there may be.

    Attributes:
        request_seconds: seconds from the accepted connection to the last byte of the request.
        seconds: seconds from the accepted connection to the last byte of the response.
        connections: number of connections open at once.
    """

    request_seconds: float = 5.0
    seconds: float = 10.0
    connections: int = 16


class HttpService(ThreadingHTTPServer):
    """HTTP service on one listening socket, from `start` to `stop`. Each connection has a thread.

    Args:
        bound: a bound stream socket; the service closes it.
        answer: returns the response to a request; called in the connection's thread, which it may block for a limited
            time. An `HttpError` that it raises is sent as the response.
        admit: called with each accepted socket; False closes the connection unread.
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
        super().__init__(("", 0), _Connection, bind_and_activate=False)
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
        """Give an HTTP connection more time, because its whole request was received."""
        self._unheard.pop(accepted, None)
        self._deadlines[accepted] += self._limits.seconds - self._limits.request_seconds

    # Called by the standard library.

    def get_request(self) -> tuple[socket.socket, Any]:  # Any: the address of a peer has the shape of its family
        """Accept an HTTP connection; after a failure wait a tenth of a second, as the next would fail too."""
        try:
            return super().get_request()
        except OSError:
            time.sleep(_TURN)  # without descriptors accepting would fail again at once, and for ever
            raise

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Whether an accepted HTTP connection may stay. Beyond the limit, close an older one or answer 503."""
        if is_reserved(request.fileno()) or not self._admit(request):
            return False
        most = self._limits.connections
        if len(self._deadlines) >= most:
            silent = list(self._unheard)
            if not silent or len(self._deadlines) >= 2 * most:
                _drained(request, b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\n\r\n")
                return False
            self._cut(silent[0])
        self._deadlines[request] = time.monotonic() + self._limits.request_seconds
        self._unheard[request] = None
        return True

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
        """Shut down an HTTP connection from another thread; its own thread then wakes up and closes it."""
        self._unheard.pop(accepted, None)
        with contextlib.suppress(OSError):
            accepted.shutdown(socket.SHUT_RDWR)


def _drained(accepted: socket.socket, last: bytes = b"") -> None:
    """Send the last bytes of a response, and discard what was received: unread bytes would reset the connection."""
    with contextlib.suppress(OSError):
        accepted.setblocking(False)
        accepted.send(last)
        accepted.recv(2 * HEAD_LIMIT)


class _Connection(BaseHTTPRequestHandler):
    """Handler of one HTTP connection: reads its request and writes the response."""

    protocol_version = "HTTP/1.1"
    wbufsize = -1  # head and body leave together
    server: HttpService

    def handle(self) -> None:
        """Receive the request and send the response; a peer that disconnected or is too slow gets none."""
        with contextlib.suppress(OSError, EOFError):
            self._send(self._response())
            _drained(self.connection)

    def finish(self) -> None:
        """Send the part of the response that is still buffered."""
        with contextlib.suppress(OSError):
            super().finish()

    def _response(self) -> HttpResponse:
        try:
            request = self._request()
            self.server.heard(self.connection)
            return self.server.answer(request)
        except HttpError as error:
            return HttpResponse(f"{error}\n".encode(), status=error.status)
        except (OSError, EOFError):
            raise
        except Exception:
            self.server.handle_error(self.connection, self.client_address)
            return HttpResponse(b"the request failed; the log says why\n", status=HTTPStatus.INTERNAL_SERVER_ERROR)

    def _request(self) -> HttpRequest:
        """Read the HTTP request. Raises `HttpError` if it is malformed or too large, `EOFError` if it is incomplete."""
        received, head = self.rfile, _Head(self.rfile)
        self.raw_requestline = head.readline()
        self.rfile = cast("Any", head)  # Any: of which the standard library reads lines, and does no more
        try:
            self.parse_request()  # which calls send_error
        finally:
            self.rfile = received
        if self.request_version == "HTTP/0.9" or not self.path.startswith("/"):
            raise HttpError(HTTPStatus.BAD_REQUEST, "the first line is no HTTP request")
        if self.headers.defects or any(len(self.headers.get_all(name, ())) > 1 for name in _SINGLE):
            raise HttpError(HTTPStatus.BAD_REQUEST, "a header is malformed, or stands twice")
        headers = {name.lower(): value.strip() for name, value in self.headers.items()}
        return HttpRequest(self.command, self.path.partition("?")[0], headers, self._body(headers))

    def _body(self, headers: Mapping[str, str]) -> bytes:
        if "transfer-encoding" in headers:
            raise HttpError(HTTPStatus.LENGTH_REQUIRED, "a body needs a Content-Length")
        length = headers.get("content-length", "0")
        if not (length.isascii() and length.isdigit()) or len(length) > 9:
            raise HttpError(HTTPStatus.BAD_REQUEST, "the Content-Length is not a number")
        if int(length) > BODY_LIMIT:
            raise HttpError(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"the body exceeds {BODY_LIMIT} bytes")
        body = self.rfile.read(int(length))
        if len(body) < int(length):
            raise EOFError
        return body

    def _send(self, response: HttpResponse) -> None:
        self.request_version = self.protocol_version  # also where the request was too malformed to have one
        self.send_response_only(response.status)
        self.send_header("Content-Type", response.content_type)
        self.send_header("Content-Length", str(len(response.body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(response.body)
        self.wfile.flush()

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> NoReturn:
        """Raise `HttpError`; called by the standard library for a request that it cannot parse."""
        raise HttpError(code, message or HTTPStatus(code).phrase)


class _Head:
    """Reads the first lines of an HTTP request (its head), together at most `HEAD_LIMIT` bytes."""

    def __init__(self, received: Any) -> None:  # Any: any buffered reader
        self._received = received
        self._left = HEAD_LIMIT

    def readline(self, limit: int = -1) -> bytes:
        """Return the next line of a request's head.

        Raises:
            HttpError: the head is too long.
            EOFError: the connection ended inside a line.
        """
        line: bytes = self._received.readline(self._left + 1)
        self._left -= len(line)
        if self._left < 0:
            raise HttpError(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, f"the head exceeds {HEAD_LIMIT} bytes")
        if not line.endswith(b"\n"):
            raise EOFError
        return line


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

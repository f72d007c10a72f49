"""One connection of the HTTP service: reads its request, and sends the response. The standard library parses.

Knows how a request is written, and its limits; knows no resource, and no other connection.
"""

import contextlib
import socket
from collections.abc import Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from typing import Any, Final, NoReturn, cast

from .http_messages import BODY_LIMIT, HEAD_LIMIT, HttpError, HttpRequest, HttpResponse

_SINGLE: Final = ("host", "content-length", "authorization")
"""Headers that a request may have only once: with two it would be unclear which one counts, so it is answered 400."""


class HttpConnection(BaseHTTPRequestHandler):
    """Handler of one HTTP connection: reads its request and writes the response."""

    protocol_version = "HTTP/1.1"
    wbufsize = -1  # head and body leave together
    server: Any  # the `HttpService`, which imports this file

    def handle(self) -> None:
        """Receive the request and send the response; a peer that disconnected or is too slow gets none."""
        with contextlib.suppress(OSError, EOFError):
            self._send(self._response())
            drain(self.connection)

    def finish(self) -> None:
        """Send the part of the response that is still buffered."""
        with contextlib.suppress(OSError):
            super().finish()

    def _response(self) -> HttpResponse:
        try:
            request = self._request()
            self.server.heard(self.connection)
            response: HttpResponse = self.server.answer(request)
            return response
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
        """Return the next line of a request's head, line end included. ``limit`` is ignored.

        Raises `HttpError` if the head exceeds `HEAD_LIMIT`, `EOFError` if the connection ends inside the line.
        """
        line: bytes = self._received.readline(self._left + 1)
        self._left -= len(line)
        if self._left < 0:
            raise HttpError(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, f"the head exceeds {HEAD_LIMIT} bytes")
        if not line.endswith(b"\n"):
            raise EOFError
        return line


def drain(accepted: socket.socket, last: bytes = b"") -> None:
    """Send ``last``, then discard bytes that were received and not read: else closing would reset the connection.

    Does not wait: bytes that the socket does not take at once are not sent, and at most 16 KiB are discarded. Errors of
    the socket are ignored.
    """
    with contextlib.suppress(OSError):
        accepted.setblocking(False)
        accepted.send(last)
        accepted.recv(2 * HEAD_LIMIT)

"""A small HTTP service in a thread of its own: for the status and the metrics of a program that is busy with its work.

Knows requests and answers of HTTP/1.1; knows nothing of what is asked. Who owns it says what is answered.

1. One request per connection; then it is closed. Nothing is kept alive, chunked, compressed or redirected.
2. Everything is bounded: bytes of head and body, seconds of the whole exchange, connections at once: one more takes the
   place of the oldest whose request is not there yet, or is answered 503. Whoever sends or reads slowly keeps nobody
   else from being answered. The last descriptors of the process are not taken: they are for Modbus.
3. It has an event loop of its own, so that a large answer, or many questions, never stand in the way of the owner's.
"""

import asyncio
import contextlib
import logging
import os
import socket
import threading
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field, replace
from http import HTTPStatus
from typing import Final

from ..errors import ConfigError, LinkDown
from ..transport.descriptors import is_reserved

_log = logging.getLogger("busway.http")

HEAD_LIMIT: Final = 8192
"""Bytes of request line and headers."""
BODY_LIMIT: Final = 4096
"""Bytes of a request's body; nothing that is asked here has one of any size."""
_BACKLOG: Final = 16
_PAUSE: Final = 60.0
"""Seconds between two lines about requests that could not be answered."""
_TURNS_TO_SETTLE: Final = 4
"""Turns of the loop until a connection that is being accepted stands, and until one that was closed has gone."""
_SINGLE: Final = frozenset({"host", "content-length", "authorization"})
"""Headers that would say two things if they stood twice."""


class HttpError(Exception):
    """A request that is answered with an error: a status and a sentence."""

    def __init__(self, status: int, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


@dataclass(frozen=True, slots=True)
class HttpRequest:
    """A request as it came.

    Attributes:
        method: ``GET``, ``POST``, …
        path: what is asked for, without the query.
        headers: by name in lower case.
        body: at most `BODY_LIMIT` bytes.
    """

    method: str
    path: str
    headers: Mapping[str, str] = field(default_factory=dict)
    body: bytes = b""


@dataclass(frozen=True, slots=True)
class HttpResponse:
    """An answer.

    Attributes:
        body: its bytes; ``content_type`` says how to read them.
        status: 200 if all is well.
    """

    body: bytes
    content_type: str = "text/plain; charset=utf-8"
    status: int = 200


@dataclass(frozen=True, slots=True)
class HttpLimits:
    """What one client may take.

    Attributes:
        request_seconds: from the accepted connection to the last byte of the request.
        seconds: from the accepted connection to the last byte of the answer.
        connections: at once.
    """

    request_seconds: float = 5.0
    seconds: float = 10.0
    connections: int = 16


class HttpService:
    """Answers on one listening socket from `start` to `stop`.

    Args:
        bound: a bound stream socket, which becomes the service's own.
        answer: gives the answer to a request, in the service's own event loop; `HttpError` answers with an error.
        admit: asked with each accepted socket; where it gives False the connection is closed unread.
        limits: `HttpLimits`.
        name: of the thread.
    """

    def __init__(
        self,
        bound: socket.socket,
        answer: Callable[[HttpRequest], Awaitable[HttpResponse]],
        *,
        admit: Callable[[socket.socket], bool] = lambda accepted: True,
        limits: HttpLimits | None = None,
        name: str = "busway http",
    ) -> None:
        self._bound = bound
        self._answer = answer
        self._admit = admit
        self._limits = limits or HttpLimits()
        self._tasks: set[asyncio.Task[None]] = set()
        self._unheard: dict[
            asyncio.Task[None], asyncio.WriteTransport
        ] = {}  # without a whole request, the oldest first
        self._told = -_PAUSE
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stopping: asyncio.Event | None = None
        self._started = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Listen, and answer from now on."""
        self._bound.listen(_BACKLOG)
        self._thread.start()
        self._started.wait()

    def stop(self) -> None:
        """End it: what is being answered is cut off. Blocks until the thread has gone; a second call does nothing."""
        if self._thread.ident is None:
            self._bound.close()
            return
        if self._loop is not None and self._stopping is not None:
            with contextlib.suppress(RuntimeError):  # the loop has gone already
                self._loop.call_soon_threadsafe(self._stopping.set)
        self._thread.join()

    # In the thread.

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        finally:
            self._bound.close()
            self._started.set()

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._stopping = asyncio.Event()
        listener = await asyncio.start_server(self._connected, sock=self._bound, limit=HEAD_LIMIT)
        self._started.set()
        try:
            await self._stopping.wait()
        finally:
            # asyncio forgets a connection that is just being accepted when its listener closes: let it arrive first.
            with contextlib.suppress(NotImplementedError):  # loops that do not accept by readiness
                self._loop.remove_reader(self._bound.fileno())
            await _settle()
            listener.close()
            for task in self._tasks:
                task.cancel()
            await _settle()

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        self._make_room()
        self._unheard[task] = writer.transport
        try:
            async with asyncio.timeout(self._limits.seconds):
                accepted = writer.get_extra_info("socket")
                if is_reserved(accepted.fileno()) or not self._admit(accepted):
                    return
                writer.write(encode_response(await self._respond(reader, task)))
                await writer.drain()
                writer.close()
                await writer.wait_closed()
        except (TimeoutError, OSError, EOFError):
            pass  # whoever asked has gone, or is too slow to be waited for
        finally:
            self._tasks.discard(task)
            self._unheard.pop(task, None)
            writer.transport.abort()

    def _make_room(self) -> None:
        """Where one is there too many, end the oldest whose request is not there yet."""
        if len(self._tasks) > self._limits.connections and self._unheard:
            oldest = next(iter(self._unheard))
            self._tasks.discard(oldest)
            self._unheard.pop(oldest).abort()

    async def _respond(self, reader: asyncio.StreamReader, task: "asyncio.Task[None]") -> HttpResponse:
        try:
            if len(self._tasks) > self._limits.connections:
                raise HttpError(HTTPStatus.SERVICE_UNAVAILABLE, "too many connections at once")
            async with asyncio.timeout(self._limits.request_seconds):
                request = await read_request(reader)
            self._unheard.pop(task, None)
            return await self._answer(request)
        except HttpError as error:
            return HttpResponse(f"{error}\n".encode(), status=error.status)
        except (OSError, EOFError):  # TimeoutError is one of them
            raise
        except Exception:
            now = time.monotonic()
            if now >= self._told + _PAUSE:
                self._told = now
                _log.exception("a request could not be answered; what follows within a minute is not said")
            return HttpResponse(b"it could not be answered\n", status=HTTPStatus.INTERNAL_SERVER_ERROR)


async def _settle() -> None:
    for _ in range(_TURNS_TO_SETTLE):
        await asyncio.sleep(0)


async def read_request(reader: asyncio.StreamReader) -> HttpRequest:
    """One request. Raises `HttpError` for what is none, `EOFError` where it ends too soon."""
    try:
        head = await reader.readuntil(b"\r\n\r\n")
    except asyncio.LimitOverrunError as error:
        raise HttpError(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, f"the head exceeds {HEAD_LIMIT} bytes") from error
    request = parse_head(head)
    if "transfer-encoding" in request.headers:
        raise HttpError(HTTPStatus.LENGTH_REQUIRED, "a body needs a Content-Length")
    length = request.headers.get("content-length", "0")
    if not (length.isascii() and length.isdigit()) or len(length) > 9:
        raise HttpError(HTTPStatus.BAD_REQUEST, "the Content-Length is no number")
    if int(length) > BODY_LIMIT:
        raise HttpError(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"the body exceeds {BODY_LIMIT} bytes")
    return replace(request, body=await reader.readexactly(int(length)))


def parse_head(head: bytes) -> HttpRequest:
    """Request line and headers. Raises `HttpError` 400."""
    lines = head.decode("latin-1").removesuffix("\r\n\r\n").split("\r\n")
    words = lines[0].split(" ")
    if len(words) != 3 or not words[2].startswith("HTTP/1.") or not words[1].startswith("/"):
        raise HttpError(HTTPStatus.BAD_REQUEST, "the first line is no request")
    headers: dict[str, str] = {}
    for line in lines[1:]:
        name, colon, value = line.partition(":")
        name = name.lower()
        if not colon or not name or name != name.strip() or (name in headers and name in _SINGLE):
            raise HttpError(HTTPStatus.BAD_REQUEST, "a header is broken, or stands twice")
        headers[name] = value.strip()
    return HttpRequest(words[0], words[1].partition("?")[0], headers)


def encode_response(response: HttpResponse) -> bytes:
    """The bytes of an answer."""
    status = HTTPStatus(response.status)
    head = (
        f"HTTP/1.1 {status.value} {status.phrase}\r\n"
        f"Content-Type: {response.content_type}\r\n"
        f"Content-Length: {len(response.body)}\r\n"
        "Cache-Control: no-store\r\n"
        "X-Content-Type-Options: nosniff\r\n"
        "Connection: close\r\n\r\n"
    )
    return head.encode("latin-1") + response.body


def parse_host_port(text: str, key: str) -> tuple[str, int]:
    """Host and port of ``127.0.0.1:9502`` or ``[::1]:9502``; port 0 takes a free one. Raises `ConfigError`."""
    host, colon, port = text.rpartition(":")
    is_bare = host.count(":") == 0 or (host.startswith("[") and host.endswith("]"))
    if not (colon and host and is_bare and port.isascii() and port.isdigit() and int(port) <= 65_535):
        raise ConfigError(f"an address such as 127.0.0.1:9502 is needed, not {text!r}", key=key)
    return host.strip("[]"), int(port)


def bind_tcp(host: str, port: int) -> socket.socket:
    """A bound TCP socket. Raises `LinkDown` where that cannot be."""
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        bound = socket.socket(family, socket.SOCK_STREAM)
        try:
            if os.name == "posix":  # elsewhere it would let two programs share one port
                bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            bound.bind(address)
        except BaseException:
            bound.close()
            raise
    except OSError as error:
        raise LinkDown(f"cannot listen on {host}:{port}: {error.strerror or error}") from error
    return bound


def bound_name(bound: socket.socket) -> str:
    """``127.0.0.1:9502``, as a TCP socket is bound."""
    host, port = bound.getsockname()[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"

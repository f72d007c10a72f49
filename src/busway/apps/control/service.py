"""The control service of a running server or gateway: answers HTTP requests for its status, reset and reload.

Knows resources and requests; knows no server: a `Subject` is any object with a status.

1. ``GET /`` lists the resources, ``GET /status`` is the whole status, ``GET /connections`` a part of it.
   ``GET /metrics`` exists if a function for metrics is given, ``POST /reload`` if one for reloading is given or the
   subject is `Reloadable`. ``POST /reset-counters`` works for a `Resettable` subject.
2. The subject is asked in its own event loop. If the loop does not answer within `GATHER_SECONDS` (`RELOAD_SECONDS` for
   a reload), the response is an error that says so.
3. Over loopback each request must carry the token and a ``Host`` of loopback, which a foreign web page cannot do.
   Requests with an ``Origin`` are refused.
"""

import asyncio
import concurrent.futures
import contextlib
import hmac
import inspect
import json
import logging
import os
from collections.abc import AsyncIterator, Callable
from http import HTTPStatus
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Protocol, Self, runtime_checkable

from ...errors import ConfigError, LinkDown, ModbusError
from ...observe.http import HttpLimits, HttpService
from ...observe.http_messages import HttpError, HttpRequest, HttpResponse
from ...version import __version__
from .addresses import OFF, ControlAddress, UnixAddress, control_directory, is_loopback, parse_control_address
from .control_socket import Bound, bind_default, bind_loopback, bind_unix, same_user
from .json_status import plain

_log = logging.getLogger("busway.apps.control")

GATHER_SECONDS: Final = 2.0
RELOAD_SECONDS: Final = 30.0
"""Time limit of a reload, in seconds; a reload reads files and certificates."""
_JSON: Final = "application/json"


class Subject(Protocol):
    """Interface of the server or gateway whose status a control service shows."""

    def status(self) -> Any:
        """Return the current status as a dataclass. Called in the event loop of the server or gateway.

        ``GET /connections`` shows its attribute ``connections``; nothing if it has none.
        """


@runtime_checkable
class Resettable(Protocol):
    """Interface of a server or gateway whose counters the control service can reset."""

    def reset_counters(self) -> None:
        """Set the counters of the server or gateway to zero; what single connections or links have counted stays.

        Nothing is closed. The class that has the method says which counters these are.
        """


@runtime_checkable
class Reloadable(Protocol):
    """Interface of a server or gateway that can read its files again while it runs."""

    async def reload(self) -> Any:
        """Read the files again, apply them, and return what changed, as data that `plain` converts to JSON.

        Raises:
            ModbusError: the files cannot be used; nothing has changed.
        """


ReloadCallback = Callable[[], Any]
"""A function or coroutine function that reads the files again; the client gets its result as JSON.

It is called without arguments in the subject's event loop.
"""
AnswerMetrics = Callable[[HttpRequest], HttpResponse]


class Control:
    """Control service of a server or gateway: answers requests for its status while the ``async with`` block runs::

        async with busway.serve(units={1: device}) as server, Control(server):
            ...

    Args:
        subject: a server, a gateway, or another object with a ``status()``.
        at: path of a Unix domain socket, or an address of loopback such as ``127.0.0.1:0``. None: a new socket in
            ``directory``.
        name: name of the program in its status, to tell several programs apart.
        directory: directory for token files, and for the socket if ``at`` is None; None for that of
            `control_directory`, where `busway status` looks.
        reload: function that reads the files again; None: the ``reload`` of a `Reloadable` subject, or no reload.
        metrics: function that answers requests for metrics, such as `MetricsEndpoint.answer`, called in a thread of
            the service; None: there are no metrics.

    Attributes:
        address: address of the service while it runs; None otherwise.

    Raises:
        ConfigError: ``at`` is not an address that `parse_control_address` accepts.
    """

    def __init__(
        self,
        subject: Subject,
        at: str | None = None,
        *,
        name: str = "server",
        directory: Path | None = None,
        reload: ReloadCallback | None = None,
        metrics: AnswerMetrics | None = None,
    ) -> None:
        self.address: ControlAddress | None = None
        self._subject = subject
        self._wanted = None if at is None else parse_control_address(at)
        self._name = name
        self._directory = directory
        self._reload = reload or (subject.reload if isinstance(subject, Reloadable) else None)
        self._metrics = metrics
        self._loop: asyncio.AbstractEventLoop | None = None
        self._bound: Bound | None = None
        self._token = ""
        self._service: HttpService | None = None
        self._asked: set[concurrent.futures.Future[Any]] = set()
        self._resources: dict[tuple[str, str], Callable[[HttpRequest], HttpResponse]] = {
            ("GET", "/"): self._index,
            ("GET", "/status"): self._status,
            ("GET", "/connections"): self._connections,
            ("POST", "/reset-counters"): self._reset_counters,
        }
        if self._metrics is not None:
            self._resources["GET", "/metrics"] = self._metrics
        if self._reload is not None:
            self._resources["POST", "/reload"] = self._reload_files

    async def start(self) -> None:
        """Open the control socket and start to answer requests; does nothing if it runs already.

        To be called in the subject's event loop.

        Raises:
            ConfigError: another file is at the path, the path is too long, this system has no Unix domain sockets, or
                the directory does not belong to the user alone.
            LinkDown: the address cannot be bound, or another program answers there.
        """
        if self._service is not None:
            return
        self._loop = asyncio.get_running_loop()
        bound = await asyncio.to_thread(self._bind)
        self._bound, self._token, self.address = bound, bound.token, bound.address
        self._service = HttpService(
            bound.socket,
            self._answer,
            admit=(lambda accepted: True) if bound.token else same_user,
            limits=HttpLimits(seconds=RELOAD_SECONDS + 5),
            name="busway control",
        )
        self._service.start()

    async def stop(self) -> None:
        """Stop answering, remove the control socket, and wait until the service's threads have ended.

        Requests that still wait for the event loop end with an error. Does nothing if the service does not run.
        """
        service, self._service = self._service, None
        bound, self._bound = self._bound, None
        self.address = None
        if bound is not None:
            bound.remove()
        for future in list(self._asked):
            future.cancel()
        if service is not None:
            # In a thread: a request may be waiting for this event loop.
            await asyncio.to_thread(service.stop)

    def _bind(self) -> Bound:
        if isinstance(self._wanted, UnixAddress):
            return bind_unix(self._wanted)
        directory = self._directory or control_directory()
        return bind_default(directory) if self._wanted is None else bind_loopback(self._wanted, directory)

    # In the threads of the service.

    def _answer(self, request: HttpRequest) -> HttpResponse:
        try:
            self._authorize(request)
            resource = self._resources.get((request.method, request.path))
            if resource is None:
                known = any(path == request.path for _, path in self._resources)
                status = HTTPStatus.METHOD_NOT_ALLOWED if known else HTTPStatus.NOT_FOUND
                raise HttpError(status, f"there is no {request.method} {request.path[:100]} here")
            return resource(request)
        except HttpError as error:
            return _json({"error": str(error)}, error.status)
        except ModbusError as error:
            return _json({"error": str(error)}, HTTPStatus.CONFLICT)

    def _authorize(self, request: HttpRequest) -> None:
        if "origin" in request.headers:
            raise HttpError(HTTPStatus.FORBIDDEN, "web pages are not answered")
        if not self._token:
            return  # the mode of the socket has authorized the client
        host = request.headers.get("host", "").rpartition(":")[0] or request.headers.get("host", "")
        if host != "localhost" and not is_loopback(host.strip("[]")):
            raise HttpError(HTTPStatus.FORBIDDEN, "the Host is not this one")
        given = request.headers.get("authorization", "").encode()
        if not hmac.compare_digest(given, f"Bearer {self._token}".encode()):
            raise HttpError(HTTPStatus.UNAUTHORIZED, "the token is missing or wrong")

    def _index(self, request: HttpRequest) -> HttpResponse:
        return _json({"resources": [f"{method} {path}" for method, path in self._resources]})

    def _status(self, request: HttpRequest) -> HttpResponse:
        status = plain(self._in_loop(self._subject.status))
        return _json({"name": self._name, "pid": os.getpid(), "version": __version__, "status": status})

    def _connections(self, request: HttpRequest) -> HttpResponse:
        status = self._in_loop(self._subject.status)
        return _json({"connections": plain(getattr(status, "connections", ()))})

    def _reset_counters(self, request: HttpRequest) -> HttpResponse:
        if not isinstance(self._subject, Resettable):
            raise HttpError(HTTPStatus.NOT_FOUND, "its counters cannot be reset")
        self._in_loop(self._subject.reset_counters)
        return _json({"reset": True})

    def _reload_files(self, request: HttpRequest) -> HttpResponse:
        assert self._reload is not None
        return _json({"reloaded": plain(self._in_loop(self._reload, RELOAD_SECONDS))})

    def _in_loop(self, work: Callable[[], Any], seconds: float = GATHER_SECONDS) -> Any:
        """Run a function or coroutine function in the subject's event loop, and return its result.

        Blocks until then; called in threads of the service.

        Args:
            work: the function, called without arguments; what it raises is raised here.
            seconds: how long to wait for the result; then a coroutine is cancelled.

        Raises:
            HttpError: the event loop has ended or `stop` was called (status 503), or the result did not come in time
                (504).
        """
        assert self._loop is not None

        async def done() -> Any:
            given = work()
            return await given if inspect.isawaitable(given) else given

        asked = done()
        try:
            future = asyncio.run_coroutine_threadsafe(asked, self._loop)
        except RuntimeError as error:  # the loop is closed
            asked.close()
            raise HttpError(HTTPStatus.SERVICE_UNAVAILABLE, "the program is about to end") from error
        self._asked.add(future)
        try:
            return future.result(seconds)
        except concurrent.futures.TimeoutError as error:
            future.cancel()
            raise HttpError(
                HTTPStatus.GATEWAY_TIMEOUT, f"the program's event loop did not answer within {seconds:g} s"
            ) from error
        except concurrent.futures.CancelledError as error:
            raise HttpError(HTTPStatus.SERVICE_UNAVAILABLE, "the program is about to end") from error
        finally:
            self._asked.discard(future)

    async def __aenter__(self) -> Self:
        await self.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.stop()


@contextlib.asynccontextmanager
async def open_control(
    subject: Subject,
    at: str | None = None,
    *,
    name: str = "server",
    reload: ReloadCallback | None = None,
    metrics: AnswerMetrics | None = None,
) -> AsyncIterator[Control | None]:
    """Context manager that runs a `Control` during its block and yields it; yields None if there is no control service.

    There is none if ``at`` is ``off``, or if ``at`` is None and the default socket cannot be opened, which is logged.

    Args:
        subject, name, reload, metrics: arguments of `Control`.
        at: argument of `Control`, or ``off``.

    Raises:
        ConfigError: the address ``at`` is invalid, or another file is there.
        LinkDown: the address ``at`` cannot be bound, or another program answers there.
    """
    if at == OFF:
        yield None
        return
    control = Control(subject, at, name=name, reload=reload, metrics=metrics)
    try:
        await control.start()
    except (ConfigError, LinkDown) as error:
        if at is not None:
            raise
        _log.warning("it runs without a control socket: %s", error)
        yield None
        return
    try:
        yield control
    finally:
        await control.stop()


def _json(content: Any, status: int = HTTPStatus.OK) -> HttpResponse:
    return HttpResponse(json.dumps(content, ensure_ascii=False).encode() + b"\n", _JSON, status)

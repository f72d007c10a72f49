"""Serves a web page and its HTTP API on one address, in the running event loop.

Knows sockets, the files of the page and the HTTP server; knows no resource.

1. On a loopback address no token is needed. On other addresses a token is created unless the user gives one. It is
   behind ``#`` in the URL of the page, a part that a browser does not send.
2. The page consists of files of this package alone: its content security policy (CSP) allows no other files, and no
   script within HTML.
3. Everything has a limit: connections, bytes of a request and of a message, seconds of an idle connection.
"""

import asyncio
import contextlib
import hashlib
import logging
import socket
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from importlib.resources import files
from types import TracebackType
from typing import Any, Final, Self, cast

import uvicorn
from fastapi import FastAPI
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route, WebSocketRoute

from ...errors import ConfigError
from ...observe.http import bind_tcp, bound_name
from ...options.endpoints import parse_endpoint
from ...options.text import host_and_port
from ...options.tls import TlsParameters
from ...transport.tls.context import WatchedContext, web_context
from ...transport.tls.roles import require_cryptography
from ..control.addresses import is_loopback
from .access import AccessToken, Application, Message, PageAccess, PageAccessRules, Receive, Role, Scope, Send
from .connections import SharedConnections, Throttle
from .operations import failed, new_application, secure_document
from .page_tokens import SHORTEST_TOKEN, is_token, new_token
from .simulation_api import Api
from .simulation_stream import Streams
from .simulation_subject import PageSubject
from .simulation_traffic import Traffic

_errors = logging.getLogger("busway.apps.web.errors")
"""Log of requests that failed with an unexpected error. Each message is logged at most once a minute, as a client can
repeat such a request without limit.
"""
_errors.addFilter(Throttle())

DEFAULT_ADDRESS: Final = "127.0.0.1:8502"
KEY: Final = "api"
_WISH_LIMIT: Final = 256 * 1024
"""Most bytes of a WebSocket message from a browser."""
_KEEP_ALIVE: Final = 15
_STOP_SECONDS: Final = 1
_FILES: Final = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/style.css": ("style.css", "text/css; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
    "/uplot/uPlot.min.css": ("uplot/uPlot.min.css", "text/css; charset=utf-8"),
    "/uplot/uPlot.esm.js": ("uplot/uPlot.esm.js", "text/javascript; charset=utf-8"),
    "/uplot/LICENSE": ("uplot/LICENSE", "text/plain; charset=utf-8"),
} | {
    f"/{name}.js": (f"{name}.js", "text/javascript; charset=utf-8")
    for name in ("app", "link", "points", "trends", "traffic", "faults", "status", "dom")
}
FilesByPath = Mapping[str, tuple[str, str]]
"""Static files of a page: by URL path, the file's name below the folder ``page`` and its content type."""
SHARED_FILES: Final[FilesByPath] = {
    path: _FILES[path]
    for path in (
        "/style.css",
        "/icon.svg",
        "/uplot/uPlot.min.css",
        "/uplot/uPlot.esm.js",
        "/uplot/LICENSE",
        "/link.js",
        "/dom.js",
    )
}
"""The files that every page has."""
_HEADERS: Final = (
    (
        b"content-security-policy",
        b"default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self';"
        b" base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    ),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
)


@dataclass(frozen=True, slots=True)
class _File:
    """One static file of the web page: its bytes, content type and HTTP ``ETag``."""

    content: bytes
    kind: str
    tag: str


class HostedPage(ABC):
    """Base class of web pages with an API; the page is served while the ``async with`` block lasts.

    Args:
        at: host and port to listen on; port 0 takes a free port.
        token: token that every request to the API must carry. None: no token is needed on a loopback address, and a new
            token is created on other addresses.
        key: name of the option that ``at`` comes from, for errors.
        tls: certificate and key for HTTPS, and the authority of clients' certificates; None for HTTP.

    Attributes:
        url: URL of the page, without the token; empty while the page is stopped.
        token: token that requests must carry; empty if no token is needed.

    Raises:
        ConfigError: the address is invalid, or the token is too short.
    """

    def __init__(self, at: str, *, token: str | None = None, key: str = KEY, tls: TlsParameters | None = None) -> None:
        if token is not None and not is_token(token):
            raise ConfigError(
                f"a token has at least {SHORTEST_TOKEN} characters, letters, digits, - . _ and ~ alone", key="token"
            )
        self._address = host_and_port(at, key)
        self._given = token
        self._tls = tls
        self.url: str = ""
        self.token: str = ""
        self._server: _Server | None = None
        self._task: asyncio.Task[None] | None = None
        self._opened = contextlib.ExitStack()

    @abstractmethod
    def application(self, rules: PageAccessRules) -> Application:
        """Return the ASGI application that serves page and API under these access rules; called by `start`."""

    def _lasting(self) -> contextlib.AbstractContextManager[object]:
        """Return a context manager that is entered while the page is served; a subclass may override it."""
        return contextlib.nullcontext()

    @property
    def page_url(self) -> str:
        """The URL to open in a browser, with the token behind ``#`` if a token is needed."""
        return f"{self.url}#token={self.token}" if self.token else self.url

    @property
    def announced_url(self) -> str:
        """The URL of the page for logs. It has a token that was created here, and no token that the user gave."""
        return self.url if self._given is not None else self.page_url

    def _rules(self, *, local: bool) -> PageAccessRules:
        """Return who may use the page. A subclass may override it.

        By default, these are callers with the page's token; all callers if no token was given and the address is a
        loopback address. Each of them may do everything.

        Args:
            local: whether the page listens on a loopback address.
        """
        self.token = self._given if self._given is not None else "" if local else new_token()
        if not self.token:
            return PageAccessRules(without_token=Role.CONFIGURE, is_loopback=local)
        tokens = (AccessToken.of(self.token, "token", Role.CONFIGURE),)
        return PageAccessRules(lambda: tokens, is_loopback=local)

    async def start(self) -> None:
        """Begin to serve the page and its API; does nothing if the page is being served already.

        Raises:
            LinkDown: the address cannot be bound.
            ConfigError: the page cannot begin, or its certificate cannot be used.
            MissingExtra: TLS needs a package that is not installed.
        """
        if self._task is not None:
            return
        context: WatchedContext | None = None
        if self._tls is not None:
            require_cryptography("the subject of a client's certificate")
            context = WatchedContext(self._tls, web_context, name="the page")
        bound = await asyncio.to_thread(bind_tcp, *self._address)
        with contextlib.ExitStack() as unless_started:
            unless_started.callback(bound.close)
            local = is_loopback(bound.getsockname()[0])
            rules = self._rules(local=local)
            self.url = f"{'http' if context is None else 'https'}://{_reachable_name(bound)}/"
            unless_started.enter_context(self._lasting())
            server = self._server = _Server(_configured(self.application(rules), context))
            self._task = asyncio.create_task(server.serve([bound]))
            try:
                await server.answering.wait()
            except asyncio.CancelledError:
                await self.stop()
                raise
            self._opened = unless_started.pop_all()

    async def stop(self) -> None:
        """Stop serving the page and close all connections; does nothing if the page is stopped."""
        task, self._task = self._task, None
        if task is not None and self._server is not None:
            self._server.should_exit = True
            await task
            left = (
                self._server.server_state.tasks
            )  # uvicorn cancels requests that take too long, and does not await them
            if left:
                await asyncio.wait(left)
        self._opened.close()
        self.url = ""

    async def __aenter__(self) -> Self:
        await self.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.stop()


class ControlPage(HostedPage):
    """The web page of a simulation with its API; it is served while the ``async with`` block lasts::

        async with ControlPage(simulation) as page:
            print(page.url)

    Args:
        subject: the running simulation.
        at: host and port to listen on; port 0 takes a free port.
        token: token that every request to the API must carry. None: no token is needed on a loopback address, and a new
            token is created on other addresses.
        name: name of the simulation, which the page shows.

    Attributes:
        traffic: the latest Modbus frames of the simulation; recorded while the page is served.
        api: the HTTP API of the simulation.
        streams: the WebSockets of the open pages.

    Raises:
        ConfigError: the address is invalid, the token is too short, or (from `start`) traffic is already recorded.
    """

    def __init__(
        self,
        subject: PageSubject,
        at: str = DEFAULT_ADDRESS,
        *,
        token: str | None = None,
        name: str = "simulation",
    ) -> None:
        super().__init__(at, token=token)
        self.traffic: Traffic = Traffic(self._ports)
        self.api: Api = Api(subject, self.traffic, name)
        self.streams: Streams = Streams(self.api)

    @contextlib.contextmanager
    def _lasting(self) -> Iterator[None]:
        self.traffic.start()
        try:
            yield
        finally:
            self.traffic.stop()

    def application(self, rules: PageAccessRules) -> Application:
        """Return the ASGI application that serves the simulation's page and API under these access rules."""
        inner = page_application(
            "busway simulator",
            "Values, faults and traffic of a simulated plant. The WebSocket /stream reports events as they happen.",
        )
        self.api.add_to(inner)
        inner.routes.append(WebSocketRoute("/stream", self.streams.serve))
        return guarded(inner, _FILES, rules)

    def _ports(self) -> set[int]:
        endpoints = [parse_endpoint(url) for url in self.api.server.endpoints]
        return {one.port for one in endpoints if one.port is not None}


def page_application(title: str, description: str) -> FastAPI:
    """Return a FastAPI application without routes. Unexpected errors of its routes are logged and answered with 500.

    Args:
        title: title of the OpenAPI document.
        description: description in the OpenAPI document.
    """
    return new_application(title, description, {Exception: _failed})


def guarded(inner: FastAPI, shown: FilesByPath, rules: PageAccessRules) -> Application:
    """Return the ASGI application of a page: an API, the files of the page, access rules and common HTTP headers.

    Args:
        inner: application with the routes of the API; routes for the files are added to it.
        shown: the files of the page; requests for them need no token.
        rules: who may use the page.
    """
    page = _read_files(shown)

    async def show_file(request: Request) -> Response:
        found = page[request.url.path]
        headers = {"ETag": found.tag, "Cache-Control": "no-cache"}
        if request.headers.get("if-none-match") == found.tag:
            return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
        return Response(found.content, media_type=found.kind, headers=headers)

    inner.routes.extend(Route(path, show_file) for path in page)
    secure_document(inner)
    return _with_headers(PageAccess(inner, rules, lambda path: path in page))


class _Server(uvicorn.Server):
    """The HTTP server of the page (uvicorn), changed to leave signals to the program and to report when it listens.

    Attributes:
        answering: set once the server listens.
    """

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self.answering = asyncio.Event()

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Handle no signals, such as Ctrl-C: the program handles them."""
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to listen for connections to the page."""
        await super().startup(sockets)
        self.answering.set()


class _HiddenTokens(logging.Filter):
    """Log filter that hides the values of headers that can carry a token: uvicorn logs all headers at DEBUG."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True, so that every record is logged. In a record of such a header, ``***`` replaces its value."""
        if isinstance(record.args, tuple) and len(record.args) == 2 and str(record.args[0]).lower() in _TOKEN_HEADERS:
            record.args = (record.args[0], "***")
        return True


_TOKEN_HEADERS: Final = frozenset({"authorization", "sec-websocket-protocol"})
_HIDDEN_TOKENS: Final = _HiddenTokens()


def _configured(application: Application, context: WatchedContext | None) -> uvicorn.Config:
    logging.getLogger("uvicorn.error").addFilter(_HIDDEN_TOKENS)  # the same again is not added
    protocols = SharedConnections().protocols(None if context is None else context.current)
    return uvicorn.Config(
        application,
        lifespan="off",
        log_config=None,
        access_log=False,
        log_level="warning",
        proxy_headers=False,
        server_header=False,
        http=cast("Any", protocols),  # a class is asked for, and called like any callable
        ws="websockets-sansio",
        ws_max_size=_WISH_LIMIT,
        timeout_keep_alive=_KEEP_ALIVE,
        timeout_graceful_shutdown=_STOP_SECONDS,
    )


def _read_files(shown: FilesByPath) -> dict[str, _File]:
    """Return the static files of a web page, by URL path."""
    place = files(__package__) / "page"
    found = {}
    for path, (name, kind) in shown.items():
        content = place.joinpath(name).read_bytes()
        found[path] = _File(content, kind, f'"{hashlib.sha256(content).hexdigest()[:16]}"')
    return found


def _with_headers(inner: Application) -> Application:
    """Return an ASGI application that passes requests to ``inner`` and adds the page's common HTTP headers."""

    async def application(scope: Scope, receive: Receive, send: Send) -> None:
        async def send_more(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers: list[tuple[bytes, bytes]] = [*message["headers"], *_HEADERS]
                if not any(name.lower() == b"cache-control" for name, _ in headers):
                    headers.append((b"cache-control", b"no-store"))
                message = {**message, "headers": headers}
            await send(message)

        await inner(scope, receive, send_more)

    return application


async def _failed(request: Request, error: Exception) -> Response:
    _errors.error("a request could not be answered", exc_info=error)
    return failed(HTTPStatus.INTERNAL_SERVER_ERROR, "it could not be answered; the log says why")


def _reachable_name(bound: socket.socket) -> str:
    """Return ``HOST:PORT`` of a socket for a browser's URL; the machine's name if it is bound to all addresses."""
    host, port = bound.getsockname()[:2]
    return f"{socket.gethostname()}:{port}" if host in ("0.0.0.0", "::") else bound_name(bound)

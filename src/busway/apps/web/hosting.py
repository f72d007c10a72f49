"""Serves a web page and its HTTP API on one address, in the running event loop.

Knows sockets and the HTTP server; knows no file and no resource of the page (`application` does).

1. On a loopback address no token is needed. On other addresses a token is created unless the user gives one. The URL
   for the browser has the token behind ``#``, a part that a browser does not send.
2. Everything has a limit: connections, bytes of a request and of a message, seconds of an idle connection.
"""

import asyncio
import contextlib
import logging
import socket
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from types import TracebackType
from typing import Any, ClassVar, Final, Self, cast

import uvicorn
from fastapi import FastAPI

from ...errors import ConfigError, LinkDown
from ...observe.http import bind_tcp, bound_name
from ...options.text import host_and_port
from ...options.tls import TlsParameters
from ...transport.tcp import network_kind
from ...transport.tls.context import web_context
from ...transport.tls.renewal import WatchedContext
from ...transport.tls.roles import require_cryptography
from ..control.addresses import is_loopback
from .access_tokens import SHORTEST_TOKEN, is_token, new_token
from .application import PageModule, guarded, page_resources
from .connections import SharedConnections
from .request_guard import AccessToken, AsgiApplication, PageAccessRules, Role

KEY: Final = "api"
_WISH_LIMIT: Final = 256 * 1024
"""Largest number of bytes in a WebSocket message from a browser."""
_KEEP_ALIVE: Final = 15
_STOP_SECONDS: Final = 1


class HostedPage(ABC):
    """Base class of web pages with an API; the page is served while the ``async with`` block lasts.

    Args:
        at: host and port to listen on; port 0 takes a free port.
        token: token that every request to the API must carry. None: no token is needed on a loopback address, and a new
            token is created on other addresses.
        key: name of the option that ``at`` comes from, for errors.
        tls: certificate and key for HTTPS, and the authority of clients' certificates; None for HTTP.

    Attributes:
        title, description: title and description of the OpenAPI document of the page's API.
        url: URL of the page, without the token; empty while the page is stopped.
        token: token that requests must carry; set by `start`. Empty if none is needed, or if a subclass has tokens of
            its own.

    Raises:
        ConfigError: the address is invalid, or the token is too short or has invalid characters.
    """

    title: ClassVar[str]
    description: ClassVar[str]

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
    def modules(self) -> Sequence[PageModule]:
        """Return the modules that the page shows, in the order of their views."""

    def resources(self) -> FastAPI:
        """Return the page's HTTP API as a FastAPI application, without the page's files and access rules."""
        return page_resources(self.title, self.description, self.modules())

    def application(self, rules: PageAccessRules) -> AsgiApplication:
        """Return the ASGI application that serves page and API under these access rules; called by `start`."""
        return guarded(self.resources(), [module.name for module in self.modules()], rules)

    def _lasting(self) -> contextlib.AbstractContextManager[object]:
        """Return a context manager that is entered while the page is served; a subclass may override it."""
        return contextlib.nullcontext()

    @property
    def page_url(self) -> str:
        """The URL to open in a browser, with the token behind ``#`` if a token is needed."""
        return f"{self.url}#token={self.token}" if self.token else self.url

    @property
    def announced_url(self) -> str:
        """The URL of the page for logs: with a token that `start` created, but without a token that the user gave."""
        return self.url if self._given is not None else self.page_url

    def _rules(self, *, local: bool) -> PageAccessRules:
        """Return the rules for who may use the page, and set `token`. Called by `start`; a subclass may override it.

        By default, callers with the page's token may use it; all callers may if no token was given and the address is a
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
            LinkDown: the address cannot be bound, or the system does not let the server listen there.
            ConfigError: the certificate cannot be used, or a subclass cannot begin, as with invalid tokens.
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
            task = self._task = asyncio.create_task(server.serve([bound]))
            task.add_done_callback(lambda _: server.answering.set())  # also if it fails before it listens
            try:
                await server.answering.wait()
            except asyncio.CancelledError:
                await self.stop()
                raise
            if task.done():
                failed, self.url, self._task = self.url, "", None
                try:
                    task.result()
                except OSError as error:
                    sentence = f"{failed} cannot be served: {error.strerror or error}"
                    raise LinkDown(sentence, kind=network_kind(error)) from error
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
    """Log filter that hides the values of headers that can carry a token; uvicorn logs all headers at level DEBUG."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True, so that every record is logged. In a record of such a header, ``***`` replaces its value."""
        if isinstance(record.args, tuple) and len(record.args) == 2 and str(record.args[0]).lower() in _TOKEN_HEADERS:
            record.args = (record.args[0], "***")
        return True


_TOKEN_HEADERS: Final = frozenset({"authorization", "sec-websocket-protocol"})
_HIDDEN_TOKENS: Final = _HiddenTokens()


def _configured(application: AsgiApplication, context: WatchedContext | None) -> uvicorn.Config:
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


def _reachable_name(bound: socket.socket) -> str:
    """Return ``HOST:PORT`` of a socket for a browser's URL; the machine's name if it is bound to all addresses."""
    host, port = bound.getsockname()[:2]
    return f"{socket.gethostname()}:{port}" if host in ("0.0.0.0", "::") else bound_name(bound)

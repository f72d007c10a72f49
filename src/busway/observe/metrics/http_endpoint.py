"""The HTTP endpoint of the metrics, ``GET /metrics``, for Prometheus to scrape.

Knows a source with a status and a collector over it; knows no server.

1. A scrape asks the source in its own event loop, for at most `ASK_SECONDS`: if the loop is stuck, or the source fails,
   the scrape says ``busway_up 0`` and still has the counts of requests.
2. The scraper chooses the format: OpenMetrics or the text format of Prometheus.
3. Read-only: a client that reaches the address sees numbers and can change nothing.
"""

import asyncio
import concurrent.futures
import logging
from collections.abc import Callable, Iterable
from http import HTTPStatus
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Protocol, Self, runtime_checkable

from ...errors import MissingExtra
from ...options.text import host_and_port
from ...pdu.functions import FunctionTable
from ...session.server_pipeline import RequestObserver
from ..http import HttpService, bind_tcp, bound_name
from ..http_messages import HttpError, HttpRequest, HttpResponse
from .observer import Classify, ClassifyByPriority, MetricsObserver, classify_by_listener
from .request_tally import RequestTally

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry

_log = logging.getLogger("busway.metrics")

ASK_SECONDS: Final = 2.0
"""Most seconds that a scrape waits for the status of its source."""


class MetricsSource(Protocol):
    """Interface of a server or gateway whose metrics are served."""

    def status(self) -> Any:
        """Return the current status: a dataclass like `busway.server.server.ServerStatus`; called in the event loop."""

    @property
    def functions(self) -> FunctionTable:
        """The table of function codes, with their messages, that the server decodes."""

    def observe(self, observer: RequestObserver) -> None:
        """Register an observer of the server's requests; only before the server is started."""


@runtime_checkable
class KnowsPriorityHosts(Protocol):
    """Interface of a server that can say which hosts are priority hosts, for a label of the metrics."""

    def is_priority(self, listener: str, host: str) -> bool:
        """Whether a host is a priority host of the listener with this URL."""


def start_metrics(
    source: MetricsSource,
    where: str,
    *,
    classify: Classify | None = None,
    links: Callable[[], Iterable[Any]] | None = None,
) -> "MetricsEndpoint":
    """Count the requests of a server or gateway from now on, and serve the metrics over HTTP.

    Call it in the event loop of the source, before the source is started::

        async with start_metrics(server, "127.0.0.1:9502"), server:
            ...

    Args:
        source: the server or gateway.
        where: address to listen on, ``127.0.0.1:9502``; port 0 takes a free one. Any client that reaches it can read.
        classify: returns the class of a client, a label of the requests. None: ``priority`` for the priority hosts of a
            source that knows them, ``line`` for serial lines, else ``other``.
        links: returns the status of connections that this process has opened itself, if metrics are to include them
            (`busway.client.open_connections.local_connections`).

    Raises:
        ConfigError: ``where`` is not an address, or the source runs already.
        MissingExtra: ``prometheus-client`` is not installed.
        LinkDown: the address cannot be bound.
    """
    return MetricsEndpoint(source, where, classify=classify, links=links)


class MetricsEndpoint:
    """The HTTP service that offers the metrics of one server or gateway; an async context manager that closes it.

    Attributes:
        url: URL to scrape.
        tally: the counts of requests.
    """

    def __init__(
        self,
        source: MetricsSource,
        where: str,
        *,
        classify: Classify | None = None,
        links: Callable[[], Iterable[Any]] | None = None,
    ) -> None:
        """Serve metrics over HTTP, and count requests; arguments and errors are those of `start_metrics`."""
        host, port = host_and_port(where, "metrics")
        need_prometheus()
        from .metric_families import ClientMetrics, ServerMetrics, registry_of

        self._source = source
        self._loop = asyncio.get_running_loop()
        bound = bind_tcp(host, port)
        try:
            observer = MetricsObserver(RequestTally(source.functions.codes()), classify=classify or _classify(source))
            source.observe(observer)
        except BaseException:
            bound.close()
            raise
        self.tally: RequestTally = observer.tally
        self._registry = registry_of(
            ServerMetrics(self._ask, self.tally),
            *(() if links is None else (ClientMetrics(links),)),
        )
        self.url: str = f"http://{bound_name(bound)}/metrics"
        self._service = HttpService(bound, self.answer, name="busway metrics")
        self._service.start()

    def answer(self, request: HttpRequest) -> HttpResponse:
        """Return the response to ``GET /metrics`` (or ``GET /``): the metrics as text.

        Blocks for up to `ASK_SECONDS`. Called in threads of this or another HTTP service, never in the source's event
        loop.

        Raises:
            HttpError: another path (404) or method (405).
        """
        if request.path not in ("/", "/metrics"):
            raise HttpError(HTTPStatus.NOT_FOUND, "there is nothing but /metrics")
        if request.method != "GET":
            raise HttpError(HTTPStatus.METHOD_NOT_ALLOWED, "metrics can only be read")
        return render(self._registry, request.headers.get("accept", ""))

    async def close(self) -> None:
        """Stop the HTTP service; returns when socket and threads are closed. A second call does nothing."""
        # In a thread: a scrape may just be waiting for this event loop.
        await asyncio.to_thread(self._service.stop)

    def _ask(self) -> Any:  # a status, as the source gives it
        """Return the source's status, asked for in its event loop; None if it fails, or the loop is closed or slow."""

        async def status() -> Any:
            return self._source.status()

        asking = status()
        try:
            future = asyncio.run_coroutine_threadsafe(asking, self._loop)
        except RuntimeError:  # the loop is closed
            asking.close()
            return None
        try:
            return future.result(ASK_SECONDS)
        except concurrent.futures.TimeoutError:
            future.cancel()
            return None
        except Exception as error:  # of a source that others have written
            _log.warning("a scrape has no status: %r", error)
            return None

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()


def need_prometheus() -> None:
    """Raise `MissingExtra` unless ``prometheus-client`` is installed."""
    try:
        import prometheus_client  # noqa: F401
    except ImportError as error:
        raise MissingExtra("prometheus-client", "metrics", purpose="metrics", key="metrics") from error


def render(registry: "CollectorRegistry", accept: str) -> HttpResponse:
    """Return all metrics of a registry as text, in the format that an ``Accept`` header prefers."""
    from prometheus_client.exposition import choose_encoder

    try:
        encode, content_type = choose_encoder(accept)
    except Exception:  # of a header that the library cannot parse: it raises errors of many types
        encode, content_type = choose_encoder("")
    return HttpResponse(encode(registry), content_type)


def _classify(source: MetricsSource) -> Classify:
    return ClassifyByPriority(source.is_priority) if isinstance(source, KnowsPriorityHosts) else classify_by_listener

"""Makes the metrics: turns status, counters and `RequestTally` into Prometheus metric families at each scrape.

Knows the shape of a status and the names of metrics; knows no server and no socket.

1. Names begin with ``busway_``; they contain units (seconds, bytes), counters end in ``_total``.
2. A new whole number in counters or in a listener's status needs no code here: it becomes a counter of its name. One
   that can decrease belongs into `_GAUGES`.
3. Values of labels come from the program or from a bounded set (listeners, endpoints, upstreams, pools, states, units,
   functions, exception codes, rules, reasons). A client cannot choose them freely.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from itertools import accumulate
from typing import Any, Final

from prometheus_client import CollectorRegistry
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    InfoMetricFamily,
    StateSetMetricFamily,
)
from prometheus_client.registry import Collector

from ...version import __version__
from .request_tally import BUCKETS, RequestTally

# What prometheus-client calls a family of metrics; each of its kinds is made and filled in another way.
Family = Any

_COUNTERS: Final[dict[str, tuple[str, str]]] = {
    "accepted": ("connections_accepted", "Connections that were given a place."),
    "unauthorized": ("connections_unauthorized", "Connections closed unread: the address is not authorized."),
    "no_longer_authorized": (
        "connections_no_longer_authorized",
        "Connections ended: a change of the address lists no longer authorizes the address.",
    ),
    "closed": ("connections_closed", "Connections that have ended."),
    "evicted": ("connections_evicted", "Connections closed to make room for others."),
    "broken_streams": ("broken_streams", "Connections closed because what came could not be followed any more."),
    "frame_timeouts": ("frame_timeouts", "Connections closed because a request began and did not end in time."),
    "reading_paused": ("reading_paused", "Times that a client did not take its replies and was not read from."),
    "responder_failures": ("responder_failures", "Requests answered 04 because a responder failed."),
    "requests": ("received_requests", "Requests that came in, answered or not."),
    "discarded_frames": ("discarded_frames", "Frames that got no answer: foreign, damaged, or replies."),
    "refused_busy": ("requests_refused_busy", "Requests answered 06 because all transaction slots were taken."),
    "refused_full": ("connections_refused_full", "Connections closed at once: no slot could be freed."),
    "header_timeouts": ("header_timeouts", "Connections closed because a header began and did not end in time."),
    "write_timeouts": ("write_timeouts", "Connections closed because a client did not take its replies in time."),
    "idle_timeouts": ("idle_timeouts", "Connections closed because they were not used."),
    "rate_limited": ("rate_limited", "Times that a host asked more often than it may."),
}
"""Metric name (without ``busway_``) and help text of the counters of a server, by the name of their field.

The metric of a field that is not listed has the field's name.
"""
_CLASS_COUNTERS: Final[dict[str, tuple[str, str]]] = {
    "received": ("received_bytes", "Bytes received, by class of device."),
    "sent": ("sent_bytes", "Bytes sent, by class of device."),
    "accepted": ("class_connections_accepted", "Connections that were given a place, by class of device."),
    "closed": ("class_connections_closed", "Connections that have ended, by class of device."),
    "requests": ("class_received_requests", "Requests that came in, by class of device."),
}
"""Metric name (without ``busway_``) and help text of the counters kept for each class of hosts, by field name."""
_GAUGES: Final = frozenset({"priority_connections", "other_connections"})
"""Integer fields of a listener's status that can decrease, so they are no counters.

The metric ``busway_connections`` shows them instead.
"""
_CONNECTION_GAUGES: Final = (
    ("supported_connections", "Connections that there may be."),
    ("remote_connections", "Connections that others have opened."),
    ("local_connections", "Connections that this program has opened."),
)
_LINK_GAUGES: Final = (
    ("in_flight", "requests_in_flight", "Requests whose reply is awaited."),
    ("queued", "requests_queued", "Calls that wait for their turn."),
)
_LINK_COUNTERS: Final = (
    ("sent_bytes", "sent_bytes", "Bytes sent to the device."),
    ("received_bytes", "received_bytes", "Bytes received from the device."),
    ("transactions", "transactions", "Requests that were sent."),
    ("failures", "failures", "Requests without a good reply, and connections that were lost."),
    ("connections", "connections", "Connections that there were."),
)
_INDICATOR_STATES: Final = ("off", "on", "flashing")


class ServerMetrics(Collector):
    """Prometheus collector that creates the metrics of one server or gateway at each scrape.

    Args:
        ask: returns the status of the server; None if it does not answer.
        tally: counts of requests; None if they are not counted.
    """

    def __init__(
        self,
        ask: Callable[[], Any],  # a status: a dataclass like busway.server.server.ServerStatus
        tally: RequestTally | None = None,
    ) -> None:
        self._ask = ask
        self._tally = tally

    def collect(self) -> Iterator[Family]:
        """Yield the current metrics of the server or gateway as metric families."""
        yield InfoMetricFamily("busway", "The version that runs.", value={"version": __version__})
        status = self._ask()
        yield GaugeMetricFamily("busway_up", "Whether the server's event loop answered in time.", value=bool(status))
        if status is not None:
            yield from server_families(status)
            yield from connection_families(getattr(status, "connections", ()), getattr(status, "listeners", ()))
            yield from listener_families(getattr(status, "listeners", ()))
            yield from security_families(getattr(status, "listeners", ()))
            yield from gateway_listener_families(getattr(status, "gateway_listeners", ()))
            yield from upstream_families(getattr(status, "upstreams", ()))
            yield from refusal_families(_refusals(status))
        if self._tally is not None:
            yield from request_families(self._tally)


def _refusals(status: Any) -> Counter[str]:
    """Return the number of refused requests by rule name: of a server, or of all listeners of a gateway."""
    servers = [one.server for one in getattr(status, "gateway_listeners", ())] or [status]
    found: Counter[str] = Counter()
    for one in servers:
        found.update(getattr(one, "refusals", {}))
    return found


def refusal_families(refusals: Mapping[str, int]) -> Iterator[Family]:
    """Yield the metric families of denied requests: all of them, and by rule.

    The first is there from the start, because Prometheus sees no increase in a series whose first value it has not
    seen. A rule has no series before its first refusal: a policy may have 100 000 rules.
    """
    denied = sum(refusals.values())
    yield CounterMetricFamily("busway_requests_denied", "Requests that the policy refused.", value=denied)
    if refusals:
        yield _by_label("busway_policy_refusals", "Requests that a rule of the policy refused.", "rule", refusals)


class ClientMetrics(Collector):
    """Prometheus collector that creates the metrics of this process's client connections at each scrape.

    Args:
        ask: returns the status of each connection, as `busway.client.open_connections.local_connections` does.
    """

    def __init__(self, ask: Callable[[], Iterable[Any]]) -> None:  # dataclasses like LocalConnectionStatus
        self._ask = ask

    def collect(self) -> Iterator[Family]:
        """Yield the current metrics of the client connections as metric families."""
        links = list(self._ask())
        states: Counter[tuple[str, str]] = Counter((one.endpoint, one.state) for one in links)
        held = GaugeMetricFamily("busway_links", "Links to devices, by their state.", labels=("endpoint", "state"))
        for labels, count in states.items():
            held.add_metric(labels, count)
        yield held
        for field, name, meaning in _LINK_GAUGES:
            yield _summed(GaugeMetricFamily(f"busway_link_{name}", meaning, labels=("endpoint",)), links, field)
        for field, name, meaning in _LINK_COUNTERS:
            yield _summed(CounterMetricFamily(f"busway_link_{name}", meaning, labels=("endpoint",)), links, field)


def _summed(family: Family, links: Iterable[Any], field: str) -> Family:
    """Add one sample for each endpoint to a metric family: the sum of a field over its links. Returns the family.

    ``links``: `busway.client.open_connections.LocalConnectionStatus` objects.
    """
    sums: Counter[str] = Counter()
    for one in links:
        sums[one.endpoint] += getattr(one, field)
    for endpoint, count in sums.items():
        family.add_metric((endpoint,), count)
    return family


def registry_of(*collectors: Collector) -> CollectorRegistry:
    """Return a new Prometheus registry with these collectors."""
    registry = CollectorRegistry()
    for collector in collectors:
        registry.register(collector)
    return registry


def server_families(status: Any) -> Iterator[Family]:
    """Yield the metric families of a server as a whole: whether it runs, uptime, numbers of connections, counters.

    ``status``: the status of a server or gateway, with ``running`` and ``uptime``; what else it does not have is left
    out.
    """
    yield GaugeMetricFamily("busway_running", "Whether it answers requests.", value=bool(status.running))
    yield GaugeMetricFamily("busway_uptime_seconds", "Seconds since the start.", value=status.uptime)
    for field, meaning in _CONNECTION_GAUGES:
        count = getattr(status, field, None)
        if count is not None:
            yield GaugeMetricFamily(f"busway_{field}", meaning, value=count)
    counters = getattr(status, "counters", None)
    if counters is None:
        return
    for name, count in _numbers(counters):
        known, meaning = _COUNTERS.get(name, (name, f"{name.replace('_', ' ').capitalize()} so far."))
        yield CounterMetricFamily(f"busway_{known}", meaning, value=count)
    yield from class_families(counters)


def class_families(counters: Any) -> Iterator[Family]:
    """Yield the metric families of counters kept separately for priority hosts and for other hosts.

    ``counters``: a `busway.server.server_counters.ServerCounters`; the label is the name of its field, ``priority`` or
    ``other``.
    """
    families: dict[str, Family] = {}
    for field in fields(counters):
        for name, count in _numbers(getattr(counters, field.name)):
            known, meaning = _CLASS_COUNTERS.get(name, (f"class_{name}", f"{name.replace('_', ' ').capitalize()}."))
            family = families.get(known)
            if family is None:
                family = families[known] = CounterMetricFamily(f"busway_{known}", meaning, labels=("peer_class",))
            family.add_metric((field.name,), count)
    yield from families.values()


def connection_families(connections: Iterable[Any], listeners: Iterable[Any]) -> Iterator[Family]:
    """Yield the metric families with the numbers of connections by listener and pool, and of requests that wait.

    Args:
        connections: `busway.server.status.ConnectionStatus` objects.
        listeners: `busway.server.status.ListenerStatus` objects; a network listener without connections has 0.
    """
    held: Counter[tuple[str, str]] = Counter()
    waiting: Counter[str] = Counter()
    for listener in listeners:
        if not listener.endpoint.partition("://")[2].startswith("/"):  # no serial port
            held.update({(listener.endpoint, "priority"): 0, (listener.endpoint, "other"): 0})
            waiting[listener.endpoint] = 0
    for one in connections:
        held[one.listener, plain_word(getattr(one, "pool", "other"))] += 1
        waiting[one.listener] += one.waiting
    family = GaugeMetricFamily("busway_connections", "Connections that there are.", labels=("listener", "pool"))
    for labels, count in held.items():
        family.add_metric(labels, count)
    yield family
    family = GaugeMetricFamily("busway_requests_waiting", "Requests that wait for a handler.", labels=("listener",))
    for listener, count in waiting.items():
        family.add_metric((listener,), count)
    yield family


def listener_families(listeners: Iterable[Any]) -> Iterator[Family]:
    """Yield the metric families of listeners: state, status indicators and counters.

    State: whether each is open, and whether a unit is in listen-only mode. Counters: the listener's own, and the
    diagnostic counters of function 08. ``listeners``: `busway.server.status.ListenerStatus` objects.
    """
    indicators = StateSetMetricFamily(
        "busway_listener_indicator", "What the status indicators show.", labels=("listener", "indicator")
    )
    is_open = GaugeMetricFamily("busway_listener_open", "Whether it can be reached.", labels=("listener",))
    muted = GaugeMetricFamily(
        "busway_listener_listen_only",
        "Whether one of its units answers nothing until it is restarted.",
        labels=("listener",),
    )
    counted: dict[str, Family] = {}
    for one in listeners:
        for indicator in fields(one.indicators):
            shown = getattr(one.indicators, indicator.name).value
            indicators.add_metric(
                (one.endpoint, indicator.name), {state: state == shown for state in _INDICATOR_STATES}
            )
        is_open.add_metric((one.endpoint,), one.is_open)
        muted.add_metric((one.endpoint,), one.listen_only)
        for name, count in (*_numbers(one), *_numbers(one.counters)):
            if name in _GAUGES:
                continue
            family = counted.get(name)
            if family is None:
                meaning = f"{name.replace('_', ' ').capitalize()} of the listener."
                family = counted[name] = CounterMetricFamily(f"busway_listener_{name}", meaning, labels=("listener",))
            family.add_metric((one.endpoint,), count)
    yield from (indicators, is_open, muted, *counted.values())


def security_families(listeners: Iterable[Any]) -> Iterator[Family]:
    """Yield the metric families of certificates and TLS handshakes of ``tls://`` listeners, if there are any.

    ``listeners``: `busway.server.status.ListenerStatus` objects; those without ``security`` are left out.
    """
    secured = [one for one in listeners if getattr(one, "security", None) is not None]
    if not secured:
        return
    expiry = GaugeMetricFamily(
        "busway_certificate_expiry_timestamp_seconds",
        "When the certificate expires, in seconds since 1970.",
        labels=("listener",),
    )
    handshakes = CounterMetricFamily("busway_handshakes", "Handshakes of TLS.", labels=("listener", "outcome"))
    reloads = CounterMetricFamily("busway_certificate_reloads", "Times that it was read anew.", labels=("listener",))
    for one in secured:
        security = one.security
        expiry.add_metric((one.endpoint,), security.not_after)
        handshakes.add_metric((one.endpoint, "established"), security.established)
        for reason, count in security.refused.items():
            handshakes.add_metric((one.endpoint, reason), count)
        reloads.add_metric((one.endpoint,), security.reloads)
    yield from (expiry, handshakes, reloads)


def gateway_listener_families(listeners: Iterable[Any]) -> Iterator[Family]:
    """Yield the metric families of a gateway's listeners: requests that were not forwarded, and broadcasts.

    ``listeners``: `busway.apps.gateway.status.GatewayListenerStatus` objects.
    """
    yield from _counters_of("gateway_listener", "listener", listeners, "Requests at the listener")


def upstream_families(upstreams: Iterable[Any]) -> Iterator[Family]:
    """Yield the metric families of a gateway's upstreams: outcomes of requests, queues, states of connections.

    Nothing if there are no upstreams. ``upstreams``: `busway.apps.gateway.upstream.UpstreamStatus` objects.
    """
    upstreams = list(upstreams)
    if not upstreams:
        return
    yield from _counters_of("upstream", "upstream", upstreams, "Requests of the upstream")
    queued = GaugeMetricFamily("busway_upstream_queued", "Requests that wait for their turn.", labels=("upstream",))
    flying = GaugeMetricFamily("busway_upstream_in_flight", "Requests whose reply is awaited.", labels=("upstream",))
    late = CounterMetricFamily(
        "busway_upstream_late_replies", "Replies that came too late; dropped.", labels=("upstream",)
    )
    markers = CounterMetricFamily(
        "busway_upstream_markers", "Requests of the gateway's own, to units that owe replies.", labels=("upstream",)
    )
    doubt = GaugeMetricFamily("busway_upstream_units_in_doubt", "Units that owe replies.", labels=("upstream",))
    silent = GaugeMetricFamily("busway_upstream_suspended_units", "Units that are not asked now.", labels=("upstream",))
    states = GaugeMetricFamily(
        "busway_upstream_connections", "Connections of the upstream, by their state.", labels=("upstream", "state")
    )
    for one in upstreams:
        queued.add_metric((one.name,), sum(link.queued for link in one.links))
        flying.add_metric((one.name,), sum(link.in_flight for link in one.links))
        late.add_metric((one.name,), sum(link.counters.late_replies for link in one.links))
        markers.add_metric((one.name,), sum(link.counters.markers for link in one.links))
        doubt.add_metric((one.name,), sum(len(link.in_doubt) for link in one.links))
        silent.add_metric((one.name,), sum(len(link.suspended) for link in one.links))
        for state, count in Counter(link.state for link in one.links).items():
            states.add_metric((one.name, state), count)
    yield from (queued, flying, late, markers, doubt, silent, states)


def _counters_of(prefix: str, label: str, parts: Iterable[Any], meaning: str) -> Iterator[Family]:
    """Yield a metric family for each counter of ``parts``, with a sample for each part.

    Args:
        prefix: beginning of the metrics' names, after ``busway_``.
        label: name of the label whose value is a part's name.
        parts: objects with a ``name``, and with ``counters``, a dataclass of integers.
        meaning: beginning of the help texts.
    """
    families: dict[str, Family] = {}
    for one in parts:
        for name, count in _numbers(one.counters):
            family = families.get(name)
            if family is None:
                family = families[name] = CounterMetricFamily(
                    f"busway_{prefix}_{name}", f"{meaning}: {name.replace('_', ' ')}.", labels=(label,)
                )
            family.add_metric((one.name,), count)
    yield from families.values()


def request_families(tally: RequestTally) -> Iterator[Family]:
    """Yield the metric families of answered requests, their durations, and unanswered requests."""
    answered = CounterMetricFamily(
        "busway_requests", "Answered requests.", labels=("peer_class", "unit", "function", "exception")
    )
    for series in tally.all_series():
        answered.add_metric((series.peer_class, series.unit, series.function, series.exception), series.count)
    yield answered
    took = HistogramMetricFamily(
        "busway_request_duration_seconds", "Seconds from a request to its answer.", labels=("function",)
    )
    for durations in tally.all_durations():
        sums = accumulate(durations.counts)
        bounds = (*map(str, BUCKETS), "+Inf")
        took.add_metric((durations.function,), list(zip(bounds, sums, strict=True)), durations.total)
    yield took
    unanswered = {why.value: count for why, count in tally.unanswered_counts().items()}
    yield _by_label("busway_requests_unanswered", "Requests that a handler gave no answer.", "reason", unanswered)


def _by_label(name: str, meaning: str, label: str, counts: Mapping[str, int]) -> Family:
    family = CounterMetricFamily(name, meaning, labels=(label,))
    for value, count in counts.items():
        family.add_metric((str(value),), count)
    return family


def _numbers(counters: Any) -> Iterator[tuple[str, int]]:
    """Yield name and value of each integer field of a dataclass of counters; nothing for other objects."""
    if is_dataclass(counters):
        for field in fields(counters):
            value = getattr(counters, field.name)
            if isinstance(value, int) and not isinstance(value, bool):
                yield field.name, value


def plain_word(value: object) -> str:
    """Return a value as the text of a label; for an enum member its value."""
    return str(value.value if isinstance(value, Enum) else value)

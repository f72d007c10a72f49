"""The metrics of one collector in its fleet, for the page with metrics and last values that Prometheus scrapes.

Knows the collector of a fleet and the families of prometheus-client (``busway[metrics]``), loaded when used.
"""

from collections.abc import Iterator
from dataclasses import asdict
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .fleet_collector import FleetCollector


def fleet_families(fleet: "FleetCollector") -> Iterator[Any]:
    """Yield the metric families of prometheus-client that show the state of one collector in its fleet.

    The families of the stream are left out for a collector without a stream. May be called from any thread.
    """
    core = import_module("prometheus_client.core")
    member = fleet.member
    owned = list(member.owned)

    def gauge(name: str, text: str, value: float) -> Any:
        return core.GaugeMetricFamily(f"busway_fleet_{name}", text, value=value)

    yield gauge("shards", "Shards that this collector owns.", len(owned))
    yield gauge("load", "Seconds of line time in a second that they need.", sum(map(member.cost, owned)))
    yield gauge("may_own", "0 while it may own none: a wrong clock, another process of its name.", not member.problem)
    yield gauge("coordinator_up", "0 while the coordinator does not confirm its changes.", fleet.is_confirmed)
    yield gauge("configuration_revision", "Revision of the configuration that it works by.", fleet.revision)
    events = core.CounterMetricFamily("busway_fleet_leases", "What happened to its leases.", labels=["event"])
    for event, count in asdict(member.counts).items():
        events.add_metric([event], count)
    yield events
    yield core.CounterMetricFamily(
        "busway_fleet_unowned_seconds",
        "Seconds in which links that it took had no owner, all links together.",
        value=fleet.unowned_seconds,
    )
    status = None if fleet.outbox is None else fleet.outbox.status()
    if status is not None:
        yield gauge("behind_commits", "Commits of its store that not all sinks have.", fleet.behind)
        yield gauge("stream_up", "0 while the stream gets no samples; they wait in the store.", not status.error)
        yield core.CounterMetricFamily(
            "busway_fleet_messages", "Messages with samples that the stream has taken.", value=status.messages
        )
        yield core.CounterMetricFamily(
            "busway_fleet_lost_samples", "Samples deleted before all sinks of the stream had them.", value=status.lost
        )

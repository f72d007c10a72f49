"""Serves the page of a running collector and prints its status, for `busway collect`, its demonstration and fleets."""

from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

from ..errors import LinkDown, ModbusError
from ..extras import missing_extra
from ..values.counts import counted
from .output import print_json, say, warn

if TYPE_CHECKING:
    from ..apps.collector.collector import Collector
    from ..apps.collector.configuration import CollectorConfiguration
    from ..apps.collector.knowledge import Knowledge
    from ..apps.fleet.zone_watch import ZoneWatch
    from ..apps.web.collector_page import CollectorPage

    Newest = Callable[[], Awaitable[int | None]]


async def open_page(
    stack: AsyncExitStack, collector: "Collector", zone: "ZoneWatch | None" = None, newest: "Newest | None" = None
) -> None:
    """Serve the collector's web page until ``stack`` closes, and print its address; print a warning if that fails.

    Also notes the collector for `busway status`, which finds it and its page until ``stack`` closes.

    Args:
        stack: exit stack that stops the page when it closes.
        collector: the running collector; its file has the address of the page, or ``off`` for no page.
        zone: what is known of the zone, for a collector of a fleet; None: the page has no tab about a fleet.
        newest: function that returns the number of the newest message in the zone's stream, to show how far sinks are
            behind; None without a stream.
    """
    at, page = collector.configuration.file.collector.page, None
    try:
        page = None if at == "off" else await _open_page_at(at, stack, collector, zone, newest)
    except ModbusError as error:
        warn(f'no page: {error}; [collector] page = "off", or another address, in {collector.configuration.name}')
    _announce(stack, collector, page, is_in_fleet=zone is not None)


async def open_demo_page(stack: AsyncExitStack, collector: "Collector") -> None:
    """Serve the page of the demonstration, on a free port if its port is taken; if that fails, print a warning."""
    at, page = collector.configuration.file.collector.page, None
    try:
        try:
            page = await _open_page_at(at, stack, collector)
        except LinkDown:
            host, _, port = at.rpartition(":")
            warn(f"port {port} is taken; the page takes another")
            page = await _open_page_at(f"{host}:0", stack, collector)
    except ModbusError as error:
        warn(f"no page: {error}")
    _announce(stack, collector, page, is_in_fleet=False)


def _announce(
    stack: AsyncExitStack, collector: "Collector", page: "CollectorPage | None", *, is_in_fleet: bool
) -> None:
    """Note the collector for `busway status` until ``stack`` closes, and print the address of its page, if any."""
    from ..apps.collector.running_notes import noted

    configuration, url = collector.configuration, "" if page is None else page.url
    stack.enter_context(noted(configuration.name, configuration.store, url, is_in_fleet=is_in_fleet))
    if page is not None:
        say(f"page on {url} (tokens that permit more than to view: {page.token_path})")


async def _open_page_at(
    at: str,
    stack: AsyncExitStack,
    collector: "Collector",
    zone: "ZoneWatch | None" = None,
    newest: "Newest | None" = None,
) -> "CollectorPage":
    """Serve the collector's web page until ``stack`` closes, and return the page.

    Args:
        at: host and port; port 0 takes a free one.
        stack: exit stack that stops the page.
        collector: the running collector.
        zone, newest: arguments of `open_page`.

    Raises:
        LinkDown: the address is taken or cannot be bound.
        ConfigError: the address is invalid.
        MissingExtra: a package for pages is not installed.
    """
    try:
        from ..apps.web.collector_page import CollectorPage

        fleet = None
        if zone is not None:
            from ..apps.web.fleet_page import FleetApi

            fleet = FleetApi(zone, newest)
    except ImportError as error:
        raise missing_extra(error) or error from error
    return await stack.enter_async_context(CollectorPage(collector, at, fleet))


def warn_of_loads(configuration: "CollectorConfiguration", knowledge: "Knowledge") -> None:
    """Print a warning for each poll period that a link cannot keep; it is polled all the same.

    Args:
        configuration: the links and devices, of a fleet those of all collectors.
        knowledge: what was learnt about the devices; their read plans depend on it.
    """
    for load in configuration.loads(knowledge):
        for problem in load.problems:
            warn(f"warning: {problem}")


def print_status(collector: "Collector", *, as_json: bool) -> None:
    """Print the status of a collector on stdout: samples kept and lost, load of links, sinks, and devices in trouble.

    Args:
        collector: the running collector.
        as_json: True prints one JSON object, which has all devices; False prints lines.
    """
    store, devices = collector.store_status(), collector.status()
    if as_json:
        print_json(
            {
                "samples": store.samples,
                "waiting": store.waiting,
                "lost": store.lost,
                "error": store.error,
                "sinks": [
                    {"name": each.name, "sent": each.sent, "lost": each.lost, "set_aside": each.set_aside,
                     "error": each.error}
                    for each in collector.sink_statuses()
                ],
                "links": {
                    name: {"busy": round(busy, 4), "probing": round(probing, 4)}
                    for name, (busy, probing) in collector.loads().items()
                },
                "devices": [
                    {"name": each.name, "link": each.link, "state": each.state, "reads": each.reads,
                     "failures": each.failures, "skipped": each.skipped, "last_error": each.last_error,
                     "unread": list(each.unread)}
                    for each in devices
                ],
            }
        )  # fmt: skip
        return
    lost = f", {store.lost} lost: {store.error or 'the store could not be written'}" if store.lost else ""
    if store.error is not None:
        why = "" if store.lost else f": {store.error}"
        lost += f", {store.waiting} waiting because the store cannot be written{why}"
    polled = sum(each.state == "polled" for each in devices)
    kept = counted(store.samples, "sample")
    print(f"{kept} kept{lost}; {polled} of {len(devices)} devices answer", flush=True)
    for name, (busy, probing) in collector.loads().items():
        share = f"{100 * probing:.1f} % for probes of silent devices"
        print(f"  link {name}: {100 * busy:.0f} % busy, {share}", flush=True)
    for sink in collector.sink_statuses():
        error = f": {sink.error}" if sink.error else ""
        print(f"  sink {sink.name}: {counted(sink.sent, 'sample')} sent, {sink.lost} lost{error}", flush=True)
    for each in devices:
        if each.state != "polled" or each.skipped:
            skipped = f", {each.skipped} rounds skipped" if each.skipped else ""
            error = f": {each.last_error}" if each.last_error and each.state != "polled" else ""
            print(f"  device {each.name}: {each.state}{skipped}{error}", flush=True)
        if each.unread:
            more = f" and {len(each.unread) - 1} more" if len(each.unread) > 1 else ""
            print(f"  device {each.name} is not asked for {each.unread[0]}{more}", flush=True)

"""``busway demo``: a small plant on a serial line, a gateway in front of it, and a client that polls it over TCP.

1. Devices, gateway and client talk real Modbus, and any other client can connect too. Only the serial line is made of
   software; its characters take as long as real ones. On a system without pseudo-terminals, a TCP connection replaces
   it.
2. On a terminal one table is redrawn in place; elsewhere a block of lines is printed each second.
3. The demonstration ends after its time, with a summary and three commands to try; ``--forever`` runs it until Ctrl-C.
"""

import asyncio
import logging
import math
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import typer

from ..errors import LinkDown, ModbusError
from ..values import format_address
from ..values.counts import counted
from .arguments import QUIET, VERBOSE, seconds, show_traffic, whole_number
from .exits import ExitCode
from .output import print_aligned, warn
from .signals import on_hangup, stop_event

if TYPE_CHECKING:
    from ..apps.gateway.gateway import Gateway
    from ..apps.simulator.demo_plant import Plant
    from ..client.aio import AsyncLink, AsyncUnit
    from ..config.files.points import PointSection
    from ..server.server import Server

    Tags = Mapping[int, Sequence[PointSection]]

EXAMPLES = """\b
Examples:
  busway demo
  busway demo --forever --port 5021
"""

HOST = "tcp://127.0.0.1"
TICK_SECONDS = 0.1
"""Seconds between two steps of the simulated plant; each step changes its values."""
POLL_SECONDS = 0.25
"""Seconds between two reads of each value."""
BLOCK_SECONDS = 1.0
"""Seconds between two printed blocks of lines if stdout is no terminal."""
BAUD = 19_200
LINE_TIMEOUT = 0.4
"""Seconds that the gateway waits for a reply of a device."""
METER_DELAY = 0.15
"""Delay of the replies of the meter, in seconds; it is a slow device on purpose."""
DEATH_AFTER, DEATH_LASTS, DEATH_EVERY = 3.0, 3.0, 8.0
"""When the thermometer, a failing device on purpose, does not answer, in seconds.

It is silent for the first time after ``DEATH_AFTER``, for ``DEATH_LASTS``, and again each ``DEATH_EVERY``.
"""


@dataclass(slots=True)
class Polled:
    """What the polling client of the demonstration has read: values, latencies and errors.

    Attributes:
        values: the latest value of each point in its unit of measure, by the point's name; None if the last read
            failed.
        latencies: response time of each successful request, in seconds.
        errors: number of requests that failed.
    """

    values: dict[str, Any] = field(default_factory=dict)  # Any: what each point's type says
    latencies: list[float] = field(default_factory=list)
    errors: int = 0

    @property
    def transactions(self) -> int:
        """Number of requests of the polling client, successful or not."""
        return len(self.latencies) + self.errors


def demo(
    forever: bool = typer.Option(False, "--forever", help="Keep it up until Ctrl-C."),
    duration: str = typer.Option("10s", "--for", metavar="TIME", help="End after this time: 10s."),
    port: str = typer.Option("5020", "--port", metavar="PORT", help="The port to serve on; another if it is taken."),
    verbose: int = VERBOSE,
    quiet: bool = QUIET,
) -> int:
    """Run a small plant on a serial line, and poll it through a gateway."""
    limit = None if forever else seconds(duration, "--for", low=0.1)
    wanted = whole_number(port, "--port", 0, 65_535)
    from ..server.loops import run

    show_traffic(verbose)
    log = logging.getLogger("busway.apps.gateway")
    level = log.level
    log.setLevel(logging.ERROR)  # a device of the demo dies by design, and the table shows it
    try:
        run(_run(wanted, limit))
    finally:
        log.setLevel(level)
    return ExitCode.DONE


async def _run(port: int, limit: float | None) -> None:
    from ..client.aio import open_link

    with stop_event() as stop, on_hangup(stop.set):
        async with AsyncExitStack() as stack:
            plant, url = await started_plant(stack, port)
            link = await stack.enter_async_context(open_link(url, shared=False, timeout=2.0, max_transactions=3))
            if limit is None:
                _print_commands(url, f"The plant is behind the gateway on {url}. Try, in another terminal:")
            polled, began = Polled(), time.monotonic()
            await _poll(link, plant, polled, stop, limit, url)
    _print_summary(polled, time.monotonic() - began)
    if limit is not None:
        served = int(url.rpartition(":")[2])
        option = "" if served == 5020 else f" --port {served}"
        _print_commands(url, f"Try next, in another terminal while `busway demo --forever{option}` runs:")


async def started_plant(stack: AsyncExitStack, port: int) -> "tuple[Plant, str]":
    """Start a plant of simulated devices and a gateway in front of it; both run until ``stack`` closes.

    Args:
        stack: exit stack that stops them.
        port: TCP port of the gateway on loopback; 0, or a port that is taken, gives a free one.

    Returns:
        The plant and the gateway's URL.
    """
    from ..apps.simulator.demo_plant import Plant

    plant = Plant()
    near, far = _line(stack)
    devices = _devices(plant, far)
    await stack.enter_async_context(devices)
    gateway = await _started(near or devices.endpoints[0], port)
    stack.push_async_exit(gateway)
    (url,) = gateway.endpoints
    moving = asyncio.create_task(_move(plant))

    async def stand_still() -> None:
        moving.cancel()
        with suppress(asyncio.CancelledError):
            await moving

    stack.push_async_callback(stand_still)
    return plant, url


def _line(stack: AsyncExitStack) -> tuple[str, str]:
    """Create a paced serial line, and return the URLs of its ends: the gateway's and the devices'.

    On a system without pseudo-terminals the first is empty, and the second is a TCP endpoint for the devices. The line
    ends when ``stack`` closes.
    """
    try:
        from ..testing.line import PacedLine
    except ImportError:  # a system without terminals
        return "", f"{HOST}:0"
    line = stack.enter_context(PacedLine(ports=2, baud=BAUD))
    near, far = (f"rtu://{path}?baud={BAUD}" for path in line.paths)
    return near, far


def _devices(plant: "Plant", url: str) -> "Server":
    """Return the server of the plant's devices at ``url``, not started yet.

    By faults, the meter answers slowly, and the thermometer stops answering from time to time.
    """
    from ..apps.simulator.demo_plant import METER, THERMOMETER
    from ..faults.applied_faults import Schedule
    from ..faults.switchboard import FaultSwitchboard
    from ..server.serving import serve

    switchboard = FaultSwitchboard()
    switchboard.add("late", units={METER}, parameters={"delay": METER_DELAY})
    death = Schedule(after=DEATH_AFTER, lasts=DEATH_LASTS, every=DEATH_EVERY)
    switchboard.add("wedged", units={THERMOMETER}, schedule=death)
    server = serve(url, units=plant.devices)
    switchboard.attach(server)
    return server


async def _started(line: str, port: int) -> "Gateway":
    """Start and return the demonstration's gateway, on ``port`` of loopback or, if that is taken, on a free port.

    Args:
        line: URL of the upstream: the serial line, or the TCP server that replaces it.
        port: the wanted port.
    """
    from ..apps.gateway.gateway import Gateway
    from ..apps.gateway.gateway_plan import simple_plan

    options = {"timeout": LINE_TIMEOUT, "retries": 0}
    if line.startswith("rtu:"):
        options |= {"first_pause": 1.0, "longest_pause": 1.0}
    gateway = Gateway(simple_plan([f"{HOST}:{port}"], line, **options))
    try:
        await gateway.start()
    except LinkDown:
        gateway = Gateway(simple_plan([f"{HOST}:0"], line, **options))
        await gateway.start()
        warn(f"port {port} is taken; the gateway is on {gateway.endpoints[0]}")
    return gateway


async def _move(plant: "Plant") -> None:
    """Advance the plant of the demonstration in real time, until cancelled."""
    before = time.monotonic()
    while True:
        await asyncio.sleep(TICK_SECONDS)
        now = time.monotonic()
        plant.tick(now - before)
        before = now


async def _poll(
    link: "AsyncLink", plant: "Plant", polled: Polled, stop: asyncio.Event, limit: float | None, url: str
) -> None:
    """Read all points of the plant, in one task per device, and display the values until the time is over.

    Args:
        link: the link to the gateway.
        plant: the plant whose points are read.
        polled: gets values, latencies and errors.
        stop: ends the polling when it is set, by a signal.
        limit: seconds; None for no limit.
        url: URL of the gateway, for the display.
    """
    tags = {unit: list(points.sections.values()) for unit, points in plant.points.items()}
    view: View = LiveView() if sys.stdout.isatty() else LineView()
    began = time.monotonic()
    ends = math.inf if limit is None else began + limit
    due = began
    polling = [asyncio.create_task(_poll_unit(link.unit(unit), tags[unit], polled)) for unit in tags]
    try:
        while not stop.is_set() and time.monotonic() < ends:
            due = max(due + POLL_SECONDS, time.monotonic())
            with suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), min(due, ends) - time.monotonic())
            view.show(url, tags, polled, time.monotonic() - began)
    finally:
        for each in polling:
            each.cancel()
        await asyncio.gather(*polling, return_exceptions=True)
        view.close()


async def _poll_unit(unit: "AsyncUnit", sections: Sequence["PointSection"], polled: Polled) -> None:
    """Read the points of one device every `POLL_SECONDS` into ``polled``, until cancelled."""
    while True:
        due = time.monotonic() + POLL_SECONDS
        for section in sections:
            await _read(unit, section, polled)
        await asyncio.sleep(max(due - time.monotonic(), 0.0))


async def _read(unit: "AsyncUnit", section: "PointSection", polled: Polled) -> None:
    before = time.perf_counter()
    try:
        raw = await unit.read(section.place, section.form)
    except ModbusError:
        polled.errors += 1
        polled.values[section.name] = None
    else:
        polled.latencies.append(time.perf_counter() - before)
        polled.values[section.name] = section.physical(raw)


class View(Protocol):
    """Interface of a display of the values that the demonstration has read."""

    def show(self, url: str, tags: "Tags", polled: Polled, elapsed: float) -> None:
        """Show the latest values of all points; called several times a second.

        Args:
            url: URL of the gateway.
            tags: the points of each unit.
            polled: what has been read so far.
            elapsed: seconds since the polling began.
        """

    def close(self) -> None:
        """End the display; what it showed last stays on the terminal."""


class LineView:
    """Display that prints a block of lines with all values each second; for stdout that is no terminal."""

    def __init__(self) -> None:
        self._due = BLOCK_SECONDS

    def show(self, url: str, tags: "Tags", polled: Polled, elapsed: float) -> None:
        if elapsed < self._due:
            return
        self._due += BLOCK_SECONDS
        print(f"{url}  {elapsed:.0f} s  {_counted(polled)}")
        print_aligned([("", *cells) for cells in _rows(tags, polled)])

    def close(self) -> None:
        pass


class LiveView:
    """Display that shows all values as one table, redrawn in place; for a terminal."""

    def __init__(self) -> None:
        from rich.live import Live

        self._live = Live(auto_refresh=False)
        self._live.start()

    def show(self, url: str, tags: "Tags", polled: Polled, elapsed: float) -> None:
        from rich.table import Table

        table = Table(title=f"{url}: three devices behind a gateway", caption=f"{elapsed:.0f} s, {_counted(polled)}")
        for heading in ("Unit", "Tag", "Value", "", "Address", "Type"):
            table.add_column(heading, justify="right" if heading == "Value" else "left")
        for cells in _rows(tags, polled):
            table.add_row(*cells)
        self._live.update(table, refresh=True)

    def close(self) -> None:
        self._live.stop()


def _counted(polled: Polled) -> str:
    return f"{counted(polled.transactions, 'transaction')}, {counted(polled.errors, 'error')}"


def _rows(tags: "Tags", polled: Polled) -> Iterator[tuple[str, ...]]:
    for unit, sections in tags.items():
        for section in sections:
            yield str(unit), *_cells(section, polled)


def _cells(section: "PointSection", polled: Polled) -> tuple[str, ...]:
    form = section.form
    kind = "bit" if form is None else form.name + ("" if section.order == "ABCD" else f" {section.order}")
    value = _shown(polled.values.get(section.name))
    return section.name, value, section.unit_of_measure, format_address(section.place), kind


def _shown(value: Any) -> str:
    if value is None:
        return "—"
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:.2f}" if isinstance(value, float) else str(value)


def percentile(sorted_values: Sequence[float], percent: float) -> float:
    """Return the value at ``percent`` (0…100) of ascending values, by nearest rank; 0.0 if there are no values."""
    if not sorted_values:
        return 0.0
    return sorted_values[max(math.ceil(len(sorted_values) * percent / 100), 1) - 1]


def _print_summary(polled: Polled, elapsed: float) -> None:
    ordered = sorted(polled.latencies)
    latencies = ", ".join(f"p{percent} {1000 * percentile(ordered, percent):.2f} ms" for percent in (50, 95, 99))
    print(f"\n{_counted(polled)} in {elapsed:.1f} s; latency {latencies}", flush=True)


def _print_commands(url: str, heading: str) -> None:
    print(f"\n{heading}")
    print(f"  busway read {url} 3x1 --type float32 --unit 1 --watch 1s")
    print(f"  busway write {url} 4x1 3.2 --type float32 --unit 1")
    print(f"  busway identify {url} --unit 255", flush=True)

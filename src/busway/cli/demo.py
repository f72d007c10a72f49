"""``busway demo``: a small plant on a port of this machine, and a client that polls it over that port.

1. It is a real conversation over TCP: any other client can join in while it runs.
2. On a terminal one table is drawn anew; elsewhere there is one block of lines per second.
3. It ends by itself, with a summary and three commands to try; ``--forever`` keeps it up until Ctrl-C.
"""

import asyncio
import math
import sys
import time
from collections.abc import Sequence
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import typer

from ..errors import LinkDown, ModbusError
from ..values import format_address
from .arguments import VERBOSE, seconds, show_traffic, whole_number
from .exits import ExitCode
from .output import print_aligned, say
from .signals import stop_event

if TYPE_CHECKING:
    from ..client.aio import AsyncUnit
    from ..config.files.device import PointSection
    from ..server.server import Server
    from ..simulator.plant import Plant

EXAMPLES = """\b
Examples:
  busway demo
  busway demo --forever --port 5021
"""

HOST = "tcp://127.0.0.1"
TICK_SECONDS = 0.1
"""How often the plant moves on."""
POLL_SECONDS = 0.25
"""How often each value is read."""
BLOCK_SECONDS = 1.0
"""How often lines are printed where there is no terminal."""


@dataclass(slots=True)
class Polled:
    """What the client has seen.

    Attributes:
        values: the latest value by name, in its unit of measure; None after an error.
        latencies: seconds from request to reply, of each transaction that had one.
        errors: transactions that had none.
    """

    values: dict[str, Any] = field(default_factory=dict)  # Any: what each point's type says
    latencies: list[float] = field(default_factory=list)
    errors: int = 0

    @property
    def transactions(self) -> int:
        """All of them."""
        return len(self.latencies) + self.errors


def demo(
    forever: bool = typer.Option(False, "--forever", help="Keep it up until Ctrl-C."),
    duration: str = typer.Option("10", "--seconds", metavar="TIME", help="End after this time: 10."),
    port: str = typer.Option("5020", "--port", metavar="PORT", help="The port to serve on; another if it is taken."),
    verbose: int = VERBOSE,
) -> int:
    """Run a small plant and poll it over TCP."""
    limit = None if forever else seconds(duration, "--seconds", low=0.1)
    wanted = whole_number(port, "--port", 0, 65_535)
    from ..server.loops import run

    show_traffic(verbose)
    run(_run(wanted, limit))
    return ExitCode.DONE


async def _run(port: int, limit: float | None) -> None:
    from ..client.aio import open_link
    from ..simulator.plant import Plant

    plant = Plant()
    with stop_event() as stop:
        async with AsyncExitStack() as stack:
            server = await _started(plant, port)
            stack.push_async_exit(server)
            (url,) = server.endpoints
            link = await stack.enter_async_context(open_link(url, shared=False))
            if limit is None:
                _print_commands(url, f"Serving the plant on {url}. Try, in another terminal:")
            polled, began = Polled(), time.monotonic()
            moving = asyncio.create_task(_move(plant))
            try:
                await _poll(link.unit(1), plant, polled, stop, limit, url)
            finally:
                moving.cancel()
                with suppress(asyncio.CancelledError):
                    await moving
    _print_summary(polled, time.monotonic() - began)
    if limit is not None:
        served = int(url.rpartition(":")[2])
        option = "" if served == 5020 else f" --port {served}"
        _print_commands(url, f"Try next, in another terminal while `busway demo --forever{option}` runs:")


async def _started(plant: "Plant", port: int) -> "Server":
    """The server on the wanted port, or on a free one."""
    from ..server.serving import serve

    server = serve(f"{HOST}:{port}", units={1: plant.device})
    try:
        await server.start()
    except LinkDown:
        server = serve(f"{HOST}:0", units={1: plant.device})
        await server.start()
        say(f"port {port} is taken; the plant is on {server.endpoints[0]}")
    return server


async def _move(plant: "Plant") -> None:
    """Let the plant live."""
    before = time.monotonic()
    while True:
        await asyncio.sleep(TICK_SECONDS)
        now = time.monotonic()
        plant.tick(now - before)
        before = now


async def _poll(
    unit: "AsyncUnit", plant: "Plant", polled: Polled, stop: asyncio.Event, limit: float | None, url: str
) -> None:
    """Read every point again and again, and show what came, until it is time."""
    sections = list(plant.points.sections.values())
    view: View = LiveView() if sys.stdout.isatty() else LineView()
    began = time.monotonic()
    ends = math.inf if limit is None else began + limit
    due = began
    try:
        while not stop.is_set() and time.monotonic() < ends:
            for section in sections:
                await _read(unit, section, polled)
            view.show(url, sections, polled, time.monotonic() - began)
            due = max(due + POLL_SECONDS, time.monotonic())
            with suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), min(due, ends) - time.monotonic())
    finally:
        view.close()


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
    """Something that shows what was read."""

    def show(self, url: str, sections: Sequence["PointSection"], polled: Polled, elapsed: float) -> None:
        """Show it as it is now."""

    def close(self) -> None:
        """No more comes."""


class LineView:
    """A block of lines each second."""

    def __init__(self) -> None:
        self._due = BLOCK_SECONDS

    def show(self, url: str, sections: Sequence["PointSection"], polled: Polled, elapsed: float) -> None:
        if elapsed < self._due:
            return
        self._due += BLOCK_SECONDS
        print(f"{url}  {elapsed:.0f} s  {_counted(polled)}")
        print_aligned([("", *_cells(section, polled)) for section in sections])

    def close(self) -> None:
        pass


class LiveView:
    """One table, drawn anew in its place."""

    def __init__(self) -> None:
        from rich.live import Live

        self._live = Live(auto_refresh=False)
        self._live.start()

    def show(self, url: str, sections: Sequence["PointSection"], polled: Polled, elapsed: float) -> None:
        from rich.table import Table

        table = Table(title=f"{url}, unit 1", caption=f"{elapsed:.0f} s, {_counted(polled)}")
        for heading in ("Tag", "Value", "", "Address", "Type"):
            table.add_column(heading, justify="right" if heading == "Value" else "left")
        for section in sections:
            table.add_row(*_cells(section, polled))
        self._live.update(table, refresh=True)

    def close(self) -> None:
        self._live.stop()


def _counted(polled: Polled) -> str:
    return f"{polled.transactions} transactions, {polled.errors} errors"


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
    """The smallest value that ``percent`` of all do not exceed (nearest rank); 0 without values."""
    if not sorted_values:
        return 0.0
    return sorted_values[max(math.ceil(len(sorted_values) * percent / 100), 1) - 1]


def _print_summary(polled: Polled, elapsed: float) -> None:
    ordered = sorted(polled.latencies)
    latencies = ", ".join(f"p{percent} {1000 * percentile(ordered, percent):.2f} ms" for percent in (50, 95, 99))
    print(f"\n{_counted(polled)} in {elapsed:.1f} s; latency {latencies}", flush=True)


def _print_commands(url: str, heading: str) -> None:
    print(f"\n{heading}")
    print(f"  busway read {url} 3x1 --type float32 --watch 1s")
    print(f"  busway write {url} 4x1 3.2 --type float32")
    print(f"  busway identify {url}", flush=True)

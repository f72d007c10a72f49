"""Times a transaction against what there is of everything else; prints JSON: ``{what: {size: nanoseconds}}``.

Run from `bench/`: python -m offline.growth SECONDS [--quick]
--quick: three sizes of each.

Each size is a script of its own on a loop without a network: the same requests, arriving in the same batches, with more
or less around them. Connections take turns, one batch each; units, addresses and routes are asked one after the other.
Of a collector a value takes the place of a transaction, of a plan a point (`offline.growth_of_points`), of a store a
sample (`offline.growth_of_stores`). Of memory the figure is bytes (`offline.growth_of_memory`). Stores and memory are
left out where it has to be quick.
"""

import asyncio
import json
import random
import struct
import sys
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

import busway
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import GatewayListener, GatewayPlan, UpstreamSettings
from busway.apps.gateway.routes import AddressRange, Route, RoutingTable
from busway.codes import Table
from busway.framing.rtu import encode_rtu
from offline import growth_of_memory, growth_of_points, growth_of_stores
from offline.scripts import IN_FLIGHT, REGISTERS, TCP, in_batches, port_of, read
from offline.timing import quickest
from offline.wire import Device, MemoryLoop, Wire

CONNECTIONS = (1, 10, 100, 1000)
UNITS = (1, 4, 16, 64, 247)
TABLE_SIZES = (100, 1000, 10_000, 65_536)
ROUTES = (1, 4, 16, 64, 247)
ADDRESS_ROUTES = (1, 4, 16, 64)
RANGES = (256, 2048, 20_480)
"""Different requests of mixed traffic: more than the server remembers reads, at the end."""
READS = 256
"""Requests of a step."""
WARMING = 2
Step = Callable[[], object]


def to_unit(request: bytes, unit: int) -> bytes:
    return request[:6] + bytes([unit]) + request[7:]


async def turns(opened: Sequence[Wire], batches: Sequence[bytes]) -> Step:
    """Each call feeds all batches, to one connection after the other, and goes on there the next time.

    While reads are new, each batch has a turn of the loop, or the server would let some of them wait for the next.
    """
    at = 0

    def step() -> None:
        nonlocal at
        for batch in batches:
            opened[at].feed(batch)
            at = (at + 1) % len(opened)

    for _ in range(WARMING * max(1, len(opened) // len(batches))):
        for batch in batches:
            opened[at].feed(batch)
            at = (at + 1) % len(opened)
            await asyncio.sleep(0)
    return step


@asynccontextmanager
async def connections(loop: MemoryLoop, size: int) -> AsyncIterator[Step]:
    """Reads of a server with so many connections, all of them busy."""
    device = busway.Device(holding_registers=1000)
    async with busway.serve(TCP, units={1: device}, max_connections=size + 10) as server:
        opened = [loop.new_connection(port_of(server.endpoints[0]), number) for number in range(size)]
        yield await turns(opened, in_batches([read(number, number * REGISTERS % 900) for number in range(READS)]))


@asynccontextmanager
async def units(loop: MemoryLoop, size: int) -> AsyncIterator[Step]:
    """Reads of so many units of a server."""
    devices = {unit: busway.Device(holding_registers=1000) for unit in range(1, size + 1)}
    async with busway.serve(TCP, units=devices) as server:
        asked = [to_unit(read(number, 0), 1 + number % size) for number in range(READS)]
        yield await turns([loop.new_connection(port_of(server.endpoints[0]))], in_batches(asked))


@asynccontextmanager
async def table_size(loop: MemoryLoop, size: int) -> AsyncIterator[Step]:
    """Reads anywhere in a table of that size."""
    chance = random.Random(1)
    async with busway.serve(TCP, units={1: busway.Device(holding_registers=size)}) as server:
        asked = [read(number, chance.randrange(size - REGISTERS)) for number in range(READS)]
        yield await turns([loop.new_connection(port_of(server.endpoints[0]))], in_batches(asked))


MIXED = (1, 2, 3, 4, 5, 6, 15, 16, 22, 23)


def mixed(number: int, chance: random.Random) -> bytes:
    """Return a request of a function that follows from the number, about 1 to 10 items anywhere in a table."""
    function, address, count = MIXED[number % len(MIXED)], chance.randrange(60_000), chance.randint(1, REGISTERS)
    if function <= 4:
        body = struct.pack(">HH", address, count)
    elif function <= 6:
        body = struct.pack(">HH", address, 0xFF00 if function == 5 else chance.randrange(65_536))
    elif function == 15:
        body = struct.pack(">HHB", address, 8 * count, count) + chance.randbytes(count)
    elif function == 22:
        body = struct.pack(">HHH", address, 0xF2, chance.randrange(65_536))
    else:
        wanted = b"" if function == 16 else struct.pack(">HH", chance.randrange(60_000), count)
        body = wanted + struct.pack(">HHB", address, count, 2 * count) + chance.randbytes(2 * count)
    return struct.pack(">HHHBB", number & 0xFFFF, 0, 2 + len(body), 1, function) + body


def all_tables() -> busway.Device:
    bits, registers = [False] * 65_536, [0] * 65_536
    return busway.Device(coils=bits, discrete_inputs=bits, input_registers=registers, holding_registers=registers)


def in_turns(loop: MemoryLoop, opened: Sequence[Wire], batches: Sequence[bytes]) -> Step:
    """Each call feeds batches for `READS` requests, one in a turn of the loop, and goes on there the next time."""
    at = 0

    async def turn() -> None:
        nonlocal at
        for _ in range(READS // IN_FLIGHT):
            opened[at % len(opened)].feed(batches[at % len(batches)])
            at += 1
            await asyncio.sleep(0)

    return lambda: loop.run_until_complete(turn())


@asynccontextmanager
async def mixed_connections(loop: MemoryLoop, size: int) -> AsyncIterator[Step]:
    """Mixed traffic at a server with so many connections, all of them busy."""
    chance = random.Random(2)
    async with busway.serve(TCP, units={1: all_tables()}, max_connections=size + 10) as server:
        opened = [loop.new_connection(port_of(server.endpoints[0]), number) for number in range(size)]
        yield in_turns(loop, opened, in_batches([mixed(number, chance) for number in range(2560)]))


@asynccontextmanager
async def mixed_ranges(loop: MemoryLoop, size: int) -> AsyncIterator[Step]:
    """Mixed traffic of so many different requests."""
    chance = random.Random(3)
    async with busway.serve(TCP, units={1: all_tables()}) as server:
        opened = [loop.new_connection(port_of(server.endpoints[0]))]
        yield in_turns(loop, opened, in_batches([mixed(number, chance) for number in range(size)]))


@asynccontextmanager
async def rtu_connections(loop: MemoryLoop, size: int) -> AsyncIterator[Step]:
    """Reads in RTU over TCP at a server with so many connections, all of them busy."""
    device = busway.Device(holding_registers=1000)
    async with busway.serve("rtu+tcp://127.0.0.1:0", units={1: device}, max_connections=size + 10) as server:
        opened = [loop.new_connection(port_of(server.endpoints[0]), number) for number in range(size)]
        frames = [encode_rtu(1, read(0, number * REGISTERS % 900)[7:]) for number in range(READS)]
        yield in_turns(loop, opened, in_batches(frames))


@asynccontextmanager
async def udp_peers(loop: MemoryLoop, size: int) -> AsyncIterator[Step]:
    """Reads over UDP of so many peers, a datagram each; the look for a further one is a system call of its own."""
    device = busway.Device(holding_registers=1000)
    async with busway.serve("udp://127.0.0.1:0", units={1: device}, max_connections=size + 10) as server:
        _, listening = loop.datagram_listeners[port_of(server.endpoints[0])]
        asked = [read(number, number * REGISTERS % 900) for number in range(READS)]
        peers = [("127.0.0.1", 40_000 + number) for number in range(size)]
        at = 0

        def step() -> None:
            nonlocal at
            for request in asked:
                listening.datagram_received(request, peers[at])
                at = (at + 1) % size

        for _ in range(WARMING * max(1, size // READS)):
            step()
        yield step
        if len(server.status().connections) != size:
            raise RuntimeError("a peer has lost its slot")


async def forwarding(loop: MemoryLoop, plan: GatewayPlan, asked: Sequence[bytes], running: AsyncExitStack) -> Step:
    """Reads through a gateway; a step runs the loop until all are answered."""
    gateway = await running.enter_async_context(Gateway(plan))
    wire = loop.new_connection(port_of(gateway.endpoints[0]))
    batches = in_batches(asked)

    async def turn() -> None:
        for batch in batches:
            wanted = wire.sent + (9 + 2 * REGISTERS) * IN_FLIGHT
            wire.feed(batch)
            for _ in range(100):
                if wire.sent == wanted:
                    break
                await asyncio.sleep(0)
            else:
                raise RuntimeError("a gateway has not answered")

    for _ in range(WARMING):
        await turn()
    return lambda: loop.run_until_complete(turn())


def plan(routes: Sequence[Route]) -> GatewayPlan:
    line = UpstreamSettings.of("line", "tcp://127.0.0.1:1", max_transactions=IN_FLIGHT, queue=4096, share_reads=False)
    return GatewayPlan(
        (GatewayListener("listener", busway.Listener(TCP)),), (line,), RoutingTable(tuple(routes)), own_unit=None
    )


@asynccontextmanager
async def routes(loop: MemoryLoop, size: int) -> AsyncIterator[Step]:
    """Reads through a gateway with so many routes, one for each unit, which is renumbered."""
    loop.listeners[1] = Device
    table = [Route(upstream="line", units=frozenset({unit}), unit=1) for unit in range(1, size + 1)]
    asked = [to_unit(read(number, number), 1 + number % size) for number in range(READS)]
    async with AsyncExitStack() as running:
        yield await forwarding(loop, plan(table), asked, running)


@asynccontextmanager
async def address_routes(loop: MemoryLoop, size: int) -> AsyncIterator[Step]:
    """The same where all routes are about one unit, each about a range of its registers."""
    loop.listeners[1] = Device
    holding, width = Table.HOLDING_REGISTERS, 32
    table = [
        Route(upstream="line", units=frozenset({1}), addresses=AddressRange(holding, width * one, width * (one + 1)))
        for one in range(size)
    ]
    asked = [read(number, width * (number % size)) for number in range(READS)]
    async with AsyncExitStack() as running:
        yield await forwarding(loop, plan(table), asked, running)


SETTINGS: dict[str, tuple[Callable[..., Any], tuple[int, ...]]] = {
    "connections of a server": (connections, CONNECTIONS),
    "units of a server": (units, UNITS),
    "registers of a table": (table_size, TABLE_SIZES),
    "connections of a server, mixed traffic": (mixed_connections, CONNECTIONS),
    "different requests of mixed traffic": (mixed_ranges, RANGES),
    "connections of a server, RTU over TCP": (rtu_connections, CONNECTIONS[:-1]),
    "peers of a server, UDP": (udp_peers, CONNECTIONS),
    "routes of a gateway, by unit": (routes, ROUTES),
    "routes of a gateway, by address of one unit": (address_routes, ADDRESS_ROUTES),
}


def measured(setting: str, seconds: float, *, quick: bool) -> dict[int, float]:
    """Nanoseconds of a transaction for each size; the sizes take turns."""
    make, sizes = SETTINGS[setting]
    if quick:
        sizes = (sizes[0], sizes[len(sizes) // 2], sizes[-1])
    loop = MemoryLoop()
    asyncio.set_event_loop(loop)
    running = AsyncExitStack()
    try:
        steps = {str(size): loop.run_until_complete(running.enter_async_context(make(loop, size))) for size in sizes}
        found = quickest(steps, seconds)
        loop.run_until_complete(running.aclose())
    finally:
        loop.close()
    return {int(size): nanoseconds / READS for size, nanoseconds in found.items()}


if __name__ == "__main__":
    few = "--quick" in sys.argv
    rows = len(SETTINGS) + len(growth_of_points.SETTINGS) + (0 if few else growth_of_stores.TIMED)
    each = float(sys.argv[1]) / rows
    found = {setting: measured(setting, each, quick=few) for setting in SETTINGS}
    found |= growth_of_points.measured(each, quick=few)
    if not few:
        found |= growth_of_stores.measured(each) | growth_of_memory.measured()
    print(json.dumps(found))

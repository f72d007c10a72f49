"""The scripts: what is done, in fixed bytes, always the same.

Each script is an asynchronous context manager on a `MemoryLoop` that gives its turn: a coroutine function that makes
`TRANSACTIONS` transactions, from the bytes of the requests to the bytes of the replies (or the other way round).

1. A script uses busway as its users do, by `busway.serve`, `busway.open` and gateways, so that what is counted is what
   runs in earnest, drivers included.
2. It is warm before it is counted: the first turns fill caches and prepared answers.
"""

import asyncio
import struct
import tempfile
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from urllib.parse import urlsplit

import busway
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import simple_plan
from busway.framing.rtu import encode_rtu
from offline.wire import NUMBERS, Canned, Device, MemoryLoop

TRANSACTIONS = 64
IN_FLIGHT = 16
REGISTERS = 10
Turn = Callable[[], Awaitable[None]]
Script = Callable[[MemoryLoop], AbstractAsyncContextManager[Turn]]
TCP = "tcp://127.0.0.1:0"
MOST_PREPARED = 4096
"""So many reads are remembered for all connections together; those that come later take the fast path."""
READ_AREA = 8000
"""Where reads are made that are not remembered."""


def read(transaction: int, address: int, count: int = REGISTERS) -> bytes:
    return struct.pack(">HHHBBHH", transaction, 0, 6, 1, 3, address, count)


def write(transaction: int, address: int) -> bytes:
    values = bytes(2 * REGISTERS)
    return struct.pack(">HHHBBHHB", transaction, 0, 7 + len(values), 1, 16, address, REGISTERS, len(values)) + values


def write_single(transaction: int, address: int) -> bytes:
    return struct.pack(">HHHBBHH", transaction, 0, 6, 1, 6, address, transaction)


def in_batches(requests: Sequence[bytes]) -> list[bytes]:
    """What arrives together."""
    return [b"".join(requests[at : at + IN_FLIGHT]) for at in range(0, len(requests), IN_FLIGHT)]


def port_of(endpoint: str) -> int:
    return urlsplit(endpoint).port or 0


def device() -> busway.Device:
    return busway.Device(holding_registers=list(range(10_000)))


def policy() -> busway.Policy:
    """Twelve rules; the one that fits is the eleventh, and a window of registers."""
    others = [busway.Rule.of(units=unit, peers=["10.0.0.0/8"], name=f"unit {unit}") for unit in range(2, 12)]
    mine = busway.Rule.of(units=1, peers=["127.0.0.0/8"], table="holding", addresses="0-9999", name="mine")
    return busway.Policy.of(*others, mine, busway.Rule.of(action="read-only", files="1-4", name="files"))


@asynccontextmanager
async def _asked(
    loop: MemoryLoop, server: busway.Server, batches: Sequence[bytes], *first: bytes
) -> AsyncIterator[Turn]:
    async with server:
        wire = loop.new_connection(port_of(server.endpoints[0]))
        for one in first:
            wire.feed(one)
            await asyncio.sleep(0)

        async def turn() -> None:
            for batch in batches:
                wire.feed(batch)
                await asyncio.sleep(0)  # as batches come; of more in one turn, some would wait for the next

        yield turn


READS = in_batches([read(number, number % IN_FLIGHT * REGISTERS) for number in range(TRANSACTIONS)])
UNPREPARED = in_batches([read(number, READ_AREA + number) for number in range(TRANSACTIONS)])
WRITES = in_batches([write(number, number) for number in range(TRANSACTIONS)])
SINGLE_WRITES = in_batches([write_single(number, number) for number in range(TRANSACTIONS)])
ALL_PREPARED = in_batches([read(number, number, 1) for number in range(MOST_PREPARED)])


def server_planned_read(loop: MemoryLoop) -> AbstractAsyncContextManager[Turn]:
    """A poller: the same reads again and again."""
    return _asked(loop, busway.serve(TCP, units={1: device()}), READS)


def server_fast_path(loop: MemoryLoop) -> AbstractAsyncContextManager[Turn]:
    """Reads that are not remembered."""
    return _asked(loop, busway.serve(TCP, units={1: device()}), UNPREPARED, *ALL_PREPARED)


def server_policy_window(loop: MemoryLoop) -> AbstractAsyncContextManager[Turn]:
    """The same behind a policy."""
    return _asked(loop, busway.serve(TCP, units={1: device()}, policy=policy()), UNPREPARED, *ALL_PREPARED)


def server_short_write(loop: MemoryLoop) -> AbstractAsyncContextManager[Turn]:
    """Writes that are dropped."""
    return _asked(loop, busway.serve(TCP, units={1: device()}), WRITES)


def server_single_write(loop: MemoryLoop) -> AbstractAsyncContextManager[Turn]:
    """Writes of one register, which are as long as a read."""
    return _asked(loop, busway.serve(TCP, units={1: device()}), SINGLE_WRITES)


def server_policy_write(loop: MemoryLoop) -> AbstractAsyncContextManager[Turn]:
    """The same behind a policy."""
    return _asked(loop, busway.serve(TCP, units={1: device()}, policy=policy()), SINGLE_WRITES)


def server_generic_path(loop: MemoryLoop) -> AbstractAsyncContextManager[Turn]:
    """Writes that a program is told of: decode, handler, encode."""
    watched = device()

    @watched.on_write("holding_registers")
    def written(change: busway.Change) -> None:
        pass

    return _asked(loop, busway.serve(TCP, units={1: watched}), WRITES)


@asynccontextmanager
async def server_audited_write(loop: MemoryLoop) -> AsyncIterator[Turn]:
    """Writes behind a policy that are written down."""
    with tempfile.TemporaryDirectory() as folder, busway.AuditLog(Path(folder) / "audit") as audit:
        server = busway.serve(TCP, units={1: device()}, policy=policy(), audit=audit)
        async with _asked(loop, server, WRITES) as turn:
            yield turn


@asynccontextmanager
async def client_execute_many(loop: MemoryLoop) -> AsyncIterator[Turn]:
    """One batch, one future."""
    loop.listeners[1] = Device
    batch = [busway.ReadHoldingRegisters(number * REGISTERS, REGISTERS) for number in range(TRANSACTIONS)]
    async with busway.open("tcp://127.0.0.1:1", max_transactions=IN_FLIGHT) as link:
        unit = link.unit(1)

        async def turn() -> None:
            await unit.execute_many(batch)

        yield turn


@asynccontextmanager
async def client_await(loop: MemoryLoop) -> AsyncIterator[Turn]:
    """Sixteen tasks that each await one read after the other."""
    loop.listeners[1] = Device
    async with busway.open("tcp://127.0.0.1:1", max_transactions=IN_FLIGHT) as link:
        unit = link.unit(1)

        async def task() -> None:
            for _ in range(TRANSACTIONS // IN_FLIGHT):
                await unit.read_holding_registers(0, count=REGISTERS)

        async def turn() -> None:
            await asyncio.gather(*(task() for _ in range(IN_FLIGHT)))

        yield turn


@asynccontextmanager
async def _forwarded(
    loop: MemoryLoop, clients: int, batches: Sequence[bytes], count: int, reply: int = 9 + 2 * REGISTERS
) -> AsyncIterator[Turn]:
    """Clients of a gateway that send these requests, ``count`` of them together, and wait for all their answers."""
    loop.listeners[1] = Device
    plan = simple_plan([TCP], "tcp://127.0.0.1:1", max_transactions=IN_FLIGHT, queue=4096, share_reads=False)
    async with Gateway(plan) as gateway:
        opened = [loop.new_connection(port_of(gateway.endpoints[0])) for _ in range(clients)]

        async def turn() -> None:
            for begin in range(0, len(batches), clients):
                wanted = [wire.sent + reply * count for wire in opened]
                for wire, batch in zip(opened, batches[begin : begin + clients], strict=True):
                    wire.feed(batch)
                for _ in range(1000):
                    if [wire.sent for wire in opened] == wanted:
                        break
                    await asyncio.sleep(0)
                else:
                    raise RuntimeError("a gateway has not answered")

        yield turn


def gateway_forward(loop: MemoryLoop) -> AbstractAsyncContextManager[Turn]:
    """Reads of one client through a gateway to a server behind it."""
    return _forwarded(loop, 1, READS, IN_FLIGHT)


def gateway_queue(loop: MemoryLoop) -> AbstractAsyncContextManager[Turn]:
    """Reads of four clients, of which one at a time has its turn upstream."""
    return _forwarded(loop, len(READS), READS, IN_FLIGHT)


def gateway_single(loop: MemoryLoop) -> AbstractAsyncContextManager[Turn]:
    """Reads of sixteen clients that each wait for their answer: batches of one."""
    reads = [read(number, number % IN_FLIGHT * REGISTERS) for number in range(TRANSACTIONS)]
    return _forwarded(loop, IN_FLIGHT, reads, 1)


def gateway_writes(loop: MemoryLoop) -> AbstractAsyncContextManager[Turn]:
    """Writes of one register of sixteen clients that each wait for their answer."""
    writes = [write_single(number, number) for number in range(TRANSACTIONS)]
    return _forwarded(loop, IN_FLIGHT, writes, 1, len(writes[0]))


def rtu_server(loop: MemoryLoop) -> AbstractAsyncContextManager[Turn]:
    """Reads in RTU, one after the other."""
    frames = [encode_rtu(1, read(0, number * REGISTERS)[7:]) for number in range(TRANSACTIONS)]
    return _asked(loop, busway.serve("rtu+tcp://127.0.0.1:0", units={1: device()}), frames)


@asynccontextmanager
async def rtu_client(loop: MemoryLoop) -> AsyncIterator[Turn]:
    """A master in RTU, lock-step."""
    request = encode_rtu(1, read(0, 0)[7:])
    reply = encode_rtu(1, bytes((3, 2 * REGISTERS)) + NUMBERS[: 2 * REGISTERS])
    marker = encode_rtu(1, read(0, 0, REGISTERS - 1)[7:])  # now and then the master checks the unit
    marked = encode_rtu(1, bytes((3, 2 * REGISTERS - 2)) + NUMBERS[: 2 * REGISTERS - 2])
    loop.listeners[1] = lambda: Canned({request: reply, marker: marked})
    async with busway.open("rtu+tcp://127.0.0.1:1") as link:
        unit = link.unit(1)

        async def turn() -> None:
            for _ in range(TRANSACTIONS):
                await unit.read_holding_registers(0, count=REGISTERS)

        yield turn


SCRIPTS: dict[str, Script] = {
    "server, planned read": server_planned_read,
    "server, fast path": server_fast_path,
    "server, policy window": server_policy_window,
    "server, short write": server_short_write,
    "server, single write": server_single_write,
    "server, policy write": server_policy_write,
    "server, generic path": server_generic_path,
    "server, audited write": server_audited_write,
    "client, execute_many": client_execute_many,
    "client, await": client_await,
    "gateway, forward": gateway_forward,
    "gateway, queue": gateway_queue,
    "gateway, single reads": gateway_single,
    "gateway, writes": gateway_writes,
    "rtu, server": rtu_server,
    "rtu, client": rtu_client,
}

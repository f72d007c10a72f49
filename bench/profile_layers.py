"""Where the microseconds of one transaction go, layer by layer, measured without sockets.

Run from `bench/`: python -m profile_layers [SECONDS] [--json]

Steps that contain each other are timed, the quickest of several measurements each, and a layer is what a step takes
beyond the one within it: the compiled answer, the session around it, the driver around that; for a client the session
and the link with its future. What kernel and event loop add is not here: the tables of servers and clients have it, and
the bare loop beside it. Instructions of bytecode are counted too, exactly, by the layer whose code they are.
"""

import asyncio
import json
import sys
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

from offline import scripts
from offline.counting import count
from offline.layers import NAMES
from offline.scripts import IN_FLIGHT, REGISTERS, TRANSACTIONS, Script
from offline.timing import quickest
from offline.wire import NUMBERS, Device, MemoryLoop, Wire

import busway
from busway.options.client import ClientParameters
from busway.server.device_responder import DeviceResponder
from busway.session.call import Call
from busway.session.diagnostic_counters import LineDiagnostics
from busway.session.responder import ClientIdentity
from busway.session.server_pipeline import RequestPipeline
from busway.session.server_transaction_slots import ServerTransactionSlots
from busway.session.tcp_client import TcpClientSession
from busway.session.tcp_server import TcpServerSession

Step = Callable[[], object]


@dataclass(frozen=True, slots=True)
class Part:
    """What a layer adds: the time of one step less that of another, divided by its transactions.

    Attributes:
        name: what it is.
        step: the one that contains it.
        less: those that it contains, without it.
    """

    name: str
    step: str
    less: tuple[str, ...] = ()


PROFILES: dict[str, tuple[Part, ...]] = {
    "server, a read that is not remembered (fast path)": (
        Part("L1 compiled answer: limits, slice of the store", "server answer"),
        Part("L2, L3 session: frames, memo, header, counters", "server session", ("server answer",)),
        Part("L5 driver: buffer, join, one write", "server driver", ("server session", "wire")),
    ),
    "server, a poller's read (planned)": (
        Part("L1–L3 one look-up of ten bytes, and the slice", "server planned session"),
        Part("L5 driver: buffer, join, one write", "server planned driver", ("server planned session", "wire")),
    ),
    "client, execute_many": (
        Part("L1–L3 session: queue, identifiers, frames, matching, replies", "client session", ("answers",)),
        Part("L5 link, its one future, the loop's turns", "client many", ("client own", "peer")),
    ),
    "client, one await for each read, 16 in flight": (
        Part("L1–L3 session, one call for each request", "client session, one by one", ("answers",)),
        Part("L5 call, link, future, values, a switch of tasks", "client await", ("client own, one by one", "peer")),
    ),
}
COUNTED: dict[str, Script] = {
    "server, a read that is not remembered (fast path)": scripts.server_fast_path,
    "server, a poller's read (planned)": scripts.server_planned_read,
    "client, execute_many": scripts.client_execute_many,
    "client, one await for each read, 16 in flight": scripts.client_await,
}


def answered(frames: bytes) -> bytes:
    """What a device answers to reads of `REGISTERS` registers."""
    body = bytes((0, 0, 0, 3 + 2 * REGISTERS, 1, 3, 2 * REGISTERS)) + NUMBERS[: 2 * REGISTERS]
    return b"".join(frames[at : at + 2] + body for at in range(0, len(frames), 12))


def server_steps() -> dict[str, Step]:
    """The compiled answer and the session. Each step makes `TRANSACTIONS` transactions."""
    client = ClientIdentity()
    fast = RequestPipeline(DeviceResponder({1: scripts.device()})).fast_path(client)
    answer = fast.bind(scripts.read(0, 0)[2:8]).answer
    assert answer is not None
    whole = b"".join(scripts.UNPREPARED)
    places = [(at + 7, at + 12) for at in range(0, len(whole), 12)]

    def answers() -> None:
        for start, end in places:
            answer(whole, start, end, client)

    def session(*first: bytes) -> TcpServerSession:
        # A handler each: its connections share what they remember, and there is no more room once these are full.
        own = DeviceResponder({1: scripts.device()})
        made = TcpServerSession(
            RequestPipeline(own),
            diagnostics=LineDiagnostics(),
            slots=ServerTransactionSlots(16),
            deliver=_nothing,
            client=ClientIdentity(peer="127.0.0.1:1"),
        )
        for one in first:
            made.receive(one, len(one))
        return made

    def received(by: TcpServerSession, batches: list[bytes]) -> None:
        for batch in batches:
            by.receive(batch, len(batch))

    return {
        "server answer": answers,
        "server session": partial(received, session(*scripts.ALL_PREPARED), scripts.UNPREPARED),
        "server planned session": partial(received, session(*scripts.READS), scripts.READS),
    }


def client_steps() -> dict[str, Step]:
    """The session with one call for all or one for each, and what plays its peer."""
    requests = [busway.ReadHoldingRegisters(number * REGISTERS, REGISTERS) for number in range(TRANSACTIONS)]

    def answers() -> None:
        for batch in scripts.READS:
            answered(batch)

    def session() -> TcpClientSession:
        made = TcpClientSession(ClientParameters(max_transactions=IN_FLIGHT, queue=TRANSACTIONS))
        made.connected(0.0)
        return made

    def exchanged(with_session: TcpClientSession, calls: list[Call]) -> None:
        for one in calls:
            with_session.submit(one, 0.0)
        while not all(one.ended for one in calls):
            sent = b"".join(with_session.transmit(0.0))
            came = answered(sent)
            with_session.receive(came, len(came), 0.0)
        with_session.finished.clear()

    many, single = session(), session()

    def together() -> None:
        exchanged(many, [Call(1, requests, is_write=False, timeout=1.0, retries=0)])

    def one_by_one() -> None:
        for at in range(0, TRANSACTIONS, IN_FLIGHT):
            some = requests[at : at + IN_FLIGHT]
            exchanged(single, [Call(1, [one], is_write=False, timeout=1.0, retries=0) for one in some])

    return {"answers": answers, "client session": together, "client session, one by one": one_by_one}


def _nothing(*_: Any) -> None:
    pass


class _SilentPeer(asyncio.BufferedProtocol):
    """Takes what comes and does nothing with it."""

    def __init__(self) -> None:
        self._buffer = bytearray(65_536)

    def get_buffer(self, sizehint: int) -> bytearray:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        pass


class _Asker(asyncio.Protocol):
    """Sends batches to a device, one after the other, and looks at nothing that comes back."""

    def __init__(self) -> None:
        self._batches = iter(scripts.READS)
        self.ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        batch = next(self._batches, None)
        if batch is None:
            self.ended.set_result(None)
        else:
            self._transport.write(batch)

    async def ask(self) -> None:
        self._batches = iter(scripts.READS)
        self.ended = asyncio.get_running_loop().create_future()
        self.data_received(b"")
        await self.ended


@asynccontextmanager
async def _peer(loop: MemoryLoop) -> AsyncIterator[scripts.Turn]:
    """The memory connection and its device alone: what is not the client's."""
    loop.listeners[1] = Device
    _, asker = await loop.create_connection(_Asker, "127.0.0.1", 1)
    assert isinstance(asker, _Asker)
    yield asker.ask


def driver_steps(loop: MemoryLoop, running: AsyncExitStack) -> dict[str, Step]:
    """Whole scripts, and what carries the bytes alone."""
    wire = Wire(loop, _SilentPeer(), ("127.0.0.1", 1))

    def carried() -> None:
        for batch in scripts.READS:
            wire.feed(batch)

    def whole(script: Script) -> Step:
        turn = loop.run_until_complete(running.enter_async_context(script(loop)))
        return lambda: loop.run_until_complete(turn())  # type: ignore[arg-type]

    return {
        "wire": carried,
        "server driver": whole(scripts.server_fast_path),
        "server planned driver": whole(scripts.server_planned_read),
        "client many": whole(scripts.client_execute_many),
        "client await": whole(scripts.client_await),
        "peer": whole(_peer),
    }


def measured(seconds: float) -> dict[str, Any]:
    """``{profile: {"parts": {part: µs}, "instructions": {layer: number}}}``, per transaction."""
    loop = MemoryLoop()
    asyncio.set_event_loop(loop)
    running = AsyncExitStack()
    try:
        steps = server_steps() | client_steps() | driver_steps(loop, running)
        found = quickest(steps, seconds)
        loop.run_until_complete(running.aclose())
    finally:
        loop.close()
    each = {name: nanoseconds / 1000 / TRANSACTIONS for name, nanoseconds in found.items()}
    for name in ("", ", one by one"):
        each[f"client own{name}"] = each[f"client session{name}"] - each["answers"]
    return {
        name: {
            "parts": {part.name: each[part.step] - sum(each[one] for one in part.less) for part in parts},
            "instructions": count(COUNTED[name]).layers,
        }
        for name, parts in PROFILES.items()
    }


def shown(found: Mapping[str, Any]) -> str:
    """For people."""
    lines = []
    for name, profile in found.items():
        lines += ["", f"{name}: {sum(profile['parts'].values()):.2f} µs"]
        lines += [f"  {part:<56} {microseconds:6.2f} µs" for part, microseconds in profile["parts"].items()]
        lines += [
            f"  instructions, {NAMES[layer]:<60} {number:7.1f}" for layer, number in profile["instructions"].items()
        ]
    return "\n".join(lines)


if __name__ == "__main__":
    words = [word for word in sys.argv[1:] if not word.startswith("--")]
    result = measured(float(words[0]) if words else 3.0)
    print(json.dumps(result) if "--json" in sys.argv else shown(result))

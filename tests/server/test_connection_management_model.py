"""A real server on sockets against a model that is written from docs/tcp.md alone, with a clock that the test moves.

Clients of several hosts connect, ask, fall silent, end and are refused, many at the same time of the clock. After each
event the model says which connections are open, in which pool and state and with what counts, and what each counter of
the server is. Where the page leaves a choice, such as between two silent connections, all of the choice will do.
The rules of the slots are in `slot_rules`.
"""

import asyncio
import random
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

import pytest
from handlers import ScriptedHandler, address_of, registers
from many_clients import answer, question, vanish
from slot_rules import SlotRules

import busway
from busway.pdu.functions import AnyRequest
from busway.server.connection_slots import SECONDS_TO_SPEAK, SlotLimits, SlotPool
from busway.server.status import ServedConnectionState

pytestmark = pytest.mark.usefixtures("transport")

PRIORITY_HOSTS = ("127.0.1.1", "127.0.1.2")
OTHER_HOSTS = ("127.0.0.3", "127.0.0.4", "127.0.0.5")
HEADER_TIMEOUT, FRAME_TIMEOUT, IDLE_TIMEOUT = 5.0, 10.0, 8.0
LATE = 0x8000
"""Requests for addresses from here on are answered when the test wants."""
STEPS = (0.0, 0.0, 0.125, SECONDS_TO_SPEAK / 2, SECONDS_TO_SPEAK, 3.0)
TURNS_TO_SETTLE = 6
LONGEST_WAIT = 20.0
"""Seconds of the real clock after which the server will not become what the model says."""


def request(number: int) -> bytes:
    return question(number, transaction=number & 0x7FFF)


def reply(number: int) -> bytes:
    return answer(number, transaction=number & 0x7FFF)


REQUEST_SIZE, REPLY_SIZE = len(request(0)), len(reply(0))


@dataclass(eq=False)
class Peer:
    """One connection of the model, with the client's end of it."""

    socket: socket.socket
    host: str
    name: str
    is_priority: bool
    opened: float
    last_used: float
    received: int = 0
    sent: int = 0
    requests: int = 0
    waiting: dict[int, busway.RequestContext] = field(default_factory=dict)
    begun: bytes = b""  # what has come of a request
    left: bytes = b""  # what has not
    begun_at: float = 0.0
    half_closed: bool = False
    has_ended: bool = False  # always: who ends is no longer open

    @property
    def is_busy(self) -> bool:
        return bool(self.waiting)

    @property
    def state(self) -> ServedConnectionState:
        if self.waiting:
            return ServedConnectionState.BUSY
        return ServedConnectionState.RECEIVING if self.begun else ServedConnectionState.IDLE


class Clock:
    """The monotonic clock of the process, which only the test moves; its steps are exact in binary."""

    def __init__(self) -> None:
        self.now = 4096.0

    def __call__(self) -> float:
        return self.now


class Walk:
    """One server, its clients, and what must be."""

    def __init__(self, server: busway.Server, chance: random.Random, clock: Clock, options: dict[str, Any]) -> None:
        self.server, self.chance, self.clock, self.options = server, chance, clock, options
        self.denied: set[str] = set()
        self.rules: SlotRules[Peer] = SlotRules(
            SlotLimits(
                options["max_priority_connections"],
                options["max_connections"],
                options["max_priority_per_host"],
                options["max_per_host"],
            )
        )
        self.counts: dict[str, int] = dict.fromkeys(COUNTERS, 0)
        self.number = 0
        self.contexts: dict[int, busway.RequestContext] = {}
        self.log: list[str] = []

    # --- what the page says ---

    @property
    def open(self) -> list[Peer]:
        return list(self.rules.open)

    def decision(self, host: str, *, has_ended: bool = False) -> tuple[SlotPool | None, list[Peer]]:
        return self.rules.decision(host, self.clock.now, is_priority=host in PRIORITY_HOSTS, has_ended=has_ended)

    def count(self, name: str, is_priority: bool | None = None, by: int = 1) -> None:
        if is_priority is not None:
            self.counts[f"{'priority' if is_priority else 'other'}.{name}"] += by
        if is_priority is None or name in ("accepted", "closed", "requests"):
            self.counts[name] += by

    def gone(self, one: Peer) -> None:
        """The server has no such connection any more; a priority slot goes to the oldest that may have it."""
        self.rules.leave(one)
        self.count("closed", one.is_priority)

    # --- events ---

    def dial(self, host: str) -> socket.socket:
        client = socket.socket()
        client.bind((host, 0))
        client.connect(("127.0.0.1", urlsplit(self.server.endpoints[0]).port))
        client.setblocking(False)
        return client

    async def connect(self) -> None:
        host = self.chance.choice(PRIORITY_HOSTS + OTHER_HOSTS)
        client = self.dial(host)
        self.log.append(f"connect {client.getsockname()}")
        if host in self.denied:
            self.count("unauthorized")
            await self.settled()
            await self.ended(client)
            return
        pool, leaves = self.decision(host)
        if pool is None:
            self.count("refused_full")
            await self.settled()
            await self.ended(client)
            return
        is_priority = host in PRIORITY_HOSTS
        await self.replaced(leaves)
        new = Peer(client, host, name_of(client), is_priority, self.clock.now, self.clock.now)
        self.rules.open[new] = pool
        self.count("accepted", is_priority)
        await self.settled()

    async def replaced(self, leaves: list[Peer]) -> None:
        """One of some connections makes room: see which."""
        if not leaves:
            return
        names = {one.name for one in leaves}
        await self.until(lambda: names - {one.peer for one in self.server.status().connections})
        here = {one.peer for one in self.server.status().connections}
        (evicted,) = [one for one in leaves if one.name not in here]
        self.count("evicted")
        self.gone(evicted)
        await self.ended(evicted.socket)

    async def knock(self) -> None:
        """A client connects, and has ended before the server looks."""
        host = self.chance.choice(PRIORITY_HOSTS + OTHER_HOSTS)
        with_reset = self.chance.random() < 0.5
        self.log.append(f"knock {host}")
        client = self.dial(host)
        if with_reset:
            vanish(client)
        else:
            client.close()
        if host in self.denied:
            self.count("unauthorized")
        elif self.decision(host, has_ended=True)[0] is None:
            self.count("refused_full")
        else:
            self.count("accepted", host in PRIORITY_HOSTS)
            self.count("closed", host in PRIORITY_HOSTS)
        await self.settled()

    async def hit_and_run(self) -> None:
        """A client connects, asks, and ends its half before the server looks; it still gets its reply."""
        host = self.chance.choice(PRIORITY_HOSTS + OTHER_HOSTS)
        self.log.append(f"hit and run {host}")
        if host in self.denied:
            return
        pool, leaves = self.decision(host)
        client = self.dial(host)
        number = self.next_number()
        client.sendall(request(number))
        client.shutdown(socket.SHUT_WR)
        if pool is None:
            self.count("refused_full")
        else:
            is_priority = host in PRIORITY_HOSTS
            await self.replaced(leaves)
            self.count("accepted", is_priority)
            self.count("closed", is_priority)
            self.count("requests", is_priority)
            self.count("received", is_priority, REQUEST_SIZE)
            self.count("sent", is_priority, REPLY_SIZE)
        await self.settled()
        assert received(client) == (reply(number) if pool is not None else b"")
        client.close()

    def next_number(self) -> int:
        self.number += 1
        return self.number

    def asked(self, one: Peer, number: int, size: int) -> None:
        """The rest of a request has come; the reply too, unless it is a late one."""
        one.last_used = self.clock.now
        one.received += size
        one.requests += 1
        one.begun = one.left = b""
        self.count("requests", one.is_priority)
        self.count("received", one.is_priority, size)
        if number < LATE:
            self.replied(one)

    def replied(self, one: Peer) -> None:
        one.sent += REPLY_SIZE
        one.last_used = self.clock.now
        self.count("sent", one.is_priority, REPLY_SIZE)

    async def ask(self) -> None:
        """Some clients ask at the same time, each once or several times; each gets its own answer."""
        free = [one for one in self.open if not one.begun and not one.half_closed]
        expected: dict[Peer, bytes] = {}
        for one in self.chance.sample(free, min(len(free), self.chance.randint(1, 3))):
            numbers = [self.next_number() for _ in range(self.chance.choice((1, 1, 3)))]
            self.log.append(f"ask {one.name} {numbers}")
            one.socket.sendall(b"".join(request(number) for number in numbers))
            expected[one] = b"".join(reply(number) for number in numbers)
            for number in numbers:
                self.asked(one, number, REQUEST_SIZE)
        await self.settled()
        for one, replies in expected.items():
            assert received(one.socket) == replies

    async def ask_for_late(self) -> None:
        free = [one for one in self.open if not one.begun and not one.half_closed and len(one.waiting) < 3]
        if not free:
            return
        one = self.chance.choice(free)
        number = self.next_number() | LATE
        self.log.append(f"late {one.name} {number}")
        one.socket.sendall(request(number))
        await self.until(lambda: number in self.contexts)
        one.waiting[number] = self.contexts.pop(number)
        self.asked(one, number, REQUEST_SIZE)
        await self.settled()

    async def answer_late(self) -> None:
        busy = [one for one in self.open if one.waiting]
        if not busy:
            return
        one = self.chance.choice(busy)
        number = self.chance.choice(list(one.waiting))
        self.log.append(f"answer {one.name} {number}")
        one.waiting.pop(number).reply(registers(number))
        self.replied(one)
        if one.half_closed and not one.waiting:
            self.gone(one)
        await self.settled()
        assert received(one.socket) == reply(number)
        if one not in self.open:
            await self.ended(one.socket)

    async def begin_request(self) -> None:
        free = [one for one in self.open if not one.begun and not one.half_closed and not one.waiting]
        if not free:
            return
        one = self.chance.choice(free)
        number, size = self.next_number(), self.chance.choice((1, 3, 7, 11))
        self.log.append(f"begin {one.name} {number} {size}")
        one.begun, one.left = request(number)[:size], request(number)[size:]
        one.begun_at = self.clock.now  # used is a connection when a whole request has come
        one.received += size
        self.count("received", one.is_priority, size)
        one.socket.sendall(one.begun)
        await self.settled()

    async def end_request(self) -> None:
        begun = [one for one in self.open if one.begun]
        if not begun:
            return
        one = self.chance.choice(begun)
        number = int.from_bytes((one.begun + one.left)[:2], "big")
        self.log.append(f"end {one.name} {number}")
        one.socket.sendall(one.left)
        self.asked(one, number, len(one.left))
        await self.settled()
        assert received(one.socket) == reply(number)

    async def leave(self) -> None:
        """A client closes, resets, or ends its half, and waits for what it is owed."""
        if not self.open:
            return
        one = self.chance.choice(self.open)
        how = self.chance.choice(("close", "reset", "half"))
        self.log.append(f"{how} {one.name}")
        if how == "half" and one.waiting:
            if not one.half_closed:
                one.half_closed = True
                one.socket.shutdown(socket.SHUT_WR)
            await self.turns()
        elif how == "half" or (how == "close" and not one.waiting):
            one.socket.shutdown(socket.SHUT_WR)
            self.gone(one)
            await self.settled()
            await self.ended(one.socket)
        elif not one.half_closed:
            vanish(one.socket)
            self.gone(one)
            await self.settled()

    async def later(self) -> None:
        """Time goes on; what is overdue ends."""
        self.clock.now += self.chance.choice(STEPS)
        now = self.clock.now
        self.log.append(f"now {now}")
        uncertain: list[Peer] = []
        idle_timeout = self.options["idle_timeout"]
        overdue: list[Peer] = []
        for one in self.open:
            if one.is_priority:
                continue
            if one.begun:
                limit = HEADER_TIMEOUT if len(one.begun) < 7 else FRAME_TIMEOUT
                if now - one.begun_at >= limit:
                    self.count("header_timeouts" if len(one.begun) < 7 else "frame_timeouts")
                    overdue.append(one)
            elif idle_timeout and not one.waiting:
                if now - one.last_used >= idle_timeout * 17 / 16:
                    self.count("idle_timeouts")
                    overdue.append(one)
                elif now - one.last_used >= idle_timeout:
                    uncertain.append(one)
        for one in overdue:
            self.gone(one)
        await self.turns()
        here = {one.peer for one in self.server.status().connections}
        for one in uncertain:
            if one.name not in here:
                self.count("idle_timeouts")
                self.gone(one)
                overdue.append(one)
        await self.settled()
        for one in overdue:
            await self.ended(one.socket)

    async def change_access(self) -> None:
        """The lists change: who may no longer connect ends, whatever its pool."""
        host = self.chance.choice(PRIORITY_HOSTS + OTHER_HOSTS)
        self.log.append(f"access {host}")
        self.denied ^= {host}  # in place: the server asks it
        ends = [one for one in self.open if one.host in self.denied]
        assert self.server.end_unauthorized() == len(ends)
        self.count("no_longer_authorized", by=len(ends))
        for one in ends:
            self.gone(one)
        await self.settled()
        for one in ends:
            await self.ended(one.socket)

    async def reset_counters(self) -> None:
        self.log.append("counters to zero")
        self.server.reset_counters()
        self.counts = dict.fromkeys(COUNTERS, 0)
        await self.settled()

    # --- comparing ---

    async def turns(self) -> None:
        for _ in range(TURNS_TO_SETTLE):
            await asyncio.sleep(0)

    async def ended(self, client: socket.socket) -> None:
        """The server has closed a connection, or is about to."""
        await self.until(lambda: has_been_closed(client))
        client.close()

    async def until(self, condition: Callable[[], object]) -> None:
        limit = time.perf_counter() + LONGEST_WAIT
        while not condition():
            assert time.perf_counter() < limit
            await asyncio.sleep(0)

    def difference(self) -> list[str]:
        status = self.server.status()
        now = self.clock.now
        is_here = [
            (one.peer, one.pool, one.state, one.age, one.idle, one.received, one.sent, one.requests, one.waiting)
            for one in status.connections
        ]
        should = [
            (
                one.name,
                pool,
                one.state,
                now - one.opened,
                now - one.last_used,
                one.received,
                one.sent,
                one.requests,
                len(one.waiting),
            )
            for one, pool in self.rules.open.items()
        ]
        found = [f"{a} instead of {b}" for a, b in zip(is_here, should, strict=False) if a != b]
        found += [f"{len(is_here)} connections instead of {len(should)}"] * (len(is_here) != len(should))
        for name, value in self.counts.items():
            seen: Any = status.counters
            for part in name.split("."):
                seen = getattr(seen, part)
            if seen != value:
                found.append(f"{name} {seen} instead of {value}")
        listener = status.listeners[0]
        if listener.priority_connections != len(self.rules.of(SlotPool.PRIORITY)):
            found.append("priority_connections")
        if listener.other_connections != len(self.rules.of(SlotPool.OTHER)):
            found.append("other_connections")
        return found

    async def settled(self) -> None:
        """Wait until the server is as the model says; then nothing more changes."""
        limit = time.perf_counter() + LONGEST_WAIT
        await self.turns()
        while found := self.difference():
            assert time.perf_counter() < limit, found
            await asyncio.sleep(0)


COUNTERS = [
    *("accepted", "closed", "evicted", "refused_full", "unauthorized", "no_longer_authorized", "requests"),
    *("broken_streams", "refused_busy", "discarded_frames"),
    *("header_timeouts", "frame_timeouts", "idle_timeouts", "write_timeouts"),
    *(f"{pool}.{name}" for pool in ("priority", "other") for name in ("accepted", "closed", "requests")),
    *(f"{pool}.{name}" for pool in ("priority", "other") for name in ("received", "sent")),
]


def name_of(client: socket.socket) -> str:
    host, port = client.getsockname()
    return f"{host}:{port}"


def received(client: socket.socket) -> bytes:
    """What has come so far."""
    try:
        return client.recv(65536)
    except (BlockingIOError, ConnectionError):
        return b""


def has_been_closed(client: socket.socket) -> bool:
    """Whether the server has closed a connection; it must have sent nothing more."""
    try:
        more = client.recv(4096)
    except BlockingIOError:
        return False
    except ConnectionError:
        return True
    assert more == b""
    return True


EVENTS: dict[Callable[[Walk], Any], int] = {
    Walk.connect: 10,
    Walk.ask: 6,
    Walk.later: 5,
    Walk.leave: 3,
    Walk.knock: 2,
    Walk.hit_and_run: 1,
    Walk.ask_for_late: 3,
    Walk.answer_late: 2,
    Walk.begin_request: 2,
    Walk.end_request: 1,
    Walk.change_access: 1,
    Walk.reset_counters: 1,
}


async def walk(seed: int, clock: Clock, steps: int) -> None:
    chance = random.Random(seed)
    max_connections, max_priority = chance.randint(1, 5), chance.randint(1, 3)
    options = {
        "max_connections": max_connections,
        "max_priority_connections": max_priority,
        "max_priority_per_host": chance.randint(1, max_priority),
        "max_per_host": chance.choice((None, 1, max_connections)),
        "idle_timeout": chance.choice((None, None, IDLE_TIMEOUT)),
    }
    contexts: dict[int, busway.RequestContext] = {}

    def respond(context: busway.RequestContext, asked: AnyRequest) -> Any:  # Any: a reply, or LATER
        number = address_of(asked)
        if number < LATE:
            return registers(number)
        contexts[number] = context
        return busway.LATER

    denied: set[str] = set()
    server = busway.serve(
        "tcp://127.0.0.1:0",
        responder=ScriptedHandler(respond),
        priority=PRIORITY_HOSTS,
        authorize=lambda host: host not in denied,
        header_timeout=HEADER_TIMEOUT,
        frame_timeout=FRAME_TIMEOUT,
        **options,
    )
    async with server:
        one = Walk(server, chance, clock, options)
        one.denied, one.contexts = denied, contexts
        one.log.append(f"seed {seed}: {options}")
        events = chance.choices(list(EVENTS), list(EVENTS.values()), k=steps)
        try:
            for event in events:
                await event(one)
        finally:
            print("\n".join(one.log[:1] + one.log[-40:]))  # it is shown if the test fails
            for peer in one.open:
                peer.socket.close()


@pytest.mark.clause("T12", "T13", "T14", "T15", "T18", "T34")
@pytest.mark.parametrize("seed", range(3))
def test_server_has_the_connections_and_counters_of_the_page_after_each_event(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock()
    monkeypatch.setattr(time, "monotonic", clock)
    asyncio.run(walk(seed, clock, steps=150))

"""Devices of our own on plain sockets, for tests of who reads them: every answer says who gave it, of what, and when.

Knows frames of Modbus/TCP and RTU as bytes; uses nothing of busway, so that a fault of busway cannot hide itself here.

1. A register of the tables is one quarter of a code: the device, the register's own address with its table, and in two
   registers how often the device was asked. So a value that belongs to another device, register or time shows it.
2. Each request is remembered with the times of its receipt and of its answer: `Field.answers`.
3. A device lies as its `Lies` say, by a seeded generator. On a line without transaction numbers only lies are told that
   can be told apart there: no second answer, no answer out of order.
"""

import asyncio
import os
import random
import struct
import threading
import time
import tty
from collections import defaultdict
from collections.abc import Callable, Coroutine, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self

from waiting import wait_until

SCALES = 1000
"""Here four registers are: device % 1000, an exponent of ten, how many places a group has, and 0."""
PLACES = 4
"""The most places that a group has."""
OPENED = 1_000_000
"""Each device counts its answers from its number times this, so that no two ever answer with one count."""


@dataclass(frozen=True, slots=True)
class Answer:
    """A request that a device got, and what came of it: times are nanoseconds since 1970."""

    device: int
    function: int
    start: int
    count: int
    round: int
    received: int
    answered: int
    lie: str

    def words(self) -> list[int]:
        """What the registers that were asked held."""
        return [word(self.device, self.function, self.start + n, self.round) for n in range(self.count)]

    def covers(self, function: int, start: int, count: int) -> bool:
        """Whether these items were asked."""
        return self.function == function and self.start <= start and start + count <= self.start + self.count


def word(device: int, function: int, register: int, turn: int) -> int:
    """What a register held when a device was asked for the ``turn``-th time."""
    if function == 3 and SCALES <= register < SCALES + 4:
        return (device % 1000, device % 4, 1 + device % PLACES, 0)[register - SCALES]
    quarter = register & 3
    return (device, (register & ~3) | (function & 3), turn >> 16 & 0xFFFF, turn & 0xFFFF)[quarter]


def bit(device: int, item: int, turn: int) -> bool:
    """What a coil or a discrete input was: sixteen say the device, the next sixteen the turn, and so on."""
    number = turn if item & 16 else device
    return bool(number >> (item & 15) & 1)


@dataclass(slots=True)
class Lies:
    """How often a device does what, of its answers, and what it refuses at all.

    Attributes:
        chances: probability by kind: late, silent, twice, foreign, short, long, exception, reset.
        delay: seconds of an honest answer.
        late: seconds of a late one, at least and at most.
        most: registers of one read; more are refused with exception 03.
        holes: ranges of registers that are refused with exception 02.
    """

    chances: Mapping[str, float] = field(default_factory=dict)
    delay: float = 0.0005
    late: tuple[float, float] = (0.2, 0.5)
    most: int = 125
    holes: Sequence[range] = ()


@dataclass(slots=True)
class LyingDevice:
    """One device at an endpoint."""

    number: int
    lies: Lies
    random: random.Random
    turns: int = 0
    free_at: float = 0.0
    is_dead: bool = False

    def kind(self, told: set[str]) -> str:
        """What it does with this request."""
        roll = self.random.random()
        for kind, chance in self.lies.chances.items():
            if kind in told:
                roll -= chance
                if roll < 0:
                    return kind
        return "honest"


Reply = Callable[[bytes], None]


class Field:
    """Devices at endpoints, answering in a thread of their own; a context manager.

    Attributes:
        answers: by number of device, all that it was asked for.
    """

    def __init__(self, seed: int = 0) -> None:
        self.answers: dict[int, list[Answer]] = defaultdict(list)
        self._random = random.Random(seed)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._ends: list[Callable[[], None]] = []
        self._next = 1

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        def stop() -> None:
            for end in self._ends:
                end()
            self._loop.call_later(0.05, self._loop.stop)

        self._loop.call_soon_threadsafe(stop)
        self._thread.join(5)
        self._loop.close()

    def wait_for_answers(self, count: int, seconds: float = 60.0) -> None:
        """Wait until the devices have been asked so many times more. Raises `TimeoutError`."""
        wanted = self._answered() + count
        wait_until(lambda: self._answered() >= wanted, seconds)

    def _answered(self) -> int:
        return sum(len(each) for each in list(self.answers.values()))

    def endpoint(self, kind: str, units: Sequence[int], lies: Lies | None = None) -> tuple[str, dict[int, LyingDevice]]:
        """Open an endpoint: ``tcp``, ``rtu+tcp`` or ``rtu``; its URL and its devices by unit."""
        devices = {}
        for unit in units:
            devices[unit] = LyingDevice(self._next, lies or Lies(), random.Random(self._random.random()))
            devices[unit].turns = OPENED * self._next % 2**31
            self._next += 1
        if kind == "tcp":
            return self._run(self._open_tcp(devices)), devices
        line = _Line(self, devices)
        url = self._run(self._open_rtu_tcp(line)) if kind == "rtu+tcp" else self._run(self._open_pty(line))
        return url, devices

    def _run(self, what: Coroutine[Any, Any, str]) -> str:
        return asyncio.run_coroutine_threadsafe(what, self._loop).result(5)

    async def _open_tcp(self, devices: dict[int, LyingDevice]) -> str:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            self._ends.append(writer.transport.abort)
            try:
                while True:
                    number, _, length, unit = struct.unpack(">HHHB", await reader.readexactly(7))
                    pdu = await reader.readexactly(length - 1)
                    device = devices.get(unit)
                    if device is not None and not device.is_dead:
                        self._answer_tcp(device, number, unit, pdu, writer)
            except (asyncio.IncompleteReadError, ConnectionError):
                writer.close()

        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        self._ends.append(server.close)
        return f"tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}"

    async def _open_rtu_tcp(self, line: "_Line") -> str:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            line.write = writer.write
            line.reset = writer.transport.abort
            line.received = b""
            self._ends.append(writer.transport.abort)
            with suppress(ConnectionError):
                while data := await reader.read(300):
                    line.receive(data)
            writer.close()

        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        self._ends.append(server.close)
        return f"rtu+tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}"

    async def _open_pty(self, line: "_Line") -> str:
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)

        def readable() -> None:
            line.receive(os.read(master, 300))

        def end() -> None:
            self._loop.remove_reader(master)
            os.close(master)
            os.close(slave)

        def write(data: bytes) -> None:
            with suppress(OSError):  # the end of the test, or the peer does not read
                os.write(master, data)

        line.write = write
        self._loop.add_reader(master, readable)
        self._ends.append(end)
        return f"rtu://{os.ttyname(slave)}?baud=115200"

    def _answer_tcp(
        self, device: LyingDevice, number: int, unit: int, pdu: bytes, writer: asyncio.StreamWriter
    ) -> None:
        def send(tail: bytes, other: int = unit) -> None:
            if not writer.is_closing():
                writer.write(struct.pack(">HHHB", number, 0, len(tail) + 1, other) + tail)

        def twice(tail: bytes) -> None:
            send(tail)
            self._loop.call_later(device.random.uniform(0, 0.02), send, tail)

        def foreign(tail: bytes) -> None:
            send(tail, unit ^ device.random.randrange(1, 256))

        actions: dict[str, Reply] = {
            "twice": twice,
            "foreign": foreign,
            "reset": lambda tail: writer.transport.abort(),
        }
        told = {"late", "silent", "short", "long", "exception", *actions}
        self.answer(device, pdu, send, actions, told, keeps_order=False)

    def answer(
        self,
        device: LyingDevice,
        pdu: bytes,
        send: Reply,
        actions: dict[str, Reply],
        told: set[str],
        *,
        keeps_order: bool,
    ) -> None:
        """Have a device answer a request, or lie, and remember it."""
        received = time.time_ns()
        if pdu[0] not in (1, 2, 3, 4) or len(pdu) != 5:
            self._at(device, 0.0, keeps_order, lambda: send(bytes((pdu[0] | 0x80, 1))))
            return
        function, start, count = struct.unpack(">BHH", pdu)
        device.turns += 1
        turn = device.turns
        refused = _refusal(device.lies, function, start, count)
        kind = "refused" if refused else device.kind(told)
        honest = _tail(device.number, function, start, count, turn)
        if refused or kind == "exception":
            tail = bytes((function | 0x80, refused or device.random.choice((4, 6, 0x0B))))
        elif kind in ("short", "long"):
            other = count + (-1 if kind == "short" and count > 1 else 1) * (16 if function < 3 else 1)
            tail = _tail(device.number, function, start, max(1, other), turn)
        else:
            tail = honest

        def act() -> None:
            answer = Answer(device.number, function, start, count, turn, received, time.time_ns(), kind)
            self.answers[device.number].append(answer)
            if kind != "silent":
                actions.get(kind, send)(tail)

        delay = device.lies.delay
        self._at(device, device.random.uniform(*device.lies.late) if kind == "late" else delay, keeps_order, act)

    def _at(self, device: LyingDevice, delay: float, keeps_order: bool, act: Callable[[], None]) -> None:
        moment = self._loop.time() + delay
        if keeps_order:
            moment = device.free_at = max(moment, device.free_at + 1e-6)
        self._loop.call_at(moment, act)


class _Line:
    """RTU frames of one line, with several units."""

    def __init__(self, world: Field, devices: dict[int, LyingDevice]) -> None:
        self._field = world
        self._devices = devices
        self.received = b""
        self.write: Callable[[bytes], None] = lambda data: None
        self.reset: Callable[[], None] = lambda: None

    def receive(self, data: bytes) -> None:
        self.received += data
        while len(self.received) >= 8:
            frame = self.received[:8]
            if crc(frame[:6]) != frame[6:]:
                self.received = self.received[1:]
                continue
            self.received = self.received[8:]
            device = self._devices.get(frame[0])
            if device is not None and not device.is_dead:
                self._answer(device, frame[0], frame[1:6])

    def _answer(self, device: LyingDevice, unit: int, pdu: bytes) -> None:
        def send(tail: bytes, other: int = unit) -> None:
            body = bytes((other,)) + tail
            self.write(body + crc(body))

        def foreign(tail: bytes) -> None:
            send(tail, 240)  # no device has this unit, so it is not taken for an answer that is owed
            send(tail)

        actions: dict[str, Reply] = {"foreign": foreign, "reset": lambda tail: self.reset()}
        told = {"late", "silent", "short", "long", "exception", *actions}
        self._field.answer(device, pdu, send, actions, told, keeps_order=True)


def _refusal(lies: Lies, function: int, start: int, count: int) -> int:
    if function < 3:
        return 0
    if any(start < hole.stop and hole.start < start + count for hole in lies.holes):
        return 2
    return 3 if count > lies.most else 0


def _tail(device: int, function: int, start: int, count: int, turn: int) -> bytes:
    if function < 3:
        data = bytearray((count + 7) // 8)
        for item in range(count):
            data[item // 8] |= bit(device, start + item, turn) << item % 8
        return bytes((function, len(data))) + bytes(data)
    words = [word(device, function, start + n, turn) for n in range(count)]
    return bytes((function, 2 * count & 0xFF)) + struct.pack(f">{count}H", *words)


def crc(data: bytes) -> bytes:
    """The check of an RTU frame, as it goes over the line."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ 0xA001 if value & 1 else value >> 1
    return value.to_bytes(2, "little")

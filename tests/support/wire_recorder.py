"""Devices on plain sockets that record each write request on their wire, and do with it what a test says.

Knows frames of Modbus/TCP as bytes; uses nothing of busway, so that a fault of busway cannot hide itself here.

1. A write is recorded when its request has arrived, whatever the device does with it then.
2. What a device does with its next writes is a queue of deeds; when that is empty, it does what is usual for it.
3. Reads are recorded too, so that a test sees what went before what.
"""

import asyncio
import contextlib
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass, field, replace
from types import TracebackType
from typing import Any, Self

SIZE = 400
"""Registers and coils of a unit."""
READS = {1, 2, 3, 4}
LATE = 0.6
"""Seconds after which a late answer comes: longer than the timeout of the links of these tests."""


@dataclass(frozen=True, slots=True)
class WireRequest:
    """A request that arrived: when (seconds since 1970, and monotonic), where, and what it asked.

    ``items`` are registers or coils that are to be written; of function 22 its masks; of reads nothing. ``deed`` is
    what the device does with a write.
    """

    at: float
    moment: float
    link: str
    unit: int
    function: int
    address: int
    count: int
    items: tuple[int, ...] = ()
    deed: str = ""

    @property
    def is_write(self) -> bool:
        return self.function not in READS


@dataclass(slots=True)
class RecordedUnit:
    """One device.

    Attributes:
        usual: what it does with a write: ``done``, ``refuse``, ``silent`` (done, no answer), ``lost`` (not done, no
            answer), ``late`` (done, answered too late), ``later`` (done and answered too late), ``cut`` (done, and
            the connection ends), ``cut before`` (not done), ``other`` (something else is held), ``overwritten``
            (another writer comes after it), ``wait`` (answered when `WireRecorder.release` is called).
        next: what it does with the next writes, before that.
        read_delay: seconds before a read is answered.
        is_dead: it hears nothing.
        mirrors: what is written to the first register is shown at the second too.
    """

    usual: str = "done"
    next: deque[str] = field(default_factory=deque)
    read_delay: float = 0.0
    is_dead: bool = False
    registers: list[int] = field(default_factory=lambda: [0] * SIZE)
    coils: list[int] = field(default_factory=lambda: [0] * SIZE)
    mirrors: dict[int, int] = field(default_factory=dict)


class WireRecorder:
    """Links with devices, answering in a thread of their own; a context manager.

    Attributes:
        requests: all that has arrived, in order.
        units: by link and number.
    """

    def __init__(self) -> None:
        self.requests: list[WireRequest] = []
        self.units: dict[tuple[str, int], RecordedUnit] = {}
        self._ports: dict[str, int] = {}
        self._servers: dict[str, asyncio.Server] = {}
        self._writers: dict[str, set[asyncio.StreamWriter]] = {}
        self._waiting: list[Callable[[], None]] = []
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for link in list(self._servers):
            self.take_down(link)
        self._run(asyncio.sleep(0.02))
        self._run(_end_of_tasks())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5)
        self._loop.close()

    # What a test does.

    def open(self, link: str, units: Sequence[int]) -> str:
        """Open a link with these units; its URL."""
        for unit in units:
            self.units[link, unit] = RecordedUnit()
        self._writers[link] = set()
        self._ports[link] = 0
        self.bring_up(link)
        return f"tcp://127.0.0.1:{self._ports[link]}"

    def bring_up(self, link: str) -> None:
        """Listen again, on the port of before."""
        if link not in self._servers:
            self._run(self._listen(link))

    def take_down(self, link: str) -> None:
        """End all connections, and listen no more."""
        server = self._servers.pop(link, None)
        if server is not None:
            self._run(self._hang_up(link, server))

    def cut(self, link: str) -> None:
        """End all connections; the next one is accepted."""
        self._run(self._hang_up(link, None))

    def release(self) -> None:
        """Answer the writes that wait."""

        def act() -> None:
            waiting, self._waiting = self._waiting, []
            for each in waiting:
                each()

        self._loop.call_soon_threadsafe(act)

    def writes(self, link: str | None = None, unit: int | None = None) -> list[WireRequest]:
        """The writes that have arrived."""
        return [
            each
            for each in list(self.requests)
            if each.is_write and link in (None, each.link) and unit in (None, each.unit)
        ]

    # What happens in the thread.

    def _run(self, what: Coroutine[Any, Any, None]) -> None:
        asyncio.run_coroutine_threadsafe(what, self._loop).result(10)

    async def _listen(self, link: str) -> None:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            self._writers[link].add(writer)
            with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
                while True:
                    number, _, length, unit = struct.unpack(">HHHB", await reader.readexactly(7))
                    self._take(link, unit, number, await reader.readexactly(length - 1), writer)
            self._writers[link].discard(writer)
            writer.close()

        self._servers[link] = server = await asyncio.start_server(serve, "127.0.0.1", self._ports[link])
        self._ports[link] = server.sockets[0].getsockname()[1]

    async def _hang_up(self, link: str, server: asyncio.Server | None) -> None:
        if server is not None:
            server.close()
        for writer in list(self._writers[link]):
            writer.transport.abort()

    def _take(self, link: str, unit: int, number: int, pdu: bytes, writer: asyncio.StreamWriter) -> None:
        device = self.units.get((link, unit))
        request, deed = _decoded(link, unit, pdu), ""
        is_heard = device is not None and not device.is_dead
        if device is not None and request.is_write:
            deed = "lost" if not is_heard else device.next.popleft() if device.next else device.usual
            request = replace(request, deed=deed)
        self.requests.append(request)
        if device is None or not is_heard:
            return

        def send(tail: bytes) -> None:
            if not writer.is_closing():
                writer.write(struct.pack(">HHHB", number, 0, len(tail) + 1, unit) + tail)

        if not request.is_write:
            answer = _read(device, request)
            if device.read_delay:
                self._loop.call_later(device.read_delay, send, answer)
            else:
                send(answer)
            return
        self._do(deed, device, request, pdu, send, writer)

    def _do(
        self,
        deed: str,
        device: RecordedUnit,
        request: WireRequest,
        pdu: bytes,
        send: Callable[[bytes], None],
        writer: asyncio.StreamWriter,
    ) -> None:
        def execute() -> None:
            _write(device, request, request.items)

        def answer() -> None:
            send(pdu if request.function == 22 else pdu[:5])

        def executed_and_answered() -> None:
            execute()
            answer()

        if deed == "refuse":
            send(bytes((request.function | 0x80, 4)))
        elif deed == "lost":
            pass
        elif deed == "later":
            self._loop.call_later(LATE, executed_and_answered)
        elif deed == "cut before":
            writer.transport.abort()
        elif deed == "wait":
            self._waiting.append(executed_and_answered)
        elif deed == "other":
            _write(device, request, tuple(item ^ 1 for item in request.items))
            answer()
        else:
            execute()
            if deed == "late":
                self._loop.call_later(LATE, answer)
            elif deed == "cut":
                writer.transport.abort()
            elif deed != "silent":
                answer()
            if deed == "overwritten":
                _write(device, request, tuple(item ^ 1 for item in request.items))


async def _end_of_tasks() -> None:
    tasks = asyncio.all_tasks() - {asyncio.current_task()}
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def _decoded(link: str, unit: int, pdu: bytes) -> WireRequest:
    function, address, count = pdu[0], *struct.unpack(">HH", pdu[1:5])
    at, moment = time.time(), time.monotonic()
    if function in READS:
        return WireRequest(at, moment, link, unit, function, address, count)
    if function == 5:
        items: tuple[int, ...] = (int(count == 0xFF00),)
    elif function == 6:
        items = (count,)
    elif function == 15:
        items = tuple(pdu[6 + n // 8] >> n % 8 & 1 for n in range(count))
    elif function == 16:
        items = struct.unpack(f">{count}H", pdu[6:])
    else:
        items = struct.unpack(">HH", pdu[3:7])
    return WireRequest(at, moment, link, unit, function, address, 1 if function in (5, 6, 22) else count, items)


def _read(device: RecordedUnit, request: WireRequest) -> bytes:
    first, end = request.address, request.address + request.count
    if end > SIZE:
        return bytes((request.function | 0x80, 2))
    if request.function < 3:
        number = sum(bit << n for n, bit in enumerate(device.coils[first:end]))
        data = number.to_bytes((request.count + 7) // 8, "little")
    else:
        data = struct.pack(f">{request.count}H", *device.registers[first:end])
    return bytes((request.function, len(data))) + data


def _write(device: RecordedUnit, request: WireRequest, items: tuple[int, ...]) -> None:
    if request.function == 22:
        held = device.registers[request.address]
        items = ((held & items[0]) | (items[1] & ~items[0] & 0xFFFF),)
    table = device.coils if request.function in (5, 15) else device.registers
    table[request.address : request.address + len(items)] = items
    for written, shown in device.mirrors.items():
        if request.address <= written < request.address + len(items) and table is device.registers:
            device.registers[shown] = device.registers[written]

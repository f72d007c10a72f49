"""Sockets that fail at the operation that a schedule names, with a device behind them that notes what reached it.

The device is no thread: what a socket takes it works through at once, and its reply is there to be received. So a run
of one thread is the same each time, and every operation of it can be made to fail.

1. Each operation (connect, send, receive, close) has a number. A schedule says what happens at which.
2. Requests are told by a number of theirs: the value of a write (function 06), the address of a read (function 03).
3. A request whose call has ended is `Wire.end`-ed. A byte of it that leaves later is noted in ``late``.
"""

import socket
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import contextmanager
from enum import Enum
from typing import Any

import pytest

from busway.client.connector import Connector
from busway.errors import LinkDown
from busway.transport.dialling import _epoll_set_of
from busway.transport.epoll.stream import EpollStream
from busway.transport.epoll.watcher import can_watch

UNANSWERED = 0xFFFF
"""Address that the device does not answer."""
PART = 5
"""Bytes of what is to be sent that are taken where only a part is: less than a header."""


class Fault(Enum):
    """What happens at an operation."""

    REFUSED = "connect: nothing listens"
    BROKEN = "connect: the system fails"
    RESET = "send: the peer has reset"
    PART_THEN_RESET = "send: a part is taken, and then the peer resets"
    EXECUTED_THEN_RESET = "send: all is taken and executed, and then the peer resets"
    PART = "send: a part is taken"
    BLOCKED = "send: nothing is taken now"
    PART_THEN_STUCK = "send: a part is taken, and nothing more"
    STUCK = "send: nothing is taken any more"
    SILENT = "send: all is taken, and nothing answered any more"
    RECEIVE_RESET = "receive: the peer has reset"
    ENDED = "receive: the peer has closed"
    NOTHING = "receive: there is nothing after all"
    CLOSE_FAILS = "close: the system fails"

    @property
    def operation(self) -> str:
        """The operation that it happens at."""
        return self.value.split(":")[0]


class Wire:
    """All connections of one client to one device.

    Attributes:
        operations: those of the run so far, by their numbers.
        executed: how often the device executed each write.
        touched: requests of which at least one byte left, in that order.
        late: requests of which a byte left after their call had ended.
        broken: what a device would have read that is no request.
    """

    def __init__(self, faults: Mapping[int, Fault]) -> None:
        self.faults = faults
        self.operations: list[str] = []
        self.executed: Counter[int] = Counter()
        self.touched: dict[int, None] = {}
        self.late: list[int] = []
        self.broken: list[str] = []
        self.lock = threading.RLock()
        self._ended: set[int] = set()
        self._sockets: list[FailingSocket] = []

    def end(self, *numbers: int) -> None:
        """The call with these requests has ended."""
        with self.lock:
            self._ended.update(numbers)

    def next(self, operation: str) -> Fault | None:
        """Count an operation; the fault that happens at it."""
        with self.lock:
            fault = self.faults.get(len(self.operations))
            self.operations.append(operation)
        return fault if fault is not None and fault.operation == operation else None

    def dial(self) -> "FailingSocket":
        """A connection."""
        fault = self.next("connect")
        if fault is Fault.REFUSED:
            raise LinkDown("no connection: nothing listens there")
        if fault is Fault.BROKEN:
            raise OSError(24, "Too many open files")
        ours, theirs = socket.socketpair()
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)
        connection = FailingSocket(self, ours, theirs)
        self._sockets.append(connection)
        return connection

    def leaves(self, stream: bytes, begin: int, end: int) -> None:
        """The bytes from ``begin`` to ``end`` of ``stream`` have left; it holds the rest of their frames, too."""
        at = 0
        while at < end:
            size = int.from_bytes(stream[at + 4 : at + 6], "big") + 6
            frame = stream[at : at + size]
            if len(frame) != 12 or frame[2:4] != b"\0\0" or frame[6] != 1 or frame[7] not in (3, 6):
                self.broken.append(stream[at:].hex(" "))
                return
            if at + size > begin:
                number = int.from_bytes(frame[10:12] if frame[7] == 6 else frame[8:10], "big")
                self.touched[number] = None
                if number in self._ended:
                    self.late.append(number)
                if frame[7] == 6 and at + size <= end:
                    self.executed[number] += 1
            at += size

    def close(self) -> None:
        """Close what is still open."""
        for connection in self._sockets:
            connection.theirs.close()
            socket.socket.close(connection)


class FailingSocket(socket.socket):
    """The client's end of one connection."""

    def __init__(self, wire: Wire, ours: socket.socket, theirs: socket.socket) -> None:
        super().__init__(fileno=ours.detach())
        self.setblocking(False)
        self._wire = wire
        self.theirs = theirs
        self._stream = b""
        self._is_reset = self._is_stuck = self._is_silent = False

    def send(self, data: Any, flags: int = 0, /) -> int:
        """Hand bytes to the device."""
        with self._wire.lock:
            fault = self._wire.next("send")
            if fault is Fault.RESET:
                self._reset()
            if self._is_reset:
                raise ConnectionResetError(104, "Connection reset by peer")
            if fault is Fault.BLOCKED or self._is_stuck:
                raise BlockingIOError(11, "Resource temporarily unavailable")
            if fault in (Fault.STUCK, Fault.PART_THEN_STUCK):
                self._stick()
            if fault is Fault.STUCK:
                raise BlockingIOError(11, "Resource temporarily unavailable")
            self._is_silent = self._is_silent or fault in (Fault.SILENT, Fault.EXECUTED_THEN_RESET)
            is_part = fault in (Fault.PART, Fault.PART_THEN_RESET, Fault.PART_THEN_STUCK)
            taken = self._take(bytes(data), PART if is_part else len(data))
            if fault in (Fault.PART_THEN_RESET, Fault.EXECUTED_THEN_RESET):
                self._reset()
            return taken

    def sendmsg(self, buffers: Any, *more: Any) -> int:
        """As `send`: some transports of asyncio have it so."""
        return self.send(b"".join(bytes(one) for one in buffers))

    def recv_into(self, buffer: Any, nbytes: int = 0, flags: int = 0, /) -> int:
        """Take what the device has said."""
        self._before_receiving()
        return super().recv_into(buffer, nbytes, flags)

    def recv(self, size: int, flags: int = 0, /) -> bytes:
        """As `recv_into`."""
        self._before_receiving()
        return super().recv(size, flags)

    def close(self) -> None:
        """Close it."""
        is_open = self.fileno() >= 0
        super().close()
        self.theirs.close()
        if is_open and self._wire.next("close") is Fault.CLOSE_FAILS:
            raise ConnectionResetError(104, "Connection reset by peer")

    def _before_receiving(self) -> None:
        with self._wire.lock:
            fault = self._wire.next("receive")
            if fault is Fault.RECEIVE_RESET:
                self._reset()
            if fault is Fault.ENDED:
                self._drain()
                self.theirs.close()
            if self._is_reset:
                raise ConnectionResetError(104, "Connection reset by peer")
            if fault is Fault.NOTHING:
                raise BlockingIOError(11, "Resource temporarily unavailable")

    def _take(self, data: bytes, at_most: int) -> int:
        offered = self._stream + data
        begin = len(self._stream)
        end = min(begin + at_most, len(offered))
        self._wire.leaves(offered, begin, end)
        self._stream = offered[:end]
        while not self._is_silent and len(self._stream) >= 12 and self.theirs.fileno() >= 0:
            frame, self._stream = self._stream[:12], self._stream[12:]
            if frame[8:10] != UNANSWERED.to_bytes(2, "big"):
                self.theirs.send(frame if frame[7] == 6 else frame[:4] + b"\0\5" + frame[6:8] + b"\2" + frame[8:10])
        return end - begin

    def _reset(self) -> None:
        self._is_reset = True
        self.theirs.close()

    def _stick(self) -> None:
        """Take nothing any more, so that no poll says that there is room."""
        self._is_stuck = True
        while True:
            try:
                super().send(bytes(4096))
            except BlockingIOError:
                return

    def _drain(self) -> None:
        while True:
            try:
                if not super().recv(4096):
                    return
            except OSError:
                return


class WireConnector:
    """A `Connector` whose connections are those of a wire. ``plain``: with the transports of the loop."""

    def __init__(self, wire: Wire, *, plain: bool = False) -> None:
        self._wire = wire
        self._plain = plain

    async def connect(self, protocol: Callable[[], Any]) -> Any:
        """A transport."""
        import asyncio

        loop = asyncio.get_running_loop()
        await asyncio.sleep(0)
        connection = self._wire.dial()
        if self._plain or not can_watch(loop):
            transport, _ = await loop.create_connection(protocol, sock=connection)
            return transport
        stream = EpollStream(_epoll_set_of(loop), connection, protocol(), "the device")
        stream.begin()
        return stream

    def dial(self) -> FailingSocket:
        """A socket."""
        return self._wire.dial()

    def release(self) -> None:
        """Nothing is held."""


@contextmanager
def connected_by(connector: Connector) -> Any:
    """Let all new links, of either kind, get their connections from one connector."""
    with pytest.MonkeyPatch.context() as patched:
        for pool in ("pool", "blocking_pool"):
            patched.setattr(f"busway.client.{pool}.connector_for", lambda *_, **__: connector)
        yield

"""A unit in real time that takes long for some requests and then answers all that it got, in their order.

Stands behind a socket or a port; speaks RTU or ASCII. A read of two registers gives the address asked and the number
of the request, a read of one gives what was written there last, so that an answer tells what it answers.
"""

from __future__ import annotations

import os
import select
import socket
import threading
import time
import tty
from collections.abc import Callable, Container
from types import TracebackType
from typing import Self

from busway.framing.character_times import SerialTiming
from busway.framing.frame_direction import LineRole
from busway.framing.received import SerialFrame
from busway.session.line_framing import line_framing

PROMPT = 0.03
HICCUP = 1.2


class LateUnit:
    """A unit, served by a thread while the ``with`` lasts.

    Args:
        scheme: ``rtu+tcp``, ``ascii+tcp``, ``rtu+udp`` or, with a ``path``, ``rtu``.
        path: of the port where it is.
        hiccups: numbers of the requests for data, counted from 1, that take `HICCUP`.

    Attributes:
        url: where clients find it.
        heard: the PDUs of all requests so far.
    """

    def __init__(self, scheme: str, *, path: str | None = None, options: str = "", hiccups: Container[int] = (3,)):
        self.heard: list[bytes] = []
        self.hiccups: Container[int] = hiccups
        self.asked_for_data = 0
        self.registers: dict[int, int] = {}
        self._framing = line_framing(
            scheme.split("+")[0], LineRole.SERVER, SerialTiming.of_network(), units=range(1, 248)
        )
        self._due: list[tuple[float, bytes]] = []
        self._free_at = 0.0
        self._stop = threading.Event()
        self._socket: socket.socket | None = None
        self._peer: object = None
        self._port = -1
        self._say: Callable[[bytes], object] | None = None
        if path is not None:
            self._port = os.open(path, os.O_RDWR | os.O_NOCTTY)
            tty.setraw(self._port)
            self.url = f"{scheme}://{path}{options}"
        else:
            kind = socket.SOCK_DGRAM if scheme.endswith("udp") else socket.SOCK_STREAM
            self._socket = socket.socket(socket.AF_INET, kind)
            self._socket.bind(("127.0.0.1", 0))
            if kind == socket.SOCK_STREAM:
                self._socket.listen()
            self.url = f"{scheme}://127.0.0.1:{self._socket.getsockname()[1]}{options}"
        self._is_stream = scheme.endswith("tcp")
        self._connections: list[socket.socket] = []
        self._thread = threading.Thread(target=self._serve, name="late-unit", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join(10)
        for one in (*self._connections, self._socket):
            if one is not None:
                one.close()
        if self._port >= 0:
            os.close(self._port)

    def _serve(self) -> None:
        while not self._stop.is_set():
            now = time.monotonic()
            wait = min([0.05, *(max(0.0, at - now) for at, _ in self._due[:1])])
            first = self._socket if self._socket is not None else self._port
            for ready in select.select([first, *self._connections], [], [], wait)[0]:
                self._take(ready)
            now = time.monotonic()
            self._found(self._framing.receiver.tick(now), now)
            while self._due and self._due[0][0] <= time.monotonic():
                self._answer(self._due.pop(0)[1])

    def _take(self, ready: socket.socket | int) -> None:
        if isinstance(ready, int):
            data = os.read(ready, 4096)
        elif ready is self._socket and self._is_stream:
            self._connections.append(ready.accept()[0])
            return
        elif ready is self._socket:
            data, self._peer = ready.recvfrom(4096)
        else:
            try:
                data = ready.recv(4096)
            except OSError:
                data = b""
            if not data:
                self._connections.remove(ready)
                ready.close()
                return
        now = time.monotonic()
        self._found(self._framing.receiver.receive(data, now), now)

    def _found(self, frames: object, now: float) -> None:
        for frame in frames:  # type: ignore[attr-defined]
            if isinstance(frame, SerialFrame):
                self._heard(frame.unit, frame.pdu, now)

    def _heard(self, unit: int, pdu: bytes, now: float) -> None:
        self.heard.append(pdu)
        takes = PROMPT
        if pdu[0] in (3, 6, 16):
            self.asked_for_data += 1
            takes = HICCUP if self.asked_for_data in self.hiccups else PROMPT
        self._free_at = max(now, self._free_at) + takes
        self._due.append((self._free_at, self._framing.encode(unit, self._reply(pdu))))

    def _reply(self, pdu: bytes) -> bytes:
        address, count = int.from_bytes(pdu[1:3], "big"), int.from_bytes(pdu[3:5], "big")
        if pdu[0] == 3 and count == 1:
            words = [self.registers.get(address, 0)]
        elif pdu[0] == 3:
            words = [address, len(self.heard), *[0] * (count - 2)]
        elif pdu[0] == 6:
            self.registers[address] = count
            return pdu
        elif pdu[0] == 16:
            for number in range(count):
                self.registers[address + number] = int.from_bytes(pdu[6 + 2 * number : 8 + 2 * number], "big")
            return pdu[:5]
        elif pdu[0] == 8:
            return pdu
        else:
            return bytes((pdu[0] | 0x80, 1))
        return bytes((3, 2 * count)) + b"".join(one.to_bytes(2, "big") for one in words)

    def _answer(self, frame: bytes) -> None:
        try:
            if self._port >= 0:
                os.write(self._port, frame)
            elif self._connections:
                self._connections[-1].sendall(frame)
            elif self._socket is not None and self._peer is not None:
                self._socket.sendto(frame, self._peer)  # type: ignore[arg-type]
        except OSError:
            pass  # its peer is gone

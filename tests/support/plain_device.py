"""A device of a few lines, and a TCP server for it that keeps every PDU it got: an independent record of what arrived.

Knows bytes and asyncio; nothing of the library under test.
"""

import asyncio
import struct
from collections.abc import Callable
from dataclasses import dataclass, field

SIZE = 64
"""Items of each table, and records of each file."""


class Refused(Exception):
    """The device answers with an exception code."""


@dataclass
class PlainDevice:
    """Tables of `SIZE` items, files 1 and 2, and a queue at register 5."""

    holding: list[int] = field(default_factory=lambda: [1000 + n for n in range(SIZE)])
    input: list[int] = field(default_factory=lambda: [2000 + n for n in range(SIZE)])
    coil: list[int] = field(default_factory=lambda: [n % 3 == 0 for n in range(SIZE)])
    discrete: list[int] = field(default_factory=lambda: [n % 5 == 0 for n in range(SIZE)])
    files: dict[int, list[int]] = field(default_factory=lambda: {n: [n * 100 + r for r in range(SIZE)] for n in (1, 2)})
    queue: tuple[int, ...] = (7, 8, 9)

    def execute(self, pdu: bytes) -> bytes | None:
        """The reply; None for functions that this device knows nothing of."""
        try:
            return self._execute(pdu[0], pdu[1:])
        except Refused as refusal:
            return bytes((pdu[0] | 0x80, refusal.args[0]))
        except struct.error:
            return bytes((pdu[0] | 0x80, 3))

    def _execute(self, function: int, body: bytes) -> bytes | None:
        if function in (1, 2):
            address, count = struct.unpack(">HH", body)
            bits = _part({1: self.coil, 2: self.discrete}[function], address, count, 2000)
            packed = sum(bool(bit) << n for n, bit in enumerate(bits)).to_bytes((count + 7) // 8, "little")
            return bytes((function, len(packed))) + packed
        if function in (3, 4):
            address, count = struct.unpack(">HH", body)
            data = _registers(_part({3: self.holding, 4: self.input}[function], address, count, 125))
            return bytes((function, len(data))) + data
        if function in (5, 6):
            address, value = struct.unpack(">HH", body)
            if function == 5 and value not in (0, 0xFF00):
                raise Refused(3)
            _replace(self.coil if function == 5 else self.holding, address, [bool(value) if function == 5 else value])
            return bytes((function,)) + body
        if function == 22:
            address, keep, put = struct.unpack(">HHH", body)
            (value,) = _part(self.holding, address, 1, 1)
            self.holding[address] = (value & keep) | (put & ~keep & 0xFFFF)
            return bytes((function,)) + body
        if function in (15, 16, 23):
            return self._write_many(function, body)
        if function in (20, 21):
            return self._records(function, body)
        if function == 24:
            (address,) = struct.unpack(">H", body)
            if address != 5:
                raise Refused(2)
            return struct.pack(">BHH", 24, 2 + 2 * len(self.queue), len(self.queue)) + _registers(list(self.queue))
        return None

    def _write_many(self, function: int, body: bytes) -> bytes:
        head = 9 if function == 23 else 5
        address, count, size = struct.unpack(">HHB", body[head - 5 : head])
        data = body[head:]
        right = (count + 7) // 8 if function == 15 else 2 * count
        if not 1 <= count <= {15: 1968, 16: 123, 23: 121}[function] or not size == right == len(data):
            raise Refused(3)
        if function == 15:
            bits = int.from_bytes(data, "little")
            _replace(self.coil, address, [bool((bits >> n) & 1) for n in range(count)])
            return bytes((function,)) + body[:4]
        values = list(struct.unpack(f">{count}H", data))
        if function == 16:
            _replace(self.holding, address, values)
            return bytes((function,)) + body[:4]
        first, number = struct.unpack(">HH", body[:4])
        _part(self.holding, first, number, 125)
        _replace(self.holding, address, values)
        read = _registers(_part(self.holding, first, number, 125))
        return bytes((function, len(read))) + read

    def _records(self, function: int, body: bytes) -> bytes:
        rest, replies, writes = body[1:], b"", []
        if body[0] != len(rest):
            raise Refused(3)
        while rest:
            _, file, record, count = struct.unpack(">BHHH", rest[:7])
            records = _part(self.files.get(file, []), record, count, 125)
            rest = rest[7:]
            if function == 20:
                replies += bytes((1 + 2 * count, 6)) + _registers(records)
            else:
                writes.append((file, record, list(struct.unpack(f">{count}H", rest[: 2 * count]))))
                rest = rest[2 * count :]
        for file, record, values in writes:
            _replace(self.files[file], record, values)
        return bytes((function,)) + (body if function == 21 else bytes((len(replies),)) + replies)


def _part(items: list[int], address: int, count: int, most: int) -> list[int]:
    if not 1 <= count <= most:
        raise Refused(3)
    if address + count > len(items):
        raise Refused(2)
    return items[address : address + count]


def _replace(items: list[int], address: int, values: list[int]) -> None:
    if address + len(values) > len(items):
        raise Refused(2)
    items[address : address + len(values)] = values


def _registers(values: list[int]) -> bytes:
    return struct.pack(f">{len(values)}H", *values)


class RecordingServer:
    """Serves devices by unit, and keeps what it got.

    Attributes:
        record: unit and PDU of every request, in their order.
    """

    def __init__(self, devices: dict[int, PlainDevice]) -> None:
        self.devices = devices
        self.record: list[tuple[int, bytes]] = []
        self._held: list[Callable[[], None]] | None = None
        self._server: asyncio.Server | None = None
        self.port = 0
        self.connections: set[asyncio.Transport] = set()

    async def __aenter__(self) -> "RecordingServer":
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(lambda: _Conversation(self), "127.0.0.1", 0)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *error: object) -> None:
        assert self._server is not None
        self._server.close()
        for connection in list(self.connections):
            connection.abort()
        await self._server.wait_closed()

    @property
    def url(self) -> str:
        """Where it listens."""
        return f"tcp://127.0.0.1:{self.port}"

    def hold(self) -> None:
        """Answer nothing until `release`."""
        self._held = []

    def release(self) -> None:
        """Answer what was held, and go on."""
        held, self._held = self._held or [], None
        for answer in held:
            answer()

    def take(self, unit: int, pdu: bytes, answer: Callable[[bytes], None]) -> None:
        """Take one request."""
        self.record.append((unit, pdu))
        if self._held is None:
            answer(self.reply(unit, pdu))
        else:
            self._held.append(lambda: answer(self.reply(unit, pdu)))

    def reply(self, unit: int, pdu: bytes) -> bytes:
        """What the unit answers; a function that it does not know is echoed."""
        device = self.devices.get(unit)
        if device is None:
            return bytes((pdu[0] | 0x80, 0x0B))
        reply = device.execute(pdu)
        return odd_reply(pdu) if reply is None else reply


def odd_reply(pdu: bytes) -> bytes:
    """A valid reply of functions that a `PlainDevice` has none for."""
    fixed = {
        7: b"\x07\x2a",
        11: b"\x0b\x00\x00\x00\x05",
        12: b"\x0c\x06\x00\x00\x00\x05\x00\x05",
        17: b"\x11\x02\x2a\xff",
        43: pdu if pdu[1:2] == b"\x0d" else b"\x2b\x0e\x01\x01\x00\x00\x01\x00\x01A",
    }
    return fixed.get(pdu[0], pdu)


class _Conversation(asyncio.Protocol):
    def __init__(self, server: RecordingServer) -> None:
        self._server = server
        self._data = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._server.connections.add(transport)

    def connection_lost(self, error: Exception | None) -> None:
        self._server.connections.discard(self._transport)

    def data_received(self, data: bytes) -> None:
        self._data += data
        while len(self._data) >= 8:
            transaction, _, length, unit = struct.unpack(">HHHB", self._data[:7])
            if len(self._data) < 6 + length:
                return
            pdu, self._data = self._data[7 : 6 + length], self._data[6 + length :]
            self._server.take(
                unit,
                pdu,
                lambda reply, transaction=transaction, unit=unit: self._transport.write(
                    struct.pack(">HHHB", transaction, 0, 1 + len(reply), unit) + reply
                ),
            )

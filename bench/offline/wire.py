"""An event loop without a network: who listens and who connects on it meet in memory.

Knows what asyncio promises of transports and protocols; knows no Modbus beyond what `Device` answers.

1. A connection is made by the same calls as ever (``create_server``, ``create_connection``), so that the drivers under
   test run as they are. A listening socket is bound, and never used.
2. What was written in one turn of the loop arrives in the next one, together.
"""

import asyncio
import socket
import struct
from collections.abc import Callable, Iterable, Mapping
from typing import Any

Factory = Callable[[], asyncio.BaseProtocol]
_pair = socket.socketpair()
SOCKET = _pair[0]
"""What connections say is their socket: of a kind that has no parameters of TCP."""
WRITE_SINGLE_REGISTER = 6
NUMBERS = b"".join(number.to_bytes(2, "big") for number in range(4096))


class Wire(asyncio.Transport):
    """One end of a connection. Attributes: ``sent`` counts bytes."""

    def __init__(self, loop: "MemoryLoop", protocol: asyncio.BaseProtocol, peer: tuple[str, int]) -> None:
        super().__init__({"peername": peer, "sockname": ("127.0.0.1", 1), "socket": SOCKET})
        self._loop = loop
        self._protocol: Any = protocol  # of either kind
        self._arriving: list[bytes] = []
        self.other: Wire | None = None  # None: what is written goes nowhere
        self.sent = 0

    def write(self, data: bytes | bytearray | memoryview) -> None:
        self.sent += len(data)
        other = self.other
        if other is not None:
            if not other._arriving:
                self._loop.call_soon(other.arrive)
            other._arriving.append(bytes(data))

    def writelines(self, list_of_data: Iterable[bytes | bytearray | memoryview]) -> None:
        self.write(b"".join(list_of_data))

    def arrive(self) -> None:
        """Hand over what has come."""
        data = b"".join(self._arriving)
        self._arriving.clear()
        self.feed(data)

    def feed(self, data: bytes) -> None:
        """Let bytes arrive here."""
        protocol = self._protocol
        if isinstance(protocol, asyncio.BufferedProtocol):
            buffer = protocol.get_buffer(len(data))
            memoryview(buffer)[: len(data)] = data
            protocol.buffer_updated(len(data))
        else:
            protocol.data_received(data)

    def is_closing(self) -> bool:
        return False

    def close(self) -> None:
        pass

    def abort(self) -> None:
        pass

    def pause_reading(self) -> None:
        pass

    def resume_reading(self) -> None:
        pass

    def get_write_buffer_size(self) -> int:
        return 0

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        pass


class Datagrams(asyncio.DatagramTransport):
    """A bound socket of UDP whose datagrams are fed by hand; what is sent goes nowhere.

    Attributes: ``sent``, bytes by peer.
    """

    def __init__(self, bound: socket.socket) -> None:
        super().__init__({"sockname": bound.getsockname(), "socket": SOCKET})
        self._bound = bound
        self.sent: dict[Any, int] = {}

    def sendto(self, data: bytes | bytearray | memoryview, addr: Any = None) -> None:
        self.sent[addr] = self.sent.get(addr, 0) + len(data)

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        pass

    def is_closing(self) -> bool:
        return False

    def close(self) -> None:
        self._bound.close()

    def abort(self) -> None:
        self._bound.close()


class _Listening:
    """What stands for an `asyncio.Server`."""

    def __init__(self, sockets: list[socket.socket]) -> None:
        self.sockets = sockets

    def close(self) -> None:
        for one in self.sockets:
            one.close()

    async def wait_closed(self) -> None:
        pass


class MemoryLoop(asyncio.SelectorEventLoop):
    """The loop.

    Attributes: ``listeners``, what makes the protocol of a new connection, by port; ``datagram_listeners``, transports
    and protocols of UDP by port; the protocols are fed by hand.
    """

    def __init__(self) -> None:
        super().__init__()
        self.listeners: dict[int, Factory] = {}
        self.datagram_listeners: dict[int, tuple[Datagrams, asyncio.DatagramProtocol]] = {}

    async def create_server(self, protocol_factory: Factory, *_: Any, sock: socket.socket, **__: Any) -> Any:  # type: ignore[override]
        self.listeners[sock.getsockname()[1]] = protocol_factory
        return _Listening([sock])

    async def create_connection(  # type: ignore[override]
        self, protocol_factory: Factory, host: str, port: int, **_: Any
    ) -> tuple[asyncio.Transport, asyncio.BaseProtocol]:
        client, server = protocol_factory(), self.listeners[port]()
        near, far = Wire(self, client, (host, port)), Wire(self, server, ("127.0.0.1", 40_000))
        near.other, far.other = far, near
        server.connection_made(far)
        client.connection_made(near)
        return near, client

    async def create_datagram_endpoint(  # type: ignore[override]
        self, protocol_factory: Factory, *_: Any, sock: socket.socket, **__: Any
    ) -> tuple[asyncio.DatagramTransport, asyncio.DatagramProtocol]:
        protocol: Any = protocol_factory()
        transport = Datagrams(sock)
        self.datagram_listeners[sock.getsockname()[1]] = transport, protocol
        protocol.connection_made(transport)
        return transport, protocol

    def new_connection(self, port: int, number: int = 0) -> Wire:
        """A connection whose client is only fed by hand, and takes what it is sent for nothing."""
        protocol = self.listeners[port]()
        wire = Wire(self, protocol, ("127.0.0.1", 40_000 + number))
        protocol.connection_made(wire)
        return wire


class Device(asyncio.Protocol):
    """Answers reads of registers on TCP, register n with n, and writes of one; the cheapest peer of a client."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        replies = []
        for at in range(0, len(data), 12):
            _, _, unit, function, address, count = struct.unpack_from(">HHxxBBHH", data, at)
            if function == WRITE_SINGLE_REGISTER:
                replies.append(data[at : at + 12])
                continue
            head = struct.pack(">BBB", unit, function, 2 * count)
            following = struct.pack(">HH", 0, 3 + 2 * count)
            replies.append(data[at : at + 2] + following + head + NUMBERS[2 * address : 2 * (address + count)])
        self._transport.write(b"".join(replies))


class Canned(asyncio.Protocol):
    """Answers each segment with what a table has for it."""

    def __init__(self, answers: Mapping[bytes, bytes]) -> None:
        self._answers = answers

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        self._transport.write(self._answers[data])

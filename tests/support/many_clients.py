"""Many plain clients in one thread: as many connections as a test wants, each with one read on its way.

Knows the bytes of function 03 and nothing of the library under test. Register n is expected to hold n, and every
connection asks for its own: an answer that is not the one to its question fails the test at once.
"""

import selectors
import socket
import struct
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

REPLY_SIZE = 11
_reset = struct.pack("ii", 1, 0)


def question(address: int, transaction: int = 1, *, count: int = 1) -> bytes:
    """A read of holding registers of unit 1."""
    return struct.pack(">HHHBBHH", transaction, 0, 6, 1, 3, address, count)


def answer(value: int, transaction: int = 1) -> bytes:
    """The answer to a read of one register that holds ``value``."""
    return struct.pack(">HHHBBBH", transaction, 0, 5, 1, 3, 2, value)


def dial(port: int, *, source: str | None = None) -> socket.socket:
    """A plain connection to the local host; ``source`` is the address it comes from."""
    link = socket.create_connection(("127.0.0.1", port), timeout=10, source_address=(source, 0) if source else None)
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, True)
    return link


def vanish(link: socket.socket) -> None:
    """End a connection as a crash does: with a reset, not with the end of a stream."""
    link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _reset)
    link.close()


@dataclass(slots=True)
class _Member:
    link: socket.socket
    address: int
    transaction: int = 0
    received: bytes = b""

    def ask(self) -> None:
        self.transaction = (self.transaction + 1) & 0xFFFF
        self.link.sendall(question(self.address, self.transaction))

    def take(self) -> bool:
        """Whether an answer is complete; it is held against the question."""
        data = self.link.recv(REPLY_SIZE - len(self.received))
        assert data, f"the server closed connection {self.address}"
        self.received += data
        if len(self.received) < REPLY_SIZE:
            return False
        expected = answer(self.address, self.transaction)
        assert self.received == expected, f"connection {self.address}: {self.received.hex()}, not {expected.hex()}"
        self.received = b""
        return True


class ManyClients:
    """Connections that ask again as soon as they are answered."""

    def __init__(self, links: Sequence[socket.socket]) -> None:
        self._members = [_Member(link, address) for address, link in enumerate(links)]
        self._selector = selectors.DefaultSelector()
        for member in self._members:
            self._selector.register(member.link, selectors.EVENT_READ, member)

    def rate(self, seconds: float) -> float:
        """Ask for so long; answers per second. No answer for 10 s fails the test."""
        began = time.perf_counter()
        answered, on_their_way = 0, len(self._members)
        for member in self._members:
            member.ask()
        while on_their_way:
            ready = self._selector.select(10)
            assert ready, f"{on_their_way} connections got no answer for 10 s"
            goes_on = time.perf_counter() < began + seconds
            for key, _ in ready:
                if key.data.take():
                    answered += 1
                    if goes_on:
                        key.data.ask()
                    else:
                        on_their_way -= 1
        return answered / (time.perf_counter() - began)

    def close(self) -> None:
        """Close all connections."""
        self._selector.close()
        for member in self._members:
            member.link.close()


@contextmanager
def many_clients(port: int, count: int, *, source: str | None = None) -> Iterator[ManyClients]:
    """So many connections to the local host, from ``source`` if it is given, for the length of the block."""
    gathered = ManyClients([dial(port, source=source) for _ in range(count)])
    try:
        yield gathered
    finally:
        gathered.close()

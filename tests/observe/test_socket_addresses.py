"""From which things the two addresses of a connection can be told."""

import asyncio
import os
import socket
from collections.abc import Iterator

import pytest

from busway.observe.socket_addresses import SocketAddresses, socket_addresses_of


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Both ends of a TCP connection."""
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        socket.create_connection(listener.getsockname()) as near,
    ):
        far, _ = listener.accept()
        with far:
            yield near, far


def test_a_socket_knows_both_its_ends(pair: tuple[socket.socket, socket.socket]) -> None:
    near, far = pair
    assert socket_addresses_of(near) == SocketAddresses(near.getsockname(), far.getsockname())


def test_what_has_the_descriptor_of_a_socket_is_asked_by_it(pair: tuple[socket.socket, socket.socket]) -> None:
    class Wrapped:
        def fileno(self) -> int:
            return pair[0].fileno()

    assert socket_addresses_of(Wrapped()) == socket_addresses_of(pair[0])
    assert pair[0].fileno() >= 0  # its descriptor is still its own


def test_a_datagram_socket_is_known_as_such() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as near:
        near.connect(("127.0.0.1", 502))
        assert socket_addresses_of(near) == SocketAddresses(near.getsockname(), ("127.0.0.1", 502), is_datagram=True)


def test_what_is_closed_or_no_socket_at_all_has_no_ends(pair: tuple[socket.socket, socket.socket]) -> None:
    pair[0].close()
    assert socket_addresses_of(pair[0]) == SocketAddresses()
    assert socket_addresses_of(None) == SocketAddresses()
    with open(os.devnull, "rb") as file:
        assert socket_addresses_of(file) == SocketAddresses()


def test_ends_are_their_own() -> None:
    ends = SocketAddresses(("10.0.0.1", 1), ("10.0.0.2", 502), is_datagram=True)
    assert socket_addresses_of(ends) is ends


async def test_a_transport_of_asyncio_is_asked_for_its_socket() -> None:
    server = await asyncio.start_server(lambda reader, writer: writer.close(), "127.0.0.1", 0)
    async with server:
        bound = server.sockets[0].getsockname()
        _, writer = await asyncio.open_connection(*bound)
        ends = socket_addresses_of(writer.transport)
        assert (ends.peer, ends.is_datagram) == (bound, False)
        writer.close()
        await writer.wait_closed()

"""A secure blocking connection: no bytes wait unseen, and nothing goes out twice."""

import select
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from busway.options.tls import TlsParameters
from busway.testing.certificates import CertificateStore
from busway.transport.receive_buffer import RECEIVE_SIZE
from busway.transport.tls.context import client_context, server_context
from busway.transport.tls.failures import TlsFailure
from busway.transport.tls.socket import TlsSocket
from busway.transport.tls.stream import TlsStream

LIMIT = 10.0


class Server:
    """The other end: a stream of TLS over a blocking socket."""

    def __init__(self, connection: socket.socket, store: CertificateStore) -> None:
        self.socket = connection
        connection.settimeout(LIMIT)
        self.stream = TlsStream(server_context(TlsParameters(**store.server().options())), server_side=True)

    def agree(self) -> None:
        while not self.stream.handshake():
            self.flush()
            self.stream.feed(self.socket.recv(10_000))
        self.flush()

    def flush(self) -> None:
        self.socket.sendall(self.stream.outgoing())

    def read(self, size: int) -> bytes:
        data, room = b"", bytearray(RECEIVE_SIZE)
        while len(data) < size:
            self.stream.feed(self.socket.recv(20_000))
            data += room[: self.stream.read_into(memoryview(room))]
        return data


@pytest.fixture
def ends(tmp_path: Path) -> Iterator[tuple[TlsSocket, Server]]:
    store = CertificateStore(tmp_path)
    mine, theirs = socket.socketpair()
    mine.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    server = Server(theirs, store)
    agreeing = threading.Thread(target=server.agree)
    agreeing.start()
    context = client_context(TlsParameters(**store.client().options()))
    client = TlsSocket(mine, context, server_name="localhost", timeout=LIMIT)
    agreeing.join()
    yield client, server
    client.close()
    theirs.close()


def is_readable(client: TlsSocket) -> bool:
    return bool(select.select([client], [], [], 0)[0])


def received(client: TlsSocket, buffer: bytearray) -> bytes:
    """Everything that can be had before the descriptor says that nothing is there."""
    data = b""
    while is_readable(client):
        try:
            data += buffer[: client.recv_into(buffer)]
        except BlockingIOError:
            continue
    return data


@pytest.mark.clause("M1")
def test_all_that_has_come_is_handed_over_before_the_descriptor_falls_silent(ends: tuple[TlsSocket, Server]) -> None:
    client, server = ends
    texts = [bytes([number]) * 9 for number in range(50)]
    for text in texts:
        server.stream.write(text)
    server.flush()
    assert received(client, bytearray(RECEIVE_SIZE)) == b"".join(texts)


def test_a_record_that_is_not_whole_yet_is_waited_for(ends: tuple[TlsSocket, Server]) -> None:
    client, server = ends
    received(client, bytearray(RECEIVE_SIZE))  # tickets
    server.stream.write(b"whole")
    records = server.stream.outgoing()
    server.socket.sendall(records[:-1])
    with pytest.raises(BlockingIOError):
        client.recv_into(bytearray(RECEIVE_SIZE))
    server.socket.sendall(records[-1:])
    assert received(client, bytearray(RECEIVE_SIZE)) == b"whole"


def test_what_the_socket_does_not_take_at_once_goes_out_once(ends: tuple[TlsSocket, Server]) -> None:
    client, server = ends
    total = bytes(number % 251 for number in range(300_000))
    read: list[bytes] = []
    reader = threading.Thread(target=lambda: read.append(server.read(len(total))))
    rest, refusals = total, 0
    while rest:
        try:
            sent = client.send(rest[:10_000] if refusals % 2 else rest[:12_000])
        except BlockingIOError:
            refusals += 1
            if not reader.ident:
                reader.start()  # only now is it read
            select.select([], [client], [], LIMIT)
        else:
            rest = rest[sent:]
    reader.join()
    assert refusals
    assert read == [total]


def test_the_server_s_end_is_an_end(ends: tuple[TlsSocket, Server]) -> None:
    client, server = ends
    server.stream.write(b"last")
    server.stream.finish()
    server.flush()
    buffer = bytearray(RECEIVE_SIZE)
    assert bytes(buffer[: client.recv_into(buffer)]) == b"last"
    server.socket.shutdown(socket.SHUT_RDWR)
    assert client.recv_into(buffer) == 0


def test_a_server_that_ends_without_a_word_may_not_like_the_certificate(ends: tuple[TlsSocket, Server]) -> None:
    client, server = ends
    server.socket.shutdown(socket.SHUT_RDWR)
    with pytest.raises(TlsFailure, match="closed the connection without a word"):
        client.recv_into(bytearray(RECEIVE_SIZE))


def test_closing_says_so_to_the_server(ends: tuple[TlsSocket, Server]) -> None:
    client, server = ends
    client.close()
    room = bytearray(100)
    server.stream.feed(server.socket.recv(10_000))
    assert server.stream.read_into(memoryview(room)) == 0
    assert server.stream.ended
    assert client.fileno() == -1

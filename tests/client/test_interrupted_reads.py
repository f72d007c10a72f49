"""A thread that an interrupt ends while a reply comes in pieces: the rest is never taken for another reply."""

import socket
import threading
from collections.abc import Iterator

import pytest

from busway import connect
from busway.client.connector import TcpConnector

ASKED, FORGED, RIGHT = 120, 0xDEAD, 7


class InterruptedSocket(socket.socket):
    """A socket after whose first receipt the program is interrupted: the bytes are taken, and no caller has them."""

    is_first = True

    def recv_into(self, *arguments: object) -> int:  # type: ignore[override]
        size = super().recv_into(*arguments)  # type: ignore[arg-type]
        if InterruptedSocket.is_first:
            InterruptedSocket.is_first = False
            raise KeyboardInterrupt
        return size


def answer(connection: socket.socket) -> None:
    """Send the head of a long reply, and its registers when the next request comes: they look like its reply."""
    with connection:
        while request := connection.recv(12):
            if request[11] == ASKED:
                connection.sendall(request[:2] + bytes((0, 0, 0, 243, 1, 3, 240)))
                if not (following := connection.recv(12)):
                    return
                forged = following[:2] + bytes.fromhex("00000005010302") + FORGED.to_bytes(2, "big")
                connection.sendall(forged.ljust(240, b"\0"))
            else:
                connection.sendall(request[:2] + bytes.fromhex("00000005010302") + RIGHT.to_bytes(2, "big"))


@pytest.fixture
def port() -> Iterator[int]:
    listener = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            threading.Thread(target=answer, args=(connection,), daemon=True).start()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    yield listener.getsockname()[1]
    listener.shutdown(socket.SHUT_RDWR)
    listener.close()
    thread.join(5)


def test_registers_of_an_interrupted_read_are_not_taken_for_the_next_reply(
    port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    dial = TcpConnector.dial

    def dial_interrupted(connector: TcpConnector) -> socket.socket:
        plain = dial(connector)
        found = InterruptedSocket(fileno=plain.detach())
        found.setblocking(False)
        return found

    monkeypatch.setattr(TcpConnector, "dial", dial_interrupted)
    monkeypatch.setattr(InterruptedSocket, "is_first", True)
    with connect(f"tcp://127.0.0.1:{port}", timeout=2, retries=1) as link:
        with pytest.raises(KeyboardInterrupt):
            link.unit(1).read_holding_registers(0, count=ASKED)
        assert link.unit(1).read_holding_registers(0, count=1) == [RIGHT]
        assert link.counters.lost_connections == 1

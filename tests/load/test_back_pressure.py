"""Clients that ask and never take an answer: each costs the server a bounded amount of memory."""

import selectors
import socket

import pytest
from many_clients import answer, dial, question, vanish
from told_program import Program

CLIENTS = 20
LONGEST = 125
"""Registers per question: the answer is twenty times as long as the question."""
REPLY_SIZE = 9 + 2 * LONGEST
RECEIVE_SIZE = 4416
"""Bytes that a server takes in at once."""
WRITE_BUFFER = 16_384
BOUND = RECEIVE_SIZE // 12 * REPLY_SIZE + WRITE_BUFFER
"""Bytes that may wait for one client: the answers to what came at once, on top of a buffer that was not full yet."""
MEGABYTE = 1 << 20


@pytest.mark.clause("T39", "T40")
def test_clients_that_never_read_cost_bounded_memory_and_the_others_are_served(start_server: type[Program]) -> None:
    server = start_server(write_buffer=WRITE_BUFFER, send_buffer=16_384, receive_buffer=16_384)
    port = server.ask("status")["port"]
    with dial(port) as one:
        one.sendall(question(3))
        assert one.recv(100) == answer(3)
    before = server.resident
    links = [_greedy(port) for _ in range(CLIENTS)]
    try:
        taken = _ask_until_nothing_is_taken(links)
        grown = server.resident - before
        assert grown < CLIENTS * 2 * BOUND + 4 * MEGABYTE
        # Nothing more is read from them: however long they go on, it is the same.
        assert _ask_until_nothing_is_taken(links) < taken / 4
        assert server.resident - before < grown + MEGABYTE
        status = server.ask("status")
        assert status["connections"] == CLIENTS
        assert status["counters"]["reading_paused"] >= CLIENTS
        with dial(port) as one:
            one.sendall(question(3))
            assert one.recv(100) == answer(3)
    finally:
        for link in links:
            vanish(link)
    assert server.ask("status", connections=0)["connections"] == 0


def _greedy(port: int, source: str = "127.0.0.1") -> socket.socket:
    """A connection with little room for answers at its own end."""
    link = socket.socket()
    link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 16_384)
    link.bind((source, 0))
    link.connect(("127.0.0.1", port))
    return link


def _ask_until_nothing_is_taken(links: list[socket.socket]) -> int:
    """Ask until the server has taken nothing from any client for half a second; the bytes that left."""
    questions = 200 * question(0, count=LONGEST)
    left = 0
    with selectors.DefaultSelector() as selector:
        for link in links:
            link.setblocking(False)
            selector.register(link, selectors.EVENT_WRITE)
        while ready := selector.select(0.5):
            for key, _ in ready:
                # Where the end of one is not taken any more, the next makes nonsense of it: nothing of it is answered.
                try:
                    left += key.fileobj.send(questions)  # type: ignore[union-attr]
                except BlockingIOError:
                    pass
                except ConnectionError:
                    selector.unregister(key.fileobj)  # the server has ended it
    return left


@pytest.mark.clause("T19", "T39")
def test_client_that_takes_nothing_for_the_user_timeout_is_ended_by_the_system(start_server: type[Program]) -> None:
    server = start_server(user_timeout=1.0, write_timeout=None, send_buffer=16_384)
    link = _greedy(server.ask("status")["port"])
    _ask_until_nothing_is_taken([link])
    after = server.ask("status", connections=0)
    assert after["connections"] == 0
    assert (after["counters"]["closed"], after["counters"]["write_timeouts"]) == (1, 0)
    link.close()


@pytest.mark.clause("T13")
def test_marked_client_that_takes_nothing_outlives_every_timeout_that_ends_another(
    start_server: type[Program],
) -> None:
    server = start_server(
        priority=["127.0.0.2"],
        user_timeout=1.0,
        write_timeout=1.0,
        frame_timeout=1.0,
        idle_timeout=1.0,
        send_buffer=16_384,
    )
    port = server.ask("status")["port"]
    priority, other = _greedy(port, "127.0.0.2"), _greedy(port, "127.0.0.3")
    _ask_until_nothing_is_taken([priority, other])
    after = server.ask("status", connections=1)
    assert after["connections"] == 1
    assert after["counters"]["priority"]["closed"] == 0
    # A second beside the other's end, and that of the priority host is still there.
    later = _greedy(port, "127.0.0.3")
    _ask_until_nothing_is_taken([later])
    assert server.ask("status", connections=1)["counters"]["priority"]["closed"] == 0
    for link in (priority, other, later):
        link.close()

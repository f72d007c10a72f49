"""Ten thousand clients that come and are gone: nothing of them stays."""

import pytest
from many_clients import answer, dial, question, vanish
from told_program import Program

AT_ONCE = 80
"""Connections of one round: more than the server has places for, so that some are closed to make room."""
PLACES = 64
WARM_UP = 25
ROUNDS = 100
"""Of 81 connections each: ten thousand with the warm-up."""
MEGABYTE = 1 << 20

WAYS = (b"", question(7)[:3], question(7), 3 * question(7), question(7)[:-1], b"\xff" * 12)
"""What a client says before it vanishes: nothing, part of a frame, a request whose answer it does not take, several,
all but one byte, and what is no frame."""


@pytest.mark.clause("T12", "T18", "T40")
def test_ten_thousand_connections_that_are_cut_off_leave_no_handle_and_no_memory(start_server: type[Program]) -> None:
    server = start_server(max_connections=PLACES)
    port = server.ask("status")["port"]
    _rounds(port, WARM_UP)
    before = server.ask("status", connections=0)
    handles, resident = server.handles, server.resident
    _rounds(port, ROUNDS)
    after = server.ask("status", connections=0)
    assert after["connections"] == 0
    counters = after["counters"]
    assert counters["accepted"] == counters["closed"]
    # A client that had vanished before the server looked takes no slot while all are taken; it is counted as refused.
    assert counters["accepted"] + counters["refused_full"] == (WARM_UP + ROUNDS) * (AT_ONCE + 1)
    assert server.handles == handles
    assert abs(after["objects"] - before["objects"]) < 100  # eight thousand connections later
    assert server.resident - resident < 2 * MEGABYTE


def _rounds(port: int, count: int) -> None:
    for _ in range(count):
        links = [dial(port) for _ in range(AT_ONCE)]
        for number, link in enumerate(links):
            try:
                link.send(WAYS[number % len(WAYS)])
            except ConnectionError:
                continue  # it had to make room
        for link in links:
            vanish(link)
        # Answered when all before it were accepted: what is tried here is the server, not the system's queue before it.
        with dial(port) as last:
            last.sendall(question(9))
            assert last.recv(100) == answer(9)

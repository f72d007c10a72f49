"""A hundred clients that begin a request and never end it, beside four hundred that work."""

import socket
import time
from contextlib import suppress

import pytest
from many_clients import dial, many_clients, question
from told_program import Program

WORKING, SLOW = 400, 100
DEADLINE = 3.0
"""Seconds that the header of a request may take to arrive."""
SECONDS = 0.3
"""Of each measurement."""
SHARE = 0.8
ATTEMPTS = 5
"""A busy machine slows a measurement down now and then; slow senders that did would do so in each."""


@pytest.mark.clause("T12", "T40")
def test_working_clients_keep_their_rate_beside_half_headers_which_end_at_their_deadline(
    start_server: type[Program],
) -> None:
    server = start_server(max_connections=WORKING + SLOW, header_timeout=DEADLINE)
    port = server.ask("status")["port"]
    with many_clients(port, WORKING) as working:
        idle = [dial(port) for _ in range(SLOW)]
        try:
            working.rate(SECONDS)
            shares = []
            for _ in range(ATTEMPTS):
                alone = working.rate(SECONDS)
                began = time.monotonic()
                for number, link in enumerate(idle):
                    link.sendall(question(0)[: 1 + number % 6])
                beside = working.rate(SECONDS)
                shares.append(beside / alone)
                if shares[-1] >= SHARE:
                    break
                for number, link in enumerate(idle):  # the rest of it: they are idle again
                    link.sendall(question(0)[1 + number % 6 :])
                    link.recv(100)
            assert max(shares) >= SHARE
            _all_are_closed(idle, began)
        finally:
            for link in idle:
                link.close()
        assert working.rate(SECONDS) > 0  # none of those was closed
        status = server.ask("status", connections=WORKING)
        assert (status["connections"], status["counters"]["header_timeouts"]) == (WORKING, SLOW)


def _all_are_closed(links: list[socket.socket], began: float) -> None:
    for link in links:
        link.settimeout(DEADLINE + 2)
        with suppress(ConnectionResetError):
            assert link.recv(100) == b""
    assert DEADLINE - 0.1 < time.monotonic() - began < DEADLINE + 1.5

"""A flood of datagrams from many senders: bounded memory, and nobody is sent more than the answer that he asked for."""

import socket
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest
from crowd import answer, question
from told_program import Program

SENDERS = 1500
ROUNDS = 12
PEERS = 32
"""Conversations that the server keeps at once."""
MEGABYTE = 1 << 20

LONGEST = question(0, count=125)
USELESS = (
    LONGEST[:-1],
    LONGEST[:7],
    b"",
    b"\x00",
    LONGEST + b"\x00",
    2 * LONGEST,  # two frames, one datagram
    LONGEST[:2] + b"\x00\x01" + LONGEST[4:],  # another protocol
    LONGEST[:7] + b"\x83\x02",
    b"\xff" * 1400,
)
"""Datagrams that nobody answers."""


@pytest.mark.clause("T40")
def test_flood_of_datagrams_costs_bounded_memory_and_brings_nobody_more_than_his_own_answer(
    start_server: type[Program],
) -> None:
    server = start_server("udp://127.0.0.1:0", max_connections=PEERS)
    port = server.ask("status")["port"]
    with _senders(port) as senders:
        _flood(senders)
        before, resident, handles = server.ask("status"), server.resident, server.handles
        for _ in range(ROUNDS - 1):
            _flood(senders)
        after = server.ask("status")
        assert after["connections"] == PEERS
        assert after["counters"]["accepted"] - after["counters"]["closed"] == PEERS
        assert server.handles == handles
        assert abs(after["objects"] - before["objects"]) < 500
        assert server.resident - resident < 2 * MEGABYTE
        assert after["counters"]["discarded_frames"] > before["counters"]["discarded_frames"]
        _nobody_got_more_than_his_answer(senders)
        # It serves as before.
        senders[0].settimeout(10)
        senders[0].send(question(77, 77))
        assert senders[0].recv(1500) == answer(77, 77)


@contextmanager
def _senders(port: int) -> Iterator[list[socket.socket]]:
    """Sockets of many hosts, each with a port of its own."""
    with ExitStack() as stack:
        senders = []
        for number in range(SENDERS):
            sender = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            sender.bind((f"127.0.{number // 250}.{number % 250 + 1}", 0))
            sender.connect(("127.0.0.1", port))
            senders.append(sender)
        yield senders


def _flood(senders: list[socket.socket]) -> None:
    for number, sender in enumerate(senders):
        sender.send(USELESS[number % len(USELESS)] if number % 2 else _own_question(number))


def _own_question(number: int) -> bytes:
    return question(number % 64, number)


def _nobody_got_more_than_his_answer(senders: list[socket.socket]) -> None:
    sizes: defaultdict[bool, int] = defaultdict(int)
    for number, sender in enumerate(senders):
        sender.setblocking(False)
        answers = []
        try:
            while True:
                answers.append(sender.recv(1500))
        except BlockingIOError:
            pass
        if number % 2:
            assert answers == []
        else:
            assert len(answers) <= ROUNDS
            assert set(answers) <= {answer(number % 64, number)}
        sizes[bool(answers)] += 1
    assert sizes[True] > SENDERS // 4  # most were heard: the flood tried the server, and not the system's buffers alone

"""A flood of datagrams from many senders: bounded memory, and no sender gets more than the answer that it asked for."""

import asyncio
import socket
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress

import pytest
from handlers import HeldReplies, ScriptedHandler
from many_clients import answer, question
from told_program import Program
from waiting import until

import busway

SENDERS = 1500
ROUNDS = 12
PEERS = 32
"""Conversations that the server keeps at once."""
PIECE = 100
"""Datagrams of a flood that the system's buffer holds: then the server is given the time to read them."""
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
"""Datagrams that are not answered."""


@pytest.mark.clause("T40")
def test_flood_of_datagrams_costs_bounded_memory_and_brings_no_sender_more_than_its_own_answer(
    start_server: type[Program],
) -> None:
    server = start_server("udp://127.0.0.1:0", max_connections=PEERS)
    port = server.ask("status")["port"]
    with _senders(port) as senders, _probe(port) as probe:
        _flood(senders, probe)
        before, resident, handles = server.ask("status"), server.resident, server.handles
        for _ in range(ROUNDS - 1):
            _flood(senders, probe)
        after = server.ask("status")
        assert after["connections"] == PEERS
        assert after["counters"]["accepted"] - after["counters"]["closed"] == PEERS
        assert server.handles == handles
        assert abs(after["objects"] - before["objects"]) < 500
        assert server.resident - resident < 2 * MEGABYTE
        assert after["counters"]["discarded_frames"] > before["counters"]["discarded_frames"]
        _no_sender_got_more_than_its_answer(senders)
        # It serves as before.
        senders[0].settimeout(10)
        senders[0].send(question(77, 77))
        while (got := senders[0].recv(1500)) != answer(77, 77):
            assert got == answer(0, 0)  # a late one to what this sender had asked in the flood


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


@contextmanager
def _probe(port: int) -> Iterator[socket.socket]:
    """A socket of one more host, which waits for its answers."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.9.1", 0))
        probe.connect(("127.0.0.1", port))
        probe.settimeout(0.2)
        yield probe


def _flood(senders: list[socket.socket], probe: socket.socket) -> None:
    for number, sender in enumerate(senders):
        sender.send(USELESS[number % len(USELESS)] if number % 2 else _own_question(number))
        if number % PIECE == PIECE - 1:
            _wait_until_answered(probe)


def _wait_until_answered(probe: socket.socket) -> None:
    """What was sent before has been read: the server reads in order."""
    for _ in range(100):
        probe.send(question(78, 78))
        with suppress(TimeoutError):
            probe.recv(1500)
            return
    raise TimeoutError("the server answers no datagram")


def _own_question(number: int) -> bytes:
    return question(number % 64, number)


def _no_sender_got_more_than_its_answer(senders: list[socket.socket]) -> None:
    sizes: defaultdict[bool, int] = defaultdict(int)
    for number, sender in enumerate(senders):
        answers = _received(sender)
        if number % 2:
            assert answers == []
        else:
            assert len(answers) <= ROUNDS
            assert set(answers) <= {answer(number % 64, number)}
        sizes[bool(answers)] += 1
    assert sizes[True] > SENDERS // 4  # most were heard: the flood tried the server, and not the system's buffers alone


# --- slow answers ------------------------------------------------------------

SLOW_SENDERS, REQUESTS = 40, 10
SLOW_PEERS, SLOTS = 8, 4
SLOW = 1000
"""From this address on, the handler waits."""


@pytest.mark.clause("T27", "T40")
async def test_flood_of_slow_requests_waits_in_bounded_places_and_every_answer_goes_to_its_asker() -> None:
    held_replies = HeldReplies()
    handler = ScriptedHandler(held_replies.decide)
    server = busway.serve("udp://127.0.0.1:0", responder=handler, max_connections=SLOW_PEERS, max_transactions=SLOTS)
    async with server:
        port = int(server.endpoints[0].rpartition(":")[2])
        with _senders(port) as all_senders:
            senders = all_senders[:SLOW_SENDERS]
            for number, sender in enumerate(senders):
                for one in range(REQUESTS):
                    address = SLOW + number * REQUESTS + one
                    sender.send(question(address, address))
                # One sender after another, so that the bound is the server's and not the system's buffer.
                await until(lambda wanted=number: server.status().counters.refused_busy >= (wanted + 1) * 6)
                assert sum(one.waiting for one in server.status().connections) <= SLOW_PEERS * SLOTS
                assert len(asyncio.all_tasks()) <= SLOW_PEERS * SLOTS + 10
            held_replies.opened.set()
            await until(lambda: not any(one.waiting for one in server.status().connections))
            for number, sender in enumerate(senders):
                first = SLOW + number * REQUESTS
                slow = [answer(address, address) for address in range(first, first + SLOTS)]
                busy = [_busy(address) for address in range(first + SLOTS, first + REQUESTS)]
                kept_its_place = number >= SLOW_SENDERS - SLOW_PEERS
                assert sorted(_received(sender)) == sorted(busy + (slow if kept_its_place else []))


def _busy(transaction: int) -> bytes:
    return transaction.to_bytes(2, "big") + bytes.fromhex("0000 0003 01 83 06")


def _received(sender: socket.socket) -> list[bytes]:
    sender.setblocking(False)
    datagrams = []
    with suppress(BlockingIOError):
        while True:
            datagrams.append(sender.recv(1500))
    return datagrams

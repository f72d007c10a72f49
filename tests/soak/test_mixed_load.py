"""A server under everything at once for minutes: it answers rightly all the time, and stays as big as it was.

``BUSWAY_SOAK_SECONDS`` says for how long, 180 without it.
"""

import json
import os
import random
import socket
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from many_clients import ManyClients, dial, many_clients, question, vanish
from told_program import Program

SERVER = Path(__file__).parents[1] / "load" / "programs" / "server.py"
SECONDS = float(os.environ.get("BUSWAY_SOAK_SECONDS", "180"))
WORKING, PRIORITY_HOST = 40, "127.0.0.2"
PLACES = 64
MEGABYTE = 1 << 20
OPTIONS = {
    "priority": [PRIORITY_HOST],
    "max_priority_connections": WORKING,
    "max_priority_per_host": WORKING,
    "max_connections": PLACES,
    "header_timeout": 1.0,
    "frame_timeout": 2.0,
    "write_timeout": 3.0,
    "write_buffer": 8192,
    "send_buffer": 8192,
}


@pytest.mark.soak
@pytest.mark.clause("T12", "T13", "T39", "T40")
def test_server_serves_marked_clients_rightly_beside_all_kinds_of_others_and_does_not_grow() -> None:
    chance = random.Random(1)
    command = [sys.executable, str(SERVER), "tcp://127.0.0.1:0", json.dumps(OPTIONS)]
    with Program(command) as server:
        port = server.ask("status")["port"]
        with many_clients(port, WORKING, source=PRIORITY_HOST) as working:
            _disturbed(port, working, chance, SECONDS / 4)
            before = server.ask("status", connections=WORKING)
            resident, handles = server.resident, server.handles
            _disturbed(port, working, chance, SECONDS * 3 / 4)
            after = server.ask("status", connections=WORKING)
            assert after["connections"] == WORKING
            assert after["counters"]["accepted"] - after["counters"]["closed"] == WORKING
            assert after["counters"]["evicted"] > before["counters"]["evicted"]
            assert after["counters"]["responder_failures"] == 0
            assert server.handles == handles
            assert abs(after["objects"] - before["objects"]) < 500
            assert server.resident - resident < 4 * MEGABYTE


def _disturbed(port: int, working: ManyClients, chance: random.Random, seconds: float) -> None:
    """Let the clients work, which checks every answer, while others come, do what they should not, and go."""
    end = time.monotonic() + seconds
    others: list[socket.socket] = []
    while time.monotonic() < end:
        for _ in range(chance.randrange(20)):
            others.append(dial(port))
            with suppress(OSError):
                others[-1].setblocking(False)
                others[-1].send(_nonsense(chance))
        working.rate(0.05)
        chance.shuffle(others)
        while len(others) > PLACES // 2 + chance.randrange(PLACES):
            vanish(others.pop())
    for link in others:
        link.close()


def _nonsense(chance: random.Random) -> bytes:
    """What a client says that does not mean it well, or does not know better."""
    address = chance.randrange(64)  # few: a server remembers how to answer what it was asked, up to a bound
    return chance.choice(
        [
            b"",
            question(address)[: chance.randrange(1, 12)],
            question(address),
            chance.randrange(1, 300) * question(address, count=125),
            chance.randbytes(chance.randrange(1, 600)),
            question(address)[:2] + b"\x00\x01" + question(address)[4:],
        ]
    )

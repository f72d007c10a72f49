"""A network that fails for minutes: cables, programs and hosts go and come, and no client is ever given a wrong value.

``BUSWAY_SOAK_SECONDS`` says for how long, 180 without it.
"""

import json
import os
import random
import time
from pathlib import Path

import pytest
from hosts import Host, Network, why_not
from told_program import Program

PROGRAMS = Path(__file__).parents[1] / "network" / "programs"
SECONDS = float(os.environ.get("BUSWAY_SOAK_SECONDS", "180"))
PORT = 5020
KEEPALIVE = {"keepalive_idle": 1, "keepalive_interval": 1, "keepalive_count": 2, "user_timeout": 3.0}
FAILURES = {"NoReply", "LinkDown", "WriteOutcomeUnknown"}
"""How a request may end here; all else is a fault of ours."""
RECOVERED = 20.0
"""Seconds after the last failure until all clients must be served again."""


class System:
    """A server and some clients, each on a host of its own, and what may happen to them."""

    def __init__(self, network: Network, chance: random.Random) -> None:
        self._chance = chance
        self._there = network.host()
        self._hosts = [network.host() for _ in range(4)]
        self._cut: list[Host] = []
        self._start_server()
        self._clients = [self._client(number) for number in range(len(self._hosts))]
        self.served = self.failed = 0

    def something_happens(self) -> None:
        """One failure, or the end of one."""
        what = [self._cut_a_cable, self._mend_all, self._restart_server, self._crash_server, self._crash_client]
        self._chance.choices(what, weights=[4, 4, 1, 1, 2])[0]()

    def mend(self) -> None:
        """Everything works again."""
        self._mend_all()

    def ask(self) -> int:
        """Each client asks once; how many were served. Whatever comes must be right."""
        wanted = []
        for client in self._clients:
            wanted.append(self._chance.randrange(1000))
            client.tell("read", address=wanted[-1])
        served = 0
        for client, address in zip(self._clients, wanted, strict=True):
            answer = client.outcome()
            if "error" in answer:
                assert answer["error"] in FAILURES, answer
            else:
                assert answer["value"] == [address], answer
                served += 1
        self.served += served
        self.failed += len(wanted) - served
        return served

    def connections(self) -> int:
        """Connections of the server, when there are as many as clients, or after some time."""
        status = self._server.ask("until", connections=len(self._clients), seconds=RECOVERED)
        return len(status["connections"])

    def _start_server(self) -> None:
        endpoint = f"tcp://{self._there.address}:{PORT}"
        self._server = self._there.start(PROGRAMS / "server.py", endpoint, json.dumps(KEEPALIVE))
        self._server.ready()

    def _client(self, number: int) -> Program:
        via = ("asyncio", "blocking")[number % 2]
        endpoint, options = f"tcp://{self._there.address}:{PORT}", KEEPALIVE | {"timeout": 0.3, "connect_timeout": 0.5}
        return self._hosts[number].start(PROGRAMS / "client.py", via, endpoint, json.dumps(options))

    def _cut_a_cable(self) -> None:
        host = self._chance.choice([self._there, *self._hosts])
        host.cut()
        self._cut.append(host)

    def _mend_all(self) -> None:
        for host in self._cut:
            host.mend()
        self._cut.clear()

    def _restart_server(self) -> None:
        self._server.kill()
        self._start_server()

    def _crash_server(self) -> None:
        self._cut = [host for host in self._cut if host is not self._there]
        self._there.crash()
        self._there.boot()
        self._start_server()

    def _crash_client(self) -> None:
        number = self._chance.randrange(len(self._hosts))
        host = self._hosts[number]
        self._cut = [one for one in self._cut if one is not host]
        host.crash()
        host.boot()
        self._clients[number] = self._client(number)


@pytest.mark.soak
@pytest.mark.clause("T18", "T37")
def test_no_client_gets_a_wrong_value_and_all_are_served_again_when_the_network_works() -> None:
    if reason := why_not():
        pytest.skip(reason)
    chance = random.Random(2)
    with Network() as network:
        system = System(network, chance)
        end = time.monotonic() + SECONDS
        while time.monotonic() < end:
            system.something_happens()
            for _ in range(chance.randrange(1, 6)):
                system.ask()
        system.mend()
        end = time.monotonic() + RECOVERED
        while system.ask() < 4:
            assert time.monotonic() < end, "a client is not served again"
        assert system.connections() == 4
        assert system.served > 100
        assert system.failed > 10

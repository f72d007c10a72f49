"""Connections that end and begin in one turn get each other's descriptor numbers, and never each other's events."""

import asyncio
import contextlib
import random
import socket
from collections.abc import Callable
from functools import partial
from urllib.parse import urlsplit

import pytest
from handlers import ScriptedHandler, address_of, registers
from many_clients import answer, question, vanish
from waiting import until

import busway
from busway.transport.accepting import EpollAcceptor
from busway.transport.epoll.watcher import EpollSet

ROUNDS = 60
CLIENTS = 12


def ask_and_reset(client: socket.socket) -> None:
    client.send(question(0xFFFF, transaction=0xFFFF))
    vanish(client)


ENDS: tuple[Callable[[socket.socket], None], ...] = (socket.socket.close, vanish, ask_and_reset)


@pytest.mark.usefixtures("transport")
async def test_each_client_gets_its_own_answers_while_others_end_and_begin_in_the_same_turn() -> None:
    chance = random.Random(7)
    responder = ScriptedHandler(lambda context, asked: registers(address_of(asked)))
    async with busway.serve("tcp://127.0.0.1:0", responder=responder, max_connections=1000) as server:
        address = ("127.0.0.1", urlsplit(server.endpoints[0]).port)
        loop = asyncio.get_running_loop()
        number = 0
        clients: list[socket.socket] = []
        for _ in range(ROUNDS):
            while len(clients) < CLIENTS:
                client = socket.create_connection(address)
                client.setblocking(False)
                clients.append(client)
            expected = {}
            for client in clients:
                number += 1
                client.send(question(number, transaction=number))
                expected[client] = answer(number, transaction=number)
            for client, reply in expected.items():
                assert await loop.sock_recv(client, 64) == reply
            chance.shuffle(clients)
            for client in clients[chance.randint(1, CLIENTS) :]:
                chance.choice(ENDS)(client)
                clients.remove(client)
                if chance.random() < 0.5:
                    fresh = socket.create_connection(address)
                    fresh.setblocking(False)
                    clients.append(fresh)
            if chance.random() < 0.5:
                await asyncio.sleep(0)
        await until(lambda: len(server.status().connections) == len(clients))
        counters = server.status().counters
        assert counters.accepted - counters.closed == len(clients)
        assert (counters.evicted, counters.broken_streams) == (0, 0)
        for client in clients:
            client.close()


async def test_connection_with_the_number_of_an_acceptor_that_closed_in_the_same_turn_hears_nothing_of_it() -> None:
    epoll_set = EpollSet(asyncio.get_running_loop())
    listening = [socket.create_server(("127.0.0.1", 0)) for _ in range(2)]
    numbers = {one.fileno() for one in listening}
    made: list[Heard] = []
    acceptors: list[EpollAcceptor] = []

    def heard(acceptor: int) -> Heard:
        if not made:  # the first one that takes a client closes the other one, whose number its next client gets
            acceptors[1 - acceptor].close()
        made.append(Heard())
        return made[-1]

    clients = [socket.create_connection(one.getsockname()) for one in listening for _ in range(2)]
    for index, one in enumerate(listening):
        one.setblocking(False)
        acceptors.append(EpollAcceptor(epoll_set, one, partial(heard, index), backlog=8, failed=never))
    await until(lambda: len(made) == 2)
    for _ in range(5):
        await asyncio.sleep(0)
    assert made[1].descriptor in numbers
    assert [one.events for one in made] == [[], []]
    for client in clients:
        with contextlib.suppress(ConnectionError):  # those that nothing has accepted
            client.send(b"hello")
    await until(lambda: made[0].events and made[1].events)
    assert [one.events for one in made] == [[b"hello"], [b"hello"]]
    for client in clients:
        client.close()
    for acceptor in acceptors:
        acceptor.close()
    await until(lambda: not len(epoll_set))
    await until(lambda: all(one.has_ended for one in made))


def never(error: OSError) -> None:
    raise AssertionError(error)


class Heard(asyncio.BufferedProtocol):
    """Keeps what it hears, and the number of its descriptor."""

    def __init__(self) -> None:
        self.buffer = bytearray(64)
        self.events: list[bytes] = []
        self.descriptor = -1
        self.has_ended = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.descriptor = transport.get_extra_info("socket").fileno()

    def get_buffer(self, sizehint: int) -> bytearray:
        return self.buffer

    def buffer_updated(self, nbytes: int) -> None:
        self.events.append(bytes(self.buffer[:nbytes]))

    def connection_lost(self, exc: Exception | None) -> None:
        self.has_ended = True

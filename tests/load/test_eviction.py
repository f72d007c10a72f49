"""New connections by the hundred push each other out: those of priority hosts stay, and answers go to their clients."""

import asyncio
import random
import struct

import pytest
from handlers import ScriptedHandler, address_of, registers
from handles import open_handles
from waiting import until

import busway
from busway.pdu.functions import AnyRequest
from busway.session.responder import ResponderAnswer
from busway.testing import golden_adu

PRIORITY_CONNECTIONS, PRIORITY_HOST = 8, "127.0.0.2"
PLACES = 12
"""For those of other hosts."""
NEW_CONNECTIONS, AT_ONCE = 1200, 40
QUESTIONS = 4
"""Of each new connection, sent at once."""
REPLY = struct.Struct(">HHHBBBHH")


def _who_asks_what(chance: random.Random) -> ScriptedHandler:
    """Answers with the port of the client and the address it asked for, some time later, in no order."""

    def decide(context: busway.RequestContext, request: AnyRequest) -> ResponderAnswer:
        reply = registers(int(context.peer.rpartition(":")[2]), address_of(request))
        if chance.random() < 0.2:
            return reply
        asyncio.get_running_loop().call_later(chance.random() * 0.02, context.reply, reply)
        return busway.LATER

    return ScriptedHandler(decide)


class _Client:
    """A connection that holds every answer against its own port and what it asked."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer
        self._port = writer.get_extra_info("sockname")[1]
        self._transaction = 0
        self.answered = 0

    async def ask(self, count: int) -> bool:
        """Ask so many questions at once; False if the server has closed the connection before all were answered."""
        asked = {}
        for _ in range(count):
            self._transaction += 1
            asked[self._transaction] = address = (self._port * 31 + self._transaction) & 0xFFFF
            question = busway.ReadHoldingRegisters(address, 1).encode()
            self._writer.write(golden_adu(question, transaction=self._transaction))
        try:
            while asked:
                reply = REPLY.unpack(await self._reader.readexactly(REPLY.size))
                transaction, *_, port, address = reply
                assert (port, address) == (self._port, asked.pop(transaction)), reply
                self.answered += 1
        except (asyncio.IncompleteReadError, ConnectionError):
            return False
        return True

    def close(self) -> None:
        """End it."""
        self._writer.transport.abort()


@pytest.mark.clause("T12", "T13", "T29")
async def test_hundreds_of_new_connections_move_no_marked_connection_and_no_answer_goes_to_another() -> None:
    chance = random.Random(4)
    before = open_handles()
    server = busway.serve(
        "tcp://127.0.0.1:0",
        responder=_who_asks_what(chance),
        priority=[PRIORITY_HOST],
        max_priority_connections=PRIORITY_CONNECTIONS,
        max_priority_per_host=PRIORITY_CONNECTIONS,
        max_connections=PLACES,
    )
    async with server:
        port = int(server.endpoints[0].rpartition(":")[2])
        priority = [await _connect(port, PRIORITY_HOST) for _ in range(PRIORITY_CONNECTIONS)]
        over = asyncio.Event()
        work = [asyncio.create_task(_work_until(over, one)) for one in priority]
        ends = [end for _ in range(NEW_CONNECTIONS // AT_ONCE) for end in await _wave(port, chance)]
        over.set()
        assert all(await asyncio.gather(*work))  # none of them was ever closed
        assert min(one.answered for one in priority) > NEW_CONNECTIONS // AT_ONCE
        # Places for twelve, waves of forty: most were pushed out, and those that were not had all their answers.
        assert ends.count(False) > NEW_CONNECTIONS // 4
        assert ends.count(True) > PLACES
        for one in priority:
            one.close()
        await until(lambda: not server.status().connections)
        counters = server.status().counters
        assert counters.accepted == counters.closed == NEW_CONNECTIONS + PRIORITY_CONNECTIONS
        assert NEW_CONNECTIONS // 4 < counters.evicted <= NEW_CONNECTIONS
        assert counters.responder_failures == 0
    await until(lambda: open_handles() == before)


async def _connect(port: int, source: str) -> _Client:
    return _Client(*await asyncio.open_connection("127.0.0.1", port, local_addr=(source, 0)))


async def _work_until(over: asyncio.Event, client: _Client) -> bool:
    while not over.is_set():
        if not await client.ask(QUESTIONS):
            return False
    return True


async def _wave(port: int, chance: random.Random) -> list[bool]:
    async def come_and_go() -> bool:
        client = await _connect(port, "127.0.0.1")
        if chance.random() < 0.1:
            await asyncio.sleep(0.005)  # an idle one, for a moment
        served = await client.ask(QUESTIONS)
        client.close()
        return served

    return await asyncio.gather(*(come_and_go() for _ in range(AT_ONCE)))

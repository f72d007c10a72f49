"""NumberMaxOfServerTransaction and NumberMaxOfClientTransaction, 1…16, where more is asked than there is room for."""

import asyncio
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import pytest
from handlers import HeldReplies, ScriptedHandler
from scripted_peer import ScriptedPeer, first_address
from waiting import until

import busway
from busway.framing.mbap import MbapFrame
from busway.testing import golden_adu

ANY_PORT = "tcp://127.0.0.1:0"
CONNECTIONS = 3
BEYOND = 5
"""Requests of each connection beyond the limit."""
ROUNDS = 3
SLOW = 1000
"""From this address on, the handlers of these tests wait."""
REPLY_SIZE, BUSY_SIZE = 11, 9


# --- the server ------------------------------------------------------------


@pytest.mark.clause("T27")
@pytest.mark.parametrize("scope", ["connection", "server"])
async def test_what_is_asked_beyond_any_limit_is_answered_06_at_once_and_the_rest_by_and_by(scope: str) -> None:
    for limit in range(1, 17):
        held_replies = HeldReplies()
        server = busway.serve(
            ANY_PORT, responder=ScriptedHandler(held_replies.decide), max_transactions=limit, scope=scope
        )
        async with server:
            port = int(server.endpoints[0].rpartition(":")[2])
            links = [await asyncio.open_connection("127.0.0.1", port) for _ in range(CONNECTIONS)]
            for number in range(ROUNDS):
                held_replies.opened.clear()
                await _one_round(held_replies, server, links, limit, scope, number)
            assert server.status().counters.responder_failures == 0
            for _, writer in links:
                writer.close()
                await writer.wait_closed()


async def _one_round(
    held_replies: HeldReplies,
    server: busway.Server,
    links: list[tuple[asyncio.StreamReader, asyncio.StreamWriter]],
    limit: int,
    scope: str,
    number: int,
) -> None:
    room = limit
    for index, (reader, writer) in enumerate(links):
        if scope == "connection":
            room = limit
        asked = limit + BEYOND
        addresses = [SLOW + number * 200 + index * 50 + one for one in range(asked)]
        writer.write(b"".join(_question(address) for address in addresses))
        refused = asked - room
        # The handler is not released yet: these come before any of the others can.
        busy = await reader.readexactly(refused * BUSY_SIZE)
        assert busy == b"".join(golden_adu(b"\x83\x06", transaction=one) for one in addresses[room:])
        writer.write(_question(7))  # slots come before handlers: whether this one would be quick is not asked
        assert await reader.readexactly(BUSY_SIZE) == golden_adu(b"\x83\x06", transaction=7)
        room = max(room - asked, 0)
    waiting = [one.waiting for one in server.status().connections]
    assert waiting == ([limit] * CONNECTIONS if scope == "connection" else [limit, 0, 0])
    held_replies.opened.set()
    for index, (reader, _) in enumerate(links):
        held = limit if scope == "connection" or index == 0 else 0
        replies = await reader.readexactly(held * REPLY_SIZE)
        got = {replies[at : at + REPLY_SIZE] for at in range(0, len(replies), REPLY_SIZE)}
        first = SLOW + number * 200 + index * 50
        assert got == {_answer(address) for address in range(first, first + held)}


def _question(address: int) -> bytes:
    return golden_adu(busway.ReadHoldingRegisters(address, 1).encode(), transaction=address)


def _answer(address: int) -> bytes:
    return golden_adu(bytes((3, 2)) + address.to_bytes(2, "big"), transaction=address)


# --- the client ------------------------------------------------------------


class Hoarder:
    """A device that keeps every request until as many are there as there may be, and then answers the newest first.

    Attributes:
        most: requests that were in its hands at once.
    """

    def __init__(self, limit: int, total: int) -> None:
        self._limit = limit
        self._total = total
        self._kept: list[MbapFrame] = []
        self.most = 0

    def answer(self, peer: ScriptedPeer, frame: MbapFrame) -> bytes | None:
        """None, or the answers to all that it keeps."""
        self._kept.append(frame)
        self._total -= 1
        self.most = max(self.most, len(self._kept))
        if len(self._kept) < self._limit and self._total:
            return None
        kept, self._kept = self._kept, []
        return b"".join(first_address(peer, one) for one in reversed(kept))


@pytest.mark.clause("T23", "T24")
async def test_client_never_has_more_on_its_way_than_any_limit_says_and_gives_each_caller_his_own() -> None:
    asked = 60
    for limit in range(1, 17):
        hoarder = Hoarder(limit, asked)
        async with ScriptedPeer(hoarder.answer) as peer, busway.open(peer.endpoint, max_transactions=limit) as link:
            unit = link.unit(1)
            values = await asyncio.gather(*(unit.read_holding_registers(one, count=1) for one in range(asked)))
        assert values == [[one] for one in range(asked)]
        assert hoarder.most == limit
        assert len(peer.frames) == asked


@pytest.mark.clause("T23", "T24")
@pytest.mark.parametrize("limit", [1, 5, 16])
async def test_threads_of_a_blocking_client_never_have_more_on_their_way_than_the_limit_says(limit: int) -> None:
    # A device that answers at once: threads ask when they like, so no thread could wait until as many are there.
    in_hand: Counter[str] = Counter()

    def answer(peer: ScriptedPeer, frame: MbapFrame) -> bytes | None:
        in_hand["now"] += 1
        in_hand["most"] = max(in_hand["most"], in_hand["now"])
        asyncio.get_running_loop().call_soon(reply, peer, frame)
        return None

    def reply(peer: ScriptedPeer, frame: MbapFrame) -> None:
        in_hand["now"] -= 1
        peer.writers[-1].write(first_address(peer, frame))

    def ask(link: busway.BlockingLink, thread: int) -> list[list[int]]:
        unit = link.unit(1)
        return [unit.read_holding_registers(thread * 100 + one, count=1) for one in range(20)]

    async with ScriptedPeer(answer) as peer:
        with busway.connect(peer.endpoint, max_transactions=limit) as link, ThreadPoolExecutor(20) as threads:
            loop = asyncio.get_running_loop()
            asks = [loop.run_in_executor(threads, ask, link, thread) for thread in range(20)]
            for thread, values in enumerate(await asyncio.gather(*asks)):
                assert values == [[thread * 100 + one] for one in range(20)]
        await until(lambda: peer.ended)
    assert len(peer.writers) == 1
    assert in_hand["most"] <= limit

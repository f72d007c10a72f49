"""Two ends of a connection in memory."""

import asyncio

import pytest

from busway.server.device_responder import DeviceResponder
from busway.session.diagnostic_counters import LineDiagnostics
from busway.session.server_pipeline import RequestPipeline
from busway.session.server_transaction_slots import ServerTransactionSlots
from busway.session.tcp_server import TcpServerSession
from busway.testing import MemoryPair, Passage, golden_adu, known_device


class Notes(asyncio.Protocol):
    """Writes down what it is told."""

    def __init__(self) -> None:
        self.received: list[bytes] = []
        self.lost = 0
        self.transport: asyncio.BaseTransport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport

    def data_received(self, data: bytes) -> None:
        self.received.append(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self.lost += 1


class BufferedNotes(asyncio.BufferedProtocol):
    """The same with a small buffer of its own."""

    def __init__(self) -> None:
        self.received: list[bytes] = []
        self.buffer = bytearray(4)

    def get_buffer(self, sizehint: int) -> bytearray:
        return self.buffer

    def buffer_updated(self, nbytes: int) -> None:
        self.received.append(bytes(self.buffer[:nbytes]))


def _pair(**options: object) -> tuple[MemoryPair, Notes, Notes]:
    first, second = Notes(), Notes()
    pair = MemoryPair(first, second, **options)  # type: ignore[arg-type]
    pair.open()
    return pair, first, second


def test_segments_arrive_as_they_were_written_and_only_when_they_are_delivered() -> None:
    pair, first, second = _pair()
    pair.first.write(b"one")
    pair.first.write(bytearray(b"two"))
    pair.second.write(b"back")
    assert second.received == first.received == []
    assert pair.first.get_write_buffer_size() == 6
    pair.deliver()
    assert second.received == [b"one", b"two"]
    assert first.received == [b"back"]
    assert pair.first.written == [b"one", b"two"]
    assert (first.transport, second.transport) == (pair.first, pair.second)


def test_buffered_protocol_gets_what_its_buffer_holds() -> None:
    buffered = BufferedNotes()
    pair = MemoryPair(Notes(), buffered)
    pair.open()
    pair.first.write(b"123456789")
    pair.deliver()
    assert buffered.received == [b"1234", b"5678", b"9"]


@pytest.mark.parametrize(
    ("passage", "arrives"),
    [
        (Passage(split=2), [b"on", b"e", b"tw", b"o"]),
        (Passage(merge=True), [b"onetwo"]),
        (Passage(split=1, merge=True), [b"onetwo"]),
        (Passage(drop=1.0), []),
    ],
)
def test_passage_splits_merges_and_drops(passage: Passage, arrives: list[bytes]) -> None:
    pair, _, second = _pair(forth=passage)
    pair.first.write(b"one")
    pair.first.write(b"two")
    pair.deliver()
    assert second.received == arrives


def test_passage_delays() -> None:
    pair, _, second = _pair(forth=Passage(delay=2.0))
    pair.first.write(b"one")
    pair.deliver(1.5)
    pair.first.write(b"two")
    assert second.received == []
    pair.deliver(0.5)
    assert second.received == [b"one"]
    pair.deliver(1.5)
    assert second.received == [b"one", b"two"]


def test_drops_come_from_the_seed() -> None:
    def arrived(seed: int) -> list[bytes]:
        pair, _, second = _pair(forth=Passage(drop=0.5, seed=seed))
        for number in range(50):
            pair.first.write(bytes((number,)))
        pair.deliver()
        return second.received

    assert arrived(1) == arrived(1) != arrived(2)
    assert 10 < len(arrived(1)) < 40


def test_close_comes_after_what_was_written_and_both_ends_learn_of_it_once() -> None:
    pair, first, second = _pair()
    pair.first.write(b"last words")
    pair.first.close()
    pair.first.write(b"too late")
    pair.first.close()
    assert pair.first.is_closing()
    assert (first.lost, second.lost) == (0, 0)
    pair.deliver()
    assert second.received == [b"last words"]
    assert (first.lost, second.lost) == (1, 1)
    assert pair.second.is_closing()
    pair.deliver()
    assert (first.lost, second.lost) == (1, 1)


def test_abort_loses_what_was_written() -> None:
    pair, first, second = _pair()
    pair.first.write(b"unsaid")
    pair.first.abort()
    pair.deliver()
    assert second.received == []
    assert (first.lost, second.lost) == (1, 1)


def test_nothing_arrives_while_reading_is_paused() -> None:
    pair, _, second = _pair()
    pair.second.pause_reading()
    pair.first.write(b"wait")
    pair.deliver()
    assert second.received == []
    pair.second.resume_reading()
    pair.deliver()
    assert second.received == [b"wait"]


async def test_with_a_schedule_it_arrives_by_itself() -> None:
    first, second = Notes(), Notes()
    pair = MemoryPair(first, second, schedule=asyncio.get_running_loop().call_soon, extra={"peername": ("memory", 1)})
    pair.open()
    pair.first.write(b"ping")
    await asyncio.sleep(0)
    assert second.received == [b"ping"]
    pair.second.close()
    await asyncio.sleep(0)
    assert (first.lost, second.lost) == (1, 1)
    assert pair.first.get_extra_info("peername") == ("memory", 1)


class Answering(asyncio.Protocol):
    """A known device behind a server session."""

    def __init__(self) -> None:
        self.session = TcpServerSession(
            RequestPipeline(DeviceResponder({1: known_device()})),
            diagnostics=LineDiagnostics(),
            slots=ServerTransactionSlots(1),
            deliver=lambda adu: None,
        )

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self.transport = transport

    def data_received(self, data: bytes) -> None:
        for adu in self.session.receive(data, len(data)):
            self.transport.write(adu)


@pytest.mark.parametrize("split", [0, 1, 5, 7, 12])
@pytest.mark.parametrize("merge", [False, True])
def test_server_session_in_memory_answers_whatever_the_segments(split: int, merge: bool) -> None:
    client = Notes()
    pair = MemoryPair(client, Answering(), forth=Passage(split=split, merge=merge))
    pair.open()
    for one in range(1, 4):
        pair.first.write(golden_adu(bytes((3, 0, one, 0, 1)), transaction=one))
    pair.deliver()
    expected = b"".join(golden_adu(bytes((3, 2, 0, one)), transaction=one) for one in range(1, 4))
    assert b"".join(client.received) == expected

"""TLS between a loop's transport and a protocol: who hears what, in which order, and what leaves when."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from busway.options.tls import TlsParameters
from busway.testing.certificates import CertificateStore
from busway.transport.tls.context import client_context, server_context
from busway.transport.tls.failures import FailureKind, TlsFailure
from busway.transport.tls.layer import TlsLayer, TlsState
from busway.transport.tls.stream import TlsStream


class Below:
    """A transport that keeps what is written, and ends when it is told to."""

    def __init__(self) -> None:
        self.layer: TlsLayer | None = None
        self.written: list[bytes] = []
        self.reading = True
        self.eof_written = False
        self.ended = ""

    def write(self, data: bytes) -> None:
        self.written.append(data)

    def take(self) -> bytes:
        data, self.written = b"".join(self.written), []
        return data

    def close(self) -> None:
        self._end("closed")

    def abort(self) -> None:
        self._end("aborted")

    def _end(self, how: str) -> None:
        if not self.ended:
            self.ended = how
            assert self.layer is not None
            asyncio.get_running_loop().call_soon(self.layer.connection_lost, None)

    def is_closing(self) -> bool:
        return bool(self.ended)

    def pause_reading(self) -> None:
        self.reading = False

    def resume_reading(self) -> None:
        self.reading = True

    def can_write_eof(self) -> bool:
        return True

    def write_eof(self) -> None:
        self.eof_written = True

    def get_write_buffer_size(self) -> int:
        return sum(map(len, self.written))

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        self.limits = (high, low)

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        return {"peername": ("10.0.0.7", 4711)}.get(name, default)


class Above(asyncio.BufferedProtocol):
    """A protocol that writes down what it hears."""

    def __init__(self) -> None:
        self.heard: list[object] = []
        self.transport: Any = None
        self.keeps_open = False
        self.answer: Callable[[bytes], bytes] | None = None
        self._buffer = bytearray(65_536)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport

    def get_buffer(self, sizehint: int) -> bytearray:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        data = bytes(self._buffer[:nbytes])
        self.heard.append(data)
        if self.answer is not None:
            self.transport.write(self.answer(data))

    def eof_received(self) -> bool:
        self.heard.append("end")
        return self.keeps_open

    def connection_lost(self, exc: Exception | None) -> None:
        self.heard.append(exc)

    def pause_writing(self) -> None:
        self.heard.append("pause")

    def resume_writing(self) -> None:
        self.heard.append("resume")


class World:
    """A server's layer, and a client that is only a stream of bytes."""

    def __init__(self, store: CertificateStore, *, client: Any = None) -> None:
        files = client or store.client()
        self.below, self.above = Below(), Above()
        self.failures: list[TlsFailure] = []
        self.gone: list[TlsLayer] = []
        self.layer = TlsLayer(
            asyncio.get_running_loop(),
            server_context(TlsParameters(**store.server().options())),
            server_side=True,
            timeout=10.0,
            established=lambda layer: self.above,
            failed=lambda layer, failure: self.failures.append(failure),
            gone=self.gone.append,
        )
        self.below.layer = self.layer
        self.client = TlsStream(
            client_context(TlsParameters(**files.options())), server_side=False, server_name="localhost"
        )
        self.layer.connection_made(self.below)  # type: ignore[arg-type]

    def arrive(self, data: bytes) -> None:
        """Bytes reach the layer, as many at once as its buffer takes."""
        while data:
            room = self.layer.get_buffer(-1)
            size = min(len(room), len(data))
            room[:size] = data[:size]
            self.layer.buffer_updated(size)
            data = data[size:]

    def agree(self) -> None:
        """The whole handshake."""
        for _ in range(5):
            self.client.handshake()
            self.arrive(self.client.outgoing())
            self.client.feed(self.below.take())

    def say(self, *texts: bytes) -> bytes:
        """Each text as a record of the client's."""
        for text in texts:
            self.client.write(text)
        return self.client.outgoing()

    def client_reads(self) -> bytes:
        """What the client has been told."""
        self.client.feed(self.below.take())
        room = bytearray(100_000)
        return bytes(room[: self.client.read_into(memoryview(room))])


@pytest.fixture
def store(tmp_path: Path) -> CertificateStore:
    return CertificateStore(tmp_path)


async def turns() -> None:
    for _ in range(3):
        await asyncio.sleep(0)


@pytest.mark.clause("M1")
async def test_records_that_come_together_are_handed_up_together_and_answered_with_one_write(
    store: CertificateStore,
) -> None:
    world = World(store)
    world.agree()
    world.above.answer = lambda data: data.upper()
    world.arrive(world.say(b"one ", b"two ", b"three"))
    assert world.above.heard == [b"one two three"]
    assert len(world.below.written) == 1
    assert world.client_reads() == b"ONE TWO THREE"
    world.layer.abort()
    await turns()


@pytest.mark.clause("M1")
async def test_a_record_that_comes_byte_by_byte_is_handed_up_once(store: CertificateStore) -> None:
    world = World(store)
    world.agree()
    for byte in world.say(b"whole"):
        world.arrive(bytes([byte]))
    assert world.above.heard == [b"whole"]
    world.layer.abort()
    await turns()


async def test_while_reading_is_paused_nothing_is_handed_up_and_nothing_is_lost(store: CertificateStore) -> None:
    world = World(store)
    world.agree()
    texts = [bytes([number]) * 16_000 for number in range(6)]  # more than the protocol's buffer takes at once

    def pause(data: bytes) -> bytes:
        world.layer.pause_reading()
        return b""

    world.above.answer = pause
    data = world.say(*texts)
    world.arrive(data)
    assert not world.below.reading
    first = len(world.above.heard)
    assert 1 <= first < 6
    world.above.answer = None
    while b"".join(world.above.heard) != b"".join(texts):  # type: ignore[arg-type]
        world.layer.resume_reading()
        await turns()
    assert world.below.reading
    world.layer.abort()
    await turns()


async def test_bytes_that_no_record_can_hold_are_written_whole_and_no_bytes_as_none(store: CertificateStore) -> None:
    world = World(store)
    world.agree()
    long = bytes(range(256)) * 200
    for data in (long, bytearray(long), memoryview(long)):
        world.layer.write(data)
        assert world.client_reads() == long
    world.layer.write(b"")
    assert world.below.take() == b""
    world.layer.abort()
    await turns()


async def test_what_is_written_after_a_protocol_failed_at_the_begin_leaves_at_once(store: CertificateStore) -> None:
    world = World(store)

    def fails(transport: asyncio.BaseTransport) -> None:
        raise RuntimeError("no memory left")

    world.above.connection_made = fails  # type: ignore[method-assign]
    with pytest.raises(RuntimeError, match="no memory"):
        world.agree()
    world.layer.write(b"sorry")
    assert world.client_reads() == b"sorry"
    world.layer.abort()
    await turns()


async def test_a_peer_that_ends_gets_the_replies_that_are_still_to_come(store: CertificateStore) -> None:
    world = World(store)
    world.agree()
    world.above.keeps_open = True
    world.client.write(b"last words")
    world.client.finish()
    world.arrive(world.client.outgoing())
    world.layer.eof_received()
    assert world.above.heard == [b"last words", "end"]
    assert not world.layer.is_closing()
    world.layer.write(b"answer")
    assert world.client_reads() == b"answer"
    world.layer.close()
    await turns()
    assert world.below.ended == "closed"
    assert world.above.heard[-1] is None


async def test_a_peer_that_ends_is_closed_where_nothing_is_to_come(store: CertificateStore) -> None:
    world = World(store)
    world.agree()
    world.client.finish()
    world.arrive(world.client.outgoing())
    assert world.below.ended == "closed"
    assert world.client_reads() == b""
    assert world.client.ended  # it was told so
    await turns()
    assert world.above.heard == ["end", None]
    assert world.gone == [world.layer]


async def test_a_damaged_record_ends_the_connection_with_an_alert_and_its_reason(store: CertificateStore) -> None:
    world = World(store)
    world.agree()
    record = bytearray(world.say(b"text"))
    record[-1] ^= 1
    world.arrive(world.say(b"") + bytes(record))
    alert = world.below.take()
    assert alert  # encrypted, but there
    assert world.below.ended == "aborted"
    await turns()
    (reason,) = world.above.heard
    assert isinstance(reason, TlsFailure)
    assert "damaged or forged" in str(reason)
    world.client.feed(alert)
    with pytest.raises(TlsFailure):
        world.client.read_into(memoryview(bytearray(100)))


async def test_good_bytes_before_a_damaged_record_are_handed_up(store: CertificateStore) -> None:
    world = World(store)
    world.agree()
    good = world.say(b"good")
    bad = bytearray(world.say(b"bad"))
    bad[-1] ^= 1
    world.arrive(good + bytes(bad))
    assert world.above.heard == [b"good"]
    await turns()
    assert isinstance(world.above.heard[-1], TlsFailure)


@pytest.mark.clause("M3")
async def test_a_refused_handshake_is_heard_once_and_its_connection_lingers_for_the_alert(
    store: CertificateStore,
) -> None:
    world = World(store, client=store.client("stranger", authority=store.foreign))
    world.client.handshake()
    world.arrive(world.client.outgoing())
    world.client.feed(world.below.take())
    world.client.handshake()
    world.arrive(world.client.outgoing())
    assert [failure.kind for failure in world.failures] == [FailureKind.UNKNOWN_AUTHORITY]
    assert world.layer.state is TlsState.REFUSED
    assert world.below.written  # the alert
    assert world.below.eof_written
    assert not world.below.ended
    world.arrive(b"whatever else the client says")
    world.layer.eof_received()
    world.layer.abort()
    await turns()
    assert len(world.failures) == 1
    assert world.above.heard == []
    assert world.gone == [world.layer]


async def test_a_peer_that_goes_within_the_handshake_is_heard_of_once(store: CertificateStore) -> None:
    world = World(store)
    world.layer.connection_lost(None)
    world.layer.connection_lost(None)
    assert [failure.kind for failure in world.failures] == [FailureKind.GONE]
    assert world.above.heard == []


async def test_the_transport_above_tells_what_the_one_below_knows(store: CertificateStore) -> None:
    world = World(store)
    world.agree()
    layer = world.layer
    assert layer.get_extra_info("peername") == ("10.0.0.7", 4711)
    assert layer.get_extra_info("nothing", 5) == 5
    assert layer.get_extra_info("ssl_object").version() == "TLSv1.3"
    layer.set_write_buffer_limits(high=1000)
    assert world.below.limits == (1000, None)
    layer.write(b"x" * 100)
    assert layer.get_write_buffer_size() > 100
    layer.pause_writing()
    layer.resume_writing()
    assert world.above.heard == ["pause", "resume"]
    layer.abort()
    layer.write(b"too late")
    await turns()
    assert layer.is_closing()

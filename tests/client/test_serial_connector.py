"""The port of a link: a reply of which the port has lost characters is none."""

from random import Random
from typing import cast

import pytest

from busway.client.serial_connector import SerialChannel, SerialStream
from busway.errors import BadReply, NoReply
from busway.framing.character_times import SerialTiming
from busway.framing.frame_direction import LineRole
from busway.framing.rtu import encode_rtu
from busway.options.client import ClientParameters
from busway.pdu.read_items import ReadHoldingRegisters
from busway.session.call import Call
from busway.session.line_framing import line_framing
from busway.session.serial_client import SerialClientSession
from busway.transport.serial.blocking import BlockingSerialPort
from busway.transport.serial.connection import SerialConnection
from busway.transport.serial.driver_counters import DriverCounters

REPLY = encode_rtu(1, bytes.fromhex("03 02 00 07"))


class Port:
    """A port that gives what a test has put there, and counts what a test says it has lost."""

    pseudo_terminal = False

    def __init__(self) -> None:
        self.lost = 5
        self.arrived: list[tuple[bytes, int]] = []

    def counters(self) -> DriverCounters | None:
        return DriverCounters(overruns=self.lost)

    def read(self, _timeout: float) -> tuple[bytes, int]:
        return self.arrived.pop(0) if self.arrived else (b"", 0)


class End:
    """A link's end that notes what it is told."""

    def __init__(self) -> None:
        self.told: list[tuple[bytes, bool | None]] = []

    def arrived(self, data: bytes) -> None:
        self.told.append((data, None))

    def arrived_damaged(self, data: bytes, overrun: bool) -> None:
        self.told.append((data, overrun))

    def connection_lost(self, exc: Exception | None) -> None:
        raise AssertionError(exc)


def asking(now: float = 0.0) -> tuple[SerialClientSession, Call]:
    """A session whose request is on the line."""
    session = SerialClientSession(
        ClientParameters(retries=0),
        framing=line_framing("rtu", LineRole.MASTER, SerialTiming.of_line()),
        jitter=Random(1).random,
        endpoint="rtu:///dev/x",
    )
    session.connected(now)
    call = Call(1, (ReadHoldingRegisters(0, 1),), is_write=False, timeout=1.0, retries=0)
    session.submit(call, now)
    (_,) = session.transmit(now + 1.0)
    session.written(now + 1.0)
    return session, call


@pytest.mark.clause("S14")
@pytest.mark.clause("S16")
def test_a_stream_tells_of_lost_characters_and_of_marked_ones() -> None:
    session, _ = asking()
    end, port = End(), Port()
    stream = SerialStream(session, end)
    stream.received(b"early", 0)
    stream.opened(cast(SerialConnection, port))
    stream.received(b"whole", 0)
    port.lost += 1
    stream.received(b"lost", 0)
    stream.received(b"marked", 2)
    stream.received(b"whole again", 0)
    assert end.told == [(b"early", None), (b"whole", None), (b"lost", True), (b"marked", False), (b"whole again", None)]


@pytest.mark.clause("S14")
@pytest.mark.clause("S16")
def test_a_reply_with_lost_characters_is_damaged_and_counted() -> None:
    session, call = asking()
    port = Port()
    channel = SerialChannel(cast(BlockingSerialPort, port), session)
    port.arrived.append((REPLY, 0))
    port.lost += 1
    with pytest.raises(BlockingIOError):
        channel.recv_into(bytearray(100))
    session.tick(10.0**9)
    assert isinstance(call.outcomes[0], NoReply | BadReply)
    assert (session.counters.overruns, session.counters.replies) == (1, 0)
    assert session.counters.damaged_frames >= 1


def test_a_reply_without_losses_is_handed_on() -> None:
    session, _ = asking()
    port = Port()
    channel = SerialChannel(cast(BlockingSerialPort, port), session)
    port.arrived.append((REPLY, 0))
    buffer = bytearray(100)
    assert buffer[: channel.recv_into(buffer)] == REPLY
    assert session.counters.overruns == 0

"""Lines that give back what a master sends, and lines that only seem to: a reply may have the bytes of its request."""

from collections.abc import Callable, Sequence

import pytest
from virtual_bus import Bus, MasterEnd

from busway.errors import ModbusError, NoReply, UnitSuspended, WriteOutcomeUnknown
from busway.framing.ascii import encode_ascii
from busway.framing.echo import Echo
from busway.framing.rtu import encode_rtu
from busway.options.client import ClientParameters
from busway.options.lines import SerialClientParameters
from busway.pdu.message import Message, Request
from busway.pdu.read_items import ReadCoils, ReadDiscreteInputs, ReadHoldingRegisters
from busway.pdu.write_items import WriteSingleRegister
from busway.server.device import Device

READ = ReadHoldingRegisters(0, 2)
REPLY = bytes.fromhex("03 04 00 01 00 02")
WRITE = WriteSingleRegister(3, 9)
FRAMINGS = pytest.mark.parametrize("framing", ["rtu", "ascii"])


class Converter:
    """A device behind a converter that gives back what it is sent.

    Attributes:
        echo_after: seconds until the copy of a request comes back; None: none comes.
        reply_after: seconds until the reply; None: the unit is silent.
        noise: bytes just before the copy.
        executed: PDUs that the unit has executed.
    """

    def __init__(self, framing: str) -> None:
        self.encode: Callable[[int, bytes], bytes] = encode_rtu if framing == "rtu" else encode_ascii
        self.echo_after: float | None = 0.005
        self.reply_after: float | None = 0.05
        self.reads = REPLY
        self.noise = b""
        self.executed: list[bytes] = []

    def __call__(self, unit: int, pdu: bytes, now: float) -> Sequence[tuple[float, bytes]]:
        found = []
        if self.echo_after is not None:
            found.append((self.echo_after, self.noise + self.encode(unit, pdu)))
        if self.reply_after is not None:
            self.executed.append(pdu)
            reply = (
                pdu
                if pdu[0] not in (1, 2, 3)
                else self.reads
                if pdu == b"\x03\x00\x00\x00\x02" or pdu[0] != 3
                else pdu[:1] + bytes((2 * pdu[4],)) + bytes(2 * pdu[4])
            )
            found.append((self.reply_after, self.encode(unit, reply)))
        return found


def line_with(framing: str) -> tuple[Bus, MasterEnd, Converter]:
    bus = Bus(framing=framing)
    master = bus.master(parameters=ClientParameters(timeout=0.3, retries=0))
    master.session.characters_take_time = False
    converter = Converter(framing)
    bus.device(converter)
    return bus, master, converter


# 01 03 00 00 15 asks for 21 coils from 0x0300; the same bytes are a reply with the three bytes of coils 00 00 15.
@FRAMINGS
@pytest.mark.parametrize("read", [ReadCoils(0x0300, 21), ReadDiscreteInputs(0x0300, 21)])
def test_a_reply_with_the_bytes_of_its_read_is_no_echo_where_the_line_does_not_echo(
    framing: str, read: Request
) -> None:
    _, master, device = line_with(framing)
    device.echo_after = None
    device.reads = read.prepare()
    assert isinstance(master.get(1, read), Message)
    assert isinstance(master.get(1, WRITE), Message)
    assert master.session.counters.timeouts == 0


@FRAMINGS
@pytest.mark.parametrize("read", [ReadCoils(0x0300, 21), ReadDiscreteInputs(0x0300, 21)])
def test_a_reply_with_the_bytes_of_its_read_follows_its_echo_where_the_line_echoes(framing: str, read: Request) -> None:
    _, master, device = line_with(framing)
    assert isinstance(master.get(1, READ), Message)
    device.reads = read.prepare()
    assert isinstance(master.get(1, read), Message)
    assert isinstance(master.get(1, WRITE), Message)
    device.reply_after = None
    assert isinstance(master.get(1, WRITE), WriteOutcomeUnknown)


@FRAMINGS
@pytest.mark.parametrize("trust", [True, False])
@pytest.mark.parametrize("second", [WRITE, WriteSingleRegister(3, 9), WriteSingleRegister(3, 10)])
def test_a_late_echo_and_a_late_reply_complete_no_later_write(framing: str, trust: bool, second: Request) -> None:
    bus = Bus(framing=framing)
    master = bus.master(
        parameters=ClientParameters(timeout=0.3, retries=0),
        serial=SerialClientParameters(trust_reply_order=trust, quiet_window=0.0),
    )
    master.session.characters_take_time = False
    device = Converter(framing)
    bus.device(device)
    assert isinstance(master.get(1, READ), Message)
    device.echo_after, device.reply_after = 0.5, 0.65  # a path that is slow once
    assert isinstance(master.get(1, WRITE), WriteOutcomeUnknown)
    device.echo_after, device.reply_after = 0.05, None
    device.executed.clear()
    outcome = master.get(1, second)
    assert isinstance(outcome, ModbusError), outcome
    assert not device.executed


@FRAMINGS
def test_late_echo_of_an_attempt_does_not_complete_the_repeated_write(framing: str) -> None:
    bus = Bus(framing=framing)
    master = bus.master(parameters=ClientParameters(timeout=0.3, retries=0, write_retries=1))
    master.session.characters_take_time = False
    device = Converter(framing)
    bus.device(device)
    assert isinstance(master.get(1, READ), Message)
    device.echo_after, device.reply_after = 0.45, None
    outcome = master.get(1, WRITE, retries=1, idempotent=True)
    assert isinstance(outcome, ModbusError), outcome


@FRAMINGS
def test_an_echo_that_is_missing_at_times_stays_known(framing: str) -> None:
    bus, master, device = line_with(framing)
    for number in range(60):
        device.echo_after = None if number % 10 in (3, 4) else 0.005
        assert isinstance(master.get(1, READ), Message)
        if number % 10 in (3, 4, 6):
            device.echo_after, device.reply_after = 0.005, None
            assert isinstance(master.get(1, WRITE), WriteOutcomeUnknown)
            device.reply_after = 0.05
            bus.run(2.0)


@FRAMINGS
def test_echoes_of_writes_show_that_a_line_still_echoes(framing: str) -> None:
    _, master, device = line_with(framing)
    assert isinstance(master.get(1, READ), Message)
    for _ in range(3):
        device.echo_after = None  # this echo is lost
        assert isinstance(master.get(1, READ), Message)
        device.echo_after = 0.005
        assert isinstance(master.get(1, WRITE), Message)
    device.reply_after = None
    assert isinstance(master.get(1, WRITE), WriteOutcomeUnknown)


@FRAMINGS
def test_echo_that_a_read_has_shown_is_known_after_the_port_was_lost(framing: str) -> None:
    bus, master, device = line_with(framing)
    assert isinstance(master.get(1, READ), Message)
    master.session.disconnected(bus.now, "unplugged")
    bus.run(1.0)
    master.session.connected(bus.now)
    device.reply_after = None
    assert isinstance(master.get(1, WRITE), WriteOutcomeUnknown)


@FRAMINGS
def test_echo_shown_by_a_read_without_a_reply_counts(framing: str) -> None:
    _, master, device = line_with(framing)
    device.reply_after = None
    assert isinstance(master.get(1, READ), NoReply)
    assert isinstance(master.get(1, WRITE), WriteOutcomeUnknown)
    assert isinstance(master.get(2, WRITE), WriteOutcomeUnknown)


@FRAMINGS
def test_writes_alone_are_done_again_some_time_after_the_echo_has_gone(framing: str) -> None:
    bus, master, device = line_with(framing)
    assert isinstance(master.get(1, READ), Message)
    device.echo_after = None
    outcomes: list[object] = []
    for _ in range(8):
        try:
            outcomes.append(master.get(1, WRITE))
        except UnitSuspended as error:
            outcomes.append(error)
        bus.run(5.0)
    assert isinstance(outcomes[-1], Message), outcomes


@FRAMINGS
@pytest.mark.parametrize("echo", [Echo.ON, Echo.AUTOMATIC])
@pytest.mark.parametrize(("noise", "after"), [(b"\x00", 0.01), (b"", 0.2), (b"\xff\x00", 0.2)])
def test_an_echo_that_is_late_or_follows_noise_does_not_complete_a_write_where_the_option_removes_it(
    framing: str, echo: Echo, noise: bytes, after: float
) -> None:
    """A busy machine reads late, and a transceiver that switches over adds a character."""
    bus = Bus(framing=framing)
    master = bus.master(parameters=ClientParameters(timeout=0.3, retries=0), echo=echo)
    master.session.characters_take_time = False
    device = Converter(framing)
    bus.device(device)
    assert isinstance(master.get(1, READ), Message)
    device.noise, device.echo_after, device.reply_after = noise, after, None
    assert isinstance(master.get(1, WRITE), WriteOutcomeUnknown)
    device.reply_after = after + 0.03
    bus.run(2.0)
    assert isinstance(master.get(1, WRITE), Message)


@FRAMINGS
@pytest.mark.parametrize(("noise", "after"), [(b"\x00", 0.01), (b"", 0.2), (b"\xff\x00", 0.2)])
def test_a_server_executes_a_write_once_whose_reply_it_hears_late_or_after_noise(
    framing: str, noise: bytes, after: float
) -> None:
    bus = Bus(framing=framing)
    device = Device(holding_registers=10)
    server = bus.servers({1: device}, echo=Echo.ON)
    encode = encode_rtu if framing == "rtu" else encode_ascii
    request = encode(1, WRITE.prepare())
    bus.run(1.0)
    server.hear(request, 0, bus.now)
    bus.run(0.1)
    server.hear(noise + request, 0, bus.now + after)
    bus.run(1.0)
    assert len(server.sent) == 1
    assert server.session.requests == 1

"""The servers of a line: silent for others, counted as in appendix A."""

import asyncio

import pytest
from virtual_bus import Bus, MasterEnd, ServerEnd

from busway.errors import NoReply
from busway.framing.ascii import encode_ascii
from busway.framing.echo import Echo
from busway.framing.rtu import encode_rtu
from busway.options.client import ClientParameters
from busway.options.lines import FramingParameters
from busway.pdu.diagnostics import (
    ChangeAsciiDelimiter,
    ClearCounters,
    ForceListenOnly,
    GetCommEventCounter,
    GetCommEventLog,
    ReadExceptionStatus,
    RestartCommunications,
    ReturnBusCommunicationErrorCount,
    ReturnBusExceptionErrorCount,
    ReturnBusMessageCount,
    ReturnQueryData,
    ReturnServerBusyCount,
    ReturnServerMessageCount,
    ReturnServerNakCount,
    ReturnServerNoResponseCount,
)
from busway.pdu.functions import STANDARD, AnyRequest
from busway.pdu.message import Message, Request
from busway.pdu.read_items import ReadHoldingRegisters
from busway.pdu.write_items import WriteSingleRegister
from busway.server.device import Device
from busway.session.diagnostic_counters import DiagnosticCounters
from busway.session.responder import LATER, SILENCE, Refusal, RequestContext, ResponderAnswer, ServedUnit

CHARACTER = 11 / 9600
T3_5 = 3.5 * CHARACTER
READ = ReadHoldingRegisters(0, 2)
REPLY = bytes.fromhex("03 04 00 00 00 00")


def pair(units: dict[int, Device] | None = None, **options: object) -> tuple[Bus, MasterEnd, ServerEnd]:
    bus = Bus(3, **options)  # type: ignore[arg-type]
    master = bus.master(parameters=ClientParameters(timeout=0.3, retries=0))
    return bus, master, bus.servers(units or {5: Device(holding_registers=10)})


def send(bus: Bus, frame: bytes, seconds: float = 0.3) -> None:
    """Put a frame of any station on the line, and let its answer pass."""
    bus.line.inject(frame, bus.now + 0.01)
    bus.run(0.01 + len(frame) * bus.line.character_time + seconds)


def value_of(reply: object) -> int:
    assert isinstance(reply, Message), reply
    return int.from_bytes(reply.values()["data"], "big")


class Handling:
    """A handler that does what a test says."""

    functions = STANDARD
    generation = 0

    def __init__(self, outcome: ResponderAnswer | Exception) -> None:
        self.outcome = outcome
        self.contexts: list[RequestContext] = []

    def serves(self, unit: int) -> ServedUnit | None:
        return ServedUnit(unit) if unit in (5, 6) else None

    def answer(self, context: RequestContext, request: AnyRequest) -> ResponderAnswer:
        self.contexts.append(context)
        if isinstance(self.outcome, Exception):
            raise self.outcome
        return self.outcome


def handled(outcome: ResponderAnswer | Exception) -> tuple[Bus, MasterEnd, ServerEnd, Handling]:
    bus = Bus(3)
    master = bus.master(parameters=ClientParameters(timeout=0.3, retries=0))
    handler = Handling(outcome)
    return bus, master, bus.servers(responder=handler), handler  # type: ignore[arg-type]


# Who is answered, and when.


@pytest.mark.clause("S6")
def test_request_is_answered_t3_5_after_its_last_byte() -> None:
    bus, master, _ = pair()
    assert isinstance(master.get(5, READ), ReadHoldingRegisters.Reply)
    request, answer = bus.line.transmissions()
    assert answer.begin - request.end == pytest.approx(T3_5)


@pytest.mark.clause("S6")
def test_damaged_frame_is_never_answered_and_error_of_content_is() -> None:
    bus, master, server = pair()
    frame = encode_rtu(5, READ.encode())
    for position in range(len(frame)):
        damaged = bytearray(frame)
        damaged[position] ^= 0x10
        send(bus, bytes(damaged), 0.1)
    assert server.sent == []
    assert isinstance(master.get(5, ReadHoldingRegisters(9, 100)), Exception)
    assert server.sent[0][1] == encode_rtu(5, b"\x83\x02")


@pytest.mark.clause("S11")
@pytest.mark.parametrize("framing", ["rtu", "ascii"])
def test_foreign_requests_and_replies_are_followed_and_never_answered(framing: str) -> None:
    encode = encode_rtu if framing == "rtu" else encode_ascii
    bus, master, server = pair(framing=framing)
    for foreign in (
        encode(6, READ.encode()),
        encode(6, REPLY),
        encode(6, WriteSingleRegister(0, 5).encode()),
        encode(6, WriteSingleRegister(0, 5).encode()),  # the echo that answers it
        encode(6, b"\x83\x02"),
        encode(5, b"\x83\x02"),  # another station answers in our name
        encode(248, READ.encode()),
    ):
        send(bus, foreign, 0.02)
    assert server.sent == []
    assert server.session.foreign == 7
    assert server.diagnostics.counters.bus_message_count == 7
    assert server.diagnostics.counters.server_message_count == 0
    assert isinstance(master.get(5, READ), ReadHoldingRegisters.Reply)


@pytest.mark.clause("S11")
def test_foreign_reply_that_looks_like_a_request_for_us_is_none() -> None:
    """A foreign reply may hold anything, also the bytes of a frame for our unit."""
    bus, _, server = pair({5: Device(holding_registers=10)})
    inner = encode_rtu(5, WriteSingleRegister(0, 99).encode())
    send(bus, encode_rtu(6, ReadHoldingRegisters(0, 4).encode()), 0.02)
    send(bus, encode_rtu(6, b"\x03\x08" + inner), 0.3)
    assert server.sent == []
    assert server.session.requests == 0


@pytest.mark.clause("S6")
def test_frame_inside_a_damaged_one_is_never_executed() -> None:
    device = Device(holding_registers=10)
    bus, _, server = pair({5: device})
    send(bus, b"\x05\x10\x00\x00" + encode_rtu(5, WriteSingleRegister(0, 99).encode()) + b"\x55" * 3)
    assert device.holding_registers[0] == 0
    assert server.sent == []


@pytest.mark.clause("S3")
def test_sole_device_answers_its_own_unit_alone() -> None:
    bus, master, server = pair()
    for unit in (1, 4, 6, 247):
        assert isinstance(master.get(unit, READ), NoReply)
    send(bus, encode_rtu(255, READ.encode()))
    send(bus, encode_rtu(0, READ.encode()))
    assert server.sent == []
    assert isinstance(master.get(5, READ), ReadHoldingRegisters.Reply)


def test_several_units_share_one_port() -> None:
    one, other = Device(holding_registers=10), Device(holding_registers=10)
    other.holding_registers[0] = 7
    _, master, _ = pair({1: one, 7: other})
    assert master.get(1, READ).registers == [0, 0]  # type: ignore[attr-defined]
    assert master.get(7, READ).registers == [7, 0]  # type: ignore[attr-defined]


# Broadcasts.


@pytest.mark.clause("S2")
def test_broadcast_is_executed_by_every_unit_and_answered_by_none() -> None:
    one, other = Device(holding_registers=10), Device(holding_registers=10)
    bus, _, server = pair({1: one, 7: other})
    send(bus, encode_rtu(0, WriteSingleRegister(0, 9).encode()))
    assert one.holding_registers[0] == other.holding_registers[0] == 9
    assert server.sent == []
    assert server.diagnostics.counters.bus_message_count == 1
    for unit in (1, 7):
        own = DiagnosticCounters(bus_message_count=1, server_message_count=1, server_no_response_count=1)
        assert server.diagnostics.of(unit).counters == own
        assert server.diagnostics.of(unit).event_count == 1


@pytest.mark.clause("S2")
def test_device_with_several_units_executes_a_broadcast_once() -> None:
    shared, other = Device(holding_registers=10), Device(holding_registers=10)
    written: list[object] = []
    shared.on_write("holding_registers")(written.append)
    other.on_write("holding_registers")(written.append)
    bus, master, server = pair({1: shared, 2: shared, 7: other, 9: shared})
    send(bus, encode_rtu(0, WriteSingleRegister(0, 9).encode()))
    assert len(written) == 2
    assert shared.holding_registers[0] == other.holding_registers[0] == 9
    # The message is every unit's; the success is that of the unit as which the device has executed it.
    assert [server.diagnostics.of(unit).event_count for unit in (1, 2, 7, 9)] == [1, 0, 1, 0]
    assert [server.diagnostics.of(unit).counters.server_message_count for unit in (1, 2, 7, 9)] == [1, 1, 1, 1]
    assert isinstance(master.get(9, WriteSingleRegister(0, 8)), Message)
    assert len(written) == 3


@pytest.mark.clause("S16")
def test_broadcast_that_fails_on_some_units_is_an_error_of_theirs_alone() -> None:
    bus, _, server = pair({1: Device(holding_registers=10), 2: Device(holding_registers=5), 3: Device(coils=1)})
    send(bus, encode_rtu(0, WriteSingleRegister(7, 9).encode()))
    units = [server.diagnostics.of(unit) for unit in (1, 2, 3)]
    assert [one.counters.bus_exception_error_count for one in units] == [0, 1, 1]
    assert [one.event_count for one in units] == [1, 0, 0]
    assert server.diagnostics.counters.bus_message_count == 1


@pytest.mark.clause("S2")
@pytest.mark.clause("S16")
@pytest.mark.parametrize(
    "pdu",
    [READ.encode(), b"\x41\x00", ForceListenOnly().encode(), b"\x06\x00\x00\x00", WriteSingleRegister(77, 1).encode()],
)
def test_broadcast_that_reads_or_is_in_error_is_only_counted(pdu: bytes) -> None:
    bus, _, server = pair()
    send(bus, encode_rtu(0, pdu))
    assert server.sent == []
    assert not server.diagnostics.listen_only
    counters = server.diagnostics.counters
    assert (counters.server_message_count, counters.server_no_response_count) == (1, 1)
    assert counters.bus_exception_error_count == 1


# Counters, event log, listen-only mode.


@pytest.mark.clause("S16")
def test_server_that_takes_no_more_answers_the_last_request_and_neither_reads_nor_executes_others() -> None:
    bus, _, server, handler = handled(LATER)
    send(bus, encode_rtu(5, READ.encode()))
    server.session.take_no_more()
    handler.contexts[0].reply(ReadHoldingRegisters.Reply(bytes(4)))
    bus.run(0.1)
    assert bus.line.transmissions()[-1].data == encode_rtu(5, REPLY)
    send(bus, encode_rtu(5, READ.encode()))
    send(bus, encode_rtu(0, WriteSingleRegister(0, 9).encode()))
    assert len(handler.contexts) == 1
    assert server.session.requests == 1


def test_counters_are_counted_as_in_the_flow_chart_and_read_by_function_08() -> None:
    bus, master, server = pair({5: Device(holding_registers=10)})
    send(bus, encode_rtu(5, READ.encode())[:-1] + b"\x00")  # 2: bad CRC
    send(bus, b"\x05\x03")  # 2: too short
    send(bus, encode_rtu(6, READ.encode()))  # 1
    send(bus, encode_rtu(6, REPLY))  # 1
    send(bus, encode_rtu(0, WriteSingleRegister(0, 1).encode()))  # 1, 4, 5
    send(bus, encode_rtu(5, b"\x41\x00"))  # 1, 4, 3: unknown function
    send(bus, encode_rtu(5, ReadHoldingRegisters(70, 2).encode()))  # 1, 4, 3: no such address
    counters = server.diagnostics.counters
    assert (counters.bus_message_count, counters.bus_communication_error_count) == (5, 2)
    assert (counters.bus_exception_error_count, counters.server_message_count) == (2, 3)
    assert counters.server_no_response_count == 1
    read = [
        value_of(master.get(5, request))
        for request in (
            ReturnBusMessageCount(),
            ReturnBusCommunicationErrorCount(),
            ReturnBusExceptionErrorCount(),
            ReturnServerMessageCount(),
            ReturnServerNoResponseCount(),
        )
    ]
    # Each of these is a message by itself. What our master says is heard by the servers alone.
    assert read == [6, 2, 2, 7, 1]
    assert isinstance(master.get(5, ClearCounters()), Message)
    assert value_of(master.get(5, ReturnBusMessageCount())) == 1


@pytest.mark.clause("S16")
@pytest.mark.parametrize(("code", "request_"), [(6, ReturnServerBusyCount()), (7, ReturnServerNakCount())])
def test_busy_and_nak_have_counters_of_their_own(code: int, request_: Request) -> None:
    _, master, server, _ = handled(Refusal(code))
    master.get(5, READ)
    counters = server.diagnostics.counters
    assert (counters.server_busy_count, counters.server_nak_count) == ((1, 0) if code == 6 else (0, 1))
    assert counters.bus_exception_error_count == 0


@pytest.mark.clause("S14")
@pytest.mark.clause("S16")
def test_marked_characters_and_overruns_are_communication_errors_and_discard_the_frame() -> None:
    bus, master, server = pair()
    server.session.receive_damaged(encode_rtu(5, WriteSingleRegister(0, 1).encode()), bus.now)
    server.session.tick(bus.now + 0.1)
    server.session.receive_damaged(b"\x05\x03", bus.now + 0.2, overrun=True)
    server.session.tick(bus.now + 0.3)
    counters = server.diagnostics.counters
    assert (counters.bus_communication_error_count, counters.bus_character_overrun_count) == (2, 1)
    assert server.session.requests == 0
    bus.run(1.0)
    assert isinstance(master.get(5, READ), Message)


@pytest.mark.clause("A23")
def test_event_counter_counts_successes_and_neither_exceptions_nor_polls_of_itself() -> None:
    _, master, _ = pair()
    for _ in range(3):
        master.get(5, READ)
    master.get(5, ReadHoldingRegisters(70, 2))
    for _ in range(2):
        master.get(5, GetCommEventCounter())
    reply = master.get(5, GetCommEventCounter())
    assert isinstance(reply, GetCommEventCounter.Reply)
    assert (reply.status, reply.event_count) == (0, 3)


@pytest.mark.clause("A23")
def test_status_is_ffff_while_a_program_command_runs() -> None:
    _, master, server = pair()
    server.diagnostics.of(5).program_command_running = True
    reply = master.get(5, GetCommEventCounter())
    assert isinstance(reply, GetCommEventCounter.Reply)
    assert reply.status == 0xFFFF


@pytest.mark.clause("A23")
def test_event_log_tells_what_happened_newest_first() -> None:
    bus, master, server = pair()
    send(bus, encode_rtu(5, READ.encode())[:-1] + b"\x00")
    send(bus, encode_rtu(0, WriteSingleRegister(0, 1).encode()))
    master.get(5, ReadHoldingRegisters(70, 2))
    master.get(5, READ)
    reply = master.get(5, GetCommEventLog())
    assert isinstance(reply, GetCommEventLog.Reply)
    # this request; answer and request of the read; exception 02 and its request; broadcast, done with without an
    # answer; communication error
    assert bytes(reply.events) == bytes.fromhex("80 40 80 41 80 40 c0 82")
    assert reply.message_count == 4
    for _ in range(40):
        master.get(5, READ)
    assert len(server.diagnostics.of(5).event_log()[3]) == 64


@pytest.mark.clause("S17")
@pytest.mark.clause("A23")
def test_listen_only_mode_mutes_until_a_restart_that_is_not_answered_either() -> None:
    device = Device(holding_registers=10)
    bus, master, server = pair({5: device})
    assert isinstance(master.get(5, ForceListenOnly()), Exception)
    assert server.diagnostics.listen_only
    for request in (READ, WriteSingleRegister(0, 3), ReturnQueryData(b"\x00\x00")):
        assert isinstance(master.get(5, request, timeout=0.1), Exception)
        master.session.breakers.answered(5)
    assert server.sent == []
    assert device.holding_registers[0] == 0
    assert server.diagnostics.of(5).event_log()[3][:6].hex(" ") == "60 a0 60 a0 60 a0"
    bus.run(1.0)
    assert isinstance(master.get(5, RestartCommunications(), timeout=0.1), Exception)
    assert server.sent == []
    assert not server.diagnostics.listen_only
    bus.run(1.0)
    markers = master.session.counters.markers
    assert isinstance(master.get(5, READ), Message)
    assert server.diagnostics.of(5).counters.bus_message_count == 1 + master.session.counters.markers - markers


@pytest.mark.clause("S16")
@pytest.mark.clause("S17")
@pytest.mark.parametrize("framing", ["rtu", "ascii"])
def test_listen_only_mode_of_a_unit_leaves_the_other_units_of_its_line_alone(framing: str) -> None:
    one, other = Device(holding_registers=10), Device(holding_registers=10)
    encode = encode_rtu if framing == "rtu" else encode_ascii
    bus, master, server = pair({1: one, 3: other}, framing=framing)
    send(bus, encode(3, ForceListenOnly().encode()), 0.1)
    assert server.diagnostics.listen_only_units == {3}
    assert isinstance(master.get(1, READ), Message)
    send(bus, encode(3, READ.encode()), 0.1)
    send(bus, encode(0, WriteSingleRegister(0, 9).encode()), 0.1)
    assert (one.holding_registers[0], other.holding_registers[0]) == (9, 0), "nor does it execute a broadcast"
    send(bus, encode(3, RestartCommunications().encode()), 0.1)
    assert [frame[:3] for _, frame in server.sent] == [encode(1, REPLY)[:3]]
    assert isinstance(master.get(3, READ), Message)
    assert value_of(master.get(1, ReturnServerMessageCount())) == 3


@pytest.mark.clause("S16")
def test_units_of_a_line_count_what_is_theirs_and_hear_the_same() -> None:
    bus, master, server = pair({1: Device(holding_registers=10), 3: Device(holding_registers=10)})
    send(bus, encode_rtu(9, READ.encode())[:-1] + b"\x00")  # damaged, for all units
    master.get(1, READ)
    master.get(1, ReadHoldingRegisters(70, 2))
    send(bus, encode_rtu(0, WriteSingleRegister(0, 1).encode()))
    master.get(3, READ)
    first, third = server.diagnostics.of(1), server.diagnostics.of(3)
    assert first.counters == DiagnosticCounters(4, 1, 1, 3, 1, 0, 0, 0)
    assert third.counters == DiagnosticCounters(4, 1, 0, 2, 1, 0, 0, 0)
    assert (first.event_count, third.event_count) == (2, 2)
    assert first.event_log()[3].hex(" ") == "40 c0 41 80 40 80 82"
    assert third.event_log()[3].hex(" ") == "40 80 40 c0 82"
    assert isinstance(master.get(3, ClearCounters()), Message)
    assert third.counters == DiagnosticCounters()
    assert value_of(master.get(1, ReturnBusMessageCount())) == 6
    assert value_of(master.get(1, ReturnBusExceptionErrorCount())) == 1
    assert value_of(master.get(1, ReturnBusCommunicationErrorCount())) == 1
    assert value_of(master.get(3, ReturnBusMessageCount())) == 4
    assert value_of(master.get(3, ReturnBusCommunicationErrorCount())) == 0


@pytest.mark.clause("S17")
@pytest.mark.parametrize(("data", "left"), [(b"\x00\x00", True), (b"\xff\x00", False)])
def test_restart_is_answered_first_and_clears_counters_and_the_log_where_it_is_told_to(data: bytes, left: bool) -> None:
    _, master, server = pair()
    master.get(5, READ)
    assert isinstance(master.get(5, RestartCommunications(data)), Message)
    assert server.diagnostics.of(5).counters.bus_message_count == 0
    assert (len(server.diagnostics.of(5).event_log()[3]) > 1) is left
    assert server.diagnostics.of(5).event_log()[3][0] == 0x00


@pytest.mark.clause("S12")
@pytest.mark.clause("S17")
def test_delimiter_is_changed_for_all_that_comes_after_the_answer() -> None:
    bus, master, server = pair(framing="ascii")
    assert isinstance(master.get(5, ChangeAsciiDelimiter(b"\x3f\x00")), Message)
    assert server.sent[-1][1].endswith(b"\r\n")
    assert isinstance(master.get(5, READ), NoReply)
    send(bus, encode_ascii(5, READ.encode(), ord("?")))
    assert server.sent[-1][1] == encode_ascii(5, REPLY, ord("?"))


def test_two_ends_may_agree_on_a_delimiter_from_the_start() -> None:
    bus = Bus(framing="ascii")
    framing = FramingParameters(delimiter=ord("?"))
    master, server = bus.master(framing=framing), bus.servers({5: Device(holding_registers=10)}, framing=framing)
    server.diagnostics.ascii_delimiter = framing.delimiter
    assert isinstance(master.get(5, READ), Message)
    assert isinstance(master.get(5, ReturnQueryData(b"\x00\x01")), Message)
    assert isinstance(master.get(5, READ), Message)


@pytest.mark.clause("S8")
@pytest.mark.parametrize("framing", ["rtu", "ascii"])
@pytest.mark.parametrize("pdu", [b"\x41\x01\x02\x03", b"\x10\x00\x00\x00\x02\x09\x00\x01\x00\x02", b"\x03\x00\x00"])
def test_unknown_function_and_contradicting_length_are_answered(framing: str, pdu: bytes) -> None:
    encode = encode_rtu if framing == "rtu" else encode_ascii
    bus, _, server = pair(framing=framing)
    send(bus, encode(5, pdu))
    code = 1 if pdu[0] == 0x41 else 3
    assert [frame for _, frame in server.sent] == [encode(5, bytes((pdu[0] | 0x80, code)))]


def test_exception_status_and_echo_of_data_are_answered() -> None:
    _, master, _ = pair()
    assert isinstance(master.get(5, ReadExceptionStatus()), Message)
    reply = master.get(5, ReturnQueryData(b"\x12\x34\x56\x78"))
    assert isinstance(reply, Message)
    assert reply.values()["data"] == b"\x12\x34\x56\x78"


# Slow handlers.


@pytest.mark.clause("S6")
def test_late_answer_leaves_when_it_is_there() -> None:
    bus, master, server, handler = handled(LATER)
    question = master.ask(5, READ)
    bus.run(0.1)
    assert server.session.waiting == 1
    handler.contexts[0].reply(ReadHoldingRegisters.Reply(bytes(4)))
    bus.run(until=lambda: question.done)
    assert isinstance(question.outcome, Message)


@pytest.mark.clause("S1")
def test_late_answer_is_given_up_when_another_station_has_sent() -> None:
    bus, master, server, handler = handled(LATER)
    question = master.ask(5, READ)
    bus.run(0.1)
    send(bus, encode_rtu(9, READ.encode()), 0.0)
    handler.contexts[0].reply(ReadHoldingRegisters.Reply(bytes(4)))
    bus.run(until=lambda: question.done)
    assert server.sent == []
    assert server.session.abandoned == 1
    assert server.diagnostics.counters.server_no_response_count == 1


@pytest.mark.clause("S1")
@pytest.mark.clause("S16")
@pytest.mark.parametrize("apart", [0.0, T3_5 / 2])
def test_of_two_requests_back_to_back_both_are_executed_and_the_last_is_answered(apart: float) -> None:
    device = Device(holding_registers=10)
    bus, _, server = pair({5: device})
    write, refused = (
        encode_rtu(5, WriteSingleRegister(0, 9).encode()),
        encode_rtu(5, WriteSingleRegister(99, 1).encode()),
    )
    last = encode_rtu(5, WriteSingleRegister(1, 8).encode())
    begins = bus.now + 0.01
    for frame in (write, refused, last):
        bus.line.inject(frame, begins)
        begins += len(frame) * bus.line.character_time + apart
    bus.run(0.5)
    assert device.holding_registers[:2] == [9, 8]
    assert [frame for _, frame in server.sent] == [last], "a write is answered by its echo"
    assert server.session.abandoned == 2
    own = server.diagnostics.of(5)
    assert own.counters == DiagnosticCounters(3, 0, 1, 3, 2, 0, 0, 0)
    assert (own.event_count, own.event_log()[3].hex(" ")) == (1, "40 80 40 80 40 80")


@pytest.mark.clause("A23")
def test_answer_that_the_port_does_not_take_is_a_write_timeout_and_none_that_was_sent() -> None:
    bus, _, server = pair({5: Device(holding_registers=10)})
    server.port_has_gone = True
    send(bus, encode_rtu(5, READ.encode()))
    own = server.diagnostics.of(5)
    assert (own.counters.server_no_response_count, own.event_count) == (1, 0)
    assert own.event_log()[3].hex(" ") == "50 80"


def test_answer_given_before_the_handler_returns_is_sent_once() -> None:
    class AtOnce(Handling):
        def answer(self, context: RequestContext, request: AnyRequest) -> ResponderAnswer:
            context.reply(ReadHoldingRegisters.Reply(bytes(4)))
            return LATER

    bus = Bus(3)
    master = bus.master()
    handler = AtOnce(LATER)
    server = bus.servers(responder=handler)
    assert isinstance(master.get(5, READ), Message)
    bus.run(1.0)
    assert len(server.sent) == 1
    assert server.session.waiting == 0


def test_awaitable_is_handed_to_the_driver() -> None:
    async def reply() -> Message:
        return ReadHoldingRegisters.Reply(bytes(4))

    bus, master, server, _ = handled(reply())
    question = master.ask(5, READ)
    bus.run(0.1)
    (deferred,) = server.session.deferred
    deferred.context.reply(asyncio.run(deferred.awaitable))  # type: ignore[arg-type]
    bus.run(until=lambda: question.done)
    assert isinstance(question.outcome, Message)


def test_silence_of_a_handler_is_counted() -> None:
    _, master, server, _ = handled(SILENCE)
    assert isinstance(master.get(5, READ), NoReply)
    assert server.diagnostics.counters.server_no_response_count == 1
    assert server.session.waiting == 0


def test_handler_that_fails_is_reported_and_answered_04() -> None:
    _, master, server, _ = handled(RuntimeError("broken"))
    assert getattr(master.get(5, READ), "code", None) == 4
    assert len(server.session.failures) == 1


def test_request_in_work_gets_no_answer_when_the_port_has_gone() -> None:
    bus, master, server, handler = handled(LATER)
    master.ask(5, READ)
    bus.run(0.1)
    server.session.close()
    handler.contexts[0].reply(ReadHoldingRegisters.Reply(bytes(4)))
    bus.run(1.0)
    assert server.sent == []


@pytest.mark.clause("S15")
def test_own_echo_is_no_message_of_the_line() -> None:
    bus = Bus(echo=True)
    master, server = bus.master(echo=Echo.ON), bus.servers({5: Device(holding_registers=10)}, echo=Echo.ON)
    for _ in range(3):
        master.get(5, READ)
    assert server.diagnostics.counters.bus_message_count == 3
    assert server.session.foreign == 0

"""Client and server talking to each other without a network: every function, and one of the user's own."""

from typing import Any

import pytest
from conversations import ClientWire
from examples import examples
from hypothesis import given, settings
from message_strategies import any_request

from busway.codes import Table
from busway.errors import ExceptionReply, ModbusError
from busway.pdu.device_interface import Context, DataModel
from busway.pdu.fields import rest, rest_length, u8
from busway.pdu.functions import STANDARD, FunctionTable
from busway.pdu.message import Message, ReplyMessage, Request
from busway.server.device import Device
from busway.server.device_responder import DeviceResponder
from busway.session.diagnostic_counters import LineDiagnostics
from busway.session.server_pipeline import RequestPipeline
from busway.session.server_transaction_slots import ServerTransactionSlots
from busway.session.tcp_server import TcpServerSession


class ReadPressure(Request):  # ten lines, from here …
    """65 Read Pressure: ``count`` sensors from ``sensor`` on."""

    code = 0x41
    sensor: int = u8(0, 15)
    count: int = u8(1, 16, default=1)

    class Reply(ReplyMessage):
        """The pressures, big-endian."""

        byte_count = rest_length(1, 2, 32, 2)
        data: bytes = rest(2, 32, 2)

    def apply(self, model: DataModel, context: Context) -> Message:
        model.check(Table.INPUT_REGISTERS, self.sensor, self.count, False)
        return self.Reply(model.read(Table.INPUT_REGISTERS, self.sensor, self.count, context))  # … to here


def device() -> Device:
    return Device(
        holding_registers=500,
        input_registers=list(range(500)),
        coils=500,
        discrete_inputs=500,
        files={1: 100},
        fifos={7: [1, 2, 3]},
        canopen=lambda data: data[::-1],
    )


def exchange(request: Request, functions: FunctionTable = STANDARD) -> Message | ModbusError:
    """What the client makes of what the server says."""
    wire = ClientWire()
    late: list[bytes] = []
    server = TcpServerSession(
        RequestPipeline(DeviceResponder({1: device()}, functions=functions)),
        diagnostics=LineDiagnostics(changes_allowed=True),
        slots=ServerTransactionSlots(1),
        deliver=late.append,
    )
    call = wire.ask(request)
    for adu in wire.session.transmit(wire.now):
        for answer in server.receive(adu, len(adu)):
            wire.feed(answer)
    assert not late
    assert not server.failures
    if call.outcomes[0] is None:
        wire.wait(1.0)
    outcome = call.outcomes[0]
    assert outcome is not None
    return outcome


@given(any_request())
@settings(max_examples=examples(300))
def test_whatever_is_asked_the_client_gets_the_functions_reply_or_the_devices_exception(request: Request) -> None:
    outcome = exchange(request)
    if isinstance(outcome, Message):
        assert type(outcome) is request.Reply
        assert request.check_reply(outcome) is None
    elif (request.code, request.sub_code) == (8, 4):
        assert not isinstance(outcome, ExceptionReply), "listen-only mode begins without an answer"
    else:
        assert isinstance(outcome, ExceptionReply), outcome
        assert outcome.code in (1, 2, 3)


@pytest.mark.clause("A8")
def test_a_function_of_the_users_own_is_used_by_client_and_server_alike() -> None:
    mine = STANDARD.with_functions(ReadPressure)
    reply: Any = exchange(ReadPressure(3, 2), mine)
    assert reply.data == b"\x00\x03\x00\x04"


@pytest.mark.clause("A8")
def test_the_same_function_is_answered_01_where_its_table_does_not_have_it() -> None:
    outcome = exchange(ReadPressure(3, 2))
    assert isinstance(outcome, ExceptionReply)
    assert (outcome.code, outcome.function) == (1, 0x41)

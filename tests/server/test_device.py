"""A device as requests see it: what it refuses, what it offers directly, and that both paths answer alike."""

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.codes import ExceptionCode, Table
from busway.errors import ConfigError
from busway.pdu.device_interface import Refusal
from busway.pdu.diagnostics import ReadExceptionStatus, ReportServerId
from busway.pdu.encapsulated import CanopenGeneralReference, ReadDeviceIdentification
from busway.pdu.exception_response import ExceptionResponse
from busway.pdu.functions import STANDARD
from busway.pdu.message import Message, Request
from busway.pdu.read_items import ReadCoils, ReadDiscreteInputs, ReadHoldingRegisters, ReadInputRegisters
from busway.pdu.write_items import (
    MaskWriteRegister,
    ReadWriteMultipleRegisters,
    WriteMultipleCoils,
    WriteMultipleRegisters,
    WriteSingleCoil,
    WriteSingleRegister,
)
from busway.server.device import Device
from busway.server.table_declaration import Cells
from busway.session.diagnostic_counters import CommunicationState
from busway.session.responder import ClientIdentity, RequestContext

TABLES = tuple(table.value for table in Table)


def execute(device: Device, request: Request) -> Message:
    """Execute a request as a server does."""
    with device.lock:
        return request.apply(device, RequestContext(unit=1, function=request.code, diagnostics=CommunicationState()))


def refusal_of(device: Device, request: Request) -> int:
    """The exception code that a request is refused with."""
    with pytest.raises(Refusal) as caught:
        execute(device, request)
    return caught.value.code


@pytest.mark.parametrize(
    "request_",
    [
        ReadCoils(0, 1),
        ReadDiscreteInputs(0, 1),
        ReadHoldingRegisters(0, 1),
        ReadInputRegisters(0, 1),
        WriteSingleCoil(0, 0),
        WriteSingleRegister(0, 0),
        WriteMultipleCoils.of(0, [True]),
        WriteMultipleRegisters.of(0, [1]),
        MaskWriteRegister(0, 0, 0),
        ReadWriteMultipleRegisters.of(0, 1, 0, [1]),
    ],
)
def test_every_access_to_an_absent_table_is_refused_with_02(request_: Request) -> None:
    assert refusal_of(Device(), request_) == ExceptionCode.ILLEGAL_DATA_ADDRESS


@pytest.mark.parametrize(
    "request_",
    [
        ReadHoldingRegisters(4, 1),
        ReadHoldingRegisters(6, 2),
        ReadHoldingRegisters(5, 5),
        WriteSingleRegister(7, 1),
        WriteMultipleRegisters.of(6, [1, 1]),
        ReadWriteMultipleRegisters.of(7, 1, 5, [1]),
        ReadWriteMultipleRegisters.of(5, 1, 7, [1]),
    ],
)
def test_holes_of_a_sparse_table_are_refused_and_nothing_changes(request_: Request) -> None:
    device = Device(holding_registers={5: [1, 2], 9: 3})
    assert refusal_of(device, request_) == ExceptionCode.ILLEGAL_DATA_ADDRESS
    assert list(device.holding_registers) == [1, 2, 3]


@pytest.mark.parametrize(
    "request_",
    [
        WriteSingleRegister(2, 9),
        WriteMultipleRegisters.of(1, [9, 9]),
        WriteMultipleRegisters.of(3, [9, 9]),
        MaskWriteRegister(3, 0, 9),
        ReadWriteMultipleRegisters.of(0, 1, 2, [9]),
        WriteSingleCoil(0, 0xFF00),
        WriteMultipleCoils.of(0, [True, True]),
    ],
)
def test_read_only_items_are_refused_with_02_and_nothing_changes(request_: Request) -> None:
    device = Device(
        holding_registers=Cells(values=[1, 2, 3, 4, 5], read_only=[(2, 2)]), coils=Cells(count=2, read_only=[(0, 1)])
    )
    assert refusal_of(device, request_) == ExceptionCode.ILLEGAL_DATA_ADDRESS
    assert (*device.holding_registers, *device.coils) == (1, 2, 3, 4, 5, False, False)
    execute(device, WriteSingleRegister(4, 9))
    execute(device, ReadWriteMultipleRegisters.of(2, 2, 0, [9]))
    assert list(device.holding_registers) == [9, 2, 3, 4, 9]


def test_reading_and_writing_in_one_request_reads_what_it_wrote() -> None:
    device = Device(holding_registers=[1, 2, 3])
    reply = execute(device, ReadWriteMultipleRegisters.of(0, 3, 1, [8, 9]))
    assert reply.encode() == bytes.fromhex("17 06 00 01 00 08 00 09")


def test_a_mask_write_is_one_step_under_the_lock() -> None:
    device = Device(holding_registers=[0x12])
    execute(device, MaskWriteRegister(0, 0xF2, 0x25))
    assert device.holding_registers[0] == 0x17


def test_a_device_says_what_it_is() -> None:
    device = Device(identification={1: "P-1"}, server_id=b"\x2a\xff", exception_status=0x6D)
    assert execute(device, ReportServerId()).encode() == bytes.fromhex("11 02 2A FF")
    assert execute(device, ReadExceptionStatus()).encode() == bytes.fromhex("07 6D")
    reply: Any = execute(device, ReadDeviceIdentification(4, 1))
    assert reply.objects[0].value == b"P-1"


def test_what_a_device_says_of_itself_can_be_replaced() -> None:
    device = Device()
    device.set_identification({5: "model"})
    device.set_server_id(b"\x01\x00")
    device.set_exception_status(lambda: 3)
    assert device.identification()[5] == b"model"
    assert sorted(device.identification()) == [0, 1, 2, 5]
    assert (device.server_id(), device.exception_status()) == (b"\x01\x00", 3)


def test_a_canopen_reference_needs_something_that_answers_it() -> None:
    request = CanopenGeneralReference(b"\x01\x02")
    assert refusal_of(Device(), request) == ExceptionCode.ILLEGAL_FUNCTION
    reply = execute(Device(canopen=lambda data: data[::-1]), request)
    assert reply.encode() == bytes.fromhex("2B 0D 02 01")


def test_all_functions_are_enabled_unless_some_are_listed() -> None:
    device = Device()
    assert device.functions is None
    assert device.enabled(3)
    assert device.enabled(100)
    device = Device(functions=[3, 16])
    assert device.enabled(3)
    assert not device.enabled(4)
    device.functions = {4}
    assert device.enabled(4)
    assert not device.enabled(3)
    assert device.functions == {4}
    for wrong in ({0}, {128}, {"3"}, {True}):
        with pytest.raises(ConfigError, match="function code"):
            device.functions = wrong


def test_a_dense_table_without_hooks_is_offered_as_a_block() -> None:
    device = Device(holding_registers=Cells(first=100, count=10), coils=20)
    for table, first, count in ((Table.HOLDING_REGISTERS, 100, 10), (Table.COILS, 0, 20)):
        for writes in (False, True):
            block = device.plain_block(table, writes=writes)
            assert block is not None
            assert (block.first, block.count) == (first, count)


@pytest.mark.parametrize(
    ("device", "reads", "writes"),
    [
        (Device(), False, False),
        (Device(coils={0: 1, 5: 1}), False, False),
        (Device(coils=Cells(count=5, read_only=[(1, 1)])), True, False),
    ],
)
def test_holes_and_read_only_ranges_are_for_the_generic_path(device: Device, reads: bool, writes: bool) -> None:
    assert (device.plain_block(Table.COILS, writes=False) is not None) is reads
    assert (device.plain_block(Table.COILS, writes=True) is not None) is writes


@pytest.mark.parametrize("direction", ["on_read", "on_write"])
def test_a_hook_ends_the_offer_of_its_direction_and_removing_it_brings_it_back(direction: str) -> None:
    device = Device(coils=5, holding_registers=5)
    hooks: Callable[..., Any] = getattr(device, direction)
    writes = direction == "on_write"
    before = device.generation
    function = hooks("coils", print)
    assert device.generation > before
    assert device.plain_block(Table.COILS, writes=writes) is None
    assert device.plain_block(Table.COILS, writes=not writes) is not None
    assert device.plain_block(Table.HOLDING_REGISTERS, writes=writes) is not None
    before = device.generation
    device.remove_hook(function)
    assert device.generation > before
    assert device.plain_block(Table.COILS, writes=writes) is not None


def test_a_change_of_the_enabled_functions_ends_every_offer() -> None:
    device = Device(coils=5)
    before = device.generation
    device.functions = [1]
    assert device.generation > before


def test_a_block_stays_right_when_a_group_replaces_what_it_holds() -> None:
    device = Device(holding_registers=2)
    answer = ReadHoldingRegisters.direct(device)
    assert answer is not None
    with device.update():
        device.holding_registers[0:2] = [1, 2]
    assert answer(ReadHoldingRegisters(0, 2).encode(), 0, 5, ClientIdentity()) == bytes.fromhex("03 04 00 01 00 02")


def devices() -> list[Device]:
    """Two of each: one for each path, so that writes are compared too."""
    return [
        Device(
            holding_registers=Cells(first=3, values=list(range(40))),
            input_registers=range(30),
            coils=Cells(first=5, values=[1, 0, 0, 1, 1] * 9),
            discrete_inputs=[0, 1, 1] * 11,
        )
        for _ in range(2)
    ]


def tables_of(device: Device) -> list[list[int]]:
    """All that a device holds in its tables."""
    return [list(getattr(device, table)) for table in TABLES]


numbers = st.one_of(
    st.integers(0, 60), st.sampled_from([0, 0xFF00, 0xFFFF, 125, 126, 2000, 2001]), st.integers(0, 0xFFFF)
)
words = numbers.map(lambda number: number.to_bytes(2, "big"))
plain_requests = st.tuples(st.integers(1, 6).map(lambda code: bytes((code,))), words, words).map(b"".join)


@st.composite
def long_requests(draw: st.DrawFn) -> bytes:
    """15 and 16, mostly with a byte count that fits."""
    code = draw(st.sampled_from([15, 16]))
    count = draw(st.one_of(st.integers(0, 50), numbers))
    length = (count + 7) // 8 if code == 15 else 2 * count
    length = min(255, draw(st.one_of(st.just(length), st.integers(0, 255))))
    data = draw(st.binary(min_size=min(length, 246), max_size=min(length, 246)))
    return bytes((code,)) + draw(words) + count.to_bytes(2, "big") + bytes((length,)) + data


@st.composite
def exchanges(draw: st.DrawFn) -> bytes:
    """22 and 23, whose byte count fits."""
    if draw(st.booleans()):
        return b"\x16" + draw(words) + draw(words) + draw(words)
    count = draw(st.integers(0, 60))
    data = draw(st.binary(min_size=2 * count, max_size=2 * count))
    return b"\x17" + draw(words) + draw(words) + draw(words) + count.to_bytes(2, "big") + bytes((2 * count,)) + data


pdus = st.one_of(
    plain_requests,
    long_requests(),
    exchanges(),
    st.tuples(plain_requests, st.binary(max_size=3)).map(b"".join),
    st.tuples(st.sampled_from([1, 2, 3, 4, 5, 6, 15, 16, 22, 23]), st.binary(max_size=12)).map(
        lambda parts: bytes((parts[0],)) + parts[1]
    ),
)


@given(st.lists(pdus, min_size=1, max_size=6))
def test_the_fast_path_answers_as_the_generic_path_does(requests: list[bytes]) -> None:
    by_generic_path, by_fast_path = devices()
    answers = {kind.code: kind.direct(by_fast_path) for kind in STANDARD}
    for pdu in requests:
        expected = generic_path(by_generic_path, pdu)
        answer = answers[pdu[0]]
        assert answer is not None
        # The PDU stands somewhere in a receive buffer.
        got = answer(b"\xaa\xaa" + pdu + b"\xaa", 2, 2 + len(pdu), ClientIdentity())
        if got is None:
            # What the fast path leaves is refused, or is a form that only the generic path judges.
            assert generic_path(by_fast_path, pdu) == expected
        else:
            assert got == expected
        assert tables_of(by_fast_path) == tables_of(by_generic_path)


@pytest.mark.parametrize(
    "pdu",
    [
        "01 00 05 00 2D",
        "02 00 03 00 05",
        "03 00 03 00 28",
        "04 00 00 00 1E",
        "05 00 31 FF 00",
        "06 00 2A 12 34",
        "0F 00 06 00 09 02 FF 01",
        "10 00 29 00 02 04 00 01 00 02",
        "16 00 2A 00 F2 00 25",
        "17 00 03 00 06 00 04 00 02 04 00 FF 00 FE",
    ],
)
def test_the_fast_path_takes_what_is_plainly_right(pdu: str) -> None:
    by_generic_path, by_fast_path = devices()
    wire = bytes.fromhex(pdu)
    answers = {kind.code: kind.direct(by_fast_path) for kind in STANDARD}
    answer = answers[wire[0]]
    assert answer is not None
    got = answer(wire, 0, len(wire), ClientIdentity())
    assert got is not None
    assert got == generic_path(by_generic_path, wire)
    assert tables_of(by_fast_path) == tables_of(by_generic_path)


def generic_path(device: Device, pdu: bytes) -> bytes:
    """The answer of decode, execute, encode."""
    request = STANDARD.decode_request(pdu)
    if not isinstance(request, Request):
        return ExceptionResponse(request.function, request.code).encode()
    try:
        return execute(device, request).encode()
    except Refusal as refusal:
        return ExceptionResponse(request.code, refusal.code).encode()

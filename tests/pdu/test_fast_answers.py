"""The fast path: what it answers itself, what it leaves to the generic path, and that both say the same."""

from dataclasses import dataclass, field
from typing import Any

import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from message_strategies import messages
from recording_device import FakeContext

from busway.codes import Table
from busway.pdu.bits import slice_bits, splice_bits
from busway.pdu.device_interface import Refusal
from busway.pdu.exception_response import ExceptionResponse
from busway.pdu.functions import STANDARD
from busway.pdu.malformed_request import MalformedRequest
from busway.pdu.message import Request
from busway.pdu.read_items import ReadCoils, ReadDiscreteInputs, ReadHoldingRegisters, ReadInputRegisters
from busway.pdu.write_items import (
    MaskWriteRegister,
    ReadWriteMultipleRegisters,
    WriteMultipleCoils,
    WriteMultipleRegisters,
    WriteSingleCoil,
    WriteSingleRegister,
)
from busway.session.responder import ClientIdentity

DIRECT: tuple[Any, ...] = (
    ReadCoils,
    ReadDiscreteInputs,
    ReadHoldingRegisters,
    ReadInputRegisters,
    WriteSingleCoil,
    WriteSingleRegister,
    WriteMultipleCoils,
    WriteMultipleRegisters,
    MaskWriteRegister,
    ReadWriteMultipleRegisters,
)


@dataclass
class PlainBlock:
    """Items from ``first`` on, as `busway.pdu.fast_answers.Block` wants them."""

    first: int
    count: int
    holds_bits: bool
    data: bytearray = field(default_factory=bytearray)

    def __post_init__(self) -> None:
        size = (self.count + 7) // 8 if self.holds_bits else 2 * self.count
        self.data = bytearray((7 * position + 3) & 0xFF for position in range(size))
        if self.holds_bits and self.count % 8:
            self.data[-1] &= 0xFF >> 8 - self.count % 8

    def put(self, position: int, count: int, data: bytes) -> None:
        if self.holds_bits:
            splice_bits(self.data, position, count, data)
        else:
            self.data[2 * position : 2 * (position + count)] = data

    def mask(self, position: int, and_mask: int, or_mask: int) -> None:
        current = int.from_bytes(self.data[2 * position : 2 * position + 2], "big")
        self.put(position, 1, (current & and_mask | or_mask & ~and_mask & 0xFFFF).to_bytes(2, "big"))

    def put_then_get(self, position: int, count: int, data: bytes, start: int, size: int) -> bytes:
        self.put(position, count, data)
        return bytes(self.data[2 * start : 2 * (start + size)])


class DecliningBlock(PlainBlock):
    """A block that looks at what is written, and leaves it to the generic path."""

    def put(self, position: int, count: int, data: bytes) -> bool:
        return True


class PlainDevice:
    """Four plain blocks, by both paths."""

    def __init__(self, first: int = 0, count: int = 300) -> None:
        self.blocks = {table: PlainBlock(first, count, table.holds_bits) for table in Table}

    def plain_block(self, table: Table, *, writes: bool) -> PlainBlock | None:
        return self.blocks[table]

    def check(self, table: Table, address: int, count: int, writes: bool, context: object = None) -> None:
        block = self.blocks[table]
        if address < block.first or address + count > block.first + block.count:
            raise Refusal(2)

    def read(self, table: Table, address: int, count: int, context: object) -> bytes:
        block = self.blocks[table]
        position = address - block.first
        if table.holds_bits:
            return slice_bits(block.data, position, count)
        return bytes(block.data[2 * position : 2 * (position + count)])

    def write(self, table: Table, address: int, count: int, data: bytes, context: object) -> None:
        self.blocks[table].put(address - self.blocks[table].first, count, data)

    @property
    def content(self) -> list[bytes]:
        return [bytes(block.data) for block in self.blocks.values()]


def generic_path(device: Any, pdu: bytes) -> bytes:
    """What a server says to ``pdu`` when it decodes it."""
    request = STANDARD.decode_request(pdu)
    if isinstance(request, MalformedRequest):
        return ExceptionResponse(pdu[0], request.code).encode()
    assert isinstance(request, Request)
    try:
        return request.apply(device, FakeContext()).encode()
    except Refusal as refusal:
        return ExceptionResponse(pdu[0], refusal.code).encode()


def expect_same(first: int, count: int, pdu: bytes) -> None:
    shorter, longer = PlainDevice(first, count), PlainDevice(first, count)
    before = shorter.content
    kind = STANDARD.find(pdu, 0, len(pdu))
    assert kind is not None
    answer = kind.direct(shorter)
    assert answer is not None
    # The PDU stands somewhere among other bytes.
    buffer = b"\xee" * 7 + pdu + b"\xdd" * 5
    said = answer(buffer, 7, 7 + len(pdu), ClientIdentity())
    expected = generic_path(longer, pdu)
    if said is None:
        assert shorter.content == before, "what is left to the generic path has changed nothing"
        return
    assert said == expected
    assert shorter.content == longer.content


@given(st.data())
@settings(max_examples=examples(400))
def test_both_paths_say_and_do_the_same_on_every_request(data: st.DataObject) -> None:
    first = data.draw(st.sampled_from((0, 0, 1, 5, 100)))
    count = data.draw(st.sampled_from((1, 7, 8, 9, 300, 3000)))
    wire = data.draw(st.sampled_from(DIRECT).flatmap(messages)).encode()
    if data.draw(st.booleans()):
        # bring it into the block, most of the time
        address = first + data.draw(st.integers(0, count))
        wire = wire[:1] + address.to_bytes(2, "big") + wire[3:]
    expect_same(first, count, wire)


@given(st.sampled_from(DIRECT).flatmap(lambda kind: st.tuples(st.just(kind), st.binary(min_size=0, max_size=16))))
@settings(max_examples=examples(400))
def test_both_paths_say_and_do_the_same_on_any_bytes(drawn: tuple[Any, bytes]) -> None:
    kind, rest = drawn
    expect_same(0, 300, bytes((kind.code,)) + rest)


@pytest.mark.parametrize(
    "pdu",
    [
        "03 0000 007D",  # 125: the most
        "03 012B 0001",  # the last register
        "01 0000 012C",  # all coils
        "01 0003 0009",  # across a byte
        "05 0001 FF00",
        "05 0001 0000",
        "06 012B 1234",
        "0F 0003 000A 02 FFFF",  # unused bits set
        "10 012A 0002 04 0001 0002",
        "16 012B 00F2 0025",
        "17 0000 007D 012A 0002 04 0001 0002",  # 125 registers read: the most
        "17 0004 0003 0005 0001 02 1234",  # what is written is read
    ],
)
def test_what_is_plainly_right_is_answered_at_once(pdu: str) -> None:
    wire = bytes.fromhex(pdu)
    kind = STANDARD.find(wire, 0, len(wire))
    assert kind is not None
    answer = kind.direct(PlainDevice())
    assert answer is not None
    assert answer(wire, 0, len(wire), ClientIdentity()) is not None
    expect_same(0, 300, wire)


@pytest.mark.parametrize(
    "pdu",
    [
        "03 0000 0000",
        "03 0000 007E",
        "03 012B 0002",
        "03 0000 01",
        "03 0000 0001 00",
        "05 0000 0100",
        "05 012C FF00",
        "06 012C 0000",
        "0F 0000 0009 01 FF",
        "0F 012B 0002 01 03",
        "10 0000 0002 02 0001",
        "10 0000 0001 02 00",
        "10 012B 0002 04 0001 0002",
        "16 012C 00F2 0025",
        "16 0000 00F2 00",
        "16 0000 00F2 0025 00",
        "17 0000 0000 0000 0001 02 1234",
        "17 0000 007E 0000 0001 02 1234",
        "17 0000 0001 0000 0000 00",
        "17 0000 0001 0000 0001 04 1234",
        "17 0000 0001 0000 0001 02 1234 56",
        "17 012B 0002 0000 0001 02 1234",
        "17 0000 0001 012B 0002 04 1234 5678",
    ],
)
def test_what_is_not_plainly_right_takes_the_generic_path(pdu: str) -> None:
    wire = bytes.fromhex(pdu)
    kind = STANDARD.find(wire, 0, len(wire))
    assert kind is not None
    answer = kind.direct(PlainDevice())
    assert answer is not None
    assert answer(wire, 0, len(wire), ClientIdentity()) is None


def test_a_block_whose_bytes_are_replaced_is_read_anew() -> None:
    device = PlainDevice(count=4)
    answer = ReadHoldingRegisters.direct(device)
    assert answer is not None
    device.blocks[Table.HOLDING_REGISTERS].data = bytearray(b"\x12\x34" * 4)
    assert answer(bytes.fromhex("03 0000 0001"), 0, 5, ClientIdentity()) == bytes.fromhex("03 02 1234")


def test_functions_that_need_more_than_a_block_have_no_fast_path() -> None:
    class NothingPlain:
        def plain_block(self, table: Table, *, writes: bool) -> None:
            return None

    for kind in STANDARD:
        if kind in DIRECT:
            assert kind.direct(NothingPlain()) is None
        else:
            assert kind.direct(PlainDevice()) is None


@pytest.mark.parametrize(
    "pdu", ["05 0003 FF00", "05 0003 0000", "06 0003 1234", "0F 0003 0002 01 03", "10 0003 0002 04 12345678"]
)
def test_a_write_that_its_block_declines_takes_the_generic_path(pdu: str) -> None:
    wire = bytes.fromhex(pdu)
    device = PlainDevice()
    device.blocks = {table: DecliningBlock(0, 300, table.holds_bits) for table in Table}
    before = device.content
    kind = STANDARD.find(wire, 0, len(wire))
    assert kind is not None
    answer = kind.direct(device)
    assert answer is not None
    assert answer(wire, 0, len(wire), ClientIdentity()) is None
    assert device.content == before

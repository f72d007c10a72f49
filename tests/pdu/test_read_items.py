"""Functions 01–04 and 24: limits on both edges, and what they do to a device."""

from typing import Any

import pytest
from recording_device import FakeContext, RecordingModel

from busway.codes import Table
from busway.errors import InvalidRequest
from busway.pdu.device_interface import Refusal
from busway.pdu.malformed_pdu import MalformedPdu
from busway.pdu.message import Request
from busway.pdu.read_items import (
    ReadCoils,
    ReadDiscreteInputs,
    ReadFifoQueue,
    ReadHoldingRegisters,
    ReadInputRegisters,
    unpack_registers,
)

READS = [
    pytest.param(ReadCoils, Table.COILS, 2000, id="01", marks=pytest.mark.clause("A9")),
    pytest.param(ReadDiscreteInputs, Table.DISCRETE_INPUTS, 2000, id="02", marks=pytest.mark.clause("A9")),
    pytest.param(ReadHoldingRegisters, Table.HOLDING_REGISTERS, 125, id="03", marks=pytest.mark.clause("A10")),
    pytest.param(ReadInputRegisters, Table.INPUT_REGISTERS, 125, id="04", marks=pytest.mark.clause("A10")),
]


@pytest.mark.parametrize(("kind", "table", "limit"), READS)
def test_a_quantity_is_1_to_the_limit(kind: Any, table: Table, limit: int) -> None:
    assert kind(0, 1).count == 1
    assert kind(0, limit).encode() == bytes((kind.code, 0, 0)) + limit.to_bytes(2, "big")
    for count in (0, limit + 1, 0xFFFF):
        with pytest.raises(InvalidRequest, match=f"count must be 1…{limit}, not {count}"):
            kind(0, count)
        with pytest.raises(MalformedPdu, match=f"count must be 1…{limit}, not {count}") as caught:
            kind.decode(bytes((kind.code, 0, 0)) + count.to_bytes(2, "big"))
        assert caught.value.code == 3


@pytest.mark.parametrize(("kind", "table", "limit"), READS)
def test_a_read_checks_its_range_and_then_reads_it(kind: Any, table: Table, limit: int) -> None:
    model = RecordingModel(size=2000)
    reply = kind(3, 10).apply(model, FakeContext())
    assert model.calls == [("check", table, 3, 10, False), ("read", table, 3, 10)]
    assert reply == kind.Reply(bytes(2) if table.holds_bits else bytes(20))
    assert kind(0, limit).apply(model, FakeContext()).encode()[:2] == bytes((kind.code, 250))


@pytest.mark.parametrize(("kind", "table", "limit"), READS)
def test_a_read_of_items_that_do_not_exist_reads_nothing(kind: Any, table: Table, limit: int) -> None:
    model = RecordingModel(size=50)
    with pytest.raises(Refusal) as caught:
        kind(41, 10).apply(model, FakeContext())
    assert caught.value.code == 2
    assert [call[0] for call in model.calls] == ["check"]


@pytest.mark.clause("A9")
@pytest.mark.parametrize("kind", [ReadCoils, ReadDiscreteInputs])
def test_bits_of_a_reply_come_first_item_first(kind: Any) -> None:
    # coils 20…38 of §6.1: CD = 27…20, 6B = 35…28, 05 = 38…36
    reply = kind.Reply(b"\xcd\x6b\x05")
    assert [int(bit) for bit in reply.bits(19)] == [1, 0, 1, 1, 0, 0, 1, 1, 1, 1, 0, 1, 0, 1, 1, 0, 1, 0, 1]


@pytest.mark.clause("A9")
def test_unused_bits_of_a_reply_are_zero() -> None:
    model = RecordingModel()
    model.bits[:] = b"\xff" * len(model.bits)
    assert ReadCoils(3, 10).apply(model, FakeContext()).encode() == b"\x01\x02\xff\x03"


@pytest.mark.parametrize("kind", [ReadHoldingRegisters, ReadInputRegisters])
def test_registers_of_a_reply_are_numbers(kind: Any) -> None:
    assert kind.Reply(bytes.fromhex("022B 0000 FFFF")).registers == [555, 0, 65_535]


def test_a_reply_has_at_least_one_item_and_at_most_what_fits() -> None:
    for kind in (ReadCoils, ReadHoldingRegisters):
        for size in (0, 252):
            with pytest.raises(InvalidRequest, match="data must have"):
                kind.Reply(bytes(size))
    with pytest.raises(InvalidRequest, match="data must have a multiple of 2 bytes, not 3"):
        ReadHoldingRegisters.Reply(b"\x00\x01\x02")


@pytest.mark.clause("A22")
@pytest.mark.parametrize("registers", [0, 1, 31])
def test_a_queue_of_up_to_31_registers_is_read_whole(registers: int) -> None:
    model = RecordingModel()
    model.queues[1246] = bytes(range(1, 63))[: 2 * registers]
    reply = ReadFifoQueue(1246).apply(model, FakeContext())
    assert isinstance(reply, ReadFifoQueue.Reply)
    assert reply.encode()[:5] == b"\x18" + (2 + 2 * registers).to_bytes(2, "big") + registers.to_bytes(2, "big")
    assert (reply.count, len(reply.registers)) == (registers, registers)
    assert model.calls == [("read_fifo", 1246)]


@pytest.mark.clause("A22")
def test_a_queue_of_more_than_31_registers_is_refused_with_03() -> None:
    model = RecordingModel()
    model.queues[7] = bytes(64)
    with pytest.raises(Refusal) as caught:
        ReadFifoQueue(7).apply(model, FakeContext())
    assert caught.value.code == 3


@pytest.mark.clause("A7")
def test_a_queue_that_does_not_exist_is_02_though_its_count_would_be_03() -> None:
    with pytest.raises(Refusal) as caught:
        ReadFifoQueue(7).apply(RecordingModel(), FakeContext())
    assert caught.value.code == 2


def test_a_queue_reply_whose_counts_disagree_is_malformed() -> None:
    with pytest.raises(MalformedPdu, match="FIFO count 1 where 2 registers follow"):
        ReadFifoQueue.Reply.decode(bytes.fromhex("18 0006 0001 0102 0304"))
    with pytest.raises(MalformedPdu):
        ReadFifoQueue.Reply.decode(b"\x18\x00\x42\x00\x20" + bytes(64))  # 32 registers
    with pytest.raises(InvalidRequest, match="FIFO count 3 where 1 registers follow"):
        ReadFifoQueue.Reply(3, b"\x00\x01")


@pytest.mark.parametrize("count", [0, 1, 125, 126, 127, 128, 65_536])
def test_registers_of_any_number_are_unpacked(count: int) -> None:
    assert unpack_registers(b"\x01\x02" * count) == [0x0102] * count


def test_reads_are_no_writes() -> None:
    kinds: list[type[Request]] = [
        ReadCoils,
        ReadDiscreteInputs,
        ReadHoldingRegisters,
        ReadInputRegisters,
        ReadFifoQueue,
    ]
    assert not any(kind.is_write for kind in kinds)

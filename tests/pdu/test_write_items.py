"""Functions 05, 06, 15, 16, 22 and 23: limits on both edges, echoes, and what they do to a device in which order."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_device import FakeContext, RecordingModel

from busway.codes import Table
from busway.errors import InvalidRequest
from busway.pdu.device_interface import Refusal
from busway.pdu.malformed_pdu import MalformedPdu
from busway.pdu.write_items import (
    COIL_OFF,
    COIL_ON,
    MaskWriteRegister,
    ReadWriteMultipleRegisters,
    WriteMultipleCoils,
    WriteMultipleRegisters,
    WriteSingleCoil,
    WriteSingleRegister,
    pack_registers,
)

HOLDING = Table.HOLDING_REGISTERS


@pytest.mark.clause("A11")
@pytest.mark.parametrize("value", [0x0001, 0x00FF, 0xFF01, 0xFFFF, 0x0100])
def test_a_coil_takes_ff00_and_0000_and_nothing_else(value: int) -> None:
    with pytest.raises(InvalidRequest, match=f"value must be one of 0x0000, 0xFF00, not {value}"):
        WriteSingleCoil(0, value)
    with pytest.raises(MalformedPdu) as caught:
        WriteSingleCoil.decode(b"\x05\x00\x00" + value.to_bytes(2, "big"))
    assert caught.value.code == 3


@pytest.mark.clause("A11")
@pytest.mark.parametrize(("value", "bit"), [(COIL_ON, b"\x01"), (COIL_OFF, b"\x00")])
def test_a_coil_is_switched_and_the_request_comes_back(value: int, bit: bytes) -> None:
    model = RecordingModel()
    request = WriteSingleCoil(9, value)
    assert request.apply(model, FakeContext()).encode() == request.encode()
    assert model.calls == [("check", Table.COILS, 9, 1, True), ("write", Table.COILS, 9, 1, bit)]


@pytest.mark.clause("A12")
@pytest.mark.parametrize("value", [0, 1, 0xFFFF])
def test_a_register_is_written_and_the_request_comes_back(value: int) -> None:
    model = RecordingModel()
    request = WriteSingleRegister(9, value)
    assert request.apply(model, FakeContext()).encode() == request.encode()
    assert model.calls == [("check", HOLDING, 9, 1, True), ("write", HOLDING, 9, 1, value.to_bytes(2, "big"))]


@pytest.mark.clause("A12")
@pytest.mark.parametrize("value", [-1, 65_536])
def test_a_register_value_out_of_range_is_never_truncated(value: int) -> None:
    with pytest.raises(InvalidRequest, match=f"value must be 0…65535, not {value}"):
        WriteSingleRegister(0, value)
    with pytest.raises(InvalidRequest, match=f"value 2 must be 0…65535, not {value}"):
        WriteMultipleRegisters.of(0, [1, value])
    with pytest.raises(InvalidRequest, match="value 1 must be an integer, not 'x'"):
        WriteMultipleRegisters.of(0, ["x"])  # type: ignore[list-item]


@pytest.mark.clause("A13")
def test_coils_are_written_up_to_1968() -> None:
    assert WriteMultipleCoils.of(0, [True]).encode() == bytes.fromhex("0F 0000 0001 01 01")
    assert len(WriteMultipleCoils.of(0, [True] * 1968).encode()) == 6 + 246
    with pytest.raises(InvalidRequest, match="count must be 1…1968, not 1969"):
        WriteMultipleCoils.of(0, [True] * 1969)
    with pytest.raises(InvalidRequest, match="count must be 1…1968, not 0"):
        WriteMultipleCoils.of(0, [])


@pytest.mark.clause("A13")
@pytest.mark.parametrize(
    "pdu",
    [
        "0F 0000 0000 01 00",  # no coils
        "0F 0000 0000 00",  # no coils, no bytes
        "0F 0000 0009 01 FF",  # nine coils in one byte
        "0F 0000 0008 02 FFFF",  # eight in two
        "0F 0000 0008 01",  # announced, not there
        "0F 0000 0008 01 FF FF",  # there, not announced
        "0F 0000 07B1 F7" + "00" * 247,  # 1969 coils
    ],
)
def test_coils_whose_byte_count_does_not_fit_are_malformed(pdu: str) -> None:
    with pytest.raises(MalformedPdu) as caught:
        WriteMultipleCoils.decode(bytes.fromhex(pdu))
    assert caught.value.code == 3


@pytest.mark.clause("A13")
def test_coils_are_checked_and_written_and_the_range_comes_back() -> None:
    model = RecordingModel()
    reply = WriteMultipleCoils(19, 10, b"\xcd\x01").apply(model, FakeContext())
    assert reply == WriteMultipleCoils.Reply(19, 10)
    assert model.calls == [("check", Table.COILS, 19, 10, True), ("write", Table.COILS, 19, 10, b"\xcd\x01")]


@pytest.mark.clause("A14")
def test_registers_are_written_up_to_123() -> None:
    assert len(WriteMultipleRegisters.of(0, [0] * 123).encode()) == 6 + 246
    for count in (0, 124):
        with pytest.raises(InvalidRequest, match=f"count must be 1…123, not {count}"):
            WriteMultipleRegisters.of(0, [0] * count)


@pytest.mark.clause("A14")
@pytest.mark.parametrize(
    "pdu",
    [
        "10 0000 0000 00",
        "10 0000 0001 01 00",  # half a register
        "10 0000 0001 04 0000 0000",  # more than announced
        "10 0000 0002 02 0000",  # fewer
        "10 0000 0001 02 00",  # cut off
        "10 0000 007C F8" + "00" * 248,  # 124 registers
        "10 0000 0001 02 0000 00",  # a byte behind
    ],
)
def test_registers_whose_byte_count_does_not_fit_are_malformed(pdu: str) -> None:
    with pytest.raises(MalformedPdu) as caught:
        WriteMultipleRegisters.decode(bytes.fromhex(pdu))
    assert caught.value.code == 3


@pytest.mark.clause("A14")
def test_registers_are_checked_and_written_and_the_range_comes_back() -> None:
    model = RecordingModel()
    reply = WriteMultipleRegisters.of(1, [10, 0x0102]).apply(model, FakeContext())
    assert reply.encode() == bytes.fromhex("10 0001 0002")
    assert model.calls == [("check", HOLDING, 1, 2, True), ("write", HOLDING, 1, 2, b"\x00\x0a\x01\x02")]


@pytest.mark.clause("A17")
def test_the_example_of_the_document_gives_0x17() -> None:
    model = RecordingModel()
    model.registers[8:10] = b"\x00\x12"
    request = MaskWriteRegister(4, 0xF2, 0x25)
    assert request.apply(model, FakeContext()).encode() == request.encode()
    assert model.registers[8:10] == b"\x00\x17"
    # The address is looked at before the register is read, and nothing is written before both.
    assert [call[0] for call in model.calls] == ["check", "read", "write"]
    assert model.calls[0] == ("check", HOLDING, 4, 1, True)


@pytest.mark.clause("A17")
@given(current=st.integers(0, 0xFFFF), and_mask=st.integers(0, 0xFFFF), or_mask=st.integers(0, 0xFFFF))
def test_each_bit_is_kept_or_set_as_its_masks_say(current: int, and_mask: int, or_mask: int) -> None:
    model = RecordingModel()
    model.registers[0:2] = current.to_bytes(2, "big")
    MaskWriteRegister(0, and_mask, or_mask).apply(model, FakeContext())
    new = int.from_bytes(model.registers[0:2], "big")
    for bit in range(16):
        one = 1 << bit
        assert new & one == (current if and_mask & one else or_mask) & one


@pytest.mark.clause("A18")
@pytest.mark.parametrize(("read", "write"), [(1, 1), (125, 121)])
def test_23_reads_up_to_125_and_writes_up_to_121(read: int, write: int) -> None:
    request = ReadWriteMultipleRegisters.of(0, read, 0, [0] * write)
    assert len(request.encode()) == 10 + 2 * write <= 253
    assert ReadWriteMultipleRegisters.decode(request.encode()) == request


@pytest.mark.clause("A18")
@pytest.mark.parametrize(
    ("read", "write", "sentence"),
    [
        (0, 1, "read count must be 1…125, not 0"),
        (126, 1, "read count must be 1…125, not 126"),
        (1, 0, "write count must be 1…121, not 0"),
        (1, 122, "write count must be 1…121, not 122"),
    ],
)
def test_23_beyond_its_limits_cannot_be_built(read: int, write: int, sentence: str) -> None:
    with pytest.raises(InvalidRequest, match=sentence):
        ReadWriteMultipleRegisters.of(0, read, 0, [0] * write)


@pytest.mark.clause("A18")
def test_23_writes_first_and_then_reads() -> None:
    model = RecordingModel()
    reply = ReadWriteMultipleRegisters.of(5, 2, 6, [0xABCD]).apply(model, FakeContext())
    assert reply.encode() == bytes.fromhex("17 04 0000 ABCD")
    assert [call[0] for call in model.calls if call[0] in ("write", "read")] == ["write", "read"]


@pytest.mark.clause("A7")
@pytest.mark.parametrize(
    "request_",
    [
        ReadWriteMultipleRegisters.of(199, 2, 0, [1]),  # what is to be read does not exist
        ReadWriteMultipleRegisters.of(0, 2, 199, [1, 2]),  # what is to be written does not exist
        ReadWriteMultipleRegisters.of(0, 2, 50, [1, 2]),  # or may not be written
    ],
)
def test_23_looks_at_both_ranges_before_it_writes(request_: Any) -> None:
    model = RecordingModel(size=200, read_only=(51,))
    with pytest.raises(Refusal) as caught:
        request_.apply(model, FakeContext())
    assert caught.value.code == 2
    assert not [call for call in model.calls if call[0] == "write"]
    assert not any(model.registers)


@pytest.mark.clause("A7")
@pytest.mark.parametrize(
    "request_",
    [
        WriteSingleCoil(51, COIL_ON),
        WriteSingleRegister(51, 7),
        WriteMultipleCoils.of(50, [True, True]),
        WriteMultipleRegisters.of(50, [7, 8]),
        MaskWriteRegister(51, 0, 7),
        WriteSingleCoil(200, COIL_ON),
        WriteSingleRegister(200, 7),
        WriteMultipleCoils.of(199, [True, True]),
        WriteMultipleRegisters.of(199, [7, 8]),
        MaskWriteRegister(200, 0, 7),
    ],
)
def test_a_write_that_is_refused_changes_nothing(request_: Any) -> None:
    model = RecordingModel(size=200, read_only=(51,))
    with pytest.raises(Refusal) as caught:
        request_.apply(model, FakeContext())
    assert caught.value.code == 2
    assert [call[0] for call in model.calls] == ["check"]
    assert not any(model.registers)
    assert not any(model.bits)


def test_registers_are_packed_big_endian() -> None:
    assert pack_registers([1, 0xFFFE]) == b"\x00\x01\xff\xfe"
    assert pack_registers([]) == b""


@pytest.mark.parametrize("values", [b"ab", bytearray(b"ab"), memoryview(b"ab"), "ab", {1: 2}, 7])
def test_bytes_and_texts_are_no_registers(values: Any) -> None:
    with pytest.raises(InvalidRequest, match="the registers must be a sequence of values, not"):
        pack_registers(values)


@pytest.mark.parametrize(("value", "number"), [(True, 1), (False, 0)])
def test_a_state_among_registers_is_named(value: bool, number: int) -> None:
    with pytest.raises(InvalidRequest, match=f"value 2 must be an integer, not {value}"):
        pack_registers([0x0101, value])
    assert pack_registers((0x0101, number)) == bytes((1, 1, 0, number))
    assert pack_registers(range(2)) == b"\x00\x00\x00\x01"

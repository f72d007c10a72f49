"""One block behind several tables (Application Protocol V1.1b3 §4.3, figure 7)."""

from typing import Any

import pytest

from busway.codes import Table
from busway.errors import ConfigError
from busway.pdu.device_interface import Refusal
from busway.pdu.message import Message, Request
from busway.pdu.read_items import ReadCoils, ReadDiscreteInputs, ReadHoldingRegisters, ReadInputRegisters
from busway.pdu.write_items import WriteMultipleCoils, WriteMultipleRegisters, WriteSingleCoil, WriteSingleRegister
from busway.server.device import Device
from busway.server.single_block import SingleBlock
from busway.server.table_declaration import Cells
from busway.session.diagnostic_counters import CommunicationState
from busway.session.responder import RequestContext


def execute(device: Device, request: Request) -> Message:
    """Execute a request as a server does."""
    with device.lock:
        return request.apply(device, RequestContext(unit=1, function=request.code, diagnostics=CommunicationState()))


def test_what_a_word_function_writes_the_bit_functions_read() -> None:
    device = Device(block=SingleBlock(4))
    execute(device, WriteMultipleRegisters.of(1, [0x8001, 0x0102]))
    bits = [bit for bit in range(64) if device.coils[bit]]
    assert bits == [16, 31, 33, 40]
    assert execute(device, ReadCoils(16, 16)).encode() == bytes.fromhex("01 02 01 80")
    assert execute(device, ReadDiscreteInputs(31, 10)).encode() == bytes.fromhex("02 02 05 02")


def test_what_a_bit_function_writes_the_word_functions_read() -> None:
    device = Device(block=SingleBlock([0xFFFF, 0, 0]))
    execute(device, WriteSingleCoil(3, 0))
    execute(device, WriteMultipleCoils.of(15, [False, True, True]))
    assert execute(device, ReadHoldingRegisters(0, 3)).encode() == bytes.fromhex("03 06 7F F7 00 03 00 00")
    assert execute(device, ReadInputRegisters(1, 1)).encode() == bytes.fromhex("04 02 00 03")


def test_bits_begin_at_the_register_that_was_declared() -> None:
    device = Device(block=SingleBlock(Cells(first=100, count=10), coils_at=(104, 20), discrete_inputs_at=(100, 1)))
    device.coils[0] = True
    device.coils[19] = True
    assert device.holding_registers[104:106] == [1, 8]
    device.input_registers[100] = 1
    assert device.discrete_inputs[:] == [True]
    assert (len(device.coils), len(device.discrete_inputs)) == (20, 1)
    with pytest.raises(Refusal):
        execute(device, ReadCoils(19, 2))


def test_without_a_declaration_all_bits_are_there_as_far_as_addresses_go() -> None:
    assert len(Device(block=SingleBlock(3)).coils) == 48
    assert len(Device(block=SingleBlock(5000)).coils) == 65536


def test_tables_that_the_block_does_not_serve_are_declared_beside_it() -> None:
    device = Device(block=SingleBlock(2, tables=("holding_registers", Table.COILS)), input_registers=[5])
    device.coils[0] = True
    assert device.input_registers[:] == [5]
    assert len(device.discrete_inputs) == 0


def test_what_is_read_only_as_a_register_is_so_as_a_coil() -> None:
    block = SingleBlock(Cells(count=4, read_only=[(0, 1), (2, 1)]), coils_at=(1, 40))
    device = Device(block=block)
    for request in (WriteSingleRegister(2, 1), WriteSingleCoil(16, 0xFF00), WriteMultipleCoils.of(15, [True] * 2)):
        with pytest.raises(Refusal):
            execute(device, request)
    for request in (WriteSingleRegister(3, 1), WriteSingleCoil(15, 0xFF00), WriteSingleCoil(32, 0xFF00)):
        execute(device, request)
    assert device.holding_registers[:] == [0, 0x8000, 0, 1]


def test_the_fast_path_is_offered_for_words_and_not_for_bits() -> None:
    device = Device(block=SingleBlock(4))
    assert device.plain_block(Table.HOLDING_REGISTERS, writes=True) is not None
    assert device.plain_block(Table.INPUT_REGISTERS, writes=False) is not None
    assert device.plain_block(Table.COILS, writes=False) is None
    assert device.plain_block(Table.DISCRETE_INPUTS, writes=False) is None


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"block": SingleBlock(0)}, "one run of registers, not 0"),
        ({"block": SingleBlock({0: 1, 2: 1})}, "one run of registers, not 2"),
        ({"block": SingleBlock(4, coils_at=(4, 1))}, "do not lie in registers 0…3"),
        ({"block": SingleBlock(4, coils_at=(3, 17))}, "do not lie in registers 0…3"),
        ({"block": SingleBlock(4, coils_at=(0, 0))}, "do not lie in registers 0…3"),
        ({"block": SingleBlock(4, discrete_inputs_at=(-1, 1))}, "do not lie in registers 0…3"),
        ({"block": SingleBlock(4, tables=("registers",))}, "there is no table 'registers'"),
        ({"block": SingleBlock(4), "coils": 8}, "served by the block already"),
        ({"block": SingleBlock(4), "coils": 0}, "served by the block already"),
    ],
)
def test_a_block_that_cannot_be_is_refused(options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        Device(**options)

"""Conversion of registers, payload builder and decoder, and the names of modules, without any connection."""

import importlib
import struct
import subprocess
import sys
from typing import Any

import pytest

import busway.compat
from busway.compat.pymodbus import pdu
from busway.compat.pymodbus.calls import ModbusClientMixin, RegisterDataType
from busway.compat.pymodbus.constants import Endian
from busway.compat.pymodbus.exceptions import ModbusException, ParameterException
from busway.compat.pymodbus.payload import BinaryPayloadBuilder, BinaryPayloadDecoder
from busway.errors import InvalidRequest

# What pymodbus 3.16.1 gives for these.
CONVERTED = [
    (-2, RegisterDataType.INT16, "big", [0xFFFE]),
    (0x12345678, RegisterDataType.UINT32, "big", [0x1234, 0x5678]),
    (0x12345678, RegisterDataType.UINT32, "little", [0x5678, 0x1234]),
    (-1, RegisterDataType.INT64, "big", [0xFFFF] * 4),
    (27.125, RegisterDataType.FLOAT32, "big", [0x41D9, 0x0000]),
    (27.125, RegisterDataType.FLOAT32, "little", [0x0000, 0x41D9]),
    ([1.0, 2.0], RegisterDataType.FLOAT32, "little", [0x0000, 0x3F80, 0x0000, 0x4000]),
    ("abcde", RegisterDataType.STRING, "big", [0x6162, 0x6364, 0x6500]),
    ("abcd", RegisterDataType.STRING, "little", [0x6364, 0x6162]),
    ([True] + [False] * 15, RegisterDataType.BITS, "big", [0x0100]),
]


@pytest.mark.parametrize(("value", "kind", "order", "registers"), CONVERTED)
def test_values_become_registers_and_registers_values(
    value: Any, kind: RegisterDataType, order: str, registers: list[int]
) -> None:
    assert ModbusClientMixin.convert_to_registers(value, kind, order) == registers
    assert ModbusClientMixin.convert_from_registers(registers, ModbusClientMixin.DATATYPE[kind.name], order) == value


def test_conversion_refuses_what_does_not_fit() -> None:
    with pytest.raises(ModbusException, match="multiple of 2"):
        ModbusClientMixin.convert_from_registers([1], RegisterDataType.FLOAT32)
    for value, kind in (("x", RegisterDataType.BITS), (1, RegisterDataType.STRING)):
        with pytest.raises(TypeError, match="Value should be"):
            ModbusClientMixin.convert_to_registers(value, kind)
    for call in (ModbusClientMixin.convert_to_registers, ModbusClientMixin.convert_from_registers):
        with pytest.raises(TypeError, match="data_type"):
            call([1], "INT16")  # type: ignore[arg-type]
    with pytest.raises(struct.error):
        ModbusClientMixin.convert_to_registers(70_000, RegisterDataType.UINT16)


def test_conversion_leaves_the_list_of_bits_as_it_is() -> None:
    bits = [True]
    assert ModbusClientMixin.convert_to_registers(bits, RegisterDataType.BITS) == [0x0100]
    assert bits == [True]


# What pymodbus 3.9.2 builds of 0x0102, 0x01020304 and 1.5, by byte order and word order.
BUILT = [
    (Endian.BIG, Endian.BIG, [0x0102, 0x0102, 0x0304, 0x3FC0, 0x0000]),
    (Endian.BIG, Endian.LITTLE, [0x0102, 0x0304, 0x0102, 0x0000, 0x3FC0]),
    (Endian.LITTLE, Endian.BIG, [0x0201, 0x0201, 0x0403, 0xC03F, 0x0000]),
    (Endian.LITTLE, Endian.LITTLE, [0x0201, 0x0403, 0x0201, 0x0000, 0xC03F]),
]


@pytest.mark.parametrize(("byteorder", "wordorder", "registers"), BUILT)
def test_payload_has_the_order_of_pymodbus_and_is_read_back(
    byteorder: str, wordorder: str, registers: list[int]
) -> None:
    builder = BinaryPayloadBuilder(byteorder=byteorder, wordorder=wordorder)
    builder.add_16bit_uint(0x0102)
    builder.add_32bit_uint(0x01020304)
    builder.add_32bit_float(1.5)
    assert builder.to_registers() == registers
    decoder = BinaryPayloadDecoder.fromRegisters(registers, byteorder=byteorder, wordorder=wordorder)
    assert decoder.decode_16bit_uint() == 0x0102
    assert decoder.decode_32bit_uint() == 0x01020304
    assert decoder.decode_32bit_float() == 1.5
    decoder.reset()
    decoder.skip_bytes(2)
    assert decoder.decode_32bit_int() == 0x01020304


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("8bit_uint", 200),
        ("8bit_int", -2),
        ("16bit_uint", 60_000),
        ("16bit_int", -300),
        ("16bit_float", 1.5),
        ("32bit_uint", 4_000_000_000),
        ("32bit_int", -70_000),
        ("32bit_float", 0.25),
        ("64bit_uint", 2**63),
        ("64bit_int", -(2**40)),
        ("64bit_float", 0.1),
    ],
)
def test_every_number_comes_back(kind: str, value: float) -> None:
    builder = BinaryPayloadBuilder()
    getattr(builder, f"add_{kind}")(value)
    assert getattr(BinaryPayloadDecoder(builder.encode()), f"decode_{kind}")() == value


def test_texts_bits_and_coils() -> None:
    builder = BinaryPayloadBuilder(byteorder=Endian.BIG)
    builder.add_string("abc")
    builder.add_bits([True, False, False, True])
    assert (builder.encode(), str(builder), builder.build()) == (b"abc\x09", "abc\t", [b"ab", b"c\x09"])
    assert builder.to_coils()[:8] == [False, True, True, False, False, False, False, True]
    decoder = BinaryPayloadDecoder(builder.encode())
    assert decoder.decode_string(3) == b"abc"
    assert decoder.decode_bits() == [True, False, False, True, False, False, False, False]
    assert BinaryPayloadDecoder.fromCoils([True] + [False] * 7).decode_bits() == [False] * 7 + [True]
    builder.reset()
    assert builder.encode() == b""
    with pytest.raises(ParameterException):
        BinaryPayloadDecoder.fromRegisters((1, 2))


@pytest.mark.parametrize(
    "name",
    [
        "bit_read_message",
        "client.mixin",
        "client.sync",
        "client.tcp",
        "framer.rtu",
        "framer.rtu_framer",
        "pdu.register_message",
        "register_read_message",
        "transaction",
    ],
)
def test_names_of_modules_of_all_releases_are_served_below_the_package(name: str) -> None:
    module = importlib.import_module(f"busway.compat.pymodbus.{name}")
    home = {"client": "ModbusTcpClient", "framer": "FramerRTU", "transaction": "ModbusRtuFramer"}
    wanted = "ModbusClientMixin" if name == "client.mixin" else home.get(name.partition(".")[0], "ReadCoilsResponse")
    assert getattr(module, wanted).__module__.startswith("busway.compat.pymodbus.")


INSTALLED = """
import busway.compat
package = busway.compat.install("pymodbus")
import pymodbus, pymodbus.client.mixin
from pymodbus.register_read_message import ReadHoldingRegistersResponse
from pymodbus.client import ModbusTcpClient
import busway.compat.pymodbus.client as ours, busway.compat.pymodbus.pdu as messages
assert pymodbus is package is busway.compat.install("pymodbus")
assert ModbusTcpClient is ours.ModbusTcpClient
assert ReadHoldingRegistersResponse is messages.ReadHoldingRegistersResponse
try:
    import pymodbus.nowhere
except ModuleNotFoundError as error:
    print(error.name)
"""


def run(program: str) -> str:
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_install_puts_the_same_objects_below_the_name_of_the_original() -> None:
    assert run(INSTALLED) == "pymodbus.nowhere\n"


def test_install_comes_before_the_original_and_knows_its_names() -> None:
    with pytest.raises(busway.ConfigError, match="'umodbus'"):
        busway.compat.install("umodbus")
    late = """
import sys, types
sys.modules["pymodbus"] = types.ModuleType("pymodbus")
import busway.compat
try:
    busway.compat.install("pymodbus")
except busway.ConfigError as error:
    print(error)
"""
    assert run(late) == "pymodbus is imported already; install comes before the first import of it\n"


def test_every_request_of_pymodbus_means_a_message_of_busway() -> None:
    kinds = [kind for kind in vars(pdu).values() if isinstance(kind, type) and issubclass(kind, pdu.KnownRequest)]
    bases = {pdu.KnownRequest, pdu.PlainRequest, pdu.DiagnosticBase}
    assert len(kinds) > 15
    for kind in kinds:
        if kind not in bases:
            assert kind.responds.function_code == kind.function_code


@pytest.mark.parametrize("message", [70_000, -1, [1, 65_536], ["1"], "1"])
def test_data_of_a_diagnostic_request_that_are_no_registers_are_refused(message: Any) -> None:
    with pytest.raises(InvalidRequest):
        pdu.DiagnosticBase(message, sub_function=0).to_request()


def test_data_of_a_diagnostic_request_are_bytes_a_number_or_several() -> None:
    for message, data in ((b"ab", "6162"), (65_535, "FFFF"), ([1, 2], "0001 0002")):
        request = pdu.DiagnosticBase(message, sub_function=0).to_request()
        assert request.encode() == bytes.fromhex("08 0000" + data)


@pytest.mark.parametrize("kind", [pdu.WriteSingleRegisterRequest, pdu.WriteSingleCoilRequest])
def test_request_to_write_one_value_without_any_is_refused(kind: Any) -> None:
    with pytest.raises(InvalidRequest, match="no value"):
        kind(0, []).to_request()

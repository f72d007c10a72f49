"""The words of the specification: numbers, limits and names as the documents have them."""

import pytest

from busway import codes
from busway.codes import DiagnosticCode, ExceptionCode, FunctionCode, MeiType, Table, exception_meaning, function_name


@pytest.mark.clause("A1")
def test_a_pdu_has_253_bytes_and_each_framing_adds_its_own() -> None:
    assert codes.PDU_LIMIT == 253
    assert codes.TCP_ADU_LIMIT == 7 + codes.PDU_LIMIT
    assert codes.RTU_ADU_LIMIT == 1 + codes.PDU_LIMIT + 2
    assert codes.ASCII_ADU_LIMIT == 1 + 2 * (1 + codes.PDU_LIMIT + 1) + 2


@pytest.mark.clause("A9")
@pytest.mark.clause("A14")
def test_every_limit_fits_a_pdu_and_one_item_more_would_break_its_byte_count_or_the_pdu() -> None:
    assert 2 + codes.MAX_READ_BITS // 8 <= codes.PDU_LIMIT
    assert 2 + 2 * codes.MAX_READ_REGISTERS <= codes.PDU_LIMIT
    assert 2 + 2 * (codes.MAX_READ_REGISTERS + 1) > codes.PDU_LIMIT
    assert 6 + codes.MAX_WRITE_BITS // 8 <= codes.PDU_LIMIT
    assert 6 + 2 * codes.MAX_WRITE_REGISTERS <= codes.PDU_LIMIT
    assert 6 + 2 * (codes.MAX_WRITE_REGISTERS + 1) > codes.PDU_LIMIT
    assert 10 + 2 * codes.MAX_READ_WRITE_WRITE_REGISTERS <= codes.PDU_LIMIT
    assert 10 + 2 * (codes.MAX_READ_WRITE_WRITE_REGISTERS + 1) > codes.PDU_LIMIT


@pytest.mark.clause("A4")
def test_there_are_four_tables_two_of_bits_and_two_that_are_written() -> None:
    assert codes.TABLE_SIZE == 65_536
    assert {table for table in Table if table.holds_bits} == {Table.COILS, Table.DISCRETE_INPUTS}
    assert {table for table in Table if table.is_writable} == {Table.COILS, Table.HOLDING_REGISTERS}
    assert [table.label for table in Table] == ["coil", "discrete input", "input register", "holding register"]


@pytest.mark.clause("A22")
def test_the_function_codes_are_those_of_the_documents() -> None:
    assert [int(code) for code in FunctionCode] == [1, 2, 3, 4, 5, 6, 7, 8, 11, 12, 15, 16, 17, 20, 21, 22, 23, 24, 43]
    assert [int(code) for code in MeiType] == [13, 14]
    assert [int(code) for code in DiagnosticCode] == [*range(5), *range(0x0A, 0x13), 0x14]


@pytest.mark.clause("A20")
def test_every_exception_has_a_meaning_and_others_are_said_to_be_none() -> None:
    assert [int(code) for code in ExceptionCode] == [1, 2, 3, 4, 5, 6, 7, 8, 10, 11]
    assert {*codes.EXCEPTION_MEANING} == {int(code) for code in ExceptionCode}
    assert exception_meaning(5).startswith("acknowledge: the device accepted")
    for code in (0, 9, 12, 255):
        assert exception_meaning(code) == "an exception code outside the specification"


def test_a_function_code_is_read_with_its_name() -> None:
    assert function_name(3) == "3 (read holding registers)"
    assert function_name(43) == "43 (encapsulated interface)"
    assert function_name(0x41) == "65 (0x41)"


@pytest.mark.clause("T3")
def test_the_ports_are_registered_ones() -> None:
    assert (codes.DEFAULT_TCP_PORT, codes.DEFAULT_TLS_PORT) == (502, 802)


@pytest.mark.clause("S3")
def test_the_addresses_of_a_line() -> None:
    assert (codes.BROADCAST_UNIT, codes.FIRST_SERIAL_UNIT, codes.LAST_SERIAL_UNIT) == (0, 1, 247)
    assert codes.TCP_DEVICE_UNIT == 255

"""Our client against pymodbus: every other function of the specification that a server of it answers."""

from collections.abc import Callable
from typing import Any

import foreign
import pytest

PYMODBUS_FILE_RECORD = b"SERVER DUMMY RECORD."
"""What pymodbus answers whatever record is asked for."""


@pytest.fixture
def unit(pymodbus_server: foreign.Program, unit_at: Callable[[str], Any]) -> Any:
    return unit_at(pymodbus_server.url)


def test_mask_write_keeps_the_bits_of_the_and_mask(unit: Any) -> None:
    unit.write_single_register(800, 0x12)
    unit.mask_write_register(800, and_mask=0xF2, or_mask=0x25)
    assert unit.read_holding_registers(800, count=1) == [0x17]


def test_the_exception_status_is_a_byte(unit: Any) -> None:
    assert unit.read_exception_status() == 0


@pytest.mark.parametrize("data", [b"\x00\x00", b"\xa5\x37"])
def test_query_data_come_back(unit: Any, data: bytes) -> None:
    assert unit.diagnostics(0x00, data) == data


def test_restart_is_echoed(unit: Any) -> None:
    assert unit.diagnostics(0x01, b"\xff\x00") == b"\xff\x00"


@pytest.mark.parametrize("sub_function", [0x02, 0x0A, 0x0B, 0x0C, 0x0D, 0x0E, 0x0F, 0x10, 0x11, 0x12, 0x14])
def test_a_counter_is_two_bytes(unit: Any, sub_function: int) -> None:
    assert unit.diagnostics(sub_function) == b"\x00\x00"


def test_the_ascii_delimiter_is_echoed(unit: Any) -> None:
    assert unit.diagnostics(0x03, b"\x0d\x00") == b"\x0d\x00"


def test_the_event_counter_comes_with_a_status(unit: Any) -> None:
    reply = unit.get_comm_event_counter()
    assert (reply.status, reply.event_count) == (0, 0)


def test_the_event_log_is_empty(unit: Any) -> None:
    reply = unit.get_comm_event_log()
    assert (reply.status, reply.event_count, reply.message_count, bytes(reply.events)) == (0, 0, 0, b"")


def test_the_server_tells_its_name_and_that_it_runs(unit: Any) -> None:
    assert unit.report_server_id() == b"Acme-PX-1-2.5\xff"


def test_file_records_are_registers(unit: Any) -> None:
    words = [int.from_bytes(PYMODBUS_FILE_RECORD[at : at + 2], "big") for at in range(0, 20, 2)]
    assert unit.read_file_record(1, 0, count=10) == words


def test_writing_file_records_is_echoed(unit: Any) -> None:
    unit.write_file_record(4, 7, [0x06AF, 0x04BE, 0x100D])


def test_the_queue_is_read_in_order(unit: Any) -> None:
    assert unit.read_fifo_queue(0x04DE) == [0, 1, 2, 3]


@pytest.mark.parametrize(("level", "highest"), [("basic", 2), ("regular", 6), ("extended", 6)])
def test_identification_objects_of_a_level(unit: Any, level: str, highest: int) -> None:
    expected = {number: text for number, text in foreign.IDENTITY.items() if number <= highest}
    assert unit.read_device_identification(level) == expected

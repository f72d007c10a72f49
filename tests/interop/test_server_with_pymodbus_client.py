"""Our server against pymodbus: every other function of the specification that a client of it sends."""

from collections.abc import Iterator
from typing import Any

import foreign
import pytest

import busway


@pytest.fixture(scope="module")
def unit(our_url: str) -> Iterator[Any]:
    with busway.connect(our_url) as link:
        yield link.unit(1)


def test_mask_write_keeps_the_bits_of_the_and_mask(pymodbus_client: foreign.Program, unit: Any) -> None:
    unit.write_single_register(800, 0x12)
    assert pymodbus_client.ask("mask_write_register 800 0xF2 0x25")["ok"]
    assert unit.read_holding_registers(800, count=1) == [0x17]


def test_the_exception_status_is_the_same_for_both(pymodbus_client: foreign.Program, unit: Any) -> None:
    assert pymodbus_client.ask("read_exception_status") == {"ok": True, "status": unit.read_exception_status()}


def test_query_data_come_back(pymodbus_client: foreign.Program) -> None:
    assert pymodbus_client.ask("diagnostics 0 0xA537") == {"ok": True, "data": 0xA537}


@pytest.mark.parametrize("sub_function", [0x02, 0x0B, 0x0C, 0x0D, 0x0E, 0x0F, 0x10, 0x11, 0x12])
def test_a_counter_is_read(pymodbus_client: foreign.Program, sub_function: int) -> None:
    answer = pymodbus_client.ask(f"diagnostics {sub_function}")
    assert answer["ok"], answer
    assert 0 <= answer["data"] <= 0xFFFF


@pytest.mark.clause("S17")
@pytest.mark.parametrize(("sub_function", "data"), [(0x01, 0xFF00), (0x03, 0x0D00), (0x0A, 0), (0x14, 0)])
def test_what_would_mute_or_reset_a_network_server_is_off(
    pymodbus_client: foreign.Program, sub_function: int, data: int
) -> None:
    answer = pymodbus_client.ask(f"diagnostics {sub_function} {data}")
    assert (answer["ok"], answer["exception"]) == (False, 1)


def test_the_event_counter_counts_successful_messages(pymodbus_client: foreign.Program) -> None:
    before = pymodbus_client.ask("get_comm_event_counter")
    assert pymodbus_client.ask("read_coils 0 1")["ok"]
    assert not pymodbus_client.ask("read_coils 1000 1")["ok"]  # an exception is no successful message
    after = pymodbus_client.ask("get_comm_event_counter")
    assert before["ready"]
    assert after["count"] == before["count"] + 1


def test_the_event_log_has_the_event_count_of_the_counter(pymodbus_client: foreign.Program) -> None:
    count = pymodbus_client.ask("get_comm_event_counter")["count"]
    answer = pymodbus_client.ask("get_comm_event_log")
    assert answer["ok"], answer
    assert answer["ready"]
    assert answer["event_count"] == count
    assert answer["message_count"] > 0
    assert len(answer["events"]) <= 64


def test_the_server_id_is_the_same_for_both(pymodbus_client: foreign.Program, unit: Any) -> None:
    answer = pymodbus_client.ask("report_server_id")
    seen = bytes.fromhex(answer["identifier"]) + (b"\xff" if answer["running"] else b"\x00")
    assert seen == unit.report_server_id()


def test_file_records_are_written_and_read(pymodbus_client: foreign.Program, unit: Any) -> None:
    assert pymodbus_client.ask("write_file_record 4 7 0x06AF 0x04BE 0x100D")["ok"]
    assert unit.read_file_record(4, 7, count=3) == [0x06AF, 0x04BE, 0x100D]
    # One register: pymodbus wants lengths in bytes, and refuses some of its own.
    assert pymodbus_client.ask("read_file_record 4 8 1") == {"ok": True, "values": [0x04BE]}


def test_a_queue_is_read_in_order(pymodbus_client: foreign.Program) -> None:
    assert pymodbus_client.ask("read_fifo_queue 40") == {"ok": True, "values": [440, 4740]}


@pytest.mark.parametrize(("level", "highest"), [(1, 2), (2, 6), (3, 6)])
def test_identification_objects_of_a_level(pymodbus_client: foreign.Program, level: int, highest: int) -> None:
    answer = pymodbus_client.ask(f"read_device_identification {level}")
    assert answer["objects"] == {
        str(number): text.hex() for number, text in foreign.IDENTITY.items() if number <= highest
    }


def test_one_identification_object(pymodbus_client: foreign.Program) -> None:
    answer = pymodbus_client.ask("read_device_identification 4 4")
    assert answer["objects"] == {"4": foreign.IDENTITY[4].hex()}


def test_an_identification_object_that_is_not_there_is_refused_with_code_2(pymodbus_client: foreign.Program) -> None:
    assert pymodbus_client.ask("read_device_identification 4 0x90")["exception"] == 2

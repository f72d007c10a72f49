"""Our server against pymodbus, RTU and ASCII: every other function of the specification that a client of it sends."""

from collections.abc import Iterator

import foreign
import pytest
from serial_peers import DeviceUnit, Pair, our_pair
from test_server_with_pymodbus_client import (  # noqa: F401 - the same questions
    test_a_counter_is_read,
    test_an_identification_object_that_is_not_there_is_refused_with_code_2,
    test_file_records_are_written_and_read,
    test_identification_objects_of_a_level,
    test_mask_write_keeps_the_bits_of_the_and_mask,
    test_one_identification_object,
    test_query_data_come_back,
    test_the_event_counter_counts_successful_messages,
    test_the_event_log_has_the_event_count_of_the_counter,
    test_the_exception_status_is_the_same_for_both,
    test_the_server_id_is_the_same_for_both,
)


@pytest.fixture(params=["pymodbus-rtu", "pymodbus-ascii"], scope="module")
def pair(request: pytest.FixtureRequest) -> Iterator[Pair]:
    with our_pair(request.param) as pair:
        yield pair


@pytest.fixture
def pymodbus_client(pair: Pair) -> foreign.Program:
    return pair.client


@pytest.fixture
def unit(pair: Pair) -> DeviceUnit:
    return DeviceUnit(pair.device)


@pytest.mark.clause("S16", "S17")
def test_the_counters_count_what_the_master_did_and_are_cleared_by_it(pair: Pair) -> None:
    def counter(sub_function: int) -> int:
        answer = pair.ask(f"diagnostics {sub_function}")
        assert answer["ok"], answer
        value: int = answer["data"]
        return value

    assert pair.ask("diagnostics 10")["ok"]  # 0A: clear
    assert pair.ask("read_holding_registers 0 1")["ok"]
    assert pair.ask("read_holding_registers 1000 1")["exception"] == 2
    assert counter(0x0D) == 1  # exceptions
    assert counter(0x0C) == 0  # damaged frames
    before = counter(0x0E)  # messages for this unit
    assert counter(0x0E) == before + 1
    assert counter(0x0B) >= before + 2  # messages on the line


@pytest.mark.clause("S17")
def test_a_restart_is_answered_and_clears_the_counters(pair: Pair) -> None:
    assert pair.ask("read_holding_registers 1000 1")["exception"] == 2
    assert pair.ask("diagnostics 1 0xFF00")["ok"]
    assert pair.ask("diagnostics 0x0D")["data"] == 0


@pytest.mark.clause("S17")
def test_the_ascii_delimiter_is_changed_and_changed_back_without_a_word_lost(pair: Pair) -> None:
    assert pair.ask("diagnostics 3 0x0A00") == {"ok": True, "data": 0x0A00}
    assert pair.ask("read_coils 0 1")["ok"]


def test_a_queue_is_read_in_order() -> None:
    # ASCII alone: on RTU this client takes the reply for two bytes shorter than it is.
    with our_pair("pymodbus-ascii") as pair:
        assert pair.ask("read_fifo_queue 40") == {"ok": True, "values": [440, 4740]}

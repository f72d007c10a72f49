"""Our client against pymodbus, RTU and ASCII: every other function of the specification that a server of it answers."""

from collections.abc import Callable
from typing import Any

import pytest
from test_client_with_pymodbus_server import (  # noqa: F401 - the same questions
    test_a_counter_is_two_bytes,
    test_file_records_are_registers,
    test_identification_objects_of_a_level,
    test_mask_write_keeps_the_bits_of_the_and_mask,
    test_query_data_come_back,
    test_restart_is_echoed,
    test_the_event_counter_comes_with_a_status,
    test_the_event_log_is_empty,
    test_the_exception_status_is_a_byte,
    test_the_queue_is_read_in_order,
    test_the_server_tells_its_name_and_that_it_runs,
    test_writing_file_records_is_echoed,
)


@pytest.fixture(params=["pymodbus-rtu", "pymodbus-ascii"])
def unit(request: pytest.FixtureRequest, served_lines: Any, unit_at: Callable[[str], Any]) -> Any:
    return unit_at(served_lines.url(request.param))

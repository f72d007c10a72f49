"""Our client on a serial line, blocking and asyncio, against each foreign server: what it is asked over TCP, too."""

from collections.abc import Callable
from typing import Any

import pytest
from serial_peers import SERVERS
from test_client_with_every_server import (  # noqa: F401 - the same questions
    test_a_single_coil_is_written_on_and_off,
    test_a_single_register_is_written,
    test_an_address_beyond_the_table_is_an_exception_reply_with_code_2,
    test_many_coils_are_written_and_their_neighbours_are_not,
    test_many_registers_are_written_and_their_neighbours_are_not,
    test_read_write_writes_before_it_reads,
    test_reading_a_table_gives_its_content,
    test_reading_hundreds_of_bits_gives_them_all,
)


@pytest.fixture(params=SERVERS)
def unit(request: pytest.FixtureRequest, served_lines: Any, unit_at: Callable[[str], Any]) -> Any:
    return unit_at(served_lines.url(request.param))

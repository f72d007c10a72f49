"""Our server on a serial line against each foreign client that has these functions: what it is asked over TCP, too."""

from collections.abc import Iterator

import foreign
import pytest
from serial_peers import DeviceUnit, Pair, our_pair
from test_server_with_every_client import (  # noqa: F401 - the same questions
    test_a_single_coil_is_written_on_and_off,
    test_a_single_register_is_written,
    test_an_address_beyond_the_table_is_refused_with_code_2,
    test_many_coils_are_written_and_their_neighbours_are_not,
    test_many_registers_are_written_and_their_neighbours_are_not,
    test_read_write_writes_before_it_reads,
    test_reading_a_table_gives_its_content,
    test_reading_hundreds_of_bits_gives_them_all,
)


@pytest.fixture(params=["libmodbus-rtu", "pymodbus-rtu", "pymodbus-ascii"], scope="module")
def pair(request: pytest.FixtureRequest) -> Iterator[Pair]:
    with our_pair(request.param) as pair:
        yield pair


@pytest.fixture
def client(pair: Pair) -> foreign.Program:
    return pair.client


@pytest.fixture
def unit(pair: Pair) -> DeviceUnit:
    return DeviceUnit(pair.device)

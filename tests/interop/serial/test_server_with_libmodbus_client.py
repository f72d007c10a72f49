"""Our server against libmodbus on an RTU line: functions that not every client has, and requests that it forges."""

from collections.abc import Iterator

import foreign
import pytest
from serial_peers import DeviceUnit, Pair, our_pair
from test_server_with_libmodbus_client import (  # noqa: F401 - the same questions
    test_a_forged_request_is_answered_as_the_specification_says,
    test_mask_write_keeps_the_bits_of_the_and_mask,
    test_the_server_id_is_the_same_for_both,
)


@pytest.fixture(scope="module")
def pair() -> Iterator[Pair]:
    with our_pair("libmodbus-rtu") as pair:
        yield pair


@pytest.fixture
def libmodbus_client(pair: Pair) -> foreign.Program:
    return pair.client


@pytest.fixture
def unit(pair: Pair) -> DeviceUnit:
    return DeviceUnit(pair.device)

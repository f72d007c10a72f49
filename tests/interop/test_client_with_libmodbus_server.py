"""Our client against libmodbus: the functions beyond those that every foreign server has."""

from collections.abc import Callable
from typing import Any

import foreign
import pytest

import busway


@pytest.fixture
def unit(libmodbus_server: foreign.Program, unit_at: Callable[[str], Any]) -> Any:
    return unit_at(libmodbus_server.url)


def test_mask_write_keeps_the_bits_of_the_and_mask(unit: Any) -> None:
    unit.write_single_register(800, 0x12)
    unit.mask_write_register(800, and_mask=0xF2, or_mask=0x25)
    assert unit.read_holding_registers(800, count=1) == [0x17]  # the example of the specification


def test_the_server_tells_its_name(unit: Any) -> None:
    reply = unit.report_server_id()
    assert bytes([0xB4, 0xFF]) + b"LMB" in reply  # 180, libmodbus's own server id; running; its version


@pytest.mark.parametrize("ask", ["get_comm_event_counter", "get_comm_event_log", "read_device_identification"])
def test_a_function_that_the_server_lacks_is_an_exception_reply_with_code_1(unit: Any, ask: str) -> None:
    with pytest.raises(busway.ExceptionReply) as caught:
        getattr(unit, ask)()
    assert caught.value.code == 1

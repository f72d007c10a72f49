"""Our client against libmodbus on an RTU line: the functions beyond those that every foreign server has."""

from collections.abc import Callable
from typing import Any

import pytest
from test_client_with_libmodbus_server import (  # noqa: F401 - the same questions
    test_mask_write_keeps_the_bits_of_the_and_mask,
    test_the_server_tells_its_name,
)

import busway


@pytest.fixture
def unit(served_lines: Any, unit_at: Callable[[str], Any]) -> Any:
    return unit_at(served_lines.url("libmodbus-rtu"))


@pytest.mark.clause("S2")
def test_a_broadcast_is_executed_by_the_server_and_not_waited_for(served_lines: Any) -> None:
    with busway.connect(served_lines.url("libmodbus-rtu")) as link:
        link.unit(0).write_multiple_registers(850, [0xB0, 0xAD])
        assert link.unit(1).read_holding_registers(850, count=2) == [0xB0, 0xAD]


@pytest.mark.parametrize("ask", ["get_comm_event_counter", "get_comm_event_log"])
def test_a_function_that_the_server_lacks_is_an_exception_reply_with_code_1(unit: Any, ask: str) -> None:
    # Not 43, whose length libmodbus does not know: on a line it never sees the end of such a request.
    with pytest.raises(busway.ExceptionReply) as caught:
        getattr(unit, ask)()
    assert caught.value.code == 1

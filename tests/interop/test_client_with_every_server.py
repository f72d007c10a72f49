"""Our client, blocking and asyncio, against each foreign server: the functions that all of them have."""

from collections.abc import Callable
from typing import Any

import foreign
import pytest

import busway

SERVERS = ["libmodbus_server", "pymodbus_server", "pymodbustcp_server"]


@pytest.fixture(params=SERVERS)
def unit(request: pytest.FixtureRequest, unit_at: Callable[[str], Any]) -> Any:
    return unit_at(request.getfixturevalue(request.param).url)


@pytest.mark.parametrize("table", foreign.CONTENT)
@pytest.mark.parametrize(("address", "count"), [(0, 1), (0, 9), (17, 16), (3, 125)])
def test_reading_a_table_gives_its_content(unit: Any, table: str, address: int, count: int) -> None:
    values = getattr(unit, f"read_{table}")(address, count=count)
    assert values == foreign.CONTENT[table][address : address + count]


@pytest.mark.parametrize("table", ["coils", "discrete_inputs"])
def test_reading_hundreds_of_bits_gives_them_all(unit: Any, table: str) -> None:
    assert getattr(unit, f"read_{table}")(1, count=499) == foreign.CONTENT[table][1:500]


def test_a_single_coil_is_written_on_and_off(unit: Any) -> None:
    unit.write_single_coil(500, True)
    assert unit.read_coils(500, count=1) == [True]
    unit.write_single_coil(500, False)
    assert unit.read_coils(500, count=1) == [False]


@pytest.mark.parametrize("value", [0, 1, 0x1234, 0xFFFF])
def test_a_single_register_is_written(unit: Any, value: int) -> None:
    unit.write_single_register(500, value)
    assert unit.read_holding_registers(500, count=1) == [value]


@pytest.mark.parametrize("count", [1, 8, 13, 300])
def test_many_coils_are_written_and_their_neighbours_are_not(unit: Any, count: int) -> None:
    pattern = [index % 2 == 0 for index in range(count)]
    unit.write_single_coil(520 + count, True)
    unit.write_multiple_coils(520, pattern)
    assert unit.read_coils(520, count=count + 1) == [*pattern, True]


@pytest.mark.parametrize("count", [1, 2, 123])
def test_many_registers_are_written_and_their_neighbours_are_not(unit: Any, count: int) -> None:
    values = [(index * 521 + 7) & 0xFFFF for index in range(count)]
    unit.write_single_register(520 + count, 0xBEEF)
    unit.write_multiple_registers(520, values)
    assert unit.read_holding_registers(520, count=count + 1)[-1:] == [0xBEEF] if count < 123 else True
    assert unit.read_holding_registers(520, count=count) == values


def test_read_write_writes_before_it_reads(unit: Any) -> None:
    unit.write_multiple_registers(700, [1, 2, 3, 4])
    assert unit.read_write_multiple_registers(700, count=4, write_address=701, values=[20, 30]) == [1, 20, 30, 4]


def test_an_address_beyond_the_table_is_an_exception_reply_with_code_2(unit: Any) -> None:
    with pytest.raises(busway.ExceptionReply) as caught:
        unit.read_holding_registers(foreign.ITEMS - 1, count=2)
    assert caught.value.code == 2
    assert caught.value.function == 3
    assert caught.value.unit == 1
    assert caught.value.address == foreign.ITEMS - 1

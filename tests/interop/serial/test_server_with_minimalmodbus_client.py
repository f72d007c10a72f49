"""Our server against minimalmodbus, RTU and ASCII: all that it can ask."""

from collections.abc import Iterator

import foreign
import pytest
from serial_peers import DeviceUnit, Pair, our_pair
from test_server_with_every_client import (  # noqa: F401 - the same questions
    test_a_single_coil_is_written_on_and_off,
    test_a_single_register_is_written,
    test_many_registers_are_written_and_their_neighbours_are_not,
    test_reading_a_table_gives_its_content,
    test_reading_hundreds_of_bits_gives_them_all,
)


@pytest.fixture(params=["minimalmodbus-rtu", "minimalmodbus-ascii"], scope="module")
def pair(request: pytest.FixtureRequest) -> Iterator[Pair]:
    with our_pair(request.param) as pair:
        yield pair


@pytest.fixture
def client(pair: Pair) -> foreign.Program:
    return pair.client


@pytest.fixture
def unit(pair: Pair) -> DeviceUnit:
    return DeviceUnit(pair.device)


@pytest.mark.parametrize("count", [1, 8, 13, 125])
def test_many_coils_are_written_and_their_neighbours_are_not(pair: Pair, count: int) -> None:
    pattern = [index % 2 == 0 for index in range(count)]  # 125 at most: it counts coils as registers
    pair.device.coils[520 + count] = True
    assert pair.ask(f"write_multiple_coils 520 {' '.join(str(int(bit)) for bit in pattern)}")["ok"]
    assert list(pair.device.coils[520 : 520 + count + 1]) == [*pattern, True]


def test_single_values_are_written_by_the_functions_for_many(pair: Pair) -> None:
    assert pair.ask("function_15 910 1")["ok"]
    assert pair.ask("function_16 910 4711")["ok"]
    assert (pair.device.coils[910], pair.device.holding_registers[910]) == (True, 4711)


def test_a_float_survives(pair: Pair) -> None:
    assert pair.ask("write_float 920 -5")["ok"]
    assert pair.ask("read_float 920") == {"ok": True, "value": -5.0}
    assert pair.device.read("holding:920", "float32") == -5.0


@pytest.mark.clause("S2")
def test_a_broadcast_is_executed_and_not_answered(pair: Pair) -> None:
    assert pair.ask("broadcast_register 930 99")["ok"]
    assert pair.ask("read_holding_registers 930 1")["values"] == [99]


@pytest.mark.parametrize(
    ("command", "code"),
    [("read_coils 999 2", 2), ("write_single_register 1000 1", 2), ("write_multiple_registers 999 1 1", 2)],
)
def test_an_address_beyond_the_table_is_refused(pair: Pair, command: str, code: int) -> None:
    assert pair.ask(command)["exception"] == code

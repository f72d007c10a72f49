"""Our server against each foreign client: the functions that all of them have.

What a client wrote is read back by that client and by one of ours.
"""

from collections.abc import Iterator
from typing import Any

import foreign
import pytest

import busway

CLIENTS = ["libmodbus_client", "pymodbus_client", "pymodbustcp_client"]


@pytest.fixture(params=CLIENTS, scope="module")
def client(request: pytest.FixtureRequest) -> foreign.Program:
    program: foreign.Program = request.getfixturevalue(request.param)
    return program


@pytest.fixture(scope="module")
def unit(our_url: str) -> Iterator[Any]:
    with busway.connect(our_url) as link:
        yield link.unit(1)


@pytest.mark.parametrize("table", foreign.CONTENT)
@pytest.mark.parametrize(("address", "count"), [(0, 1), (0, 9), (17, 16), (3, 125)])
def test_reading_a_table_gives_its_content(client: foreign.Program, table: str, address: int, count: int) -> None:
    answer = client.ask(f"read_{table} {address} {count}")
    assert answer == {"ok": True, "values": foreign.CONTENT[table][address : address + count]}


@pytest.mark.parametrize("table", ["coils", "discrete_inputs"])
def test_reading_hundreds_of_bits_gives_them_all(client: foreign.Program, table: str) -> None:
    assert client.ask(f"read_{table} 1 499")["values"] == foreign.CONTENT[table][1:500]


def test_a_single_coil_is_written_on_and_off(client: foreign.Program, unit: Any) -> None:
    assert client.ask("write_single_coil 500 1")["ok"]
    assert unit.read_coils(500, count=1) == [True]
    assert client.ask("write_single_coil 500 0")["ok"]
    assert client.ask("read_coils 500 1")["values"] == [False]
    assert unit.read_coils(500, count=1) == [False]


@pytest.mark.parametrize("value", [0, 1, 0x1234, 0xFFFF])
def test_a_single_register_is_written(client: foreign.Program, unit: Any, value: int) -> None:
    assert client.ask(f"write_single_register 500 {value}")["ok"]
    assert unit.read_holding_registers(500, count=1) == [value]
    assert client.ask("read_holding_registers 500 1")["values"] == [value]


@pytest.mark.parametrize("count", [1, 8, 13, 300])
def test_many_coils_are_written_and_their_neighbours_are_not(client: foreign.Program, unit: Any, count: int) -> None:
    pattern = [index % 2 == 0 for index in range(count)]
    unit.write_single_coil(520 + count, True)
    assert client.ask(f"write_multiple_coils 520 {' '.join(str(int(bit)) for bit in pattern)}")["ok"]
    assert unit.read_coils(520, count=count + 1) == [*pattern, True]
    assert client.ask(f"read_coils 520 {count}")["values"] == pattern


@pytest.mark.parametrize("count", [1, 2, 123])
def test_many_registers_are_written_and_their_neighbours_are_not(
    client: foreign.Program, unit: Any, count: int
) -> None:
    values = [(index * 521 + 7) & 0xFFFF for index in range(count)]
    unit.write_single_register(520 + count, 0xBEEF)
    assert client.ask(f"write_multiple_registers 520 {' '.join(map(str, values))}")["ok"]
    assert unit.read_holding_registers(520, count=count + 1) == [*values, 0xBEEF]
    assert client.ask(f"read_holding_registers 520 {count}")["values"] == values


def test_read_write_writes_before_it_reads(client: foreign.Program, unit: Any) -> None:
    unit.write_multiple_registers(700, [1, 2, 3, 4])
    answer = client.ask("read_write_multiple_registers 700 4 701 20 30")
    assert answer == {"ok": True, "values": [1, 20, 30, 4]}
    assert unit.read_holding_registers(700, count=4) == [1, 20, 30, 4]


@pytest.mark.parametrize(
    "command",
    [
        "read_coils 999 2",
        "read_discrete_inputs 1000 1",
        "read_holding_registers 990 11",
        "read_input_registers 65535 1",
        "write_single_coil 1000 1",
        "write_single_register 1000 1",
        "write_multiple_coils 999 1 1",
        "write_multiple_registers 999 1 1",
        "read_write_multiple_registers 0 1 999 1 1",
    ],
)
def test_an_address_beyond_the_table_is_refused_with_code_2(client: foreign.Program, command: str) -> None:
    answer = client.ask(command)
    assert (answer["ok"], answer["exception"]) == (False, 2)

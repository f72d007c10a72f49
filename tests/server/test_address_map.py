"""Finding a range among the runs of a table, and refusing requests for others."""

import threading

import pytest

from busway.codes import ExceptionCode, Table
from busway.pdu.device_interface import Refusal
from busway.server.address_map import AddressMap, map_of_bits, map_of_registers
from busway.server.table_declaration import Cells, lay_out


def sparse() -> AddressMap:
    """Registers 10…12 and 20…21, of which 11 and 20…21 are read-only."""
    cells = Cells(values={10: [1, 2, 3], 20: [4, 5]}, read_only=[(11, 1), (20, 2)])
    return map_of_registers(lay_out(cells, key="holding_registers"), threading.RLock())


@pytest.mark.parametrize(
    ("address", "count", "found"),
    [
        (10, 1, 10),
        (10, 3, 10),
        (12, 1, 10),
        (20, 2, 20),
        (21, 1, 20),
        (9, 1, None),
        (9, 2, None),
        (12, 2, None),
        (10, 11, None),
        (13, 1, None),
        (19, 2, None),
        (21, 2, None),
        (22, 1, None),
        (65535, 1, None),
        (10, 0, None),
    ],
)
def test_a_range_is_found_where_all_of_it_exists(address: int, count: int, found: int | None) -> None:
    run = sparse().find(address, count)
    assert (None if run is None else run.first) == found


def test_nothing_is_found_in_an_absent_table() -> None:
    assert AddressMap().find(0, 1) is None


@pytest.mark.parametrize(
    ("address", "count", "read_only"), [(10, 1, False), (10, 2, True), (11, 1, True), (12, 1, False), (21, 1, True)]
)
def test_one_read_only_item_makes_a_range_read_only(address: int, count: int, read_only: bool) -> None:
    assert sparse().is_read_only(address, count) is read_only


@pytest.mark.parametrize(
    ("address", "count", "writes", "sentence"),
    [
        (12, 2, False, "holding registers 12…13 do not all exist"),
        (9, 1, True, "holding registers 9…9 do not all exist"),
        (10, 0, False, "holding registers 10…9 do not all exist"),
        (10, 2, True, "holding registers 10…11 are read-only"),
    ],
)
def test_a_request_for_what_is_missing_or_read_only_is_refused_with_02(
    address: int, count: int, writes: bool, sentence: str
) -> None:
    with pytest.raises(Refusal, match=sentence) as refused:
        sparse().accessed(Table.HOLDING_REGISTERS, address, count, writes=writes)
    assert refused.value.code == ExceptionCode.ILLEGAL_DATA_ADDRESS


@pytest.mark.parametrize(("address", "count", "writes"), [(10, 3, False), (21, 1, False), (10, 1, True), (12, 1, True)])
def test_a_request_gets_the_run_that_holds_its_range(address: int, count: int, writes: bool) -> None:
    address_map = sparse()
    run = address_map.accessed(Table.HOLDING_REGISTERS, address, count, writes=writes)
    assert run is address_map.find(address, count)


def test_bits_are_packed_as_declared() -> None:
    address_map = map_of_bits(lay_out([1, 0, 0, 0, 0, 0, 0, 0, 1], key="coils", bits=True), threading.RLock())
    assert address_map.runs[0].memory.data == bytes.fromhex("01 01")
    assert address_map.count == 9

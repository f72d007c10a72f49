"""Tables as the application sees them."""

from typing import Any

import pytest

from busway.errors import InvalidRequest
from busway.server.device import Device
from busway.server.table_declaration import Cells


def test_one_item_is_read_and_written_by_its_address() -> None:
    device = Device(holding_registers=10, coils=10)
    device.holding_registers[5] = 0xBEEF
    device.coils[9] = True
    assert device.holding_registers[5] == 0xBEEF
    assert device.coils[9] is True
    assert device.coils[8] is False


def test_a_slice_is_read_and_written_as_a_list() -> None:
    device = Device(input_registers=10, discrete_inputs=[False] * 10)
    device.input_registers[5:9] = [1, 2, 3, 4]
    device.discrete_inputs[1:3] = (True, True)
    assert device.input_registers[4:10] == [0, 1, 2, 3, 4, 0]
    assert device.discrete_inputs[:4] == [False, True, True, False]


def test_a_slice_without_ends_covers_the_table_from_its_first_item() -> None:
    device = Device(holding_registers=Cells(first=100, values=[7, 8, 9]))
    assert device.holding_registers[:] == [7, 8, 9]
    assert device.holding_registers[101:] == [8, 9]
    assert device.holding_registers[101:101] == []


def test_a_sparse_table_shows_its_ranges_length_and_values() -> None:
    device = Device(holding_registers={5: [1, 2], 9: 3})
    assert device.holding_registers.ranges == ((5, 2), (9, 1))
    assert len(device.holding_registers) == 3
    assert list(device.holding_registers) == [1, 2, 3]


@pytest.mark.parametrize("key", [-1, 4, 7, 10, 65536, slice(5, 10), slice(None), slice(-3, -1), slice(9, 5)])
def test_what_does_not_exist_is_an_index_error_and_changes_nothing(key: Any) -> None:
    device = Device(holding_registers={5: [1, 2], 9: 3})
    with pytest.raises(IndexError, match="holding_registers"):
        device.holding_registers[key]
    with pytest.raises(IndexError, match="holding_registers"):
        device.holding_registers[key] = [9] * 5 if key in (slice(5, 10), slice(None)) else 9
    assert list(device.holding_registers) == [1, 2, 3]


def test_an_absent_table_holds_nothing() -> None:
    device = Device()
    assert len(device.coils) == 0
    assert device.coils[:] == []
    with pytest.raises(IndexError, match="there is nothing"):
        device.coils[0]


def test_a_slice_with_a_step_is_refused() -> None:
    with pytest.raises(IndexError, match="step"):
        Device(coils=8).coils[0:8:2]


@pytest.mark.parametrize("values", [[1], [1, 2, 3], 5, "ab", [1, 65536], [1, "2"]])
def test_values_that_do_not_fit_a_slice_are_refused_and_change_nothing(values: Any) -> None:
    device = Device(holding_registers=[7, 8])
    with pytest.raises(InvalidRequest):
        device.holding_registers[0:2] = values
    assert device.holding_registers[:] == [7, 8]


@pytest.mark.parametrize("value", [[1], (1,), "1", 65536, -1, 1.5, None])
def test_a_value_that_does_not_fit_an_item_is_refused_and_changes_nothing(value: Any) -> None:
    device = Device(holding_registers=[7])
    with pytest.raises(InvalidRequest):
        device.holding_registers[0] = value
    assert device.holding_registers[0] == 7


def test_the_application_writes_what_modbus_can_only_read() -> None:
    device = Device(holding_registers=Cells(count=2, read_only=[(0, 2)]), input_registers=2)
    device.holding_registers[0] = 5
    device.input_registers[0] = 6
    assert (device.holding_registers[0], device.input_registers[0]) == (5, 6)

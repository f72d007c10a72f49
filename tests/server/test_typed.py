"""Typed values at written addresses."""

from typing import Any

import pytest

from busway.errors import InvalidRequest
from busway.server.device import Device


def test_a_float_goes_in_and_out_in_the_order_asked_for() -> None:
    device = Device(holding_registers=200)
    device.write("4x101", 3.5, "float32", order="CDAB")
    assert device.holding_registers[100:102] == [0x0000, 0x4060]
    assert device.read("4x101", "float32", order="CDAB") == 3.5


def test_a_list_fills_consecutive_values_and_count_reads_them() -> None:
    device = Device(input_registers=10)
    device.write("3x1", [1, -2], "int32")
    assert device.input_registers[0:4] == [0, 1, 0xFFFF, 0xFFFE]
    assert device.read("3x1", "int32", count=2) == [1, -2]
    assert device.read("3x1", "int32", count=1) == [1]


def test_without_a_type_the_items_themselves_are_meant() -> None:
    device = Device(holding_registers=4, coils=4)
    device.write("4x2", [7, 8])
    device.write("0x3", True)
    assert device.read("holding:1", count=2) == [7, 8]
    assert device.read("%MW1") == 7
    assert device.read("coil:0", count=4) == [False, False, True, False]


def test_one_bit_of_a_register_is_changed_alone() -> None:
    device = Device(holding_registers=[0x00FF])
    device.write("4x1.15", True)
    device.write("4x1.0", False)
    assert device.holding_registers[0] == 0x80FE
    assert device.read("4x1.15") is True
    assert device.read("4x1.0") is False


def test_typed_values_take_part_in_a_group() -> None:
    device = Device(holding_registers=[0, 0])
    with device.update():
        device.write("4x1.3", True)
        device.write("4x2", 5, "uint16")
        assert device.read("4x1", count=2) == [8, 5]
    assert device.holding_registers[:] == [8, 5]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("4x3", 1), "there is no 2"),
        (("4x2", 1.0, "float32"), "there is no 1…2"),
        (("4x1", 70000, "uint16"), "does not fit uint16"),
        (("4x1", 65536), "0…65535"),
        (("4x1", 1, "float33"), "float33"),
        (("101", 1), "does not say which table"),
        ((5, 1), "does not say which table"),
        (("0x1", 1, "uint16"), "one bit and has no type"),
        (("0x1", "off"), "True or False"),
        (("4x1.3", True, "uint16"), "has no type"),
        (("4x1.3", 2), "a bit must be True or False, not 2"),
        (("4x1.3", [True]), "a bit must be True or False"),
        (("nonsense", 1), "is no address"),
    ],
)
def test_a_write_that_cannot_be_is_refused_and_changes_nothing(arguments: tuple[Any, ...], sentence: str) -> None:
    device = Device(holding_registers=2, coils=1)
    with pytest.raises(InvalidRequest) as caught:
        device.write(*arguments)
    assert sentence in str(caught.value)
    assert (*device.holding_registers, *device.coils) == (0, 0, False)


@pytest.mark.parametrize(
    ("arguments", "count", "sentence"),
    [
        (("4x1",), 0, "1 or more"),
        (("4x1",), True, "1 or more"),
        (("4x1",), 3, "there is no 0…2"),
        (("4x2", "float32"), None, "there is no 1…2"),
    ],
)
def test_a_read_that_cannot_be_is_refused(arguments: tuple[Any, ...], count: Any, sentence: str) -> None:
    with pytest.raises(InvalidRequest) as caught:
        Device(holding_registers=2).read(*arguments, count=count)
    assert sentence in str(caught.value)

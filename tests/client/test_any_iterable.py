"""What a write takes for several values: anything that has an order, and nothing that only looks like it."""

from array import array
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import pytest

import busway
from busway.client.operations import write_values
from busway.pdu.message import Request


def request_of(operation: Iterator[Any]) -> Request:
    (request,) = next(operation)
    assert isinstance(request, Request)
    return request


def written(address: str, values: object) -> Request:
    return request_of(write_values(address, values, None, "ABCD", "auto"))


@pytest.mark.parametrize(
    "make",
    [
        lambda: (n for n in (3, 4, 5)),
        lambda: range(3, 6),
        lambda: iter([3, 4, 5]),
        lambda: array("H", (3, 4, 5)),
        lambda: map(int, "345"),
    ],
)
def test_registers_come_from_any_iterable(make: Callable[[], Iterable[int]]) -> None:
    wanted = busway.WriteMultipleRegisters.of(0, [3, 4, 5])
    assert busway.WriteMultipleRegisters.of(0, make()) == wanted
    assert written("4x1", make()) == wanted
    assert busway.ReadWriteMultipleRegisters.of(0, 1, 0, make()) == busway.ReadWriteMultipleRegisters.of(
        0, 1, 0, [3, 4, 5]
    )
    assert busway.WriteFileRecord.of(1, 0, make()) == busway.WriteFileRecord.of(1, 0, [3, 4, 5])


def test_coils_come_from_a_generator() -> None:
    wanted = busway.WriteMultipleCoils.of(0, [True, False, True])
    assert busway.WriteMultipleCoils.of(0, (bit == "1" for bit in "101")) == wanted
    assert written("0x1", (bit == "1" for bit in "101")) == wanted


@pytest.mark.parametrize("values", [{1, 2}, frozenset((1, 2)), {1: 2}, b"\x01\x02", "12"])
def test_what_has_no_order_or_is_one_value_is_refused(values: object) -> None:
    for address in ("4x1", "0x1"):
        with pytest.raises(busway.InvalidRequest):
            written(address, values)


def forever() -> Iterator[int]:
    while True:
        yield 1


def test_values_without_an_end_are_refused() -> None:
    for build in (
        lambda: busway.WriteMultipleRegisters.of(0, forever()),
        lambda: busway.WriteMultipleCoils.of(0, (bool(one) for one in forever())),
        lambda: written("4x1", forever()),
        lambda: busway.WriteMultipleRegisters.of(0, range(10**12)),
    ):
        with pytest.raises(busway.InvalidRequest, match="more than the 65536 that a device has"):
            build()

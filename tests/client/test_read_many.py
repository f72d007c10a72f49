"""`Unit.read_many`: which requests it sends, and what it gives."""

from collections.abc import Iterator
from typing import Any

import pytest

import busway
from busway.client.read_many import read_together
from busway.errors import InvalidRequest

WANTED: dict[str, Any] = {
    "temperature": ("4x3", "float32"),
    "speed": "4x1",
    "alarms": ("4x2", "bits"),
    "mode": "4x2.1",
    "name": ("4x101", busway.string(4)),
    "input": ("3x1", "int16", 2),
    "on": "0x10",
    "flags": ("0x8", None, 2),
}


@pytest.fixture
def url() -> Iterator[str]:
    device = busway.Device(coils=20, holding_registers=200, input_registers=5)
    device.write("4x1", 7)
    device.write("4x2", 0b10)
    device.write("4x3", 1.5, "float32")
    device.write("4x101", "abcd", "string:4")
    device.write("3x1", -1, "int16")
    device.write("3x2", 5, "int16")
    device.write("0x10", True)
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device}) as server:
        yield server.endpoints[0]


FOUND = {
    "temperature": 1.5,
    "speed": 7,
    "alarms": (False, True, *[False] * 14),
    "mode": True,
    "name": "abcd",
    "input": [-1, 5],
    "on": True,
    "flags": [False, False],
}


def test_values_come_by_name_and_in_the_order_of_the_names(url: str) -> None:
    with busway.connect(url) as link:
        found = link.unit(1).read_many(WANTED)
        assert found == FOUND
        assert list(found) == list(WANTED)
        assert link.counters.requests == 4


async def test_the_asyncio_interface_gives_the_same(url: str) -> None:
    async with busway.open(url) as link:
        assert await link.unit(1).read_many(WANTED) == FOUND


def asked(wanted: dict[str, Any]) -> list[tuple[str, int, int]]:
    """The requests: class, first item, number of items."""
    requests: list[Any] = list(next(read_together(wanted, "ABCD")))
    return [(type(one).__name__, one.address, one.count) for one in requests]


def test_ranges_that_touch_are_one_request_and_holes_are_not_read() -> None:
    assert asked({"a": "4x1", "b": ("4x2", "uint32"), "c": "4x5"}) == [
        ("ReadHoldingRegisters", 0, 3),
        ("ReadHoldingRegisters", 4, 1),
    ]


def test_ranges_that_overlap_are_one_request() -> None:
    assert asked({"a": ("4x1", None, 10), "b": ("4x3", "float32"), "c": "4x1.15"}) == [("ReadHoldingRegisters", 0, 10)]


def test_a_request_ends_where_it_is_full_and_no_value_is_cut() -> None:
    wanted = {f"v{index}": (f"4x{1 + 4 * index}", "float64") for index in range(40)}
    assert asked(wanted) == [("ReadHoldingRegisters", 0, 124), ("ReadHoldingRegisters", 124, 36)]


def test_tables_are_asked_each_by_itself() -> None:
    assert {kind for kind, _, _ in asked({"a": "0x1", "b": "1x1", "c": "3x1", "d": "4x1"})} == {
        "ReadCoils",
        "ReadDiscreteInputs",
        "ReadInputRegisters",
        "ReadHoldingRegisters",
    }


def test_nothing_wanted_is_nothing_asked() -> None:
    with busway.connect("tcp://127.0.0.1:1") as link:
        assert link.unit(1).read_many({}) == {}


@pytest.mark.parametrize(
    ("wanted", "sentence"),
    [
        ("101", "v: address '101' does not say which table"),
        (("4x1", "float33"), "v: unknown type 'float33'"),
        (("0x1", "uint16"), "v: 0x1: a coil is one bit and has no type uint16"),
        (("4x1", "uint16", 126), "v: 4x1: 126 holding registers are more than the 125 of one request"),
        (("4x65536", "uint32"), "v: 4x65536: 2 holding registers end beyond the last one, 65536"),
        (("4x1", "uint16", 0), "v: count must be at least 1, not 0"),
        (("4x1", "uint16", 1, 2), "v: an address, a type and a count are wanted"),
    ],
)
def test_what_cannot_be_names_the_name_and_nothing_is_sent(wanted: Any, sentence: str) -> None:
    with busway.connect("tcp://127.0.0.1:1") as link, pytest.raises(InvalidRequest) as caught:
        link.unit(1).read_many({"good": "4x1", "v": wanted})
    assert caught.value.message.startswith(sentence)


def test_wide_registers_are_refused() -> None:
    with pytest.raises(InvalidRequest, match="needs registers of 2 bytes, not of 4"):
        next(read_together({"a": "4x1"}, "ABCD", 4))

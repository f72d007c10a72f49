"""`Unit.read_many`: which requests it sends, and what it gives."""

from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import busway
from busway.client.read_many import read_together
from busway.errors import InvalidRequest
from busway.pdu.bits import pack_bits
from busway.pdu.read_items import ReadCoils
from busway.values import value_type

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


KINDS = ["int16", "uint16", "float32", "int32", "uint64", "bit:0", "bit:3", "bit:12", "bits", "string:3", "int8:high"]
ORDERS = ["ABCD", "BADC", "CDAB", "DCBA"]
MEMORY = bytes(value * 37 % 95 + 32 for value in range(400))
"""200 registers; each byte is a character, so that strings can be decoded."""


@st.composite
def wanted_values(draw: st.DrawFn) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for number in range(draw(st.integers(1, 25))):
        at = draw(st.integers(1, 90))
        if draw(st.integers(0, 9)) == 0:
            found[f"coil {number}"] = (f"0x{at}", None, draw(st.none() | st.integers(1, 20)))
        else:
            order = draw(st.sampled_from(ORDERS))
            found[f"value {number}"] = (
                f"4x{at}",
                value_type(draw(st.sampled_from(KINDS)), order),
                draw(st.none() | st.integers(1, 5)),
            )
    return found


def values_of(asked: dict[str, Any]) -> dict[str, Any]:
    """What `read_many` makes of a device whose registers and coils are `MEMORY`."""
    steps = read_together(asked, "ABCD")
    requests = next(steps)
    coils = [bool(byte & 1) for byte in MEMORY]
    replies = [
        type(one).Reply(pack_bits(coils[one.address : one.address + one.count]))
        if isinstance(one, ReadCoils)
        else type(one).Reply(MEMORY[2 * one.address : 2 * (one.address + one.count)])
        for one in requests
    ]
    with pytest.raises(StopIteration) as ended:
        steps.send(replies)
    return dict(ended.value.value)


@given(wanted_values())
def test_values_read_together_are_those_read_one_by_one(asked: dict[str, Any]) -> None:
    expected: dict[str, Any] = {}
    for name, (address, form, count) in asked.items():
        at, number = int(address[2:]) - 1, count or 1
        if form is None:
            found = [bool(byte & 1) for byte in MEMORY[at : at + number]]
        else:
            found = form.decode(MEMORY[2 * at : 2 * (at + number * form.registers)])
        expected[name] = found[0] if count is None else found
    for _ in range(2):  # the second time the requests are known
        assert repr(values_of(asked)) == repr(expected)  # repr: a float may be no number


def test_names_that_are_asked_again_with_another_address_or_order_are_read_there() -> None:
    first = {"a": ("4x1", "uint16"), "b": "4x2"}
    assert values_of(first) != values_of(first | {"b": "4x3"})
    assert values_of({"a": ("4x1", "uint32")}) != values_of({"a": ("4x1", value_type("uint32", "DCBA"))})
    changed = dict(first)
    values_of(changed)
    changed["a"] = ("4x5", "uint16")
    assert values_of(changed)["a"] == int.from_bytes(MEMORY[8:10], "big")

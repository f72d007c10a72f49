"""Which line and unit a request belongs to."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

import busway
from busway.codes import Table
from busway.errors import ConfigError
from busway.gateway.routes import Action, AddressRange, FrontRoutes, Route, RoutingTable, Straddles, units_text
from busway.pdu.general import OpaqueRequest

HOLDING = Table.HOLDING_REGISTERS


def _find(routes: list[Route], unit: int, request: busway.Request) -> Route | Straddles | None:
    return FrontRoutes(routes).find(unit, request)


def test_the_first_route_that_fits_decides() -> None:
    first, second = Route(line="a", units=frozenset({1})), Route(line="b")
    read = busway.ReadHoldingRegisters(0, 1)
    assert _find([first, second], 1, read) is first
    assert _find([first, second], 2, read) is second


def test_a_unit_without_a_route_has_none() -> None:
    assert _find([Route(line="a", units=frozenset({1}))], 2, busway.ReadHoldingRegisters(0, 1)) is None


def test_a_route_may_take_some_functions_only() -> None:
    reads = Route(line="a", functions=frozenset({3, 4}))
    assert _find([reads], 1, busway.ReadHoldingRegisters(0, 1)) is reads
    assert _find([reads], 1, busway.WriteSingleRegister(0, 1)) is None


@pytest.mark.parametrize(
    ("request_", "taken"),
    [
        (busway.ReadHoldingRegisters(100, 10), True),
        (busway.ReadHoldingRegisters(109, 1), True),
        (busway.ReadHoldingRegisters(110, 1), False),
        (busway.ReadHoldingRegisters(90, 10), False),
        (busway.ReadInputRegisters(100, 1), False),
        (busway.MaskWriteRegister(105, 0, 1), True),
        (busway.ReadWriteMultipleRegisters.of(100, 2, 108, [1, 2]), True),
        (OpaqueRequest(0x41, b"\x00\x64"), False),
        (busway.ReportServerId(), False),
    ],
)
def test_a_range_takes_what_lies_wholly_within_it(request_: busway.Request, taken: bool) -> None:
    route = Route(line="a", addresses=AddressRange(HOLDING, 100, 110))
    assert _find([route], 1, request_) == (route if taken else None)


@pytest.mark.parametrize(
    "request_",
    [
        busway.ReadHoldingRegisters(99, 2),
        busway.ReadHoldingRegisters(105, 10),
        busway.ReadHoldingRegisters(90, 40),
        busway.ReadWriteMultipleRegisters.of(0, 2, 108, [1, 2]),
    ],
)
def test_what_lies_across_the_edge_of_a_range_fits_nowhere(request_: busway.Request) -> None:
    route = Route(line="a", addresses=AddressRange(HOLDING, 100, 110))
    assert _find([route, Route(line="b")], 1, request_) == Straddles(route)


def test_a_route_that_can_never_be_reached_is_refused_by_name() -> None:
    with pytest.raises(ConfigError, match="never reached: 'all of it'") as error:
        RoutingTable((Route(line="a", name="all of it"), Route(line="b", units=frozenset({7}))))
    assert error.value.key == "route[1]"


def test_routes_of_different_fronts_do_not_hide_each_other() -> None:
    table = RoutingTable((Route(line="a", fronts=frozenset({"x"})), Route(line="b", fronts=frozenset({"y"}))))
    read = busway.ReadCoils(0, 1)
    assert [table.of_front(name).find(1, read).line for name in "xy"] == ["a", "b"]  # type: ignore[union-attr]
    assert table.of_front("z").units == frozenset()


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"line": "a", "action": Action.DROP}, "line"),
        ({}, "line"),
        ({"line": "a", "units": frozenset()}, "units"),
        ({"line": "a", "units": frozenset({300})}, "units"),
        ({"line": "a", "unit_offset": 1}, "unit_offset"),
        ({"line": "a", "unit": 256}, "unit"),
        ({"line": "a", "units": frozenset({1}), "unit": 2, "unit_offset": 1}, "unit_offset"),
        ({"line": "a", "max_registers": 0}, "max_registers"),
        ({"line": "a", "cache": -1.0}, "cache"),
        ({"action": Action.REFUSE, "code": 0}, "code"),
    ],
)
def test_a_route_that_can_not_be_is_refused(options: dict[str, object], key: str) -> None:
    with pytest.raises(ConfigError) as error:
        Route(**options)  # type: ignore[arg-type]
    assert error.value.key == key


@given(st.frozensets(st.integers(0, 255), min_size=1))
def test_units_are_written_so_that_they_can_be_read_back(units: frozenset[int]) -> None:
    found: set[int] = set()
    for part in units_text(units).split(", "):
        first, _, last = part.partition("-")
        found |= set(range(int(first), int(last or first) + 1))
    assert found == units

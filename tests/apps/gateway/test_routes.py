"""Which line and unit a request belongs to."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

import busway
from busway.apps.gateway.routes import (
    AddressRange,
    ListenerRoutes,
    Route,
    RouteAction,
    RoutingTable,
    Straddles,
    units_text,
)
from busway.codes import Table
from busway.errors import ConfigError
from busway.pdu.unknown_functions import OpaqueRequest

HOLDING = Table.HOLDING_REGISTERS


def _find(routes: list[Route], unit: int, request: busway.Request) -> Route | Straddles | None:
    return ListenerRoutes(routes).find(unit, request)


def test_the_first_route_that_fits_decides() -> None:
    first, second = Route(upstream="a", units=frozenset({1})), Route(upstream="b")
    read = busway.ReadHoldingRegisters(0, 1)
    assert _find([first, second], 1, read) is first
    assert _find([first, second], 2, read) is second


def test_a_unit_without_a_route_has_none() -> None:
    assert _find([Route(upstream="a", units=frozenset({1}))], 2, busway.ReadHoldingRegisters(0, 1)) is None


def test_a_route_may_take_some_functions_only() -> None:
    reads = Route(upstream="a", functions=frozenset({3, 4}))
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
    route = Route(upstream="a", addresses=AddressRange(HOLDING, 100, 110))
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
    route = Route(upstream="a", addresses=AddressRange(HOLDING, 100, 110))
    assert _find([route, Route(upstream="b")], 1, request_) == Straddles(route)


def test_a_route_that_can_never_be_reached_is_refused_by_name() -> None:
    with pytest.raises(ConfigError, match="never reached: 'all of it'") as error:
        RoutingTable((Route(upstream="a", name="all of it"), Route(upstream="b", units=frozenset({7}))))
    assert error.value.key == "route[1]"


def test_routes_of_different_listeners_do_not_hide_each_other() -> None:
    table = RoutingTable(
        (Route(upstream="a", listeners=frozenset({"x"})), Route(upstream="b", listeners=frozenset({"y"})))
    )
    read = busway.ReadCoils(0, 1)
    assert [table.of_listener(name).find(1, read).upstream for name in "xy"] == ["a", "b"]  # type: ignore[union-attr]
    assert table.of_listener("z").units == frozenset()


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"upstream": "a", "action": RouteAction.DROP}, "upstream"),
        ({}, "upstream"),
        ({"upstream": "a", "units": frozenset()}, "units"),
        ({"upstream": "a", "units": frozenset({300})}, "units"),
        ({"upstream": "a", "unit_offset": 1}, "unit_offset"),
        ({"upstream": "a", "unit": 256}, "unit"),
        ({"upstream": "a", "units": frozenset({1}), "unit": 2, "unit_offset": 1}, "unit_offset"),
        ({"upstream": "a", "max_registers": 0}, "max_registers"),
        ({"upstream": "a", "cache": -1.0}, "cache"),
        ({"action": RouteAction.REFUSE, "code": 0}, "code"),
    ],
)
def test_a_route_that_cannot_be_is_refused(options: dict[str, object], key: str) -> None:
    with pytest.raises(ConfigError) as error:
        Route(**options)  # type: ignore[arg-type]
    assert error.value.key == key


EDGES = st.integers(0, 40)


@st.composite
def _ranges(draw: st.DrawFn) -> AddressRange | None:
    first, end = sorted(draw(st.lists(EDGES, min_size=2, max_size=2, unique=True)))
    table = draw(st.sampled_from([HOLDING, HOLDING, Table.COILS]))
    return draw(st.sampled_from([AddressRange(table, first, end)] * 9 + [None]))


ROUTES = st.lists(
    st.builds(
        Route,
        upstream=st.just("a"),
        functions=st.sampled_from([frozenset(), frozenset({3}), frozenset({3, 6, 16}), frozenset({1, 23})]),
        addresses=_ranges(),
        shift=st.integers(0, 1000),  # tells them apart
    ),
    max_size=12,
)
REQUESTS = st.one_of(
    st.builds(busway.ReadHoldingRegisters, EDGES, st.integers(1, 25)),
    st.builds(busway.ReadCoils, EDGES, st.integers(1, 25)),
    st.builds(busway.ReadInputRegisters, EDGES, st.integers(1, 25)),
    st.builds(busway.WriteSingleRegister, EDGES, st.just(1)),
    st.builds(lambda at, to: busway.ReadWriteMultipleRegisters.of(at, 3, to, [1, 2]), EDGES, EDGES),
    st.just(busway.ReadHoldingRegisters(65_530, 6)),
    st.just(busway.ReportServerId()),
    st.just(OpaqueRequest(0x41, b"\0\0")),
)


def _walked(routes: list[Route], request: busway.Request) -> Route | Straddles | None:
    """The rules, as they are written: one route after the other."""
    code = request.function if isinstance(request, OpaqueRequest) else request.code
    spans = () if isinstance(request, OpaqueRequest) else request.spans()
    for route in routes:
        taken = route.addresses
        if route.functions and code not in route.functions:
            continue
        if taken is None:
            return route
        same = [span for span in spans if span.table is taken.table]
        if any(span.address < taken.end and taken.first < span.address + span.count for span in same):
            whole = all(taken.first <= span.address and span.address + span.count <= taken.end for span in same)
            return route if whole and len(same) == len(spans) else Straddles(route)
    return None


@given(ROUTES, st.lists(REQUESTS, min_size=1, max_size=8))
def test_a_route_that_is_found_by_address_is_the_first_that_fits(
    routes: list[Route], requests: list[busway.Request]
) -> None:
    found = ListenerRoutes(routes)
    for request in requests:
        assert found.find(1, request) == _walked(routes, request)


def test_many_ranges_of_one_unit_are_not_looked_through(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: object) -> None:
        raise AssertionError("looked through")

    monkeypatch.setattr(ListenerRoutes, "_looked_through", never)
    routes = [Route(upstream="a", addresses=AddressRange(HOLDING, 10 * n, 10 * n + 10), shift=n) for n in range(500)]
    found = ListenerRoutes(routes)
    assert found.find(1, busway.ReadHoldingRegisters(4321, 9)) is routes[432]
    assert found.find(1, busway.ReadHoldingRegisters(4321, 10)) == Straddles(routes[432])
    assert found.find(1, busway.ReadHoldingRegisters(5000, 1)) is None


@given(st.frozensets(st.integers(0, 255), min_size=1))
def test_units_are_written_so_that_they_can_be_read_back(units: frozenset[int]) -> None:
    found: set[int] = set()
    for part in units_text(units).split(", "):
        first, _, last = part.partition("-")
        found |= set(range(int(first), int(last or first) + 1))
    assert found == units

"""What a coil takes: True, False, 1 and 0. Anything else is refused before a byte leaves, by every way in."""

import socket
from collections.abc import Iterator
from typing import Any

import pytest
from client_kinds import CLIENT_KINDS, ClientKind

import busway
from busway import InvalidRequest
from busway.server.table_view import TableView

NO_STATES = ["off", "on", "", "0", "1", 2, -1, 0xFF00, None, 1.0, 0.0, b"\x00", object(), [False]]


@pytest.fixture
def closed_url() -> Iterator[str]:
    """URL of a port without a listener: what is sent there ends as `LinkDown`."""
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        yield f"tcp://127.0.0.1:{holder.getsockname()[1]}"


@pytest.fixture(params=CLIENT_KINDS, ids=lambda via: via.name)
def via(request: pytest.FixtureRequest) -> ClientKind:
    return request.param


def test_a_client_refuses_what_is_no_state_before_anything_is_sent(via: ClientKind, closed_url: str) -> None:
    with via.link(closed_url) as link:
        unit = link.unit(1)
        for value in NO_STATES:
            with pytest.raises(InvalidRequest, match="True or False"):
                unit.write_single_coil(0, value)
            with pytest.raises(InvalidRequest, match="value 2 must be True or False"):
                unit.write_multiple_coils(0, [True, value])
            with pytest.raises(InvalidRequest):
                unit.write("0x1", [value] if isinstance(value, list) else value)  # a list holds several
            with pytest.raises(InvalidRequest, match="value 2 must be True or False"):
                unit.write("0x1", [True, value])
            with pytest.raises(InvalidRequest):
                unit.write("4x1.3", value)


@pytest.mark.parametrize("values", ["on", "10", None, 5, True])
def test_one_value_is_no_sequence_of_states(via: ClientKind, closed_url: str, values: Any) -> None:
    with via.link(closed_url) as link, pytest.raises(InvalidRequest, match="sequence of True and False"):
        link.unit(1).write_multiple_coils(0, values)


@pytest.mark.parametrize("value", NO_STATES)
def test_a_request_is_not_made_of_what_is_no_state(value: Any) -> None:
    with pytest.raises(InvalidRequest):
        busway.WriteSingleCoil.of(0, value)
    with pytest.raises(InvalidRequest):
        busway.WriteMultipleCoils.of(0, [value])
    if value not in (0, 0xFF00):  # what the wire has for off and on
        with pytest.raises(InvalidRequest):
            busway.WriteSingleCoil(0, value)


@pytest.mark.parametrize("table", ["coils", "discrete_inputs"])
@pytest.mark.parametrize("value", NO_STATES[:-1])
def test_a_device_refuses_what_is_no_state_and_keeps_what_it_holds(table: str, value: Any) -> None:
    device = busway.Device(coils=[True, False], discrete_inputs=[True, False])
    view: TableView = getattr(device, table)
    address = {"coils": "0x1", "discrete_inputs": "1x1"}[table]
    for write in (
        lambda: device.write(address, value),
        lambda: device.write(address, [False, value]),
        lambda: view.write(0, [value]),
        lambda: view.__setitem__(0, value),
        lambda: view.__setitem__(slice(0, 2), [False, value]),
    ):
        with pytest.raises(InvalidRequest, match="True or False"):
            write()
    assert view[:] == [True, False]


class _Boolean:
    """A boolean as numpy has it: no integer, and not Python's."""

    def __init__(self, state: bool) -> None:
        self._state = state

    def __bool__(self) -> bool:
        return self._state


_Boolean.__module__, _Boolean.__name__ = "numpy", "bool_"


class _Number:
    """An integer of another type."""

    def __init__(self, number: int) -> None:
        self._number = number

    def __index__(self) -> int:
        return self._number


@pytest.mark.parametrize(
    ("on", "off"), [(True, False), (1, 0), (_Boolean(True), _Boolean(False)), (_Number(1), _Number(0))]
)
def test_booleans_and_the_numbers_1_and_0_are_states_by_every_way_in(via: ClientKind, on: Any, off: Any) -> None:
    device = busway.Device(coils=4, holding_registers=1)
    with (
        busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device}) as server,
        via.link(server.endpoints[0]) as link,
    ):
        unit = link.unit(1)
        unit.write_single_coil(0, on)
        unit.write_multiple_coils(1, [on, off, on])
        assert device.coils[:] == [True, True, False, True]
        unit.write("0x1", off)
        unit.write("0x2", [off, on])
        unit.write("4x1.3", on)
        assert device.coils[:] == [False, False, True, True]
        assert device.holding_registers[:] == [8]
    device.write("0x1", [on, off])
    assert device.coils[0:2] == [True, False]

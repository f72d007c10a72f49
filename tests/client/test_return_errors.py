"""`execute_many(return_errors=True)` returns errors also where nothing could be sent."""

from typing import Any

import pytest
from client_kinds import CLIENT_KINDS, AnyLink, ClientKind
from failing_sockets import Fault, Wire, WireConnector, connected_by

import busway

ENDPOINT = "tcp://127.0.0.1:9"
LONG = 30.0
REQUESTS = [busway.ReadHoldingRegisters(7, 1), busway.WriteSingleRegister(8, 1), busway.ReadHoldingRegisters(9, 1)]
PLACES = [(3, 7), (6, 8), (3, 9)]


@pytest.fixture(params=CLIENT_KINDS, ids=lambda via: via.name)
def via(request: pytest.FixtureRequest) -> ClientKind:
    found: ClientKind = request.param
    return found


def assert_refused(link: AnyLink, kind: type[busway.ModbusError], **call: Any) -> None:
    """Each request has an error of its own, which names it; without ``return_errors`` there is one for all."""
    outcomes = link.unit(1).execute_many(REQUESTS, return_errors=True, **call)
    assert [type(one) for one in outcomes] == [kind] * 3
    assert len({id(one) for one in outcomes}) == 3
    assert [(one.function, one.address) for one in outcomes] == PLACES
    assert {one.endpoint for one in outcomes} == {link.real.endpoint.url}
    assert {one.unit for one in outcomes} == {1}
    with pytest.raises(kind):
        link.unit(1).execute_many(REQUESTS, **call)


def test_while_the_next_attempt_to_connect_is_not_due(via: ClientKind) -> None:
    wire = Wire({0: Fault.REFUSED})
    options = {"shared": False, "reconnect_first": LONG, "reconnect_most": LONG}
    with connected_by(WireConnector(wire)), via.link(ENDPOINT, **options) as link:
        with pytest.raises(busway.LinkDown, match="nothing listens there"):
            link.unit(1).read_holding_registers(0, count=1)
        assert link.state == "backing off"
        assert_refused(link, busway.LinkDown)
        (error, *_) = link.unit(1).execute_many(REQUESTS, return_errors=True)
        assert not error.sent
        assert "the next attempt is made in" in str(error)
        assert isinstance(error.__cause__, busway.LinkDown)
    assert wire.operations == ["connect"]


def test_while_the_queue_is_full(via: ClientKind) -> None:
    wire = Wire({})
    with connected_by(WireConnector(wire)), via.link(ENDPOINT, shared=False) as link:
        assert link.unit(1).read_holding_registers(5, count=1) == [5]
        link.real._link.session.queue.limit = 0
        assert_refused(link, busway.Overloaded)
    wire.close()


def test_while_the_breaker_of_the_unit_is_open(via: ClientKind) -> None:
    wire = Wire({1: Fault.SILENT})
    options = {"shared": False, "timeout": 0.01, "retries": 0, "open_after": 1, "first_pause": LONG}
    options["longest_pause"] = LONG
    with connected_by(WireConnector(wire)), via.link("rtu+tcp://127.0.0.1:9", **options) as link:
        with pytest.raises(busway.NoReply):
            link.unit(1).read_holding_registers(5, count=1)
        assert_refused(link, busway.UnitSuspended)
        (error, *_) = link.unit(1).execute_many(REQUESTS, return_errors=True)
        assert 0 < error.next_probe <= LONG
    wire.close()


def test_a_call_that_is_wrong_is_raised(via: ClientKind) -> None:
    with connected_by(WireConnector(Wire({}))), via.link("rtu+tcp://127.0.0.1:9", shared=False) as link:
        unit = link.unit(0)
        with pytest.raises(busway.InvalidRequest):  # a read that is a broadcast
            unit.execute_many(REQUESTS, return_errors=True)
        with pytest.raises(busway.InvalidRequest, match="unknown option"):
            unit.execute_many(REQUESTS, return_errors=True, adaptive_timeout=3)

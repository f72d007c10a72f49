"""The sequence of the client (Messaging on TCP/IP V1.0b §5.3): whatever the network does inside it, the transaction
ends with a reason, its resources are free, and the next one works."""

import gc
import socket
from typing import Any

import pytest
from client_kinds import CLIENT_KINDS, AnyLink, ClientKind
from handles import open_handles

import busway
from busway.testing import faulty_server, known_device

AMPLE = 5.0
SHORT = 0.05


@pytest.fixture(params=CLIENT_KINDS, ids=lambda via: via.name)
def via(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> ClientKind:
    monkeypatch.setattr("busway.client.blocking_link._IDLE_SECONDS", 0.0)
    found: ClientKind = request.param
    return found


def session_of(link: AnyLink) -> Any:
    """What holds the transactions of a link."""
    return link.real._link.session


def assert_free(link: AnyLink, limit: int = 4) -> None:
    """No transaction is left: nothing is in flight or waits, and every place is free."""
    session = session_of(link)
    assert (session.in_flight, session.queued, len(session._free)) == (0, 0, limit)
    assert not session.finished
    assert session.deadline() is None


FAILURES = {
    "the peer closes before the reply": ("execute-then-drop", {}, busway.WriteOutcomeUnknown, busway.LinkDown),
    "no reply comes": ("wedged", {}, busway.WriteOutcomeUnknown, busway.NoReply),
    "part of a reply comes": ("short", {"missing": 2, "header": True}, busway.WriteOutcomeUnknown, busway.NoReply),
    "another reply comes": ("wrong-echo", {}, busway.WriteOutcomeUnknown, busway.BadReply),
    "the device refuses": ("busy", {}, busway.ExceptionReply, type(None)),
}
"""By what happens to a write: the fault profile that does it, the error of the call, and its cause."""


@pytest.mark.clause("T21", "T37", "A21")
@pytest.mark.parametrize("failure", list(FAILURES))
def test_a_failure_inside_a_transaction_ends_it_with_its_reason_and_the_next_one_works(
    via: ClientKind, failure: str
) -> None:
    name, options, error, cause = FAILURES[failure]
    with (
        faulty_server(known_device()) as server,
        via.link(server.endpoint, timeout=SHORT, retries=0, max_transactions=4) as link,
    ):
        unit = link.unit(1)
        assert unit.read_holding_registers(1, count=1, timeout=AMPLE) == [1]
        fault = server.add(name, **options)
        with pytest.raises(error) as caught:
            unit.write_single_register(900, 1)
        assert isinstance(caught.value.__cause__, cause)
        assert (caught.value.endpoint, caught.value.unit, caught.value.function) == (server.endpoint, 1, 6)
        assert str(caught.value)
        link.breathe()
        assert_free(link)
        fault.off()
        assert unit.read_holding_registers(2, count=1, timeout=AMPLE, retries=3) == [2]
        assert_free(link)


@pytest.mark.clause("T21", "T37")
def test_a_connection_that_cannot_be_had_ends_the_transaction_before_anything_is_sent(via: ClientKind) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        with via.link(f"tcp://127.0.0.1:{probe.getsockname()[1]}", max_transactions=4) as link:
            with pytest.raises(busway.LinkDown, match="nothing listens there") as caught:
                link.unit(1).write_single_register(0, 1)
            assert not caught.value.sent
            assert isinstance(caught.value.__cause__, OSError)
            assert_free(link)


@pytest.mark.clause("T19", "T37")
def test_a_host_that_does_not_answer_ends_the_transaction_with_the_connect_timeout(via: ClientKind) -> None:
    with socket.socket() as full:
        full.bind(("127.0.0.1", 0))
        full.listen(0)
        callers = []
        try:
            for _ in range(4):  # so many that the system lets no more in
                caller = socket.socket()
                caller.setblocking(False)
                caller.connect_ex(full.getsockname())
                callers.append(caller)
            endpoint = f"tcp://127.0.0.1:{full.getsockname()[1]}"
            with via.link(endpoint, connect_timeout=SHORT, max_transactions=4) as link:
                with pytest.raises(busway.LinkDown, match="no connection within the connect timeout"):
                    link.unit(1).read_holding_registers(0, count=1)
                assert_free(link)
        finally:
            for caller in callers:
                caller.close()


@pytest.mark.clause("T37")
def test_a_name_that_cannot_be_resolved_ends_the_transaction_with_that_reason(via: ClientKind) -> None:
    with via.link("tcp://no-such-host.invalid", max_transactions=4, connect_timeout=30.0) as link:
        with pytest.raises(busway.LinkDown, match="cannot be resolved"):
            link.unit(1).read_holding_registers(0, count=1)
        assert_free(link)


@pytest.mark.clause("T37")
def test_of_many_transactions_each_ends_by_itself_and_none_gets_what_is_another_s(via: ClientKind) -> None:
    requests = [busway.ReadHoldingRegisters(address, 1) for address in range(12)]
    with (
        faulty_server(known_device()) as server,
        via.link(server.endpoint, timeout=AMPLE, retries=0, max_transactions=4) as link,
    ):
        server.add("wedged", addresses=range(6, 12))
        outcomes = link.unit(1).execute_many(requests, return_errors=True, timeout=4 * SHORT)
        for address, outcome in enumerate(outcomes):
            if address < 6:
                assert outcome.registers == [address]
            else:
                assert isinstance(outcome, busway.NoReply | busway.LinkDown)
                assert outcome.address == address
        link.breathe()
        assert_free(link)


@pytest.mark.clause("T37", "T18")
def test_ten_failures_of_each_kind_leave_no_handle(via: ClientKind) -> None:
    with faulty_server(known_device()) as server:
        gc.collect()
        before = open_handles()
        for name, options, _, _ in FAILURES.values():
            fault = server.add(name, **options)
            for _ in range(10):
                with (
                    via.link(server.endpoint, timeout=0.005, retries=0) as link,
                    pytest.raises(busway.ModbusError),
                ):
                    link.unit(1).write_single_register(900, 1)
            fault.off()
        server.wait_until(lambda: server.connections == 0)
        gc.collect()
        assert open_handles() <= before

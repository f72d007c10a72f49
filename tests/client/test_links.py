"""What holds for links of both kinds: connecting, retries, deadlines, sharing, closing."""

import gc
import socket
import time
from collections.abc import Iterator

import pytest
from client_kinds import CLIENT_KINDS, ClientKind
from foreign_servers import free_port
from handles import open_handles

import busway
from busway.testing import FakeClock, Schedule, faulty_server, known_device

AMPLE = 5.0
SHORT = 0.06


@pytest.fixture(params=CLIENT_KINDS, ids=lambda via: via.name)
def via(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> ClientKind:
    # A blocking link looks whether its peer has closed only after a pause: here, always.
    monkeypatch.setattr("busway.client.blocking_link._IDLE_SECONDS", 0.0)
    found: ClientKind = request.param
    return found


@pytest.fixture
def closed_port() -> Iterator[int]:
    """A port that no program listens on; it is held, so that no other test gets it meanwhile."""
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        yield holder.getsockname()[1]


# --- connecting ----------------------------------------------------------------------------------


@pytest.mark.clause("T6")
def test_link_connects_at_the_first_need_and_stays_connected_between_requests(via: ClientKind) -> None:
    with faulty_server(known_device()) as server, via.link(server.endpoint) as link:
        assert (link.state, link.real.is_connected, server.accepted) == ("down", False, 0)
        for address in (1, 2, 3):
            assert link.unit(1).read_holding_registers(address, count=1) == [address]
        assert (link.state, link.real.is_connected, server.accepted) == ("up", True, 1)
        assert str(link.real.endpoint) == server.endpoint


@pytest.mark.clause("T17")
def test_connection_is_closed_when_the_link_is(via: ClientKind) -> None:
    with faulty_server(known_device()) as server:
        with via.link(server.endpoint) as link:
            link.connect()
            link.connect()
            server.wait_until(lambda: server.connections == 1)
            assert server.accepted == 1
        server.wait_until(lambda: server.connections == 0)


@pytest.mark.clause("T37")
def test_without_a_listener_the_error_says_where_and_that_nothing_was_sent(via: ClientKind, closed_port: int) -> None:
    with via.link(f"tcp://127.0.0.1:{closed_port}") as link:
        with pytest.raises(busway.LinkDown) as caught:
            link.unit(9).write_single_register(7, 1)
        error = caught.value
        assert not error.sent
        assert (error.endpoint, error.unit) == (f"tcp://127.0.0.1:{closed_port}", 9)
        assert "nothing listens there" in str(error)
        assert isinstance(error, ConnectionError)
        with pytest.raises(busway.LinkDown):
            link.connect()


def test_peer_that_is_down_fails_the_next_calls_fast_and_is_found_when_it_comes_back(via: ClientKind) -> None:
    port = free_port()
    with via.link(f"tcp://127.0.0.1:{port}") as link:
        unit = link.unit(1)
        with pytest.raises(busway.LinkDown):
            unit.read_holding_registers(0, count=1)
        assert link.state == "backing off"
        with pytest.raises(busway.LinkDown, match="the next attempt is made in"):
            unit.read_holding_registers(0, count=1)
        with busway.serve_in_thread(f"tcp://127.0.0.1:{port}", units=known_device()):
            assert _until_it_answers(unit) == [5]
        assert link.state in ("up", "down")


def _until_it_answers(unit: object) -> list[int]:
    """What a unit says once its link has made up its mind to connect; it does so within its first pause, 0.1 s."""
    end = time.monotonic() + AMPLE
    while True:
        try:
            return unit.read_holding_registers(5, count=1)  # type: ignore[attr-defined, no-any-return]
        except busway.LinkDown:
            assert time.monotonic() < end


def test_peer_that_accepts_and_closes_is_given_longer_and_longer_pauses(via: ClientKind) -> None:
    with (
        faulty_server(known_device(), "close-if-silent", seconds=0.0) as server,
        via.link(server.endpoint, deadline=0.5, retries=100) as link,
    ):
        with pytest.raises(busway.NoReply, match="deadline"):
            link.unit(1).read_holding_registers(0, count=1)
        # Pauses of 50…100, 100…200 and 200…400 ms: three to five attempts in half a second.
        assert 3 <= server.accepted <= 5


@pytest.mark.clause("T7")
@pytest.mark.clause("T37")
def test_connection_that_is_lost_costs_a_read_a_repetition_and_a_write_its_certainty(via: ClientKind) -> None:
    with faulty_server(known_device()) as server, via.link(server.endpoint, timeout=AMPLE, retries=1) as link:
        unit = link.unit(1)
        unit.read_holding_registers(0, count=1)
        drop = server.add("execute-then-drop")  # takes effect on writes only
        with pytest.raises(busway.WriteOutcomeUnknown) as caught:
            unit.write_single_register(0, 1)
        cause = caught.value.__cause__
        assert isinstance(cause, busway.LinkDown)
        assert cause.sent
        drop.off()
        assert unit.read_holding_registers(0, count=1) == [1]
        assert link.counters.lost_connections == 1


# --- time ----------------------------------------------------------------------------------------


@pytest.mark.clause("T26")
@pytest.mark.alone
def test_timeout_and_retries_of_the_call_go_before_those_of_the_link(via: ClientKind) -> None:
    with faulty_server(known_device(), "wedged") as server, via.link(server.endpoint, timeout=AMPLE) as link:
        begin = time.monotonic()
        with pytest.raises(busway.NoReply) as caught:
            link.unit(1).read_holding_registers(0, count=1, timeout=0.03, retries=2)
        assert 0.09 <= time.monotonic() - begin < 1
        assert (caught.value.attempt, len(server.requests)) == (3, 3)
        assert caught.value.elapsed is not None
        assert caught.value.elapsed >= 0.09
        assert "0.03 s" in str(caught.value)
        assert isinstance(caught.value, TimeoutError)


@pytest.mark.clause("T26")
@pytest.mark.alone
def test_deadline_ends_a_call_whatever_its_retries(via: ClientKind) -> None:
    with faulty_server(known_device(), "wedged") as server, via.link(server.endpoint, retries=50) as link:
        begin = time.monotonic()
        with pytest.raises(busway.NoReply):
            link.unit(1).read_holding_registers(0, count=1, timeout=0.04, deadline=0.1)
        assert 0.1 <= time.monotonic() - begin < 0.4
        assert 2 <= len(server.requests) <= 3


def test_timeout_of_one_request_among_many_fails_it_alone(via: ClientKind) -> None:
    with (
        faulty_server(known_device()) as server,
        via.link(server.endpoint, timeout=SHORT, retries=0, max_transactions=4) as link,
    ):
        server.add("wedged", addresses=range(3, 4))
        requests = [busway.ReadHoldingRegisters(address, 1) for address in range(8)]
        outcomes = link.unit(1).execute_many(requests, return_errors=True)
        assert [type(one).__name__ for one in outcomes].count("NoReply") == 1
        assert isinstance(outcomes[3], busway.NoReply)
        assert outcomes[3].address == 3
        assert [one.registers[0] for one in outcomes if not isinstance(one, busway.ModbusError)] == [
            0,
            1,
            2,
            4,
            5,
            6,
            7,
        ]
        with pytest.raises(busway.NoReply):
            link.unit(1).execute_many(requests)


def test_write_is_never_repeated_unless_the_link_or_the_caller_says_so(via: ClientKind) -> None:
    for options, call, sent in (
        ({"retries": 3}, {}, 1),
        ({"write_retries": 2}, {}, 3),
        ({"retries": 1}, {"idempotent": True}, 2),
    ):
        with (
            faulty_server(known_device(), "wedged") as server,
            via.link(server.endpoint, timeout=0.03, **options) as link,
        ):
            with pytest.raises(busway.WriteOutcomeUnknown):
                link.unit(1).write_single_register(0, 1, **call)
            assert len(server.requests) == sent


@pytest.mark.clause("T9")
@pytest.mark.clause("T23")
@pytest.mark.parametrize("limit", [1, 3, 16])
def test_no_more_requests_are_in_flight_than_the_limit_says(via: ClientKind, limit: int) -> None:
    clock = FakeClock()
    with (
        faulty_server(known_device(), "late", clock=clock, delay=1.0) as server,
        via.link(server.endpoint, timeout=SHORT, retries=0, max_transactions=limit, recycle_after_timeouts=100) as link,
    ):
        requests = [busway.ReadHoldingRegisters(address, 1) for address in range(limit + 1)]
        outcomes = link.unit(1).execute_many(requests, return_errors=True, deadline=SHORT / 2)
        assert len(server.requests) == limit
        assert len({one.transaction for one in server.requests}) == limit
        assert all(isinstance(one, busway.NoReply) for one in outcomes)
        assert "nothing was sent" in str(outcomes[-1])


# --- arguments -----------------------------------------------------------------------------------


def test_arguments_out_of_range_cost_an_error_and_send_nothing(via: ClientKind) -> None:
    with faulty_server(known_device()) as server, via.link(server.endpoint) as link:
        unit = link.unit(1)
        for call in (
            lambda: unit.read_holding_registers(0, count=126),
            lambda: unit.read_holding_registers(0, count=0),
            lambda: unit.read_holding_registers(65_536, count=1),
            lambda: unit.read_holding_registers(65_535, count=2),
            lambda: unit.read_holding_registers(0, count=1, timeout=-1),
            lambda: unit.read_holding_registers(0, count=1, retries=-1),
            lambda: unit.read_holding_registers(0, count=1, deadline=-1),
            lambda: unit.read_holding_registers(0, count=1, adaptive_timeout=3),
            lambda: unit.write_single_register(0, 65_536),
            lambda: unit.write_multiple_registers(0, []),
            lambda: unit.write_multiple_coils(0, [True] * 1969),
            lambda: unit.read("101"),
            lambda: unit.write("3x1", 1),
            lambda: link.unit(256),
            lambda: link.unit(-1),
        ):
            with pytest.raises(busway.InvalidRequest):
                call()
        assert server.accepted == len(server.requests) == 0


@pytest.mark.clause("T24")
def test_unit_is_255_where_none_is_named(via: ClientKind) -> None:
    with faulty_server(known_device()) as server, via.link(server.endpoint) as link:
        assert link.real.unit().number == 255
        link.unit().read_holding_registers(0, count=1)
        assert server.requests[0].unit == 255


@pytest.mark.parametrize(
    ("url", "options", "key"),
    [
        ("tcp://127.0.0.1", {"timout": 1}, "timout"),
        ("tcp://127.0.0.1?patience=1", {}, "patience"),
        ("tcp://127.0.0.1", {"timeout": 0}, "timeout"),
        ("tcp://127.0.0.1", {"max_transactions": 17}, "max_transactions"),
        ("tcp://127.0.0.1", {"queue": 0}, "queue"),
        ("tcp://127.0.0.1?transaction_policy=maybe", {}, "transaction_policy"),
        ("tcp://127.0.0.1?connect_timeout=fast", {}, "connect_timeout"),
    ],
)
def test_option_that_cannot_be_is_refused_and_named(
    via: ClientKind, url: str, options: dict[str, object], key: str
) -> None:
    with pytest.raises(busway.ConfigError) as caught, via.link(url, **options):
        raise AssertionError("the link was made")
    assert caught.value.key == key


def test_options_of_the_url_hold_and_keywords_go_before_them(via: ClientKind) -> None:
    with faulty_server(known_device(), "wedged") as server:
        with via.link(f"{server.endpoint}?timeout=0.03&retries=1") as link, pytest.raises(busway.NoReply) as caught:
            link.unit(1).read_holding_registers(0, count=1)
        assert caught.value.attempt == 2
        with via.link(f"{server.endpoint}?timeout=9", timeout=0.03, retries=0) as link, pytest.raises(busway.NoReply):
            link.unit(1).read_holding_registers(0, count=1)


# --- ends ----------------------------------------------------------------------------------------


@pytest.mark.clause("T5")
def test_link_that_was_closed_says_so(via: ClientKind) -> None:
    with faulty_server(known_device()) as server, via.link(server.endpoint) as link:
        link.unit(1).read_holding_registers(0, count=1)
        link.call(link.real.close)
        with pytest.raises(busway.LinkClosed, match="closed by its user"):
            link.unit(1).read_holding_registers(0, count=1)
        link.call(link.real.close)


@pytest.mark.clause("T18")
def test_three_hundred_links_come_and_go_without_leaving_a_handle(via: ClientKind) -> None:
    with faulty_server(known_device()) as server:
        with via.link(server.endpoint) as link:
            link.unit(1).read_holding_registers(0, count=1)
        gc.collect()
        before = open_handles()
        for number in range(300):
            with via.link(server.endpoint) as link:
                assert link.unit(1).read_holding_registers(number, count=1) == [number]
        server.wait_until(lambda: server.connections == 0)
        gc.collect()
        assert open_handles() <= before
        assert server.accepted == 301


@pytest.mark.clause("T18")
def test_hundred_failed_connections_leave_no_handle(via: ClientKind, closed_port: int) -> None:
    gc.collect()
    before = open_handles()
    for _ in range(100):
        with via.link(f"tcp://127.0.0.1:{closed_port}") as link, pytest.raises(busway.LinkDown):
            link.unit(1).read_holding_registers(0, count=1)
    gc.collect()
    assert open_handles() <= before


def test_connection_that_drops_a_hundred_times_is_made_again_each_time(via: ClientKind) -> None:
    with faulty_server(known_device()) as server, via.link(server.endpoint, timeout=AMPLE) as link:
        unit = link.unit(1)
        gc.collect()
        before = None
        for number in range(100):
            assert unit.read_holding_registers(number, count=1) == [number]
            server.drop_connections()
            server.wait_until(lambda: server.connections == 0)
            link.breathe()
            before = before or open_handles()
        assert open_handles() <= before
        assert link.counters.timeouts == 0


def test_counters_tell_what_happened(via: ClientKind) -> None:
    with faulty_server(known_device()) as server, via.link(server.endpoint, timeout=0.4, retries=1) as link:
        unit = link.unit(1)
        unit.read_holding_registers(0, count=1)
        with pytest.raises(busway.ExceptionReply):
            unit.read_holding_registers(5000, count=1)
        server.add("wedged", schedule=Schedule(times=1))
        unit.read_holding_registers(1, count=1)
        counters = link.counters
        assert (counters.requests, counters.replies, counters.exceptions) == (4, 2, 1)
        assert (counters.timeouts, counters.retries, counters.connections) == (1, 1, 1)

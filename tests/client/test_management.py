"""Explicit management: how many connections an endpoint may have, and which of them takes a request."""

import pytest

import busway
from busway.options.client import ManagementParameters
from busway.testing import faulty_server, known_device

AMPLE = 5.0


# --- limits --------------------------------------------------------------------------------------


@pytest.mark.clause("T5", "T40", "T41")
def test_one_more_connection_than_the_limit_is_refused_and_there_is_room_when_one_is_closed() -> None:
    with faulty_server(known_device()) as server:
        options = {"shared": False, "max_connections": 2}
        first = busway.connect(server.endpoint, **options)  # type: ignore[arg-type]
        second = busway.connect(server.endpoint, **options)  # type: ignore[arg-type]
        with pytest.raises(busway.Overloaded, match="max_connections is 2") as caught:
            busway.connect(server.endpoint, **options)  # type: ignore[arg-type]
        assert caught.value.endpoint == server.endpoint
        assert server.accepted == 0
        busway.connect(server.endpoint).close()  # a shared one is no matter of this limit
        first.close()
        third = busway.connect(server.endpoint, **options)  # type: ignore[arg-type]
        assert third.unit(1).read_holding_registers(3, count=1) == [3]
        second.close()
        third.close()


@pytest.mark.clause("T5", "T41")
async def test_an_event_loop_has_such_a_limit_too() -> None:
    with faulty_server(known_device()) as server:
        first = busway.open(server.endpoint, shared=False, max_connections=1)
        await first.unit(1).read_holding_registers(0, count=1)
        with pytest.raises(busway.Overloaded, match="max_connections is 1"):
            await busway.open(server.endpoint, shared=False, max_connections=1).connect()
        await first.close()
        async with busway.open(server.endpoint, shared=False, max_connections=1) as second:
            assert await second.unit(1).read_holding_registers(3, count=1) == [3]


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"max_connections": 0}, "max_connections"),
        ({"max_connections": 10_001}, "max_connections"),
        ({"reconnect_first": 0.0}, "reconnect_first"),
        ({"reconnect_most": 3601.0}, "reconnect_most"),
        ({"reconnect_first": 6.0}, "reconnect_first"),
        ({"interface": ""}, "interface"),
        ({"hold": 0.0}, "hold"),
    ],
)
@pytest.mark.clause("T33")
def test_a_parameter_that_cannot_be_is_refused_by_name(options: dict[str, object], key: str) -> None:
    with pytest.raises(busway.ConfigError) as caught:
        ManagementParameters(**options)  # type: ignore[arg-type]
    assert caught.value.key == key


# --- selection -----------------------------------------------------------------------------------


@pytest.mark.clause("T41")
def test_a_request_takes_the_first_or_the_oldest_of_several_connections_as_the_rule_says() -> None:
    with (
        faulty_server(known_device()) as server,
        busway.connect(server.endpoint, shared=False) as first,
        busway.connect(server.endpoint, shared=False) as second,
        busway.connect(server.endpoint, select="first") as by_first,
        busway.connect(server.endpoint, select="oldest") as by_oldest,
    ):
        second.connect()
        by_first.unit(1).read_holding_registers(0, count=1)
        assert (first.counters.requests, second.counters.requests) == (0, 1)  # the only one that stands
        first.connect()
        by_first.unit(1).read_holding_registers(0, count=1)
        assert (first.counters.requests, second.counters.requests) == (1, 1)
        by_oldest.unit(1).read_holding_registers(0, count=1)
        assert (first.counters.requests, second.counters.requests) == (1, 2)
        assert by_oldest.state == "up"
        assert by_oldest.counters is second.counters
        assert server.accepted == 2


@pytest.mark.clause("T41")
def test_a_link_that_chooses_a_connection_cannot_have_one_of_its_own() -> None:
    for opened in (busway.open, busway.connect):
        with pytest.raises(busway.ConfigError, match="shared: has no effect with select"):
            opened("tcp://127.0.0.1:1", select="first", shared=False)


@pytest.mark.clause("T41")
async def test_so_it_does_on_an_event_loop() -> None:
    with faulty_server(known_device()) as server:
        first, second = busway.open(server.endpoint, shared=False), busway.open(server.endpoint, shared=False)
        chosen = {rule: busway.open(server.endpoint, select=rule) for rule in ("first", "oldest")}  # type: ignore[arg-type]
        with pytest.raises(busway.LinkDown, match="none to choose"):
            await chosen["first"].unit(1).read_holding_registers(0, count=1)
        assert (chosen["first"].state, chosen["first"].is_connected) == ("down", False)
        assert chosen["first"].counters.requests == 0
        async with first, second:
            await second.connect()
            await first.connect()
            async with chosen["oldest"], chosen["first"]:
                await chosen["first"].unit(1).read_holding_registers(0, count=1)
                assert (first.counters.requests, second.counters.requests) == (1, 0)
                await chosen["oldest"].unit(1).read_holding_registers(0, count=1)
                assert (first.counters.requests, second.counters.requests) == (1, 1)
                assert chosen["oldest"].is_connected
            assert first.is_connected  # the callback that chooses closes nothing
            assert second.is_connected
        assert server.accepted == 2


@pytest.mark.clause("T41")
def test_where_no_connection_stands_the_first_link_makes_one_and_without_a_link_there_is_none_to_choose() -> None:
    with faulty_server(known_device()) as server, busway.connect(server.endpoint, select="oldest") as chooser:
        with pytest.raises(busway.LinkDown, match="none to choose") as caught:
            chooser.unit(1).read_holding_registers(0, count=1)
        assert not caught.value.sent
        assert (chooser.state, chooser.is_connected, chooser.counters.requests) == ("down", False, 0)
        with busway.connect(server.endpoint) as link:
            assert chooser.unit(1).read_holding_registers(9, count=1) == [9]
            assert link.counters.requests == 1
        chooser.close()
        with pytest.raises(busway.LinkClosed, match="closed by its user"):
            chooser.unit(1).read_holding_registers(0, count=1)


@pytest.mark.parametrize("make", [busway.open, busway.connect], ids=["asyncio", "blocking"])
@pytest.mark.parametrize(
    ("url", "options", "key"),
    [
        ("tcp://127.0.0.1", {"select": "newest"}, "select"),
        ("tcp://127.0.0.1", {"select": "first", "max_transactions": 4}, "max_transactions"),
        ("tcp://127.0.0.1?hold=3", {"select": "oldest"}, "hold"),
    ],
)
def test_what_has_no_effect_with_a_selection_is_refused(make: object, url: str, options: dict, key: str) -> None:  # type: ignore[type-arg]
    with pytest.raises(busway.ConfigError) as caught:
        make(url, **options)  # type: ignore[operator]
    assert caught.value.key == key


def test_time_and_retries_are_each_users_own_also_with_a_selection() -> None:
    with (
        faulty_server(known_device(), "wedged") as server,
        busway.connect(server.endpoint, timeout=AMPLE),
        busway.connect(server.endpoint, select="first", timeout=0.03, retries=1) as chooser,
    ):
        with pytest.raises(busway.NoReply) as caught:
            chooser.unit(1).read_holding_registers(0, count=1)
        assert caught.value.attempt == 2

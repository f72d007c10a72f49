"""Reconnecting on real sockets: what is told, what waits and what fails fast, and when it is tried again."""

import asyncio
import contextlib
import logging
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from client_kinds import CLIENT_KINDS, ClientKind
from waiting import until

import busway
from busway.testing import faulty_server, known_device

AMPLE = 5.0


@pytest.fixture(params=CLIENT_KINDS, ids=lambda via: via.name)
def via(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> ClientKind:
    monkeypatch.setattr("busway.client.blocking_link._IDLE_SECONDS", 0.0)
    found: ClientKind = request.param
    return found


@pytest.fixture
def told(caplog: pytest.LogCaptureFixture) -> Iterator[list[str]]:
    """What links tell, without the name of the endpoint."""
    lines: list[str] = []

    class Keep(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            lines.append(f"{record.levelname.lower()} {record.getMessage().split(': ', 1)[1]}")

    logger = logging.getLogger("busway.client")
    handler = Keep()
    with caplog.at_level(logging.DEBUG, "busway.client"):
        logger.addHandler(handler)
        yield lines
        logger.removeHandler(handler)


def read(link: object, **call: object) -> object:
    """A read of register 5: its value, or the class of the error."""
    try:
        return link.unit(1).read_holding_registers(5, count=1, **call)  # type: ignore[attr-defined]
    except busway.ModbusError as error:
        return type(error)


# --- what is told --------------------------------------------------------------------------------


def test_a_connection_that_comes_and_goes_is_told_once_each_time(via: ClientKind, told: list[str]) -> None:
    with faulty_server(known_device()) as server, via.link(server.endpoint, timeout=AMPLE) as link:
        for _ in range(3):
            assert read(link) == [5]
        server.drop_connections()
        server.wait_until(lambda: server.connections == 0)
        link.breathe()
        assert read(link) == [5]
    assert [line for line in told if "the peer" not in line] == [
        "info up: connected",
        "info up: connected",
        "info down: the link was closed",
    ]
    assert len(told) == 4
    assert told[1].startswith("info down: the peer")


def test_a_peer_that_is_not_there_is_told_once_however_often_it_is_tried(via: ClientKind, told: list[str]) -> None:
    with faulty_server(known_device()) as server:
        endpoint = server.endpoint
    port = endpoint.rsplit(":", 1)[1]
    with via.link(endpoint, reconnect_first=0.001, reconnect_most=0.002, timeout=AMPLE) as link:
        end = time.monotonic() + AMPLE
        tried = set()
        while len(tried) < 5 and time.monotonic() < end:
            assert read(link) is busway.LinkDown
            tried.add(_failures(link))
        assert told == ["info backing off: no connection: nothing listens there (connection refused)"]
        with busway.serve_in_thread(f"tcp://127.0.0.1:{port}", units=known_device()):
            while read(link) is busway.LinkDown:
                assert time.monotonic() < end
        assert len(told) == 2
        assert told[1].startswith("info up: it answers again, after ")


def _failures(link: object) -> int:
    real = link.real._link  # type: ignore[attr-defined]
    return int(real.reconnect.failures)


@pytest.mark.alone
def test_a_flapping_peer_is_told_once_and_tried_with_longer_and_longer_pauses(via: ClientKind, told: list[str]) -> None:
    with (
        faulty_server(known_device()) as server,
        via.link(server.endpoint, timeout=AMPLE, retries=100, deadline=0.5, reconnect_first=0.05) as link,
    ):
        flapping = server.add("close-if-silent", seconds=0.0)
        assert read(link) in (busway.NoReply, busway.LinkDown)
        assert 3 <= server.accepted <= 6  # after pauses of 25…50, 50…100, 100…200 and 200…400 ms
        assert len(told) == 2
        assert told[0] == "info up: connected"
        assert told[1].startswith("info backing off: ")
        flapping.off()
        end = time.monotonic() + AMPLE
        while read(link, deadline=AMPLE) != [5]:
            assert time.monotonic() < end
        assert len(told) == 3
        assert told[2].startswith("info up: it answers again, after ")
        assert _failures(link) == 0


def test_a_silent_peer_is_told_as_suspect_and_recycled_and_each_of_that_once(via: ClientKind, told: list[str]) -> None:
    with (
        faulty_server(known_device()) as server,
        via.link(server.endpoint, timeout=0.03, retries=0, recycle_after_timeouts=3) as link,
    ):
        assert read(link, timeout=AMPLE) == [5]
        wedged = server.add("wedged")
        for number in range(3):
            assert read(link) is busway.NoReply
            assert link.state == ("suspect" if number < 2 else "down")
        wedged.off()
        assert read(link, timeout=AMPLE) == [5]
        assert link.counters.recycled == 1
    assert told == [
        "info up: connected",
        "info suspect: no reply in time",
        "info down: reconnecting after 3 timeouts in a row",
        "info up: connected",
        "info down: the link was closed",
    ]


def test_connections_that_are_held_per_request_are_no_news_for_an_operator(via: ClientKind, told: list[str]) -> None:
    with faulty_server(known_device()) as server, via.link(server.endpoint, hold="request") as link:
        for _ in range(3):
            assert read(link) == [5]
    assert told == ["debug up: connected", "debug down: nothing more is asked"] * 3


# --- what waits and what fails fast --------------------------------------------------------------


async def test_what_is_asked_while_the_connection_is_made_waits_for_it() -> None:
    with faulty_server(known_device()) as server:
        async with busway.open(server.endpoint, timeout=AMPLE) as link:
            reads = [asyncio.create_task(link.unit(1).read_holding_registers(n, count=1)) for n in range(5)]
            await asyncio.sleep(0)
            assert link.state == "connecting"
            assert await asyncio.gather(*reads) == [[n] for n in range(5)]
            assert server.accepted == 1


async def test_what_waits_fails_with_the_attempt_to_connect_and_what_comes_later_fails_at_once() -> None:
    with faulty_server(known_device()) as server:
        endpoint = server.endpoint
    async with busway.open(endpoint, timeout=30, reconnect_first=30, reconnect_most=30) as link:
        reads = [asyncio.create_task(link.unit(1).read_holding_registers(n, count=1)) for n in range(5)]
        outcomes = await asyncio.gather(*reads, return_exceptions=True)
        assert all(isinstance(one, busway.LinkDown) and not one.sent for one in outcomes)
        assert len({id(one) for one in outcomes}) == 5
        with pytest.raises(busway.LinkDown, match="the next attempt is made in"):
            await link.unit(1).read_holding_registers(0, count=1)
        assert link.state == "backing off"


@pytest.mark.alone
async def test_of_a_flapping_peer_only_calls_to_be_repeated_wait() -> None:
    with faulty_server(known_device(), "close-if-silent", seconds=0.0) as server:
        async with busway.open(server.endpoint, timeout=30, retries=2, reconnect_first=0.2) as link:
            repeated = asyncio.create_task(link.unit(1).read_holding_registers(1, count=1))
            await until(lambda: link.counters.lost_connections == 2)
            begin = asyncio.get_running_loop().time()
            with pytest.raises(busway.LinkDown, match="before any reply; the next attempt is made in"):
                await link.unit(1).read_holding_registers(2, count=1)
            assert asyncio.get_running_loop().time() - begin < 0.15
            with pytest.raises(busway.LinkDown):
                await repeated
            assert link.counters.connections == 3


@pytest.mark.clause("T7")
def test_a_connection_that_ends_before_anything_was_asked_is_made_anew_at_once(via: ClientKind) -> None:
    with (
        faulty_server(known_device()) as server,
        via.link(server.endpoint, timeout=AMPLE, retries=0, reconnect_first=30, reconnect_most=30) as link,
    ):
        link.connect()
        server.wait_until(lambda: server.connections == 1)
        server.drop_connections()
        server.wait_until(lambda: server.connections == 0)
        link.breathe()
        assert read(link, deadline=10) == [5]  # well before the first pause is over
        assert server.accepted == 2


# --- ways out ------------------------------------------------------------------------------------


@pytest.mark.clause("T16", "T18")
def test_a_client_never_leaves_from_the_same_port_twice_in_a_row(via: ClientKind) -> None:
    ports = []
    with faulty_server(known_device()) as server, via.link(server.endpoint, hold="request") as link:
        for _ in range(5):
            link.connect()
            (status,) = (one for one in busway.local_connections() if one.endpoint == server.endpoint)
            ports.append(int(status.local.rsplit(":", 1)[1]))
            assert read(link) == [5]
    assert len(set(ports)) == 5
    assert min(ports) > 1024


@pytest.mark.clause("T20")
def test_a_connection_leaves_through_the_interface_that_is_named(via: ClientKind) -> None:
    with faulty_server(known_device()) as server:
        with via.link(server.endpoint, interface="lo", local_address="127.0.0.3", timeout=AMPLE) as link:
            assert read(link) == [5]
            (status,) = (one for one in busway.local_connections() if one.endpoint == server.endpoint)
            assert status.local.startswith("127.0.0.3:")
        for options, reason in (
            ({"interface": "there-is-none"}, "interface: 'there-is-none' does not exist on this host, which has .*lo"),
            (
                {"interface": "lo", "local_address": "192.0.2.1"},
                "local_address: '192.0.2.1' is no address of this host",
            ),
        ):
            with via.link(server.endpoint, **options) as link, pytest.raises(busway.LinkDown, match=reason) as caught:
                link.unit(1).read_holding_registers(0, count=1)
            assert caught.value.kind == "local"


@pytest.mark.clause("T20")
@pytest.mark.parametrize("scheme", ["tcp", "rtu+tcp", "tls", "udp"])
@pytest.mark.parametrize(
    ("local_address", "reason"),
    [
        ("192.0.2.1", "'192.0.2.1' is no address of this host; give one that it has, or leave the option out"),
        ("eth0", r"'eth0' cannot be resolved \(.+\); give an address of this host, such as 192.168.1.5, or leave"),
        ("::1", "'::1' is IPv6 and the host 127.0.0.1 is not; give an address of the same family, or leave"),
    ],
)
def test_a_local_address_that_cannot_be_used_is_named_with_its_option(
    via: ClientKind, scheme: str, local_address: str, reason: str
) -> None:
    options: dict[str, Any] = {"local_address": local_address, "retries": 0}
    if scheme == "tls":
        options["verify"] = "off-insecure"
    with (
        via.link(f"{scheme}://127.0.0.1:9", **options) as link,
        pytest.raises(busway.LinkDown, match=f"no connection: local_address: {reason}") as caught,
    ):
        link.unit(1).read_holding_registers(0, count=1)
    assert (caught.value.kind, caught.value.sent) == ("local", False)


@pytest.mark.clause("T20")
def test_without_a_listener_behind_an_interface_the_error_says_so(via: ClientKind) -> None:
    with contextlib.closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp://127.0.0.1:{probe.getsockname()[1]}"
        with via.link(endpoint, interface="lo") as link, pytest.raises(busway.LinkDown, match="nothing listens there"):
            link.unit(1).read_holding_registers(0, count=1)


@pytest.mark.clause("T20")
def test_a_system_that_cannot_bind_to_an_interface_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(socket, "SO_BINDTODEVICE")
    with pytest.raises(busway.ConfigError) as caught:
        busway.connect("tcp://127.0.0.1", interface="lo")
    assert caught.value.key == "interface"


def test_threads_that_wait_on_a_flapping_peer_all_get_an_end() -> None:
    with (
        faulty_server(known_device(), "close-if-silent", seconds=0.0) as server,
        busway.connect(server.endpoint, timeout=AMPLE, retries=1, reconnect_first=0.02) as link,
    ):
        outcomes: list[object] = []
        threads = [threading.Thread(target=lambda: outcomes.append(read(link))) for _ in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(10)
            assert not thread.is_alive()
        assert outcomes == [busway.LinkDown] * 6


def test_connecting_by_name_while_the_next_attempt_is_not_due_fails_at_once_and_later_succeeds(via: ClientKind) -> None:
    with faulty_server(known_device()) as server:
        endpoint = server.endpoint
    port = endpoint.rsplit(":", 1)[1]
    with via.link(endpoint, reconnect_first=0.2, reconnect_most=0.2, timeout=AMPLE) as link:
        with pytest.raises(busway.LinkDown):
            link.connect()
        assert link.state == "backing off"
        with busway.serve_in_thread(f"tcp://127.0.0.1:{port}", units=known_device()):
            end = time.monotonic() + AMPLE
            while True:
                try:
                    link.connect()
                    break
                except busway.LinkDown:
                    assert time.monotonic() < end
                    time.sleep(0.01)
            assert link.state == "up"
            assert read(link) == [5]
            assert link.state == "up"

"""Clauses T19, T20 and T33: what is set on sockets, read back from the system on both sides."""

import socket
from pathlib import Path

import pytest
from waiting import until

import busway
from busway.client.connector import TcpConnector
from busway.client.settings import link_settings
from busway.options.sockets import SocketParameters
from busway.testing import CertificateStore
from busway.transport.tcp import configure

ANY_PORT = "tcp://127.0.0.1:0"
CHOSEN = {
    "keepalive_idle": 71,
    "keepalive_interval": 13,
    "keepalive_count": 5,
    "user_timeout": 7.0,
    "receive_buffer": 8192,
    "send_buffer": 16_384,
}


def options_of(connection: socket.socket) -> dict[str, float]:
    """What the system says of a connection, in our names."""

    def tcp(name: str) -> int:
        return connection.getsockopt(socket.IPPROTO_TCP, getattr(socket, name))

    return {
        "no_delay": tcp("TCP_NODELAY"),
        "keepalive": connection.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE),
        "keepalive_idle": tcp("TCP_KEEPIDLE"),
        "keepalive_interval": tcp("TCP_KEEPINTVL"),
        "keepalive_count": tcp("TCP_KEEPCNT"),
        "user_timeout": tcp("TCP_USER_TIMEOUT") / 1000,
    }


def buffers_of(connection: socket.socket) -> tuple[int, int]:
    """Sizes of the receive and the send buffer in bytes; Linux gives twice what was asked for."""
    return (
        connection.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF),
        connection.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF),
    )


DEFAULTS = {
    "no_delay": 1,
    "keepalive": 1,
    "keepalive_idle": 60,
    "keepalive_interval": 10,
    "keepalive_count": 3,
    "user_timeout": 30.0,
}


@pytest.mark.clause("T19")
@pytest.mark.parametrize("chosen", [{}, CHOSEN], ids=["defaults", "chosen"])
async def test_a_connection_of_each_side_has_the_parameters_that_were_asked_for(chosen: dict[str, float]) -> None:
    expected = DEFAULTS | {name: value for name, value in chosen.items() if name in DEFAULTS}
    async with (
        busway.serve(ANY_PORT, units={1: busway.Device()}, **chosen) as server,
        busway.open(server.endpoints[0], **chosen) as link,
    ):
        await link.connect()
        dialled = link._link._transport.get_extra_info("socket")  # type: ignore[union-attr]
        await until(lambda: server.status().connections)
        (accepted,) = server._streams[0].management._connections
        served = accepted._transport.get_extra_info("socket")
        for connection in (dialled, served):
            assert options_of(connection) == expected
            if chosen:
                receive, send = buffers_of(connection)
                assert receive >= chosen["receive_buffer"]
                assert send >= chosen["send_buffer"]
                assert receive <= 4 * chosen["receive_buffer"]


@pytest.mark.clause("T19")
def test_a_blocking_connection_has_them_too() -> None:
    with busway.serve_in_thread(ANY_PORT, units={1: busway.Device()}) as server:
        endpoint = busway.parse_endpoint(server.endpoints[0])
        with TcpConnector(endpoint, SocketParameters(**CHOSEN)).dial() as connection:  # type: ignore[arg-type]
            assert options_of(connection) == DEFAULTS | {name: CHOSEN[name] for name in CHOSEN if name in DEFAULTS}


@pytest.mark.clause("T13", "T19")
@pytest.mark.parametrize("scheme", ["tcp", "tls"])
async def test_the_connection_of_a_priority_host_is_probed_and_has_no_user_timeout(scheme: str, tmp_path: Path) -> None:
    store = CertificateStore(tmp_path)
    secure = {"tls": busway.TlsParameters(**store.server().options())} if scheme == "tls" else {}
    own = store.client("operator").options() if scheme == "tls" else {}
    async with (
        busway.serve(f"{scheme}://127.0.0.1:0", units=busway.Device(), priority=["127.0.0.2"], **secure) as server,
        busway.open(server.endpoints[0], local_address="127.0.0.2", shared=False, **own) as priority,
        busway.open(server.endpoints[0], local_address="127.0.0.3", shared=False, **own) as other,
    ):
        for link, expected in ((priority, DEFAULTS | {"user_timeout": 0.0}), (other, DEFAULTS)):
            await link.unit(1).diagnostics(0)
            newest = list(server._streams[0].management._connections)[-1]
            assert options_of(newest._transport.get_extra_info("socket")) == expected


@pytest.mark.clause("T18", "T19")
@pytest.mark.parametrize(
    ("chosen", "expected"),
    [
        ({"keepalive_idle": 1, "keepalive_interval": 1, "keepalive_count": 2}, 2.5),
        ({"keepalive_idle": 1, "keepalive_interval": 1, "keepalive_count": 2, "user_timeout": 1.0}, 1.0),
        ({"keepalive_idle": 1, "keepalive_interval": 1, "keepalive_count": 2, "keepalive": False}, 30.0),
        ({"keepalive_idle": 1, "keepalive_interval": 1, "keepalive_count": 2, "user_timeout": None}, None),
        ({}, 30.0),
    ],
)
def test_the_user_timeout_never_makes_keepalive_wait_for_longer_than_its_own_figures_say(
    chosen: dict[str, float | None], expected: float | None
) -> None:
    parameters = SocketParameters(**chosen)  # type: ignore[arg-type]
    assert parameters.effective_user_timeout == expected
    with socket.socket() as connection:
        configure(connection, parameters)
        assert options_of(connection)["user_timeout"] == (expected or 0)


@pytest.mark.clause("T19")
async def test_a_listener_can_be_opened_again_at_once_on_the_port_it_had() -> None:
    async with busway.serve(ANY_PORT, units={1: busway.Device()}) as server:
        (endpoint,) = server.endpoints
        link = busway.open(endpoint)
        await link.connect()
        await until(lambda: server.status().connections)
    # The server closed first, so the connection is in the wait state of TCP on its side.
    async with busway.serve(endpoint, units={1: busway.Device()}) as again:
        assert again.endpoints == [endpoint]
    await link.close()


@pytest.mark.clause("T19")
@pytest.mark.parametrize("name", ["receive_buffer", "send_buffer"])
def test_a_buffer_below_900_bytes_is_refused(name: str) -> None:
    with pytest.raises(busway.ConfigError, match="at least 900"):
        link_settings("tcp://10.0.0.5", {name: 899})


@pytest.mark.clause("T20")
@pytest.mark.parametrize("scheme", ["tls", "udp", "rtu+udp"])
def test_an_interface_is_refused_where_it_would_have_no_effect(scheme: str) -> None:
    with pytest.raises(busway.ConfigError, match="unknown option") as caught:
        link_settings(f"{scheme}://10.0.0.5:502?interface=lo", {})
    assert caught.value.key == "interface"


@pytest.mark.clause("T20")
async def test_a_client_and_a_server_meet_over_ipv6() -> None:
    async with busway.serve("tcp://[::1]:0", units={1: busway.Device(holding_registers=[7])}) as server:
        assert server.endpoints[0].startswith("tcp://[::1]:")
        async with busway.open(server.endpoints[0], local_address="::1") as link:
            assert await link.unit(1).read_holding_registers(0, count=1) == [7]
            assert server.status().connections[0].peer.startswith("[::1]:")


@pytest.mark.clause("T33")
@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"timeout": 0}, "timeout"),
        ({"max_transactions": 17}, "max_transactions"),
        ({"keepalive_count": 0}, "keepalive_count"),
        ({"tiemout": 1.0}, "tiemout"),
        ({"transaction_policy": "ignore", "max_transactions": 2}, "transaction_policy"),
    ],
)
def test_the_settings_of_a_client_are_checked_as_a_whole_before_anything_is_opened(
    options: dict[str, object], key: str
) -> None:
    with pytest.raises(busway.ConfigError) as caught:
        busway.connect("tcp://127.0.0.1:1", **options)
    assert caught.value.key == key


@pytest.mark.clause("T33")
def test_the_settings_of_a_client_are_one_object() -> None:
    settings = link_settings(
        "tcp://10.0.0.5?timeout=2", {"retries": 0, "keepalive_idle": 30, "local_address": "10.0.0.1"}
    )
    assert settings.endpoint.host == "10.0.0.5"
    assert settings.parameters.timeout == 2.0
    assert settings.parameters.retries == 0
    assert settings.sockets.keepalive_idle == 30
    assert settings.sockets.local_address == "10.0.0.1"

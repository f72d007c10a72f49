"""Port 502 beside another one: where it is listened on, where not, and what happens where it cannot be opened."""

import logging
import socket
from urllib.parse import urlsplit

import pytest
from foreign_servers import free_port

import busway
from busway.options.server import ListenerParameters
from busway.server.listener import as_listeners
from busway.server.listener_settings import listener_settings
from busway.server.standard_port import with_standard_port

LIMITS = ListenerParameters()


def beside(choice: bool | None, *urls: str) -> list[str]:
    """The listeners that stand beside those on ``urls``."""
    wanted = [listener_settings(one, limits=LIMITS) for one in as_listeners(urls)]
    return [one.endpoint.url for one in with_standard_port(wanted, choice)[len(wanted) :]]


@pytest.mark.clause("T3")
@pytest.mark.parametrize(
    ("urls", "expected"),
    [
        (["tcp://192.0.2.1:1502"], ["tcp://192.0.2.1:502"]),
        (["tcp://:1502"], ["tcp://:502"]),
        (["tcp://[2001:db8::1]:1502"], ["tcp://[2001:db8::1]:502"]),
        (["tcp://192.0.2.1:1502", "tcp://192.0.2.1:1503", "tcp://192.0.2.2:1502"], 2 * ["502"]),
        (["tcp://192.0.2.1:1502", "tcp://192.0.2.1"], []),
        (["tcp://192.0.2.1:1502", "tcp://0.0.0.0:502"], []),
        (["tcp://127.0.0.1:5020", "tcp://localhost:5020", "tcp://[::1]:5020"], []),
        (["tcp://192.0.2.1:0"], []),
        (["udp://192.0.2.1:1502", "rtu+tcp://192.0.2.1:4001"], []),
    ],
)
def test_left_to_the_server_it_stands_beside_those_that_the_network_can_reach(
    urls: list[str], expected: list[str]
) -> None:
    found = beside(None, *urls)
    assert len(found) == len(expected)
    assert all(url.endswith(wanted) for url, wanted in zip(found, expected, strict=True))


@pytest.mark.clause("T3")
def test_by_name_it_is_switched_off_or_stands_beside_every_listener() -> None:
    assert beside(False, "tcp://192.0.2.1:1502") == []
    assert beside(True, "tcp://127.0.0.1:0", "udp://127.0.0.1:5020") == ["tcp://127.0.0.1:502"]


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> socket.socket:
    """A socket on the port that the standard one is for this test; it is not listening yet."""
    holder = socket.socket()
    holder.bind(("127.0.0.1", free_port()))
    monkeypatch.setattr("busway.server.standard_port.DEFAULT_TCP_PORT", holder.getsockname()[1])
    return holder


@pytest.mark.clause("T3")
async def test_both_ports_answer(taken: socket.socket) -> None:
    port = taken.getsockname()[1]
    taken.close()
    device = busway.Device(holding_registers=[7])
    server = busway.Server(["tcp://127.0.0.1:0"], busway.serve(units=device)._responder, standard_port=True)
    async with server:
        assert urlsplit(server.endpoints[1]).port == port
        for endpoint in server.endpoints:
            async with busway.open(endpoint) as link:
                assert await link.unit(1).read_holding_registers(0, count=1) == [7]


@pytest.mark.clause("T3")
async def test_where_it_cannot_be_had_that_is_an_error_by_name_and_a_warning_otherwise(
    taken: socket.socket, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.WARNING, "busway.server")
    handler = busway.serve(units=busway.Device(coils=1))._responder
    with taken:
        taken.listen()
        with pytest.raises(busway.LinkDown, match=str(taken.getsockname()[1])):
            await busway.Server(["tcp://127.0.0.1:0"], handler, standard_port=True).start()
        free = free_port()
        monkeypatch.setattr("busway.server.standard_port._is_loopback", lambda host: False)
        async with busway.Server([f"tcp://127.0.0.1:{free}"], handler) as server:
            assert server.endpoints == [f"tcp://127.0.0.1:{free}"]
    assert [record.getMessage() for record in caplog.records if "not listened on beside" in record.getMessage()]


@pytest.mark.clause("M6")
async def test_rules_about_the_listener_beside_which_it_stands_hold_there_too(taken: socket.socket) -> None:
    taken.close()
    url = f"tcp://127.0.0.1:{free_port()}"
    policy = busway.Policy.of(busway.Rule.of(name="no", action="deny", listeners=[url]), default="allow")
    responder = busway.serve(units=busway.Device(holding_registers=[7]))._responder
    async with busway.Server([url], responder, standard_port=True, policy=policy) as server:
        assert len(server.endpoints) == 2
        for endpoint in server.endpoints:
            async with busway.open(endpoint) as link:
                with pytest.raises(busway.ExceptionReply, match="exception 01"):
                    await link.unit(1).read_holding_registers(0, count=1)

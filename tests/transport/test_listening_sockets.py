"""Bound sockets: of both families on one port, on an interface, and nothing left open after a failure."""

import errno
import socket
import sys
from typing import Any

import pytest
from handles import open_handles

import busway
from busway.transport.listening_sockets import bound_sockets


def addresses(host: str | None, port: int, kind: socket.SocketKind = socket.SOCK_STREAM) -> list[Any]:
    return socket.getaddrinfo(host, port, type=kind, flags=socket.AI_PASSIVE)


@pytest.mark.clause("T20")
@pytest.mark.parametrize("kind", [socket.SOCK_STREAM, socket.SOCK_DGRAM])
def test_every_address_is_both_families_on_one_port(kind: socket.SocketKind) -> None:
    made = bound_sockets(addresses(None, 0, kind))
    assert {one.family for one in made} == {socket.AF_INET, socket.AF_INET6}
    assert len({one.getsockname()[1] for one in made}) == 1
    for one in made:
        assert not one.getblocking()
        one.close()


def test_port_that_is_taken_is_an_error_that_leaves_nothing_open() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        before = open_handles()
        both = [*addresses("127.0.0.2", taken.getsockname()[1]), *addresses("127.0.0.1", taken.getsockname()[1])]
        with pytest.raises(OSError, match="in use") as caught:
            bound_sockets(both)
        assert caught.value.errno == errno.EADDRINUSE
        assert open_handles() == before


def test_address_of_another_host_is_an_error() -> None:
    with pytest.raises(OSError, match="assign") as caught:
        bound_sockets(addresses("192.0.2.1", 0))
    assert caught.value.errno == errno.EADDRNOTAVAIL


def test_family_that_the_system_does_not_have_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    real = socket.socket

    def without_ipv6(family: int, *rest: int) -> socket.socket:
        if family == socket.AF_INET6:
            raise OSError(errno.EAFNOSUPPORT, "no such family")
        return real(family, *rest)

    wanted = addresses(None, 0)
    monkeypatch.setattr("busway.transport.listening_sockets.socket.socket", without_ipv6)
    (made,) = bound_sockets(wanted)
    monkeypatch.undo()
    assert made.family == socket.AF_INET
    made.close()


@pytest.mark.clause("T20")
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux binds to an interface by its name")
async def test_listener_on_an_interface_is_reached_by_that_alone_and_shown_with_its_netmask() -> None:
    device = busway.Device(holding_registers=[7])
    async with busway.serve("tcp://0.0.0.0:0", units=device, interface="lo") as server:
        port = server.endpoints[0].rpartition(":")[2]
        async with busway.open(f"tcp://127.0.0.1:{port}") as link:
            assert await link.unit(1).read_holding_registers(0, count=1) == [7]
        shown = server.status().listeners[0].interfaces
        assert ("lo", "127.0.0.1", "255.0.0.0") in [(one.name, one.address, one.netmask) for one in shown]


@pytest.mark.clause("T20")
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux binds to an interface by its name")
async def test_interface_that_is_not_there_is_an_error_of_the_start() -> None:
    with pytest.raises(
        busway.LinkDown, match=r"cannot listen: interface: 'nowhere0' does not exist .*has .*lo"
    ) as caught:
        await busway.serve("tcp://0.0.0.0:0", units=busway.Device(coils=1), interface="nowhere0").start()
    assert caught.value.kind == "local"


def test_system_without_the_means_to_bind_to_an_interface_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("busway.transport.listening_sockets.socket.SO_BINDTODEVICE", raising=False)
    with pytest.raises(busway.ConfigError) as caught:
        bound_sockets(addresses("127.0.0.1", 0), interface="lo")
    assert caught.value.key == "interface"

"""A client that is not authorized is closed before a byte of it is parsed, and counted."""

import socket

import pytest

import busway


@pytest.mark.clause("T35")
def test_a_host_that_is_refused_is_closed_unheard_and_counted() -> None:
    asked: list[str] = []

    def deny(host: str) -> bool:
        asked.append(host)
        return False

    device = busway.Device(holding_registers=10)
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device}, authorize=deny) as server:
        port = int(server.endpoints[0].rpartition(":")[2])
        with socket.create_connection(("127.0.0.1", port), 5) as client:
            try:
                client.sendall(bytes.fromhex("0001 0000 0006 01 06 0000 0007"))
                answer = client.recv(100)
            except ConnectionError:
                answer = b""
        status = server.status()
    assert answer == b""
    assert device.holding_registers[0] == 0
    assert asked == ["127.0.0.1"]
    assert status.counters.unauthorized == 1
    assert status.counters.accepted == 0


@pytest.mark.clause("T35")
def test_a_datagram_of_a_refused_host_is_dropped_and_counted() -> None:
    device = busway.Device(holding_registers=10)
    with busway.serve_in_thread("udp://127.0.0.1:0", units={1: device}, authorize=lambda host: False) as server:
        with (
            busway.connect(server.endpoints[0], timeout=0.1, retries=0) as link,
            pytest.raises(busway.WriteOutcomeUnknown),
        ):
            link.unit(1).write_single_register(0, 7)
        assert server.status().counters.unauthorized == 1
    assert device.holding_registers[0] == 0


@pytest.mark.clause("T34")
def test_the_status_tells_how_many_connections_are_supported() -> None:
    units = {1: busway.Device(coils=1)}
    endpoints = ("tcp://127.0.0.1:0", "tcp://127.0.0.1:0")
    with busway.serve_in_thread(*endpoints, units=units, max_connections=5) as server:
        assert server.status().supported_connections == 26  # with 8 priority slots each

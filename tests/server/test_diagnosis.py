"""The three lamps of a listener, on a clock of their own and over a real one (S19)."""

import socket

import pytest

import busway
from busway.server.diagnosis import ACTIVITY_SHOWN, FAULT_SHOWN, Diagnosis, Lamp, Lamps

pytestmark = pytest.mark.clause("S19")


def opened() -> Diagnosis:
    diagnosis = Diagnosis()
    diagnosis.is_open = True
    return diagnosis


def test_an_open_listener_without_traffic_shows_its_device_lamp_alone() -> None:
    assert opened().lamps(100.0) == Lamps(Lamp.OFF, Lamp.OFF, Lamp.ON)


def test_a_port_that_is_not_there_flashes_the_error_lamp() -> None:
    assert Diagnosis().lamps(100.0) == Lamps(Lamp.OFF, Lamp.FLASHING, Lamp.OFF)


def test_traffic_shows_for_half_a_second() -> None:
    diagnosis = opened()
    diagnosis.traffic = 100.0
    assert diagnosis.lamps(100.0 + ACTIVITY_SHOWN / 2).communication is Lamp.ON
    assert diagnosis.lamps(100.0 + ACTIVITY_SHOWN).communication is Lamp.OFF


def test_a_damaged_frame_flashes_and_a_failed_handler_shows_steady_and_goes_before() -> None:
    diagnosis = opened()
    diagnosis.communication_fault = 100.0
    assert diagnosis.lamps(101.0).error is Lamp.FLASHING
    diagnosis.internal_fault = 100.0
    assert diagnosis.lamps(101.0).error is Lamp.ON
    assert diagnosis.lamps(100.0 + FAULT_SHOWN).error is Lamp.OFF


def test_listen_only_mode_flashes_the_device_lamp() -> None:
    assert opened().lamps(100.0, listen_only=True).device_status is Lamp.FLASHING


def test_the_status_of_a_server_shows_traffic_and_a_failed_handler() -> None:
    device = busway.Device(holding_registers=10)

    @device.on_read("holding_registers")
    def fails(access: busway.Access) -> None:
        raise RuntimeError("no sensor")

    with busway.serve_in_thread("udp://127.0.0.1:0", units={1: device}) as server:
        host, port = server.endpoints[0].removeprefix("udp://").split(":")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.settimeout(5)
            client.sendto(bytes.fromhex("0001 0000 0006 01 03 0000 0001"), (host, int(port)))
            assert client.recv(100) == bytes.fromhex("0001 0000 0003 01 83 04")
        (listener,) = server.status().listeners
    assert listener.lamps.communication is Lamp.ON
    assert listener.lamps.error is Lamp.ON

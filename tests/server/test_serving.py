"""Serving beside or instead of a blocking program."""

import asyncio
import errno
import os
import signal
import subprocess
import sys
import threading
from typing import Any
from urllib.parse import urlsplit

import pytest

import busway

ANY_PORT = "tcp://127.0.0.1:0"


def test_server_in_a_thread_serves_a_device_that_the_program_changes_meanwhile() -> None:
    device = busway.Device(holding_registers=10)
    with busway.serve_in_thread(ANY_PORT, units=device) as server, busway.connect(server.endpoints[0]) as link:
        for value in (1, 2, 3):
            device.holding_registers[4] = value
            assert link.unit(1).read_holding_registers(4, count=1) == [value]
        link.unit(1).write_single_register(5, 99)
        assert device.holding_registers[5] == 99
        status = server.status()
        assert status.running
        assert status.counters.requests == 4
        server.reset()
        assert server.status().counters.requests == 0


def test_server_in_a_thread_has_ended_when_the_block_is_left() -> None:
    before = threading.active_count()
    with busway.serve_in_thread(ANY_PORT, units=busway.Device(holding_registers=10)) as server:
        endpoint = server.endpoints[0]
    assert threading.active_count() == before
    with busway.connect(endpoint) as link, pytest.raises(busway.LinkDown):
        link.unit(1).read_holding_registers(0, count=1)


def test_server_in_a_thread_ends_when_the_block_is_left_by_an_exception() -> None:
    before = threading.active_count()
    with pytest.raises(ZeroDivisionError), busway.serve_in_thread(ANY_PORT, units=busway.Device(holding_registers=10)):
        raise ZeroDivisionError
    assert threading.active_count() == before


def test_listener_that_a_thread_cannot_have_is_an_error_of_the_program() -> None:
    with busway.serve_in_thread(ANY_PORT, units=busway.Device(holding_registers=10)) as server:
        taken = server.endpoints[0]
        with (
            pytest.raises(busway.LinkDown, match="listen") as caught,
            busway.serve_in_thread(taken, units=busway.Device(holding_registers=10)),
        ):
            raise AssertionError("two servers on one port")
        assert caught.value.endpoint == taken


def test_event_loop_that_a_thread_cannot_have_is_an_error_of_the_program(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_loop() -> asyncio.AbstractEventLoop:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr("busway.server.loops._loop_factory", lambda: no_loop)
    before = threading.active_count()
    with (
        pytest.raises(OSError, match="Too many open files"),
        busway.serve_in_thread(ANY_PORT, units=busway.Device(holding_registers=10)),
    ):
        raise AssertionError("a server without an event loop")
    assert threading.active_count() == before


_FOREVER = """
import busway
busway.serve_forever(
    "tcp://127.0.0.1:0",
    units=busway.Device(holding_registers=[1, 2, 3]),
    started=lambda server: print(server.endpoints[0], flush=True),
)
print("ended", flush=True)
"""


@pytest.mark.skipif(os.name == "nt", reason="an interrupt is sent another way on Windows")
def test_serve_forever_serves_until_it_is_interrupted() -> None:
    with subprocess.Popen([sys.executable, "-c", _FOREVER], stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        endpoint = program.stdout.readline().strip()
        assert urlsplit(endpoint).port
        with busway.connect(endpoint) as link:
            assert link.unit(1).read_holding_registers(0, count=3) == [1, 2, 3]
            program.send_signal(signal.SIGINT)
            assert program.stdout.readline() == "ended\n"
        assert program.wait(60) == 0


@pytest.mark.parametrize(
    ("units", "sentence"),
    [
        ({1: "x"}, "units: unit 1 must be a busway.Device, not 'x'"),
        ({1: None}, "units: unit 1 must be a busway.Device, not None"),
        ("x", "units: must be a device, or devices by unit as in {1: device}, not 'x'"),
        ([], "units: must be a device, or devices by unit as in {1: device}, not []"),
    ],
)
def test_units_that_are_no_devices_are_refused(units: Any, sentence: str) -> None:
    with pytest.raises(busway.ConfigError) as caught:
        busway.serve("tcp://127.0.0.1:0", units=units)
    assert str(caught.value) == sentence

"""The connections of checks: a device that takes no bytes ends them."""

import contextlib
import socket

import pytest

from busway.apps.check import wire
from busway.client.settings import link_settings
from busway.errors import LinkDown


def test_a_device_that_takes_no_bytes_ends_the_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wire, "_LONGEST_STALL", 0.0)
    near, far = socket.socketpair()
    with near, far:
        near.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                near.send(bytes(65_536))
        connection = wire.NetworkWire(near, link_settings("tcp://127.0.0.1:1", {}))
        with pytest.raises(LinkDown, match=r"^tcp://127\.0\.0\.1:1: the device takes no bytes for 0 s$"):
            connection.send(b"\x00")

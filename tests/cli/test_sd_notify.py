"""What a service manager is told, over a real datagram socket."""

import asyncio
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from control_sockets import short_directory

from busway.cli.sd_notify import Manager, watched


@contextmanager
def manager_socket(name: str = "") -> Iterator[tuple[str, socket.socket]]:
    """A socket as a service manager has it: in a folder, or with a name that no file system has."""
    with short_directory() as folder, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.settimeout(10)
        if name:
            receiver.bind("\0" + name)
            yield "@" + name, receiver
        else:
            receiver.bind(str(folder / "notify"))
            yield str(folder / "notify"), receiver


def told(receiver: socket.socket) -> dict[str, str]:
    """The next datagram, as assignments."""
    return dict(line.split("=", 1) for line in receiver.recv(4096).decode().split("\n"))


@pytest.mark.parametrize("name", ["", f"busway-test-{os.getpid()}"], ids=["path", "abstract name"])
def test_ready_reloading_stopping_and_alive_are_told(name: str) -> None:
    with manager_socket(name) as (address, receiver):
        manager = Manager({"NOTIFY_SOCKET": address})
        assert manager.is_there
        manager.ready("one\ntwo")
        assert told(receiver) == {"READY": "1", "STATUS": "one two"}
        before = time.monotonic_ns() // 1000
        manager.reloading()
        reloading = told(receiver)
        assert reloading.pop("RELOADING") == "1"
        assert before <= int(reloading["MONOTONIC_USEC"]) <= time.monotonic_ns() // 1000
        manager.stopping("3 requests to answer")
        assert told(receiver) == {"STOPPING": "1", "STATUS": "3 requests to answer"}
        manager.alive()
        assert told(receiver) == {"WATCHDOG": "1"}


@pytest.mark.parametrize("address", [None, "", "relative/path", "vsock:2:1234"])
def test_without_an_address_that_can_be_nothing_is_sent(address: str | None) -> None:
    manager = Manager({} if address is None else {"NOTIFY_SOCKET": address})
    assert not manager.is_there
    manager.ready("no listener")


def test_a_manager_that_has_gone_is_lived_without() -> None:
    with short_directory() as folder:
        Manager({"NOTIFY_SOCKET": str(folder / "gone")}).ready("no listener")


@pytest.mark.parametrize(
    ("variables", "seconds"),
    [
        ({"WATCHDOG_USEC": "3000000"}, 3.0),
        ({"WATCHDOG_USEC": "500000", "WATCHDOG_PID": str(os.getpid())}, 0.5),
        ({"WATCHDOG_USEC": "500000", "WATCHDOG_PID": "1"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "-5"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
        ({}, None),
    ],
)
def test_the_watchdog_is_for_the_process_that_it_names(variables: dict[str, str], seconds: float | None) -> None:
    assert Manager({"NOTIFY_SOCKET": "/run/notify", **variables}).watchdog == seconds
    assert Manager(variables).watchdog is None


async def test_the_manager_hears_that_the_event_loop_turns_twice_in_its_time() -> None:
    with manager_socket() as (address, receiver):
        manager = Manager({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "20000"})
        receiver.setblocking(False)
        loop = asyncio.get_running_loop()
        async with watched(manager):
            for _ in range(3):
                assert await asyncio.wait_for(loop.sock_recv(receiver, 100), 60) == b"WATCHDOG=1"


async def test_without_a_manager_nothing_is_sent() -> None:
    with manager_socket() as (address, receiver):
        receiver.setblocking(False)
        async with watched(Manager({"NOTIFY_SOCKET": address})):
            pass
        with pytest.raises(BlockingIOError):
            receiver.recv(100)

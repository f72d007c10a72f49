"""Tells a service manager such as systemd that the program is ready, reloads, stops or is alive (sd_notify(3)).

Knows the datagrams of systemd's protocol and its environment variables; knows nothing of the program that runs.

1. Without ``NOTIFY_SOCKET`` nothing is sent.
2. If the manager does not listen, the program goes on: what cannot be sent is dropped.
3. A task of the event loop sends ``WATCHDOG=1`` twice in each interval of ``WATCHDOG_USEC``. If the event loop is
   stuck, nothing is sent, and the manager restarts the program.
4. The protocol is one datagram with lines of text: too little for a dependency.
"""

import asyncio
import contextlib
import os
import socket
import time
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from typing import Final

_MICROSECONDS: Final = 1_000_000


class Manager:
    """Sends messages to the service manager, such as systemd, that started this program; without one, nothing is sent.

    Args:
        environment: environment variables to use instead of those of the process.

    Attributes:
        watchdog: seconds within which the manager expects each next call of `alive`; None without a watchdog.
    """

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        variables = os.environ if environment is None else environment
        self._address = _address(variables.get("NOTIFY_SOCKET", ""))
        self.watchdog: float | None = _watchdog(variables) if self._address else None

    @property
    def is_there(self) -> bool:
        """Whether the environment names the socket of a service manager, so that messages are sent."""
        return bool(self._address)

    def ready(self, status: str) -> None:
        """Tell the service manager that the start or a reload is done; ``status`` is a line about the program."""
        self._send("READY=1", f"STATUS={status}")

    def reloading(self) -> None:
        """Tell the service manager that the program reads its files again; `ready` ends that."""
        self._send("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self, status: str) -> None:
        """Tell the service manager that the program is about to end; ``status`` is a line about it."""
        self._send("STOPPING=1", f"STATUS={status}")

    def alive(self) -> None:
        """Tell the watchdog of the service manager that the program still works."""
        self._send("WATCHDOG=1")

    def _send(self, *assignments: str) -> None:
        if not self._address:
            return
        text = "\n".join(each.replace("\n", " ") for each in assignments)
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.setblocking(False)
            sender.sendto(text.encode(), self._address)


@asynccontextmanager
async def watched(manager: Manager) -> AsyncIterator[None]:
    """Context manager during which a task regularly tells the service manager's watchdog that the event loop works.

    Does nothing without a watchdog.
    """
    if manager.watchdog is None:
        yield
        return
    task = asyncio.get_running_loop().create_task(_keep_telling(manager, manager.watchdog / 2))
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def _keep_telling(manager: Manager, seconds: float) -> None:
    while True:
        manager.alive()
        await asyncio.sleep(seconds)


def _address(name: str) -> str:
    """Return the socket address for the value of ``NOTIFY_SOCKET``: a path, or ``@NAME`` for an abstract socket.

    Empty if the value has neither form, or the system has no Unix sockets.
    """
    if not hasattr(socket, "AF_UNIX"):
        return ""
    if name.startswith("@"):
        return "\0" + name[1:]
    return name if name.startswith("/") else ""


def _watchdog(variables: Mapping[str, str]) -> float | None:
    """Return the interval of the service manager's watchdog in seconds; None if this process has no watchdog."""
    microseconds, process = variables.get("WATCHDOG_USEC", ""), variables.get("WATCHDOG_PID", "")
    if not (microseconds.isascii() and microseconds.isdecimal()) or not int(microseconds):
        return None
    if process and process != str(os.getpid()):
        return None
    return int(microseconds) / _MICROSECONDS

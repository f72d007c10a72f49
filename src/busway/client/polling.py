"""Waits of a blocking link at its socket or serial port, until it is readable or a time is over.

Knows descriptors; knows no conversation.
"""

import select
from typing import Final

from ..transport.serial.waiting import wait_ready
from .channel import Channel

_LONGEST_WAIT: Final = 0.25
"""Longest single wait at a port, in seconds: closing it does not wake a thread that waits there."""


class ExactPoll:
    """Waits until one serial port is ready, with exact timing: it wakes ``spin`` seconds early and waits busily."""

    def __init__(self, spin: float) -> None:
        self._spin = spin

    def wait(self, connection: Channel, seconds: float, writes: bool) -> bool:
        """Wait until bytes can be received (or sent, if ``writes``); return False after ``seconds`` without."""
        if seconds > self._spin:
            seconds -= self._spin
        try:
            descriptor = connection.fileno()
            return bool(wait_ready([descriptor], [descriptor] if writes else [], min(seconds, _LONGEST_WAIT)))
        except (OSError, ValueError):
            return False  # another thread closed the port while this one was about to wait


class Poll:
    """Waits until one socket is ready, with ``poll`` where the system has it: it has no highest descriptor."""

    def __init__(self, connection: Channel) -> None:
        self._poll = select.poll() if hasattr(select, "poll") else None
        self._writes = False
        if self._poll is not None:
            self._poll.register(connection, select.POLLIN)

    def wait(self, connection: Channel, seconds: float, writes: bool) -> bool:
        """Wait until bytes can be received (or sent, if ``writes``); return False after ``seconds`` without."""
        if self._poll is None:
            readable, writable, _ = select.select([connection], [connection] if writes else [], [], seconds)
            return bool(readable or writable)
        try:
            if writes != self._writes:
                self._writes = writes
                self._poll.modify(connection, select.POLLIN | (select.POLLOUT if writes else 0))
            return bool(self._poll.poll(seconds * 1000 + 0.5))
        except (OSError, ValueError):
            return False  # another thread closed the socket while this one was about to wait
